//! The bootloader on the strict model of a flash, with the resident part's decision after each reset.

use std::task::Poll;

use boot_core::canopen::program::Supply;
use boot_core::flash::Flash;
use boot_core::renewal::check;
use boot_core::store::{Journal, NodeParameters, ProgramRecord, RenewalRecord};
use canopen::od::Address;
use canopen::{AbortCode, BitRate, Instant, NodeId};
use kit::model::{caught, ModelFlash, PowerCut};
use kit::renewal::{load, loads, HOME, PLACES, STAGING};
use kit::rig::{crc32, fill_journal, go_on, Rig, Setup, BOARD_NODE};
use shared_abi::geometry::Region;
use shared_abi::renewal::{Origin, Progress, State};
use shared_abi::warm_start::{BootRequest, TrialStep};

use crate::device::{Action, Device, Program, Seen, Stored, Trouble};
use crate::files::{file, keys, OLD};

/// More steps than any work takes.
const ENDLESS: usize = 1_000_000;

/// The device.
pub struct Model {
    rig: Rig,
    /// The time since the last reset, in ms.
    now: u32,
    starts: u32,
    /// The open transfer: its sub-index, and the bytes that are to come.
    open: Option<(u8, Vec<u8>)>,
    request: Option<BootRequest>,
    read_back: Option<u32>,
    is_idle: bool,
}

/// Whether the bootloader of a product can be renewed.
fn renews(setup: &Setup) -> bool {
    setup.profile.extras.bootloader.is_some()
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
            flash.poke(setup.layout.key_block().base, &keys());
        }
        let rig = Rig::on(setup, buffer, flash);
        Self { rig, now: 0, starts: 0, open: None, request: None, read_back: None, is_idle: false }
    }

    fn reset(&mut self, request: Option<BootRequest>) {
        let is_low = self.rig.chip.supply() == Supply::Low;
        self.rig.reset_for(request);
        self.rig.chip.model().low_from = is_low.then_some(0);
        (self.now, self.starts, self.open, self.is_idle) = (0, self.starts + 1, None, false);
    }

    fn power_off(&mut self) {
        {
            let mut flash = self.rig.chip.model();
            (flash.cut, flash.fail, flash.weak, flash.low_from) = (None, None, None, None);
        }
        self.reset(None);
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
        go_on(&mut *self.rig.node, sub, &part, 7)?;
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
        let data = |sub| Address::new(0x1F50, sub);
        let mut answer = Ok(());
        match *action {
            Action::Command { sub, value } => answer = rig.command(sub, value),
            Action::Password { sub, is_right } => {
                if let Some((at, password)) = rig.setup.password(sub) {
                    let mut password = password.to_vec();
                    password[0] ^= u8::from(!is_right);
                    answer = rig.node.write(at, &password);
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
            Action::Upload { sub } if rig.setup.has(sub) && rig.setup.profile.extras.read_back => {
                let upload = rig.node.upload_start(data(sub)).and_then(|size| {
                    let mut bytes = vec![0; size.expect("it is known") as usize];
                    rig.node.upload_data(data(sub), 0, &mut bytes).map(|read| crc32(&bytes[..read]))
                });
                answer = upload.map(|crc| self.read_back = Some(crc));
            }
            Action::Upload { .. } => {}
            Action::Store(id) => {
                let store = rig.node.store(NodeId::new(id), Some(BitRate::K250));
                answer = if let Poll::Ready(Err(_)) = store { Err(AbortCode::GENERAL) } else { Ok(()) };
            }
            Action::Run(steps) => {
                for _ in 0..steps {
                    self.step();
                }
            }
            Action::Settle => assert!((0..ENDLESS).any(|_| self.step()), "the work does not end"),
            Action::Wait(ms) => self.pass(ms),
            Action::ResetNode => {
                self.finish();
                self.reset(None);
            }
            Action::PowerOff => self.power_off(),
            Action::Flash(after, trouble) => {
                let mut flash = rig.chip.model();
                let at = flash.operations + after;
                match trouble {
                    Trouble::Cut(cut) => flash.cut = Some((at, cut)),
                    Trouble::Dip => flash.low_from = Some(at),
                    Trouble::Fail(fault) => flash.fail = Some((at, fault)),
                    Trouble::Weak(seed) => flash.weak = Some((at, seed)),
                    Trouble::None => {
                        (flash.cut, flash.fail, flash.weak, flash.low_from) = (None, None, None, None);
                    }
                }
            }
            Action::Supply => rig.chip.model().low_from = None,
            Action::Rot(at, bits) => self.rot(at, bits),
            Action::Renew(_) => unreachable!("it is several"),
        }
        // A request to leave the bootloader. A program that starts comes back.
        if let Some(request) = self.rig.node.take_boot_request() {
            if request != BootRequest::Renewal(TrialStep::Late) {
                self.finish();
            }
            self.reset(Some(request));
            self.request = Some(request);
        }
        answer
    }

    /// One place rots where another image is certain.
    fn rot(&mut self, at: usize, bits: u8) {
        let seen = self.look();
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
        self.rig.setup
    }

    fn act(&mut self, action: &Action) -> Result<(), AbortCode> {
        (self.is_idle, self.request, self.read_back) = (false, None, None);
        let answer = caught(|| self.perform(action));
        answer.unwrap_or_else(|cause| {
            if !cause.is::<PowerCut>() {
                std::panic::resume_unwind(cause);
            }
            self.power_off();
            Err(AbortCode::GENERAL)
        })
    }

    fn look(&mut self) -> Seen {
        let setup = self.rig.setup;
        let origin = renews(setup).then(|| Progress::from_bytes(self.rig.word(0x2007, 9).to_le_bytes()));
        let origin = origin.map_or(Origin::Home, |progress| progress.expect("known numbers").origin);
        let touched = std::mem::take(&mut self.rig.chip.model().touched);
        let mut flash = self.rig.chip.model().clone();
        flash.power_on();
        let (layout, host) = (setup.layout, setup.host());
        let journal = Journal::open(&flash, layout.parameters);
        let record = RenewalRecord::load(&journal, &flash);
        let programs = (1..=setup.programs()).map(|number| {
            let record = ProgramRecord::load(&journal, &flash, number);
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
            Program { stored, record, state, crc, status, is_true }
        });
        let programs = programs.collect();
        let staged = check(&flash, PLACES.staging, layout, host);
        Seen {
            starts: self.starts,
            origin,
            loads: loads(&flash, layout, host, None).map(|(header, ..)| header.crc),
            home: load(&flash, PLACES.home, host).ok().map(|header| header.crc),
            record,
            is_staged: record.is_some_and(|record| staged.is_ok_and(|image| image.crc == record.crc)),
            programs,
            node: NodeParameters::load(&journal, &flash, BOARD_NODE, |_| true),
            is_stored: self.rig.node.stored() == Poll::Ready(Ok(())),
            touched,
            request: self.request,
            read_back: self.read_back,
            is_idle: self.is_idle,
            is_certain: layout.parameters.iter().all(|region| flash.is_stable(*region)),
        }
    }
}
