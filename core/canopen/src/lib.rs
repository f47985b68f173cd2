//! A CANopen slave and an SDO client (CiA 301), sans-IO and without an allocator.
//!
//! Nothing in this crate waits, reads a clock or accesses a controller. The owner passes in frames
//! and the time, and fetches the frames to send: `handle(&frame, now)` for each received frame,
//! then `poll(now)` until it returns nothing, and again after some time has passed.
//!
//! | module | what it is |
//! |---|---|
//! | [`frame`] | a CAN frame, node-IDs, COB-IDs of the predefined connection set |
//! | [`time`] | milliseconds that wrap |
//! | [`od`] | the object dictionary: a table of entries and a trait for their values |
//! | [`sdo`] | wire codec, abort codes, server, client |
//! | [`nmt`], [`heartbeat`] | network management of a slave, heartbeat producer |
//! | [`node`] | NMT, heartbeat, emergencies and SDO server of one node-ID |
//! | [`device`] | the objects that every device has |
//! | `debugger` | the debugger interface, 1025h (feature `debugger`) |
//! | [`emcy`] | emergency producer, 1001h, 1003h, 1014h |
//! | [`lss`] | layer setting services: node-ID and bit rate over the bus |
//! | [`bit_rate`] | the bit rates of CANopen, and their detection by listening |
//! | [`line`](mod@line) | state of the CAN controller: error passive, bus-off, frames lost |
//! | [`slave`] | a device on the bus: node, LSS and line together |
//! | [`password`] | a password check that slows down guessing |
//! | [`pdo`] | process data objects and SYNC, of an application |
//! | [`program`] | program download: the indices and values of CiA 302-3 |
#![no_std]
#![forbid(unsafe_code)]

#[cfg(feature = "alloc")]
extern crate alloc;

mod abort;
pub mod bit_rate;
#[cfg(feature = "debugger")]
pub mod debugger;
pub mod device;
pub mod emcy;
pub mod frame;
pub mod heartbeat;
pub mod line;
pub mod lss;
pub mod nmt;
pub mod node;
pub mod od;
pub mod password;
pub mod pdo;
pub mod program;
pub mod sdo;
pub mod slave;
pub mod time;

pub use abort::AbortCode;
pub use bit_rate::BitRate;
pub use frame::{CobId, Frame, NodeId};
pub use od::{Address, Objects};
pub use time::Instant;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
