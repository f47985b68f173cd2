//! The same firmware with CAN over its UART: the masters are one host on a serial line, and frames
//! are text (`docs/can-over-uart.md`). Between them come bytes that are no frame.

use std::collections::VecDeque;
use std::fmt::Write as _;

use attack::device::Action;
use canopen::Frame;
use embedded_can::{Frame as _, Id, StandardId};
use emulator::machine::Usart;
use emulator::time::Span;
use shared_abi::layout::Layout;

use super::board::{long_dlc, Board};
use super::target::{Event, Happened, Target};
use kit::random::Random;

/// The device has said all that it has to say when it was silent for this time, in us: its answer to a
/// frame begins earlier.
const SILENCE_US: u64 = 8000;
/// Bytes that wait at the board's receiver at most.
const AHEAD: usize = 64;

/// A board and its serial line.
pub struct SerialBoard {
    board: Board,
    /// Bytes for the device, and the frames in them with the number of their last byte.
    to_send: VecDeque<u8>,
    frames: VecDeque<(u64, Frame)>,
    /// Bytes ordered, and bytes given to the receiver of the board.
    ordered: u64,
    given: u64,
    /// The begun line of the device, and when its last byte came.
    line: String,
    said_at: u64,
    /// The time of the last exchange.
    exchanged_at: u64,
    events: Vec<Event>,
}

impl SerialBoard {
    /// A board with this bootloader, switched on.
    #[must_use]
    pub fn new(layout: &'static Layout, bootloader: &str) -> Self {
        Self {
            board: Board::new(layout, bootloader, &[]),
            to_send: VecDeque::new(),
            frames: VecDeque::new(),
            ordered: 0,
            given: 0,
            line: String::new(),
            said_at: 0,
            exchanged_at: 0,
            events: Vec::new(),
        }
    }

    /// The UART of the firmware, once it is in use.
    fn usart(&mut self) -> Option<&mut Usart> {
        self.board.bench.machine().usarts_mut().iter_mut().find(|usart| usart.accesses() > 0)
    }

    fn order(&mut self, bytes: &[u8]) {
        self.ordered += bytes.len() as u64;
        self.to_send.extend(bytes);
    }

    /// Gives the receiver some bytes, and reads what the device says.
    fn exchange(&mut self) {
        let now = self.board.bench.time();
        let at = self.now_us();
        let mut bytes = std::mem::take(&mut self.to_send);
        let Some(usart) = self.usart() else {
            self.to_send = bytes;
            return;
        };
        let room = AHEAD.saturating_sub(usart.waiting()).min(bytes.len());
        let next: Vec<u8> = bytes.iter().take(room).copied().collect();
        let taken = usart.receive(&next, now);
        bytes.drain(..taken);
        let waiting = usart.waiting() as u64;
        let said: Vec<u8> = usart.take_sent().iter().map(|character| character.byte).collect();
        self.to_send = bytes;
        self.given += taken as u64;
        // They came since the last exchange, and before what the device made of them.
        let came_at = std::mem::replace(&mut self.exchanged_at, at);
        while let Some((_, frame)) = self.frames.front().filter(|(end, _)| *end <= self.given - waiting) {
            self.events.push((came_at, Happened::Frame { by_device: false, frame: *frame }));
            self.frames.pop_front();
        }
        for byte in said {
            self.said_at = at;
            match byte {
                b'\r' => {
                    let line = std::mem::take(&mut self.line);
                    if let Some(frame) = frame(&line) {
                        self.events.push((at, Happened::Frame { by_device: true, frame }));
                    }
                }
                // A refusal of what was no line.
                0x07 => self.line.clear(),
                byte => self.line.push(byte.into()),
            }
        }
    }

    /// Bytes that are no line, and lines that are no frame.
    fn scramble(&mut self, random: &mut Random) {
        // What a host could ask for is excluded by the first character: a closed channel is closed.
        let mut bytes = vec![b'\r', b'x'];
        let len = random.below(200);
        let alphabet = random.pick(&[&b"tTrR0123456789ABCDEF"[..], &[0x00, 0x07, 0x0A, 0x7F, 0x80, 0xFF]]);
        let any = random.chance(50);
        bytes.extend((0..len).map(|_| if any { random.below(256) as u8 } else { random.pick(alphabet) }));
        bytes[2..].iter_mut().filter(|byte| **byte == b'\r').for_each(|byte| *byte = b'!');
        self.order(&bytes);
    }
}

/// The text of a frame (CAN232 manual); if it has eight bytes, with any data length code that means eight.
fn text(frame: &Frame, sent: u64) -> String {
    let dlc = if frame.dlc() == 8 { long_dlc(sent) } else { frame.dlc() as u8 };
    let kind = match (frame.is_extended(), frame.is_remote_frame()) {
        (false, false) => 't',
        (false, true) => 'r',
        (true, false) => 'T',
        (true, true) => 'R',
    };
    let mut text = match frame.id() {
        Id::Standard(id) => format!("{kind}{:03X}{dlc:X}", id.as_raw()),
        Id::Extended(id) => format!("{kind}{:08X}{dlc:X}", id.as_raw()),
    };
    for byte in frame.data() {
        // Writing into a string cannot fail.
        let _ = write!(text, "{byte:02X}");
    }
    text
}

/// The data frame in a line of the device; `None` for its acknowledgements and for part of a line.
fn frame(line: &str) -> Option<Frame> {
    let digits = line.strip_prefix('t')?;
    let id = StandardId::new(u16::from_str_radix(digits.get(..3)?, 16).ok()?)?;
    let data = digits.get(4..)?.as_bytes().chunks(2).map(|two| {
        let two = std::str::from_utf8(two).ok()?;
        u8::from_str_radix(two, 16).ok()
    });
    let data: Vec<u8> = data.collect::<Option<_>>()?;
    (digits.get(3..4)? == data.len().to_string()).then(|| Frame::new(id, &data))?
}

impl Target for SerialBoard {
    fn now_us(&self) -> u64 {
        self.board.now_us()
    }

    /// Queues of 512 bytes at 115 200 bit/s.
    fn answer_us(&self) -> u64 {
        70_000
    }

    fn send(&mut self, _master: usize, frame: &Frame) {
        // The first CR ends whatever is on the line.
        let line = format!("\r{}\r", text(frame, self.ordered));
        self.order(line.as_bytes());
        self.frames.push_back((self.ordered, *frame));
    }

    fn is_drained(&mut self) -> bool {
        self.frames.is_empty() && self.to_send.is_empty() && self.now_us() > self.said_at + SILENCE_US
    }

    fn pass_us(&mut self, us: u64) {
        let until = self.now_us() + us;
        loop {
            self.exchange();
            let left = until.saturating_sub(self.now_us());
            if left == 0 {
                return;
            }
            self.board.bench.world.run_for(Span::from_micros(left.min(1000)));
        }
    }

    fn events(&mut self) -> Vec<Event> {
        let mut events = self.board.events();
        events.append(&mut self.events);
        events.sort_by_key(|(at, _)| *at);
        events
    }

    fn flash(&mut self) -> &[u8] {
        self.board.flash()
    }

    fn flash_activity(&mut self) -> (u64, bool) {
        self.board.flash_activity()
    }

    fn act(&mut self, action: &Action) {
        match *action {
            Action::Scramble(seed) => self.scramble(&mut Random(seed)),
            // It has no error frames.
            Action::Disturb(_) => {}
            _ => {
                self.board.act(action);
                if matches!(action, Action::PowerOff) {
                    self.line.clear();
                }
            }
        }
    }

    fn longest_between_feeds_us(&mut self) -> u64 {
        self.board.longest_between_feeds_us()
    }

    fn complaint(&mut self) -> Option<String> {
        self.board.complaint()
    }
}
