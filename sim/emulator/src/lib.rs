//! An emulated STM32F4 on a virtual CAN bus: it runs the very ELF files that go onto the board.
//!
//! | file | what it does |
//! |---|---|
//! | [`world`] | machines and host ports on one bus, in one virtual time |
//! | [`machine`] | one board: power, reset, time, images, the debugger's control |
//! | [`cpu`] | the Cortex-M4: Unicorn runs the instructions, the module handles the exceptions |
//! | [`costs`] | what code costs in cycles, if the manuals are asked |
//! | [`chip`] | the chip around the CPU: memories, peripherals, clocks, the address map |
//! | [`slice`](mod@slice) | what chip and CPU loop have to say to each other |
//! | [`cortex`] | exceptions, system control block, SysTick, breakpoint unit |
//! | [`periph`] | the peripherals except CAN; [`peripheral`] is their interface to the chip |
//! | [`bxcan`] | the CAN controllers |
//! | [`variant`] | how the lines of the family differ |
//! | [`silicon`] | what the manuals leave open: the values of one chip |
//! | [`supply`] | VDD, and the resets by it |
//! | [`circuit`] | what a board has at the pins: a watchdog chip, a latch for the power |
//! | [`memory`], [`clock`], [`noise`] | memory of host and chip, cycles as time, random values by a seed |
//! | [`options`], [`error`], [`report`] | set-up, errors, accesses that are wrong or not modelled |
//! | [`bus`], [`frame`] | the CAN bus: arbitration, errors, faults; frames and their bits |
//! | [`time`], [`pacing`] | virtual time, and how it follows the wall clock |
//! | [`socketcand`], [`serial`], [`control`] | the bus, a USART, and power and pins for other programs |
//! | [`gdb`] | the door for gdb |
//! | [`candump`], [`rtt`], [`defmt`] | the log of the bus, and what a program prints |

pub mod bus;
pub mod bxcan;
pub mod candump;
pub mod chip;
pub mod circuit;
pub mod clock;
pub mod control;
pub mod cortex;
pub mod costs;
pub mod cpu;
pub mod defmt;
pub mod error;
pub mod frame;
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
pub mod silicon;
pub mod slice;
pub mod socketcand;
pub mod supply;
pub mod time;
pub mod variant;
pub mod world;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
