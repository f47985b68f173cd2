//! 1F50h: passes an SDO transfer to the intake, and carries out the results.

use canopen::program::FlashError;
use canopen::AbortCode;
use seal::wire::Requirements;
use shared_abi::block_file::FRAMING;
use shared_abi::ram_image::Host;

use super::{find, Downloader, Failure, Transfer};
use crate::choices::{Choices, Has};
use crate::flash::Flash;
use crate::intake::{Destination, Findings, Intake};
use crate::policy::Judge;
use crate::refusal::Refusal;
use crate::resume::Partial;
use crate::session::{LastBlock, Session, ANY};
use crate::store::Parameters;
use crate::unseal::Place;

impl<P: Parameters, const PROGRAMS: usize, C: Choices> Downloader<'_, P, PROGRAMS, C> {
    /// 1F50h: the client starts a transfer, with its size if it is known.
    ///
    /// # Errors
    /// The abort for the client.
    pub fn download_start<F: Flash>(
        &mut self,
        flash: &F,
        program: u8,
        size: Option<u32>,
    ) -> Result<(), AbortCode> {
        self.download_cancel();
        if C::RENEWS {
            self.may_renew(flash, program)?;
        }
        let room = self.has_room();
        let Some(state) = find::<C>(&mut self.programs, program) else { return Err(AbortCode::NO_SUB_INDEX) };
        // A second CLEAR erases everything, but not after a download, taken or refused: then it may come
        // from a host that repeats the same wrong file.
        if let Session::Cleared { just } = &mut state.session {
            *just = false;
        }
        if PROGRAMS > 1
            && matches!(state.session, Session::Open { .. })
            && self.programmer.program() != Some(program)
        {
            // The programmer tracks the flash of one program at a time. The download of another
            // program, which began meanwhile, has ended this one.
            state.session = Session::Failed;
        }
        let others = self.programmer.is_busy() && self.programmer.program().is_some_and(|of| of != program);
        // The data wait where CLEAR still erases.
        let takes = self.programmer.is_abortable() || self.programmer.has_cleared(program);
        let refusal = if self.boot_request.is_some() || others || !takes || !room {
            Some(Refusal::untimely(FlashError::Busy))
        } else if state.locked {
            Some(Refusal::untimely(FlashError::NoAccess))
        } else if size.is_some_and(|size| size < FRAMING as u32) && self.policy.data != Some(program) {
            Some(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW))
        } else {
            None
        };
        if let Some(refusal) = refusal {
            return Err(state.refuse(refusal));
        }
        state.streamed = false;
        self.transfer = Some(Transfer { program, intake: Intake::new(size) });
        Ok(())
    }

    /// The number of bytes that [`download_data`](Self::download_data) accepts at present. With
    /// `held`, the answer to the client is already delayed, and the client may use a reserve.
    #[must_use]
    pub fn space(&self, held: bool) -> usize {
        let room = |transfer: &Transfer| transfer.intake.room(&self.programmer.source().queue, held);
        self.transfer.as_ref().map_or(usize::MAX, room)
    }

    /// 1F50h: the next bytes of the transfer.
    ///
    /// # Errors
    /// The abort that ends the transfer.
    pub fn download_data(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        self.take(Some(data)).map(drop)
    }

    /// 1F50h: the transfer is complete. Checks it completely and leaves the flash work for later.
    ///
    /// # Errors
    /// The abort in place of the last acknowledgement.
    pub fn download_end(&mut self) -> Result<(), AbortCode> {
        let program = self.take(None)?;
        self.transfer = None;
        if let Some(state) = find::<C>(&mut self.programs, program) {
            state.failure = None;
        }
        Ok(())
    }

    /// 1F50h: the transfer was aborted. A block may be sent again; an aborted stream may leave an
    /// incomplete program.
    pub fn download_cancel(&mut self) {
        let Some(Transfer { program, intake }) = self.transfer.take() else { return };
        self.programmer.source_mut().queue.discard();
        let Some(state) = find::<C>(&mut self.programs, program) else { return };
        if intake.is_stream() && matches!(state.session, Session::Open { .. }) {
            state.session = Session::Failed;
            state.failure.get_or_insert(Failure::of(FlashError::Format));
            self.programmer.abort();
        }
    }

    /// Passes the next bytes, or the end (`None`), to the format of the open transfer, and carries
    /// out the results; returns the program's number.
    fn take(&mut self, data: Option<&[u8]>) -> Result<u8, AbortCode> {
        let Some(Transfer { program, intake }) = &mut self.transfer else { return Err(self.fault) };
        let program = *program;
        let Some(state) = find::<C>(&mut self.programs, program) else { return Err(self.fault) };
        let judge = Judge {
            layout: self.layout,
            policy: self.policy,
            program,
            region: state.region,
            session: state.session,
            installed: state.record.is_some(),
            stopped: state.stopped,
            images: self.rights.images(),
            partial: state.resumable(),
        };
        let mut to = Destination {
            judge,
            queue: &mut self.programmer.source_mut().queue,
            findings: Findings::default(),
        };
        let outcome = match data {
            Some(bytes) => intake.data::<C>(bytes, &mut to),
            None => intake.end(&mut to),
        };
        let findings = to.findings;
        let streaming = intake.may_be_stream();
        let is_stream = intake.is_stream();
        match outcome {
            Ok(()) => {
                self.proceed(program, is_stream, findings);
                Ok(program)
            }
            Err(refusal) => {
                // What is stored of the data before it does not go on after a cut.
                if matches!(judge.session, Session::Open { next } if next != 1) {
                    self.programmer.forbid_resume(program);
                }
                if findings.begins.is_some() && !matches!(judge.session, Session::Open { .. }) {
                    // Its pieces belong to a download that does not start.
                    self.programmer.source_mut().queue.clear();
                }
                if refusal.0 == FlashError::Crc || streaming {
                    self.outcome = Some((program, Err(refusal.0)));
                }
                let abort = state.refuse(refusal);
                self.download_cancel();
                Err(abort)
            }
        }
    }

    /// Carries out the results of accepted bytes.
    fn proceed(&mut self, program: u8, is_stream: bool, findings: Findings) {
        let staging = self.staging_of(program);
        let has = C::RENEWS.then(|| {
            let Host { board, services, features, .. } = self.host();
            Requirements { board, services, features: features.0 }
        });
        let Some(state) = find::<C>(&mut self.programs, program) else { return };
        if let Some(begin) = findings.begins {
            // A RAM image has its version in its header.
            if staging.is_none() {
                (state.version, state.announced_date) = (begin.version, begin.date);
            }
            let mut next = 1;
            let goes_on = C::RESUMES && state.resumable().is_same(begin.partial);
            // A sequence of blocks that begins again continues over the existing pieces.
            if matches!(state.session, Session::Open { .. }) {
                if goes_on {
                    next = ANY;
                }
                if C::RESUMES && !goes_on {
                    state.partial = Partial::NONE;
                    self.programmer.forbid_resume(program);
                }
            } else {
                let mut partial = if C::RESUMES { begin.partial } else { begin.partial.forbidden() };
                if goes_on && matches!(state.session, Session::Idle) && findings.sealed.is_none() {
                    partial = state.partial;
                    next = ANY;
                }
                self.programmer.source_mut().queue.last = LastBlock::none(partial.start());
                let counts_as_clear = core::mem::take(&mut state.stopped) && is_stream;
                let mut erases = next == ANY || counts_as_clear || self.policy.erases(state.session);
                if let Some(staging) = staging {
                    // It is erased in any case, and begins anew after a cut.
                    (erases, partial) = (true, Partial::begin(0, staging.base));
                }
                let region = staging.unwrap_or(state.region);
                self.programmer.open(program, region, erases, begin.size, partial);
                if findings.sealed.is_some() {
                    // What was found authentic is not known any more after a cut.
                    self.programmer.forbid_resume(program);
                    self.programmer.source_mut().unsealer.begin(Place {
                        layout: self.layout,
                        policy: &self.policy.seal,
                        program,
                        region,
                        lowered_counter: self.rights.lowered_counter(),
                        has,
                        home: staging.map(|_| state.region),
                    });
                }
                state.partial = partial;
            }
            state.session = Session::Open { next };
        }
        if let (true, Session::Open { next }) = (findings.block, &mut state.session) {
            *next = self.programmer.source_mut().queue.last.next();
        }
        if let Some(expected) = findings.complete {
            self.programmer.complete(expected, state.announced_date);
            if is_stream {
                state.streamed = true;
                state.start_when_verified = self.policy.starts_by_itself;
            }
        }
    }
}
