//! The check of a program before it starts. What becomes of it then: `choice.rs`.

use boot_core::canopen::BitRate;
use boot_core::crc::CrcKind;
use boot_core::decision::{choose, Exit, Images, Policy, Woken};
use boot_core::flash::{run, Flash as _};
use boot_core::program::{verify, Invalid, VerifiedProgram};
use boot_core::store::{Journal, Key, Parameters, ProgramRecord, Value};
use kit::model::ModelFlash;
use shared_abi::boot_report::Reason;
use shared_abi::geometry::Region;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;
use shared_abi::vectors::VectorFault;

fn store(flash: &mut ModelFlash, journal: &mut Journal, key: Key, value: Value) {
    journal.store(key, value);
    run(flash, |flash, outcome| journal.next(flash, outcome)).unwrap();
}

/// A released program of 64 bytes as a download leaves it, and its check.
fn check(damage: impl FnOnce(&mut ModelFlash)) -> Result<VerifiedProgram, Invalid> {
    let mut flash = ModelFlash::new(LAYOUT.chip);
    let mut bytes = vec![0xA5; 64];
    bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&0x0802_0189_u32.to_le_bytes());
    flash.poke(0x0802_0000, &bytes);
    let mut journal = Journal::open(&flash, LAYOUT.parameters);
    store(
        &mut flash,
        &mut journal,
        Key::program(1),
        ProgramRecord::released(64, boot_core::crc32(&bytes)).value(),
    );
    damage(&mut flash);
    verify(&flash, &Journal::open(&flash, LAYOUT.parameters), &LAYOUT, CrcKind::Crc32, 1)
}

/// A record that is longer than its program's flash is no program, even if the CRC of what follows
/// there is right: one bit of a size must not let the check read into another region.
#[test]
fn a_program_ends_inside_its_region() {
    let region = LAYOUT.programs[0];
    let verified = |size: u32| {
        let mut flash = ModelFlash::new(LAYOUT.chip);
        let vectors = [0x2001_FFC0_u32, region.base + 0x189].map(u32::to_le_bytes).concat();
        flash.poke(region.base, &vectors);
        let mut bytes = vec![0; size as usize];
        flash.read(region.base, &mut bytes);
        let mut journal = Journal::open(&flash, LAYOUT.parameters);
        store(
            &mut flash,
            &mut journal,
            Key::program(1),
            ProgramRecord::released(size, boot_core::crc32(&bytes)).value(),
        );
        verify(&flash, &Journal::open(&flash, LAYOUT.parameters), &LAYOUT, CrcKind::Crc32, 1).map(|_| ())
    };
    assert_eq!(verified(region.size), Ok(()));
    for more in [1, 4, 1024, 1025, 0x1_0000] {
        assert_eq!(verified(region.size + more), Err(Invalid::Size), "{more} bytes too long");
    }
}

#[test]
fn any_damage_to_a_program_keeps_it_from_starting() {
    for offset in 8..64 {
        for bit in 0..8 {
            let damaged = check(|flash| flash.poke(0x0802_0000 + offset, &[0xA5 ^ 1 << bit]));
            assert_eq!(damaged, Err(Invalid::Crc));
        }
    }
    let erased = check(|flash| flash.poke(0x0802_0000, &[0xFF; 64]));
    assert_eq!(erased, Err(Invalid::Vectors(VectorFault::StackPointer)));
    assert!(check(|flash| flash.poke(0x0802_0040, &[0])).is_ok(), "what lies behind its size is not its own");
}

/// A chip that had the map with the bootloader in sectors 0 and 1, its journal in 2 and 3 and its program from
/// sector 4 on, gets today's: sector 1 has code, and sector 2 a whole journal with the record of a program
/// that is not where it says. Nothing starts, for a reason that has a name, and each value can be stored.
#[test]
fn a_journal_of_the_map_before_this_one_starts_nothing_and_can_be_written() {
    let before = [Region::new(0x0800_8000, 0x4000), Region::new(0x0800_C000, 0x4000)];
    assert_eq!(LAYOUT.parameters.map(|region| region.base), [0x0800_4000, before[0].base]);
    // A slot has 28 bytes: after more than 585 stores the other region has the values.
    let blank = (vec![], Invalid::Vectors(VectorFault::StackPointer), Reason::Vectors);
    let vectors = [0x2001_FFC0_u32, 0x0802_0189].map(u32::to_le_bytes).concat();
    for (stores, (there, invalid, reason)) in
        [(1, blank.clone()), (600, blank), (600, (vectors, Invalid::Crc, Reason::Damaged))]
    {
        let mut flash = ModelFlash::new(LAYOUT.chip);
        let program = [0xA5; 64];
        flash.poke(0x0801_0000, &program);
        let mut journal = Journal::open(&flash, before);
        store(
            &mut flash,
            &mut journal,
            Key::program(1),
            ProgramRecord::released(64, boot_core::crc32(&program)).value(),
        );
        for count in 0..stores {
            store(&mut flash, &mut journal, Key::CRASH_COUNT, [count % 3, 0, 0, 0]);
        }
        flash.poke(0x0800_4000, &[0x4B; 0x3000]);
        flash.poke(0x0802_0000, &there);

        let mut journal = Journal::open(&flash, LAYOUT.parameters);
        let found = verify(&flash, &journal, &LAYOUT, CrcKind::Crc32, 1);
        assert_eq!(found, Err(invalid), "{stores} stores");
        let woken = Woken::power_on(5, BitRate::K125);
        let policy = Policy::plain(&LAYOUT, &[1]);
        let Exit::Bootloader { stay, .. } = choose(&woken, &Images::SOUND, &flash, &journal, &policy).exit
        else {
            panic!("it starts")
        };
        // 1F57h/1 says that it is no valid program.
        assert_eq!((stay.reason, stay.refused), (reason, 1));
        for count in 0..600 {
            store(&mut flash, &mut journal, Key::NODE, [count, 1, 0, 0]);
            let again = Journal::open(&flash, LAYOUT.parameters);
            assert_eq!(again.get(&flash, Key::NODE), Some([count, 1, 0, 0]), "{stores} stores");
        }
        assert_eq!(flash.cells(Region::new(0x0801_0000, 64)), program, "outside of the journal");
    }
}
