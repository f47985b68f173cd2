//! The STM32F407G-DISC1 with a watchdog chip: it has the same memory map, with another name.

use crate::layout::{stm32f407g_disc1, Layout};

/// The memory map of the STM32F407G-DISC1 with a watchdog chip.
pub const LAYOUT: Layout = Layout { board: "watchdog-chip", ..stm32f407g_disc1::LAYOUT }.checked();
