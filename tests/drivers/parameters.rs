//! The EEPROM of `docs/eeprom.md`: a power cut at each write, chips that do wrong, and a bootloader with it.

use std::cell::RefCell;
use std::rc::Rc;

use boot_core::bootloader::{Bootloader, Everything};
use boot_core::control::Step;
use boot_core::crc::CrcKind;
use boot_core::flash::run;
use boot_core::program::verify;
use boot_core::store::{Key, Parameters, StoreError, Value};
use canopen::od::Objects;
use kit::bench::{block_file, node, program, CLEAR, CONFIG, CONTROL, DATA, LAYOUT, SET_SIGNATURE};
use kit::boot::{leaked, Boot};
use kit::model::{ModelFlash, CHIP};
use kit::random::Random;

use crate::eeprom::{
    InEeprom, Spi, BUSY, PAGE, READ, READ_STATUS, SLOTS, WRITE, WRITE_ENABLE, WRITE_ENABLED,
};

const PAGE_BYTES: usize = PAGE as usize;
const KEYS: [Key; 3] = [Key::NODE, Key::program(1), Key::CRASH_COUNT];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cut {
    Before,
    After,
    /// Any bits of the whole page.
    Torn,
    /// The page is written, and any bits of it read otherwise each time.
    Unstable,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lie {
    Absent,
    Low,
    Protected,
    NeverEnds,
    StuckBit,
}

/// A chip that takes nothing that a real one would ignore.
#[derive(Clone)]
struct Chip {
    cells: Vec<u8>,
    /// The bits of pages that read otherwise each time.
    unstable: Vec<(usize, u8)>,
    latch: bool,
    busy: u8,
    writes: u32,
    /// The power fails in this write; the chip takes nothing after it.
    cut: Option<(u32, Cut)>,
    is_off: bool,
    lie: Option<Lie>,
    random: u64,
}

#[derive(Clone)]
struct Bus(Rc<RefCell<Chip>>);

impl Bus {
    fn new() -> Self {
        let cells = vec![0xFF; 4 * SLOTS as usize * PAGE_BYTES];
        let (unstable, cut, lie) = (Vec::new(), None, None);
        Self::of(Chip {
            cells,
            unstable,
            latch: false,
            busy: 0,
            writes: 0,
            cut,
            is_off: false,
            lie,
            random: 7,
        })
    }

    fn of(chip: Chip) -> Self {
        Self(Rc::new(RefCell::new(chip)))
    }

    fn get(&self, key: Key) -> Option<Value> {
        InEeprom::open(self.clone()).get(&ModelFlash::new(&CHIP), key)
    }

    fn store(&self, key: Key, value: Value) -> Result<(), StoreError> {
        let mut eeprom = InEeprom::open(self.clone());
        eeprom.store(key, value);
        run(&mut ModelFlash::new(&CHIP), |flash, outcome| eeprom.next(flash, outcome))
    }

    /// The power returns, and fails again in this write.
    fn again(&self, cut: Option<(u32, Cut)>) -> Self {
        let chip = self.0.borrow().clone();
        Self::of(Chip { latch: false, busy: 0, writes: 0, is_off: false, cut, ..chip })
    }
}

impl Chip {
    fn write(&mut self, at: usize, bytes: &[u8]) {
        assert!(core::mem::take(&mut self.latch), "without the write enable latch the chip ignores it");
        let page = at - at % PAGE_BYTES;
        assert!(at + bytes.len() <= page + PAGE_BYTES, "a write that leaves its page wraps");
        (self.writes, self.busy) = (self.writes + 1, 3);
        let cut = self.cut.filter(|(write, _)| *write == self.writes).map(|(_, cut)| cut);
        self.is_off = cut.is_some();
        if cut == Some(Cut::Before) {
            return;
        }
        self.unstable.retain(|(byte, _)| *byte / PAGE_BYTES != page / PAGE_BYTES);
        self.cells[at..at + bytes.len()].copy_from_slice(bytes);
        let mut random = Random(self.random);
        match cut {
            // With a few bits of the old content, and a few of erased cells.
            Some(Cut::Torn) => {
                (page..page + PAGE_BYTES)
                    .for_each(|byte| self.cells[byte] ^= random.next() as u8 & random.next() as u8);
            }
            // A record that reads right now and wrong later is the worst: few bits.
            Some(Cut::Unstable) => {
                let bits = (0..2).map(|_| (page + random.below(28), 1 << random.below(8)));
                self.unstable.extend(bits);
            }
            _ => {}
        }
        self.random = random.next();
    }
}

impl Spi for Bus {
    fn transfer(&mut self, bytes: &[u8], answer: &mut [u8]) {
        let chip = &mut *self.0.borrow_mut();
        match chip.lie {
            Some(Lie::Absent) => return answer.fill(0xFF),
            Some(Lie::Low) => return answer.fill(0),
            _ if chip.is_off => return answer.fill(0xFF),
            _ => assert!(chip.busy == 0 || bytes == [READ_STATUS], "a busy chip ignores other commands"),
        }
        match bytes {
            [READ_STATUS] => {
                let latch = if chip.latch { WRITE_ENABLED } else { 0 };
                answer[0] = latch | if chip.busy > 0 { BUSY } else { 0 };
                chip.busy -= u8::from(chip.busy > 0 && chip.lie != Some(Lie::NeverEnds));
            }
            [WRITE_ENABLE] => chip.latch = chip.lie != Some(Lie::Protected),
            [READ, high, low] => {
                let at = usize::from(u16::from_be_bytes([*high, *low]));
                answer.copy_from_slice(&chip.cells[at..at + answer.len()]);
                let mut random = Random(chip.random);
                for (byte, bits) in &chip.unstable {
                    if let Some(byte) = byte.checked_sub(at).and_then(|at| answer.get_mut(at)) {
                        *byte ^= random.next() as u8 & bits;
                    }
                }
                chip.random = random.next();
                let stuck = u8::from(chip.lie == Some(Lie::StuckBit));
                answer.iter_mut().for_each(|byte| *byte |= stuck);
            }
            [WRITE, high, low, data @ ..] => {
                chip.write(usize::from(u16::from_be_bytes([*high, *low])), data);
            }
            other => panic!("the chip does not know {other:02X?}"),
        }
    }
}

/// The value of a store.
fn value(number: u32) -> Value {
    [number, !number, number << 9, 1]
}

/// Stores until the power fails, from this number on; returns how many were acknowledged.
fn history(bus: &Bus, count: u32) -> u32 {
    (1..=count).take_while(|number| bus.store(KEYS[*number as usize % 3], value(*number)).is_ok()).count()
        as u32
}

/// Reads each key as often as bits between 0 and 1 need it: the acknowledged value, or the one in flight.
fn check(bus: &Bus, done: u32, in_flight: u32, at: &str) {
    for (place, key) in KEYS.into_iter().enumerate() {
        let last = |upto: u32| (1..=upto).rev().find(|number| *number as usize % 3 == place).map(value);
        for _ in 0..6 {
            let found = bus.get(key);
            assert!([last(done), last(in_flight)].contains(&found), "{at}, {key:?}: {found:X?}");
        }
    }
}

/// Past the first change of regions, whose erase the first cuts of the second half are in.
const STORES: u32 = SLOTS + 6;

#[test]
fn after_a_cut_at_each_write_the_old_or_the_new_value_is_read() {
    let whole = Bus::new();
    assert_eq!(history(&whole, STORES), STORES);
    let writes = whole.0.borrow().writes;
    check(&whole, STORES, STORES, "no cut");
    assert!(writes > 7 * STORES + SLOTS, "{writes}: the other region was not erased");
    // The first stores and the change of regions: all; between them they are all alike.
    let (mut cuts, change) = (0, writes - 9 * 7 - 2 * SLOTS);
    for write in (1..30).chain(change..=writes) {
        for cut in [Cut::Before, Cut::After, Cut::Torn, Cut::Unstable] {
            let at = format!("{cut:?} at write {write}");
            let bus = Bus::new().again(Some((write, cut)));
            let done = history(&bus, STORES);
            let bus = bus.again(None);
            check(&bus, done, done + 1, &at);
            // The store again, with a second cut in it; then without one.
            let next = (KEYS[(done + 1) as usize % 3], value(done + 1));
            for second in (1..9).map(|write| Some((write, cut))) {
                let cut_again = bus.again(second);
                let _ = cut_again.store(next.0, next.1);
                check(&cut_again.again(None), done, done + 1, &format!("{at}, then {second:?}"));
                cuts += 1;
            }
            assert_eq!(bus.store(next.0, next.1), Ok(()), "{at}");
            check(&bus, done + 1, done + 1, &at);
            let before = bus.0.borrow().writes;
            assert_eq!(bus.store(next.0, next.1), Ok(()), "{at}");
            assert_eq!(bus.0.borrow().writes, before, "{at}: a value that stands is not written again");
        }
    }
    assert!(cuts > 5000, "{cuts}");
}

#[test]
fn a_chip_that_does_wrong_ends_with_an_error_and_no_value() {
    for lie in [Lie::Absent, Lie::Low, Lie::Protected, Lie::NeverEnds, Lie::StuckBit] {
        let bus = Bus::new();
        bus.0.borrow_mut().lie = Some(lie);
        assert_eq!(bus.get(Key::NODE), None, "{lie:?}");
        assert!(bus.store(Key::NODE, value(2)).is_err(), "{lie:?}");
    }
}

/// An update as on a device with the journal, and the next power-on finds it.
#[test]
fn a_bootloader_installs_a_program_with_its_record_in_the_eeprom() {
    let bus = Bus::new();
    let image = program(700, 3);
    let mut flash = ModelFlash::new(&CHIP);
    let settle = |device: &mut Bootloader<'_, &mut ModelFlash, InEeprom<Bus>, 1, Everything>| {
        assert!((0..1_000_000).any(|_| device.step() == Step::Idle), "the work does not end");
    };
    let (buffer, sealed) = leaked(4096);
    let mut device = Boot::new(&CONFIG, node()).with(InEeprom::open(bus.clone()), &mut flash, buffer, sealed);
    device.write(CONTROL, &[CLEAR]).unwrap();
    settle(&mut device);
    for block in block_file(&image, 96) {
        device.download_start(DATA, Some(block.len() as u32)).unwrap();
        device.download_data(DATA, &block).unwrap();
        device.download_end(DATA).unwrap();
        settle(&mut device);
    }
    device.write(CONTROL, &[SET_SIGNATURE]).unwrap();
    settle(&mut device);
    drop(device);
    let found = verify(&flash, &InEeprom::open(bus.again(None)), &LAYOUT, CrcKind::Crc32, 1);
    assert!(found.is_ok_and(|program| program.signed), "{found:?}");
    let journal = LAYOUT.parameters.map(|region| flash.cells(region).iter().all(|byte| *byte == 0xFF));
    assert_eq!(journal, [true; 2], "nothing of it is in the flash");
}
