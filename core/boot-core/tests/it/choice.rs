//! The choice of the boot stage: a table of all that it may find, against rules that say what a
//! device never does, and what it always does.

use std::task::Poll;

use boot_core::canopen::BitRate;
use boot_core::crc32;
use boot_core::decision::{choose, Autostart, Choice, Exit, Images, Policy, Start, Stay, Store, Woken};
use boot_core::flash::{Flash, FlashFault, Next, Operation};
use boot_core::store::{Key, Parameters, ProgramRecord, RenewalRecord, StoreError, Value};
use kit::renewal::{words, HOME, SOUND, STAGING, TWO};
use shared_abi::boot_report::Reason;
use shared_abi::geometry::{Region, Sector};
use shared_abi::handoff::ResetCause::{self, *};
use shared_abi::ram_image::Header;
use shared_abi::renewal::{of_word, Origin, State, TrialEnd, BOOTLOADER};
use shared_abi::warm_start::{Damage, WarmStart};

/// What there is of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Program {
    Absent,
    Unreleased,
    Released,
    Confirmed,
    OtherContents,
    TooLong,
    NoVectors,
}
use Program::*;

/// The image at home, as its header says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum AtHome {
    /// The one that ran when the other one was staged.
    Old,
    /// The one in staging.
    New,
    /// A debug probe has written it.
    Foreign,
}
use AtHome::*;

/// What there is of the bootloader.
#[derive(Clone, Copy, Debug)]
struct Bootloader {
    record: Option<State>,
    /// The image of the record is in staging.
    staged: bool,
    at_home: AtHome,
    home_loads: bool,
    staging_loads: bool,
}

/// A row of the table.
#[derive(Clone, Copy, Debug)]
struct Row {
    cause: ResetCause,
    /// Number and argument in the warm-start cell.
    cell: (u32, u32),
    strap: bool,
    crashes: u32,
    ended: Option<Origin>,
    stored: bool,
    programs: [Program; 2],
    bootloader: Bootloader,
}

const CAUSES: [ResetCause; 9] =
    [PowerOn, BrownOut, Standby, Pin, Software, IndependentWatchdog, WindowWatchdog, LowPower, Unknown];
/// docs/protocol.md: none, the mark, each request; 15, 17: none for this version. 0x0505: node-ID
/// 5, 25 kbit/s.
const CELLS: [(u32, u32); 25] = [
    (0, 0),
    (0, 1),
    (1, 0),
    (2, 1),
    (2, 2),
    (3, 1),
    (3, 2),
    (3, 3),
    (4, 0),
    (5, 0),
    (6, 1),
    (6, 2),
    (7, 0x01_0001),
    (8, 3),
    (9, 1),
    (10, 1),
    (11, 1),
    (12, 0x0505),
    (13, 1),
    (13, 2),
    (13, 3),
    (14, 0),
    (15, 1),
    (16, 0),
    (17, 0),
];
const CRC_OF_NEW: u32 = 0x1234_0001;
const CRC_OF_OLD: u32 = 0x1234_0002;

/// The products, and whether their store is nearly full.
fn products() -> Vec<(Policy, bool)> {
    let plain = Policy { renewal: true, ..Policy::plain(&TWO, &[1, 2]) };
    vec![
        (plain.clone(), false),
        (Policy { autostart: Autostart::List(&[2, 1]), two_resets: true, ..plain.clone() }, true),
        (Policy { autostart: Autostart::List(&[]), max_crash_resets: 1, ..plain.clone() }, false),
        (Policy { pin_resets_are_crashes: true, ..plain.clone() }, false),
        (
            Policy {
                autostart: Autostart::Function(|| &[7, 2]),
                two_resets: true,
                sealed: true,
                ..plain.clone()
            },
            false,
        ),
        (Policy { rescue_window_ms: 300, two_resets: true, sealed: true, ..plain.clone() }, true),
        (
            Policy { rescue_window_ms: 300, rescue_window_confirmed_ms: 20, renewal: false, ..plain.clone() },
            false,
        ),
        (Policy { node_ids: 6..=127, ..plain.clone() }, false),
        (Policy { start_allowed: |number| number != 1, ..plain.clone() }, false),
        // Program 2 is data.
        (Policy { programs: &[1], renewal: false, ..plain }, true),
    ]
}

// --- the device

/// The bytes of a program: vectors and more.
fn contents(region: Region, program: Program) -> Vec<u8> {
    let reset = if program == NoVectors { 0 } else { region.base + TWO.chip.vector_table_size() + 1 };
    let mut bytes = [TWO.ram.end(), reset].map(u32::to_le_bytes).concat();
    bytes.resize(64, 0xA5);
    bytes
}

/// Its flash, and its store.
struct Device {
    flash: Vec<(Region, Vec<u8>)>,
    values: Vec<(Key, Value)>,
    is_nearly_full: bool,
}

impl Device {
    fn of(programs: [Program; 2], bootloader: Bootloader) -> Self {
        let mut flash = Vec::new();
        let mut values = vec![(Key::CRASH_COUNT, [0; 4])];
        for ((number, region), program) in (1..).zip(TWO.programs).zip(programs) {
            let bytes = contents(*region, program);
            let size = if program == TooLong { region.size + 1 } else { 64 };
            let crc = if program == OtherContents { 0 } else { crc32(&bytes) };
            let (signed, confirmed) = (program != Unreleased, program == Confirmed);
            let record = ProgramRecord { signed, confirmed, ..ProgramRecord::released(size, crc) };
            flash.push((Region::new(region.base, 64), bytes));
            if program != Absent {
                values.push((Key::program(number), record.value()));
            }
        }
        let Bootloader { record, staged, at_home, .. } = bootloader;
        let home = match at_home {
            Old => CRC_OF_OLD,
            New => CRC_OF_NEW,
            Foreign => 3,
        };
        let staging = if staged { CRC_OF_NEW } else { 4 };
        for (place, crc) in [(HOME, home), (STAGING, staging)] {
            let header = words(&Header { crc, size: 64, ..SOUND });
            flash.push((Region::new(place.base, Header::SIZE), header));
        }
        if let Some(state) = record {
            let record = RenewalRecord { state, size: Header::SIZE + 64, crc: CRC_OF_NEW, home: CRC_OF_OLD };
            values.push((Key::program(BOOTLOADER), record.value()));
        }
        Self { flash, values, is_nearly_full: false }
    }
}

impl Flash for Device {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        buffer.fill(0xFF);
        for (region, bytes) in &self.flash {
            if region.contains(address, buffer.len() as u32) {
                let at = (address - region.base) as usize;
                buffer.copy_from_slice(&bytes[at..at + buffer.len()]);
            }
        }
    }

    fn is_blank(&self, _: Region) -> bool {
        true
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        TWO.chip.sector_at(address)
    }

    fn start(&mut self, _: Operation) -> Result<(), FlashFault> {
        unreachable!("nothing changes by a choice")
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        Poll::Ready(Ok(()))
    }
}

impl Parameters for Device {
    fn get<F: Flash>(&self, _: &F, key: Key) -> Option<Value> {
        self.values.iter().find(|(known, _)| *known == key).map(|(_, value)| *value)
    }

    fn is_nearly_full(&self) -> bool {
        self.is_nearly_full
    }

    fn store(&mut self, _: Key, _: Value) {
        unreachable!("nothing changes by a choice")
    }

    fn next<F: Flash>(&mut self, _: &F, _: Result<(), FlashFault>) -> Next<StoreError> {
        unreachable!("nothing changes by a choice")
    }
}

impl Row {
    fn choose(&self, device: &Device, policy: &Policy) -> Choice<()> {
        let Bootloader { home_loads, staging_loads, .. } = self.bootloader;
        let cell = WarmStart::encode(self.cell.0, self.cell.1);
        let woken = Woken {
            cause: self.cause,
            request: cell.request(),
            is_marked: cell == WarmStart::MARKED,
            strap: self.strap,
            ended: self.ended,
            stored: self.stored,
            ..Woken::power_on(5, BitRate::K125)
        };
        let images = Images {
            home: HOME,
            staging: STAGING,
            check: |place| match place {
                HOME if home_loads => Ok(()),
                HOME => Err(Damage::Crc),
                _ if staging_loads => Ok(()),
                _ => Err(Damage::Board),
            },
        };
        choose(&woken, &images, device, device, policy)
    }
}

// --- the rules

/// What a rule asks about a row.
struct Facts<'a> {
    row: &'a Row,
    policy: &'a Policy,
    is_full: bool,
}

impl Facts<'_> {
    /// The number of the request is one of these.
    fn asks(&self, numbers: &[u32]) -> bool {
        numbers.contains(&self.row.cell.0)
    }

    /// There is no request in the cell that this version knows.
    fn asks_nothing(&self) -> bool {
        self.asks(&[0, 15, 17])
    }

    /// The program that the request names.
    fn named(&self) -> Option<u8> {
        self.asks(&[2, 3, 6, 9, 10]).then_some(self.row.cell.1 as u8)
    }

    fn program(&self, number: u8) -> Program {
        if self.policy.programs.contains(&number) {
            self.row.programs[usize::from(number) - 1]
        } else {
            Absent
        }
    }

    /// The program may be started, and was released.
    fn is_free(&self, number: u8) -> bool {
        self.policy.node_ids.contains(&5)
            && (self.policy.start_allowed)(number)
            && matches!(self.program(number), Released | Confirmed)
    }

    /// As before, or it was asked for without a release.
    fn may_start(&self, number: u8) -> bool {
        let policy = Policy { start_allowed: self.policy.start_allowed, ..self.policy.clone() };
        let is_tried =
            self.asks(&[2, 9]) && self.named() == Some(number) && self.program(number) == Unreleased;
        self.is_free(number) || is_tried && policy.node_ids.contains(&5) && (policy.start_allowed)(number)
    }

    fn autostart(&self) -> &'static [u8] {
        match self.policy.autostart {
            Autostart::InOrder => self.policy.programs,
            Autostart::List(list) => list,
            Autostart::Function(list) => list(),
        }
    }

    /// The program whose turn it is.
    fn next(&self) -> Option<u8> {
        match self.named() {
            Some(number) => Some(number).filter(|number| self.may_start(*number)),
            None => self.autostart().iter().copied().find(|number| self.is_free(*number)),
        }
    }

    /// A trial of a RAM image has ended by a reset that nobody asked for.
    fn trial_broke_off(&self) -> bool {
        self.policy.renewal
            && self.row.ended == Some(Origin::Trial)
            && self.row.bootloader.record == Some(State::Staged)
            && !matches!(self.row.cell, (13, 2 | 3))
    }

    /// The reset has ended the RAM image: no program ran.
    fn bootloader_ran(&self) -> bool {
        self.policy.renewal && self.row.ended.is_some()
    }

    /// Somebody wants the bootloader, whatever programs there are.
    fn wants_bootloader(&self) -> bool {
        self.asks(&[1, 4, 7, 13]) || self.row.strap || self.trial_broke_off() && self.asks_nothing()
    }

    /// The count of crashes from now on.
    fn crashes(&self) -> u32 {
        let Row { crashes, cause, .. } = *self.row;
        let is_crash = matches!(cause, Software | IndependentWatchdog | WindowWatchdog | LowPower)
            || cause == Pin && self.policy.pin_resets_are_crashes;
        match self.asks_nothing() {
            // What the bootloader itself has left.
            false if self.asks(&[4, 6, 8, 13]) => crashes,
            false => 0,
            true if self.bootloader_ran() => crashes,
            true if is_crash => {
                if crashes < 255 {
                    crashes + 1
                } else {
                    255
                }
            }
            true if crashes < self.policy.max_crash_resets => 0,
            true => crashes,
        }
    }

    fn is_crash_loop(&self) -> bool {
        self.named().is_none() && self.crashes() >= self.policy.max_crash_resets
    }

    fn pin_resets(&self) -> u32 {
        match self.row.cell {
            (0, 1) if self.policy.two_resets && self.row.cause == Pin => 2,
            _ if self.asks_nothing() && self.policy.two_resets && self.row.cause == Pin => 1,
            _ => 0,
        }
    }

    /// The rescue window of a program, in ms.
    fn window(&self, number: u8) -> u16 {
        match self.program(number) {
            Confirmed if self.asks_nothing() => self.policy.rescue_window_confirmed_ms,
            _ if self.asks_nothing() || self.asks(&[16]) => self.policy.rescue_window_ms,
            _ => 0,
        }
    }

    /// The store is compacted before this start.
    fn is_compacted(&self) -> bool {
        self.is_full && !self.asks(&[2, 3, 6, 9])
    }

    /// A program would start by this reset, now or after a while.
    fn starts(&self) -> Option<u8> {
        self.next().filter(|_| !self.wants_bootloader() && !self.is_crash_loop())
    }

    /// Staging has the image of its record.
    fn staging(&self, states: &[State]) -> bool {
        let Bootloader { record, staged, .. } = self.row.bootloader;
        self.policy.renewal && staged && record.is_some_and(|state| states.contains(&state))
    }

    /// A place whose image may run.
    fn any_image(&self) -> bool {
        let Bootloader { home_loads, staging_loads, .. } = self.row.bootloader;
        let may_be_staged = self.staging(&[State::Confirmed, State::Installed]) || self.tries();
        home_loads || staging_loads && may_be_staged
    }

    fn tries(&self) -> bool {
        self.row.cell == (13, 1) && self.staging(&[State::Staged])
    }

    /// How the last trial of an image ended.
    fn trial_end(&self) -> TrialEnd {
        match self.row.cell {
            _ if !self.policy.renewal => TrialEnd::None,
            (13, 2) => TrialEnd::Late,
            (13, 3) => TrialEnd::GivenUp,
            (13, 1) if self.tries() && !self.row.bootloader.staging_loads => TrialEnd::Damaged(Damage::Board),
            _ if self.trial_broke_off() => TrialEnd::Reset(self.row.cause),
            _ => TrialEnd::None,
        }
    }
}

/// Notes each rule that is broken: what must hold if a condition does.
macro_rules! rules {
    ($broken:ident: $($text:literal if $condition:expr => $holds:expr;)*) => {
        $(if $condition && !$holds {
            $broken.push($text);
        })*
    };
}

/// Each rule that the choice breaks.
fn broken(facts: &Facts, choice: &Choice<()>) -> Vec<&'static str> {
    let mut broken = Vec::new();
    let Choice { store, waits, damage, exit } = *choice;
    let Row { stored, crashes, .. } = *facts.row;

    let asked = facts.policy.sealed && facts.asks(&[10, 11, 12]) && !stored;
    let first = Choice { store: Some(Store::Asked), waits: false, damage: None, exit: Exit::Choose };
    rules! { broken:
        "what a sealed program asked for is stored before anything else is decided"
            if asked => *choice == first;
    }
    if asked {
        return broken;
    }
    let crashes = (facts.crashes() != crashes).then_some(Store::CrashCount(facts.crashes()));
    let can_stay = facts.any_image();
    let starts = if let Exit::Program(Start { number, .. }) = exit { Some(number) } else { None };
    let is_held = facts.starts().is_some_and(|number| facts.window(number) > 0 || facts.is_compacted());
    let order = facts.autostart().iter().chain(facts.policy.programs);
    let any = order.copied().find(|number| facts.is_free(*number));
    rules! { broken:
        "the choice is made"
            if true => exit != Exit::Choose;
        "a count is stored if it changes"
            if true => store == crashes;
        "only a start after the first of two resets waits"
            if true => waits == (facts.pin_resets() == 1 && facts.starts().is_some());
        "damage is left in the cell if no image loads, and for no other reason"
            if damage.is_some() => !can_stay && damage == Some(Damage::Crc);
        "no program starts that is not whole, released or asked for once, and allowed"
            if starts.is_some() => starts.is_some_and(|number| facts.may_start(number));
        "a device with an image that loads never starts a program when the bootloader is wanted"
            if can_stay && facts.wants_bootloader() => starts.is_none();
        "a device with an image that loads never starts a program after a crash loop"
            if can_stay && facts.is_crash_loop() => starts.is_none();
        "a device with an image that loads never starts a program after two resets"
            if can_stay && facts.pin_resets() == 2 => starts.is_none();
        "a device with an image that loads never starts a program whose turn it is not"
            if can_stay && starts.is_some() => starts == facts.next();
        "a device with an image that loads never starts a program that is held back"
            if can_stay && is_held => starts.is_none();
        "a device with an image that loads never resets again and again"
            if can_stay => exit != Exit::Again;
        "a program whose turn it is starts"
            if facts.starts().is_some() && !is_held && facts.pin_resets() < 2 =>
                starts == facts.starts() && damage.is_none();
        "without any image a released program starts, the preferred one first"
            if damage.is_some() => starts == any && (any.is_some() || exit == Exit::Again);
        "a device resets again and again only without an image and a program"
            if exit == Exit::Again => !can_stay && any.is_none() && damage.is_some();
    }
    if let Exit::Program(Start { number, trial, .. }) = exit {
        rules! { broken:
            "a trial is the start of a program that is not released"
                if true => trial == (facts.program(number) == Unreleased);
        }
    }
    if let Exit::Bootloader { stay, .. } = exit {
        broken.extend(broken_entry(facts, exit));
        broken.extend(broken_stay(facts, stay));
    }
    broken
}

/// Each rule that the entry into an image of the bootloader breaks.
fn broken_entry(facts: &Facts, exit: Exit<()>) -> Vec<&'static str> {
    let mut broken = Vec::new();
    let Exit::Bootloader { place, origin, crash_resets, renewal, .. } = exit else { return broken };
    let Bootloader { home_loads, staging_loads, at_home, .. } = facts.row.bootloader;
    let is_confirmed = facts.staging(&[State::Confirmed]);
    rules! { broken:
        "an image that does not load is never entered"
            if true => if place == HOME { home_loads } else { staging_loads && place == STAGING };
        "the origin is that of the place"
            if true => (place == HOME) == (origin == Origin::Home);
        "what is on trial runs once, by a request"
            if origin == Origin::Trial => facts.tries();
        "a trial that was asked for is made"
            if facts.tries() && staging_loads => origin == Origin::Trial;
        "only a confirmed image takes the place of home"
            if origin == Origin::Confirmed => is_confirmed && (at_home != Foreign || !home_loads);
        "a confirmed image runs, unless a probe has written home"
            if is_confirmed && staging_loads && !(at_home == Foreign && home_loads) =>
                origin == Origin::Confirmed;
        "the spare runs only if home is damaged"
            if origin == Origin::Spare => facts.staging(&[State::Installed]) && !home_loads;
        "the count that is reported is that of now"
            if true => crash_resets == facts.crashes();
        "the end of a trial is reported, and nothing else"
            if true => of_word(renewal).1 == facts.trial_end();
    }
    broken
}

/// Each rule that the reason to stay breaks.
fn broken_stay(facts: &Facts, stay: Stay) -> Vec<&'static str> {
    let mut broken = Vec::new();
    let Stay { reason, refused, held, window_ms } = stay;
    let ended = facts.trial_broke_off() && (facts.asks_nothing() || facts.asks(&[4]));
    let asked = facts.asks(&[1, 4, 7, 13]) || ended;
    let is_free = !facts.wants_bootloader() && !ended;
    let waiting = facts.starts().filter(|_| facts.pin_resets() < 2);

    // Why a program does not start.
    let is_refused = is_free && !facts.is_crash_loop() && facts.starts().is_none();
    let tried: Vec<u8> = facts.named().map_or(facts.autostart().to_vec(), |number| vec![number]);
    let there =
        tried.iter().copied().find(|number| facts.program(*number) != Absent).or(tried.first().copied());
    let (why, is_broken) = match there.map(|number| facts.program(number)) {
        None => (Reason::NoAutostart, false),
        _ if !facts.policy.node_ids.contains(&5) => (Reason::NodeId, false),
        Some(Absent) => (Reason::NoProgram, false),
        Some(OtherContents | TooLong) => (Reason::Damaged, true),
        Some(NoVectors) => (Reason::Vectors, true),
        Some(Unreleased) if !facts.asks(&[2, 9]) => (Reason::Unsigned, false),
        Some(Unreleased | Released | Confirmed) => (Reason::Forbidden, false),
    };
    let named = there.filter(|_| is_refused && (facts.asks(&[2, 3, 9]) || is_broken)).unwrap_or(0);
    rules! { broken:
        "who asks for the bootloader is named first"
            if facts.asks(&[1, 7]) => reason == Reason::Requested;
        "a fault is named"
            if facts.asks(&[4]) && !ended => reason == Reason::Fault;
        "a trial, and its end, are named"
            if facts.asks(&[13]) || ended => reason == Reason::Renewal;
        "the strap is named"
            if facts.row.strap && !asked => reason == Reason::Strap;
        "a crash loop is named, and is one"
            if true => (reason == Reason::CrashLoop) == (is_free && facts.is_crash_loop());
        "two resets are named, and keep the device from a start"
            if true => (reason == Reason::TwoResets) == (facts.pin_resets() == 2 && facts.starts().is_some());
        "what is held back is the program whose turn it is"
            if true => held == waiting.unwrap_or(0);
        "the window is that of the program"
            if held > 0 => window_ms == facts.window(held);
        "a window or a compaction holds it back"
            if held > 0 => reason == if window_ms > 0 { Reason::Rescue } else { Reason::Compaction };
        "nothing else holds it back"
            if held > 0 => window_ms > 0 || facts.is_compacted();
        "what is wrong is that of the first program that is there"
            if is_refused => reason == why;
        "1F57h names what a client asked for, or what is damaged, and nothing else"
            if true => refused == named;
    }
    broken
}

// --- the table

/// Every state of home and staging.
fn bootloaders() -> Vec<Bootloader> {
    let mut all = Vec::new();
    for loads in 0..4 {
        let of = |record, staged, at_home| Bootloader {
            record,
            staged,
            at_home,
            home_loads: loads & 1 == 0,
            staging_loads: loads & 2 == 0,
        };
        all.push(of(None, false, Old));
        for state in [State::Staged, State::Confirmed, State::Installed] {
            for at_home in [Old, New, Foreign] {
                all.extend([of(Some(state), true, at_home), of(Some(state), false, at_home)]);
            }
        }
    }
    all
}

/// Plays the rows with these states, and returns their number.
fn play(
    programs: &[[Program; 2]],
    bootloaders: &[Bootloader],
    crashes: &[u32],
    causes: &[ResetCause],
) -> usize {
    let mut rows = 0;
    for (programs, bootloader) in programs.iter().flat_map(|p| bootloaders.iter().map(move |b| (*p, *b))) {
        let mut device = Device::of(programs, bootloader);
        for (policy, is_full) in products() {
            device.is_nearly_full = is_full;
            for (crashes, cause) in
                crashes.iter().flat_map(|count| causes.iter().map(move |cause| (*count, *cause)))
            {
                device.values[0].1 = [crashes, 0, 0, 0];
                for (cell, more) in CELLS.iter().flat_map(|cell| (0..4).map(move |more| (*cell, more))) {
                    let (strap, ended) = (more & 1 != 0, (more & 2 != 0).then_some(Origin::Trial));
                    // Once before what was asked for is stored, and once after that.
                    for stored in [false, true] {
                        let row = Row { cause, cell, strap, crashes, ended, stored, programs, bootloader };
                        let choice = row.choose(&device, &policy);
                        let broken = broken(&Facts { row: &row, policy: &policy, is_full }, &choice);
                        assert!(broken.is_empty(), "{broken:#?}\n{row:?}\n{choice:?}\n{policy:?}");
                        rows += 1;
                        if choice.exit != Exit::Choose {
                            break;
                        }
                    }
                }
            }
        }
    }
    rows
}

/// Each cause, request, strap and count with each program and product, for what matters of home.
#[test]
fn the_boot_stage_keeps_its_rules_with_every_program() {
    let all = [Absent, Unreleased, Released, Confirmed, OtherContents, TooLong, NoVectors];
    let others = [Absent, Unreleased, Released, OtherContents];
    let programs: Vec<_> = all.iter().flat_map(|first| others.map(|second| [*first, second])).collect();
    let some: Vec<_> = bootloaders().into_iter().filter(|b| b.record.is_none() && b.staging_loads).collect();
    let rows = play(&programs, &some, &[0, 2, 3, u32::MAX], &CAUSES);
    assert!(rows > 50_000, "{rows}");
    println!("{rows} rows");
}

/// Each request, strap and state of home and staging, for what matters of the programs.
#[test]
fn the_boot_stage_keeps_its_rules_with_every_image() {
    let programs = [[Released, Released], [Unreleased, OtherContents], [Absent, Absent]];
    let rows = play(&programs, &bootloaders(), &[0, 3], &[PowerOn, Pin, Software]);
    assert!(rows > 50_000, "{rows}");
    println!("{rows} rows");
}
