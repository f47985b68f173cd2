//! The adapter's end of an SLCAN line: CAN frames as text, after the manuals of Lawicel's CAN232
//! and CANUSB. It takes bytes, and returns answers and frames.
//!
//! It simulates a bus with two nodes, this device and the host, without a bit rate: every bit rate
//! is accepted. There are no time stamps, no filters that the host could set and no polling:
//! commands for these are refused.

use embedded_can::{ExtendedId, Frame, Id, StandardId};
use shared_abi::bxcan::data_length;

use crate::ring::LOST;

/// Length of the protocol's longest line without its end: a data frame of eight bytes with an
/// identifier of 29 bits.
const LONGEST: usize = 1 + 8 + 1 + 16;
/// Length of the longest text of a frame, with its end.
pub const FRAME_TEXT: usize = LONGEST + 1;
/// The end of a line.
pub const END: u8 = b'\r';
/// BEL: a command is refused.
const REFUSED: Answer = Answer::of(&[0x07]);
const DONE: Answer = Answer::of(&[END]);

/// The answer to a line of the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Answer {
    bytes: [u8; 6],
    len: usize,
}

impl Answer {
    const fn of(text: &[u8]) -> Self {
        let mut bytes = [0; 6];
        let mut len = 0;
        while len < text.len() && len < bytes.len() {
            bytes[len] = text[len];
            len += 1;
        }
        Self { bytes, len }
    }

    /// The text of the answer.
    #[must_use]
    pub fn text(&self) -> &[u8] {
        self.bytes.get(..self.len).unwrap_or_default()
    }
}

/// The state of the channel: whether frames pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Channel {
    /// After a reset of this device, which the host may not know of: frames pass, and the host may
    /// open the channel as if it were closed.
    Fresh,
    /// Frames pass in both directions.
    Open,
    /// Frames pass only to the host.
    Listening,
    /// No frames pass.
    Closed,
}

/// The adapter.
#[derive(Clone, Debug)]
pub struct Slcan {
    channel: Channel,
    line: [u8; LONGEST],
    /// Number of bytes of the line; a line with more bytes than fit is refused.
    len: usize,
    overrun: bool,
    serial: u16,
}

impl Slcan {
    /// The adapter of a device with this serial number, after its reset.
    #[must_use]
    pub const fn new(serial: u16) -> Self {
        Self { channel: Channel::Fresh, line: [0; LONGEST], len: 0, overrun: false, serial }
    }

    /// Whether frames to the host pass; otherwise they are lost, as on a bus without another node.
    #[must_use]
    pub fn is_heard(&self) -> bool {
        self.channel != Channel::Closed
    }

    /// Takes a byte from the host. At the end of a line it returns the answer and the frame of the
    /// line, if it was one.
    pub fn receive<F: Frame>(&mut self, byte: u8) -> Option<(Answer, Option<F>)> {
        match byte {
            END => {
                let len = core::mem::take(&mut self.len);
                let line = self.line;
                // The line is too long, or part of it is lost.
                Some(line.get(..len).map_or((REFUSED, None), |line| self.carry_out(line)))
            }
            // Some hosts end their lines with CR LF.
            b'\n' if self.len == 0 => None,
            _ => {
                self.overrun |= byte == LOST;
                if let Some(place) = self.line.get_mut(self.len) {
                    *place = byte;
                }
                // The count stops at one more than fits.
                self.len = (self.len + 1).min(LONGEST + 1);
                None
            }
        }
    }

    fn carry_out<F: Frame>(&mut self, line: &[u8]) -> (Answer, Option<F>) {
        let may_send = matches!(self.channel, Channel::Fresh | Channel::Open);
        if let Some(frame) = parse(line).filter(|_| may_send) {
            let done = match line {
                [b'T' | b'R', ..] => Answer::of(b"Z\r"),
                _ => Answer::of(b"z\r"),
            };
            return (done, Some(frame));
        }
        (self.command(line).unwrap_or(REFUSED), None)
    }

    /// Carries out a command that is not a frame; `None` if it is refused.
    fn command(&mut self, line: &[u8]) -> Option<Answer> {
        let may_open = matches!(self.channel, Channel::Fresh | Channel::Closed);
        match line {
            // An empty line ends an incomplete command.
            [] => Some(DONE),
            // The bit rate by its number, or by two registers of a controller that does not exist
            // here.
            [b'S', b'0'..=b'8'] => may_open.then_some(DONE),
            [b's', digits @ ..] if digits.len() == 4 && number(digits).is_some() => may_open.then_some(DONE),
            [b'O'] if may_open => self.set(Channel::Open),
            [b'L'] if may_open => self.set(Channel::Listening),
            [b'C'] if self.channel != Channel::Closed => self.set(Channel::Closed),
            // Time stamps stay off; frames are sent without polling.
            [b'Z', b'0'] | [b'X', b'1'] => may_open.then_some(DONE),
            [b'F'] if self.channel != Channel::Closed => {
                // Bit 3: data overrun.
                let overrun = core::mem::take(&mut self.overrun);
                Some(Answer::of(if overrun { b"F08\r" } else { b"F00\r" }))
            }
            // Hardware 1.0, software 1.3: the protocol of the CAN232's manual.
            [b'V'] => Some(Answer::of(b"V1013\r")),
            [b'N'] => {
                let digit = |place: u32| hex(self.serial >> (4 * place));
                Some(Answer::of(&[b'N', digit(3), digit(2), digit(1), digit(0), END]))
            }
            _ => None,
        }
    }

    fn set(&mut self, channel: Channel) -> Option<Answer> {
        self.channel = channel;
        Some(DONE)
    }
}

/// The text of a frame for the host, with its end.
pub fn text_of<F: Frame>(frame: &F, mut put: impl FnMut(u8)) {
    let (id, digits) = match frame.id() {
        Id::Standard(id) => (id.as_raw().into(), 3),
        Id::Extended(id) => (id.as_raw(), 8),
    };
    put(match (digits, frame.is_remote_frame()) {
        (3, false) => b't',
        (3, true) => b'r',
        (_, false) => b'T',
        (_, true) => b'R',
    });
    for place in (0..digits).rev() {
        put(hex((id >> (4 * place)) as u16));
    }
    put(hex(frame.dlc() as u16));
    for byte in frame.data() {
        put(hex(u16::from(*byte) >> 4));
        put(hex(u16::from(*byte)));
    }
    put(END);
}

/// The frame of a line; `None` if the line is not a frame.
fn parse<F: Frame>(line: &[u8]) -> Option<F> {
    let (kind, rest) = line.split_first()?;
    let (id, rest): (Id, _) = match kind {
        b't' | b'r' => {
            let (digits, rest) = rest.split_at_checked(3)?;
            (StandardId::new(number(digits)? as u16)?.into(), rest)
        }
        b'T' | b'R' => {
            let (digits, rest) = rest.split_at_checked(8)?;
            (ExtendedId::new(number(digits)?)?.into(), rest)
        }
        _ => return None,
    };
    let (&dlc, data) = rest.split_first()?;
    let dlc = data_length(number(&[dlc])? as u8);
    if matches!(kind, b'r' | b'R') {
        return data.is_empty().then(|| F::new_remote(id, dlc))?;
    }
    if data.len() != 2 * dlc {
        return None;
    }
    let mut bytes = [0; 8];
    for (byte, digits) in bytes.iter_mut().zip(data.chunks(2)) {
        *byte = number(digits)? as u8;
    }
    F::new(id, bytes.get(..dlc)?)
}

/// The number in up to eight hexadecimal digits.
fn number(digits: &[u8]) -> Option<u32> {
    digits.iter().try_fold(0, |number, &digit| Some(number << 4 | char::from(digit).to_digit(16)?))
}

/// The digit of the lowest four bits.
fn hex(value: u16) -> u8 {
    char::from_digit((value & 0xF).into(), 16).map_or(b'0', |digit| digit.to_ascii_uppercase() as u8)
}
