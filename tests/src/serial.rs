//! The host's end of the board's serial line, in virtual time.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::time::{Duration, Instant};

use canopen::NodeId;
use coboot_can::slcan::Line;
use coboot_can::{Adapter, AdapterError};
use coflash_core::device::{Session, Timing};
use embedded_can::{Frame as _, Id, StandardId};
use emulator::time::{Span, Time};

use crate::bench::Bench;
use crate::script::Wire;

/// How long the board runs between two reads of the line.
const PERIOD: Span = Span::from_micros(100);
/// Shorter than a character at 115 200 bit/s (87 us): a session that ends with a frame ends before
/// the first character of the next frame is complete, so that this frame is still checked.
const SHORT_PERIOD: Span = Span::from_micros(50);

/// A board with a serial line.
pub trait Serial {
    /// Its time.
    fn time(&self) -> Duration;
    /// Moves what it has sent to the end of `received`.
    fn take_sent(&mut self, received: &mut VecDeque<u8>);
    /// Runs for a moment.
    ///
    /// # Errors
    /// The board does not run.
    fn run(&mut self) -> io::Result<()>;
    /// Receives these bytes; returns how many.
    fn send(&mut self, bytes: &[u8]) -> usize;
}

impl Serial for &mut Bench {
    fn time(&self) -> Duration {
        Duration::from_nanos(Bench::time(self).0 / 1000)
    }

    fn take_sent(&mut self, received: &mut VecDeque<u8>) {
        received.extend(self.usart().take_sent().iter().map(|character| character.byte));
    }

    fn run(&mut self) -> io::Result<()> {
        self.world.run_for(PERIOD);
        Ok(())
    }

    fn send(&mut self, bytes: &[u8]) -> usize {
        let now = Bench::time(self);
        self.usart().receive(bytes, now)
    }
}

/// The host's end of the line of a board. A read lets the board run.
pub struct SerialLine<S> {
    board: S,
    epoch: Instant,
    timeout: Duration,
    /// Received bytes that were not read yet.
    received: VecDeque<u8>,
}

impl<S: Serial> SerialLine<S> {
    /// The line of a board, which has power and has configured its UART.
    pub fn new(board: S) -> Self {
        Self { board, epoch: Instant::now(), timeout: Duration::ZERO, received: VecDeque::new() }
    }
}

impl<S: Serial> Read for SerialLine<S> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let deadline = self.board.time() + self.timeout;
        loop {
            self.board.take_sent(&mut self.received);
            if !self.received.is_empty() {
                return self.received.read(buffer);
            }
            if self.board.time() >= deadline {
                return Err(ErrorKind::TimedOut.into());
            }
            self.board.run()?;
        }
    }
}

impl<S: Serial> Write for SerialLine<S> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Ok(self.board.send(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<S: Serial> Line for SerialLine<S> {
    fn set_timeout(&mut self, timeout: Duration) -> io::Result<()> {
        self.timeout = timeout;
        Ok(())
    }

    fn now(&self) -> Instant {
        self.epoch + self.board.time()
    }
}

/// A board's UART as a bus: frames as text, as in the CAN232's manual. This code is independent of
/// coflash's parser.
pub struct TextBus {
    /// The bench of the board.
    pub bench: Bench,
    /// The received part of a line, and the end time of its first character.
    line: (Time, String),
    heard: Vec<Heard>,
    /// The frames up to here were passed to the host's session.
    given: usize,
}

/// A frame of the device.
struct Heard {
    start: Time,
    end: Time,
    id: u16,
    data: Vec<u8>,
}

impl TextBus {
    /// The UART of the first board of a bench.
    pub fn new(bench: Bench) -> Self {
        Self { bench, line: (Time(0), String::new()), heard: Vec::new(), given: 0 }
    }

    fn run(&mut self, span: Span) {
        self.bench.world.run_for(span);
        let usarts = self.bench.machine().usarts_mut().iter_mut();
        for character in usarts.flat_map(|usart| usart.take_sent()).collect::<Vec<_>>() {
            let (start, line) = &mut self.line;
            if line.is_empty() {
                *start = character.end;
            }
            match character.byte {
                b'\r' => {
                    let line = std::mem::take(line);
                    self.heard.extend(frame(*start, character.end, &line));
                }
                byte => line.push(byte.into()),
            }
        }
    }
}

/// The frame in a line of text; a line without a frame acknowledges the host's text.
fn frame(start: Time, end: Time, line: &str) -> Option<Heard> {
    let text = match line.strip_prefix('t') {
        Some(text) => text,
        None if line.is_empty() || line == "z" => return None,
        None => panic!("the device said {line:?}"),
    };
    let number = |digits: &str| u16::from_str_radix(digits, 16).expect("hexadecimal digits");
    let (id, len) = (number(&text[..3]), number(&text[3..4]));
    let data: Vec<u8> = (4..text.len()).step_by(2).map(|i| number(&text[i..i + 2]) as u8).collect();
    assert_eq!(data.len(), usize::from(len), "the device said {line:?}");
    Some(Heard { start, end, id, data })
}

impl Wire for TextBus {
    fn bench(&mut self) -> &mut Bench {
        &mut self.bench
    }

    fn power_cycle(&mut self) {
        self.bench.power_cycle();
        // The rest of a line that was cut.
        self.line.1.clear();
    }

    fn run_ms(&mut self, ms: u64) {
        self.run(Span::from_millis(ms));
    }

    fn send(&mut self, id: u16, data: &[u8]) {
        let data_text: String = data.iter().map(|byte| format!("{byte:02X}")).collect();
        let text = format!("t{id:03X}{}{data_text}\r", data.len());
        let now = self.bench.time();
        assert_eq!(self.bench.usart().receive(text.as_bytes(), now), text.len());
    }

    fn frames_since(&self, from: Time) -> Vec<(Time, u32, Vec<u8>)> {
        let since = self.heard.iter().filter(|frame| frame.start >= from);
        since.map(|frame| (frame.end, frame.id.into(), frame.data.clone())).collect()
    }

    fn session_with(&mut self, node: u8) -> Session<'_> {
        self.given = self.heard.len();
        Session::new(self, NodeId::new(node).expect("1 to 127"), Timing::default())
    }
}

impl Adapter for TextBus {
    fn send(&mut self, frame: &canopen::Frame) -> Result<(), AdapterError> {
        let Id::Standard(id) = frame.id() else { panic!("CANopen has 11 bits") };
        Wire::send(self, id.as_raw(), frame.data());
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<canopen::Frame>, AdapterError> {
        let nanos = u64::try_from(timeout.as_nanos()).unwrap_or(u64::MAX / 1000);
        let deadline = self.bench.time() + Span::from_nanos(nanos);
        loop {
            if let Some(Heard { id, data, .. }) = self.heard.get(self.given) {
                self.given += 1;
                let id = StandardId::new(*id).expect("11 bits");
                return Ok(canopen::Frame::new(id, data));
            }
            if self.bench.time() >= deadline {
                return Ok(None);
            }
            self.run(SHORT_PERIOD);
        }
    }

    fn now(&self) -> Duration {
        Duration::from_nanos(self.bench.time().0 / 1000)
    }
}
