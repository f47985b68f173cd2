//! The bootloader on the strict model of a flash, with the resident part's decision after each reset.

use boot_core::canopen::program::Supply;
use boot_core::flash::Flash;
use boot_core::renewal::check;
use boot_core::store::{Journal, ProgramRecord, RenewalRecord};
use canopen::{BitRate, Instant, NodeId};
use kit::model::{caught, ModelFlash, PowerCut, CHIP};
use kit::renewal::{load, loads, HOME, PLACES, STAGING};
use kit::rig::{crc32, Rig, Setup};
use shared_abi::geometry::Region;
use shared_abi::renewal::{Origin, Progress, State};
use shared_abi::warm_start::{BootRequest, TrialStep};

use crate::device::{Action, Device, Seen, Stored, Trouble};
use crate::files::{file, keys, OLD};

/// More steps than any work takes.
const ENDLESS: usize = 1_000_000;

/// The device.
pub struct Model {
    rig: Rig,
    /// The time since the last reset, in ms.
    now: u32,
    starts: u32,
    /// The sub-index of the last transfer.
    sub: u8,
}

impl Model {
    /// A new device with a bootloader, and no program.
    #[must_use]
    pub fn new(setup: &'static Setup) -> Self {
        let mut flash = ModelFlash::new(&CHIP);
        flash.poke(HOME.base, &file(setup, OLD).plain);
        if setup.takes_sealed {
            flash.poke(setup.layout.key_block().base, &keys());
        }
        Self { rig: Rig::on(setup, 2048, flash), now: 0, starts: 0, sub: 1 }
    }

    fn reset(&mut self, request: Option<BootRequest>) {
        let is_low = self.rig.chip.supply() == Supply::Low;
        self.rig.reset_for(request);
        self.rig.chip.model().low_from = is_low.then_some(0);
        (self.now, self.starts) = (0, self.starts + 1);
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
            if self.rig.node.is_idle_after_step() {
                self.pass(100);
            }
        }
        panic!("a reset waits for ever");
    }

    fn pass(&mut self, ms: u32) {
        self.now += ms;
        self.rig.node.set_time(Instant::from_millis(self.now));
    }

    fn perform(&mut self, action: &Action) -> bool {
        let rig = &mut self.rig;
        let mut taken = Ok(());
        match *action {
            Action::Command { sub, value } => taken = rig.command(sub, value),
            Action::Password { sub } => taken = rig.unlock(sub),
            Action::Send { sub, content, block, bytes } => {
                let file = file(rig.setup, content);
                let all = block.map_or(&file.whole, |block| &file.blocks[block % file.blocks.len()]);
                let part = &all[..bytes.unwrap_or(all.len()).min(all.len())];
                self.sub = sub;
                taken = rig.begin(sub, Some(all.len() as u32), part);
                if taken.is_ok() && bytes.is_none() {
                    taken = rig.end(sub);
                }
            }
            Action::Cancel => rig.cancel(self.sub),
            Action::Store(id) => drop(rig.node.store(NodeId::new(id), Some(BitRate::K250))),
            Action::Run(steps) => rig.steps(steps),
            Action::Settle => rig.settle(),
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
        }
        taken.is_ok()
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

    fn act(&mut self, action: &Action) -> bool {
        let answer = caught(|| self.perform(action));
        answer.unwrap_or_else(|cause| {
            if !cause.is::<PowerCut>() {
                std::panic::resume_unwind(cause);
            }
            self.power_off();
            false
        })
    }

    fn look(&mut self) -> Seen {
        let setup = self.rig.setup;
        let progress = Progress::from_bytes(self.rig.word(0x2007, 9).to_le_bytes());
        self.rig.chip.model().touched.clear();
        let mut flash = self.rig.chip.model().clone();
        flash.power_on();
        let (layout, host) = (setup.layout, setup.host());
        let journal = Journal::open(&flash, layout.parameters);
        let record = RenewalRecord::load(&journal, &flash);
        let programs = (1..=setup.programs()).map(|number| {
            let Some(record) = ProgramRecord::load(&journal, &flash, number) else { return Stored::None };
            let region = setup.region(number);
            let place = Region::new(region.base, record.size.min(region.size));
            let is_true = crc32(flash.cells(place)) == record.crc && flash.is_stable(place);
            if is_true {
                Stored::Good(record.crc)
            } else {
                Stored::Damaged
            }
        });
        let staged = check(&flash, PLACES.staging, layout, host);
        Seen {
            starts: self.starts,
            origin: progress.expect("known numbers").origin,
            loads: loads(&flash, layout, host, None).map(|(header, ..)| header.crc),
            home: load(&flash, PLACES.home, host).ok().map(|header| header.crc),
            record,
            is_staged: record.is_some_and(|record| staged.is_ok_and(|image| image.crc == record.crc)),
            programs: programs.collect(),
            is_certain: layout.parameters.iter().all(|region| flash.is_stable(*region)),
        }
    }
}
