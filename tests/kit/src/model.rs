//! A strict flash: it behaves like the F4's, refuses operations that the F4 would carry out wrongly
//! without an error, and loses power on demand.

use std::cell::{Cell, RefCell, RefMut};
use std::collections::BTreeMap;
use std::panic::panic_any;
use std::rc::Rc;
use std::sync::Once;
use std::task::Poll;

use boot_core::canopen::program::Supply;
use boot_core::flash::{Flash, FlashFault, Operation as Started};
use shared_abi::geometry::{Geometry, Region, Sector, SectorRun, STM32F407VG};
use shared_abi::layout::Layout;

use crate::random::Random;

/// The F407 with sectors a 64th of their size: the same shape, and cheap to erase in a model.
pub static CHIP: Geometry = Geometry {
    chip: "small-f407",
    flash: Region::new(0x0800_0000, 0x4400),
    sectors: &[
        SectorRun { count: 4, size: 0x200 },
        SectorRun { count: 1, size: 0x400 },
        SectorRun { count: 7, size: 0x800 },
    ],
    interrupts: 4,
    ports: 1,
    ..STM32F407VG
};

/// The flash of [`CHIP`] with one program.
pub const ONE_PROGRAM: Layout = Layout {
    board: "model",
    chip: &CHIP,
    bootloader: Region::new(0x0800_0000, 0x400),
    callgate_offset: 0x40,
    home: None,
    parameters: [Region::new(0x0800_0400, 0x200), Region::new(0x0800_0600, 0x200)],
    data: None,
    programs: &[Region::new(0x0800_0800, 0x3C00)],
    staging: None,
    ram: Region::new(0x2000_0000, 0x1_FFC0),
    handoff: Region::new(0x2001_FFC0, 48),
    warm_start: Region::new(0x2001_FFF0, 16),
}
.checked();

/// With two programs.
pub const TWO_PROGRAMS: Layout =
    Layout { programs: &[Region::new(0x0800_0800, 0x1C00), Region::new(0x0800_2400, 0x2000)], ..ONE_PROGRAM }
        .checked();

/// Thrown by the flash when the power is cut. Catch it, then call [`ModelFlash::power_on`].
pub struct PowerCut;

/// The state of the running operation at a power cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cut {
    /// Nothing.
    Before,
    /// A part: some bits of the word, a part of the sector.
    Torn(u64),
    /// A part is done, and some bits are left between 0 and 1: they read differently each time,
    /// until they are programmed to 0 or erased again.
    Unstable(u64),
    /// All is done, but the result was not read.
    After,
}

#[derive(Clone, Copy, Debug)]
enum Operation {
    Erase(Region),
    Program { address: u32, word: u32 },
}

#[derive(Clone)]
pub struct ModelFlash {
    chip: &'static Geometry,
    cells: Vec<u8>,
    /// Bits that read differently each time, by cell.
    unstable: BTreeMap<usize, u8>,
    /// Changes with every read of an unstable bit.
    noise: Cell<u64>,
    running: Option<Operation>,
    /// Polls until the running operation ends.
    polls_left: u32,
    /// Operations started since the last `power_on`.
    pub operations: u32,
    /// Cut the power in the operation with this number.
    pub cut: Option<(u32, Cut)>,
    /// Make the operation with this number fail with this error.
    pub fail: Option<(u32, FlashFault)>,
    /// Make the operation with this number do a part, selected by the seed, and report success.
    pub weak: Option<(u32, u64)>,
    /// The numbers of the sectors that are protected against writing.
    pub protected: Vec<u8>,
    /// The supply is too low from the operation with this number on.
    pub low_from: Option<u32>,
    /// The option bytes.
    pub option_bytes: u32,
    /// Every region that was written or erased.
    pub touched: Vec<Region>,
    /// The number of bytes that were read.
    pub bytes_read: Cell<usize>,
}

impl ModelFlash {
    pub fn new(chip: &'static Geometry) -> Self {
        Self {
            chip,
            cells: vec![0xFF; chip.flash.size as usize],
            unstable: BTreeMap::new(),
            noise: Cell::new(0),
            running: None,
            polls_left: 0,
            operations: 0,
            cut: None,
            fail: None,
            weak: None,
            protected: Vec::new(),
            low_from: None,
            option_bytes: 0,
            touched: Vec::new(),
            bytes_read: Cell::new(0),
        }
    }

    pub fn power_on(&mut self) {
        self.running = None;
        self.operations = 0;
        self.cut = None;
    }

    fn index(&self, address: u32) -> usize {
        (address - self.chip.flash.base) as usize
    }

    /// Direct access, as by a debug probe.
    pub fn cells(&self, region: Region) -> &[u8] {
        let at = self.index(region.base);
        &self.cells[at..at + region.size as usize]
    }

    /// Whether every bit of it reads the same each time.
    pub fn is_stable(&self, region: Region) -> bool {
        let at = self.index(region.base);
        self.unstable.range(at..at + region.size as usize).all(|(_, bits)| *bits == 0)
    }

    /// Direct access, as by a debug probe.
    pub fn poke(&mut self, address: u32, bytes: &[u8]) {
        let at = self.index(address);
        self.cells[at..at + bytes.len()].copy_from_slice(bytes);
    }

    fn begin(&mut self, operation: Operation) -> Result<(), FlashFault> {
        assert!(self.running.is_none(), "an operation was started while another one runs");
        if self.supply() == Supply::Low {
            return Err(FlashFault::Supply);
        }
        self.operations += 1;
        let region = match operation {
            Operation::Erase(region) => region,
            Operation::Program { address, .. } => Region::new(address, 4),
        };
        if self.chip.sector_at(region.base).is_some_and(|sector| self.protected.contains(&sector.number)) {
            return Err(FlashFault::Protected);
        }
        self.touched.push(region);
        self.running = Some(operation);
        self.polls_left = 2;
        if let Some((number, cut)) = self.cut {
            if number == self.operations {
                match cut {
                    Cut::Before => {}
                    Cut::After => self.complete(operation),
                    Cut::Torn(seed) => self.tear(operation, seed, false),
                    Cut::Unstable(seed) => self.tear(operation, seed, true),
                }
                panic_any(PowerCut);
            }
        }
        Ok(())
    }

    /// The place of the operation, and its effect on the cells there.
    fn effect(&self, operation: Operation) -> Vec<(usize, u8)> {
        match operation {
            Operation::Erase(region) => {
                let at = self.index(region.base);
                (at..at + region.size as usize).map(|at| (at, 0xFF)).collect()
            }
            Operation::Program { address, word } => {
                let at = self.index(address);
                word.to_le_bytes()
                    .into_iter()
                    .enumerate()
                    .map(|(i, byte)| (at + i, self.cells[at + i] & byte))
                    .collect()
            }
        }
    }

    fn complete(&mut self, operation: Operation) {
        for (at, becomes) in self.effect(operation) {
            self.cells[at] = becomes;
            match operation {
                Operation::Erase(_) => drop(self.unstable.remove(&at)),
                // A bit programmed to 0 is certain; a 1 keeps its state.
                Operation::Program { .. } => {
                    if let Some(bits) = self.unstable.get_mut(&at) {
                        *bits &= becomes;
                    }
                }
            }
        }
    }

    /// Does a part of the operation, selected by `seed`. An odd seed of a torn erase ends it in the
    /// middle of the sector; an odd seed of an unstable operation does everything except one bit.
    fn tear(&mut self, operation: Operation, seed: u64, unstable: bool) {
        let mut random = Random(seed.wrapping_add(u64::from(self.operations) << 8));
        let odd = seed & 1 == 1;
        let effect = self.effect(operation);
        if odd && unstable {
            let changed: Vec<_> = effect.iter().filter(|(at, becomes)| self.cells[*at] != *becomes).collect();
            if let Some((at, becomes)) = changed.get(random.next() as usize % changed.len().max(1)) {
                let bits = self.cells[*at] ^ becomes;
                let one = 1 << bits.trailing_zeros();
                let at = *at;
                self.complete(operation);
                *self.unstable.entry(at).or_default() |= one;
            }
            return;
        }
        let middle = random.next() as usize % effect.len();
        for (i, (at, becomes)) in effect.into_iter().enumerate() {
            let before = self.cells[at];
            let changed = match operation {
                Operation::Erase(_) if odd => (before ^ becomes) & if i < middle { 0xFF } else { 0 },
                _ => (before ^ becomes) & random.next() as u8,
            };
            self.cells[at] = before ^ changed;
            let between = (before ^ becomes) & random.next() as u8;
            if unstable && between != 0 {
                *self.unstable.entry(at).or_default() |= between;
            }
        }
    }
}

impl Flash for ModelFlash {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        assert!(self.running.is_none(), "flash was read while it is busy: on the chip the core stalls");
        self.bytes_read.set(self.bytes_read.get() + buffer.len());
        // Nearly every read: inside the flash, and no bit is between 0 and 1.
        if self.chip.flash.contains(address, buffer.len() as u32) {
            let at = self.index(address);
            let end = at + buffer.len();
            if self.unstable.is_empty() || self.unstable.range(at..end).next().is_none() {
                buffer.copy_from_slice(&self.cells[at..end]);
                return;
            }
        }
        for (i, byte) in buffer.iter_mut().enumerate() {
            let address = address.wrapping_add(i as u32);
            let inside = self.chip.flash.contains(address, 1);
            if !inside {
                *byte = 0xFF;
                continue;
            }
            let at = self.index(address);
            *byte = self.cells[at];
            if let Some(bits) = self.unstable.get(&at) {
                let mut random = Random(self.noise.get());
                *byte ^= bits & random.next() as u8;
                self.noise.set(random.0);
            }
        }
    }

    fn start(&mut self, operation: Started) -> Result<(), FlashFault> {
        match operation {
            Started::Erase(sector) => {
                assert_eq!(self.chip.sector(sector.number), Some(sector), "no such sector");
                self.begin(Operation::Erase(sector.region))
            }
            Started::Program { address, word } => {
                assert!(self.chip.flash.contains(address, 4) && address.is_multiple_of(4), "{address:#x}");
                self.begin(Operation::Program { address, word })
            }
        }
    }

    fn is_protected(&self, sector: Sector) -> bool {
        self.protected.contains(&sector.number)
    }

    fn supply(&self) -> Supply {
        match self.low_from {
            Some(number) if self.operations + 1 >= number => Supply::Low,
            _ => Supply::Good,
        }
    }

    fn option_bytes(&self) -> u32 {
        self.option_bytes
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        assert!(self.running.is_none(), "the store was asked while the flash is busy");
        self.chip.sector_at(address)
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        let Some(operation) = self.running else { return Poll::Ready(Ok(())) };
        if self.polls_left > 0 {
            self.polls_left -= 1;
            return Poll::Pending;
        }
        self.running = None;
        if let Some((number, error)) = self.fail {
            if number == self.operations {
                return Poll::Ready(Err(error));
            }
        }
        match self.weak {
            Some((number, seed)) if number == self.operations => self.tear(operation, seed, false),
            _ => self.complete(operation),
        }
        Poll::Ready(Ok(()))
    }
}

/// Runs `scenario`; returns whether the power was cut in it.
pub fn until_power_cut(scenario: impl FnOnce()) -> bool {
    quiet_power_cuts();
    let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(scenario));
    match outcome {
        Ok(()) => false,
        Err(cause) if cause.is::<PowerCut>() => true,
        Err(cause) => std::panic::resume_unwind(cause),
    }
}

thread_local! {
    /// Whether a panic of this thread is caught and not printed.
    static CAUGHT: Cell<bool> = const { Cell::new(false) };
}

/// Catches a panic, of a power cut or of the bootloader, without printing it.
pub fn caught<T>(act: impl FnOnce() -> T) -> std::thread::Result<T> {
    quiet_power_cuts();
    let before = CAUGHT.replace(true);
    let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(act));
    CAUGHT.set(before);
    outcome
}

/// Suppresses the output of power cuts, which are panics, and of panics in [`caught`]; once for
/// the process.
fn quiet_power_cuts() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let default = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if !CAUGHT.get() && !info.payload().is::<PowerCut>() {
                default(info);
            }
        }));
    });
}

/// A flash that outlives a bootloader: all copies refer to the same contents.
#[derive(Clone)]
pub struct Chip(Rc<RefCell<ModelFlash>>);

impl Chip {
    pub fn new(flash: ModelFlash) -> Self {
        Self(Rc::new(RefCell::new(flash)))
    }

    /// As a debug probe sees it.
    pub fn model(&self) -> RefMut<'_, ModelFlash> {
        self.0.borrow_mut()
    }
}

impl Flash for Chip {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        self.0.borrow().read(address, buffer);
    }

    fn start(&mut self, operation: Started) -> Result<(), FlashFault> {
        self.model().start(operation)
    }

    fn is_protected(&self, sector: Sector) -> bool {
        self.0.borrow().is_protected(sector)
    }

    fn supply(&self) -> Supply {
        self.0.borrow().supply()
    }

    fn option_bytes(&self) -> u32 {
        self.0.borrow().option_bytes()
    }

    fn sector_at(&self, address: u32) -> Option<Sector> {
        self.0.borrow().sector_at(address)
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        self.model().poll()
    }
}
