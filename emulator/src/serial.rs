//! A board's USART for other programs: as a pseudo-terminal, which they open like a serial port, or over TCP.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};

use crate::machine::Machine;

/// Bytes of the board that a client has not read; the oldest are lost.
const MOST_UNREAD: usize = 16 * 1024;
/// Bytes of a client that are not on their way to the board yet.
const MOST_UNHEARD: usize = 4 * 1024;

/// The other end of a USART's line.
pub struct Serial {
    /// Which USART.
    usart: &'static str,
    line: Line,
    unread: VecDeque<u8>,
    unheard: VecDeque<u8>,
}

enum Line {
    #[cfg(unix)]
    Terminal(Terminal),
    Tcp {
        listener: TcpListener,
        client: Option<TcpStream>,
    },
}

/// A pseudo-terminal.
#[cfg(unix)]
struct Terminal {
    ours: serialport::TTYPort,
    name: String,
    /// The clients' end: as long as it is open here, they may come and go.
    _theirs: serialport::TTYPort,
}

impl Serial {
    /// A pseudo-terminal for a USART.
    ///
    /// # Errors
    /// When the system gives none.
    #[cfg(unix)]
    pub fn terminal(usart: &'static str) -> io::Result<Self> {
        use serialport::SerialPort;
        let (mut ours, theirs) = serialport::TTYPort::pair()?;
        ours.set_timeout(std::time::Duration::ZERO)?;
        let name = theirs.name().ok_or_else(|| io::Error::other("a pseudo-terminal without a name"))?;
        Ok(Self::with(usart, Line::Terminal(Terminal { ours, name, _theirs: theirs })))
    }

    /// A USART for one client at a time that connects to this address.
    ///
    /// # Errors
    /// When it cannot be listened at.
    pub fn listen(usart: &'static str, address: impl ToSocketAddrs) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Self::with(usart, Line::Tcp { listener, client: None }))
    }

    fn with(usart: &'static str, line: Line) -> Self {
        Self { usart, line, unread: VecDeque::new(), unheard: VecDeque::new() }
    }

    /// The USART.
    #[must_use]
    pub fn usart(&self) -> &'static str {
        self.usart
    }

    /// Where clients find it: the name of the terminal, or `tcp://` and the address.
    #[must_use]
    pub fn place(&self) -> String {
        match &self.line {
            #[cfg(unix)]
            Line::Terminal(terminal) => terminal.name.clone(),
            Line::Tcp { listener, .. } => {
                let unknown = SocketAddr::from(([0, 0, 0, 0], 0));
                format!("tcp://{}", listener.local_addr().unwrap_or(unknown))
            }
        }
    }

    /// Carries over what the board and the client have to say to each other; waits for nothing. Gives the number of bytes that the
    /// client got.
    pub fn exchange(&mut self, machine: &mut Machine) -> usize {
        let now = machine.now();
        let powered = machine.is_powered();
        let Some(usart) = machine.usart_mut(self.usart) else { return 0 };
        self.unread.extend(usart.take_heard().iter().map(|character| character.byte));
        let too_many = self.unread.len().saturating_sub(MOST_UNREAD);
        self.unread.drain(..too_many);
        if self.unheard.len() < MOST_UNHEARD {
            let mut bytes = [0; MOST_UNHEARD];
            let len = self.line.read(&mut bytes);
            self.unheard.extend(&bytes[..len]);
        }
        if powered {
            let taken = usart.hear(self.unheard.make_contiguous(), now);
            self.unheard.drain(..taken);
        } else {
            self.unheard.clear();
        }
        let written = self.line.write(self.unread.make_contiguous());
        self.unread.drain(..written);
        written
    }
}

impl Line {
    /// What the client says; nothing where there is none.
    fn read(&mut self, bytes: &mut [u8]) -> usize {
        match self {
            #[cfg(unix)]
            Self::Terminal(terminal) => terminal.ours.read(bytes).unwrap_or(0),
            Self::Tcp { listener, client } => {
                if client.is_none() {
                    *client = listener.accept().ok().map(|(stream, _)| stream).filter(|stream| {
                        stream.set_nonblocking(true).and_then(|()| stream.set_nodelay(true)).is_ok()
                    });
                }
                let Some(stream) = client else { return 0 };
                match stream.read(bytes) {
                    Ok(len) if len > 0 => len,
                    Err(error) if is_patient(&error) => 0,
                    _ => {
                        *client = None;
                        0
                    }
                }
            }
        }
    }

    /// Gives the client as much as it takes. A line that nobody is at takes everything.
    fn write(&mut self, bytes: &[u8]) -> usize {
        if bytes.is_empty() {
            return 0;
        }
        match self {
            #[cfg(unix)]
            Self::Terminal(terminal) => terminal.ours.write(bytes).unwrap_or(0),
            Self::Tcp { client, .. } => {
                let Some(stream) = client else { return bytes.len() };
                match stream.write(bytes) {
                    Ok(len) => len,
                    Err(error) if is_patient(&error) => 0,
                    Err(_) => {
                        *client = None;
                        bytes.len()
                    }
                }
            }
        }
    }
}

/// Nothing is wrong, there is only nothing to do.
fn is_patient(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted | ErrorKind::TimedOut)
}
