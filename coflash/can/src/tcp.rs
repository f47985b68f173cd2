//! TCP connections to servers.

use std::io::{self, ErrorKind, Read};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use super::adapter::AdapterError;

/// How long a server may take to accept the connection, and to accept data.
pub(crate) const PATIENCE: Duration = Duration::from_secs(3);

/// Whether the error only means that the socket has no data, or no room, at present.
pub(crate) fn waits(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

/// Reads what arrives within this time. The stream's own time-out would be rounded up to the system's tick of some
/// milliseconds.
#[cfg(unix)]
pub(crate) fn read_within(stream: &mut TcpStream, bytes: &mut [u8], timeout: Duration) -> io::Result<usize> {
    use rustix::event::{poll, PollFd, PollFlags, Timespec};

    let timeout = Timespec::try_from(timeout).map_err(|_| ErrorKind::InvalidInput)?;
    match poll(&mut [PollFd::new(stream, PollFlags::IN)], Some(&timeout))? {
        0 => Err(ErrorKind::TimedOut.into()),
        _ => stream.read(bytes),
    }
}

/// Reads what arrives within this time, in pauses that are shorter than the system's tick.
#[cfg(not(unix))]
pub(crate) fn read_within(stream: &mut TcpStream, bytes: &mut [u8], timeout: Duration) -> io::Result<usize> {
    stream.set_nonblocking(true)?;
    let end = std::time::Instant::now() + timeout;
    let read = loop {
        match stream.read(bytes) {
            Err(error) if waits(&error) && std::time::Instant::now() < end => {
                std::thread::sleep(Duration::from_micros(100));
            }
            read => break read,
        }
    };
    stream.set_nonblocking(false)?;
    read
}

/// Connects to a server, `name` in messages. A read or a write waits for at most `wait`. Messages are
/// small, and each is waited for: Nagle's algorithm would delay them.
pub(crate) fn connect(
    name: &str,
    server: &str,
    default_port: Option<u16>,
    wait: Duration,
) -> Result<TcpStream, AdapterError> {
    let connected = stream(server, default_port).and_then(|stream| {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(wait))?;
        stream.set_write_timeout(Some(wait))?;
        Ok(stream)
    });
    connected.map_err(|source| AdapterError::Open { adapter: name.to_string(), source: source.into() })
}

/// Connects to the first address of the server that answers.
fn stream(server: &str, default_port: Option<u16>) -> io::Result<TcpStream> {
    let has_port = server.rsplit_once(':').is_some_and(|(host, port)| {
        !port.is_empty()
            && port.bytes().all(|b| b.is_ascii_digit())
            && (!host.contains(':') || host.ends_with(']'))
    });
    let server = match default_port {
        Some(port) if !has_port => format!("{server}:{port}"),
        _ => server.to_string(),
    };
    let mut result = Err(io::Error::new(io::ErrorKind::NotFound, "the host has no address"));
    for address in server.to_socket_addrs()? {
        result = TcpStream::connect_timeout(&address, PATIENCE);
        if result.is_ok() {
            break;
        }
    }
    result
}
