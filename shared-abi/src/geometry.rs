//! The properties of the chips, as their reference manuals state them (section 3 "Embedded flash
//! memory" and section 2 "Memory map" of RM0090 rev 19 for STM32F405 to F439, RM0402 for F412,
//! RM0430 for F413 and F423, RM0390 for F446, RM0386 for F469 and F479). Nothing here is a choice
//! of this project; the choices are in [`crate::layout`].
//!
//! A chip is defined by its line ([`Line`]) and the size of its flash. Its name gives both, and the
//! package.

mod chip;
mod chips;
mod line;
mod pins;

pub use chip::{Geometry, Region, Sector, SectorRun, CORE_VECTORS, CORE_VECTORS_SIZE, OTP, SYSTEM_MEMORY};
pub use chips::*;
pub use line::{Limits, Line};
pub use pins::{is_debug_pin, CanLine, Pin};

/// The chip with this name, in the usual spellings ([`Geometry::is_named`]).
#[must_use]
pub fn by_name(name: &str) -> Option<&'static Geometry> {
    CHIPS.iter().copied().find(|chip| chip.is_named(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The order codes of the data sheet (DS8626, ordering information): package and range after the
    /// code, then options.
    #[test]
    fn a_chip_is_named_by_its_order_code() {
        for (name, expected) in [
            ("STM32F407VG", true),
            ("stm32f407vg", true),
            ("STM32F407VGT6", true),
            ("STM32F407VGT6TR", true),
            ("STM32F407VGH6ABC", true),
            ("STM32F407VGH6ABCD", false),
            ("STM32F407VGT", false),
            ("STM32F407VG66", false),
            ("STM32F407VGTT", false),
            ("STM32F407VGT6-R", false),
            ("STM32F407VE", false),
            ("STM32F407V", false),
            ("", false),
        ] {
            assert_eq!(STM32F407VG.is_named(name), expected, "{name}");
        }
    }

    #[test]
    fn a_region_contains_what_lies_between_its_ends() {
        let region = Region::new(0x100, 0x10);
        for (address, len, expected) in [
            (0x100, 0x10, true),
            (0x10F, 1, true),
            (0x100, 0, true),
            (0x10F, 0, true),
            (0x110, 0, false),
            (0x110, 1, false),
            (0x10F, 2, false),
            (0x0FF, 1, false),
            (0x0FF, 0, false),
            (0x100, 0x11, false),
            (0x100, u32::MAX, false),
            (u32::MAX, u32::MAX, false),
        ] {
            assert_eq!(region.contains(address, len), expected, "{address:#x}, {len:#x}");
        }
    }

    #[test]
    fn whole_sectors_are_one_at_least() {
        for (base, kib, expected) in [
            (0x0800_4000, 16, true),
            (0x0800_4000, 0, false),
            (0x0800_0000, 64, true),
            (0x0800_4000, 17, false),
            (0x0800_4400, 15, false),
        ] {
            let region = Region::new(base, kib * 1024);
            assert_eq!(STM32F407VG.is_whole_sectors(&region), expected, "{base:#x}, {kib}");
        }
    }

    /// RM0090 table 5, copied from the manual.
    #[test]
    fn sectors_of_the_f407_are_those_of_the_manual() {
        let table = [
            (0, 0x0800_0000, 16),
            (1, 0x0800_4000, 16),
            (2, 0x0800_8000, 16),
            (3, 0x0800_C000, 16),
            (4, 0x0801_0000, 64),
            (5, 0x0802_0000, 128),
            (6, 0x0804_0000, 128),
            (7, 0x0806_0000, 128),
            (8, 0x0808_0000, 128),
            (9, 0x080A_0000, 128),
            (10, 0x080C_0000, 128),
            (11, 0x080E_0000, 128),
        ];
        assert!(STM32F407VG.sectors().eq(table
            .iter()
            .map(|&(number, base, kib)| Sector { number, region: Region::new(base, kib * 1024) })));
        assert_eq!(STM32F407VG.sector_at(0x080F_FFFF).unwrap().number, 11);
        assert_eq!(STM32F407VG.sector_at(0x0810_0000), None);
        assert_eq!(STM32F407VG.sector_at(0x07FF_FFFF), None);
    }

    /// RM0090 table 6 and section 3.9.8 (SNB), first and last sectors.
    #[test]
    fn sectors_of_the_f429_are_those_of_the_manual() {
        let table = [
            (0, 0x0800_0000, 16, 0b00000),
            (4, 0x0801_0000, 64, 0b00100),
            (11, 0x080E_0000, 128, 0b01011),
            (12, 0x0810_0000, 16, 0b10000),
            (15, 0x0810_C000, 16, 0b10011),
            (16, 0x0811_0000, 64, 0b10100),
            (17, 0x0812_0000, 128, 0b10101),
            (23, 0x081E_0000, 128, 0b11011),
        ];
        for (number, base, kib, code) in table {
            let sector = Sector { number, region: Region::new(base, kib * 1024) };
            assert_eq!(STM32F429ZI.sector(number), Some(sector));
            assert_eq!(STM32F429ZI.sector_at(base), Some(sector));
            assert_eq!(STM32F429ZI.sector_code(number), code, "sector {number}");
        }
        assert_eq!(STM32F429ZI.sector(24), None);
        assert_eq!(STM32F429ZI.sector_at(0x0820_0000), None);
    }

    /// The sectors of RM0390.
    #[test]
    fn sectors_of_the_f446_are_those_of_the_manual() {
        let bases = [
            0x0800_0000,
            0x0800_4000,
            0x0800_8000,
            0x0800_C000,
            0x0801_0000,
            0x0802_0000,
            0x0804_0000,
            0x0806_0000,
        ];
        assert!(STM32F446RE.sectors().map(|sector| sector.region.base).eq(bases));
        assert_eq!(STM32F446RE.sector_at(0x0807_FFFF).unwrap().number, 7);
        assert_eq!(STM32F446RE.sector_at(0x0808_0000), None);
        assert_eq!(STM32F446RE.sector_code(7), 7);
    }

    /// RM0090 table 9 (DB1M = 1) and section 3.9.8, first and last sectors.
    #[test]
    fn a_mebibyte_in_two_banks_is_that_of_the_manual() {
        let chip = STM32F429ZG.in_two_banks();
        for (place, base, kib, code) in [
            (0, 0x0800_0000, 16, 0b00000),
            (7, 0x0806_0000, 128, 0b00111),
            (8, 0x0808_0000, 16, 0b10000),
            (12, 0x0809_0000, 64, 0b10100),
            (13, 0x080A_0000, 128, 0b10101),
            (15, 0x080E_0000, 128, 0b10111),
        ] {
            let sector = Sector { number: place, region: Region::new(base, kib * 1024) };
            assert_eq!(chip.sector(place), Some(sector));
            assert_eq!(chip.sector_code(place), code, "sector {place}");
        }
        assert_eq!(chip.sector(16), None);
        assert_eq!((STM32F429ZG.sectors().count(), STM32F429ZG.second_bank), (12, None));
    }

    /// Flash, SRAM, CCM in KiB and the device identifier from ST's CMSIS packs (Keil.STM32F4xx_DFP
    /// 2.17.1), with the chips of one line in each row.
    #[test]
    fn memories_are_those_of_the_packs() {
        for (line, letters, sram, ccm) in [
            ("stm32f405", "eg", 128, 64),
            ("stm32f407", "eg", 128, 64),
            ("stm32f412", "eg", 256, 0),
            ("stm32f413", "gh", 320, 0),
            ("stm32f415", "g", 128, 64),
            ("stm32f417", "eg", 128, 64),
            ("stm32f423", "h", 320, 0),
            ("stm32f427", "gi", 192, 64),
            ("stm32f429", "egi", 192, 64),
            ("stm32f437", "gi", 192, 64),
            ("stm32f439", "gi", 192, 64),
            ("stm32f446", "ce", 128, 0),
            ("stm32f469", "egi", 320, 64),
            ("stm32f479", "gi", 320, 64),
        ] {
            let of_line = || CHIPS.iter().filter(|chip| chip.chip.starts_with(line));
            for chip in of_line() {
                assert_eq!(chip.line.name(), line);
                assert_eq!((chip.sram.size / 1024, chip.ccm.size / 1024), (sram, ccm), "{}", chip.chip);
                let letter = chip.chip.chars().last().unwrap();
                assert!(letters.contains(letter), "{}", chip.chip);
                let kib = [('c', 256), ('e', 512), ('g', 1024), ('h', 1536), ('i', 2048)];
                assert!(kib.contains(&(letter, chip.flash.size / 1024)), "{}", chip.chip);
            }
            for letter in letters.chars() {
                assert!(of_line().any(|chip| chip.chip.ends_with(letter)), "{line} with {letter}");
            }
        }
        // The packs list the same number of chips.
        assert_eq!(CHIPS.len(), 125);
    }

    #[test]
    fn chips_are_named_as_people_write_them() {
        for name in ["stm32f429zi", "STM32F429ZI", "STM32F429ZIT6", "stm32f429zit6tr", "STM32F429ZIY7"] {
            assert_eq!(by_name(name), Some(&STM32F429ZI), "{name}");
        }
        for name in ["", "stm32f429z", "stm32f429zit", "stm32f429zi6t", "stm32f429zit6 x", "STM32F411RE"] {
            assert_eq!(by_name(name), None, "{name}");
        }
        for chip in CHIPS {
            assert_eq!(by_name(chip.chip), Some(*chip));
            assert_eq!(Line::of(chip.chip), Some(chip.line));
        }
    }

    #[test]
    fn a_region_does_not_wrap() {
        let region = Region::new(0x0801_0000, 0x1000);
        assert!(region.contains(0x0801_0000, 0x1000));
        assert!(!region.contains(0x0801_0000, 0x1001));
        assert!(!region.contains(0x0801_0001, 0x1000));
        assert!(!region.contains(0x0801_0010, u32::MAX));
        assert!(!region.contains(u32::MAX, 1));
        assert!(!region.contains(region.end(), 0));
    }
}
