//! A CANopen slave and an SDO client (CiA 301), sans-IO and without an allocator.
//!
//! Nothing in here waits, reads a clock or touches a controller. Frames and the time are passed in, frames to send are
//! fetched: `handle(&frame, now)` for each frame received, then `poll(now)` until it has nothing more to send, and
//! again whenever time has passed.
//!
//! | module | what it is |
//! |---|---|
//! | [`frame`] | a CAN frame, node-IDs, COB-IDs of the predefined connection set |
//! | [`time`] | milliseconds that wrap |
//! | [`od`] | the object dictionary: a table of entries and a trait for their values |
//! | [`sdo`] | wire codec, abort codes, server, client |
//! | [`nmt`], [`heartbeat`] | network management of a slave, heartbeat producer |
//! | [`node`] | all of a slave tied together for one node-ID |
//! | [`device`] | the objects that every device has |
//! | `emcy` | emergency producer, 1001h, 1003h, 1014h (feature `emcy`) |
//! | `lss` | layer setting services: node-ID and bit rate over the bus (feature `lss`) |
//! | [`program`] | program download: the words of CiA 302-3 |
#![no_std]
#![forbid(unsafe_code)]

#[cfg(feature = "alloc")]
extern crate alloc;

pub mod device;
#[cfg(feature = "emcy")]
pub mod emcy;
pub mod frame;
pub mod heartbeat;
#[cfg(feature = "lss")]
pub mod lss;
pub mod nmt;
pub mod node;
pub mod od;
pub mod program;
pub mod sdo;
pub mod time;

pub use frame::{CobId, Frame, NodeId};
pub use od::{Address, Objects};
pub use sdo::AbortCode;
pub use time::Instant;
