//! The STM32F407G-DISC1 with its transceiver at CAN2: it has the same memory map, with another
//! name.

use crate::layout::{stm32f407g_disc1, Layout};

/// The memory map of the STM32F407G-DISC1 with CAN2.
pub const LAYOUT: Layout = Layout { board: "stm32f407g-disc1-can2", ..stm32f407g_disc1::LAYOUT }.checked();
