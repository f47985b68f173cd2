//! The bus as a log that candump, canplayer, python-can and others read:
//! `(0000000012.345678) can0 601#4000100000000000`.

use std::cell::RefCell;
use std::fmt;
use std::io::{self, Write};
use std::rc::Rc;

use crate::bus::node::ErrorKind;
use crate::bus::{Outcome, Record};
use crate::time::Time;

/// One line of the log, without line feed. The time is the end of the frame.
#[derive(Clone, Copy, Debug)]
pub struct Line<'a> {
    /// The interface's name, `can0`.
    pub channel: &'a str,
    /// What happened.
    pub record: &'a Record,
}

impl fmt::Display for Line<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "({}) {} ", Stamp(self.record.end), self.channel)?;
        match self.record.outcome {
            Outcome::Good | Outcome::KeptBack => write!(f, "{}", self.record.frame),
            Outcome::Bad(kind) => write!(f, "{}", error_frame(kind)),
        }
    }
}

/// Seconds with ten places before and six after the point.
struct Stamp(Time);

impl fmt::Display for Stamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let micros = self.0 .0 / 1_000_000;
        write!(f, "{:010}.{:06}", micros / 1_000_000, micros % 1_000_000)
    }
}

/// The error as Linux reports it (linux/can/error.h): class in the identifier with CAN_ERR_FLAG,
/// kind of the violation in byte 2.
fn error_frame(kind: ErrorKind) -> &'static str {
    match kind {
        ErrorKind::Acknowledge => "20000020#0000000000000000",
        ErrorKind::BitRecessive | ErrorKind::BitDominant => "20000008#0000010000000000",
        ErrorKind::Form => "20000008#0000020000000000",
        ErrorKind::Stuff => "20000008#0000040000000000",
        // Byte 3 says where: CRC sequence.
        ErrorKind::Crc => "20000008#0000000800000000",
    }
}

/// Which lines go into the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lines {
    /// Good frames. A frame that an injected fault kept from its receivers is not in it, as candump
    /// would not see it.
    Frames,
    /// Error frames too.
    FramesAndErrors,
}

/// Writes a log, and remembers the first failure instead of writing on.
#[derive(Debug)]
struct Log<W> {
    out: W,
    channel: String,
    lines: Lines,
    result: io::Result<()>,
}

/// A log in the making, shared with the bus that feeds it.
#[derive(Debug)]
pub struct Handle<W>(Rc<RefCell<Log<W>>>);

impl<W> Clone for Handle<W> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<W: Write + 'static> Handle<W> {
    /// A log of the interface `channel`.
    pub fn new(out: W, channel: &str, lines: Lines) -> Self {
        let log = Log { out, channel: channel.into(), lines, result: Ok(()) };
        Self(Rc::new(RefCell::new(log)))
    }

    /// Writes one line, if it belongs into the log and nothing has failed before.
    pub fn record(&self, record: &Record) {
        let mut log = self.0.borrow_mut();
        let wanted = match record.outcome {
            Outcome::Good => true,
            Outcome::KeptBack => false,
            Outcome::Bad(_) => log.lines == Lines::FramesAndErrors,
        };
        if wanted && log.result.is_ok() {
            let Log { out, channel, .. } = &mut *log;
            let written = writeln!(out, "{}", Line { channel, record });
            log.result = written;
        }
    }

    /// Brings everything to where it belongs. Gives the first failure since the last call; writing
    /// goes on after it.
    ///
    /// # Errors
    /// What the writer said.
    pub fn flush(&self) -> io::Result<()> {
        let mut log = self.0.borrow_mut();
        std::mem::replace(&mut log.result, Ok(()))?;
        log.out.flush()
    }

    /// What the bus calls for each frame.
    pub fn sink(&self) -> impl FnMut(&Record) + 'static {
        let handle = self.clone();
        move |record| handle.record(record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Frame;

    fn record(outcome: Outcome) -> Record {
        Record {
            start: Time(12_345_000_000_000),
            end: Time(12_345_678_999_999),
            frame: Frame::standard(0x601, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]).unwrap(),
            from: Some(0),
            readers: 0b10,
            outcome,
        }
    }

    #[test]
    fn lines() {
        let line = |record| Line { channel: "can0", record: &record }.to_string();
        assert_eq!(line(record(Outcome::Good)), "(0000000012.345678) can0 601#4000100000000000");
        let bad = record(Outcome::Bad(ErrorKind::Acknowledge));
        assert_eq!(line(bad), "(0000000012.345678) can0 20000020#0000000000000000");
    }

    #[test]
    fn what_goes_in() {
        for (lines, expected) in [(Lines::Frames, 1), (Lines::FramesAndErrors, 2)] {
            let log = Handle::new(Vec::new(), "can0", lines);
            let mut sink = log.sink();
            for outcome in [Outcome::Good, Outcome::KeptBack, Outcome::Bad(ErrorKind::Stuff)] {
                sink(&record(outcome));
            }
            log.flush().unwrap();
            let text = String::from_utf8(log.0.borrow().out.clone()).unwrap();
            assert_eq!(text.lines().count(), expected, "{text}");
        }
    }

    #[test]
    fn a_full_disk_is_reported_once() {
        struct Full;
        impl Write for Full {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(io::Error::other("disk full"))
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let log = Handle::new(Full, "can0", Lines::Frames);
        log.record(&record(Outcome::Good));
        log.record(&record(Outcome::Good));
        assert_eq!(log.flush().unwrap_err().to_string(), "disk full");
        assert!(log.flush().is_ok());
    }
}
