//! The standing attacker of the bus: two masters that do what masters do, mixed with noise, floods,
//! frames that are nearly right, bus errors and power cuts; in virtual time, by seeds. It goes on
//! where it has brought the device, and checks after each burst:
//!
//! - the device answers: a read of 1000h after an SDO abort, within [`Target::answer_us`];
//! - the programs and the node parameters are as they were, unless a master asked for a change;
//! - no reset that nobody asked for;
//! - the watchdog is fed in time, also if its clock is the fastest;
//! - the record of a program is true: its CRC is that of the flash and of an image that was sent;
//! - LSS answers only what was asked in its state.
//!
//! | module | what it is |
//! |---|---|
//! | [`target`] | what the attacker needs of a device |
//! | [`board`] | the built firmware in the emulator |
//! | [`line`](mod@line) | the same with CAN over its UART |
//! | [`node`] | `coboot-node`: the same code without a chip, for millions of frames |
//! | [`model`] | what the masters asked for, read from the bus |
//! | [`setup`] | the firmware and the images |
//! | `masters` | what the masters send |
//!
//! The attack below the bus is `tests/attack`, with faults of the flash and sealed images.

pub mod board;
pub mod line;
mod masters;
pub mod model;
pub mod node;
pub mod setup;
pub mod target;

use std::collections::VecDeque;
use std::fmt;

use boot_core::store::{Journal, Key, Parameters, ProgramRecord};
use canopen::lss::LssAddress;
use canopen::{CobId, Frame, NodeId};
use embedded_can::{Frame as _, Id};
use shared_abi::geometry::Region;

use attack::device::Action;
pub use attack::play::Broken;
use kit::model::ModelFlash;
use kit::random::Random;
use model::{Ask, Model, Node, ANSWERS, NO_NODE, PARAMETERS};
use setup::{Image, Setup};
use target::{Happened, Target};

/// The longest way back from bus-off (`tests/device/hostile_bus.rs`), in us.
const BUS_OFF_US: u64 = 5_400_000;
/// A device has started, and a rescue window is over, in us.
const START_US: u64 = 700_000;
/// All work on the flash ends within this time, in us: the erase of 1 MiB takes 11 s.
const WORK_US: u64 = 40_000_000;

/// A device with a password, or with keys, waits with a reset until no wrong password or signature delays the
/// next attempt (`core/canopen/src/password.rs`), in us.
const PASSWORD_US: u64 = 33_000_000;

/// The longest time between two feeds of the watchdog, in us: the shortest `watchdog_ms` that a product may
/// have is 250 (docs/product.md), which is 125 counts of LSI / 64 (RM0090 section 21.4.3), and the LSI has
/// 47 kHz at most (datasheet DocID022152).
const FEED_US: u64 = 125 * 64 * 1_000_000 / 47_000;

// The rules, as what must be true; `model` has two of them.
const PROGRAMS: &str = "a program changes if somebody asked for it alone";
const RECORDS: &str = "the record of a program is true";
const RESETS: &str = "a reset comes if somebody asked for it alone";
const WATCHDOG: &str = "the watchdog is fed in time";
const WORKS: &str = "all work ends, and what is touched exists";

/// The counts of an attack.
#[derive(Clone, Copy, Debug, Default)]
pub struct Summary {
    /// Frames of the masters on the bus.
    pub frames: u64,
    /// Frames of the device.
    pub answers: u64,
    /// Frames that were destroyed.
    pub errors: u64,
    /// Bursts, each with a check.
    pub bursts: u64,
    /// Resets that were asked for.
    pub resets: u64,
    /// Power cuts.
    pub cuts: u64,
    /// Programs that were sent completely.
    pub updates: u64,
    /// Checks that found a running application.
    pub running: u64,
    /// Stores of node parameters.
    pub stores: u64,
    /// The slowest answer of a check, without those after bus-off and resets, in us.
    pub slowest_us: u64,
    /// The slowest one after bus-off, in us.
    pub slowest_off_us: u64,
    /// The longest time between two feeds of the watchdog, in us.
    pub unfed_us: u64,
}

impl Summary {
    /// Adds another attack.
    pub fn add(&mut self, other: &Self) {
        self.frames += other.frames;
        self.answers += other.answers;
        self.errors += other.errors;
        self.bursts += other.bursts;
        self.resets += other.resets;
        self.cuts += other.cuts;
        self.updates += other.updates;
        self.running += other.running;
        self.stores += other.stores;
        self.slowest_us = self.slowest_us.max(other.slowest_us);
        self.slowest_off_us = self.slowest_off_us.max(other.slowest_off_us);
        self.unfed_us = self.unfed_us.max(other.unfed_us);
    }
}

/// An attack that found something.
#[derive(Clone, Debug)]
pub struct Found {
    /// The name of the setup.
    pub setup: &'static str,
    /// The seed.
    pub seed: u64,
    /// The burst, counted from 0.
    pub burst: u64,
    /// The broken rule.
    pub broken: Broken,
    /// The last frames and actions.
    pub story: String,
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { setup, seed, burst, broken, story } = self;
        write!(f, "{setup}, seed {seed}, burst {burst}: {broken}\n{story}")
    }
}

/// Attacks a new board of this setup until its masters have sent so many frames.
///
/// # Errors
/// The first broken rule.
pub fn run(setup: &Setup, seed: u64, frames: u64) -> Result<Summary, Box<Found>> {
    let found = |burst, broken, story| Box::new(Found { setup: setup.name, seed, burst, broken, story });
    let attack = Attack::new(setup.target(), setup.clone(), seed);
    let mut attack = attack.map_err(|broken| found(0, broken, String::new()))?;
    while attack.summary.frames < frames {
        attack.burst().map_err(|broken| found(attack.summary.bursts, broken, attack.story()))?;
    }
    Ok(attack.summary)
}

/// An attack on a device.
pub struct Attack {
    target: Box<dyn Target>,
    setup: Setup,
    model: Model,
    random: Random,
    /// Frames of the device that a client has not read yet.
    heard: VecDeque<Frame>,
    /// The identifiers of the frames of each master that may not have been on the bus yet.
    waiting: [Vec<(Id, bool)>; 2],
    /// The flash and the records at the last check.
    flash: Vec<u8>,
    records: Vec<Option<ProgramRecord>>,
    /// The application was running at the last check.
    is_app: bool,
    /// Since the last check: a reset, a power cut, errors on the bus.
    was_reset: bool,
    was_cut: bool,
    was_disturbed: bool,
    /// There were errors, and the device has not answered since: it may be bus-off and hear nothing.
    in_doubt: bool,
    /// A reset that was asked for may come until then.
    leaves_until: u64,
    /// The last frames and actions, for a report.
    reported: VecDeque<String>,
    /// The counts.
    pub summary: Summary,
}

/// So many lines are kept for a report.
const TOLD: usize = 120;

impl Attack {
    /// An attack on a new device.
    ///
    /// # Errors
    /// If the device does not answer.
    pub fn new(mut target: Box<dyn Target>, setup: Setup, seed: u64) -> Result<Self, Broken> {
        let programs = setup.layout.programs.len() as u8;
        let address = LssAddress { vendor_id: 0, product_code: 0, revision: 0, serial_number: 0 };
        let flash = target.flash().to_vec();
        let model = Model::new(programs, setup.fixed, setup.default, address);
        let mut attack = Self {
            target,
            setup,
            model,
            random: Random(seed),
            heard: VecDeque::new(),
            waiting: Default::default(),
            flash,
            records: vec![None; usize::from(programs)],
            is_app: false,
            was_reset: true,
            was_cut: false,
            was_disturbed: false,
            in_doubt: false,
            leaves_until: 0,
            reported: VecDeque::new(),
            summary: Summary::default(),
        };
        attack.pass(100_000)?;
        let mut address = [0; 4];
        for (sub, part) in (1..).zip(&mut address) {
            let answer = attack.ask([0x40, 0x18, 0x10, sub, 0, 0, 0, 0], attack.target.answer_us())?;
            let Some([0x43, _, _, _, a, b, c, d]) = answer else {
                return Err(Broken(ANSWERS, format!("1018h/{sub}: {answer:02X?}")));
            };
            *part = u32::from_le_bytes([a, b, c, d]);
        }
        let [vendor_id, product_code, revision, serial_number] = address;
        let address = LssAddress { vendor_id, product_code, revision, serial_number };
        attack.model = Model::new(programs, attack.setup.fixed, attack.setup.default, address);
        attack.check()?;
        Ok(attack)
    }

    /// A burst and its check.
    ///
    /// # Errors
    /// The broken rule.
    pub fn burst(&mut self) -> Result<(), Broken> {
        self.attack()?;
        self.check()?;
        self.summary.bursts += 1;
        Ok(())
    }

    /// The last frames and actions.
    #[must_use]
    pub fn story(&self) -> String {
        self.reported.iter().map(|line| format!("  {line}\n")).collect()
    }

    fn tell(&mut self, line: String) {
        if self.reported.len() == TOLD {
            self.reported.pop_front();
        }
        self.reported.push_back(line);
    }

    // --- the bus

    /// Sends a frame, by this master; by the other one if that has a frame with the same identifier
    /// waiting: the two would collide for ever.
    fn send(&mut self, master: usize, frame: &Frame) {
        let other = 1 - master;
        let id = (frame.id(), frame.is_remote_frame());
        let master = if self.waiting[other].contains(&id) { other } else { master };
        if !self.waiting[master].contains(&id) {
            self.waiting[master].push(id);
        }
        self.target.send(master, frame);
    }

    /// Time passes, and the model follows the bus.
    fn pass(&mut self, us: u64) -> Result<(), Broken> {
        self.target.pass_us(us);
        for (at, happened) in self.target.events() {
            match happened {
                Happened::Frame { by_device, frame } => {
                    let ms = at as f64 / 1000.0;
                    self.tell(format!("{ms:>12.3} {} {frame}", if by_device { "<-" } else { "->" }));
                    if by_device {
                        self.summary.answers += 1;
                        self.follow(&frame)?;
                    } else {
                        self.summary.frames += 1;
                        self.model.sent(&frame, at);
                    }
                }
                Happened::Missed(frame) => {
                    self.tell(format!("{:>12.3} ~> {frame}", at as f64 / 1000.0));
                    self.summary.frames += 1;
                }
                Happened::Error => {
                    self.summary.errors += 1;
                    self.in_doubt = true;
                }
                Happened::Reset => {
                    self.tell(format!("{:>12.3} reset", at as f64 / 1000.0));
                    self.reset_was_asked()?;
                    self.leaves_until = 0;
                    self.summary.resets += 1;
                    self.was_reset = true;
                    self.restarted()?;
                }
                Happened::Trouble if self.is_app && self.may_leave() => {
                    // One of the application's ways back is the watchdog.
                    self.was_reset = true;
                    self.restarted()?;
                }
                Happened::Trouble => {
                    return Err(Broken(RESETS, "by the watchdog, or the CPU has locked up".into()));
                }
                Happened::PowerCut => {
                    self.tell(format!("{:>12.3} the power fails", at as f64 / 1000.0));
                    self.was_cut = true;
                }
            }
        }
        if self.was_cut {
            self.was_cut = false;
            self.was_reset = true;
            self.summary.cuts += 1;
            self.target.act(&Action::PowerOff);
            self.target.events();
            self.restarted()?;
        }
        Ok(())
    }

    /// A frame of the device.
    fn follow(&mut self, frame: &Frame) -> Result<(), Broken> {
        if let (Some(id @ 0x701..=0x77F), [0]) = (frame.cob_id().map(CobId::get), frame.data()) {
            let id = (id - 0x700) as u8;
            let allowed = self.setup.fixed == Some(id) || self.model.may_be(id);
            if !allowed {
                return Err(Broken(PARAMETERS, format!("boot-up with node-ID {id}")));
            }
            self.model.booted(id);
        }
        let stored = self.model.stored();
        self.model.answered(frame)?;
        self.summary.stores += u64::from(self.model.stored() != stored);
        if frame.exactly::<8>().is_some() {
            self.heard.push_back(*frame);
        }
        Ok(())
    }

    /// The device has started again: what it knows is what it has stored.
    fn restarted(&mut self) -> Result<(), Broken> {
        if self.model.is_storing() {
            let found = self.stored();
            self.model.stored_is(found)?;
        }
        self.model.restarted();
        self.target.set_bit_rate(self.model.bit_rate());
        Ok(())
    }

    /// Until all frames of the masters were on the bus, and their effect has come.
    fn drain(&mut self) -> Result<(), Broken> {
        for _ in 0..60_000 {
            if self.target.is_drained() {
                self.waiting = Default::default();
                return self.pass(1000);
            }
            self.pass(1000)?;
        }
        Err(Broken(WORKS, "the masters cannot send".into()))
    }

    /// Waits until the device answers, if there were errors: what it does not hear, it cannot obey, and
    /// the model would not know.
    fn clear_doubt(&mut self) -> Result<(), Broken> {
        self.drain()?;
        if !self.in_doubt {
            return Ok(());
        }
        self.was_disturbed = true;
        let from = self.target.now_us();
        let until = from + BUS_OFF_US;
        while self.target.now_us() < until {
            self.in_doubt = false;
            let is_named = self.model.id().is_some();
            if is_named
                && self.ask([0x40, 0x00, 0x10, 0, 0, 0, 0, 0], self.target.answer_us())?.is_some()
                && !self.in_doubt
            {
                let took = self.target.now_us() - from;
                self.summary.slowest_off_us = self.summary.slowest_off_us.max(took);
                return Ok(());
            }
            self.pass(20_000)?;
        }
        self.in_doubt = false;
        Ok(())
    }

    fn node(&self) -> NodeId {
        self.model.id().and_then(NodeId::new).unwrap_or(NodeId::MAX)
    }

    fn sdo(&self, bytes: [u8; 8]) -> Frame {
        Frame::full(CobId::sdo_request(self.node()), bytes)
    }

    /// A request to the device's own server, and the answer.
    fn ask(&mut self, bytes: [u8; 8], within_us: u64) -> Result<Option<[u8; 8]>, Broken> {
        self.drain()?;
        self.heard.clear();
        let frame = self.sdo(bytes);
        self.send(0, &frame);
        let until = self.target.now_us() + within_us;
        while self.target.now_us() < until {
            let response = CobId::sdo_response(self.node());
            if let Some(answer) = self.heard.iter().find(|frame| frame.has_cob_id(response)) {
                return Ok(answer.exactly().copied());
            }
            self.pass(500)?;
        }
        Ok(None)
    }

    /// A request of LSS, and the answer if one is due.
    fn lss(&mut self, bytes: [u8; 8], within_us: u64) -> Result<Option<[u8; 8]>, Broken> {
        self.clear_doubt()?;
        self.heard.clear();
        self.send(0, &Frame::full(CobId::LSS_REQUEST, bytes));
        self.drain()?;
        let until = self.target.now_us() + within_us;
        loop {
            if let Some(answer) = self.heard.iter().find(|frame| frame.has_cob_id(CobId::LSS_RESPONSE)) {
                return Ok(answer.exactly().copied());
            }
            if self.target.now_us() >= until {
                return Ok(None);
            }
            self.pass(500)?;
        }
    }

    // --- the rules

    /// Whether a master asked for something that ends in a reset.
    fn may_leave(&self) -> bool {
        let programs = 1..=self.setup.layout.programs.len() as u8;
        let asked = |ask: Ask, program: u8| match ask {
            Ask::AnyControl => true,
            // The application leaves for each of them; the bootloader starts a program that it has.
            Ask::Control(value) if self.is_app => matches!(value, 0 | 1 | 2 | 3 | 0x80),
            // 2 starts a program that was sent in one transfer, and any program in some dialects.
            Ask::Control(1 | 2) => self.may_have(program),
            Ask::Control(_) => false,
            Ask::Download => self.setup.starts_by_itself,
            Ask::Password => false,
        };
        self.model.node_reset()
            || programs.into_iter().any(|at| self.model.asked(at).any(|ask| asked(ask, at)))
    }

    /// Whether there may be a program since the last check.
    fn may_have(&self, program: u8) -> bool {
        self.records[usize::from(program) - 1].is_some()
            || self.model.asked(program).any(|ask| ask == Ask::Download)
    }

    fn reset_was_asked(&self) -> Result<(), Broken> {
        let programs = 1..=self.setup.layout.programs.len() as u8;
        // After a restart, the end of a rescue window is a reset.
        let window = self.was_reset && programs.into_iter().any(|program| self.may_have(program));
        if self.may_leave() || window || self.target.now_us() < self.leaves_until {
            return Ok(());
        }
        Err(Broken(RESETS, "nobody asked for it".into()))
    }

    /// The contents of the flash, to read the journal from.
    fn view(&mut self) -> ModelFlash {
        let chip = self.setup.layout.chip;
        let mut flash = ModelFlash::new(chip);
        flash.poke(chip.flash.base, self.target.flash());
        flash
    }

    /// The stored node parameters.
    fn stored(&mut self) -> Option<Node> {
        let layout = self.setup.layout;
        let view = self.view();
        let [id, rate, ..] = Journal::open(&view, layout.parameters).get(&view, Key::NODE)?;
        Some((id as u8, rate as u8))
    }

    /// The checks after a burst.
    fn check(&mut self) -> Result<(), Broken> {
        self.target.act(&Action::Disturb(0));
        self.clear_doubt()?;
        if self.was_reset {
            self.pass(START_US)?;
        }
        while self.target.now_us() < self.model.silent_until() {
            self.pass(1000)?;
        }
        self.target.set_bit_rate(self.model.bit_rate());
        self.answers()?;
        let resets = self.summary.resets;
        self.work_ends()?;
        if self.summary.resets != resets {
            // A start that was asked for comes after its answer: another program may answer now.
            self.pass(START_US)?;
            self.answers()?;
        }
        self.flash_is_right()?;
        self.summary.unfed_us = self.target.longest_between_feeds_us();
        if self.summary.unfed_us > FEED_US {
            let us = self.summary.unfed_us;
            return Err(Broken(WATCHDOG, format!("fed after {us} us; {FEED_US} is allowed")));
        }
        if let Some(what) = self.target.complaint() {
            return Err(Broken(WORKS, what));
        }
        if self.setup.delays_resets() && self.may_leave() && !self.was_reset {
            self.leaves_until = self.target.now_us() + PASSWORD_US;
        }
        self.model.forget();
        (self.was_reset, self.was_disturbed) = (false, false);
        Ok(())
    }

    /// The device answers a read, and with a node-ID if it had none.
    fn answers(&mut self) -> Result<(), Broken> {
        let begun = self.target.now_us();
        loop {
            self.lss([0x04, 0, 0, 0, 0, 0, 0, 0], 0)?;
            // After bus-off, answers of before come first.
            let may_leave = self.may_leave() || self.target.now_us() < self.leaves_until;
            let patience = match (self.was_disturbed, may_leave || self.was_reset) {
                (true, _) => BUS_OFF_US,
                (false, true) => 3 * START_US,
                (false, false) => 0,
            };
            if self.model.id().is_none() {
                let named = self.name_it()?;
                if !named && self.target.now_us() < begun + patience {
                    self.pass(50_000)?;
                    continue;
                }
            }
            // An application may be in the NMT state STOPPED.
            self.send(0, &Frame::of(CobId::NMT, &[0x80, 0]));
            let abort = self.sdo([0x80, 0, 0, 0, 0, 0, 0, 8]);
            self.send(0, &abort);
            self.drain()?;
            let from = self.target.now_us();
            let answer = self.ask([0x40, 0x00, 0x10, 0, 0, 0, 0, 0], self.target.answer_us())?;
            let now = self.target.now_us();
            match answer {
                Some([0x43, 0x00, 0x10, 0, a, b, c, d]) => {
                    self.is_app = u32::from_le_bytes([a, b, c, d]) != self.setup.device_type;
                    self.summary.running += u64::from(self.is_app);
                    let summary = &mut self.summary;
                    if self.was_disturbed {
                        summary.slowest_off_us = summary.slowest_off_us.max(now - begun);
                    } else {
                        summary.slowest_us = summary.slowest_us.max(now - from);
                    }
                    return Ok(());
                }
                _ if now < begun + patience => self.pass(50_000)?,
                answer => {
                    let ms = patience.max(self.target.answer_us()) / 1000;
                    return Err(Broken(ANSWERS, format!("a read of 1000h: {answer:02X?} within {ms} ms")));
                }
            }
        }
    }

    /// Gives it a node-ID: it has none, and answers LSS. Returns whether it did.
    fn name_it(&mut self) -> Result<bool, Broken> {
        let (id, _) = self.setup.default;
        self.lss([0x04, 1, 0, 0, 0, 0, 0, 0], 0)?;
        let answer = self.lss([0x11, id, 0, 0, 0, 0, 0, 0], self.target.answer_us())?;
        self.lss([0x04, 0, 0, 0, 0, 0, 0, 0], 0)?;
        self.pass(20_000)?;
        Ok(answer == Some([0x11, 0, 0, 0, 0, 0, 0, 0]))
    }

    /// All work on the flash ends, and the resets that follow from it have come.
    fn work_ends(&mut self) -> Result<(), Broken> {
        let until = self.target.now_us() + WORK_US;
        let mut quiet = 0;
        let mut before = self.target.flash_activity();
        while quiet < 20 {
            self.pass(2000)?;
            let now = self.target.flash_activity();
            quiet = if now == before && !now.1 { quiet + 1 } else { 0 };
            before = now;
            if self.target.now_us() > until {
                return Err(Broken(WORKS, "the work on the flash does not end".into()));
            }
        }
        Ok(())
    }

    /// Only what was asked for has changed, and each record is true.
    fn flash_is_right(&mut self) -> Result<(), Broken> {
        let layout = self.setup.layout;
        let now = self.target.flash().to_vec();
        let place = |region: Region| {
            let at = (region.base - layout.chip.flash.base) as usize;
            at..at + region.size as usize
        };
        let view = self.view();
        let journal = Journal::open(&view, layout.parameters);
        let stored = journal.get(&view, Key::NODE).map(|[id, rate, ..]| (id as u8, rate as u8));
        self.model.stored_is(stored)?;
        for own in [Some(layout.bootloader), layout.home, layout.data].into_iter().flatten() {
            if now[place(own)] != self.flash[place(own)] {
                return Err(Broken(PROGRAMS, format!("{:08X}h: the bootloader, or the data", own.base)));
            }
        }
        for (program, region) in (1..).zip(layout.programs) {
            let at = usize::from(program) - 1;
            let was = self.records[at];
            let record = journal.program(&view, program);
            let asked: Vec<Ask> = self.model.asked(program).collect();
            let may_change = asked
                .iter()
                .any(|ask| matches!(ask, Ask::Download | Ask::AnyControl | Ask::Password | Ask::Control(3)));
            let cells = place(*region);
            if !may_change && now[cells.clone()] != self.flash[cells.clone()] {
                return Err(Broken(PROGRAMS, format!("program {program}: its flash has changed")));
            }
            let content = |record: ProgramRecord| (record.size, record.crc);
            if !may_change && record.map(content) != was.map(content) {
                return Err(Broken(PROGRAMS, format!("program {program}: from {was:?} to {record:?}")));
            }
            if asked.is_empty() && !self.is_app && record != was && !self.was_reset {
                return Err(Broken(PROGRAMS, format!("program {program}: from {was:?} to {record:?}")));
            }
            if let Some(record) = record {
                let size = record.size.min(region.size) as usize;
                let crc = crate::sealed::crc32(&now[cells][..size]);
                let images = &self.setup.images;
                let is_data = self.setup.data == Some(program);
                let sent = |image: &Image| image.program == program && image.crcs.contains(&crc);
                // Data may be any bytes.
                let sent = is_data || images.iter().any(sent);
                if crc != record.crc || record.size > region.size || !sent {
                    return Err(Broken(RECORDS, format!("program {program}: {record:X?}, flash {crc:08X}")));
                }
            }
            self.records[at] = record;
        }
        if self.is_app && self.records.iter().all(Option::is_none) {
            return Err(Broken(RECORDS, "an application runs, and no program has a record".into()));
        }
        self.flash = now;
        Ok(())
    }
}

/// Whether a value is a node-ID in LSS.
fn is_node_id(id: u8) -> bool {
    matches!(id, 1..=127 | NO_NODE)
}
