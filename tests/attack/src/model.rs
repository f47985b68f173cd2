//! The bootloader on the strict model of a flash, with the resident part's decision after each reset.

use std::task::Poll;

use boot_core::canopen::program::Supply;
use boot_core::decision::{self, choose, Autostart, Choice, Exit, Images, Woken};
use boot_core::flash::{run, Flash};
use boot_core::renewal::check;
use boot_core::store::{Key, NodeParameters, Parameters, ProgramRecord, RenewalRecord};
use canopen::od::Address;
use canopen::program::{PROGRAM_PARTIAL, STATE_REASON, STATE_RELEASED, STATE_STARTS};
use canopen::{AbortCode, BitRate, Instant, NodeId};
use kit::model::{caught, ModelFlash, PowerCut};
use kit::renewal::{load, loads, HOME, PLACES, STAGING};
use kit::rig::{crc32, fill_journal, go_on, Rig, Setup, BOARD_NODE};
use shared_abi::geometry::Region;
use shared_abi::handoff::ResetCause;
use shared_abi::layout::Layout;
use shared_abi::renewal::{Origin, Progress, State};
use shared_abi::warm_start::{BootRequest, TrialStep};

use crate::device::{Action, Device, Holder, Observation, Partial, Program, Stored, Trouble};
use crate::files::{file, OLD};
use crate::mistakes::{Mistake, Store};
use crate::sealed::{default_keys, keys, request};

/// Program 1 alone starts by itself.
pub const FIRST: Autostart = Autostart::List(&[1]);
/// More steps than any work takes.
const ENDLESS: usize = 1_000_000;

/// The device.
pub struct Model {
    setup: &'static Setup,
    rig: Rig,
    mistake: Option<Mistake>,
    /// The time since the last reset, in ms.
    now: u32,
    starts: u32,
    /// Flash operations before the last reset.
    operations: u32,
    /// The open transfer: its sub-index, and the bytes that are to come.
    open: Option<(u8, Vec<u8>)>,
    request: Option<BootRequest>,
    read_back: Option<u32>,
    is_idle: bool,
    is_cut: bool,
    /// Nothing was done since the last reset.
    is_fresh: bool,
}

/// Whether the bootloader of a product can be renewed.
fn renews(setup: &Setup) -> bool {
    setup.profile.extras.bootloader.is_some()
}

/// The boot stage's choice on a device whose bootloader is whole. A program starts at once.
pub fn choice(
    flash: &impl Flash,
    parameters: &impl Parameters,
    layout: &'static Layout,
    autostart: Autostart,
    (cause, request): (ResetCause, Option<BootRequest>),
) -> Choice<()> {
    let policy = decision::Policy { autostart, ..decision::Policy::plain(layout, &[1, 2]) };
    let node = NodeParameters::load(parameters, flash, BOARD_NODE, |_| true);
    let woken = Woken { cause, request, ..Woken::power_on(node.id_or_none(), node.bit_rate) };
    choose(&woken, &Images::SOUND, flash, parameters, &policy)
}

impl Model {
    /// A device with a bootloader, and no program; with a buffer of this size for blocks, and so many values in
    /// its journal.
    #[must_use]
    pub fn new(setup: &'static Setup, buffer: usize, stores: u32) -> Self {
        let mut flash = ModelFlash::new(setup.layout.chip);
        fill_journal(&mut flash, setup.layout, stores);
        if renews(setup) {
            flash.poke(HOME.base, &file(setup, OLD).plain);
        }
        if setup.takes_sealed {
            flash.poke(setup.layout.key_block().base, &default_keys());
        }
        Self::on(setup, buffer, flash, None)
    }

    /// A device with this flash, and a mistake in its bootloader.
    #[must_use]
    pub fn on(setup: &'static Setup, buffer: usize, flash: ModelFlash, mistake: Option<Mistake>) -> Self {
        let rig = Rig::on(mistake.map_or(setup, |mistake| mistake.setup(setup)), buffer, flash);
        let mut model = Self {
            setup,
            rig,
            mistake,
            now: 0,
            starts: 0,
            operations: 0,
            open: None,
            request: None,
            read_back: None,
            is_idle: false,
            is_cut: false,
            is_fresh: true,
        };
        model.err();
        model
    }

    /// The flash, without power.
    #[must_use]
    pub fn flash(&self) -> ModelFlash {
        let mut flash = self.rig.chip.model().clone();
        flash.power_on();
        flash
    }

    /// Whether the power was cut in the last action.
    #[must_use]
    pub fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// All its flash operations.
    #[must_use]
    pub fn operations(&self) -> u32 {
        self.operations + self.rig.chip.model().operations
    }

    /// A mistake is in each new bootloader.
    fn err(&mut self) {
        if let Some(node) = self.mistake.and_then(|mistake| mistake.node(&self.rig)) {
            self.rig.node = node;
        }
    }

    /// Counts the flash operations from the beginning. A cut that is to come stays.
    fn count_anew(&mut self) {
        let mut flash = self.rig.chip.model();
        let (operations, cut) = (flash.operations, flash.cut);
        flash.power_on();
        flash.cut = cut.filter(|(at, _)| *at > operations).map(|(at, cut)| (at - operations, cut));
        self.operations += operations;
    }

    fn reset(&mut self, cause: ResetCause, request: Option<BootRequest>) {
        let is_low = self.rig.chip.supply() == Supply::Low;
        self.count_anew();
        self.rig.chip.model().low_from = is_low.then_some(0);
        self.boot_stage(cause, request);
        self.count_anew();
        let cut = self.rig.chip.model().cut;
        self.rig.reset_for(request);
        self.err();
        self.rig.chip.model().cut = cut;
        (self.now, self.starts, self.open) = (0, self.starts + 1, None);
        (self.is_idle, self.is_fresh) = (false, true);
    }

    /// What the boot stage stores.
    fn boot_stage(&mut self, cause: ResetCause, request: Option<BootRequest>) {
        let layout = self.setup.layout;
        let mut flash = self.rig.chip.clone();
        let mut store = Store::open(&flash, layout, self.mistake);
        let choice = choice(&flash, &store, layout, FIRST, (cause, request));
        if let Some(decision::Store::CrashCount(count)) = choice.store {
            store.store(Key::CRASH_COUNT, [count, 0, 0, 0]);
            let _ = run(&mut flash, |flash, outcome| store.next(flash, outcome));
        }
    }

    fn power_off(&mut self) {
        {
            let mut flash = self.rig.chip.model();
            (flash.fail, flash.weak, flash.low_from) = (None, None, None);
        }
        self.reset(ResetCause::PowerOn, None);
    }

    /// A reset that somebody has requested waits for what a host believes to be done.
    fn finish(&mut self) {
        for _ in 0..ENDLESS {
            if !self.rig.node.is_finishing() {
                return;
            }
            if self.step() {
                self.pass(100);
            }
        }
        panic!("a reset waits for ever");
    }

    fn step(&mut self) -> bool {
        self.is_idle = self.rig.node.is_idle_after_step();
        self.is_idle
    }

    /// The next part of the open transfer, which ends with its last one.
    fn go_on(&mut self, bytes: Option<usize>) -> Result<(), AbortCode> {
        let Some((sub, mut rest)) = self.open.take() else { return Ok(()) };
        let part: Vec<u8> = rest.drain(..bytes.unwrap_or(rest.len()).min(rest.len())).collect();
        // In segments of several sizes. (A first one with fewer than four bytes hides what it is.)
        go_on(&mut *self.rig.node, sub, &part, 7 - part.len() % 7)?;
        if bytes.is_none() {
            return self.rig.end(sub);
        }
        self.open = Some((sub, rest));
        Ok(())
    }

    fn pass(&mut self, ms: u32) {
        self.now += ms;
        self.rig.node.set_time(Instant::from_millis(self.now));
    }

    fn perform(&mut self, action: &Action) -> Result<(), AbortCode> {
        let rig = &mut self.rig;
        let mut answer = Ok(());
        match *action {
            Action::Command { sub, value } => answer = rig.command(sub, value),
            Action::Password { sub, is_right } => {
                if let Some((at, password)) = rig.setup.password(sub) {
                    let mut password = password.to_vec();
                    password[0] ^= u8::from(!is_right);
                    answer = rig.write(at, &password);
                }
            }
            Action::Send { sub, sent, is_announced, bytes } => {
                let all = sent.bytes(rig.setup);
                answer = rig.begin(sub, is_announced.then_some(all.len() as u32), &[]);
                if answer.is_ok() {
                    self.open = Some((sub, all));
                    answer = self.go_on(bytes);
                }
            }
            Action::GoOn(bytes) => answer = self.go_on(bytes),
            Action::Cancel => {
                if let Some((sub, _)) = self.open.take() {
                    rig.cancel(sub);
                }
            }
            Action::Read { index, sub } => {
                let at = Address::new(index, sub);
                if rig.node.entries().iter().any(|entry| entry.at == at) && index != 0x1F50 {
                    answer = rig.node.read(at, &mut [0; 64]).map(drop);
                }
            }
            Action::Upload { sub } => answer = self.upload(sub),
            Action::Store(id) => {
                let store = rig.node.store(NodeId::new(id), Some(BitRate::K250));
                answer = if let Poll::Ready(Err(_)) = store { Err(AbortCode::GENERAL) } else { Ok(()) };
            }
            Action::Right(holder, rights) => answer = self.ask(holder, rights),
            Action::Return(program) if rig.setup.has(program) && rig.node.is_idle_after_step() => {
                rig.node.confirm(program);
            }
            Action::Return(_) => {}
            Action::Run(steps) => {
                for _ in 0..steps {
                    self.step();
                }
            }
            Action::Settle => assert!((0..ENDLESS).any(|_| self.step()), "the work does not end"),
            Action::Wait(ms) => self.pass(ms),
            Action::ResetNode => {
                self.finish();
                self.reset(ResetCause::Pin, None);
            }
            Action::Crash => self.reset(ResetCause::IndependentWatchdog, None),
            Action::PowerOff => self.power_off(),
            Action::Flash(after, trouble) => self.trouble(after, trouble),
            Action::Supply => rig.chip.model().low_from = None,
            Action::Rot(at, bits) => self.rot(at, bits),
            Action::Renew(_) => unreachable!("it is several"),
            // It has no bus.
            Action::Disturb(_) | Action::Scramble(_) => {}
        }
        // A request to leave the bootloader. A program that starts comes back.
        if let Some(request) = self.rig.node.take_boot_request() {
            if request != BootRequest::Renewal(TrialStep::Late) {
                self.finish();
            }
            self.reset(ResetCause::Software, Some(request));
            self.request = Some(request);
        }
        answer
    }

    /// Reads a program back, if the device permits it.
    fn upload(&mut self, sub: u8) -> Result<(), AbortCode> {
        let (rig, at) = (&mut self.rig, Address::new(0x1F50, sub));
        if rig.setup.has(sub) && rig.setup.profile.extras.read_back {
            let size = rig.upload_start(at)?.expect("it is known");
            let mut bytes = vec![0; size as usize];
            let read = rig.upload_data(at, 0, &mut bytes)?;
            self.read_back = Some(crc32(&bytes[..read]));
        }
        Ok(())
    }

    /// So many flash operations later there is trouble.
    fn trouble(&mut self, after: u32, trouble: Trouble) {
        let mut flash = self.rig.chip.model();
        let at = flash.operations + after;
        match trouble {
            Trouble::Cut(cut) => flash.cut = Some((at, cut)),
            Trouble::Dip => flash.low_from = Some(at),
            Trouble::Fail(fault) => flash.fail = Some((at, fault)),
            Trouble::Weak(seed) => flash.weak = Some((at, seed)),
            Trouble::None => (flash.cut, flash.fail, flash.weak, flash.low_from) = (None, None, None, None),
        }
    }

    /// Asks a sealed device for rights.
    fn ask(&mut self, holder: Holder, rights: u32) -> Result<(), AbortCode> {
        const RIGHTS: Address = Address::new(0x2002, 1);
        let mut challenge = [0; 48];
        self.rig.node.read(RIGHTS, &mut challenge)?;
        let key = match holder {
            Holder::Root => &keys().root,
            Holder::Release => &keys().release,
            Holder::Stranger => &keys().stranger,
        };
        self.rig.node.write(Address::new(0x2002, 2), &request(&challenge, key, rights, 0))?;
        assert!((0..ENDLESS).any(|_| self.step()), "the work does not end");
        self.rig.node.read(RIGHTS, &mut challenge)?;
        let granted = u32::from_le_bytes([44, 45, 46, 47].map(|at| challenge[at]));
        if granted & rights == rights {
            Ok(())
        } else {
            Err(AbortCode::GENERAL)
        }
    }

    /// One place rots where another image is certain.
    fn rot(&mut self, at: usize, bits: u8) {
        let seen = self.observe();
        let place = match (seen.state(), seen.origin) {
            (State::Installed, Origin::Home) if seen.is_staged && at.is_multiple_of(2) => HOME,
            (State::Staged, Origin::Home | Origin::Trial) | (State::Installed, Origin::Home) => STAGING,
            _ => return,
        };
        if seen.is_certain && !self.rig.node.is_finishing() {
            let at = place.base + (at / 2) as u32 % place.size;
            {
                let mut flash = self.rig.chip.model();
                let cell = flash.cells(Region::new(at, 1))[0];
                flash.poke(at, &[cell & bits]);
            }
            self.power_off();
        }
    }
}

impl Device for Model {
    fn setup(&self) -> &'static Setup {
        self.setup
    }

    fn act(&mut self, action: &Action) -> Result<(), AbortCode> {
        (self.is_idle, self.request, self.read_back, self.is_cut) = (false, None, None, false);
        self.is_fresh = false;
        self.rig.chip.model().touched.clear();
        let answer = caught(|| self.perform(action));
        answer.unwrap_or_else(|cause| {
            if !cause.is::<PowerCut>() {
                std::panic::resume_unwind(cause);
            }
            self.power_off();
            self.is_cut = true;
            Err(AbortCode::GENERAL)
        })
    }

    fn observe(&mut self) -> Observation {
        let setup = self.setup;
        let origin = renews(setup).then(|| Progress::from_bytes(self.rig.word(0x2007, 9).to_le_bytes()));
        let origin = origin.map_or(Origin::Home, |progress| progress.expect("known numbers").origin);
        let touched = std::mem::take(&mut self.rig.chip.model().touched);
        let mut flash = self.rig.chip.model().clone();
        flash.power_on();
        let (layout, host) = (setup.layout, setup.host());
        let journal = Store::open(&flash, layout, self.mistake);
        let record = RenewalRecord::load(&journal, &flash);
        let programs = (1..=setup.programs()).map(|number| {
            let record = journal.program(&flash, number);
            let region = setup.region(number);
            let stored = record.map_or(Stored::None, |record| {
                let place = Region::new(region.base, record.size.min(region.size));
                let is_true = crc32(flash.cells(place)) == record.crc && flash.is_stable(place);
                if is_true {
                    Stored::Good(record.crc)
                } else {
                    Stored::Damaged
                }
            });
            let rig = &mut self.rig;
            let (state, crc, status) = (rig.state(number), rig.identification(number), rig.status(number));
            let is_true = stored == Stored::Good(crc) || rig.is_true(number);
            let counter = journal.get(&flash, Key::counter(number)).map_or(0, |[counter, ..]| counter);
            let partial = self.is_fresh.then(|| partial(rig, number, &flash)).flatten();
            Program { stored, record, state, crc, status, is_true, counter, partial }
        });
        let programs: Vec<Program> = programs.collect();
        let chosen =
            |autostart| choice(&flash, &journal, layout, autostart, (ResetCause::PowerOn, None)).exit;
        let stays = match chosen(Autostart::InOrder) {
            Exit::Bootloader { stay, .. } if stay.held == 0 => stay.reason as u32,
            _ => STATE_STARTS.into(),
        };
        let released = (1..).zip(&programs).map(|(number, program)| {
            let is_signed = program.record.is_some_and(|record| record.signed);
            u32::from(is_signed && !setup.is_data(number)) << (number - 1)
        });
        let released = released.sum();
        let starting = match chosen(FIRST) {
            Exit::Program(start) => {
                let region = setup.region(start.number);
                let is_whole = |record: ProgramRecord| {
                    record.signed && crc32(&flash.cells(region)[..record.size as usize]) == record.crc
                };
                // A bit between 0 and 1 may hide the record that the boot stage has read.
                let mut records = (0..64).map(|_| journal.program(&flash, start.number));
                Some((start.number, records.any(|record| record.is_some_and(is_whole))))
            }
            Exit::Bootloader { .. } | Exit::Again | Exit::Choose => None,
        };
        let staged = check(&flash, PLACES.staging, layout, host);
        Observation {
            starts: self.starts,
            origin,
            loads: loads(&flash, layout, host, None).map(|(header, ..)| header.crc),
            home: load(&flash, PLACES.home, host).ok().map(|header| header.crc),
            record,
            is_staged: record.is_some_and(|record| staged.is_ok_and(|image| image.crc == record.crc)),
            programs,
            starting,
            stays: [self.rig.word(0x2007, STATE_REASON), stays],
            released: [self.rig.word(0x2007, STATE_RELEASED), released],
            node: NodeParameters::load(&journal, &flash, BOARD_NODE, |_| true),
            is_stored: self.rig.node.stored() == Poll::Ready(Ok(())),
            touched,
            request: self.request,
            read_back: self.read_back,
            is_idle: self.is_idle,
            is_cut: self.is_cut,
            is_certain: layout.parameters.iter().all(|region| flash.is_stable(*region)),
        }
    }
}

/// The download of a program that goes on, as the device says.
fn partial(rig: &mut Rig, number: u8, flash: &ModelFlash) -> Option<Partial> {
    let mut bytes = [0; 8];
    let at = Address::new(PROGRAM_PARTIAL, number);
    if !rig.node.entries().iter().any(|entry| entry.at == at) {
        return None;
    }
    rig.node.read(at, &mut bytes).expect("2006h can be read");
    let [id, end] = [0, 4].map(|at| u32::from_le_bytes([at, at + 1, at + 2, at + 3].map(|at| bytes[at])));
    let region = rig.setup.region(number);
    let len = if id == 0 { 0 } else { end.wrapping_sub(region.base) as usize };
    let crc = if len > region.size as usize { 0 } else { crc32(&flash.cells(region)[..len]) };
    (id != 0).then_some(Partial { id, len, crc })
}
