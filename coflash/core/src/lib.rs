//! Host side of coboot: firmware files, and the update of a device over CANopen. The ways to a bus are
//! in the crate `coboot-can`.
//!
//! | room | what is in it | uses |
//! |---|---|---|
//! | [`advice`] | what to do next, after an error or in mid-update | |
//! | [`file`](mod@file) | firmware files: read, checked, converted | `advice` |
//! | [`device`] | SDO with one node, what it says about itself, scan, LSS, errors with numbers and advice | `advice` |
//! | [`update`] | the procedure, a file for each dialect, many devices at once | `advice`, `device`, `file` |
//! | [`machine`] | a package with the programs of a whole machine: its recipe and file, the plan for a bus, the update | `device`, `file`, `update` |
//!
//! The page in the browser, the update agent, the conformance checks and the command line are crates
//! beside this one (`coflash-ui`, `coflash-agent`, `coflash-conform`, `coflash`) and use it as every
//! other program does: decisions are made here, and output is printed there.
//!
//! These lines flash a file:
//!
//! ```no_run
//! use coflash_core::device::{Session, Timing};
//! use coflash_core::file::convert::{program_of, Options, Region};
//! use coflash_core::update::{flash, FlashOptions};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let layout = shared_abi::layout::by_name("stm32f407g-disc1").ok_or("unknown board")?;
//! let options = Options::default().region(Region::Strict(layout.programs[0].into()));
//! let firmware = coflash_core::file::load("app.elf".as_ref(), None, None)?;
//! let program = program_of(firmware, &options)?.program;
//!
//! let mut bus = coboot_can::open("socketcand://127.0.0.1:29536/can0")?;
//! let node = canopen::NodeId::new(1).ok_or("no such node-ID")?;
//! let mut session = Session::new(&mut bus, node, Timing::default());
//! flash(&mut session, &program, &FlashOptions::default(), &mut |event| println!("{event}"))?;
//! # Ok(())
//! # }
//! ```
#![forbid(unsafe_code)]

mod json;
#[macro_use]
mod options;
mod unicode;

pub mod advice;
pub mod device;
pub mod file;
pub mod machine;
pub mod update;

pub use advice::Advice;
pub use device::{Error, Session};

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
