//! The parts of the Cortex-M4 that sit beside the instruction set: exceptions and their priorities,
//! the system control block, SysTick, the breakpoint unit. Sources: PM0214 (programming manual of
//! the STM32F4's core) chapter 4, and the ARMv7-M architecture reference manual (DDI 0403E) where
//! PM0214 is silent.

pub mod debug;
pub mod exceptions;
pub mod scs;
pub mod systick;
