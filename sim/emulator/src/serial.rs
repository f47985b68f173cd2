//! A board's USART for other programs: as a pseudo-terminal, which they open like a serial port, or
//! over TCP.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};

use crate::machine::Machine;

/// The most bytes of the board that wait for a client to read them; the oldest are lost.
const MOST_UNREAD: usize = 16 * 1024;
/// The most bytes of a client that wait to be sent to the board.
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
    /// The clients' end. Because it stays open here, clients may connect and disconnect.
    _theirs: serialport::TTYPort,
}

impl Serial {
    /// A pseudo-terminal for a USART.
    ///
    /// # Errors
    /// The operating system's error.
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
    /// The operating system's error: it cannot listen at the address.
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

    /// The address for clients: the name of the terminal, or `tcp://` and the address.
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

    /// Passes bytes between board and client in both directions; does not wait. Returns the number
    /// of bytes that the client got.
    pub fn exchange(&mut self, machine: &mut Machine) -> usize {
        let now = machine.now();
        let powered = machine.is_powered();
        let Some(usart) = machine.usart_mut(self.usart) else { return 0 };
        self.unread.extend(usart.take_sent().iter().map(|character| character.byte));
        let too_many = self.unread.len().saturating_sub(MOST_UNREAD);
        self.unread.drain(..too_many);
        if self.unheard.len() < MOST_UNHEARD {
            let mut bytes = [0; MOST_UNHEARD];
            let len = self.line.read(&mut bytes);
            self.unheard.extend(&bytes[..len]);
        }
        if powered {
            let taken = usart.receive(self.unheard.make_contiguous(), now);
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
    /// Reads the client's bytes; returns 0 if there are none.
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

    /// Gives the client as many bytes as it takes. Without a TCP client all bytes are lost.
    fn write(&mut self, bytes: &[u8]) -> usize {
        if bytes.is_empty() {
            return 0;
        }
        match self {
            #[cfg(unix)]
            // A write waits until all bytes find room, and the check before it only says that
            // there is some room. So write a byte at a time.
            Self::Terminal(terminal) => {
                bytes.iter().take_while(|byte| matches!(terminal.ours.write(&[**byte]), Ok(1))).count()
            }
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

/// Whether the error only means that there is nothing to do at present.
fn is_patient(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted | ErrorKind::TimedOut)
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;
    use crate::machine::Options;
    use crate::peripheral::Peripheral;
    use crate::time::Time;
    use shared_abi::geometry::STM32F407VG;

    /// A board whose USART2 is on: 16 MHz, 139 cycles a bit.
    fn board() -> Machine {
        let mut machine = Machine::new(&STM32F407VG, Options::default()).unwrap();
        machine.power_on(Time(0));
        let usart = machine.usart_mut("USART2").unwrap();
        usart.set_clock(16_000_000);
        usart.set_wired(true, true);
        usart.write(0x08, 139, Time(0)).unwrap();
        usart.write(0x0C, 1 << 13 | 1 << 3 | 1 << 2, Time(0)).unwrap();
        machine
    }

    fn say(machine: &mut Machine, byte: u8) {
        let usart = machine.usart_mut("USART2").unwrap();
        usart.write(0x04, byte.into(), Time(0)).unwrap();
        usart.advance(Time(1_000_000_000));
    }

    /// Exchanges until something is true; the host's own line may take its time.
    fn until(serial: &mut Serial, machine: &mut Machine, mut is_so: impl FnMut(&mut Machine) -> bool) {
        let began = Instant::now();
        while !is_so(machine) {
            assert!(began.elapsed() < Duration::from_secs(20), "it never is");
            serial.exchange(machine);
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn waiting(machine: &mut Machine) -> usize {
        machine.usart_mut("USART2").unwrap().waiting()
    }

    #[test]
    fn clients_come_and_go() {
        let mut machine = board();
        let mut serial = Serial::listen("USART2", "127.0.0.1:0").unwrap();
        let address = serial.place().replace("tcp://", "");
        // No client is connected: the bytes are lost, and nothing waits.
        say(&mut machine, b'a');
        assert_eq!(serial.exchange(&mut machine), 1);
        for byte in [b'b', b'c'] {
            let mut client = TcpStream::connect(&address).unwrap();
            client.write_all(&[byte; 3]).unwrap();
            let before = waiting(&mut machine);
            until(&mut serial, &mut machine, |machine| waiting(machine) == before + 3);
            say(&mut machine, byte);
            serial.exchange(&mut machine);
            let mut heard = [0];
            client.read_exact(&mut heard).unwrap();
            assert_eq!(heard, [byte]);
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_terminal_that_nobody_reads_holds_nothing_up() {
        let mut machine = board();
        let mut serial = Serial::terminal("USART2").unwrap();
        for n in 0..40_000_u32 {
            say(&mut machine, n as u8);
            if n % 100 == 0 {
                serial.exchange(&mut machine);
            }
        }
        assert!(serial.unread.len() <= MOST_UNREAD);
        let mut port = std::fs::OpenOptions::new().read(true).write(true).open(serial.place()).unwrap();
        port.write_all(b"abc").unwrap();
        until(&mut serial, &mut machine, |machine| waiting(machine) == 3);
    }

    #[test]
    fn a_board_without_power_hears_nothing() {
        let mut machine = board();
        let mut serial = Serial::listen("USART2", "127.0.0.1:0").unwrap();
        let mut client = TcpStream::connect(serial.place().replace("tcp://", "")).unwrap();
        client.write_all(b"x").unwrap();
        until(&mut serial, &mut machine, |machine| waiting(machine) == 1);
        machine.power_off();
        client.write_all(b"y").unwrap();
        for _ in 0..20 {
            serial.exchange(&mut machine);
            std::thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(waiting(&mut machine), 0);
    }
}
