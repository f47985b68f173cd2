//! Embedded flash interface (RM0090 section 3) and the flash array itself.
//!
//! Programming clears bits and never sets one, as on the chip: the F4 does not check that the
//! target is erased. While an operation runs (BSY) the array answers neither fetches nor data
//! reads; the machine stalls the CPU then.

mod cells;
mod data_cache;
mod fetched_lines;
mod lock;
mod options;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use shared_abi::geometry::{Geometry, Sector};

use crate::memory::HostMemory;
use crate::noise::Noise;
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::silicon::Silicon;
use crate::supply::NOMINAL;
use crate::time::{Span, Time};
use cells::{carry_out, weak_bits};
pub use cells::{Cells, Cut, Operation};
use data_cache::DataCache;
use fetched_lines::FetchedLines;
use lock::Lock;
use options::{OptionBytes, Request};

/// Interrupt line of the flash (RM0090 table 61).
const LINE: u16 = 4;

const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];

const SR_EOP: u32 = 1 << 0;
const SR_OPERR: u32 = 1 << 1;
const SR_WRPERR: u32 = 1 << 4;
const SR_PGAERR: u32 = 1 << 5;
const SR_PGPERR: u32 = 1 << 6;
const SR_PGSERR: u32 = 1 << 7;
/// A load from a sector that is protected against reading (chips with PCROP).
const SR_RDERR: u32 = 1 << 8;
const SR_BSY: u32 = 1 << 16;
const SR_CLEARABLE: u32 = SR_EOP | SR_OPERR | SR_WRPERR | SR_PGAERR | SR_PGPERR | SR_PGSERR;

const CR_PG: u32 = 1 << 0;
const CR_SER: u32 = 1 << 1;
const CR_MER: u32 = 1 << 2;
/// On a chip with one bank, the uppermost of the five bits is reserved.
const CR_SNB: u32 = 0x1F << 3;
/// Mass erase of the second bank, on a chip that has one.
const CR_MER1: u32 = 1 << 15;
const CR_PSIZE: u32 = 3 << 8;
const CR_STRT: u32 = 1 << 16;
const CR_EOPIE: u32 = 1 << 24;
const CR_ERRIE: u32 = 1 << 25;
const CR_LOCK: u32 = 1 << 31;
const CR_KEPT: u32 = CR_PG | CR_SER | CR_MER | CR_SNB | CR_PSIZE | CR_EOPIE | CR_ERRIE;

const ACR_MASK: u32 = 0x0000_1F07;

/// Which of the datasheet's times operations take.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FlashTimes {
    /// The typical ones.
    #[default]
    Typical,
    /// The longest ones.
    Worst,
}

/// Erase times in milliseconds by parallelism x8, x16, x32, x64: (typical, worst). STM32F405/407
/// datasheet (DocID022152 rev 8) tables 40 and 41; x64 needs the external voltage and has no
/// maximum there: the x32 one is used.
const ERASE_16_KIB: [(u64, u64); 4] = [(400, 800), (300, 600), (250, 500), (230, 500)];
const ERASE_64_KIB: [(u64, u64); 4] = [(1_200, 2_400), (700, 1_400), (550, 1_100), (490, 1_100)];
const ERASE_128_KIB: [(u64, u64); 4] = [(2_000, 4_000), (1_300, 2_600), (1_000, 2_000), (875, 2_000)];
const ERASE_MASS: [(u64, u64); 4] = [(16_000, 32_000), (11_000, 22_000), (8_000, 16_000), (6_900, 16_000)];
/// Programming one unit of any width takes this many microseconds (the same tables): (typical,
/// worst).
const PROGRAM: (u64, u64) = (16, 100);

/// The lowest supply for programming and erasing by parallelism x8, x16, x32, in mV (RM0090 table 13). x64
/// needs the external voltage, too, which no board here has.
const SUPPLY: [u32; 3] = [1_800, 2_100, 2_700];

/// How long a bit between 0 and 1 reads the same, at most.
const REDRAW: Span = Span::from_millis(20);

/// Cut the power at a flash operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FlashCut {
    /// The operation, counted from 0 since the cut was asked for.
    pub operation: u64,
    /// Where in it.
    pub when: Cut,
}

/// The counters of flash operations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FlashCounters {
    /// Sectors erased.
    pub sectors_erased: u64,
    /// Units programmed, of whatever width.
    pub units_programmed: u64,
    /// Operations refused with an error flag.
    pub refused: u64,
    /// Operations with a supply too low for their width.
    pub weak: u64,
}

#[derive(Clone, Debug)]
struct Running {
    operation: Operation,
    ends: Time,
    /// The supply was too low when it began.
    is_weak: bool,
}

/// The result of a store by the CPU to the array.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Store {
    /// An operation started.
    Started,
    /// Refused; an error flag says why.
    Refused(&'static str),
}

/// The flash interface registers and the array.
pub struct Flash {
    geometry: &'static Geometry,
    times: FlashTimes,
    /// How far its times are from the typical to the worst, in thousandths.
    slowness_permille: u64,
    /// The array.
    pub array: HostMemory,
    acr: u32,
    sr: u32,
    cr: u32,
    lock: Lock,
    /// The option bytes.
    pub(crate) options: OptionBytes,
    /// A debugger has connected, with read-out protection: no access until the next power-on.
    is_shut: bool,
    running: Option<Running>,
    /// Ranges of the array that changed since the machine last asked, as (offset, length).
    changed: Vec<(u32, u32)>,
    /// A bus error that the last register write caused.
    bus_error: bool,
    /// When the operation that a register write had to wait for ended.
    waited_until: Option<Time>,
    cut: Option<FlashCut>,
    power_failed: bool,
    /// The bits between 0 and 1, by the offset of their byte.
    unstable: BTreeMap<u32, u8>,
    /// How these read now.
    noise: Noise,
    /// When they read otherwise.
    redraw_at: Time,
    /// VDD in mV.
    supply: u32,
    /// The data cache, on a chip whose lines become stale.
    data_cache: Option<DataCache>,
    /// The instruction cache, on the same.
    fetched: Option<FetchedLines>,
    /// The operations that have started since somebody wants to know them.
    log: Option<Vec<Operation>>,
    /// Usage.
    pub counters: FlashCounters,
}

impl Flash {
    /// An erased flash of the chip.
    #[must_use]
    pub fn new(geometry: &'static Geometry, times: FlashTimes, silicon: Silicon) -> Self {
        Self {
            geometry,
            times,
            slowness_permille: silicon.flash_slowness_permille.into(),
            array: HostMemory::new(geometry.flash.size, 0xFF),
            acr: 0,
            sr: 0,
            cr: 0,
            lock: Lock::default(),
            options: OptionBytes::of(geometry),
            is_shut: false,
            running: None,
            changed: Vec::new(),
            bus_error: false,
            waited_until: None,
            cut: None,
            power_failed: false,
            unstable: BTreeMap::new(),
            noise: Noise(0),
            redraw_at: Time(0),
            supply: NOMINAL,
            data_cache: silicon.stale_lines.then(DataCache::default),
            fetched: silicon.stale_lines.then(FetchedLines::default),
            log: None,
            counters: FlashCounters::default(),
        }
    }

    /// When the running operation ends, if one runs.
    #[must_use]
    pub fn busy_until(&self) -> Option<Time> {
        self.running.as_ref().map(|running| running.ends)
    }

    /// FLASH_ACR: wait states, prefetch and caches.
    #[must_use]
    pub fn acr(&self) -> u32 {
        self.acr
    }

    /// Whether each load from the array has to be noticed ([`Self::load`]).
    #[must_use]
    pub fn caches_data(&self) -> bool {
        self.data_cache.as_ref().is_some_and(DataCache::is_enabled)
    }

    /// How many lines of the data cache differ from the array.
    #[must_use]
    pub fn stale_lines(&self) -> usize {
        self.data_cache.as_ref().map_or(0, DataCache::stale)
    }

    /// The CPU is about to load from the array.
    pub fn load(&mut self, offset: u32, len: u32) {
        if let Some(cache) = self.data_cache.as_mut().filter(|cache| cache.is_enabled()) {
            cache.load(offset, len, self.array.bytes_mut(), &mut self.changed);
        }
    }

    /// Whether each fetch from the array has to be noticed ([`Self::fetch`]).
    #[must_use]
    pub fn caches_code(&self) -> bool {
        self.fetched.as_ref().is_some_and(FetchedLines::is_enabled)
    }

    /// The CPU fetches code from the array. Returns the offset of the first line of it that the instruction cache
    /// has from before an operation changed the array.
    pub fn fetch(&mut self, offset: u32, len: u32) -> Option<u32> {
        self.fetched.as_mut().filter(|lines| lines.is_enabled())?.fetch(offset, len)
    }

    /// An operation has changed this range of the array.
    fn note_change(&mut self, offset: u32, len: u32) {
        if let Some(lines) = &mut self.fetched {
            lines.note(offset, len);
        }
        self.changed.push((offset, len));
    }

    /// The array has its true bytes, whatever the data cache has.
    fn show_array(&mut self) {
        if let Some(cache) = &mut self.data_cache {
            cache.show_array(self.array.bytes_mut(), &mut self.changed);
        }
    }

    /// The CPU sees the array through the data cache again.
    fn show_lines(&mut self) {
        if let Some(cache) = &mut self.data_cache {
            cache.show_lines(self.array.bytes_mut(), &mut self.changed);
        }
    }

    /// The wait states that are set (ACR.LATENCY).
    #[must_use]
    pub fn latency(&self) -> u32 {
        self.acr & 7
    }

    /// Takes the ranges (offset, length) that changed; the machine drops its translations of them.
    pub fn take_changed(&mut self) -> Vec<(u32, u32)> {
        std::mem::take(&mut self.changed)
    }

    /// Takes the bus error of the last register write.
    pub fn take_bus_error(&mut self) -> bool {
        std::mem::take(&mut self.bus_error)
    }

    /// Takes the time up to which the bus was held because a write had to wait for the running
    /// operation.
    pub fn take_wait(&mut self) -> Option<Time> {
        self.waited_until.take()
    }

    /// VDD has this voltage in mV.
    pub fn set_supply(&mut self, mv: u32) {
        self.supply = mv;
    }

    /// What a supply that is too low means for the operations that start now.
    #[must_use]
    pub fn weakness(&self) -> Option<String> {
        let psize = self.psize();
        let bits = 8 << psize;
        match SUPPLY.get(psize) {
            None => Some(format!(
                "FLASH_CR.PSIZE is {bits} bits, which needs the external voltage VPP: what is written or erased may                  not last"
            )),
            Some(needed) if self.supply < *needed => Some(format!(
                "VDD is {} mV, and FLASH_CR.PSIZE of {bits} bits needs {needed} mV: what is written or erased may \
                 not last",
                self.supply
            )),
            Some(_) => None,
        }
    }

    fn psize(&self) -> usize {
        ((self.cr & CR_PSIZE) >> 8) as usize
    }

    /// Arms a power cut; operations are counted from now on.
    pub fn cut_power_at(&mut self, cut: Option<FlashCut>) {
        self.cut = cut;
    }

    /// Whether the armed power cut happened; [`Self::lose_power`] clears it.
    #[must_use]
    pub fn power_has_failed(&self) -> bool {
        self.power_failed
    }

    /// Keeps the operations that start from now on.
    pub fn keep_log(&mut self) {
        self.log = Some(Vec::new());
    }

    /// Takes the operations since [`Self::keep_log`], in order, and keeps no more.
    pub fn take_log(&mut self) -> Vec<Operation> {
        self.log.take().unwrap_or_default()
    }

    /// What the array holds.
    #[must_use]
    pub fn cells(&self) -> Cells {
        Cells { bytes: self.array.bytes().to_vec(), unstable: self.unstable.clone() }
    }

    /// Replaces what the array holds. `seed` chooses how bits between 0 and 1 read.
    pub fn preset_cells(&mut self, cells: &Cells, seed: u64) {
        self.preset(0, &cells.bytes);
        self.unstable.clone_from(&cells.unstable);
        self.noise = Noise(seed);
        self.redraw();
    }

    /// The bits between 0 and 1 read otherwise.
    fn redraw(&mut self) {
        self.show_array();
        for (at, bits) in &self.unstable {
            let cell = &mut self.array.bytes_mut()[*at as usize];
            *cell = *cell & !bits | self.noise.byte() & bits;
            self.changed.push((*at, 1));
        }
        self.show_lines();
    }

    /// Writes into the array as a debug probe does, whatever the locks say.
    pub fn preset(&mut self, offset: u32, bytes: &[u8]) {
        self.show_array();
        let start = offset as usize;
        self.array.bytes_mut()[start..start + bytes.len()].copy_from_slice(bytes);
        self.changed.push((offset, u32::try_from(bytes.len()).unwrap_or(u32::MAX)));
        self.show_lines();
    }

    /// The power fails now: the running operation is torn. `seed` chooses how.
    pub fn lose_power(&mut self, seed: u64) {
        self.empty_caches();
        self.is_shut = false;
        if let Some(running) = self.running.take() {
            self.tear(&running.operation, Cut::Torn { seed });
        }
        self.cut = None;
        self.power_failed = false;
    }

    fn empty_caches(&mut self) {
        self.show_array();
        if let Some(cache) = &mut self.data_cache {
            cache.reset();
        }
        if let Some(lines) = &mut self.fetched {
            *lines = FetchedLines::default();
        }
    }

    fn width(&self) -> u32 {
        1 << self.psize()
    }

    fn pick(&self, (typical, worst): (u64, u64)) -> u64 {
        match self.times {
            FlashTimes::Typical => typical + (worst - typical) * self.slowness_permille / 1000,
            FlashTimes::Worst => worst,
        }
    }

    fn erase_time(&self, sectors: &[Sector]) -> Span {
        let table = match sectors {
            [one] if one.region.size <= 16 * 1024 => ERASE_16_KIB,
            [one] if one.region.size <= 64 * 1024 => ERASE_64_KIB,
            [_] => ERASE_128_KIB,
            _ => ERASE_MASS,
        };
        Span::from_millis(self.pick(table[self.psize()]))
    }

    /// A debugger connects: with read-out protection of level 1 that shuts the flash until the next power-on
    /// (section 3.7.3). Returns whether it can connect: with level 2 the port is off.
    pub fn connect_debugger(&mut self) -> bool {
        self.is_shut |= self.options.level() == 1;
        self.options.level() != 2
    }

    /// Whether the array answers with bus errors alone.
    #[must_use]
    pub fn is_shut(&self) -> bool {
        self.is_shut
    }

    /// Whether the data bus is kept out of the sector with this offset (PCROP, section 3.7.5).
    #[must_use]
    pub fn hides(&self, offset: u32) -> bool {
        let Some(sector) = self.geometry.sector_at(self.geometry.flash.base + offset) else { return false };
        let (bank, number) = self.within_bank(sector.number);
        self.options.hides(bank, number)
    }

    /// The CPU loads from such a sector.
    pub fn load_hidden(&mut self) {
        self.sr |= SR_RDERR;
        if self.cr & CR_ERRIE != 0 {
            self.sr |= SR_OPERR;
        }
    }

    /// nWRP: a zero protects the sector (section 3.7.4).
    fn is_protected(&self, sector: Sector) -> bool {
        if self.is_shut {
            return true;
        }
        let (bank, number) = self.within_bank(sector.number);
        self.options.protects(bank, number)
    }

    /// The bank of a sector, 0 or 1, and its number in it.
    fn within_bank(&self, sector: u8) -> (usize, u8) {
        let second = self.geometry.second_bank.and_then(|first| sector.checked_sub(first));
        second.map_or((0, sector), |number| (1, number))
    }

    /// Sets the option bytes as a debug probe does: at once, and unnoticed by the running program.
    ///
    /// # Panics
    /// For a sector without a bit of its own.
    pub fn protect_sector(&mut self, number: u8, protected: bool) {
        let (bank, within) = self.within_bank(number);
        assert!(within < 12, "sector {number} has no bit of nWRP");
        self.options.preset_protection(bank, within, protected);
    }

    fn refuse(&mut self, flag: u32, why: &'static str) -> Store {
        self.sr |= flag;
        if self.cr & CR_ERRIE != 0 {
            self.sr |= SR_OPERR;
        }
        self.counters.refused += 1;
        Store::Refused(why)
    }

    /// The CPU stores `bytes` (1, 2, 4 or 8) at `offset` of the array.
    pub fn store(&mut self, offset: u32, bytes: &[u8], now: Time) -> Store {
        let start = self.wait_until_idle(now);
        let len = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
        if !self.lock.is_open() {
            return self.refuse(SR_PGSERR, "the flash is locked");
        }
        if self.cr & CR_PG == 0 {
            return self.refuse(SR_PGSERR, "FLASH_CR.PG is not set");
        }
        if len != self.width() {
            return self.refuse(SR_PGPERR, "the width of the store is not the one of FLASH_CR.PSIZE");
        }
        if offset / 16 != (offset + len - 1) / 16 {
            return self.refuse(SR_PGAERR, "the store crosses a row of 128 bits");
        }
        let Some(sector) = self.geometry.sector_at(self.geometry.flash.base + offset) else {
            return self.refuse(SR_PGSERR, "the address is beyond the flash");
        };
        if self.is_protected(sector) {
            return self.refuse(SR_WRPERR, "the option bytes protect the sector");
        }
        let takes = Span::from_micros(self.pick(PROGRAM));
        self.start(Operation::Program { offset, bytes: bytes.to_vec() }, takes, start);
        Store::Started
    }

    /// Where a write must wait for the running operation, ends it; returns when the write takes
    /// effect.
    fn wait_until_idle(&mut self, now: Time) -> Time {
        match self.busy_until() {
            Some(ends) if ends > now => {
                self.waited_until = Some(ends);
                self.advance(ends);
                ends
            }
            _ => {
                self.advance(now);
                now
            }
        }
    }

    fn start(&mut self, operation: Operation, takes: Span, now: Time) {
        if let Some(log) = &mut self.log {
            log.push(operation.clone());
        }
        if let Some(cut) = &mut self.cut {
            if cut.operation == 0 {
                let when = cut.when;
                self.cut = None;
                self.power_failed = true;
                match when {
                    Cut::Before => {}
                    Cut::After => self.complete(&operation),
                    Cut::Torn { .. } | Cut::Unstable { .. } => self.tear(&operation, when),
                }
                return;
            }
            cut.operation -= 1;
        }
        let is_weak = self.weakness().is_some();
        self.running = Some(Running { operation, ends: now + takes, is_weak });
    }

    fn start_erase(&mut self, now: Time) -> Result<(), Unmodelled> {
        let all: Vec<Sector> = self.geometry.sectors().collect();
        // MER and MER1 are bits for a bank each.
        let banks = [self.cr & CR_MER != 0, self.cr & CR_MER1 != 0];
        let sectors = match (self.cr & CR_SER != 0, banks) {
            (true, [false, false]) => {
                let code = (self.cr & CR_SNB) >> 3;
                match self.sector_named(code) {
                    Some(sector) => vec![sector],
                    None => {
                        self.refuse(SR_PGSERR, "no such sector");
                        return unmodelled(format!("FLASH_CR.SNB is {code:05b}b: that names no sector"));
                    }
                }
            }
            (false, [true, _] | [_, true]) => all
                .into_iter()
                .filter(|sector| {
                    let first_of_second = self.geometry.second_bank.unwrap_or(u8::MAX);
                    banks[usize::from(sector.number >= first_of_second)]
                })
                .collect(),
            _ => {
                self.refuse(SR_PGSERR, "neither SER nor MER");
                return unmodelled("FLASH_CR.STRT without exactly one of SER and MER");
            }
        };
        if self.cr & CR_PG != 0 {
            self.refuse(SR_PGSERR, "PG is set");
            return unmodelled("FLASH_CR.STRT while PG is set");
        }
        if sectors.iter().any(|&sector| self.is_protected(sector)) {
            self.refuse(SR_WRPERR, "the option bytes protect the sector");
            return Ok(());
        }
        let takes = self.erase_time(&sectors);
        self.start(Operation::Erase { sectors }, takes, now);
        self.weakness().map_or(Ok(()), |what| Err(Unmodelled(what)))
    }

    /// The sector that a value of SNB names. With two banks bit 4 is the bank and the others count
    /// its sectors from 0 (section 3.9.8); values beyond are reserved.
    fn sector_named(&self, code: u32) -> Option<Sector> {
        let code = u8::try_from(code).ok()?;
        let number = match self.geometry.second_bank {
            None => code,
            Some(first) => match (code & 0x10 != 0, code & 0xF) {
                (_, within) if within >= first => return None,
                (true, within) => first + within,
                (false, within) => within,
            },
        };
        self.geometry.sector(number)
    }

    fn complete(&mut self, operation: &Operation) {
        self.show_array();
        match operation {
            Operation::Program { .. } => self.counters.units_programmed += 1,
            Operation::Erase { sectors } => self.counters.sectors_erased += sectors.len() as u64,
            Operation::Options { optcr } => {
                if self.options.program(*optcr) {
                    self.array.bytes_mut().fill(0xFF);
                    self.unstable.clear();
                    self.note_change(0, self.geometry.flash.size);
                }
            }
        }
        self.carry_out(operation, Cut::After);
        if let Some(cache) = &mut self.data_cache {
            cache.note(operation);
        }
        self.show_lines();
    }

    /// Completes an operation that had too little voltage: what it leaves reads right at first, and may not
    /// last (section 3.6.2).
    fn complete_weakly(&mut self, operation: &Operation, now: Time) {
        self.counters.weak += 1;
        self.show_array();
        let weak = weak_bits(operation, self.geometry, self.array.bytes(), &mut self.noise);
        self.complete(operation);
        if self.unstable.is_empty() {
            self.redraw_at = now + REDRAW;
        }
        for (at, bits) in weak {
            *self.unstable.entry(at).or_default() |= bits;
        }
    }

    /// Carries an operation out in part.
    fn tear(&mut self, operation: &Operation, how: Cut) {
        if let Operation::Options { .. } = operation {
            self.options.tear();
        }
        self.show_array();
        self.carry_out(operation, how);
    }

    fn carry_out(&mut self, operation: &Operation, until: Cut) {
        let array = self.array.bytes_mut();
        let ranges = carry_out(operation, self.geometry, until, array, &mut self.unstable);
        for (offset, len) in ranges {
            self.note_change(offset, len);
        }
    }

    fn write_key(&mut self, value: u32) -> Result<(), Unmodelled> {
        self.lock = self.lock.turn(value, KEYS);
        if self.lock == Lock::Barred {
            return unmodelled(
                "wrong key sequence at FLASH_KEYR: FLASH_CR is locked until the next reset, and the chip answers \
                 with a bus error",
            );
        }
        Ok(())
    }

    fn write_cr(&mut self, value: u32, now: Time) -> Result<(), Unmodelled> {
        if !self.lock.is_open() {
            return unmodelled("FLASH_CR is written while it is locked: the chip ignores it");
        }
        let start = self.wait_until_idle(now);
        let second_bank = if self.geometry.second_bank.is_some() { CR_MER1 } else { 0 };
        self.cr = value & (CR_KEPT | second_bank);
        if value & CR_LOCK != 0 {
            self.lock = self.lock.close();
            return Ok(());
        }
        if value & CR_STRT != 0 {
            return self.start_erase(start);
        }
        Ok(())
    }

    fn write_optcr(&mut self, value: u32, now: Time) -> Result<(), Unmodelled> {
        let start = self.wait_until_idle(now);
        match self.options.write(value)? {
            Request::Done => {}
            Request::Program(optcr) => {
                // Option bytes lie in a sector of their own; the datasheet gives no time: that of a 16
                // KiB sector.
                let takes = Span::from_millis(self.pick(ERASE_16_KIB[2]));
                self.start(Operation::Options { optcr }, takes, start);
            }
            Request::Protected => {
                let why = "FLASH_OPTCR would take back a protection against reading, and not erase the flash";
                self.refuse(SR_WRPERR, why);
                return Err(Unmodelled(why.into()));
            }
        }
        Ok(())
    }
}

impl Peripheral for Flash {
    fn name(&self) -> &'static str {
        "FLASH"
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        self.advance(now);
        Ok(match offset {
            0x00 => self.acr,
            // The key registers are write-only.
            0x04 | 0x08 => 0,
            0x0C => self.sr | if self.running.is_some() { SR_BSY } else { 0 },
            0x10 => {
                let locked = if self.lock.is_open() { 0 } else { CR_LOCK };
                let erasing =
                    matches!(&self.running, Some(Running { operation: Operation::Erase { .. }, .. }));
                self.cr | locked | if erasing { CR_STRT } else { 0 }
            }
            0x14 => {
                let programming =
                    matches!(&self.running, Some(Running { operation: Operation::Options { .. }, .. }));
                self.options.read(programming)
            }
            0x18 if self.geometry.second_bank.is_some() => self.options.read_second(),
            _ => return unmodelled("the flash interface has no such register"),
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        self.advance(now);
        match offset {
            0x00 => {
                // The cache reset bits act at once and stay as written.
                self.acr = value & ACR_MASK;
                self.show_array();
                if let Some(cache) = &mut self.data_cache {
                    cache.control(self.acr);
                }
                self.show_lines();
                if let Some(lines) = &mut self.fetched {
                    lines.control(self.acr);
                }
                Ok(())
            }
            0x04 | 0x08 => {
                let result =
                    if offset == 0x04 { self.write_key(value) } else { self.options.write_key(value) };
                self.bus_error = result.is_err();
                result
            }
            0x0C => {
                let of_the_chip = if self.options.may_hide() { SR_RDERR } else { 0 };
                self.sr &= !(value & (SR_CLEARABLE | of_the_chip));
                Ok(())
            }
            0x10 => self.write_cr(value, now),
            0x14 => self.write_optcr(value, now),
            0x18 if self.geometry.second_bank.is_some() => {
                self.wait_until_idle(now);
                self.options.write_second(value)
            }
            _ => unmodelled("the flash interface has no such register"),
        }
    }

    fn advance(&mut self, now: Time) {
        if now >= self.redraw_at && !self.unstable.is_empty() {
            self.redraw_at = now + REDRAW;
            self.redraw();
        }
        if self.busy_until().is_some_and(|ends| ends <= now) {
            if let Some(running) = self.running.take() {
                let is_weak = running.is_weak || self.weakness().is_some();
                match is_weak {
                    true => self.complete_weakly(&running.operation, now),
                    false => self.complete(&running.operation),
                }
                if self.cr & CR_EOPIE != 0 {
                    self.sr |= SR_EOP;
                }
            }
        }
    }

    fn next_event(&self) -> Option<Time> {
        self.busy_until()
    }

    fn interrupts(&self, active: &mut Vec<u16>) {
        let end = self.cr & CR_EOPIE != 0 && self.sr & SR_EOP != 0;
        let error = self.cr & CR_ERRIE != 0 && self.sr & SR_OPERR != 0;
        if end || error {
            active.push(LINE);
        }
    }

    /// System reset: an operation that runs is broken off (section 3.6: its contents are not
    /// protected).
    fn reset(&mut self) {
        self.empty_caches();
        if let Some(running) = self.running.take() {
            // A fixed seed: a reset is no power failure, but leaves the same kind of half-done
            // work.
            self.tear(&running.operation, Cut::Torn { seed: 0x5EED });
        }
        self.acr = 0;
        self.sr = 0;
        self.cr = 0;
        self.lock = Lock::default();
        self.options.reset();
        self.bus_error = false;
        self.waited_until = None;
    }
}
