//! Every rule of the layout: a layout that breaks it is refused with a message that names the rule.
//!
//! `checked` is a `const fn` that the board files call in a constant, so a panic here is a compile
//! error there.

use std::panic::catch_unwind;

use shared_abi::geometry::{Geometry, Region, SectorRun, STM32F446RE};
use shared_abi::layout::stm32f407g_disc1::LAYOUT;
use shared_abi::layout::Layout;

fn broken(change: impl FnOnce(&mut Layout)) -> String {
    let mut layout = LAYOUT;
    change(&mut layout);
    message_of(|| layout.checked())
}

/// The message of a check, which fails the build with it.
fn message_of<T>(check: impl FnOnce() -> T + std::panic::UnwindSafe) -> String {
    let Err(panic) = catch_unwind(check) else { panic!("it was accepted") };
    match panic.downcast::<String>() {
        Ok(text) => *text,
        Err(panic) => panic.downcast_ref::<&str>().map(|text| (*text).to_owned()).unwrap_or_default(),
    }
}

const KIB: u32 = 1024;

/// A rule, and a change that breaks it.
type Case = (&'static str, fn(&mut Layout));

const OF_THE_BOOTLOADER: [Case; 20] = [
    ("must start at the base of the flash", |l| l.bootloader.base = 0x0800_4000),
    ("the bootloader must end at a sector border", |l| l.bootloader.size = 33 * KIB),
    ("the callgate overlaps the bootloader's vector table", |l| l.callgate_offset = 0x3C),
    ("the callgate lies outside the bootloader", |l| l.callgate_offset = 16 * KIB),
    ("the callgate lies outside the bootloader", |l| l.callgate_offset = 16 * KIB - 4),
    ("a parameter region must start and end at sector borders", |l| l.parameters[0].size = 8 * KIB),
    ("a parameter region overlaps the bootloader", |l| l.parameters[0].base = 0x0800_0000),
    ("the two parameter regions overlap", |l| l.parameters[1] = l.parameters[0]),
    ("the home of the RAM image must start and end at sector borders", |l| home(l, 0x0801_0000, 32)),
    ("the home of the RAM image overlaps the bootloader", |l| home(l, 0x0800_0000, 16)),
    ("the home of the RAM image overlaps a parameter region", |l| home(l, 0x0800_4000, 16)),
    ("the data region must start and end", |l| l.data = Some(Region::new(0x0800_C000, 17 * KIB))),
    ("the data region overlaps the bootloader", |l| l.data = l.home),
    ("the data region overlaps the bootloader", |l| l.data = Some(l.bootloader)),
    ("the data region overlaps a parameter region", |l| l.data = Some(l.parameters[1])),
    ("a staging region needs a home", |l| {
        l.home = None;
        staging(l, 0x080E_0000, 128);
    }),
    ("must be the last sector", |l| staging(l, 0x080C_0000, 256)),
    ("must be the last sector", |l| staging(l, 0x080C_0000, 128)),
    ("must be the last sector", |l| staging(l, 0x080F_0000, 64)),
    ("and not its only one", |l| {
        programs(l, &[(0x080E_0000, 128)]);
        staging(l, 0x080E_0000, 128);
    }),
];

const OF_PROGRAMS: [Case; 10] = [
    ("there must be 1 to 254 programs", |l| programs(l, &[])),
    ("there must be 1 to 254 programs", |l| programs(l, &[(0x0801_0000, 64); 255])),
    ("a program must start and end at sector borders", |l| programs(l, &[(0x0801_0000, 100)])),
    ("a program must start and end at sector borders", |l| programs(l, &[(0x0801_1000, 60)])),
    ("a program overlaps the bootloader", |l| programs(l, &[(0x0800_0000, 16)])),
    ("a program overlaps the bootloader", |l| programs(l, &[(0x0801_0000, 64)])),
    ("a program overlaps a parameter region", |l| programs(l, &[(0x0800_8000, 16)])),
    ("a program overlaps the data region", |l| programs(l, &[(0x0800_C000, 16)])),
    ("two programs overlap", |l| programs(l, &[(0x0802_0000, 256), (0x0804_0000, 128)])),
    ("two programs overlap", |l| programs(l, &[(0x0802_0000, 128); 254])),
];

const OF_THE_RAM: [Case; 9] = [
    ("the RAM of the images lies outside the chip's SRAM", |l| l.ram.size = 256 * KIB),
    ("must be a multiple of 8", |l| l.ram.size -= 4),
    ("lies inside the RAM of the images", |l| l.ram.size += 8),
    ("the handoff overlaps the warm-start cell", |l| l.handoff = Region::new(0x2001_FFC8, 48)),
    ("the handoff region has not the size of the handoff", |l| l.handoff.size = 40),
    ("has not the size of the warm-start cell", |l| l.warm_start = Region::new(0x2001_FFF0, 12)),
    ("must be the last RAM cell", |l| {
        l.warm_start = Region::new(0x2001_FFC0, 16);
        l.handoff = Region::new(0x2001_FFD0, 48);
    }),
    ("must be word-aligned", |l| {
        l.ram.size -= 8;
        l.handoff.base -= 2;
    }),
    ("must be word-aligned", |l| l.warm_start.base += 2),
];

fn home(layout: &mut Layout, base: u32, kib: u32) {
    layout.home = Some(Region::new(base, kib * KIB));
}

fn staging(layout: &mut Layout, base: u32, kib: u32) {
    layout.staging = Some(Region::new(base, kib * KIB));
}

/// A layout file lives as long as the program, and so do the regions made here, with sizes in KiB.
fn programs(layout: &mut Layout, regions: &[(u32, u32)]) {
    layout.programs =
        regions.iter().map(|&(base, kib)| Region::new(base, kib * KIB)).collect::<Vec<_>>().leak();
}

#[test]
fn each_broken_rule_is_named() {
    for (rule, change) in [&OF_THE_BOOTLOADER[..], &OF_PROGRAMS, &OF_THE_RAM].concat() {
        let message = broken(change);
        assert!(message.contains(rule), "expected {rule:?}, got {message:?}");
    }
}

#[test]
fn no_region_is_empty_or_reaches_over_the_end_of_the_address_space() {
    let regions: [fn(&mut Layout) -> &mut Region; 9] = [
        |l| &mut l.bootloader,
        |l| &mut l.parameters[0],
        |l| &mut l.parameters[1],
        |l| &mut l.ram,
        |l| &mut l.handoff,
        |l| &mut l.warm_start,
        |l| l.home.as_mut().unwrap(),
        |l| l.data.as_mut().unwrap(),
        |l| l.staging.get_or_insert(Region::new(0x080E_0000, 128 * 1024)),
    ];
    for region in regions {
        for wrong in [Region::new(region(&mut { LAYOUT }).base, 0), Region::new(0xFFFF_FF00, 0x101)] {
            assert!(broken(|l| *region(l) = wrong).contains("a region is empty"));
        }
    }
    for wrong in [Region::new(0x0802_0000, 0), Region::new(0xFFFF_FF00, 0x101)] {
        let message = broken(|l| l.programs = vec![Region::new(0x0804_0000, 128 * KIB), wrong].leak());
        assert!(message.contains("a region is empty"), "{message}");
    }
}

/// The purpose of the check: the same values with one mistake each.
#[test]
fn a_geometry_that_no_chip_has_is_refused() {
    let wrong: [(&str, Geometry); 8] = [
        (
            "flash or SRAM of the chip is empty",
            Geometry { flash: Region::new(0xFFFF_0000, 512 * 1024), ..STM32F446RE },
        ),
        ("flash or SRAM of the chip is empty", Geometry { sram: Region::new(0x2000_0000, 0), ..STM32F446RE }),
        (
            "the sectors do not add up",
            Geometry { flash: Region::new(0x0800_0000, 1024 * 1024), ..STM32F446RE },
        ),
        (
            "16, 64 or 128 KiB",
            Geometry { sectors: &[SectorRun { count: 16, size: 32 * 1024 }], ..STM32F446RE },
        ),
        (
            "more than 24 sectors",
            Geometry { sectors: &[SectorRun { count: 32, size: 16 * 1024 }], ..STM32F446RE },
        ),
        ("8 or 12 sectors each", Geometry { second_bank: Some(4), ..STM32F446RE }),
        ("interrupt lines", Geometry { interrupts: 113, ..STM32F446RE }),
        ("whole pages", Geometry { sram: Region::new(0x2000_0000, 1000), ..STM32F446RE }),
    ];
    for (message, geometry) in wrong {
        let said = message_of(|| geometry.checked());
        assert!(said.contains(message), "{said}, not {message}");
    }
}
