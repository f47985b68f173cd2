//! An emulated STM32F4 on a virtual CAN bus: it runs the very ELF files that go onto the board.

pub mod peripheral;
pub mod time;
