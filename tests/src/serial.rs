//! The board's serial line as a host's end of it, in virtual time.

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read, Write};
use std::time::{Duration, Instant};

use coflash::adapter::slcan::Line;
use emulator::time::Span;

use crate::bench::Bench;

/// How far the board goes on between two looks at the line.
const LOOK: Span = Span::from_micros(100);

/// The host's end of the line of a board's UART. Whoever reads lets the board run.
pub struct SerialLine<'b> {
    /// The bench of the board.
    pub bench: &'b mut Bench,
    epoch: Instant,
    timeout: Duration,
    /// What has come and was not read yet.
    come: VecDeque<u8>,
}

impl<'b> SerialLine<'b> {
    /// The line of the first board of a bench, which has power and has set its UART up.
    pub fn new(bench: &'b mut Bench) -> Self {
        Self { bench, epoch: Instant::now(), timeout: Duration::ZERO, come: VecDeque::new() }
    }
}

impl Read for SerialLine<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let deadline = self.now() + self.timeout;
        loop {
            self.come.extend(self.bench.usart().take_sent().iter().map(|character| character.byte));
            if !self.come.is_empty() {
                return self.come.read(buffer);
            }
            if self.now() >= deadline {
                return Err(ErrorKind::TimedOut.into());
            }
            self.bench.world.run_for(LOOK);
        }
    }
}

impl Write for SerialLine<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let now = self.bench.time();
        Ok(self.bench.usart().receive(bytes, now))
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Line for SerialLine<'_> {
    fn set_timeout(&mut self, timeout: Duration) -> io::Result<()> {
        self.timeout = timeout;
        Ok(())
    }

    fn now(&self) -> Instant {
        self.epoch + Duration::from_nanos(self.bench.time().0 / 1000)
    }
}
