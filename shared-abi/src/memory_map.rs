//! The addresses of a chip that a debugger may access without knowledge of the chip: there is
//! memory or a register at each of them. An access to any other address is a bus fault.
//!
//! | what | read | written |
//! |---|---|---|
//! | flash, one-time programmable bytes, unique ID, option bytes | yes | no |
//! | SRAM, CCM | yes | yes |
//! | registers of the peripherals, by words | yes | yes, but for those of the flash |
//! | registers of the core, by words: DWT, FPB, system control space, DBGMCU | yes | yes |
//!
//! Registers of the flash cannot be written, because a write could erase the bootloader. The table
//! leaves out USB, Ethernet, the camera, cryptography, random numbers, DMA2D and external memory:
//! some of them stall the bus while they have no clock. It also leaves out the bit-band aliases and
//! the alias of the flash at 0, because they would bypass this table.

use crate::geometry::{Geometry, Line, Region};

/// One-time programmable bytes, unique ID and flash size (RM0090, embedded flash and device
/// electronic signature).
const SYSTEM: Region = Region::new(0x1FFF_7800, 0x224);
/// The option bytes (RM0090, embedded flash).
const OPTION_BYTES: Region = Region::new(0x1FFF_C000, 0x10);
/// The flash interface.
const FLASH_REGISTERS: Region = Region::new(0x4002_3C00, 0x400);

/// The registers of the core (PM0214 section 4, DDI 0403E section C1; DBGMCU: RM0090, debug
/// support).
const CORE: [Region; 4] = [
    // DWT, FPB.
    Region::new(0xE000_1000, 0x1000),
    Region::new(0xE000_2000, 0x1000),
    // System control space.
    Region::new(0xE000_E000, 0x1000),
    Region::new(0xE004_2000, 0x10),
];

/// RM0090 table 1 (STM32F405 to F417): APB1, APB2, AHB1.
const F407: &[Region] = &[
    Region::new(0x4000_0000, 0x2400), // TIM2 to TIM7, TIM12 to TIM14
    Region::new(0x4000_2800, 0x3800), // RTC to I2C3
    Region::new(0x4000_6400, 0x0800), // CAN1, CAN2
    Region::new(0x4000_7000, 0x0800), // PWR, DAC
    Region::new(0x4001_0000, 0x0800), // TIM1, TIM8
    Region::new(0x4001_1000, 0x0800), // USART1, USART6
    Region::new(0x4001_2000, 0x0400), // ADC
    Region::new(0x4001_2C00, 0x0800), // SDIO, SPI1
    Region::new(0x4001_3800, 0x1400), // SYSCFG, EXTI, TIM9 to TIM11
    Region::new(0x4002_0000, 0x2400), // GPIOA to GPIOI
    Region::new(0x4002_3000, 0x0400), // CRC
    Region::new(0x4002_3800, 0x1800), // RCC, flash, backup SRAM
    Region::new(0x4002_6000, 0x0800), // DMA1, DMA2
];

/// RM0090 table 1 (STM32F42x and F43x).
const F429: &[Region] = &[
    Region::new(0x4000_0000, 0x2400), // TIM2 to TIM7, TIM12 to TIM14
    Region::new(0x4000_2800, 0x3800), // RTC to I2C3
    Region::new(0x4000_6400, 0x0800), // CAN1, CAN2
    Region::new(0x4000_7000, 0x1000), // PWR, DAC, UART7, UART8
    Region::new(0x4001_0000, 0x0800), // TIM1, TIM8
    Region::new(0x4001_1000, 0x0800), // USART1, USART6
    Region::new(0x4001_2000, 0x0400), // ADC
    Region::new(0x4001_2C00, 0x2000), // SDIO, SPI1, SPI4, SYSCFG, EXTI, TIM9 to TIM11
    Region::new(0x4001_5000, 0x0C00), // SPI5, SPI6, SAI1
    Region::new(0x4001_6800, 0x0400), // LTDC
    Region::new(0x4002_0000, 0x2C00), // GPIOA to GPIOK
    Region::new(0x4002_3000, 0x0400), // CRC
    Region::new(0x4002_3800, 0x1800), // RCC, flash, backup SRAM
    Region::new(0x4002_6000, 0x0800), // DMA1, DMA2
];

/// RM0390 table 1 (STM32F446).
const F446: &[Region] = &[
    Region::new(0x4000_0000, 0x2400), // TIM2 to TIM7, TIM12 to TIM14
    Region::new(0x4000_2800, 0x0C00), // RTC, WWDG, IWDG
    Region::new(0x4000_3800, 0x4000), // SPI2 to DAC
    Region::new(0x4001_0000, 0x0800), // TIM1, TIM8
    Region::new(0x4001_1000, 0x0800), // USART1, USART6
    Region::new(0x4001_2000, 0x0400), // ADC
    Region::new(0x4001_2C00, 0x2000), // SDIO, SPI1, SPI4, SYSCFG, EXTI, TIM9 to TIM11
    Region::new(0x4001_5800, 0x0800), // SAI1, SAI2
    Region::new(0x4002_0000, 0x2000), // GPIOA to GPIOH
    Region::new(0x4002_3000, 0x0400), // CRC
    Region::new(0x4002_3800, 0x1800), // RCC, flash, backup SRAM
    Region::new(0x4002_6000, 0x0800), // DMA1, DMA2
];

/// RM0402 (STM32F412): register boundary addresses.
const F412: &[Region] = &[
    Region::new(0x4000_0000, 0x2400), // TIM2 to TIM7, TIM12 to TIM14
    Region::new(0x4000_2800, 0x2400), // RTC to USART3
    Region::new(0x4000_5400, 0x1800), // I2C1 to I2C3, FMPI2C1, CAN1, CAN2
    Region::new(0x4000_7000, 0x0400), // PWR
    Region::new(0x4001_0000, 0x0800), // TIM1, TIM8
    Region::new(0x4001_1000, 0x0800), // USART1, USART6
    Region::new(0x4001_2000, 0x0400), // ADC
    Region::new(0x4001_2C00, 0x2000), // SDIO, SPI1, SPI4, SYSCFG, EXTI, TIM9 to TIM11
    Region::new(0x4001_5000, 0x0400), // SPI5
    Region::new(0x4001_6000, 0x0400), // DFSDM1
    Region::new(0x4002_0000, 0x2000), // GPIOA to GPIOH
    Region::new(0x4002_3000, 0x0400), // CRC
    Region::new(0x4002_3800, 0x0800), // RCC, flash
    Region::new(0x4002_6000, 0x0800), // DMA1, DMA2
];

/// RM0430 (STM32F413 and F423): register boundary addresses.
const F413: &[Region] = &[
    Region::new(0x4000_0000, 0x8000), // TIM2 to UART8
    Region::new(0x4001_0000, 0x0800), // TIM1, TIM8
    Region::new(0x4001_1000, 0x1400), // USART1, USART6, UART9, UART10, ADC
    Region::new(0x4001_2C00, 0x2000), // SDIO, SPI1, SPI4, SYSCFG, EXTI, TIM9 to TIM11
    Region::new(0x4001_5000, 0x0400), // SPI5
    Region::new(0x4001_5800, 0x0400), // SAI1
    Region::new(0x4001_6000, 0x0800), // DFSDM1, DFSDM2
    Region::new(0x4002_0000, 0x2000), // GPIOA to GPIOH
    Region::new(0x4002_3000, 0x0400), // CRC
    Region::new(0x4002_3800, 0x0800), // RCC, flash
    Region::new(0x4002_6000, 0x0800), // DMA1, DMA2
];

/// The peripherals of a chip. The additional ones of the F469 and F479 over the F429's, DSI and
/// QUADSPI, are left out.
const fn peripherals(line: Line) -> &'static [Region] {
    match line {
        Line::F405 | Line::F407 | Line::F415 | Line::F417 => F407,
        Line::F412 => F412,
        Line::F413 | Line::F423 => F413,
        Line::F446 => F446,
        Line::F427 | Line::F429 | Line::F437 | Line::F439 | Line::F469 | Line::F479 => F429,
    }
}

/// Whether these bytes are whole registers, all of one peripheral or of adjacent ones.
fn are_registers(chip: &Geometry, address: u32, len: u32) -> bool {
    let all = peripherals(chip.line).iter().chain(&CORE);
    address.is_multiple_of(4) && len.is_multiple_of(4) && within(all, address, len)
}

fn within<'a>(regions: impl IntoIterator<Item = &'a Region>, address: u32, len: u32) -> bool {
    len > 0 && regions.into_iter().any(|region| region.contains(address, len))
}

/// Whether these bytes may be read. Every address and length is allowed as an argument; a length of
/// 0 may not be read.
#[must_use]
pub fn may_read(chip: &Geometry, address: u32, len: u32) -> bool {
    within([&chip.flash, &chip.sram, &chip.ccm, &SYSTEM, &OPTION_BYTES], address, len)
        || are_registers(chip, address, len)
}

/// Whether these bytes may be written. Every address and length is allowed as an argument; a length
/// of 0 may not be written.
#[must_use]
pub fn may_write(chip: &Geometry, address: u32, len: u32) -> bool {
    let is_flash = || FLASH_REGISTERS.overlaps(&Region::new(address, len));
    within([&chip.sram, &chip.ccm], address, len) || are_registers(chip, address, len) && !is_flash()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CHIPS, STM32F407VG, STM32F412RG, STM32F413RH, STM32F429ZI, STM32F446RE};

    /// The first and the last word of each region, and the words beside it (RM0090 tables 1 and 5).
    #[test]
    fn what_answers_may_be_touched_and_what_does_not_may_not() {
        let chip = &STM32F407VG;
        for (address, read, write) in [
            (0x0000_0000, false, false), // the alias of the flash
            (0x07FF_FFFC, false, false),
            (0x0800_0000, true, false), // flash: read only
            (0x080F_FFFC, true, false),
            (0x0810_0000, false, false),
            (0x1000_0000, true, true), // CCM
            (0x1000_FFFC, true, true),
            (0x1001_0000, false, false),
            (0x1FFF_7A10, true, false), // unique ID
            (0x1FFF_C000, true, false), // option bytes
            (0x1FFF_0000, false, false),
            (0x2000_0000, true, true), // SRAM
            (0x2001_FFFC, true, true),
            (0x2002_0000, false, false),
            (0x2200_0000, false, false), // bit-band alias
            (0x4000_6400, true, true),   // CAN1_MCR
            (0x4000_2400, false, false),
            (0x4000_6000, false, false),
            (0x4000_8000, false, false),
            (0x4002_2400, false, false), // GPIOJ is of the F42x
            (0x4002_3800, true, true),   // RCC_CR
            (0x4002_3BFC, true, true),
            (0x4002_3C00, true, false), // FLASH_ACR
            (0x4002_3C10, true, false), // FLASH_CR
            (0x4002_3FFC, true, false),
            (0x4002_4000, true, true), // backup SRAM
            (0x4002_8000, false, false),
            (0x4247_8000, false, false), // bit-band alias of FLASH_ACR
            (0x5000_0000, false, false),
            (0x6000_0000, false, false),
            (0xA000_0000, false, false),
            (0xE000_0FFC, false, false),
            (0xE000_2000, true, true), // FP_CTRL
            (0xE000_3000, false, false),
            (0xE000_ED00, true, true), // CPUID
            (0xE000_EDFC, true, true), // DEMCR
            (0xE000_F000, false, false),
            (0xE004_2000, true, true), // DBGMCU_IDCODE
            (0xE004_2010, false, false),
            (0xFFFF_FFFC, false, false),
        ] {
            assert_eq!(may_read(chip, address, 4), read, "read {address:08X}");
            assert_eq!(may_write(chip, address, 4), write, "write {address:08X}");
        }
    }

    #[test]
    fn the_chips_differ_where_their_manuals_do() {
        let chips = [&STM32F407VG, &STM32F412RG, &STM32F413RH, &STM32F429ZI, &STM32F446RE];
        for (address, on) in [
            (0x2002_F000, [false, true, true, true, false]), // SRAM above 128 KiB
            (0x2004_0000, [false, false, true, false, false]), // SRAM2 of the F413
            (0x4000_4C00, [true, false, true, true, true]),  // UART4
            (0x4000_6C00, [false, false, true, false, true]), // CAN3; HDMI-CEC of the F446
            (0x4000_7400, [true, false, true, true, true]),  // DAC
            (0x4000_7800, [false, false, true, true, false]), // UART7
            (0x4000_6000, [false, true, true, false, true]), // FMPI2C1
            (0x4000_3400, [true, true, true, true, false]),  // I2S2ext
            (0x4001_1800, [false, false, true, false, false]), // UART9
            (0x4001_3400, [false, true, true, true, true]),  // SPI4
            (0x4001_5000, [false, true, true, true, false]), // SPI5
            (0x4001_6000, [false, true, true, false, false]), // DFSDM1
            (0x4002_2000, [true, false, false, true, false]), // GPIOI
            (0x4002_2800, [false, false, false, true, false]), // GPIOK
            (0x4002_4000, [true, false, false, true, true]), // backup SRAM
            (0x1000_0000, [true, false, false, true, false]), // CCM
            (0x0817_FFFC, [false, false, true, true, false]), // the last sector of the F413
            (0x081F_FFFC, [false, false, false, true, false]), // second bank
        ] {
            assert_eq!(chips.map(|chip| may_read(chip, address, 4)), on, "{address:08X}");
        }
    }

    #[test]
    fn registers_are_words_and_nothing_leads_over_a_border() {
        for chip in CHIPS {
            assert!(may_read(chip, 0x2000_0001, 3) && may_write(chip, 0x2000_0003, 1));
            for (address, len) in [(0x4002_0001, 4), (0x4002_0000, 2), (0x4002_0002, 2), (0xE000_ED04, 1)] {
                assert!(!may_read(chip, address, len) && !may_write(chip, address, len), "{address:08X}");
            }
            let ram = chip.sram.end();
            assert!(may_write(chip, ram - 8, 8) && !may_write(chip, ram - 8, 9));
            // A range that enters the flash's registers, and one that leaves them.
            assert!(may_read(chip, 0x4002_3BFC, 8) && !may_write(chip, 0x4002_3BFC, 8));
            assert!(!may_write(chip, 0x4002_3FFC, 8));
            for (address, len) in [(0x2000_0000, 0), (u32::MAX, 1), (u32::MAX - 3, u32::MAX), (4, u32::MAX)] {
                assert!(!may_read(chip, address, len) && !may_write(chip, address, len), "{address:08X}");
            }
        }
    }
}
