//! The areas of an STM32F4's address space that are not its main flash: what lies there is never
//! written by a bootloader.

use std::fmt;

use super::range::AddressRange;
use crate::advice::Advice;

/// An area outside the main flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Area {
    /// The boot memory, which shows at address 0 what the chip starts from.
    Alias,
    /// The data EEPROM of an STM32L0 or L1, at an address where the board's chip has no program.
    Eeprom,
    /// The core-coupled RAM.
    Ccm,
    /// The option bytes, of this family and of others.
    OptionBytes,
    /// The memory with ST's own boot loader.
    SystemMemory,
    /// The bytes that can be programmed once.
    Otp,
    /// The SRAM.
    Ram,
    /// The SRAM that a battery keeps, often used in place of an EEPROM.
    BackupSram,
    /// Registers of peripherals and of the core.
    Registers,
    /// A memory outside the chip, at the memory controller (FMC) or at QUADSPI.
    External,
    /// Where no STM32F4 has anything that can be written: the unique ID, and nothing at all.
    Reserved,
}

/// Main flash of the STM32F4: at most 2 MiB.
pub(crate) const FLASH: AddressRange = AddressRange { first: 0x0800_0000, last: 0x081F_FFFF };

/// RM0090 rev 19, sections 2.3 (memory map) and 3.4 to 3.6 (system memory, OTP, option bytes);
/// section 3.4 of RM0390 for QUADSPI. The first one that has an address counts.
const AREAS: [(AddressRange, Area); 13] = [
    (range(0x0000_0000, 0x07FF_FFFF), Area::Alias),
    (range(0x1000_0000, 0x1000_FFFF), Area::Ccm),
    (range(0x1FFE_C000, 0x1FFE_FFFF), Area::OptionBytes),
    (range(0x1FFF_0000, 0x1FFF_77FF), Area::SystemMemory),
    (range(0x1FFF_7800, 0x1FFF_7A0F), Area::Otp),
    // F4: from C000h on; STM32F0, F1 and F3: from F800h on.
    (range(0x1FFF_C000, 0x1FFF_FFFF), Area::OptionBytes),
    (range(0x2000_0000, 0x3FFF_FFFF), Area::Ram),
    (range(0x4002_4000, 0x4002_4FFF), Area::BackupSram),
    (range(0x4000_0000, 0x5FFF_FFFF), Area::Registers),
    (range(0x6000_0000, 0x9FFF_FFFF), Area::External),
    (range(0xA000_0000, 0xBFFF_FFFF), Area::Registers),
    (range(0xC000_0000, 0xDFFF_FFFF), Area::External),
    (range(0xE000_0000, 0xFFFF_FFFF), Area::Registers),
];

/// The data EEPROM of STM32L0 and L1 (RM0038 section 3.3): inside the flash of larger STM32F4.
const EEPROM: AddressRange = range(0x0808_0000, 0x0808_3FFF);

const fn range(first: u32, last: u32) -> AddressRange {
    AddressRange { first, last }
}

impl Area {
    /// The area of an address; `None` in the main flash.
    #[must_use]
    pub fn of(address: u32) -> Option<Self> {
        if FLASH.has(address) {
            return None;
        }
        let area = AREAS.iter().find(|(range, _)| range.has(address)).map(|(_, area)| *area);
        Some(area.unwrap_or(Self::Reserved))
    }

    /// The area of an address that the region of a program does not have.
    #[must_use]
    pub(crate) fn outside(address: u32) -> Option<Self> {
        Self::of(address).or(EEPROM.has(address).then_some(Self::Eeprom))
    }

    /// Whether it is empty after power-on.
    pub(crate) const fn is_ram(self) -> bool {
        matches!(self, Self::Ram | Self::Ccm | Self::BackupSram)
    }

    /// What to do with data for this area.
    #[must_use]
    pub const fn advice(self) -> Advice {
        match self {
            Self::Alias => Advice::AreaAlias,
            Self::Eeprom => Advice::AreaEeprom,
            Self::OptionBytes => Advice::AreaOptionBytes,
            Self::SystemMemory => Advice::AreaSystemMemory,
            Self::Otp => Advice::AreaOtp,
            Self::Ccm | Self::Ram => Advice::AreaRam,
            Self::BackupSram => Advice::AreaBackupSram,
            Self::Registers => Advice::AreaRegisters,
            Self::Reserved => Advice::AreaReserved,
            Self::External => Advice::AreaExternal,
        }
    }
}

impl fmt::Display for Area {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Alias => "the boot memory at address 0",
            Self::Eeprom => "the data EEPROM of another family (STM32L0, L1)",
            Self::OptionBytes => "the option bytes",
            Self::SystemMemory => "the system memory with ST's boot loader",
            Self::Otp => "the OTP area (one-time programmable bytes)",
            Self::Ccm => "the CCM RAM",
            Self::Ram => "the RAM",
            Self::BackupSram => "the backup SRAM, which is no EEPROM",
            Self::Registers => "the registers of peripherals",
            Self::External => "an external memory (FMC, QUADSPI)",
            Self::Reserved => "a range in which no STM32F4 has memory that can be written",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// First and last address of each area: RM0090 rev 19, table 1 and tables 5 to 7, figure of the
    /// memory map in DS8626.
    #[test]
    fn areas_are_those_of_the_manual() {
        for (first, last, area) in [
            (0x1000_0000, 0x1000_FFFF, Some(Area::Ccm)),
            (0x1FFF_0000, 0x1FFF_77FF, Some(Area::SystemMemory)),
            (0x1FFF_7800, 0x1FFF_7A0F, Some(Area::Otp)),
            (0x1FFF_C000, 0x1FFF_C00F, Some(Area::OptionBytes)),
            (0x1FFE_C000, 0x1FFE_C00F, Some(Area::OptionBytes)),
            (0x2000_0000, 0x2001_FFFF, Some(Area::Ram)),
            (0x4002_4000, 0x4002_4FFF, Some(Area::BackupSram)),
            (0x4000_0000, 0x4000_7FFF, Some(Area::Registers)),
            (0x6000_0000, 0x9FFF_FFFF, Some(Area::External)),
            (0xC000_0000, 0xDFFF_FFFF, Some(Area::External)),
            (0xE000_0000, 0xE00F_FFFF, Some(Area::Registers)),
            (0x0000_0000, 0x001F_FFFF, Some(Area::Alias)),
            (0x0800_0000, 0x081F_FFFF, None),
            // Reserved: after the largest flash, after the CCM RAM, around OTP and option bytes.
            (0x0820_0000, 0x0FFF_FFFF, Some(Area::Reserved)),
            (0x1001_0000, 0x1FFE_BFFF, Some(Area::Reserved)),
            (0x1FFF_7A10, 0x1FFF_BFFF, Some(Area::Reserved)),
        ] {
            assert_eq!((Area::of(first), Area::of(last)), (area, area), "{first:08X}h");
        }
        assert_eq!(Area::outside(0x0808_0000), Some(Area::Eeprom));
        assert_eq!(Area::outside(0x0800_8000), None);
    }
}
