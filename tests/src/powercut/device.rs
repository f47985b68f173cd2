//! A device of `boot-core` and the flash model: power-on, boot stage, bootloader; and the same with
//! a bug in it.

use core::task::Poll;

use boot_core::bootloader::{Bootloader, Config};
use boot_core::canopen::lss::LssDevice;
use boot_core::canopen::od::{Address, Objects};
use boot_core::canopen::{AbortCode, BitRate, NodeId};
use boot_core::control::{Policy, SealedMemory, Step};
use boot_core::crc32;
use boot_core::decision::{self, choose, Autostart, Exit, Images, Start, Woken};
use boot_core::flash::{run, Flash, FlashFault, Next, Operation};
use boot_core::profile::Profile;
use boot_core::store::{Journal, Key, NodeParameters, Parameters, ProgramRecord, StoreError, Value};
use shared_abi::geometry::{Region, Sector};
use shared_abi::layout::Layout;
use shared_abi::warm_start::BootRequest;

use kit::boot::Boot;
use kit::model::{ModelFlash, CHIP, TWO_PROGRAMS};
use kit::rig::{go_on, AT_ONCE_2, ESACADEMY_2, LIFT_2, STANDARD_2};
pub use kit::rig::{PRODUCT_CODE, VENDOR_ID};

/// Seed of the program before an update.
pub const OLD: u8 = 0xA3;
/// Seed of the new program.
pub const NEW: u8 = 0xB7;

/// Two programs; setups with one program use the first.
pub static LAYOUT: Layout = TWO_PROGRAMS;

const PROGRAMS: usize = 2;
/// 6005h/1.
const LIFT_PASSWORD: Address = Address::new(0x6005, 1);

/// A lift: program 2 is a set of parameters, and a download replaces what is there.
static LIFT: Config = Config {
    download: Policy { data: Some(2), replaces: true, read_back: true, ..STANDARD_2.config.download },
    ..STANDARD_2.config
};
/// A lift that requires its password.
static LOCKED_LIFT: Config = Config {
    entries: LIFT_2.config.entries,
    download: Policy { locked: true, ..LIFT.download },
    password: Profile::LIFT.password,
    ..STANDARD_2.config
};

/// The exit of the boot stage in these tests: program 1 starts by itself, there is no rescue
/// window, and the bootloader is whole.
pub fn exit(
    flash: &impl Flash,
    parameters: &impl Parameters,
    layout: &'static Layout,
    request: Option<BootRequest>,
) -> Exit<()> {
    let policy =
        decision::Policy { autostart: Autostart::List(&[1]), ..decision::Policy::plain(layout, &[1, 2]) };
    let node = NodeParameters::load(parameters, flash, BOARD_NODE, |_| true);
    let woken = Woken { request, ..Woken::power_on(node.id_or_none(), node.bit_rate) };
    choose(&woken, &Images::SOUND, flash, parameters, &policy).exit
}

/// Node-ID and bit rate of a device without stored values.
pub const BOARD_NODE: NodeParameters = NodeParameters { id: NodeId::new(1), bit_rate: BitRate::K125 };

/// A possible bug, which the proof must detect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bug {
    /// The record of the new program is stored and released before its data are complete.
    SignatureBeforeData,
    /// The sectors are erased while the record is still valid.
    EraseBeforeInvalidating,
    /// The program is erased before the target of the new one is known.
    EraseBeforeCheck,
    /// Records carry no CRC.
    JournalWithoutCrc,
    /// A full journal is erased first and then written again.
    CompactionInPlace,
    /// A sector whose first bytes are blank is taken for erased.
    BlankAtFirstSight,
    /// Half erased sectors are not recorded.
    TouchedForgotten,
}

impl Bug {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::SignatureBeforeData,
        Self::EraseBeforeInvalidating,
        Self::EraseBeforeCheck,
        Self::JournalWithoutCrc,
        Self::CompactionInPlace,
        Self::BlankAtFirstSight,
        Self::TouchedForgotten,
    ];
}

/// The state of the device after power-on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Outcome {
    /// The bootloader answers.
    Bootloader,
    /// This program runs, byte for byte; identified by its seed.
    Runs(u8),
}

/// A device with its flash. Everything else is lost with the power.
#[derive(Clone)]
pub struct Device {
    /// Its flash.
    pub flash: ModelFlash,
    bug: Option<Bug>,
}

impl Device {
    /// A device with empty flash.
    pub fn new(bug: Option<Bug>) -> Self {
        Self { flash: ModelFlash::new(&CHIP), bug }
    }

    fn parameters(&self) -> Store {
        Store::open(&self.flash, self.bug)
    }

    /// The decision of the boot stage with this flash, without any effect.
    ///
    /// # Errors
    /// If a program would run that is not one of the tests' complete programs.
    pub fn decision(&self) -> Result<Outcome, String> {
        match exit(&self.flash, &self.parameters(), &LAYOUT, None) {
            Exit::Bootloader { .. } | Exit::Again | Exit::Choose => Ok(Outcome::Bootloader),
            Exit::Program(Start { number, .. }) => {
                let region = LAYOUT.programs[usize::from(number) - 1];
                let cells = self.flash.cells(region);
                let seed = cells[8];
                let whole = image(number, seed);
                if cells[..whole.len()] == whole[..] {
                    Ok(Outcome::Runs(seed))
                } else {
                    Err(format!("program {number} would be started, and is not whole"))
                }
            }
        }
    }

    /// Checks that each program with a record matches its record: there must be no record for a
    /// program that is not there.
    ///
    /// # Errors
    /// The program that does not match.
    pub fn records_are_true(&self) -> Result<(), String> {
        let parameters = self.parameters();
        for (number, region) in (1..).zip(LAYOUT.programs) {
            let Some(record) = ProgramRecord::load(&parameters, &self.flash, number) else { continue };
            let program = Region::new(region.base, record.size.min(region.size));
            if crc32(self.flash.cells(program)) != record.crc || !self.flash.is_stable(program) {
                return Err(format!("program {number} has a record, and is not what it says"));
            }
        }
        Ok(())
    }

    /// Program `number` according to its record: its seed, and whether it is released.
    pub fn installed(&self, number: u8) -> Option<(u8, bool)> {
        let record = ProgramRecord::load(&self.parameters(), &self.flash, number)?;
        Some((self.flash.cells(LAYOUT.programs[usize::from(number) - 1])[8], record.signed))
    }

    /// The node-ID and bit rate after the next reset.
    pub fn node(&self) -> NodeParameters {
        NodeParameters::load(&self.parameters(), &self.flash, BOARD_NODE, |_| true)
    }

    /// The power returns.
    pub fn power_on(&mut self) {
        self.flash.power_on();
        self.flash.touched.clear();
    }

    /// The boot stage, including its writes.
    pub fn boot(&mut self) {
        let mut parameters = self.parameters();
        if parameters.get(&self.flash, Key::CRASH_COUNT).is_some_and(|[count, ..]| count > 0) {
            parameters.store(Key::CRASH_COUNT, [0; 4]);
            let _ = run(&mut self.flash, |flash, outcome| parameters.next(flash, outcome));
        }
    }

    /// A value that the running device stores.
    pub fn store(&mut self, key: Key, value: Value) {
        let mut parameters = self.parameters();
        parameters.store(key, value);
        let _ = run(&mut self.flash, |flash, outcome| parameters.next(flash, outcome));
    }

    /// Bootloader mode, with a host that talks to it.
    pub fn host<R>(&mut self, talk: impl FnOnce(&mut Host<'_, '_>) -> R) -> R {
        let setup = if self.bug == Some(Bug::EraseBeforeCheck) { &AT_ONCE_2 } else { &STANDARD_2 };
        self.host_of(&setup.config, talk)
    }

    /// The same for the bootloader of a lift.
    pub fn host_of_lift<R>(&mut self, talk: impl FnOnce(&mut Host<'_, '_>) -> R) -> R {
        self.host_of(&LIFT, talk)
    }

    /// The same for the bootloader of a lift that requires its password.
    pub fn host_of_locked_lift<R>(&mut self, talk: impl FnOnce(&mut Host<'_, '_>) -> R) -> R {
        self.host_of(&LOCKED_LIFT, talk)
    }

    /// The same for the bootloader of ESAcademy.
    pub fn host_of_esacademy<R>(&mut self, talk: impl FnOnce(&mut Host<'_, '_>) -> R) -> R {
        self.host_of(&ESACADEMY_2.config, talk)
    }

    fn host_of<R>(&mut self, config: &'static Config, talk: impl FnOnce(&mut Host<'_, '_>) -> R) -> R {
        let (parameters, node) = (self.parameters(), self.node());
        let flash = Chip { flash: &mut self.flash, bug: self.bug };
        let (mut buffer, mut room) = ([0; 256], SealedMemory::new());
        let node = Boot::new(config, node).with(parameters, flash, &mut buffer, room.sealed());
        talk(&mut Host { node })
    }
}

/// The host's actions by SDO and LSS, through the calls that the protocol makes.
pub struct Host<'b, 'f> {
    node: Bootloader<'b, Chip<'f>, Store, PROGRAMS>,
}

impl Host<'_, '_> {
    /// Runs until there is no work.
    pub fn settle(&mut self) {
        assert!((0..1_000_000).any(|_| self.node.step() == Step::Idle), "the work does not end");
    }

    /// 1F57h of a program.
    fn status(&mut self, program: u8) -> u32 {
        let mut bytes = [0; 4];
        self.node.read(Address::new(0x1F57, program), &mut bytes).expect("1F57h can be read");
        u32::from_le_bytes(bytes)
    }

    /// A command, carried out.
    ///
    /// # Errors
    /// The abort or the status.
    pub fn command(&mut self, program: u8, command: u8) -> Result<(), String> {
        self.node.write(Address::new(0x1F51, program), &[command]).map_err(abort_text)?;
        self.settle();
        self.ended(program)
    }

    /// Sends a block, or a whole program, in SDO segments, and returns the result.
    ///
    /// # Errors
    /// The abort or the status.
    pub fn block(&mut self, program: u8, block: &[u8]) -> Result<(), String> {
        let at = Address::new(0x1F50, program);
        self.node.download_start(at, Some(block.len() as u32)).map_err(abort_text)?;
        go_on(&mut self.node, program, block, 7).map_err(abort_text)?;
        self.node.download_end(at).map_err(abort_text)?;
        self.settle();
        self.ended(program)
    }

    /// Sends the password that unlocks 1F50h of a program, as the profile defines it, without
    /// waiting for running work.
    ///
    /// # Errors
    /// The abort.
    pub fn password(&mut self, program: u8) -> Result<(), String> {
        let lift = self.node.entries().iter().any(|entry| entry.at == LIFT_PASSWORD);
        if lift {
            self.node.write(LIFT_PASSWORD, Profile::LIFT.password).map_err(abort_text)
        } else {
            self.node.write(Address::new(0x7F50, program), Profile::ESACADEMY.password).map_err(abort_text)
        }
    }

    /// Sends only the first `sent` bytes of a program, then runs this many steps of work; then the
    /// client is gone.
    ///
    /// # Errors
    /// The abort.
    pub fn broken_off(&mut self, program: u8, data: &[u8], sent: usize, steps: u32) -> Result<(), String> {
        let at = Address::new(0x1F50, program);
        self.node.download_start(at, Some(data.len() as u32)).map_err(abort_text)?;
        go_on(&mut self.node, program, &data[..sent], 7).map_err(abort_text)?;
        for _ in 0..steps {
            self.node.step();
        }
        self.node.download_cancel(at);
        Ok(())
    }

    fn ended(&mut self, program: u8) -> Result<(), String> {
        match self.status(program) {
            0 => Ok(()),
            status => Err(format!("status {status:08X}h")),
        }
    }

    /// LSS: configure node-ID and bit rate, and store them.
    ///
    /// # Errors
    /// The values could not be stored.
    pub fn store_node(&mut self, node: NodeParameters) -> Result<(), String> {
        let mut outcome = LssDevice::store(&mut self.node, node.id, Some(node.bit_rate));
        while outcome.is_pending() {
            self.node.step();
            outcome = self.node.stored();
        }
        match outcome {
            Poll::Ready(Err(error)) => Err(format!("LSS store: {error:?}")),
            _ => Ok(()),
        }
    }
}

fn abort_text(abort: AbortCode) -> String {
    format!("abort {abort:?}")
}

/// Program `number` with this seed: a plausible vector table, and distinct data.
pub fn image(number: u8, seed: u8) -> Vec<u8> {
    let base = LAYOUT.programs[usize::from(number) - 1].base;
    let len = 150 + usize::from(seed % 16) * 8;
    let mut bytes: Vec<u8> = (0..len).map(|i| (i as u8).wrapping_mul(31) ^ seed).collect();
    bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&(base + 0x101).to_le_bytes());
    bytes[8] = seed;
    bytes
}

/// A chip as `boot-core` sees it, possibly with a bug.
struct Chip<'f> {
    flash: &'f mut ModelFlash,
    bug: Option<Bug>,
}

impl Flash for Chip<'_> {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        self.flash.read(address, buffer);
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        if let (Some(Bug::BlankAtFirstSight), Operation::Erase(sector)) = (self.bug, operation) {
            if self.flash.read_word(sector.region.base) == u32::MAX {
                return Ok(());
            }
        }
        self.flash.start(operation)
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        self.flash.sector_at(address)
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        self.flash.poll()
    }
}

/// The journal, or a faulty replacement of it.
enum Store {
    Journal(Journal),
    /// Stores this record instead of removing one, or does not remove it.
    Instead(Journal, Option<Value>),
    /// Forgets which sectors may be half erased.
    Forgetful(Journal),
    /// One region with consecutive records; a word before each record identifies it. `checked`: a
    /// CRC follows.
    Naive {
        checked: bool,
        work: Vec<(u32, u32)>,
    },
}

impl Store {
    fn open(flash: &ModelFlash, bug: Option<Bug>) -> Self {
        let journal = Journal::open(flash, LAYOUT.parameters);
        match bug {
            Some(Bug::JournalWithoutCrc) => Self::Naive { checked: false, work: Vec::new() },
            Some(Bug::CompactionInPlace) => Self::Naive { checked: true, work: Vec::new() },
            Some(Bug::EraseBeforeInvalidating) => Self::Instead(journal, None),
            Some(Bug::TouchedForgotten) => Self::Forgetful(journal),
            Some(Bug::SignatureBeforeData) => {
                let new = image(1, NEW);
                let record = ProgramRecord {
                    size: new.len() as u32,
                    crc: crc32(&new),
                    signed: true,
                    confirmed: false,
                    version: 0,
                    half_erased: false,
                    seal: None,
                    withdrawn: false,
                };
                Self::Instead(journal, Some(record.value()))
            }
            _ => Self::Journal(journal),
        }
    }
}

/// The words of a naive record: its key, four words of value, its CRC.
const NAIVE: usize = 6;

/// Another number for the key, in the lower half of the word.
fn naive_key(Key(key): Key) -> u32 {
    (key >> 16) << 8 | key & 0xFF
}

fn naive_crc(words: &[u32]) -> u32 {
    crc32(&words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>())
}

/// The records of the naive store, and the place of the next one.
fn naive_records<F: Flash>(flash: &F, checked: bool) -> (Vec<[u32; NAIVE]>, u32) {
    let region = LAYOUT.parameters[0];
    let mut records = Vec::new();
    for base in (region.base..region.end()).step_by(4 * NAIVE) {
        let record: [u32; NAIVE] = core::array::from_fn(|i| flash.read_word(base + 4 * i as u32));
        if record == [u32::MAX; NAIVE] || base + 4 * NAIVE as u32 > region.end() {
            return (records, base);
        }
        if !checked || naive_crc(&record[..NAIVE - 1]) == record[NAIVE - 1] {
            records.push(record);
        }
    }
    (records, region.end())
}

impl Parameters for Store {
    fn get<F: Flash>(&self, flash: &F, key: Key) -> Option<Value> {
        match self {
            Self::Journal(journal) | Self::Instead(journal, _) => journal.get(flash, key),
            Self::Forgetful(journal) => {
                let [first, rest @ ..] = journal.get(flash, key)?;
                let [a, b, c] = rest;
                // Above the size.
                Some([
                    if key.0 >> 16 == Key::program(0).0 >> 16 { first & 0x00FF_FFFF } else { first },
                    a,
                    b,
                    c,
                ])
            }
            Self::Naive { checked, .. } => {
                let (records, _) = naive_records(flash, *checked);
                let found = records.iter().rev().find(|record| record[0] == naive_key(key))?;
                Some([found[1], found[2], found[3], found[4]])
            }
        }
    }

    fn store(&mut self, key: Key, value: Value) {
        match self {
            Self::Instead(journal, instead)
                if key == Key::program(1) && ProgramRecord::from_value(value).is_none() =>
            {
                if let Some(instead) = instead {
                    journal.store(key, *instead);
                }
            }
            Self::Journal(journal) | Self::Instead(journal, _) | Self::Forgetful(journal) => {
                journal.store(key, value);
            }
            Self::Naive { work, .. } => {
                let mut record = vec![naive_key(key), value[0], value[1], value[2], value[3]];
                record.push(naive_crc(&record));
                // The address is determined when the flash can be read.
                *work = record.into_iter().map(|word| (u32::MAX, word)).collect();
            }
        }
    }

    fn next<F: Flash>(&mut self, flash: &F, outcome: Result<(), FlashFault>) -> Next<StoreError> {
        let Self::Naive { checked, work } = self else {
            let (Self::Journal(journal) | Self::Instead(journal, _) | Self::Forgetful(journal)) = self else {
                unreachable!()
            };
            return journal.next(flash, outcome);
        };
        if let Err(fault) = outcome {
            return Next::Done(Err(StoreError::Flash(fault)));
        }
        let region = LAYOUT.parameters[0];
        if let Some(&(u32::MAX, key)) = work.first() {
            let (mut records, mut end) = naive_records(flash, *checked);
            if end + 4 * NAIVE as u32 > region.end() {
                // The bug: until everything is written again, the region is empty.
                let new: Vec<u32> = work.iter().map(|(_, word)| *word).collect();
                records.retain(|record| record[0] != key);
                let mut latest: Vec<[u32; NAIVE]> = Vec::new();
                for record in records {
                    latest.retain(|other| other[0] != record[0]);
                    latest.push(record);
                }
                let words = latest.into_iter().flatten().chain(new);
                *work = (region.base..).step_by(4).zip(words).collect();
                let Some(sector) = LAYOUT.chip.sector_at(region.base) else { unreachable!() };
                return Next::Start(Operation::Erase(sector));
            }
            for (address, _) in work.iter_mut() {
                *address = end;
                end += 4;
            }
        }
        if work.is_empty() {
            return Next::Done(Ok(()));
        }
        let (address, word) = work.remove(0);
        Next::Start(Operation::Program { address, word })
    }
}
