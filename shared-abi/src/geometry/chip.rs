//! What is known about a chip.

use super::line::Line;

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

    /// The address after the last byte. No region of a chip reaches the end of the address space.
    #[must_use]
    pub const fn end(&self) -> u32 {
        self.base + self.size
    }

    /// Whether the region is not empty, and its end is a 32-bit address.
    #[must_use]
    pub const fn is_possible(&self) -> bool {
        self.size > 0 && self.base.checked_add(self.size).is_some()
    }

    /// Whether the `len` bytes from `address` all lie inside. No address and no length causes an
    /// overflow.
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

/// A sector: one erasable unit of the flash.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sector {
    /// The sector's index among the chip's sectors, from 0 on. It is the number in the manual's
    /// table, except on a chip with 1 MiB in two banks: the manual leaves out 8 to 11 there, so
    /// index 8 is sector 12 of the manual. [`Geometry::sector_code`] converts the index to the
    /// value for `FLASH_CR.SNB`.
    pub number: u8,
    /// The bytes of the sector.
    pub region: Region,
}

/// Consecutive sectors of equal size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SectorRun {
    /// The number of sectors.
    pub count: u8,
    /// The size of each sector in bytes.
    pub size: u32,
}

/// The properties of one chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Geometry {
    /// Order code without package and temperature range, in lower case.
    pub chip: &'static str,
    /// The line of the chip.
    pub line: Line,
    /// The main flash.
    pub flash: Region,
    /// Its sectors, in the order of their addresses.
    pub sectors: &'static [SectorRun],
    /// Index of the first sector of the second bank, on a chip with two banks: 12, or 8 with 1 MiB
    /// in two banks.
    pub second_bank: Option<u8>,
    /// The RAM for both the CPU and the bus masters, as one contiguous range.
    pub sram: Region,
    /// Core-coupled RAM: only data, no code and no DMA. Size 0 if the chip has none.
    pub ccm: Region,
    /// Number of interrupt lines after the 16 exceptions of the core.
    pub interrupts: u16,
    /// Number of GPIO ports, from A on (the memory map's table of register boundaries). Packages
    /// have fewer ports.
    pub ports: u8,
}

const KIB: u32 = 1024;

/// The system memory, a ROM with a loader of ST: the same on every chip (RM0090 section 3.4, RM0390, RM0402 and
/// RM0430 section 3.3).
pub const SYSTEM_MEMORY: Region = Region::new(0x1FFF_0000, 30 * 1024);
/// The one-time programmable bytes after it: 16 blocks of 32 bytes, the same on every chip (RM0090 section 3.8;
/// tables "Flash module organization" of RM0390, RM0402 and RM0430). A lock byte for each block follows them.
pub const OTP: Region = Region::new(0x1FFF_7800, 512);

/// Number of the core's vectors, which precede those of the interrupts: the initial stack pointer,
/// Reset and the other exceptions (ARMv7-M B1.5.3).
pub const CORE_VECTORS: u32 = 16;
/// Size of these vectors in bytes.
pub const CORE_VECTORS_SIZE: u32 = CORE_VECTORS * 4;

/// Start of flash, SRAM and CCM on every chip.
const FLASH: u32 = 0x0800_0000;
const SRAM: u32 = 0x2000_0000;
const CCM: u32 = 0x1000_0000;

/// The sectors of a bank, or of a flash with one bank: four of 16 KiB, one of 64 KiB and the rest
/// of 128 KiB (RM0090 tables 5 and 6, RM0402, RM0430, RM0390 and RM0386: flash module
/// organization).
const SMALL: [SectorRun; 2] =
    [SectorRun { count: 4, size: 16 * KIB }, SectorRun { count: 1, size: 64 * KIB }];

/// One bank with `large` sectors of 128 KiB.
const fn bank(large: u8) -> [SectorRun; 3] {
    [SMALL[0], SMALL[1], SectorRun { count: large, size: 128 * KIB }]
}

/// Two such banks, one after the other.
const fn two_banks(large: u8) -> [SectorRun; 6] {
    let [a, b, c] = bank(large);
    [a, b, c, a, b, c]
}

/// The text in these bytes.
pub(super) const fn text(bytes: &[u8]) -> &str {
    match core::str::from_utf8(bytes) {
        Ok(text) => text,
        Err(_) => panic!("no text"),
    }
}

impl Geometry {
    /// A chip of a line, from its name in lower case; the last letter gives the size of the flash.
    pub(super) const fn new(line: Line, chip: &'static str) -> Self {
        let (kib, sectors, second_bank): (u32, &[SectorRun], _) = match chip.as_bytes()[10] {
            b'c' => (256, &const { bank(1) }, None),
            b'e' => (512, &const { bank(3) }, None),
            b'g' => (1024, &const { bank(7) }, None),
            b'h' => (1536, &const { bank(11) }, None),
            b'i' => (2048, &const { two_banks(7) }, Some(12)),
            _ => panic!("the last letter of a chip's name is the flash: C, E, G, H or I"),
        };
        Self {
            chip,
            line,
            flash: Region::new(FLASH, kib * KIB),
            sectors,
            second_bank,
            sram: Region::new(SRAM, line.sram()),
            ccm: Region::new(CCM, line.ccm()),
            interrupts: line.interrupts(),
            ports: line.ports(),
        }
        .checked()
    }

    /// The same chip with its 1 MiB in two banks, as the option bit DB1M sets it: sectors 0 to 7
    /// and 12 to 19 of the manual (RM0090 table 9, RM0386). The option is set in production.
    ///
    /// # Panics
    /// At compile time, if the chip has no such option.
    #[must_use]
    pub const fn in_two_banks(self) -> Self {
        use Line::*;
        assert!(
            matches!(self.line, F427 | F429 | F437 | F439 | F469 | F479) && self.flash.size == 1024 * KIB,
            "DB1M is an option of the STM32F42x, F43x, F469 and F479 with 1 MiB"
        );
        Self { sectors: &const { two_banks(3) }, second_bank: Some(8), ..self }.checked()
    }

    /// Whether this is the chip's name: the order code in any case, with or without package,
    /// temperature range and the characters after them (`STM32F407VGT6TR`).
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

    /// Returns the geometry if it is possible; otherwise it fails the build with the message of the
    /// broken rule.
    #[must_use]
    pub const fn checked(self) -> Self {
        match self.check() {
            Ok(()) => self,
            Err(rule) => panic!("{}", rule),
        }
    }

    /// Checks whether the geometry is possible. No number causes a panic.
    ///
    /// # Errors
    /// The first broken rule, in words.
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
            if first as u32 * 2 != count || !matches!(first, 8 | 12) {
                return Err("the second bank of an STM32F4 is as large as the first: 8 or 12 sectors each");
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

    /// The value of `FLASH_CR.SNB` for a sector: its number; bit 4 selects the second bank, whose
    /// sectors count from 0 again (RM0090 section 3.9.8: sector 12 is 10000b).
    #[must_use]
    pub const fn sector_code(&self, number: u8) -> u8 {
        match self.second_bank {
            Some(first) if number >= first => 0x10 + (number - first),
            _ => number,
        }
    }

    /// The sectors in the order of their addresses.
    pub fn sectors(&self) -> impl Iterator<Item = Sector> + '_ {
        let mut next = 0;
        core::iter::from_fn(move || {
            let sector = self.sector(next)?;
            next += 1;
            Some(sector)
        })
    }

    /// The sector with this number, if the chip has it.
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

    /// The sector that contains `address`, if the address is in flash.
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

    /// Whether a region starts and ends at borders of sectors, so that it can be erased without an
    /// effect on its neighbours.
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

    /// Size of this chip's vector table in bytes.
    #[must_use]
    pub const fn vector_table_size(&self) -> u32 {
        CORE_VECTORS_SIZE + self.interrupts as u32 * 4
    }

    /// The alignment that `VTOR` requires of a vector table: the table's size rounded up to a power
    /// of two (PM0214 section 4.4.4).
    #[must_use]
    pub const fn vector_table_alignment(&self) -> u32 {
        self.vector_table_size().next_power_of_two()
    }
}
