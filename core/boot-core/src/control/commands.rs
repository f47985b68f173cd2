//! 1F51h: the effects of its commands, and the reasons to refuse them. Passwords are here, too:
//! they permit a download, and one of them replaces CLEAR. So are requests for rights.

use canopen::program::{FlashError, ProgramControl};
use canopen::AbortCode;
use seal::access::right;
use shared_abi::geometry::Region;
use shared_abi::renewal::BOOTLOADER;
use shared_abi::warm_start::BootRequest;

use super::{find, Downloader, Failure};
use crate::choices::{Choices, Has};
use crate::flash::Flash;
use crate::policy::Erase;
use crate::refusal::Refusal;
use crate::session::Session;
use crate::store::{Parameters, ProgramRecord};

impl<P: Parameters, const PROGRAMS: usize, C: Choices> Downloader<'_, P, PROGRAMS, C> {
    /// 1F51h: a command. It is checked and acknowledged now, and [`step`](Self::step) carries it
    /// out.
    ///
    /// # Errors
    /// The abort for the client.
    pub fn command(&mut self, program: u8, command: ProgramControl) -> Result<(), AbortCode> {
        use ProgramControl::{Clear, ClrSignature, ResetStat, SetSignature, Start, StartBootloader, Stop};

        if C::RENEWS && program == BOOTLOADER {
            return self.command_bootloader(command);
        }
        let keeps = command == Clear && self.programmer.may_take(program).is_err();
        let state = find::<C>(&mut self.programs, program).ok_or(AbortCode::NO_SUB_INDEX)?;
        if matches!(command, Stop | StartBootloader) {
            // No program runs, but the bootloader: the requested state already exists. Many masters send
            // no CLEAR after STOP.
            state.stopped |= command == Stop;
            return Ok(());
        }
        // A host that sends a program in one transfer uses 2 as in CiA 302-3: reset the program,
        // which starts it.
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
        // A second CLEAR in a row; one that is refused ends the row.
        let again = match &mut state.session {
            Session::Cleared { just } if command == Clear => core::mem::take(just),
            _ => false,
        };
        // A new download does not wait for the end of the old one.
        let own = self.programmer.program().is_none_or(|of| of == program);
        let restarts = command == Clear && own && self.programmer.is_abortable();
        let busy = match command {
            // Also not during the download of a sealed image, which changes the record itself.
            SetSignature | ClrSignature => {
                !self.programmer.may_store() || self.programmer.source().unsealer.is_active()
            }
            _ => self.programmer.has_work(),
        };
        if self.boot_request.is_some() || (busy && !restarts) || keeps {
            return Err(state.refuse(Refusal::untimely(FlashError::Busy)));
        }
        let changes = matches!(command, Clear | SetSignature | ClrSignature);
        let erases = again || (self.policy.erase)(program) == Erase::AtOnce;
        let withdrawn = state.record.is_some_and(|record| record.withdrawn);
        let has_right = self.rights.permits(right_of(command, erases, withdrawn));
        if !has_right || changes && (state.locked || !(self.policy.allowed)()) {
            return Err(state.refuse(Refusal::untimely(FlashError::NoAccess)));
        }
        state.failure = None;
        let fresh = core::mem::take(&mut state.streamed);
        let record = state.record.filter(|_| !data);
        match (command, record) {
            (Clear, _) => {
                // Before the transfer is aborted, because the abort marks an open session as
                // failed.
                state.session = Session::Cleared { just: true };
                let region = state.region;
                self.clear(program, region, erases);
            }
            (Start, Some(_)) if fresh => self.boot_request = Some(BootRequest::Fresh(program)),
            (Start, Some(record)) => self.boot_request = Some(start_request(program, record.signed)),
            (SetSignature | ClrSignature, Some(record)) => {
                // Also if the record reads this way: after a power cut it may read differently later.
                // The store writes nothing if the value is certain.
                let signed = command == SetSignature;
                let withdrawn = !signed && self.rights.takes_no_other();
                let record = ProgramRecord { signed, withdrawn, ..record };
                self.programmer.record(&mut self.parameters, program, record, false);
            }
            (Start | SetSignature, None) => {
                state.failure = Some(Failure::of(FlashError::NoValidProgram));
            }
            (Stop | StartBootloader | ResetStat | ClrSignature, _) => {}
        }
        Ok(())
    }

    /// CLEAR, in its flash half.
    fn clear(&mut self, program: u8, region: Region, erases: bool) {
        self.download_cancel();
        if self.programmer.has_cleared(program) {
            return;
        }
        self.programmer.abort();
        if erases {
            self.programmer.erase_all(program, region);
        }
    }

    /// 2008h: the device leaves for the loader in the ROM of the chip. It can erase everything, so what keeps
    /// a client from a download keeps it from this command: a password, or the product.
    ///
    /// # Errors
    /// The abort for the client: the command is not permitted now, the device is busy, or its option bytes
    /// leave the loader no use.
    pub(crate) fn leave_for_rom_loader<F: Flash>(&mut self, flash: &F) -> Result<(), AbortCode> {
        let is_locked = self.programs.iter().any(|program| program.locked);
        let is_busy = self.boot_request.is_some() || self.programmer.has_work();
        if is_locked || is_busy || !(self.policy.allowed)() || !rom_loader_runs(flash.option_bytes()) {
            return Err(AbortCode::DEVICE_STATE);
        }
        self.boot_request = Some(BootRequest::RomLoader);
        Ok(())
    }

    /// The program has returned the device to the bootloader: it no longer needs a rescue window.
    pub fn confirm(&mut self, program: u8) {
        let Some(record) = self.program(program).and_then(|state| state.record) else { return };
        if !record.confirmed && !self.busy() {
            let record = ProgramRecord { confirmed: true, ..record };
            self.programmer.record(&mut self.parameters, program, record, true);
        }
    }

    /// 2002h/2: a client asks for rights. One signature is checked at a time, and that of an image
    /// takes precedence.
    ///
    /// # Errors
    /// The abort for the client.
    pub(crate) fn ask<F: Flash>(&mut self, flash: &F, request: &[u8]) -> Result<(), AbortCode> {
        let busy = self.busy();
        let unsealer = &mut self.programmer.source_mut().unsealer;
        if busy || unsealer.is_active() {
            return Err(AbortCode::DEVICE_STATE);
        }
        self.rights.ask(flash, request, unsealer)
    }

    /// A correct password arrived for all programs, and for the bootloader itself.
    ///
    /// # Errors
    /// As [`unlock`](Self::unlock).
    pub(crate) fn unlock_all(&mut self) -> Result<(), AbortCode> {
        let last = PROGRAMS as u8;
        (1..=last).try_for_each(|place| {
            self.unlock(if C::RENEWS && place == last { BOOTLOADER } else { place }, false)
        })
    }

    /// A correct password arrived: from now on 1F50h accepts data, as after CLEAR. With `at_once`,
    /// the old program becomes invalid now; otherwise only when a new one replaces it. A previous
    /// download, of this program or another one, is aborted.
    ///
    /// # Errors
    /// The device is busy with other work.
    pub fn unlock(&mut self, program: u8, at_once: bool) -> Result<(), AbortCode> {
        // A password crosses the bus in plain text: in a sealed device it must not make a program
        // invalid.
        let is_program = !(C::RENEWS && program == BOOTLOADER);
        let at_once = at_once && is_program && self.rights.permits(right::ERASE);
        let keeps = at_once && self.programmer.may_take(program).is_err();
        let Some(state) = find::<C>(&mut self.programs, program) else { return Err(AbortCode::NO_SUB_INDEX) };
        if self.boot_request.is_some() || !self.programmer.is_abortable() || keeps {
            return Err(state.refuse(Refusal::untimely(FlashError::Busy)));
        }
        self.download_cancel();
        self.programmer.abort();
        if let Some(state) = find::<C>(&mut self.programs, program) {
            state.locked = false;
            state.failure = None;
            state.streamed = false;
            state.session = Session::Cleared { just: false };
        }
        if let (true, Some(region)) = (at_once, self.program(program).map(|state| state.region)) {
            self.programmer.void_if_writable(program, region);
        }
        Ok(())
    }
}

/// Whether the loader in the ROM runs on a chip with these option bytes, as `FLASH_OPTCR` has them. It feeds no
/// watchdog, so it would be ended by one that runs after each reset (WDG_SW is 0); read-out protection of level 2
/// switches it off (AN2606). 0 is a device without a chip.
const fn rom_loader_runs(option_bytes: u32) -> bool {
    const WDG_SW: u32 = 1 << 5;
    const RDP_LEVEL_2: u32 = 0xCC;
    option_bytes & WDG_SW != 0 && option_bytes >> 8 & 0xFF != RDP_LEVEL_2
}

/// The request that starts a program; a program without the release is started on trial.
fn start_request(program: u8, signed: bool) -> BootRequest {
    if signed {
        BootRequest::Start(program)
    } else {
        BootRequest::Trial(program)
    }
}

/// The right that a command needs in a sealed device; 0 for none.
fn right_of(command: ProgramControl, erases: bool, withdrawn: bool) -> u32 {
    match command {
        ProgramControl::Clear if erases => right::ERASE,
        ProgramControl::ClrSignature => right::CLEAR_SIGNATURE,
        // Otherwise anybody could undo what the right has done.
        ProgramControl::SetSignature if withdrawn => right::CLEAR_SIGNATURE,
        _ => 0,
    }
}
