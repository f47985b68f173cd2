//! NUCLEO-F446RE (STM32F446RE: 512 KiB flash in 4×16, 64 and 3×128 KiB; 128 KiB SRAM).

use crate::geometry::{Region, STM32F446RE};
use crate::layout::Layout;

/// The memory map of the NUCLEO-F446RE: compact.
pub const LAYOUT: Layout = Layout {
    board: "nucleo-f446re",
    chip: &STM32F446RE,
    bootloader: Region::new(0x0800_0000, 32 * 1024),
    callgate_offset: 0x40,
    home: None,
    parameters: [Region::new(0x0800_8000, 16 * 1024), Region::new(0x0800_C000, 16 * 1024)],
    data: None,
    programs: &[Region::new(0x0801_0000, 448 * 1024)],
    staging: None,
    ram: Region::new(0x2000_0000, 128 * 1024 - 64),
    handoff: Region::new(0x2001_FFC0, 48),
    warm_start: Region::new(0x2001_FFF0, 16),
}
.checked();
