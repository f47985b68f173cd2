//! STM32F429I-DISC1 (STM32F429ZI: 2 MiB flash in two banks of 4×16, 64 and 7×128 KiB; 192 KiB
//! SRAM).
//!
//! The program extends over both banks: sectors 5 to 11 of the first bank and all of the second
//! one, sectors 12 to 23. The three SRAMs (112, 16 and 64 KiB) are contiguous and form one region
//! for a program; handoff and warm-start cell are at the end of the third one. The CCM is not
//! assigned: the bootloader does not clear it, and the application may use it.

use crate::geometry::{Region, STM32F429ZI};
use crate::layout::Layout;

/// The memory map of the STM32F429I-DISC1: split.
pub const LAYOUT: Layout = Layout {
    board: "stm32f429i-disc1",
    chip: &STM32F429ZI,
    bootloader: Region::new(0x0800_0000, 16 * 1024),
    callgate_offset: 0x40,
    home: Some(Region::new(0x0801_0000, 64 * 1024)),
    parameters: [Region::new(0x0800_4000, 16 * 1024), Region::new(0x0800_8000, 16 * 1024)],
    data: Some(Region::new(0x0800_C000, 16 * 1024)),
    programs: &[Region::new(0x0802_0000, (2048 - 128) * 1024)],
    staging: None,
    ram: Region::new(0x2000_0000, 192 * 1024 - 64),
    handoff: Region::new(0x2002_FFC0, 48),
    warm_start: Region::new(0x2002_FFF0, 16),
}
.checked();
