//! The journal of parameters on two sectors of any contents.
//!
//! Must hold: opening and reading survive any contents; a successfully stored value reads back, now
//! and after the next start, and the other value does not change.
#![cfg_attr(fuzzing, no_main)]

use boot_core::flash::run;
use boot_core::store::{Journal, Key, Parameters};
use coboot_fuzz::Input;
use kit::model::ModelFlash;
use shared_abi::geometry::{Geometry, Region, SectorRun, STM32F407VG};

static CHIP: Geometry = Geometry {
    chip: "two-sectors",
    flash: Region::new(0x0800_0000, 0x400),
    sectors: &[SectorRun { count: 2, size: 0x200 }],
    ..STM32F407VG
};
const REGIONS: [Region; 2] = [Region::new(0x0800_0000, 0x200), Region::new(0x0800_0200, 0x200)];
const KEYS: [Key; 3] = [Key::program(1), Key::program(2), Key::CRASH_COUNT];

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let mut flash = ModelFlash::new(&CHIP);
    let Some([fills, stores]) = input.array() else { return };
    for _ in 0..fills % 8 {
        let Some([low, high, len]) = input.array() else { break };
        let at = u32::from(u16::from_le_bytes([low, high]) % 0x400);
        let most = (0x400 - at).min(len.into()) as usize;
        flash.poke(0x0800_0000 + at, input.take(most));
    }
    let mut journal = Journal::open(&flash, REGIONS);
    for i in 0..stores {
        let Some([which, byte]) = input.array() else { break };
        let key = KEYS[usize::from(which) % KEYS.len()];
        let value = [u32::from(byte), u32::from(i), u32::MAX, 0];
        let before = KEYS.map(|key| journal.get(&flash, key));
        journal.store(key, value);
        let mut operations = 0;
        let outcome = run(&mut flash, |flash, outcome| {
            operations += 1;
            assert!(operations < 100_000, "a store that never ends");
            journal.next(flash, outcome)
        });
        if which & 0x80 != 0 {
            flash.power_on();
            journal = Journal::open(&flash, REGIONS);
        }
        for (other, before) in KEYS.into_iter().zip(before) {
            let now = journal.get(&flash, other);
            if other != key {
                assert_eq!(now, before, "{other:?} changed while {key:?} was stored");
            } else if outcome.is_ok() {
                assert_eq!(now, Some(value), "{key:?} does not read back");
            }
        }
    }
});
