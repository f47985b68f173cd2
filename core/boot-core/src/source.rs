//! Where the data for the flash come from: the pieces in the queue, or a sealed image, whose bytes
//! are in the queue and whose pieces come out of the [`Unsealer`].
//!
//! The programmer asks this module, and never which of the two it is.

use canopen::program::FlashError;
use shared_abi::block_file::MAX_BLOCK_SIZE;

use crate::flash::Flash;
use crate::program::Expected;
use crate::queue::{Piece, Queue};
use crate::store::{Parameters, Value};
use crate::unseal::{proved, Progress, Unsealer};

/// The source of the program that is being downloaded.
pub(crate) struct Source<'b> {
    /// The received data that are not in flash yet.
    pub queue: Queue<'b>,
    /// The sealed image, if the program came as one.
    pub unsealer: Unsealer<'b>,
    /// `Some` from the end of the program's data until the program is to be verified.
    ended: Option<Expected>,
    /// The creation date in the control block, in seconds since 1970-01-01 UTC, 0 for none. `None` when it is
    /// stored.
    date: Option<u32>,
}

/// What there is to do when no piece is ready.
pub(crate) enum Demand {
    /// Nothing before more data arrive.
    Wait,
    /// The received bytes must be [processed](Source::step).
    Process,
    /// The program has this security counter: it must be stored.
    Counter(Value),
    /// All of the program is in flash, which must be compared with this.
    Verify(Expected),
    /// The program was already installed, with this record.
    Keep(Value),
}

impl<'b> Source<'b> {
    pub(crate) fn new(buffer: &'b mut [u8], unsealer: Unsealer<'b>) -> Self {
        Self { queue: Queue::new(buffer), unsealer, ended: None, date: None }
    }

    /// Another program begins, or none: the queue stays.
    pub(crate) fn end(&mut self) {
        self.unsealer.cancel();
        self.ended = None;
    }

    /// Discards the received data.
    pub(crate) fn clear(&mut self) {
        self.queue.clear();
        self.end();
    }

    /// The program was sent completely, with this date. (A sealed image has its date in the manifest.)
    pub(crate) fn complete(&mut self, expected: Expected, date: u32) {
        self.ended = Some(expected);
        self.date = Some(date);
    }

    /// The date of the program, and the CRC of the program to which it belongs: it must be stored before the
    /// program is verified. Once, when all of it is in flash.
    pub(crate) fn take_date(&mut self) -> Option<Value> {
        let expected = match self.unsealer.progress() {
            None => self.ended?,
            Some(Progress::Installed { .. }) if self.is_complete() => self.unsealer.expected(),
            Some(_) => return None,
        };
        let announced = self.date.take()?;
        let date = if self.unsealer.is_active() { self.unsealer.created() } else { announced };
        Some([date, expected.crc.filter(|_| date != 0)?, 0, 0])
    }

    /// Whether the program was sent completely, and is not yet to be verified.
    pub(crate) fn is_complete(&self) -> bool {
        self.ended.is_some()
    }

    /// Whether the size of the program is known. That of a sealed image is not known before an
    /// authentic piece.
    pub(crate) fn is_sized(&self) -> bool {
        self.is_complete() && !self.unsealer.is_active()
    }

    /// The size of the program, if it is known: that of an authentic image, or of a complete one.
    pub(crate) fn size(&self) -> Option<u32> {
        if self.unsealer.is_active() {
            Some(self.unsealer.expected().size)
        } else {
            self.ended.map(|expected| expected.size)
        }
    }

    /// Whether there is something to [process](Self::step) before any piece: the signature of a
    /// request for rights.
    pub(crate) fn is_urgent(&self) -> bool {
        self.unsealer.is_asked()
    }

    /// Whether there is something to do before more data arrive.
    pub(crate) fn has_work(&self) -> bool {
        let works = matches!(self.unsealer.progress(), Some(Progress::Works));
        !self.queue.is_empty() || works || self.is_urgent() || self.is_complete()
    }

    /// Whether the queue has room for a block of the largest size. (A smaller queue takes one block
    /// at a time.)
    pub(crate) fn has_room(&self) -> bool {
        self.queue.is_empty() || self.queue.free() >= MAX_BLOCK_SIZE
    }

    /// The next piece for the flash.
    pub(crate) fn piece(&self) -> Option<Piece> {
        if self.unsealer.is_active() {
            self.unsealer.piece()
        } else {
            self.queue.first()
        }
    }

    /// A byte of this piece.
    pub(crate) fn byte(&self, offset: usize) -> u8 {
        if self.unsealer.is_active() {
            self.unsealer.data(offset)
        } else {
            self.queue.data(offset)
        }
    }

    /// The piece is in flash.
    pub(crate) fn written(&mut self) {
        if self.unsealer.is_active() {
            self.unsealer.written();
        } else {
            self.queue.pop();
        }
    }

    /// What there is to do when no piece is ready.
    pub(crate) fn next(&mut self) -> Result<Demand, FlashError> {
        let (ended, is_empty) = (self.is_complete(), self.queue.is_empty());
        match self.unsealer.progress() {
            None => Ok(self.ended.take().map_or(Demand::Wait, Demand::Verify)),
            Some(Progress::Waits) if is_empty && ended => Err(FlashError::Format),
            Some(Progress::Waits) if is_empty => Ok(Demand::Wait),
            Some(Progress::Waits | Progress::Works) => Ok(Demand::Process),
            Some(Progress::Installed { .. }) if !is_empty => Err(FlashError::Format),
            Some(Progress::Installed { .. }) if !ended => Ok(Demand::Wait),
            Some(Progress::Installed { same }) => {
                // Also for the same image: its certificate may have a higher epoch.
                if let Some(counter) = self.unsealer.take_counter() {
                    return Ok(Demand::Counter(counter));
                }
                self.ended = None;
                Ok(match same {
                    Some(record) => Demand::Keep(record),
                    None => Demand::Verify(self.unsealer.expected()),
                })
            }
        }
    }

    /// Processes received bytes with one bounded step.
    pub(crate) fn step<F: Flash>(
        &mut self,
        flash: &F,
        parameters: &impl Parameters,
    ) -> Result<(), FlashError> {
        self.unsealer.step(flash, parameters, &mut self.queue)
    }

    /// The security counter that must be stored before the record of this program is removed.
    pub(crate) fn proved<F: Flash>(
        &self,
        flash: &F,
        parameters: &impl Parameters,
        program: u8,
    ) -> Option<Value> {
        if self.unsealer.is_present() {
            proved(flash, parameters, program)
        } else {
            None
        }
    }

    /// The record of the program was stored, or could not be stored.
    pub(crate) fn stored(&mut self, result: Result<(), FlashError>) {
        self.unsealer.stored(result);
    }

    /// The work on the program failed.
    pub(crate) fn fail(&mut self, error: FlashError) {
        self.unsealer.fail(error);
    }
}
