//! The bootloader without its hardware: sans-IO, `no_std`, no unsafe.
//!
//! | module | what it does |
//! |---|---|
//! | [`bootloader`] | the object dictionary and everything behind it |
//! | [`decision`] | bootloader or program, after every reset |
//! | [`program`] | what is known of a program, and the proof that it may be started |
//! | [`parameters`] | the power-fail-safe journal of the non-volatile parameters |
//! | [`node`] | node-ID and bit rate of the device |
//! | [`download`] | 1F50h, 1F51h, 1F56h, 1F57h: block files into flash |
//! | [`crc`] | CRC-32 |
//! | [`flash`] | the seam to the flash |
#![no_std]
#![forbid(unsafe_code)]

pub mod bootloader;
pub mod crc;
pub mod decision;
pub mod download;
pub mod flash;
pub mod node;
pub mod parameters;
pub mod profile;
pub mod program;
#[cfg(feature = "read-back")]
mod stored_version;

/// Frames, node and transfers, in which the core speaks: a firmware that uses this crate needs no
/// other for them.
pub use canopen;
pub use crc::crc32;
