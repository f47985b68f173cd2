//! Host side of coboot: firmware files, bus adapters, and the update of a device over CANopen.
//!
//! | room | what is in it | uses |
//! |---|---|---|
//! | [`bus`] | ways to a CAN bus, chosen by URL; traces, frames in words | |
//! | [`file`](mod@file) | firmware files: read, checked, converted | |
//! | [`device`] | SDO with one node, what it says about itself, scan, LSS, errors with numbers and advice | `bus` |
//! | [`update`] | the procedure, a file for each dialect, many devices at once, job files | `bus`, `device`, `file` |
//! | [`machine`] | a package with the programs of a whole machine: its file, the plan for a bus, the update | `bus`, `device`, `file`, `update` |
//! | `agent` (feature `agent`) | a client of an update server, for the devices of its buses | `bus`, `device`, `file`, `update` |
//! | `conform` (feature `conform`) | conformance checks on a device | `bus`, `device` |
//! | `ui` (feature `ui`) | a local web server and its page in the browser | `bus`, `device`, `file`, `update` |
//!
//! The command line (`src/cli`, feature `cli`) is an ordinary user of this library: decisions are
//! made here, and output is printed there.
//!
//! These lines flash a file:
//!
//! ```no_run
//! use coflash::device::{Session, Timing};
//! use coflash::file::convert::{blocks_of, Options, Region};
//! use coflash::update::{flash, FlashOptions};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let layout = shared_abi::layout::by_name("stm32f407g-disc1").ok_or("unknown board")?;
//! let options = Options::default().region(Region::Strict(layout.programs[0].into()));
//! let firmware = coflash::file::load("app.elf".as_ref(), None, None)?;
//! let blocks = blocks_of(firmware, &options)?.file;
//!
//! let mut bus = coflash::bus::open("socketcand://127.0.0.1:29536/can0")?;
//! let node = canopen::NodeId::new(1).ok_or("no such node-ID")?;
//! let mut session = Session::new(&mut bus, node, Timing::default());
//! flash(&mut session, &blocks, &FlashOptions::default(), &mut |event| println!("{event}"))?;
//! # Ok(())
//! # }
//! ```
#![forbid(unsafe_code)]

// The command line names this library as every other program does.
#[cfg(feature = "cli")]
extern crate self as coflash;

mod json;
#[macro_use]
mod setters;
mod unicode;

#[cfg(feature = "agent")]
pub mod agent;
pub mod bus;
#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod cli;
#[cfg(feature = "conform")]
pub mod conform;
pub mod device;
pub mod file;
pub mod machine;
#[cfg(feature = "ui")]
pub mod ui;
pub mod update;

pub use bus::Adapter;
pub use device::{Error, Session};

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
