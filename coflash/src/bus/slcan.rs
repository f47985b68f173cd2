//! SLCAN: CAN frames as text over a serial line (Lawicel CAN232 manual, version 3), or over TCP.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use canopen::Frame;
use embedded_can::{ExtendedId, Frame as _, Id, StandardId};

use super::adapter::{Adapter, AdapterError};
use super::found::shown;
use super::health::{Controller, Health};
use super::hex::{hex_bytes, hex_number};
use super::ports;
use super::tcp::{connect, PATIENCE};

/// How long an adapter may take to answer a command. Some adapters never answer, but work.
const ANSWER: Duration = Duration::from_millis(300);
/// Longer than any message of the protocol.
const LONGEST_MESSAGE: usize = 64;
/// The most frames that are kept while the tool waits for an answer.
const MOST_EARLY: usize = 1024;
/// The speed of a serial line; adapters on USB ignore it.
const BAUD: u32 = 115_200;

/// The bit rates in the order of their commands (`S0` to `S8`).
const BIT_RATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

/// The line that carries the text.
pub trait Line: Read + Write {
    /// Sets how long a read waits at most.
    ///
    /// # Errors
    /// The line is gone.
    fn set_timeout(&mut self, timeout: Duration) -> io::Result<()>;

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
    /// Received bytes of an incomplete message.
    partial: Vec<u8>,
    /// Received bytes that were not parsed yet.
    rest: Vec<u8>,
    /// Frames that arrived while the tool waited for an answer.
    early: VecDeque<Frame>,
    /// A message outside the protocol that the adapter sent while it was opened.
    odd: Option<String>,
}

/// The result of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Answer {
    /// The adapter answered as the protocol requires.
    Done,
    /// The adapter refused (BEL).
    Refused,
    /// The adapter sent nothing, or nothing of the protocol.
    None,
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
        let open = |source| AdapterError::Open { adapter: name.clone(), source };
        let stream = connect(server, None).map_err(open)?;
        stream.set_nodelay(true).map_err(open)?;
        stream.set_write_timeout(Some(PATIENCE)).map_err(open)?;
        Self::open(stream, name, bit_rate)
    }
}

impl Slcan<Box<dyn serialport::SerialPort>> {
    /// Opens the serial port `port` and the bus of its adapter.
    ///
    /// # Errors
    /// [`AdapterError::Open`] or [`AdapterError::Protocol`].
    pub fn serial(port: &str, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        let name = format!("SLCAN adapter {port}");
        let line = serialport::new(port, BAUD)
            .timeout(PATIENCE)
            .open()
            .map_err(|error| ports::refused(name.clone(), port, &error))?;
        Self::open(line, name, bit_rate)
    }
}

impl<L: Line> Slcan<L> {
    /// Opens the bus of the adapter at the other end of `line`, at `bit_rate` (bit/s) or at the
    /// adapter's current bit rate.
    ///
    /// # Errors
    /// [`AdapterError::Protocol`] if the adapter refuses, [`AdapterError::Lost`] if the line fails.
    pub fn open(line: L, name: String, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        let mut adapter = Self::opened(line, name);
        // End a session that was active before, and close the bus. The adapter refuses C if the bus
        // is closed already, which does no harm.
        adapter.send_text("\r\rC\r")?;
        adapter.settle()?;
        // The version: an adapter that sends no acknowledgements answers at least this command.
        let version = adapter.command("V\r", |text| text.len() > 1 && text[0] == b'V')?;
        if let Some(rate) = bit_rate {
            let Some(number) = BIT_RATES.iter().position(|known| *known == rate) else {
                return Err(adapter.unexpected(format!("it does not support {rate} bit/s")));
            };
            if adapter.command(&format!("S{number}\r"), <[u8]>::is_empty)? == Answer::Refused {
                return Err(adapter.unexpected("it refuses the bit rate".to_string()));
            }
        }
        match adapter.command("O\r", <[u8]>::is_empty)? {
            Answer::Refused => Err(adapter.unexpected("it refuses to open the bus".to_string())),
            Answer::None if version == Answer::None => Err(adapter.mute()),
            Answer::Done | Answer::None => Ok(adapter),
        }
    }

    /// The adapter at the other end of `line`; its bus is open already.
    pub fn opened(line: L, name: String) -> Self {
        Self {
            opened: line.now(),
            line,
            name,
            partial: Vec::new(),
            rest: Vec::new(),
            early: VecDeque::new(),
            odd: None,
        }
    }

    /// Sends a command and waits for the answer that `answers` recognises.
    fn command(&mut self, text: &str, answers: impl Fn(&[u8]) -> bool) -> Result<Answer, AdapterError> {
        self.send_text(text)?;
        let deadline = self.line.now() + ANSWER;
        while let Some(message) = self.message(deadline)? {
            match message {
                Message::Refused => return Ok(Answer::Refused),
                Message::Text(text) if answers(&text) => return Ok(Answer::Done),
                Message::Text(text) => self.stray(&text),
            }
            // The deadline also ends the wait on a line that sends without pause.
            if self.line.now() >= deadline {
                break;
            }
        }
        Ok(Answer::None)
    }

    /// Keeps a message that arrived while the tool waited for another one.
    fn stray(&mut self, text: &[u8]) {
        match parse_frame(text) {
            // Frames may come as soon as the bus is open.
            Some(frame) if self.early.len() < MOST_EARLY => self.early.push_back(frame),
            Some(_) => {}
            None if text.is_empty() || matches!(text, b"z" | b"Z") => {}
            None => self.odd = Some(shown(text)),
        }
    }

    /// The error for a device that answers neither V nor O: it is not an SLCAN adapter.
    fn mute(&self) -> AdapterError {
        let said = match &self.odd {
            Some(odd) => format!("; it sent '{odd}'"),
            None => String::new(),
        };
        let what = format!("it answered neither V (version) nor O (open the bus){said}");
        let advice = format!(
            "this is not an SLCAN adapter, or another port of it: {}; some adapters must be switched to SLCAN, or speak gs_usb \
             (coflash adapters)",
            ports::those_there()
        );
        AdapterError::unusable(self.name.clone(), what, advice)
    }

    /// Reads until nothing more arrives.
    fn settle(&mut self) -> Result<(), AdapterError> {
        let end = self.line.now() + ANSWER;
        while self.line.now() < end {
            let quiet = self.line.now() + Duration::from_millis(50);
            match self.message(quiet.min(end))? {
                Some(Message::Text(text)) if parse_frame(&text).is_none() => self.stray(&text),
                // Frames of a bus that was open before belong to an earlier session.
                Some(_) => {}
                None => break,
            }
        }
        Ok(())
    }

    fn send_text(&mut self, text: &str) -> Result<(), AdapterError> {
        let done = self.line.write_all(text.as_bytes()).and_then(|()| self.line.flush());
        done.map_err(|error| self.lost(error))
    }

    /// The next message; `None` if the deadline has passed.
    fn message(&mut self, deadline: Instant) -> Result<Option<Message>, AdapterError> {
        loop {
            if let Some(message) = self.take()? {
                return Ok(Some(message));
            }
            let left = deadline.saturating_duration_since(self.line.now());
            let mut bytes = [0; 4096];
            // Received data are read even after the deadline.
            let read = self.line.set_timeout(left).and_then(|()| self.line.read(&mut bytes));
            match read {
                Ok(0) => {
                    let closed = io::Error::new(ErrorKind::ConnectionAborted, "the line was closed");
                    return Err(self.lost(closed));
                }
                Ok(len) => self.rest.extend_from_slice(&bytes[..len]),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                    if deadline <= self.line.now() {
                        return Ok(None);
                    }
                }
                Err(error) => return Err(self.lost(error)),
            }
        }
    }

    /// Takes a complete message from the received bytes.
    fn take(&mut self) -> Result<Option<Message>, AdapterError> {
        let mut taken = None;
        let mut used = 0;
        for byte in &self.rest {
            used += 1;
            match byte {
                b'\r' => taken = Some(Message::Text(std::mem::take(&mut self.partial))),
                0x07 => {
                    self.partial.clear();
                    taken = Some(Message::Refused);
                }
                b'\n' => {}
                byte => self.partial.push(*byte),
            }
            if taken.is_some() || self.partial.len() > LONGEST_MESSAGE {
                break;
            }
        }
        self.rest.drain(..used);
        if self.partial.len() > LONGEST_MESSAGE {
            let said = String::from_utf8_lossy(&self.partial).escape_debug().to_string();
            return Err(self.unexpected(format!("a message without an end: '{said}'")));
        }
        Ok(taken)
    }

    fn lost(&self, source: io::Error) -> AdapterError {
        AdapterError::Lost { adapter: self.name.clone(), source }
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
        self.send_text(&text_of(frame))
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        if let Some(frame) = self.early.pop_front() {
            return Ok(Some(frame));
        }
        let deadline = self.line.now() + timeout;
        while let Some(message) = self.message(deadline)? {
            // Acknowledgements (z, Z, empty) are ignored. A frame that the adapter refused counts
            // as lost on the bus: its sender misses the answer and repeats it.
            if let Message::Text(text) = message {
                if let Some(frame) = parse_frame(&text) {
                    return Ok(Some(frame));
                }
            }
            if self.line.now() >= deadline {
                break;
            }
        }
        Ok(None)
    }

    fn now(&self) -> Duration {
        self.line.now().saturating_duration_since(self.opened)
    }

    /// Reads the status flags (`F`). Not all adapters know this command.
    fn health(&mut self) -> Option<Health> {
        let flags = std::cell::Cell::new(None);
        let answers = |text: &[u8]| {
            flags.set(status_flags(text).or(flags.get()));
            flags.get().is_some()
        };
        let answer = self.command("F\r", answers);
        flags.get().filter(|_| matches!(answer, Ok(Answer::Done))).map(|flags| {
            let controller = match flags {
                flags if flags & PASSIVE != 0 => Controller::Passive,
                flags if flags & WARNING != 0 => Controller::Warning,
                _ => Controller::Active,
            };
            Health { controller: Some(controller), ..Health::default() }
        })
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

/// The frame in a message. Four digits of a time stamp may follow it (the adapter's command `Z1`).
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
    let dlc: usize = text.get(digits + 1..digits + 2)?.parse().ok().filter(|dlc| *dlc <= 8)?;
    let rest = text.get(digits + 2..)?;
    if kind.eq_ignore_ascii_case(&'r') {
        return Frame::new_remote(id, dlc);
    }
    let data = rest.get(..2 * dlc)?;
    if !matches!(rest.len() - data.len(), 0 | 4) {
        return None;
    }
    Frame::new(id, &hex_bytes(data)?)
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use canopen::CobId;
    use proptest::prelude::*;

    use super::*;

    fn frame(id: u16, data: &[u8]) -> Frame {
        Frame::of(CobId::new(id).unwrap(), data)
    }

    /// Examples of the CAN232 manual.
    #[test]
    fn messages_are_those_of_the_protocol() {
        assert_eq!(text_of(&frame(0x100, &[0x11, 0x22, 0x33])), "t1003112233\r");
        assert_eq!(text_of(&frame(0x7FF, &[])), "t7FF0\r");
        assert_eq!(parse_frame(b"t10021133"), Some(frame(0x100, &[0x11, 0x33])));
        assert_eq!(parse_frame(b"t100211330A1B"), Some(frame(0x100, &[0x11, 0x33])), "with time");
        let extended = Frame::new(ExtendedId::new(0x100).unwrap(), &[0x11, 0x33]).unwrap();
        assert_eq!(parse_frame(b"T0000010021133"), Some(extended));
        assert_eq!(text_of(&extended), "T0000010021133\r");
        let remote = Frame::new_remote(StandardId::new(0x100).unwrap(), 2).unwrap();
        assert_eq!((parse_frame(b"r1002"), text_of(&remote)), (Some(remote), "r1002\r".to_string()));
        for bad in [
            &b""[..],
            b"z",
            b"Z",
            b"V1013",
            b"t",
            b"t10",
            b"t100",
            b"t1009",
            b"t10011",
            b"t100111223",
            b"t8000",
            b"txyz0",
            b"T200000000",
            b"t100\xC3\xA91",
            b"t1001+1",
            b"t+121AA",
        ] {
            assert_eq!(parse_frame(bad), None, "{bad:?}");
        }
    }

    /// An adapter that follows a script: each text written to it gives an answer.
    #[derive(Debug, Default)]
    struct Played {
        answers: VecDeque<(&'static str, &'static [u8])>,
        written: String,
        incoming: VecDeque<u8>,
        gone: bool,
    }

    impl Read for Played {
        fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
            // One byte at a time: the reader must not rely on more.
            match self.incoming.pop_front() {
                Some(byte) => bytes[0] = byte,
                None if self.gone => return Ok(0),
                None => return Err(ErrorKind::TimedOut.into()),
            }
            Ok(1)
        }
    }

    impl Write for Played {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.written.push_str(std::str::from_utf8(bytes).unwrap());
            while let Some((text, answer)) = self.answers.front() {
                if !self.written.ends_with(text) {
                    break;
                }
                self.incoming.extend(*answer);
                self.answers.pop_front();
            }
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Line for &mut Played {
        fn set_timeout(&mut self, _: Duration) -> io::Result<()> {
            Ok(())
        }
    }

    fn open(played: &mut Played, rate: Option<u32>) -> Result<Slcan<&mut Played>, AdapterError> {
        Slcan::open(played, "SLCAN adapter test".to_string(), rate)
    }

    #[test]
    fn a_session_sets_the_bit_rate_opens_and_closes() {
        // The bus was closed already; the frame follows the acknowledgement directly.
        let answers = [
            ("C\r", &b"\r\x07"[..]),
            ("V\r", b"V1013\r"),
            ("S6\r", b"\r"),
            ("O\r", b"\rt70517F\r"),
            ("t6050\r", b"z\rt5850\r"),
        ];
        let mut played = Played { answers: answers.into(), ..Played::default() };
        let mut bus = open(&mut played, Some(500_000)).unwrap();
        let soon = Duration::from_millis(20);
        assert_eq!(bus.receive(soon).unwrap(), Some(frame(0x705, &[0x7F])));
        bus.send(&frame(0x605, &[])).unwrap();
        assert_eq!(bus.receive(soon).unwrap(), Some(frame(0x585, &[])));
        assert_eq!(bus.receive(soon).unwrap(), None);
        drop(bus);
        assert_eq!(played.written, "\r\rC\rV\rS6\rO\rt6050\rC\r");
    }

    #[test]
    fn an_adapter_that_answers_v_or_o_works_and_one_that_refuses_or_is_mute_is_named() {
        for answers in [vec![("V\r", &b"V1013\r"[..])], vec![("V\r", b"\x07")], vec![("O\r", b"\r")]] {
            assert!(open(&mut Played { answers: answers.into(), ..Played::default() }, None).is_ok());
        }
        let mute = |played: &mut Played| open(played, None).map(|_| ()).unwrap_err().to_string();
        let error = mute(&mut Played::default());
        assert!(error.ends_with("it answered neither V (version) nor O (open the bus)"), "{error}");
        // A GPS receiver, and a port that echoes.
        let mut gps = Played { answers: vec![("V\r", &b"$GPGGA,1,2\r\n"[..])].into(), ..Played::default() };
        let error = mute(&mut gps);
        assert!(error.ends_with("; it sent '$GPGGA,1,2'"), "{error}");
        let echo = vec![("C\r", &b"C\r"[..]), ("V\r", b"V\r"), ("O\r", b"O\r")];
        let error = mute(&mut Played { answers: echo.into(), ..Played::default() });
        assert!(error.ends_with("; it sent 'O'"), "{error}");
        for (answers, rate, words) in [
            (vec![("S4\r", &b"\x07"[..])], 125_000, "it refuses the bit rate"),
            (vec![("O\r", &b"\x07"[..])], 125_000, "it refuses to open the bus"),
            (vec![], 123_456, "it does not support 123456 bit/s"),
        ] {
            let mut played = Played { answers: answers.into(), ..Played::default() };
            let error = open(&mut played, Some(rate)).map(|_| ()).unwrap_err();
            assert!(error.to_string().contains(words), "{error}");
        }
        let mut gone = Played { gone: true, ..Played::default() };
        let error = open(&mut gone, None).map(|_| ()).unwrap_err();
        assert!(matches!(error, AdapterError::Lost { .. }), "{error}");
    }

    #[test]
    fn the_status_flags_tell_the_controllers_state() {
        for (answer, controller) in [
            (&b"F00\r"[..], Some(Controller::Active)),
            (b"t70517F\rF04\r", Some(Controller::Warning)),
            (b"FA4\r", Some(Controller::Passive)),
            (b"\x07", None),
            (b"F1\r", None),
            (b"", None),
        ] {
            let answers = [("V\r", &b"V1013\r"[..]), ("O\r", b"\r"), ("F\r", answer)];
            let mut played = Played { answers: answers.into(), ..Played::default() };
            let mut bus = open(&mut played, None).unwrap();
            assert_eq!(bus.health().and_then(|health| health.controller), controller, "{answer:?}");
            // A frame that arrives meanwhile is not lost.
            let frame_came = answer.starts_with(b"t");
            assert_eq!(bus.receive(Duration::ZERO).unwrap().is_some(), frame_came);
        }
    }

    #[test]
    fn a_line_that_speaks_something_else_is_quoted() {
        let mut played = Played::default();
        played.incoming.extend([b'x'; LONGEST_MESSAGE + 1]);
        let error = open(&mut played, None).map(|_| ()).unwrap_err();
        assert!(error.to_string().contains("a message without an end: 'xxx"), "{error}");
    }

    proptest! {
        #[test]
        fn any_text_is_a_frame_or_not(text in "[tTrRzZ][0-9A-Fa-f]{0,30}") {
            if let Some(frame) = parse_frame(text.as_bytes()) {
                let again = text_of(&frame);
                prop_assert_eq!(parse_frame(again.trim_end().as_bytes()), Some(frame));
            }
        }
    }
}
