//! The renewal of the bootloader in the objects 1F50h to 1F57h: the bootloader's own RAM image is one
//! more program, with rules of its own (docs/renewal.md).

use canopen::program::{FlashError, ProgramControl};
use canopen::{AbortCode, Instant};
use shared_abi::boot_report::BootReport;
use shared_abi::geometry::Region;
use shared_abi::ram_image::Host;
use shared_abi::renewal::{of_word, Origin, Progress, State, BOOTLOADER};
use shared_abi::warm_start::{BootRequest, TrialStep};

use super::{find, load, Downloader, Failure, Program};
use crate::choices::{Choices, Has};
use crate::flash::Flash;
use crate::policy::Renewal;
use crate::program::Expected;
use crate::programmer::Renewing;
use crate::refusal::Refusal;
use crate::renewal::{check, header, identification, Known, Places};
use crate::resume::Partial;
use crate::session::Session;
use crate::store::{Parameters, ProgramRecord, RenewalRecord};

/// Of a device without renewal.
const NO_HOST: Host = Renewal::NONE.host(0, 0);

impl<P: Parameters, const PROGRAMS: usize, C: Choices> Downloader<'_, P, PROGRAMS, C> {
    fn known(&self) -> Known {
        self.renewal.unwrap_or(Known::NOTHING)
    }

    /// What is stored of a renewal.
    fn renewal_state(&self) -> State {
        self.programmer.image().map_or(State::None, |record| record.state)
    }

    fn set_record(&mut self, record: Option<RenewalRecord>) {
        if let Some(renewing) = &mut self.programmer.renewing {
            renewing.record = record;
        }
    }

    /// 2007h/9.
    #[must_use]
    pub fn renewal(&self) -> Progress {
        let Known { origin, trial_end, .. } = self.known();
        Progress { state: self.renewal_state(), origin, trial_end }
    }

    /// 2007h/8: the version of the running image, and that of the services of the resident part.
    #[must_use]
    pub fn versions(&self) -> [u8; 8] {
        let (Known { version, .. }, host) = (self.known(), self.host());
        (u64::from(host.services) << 32 | u64::from(version)).to_le_bytes()
    }

    /// What the device has for a RAM image.
    pub(super) fn host(&self) -> Host {
        self.programmer.renewing.map_or(NO_HOST, |renewing| renewing.host)
    }

    /// Starts with the report of the resident part. What a cut has interrupted goes on.
    pub(super) fn begin_renewal<F: Flash>(&mut self, flash: &F, report: &BootReport) {
        let (Some(places), Some(policy)) = (Places::of(self.layout), self.policy.renewal) else { return };
        let (origin, trial_end) = of_word(report.renewal);
        let running = if origin == Origin::Home { places.home } else { places.staging };
        let header = header(flash, running);
        let identification = identification(flash, running, &header);
        self.renewal =
            Some(Known { origin, trial_end, version: header.version, identification, confirmed: false });
        if let Some(state) = find::<C>(&mut self.programs, BOOTLOADER) {
            state.region = places.home;
        }
        self.show_image(identification, header.version);
        let host = policy.host(self.parameters.services(), self.parameters.facts());
        let layout = self.layout;
        self.programmer.renewing = Some(Renewing { layout, policy, host, record: None, is_occupied: false });
        let last = layout.programs.len() as u8;
        self.note_record(last, load::<C>(&self.parameters, flash, last, &self.rights).0);
        let mut record = self.image_record(flash);
        if let Some(record) = record.as_mut().filter(|_| origin == Origin::Confirmed) {
            // The resident part has read that it is confirmed; it may read differently each time.
            record.state = State::Confirmed;
        }
        self.set_record(record);
        let Some(record) = record else { return };
        match (record.state, origin) {
            (State::Confirmed, Origin::Confirmed | Origin::Spare) => self.programmer.install(),
            // Home is an image that the record does not know, so it is void; or nothing is left in staging.
            (State::Staged | State::Installed, Origin::Home)
                if places.is_home_foreign(flash, &record) || !places.is_in_staging(flash, &record) =>
            {
                self.programmer.void(BOOTLOADER);
            }
            _ => {}
        }
    }

    /// What is stored about the image in staging, and can be relied upon.
    fn image_record<F: Flash>(&self, flash: &F) -> Option<RenewalRecord> {
        let record = RenewalRecord::load(&self.parameters, flash)?;
        let places = Places::of(self.layout)?;
        let state = match (record.state, self.known().origin) {
            // The image in staging would have been loaded: this record may read differently each time, and
            // a master has to confirm the image again.
            (State::Confirmed, Origin::Home) => State::Staged,
            // As long as home is damaged the spare is needed, as a confirmed image is.
            (State::Installed, Origin::Spare)
                if check(flash, places.home, self.layout, self.host()).is_err() =>
            {
                State::Confirmed
            }
            (state, _) => state,
        };
        Some(RenewalRecord { state, ..record })
    }

    /// Takes the time since the start of the image: a trial ends by itself.
    pub(crate) fn watch_trial(&mut self, now: Instant) {
        let Some(policy) = self.policy.renewal else { return };
        let ends = u32::from(policy.confirm_within_s) * 1000;
        let is_over = now.has_reached(Instant::from_millis(ends)) && !self.programmer.is_installing();
        if self.is_on_trial() && self.boot_request.is_none() && is_over {
            self.boot_request = Some(BootRequest::Renewal(TrialStep::Late));
        }
    }

    /// 1F51h/n: a command for the bootloader itself. By itself it changes no flash but the record.
    pub(super) fn command_bootloader(&mut self, command: ProgramControl) -> Result<(), AbortCode> {
        use ProgramControl::{Clear, ClrSignature, ResetStat, SetSignature, Start, StartBootloader, Stop};

        let Known { origin, .. } = self.known();
        let is = self.renewal_state();
        let on_trial = self.is_on_trial();
        let busy = self.boot_request.is_some() || self.programmer.has_work();
        let is_open = |program: &Program| matches!(program.session, Session::Open { .. });
        let loads = self.transfer.is_some() || self.programs.iter().any(is_open);
        let Some(state) = find::<C>(&mut self.programs, BOOTLOADER) else {
            return Err(AbortCode::NO_SUB_INDEX);
        };
        if matches!(command, Stop | StartBootloader) {
            // It runs, and it is the bootloader.
            state.stopped |= command == Stop;
            return Ok(());
        }
        let own = self.programmer.program() == Some(BOOTLOADER);
        let restarts = command == Clear && own && self.programmer.is_abortable();
        // A start would break off a download, and nobody starts a second trial from a first one.
        if busy && !restarts || command == Start && (loads && !own || origin == Origin::Trial) {
            return Err(state.refuse(Refusal::untimely(FlashError::Busy)));
        }
        if matches!(command, Clear | SetSignature | ClrSignature | Start)
            && (state.locked || !(self.policy.allowed)())
        {
            return Err(state.refuse(Refusal::untimely(FlashError::NoAccess)));
        }
        state.failure = None;
        match command {
            Clear | ClrSignature if on_trial => {
                self.boot_request = Some(BootRequest::Renewal(TrialStep::GivenUp))
            }
            Clear => {
                state.session = Session::Cleared { just: true };
                self.download_cancel();
                self.programmer.abort();
            }
            Start if is == State::Staged => self.boot_request = Some(BootRequest::Renewal(TrialStep::Try)),
            Start => state.failure = Some(Failure::of(FlashError::NoValidProgram)),
            // A master has reached the image on trial; or an installation that has failed is tried again.
            SetSignature if on_trial && is == State::Staged || is == State::Confirmed => {
                self.programmer.install()
            }
            // A program has taken the flash of the image on trial.
            SetSignature if on_trial => state.failure = Some(Failure::of(FlashError::NoValidProgram)),
            SetSignature | Stop | StartBootloader | ResetStat | ClrSignature => {}
        }
        Ok(())
    }

    /// The record of the image was stored or removed.
    pub(super) fn image_stored<F: Flash>(&mut self, flash: &F) {
        let record = self.image_record(flash);
        self.set_record(record);
        if let (Some(known), Some(State::Confirmed | State::Installed)) =
            (&mut self.renewal, record.map(|record| record.state))
        {
            known.confirmed = true;
        }
        if record.is_none() {
            // Nothing is staged any more.
            let Known { identification, version, .. } = self.known();
            self.show_image(identification, version);
        }
    }

    /// The image in 1F56h/n and 2005h/n: the one that was staged in this run, otherwise the running one.
    fn show_image(&mut self, identification: u32, version: u32) {
        let Some(state) = find::<C>(&mut self.programs, BOOTLOADER) else { return };
        (state.identification, state.version) = (identification, version);
    }

    /// Checks a complete image in staging; its record.
    pub(super) fn check_image<F: Flash>(
        &mut self,
        flash: &F,
        expected: &Expected,
        crc: u32,
    ) -> Result<RenewalRecord, FlashError> {
        let places = Places::of(self.layout).ok_or(FlashError::Unspecified)?;
        if expected.crc.is_some_and(|sent| sent != crc) {
            return Err(FlashError::NoValidProgram);
        }
        let image =
            check(flash, places.staging, self.layout, self.host()).map_err(|_| FlashError::NoValidProgram)?;
        if expected.size < image.total() {
            return Err(FlashError::NoValidProgram);
        }
        self.show_image(image.crc, image.version);
        let home = header(flash, places.home).crc;
        Ok(RenewalRecord { state: State::Staged, size: image.total(), crc: image.crc, home })
    }

    /// Whether a transfer of this program may begin now, which begins a download or goes on with one.
    pub(super) fn may_renew<F: Flash>(&mut self, flash: &F, program: u8) -> Result<(), AbortCode> {
        let Some(places) = Places::of(self.layout) else { return Ok(()) };
        let is_open =
            self.program(program).is_some_and(|state| matches!(state.session, Session::Open { .. }));
        // An image on trial takes no other one, also when it is installed: it does not run from home.
        let on_trial = self.known().origin == Origin::Trial && program == BOOTLOADER;
        let mut may = if on_trial { Err(FlashError::Busy) } else { self.programmer.may_take(program) };
        if may.is_ok() && program == BOOTLOADER && !is_open && !self.programmer.is_busy() {
            may = self.programmer.check_writable(flash, places.staging);
            may = may.and_then(|()| self.programmer.check_writable(flash, places.home));
        }
        let Err(error) = may else { return Ok(()) };
        let detail = self.programmer.take_detail();
        let Some(state) = find::<C>(&mut self.programs, program) else { return Ok(()) };
        let abort = state.refuse(Refusal::untimely(error));
        state.failure = Some(Failure { error, detail });
        Err(abort)
    }

    /// Takes note whether the last program reaches into staging, from its record as stored.
    pub(super) fn note_record(&mut self, program: u8, record: Option<ProgramRecord>) {
        let Some(renewing) = &mut self.programmer.renewing else { return };
        if let Some(region) = self.layout.program(program).filter(|_| program == renewing.last_program()) {
            let size = record.map_or(0, |record| record.size);
            renewing.is_occupied = region.base.saturating_add(size) > renewing.places().staging.base;
        }
    }

    /// The flash for a new image of the bootloader; `None` for any other program.
    pub(super) fn staging_of(&self, program: u8) -> Option<Region> {
        let places = if C::RENEWS && program == BOOTLOADER { Places::of(self.layout) } else { None };
        places.map(|places| places.staging)
    }

    /// Whether the running image is on trial, and not confirmed.
    fn is_on_trial(&self) -> bool {
        let known = self.known();
        let is_confirmed =
            known.confirmed || matches!(self.renewal_state(), State::Confirmed | State::Installed);
        known.origin == Origin::Trial && !is_confirmed
    }

    /// The flash of staging is about to be erased for a new image: the last program's open download ends, and does
    /// not go on after a cut if its stored progress has passed the start of staging. Its record stays.
    pub(super) fn drop_partial<F: Flash>(&mut self, flash: &F) {
        let Some(Places { staging, .. }) = Places::of(self.layout) else { return };
        let last = self.layout.programs.len() as u8;
        let (_, stored) = load::<C>(&self.parameters, flash, last, &self.rights);
        let Some(state) = find::<C>(&mut self.programs, last) else { return };
        if matches!(state.session, Session::Open { .. }) {
            state.session = Session::Failed;
        }
        if stored.start() > staging.base {
            state.partial = Partial::NONE;
            self.programmer.void(last);
        }
    }
}
