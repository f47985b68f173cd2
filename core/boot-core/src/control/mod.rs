//! Program download: 1F50h takes the data, 1F51h the commands, and 1F57h shows the result.
//!
//! This module connects the other modules. The `intake` checks incoming data: it refuses them at
//! once, with an abort and a status, or accepts them. The `programmer` carries out the accepted
//! work ([`Downloader::step`]). The two never wait for each other; a queue lies between them. While
//! the queue has room for another block, the status is not busy, even if the flash works: a host
//! that reads the status between blocks sends the next block while the previous ones are being
//! programmed.
//!
//! An installed program is lost only after the first data of a new one were found good: the device
//! carries out CLEAR together with these data (SYS TEC manual L-1112d_10, figure 12), see
//! [`Erase`].

mod commands;
mod renewal;
mod rights;
mod sealed;
mod transfer;

use core::task::Poll;

use canopen::program::{region_value, FlashError, FlashStatus, ProgramState};
use canopen::AbortCode;
use seal::access::right;
use shared_abi::boot_report::{BootReport, Reason};
use shared_abi::geometry::Region;
use shared_abi::label;
use shared_abi::layout::Layout;
use shared_abi::renewal::BOOTLOADER;
use shared_abi::warm_start::BootRequest;

use crate::choices::{Choices, Everything, Has};
use crate::decision::{Contents, Product};
use crate::flash::Flash;
use crate::intake::Intake;
use crate::keys::Images;
use crate::policy::Judge;
use crate::program::{check_vectors, Expected, VerifiedProgram};
use crate::programmer::{Event, Programmer};
use crate::refusal::Refusal;
use crate::renewal::Known;
use crate::resume::Partial;
use crate::session::Session;
use crate::source::Source;
use crate::store::{Key, NodeParameters, Parameters, ProgramRecord};
use crate::unseal::Outcome;
use rights::Rights;

pub use crate::policy::{AppInfo, Erase, Policy, Renewal, Verdict};
pub use crate::programmer::Step;
pub use sealed::{Sealed, SealedMemory};

/// The used places of the store from which on it is compacted when the device is idle. An update stores some 20
/// values at most.
const USED: u32 = 64;
/// The same between two downloads: a master that never leaves the device alone must not make its starts slow, and
/// a program must find room in it.
const USED_AT_MOST: u32 = 256;

/// One program in the form of the objects 1F50h–1F57h.
#[derive(Clone, Copy, Debug)]
struct Program {
    /// Its flash.
    region: Region,
    /// The stored record; a copy, because the flash cannot be read while it is busy.
    record: Option<ProgramRecord>,
    /// Without a record: why.
    absent: Reason,
    /// 1F56h: the CRC that was computed last, or the stored one.
    identification: u32,
    /// Why the last block or command failed.
    failure: Option<Failure>,
    session: Session,
    /// The download that was cut off or is going on, as stored; a copy for the same reason.
    partial: Partial,
    /// The version in the last control block; of the bootloader itself, that of the image in 1F56h.
    version: u32,
    /// The creation date in the last control block, in seconds since 1970-01-01 UTC; 0 for none.
    announced_date: u32,
    /// The creation date of the stored program, in the same way.
    date: u32,
    /// The last complete transfer was a raw image or Intel HEX, and no command followed.
    streamed: bool,
    /// The program must start after its verification, because its host did not wait for that.
    start_when_verified: bool,
    /// The client has not sent the password.
    locked: bool,
    /// STOP was written since the last download began.
    stopped: bool,
}

/// Why a block or a command failed.
#[derive(Clone, Copy, Debug)]
struct Failure {
    error: FlashError,
    /// [`FlashStatus::detail`].
    detail: u8,
}

impl Failure {
    const fn of(error: FlashError) -> Self {
        Self { error, detail: 0 }
    }
}

/// The open SDO transfer to 1F50h.
struct Transfer {
    program: u8,
    intake: Intake,
}

/// The download of programs into flash. `PROGRAMS` is the number of programs in the layout, and one
/// more if the bootloader can be renewed: its own image is the last one, with the number
/// [`BOOTLOADER`].
pub struct Downloader<'b, P, const PROGRAMS: usize, C = Everything> {
    layout: &'static Layout,
    policy: &'static Policy,
    parameters: P,
    programs: [Program; PROGRAMS],
    programmer: Programmer<'b, C>,
    rights: Rights<'b>,
    transfer: Option<Transfer>,
    /// The abort for a client that continues to send after the flash has failed.
    fault: AbortCode,
    /// A request to leave the bootloader, not yet carried out.
    boot_request: Option<BootRequest>,
    /// The result of work on a program, or of a damaged block, not yet reported.
    outcome: Option<(u8, Result<(), FlashError>)>,
    /// The result of the last storing of node-ID and bit rate.
    node_stored: Result<(), FlashError>,
    /// `None` if the bootloader cannot be renewed.
    renewal: Option<Known>,
}

impl<'b, P: Parameters, const PROGRAMS: usize, C: Choices> Downloader<'b, P, PROGRAMS, C> {
    /// Starts with the stored parameters. The larger the `buffer`, the further the flash may lag
    /// behind the bus; blocks larger than the buffer, or than 16 KiB, are refused.
    pub fn new<F: Flash>(
        layout: &'static Layout,
        policy: &'static Policy,
        parameters: P,
        flash: &F,
        buffer: &'b mut [u8],
        sealed: Sealed<'b>,
    ) -> Self {
        let (mut rights, unsealer) = sealed.split();
        rights.attach(flash, &parameters, layout, policy);
        let mut number = 0;
        let programs = [(); PROGRAMS].map(|()| {
            number += 1;
            let (record, partial) = if C::RENEWS && layout.program(number).is_none() {
                (None, Partial::NONE)
            } else {
                load::<C>(&parameters, flash, number, &rights)
            };
            let region = layout.program(number).unwrap_or(Region::new(0, 0));
            Program {
                region,
                record,
                absent: Reason::NoProgram,
                identification: record.map_or(0, |record| record.crc),
                failure: None,
                session: Session::Idle,
                partial,
                version: 0,
                announced_date: 0,
                date: date::<C>(&parameters, flash, number, region, record),
                streamed: false,
                start_when_verified: false,
                locked: policy.locked,
                stopped: false,
            }
        });
        Self {
            layout,
            policy,
            parameters,
            programs,
            programmer: Programmer::new(Source::new(buffer, unsealer), policy.crc, policy.crc_step),
            rights,
            transfer: None,
            fault: AbortCode::DEVICE_STATE,
            boot_request: None,
            outcome: None,
            node_stored: Ok(()),
            renewal: None,
        }
    }

    /// Takes the report of the resident part. If it has refused to start a program, its status is that of a
    /// START of no valid program. A damaged program is none any more.
    pub(crate) fn take_report<F: Flash>(&mut self, flash: &F, report: &BootReport) {
        if C::RENEWS {
            self.begin_renewal(flash, report);
        }
        // A program may have answered STOP itself before it has left; it then leaves no node-ID.
        if let (Some(state), 0) = (find::<C>(&mut self.programs, report.owed.program), report.owed.value) {
            state.stopped = true;
        }
        let Some(state) = find::<C>(&mut self.programs, report.refused) else { return };
        state.failure = Some(Failure::of(FlashError::NoValidProgram));
        if report.reason == Reason::Damaged as u8 || report.reason == Reason::Vectors as u8 {
            state.record = None;
            state.identification = 0;
            state.absent =
                if report.reason == Reason::Damaged as u8 { Reason::Damaged } else { Reason::Vectors };
        }
    }

    /// Ends all work at once, and returns the buffer.
    pub fn into_buffer(self) -> &'b mut [u8] {
        self.programmer.into_buffer()
    }

    /// The rights and the event log.
    pub(crate) fn rights(&self) -> &Rights<'b> {
        &self.rights
    }

    /// See [`rights`](Self::rights).
    pub(crate) fn rights_mut(&mut self) -> &mut Rights<'b> {
        &mut self.rights
    }

    /// 1F57h. It is busy while a command of this program is carried out, or while no further block
    /// can be accepted.
    #[must_use]
    pub fn status(&self, program: u8) -> FlashStatus {
        let busy = self.programmer.is_busy_with(program);
        match self.program(program).and_then(|state| state.failure) {
            Some(Failure { error, detail }) => {
                FlashStatus { busy, error: Some(error), detail: detail.into() }
            }
            None => FlashStatus { busy, ..FlashStatus::OK },
        }
    }

    /// 1F51h: no program runs. The value shows whether a program exists.
    #[must_use]
    pub fn control(&self, program: u8) -> ProgramState {
        if C::RENEWS && program == BOOTLOADER {
            return ProgramState::Running;
        }
        match self.program(program).and_then(|state| state.record) {
            Some(_) => ProgramState::Stopped,
            None => ProgramState::Absent,
        }
    }

    /// 2007h/12: the programs that are released for autostart, number 1 in bit 0.
    pub(crate) fn released(&self) -> u32 {
        let of = |(place, state): (usize, &Program)| match state.record {
            Some(record) if record.signed => 1 << place,
            _ => 0,
        };
        let released: u32 = self.programs.iter().take(32).enumerate().map(of).sum();
        // Data are stored as a program that is released.
        match self.policy.data {
            Some(number) => released & !(1_u32.wrapping_shl(u32::from(number).wrapping_sub(1))),
            None => released,
        }
    }

    /// 1F56h: the CRC of the program, 0 if there is none.
    #[must_use]
    pub fn identification(&self, program: u8) -> u32 {
        self.program(program).map_or(0, |state| state.identification)
    }

    /// 2005h: the version of the program in flash, 0 if unknown.
    #[must_use]
    pub fn version(&self, program: u8) -> u32 {
        let Some(state) = self.program(program) else { return 0 };
        match state.record {
            Some(record) => record.version,
            None if C::RENEWS && program == BOOTLOADER => state.version,
            None => 0,
        }
    }

    /// 1F52h: the creation date of the installed program with the lowest number, in seconds since 1970-01-01
    /// UTC; 0 if unknown.
    pub(crate) fn date(&self) -> u32 {
        self.programs.iter().find(|state| state.record.is_some()).map_or(0, |state| state.date)
    }

    /// 2006h: the download that can go on, as the CRC of its control block and the address up to
    /// which its data have arrived, little-endian; zeros if there is none.
    #[must_use]
    pub fn partial(&self, program: u8) -> [u8; 8] {
        let Some(state) = self.program(program) else { return [0; 8] };
        let [id, stored] = state.resumable().words();
        let (id, end) = match state.session {
            Session::Idle => (id, stored),
            Session::Open { .. } => (id, self.programmer.source().queue.last.end()),
            _ => (0, 0),
        };
        region_value(id, end)
    }

    /// 2004h: address and size of the program's flash, little-endian.
    #[must_use]
    pub fn region(&self, program: u8) -> [u8; 8] {
        self.program(program).map_or([0; 8], |state| region_value(state.region.base, state.region.size))
    }

    /// Whether [`Downloader::step`] has work to do.
    #[must_use]
    pub fn busy(&self) -> bool {
        self.programmer.is_busy()
    }

    /// Returns the request to leave the bootloader, once; the answer to the command may not have
    /// been sent yet.
    pub fn take_boot_request(&mut self) -> Option<BootRequest> {
        self.boot_request.take()
    }

    /// Returns the result of work on a program, or of a damaged block, once.
    pub fn take_outcome(&mut self) -> Option<(u8, Result<(), FlashError>)> {
        self.outcome.take()
    }

    /// Whether a complete program or an acknowledged command is not yet carried out: a reset now
    /// would undo it, and begin an installation at home anew, with the erase.
    #[must_use]
    pub fn is_finishing(&self) -> bool {
        let programmer = &self.programmer;
        programmer.finishing().is_some() || programmer.is_storing() || programmer.is_installing()
    }

    /// Whether the store is being compacted, or may have to be before a program starts.
    #[must_use]
    pub fn is_compacting(&self) -> bool {
        self.programmer.is_compacting()
    }

    /// Stores node-ID and bit rate in the background.
    ///
    /// # Errors
    /// The device is busy with other work.
    pub fn store_node(&mut self, node: NodeParameters) -> Result<(), FlashError> {
        if !self.programmer.may_store() || self.boot_request.is_some() {
            return Err(FlashError::Busy);
        }
        self.programmer.store_node(&mut self.parameters, node);
        Ok(())
    }

    /// The result of the last [`store_node`](Self::store_node).
    pub fn node_stored(&self) -> Poll<Result<(), FlashError>> {
        if self.programmer.is_storing_node() {
            Poll::Pending
        } else {
            Poll::Ready(self.node_stored)
        }
    }

    /// Prepares to read 1F50h; returns the region of the stored program.
    ///
    /// # Errors
    /// The abort for the client.
    pub fn stored(&self, program: u8) -> Result<Region, AbortCode> {
        let state = self.program(program).ok_or(AbortCode::NO_SUB_INDEX)?;
        if !self.policy.read_back {
            return Err(AbortCode::WRITE_ONLY);
        }
        if !self.rights.permits(right::READ_BACK) {
            return Err(AbortCode::DEVICE_STATE);
        }
        // The flash cannot be read while it works.
        if state.locked || self.busy() {
            return Err(AbortCode::DEVICE_STATE);
        }
        match self.installed(program) {
            (Region { size: 0, .. }, _) => Err(AbortCode::NO_DATA),
            (place, _) => Ok(place),
        }
    }

    /// The region of the stored program, and its CRC; an empty region if there is none.
    pub(crate) fn installed(&self, program: u8) -> (Region, u32) {
        match self.program(program) {
            Some(Program { region, record: Some(record), .. }) => {
                (Region::new(region.base, record.size), record.crc)
            }
            _ => (Region::new(0, 0), 0),
        }
    }

    /// Continues the work with one step.
    pub fn step<F: Flash>(&mut self, flash: &mut F) -> Step {
        let rights = &mut self.rights;
        let (step, event) = self.programmer.step(&mut self.parameters, flash, || rights.take_note());
        let unsealer = &mut self.programmer.source_mut().unsealer;
        let news = unsealer.take_news();
        let is_same = matches!(news.outcome, Outcome::Installed { same: true, .. });
        self.rights.update(news, unsealer.edition());
        match event {
            None => {}
            Some(Event::NodeStored(outcome)) => self.node_stored = outcome,
            Some(Event::Stored { program: BOOTLOADER, ends }) if C::RENEWS => {
                self.image_stored(flash);
                if ends {
                    self.end(BOOTLOADER, Ok(()));
                } else if self.programmer.program() == Some(BOOTLOADER) {
                    self.drop_partial(flash);
                }
            }
            Some(Event::Written { program: BOOTLOADER, expected, crc }) if C::RENEWS => {
                if let Some(state) = find::<C>(&mut self.programs, BOOTLOADER) {
                    state.session = Session::Idle;
                }
                let record = self.check_image(flash, &expected, crc);
                let stores =
                    record.and_then(|record| self.programmer.record_image(&mut self.parameters, record));
                if let Err(error) = stores {
                    self.end(BOOTLOADER, Err(error));
                }
            }
            Some(Event::Stored { program, ends }) => {
                let (record, partial) = load::<C>(&self.parameters, flash, program, &self.rights);
                if C::RENEWS {
                    self.note_record(program, record);
                }
                if let Some(state) = find::<C>(&mut self.programs, program) {
                    state.record = record;
                    state.absent = Reason::NoProgram;
                    state.date = date::<C>(&self.parameters, flash, program, state.region, record);
                    if record.is_none() {
                        state.identification = 0;
                    }
                    let open = matches!(state.session, Session::Open { .. });
                    if !open {
                        state.partial = partial;
                    }
                    if ends && open && is_same {
                        state.session = Session::Idle;
                    }
                }
                if ends {
                    self.end(program, Ok(()));
                }
            }
            Some(Event::Written { program, expected, crc }) => {
                if let Err(error) = self.record(flash, program, &expected, crc) {
                    self.end(program, Err(error));
                }
            }
            Some(Event::Failed { program, error, erasing }) => {
                self.fault = match error {
                    _ if erasing => AbortCode::GENERAL,
                    // The errors for which a sealed image is refused.
                    error
                        if self.rights.is_present()
                            && !matches!(error, FlashError::Write | FlashError::NvData) =>
                    {
                        AbortCode::STORE
                    }
                    _ => AbortCode::HARDWARE,
                };
                if C::RENEWS {
                    // A record that could not be removed stays.
                    self.image_stored(flash);
                }
                self.end(program, Err(error));
            }
        }
        step
    }

    /// A program was written completely, with this CRC in flash: stores its record.
    fn record<F: Flash>(
        &mut self,
        flash: &F,
        program: u8,
        expected: &Expected,
        crc: u32,
    ) -> Result<(), FlashError> {
        if let Some(state) = find::<C>(&mut self.programs, program) {
            state.identification = crc;
            state.session = Session::Idle;
        }
        let version = self.check_stored(flash, program, expected, crc)?;
        let whole = expected.crc.is_none() || self.programmer.source().unsealer.is_active();
        let record = ProgramRecord {
            size: expected.size,
            crc,
            signed: whole && self.policy.valid_without_signature,
            confirmed: false,
            version,
            half_erased: self.programmer.is_half_erased(),
            seal: None,
            withdrawn: false,
        };
        let record = self.programmer.source().unsealer.mark(record);
        self.programmer.record(&mut self.parameters, program, record, false);
        Ok(())
    }

    /// Compacts the store from so many used places on, unless there is other work or a download is open. Returns
    /// whether it begins.
    pub(crate) fn compact(&mut self, is_idle: bool) -> bool {
        let used = if is_idle { USED } else { USED_AT_MOST };
        let is_open = |program: &Program| matches!(program.session, Session::Open { .. });
        let waits = self.transfer.is_some() || self.boot_request.is_some() || self.programmer.has_work();
        !waits && !self.programs.iter().any(is_open) && self.programmer.compact(&mut self.parameters, used)
    }

    /// Compares the flash with the expected program; returns the program's version.
    fn check_stored<F: Flash>(
        &self,
        flash: &F,
        program: u8,
        expected: &Expected,
        crc: u32,
    ) -> Result<u32, FlashError> {
        let Some(state) = self.program(program) else { return Err(FlashError::Unspecified) };
        let region = state.region;
        if self.policy.data == Some(program) {
            return Ok(state.version);
        }
        if expected.crc.is_some_and(|sent| sent != crc) || check_vectors(flash, region, self.layout).is_err()
        {
            return Err(FlashError::NoValidProgram);
        }
        let mut label = [0; label::SIZE];
        // The label must lie inside the program.
        if expected.size >= label::OFFSET + label::SIZE as u32 {
            flash.read(region.base + label::OFFSET, &mut label);
        }
        let judge = Judge {
            layout: self.layout,
            policy: self.policy,
            program,
            region,
            session: state.session,
            installed: false,
            stopped: false,
            images: Images::Plain,
            partial: Partial::NONE,
        };
        // The version of a control block takes precedence.
        let announced = state.version;
        let checked =
            judge.check_label(&label).map(|version| if announced == 0 { version } else { announced });
        checked.map_err(|Refusal(error, _)| error)
    }

    /// Ends a piece of work on a program.
    fn end(&mut self, program: u8, outcome: Result<(), FlashError>) {
        // Without a target the received data were discarded, also those of another program.
        let is_gone = C::RENEWS && self.programmer.program().is_none();
        let current = self.transfer.as_ref().is_some_and(|transfer| transfer.program == program || is_gone);
        if outcome.is_err() && current {
            self.transfer = None;
            self.programmer.source_mut().queue.clear();
        }
        self.outcome = Some((program, outcome));
        let Some(state) = find::<C>(&mut self.programs, program) else { return };
        let start = core::mem::take(&mut state.start_when_verified);
        state.failure = outcome.err().map(|error| Failure { error, detail: self.programmer.take_detail() });
        if outcome.is_err() {
            // Nothing goes on with a program that was refused as a whole.
            self.programmer.forbid_resume(program);
            state.streamed = false;
            if !matches!(state.session, Session::Idle) {
                state.session = Session::Failed;
            }
        } else if start && state.record.is_some() {
            self.boot_request = Some(BootRequest::Fresh(program));
        }
    }

    /// Whether the queue has room for another transfer.
    fn has_room(&self) -> bool {
        self.programmer.source().has_room()
    }

    /// The program with this number, if it exists.
    fn program(&self, program: u8) -> Option<&Program> {
        self.programs.get(place::<C>(PROGRAMS, program))
    }
}

/// The programs as they were checked last: when they were stored, or by the boot stage.
impl<P: Parameters, const PROGRAMS: usize, C: Choices> Contents for &Downloader<'_, P, PROGRAMS, C> {
    type Vectors = ();

    fn check(&self, _: impl Product, number: u8) -> Result<VerifiedProgram<()>, Reason> {
        let state = self.program(number).ok_or(Reason::NoProgram)?;
        match &state.record {
            &Some(ProgramRecord { signed, confirmed, .. }) => {
                Ok(VerifiedProgram { signed, confirmed, locks_flash: false, vectors: () })
            }
            None => Err(state.absent),
        }
    }
}

/// The record of a program, if the device may start it; and its download that was cut off. Both are of
/// one reading: after a power cut the next one may differ.
fn load<C: Choices>(
    parameters: &impl Parameters,
    flash: &impl Flash,
    number: u8,
    rights: &Rights<'_>,
) -> (Option<ProgramRecord>, Partial) {
    let value = parameters.get(flash, Key::program(number)).unwrap_or([0; 4]);
    let record = ProgramRecord::from_value(value);
    let record = record.filter(|record| record.is_sealed() || !rights.takes_no_other());
    (record, if C::RESUMES { Partial::of_words(ProgramRecord::partial_of(value)) } else { Partial::NONE })
}

/// The creation date of a program with this record, in seconds since 1970-01-01 UTC; 0 if unknown.
fn date<C: Choices>(
    parameters: &impl Parameters,
    flash: &impl Flash,
    number: u8,
    region: Region,
    record: Option<ProgramRecord>,
) -> u32 {
    match record {
        Some(record) if C::DATES => parameters.date(flash, number, region, &record),
        _ => 0,
    }
}

/// The program with this number, if it exists.
fn find<C: Choices>(programs: &mut [Program], number: u8) -> Option<&mut Program> {
    programs.get_mut(place::<C>(programs.len(), number))
}

/// The place of a program in the list of all. The last one is the bootloader's, if it can be renewed.
fn place<C: Choices>(count: usize, number: u8) -> usize {
    let of_bootloader = count.wrapping_sub(1);
    match usize::from(number).wrapping_sub(1) {
        _ if C::RENEWS && number == BOOTLOADER => of_bootloader,
        place if C::RENEWS && place == of_bootloader => usize::MAX,
        place => place,
    }
}

impl Program {
    /// The download that can go on: none after a refusal, until a block is accepted.
    const fn resumable(&self) -> Partial {
        match self.failure {
            None => self.partial,
            Some(_) => Partial::NONE,
        }
    }

    /// Records the reason of a refusal. The error that ended a session stays visible.
    fn refuse(&mut self, Refusal(error, abort): Refusal) -> AbortCode {
        if !matches!(self.session, Session::Failed) || self.failure.is_none() {
            self.failure = Some(Failure::of(error));
        }
        abort
    }
}
