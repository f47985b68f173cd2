//! 1F51h: what its commands do, and when they are refused. Passwords stand beside them: they give
//! the right to a download, and one of them takes the place of CLEAR.

use canopen::program::{FlashError, ProgramControl};
use canopen::AbortCode;
#[cfg(feature = "sealed")]
use seal::access::right;
use shared_abi::warm_start::BootRequest;

use super::{find, Downloader};
use crate::policy::Erase;
use crate::refusal::Refusal;
use crate::session::Session;
use crate::store::{Parameters, ProgramRecord};

impl<P: Parameters, const PROGRAMS: usize> Downloader<'_, P, PROGRAMS> {
    /// 1F51h: a command. It is judged and acknowledged now and carried out by
    /// [`step`](Self::step).
    ///
    /// # Errors
    /// The abort that answers it.
    pub fn command(&mut self, program: u8, command: ProgramControl) -> Result<(), AbortCode> {
        use ProgramControl::{Clear, ClrSignature, ResetStat, SetSignature, Start, StartBootloader, Stop};

        let state = find(&mut self.programs, program).ok_or(AbortCode::NO_SUB_INDEX)?;
        if matches!(command, Stop | StartBootloader) {
            // No program runs, and the bootloader does: both are so already.
            return Ok(());
        }
        // Who sends a program in one go means by 2 what CiA 302-3 says: reset the program, which
        // starts it.
        let command = match command {
            ResetStat if state.streamed || self.policy.reset_starts => Start,
            command => command,
        };
        // Data are never started.
        let data = self.policy.data == Some(program);
        let may_start = command == Start && state.streamed && !data && self.boot_request.is_none();
        if may_start && self.programmer.finishing() == Some(program) {
            state.start_when_verified = true;
            return Ok(());
        }
        // A new beginning does not wait for the end of the old one.
        let own = self.programmer.program().is_none_or(|of| of == program);
        let restarts = command == Clear && own && self.programmer.is_abortable();
        let busy = match command {
            // Nor while a sealed image comes: the record is its business then.
            SetSignature | ClrSignature => {
                self.programmer.is_busy() || self.programmer.unsealer().is_active()
            }
            _ => self.programmer.has_work(),
        };
        if self.boot_request.is_some() || (busy && !restarts) {
            return Err(state.refuse(Refusal::untimely(FlashError::Busy)));
        }
        let changes = matches!(command, Clear | SetSignature | ClrSignature);
        #[cfg(feature = "sealed")]
        {
            let again = matches!(state.session, Session::Cleared { just: true });
            let needed = match command {
                Clear if again || (self.policy.erase)(program) == Erase::AtOnce => right::ERASE,
                ClrSignature => right::CLEAR_SIGNATURE,
                _ => 0,
            };
            if needed != 0 && !self.programmer.unsealer().permits(needed) {
                return Err(state.refuse(Refusal::untimely(FlashError::NoAccess)));
            }
        }
        if changes && (state.locked || !(self.policy.allowed)()) {
            return Err(state.refuse(Refusal::untimely(FlashError::NoAccess)));
        }
        state.error = None;
        let fresh = core::mem::take(&mut state.streamed);
        let record = state.record.filter(|_| !data);
        match (command, record) {
            (Clear, _) => {
                let region = state.region;
                let again = matches!(state.session, Session::Cleared { just: true });
                // Before the transfer is broken off, which fails a session that is open.
                state.session = Session::Cleared { just: true };
                // A sector that is still being erased for the old download is waited for.
                let at_once = (again || (self.policy.erase)(program) == Erase::AtOnce) && !busy;
                self.download_cancel();
                self.programmer.abort();
                if at_once {
                    self.programmer.erase_all(program, region);
                }
            }
            (Start, Some(_)) if fresh => self.boot_request = Some(BootRequest::Fresh(program)),
            (Start, Some(record)) => self.boot_request = Some(start_request(program, record.signed)),
            (SetSignature | ClrSignature, Some(record)) => {
                // Also where it is so already: after a power cut it may read so now and otherwise
                // later.
                let signed = command == SetSignature;
                let record = ProgramRecord { signed, ..record };
                self.programmer.record(&mut self.parameters, program, record, false);
            }
            (Start | SetSignature, None) => state.error = Some(FlashError::NoValidProgram),
            (Stop | StartBootloader | ResetStat | ClrSignature, _) => {}
        }
        Ok(())
    }

    /// The program has brought the device back to the bootloader, so it can do that: it needs no
    /// rescue window any more.
    pub fn confirm(&mut self, program: u8) {
        // Not by `program`: this is called before the bootloader is at its place, and what is called
        // there alone is shorter by that.
        let state = self.programs.get(usize::from(program).wrapping_sub(1));
        let Some(record) = state.and_then(|state| state.record) else { return };
        if !record.confirmed && !self.busy() {
            let record = ProgramRecord { confirmed: true, ..record };
            self.programmer.record(&mut self.parameters, program, record, true);
        }
    }

    /// A password came: 1F50h takes data from now on, and CLEAR is as good as given. `at_once`: the
    /// old program is void now, and not only when there is another one. What was being downloaded
    /// before, of this program or another one, is broken off.
    ///
    /// # Errors
    /// If other work goes on.
    pub fn unlock(&mut self, program: u8, at_once: bool) -> Result<(), AbortCode> {
        let Some(state) = find(&mut self.programs, program) else { return Err(AbortCode::NO_SUB_INDEX) };
        if self.boot_request.is_some() || !self.programmer.is_abortable() {
            return Err(state.refuse(Refusal::untimely(FlashError::Busy)));
        }
        self.download_cancel();
        self.programmer.abort();
        if let Some(state) = find(&mut self.programs, program) {
            state.locked = false;
            state.error = None;
            state.streamed = false;
            state.session = Session::Cleared { just: false };
        }
        // A password crosses the bus as it is: in a sealed device it costs no program.
        #[cfg(feature = "sealed")]
        let at_once = at_once && self.programmer.unsealer().permits(right::ERASE);
        if at_once {
            self.programmer.void(program);
        }
        Ok(())
    }
}

/// The request that starts a program; unsigned, on trial.
fn start_request(program: u8, signed: bool) -> BootRequest {
    if signed {
        BootRequest::Start(program)
    } else {
        BootRequest::Trial(program)
    }
}
