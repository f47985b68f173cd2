//! Opens the bus of an SLCAN adapter, and tells an adapter from another device at the same port.
//!
//! The protocol names no device, and the firmwares differ: some acknowledge commands with CR and
//! refuse with BEL, others send nothing but frames. So the tool sends `C` (twice), `V`, `Sn` and
//! `O`, and judges everything that comes back:
//!
//! | the device sends | it is |
//! |---|---|
//! | `V` and a number (`V1013`) to `V`, or frames (`t70517F`) | an adapter |
//! | CR or BEL alone to any command | an adapter (Lawicel, USBtin, Arduino sketches) |
//! | the same words to `V` each time, and no words to other commands | an adapter (CANable) |
//! | words to `C`, `Sn` or `O`, or without being asked | something else (modem, shell, GPS receiver) |
//! | nothing, or only what it got (an echo) | something else |
//!
//! An adapter may restart when its port opens (Arduino), so the commands are repeated for
//! [`START`]. A result that is not good is believed only if it comes twice: a late answer may be
//! taken for that of the next command, so the tool waits longer the second time.

use std::time::Duration;

use super::queue::LATE_ANSWER;
use super::{is_version, Line, Message, Slcan, ANSWER};
use crate::adapter::{AdapterError, Obstacle};
use crate::found::shown;
use crate::ports;

/// How long the line must be silent until a late adapter has answered all commands.
const QUIET: Duration = Duration::from_millis(500);
/// How long more text of an answer is waited for. Converters from USB hold back text for 16 ms.
pub(super) const REST: Duration = Duration::from_millis(30);
/// How long the commands are repeated for an adapter that is silent at first. The last attempt
/// begins after 2.4 s or later: by then an adapter that restarts has started.
const START: Duration = Duration::from_secs(3);
/// The most attempts, for a device that answers each one in another way.
const ATTEMPTS: usize = 6;
/// The most lines of an answer that are kept.
const MOST_LINES: usize = 8;

/// The bit rates in the order of their commands (`S0` to `S8`).
const BIT_RATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];

/// The answer to a command, as far as the protocol defines it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Answer {
    /// CR: done.
    Done,
    /// BEL: refused.
    Refused,
    /// Nothing, or nothing of the protocol.
    None,
}

/// What came back after a command.
pub(super) struct Reply {
    pub(super) answer: Answer,
    /// Lines outside the protocol.
    pub(super) words: Vec<String>,
}

/// The result of an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    /// The bus is open.
    Open,
    /// The bus is open, but the adapter also sends words.
    OpenWithWords,
    RefusesRate,
    RefusesOpen,
    /// It acknowledges `Sn`, but not `O`.
    OpenUnanswered,
    /// It acknowledges `O`, but not `Sn`.
    RateUnanswered,
    /// Nothing shows that it is an adapter.
    Unknown,
}

/// What an attempt has shown.
#[derive(Default)]
pub(super) struct Heard {
    /// It sent a version of the protocol, or a frame.
    is_certain: bool,
    /// It acknowledged or refused a command.
    answers: bool,
    /// It gave the same words to `V` twice.
    has_name: bool,
    /// It sent words where an adapter sends none.
    talks: bool,
    /// It did so before it was asked for its version: its words are no late answer.
    talks_first: bool,
    /// It sent anything but an echo.
    lives: bool,
}

impl Heard {
    fn is_adapter(&self) -> bool {
        self.is_certain || (!self.talks && (self.answers || self.has_name))
    }
}

impl<L: Line> Slcan<L> {
    /// Opens the bus of the adapter at the other end of `line`, at `bit_rate` (bit/s) or at the
    /// adapter's current bit rate. Waits until an adapter that restarts has started.
    ///
    /// # Errors
    /// [`AdapterError::Unusable`] if there is no adapter at the other end, or it answers in a way
    /// that leaves open what it did. [`AdapterError::Protocol`] if it refuses. [`AdapterError::Lost`] if the
    /// line fails.
    pub fn open(line: L, name: String, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        Self::opened(line, name).open_bus(bit_rate)
    }

    /// Opens the bus; the errors are those of [`open`](Self::open).
    pub(super) fn open_bus(mut self, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        self.rate = bit_rate.map(|rate| self.rate_command(rate)).transpose()?;
        let end = self.line.now() + START;
        let (mut before, mut window) = (None, ANSWER);
        for _ in 0..ATTEMPTS {
            let mut heard = Heard::default();
            let outcome = self.attempt(window, &mut heard)?;
            self.sending.opened(bit_rate, heard.answers);
            if outcome == Outcome::Open {
                return Ok(self);
            }
            let is_final = match outcome {
                Outcome::Unknown => self.line.now() >= end,
                outcome => before == Some(outcome),
            };
            before = Some(outcome);
            if is_final {
                break;
            }
            if heard.lives {
                self.drain()?;
            }
            if heard.lives && !heard.talks_first {
                window = LATE_ANSWER;
            }
        }
        self.judged(before)
    }

    /// The command for a bit rate.
    fn rate_command(&self, rate: u32) -> Result<String, AdapterError> {
        match BIT_RATES.iter().position(|known| *known == rate) {
            Some(number) => Ok(format!("S{number}")),
            None => Err(self.unexpected(format!("it does not support {rate} bit/s"))),
        }
    }

    /// Closes the bus, asks for the version, sets the bit rate and opens the bus.
    fn attempt(&mut self, window: Duration, heard: &mut Heard) -> Result<Outcome, AdapterError> {
        // The first C ends a line that an earlier session left incomplete. An empty line would do
        // the same, but some firmwares repeat their last command for it. An adapter whose bus is
        // closed refuses C, which does no harm.
        let words = self.ask("C\rC", window, heard)?.words;
        // The first line may be the rest of a frame that the adapter was sending.
        let is_rest = |line: &String| line.bytes().all(|byte| byte.is_ascii_hexdigit());
        heard.talks &= !matches!(words.as_slice(), [line] if is_rest(line));
        heard.talks_first = heard.talks;
        // Frames of a bus that was open before belong to an earlier session.
        self.early.clear();
        self.ask_name(window, heard)?;
        let set = match self.rate.clone() {
            Some(rate) => self.ask(&rate, window, heard)?.answer,
            None => Answer::None,
        };
        let open = self.ask("O", window, heard)?.answer;
        Ok(match (set, open) {
            _ if !heard.is_adapter() => Outcome::Unknown,
            (Answer::Refused, _) => Outcome::RefusesRate,
            (_, Answer::Refused) => Outcome::RefusesOpen,
            (Answer::Done, Answer::None) => Outcome::OpenUnanswered,
            (Answer::None, Answer::Done) if self.rate.is_some() => Outcome::RateUnanswered,
            _ if heard.talks => Outcome::OpenWithWords,
            _ => Outcome::Open,
        })
    }

    /// Asks for the version. Words of the adapter's own count as its name if it repeats them: a
    /// device that talks by itself, or that measures, says something else.
    fn ask_name(&mut self, window: Duration, heard: &mut Heard) -> Result<(), AdapterError> {
        let words = self.ask("V", window, heard)?.words;
        if words.is_empty() {
            return Ok(());
        }
        heard.has_name = self.ask("V", window, heard)?.words == words;
        heard.talks = heard.talks_first || !heard.has_name;
        Ok(())
    }

    /// Sends a command, and collects what comes back within `window`.
    pub(super) fn ask(
        &mut self,
        command: &str,
        window: Duration,
        heard: &mut Heard,
    ) -> Result<Reply, AdapterError> {
        self.send_text(&format!("{command}\r"))?;
        let end = self.line.now() + window;
        let rest = if window > ANSWER { QUIET } else { REST };
        let mut deadline = end;
        let mut reply = Reply { answer: Answer::None, words: Vec::new() };
        while let Some(message) = self.message(deadline)? {
            self.note(command, message, &mut reply, heard);
            if self.line.now() >= deadline {
                break;
            }
            deadline = end.min(self.line.now() + rest);
        }
        Ok(reply)
    }

    /// Adds a message to the reply.
    fn note(&mut self, command: &str, message: Message, reply: &mut Reply, heard: &mut Heard) {
        let text = match message {
            Message::Text(text) if command.split('\r').any(|sent| sent.as_bytes() == text) => {
                self.echoes = true;
                return;
            }
            Message::Text(text) => Some(text),
            Message::Refused => None,
        };
        heard.lives = true;
        let answer = match text.as_deref() {
            None => Answer::Refused,
            Some(b"" | b"z" | b"Z") => Answer::Done,
            Some(text) => {
                if self.stray(text) || is_version(text) {
                    heard.is_certain = true;
                } else {
                    heard.talks = true;
                    let words = shown(text);
                    self.odd.get_or_insert_with(|| words.clone());
                    if reply.words.len() < MOST_LINES {
                        reply.words.push(words);
                    }
                }
                return;
            }
        };
        heard.answers = true;
        if reply.answer == Answer::None {
            reply.answer = answer;
        }
    }

    /// Waits until the answers to earlier commands have arrived, and drops them.
    fn drain(&mut self) -> Result<(), AdapterError> {
        let end = self.line.now() + LATE_ANSWER;
        while self.line.now() < end {
            let quiet = self.line.now() + QUIET;
            if self.message(quiet.min(end))?.is_none() {
                break;
            }
        }
        Ok(())
    }

    /// The result of the attempts, of which the last had this outcome, as an adapter or an error.
    fn judged(self, outcome: Option<Outcome>) -> Result<Self, AdapterError> {
        let rate = self.rate.as_deref().unwrap_or("S");
        let changes = |done: &str, undone: &str| {
            let what = format!("it acknowledges {done}, but not {undone}");
            let advice =
                "unplug the adapter and plug it in again; if it has a fixed bit rate, leave out @BITRATE";
            Err(AdapterError::unusable(&self.name, Obstacle::Other, what, advice))
        };
        match outcome {
            Some(Outcome::Open | Outcome::OpenWithWords) => Ok(self),
            Some(Outcome::RefusesRate) => Err(self.unexpected("it refuses the bit rate".to_string())),
            Some(Outcome::RefusesOpen) => Err(self.unexpected("it refuses to open the bus".to_string())),
            Some(Outcome::OpenUnanswered) => changes(rate, "O"),
            Some(Outcome::RateUnanswered) => changes("O", rate),
            Some(Outcome::Unknown) | None => Err(self.no_adapter()),
        }
    }

    /// The error for a device that is not an SLCAN adapter.
    fn no_adapter(&self) -> AdapterError {
        let said = match &self.odd {
            Some(odd) => format!("; it sent '{odd}'"),
            // Text without an end of line.
            None if !self.partial.is_empty() => format!("; it sent '{}'", shown(&self.partial)),
            None if self.echoes => "; it sent back what it got".to_string(),
            None => String::new(),
        };
        let at = self.baud.map_or(String::new(), |baud| format!(" at {baud} bit/s"));
        let what =
            format!("it answered neither V (version) nor O (open the bus){at} as an adapter does{said}");
        let speed = match self.baud {
            Some(_) => "an adapter with a UART may have another speed: append, for example, ?baud=57600 to the URL; or ",
            None => "",
        };
        let advice = format!(
            "{speed}this is not an SLCAN adapter, or another port of it: {}; some adapters must be switched to SLCAN, or speak gs_usb",
            ports::those_there()
        );
        AdapterError::unusable(&self.name, Obstacle::Absent, what, advice)
    }
}
