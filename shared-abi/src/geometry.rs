//! The silicon: what a chip has, as its reference manual states it (RM0090 rev 19 for
//! STM32F405–F439, RM0390 for STM32F446: section 3 "Embedded flash memory" and section 2 "Memory
//! map"). Nothing here is a choice of ours; the choices are in [`crate::layout`].

/// A half-open range of addresses: `base..base + size`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Region {
    /// First address.
    pub base: u32,
    /// Length in bytes.
    pub size: u32,
}

impl Region {
    /// The region that starts at `base` and is `size` bytes long.
    #[must_use]
    pub const fn new(base: u32, size: u32) -> Self {
        Self { base, size }
    }

    /// The address behind the last byte. No region of a chip reaches the end of the address space.
    #[must_use]
    pub const fn end(&self) -> u32 {
        self.base + self.size
    }

    /// Whether it has a byte, and its end is an address.
    #[must_use]
    pub const fn is_possible(&self) -> bool {
        self.size > 0 && self.base.checked_add(self.size).is_some()
    }

    /// Whether the `len` bytes from `address` all lie inside; no address and no length overflows
    /// it.
    #[must_use]
    pub const fn contains(&self, address: u32, len: u32) -> bool {
        address >= self.base
            && len <= self.size
            && address - self.base <= self.size - len
            && (len > 0 || address < self.end())
    }

    /// Whether the two share at least one byte.
    #[must_use]
    pub const fn overlaps(&self, other: &Self) -> bool {
        self.base < other.end() && other.base < self.end()
    }
}

/// One erasable unit of the flash.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sector {
    /// Its number in the manual's table; [`Geometry::sector_code`] makes of it what goes into
    /// `FLASH_CR.SNB`.
    pub number: u8,
    /// The bytes it covers.
    pub region: Region,
}

/// A run of equally large sectors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SectorRun {
    /// How many sectors follow one another.
    pub count: u8,
    /// Bytes of each.
    pub size: u32,
}

/// What one chip has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Geometry {
    /// Order code without package and temperature range, in lower case.
    pub chip: &'static str,
    /// The main flash.
    pub flash: Region,
    /// Its sectors, in address order.
    pub sectors: &'static [SectorRun],
    /// Number of the first sector of the second bank, on a chip that has two.
    pub second_bank: Option<u8>,
    /// The RAM that both the CPU and the bus masters reach, as one contiguous range.
    pub sram: Region,
    /// Core-coupled RAM: data only, no code and no DMA. Size 0 where the chip has none.
    pub ccm: Region,
    /// Number of interrupt lines behind the 16 exceptions of the core.
    pub interrupts: u16,
    /// Number of GPIO ports, from A on (the memory map's table of register boundaries). Packages
    /// have fewer.
    pub ports: u8,
}

const KIB: u32 = 1024;

/// Vectors of the core, in front of those of the interrupts: the initial stack pointer, Reset and
/// the other exceptions (ARMv7-M B1.5.3).
pub const CORE_VECTORS: u32 = 16;
/// Bytes of them.
pub const CORE_VECTORS_SIZE: u32 = CORE_VECTORS * 4;

/// STM32F407VG and STM32F407IG: 1 MiB flash, 112 + 16 KiB SRAM, 64 KiB CCM.
///
/// RM0090 table 5 (sectors), table 61 (82 interrupt lines).
pub const STM32F407VG: Geometry = Geometry {
    chip: "stm32f407vg",
    flash: Region::new(0x0800_0000, 1024 * KIB),
    sectors: &[
        SectorRun { count: 4, size: 16 * KIB },
        SectorRun { count: 1, size: 64 * KIB },
        SectorRun { count: 7, size: 128 * KIB },
    ],
    second_bank: None,
    sram: Region::new(0x2000_0000, 128 * KIB),
    ccm: Region::new(0x1000_0000, 64 * KIB),
    interrupts: 82,
    ports: 9,
}
.checked();

/// STM32F429ZI and its packages: 2 MiB flash in two banks, 112 + 16 + 64 KiB SRAM, 64 KiB CCM.
///
/// RM0090 (sectors; SRAM1, SRAM2 and SRAM3 follow one another); 91 interrupt lines as the PAC has
/// them.
pub const STM32F429ZI: Geometry = Geometry {
    chip: "stm32f429zi",
    flash: Region::new(0x0800_0000, 2048 * KIB),
    sectors: &[
        SectorRun { count: 4, size: 16 * KIB },
        SectorRun { count: 1, size: 64 * KIB },
        SectorRun { count: 7, size: 128 * KIB },
        SectorRun { count: 4, size: 16 * KIB },
        SectorRun { count: 1, size: 64 * KIB },
        SectorRun { count: 7, size: 128 * KIB },
    ],
    second_bank: Some(12),
    sram: Region::new(0x2000_0000, (112 + 16 + 64) * KIB),
    ccm: Region::new(0x1000_0000, 64 * KIB),
    interrupts: 91,
    ports: 11,
}
.checked();

/// STM32F446RE: 512 KiB flash, 112 + 16 KiB SRAM, no CCM.
///
/// RM0390 (sectors, memory map); 97 interrupt lines as the PAC has them.
pub const STM32F446RE: Geometry = Geometry {
    chip: "stm32f446re",
    flash: Region::new(0x0800_0000, 512 * KIB),
    sectors: &[
        SectorRun { count: 4, size: 16 * KIB },
        SectorRun { count: 1, size: 64 * KIB },
        SectorRun { count: 3, size: 128 * KIB },
    ],
    second_bank: None,
    sram: Region::new(0x2000_0000, 128 * KIB),
    ccm: Region::new(0x1000_0000, 0),
    interrupts: 97,
    ports: 8,
}
.checked();

/// Every chip that is described here.
pub const CHIPS: &[&Geometry] = &[&STM32F407VG, &STM32F429ZI, &STM32F446RE];

impl Geometry {
    /// The line of the family that the chip is of: `stm32f407`.
    #[must_use]
    pub fn line(&self) -> &'static str {
        self.chip.get(..9).unwrap_or(self.chip)
    }

    /// Whether this is its name: the order code as people write it, in any case, with or without
    /// package, temperature range and what follows them (`STM32F407VGT6TR`).
    #[must_use]
    pub fn is_named(&self, name: &str) -> bool {
        let Some((code, rest)) = name.split_at_checked(self.chip.len()) else { return false };
        let is_rest = match rest.as_bytes() {
            [] => true,
            [package, range, more @ ..] => {
                package.is_ascii_alphabetic()
                    && range.is_ascii_digit()
                    && more.len() <= 3
                    && more.iter().all(u8::is_ascii_alphanumeric)
            }
            _ => false,
        };
        code.eq_ignore_ascii_case(self.chip) && is_rest
    }

    /// Gives the geometry back if it can be that of a chip; fails the build with the broken rule's
    /// words if not.
    #[must_use]
    pub const fn checked(self) -> Self {
        match self.check() {
            Ok(()) => self,
            Err(rule) => panic!("{}", rule),
        }
    }

    /// Whether it can be that of a chip; otherwise the first rule that it breaks, in words. No number
    /// makes it panic.
    ///
    /// # Errors
    /// The broken rule.
    pub const fn check(&self) -> Result<(), &'static str> {
        if !self.flash.is_possible() || !self.sram.is_possible() {
            return Err("flash or SRAM of the chip is empty, or reaches over the end of the address space");
        }
        let (mut total, mut count, mut run) = (0, 0, 0);
        while run < self.sectors.len() {
            let SectorRun { count: many, size } = self.sectors[run];
            if many == 0 || (size != 16 * KIB && size != 64 * KIB && size != 128 * KIB) {
                return Err("a sector of the STM32F4 has 16, 64 or 128 KiB");
            }
            count += many as u32;
            if count > 24 {
                return Err("no STM32F4 has more than 24 sectors");
            }
            total += many as u32 * size;
            run += 1;
        }
        if total != self.flash.size {
            return Err("the sectors do not add up to the flash");
        }
        if let Some(first) = self.second_bank {
            if first != 12 || self.sector(first).is_none() {
                return Err("the second bank of an STM32F4 begins with sector 12");
            }
        }
        if self.interrupts == 0 || self.vector_table_alignment() > 512 {
            return Err("no STM32F4 has more than 112 interrupt lines");
        }
        if !self.sram.base.is_multiple_of(4096) || !self.sram.size.is_multiple_of(4096) {
            return Err("the SRAM must be whole pages of 4 KiB");
        }
        Ok(())
    }

    /// What `FLASH_CR.SNB` takes for a sector: its number, but bit 4 chooses the second bank, whose
    /// sectors count from 0 again (RM0090 section 3.9.8: sector 12 is 10000b).
    #[must_use]
    pub const fn sector_code(&self, number: u8) -> u8 {
        match self.second_bank {
            Some(first) if number >= first => 0x10 + (number - first),
            _ => number,
        }
    }

    /// The sectors in address order.
    pub fn sectors(&self) -> impl Iterator<Item = Sector> + '_ {
        let mut next = 0;
        core::iter::from_fn(move || {
            let sector = self.sector(next)?;
            next += 1;
            Some(sector)
        })
    }

    /// The sector of this number, if the chip has it.
    #[must_use]
    pub const fn sector(&self, number: u8) -> Option<Sector> {
        let mut base = self.flash.base;
        let mut left = number;
        let mut run = 0;
        while run < self.sectors.len() {
            let SectorRun { count, size } = self.sectors[run];
            if left < count {
                let region = Region::new(base + left as u32 * size, size);
                return Some(Sector { number, region });
            }
            left -= count;
            base += count as u32 * size;
            run += 1;
        }
        None
    }

    /// The sector that holds `address`, if it is in flash.
    #[must_use]
    pub const fn sector_at(&self, address: u32) -> Option<Sector> {
        let (mut number, mut base) = (0, self.flash.base);
        let mut run = 0;
        while run < self.sectors.len() {
            let SectorRun { count, size } = self.sectors[run];
            let mut left = count;
            while left > 0 {
                let region = Region::new(base, size);
                if region.contains(address, 1) {
                    return Some(Sector { number, region });
                }
                base += size;
                number += 1;
                left -= 1;
            }
            run += 1;
        }
        None
    }

    /// Whether a region starts and ends where sectors do, so that it can be erased without touching
    /// a neighbour.
    #[must_use]
    pub const fn is_whole_sectors(&self, region: &Region) -> bool {
        let starts = match self.sector_at(region.base) {
            Some(sector) => sector.region.base == region.base,
            None => false,
        };
        let ends = match self.sector_at(region.end() - 1) {
            Some(sector) => sector.region.end() == region.end(),
            None => false,
        };
        region.size > 0 && starts && ends
    }

    /// Bytes that a vector table of this chip occupies.
    #[must_use]
    pub const fn vector_table_size(&self) -> u32 {
        CORE_VECTORS_SIZE + self.interrupts as u32 * 4
    }

    /// What `VTOR` demands of a vector table's address: the table's size rounded up to a power of
    /// two (PM0214 section 4.4.4).
    #[must_use]
    pub const fn vector_table_alignment(&self) -> u32 {
        self.vector_table_size().next_power_of_two()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    /// RM0090 table 6 and section 3.9.8 (SNB), at the borders.
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

    /// RM0390, the sectors.
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
