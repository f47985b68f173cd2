//! SLCAN: CAN frames as text over a serial line (Lawicel CAN232 manual, version 3), or over TCP.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use canopen::Frame;
use embedded_can::{ExtendedId, Frame as _, Id, StandardId};
use shared_abi::bxcan::data_length;

use super::adapter::{Adapter, AdapterError};
use super::digits::{hex_bytes, hex_number};
use super::echo::Echoes;
use super::health::{Controller, Health, Losses};
use super::ports;
use super::tcp::{connect, read_within, waits, PATIENCE};

mod opening;
mod queue;
mod sending;

use self::queue::Sending;

/// How long an adapter may take to answer a command. Some adapters never answer, but work.
const ANSWER: Duration = Duration::from_millis(300);

/// Longer than any message of the protocol. The rest of a longer line is dropped.
const LONGEST_MESSAGE: usize = 64;
/// The most frames that are kept while the tool waits for an answer, or for their echoes.
const MOST_EARLY: usize = 1024;
/// The speed of a serial line in bit/s, if the URL has none; adapters on USB ignore it.
pub(super) const BAUD: u32 = 115_200;

/// The line that carries the text.
pub trait Line: Read + Write {
    /// Sets how long a read waits at most.
    ///
    /// # Errors
    /// The line is gone.
    fn set_timeout(&mut self, timeout: Duration) -> io::Result<()>;

    /// Reads what arrives within this time.
    ///
    /// # Errors
    /// Nothing has arrived, or the line is gone.
    fn read_within(&mut self, bytes: &mut [u8], timeout: Duration) -> io::Result<usize> {
        self.set_timeout(timeout)?;
        self.read(bytes)
    }

    /// The time on the clock of the line's other end.
    fn now(&self) -> Instant {
        Instant::now()
    }
}

impl Line for TcpStream {
    fn set_timeout(&mut self, timeout: Duration) -> io::Result<()> {
        // Zero would mean no time-out.
        self.set_read_timeout(Some(timeout.max(Duration::from_micros(1))))
    }

    fn read_within(&mut self, bytes: &mut [u8], timeout: Duration) -> io::Result<usize> {
        read_within(self, bytes, timeout)
    }
}

impl Line for Box<dyn serialport::SerialPort> {
    fn set_timeout(&mut self, timeout: Duration) -> io::Result<()> {
        (**self).set_timeout(timeout).map_err(io::Error::from)
    }
}

/// An adapter that speaks SLCAN.
#[derive(Debug)]
pub struct Slcan<L: Line> {
    line: L,
    name: String,
    opened: Instant,
    /// When the last bytes came.
    heard: Instant,
    /// Received bytes of an incomplete message.
    partial: Vec<u8>,
    /// Received bytes that were not parsed yet.
    rest: Vec<u8>,
    /// Frames that arrived while the tool waited for an answer.
    early: VecDeque<Frame>,
    /// The adapter sends back what it gets.
    echoes: bool,
    /// Frames that were sent and did not come back yet, if the adapter echoes.
    sent: Echoes<MOST_EARLY>,
    /// Frames on their way into the adapter's queue.
    sending: Sending,
    /// The command for the bit rate, if the tool sets it.
    rate: Option<String>,
    /// The speed of the line, if it is a serial port.
    baud: Option<u32>,
    /// Lines outside the protocol that came since the bus is open.
    strange: u32,
    /// The first line outside the protocol that came while the adapter was opened.
    odd: Option<String>,
}

/// A message of the adapter.
#[derive(Debug, PartialEq, Eq)]
enum Message {
    /// A line, without its end character.
    Text(Vec<u8>),
    /// A refusal (BEL).
    Refused,
}

impl Slcan<TcpStream> {
    /// Connects to an adapter at `host:port`, or to a server that acts as one, and opens its bus.
    ///
    /// # Errors
    /// [`AdapterError::Open`] or [`AdapterError::Protocol`].
    pub fn connect(server: &str, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        let name = format!("SLCAN adapter {server}");
        let line = connect(&name, server, None, PATIENCE)?;
        Self::opened(line, name).open_bus(bit_rate)
    }
}

impl Slcan<Box<dyn serialport::SerialPort>> {
    /// Opens the serial port `port` at `baud` bit/s and the bus of its adapter.
    ///
    /// # Errors
    /// [`AdapterError::Open`] or [`AdapterError::Protocol`].
    pub fn serial(port: &str, baud: u32, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        let name = format!("SLCAN adapter {port}");
        let line = serialport::new(port, baud)
            .timeout(PATIENCE)
            .open()
            .map_err(|error| ports::refused(name.clone(), port, &error))?;
        let mut adapter = Self::opened(line, name);
        adapter.baud = Some(baud);
        adapter.open_bus(bit_rate)
    }
}

impl<L: Line> Slcan<L> {
    /// The adapter at the other end of `line`; its bus is open already.
    pub fn opened(line: L, name: String) -> Self {
        Self {
            opened: line.now(),
            heard: line.now(),
            sending: Sending::new(line.now()),
            rate: None,
            baud: None,
            line,
            name,
            partial: Vec::new(),
            rest: Vec::new(),
            early: VecDeque::new(),
            echoes: false,
            sent: Echoes::default(),
            strange: 0,
            odd: None,
        }
    }

    /// Keeps a frame that arrived while the tool waited for another message. Frames may come as
    /// soon as the bus is open. Returns whether it was a frame.
    fn stray(&mut self, text: &[u8]) -> bool {
        let frame = parse_frame(text).filter(|frame| !self.sent.takes(frame));
        if let Some(frame) = frame.filter(|_| self.early.len() < MOST_EARLY) {
            self.early.push_back(frame);
        }
        frame.is_some()
    }

    /// The status flags; `None` if the adapter does not send them.
    fn flags(&mut self) -> Result<Option<u32>, AdapterError> {
        self.settle()?;
        self.send_text("F\r")?;
        let deadline = self.line.now() + ANSWER;
        while let Some(Message::Text(text)) = self.message(deadline)? {
            if let Some(flags) = status_flags(&text) {
                return Ok(Some(flags));
            }
            self.stray(&text);
            if self.line.now() >= deadline {
                break;
            }
        }
        Ok(None)
    }

    fn send_text(&mut self, text: &str) -> Result<(), AdapterError> {
        self.write_text(text)?;
        self.line.flush().map_err(|error| self.lost(error))
    }

    /// Writes text without waiting until the line has sent it. A serial port has one time-out for both ways.
    fn write_text(&mut self, text: &str) -> Result<(), AdapterError> {
        let done = self.line.set_timeout(PATIENCE).and_then(|()| self.line.write_all(text.as_bytes()));
        done.map_err(|error| self.lost(error))
    }

    /// The next message; `None` if the deadline has passed.
    fn message(&mut self, deadline: Instant) -> Result<Option<Message>, AdapterError> {
        loop {
            if let Some(message) = self.take() {
                return Ok(Some(message));
            }
            let left = deadline.saturating_duration_since(self.line.now());
            let mut bytes = [0; 4096];
            // After the deadline the line is read once more: data may have arrived already.
            match self.line.read_within(&mut bytes, left) {
                Ok(0) => {
                    let closed = io::Error::new(ErrorKind::ConnectionAborted, "the line was closed");
                    return Err(self.lost(closed));
                }
                Ok(len) => {
                    self.heard = self.line.now();
                    self.rest.extend_from_slice(&bytes[..len]);
                }
                Err(error) if waits(&error) => {}
                Err(error) => return Err(self.lost(error)),
            }
            if left.is_zero() {
                return Ok(self.take());
            }
        }
    }

    /// Takes a complete message from the received bytes.
    fn take(&mut self) -> Option<Message> {
        let mut taken = None;
        let mut used = 0;
        for byte in &self.rest {
            // BEL alone is a refusal; it also ends a line, such as the title in a shell's prompt.
            if *byte == 0x07 && !self.partial.is_empty() {
                taken = Some(Message::Text(std::mem::take(&mut self.partial)));
                break;
            }
            used += 1;
            match byte {
                b'\r' => taken = Some(Message::Text(std::mem::take(&mut self.partial))),
                0x07 => taken = Some(Message::Refused),
                b'\n' => {}
                byte if self.partial.len() < LONGEST_MESSAGE => self.partial.push(*byte),
                _ => {}
            }
            if taken.is_some() {
                break;
            }
        }
        self.rest.drain(..used);
        taken
    }

    fn lost(&self, source: io::Error) -> AdapterError {
        AdapterError::Lost { adapter: self.name.clone(), source: source.into() }
    }

    fn unexpected(&self, said: String) -> AdapterError {
        AdapterError::Protocol { adapter: self.name.clone(), said }
    }
}

impl<L: Line> Drop for Slcan<L> {
    /// Closes the bus, so that the adapter's buffers do not fill up while no program reads. An
    /// error is ignored: the adapter may be gone.
    fn drop(&mut self) {
        let _ = self.send_text("C\r");
    }
}

impl<L: Line> Adapter for Slcan<L> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.hand_over(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let deadline = self.line.now() + timeout;
        loop {
            if let Some(frame) = self.early.pop_front() {
                return Ok(Some(frame));
            }
            let until = self.sending.due().map_or(deadline, |due| due.min(deadline));
            let message = self.message(until)?;
            if let Some(frame) = message.as_ref().and_then(|message| self.hear(message)) {
                return Ok(Some(frame));
            }
            self.go_on()?;
            if self.line.now() >= deadline {
                return Ok(self.early.pop_front());
            }
        }
    }

    fn now(&self) -> Duration {
        self.line.now().saturating_duration_since(self.opened)
    }

    /// Reads the status flags (`F`), which not all adapters know.
    fn health(&mut self) -> Option<Health> {
        let controller = self.flags().ok().flatten().map(|flags| match flags {
            flags if flags & PASSIVE != 0 => Controller::Passive,
            flags if flags & WARNING != 0 => Controller::Warning,
            _ => Controller::Active,
        });
        let (losses, strange) = (self.losses(), self.strange);
        let known = controller.is_some() || losses != Losses::default() || strange > 0;
        known.then_some(Health { controller, losses, strange, ..Health::default() })
    }

    fn losses(&self) -> Losses {
        self.sending.losses
    }
}

/// Bits of the status flags: error warning and error passive.
const WARNING: u32 = 0x04;
const PASSIVE: u32 = 0x20;

/// `Fxx`.
fn status_flags(text: &[u8]) -> Option<u32> {
    let digits = text.strip_prefix(b"F").filter(|digits| digits.len() == 2)?;
    hex_number(std::str::from_utf8(digits).ok()?)
}

/// Whether a line is the version of the protocol: `V` and digits, such as `V1013`. An adapter may
/// have echoed the command before it.
fn is_version(text: &[u8]) -> bool {
    let version = text.strip_prefix(b"VV").or_else(|| text.strip_prefix(b"V"));
    version.is_some_and(|version| version.first().is_some_and(u8::is_ascii_digit))
}

/// Whether a line that has no frame is one of the protocol: an acknowledgement, the answer to a command of
/// before, or a CAN FD frame of those that have extended it.
fn is_of_protocol(text: &[u8]) -> bool {
    matches!(text, b"" | b"z" | b"Z" | [b'd' | b'D' | b'b' | b'B' | b'N', ..])
        || status_flags(text).is_some()
        || is_version(text)
}

/// `t6018400010…`, `T1234567880…`, `r6018`, `R123456788`, with the end of the line.
fn text_of(frame: &Frame) -> String {
    let (kind, id) = match (frame.id(), frame.is_remote_frame()) {
        (Id::Standard(id), false) => ('t', format!("{:03X}", id.as_raw())),
        (Id::Standard(id), true) => ('r', format!("{:03X}", id.as_raw())),
        (Id::Extended(id), false) => ('T', format!("{:08X}", id.as_raw())),
        (Id::Extended(id), true) => ('R', format!("{:08X}", id.as_raw())),
    };
    let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
    format!("{kind}{id}{}{data}\r", frame.dlc())
}

/// The frame in a message. A time stamp may follow it: four digits (the command `Z1`), or eight in
/// firmwares that count microseconds (`Z2`).
fn parse_frame(text: &[u8]) -> Option<Frame> {
    let text = std::str::from_utf8(text).ok().filter(|text| text.is_ascii())?;
    let kind = text.chars().next()?;
    let digits = match kind {
        't' | 'r' => 3,
        'T' | 'R' => 8,
        _ => return None,
    };
    let number = hex_number(text.get(1..=digits)?)?;
    let id: Id = if digits == 3 {
        StandardId::new(u16::try_from(number).ok()?)?.into()
    } else {
        ExtendedId::new(number)?.into()
    };
    // An adapter may hand on a data length code above 8, in hexadecimal.
    let dlc = data_length(hex_number(text.get(digits + 1..digits + 2)?)? as u8);
    let is_remote = kind.eq_ignore_ascii_case(&'r');
    let rest = text.get(digits + 2..)?;
    let (data, time) = rest.split_at_checked(if is_remote { 0 } else { 2 * dlc })?;
    if !matches!(time.len(), 0 | 4 | 8) || !time.bytes().all(|digit| digit.is_ascii_hexdigit()) {
        return None;
    }
    match is_remote {
        true => Frame::new_remote(id, dlc),
        false => Frame::new(id, &hex_bytes(data)?),
    }
}

#[cfg(test)]
mod tests;
