//! The STM32F407G-DISC1 with room for two programs: the same board with another memory map.

#[path = "stm32f407g_disc1.rs"]
mod same;

pub use same::*;
