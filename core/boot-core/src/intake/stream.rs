//! Common code of the formats with a whole program in one transfer: it cuts the bytes into pieces,
//! and checks the first piece before the old program is lost.

use canopen::program::FlashError;
use canopen::AbortCode;
use shared_abi::geometry::Region;
use shared_abi::label;

use super::format::{Begin, Destination, SMALLEST_PROGRAM};
use crate::policy::Judge;
use crate::program::Expected;
use crate::queue::{Queue, PIECE_HEADER};
use crate::refusal::Refusal;
use crate::resume::Partial;

/// Data of a piece: long enough to keep the flash busy, short enough that a small queue holds
/// several.
const PIECE: usize = 1024;
/// The part of the queue that is filled slowly, so that a client still gets its answers in time
/// while the flash erases. An erase of 2 s at 7 bytes every
/// [`HOLD_MS`](canopen::sdo::server::HOLD_MS) needs 7 KiB.
const RESERVE: usize = 8 * 1024;

/// The number of bytes that a stream may send at present. With `held`, the answer to the client is
/// already delayed, and the client may use the reserve. (Data scattered byte by byte take 9 bytes
/// of the queue each, and at least 13 characters of Intel HEX.)
pub(super) fn room(queue: &Queue<'_>, held: bool) -> usize {
    let reserve = RESERVE.min(queue.capacity() / 4);
    // The open piece already has its header; another piece may begin.
    let keep = 2 * PIECE_HEADER + if held { 0 } else { reserve };
    queue.free().saturating_sub(keep)
}

/// An incoming program.
pub(super) struct Stream {
    /// The address of the next byte.
    next: u32,
    /// The address after the highest byte so far.
    end: u32,
    /// Size of the image in bytes, 0 if unknown.
    size: u32,
}

impl Stream {
    pub(super) fn new(judge: &Judge<'_>) -> Self {
        let base = judge.region.base;
        Self { next: base, end: base, size: 0 }
    }

    /// Sets the size of the image.
    pub(super) fn set_size(&mut self, size: u32) {
        self.size = size;
    }

    /// Sets the address of the next bytes: a gap begins a new piece, but for one before the label.
    pub(super) fn seek(&mut self, address: u32, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        // A linker may leave a gap before the label, which is judged with the vectors.
        let base = to.judge.region.base;
        if self.next != base && address <= base + label::OFFSET {
            while self.next < address && to.queue.push(self.next, &[0xFF]) {
                self.next += 1;
            }
        }
        if address != self.next {
            self.close(to)?;
            self.next = address;
        }
        Ok(())
    }

    /// Whether `size` bytes may have the next address.
    pub(super) fn check_place(&mut self, size: u32, judge: &Judge<'_>) -> Result<(), Refusal> {
        judge.check_place(Region::new(self.next, size))?;
        self.end = self.end.max(self.next + size);
        Ok(())
    }

    /// Adds bytes to the open piece.
    pub(super) fn append(&mut self, data: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        if !to.queue.push(self.next, data) {
            // A client that waits for the answers does not get here.
            return Err(Refusal(FlashError::Busy, AbortCode::OUT_OF_MEMORY));
        }
        self.next += data.len() as u32;
        Ok(())
    }

    /// Adds the open piece to the queue if it is long enough. All of it must have been checked.
    pub(super) fn close_if_full(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        if to.queue.open_size() >= PIECE.min(to.queue.capacity() / 8) {
            self.close(to)?;
        }
        Ok(())
    }

    /// The client has sent all data.
    pub(super) fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        let size = self.end - to.judge.region.base;
        if size < if to.judge.is_data() { 1 } else { SMALLEST_PROGRAM } {
            return Err(Refusal::unfit(FlashError::Format));
        }
        self.close(to)?;
        to.findings.complete = Some(Expected { size, crc: None });
        Ok(())
    }

    fn close(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        if to.queue.open_size() > 0 && !to.judge.has_begun() && to.findings.begins.is_none() {
            judge_start(to)?;
            let partial = Partial::begin(0, to.judge.region.base);
            to.findings.begins = Some(Begin { size: self.size, version: 0, date: 0, partial });
        }
        to.queue.commit();
        Ok(())
    }
}

/// Checks the open piece if it is the start of the program: its vectors and its label, as far as
/// the piece holds them. A HEX file may begin anywhere, and a small block may end before the label;
/// vectors and label are checked again when everything is in flash.
pub(super) fn judge_start(to: &Destination<'_, '_>) -> Result<(), Refusal> {
    if to.queue.open_address() != to.judge.region.base {
        // An installed program is given up for the start of another one alone.
        let is_kept = to.judge.installed && !to.judge.has_begun();
        return if is_kept { Err(Refusal::unfit(FlashError::Address)) } else { Ok(()) };
    }
    // It may have changed since the download began, and so far nothing is lost.
    to.judge.is_allowed()?;
    // The header of a new RAM image is judged before anything is written.
    if to.judge.is_data() || to.judge.is_bootloader() {
        return Ok(());
    }
    let mut vectors = [0; 8];
    // An installed program is not lost for fewer bytes: the zeros are no vectors.
    if to.queue.read_open(0, &mut vectors) || to.judge.installed {
        let [a, b, c, d, e, f, g, h] = vectors;
        to.judge.check_vectors([[a, b, c, d], [e, f, g, h]].map(u32::from_le_bytes))?;
    }
    let mut label = [0; label::SIZE];
    if to.queue.read_open(label::OFFSET as usize, &mut label) {
        to.judge.check_label(&label)?;
    }
    Ok(())
}
