//! The transfers of a session over the bus: reads and writes of any length with the SDO client.

use std::time::Duration;

use canopen::sdo::client::{Block, Buffer, Config, Sink};
use canopen::sdo::{Download, SdoError, Step, Transfer, Upload};
use canopen::{AbortCode, Address, CobId, Instant};

use super::listen::SLICE;
use super::{Session, SILENCE, UPLOAD_MAX};
use crate::device::doing::Doing;
use crate::device::error::Error;
use crate::device::timing::Transfers;

/// The largest value that is read as a whole. All objects of a bootloader are much smaller.
pub(super) const VALUE_MAX: usize = 4096;
/// A buffer that grows with the data that really arrive; an announced size reserves no memory.
struct Grown(Vec<u8>);

impl Sink for Grown {
    fn write(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        if self.0.len() + data.len() > UPLOAD_MAX {
            return Err(AbortCode::OUT_OF_MEMORY);
        }
        self.0.extend_from_slice(data);
        Ok(())
    }
}

/// After this time without an abort, no more aborts come for the segments of a refused transfer. A
/// frame on the slowest bus takes 13 ms.
const QUIET: Duration = Duration::from_millis(30);
/// After this many frames in a row, the session checks for an answer of the node.
const BURST: u32 = 8;
/// For fewer bytes, a block transfer needs more frames than it saves.
pub(super) const WORTH_BLOCKS: usize = 4 * 7;

/// What [`Timing::command`] limits in a transfer. The SDO time-out alone does not end every
/// transfer: it starts again with each answer, and a faulty device may answer without end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Patience {
    /// The whole transfer.
    InAll,
    /// The time without progress.
    ForEachStep,
}

impl Session<'_> {
    /// Reads a value without repetition; otherwise like [`read`](Self::read).
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn read_once(&mut self, at: Address) -> Result<Vec<u8>, Error> {
        if !self.hears_the_bus() {
            return self.read_there(at);
        }
        let mut bytes = [0; VALUE_MAX];
        let mut upload = Upload::new(self.node, at, Buffer::new(&mut bytes), self.config());
        // A value is short: all of it must arrive within the time.
        let doing = Doing::Read(at);
        match self.run(&mut upload, doing, Patience::InAll, &mut |_| {}) {
            Ok(()) => Ok(upload.sink().filled().to_vec()),
            // It ends the transfer of a client that stopped in it, and does not answer this read.
            Err(Error::Refused { code, .. }) if code == AbortCode::TIMEOUT => {
                Err(Error::Protocol { doing, code })
            }
            Err(error) => Err(error),
        }
    }

    /// Reads a value of any length, by block transfer if the device supports it. Calls `progress`
    /// with the number of bytes that have arrived.
    ///
    /// # Errors
    /// The errors of [`read`](Self::read); [`Error::Protocol`] for more than [`UPLOAD_MAX`] bytes.
    pub fn upload(&mut self, at: Address, progress: &mut dyn FnMut(u32)) -> Result<Vec<u8>, Error> {
        if !self.hears_the_bus() {
            return self.upload_there(at, self.timing.command, progress);
        }
        let (sink, config) = (Grown(Vec::new()), self.config());
        let mut upload = match self.transfers {
            Transfers::Blocks => Upload::as_blocks(self.node, at, sink, config, Block::default()),
            Transfers::Segments => Upload::new(self.node, at, sink, config),
        };
        self.run(&mut upload, Doing::Read(at), Patience::ForEachStep, progress)?;
        Ok(upload.into_sink().0)
    }

    /// Writes a value, once. Calls `progress` with the number of bytes that the device has
    /// accepted.
    ///
    /// # Errors
    /// [`Error::NoAnswer`], [`Error::Refused`], [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn write(
        &mut self,
        at: Address,
        data: &[u8],
        doing: Doing,
        progress: &mut dyn FnMut(u32),
    ) -> Result<(), Error> {
        if !self.hears_the_bus() {
            return self.write_there(at, data, doing, progress);
        }
        let mut config = self.config();
        if data.len() > WORTH_BLOCKS {
            config.timeout_ms = config.timeout_ms.saturating_mul(self.sharing).min(u32::MAX / 4);
        }
        if self.transfers == Transfers::Blocks && data.len() > WORTH_BLOCKS {
            let block = Block { fallback: false, ..Block::default() };
            let mut download = Download::as_blocks(self.node, at, data, config, block);
            match self.run(&mut download, doing, Patience::ForEachStep, progress) {
                // Later values are not tried by block transfer again.
                Err(Error::Refused { code, .. }) if download.progress() == 0 && means_no_blocks(code) => {
                    self.transfers = Transfers::Segments;
                }
                Err(error @ Error::Refused { .. }) => {
                    self.settle_after_burst()?;
                    return Err(error);
                }
                result => return result,
            }
        }
        let mut download = Download::new(self.node, at, data, config);
        self.run(&mut download, doing, Patience::ForEachStep, progress)
    }

    /// Waits until the node has been silent for a while: the segments that were under way when it
    /// refused a block transfer cause an abort each, and these aborts do not answer the next
    /// request.
    fn settle_after_burst(&mut self) -> Result<(), Error> {
        let deadline = self.now() + self.timing.sdo;
        let response = CobId::sdo_response(self.node);
        while self.now() < deadline && self.listen(QUIET, |frame| frame.cob_id() == Some(response))? {}
        Ok(())
    }

    fn config(&self) -> Config {
        Config { timeout_ms: u32::try_from(self.timing.sdo.as_millis()).unwrap_or(u32::MAX / 4) }
    }

    /// Runs one transfer to its end.
    fn run(
        &mut self,
        transfer: &mut impl Transfer,
        doing: Doing,
        patience: Patience,
        progress: &mut dyn FnMut(u32),
    ) -> Result<(), Error> {
        self.check_cancelled()?;
        // Answers to requests that were given up do not belong to this transfer.
        let mut stale = 0;
        while stale < 1000 && self.receive(Duration::ZERO)?.is_some() {
            stale += 1;
        }
        let began = self.now();
        let mut deadline = began + self.timing.command;
        let mut cancelled = false;
        let mut told = 0;
        let mut burst = 0;
        loop {
            if !cancelled && self.check_cancelled().is_err() {
                cancelled = true;
                transfer.abort(AbortCode::GENERAL);
            }
            if self.now() >= deadline {
                transfer.abort(AbortCode::TIMEOUT);
            }
            match transfer.poll(self.instant()) {
                Step::Send(frame) => {
                    self.send(&frame)?;
                    burst += 1;
                    if burst % BURST == 0 {
                        if let Some(frame) = self.receive(Duration::ZERO)? {
                            let now = self.instant();
                            transfer.handle(&frame, now);
                        }
                    }
                }
                Step::Wait(until) => {
                    burst = 0;
                    let now = self.instant();
                    let left = if now.has_reached(until) { 0 } else { until.since(now) };
                    let left = Duration::from_millis(left.into());
                    let received = self.receive(left.min(SLICE))?;
                    if received.is_none() && self.timing.sdo > SILENCE {
                        self.note_silence(began, self.timing.sdo.max(self.timing.silent), doing);
                    }
                    if let Some(frame) = received {
                        let now = self.instant();
                        transfer.handle(&frame, now);
                        if transfer.progress() != told {
                            told = transfer.progress();
                            progress(told);
                            if patience == Patience::ForEachStep {
                                deadline = self.now() + self.timing.command;
                            }
                        }
                    }
                }
                Step::Done(_) if cancelled => return Err(Error::Cancelled),
                Step::Done(Ok(())) => return Ok(()),
                Step::Done(Err(SdoError::NoAnswer)) => {
                    return Err(Error::NoAnswer { node: self.node, doing })
                }
                Step::Done(Err(SdoError::Server(code))) => {
                    return Err(Error::Refused { node: self.node, doing, code })
                }
                Step::Done(Err(SdoError::Client(code))) => return Err(Error::Protocol { doing, code }),
            }
        }
    }

    /// The bus time in the form of the state machines: they compare times by difference, so a wrap
    /// does no harm.
    fn instant(&self) -> Instant {
        Instant::from_millis(self.now().as_millis() as u32)
    }
}

/// Whether a server refuses block transfer with this code. Some servers use the general error for
/// it.
fn means_no_blocks(code: AbortCode) -> bool {
    matches!(code, AbortCode::COMMAND | AbortCode::UNSUPPORTED_ACCESS | AbortCode::GENERAL)
}
