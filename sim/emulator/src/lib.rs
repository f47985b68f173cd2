//! An emulated STM32F4 on a virtual CAN bus: it runs the very ELF files that go onto the board.

pub mod bus;
pub mod bxcan;
pub mod candump;
pub mod chip;
pub mod clock;
pub mod control;
pub mod cortex;
pub mod cpu;
pub mod defmt;
pub mod error;
pub mod frame;
#[cfg(feature = "gdb")]
pub mod gdb;
pub mod machine;
pub mod memory;
pub mod noise;
pub mod options;
pub mod pacing;
pub mod periph;
pub mod peripheral;
pub mod report;
pub mod rtt;
pub mod serial;
pub mod slice;
pub mod socketcand;
pub mod time;
pub mod variant;
pub mod world;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
