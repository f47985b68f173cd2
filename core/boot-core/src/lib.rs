//! The bootloader without its hardware: sans-IO, `no_std`, no unsafe.
//!
//! | module | what it does | knows |
//! |---|---|---|
//! | [`decision`] | bootloader or program, after every reset | records, no flash |
//! | `intake` | what arrives in 1F50h: bytes in, judged and placed pieces out | formats, no flash |
//! | `queue` | the pieces between the two | |
//! | `unseal` | sealed images: authentic, deciphered, unpacked (feature `sealed`) | the format, no object |
//! | `programmer` | erase, write, read back, verify | pieces and flash, no format, no object |
//! | [`store`] | everything non-volatile | the journal |
//! | [`control`] | 1F51h, 1F57h, sessions: the rules that tie the three together | all of them |
//! | [`bootloader`] | the object dictionary over it | objects |
//! | [`program`] | the proof that a program may be started | |
//! | [`policy`], [`profile`] | what a product may choose | |
//! | [`flash`] | the seam to the flash | |
#![no_std]
#![forbid(unsafe_code)]

pub mod bootloader;
pub mod control;
pub mod crc;
pub mod decision;
pub mod flash;
mod intake;
mod keys;
pub mod policy;
pub mod profile;
pub mod program;
mod programmer;
mod queue;
mod refusal;
mod resume;
mod sequence;
mod session;
pub mod store;
mod stored_version;
pub mod unseal;

/// Frames, node and transfers, used in the interface of the core: firmware that uses this crate
/// needs no further dependency for them.
pub use canopen;
pub use crc::crc32;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
