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
    let panic = catch_unwind(|| layout.checked()).expect_err("the layout was accepted");
    panic
        .downcast_ref::<&str>()
        .map_or_else(|| panic.downcast_ref::<String>().cloned().unwrap_or_default(), |s| (*s).to_owned())
}

/// A layout file lives as long as the program, and so do the regions made here.
fn programs(regions: &[(u32, u32)]) -> &'static [Region] {
    regions.iter().map(|&(base, size)| Region::new(base, size)).collect::<Vec<_>>().leak()
}

#[test]
fn each_broken_rule_is_named() {
    const KIB: u32 = 1024;
    let cases: Vec<(String, &str)> = vec![
        (broken(|l| l.bootloader.base = 0x0800_4000), "must start at the base of the flash"),
        (broken(|l| l.bootloader.size = 33 * KIB), "the bootloader must end at a sector border"),
        (broken(|l| l.callgate_offset = 0x3C), "the callgate overlaps the bootloader's vector table"),
        (broken(|l| l.callgate_offset = 16 * KIB), "the callgate lies outside the bootloader"),
        (
            broken(|l| l.parameters[0].size = 8 * KIB),
            "a parameter region must start and end at sector borders",
        ),
        (broken(|l| l.parameters[0].base = 0x0800_0000), "a parameter region overlaps the bootloader"),
        (broken(|l| l.parameters[1] = l.parameters[0]), "the two parameter regions overlap"),
        (broken(|l| l.programs = &[]), "there must be 1 to 254 programs"),
        (
            broken(|l| l.programs = programs(&[(0x0801_0000, 100 * KIB)])),
            "a program must start and end at sector borders",
        ),
        (
            broken(|l| l.programs = programs(&[(0x0801_1000, 60 * KIB)])),
            "a program must start and end at sector borders",
        ),
        (broken(|l| l.programs = programs(&[(0x0800_0000, 16 * KIB)])), "a program overlaps the bootloader"),
        (broken(|l| l.programs = programs(&[(0x0801_0000, 64 * KIB)])), "a program overlaps the bootloader"),
        (
            broken(|l| l.programs = programs(&[(0x0800_8000, 16 * KIB)])),
            "a program overlaps a parameter region",
        ),
        (
            broken(|l| l.programs = programs(&[(0x0802_0000, 256 * KIB), (0x0804_0000, 128 * KIB)])),
            "two programs overlap",
        ),
        (
            broken(|l| l.home = Some(Region::new(0x0801_0000, 32 * KIB))),
            "the home of the RAM image must start and end at sector borders",
        ),
        (
            broken(|l| l.home = Some(Region::new(0x0800_0000, 16 * KIB))),
            "the home of the RAM image overlaps the bootloader",
        ),
        (
            broken(|l| l.home = Some(Region::new(0x0800_4000, 16 * KIB))),
            "the home of the RAM image overlaps a parameter region",
        ),
        (broken(|l| l.data = Some(Region::new(0x0800_C000, 17 * KIB))), "the data region must start and end"),
        (broken(|l| l.data = l.home), "the data region overlaps the bootloader"),
        (broken(|l| l.data = Some(l.bootloader)), "the data region overlaps the bootloader"),
        (broken(|l| l.data = Some(l.parameters[1])), "the data region overlaps a parameter region"),
        (broken(|l| l.programs = programs(&[(0x0800_C000, 16 * KIB)])), "a program overlaps the data region"),
        (
            broken(|l| {
                l.home = None;
                l.staging = Some(Region::new(0x080E_0000, 128 * KIB));
            }),
            "a staging region needs a home",
        ),
        (broken(|l| l.staging = Some(Region::new(0x080C_0000, 256 * KIB))), "must be the last sector"),
        (broken(|l| l.staging = Some(Region::new(0x080C_0000, 128 * KIB))), "must be the last sector"),
        (
            broken(|l| {
                l.programs = programs(&[(0x080E_0000, 128 * KIB)]);
                l.staging = Some(Region::new(0x080E_0000, 128 * KIB));
            }),
            "and not its only one",
        ),
        (broken(|l| l.ram.size = 256 * KIB), "the RAM of the images lies outside the chip's SRAM"),
        (broken(|l| l.ram.size -= 4), "must be a multiple of 8"),
        (broken(|l| l.ram.size += 8), "lies inside the RAM of the images"),
        (broken(|l| l.handoff = Region::new(0x2001_FFC8, 48)), "the handoff overlaps the warm-start cell"),
        (broken(|l| l.handoff.size = 40), "the handoff region has not the size of the handoff"),
        (broken(|l| l.warm_start = Region::new(0x2001_FFF0, 12)), "has not the size of the warm-start cell"),
        (
            broken(|l| {
                l.warm_start = Region::new(0x2001_FFC0, 16);
                l.handoff = Region::new(0x2001_FFD0, 48);
            }),
            "must be the last RAM cell",
        ),
        (broken(|l| l.callgate_offset = 16 * KIB - 4), "the callgate lies outside the bootloader"),
        (
            broken(|l| l.programs = programs(&[(0x0801_0000, 64 * KIB); 255])),
            "there must be 1 to 254 programs",
        ),
        (broken(|l| l.programs = programs(&[(0x0802_0000, 128 * KIB); 254])), "two programs overlap"),
        (
            broken(|l| {
                l.ram.size -= 8;
                l.handoff.base -= 2;
            }),
            "must be word-aligned",
        ),
        (broken(|l| l.warm_start.base += 2), "must be word-aligned"),
    ];
    for (message, rule) in cases {
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
    for wrong in [(0x0802_0000, 0), (0xFFFF_FF00, 0x101)] {
        let message = broken(|l| l.programs = programs(&[(0x0804_0000, 128 * 1024), wrong]));
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
        let panic = catch_unwind(|| geometry.checked()).expect_err(message);
        let said = panic
            .downcast_ref::<&str>()
            .copied()
            .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
            .unwrap_or_default();
        assert!(said.contains(message), "{said}, not {message}");
    }
}
