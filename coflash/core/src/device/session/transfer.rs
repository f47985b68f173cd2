//! The transfers of a session over the bus: reads and writes of any length with the SDO client.

use std::time::Duration;

use canopen::sdo::client::{Block, Buffer, Config, Sink};
use canopen::sdo::{Download, SdoError, Step, Transfer, Upload};
use canopen::{AbortCode, Address, CobId, Frame, Instant, NodeId};
use embedded_can::Frame as _;

use super::listen::SLICE;
use super::{Session, SILENCE, UPLOAD_MAX};
use crate::device::doing::Doing;
use crate::device::error::Error;
use crate::device::timing::Transfers;

/// The largest value that is read as a whole. All objects of a bootloader are much smaller.
const VALUE_MAX: usize = 4096;
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

/// After this time without an answer, no more answers come to a transfer that has ended. A frame on
/// the slowest bus takes 13 ms.
const QUIET: Duration = Duration::from_millis(30);
/// After this many frames in a row, the session checks for an answer of the node.
const BURST: u32 = 8;
/// The most frames that may have arrived unnoticed: what an adapter keeps while the host is held up.
const ARRIVED_MAX: u32 = 1000;
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
    /// Carries out a read, and repeats it if no answer comes or if the answers do not fit. The
    /// answer to an attempt that was given up may come during the next one and spoil it. So what
    /// still comes is then waited for, and one more attempt does not count.
    pub(super) fn repeated<T>(
        &mut self,
        read: &mut dyn FnMut(&mut Self) -> Result<T, Error>,
    ) -> Result<T, Error> {
        let began = self.now();
        let (mut left, mut spoilt) = (self.timing.attempts.max(1), false);
        loop {
            let error = match read(self) {
                Err(error) if may_get_through(&error) => error,
                result => return result,
            };
            left = left.saturating_sub(1);
            let is_invalid = matches!(error, Error::Protocol { .. });
            let again = left > 0 || (is_invalid && !spoilt);
            if !again || self.now().saturating_sub(began) >= self.timing.command {
                return Err(error);
            }
            if is_invalid {
                spoilt |= left == 0;
                self.await_no_answer()?;
            }
        }
    }

    /// Reads a value without repetition; otherwise like [`read`](Self::read).
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn read_once(&mut self, at: Address) -> Result<Vec<u8>, Error> {
        if !self.hears_the_bus() {
            return self.upload_there(at, VALUE_MAX, &mut |_| {});
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

    /// Reads a value of any length, by block transfer if the device supports it. A read without an
    /// answer is repeated from the start. Calls `progress` with the number of bytes that have
    /// arrived.
    ///
    /// # Errors
    /// The errors of [`read`](Self::read); [`Error::Protocol`] for more than [`UPLOAD_MAX`] bytes.
    pub fn upload(&mut self, at: Address, progress: &mut dyn FnMut(u32)) -> Result<Vec<u8>, Error> {
        self.repeated(&mut |session| session.upload_once(at, progress))
    }

    fn upload_once(&mut self, at: Address, progress: &mut dyn FnMut(u32)) -> Result<Vec<u8>, Error> {
        if !self.hears_the_bus() {
            return self.upload_there(at, UPLOAD_MAX, progress);
        }
        let (sink, config, doing) = (|| Grown(Vec::new()), self.config(), Doing::Read(at));
        let by_blocks = self.transfers == Transfers::Blocks && !self.lacks_block_upload;
        if by_blocks {
            let mut upload = Upload::as_blocks(self.node, at, sink(), config, Block::default());
            match self.run(&mut upload, doing, Patience::ForEachStep, progress) {
                Err(Error::Refused { .. }) if upload.refuses_blocks() => {}
                result => return result.map(|()| upload.into_sink().0),
            }
        }
        let mut upload = Upload::new(self.node, at, sink(), config);
        self.run(&mut upload, doing, Patience::ForEachStep, progress)?;
        // The object can be read, so it was the service that the device refused: it is not asked again.
        self.lacks_block_upload |= by_blocks;
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
            let mut download = Download::as_blocks(self.node, at, data, config);
            let sent = self.run(&mut download, doing, Patience::ForEachStep, progress);
            self.takes_blocks |= download.progress() > 0;
            match sent {
                // Later values are not tried by block transfer again.
                Err(Error::Refused { .. }) if download.refuses_blocks() && !self.takes_blocks => {
                    self.transfers = Transfers::Segments;
                }
                // The segments that were under way when the node refused cause an abort each.
                Err(error @ Error::Refused { .. }) => {
                    self.await_no_answer()?;
                    return Err(error);
                }
                result => return result,
            }
        }
        let mut download = Download::new(self.node, at, data, config);
        self.run(&mut download, doing, Patience::ForEachStep, progress)
    }

    /// Waits until the node has sent no answer for a while: what it still sends after the end of a
    /// transfer does not answer the next request.
    fn await_no_answer(&mut self) -> Result<(), Error> {
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
        while stale < ARRIVED_MAX && self.receive(Duration::ZERO)?.is_some() {
            stale += 1;
        }
        let began = self.now();
        let mut deadline = began + self.timing.command;
        let mut cancelled = false;
        let mut reported = 0;
        let mut burst = 0;
        let mut short = None;
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
                    let (mut next, mut arrived) = (received, 0);
                    while let Some(frame) = next {
                        let now = self.instant();
                        transfer.handle(&frame, now);
                        short = short_answer(&frame, self.node).or(short);
                        if transfer.progress() != reported {
                            reported = transfer.progress();
                            progress(reported);
                            if patience == Patience::ForEachStep {
                                deadline = self.now() + self.timing.command;
                            }
                        }
                        // A host that was held up may find the answer after other frames: it has
                        // come in time, although the time is over.
                        arrived += 1;
                        let is_late = now.has_reached(until) && transfer.awaits_answer();
                        next = match is_late && arrived < ARRIVED_MAX {
                            true => self.receive(Duration::ZERO)?,
                            false => None,
                        };
                    }
                }
                Step::Done(_) if cancelled => return Err(Error::Cancelled),
                Step::Done(result) => {
                    return result.map_err(|error| transfer_error(error, self.node, doing, short))
                }
            }
        }
    }

    /// The bus time in the form of the state machines: they compare times by difference, so a wrap
    /// does no harm.
    fn instant(&self) -> Instant {
        Instant::from_millis(self.now().as_millis() as u32)
    }
}

/// The error of a transfer that has ended by `error`; `short` is the length of an answer that was too short.
fn transfer_error(error: SdoError, node: NodeId, doing: Doing, short: Option<usize>) -> Error {
    match (error, short, doing) {
        (SdoError::NoAnswer, Some(len), Doing::Read(_)) => Error::ShortAnswer { node, doing, len },
        (SdoError::NoAnswer, ..) => Error::NoAnswer { node, doing },
        (SdoError::Server(code), ..) => Error::Refused { node, doing, code },
        (SdoError::Client(code), ..) => Error::Protocol { doing, code },
    }
}

/// Whether another attempt of a read may get through after this error. A server's time-out ends the
/// transfer of a client that stopped in it.
fn may_get_through(error: &Error) -> bool {
    match error {
        Error::NoAnswer { .. } | Error::ShortAnswer { .. } => true,
        Error::Refused { code, .. } => *code == AbortCode::TIMEOUT,
        Error::Protocol { code, .. } => *code != AbortCode::OUT_OF_MEMORY,
        _ => false,
    }
}

/// The length of an answer of the node that has fewer than the eight bytes of SDO (CiA 301 clause
/// 7.2.4.3): no client may guess what is missing.
fn short_answer(frame: &Frame, node: NodeId) -> Option<usize> {
    let is_short = frame.cob_id() == Some(CobId::sdo_response(node)) && frame.dlc() < 8;
    is_short.then(|| frame.dlc())
}
