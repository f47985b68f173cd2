//! Gateways of CiA 309-3: commands and answers as lines of text over TCP.
//!
//! | command | answer |
//! |---|---|
//! | `[7] 1 5 r 0x1018 4 d` | `[7] VNLxKQ==` |
//! | `[8] 1 5 w 0x1F51 1 u8 0x80` | `[8] OK` |
//! | `[9] 1 5 reset node` | `[9] OK` |
//! | `[10] 1 set sdo_timeout 500` | `[10] OK` |
//! | any | `[7] ERROR:0x06020000`, an SDO abort; `[7] ERROR:106`, an error of the gateway |
//!
//! Each command begins with a number, and its answer begins with the same number; then come network
//! and node. Every value is read as a domain (`d`) in base64, whatever its type, so the bytes are
//! those of the SDO transfer. Lines without a number are events of the network, such as the boot-up
//! message `1 5 ERROR 205`. Lines end with CR LF.
//!
//! CANopenNode's `canopend` and Lely's `coctl` tools speak this form.

use std::collections::BTreeSet;
use std::fmt;
use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use canopen::{AbortCode, NodeId};

use self::line::{Line, ERROR};
use super::adapter::AdapterError;
use super::found::shown;
use super::gateway::{Ask, Gateway, GatewayError};
use super::tcp::{self, waits};

mod base64;
mod line;

/// canopend's default port; the standard defines none.
const DEFAULT_PORT: u16 = 60_000;
/// How long one read or write of the socket waits at most.
const SLICE: Duration = Duration::from_millis(50);
/// A long command is sent in pieces of this many bytes.
const PIECE: usize = 4096;
/// How long the gateway may take to answer a command that concerns the gateway alone.
const AT_ONCE: Duration = Duration::from_secs(5);
/// Longer than the text of any value that is read as a whole.
const LONGEST_LINE: usize = 100 << 20;
/// Longer than any line that is not an answer, and than any answer without a value.
const LONGEST_WORDS: usize = 4096;
/// The most bytes of an unfinished line that an error shows.
const SHOWN: usize = 80;
/// The characters of an answer that a gateway on the slowest bus sends in a second. An answer that
/// comes so fast may take longer than the time limit.
const SLOWEST: u32 = 250;
/// The longest SDO time-out: 16 bits of milliseconds.
const LONGEST_TIMEOUT: u128 = 0xFFFF;
/// Codes from this value on are SDO abort codes.
const ABORTS: u32 = 0x0503_0000;

/// A connection to a gateway, and one network behind it.
#[derive(Debug)]
pub struct Cia309 {
    stream: TcpStream,
    name: String,
    network: u16,
    opened: Instant,
    /// The number of the last command.
    sequence: u32,
    /// Commands that were given up. Their answers may still arrive.
    given_up: BTreeSet<u32>,
    /// Received bytes that were not parsed yet.
    inbox: Vec<u8>,
    /// The number of bytes at the beginning of `inbox` that are known to contain no end of line.
    searched: usize,
    /// The SDO time-out that the gateway was given last.
    timeout: Option<Duration>,
}

impl Cia309 {
    /// Connects to a gateway at `host:port`.
    ///
    /// # Errors
    /// [`AdapterError::Open`].
    pub fn connect(server: &str, network: u16) -> Result<Self, AdapterError> {
        let name = format!("CiA 309-3 gateway {server}");
        Ok(Self {
            stream: tcp::connect(&name, server, Some(DEFAULT_PORT), SLICE)?,
            name,
            network,
            opened: Instant::now(),
            sequence: 0,
            given_up: BTreeSet::new(),
            inbox: Vec::new(),
            searched: 0,
            timeout: None,
        })
    }

    fn lost(&self, source: io::Error) -> AdapterError {
        AdapterError::Lost { adapter: self.name.clone(), source: source.into() }
    }

    fn protocol(&self, said: &str) -> AdapterError {
        let shown: String = said.chars().filter(|c| !c.is_control()).take(80).collect();
        AdapterError::Protocol { adapter: self.name.clone(), said: shown }
    }

    fn failed(&self, what: String) -> AdapterError {
        AdapterError::Gateway { adapter: self.name.clone(), what }
    }

    /// Sends a command with its number in front.
    fn command(
        &mut self,
        words: &str,
        ask: &Wait<'_>,
        mut taken: impl FnMut(usize),
    ) -> Result<u32, GatewayError> {
        self.sequence = self.sequence.wrapping_add(1);
        let sequence = self.sequence;
        self.given_up.insert(sequence);
        let text = format!("[{sequence}] {} {words}\r\n", self.network);
        let mut rest = text.as_bytes();
        let mut deadline = Instant::now() + ask.patience;
        while !rest.is_empty() {
            match self.stream.write(&rest[..rest.len().min(PIECE)]) {
                Ok(0) => return Err(self.lost(ErrorKind::WriteZero.into()).into()),
                Ok(len) => {
                    rest = &rest[len..];
                    deadline = Instant::now() + ask.patience;
                    taken(text.len() - rest.len());
                }
                Err(error) if waits(&error) => {}
                Err(error) => return Err(self.lost(error).into()),
            }
            if rest.is_empty() {
                break;
            }
            if (ask.cancelled)() {
                return Err(self.hang_up());
            }
            if Instant::now() >= deadline {
                let seconds = ask.patience.as_secs_f64();
                return Err(self.failed(format!("it has accepted no data for {seconds:.1} s")).into());
            }
        }
        Ok(sequence)
    }

    /// Closes the connection in the middle of a command: this is the only way to end a transfer of
    /// the gateway.
    fn hang_up(&self) -> GatewayError {
        // The result does not matter: the connection may be closed already.
        let _ = self.stream.shutdown(std::net::Shutdown::Both);
        GatewayError::Cancelled
    }

    /// Waits for the answer to a command. Calls `arrived` with the number of bytes of the answer
    /// that have arrived. Only these extend the wait: other lines, and bytes without an end, do not.
    fn answer(
        &mut self,
        sequence: u32,
        wait: &Wait<'_>,
        whole: bool,
        mut arrived: impl FnMut(usize),
    ) -> Result<String, GatewayError> {
        let limit = Instant::now() + wait.patience;
        let mut begun: Option<String> = None;
        loop {
            while let Some((text, ended)) = self.line()? {
                match self.parse(&text)? {
                    Line::Answer(number, answer)
                        if number == sequence && (ended || !whole || answer.starts_with(ERROR)) =>
                    {
                        self.given_up.remove(&sequence);
                        return Ok(answer);
                    }
                    // The first part of a line; the error that interrupted it follows.
                    Line::Answer(number, answer) if number == sequence => begun = Some(answer),
                    Line::Broken(error) if begun.is_some() => {
                        self.given_up.remove(&sequence);
                        return Ok(error);
                    }
                    Line::Answer(number, _) if number != sequence && self.given_up.remove(&number) => {}
                    Line::Answer(..) | Line::Broken(_) => {
                        let said = format!("'{text}', while command [{sequence}] waits for its answer");
                        return Err(self.protocol(&said).into());
                    }
                    Line::BootUp(..) | Line::Event => {}
                }
            }
            let begins = self.inbox.starts_with(format!("[{sequence}]").as_bytes());
            let part = if begins { self.inbox.len() } else { 0 };
            if part > wait.longest {
                let said = format!(
                    "an answer to command [{sequence}] that is longer than {} characters",
                    wait.longest
                );
                return Err(self.protocol(&said).into());
            }
            arrived(part);
            if (wait.cancelled)() {
                return Err(GatewayError::Cancelled);
            }
            if Instant::now() >= limit + Duration::from_secs(part as u64) / SLOWEST {
                let said = match shown(self.inbox[..self.inbox.len().min(SHOWN)].trim_ascii()) {
                    said if said.is_empty() => said,
                    said => format!("; it sent '{said}', and no end of the line"),
                };
                return Err(self.failed(format!("it has not answered for {wait}{said}")).into());
            }
            self.receive()?;
        }
    }

    /// Reads the data that the socket has; waits a short time for them.
    fn receive(&mut self) -> Result<(), AdapterError> {
        let mut bytes = [0; 16 * 1024];
        match self.stream.read(&mut bytes) {
            Ok(0) => Err(self.lost(ErrorKind::UnexpectedEof.into())),
            Ok(len) if self.inbox.len() + len > LONGEST_LINE => Err(self.protocol("a line without an end")),
            Ok(len) => {
                self.inbox.extend_from_slice(&bytes[..len]);
                Ok(())
            }
            Err(error) if waits(&error) => Ok(()),
            Err(error) => Err(self.lost(error)),
        }
    }

    /// The next line that is complete, and whether CR was before its LF.
    fn line(&mut self) -> Result<Option<(String, bool)>, AdapterError> {
        loop {
            let end = self.inbox[self.searched..].iter().position(|byte| *byte == b'\n');
            let Some(end) = end.map(|end| end + self.searched) else {
                self.searched = self.inbox.len();
                // The wait for an answer limits its length.
                if self.inbox.len() > LONGEST_WORDS && !self.inbox.starts_with(b"[") {
                    let begin = String::from_utf8_lossy(&self.inbox[..LONGEST_WORDS]);
                    return Err(self.protocol(&format!("a line without an end: {begin}")));
                }
                return Ok(None);
            };
            self.searched = 0;
            let mut line: Vec<u8> = self.inbox.drain(..=end).collect();
            line.pop();
            let ended = line.pop_if(|byte| *byte == b'\r').is_some();
            let Ok(text) = String::from_utf8(line) else {
                return Err(self.protocol("bytes that are not text"));
            };
            if !text.trim().is_empty() {
                return Ok(Some((text, ended)));
            }
        }
    }

    fn parse(&self, text: &str) -> Result<Line, AdapterError> {
        line::parse(text).ok_or_else(|| self.protocol(text))
    }

    /// The error that an answer reports, if it does.
    fn error(&self, answer: &str) -> Option<GatewayError> {
        Some(match line::error(answer)? {
            Some(103) => GatewayError::NoAnswer,
            Some(code) if AbortCode(code) == AbortCode::TIMEOUT => GatewayError::NoAnswer,
            Some(code) if code >= ABORTS => GatewayError::Abort(AbortCode(code)),
            Some(code) => self.failed(self.refusal(code)).into(),
            None => self.protocol(answer).into(),
        })
    }

    /// The CiA 309-3 error codes that a command of this tool can cause.
    fn refusal(&self, code: u32) -> String {
        let what = match code {
            100 => "it does not support the request".to_string(),
            101 => "it does not understand the request".to_string(),
            102 => "its state does not allow the request".to_string(),
            104 => "it needs a default network".to_string(),
            105 => "it needs a default node".to_string(),
            106 => format!("it has no network {}", self.network),
            107 => "it does not reach this node-ID".to_string(),
            301 => "it is off the bus".to_string(),
            303 => "its buffer for CAN frames has overflowed".to_string(),
            600 => "it has no memory left".to_string(),
            _ => "it refuses the request".to_string(),
        };
        format!("{what} (error {code} of CiA 309-3)")
    }

    /// Sets in the gateway how long a node may take. A gateway without this command keeps its own
    /// time-out.
    fn set_timeout(&mut self, sdo: Duration, cancelled: &dyn Fn() -> bool) -> Result<(), GatewayError> {
        if self.timeout == Some(sdo) {
            return Ok(());
        }
        let wait = Wait { patience: AT_ONCE, sdo: Duration::ZERO, longest: LONGEST_WORDS, cancelled };
        let words = format!("set sdo_timeout {}", sdo.as_millis().clamp(1, LONGEST_TIMEOUT));
        let sequence = self.command(&words, &wait, |_| {})?;
        let answer = self.answer(sequence, &wait, false, |_| {})?;
        match self.error(&answer) {
            Some(GatewayError::Adapter(AdapterError::Gateway { .. })) | None => {}
            Some(error) => return Err(error),
        }
        self.timeout = Some(sdo);
        Ok(())
    }

    /// Checks the answer to a command that returns no value.
    fn done(&self, answer: &str) -> Result<(), GatewayError> {
        match self.error(answer) {
            Some(error) => Err(error),
            None if answer.starts_with("OK") => Ok(()),
            None => Err(self.protocol(answer).into()),
        }
    }
}

/// How long to wait for the gateway, and until when.
struct Wait<'c> {
    patience: Duration,
    /// The part of it that is the node's.
    sdo: Duration,
    /// The longest answer, in characters.
    longest: usize,
    cancelled: &'c dyn Fn() -> bool,
}

impl<'c> From<&Ask<'c>> for Wait<'c> {
    fn from(ask: &Ask<'c>) -> Self {
        Self {
            patience: ask.patience,
            sdo: ask.sdo,
            longest: base64::length(ask.longest).saturating_add(LONGEST_WORDS),
            cancelled: ask.cancelled,
        }
    }
}

impl fmt::Display for Wait<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |time: Duration| time.as_secs_f64();
        write!(f, "{:.1} s", seconds(self.patience))?;
        if self.sdo.is_zero() {
            return Ok(());
        }
        let own = self.patience.saturating_sub(self.sdo);
        write!(
            f,
            " ({:.1} s for SDO with the node, and {:.1} s for the gateway)",
            seconds(self.sdo),
            seconds(own)
        )
    }
}

impl Gateway for Cia309 {
    fn upload(&mut self, ask: &Ask<'_>, progress: &mut dyn FnMut(u32)) -> Result<Vec<u8>, GatewayError> {
        self.set_timeout(ask.sdo, ask.cancelled)?;
        let words = format!("{} r {:#06X} {} d", ask.node, ask.at.index, ask.at.sub);
        let wait = Wait::from(ask);
        let sequence = self.command(&words, &wait, |_| {})?;
        let answer = self.answer(sequence, &wait, true, |text| progress((text / 4 * 3) as u32))?;
        if let Some(error) = self.error(&answer) {
            return Err(error);
        }
        base64::decode(&answer).ok_or_else(|| {
            let said = format!("'{answer}', which is not a domain in base64");
            self.protocol(&said).into()
        })
    }

    fn download(
        &mut self,
        ask: &Ask<'_>,
        data: &[u8],
        progress: &mut dyn FnMut(u32),
    ) -> Result<(), GatewayError> {
        self.set_timeout(ask.sdo, ask.cancelled)?;
        let number = || data.iter().rev().fold(0_u64, |number, byte| number << 8 | u64::from(*byte));
        let value = match data.len() {
            length @ (1 | 2 | 4) => format!("u{} {:#X}", length * 8, number()),
            _ => format!("d {}", base64::encode(data)),
        };
        let words = format!("{} w {:#06X} {} {value}", ask.node, ask.at.index, ask.at.sub);
        let wait = Wait::from(ask);
        let sequence = self.command(&words, &wait, |taken| {
            progress((taken / 4 * 3).min(data.len()) as u32);
        })?;
        let answer = self.answer(sequence, &wait, false, |_| {})?;
        self.done(&answer)
    }

    fn reset_node(&mut self, node: NodeId) -> Result<(), GatewayError> {
        let wait =
            Wait { patience: AT_ONCE, sdo: Duration::ZERO, longest: LONGEST_WORDS, cancelled: &|| false };
        let sequence = self.command(&format!("{node} reset node"), &wait, |_| {})?;
        let answer = self.answer(sequence, &wait, false, |_| {})?;
        self.done(&answer)
    }

    fn greet(&mut self, sdo: Duration) -> Result<(), AdapterError> {
        match self.set_timeout(sdo, &|| false) {
            Err(GatewayError::Adapter(error)) => Err(error),
            // A refusal is a word, too.
            _ => Ok(()),
        }
    }

    fn wait(&mut self, time: Duration) -> Result<Option<NodeId>, GatewayError> {
        let deadline = Instant::now() + time;
        loop {
            while let Some((text, _)) = self.line()? {
                match self.parse(&text)? {
                    Line::BootUp(network, node) if network == u32::from(self.network) => {
                        return Ok(Some(node))
                    }
                    Line::Answer(number, _) if !self.given_up.remove(&number) => {
                        return Err(self.protocol(&format!("'{text}', which answers no command")).into())
                    }
                    Line::Answer(..) | Line::Broken(_) | Line::BootUp(..) | Line::Event => {}
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            let slice = left.min(SLICE).max(Duration::from_millis(1));
            let set = |stream: &TcpStream, time| stream.set_read_timeout(Some(time));
            set(&self.stream, slice).map_err(|error| self.lost(error))?;
            let received = self.receive();
            set(&self.stream, SLICE).map_err(|error| self.lost(error))?;
            received?;
        }
    }

    fn now(&self) -> Duration {
        self.opened.elapsed()
    }
}
