//! The memory map (RM0090 section 2.3), and what the map of the core adds (PM0214 section 2.2).

use shared_abi::geometry::{Region, SYSTEM_MEMORY};

use crate::cortex::debug::COMPARATORS;
use crate::memory::PAGE;
use crate::periph::{otg, rcc};

/// Where flash (or whatever the boot pins choose) shows up for the reset vector.
pub const BOOT_ALIAS: u32 = 0;
/// The pages of the system memory, and behind it of the unique ID and the flash size.
pub const SYSTEM: Region = Region::new(SYSTEM_MEMORY.base, 8 * PAGE);
/// The one-time programmable bytes, 16 blocks of 32 and a lock byte for each (RM0090 section 3.8).
pub const OTP: Region = Region::new(0x1FFF_7800, OTP_BLOCKS * OTP_BLOCK + OTP_BLOCKS);
pub const OTP_BLOCKS: u32 = 16;
pub const OTP_BLOCK: u32 = 32;
pub const UNIQUE_ID: u32 = 0x1FFF_7A10;
pub const FLASH_SIZE: u32 = 0x1FFF_7A22;
/// Page of the option bytes.
pub const OPTION_PAGE: Region = Region::new(0x1FFF_C000, PAGE);
/// AHB1 and APB peripherals.
pub const PERIPHERALS: Region = Region::new(0x4000_0000, 0x0008_0000);
/// AHB2: USB OTG FS, DCMI, crypto, RNG.
pub const PERIPHERALS_AHB2: Region = Region::new(0x5000_0000, 0x0006_1000);
/// Private peripheral bus: DWT, FPB, system control space, DBGMCU.
pub const PRIVATE: Region = Region::new(0xE000_0000, 0x0010_0000);
pub const ITM: u32 = 0xE000_0000;
pub const DWT: u32 = 0xE000_1000;
pub const FPB: u32 = 0xE000_2000;
pub const SCS: u32 = 0xE000_E000;
pub const DBGMCU: u32 = 0xE004_2000;

/// Where loads from hidden sectors of the flash go (PCROP); an address of external memory, which no chip here has.
pub const HIDDEN: Region = Region::new(0x9000_0000, 0x0020_0000);
/// Where the pages are whose words the FPB replaces, one for each comparator; another such address.
pub const PATCHED: Region = Region::new(0x9100_0000, COMPARATORS as u32 * PAGE);
/// What a bank of the flash has, on a chip whose banks can be swapped.
pub const BANK: u32 = 0x0010_0000;

/// Bit-band alias of the first MiB of SRAM space (PM0214 section 2.2.5); as much as there is SRAM
/// is mapped.
pub const SRAM_ALIAS: u32 = 0x2200_0000;
/// Bit-band alias of the first MiB of peripheral space.
pub const PERIPHERAL_ALIAS: Region = Region::new(0x4200_0000, 0x0200_0000);

/// A modelled block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Block {
    Crc,
    Rcc,
    Flash,
    Gpio(usize),
    Iwdg,
    Wwdg,
    Pwr,
    Rtc,
    Syscfg,
    Exti,
    Can1,
    Can2,
    Usart(usize),
    Tim(usize),
    I2c(usize),
    Otg,
}

/// The block that answers at an address, with the offset in its registers.
pub enum Place {
    Block { block: Block, offset: u32, enable: ClockEnable },
    Scs(u32),
    Dwt(u32),
    Fpb(u32),
    Dbgmcu(u32),
    Itm,
    Nobody,
}

/// Where RCC enables the clock of a block: register offset and bit; `None` for a block that is
/// always clocked.
pub type ClockEnable = Option<(u32, u32)>;

/// Start, block, and its clock.
pub const BLOCKS: [(u32, Block, ClockEnable); 46] = [
    (0x4000_0000, Block::Tim(0), Some((rcc::APB1ENR, 0))),
    (0x4000_0400, Block::Tim(1), Some((rcc::APB1ENR, 1))),
    (0x4000_0800, Block::Tim(2), Some((rcc::APB1ENR, 2))),
    (0x4000_0C00, Block::Tim(3), Some((rcc::APB1ENR, 3))),
    (0x4000_1000, Block::Tim(4), Some((rcc::APB1ENR, 4))),
    (0x4000_1400, Block::Tim(5), Some((rcc::APB1ENR, 5))),
    (0x4000_1800, Block::Tim(9), Some((rcc::APB1ENR, 6))),
    (0x4000_1C00, Block::Tim(10), Some((rcc::APB1ENR, 7))),
    (0x4000_2000, Block::Tim(11), Some((rcc::APB1ENR, 8))),
    (0x4000_2800, Block::Rtc, None),
    (0x4000_2C00, Block::Wwdg, Some((rcc::APB1ENR, 11))),
    (0x4000_3000, Block::Iwdg, None),
    (0x4000_4400, Block::Usart(1), Some((rcc::APB1ENR, 17))),
    (0x4000_4800, Block::Usart(2), Some((rcc::APB1ENR, 18))),
    (0x4000_4C00, Block::Usart(3), Some((rcc::APB1ENR, 19))),
    (0x4000_5000, Block::Usart(4), Some((rcc::APB1ENR, 20))),
    (0x4000_5400, Block::I2c(0), Some((rcc::APB1ENR, 21))),
    (0x4000_5800, Block::I2c(1), Some((rcc::APB1ENR, 22))),
    (0x4000_5C00, Block::I2c(2), Some((rcc::APB1ENR, 23))),
    (0x4000_6400, Block::Can1, Some((rcc::APB1ENR, 25))),
    (0x4000_6800, Block::Can2, Some((rcc::APB1ENR, 26))),
    (0x4000_7000, Block::Pwr, Some((rcc::APB1ENR, 28))),
    (0x4001_0000, Block::Tim(12), Some((rcc::APB2ENR, 0))),
    (0x4001_0400, Block::Tim(13), Some((rcc::APB2ENR, 1))),
    (0x4001_1000, Block::Usart(0), Some((rcc::APB2ENR, 4))),
    (0x4001_1400, Block::Usart(5), Some((rcc::APB2ENR, 5))),
    (0x4001_3800, Block::Syscfg, Some((rcc::APB2ENR, 14))),
    (0x4001_3C00, Block::Exti, None),
    (0x4001_4000, Block::Tim(6), Some((rcc::APB2ENR, 16))),
    (0x4001_4400, Block::Tim(7), Some((rcc::APB2ENR, 17))),
    (0x4001_4800, Block::Tim(8), Some((rcc::APB2ENR, 18))),
    (0x4002_0000, Block::Gpio(0), Some((rcc::AHB1ENR, 0))),
    (0x4002_0400, Block::Gpio(1), Some((rcc::AHB1ENR, 1))),
    (0x4002_0800, Block::Gpio(2), Some((rcc::AHB1ENR, 2))),
    (0x4002_0C00, Block::Gpio(3), Some((rcc::AHB1ENR, 3))),
    (0x4002_1000, Block::Gpio(4), Some((rcc::AHB1ENR, 4))),
    (0x4002_1400, Block::Gpio(5), Some((rcc::AHB1ENR, 5))),
    (0x4002_1800, Block::Gpio(6), Some((rcc::AHB1ENR, 6))),
    (0x4002_1C00, Block::Gpio(7), Some((rcc::AHB1ENR, 7))),
    (0x4002_2000, Block::Gpio(8), Some((rcc::AHB1ENR, 8))),
    (0x4002_2400, Block::Gpio(9), Some((rcc::AHB1ENR, 9))),
    (0x4002_2800, Block::Gpio(10), Some((rcc::AHB1ENR, 10))),
    (0x4002_3000, Block::Crc, Some((rcc::AHB1ENR, 12))),
    (0x4002_3800, Block::Rcc, None),
    (0x4002_3C00, Block::Flash, None),
    (0x5000_0000, Block::Otg, Some((rcc::AHB2ENR, 7))),
];

impl Block {
    /// Bytes of its registers.
    pub fn size(self) -> u32 {
        match self {
            Self::Otg => otg::SIZE,
            _ => 0x400,
        }
    }
}

pub const RCC_CFGR: u32 = 0x4002_3808;
pub const SYSCFG_MEMRMP: u32 = 0x4001_3800;

/// Names of blocks that are not modelled, for reports (RM0090 table 1).
pub const UNMODELLED: [(u32, &str); 17] = [
    (0x4000_3400, "I2S2ext"),
    (0x4000_3800, "SPI2"),
    (0x4000_3C00, "SPI3"),
    (0x4000_4000, "I2S3ext"),
    (0x4000_7400, "DAC"),
    (0x4001_2000, "ADC"),
    (0x4001_2C00, "SDIO"),
    (0x4001_3000, "SPI1"),
    (0x4002_4000, "the backup SRAM"),
    (0x4002_6000, "DMA1"),
    (0x4002_6400, "DMA2"),
    (0x4002_8000, "Ethernet"),
    (0x4004_0000, "USB OTG HS"),
    (0x5000_1000, "a FIFO of USB OTG FS"),
    (0x5005_0000, "DCMI"),
    (0x5006_0000, "CRYP/HASH"),
    (0x5006_0800, "RNG"),
];

/// Whether a register belongs to a counter that counts the core's cycles: SysTick, or the cycle counter of
/// the DWT.
#[must_use]
pub fn counts_cycles(address: u32) -> bool {
    Region::new(SCS + 0x10, 0x10).contains(address, 1) || Region::new(DWT, 8).contains(address, 1)
}
