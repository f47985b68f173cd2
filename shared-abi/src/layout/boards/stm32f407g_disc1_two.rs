//! The STM32F407G-DISC1 with room for two programs: one in sectors 5 to 7, one in sectors 8 to 11.

use crate::geometry::Region;
use crate::layout::{stm32f407g_disc1, Layout};

/// The memory map of the STM32F407G-DISC1 with two programs.
pub const LAYOUT: Layout = Layout {
    board: "stm32f407g-disc1-two",
    programs: &[Region::new(0x0802_0000, 384 * 1024), Region::new(0x0808_0000, 512 * 1024)],
    ..stm32f407g_disc1::LAYOUT
}
.checked();
