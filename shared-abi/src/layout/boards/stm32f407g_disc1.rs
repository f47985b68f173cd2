//! STM32F407G-DISC1 (STM32F407VG: 1 MiB flash in 4×16, 64 and 7×128 KiB; 128 KiB SRAM).

use crate::geometry::{Region, STM32F407VG};
use crate::layout::Layout;

/// The memory map of the STM32F407G-DISC1: split.
pub const LAYOUT: Layout = Layout {
    board: "stm32f407g-disc1",
    chip: &STM32F407VG,
    bootloader: Region::new(0x0800_0000, 16 * 1024),
    callgate_offset: 0x40,
    home: Some(Region::new(0x0801_0000, 64 * 1024)),
    parameters: [Region::new(0x0800_4000, 16 * 1024), Region::new(0x0800_8000, 16 * 1024)],
    data: Some(Region::new(0x0800_C000, 16 * 1024)),
    programs: &[Region::new(0x0802_0000, 896 * 1024)],
    staging: Some(Region::new(0x080E_0000, 128 * 1024)),
    ram: Region::new(0x2000_0000, 128 * 1024 - 64),
    handoff: Region::new(0x2001_FFC0, 48),
    warm_start: Region::new(0x2001_FFF0, 16),
}
.checked();
