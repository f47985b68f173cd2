//! The socketcand protocol: CAN frames as text over TCP (socketcand, `doc/protocol.md`, raw mode).
//! This module has the client, and the message formats for a server.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use canopen::Frame;
use embedded_can::{ExtendedId, Frame as _, Id, StandardId};

use super::adapter::{Adapter, AdapterError};
use super::digits::{hex_bytes, hex_number};
use super::echo::Echoes;
use super::found::shown;
use super::health::Health;
use super::tcp::{connect, read_within, waits, PATIENCE};

/// Longer than any message of the protocol.
const LONGEST_MESSAGE: usize = 4096;
/// The bits of an error frame's identifier that tell its class: those below `CAN_ERR_FLAG`.
const ERROR_CLASS: u32 = 0x1FFF_FFFF;
/// More frames than are sent before their echoes come.
const MOST_SENT: usize = 256;
/// The most bytes of a server's text that an error shows.
const SHOWN: usize = 80;
/// The default port of socketcand.
const DEFAULT_PORT: u16 = 29536;

/// A bus of a socketcand server.
#[derive(Debug)]
pub struct Socketcand {
    stream: TcpStream,
    name: String,
    opened: Instant,
    messages: Messages,
    /// What the error frames have reported.
    health: Health,
    /// What was sent, until another node is heard.
    sent: Echoes<MOST_SENT>,
    hears_others: bool,
}

impl Socketcand {
    /// Connects to `server` (`host:port` or `host`) and opens `bus` there in raw mode.
    ///
    /// # Errors
    /// [`AdapterError::Open`] or [`AdapterError::Protocol`].
    pub fn connect(server: &str, bus: &str) -> Result<Self, AdapterError> {
        let name = format!("socketcand {server}, bus {bus}");
        let mut adapter = Self {
            stream: connect(&name, server, Some(DEFAULT_PORT), PATIENCE)?,
            name,
            opened: Instant::now(),
            messages: Messages::default(),
            health: Health::default(),
            sent: Echoes::default(),
            hears_others: false,
        };
        adapter.expect("hi")?;
        adapter.send_text(&format!("< open {bus} >"))?;
        adapter.expect("ok")?;
        adapter.send_text("< rawmode >")?;
        adapter.expect("ok")?;
        Ok(adapter)
    }

    /// Waits for the message with this first word during the log-in.
    fn expect(&mut self, word: &str) -> Result<(), AdapterError> {
        let deadline = Instant::now() + PATIENCE;
        while let Some(message) = self.message(deadline)? {
            let first = message.split_ascii_whitespace().next();
            if first.is_some_and(|first| first.eq_ignore_ascii_case(word)) {
                return Ok(());
            }
            // Frames may arrive as soon as the bus is open.
            if !message.starts_with("frame ") && !self.is_error_frame(&message) {
                return Err(self.unexpected(format!("'< {message} >' instead of '< {word} >'")));
            }
            // A bus without a pause does not keep the client in this loop.
            if Instant::now() >= deadline {
                break;
            }
        }
        let said = match shown(&self.messages.stray) {
            said if said.is_empty() => "nothing".to_string(),
            said => format!("'{said}'"),
        };
        Err(self.unexpected(format!("{said} instead of '< {word} >'")))
    }

    /// Adds an error frame of the bus to what is known about it. `false` for any other message.
    fn is_error_frame(&mut self, message: &str) -> bool {
        let frame = parse_error_frame(message);
        if let Some((class, data)) = &frame {
            self.health.error_frame(*class, data);
        }
        frame.is_some()
    }

    /// A server may return the client's own frames. Notes whether it sends any others.
    fn note(&mut self, frame: &Frame) {
        if !self.hears_others {
            self.hears_others = !self.sent.takes(frame);
            self.health.only_echoes = !self.hears_others;
        }
    }

    fn send_text(&mut self, message: &str) -> Result<(), AdapterError> {
        self.stream.write_all(message.as_bytes()).map_err(|error| self.lost(error))
    }

    /// The next message without its brackets; `None` if the deadline has passed.
    fn message(&mut self, deadline: Instant) -> Result<Option<String>, AdapterError> {
        loop {
            match self.messages.next() {
                Ok(None) => {}
                Ok(message) => return Ok(message),
                Err(said) => return Err(self.unexpected(said)),
            }
            let left = deadline.saturating_duration_since(Instant::now());
            let mut bytes = [0; 4096];
            match read_within(&mut self.stream, &mut bytes, left) {
                Ok(0) => {
                    let closed =
                        io::Error::new(ErrorKind::ConnectionAborted, "the server closed the connection");
                    return Err(self.lost(closed));
                }
                Ok(len) => self.messages.add(&bytes[..len]),
                Err(error) if waits(&error) => {}
                Err(error) => return Err(self.lost(error)),
            }
            // After the deadline the stream is read once: text between messages may have no end.
            if left.is_zero() {
                return self.messages.next().map_err(|said| self.unexpected(said));
            }
        }
    }

    fn lost(&self, source: io::Error) -> AdapterError {
        AdapterError::Lost { adapter: self.name.clone(), source: source.into() }
    }

    fn unexpected(&self, said: String) -> AdapterError {
        AdapterError::Protocol { adapter: self.name.clone(), said }
    }
}

impl Adapter for Socketcand {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        if !self.hears_others {
            self.sent.sent(frame);
        }
        self.send_text(&send_message(frame))
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let deadline = Instant::now() + timeout;
        while let Some(message) = self.message(deadline)? {
            if let Some(frame) = parse_frame(&message) {
                self.note(&frame);
                return Ok(Some(frame));
            }
            if !self.is_error_frame(&message) && message.starts_with("error") {
                return Err(self.unexpected(message));
            }
            // Other messages (echo, statistics, CAN FD frames) are ignored. A server that sends
            // only such messages cannot keep the client in this loop.
            if Instant::now() >= deadline {
                break;
            }
        }
        Ok(None)
    }

    fn now(&self) -> Duration {
        self.opened.elapsed()
    }

    /// The reports of the error frames. A server sends them if it was told to (`--error-mask`).
    fn health(&mut self) -> Option<Health> {
        Some(Health { strange: self.messages.strays, ..self.health })
    }
}

/// The client's message that sends a frame: `< send 605 8 40 0 10 0 0 0 0 0 >`. A 29-bit identifier
/// has eight digits.
#[must_use]
pub fn send_message(frame: &Frame) -> String {
    let data: String = frame.data().iter().map(|byte| format!("{byte:02X} ")).collect();
    format!("< send {} {} {data}>", identifier(frame), frame.dlc())
}

/// The frame in a server's message `frame 585 12.345678 4000100000000000`, passed without the
/// brackets. Servers write the data with or without blanks between the bytes. `None` for any other
/// message.
#[must_use]
pub fn parse_frame(message: &str) -> Option<Frame> {
    let mut words = message.split_ascii_whitespace();
    let ("frame", Some(id), Some(_time)) = (words.next()?, words.next(), words.next()) else { return None };
    let id = parse_identifier(id)?;
    let digits: String = words.collect();
    Frame::new(id, &hex_bytes(&digits)?)
}

/// The error frame of the bus in a server's message `error 004 12.345678`, passed without the
/// brackets: the class of the error and the data, in the form of Linux (`linux/can/error.h`).
/// socketcand sends no data, and its description of the protocol names no time. `None` for any other message; an
/// error of the server itself is words: `error unknown command`.
fn parse_error_frame(message: &str) -> Option<(u32, Vec<u8>)> {
    let mut words = message.split_ascii_whitespace();
    let ("error", class) = (words.next()?, words.next()?) else { return None };
    let number = hex_number(class).filter(|_| class.len() <= 8)?;
    match words.next() {
        Some(time) if time.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.') => {}
        // "bad", for one, could also be a word.
        None if class.starts_with(|first: char| first.is_ascii_digit()) => {}
        _ => return None,
    }
    let data = hex_bytes(&words.collect::<String>())?;
    Some((number & ERROR_CLASS, data))
}

/// The server's message for a frame on the bus at `time` after its start: `< frame 585 12.345678
/// 4000100000000000 >`. Without data there are two blanks before the bracket; python-can needs
/// them.
#[must_use]
pub fn frame_message(frame: &Frame, time: Duration) -> String {
    let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
    format!("< frame {} {}.{:06} {data} >", identifier(frame), time.as_secs(), time.subsec_micros())
}

/// The frame in a client's message `send 605 8 40 0 10 0 0 0 0 0`, passed without the brackets. A data length
/// code of 9 to 15 is one of eight bytes (ISO 11898-1:2015, table 5).
/// `None` for any other message.
#[must_use]
pub fn parse_send(message: &str) -> Option<Frame> {
    let mut words = message.split_ascii_whitespace();
    let ("send", id, dlc) = (words.next()?, parse_identifier(words.next()?)?, words.next()?) else {
        return None;
    };
    let data = words.map(|word| u8::try_from(hex_number(word)?).ok()).collect::<Option<Vec<u8>>>()?;
    let is_long = data.len() == 8 && matches!(dlc.parse(), Ok(9..=15_u8));
    (is_long || dlc == data.len().to_string()).then(|| Frame::new(id, &data)).flatten()
}

/// Three digits for an identifier of 11 bits, eight for 29 bits.
fn identifier(frame: &Frame) -> String {
    match frame.id() {
        Id::Standard(id) => format!("{:03X}", id.as_raw()),
        Id::Extended(id) => format!("{:08X}", id.as_raw()),
    }
}

fn parse_identifier(word: &str) -> Option<Id> {
    let number = hex_number(word)?;
    Some(if word.len() > 3 {
        ExtendedId::new(number)?.into()
    } else {
        StandardId::new(u16::try_from(number).ok()?)?.into()
    })
}

/// Cuts the byte stream into messages, regardless of how TCP splits and joins them.
#[derive(Debug, Default)]
pub struct Messages {
    /// Received bytes of an incomplete message.
    partial: Option<Vec<u8>>,
    complete: VecDeque<String>,
    overlong: bool,
    /// Bytes between messages that are no blanks.
    strays: u32,
    /// The first text between messages.
    stray: Vec<u8>,
}

impl Messages {
    /// Adds received bytes.
    pub fn add(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            match (byte, &mut self.partial) {
                (b'<', partial) => *partial = Some(Vec::new()),
                (b'>', Some(text)) => {
                    self.complete.push_back(String::from_utf8_lossy(text).trim().to_string());
                    self.partial = None;
                }
                (_, Some(text)) if text.len() < LONGEST_MESSAGE => text.push(byte),
                (_, Some(_)) => self.overlong = true,
                // A byte between two messages.
                (byte, None) => {
                    self.strays = self.strays.saturating_add(u32::from(!byte.is_ascii_whitespace()));
                    if self.stray.len() < SHOWN && !byte.is_ascii_control() {
                        self.stray.push(byte);
                    }
                }
            }
        }
    }

    /// The oldest complete message, without its brackets.
    ///
    /// # Errors
    /// The text from a peer that uses another protocol.
    #[allow(clippy::should_implement_trait)]
    pub fn next(&mut self) -> Result<Option<String>, String> {
        if self.overlong {
            return Err("a message without an end".to_string());
        }
        Ok(self.complete.pop_front())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::net::TcpListener;
    use std::thread;

    use canopen::{CobId, NodeId};
    use proptest::prelude::*;

    use super::*;
    use crate::health::Trouble;
    use crate::tests::frame;

    /// Both directions, as the protocol description of socketcand writes them.
    #[test]
    fn messages_are_those_of_the_protocol() {
        assert_eq!(send_message(&frame(0x123, &[0x11, 0x22, 0xA3])), "< send 123 3 11 22 A3 >");
        assert_eq!(send_message(&frame(0x7E5, &[])), "< send 7E5 0 >");
        assert_eq!(parse_frame("frame 123 23.424242 11 22 A3"), Some(frame(0x123, &[0x11, 0x22, 0xA3])));
        assert_eq!(parse_frame("frame 123 23.424242 1122a3"), Some(frame(0x123, &[0x11, 0x22, 0xA3])));
        assert_eq!(parse_frame("frame 7E5 23.4"), Some(frame(0x7E5, &[])));
        let extended = Frame::new(ExtendedId::new(0x123).unwrap(), &[1]).unwrap();
        assert_eq!(parse_frame("frame 00000123 1.0 01"), Some(extended));
        assert_eq!(send_message(&extended), "< send 00000123 1 01 >");
        const BAD: &str = "|ok|frame|frame 123|frame 800 1.0|frame xyz 1.0 00|frame 20000000 1.0 00|\
            frame 123 1.0 1|frame 123 1.0 001122334455667788|frame 123 1.0 0\u{e9}1|\
            frame 123 1.0 +1|frame +12 1.0 01";
        for bad in BAD.split('|') {
            assert_eq!(parse_frame(bad), None, "{bad}");
        }
    }

    /// Both directions, as the protocol description of socketcand writes them and as python-can
    /// needs them.
    #[test]
    fn a_server_reads_and_writes_messages_of_the_protocol() {
        assert_eq!(parse_send("send 123 0"), Some(frame(0x123, &[])));
        assert_eq!(parse_send("send 123 4 11 22 33 44"), Some(frame(0x123, &[0x11, 0x22, 0x33, 0x44])));
        assert_eq!(parse_send("send 1 1 5"), Some(frame(1, &[5])));
        let eight = Some(frame(0x601, &[1, 2, 3, 4, 5, 6, 7, 8]));
        assert_eq!([9, 15].map(|dlc| parse_send(&format!("send 601 {dlc} 1 2 3 4 5 6 7 8"))), [eight; 2]);
        let extended = Frame::new(ExtendedId::new(0x1AAA_AAAA).unwrap(), &[0x11, 0xF1]).unwrap();
        assert_eq!(parse_send("send 1AAAAAAA 2 11 F1"), Some(extended));
        const BAD: &str = "|send|send 123|send 123 1|send 123 1 11 22|send 123 9 1 2 3 4 5 6 7 8 9|\
            send 123 16 1 2 3 4 5 6 7 8|send 123 01 11|send 123 1 111|send 123 1 +1|send 800 0|\
            send 20000000 0|sendrtr 123 0|frame 123 1.0 11";
        for bad in BAD.split('|') {
            assert_eq!(parse_send(bad), None, "{bad}");
        }
        let time = Duration::from_micros(23_024_242);
        assert_eq!(frame_message(&frame(0x23, &[0x11, 0xA2]), time), "< frame 023 23.024242 11A2 >");
        assert_eq!(frame_message(&frame(0x7E5, &[]), time), "< frame 7E5 23.024242  >");
        assert_eq!(frame_message(&extended, time), "< frame 1AAAAAAA 23.024242 11F1 >");
    }

    /// A server that follows `script`: pairs of the text to wait for and the answer to send.
    fn server(script: &'static [(&'static str, &'static str)]) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            stream.set_nodelay(true).unwrap();
            for (awaited, answer) in script {
                let mut got = vec![0; awaited.len()];
                stream.read_exact(&mut got).unwrap();
                assert_eq!(std::str::from_utf8(&got).unwrap(), *awaited);
                // Byte by byte: the client must not rely on packet borders.
                for byte in answer.as_bytes() {
                    stream.write_all(&[*byte]).unwrap();
                }
            }
        });
        address
    }

    const LOG_IN: [(&str, &str); 2] = [("", "< hi >"), ("< open can0 >", "< ok >")];

    #[test]
    fn a_session_from_log_in_to_the_end_of_the_server() {
        let address = server(&[
            LOG_IN[0],
            LOG_IN[1],
            ("< rawmode >", "< ok >< frame 701 1.000000 00 >< frame 701 1.1 7F >< stat 1 >"),
            ("< send 601 8 40 00 10 00 00 00 00 00 >", "\n< frame 581 2.000000 4300100000000010 > "),
        ]);
        let mut bus = crate::open(&format!("socketcand://{address}/can0")).unwrap();
        let long = Duration::from_secs(20);
        assert_eq!(bus.receive(long).unwrap(), Some(frame(0x701, &[0])));
        assert_eq!(bus.receive(long).unwrap(), Some(frame(0x701, &[0x7F])));
        bus.send(&Frame::of(CobId::sdo_request(NodeId::MIN), &[0x40, 0, 0x10, 0, 0, 0, 0, 0])).unwrap();
        let answer = frame(0x581, &[0x43, 0, 0x10, 0, 0, 0, 0, 0x10]);
        assert_eq!(bus.receive(long).unwrap(), Some(answer));
        assert!(matches!(bus.receive(long), Err(AdapterError::Lost { .. })));
    }

    /// What a server adds to its greeting, or writes in capitals, is still its greeting.
    #[test]
    fn a_server_greets_as_it_likes() {
        for script in [
            [("", "< hi socketcand 0.6.1 >"), ("< open can0 >", "< ok can0 >"), ("< rawmode >", "< ok >")],
            [("", "<HI>\r\n"), ("< open can0 >", "<OK>\r\n"), ("< rawmode >", "<Ok>\r\n")],
            [("", "Welcome\r\n<\thi\t>"), ("< open can0 >", "<  ok  >"), ("< rawmode >", "< ok\n>")],
        ] {
            Socketcand::connect(&server(script.to_vec().leak()), "can0").unwrap();
        }
    }

    /// linux-can/socketcand, pull request 67: the class of the error in hexadecimal, and the time.
    #[test]
    fn error_frames_of_the_bus_are_told_from_errors_of_the_server() {
        for (message, frame) in [
            ("error 004 1700000123.000456", Some((0x004, vec![]))),
            ("error 088 1700000123.000456", Some((0x088, vec![]))),
            ("error 20000020 5.000000", Some((0x020, vec![]))),
            ("error 0A8 0.000000 00 00 04 00 00 00 00 00", Some((0x0A8, vec![0, 0, 4, 0, 0, 0, 0, 0]))),
            ("error 4", Some((4, vec![]))),
            ("error", None),
            ("error unknown command", None),
            ("error could not open bus", None),
            ("error bad", None),
            ("error bad command", None),
            ("error 404 not found", None),
            ("error 004 12.5 xyz", None),
            ("error 123456789 1.0", None),
            ("errors 004 1.0", None),
            ("frame 004 1.0 00", None),
        ] {
            assert_eq!(parse_error_frame(message), frame, "{message}");
        }
    }

    /// A server that becomes something else: what it sends has no brackets.
    #[test]
    fn what_is_between_messages_is_told() {
        let address = server(&[
            LOG_IN[0],
            LOG_IN[1],
            ("< rawmode >", "< ok >\r\n\t "),
            ("< send 601 8 40 00 10 00 00 00 00 00 >", "[1] OK\r\n< frame 701 1.0 7F >"),
            ("< send 601 8 40 00 10 00 00 00 00 00 >", ""),
        ]);
        let mut bus = crate::open(&format!("socketcand://{address}/can0")).unwrap();
        assert_eq!(bus.health().unwrap().trouble(), None);
        bus.send(&Frame::of(CobId::sdo_request(NodeId::MIN), &[0x40, 0, 0x10, 0, 0, 0, 0, 0])).unwrap();
        assert_eq!(bus.receive(Duration::from_secs(20)).unwrap(), Some(frame(0x701, &[0x7F])));
        let health = bus.health().unwrap();
        assert_eq!((health.strange, health.trouble()), (5, Some(Trouble::Strange)));
    }

    #[test]
    fn error_frames_are_counted_and_end_no_session() {
        let address = server(&[
            LOG_IN[0],
            LOG_IN[1],
            (
                "< rawmode >",
                "< error 020 0.9 >< ok >< error 004 1700000123.000456 >< frame 701 1.0 00 >\
                 < error 020 1.1 >< frame 701 1.1 7F >< error 020 1.2 >< error unknown command >",
            ),
            ("never", ""),
        ]);
        let mut bus = Socketcand::connect(&address, "can0").unwrap();
        let long = Duration::from_secs(20);
        assert_eq!(bus.receive(long).unwrap(), Some(frame(0x701, &[0])));
        assert_eq!(bus.receive(long).unwrap(), Some(frame(0x701, &[0x7F])));
        let error = bus.receive(long).unwrap_err();
        assert!(error.to_string().ends_with("answered unexpectedly: error unknown command"), "{error}");
        // CAN_ERR_ACK is 20h.
        let health = bus.health().unwrap();
        assert_eq!((health.unacknowledged, health.unclear), (3, 1));
    }

    /// Lines of a server that returns what it gets: no other node is on its bus.
    #[test]
    fn a_server_that_only_returns_our_frames_is_told() {
        const READ: &str = "< send 605 8 40 00 10 00 00 00 00 00 >";
        let request = Frame::of(CobId::new(0x605).unwrap(), &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
        let long = Duration::from_secs(20);
        for (other, trouble) in [
            ("< frame 605 1.2 4000100000000000 >", Some(Trouble::Echo)),
            ("< frame 705 1.2 7F >", None),
            // The request of another tool: it comes twice, and was sent once.
            ("< frame 605 1.2 4000180100000000 >", None),
        ] {
            let script = [
                LOG_IN[0],
                LOG_IN[1],
                ("< rawmode >", "< ok >"),
                (READ, "< frame 605 1.1 4000100000000000 >"),
                (READ, other),
                ("never", ""),
            ];
            let mut bus = Socketcand::connect(&server(script.to_vec().leak()), "can0").unwrap();
            assert_eq!(bus.health().unwrap().trouble(), None);
            bus.send(&request).unwrap();
            assert_eq!(bus.receive(long).unwrap(), Some(request));
            assert_eq!(bus.health().unwrap().trouble(), Some(Trouble::Echo));
            bus.send(&request).unwrap();
            bus.receive(long).unwrap().unwrap();
            assert_eq!(bus.health().unwrap().trouble(), trouble, "{other}");
        }
    }

    /// The server sends while the client waits, until its connection is closed.
    fn flood(log_in: &'static [&'static [u8]], text: &'static [u8]) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            for (number, answer) in log_in.iter().enumerate() {
                // The client's message before this answer; it fits into one read.
                if number > 0 {
                    let _ = stream.read(&mut [0; 64]).unwrap();
                }
                stream.write_all(answer).unwrap();
            }
            while stream.write_all(text).is_ok() {}
        });
        address
    }

    /// These tests end, or they hang: no time is measured.
    #[test]
    fn a_server_that_never_pauses_keeps_nobody_waiting() {
        const OPEN: &[&[u8]] = &[b"< hi >"];
        const OPEN_AND_OK: &[&[u8]] = &[b"< hi >", b"< ok >", b"< ok >"];
        for text in [&b"no bracket at all "[..], b"< error 004 1.5 >"] {
            let mut bus = Socketcand::connect(&flood(OPEN_AND_OK, text), "can0").unwrap();
            assert_eq!(bus.receive(Duration::from_millis(20)).unwrap(), None);
            drop(bus);
            let error = Socketcand::connect(&flood(OPEN, text), "can0").unwrap_err();
            assert!(error.to_string().contains("instead of '< ok >'"), "{error}");
        }
    }

    #[test]
    fn waiting_ends_when_nothing_comes() {
        let address = server(&[LOG_IN[0], LOG_IN[1], ("< rawmode >", "< ok >"), ("never", "")]);
        let mut bus = Socketcand::connect(&address, "can0").unwrap();
        assert_eq!(bus.receive(Duration::ZERO).unwrap(), None);
        let before = bus.now();
        assert_eq!(bus.receive(Duration::from_millis(30)).unwrap(), None);
        assert!(bus.now() - before >= Duration::from_millis(30), "the adapter's own clock has moved on");
    }

    #[test]
    fn a_server_that_refuses_or_speaks_otherwise_is_quoted() {
        for (script, words) in [
            (
                &[("", "< hi >"), ("< open can0 >", "< error could not open bus >")][..],
                "'< error could not open bus >' instead of '< ok >'",
            ),
            (&[("", "<html>")][..], "'< html >' instead of '< hi >'"),
            (
                &[("", "SSH-2.0-OpenSSH_9.6\r\n\x07"), ("never", "")][..],
                "'SSH-2.0-OpenSSH_9.6' instead of '< hi >'",
            ),
            (&[("", "< high >")][..], "'< high >' instead of '< hi >'"),
        ] {
            let error = Socketcand::connect(&server(script), "can0").unwrap_err();
            assert!(error.to_string().contains(words), "{error}");
            assert_eq!(error.number(), 0x6000_0302);
        }
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        drop(listener);
        let error = Socketcand::connect(&address, "can0").unwrap_err();
        assert!(matches!(error, AdapterError::Open { .. }), "{error}");
    }

    proptest! {
        #[test]
        fn any_stream_is_cut_the_same_however_it_arrives(
            bytes in prop::collection::vec(prop::sample::select(b"<> frame123456.ABC\xFF".to_vec()), 0..200),
            cut in any::<prop::sample::Index>(),
        ) {
            let cut = cut.index(bytes.len() + 1);
            let (mut whole, mut parts) = (Messages::default(), Messages::default());
            whole.add(&bytes);
            parts.add(&bytes[..cut]);
            parts.add(&bytes[cut..]);
            prop_assert_eq!(&whole.complete, &parts.complete);
            for message in &whole.complete {
                let _ = parse_frame(message);
            }
        }
    }

    #[test]
    fn a_message_that_was_cut_off_does_not_spoil_the_next() {
        let mut messages = Messages::default();
        messages.add(b"noise > < frame 123 < ok >");
        assert_eq!(messages.next(), Ok(Some("ok".to_string())));
        assert_eq!(messages.next(), Ok(None));
    }

    #[test]
    fn a_message_without_end_is_no_leak() {
        let mut messages = Messages::default();
        messages.add(b"<");
        messages.add(&[b'x'; LONGEST_MESSAGE]);
        assert_eq!(messages.next(), Ok(None));
        messages.add(b"x");
        assert!(messages.next().is_err());
    }
}
