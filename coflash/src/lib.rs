//! Host side of coboot: firmware files, bus adapters, and the update of a device over CANopen.
//!
//! | module | what it does |
//! |---|---|
//! | [`read`] | Intel HEX, S-record, ELF, raw and block files into memory, with the place of every fault |
//! | [`image`] | memory contents with holes |
//! | [`convert`] | an image into blocks |
//! | [`inspect`] | what a firmware file holds, in words |
//! | [`block_file`] | the container that 1F50h takes: read, verified, written |
//! | [`adapter`] | ways to a CAN bus, chosen by URL |
//! | [`gateway`] | ways to devices on a bus somewhere else, by SDO alone |
//! | [`link`] | what a URL leads to: a bus or a gateway |
//! | [`session`] | SDO with one node: values, commands, status |
//! | [`flash`] | the update procedure, with its steps as events |
//! | [`dialect`] | what different bootloaders make of the same objects |
//! | [`flying_master`] | NMT mastership, asked for and given back |
//! | [`job`] | a file that says which devices get what |
//! | [`many`] | the same for many devices at once |
//! | [`hub`] | several conversations over one adapter |
//! | [`info`] | what a device says about itself |
//! | [`scan`] | who is on the bus |
//! | [`lss`] | node-ID and bit rate over the bus |
//! | [`decode`] | frames in words |
//! | [`candump`] | logs of frames |
//! | [`diagnose`] | why a device may be silent |
//! | [`config`] | a file with defaults for options |
//! | [`legacy`] | the numbers that the manual's tools end with |
//! | [`error`] | what can go wrong with a device, with numbers and advice |
//!
//! Flashing a file takes these lines:
//!
//! ```no_run
//! use coflash::convert::{blocks_of, Options, Region};
//! use coflash::flash::{flash, FlashOptions};
//! use coflash::session::{Session, Timing};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let layout = shared_abi::layout::by_name("stm32f407g-disc1").ok_or("unknown board")?;
//! let options = Options { region: Region::Strict(layout.programs[0].into()), ..Options::default() };
//! let firmware = coflash::read::load("app.elf".as_ref(), None, None)?;
//! let blocks = blocks_of(firmware, &options)?.file;
//!
//! let mut bus = coflash::adapter::open("socketcand://127.0.0.1:29536/can0")?;
//! let node = canopen::NodeId::new(1).ok_or("no such node-ID")?;
//! let mut session = Session::new(&mut bus, node, Timing::default());
//! flash(&mut session, &blocks, &FlashOptions::default(), &mut |event| println!("{event}"))?;
//! # Ok(())
//! # }
//! ```
#![forbid(unsafe_code)]

pub mod adapter;
pub mod block_file;
pub mod candump;
pub mod config;
pub mod convert;
pub mod debugger;
pub mod decode;
pub mod diagnose;
pub mod dialect;
pub mod error;
pub mod flash;
pub mod flying_master;
pub mod gateway;
pub mod hub;
pub mod image;
pub mod info;
pub mod inspect;
pub mod job;
pub mod legacy;
pub mod link;
pub mod lss;
pub mod many;
pub mod read;
pub mod scan;
pub mod session;

pub use adapter::Adapter;
pub use error::Error;
pub use session::Session;
