//! TCP connections to servers.

use std::io;
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

/// How long a server may take to accept the connection, and to accept data.
pub(crate) const PATIENCE: Duration = Duration::from_secs(3);

/// Connects to the first address of the server that answers.
pub(crate) fn connect(server: &str, default_port: Option<u16>) -> io::Result<TcpStream> {
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
