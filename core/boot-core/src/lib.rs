//! The bootloader without its hardware: sans-IO, `no_std`, no unsafe.
//!
//! | module | what it does | knows |
//! |---|---|---|
//! | [`decision`] | what runs after a reset: a program, or the bootloader from which place | records and images, no object |
//! | `intake` | what arrives in 1F50h: bytes in, judged and placed pieces out | formats, no flash |
//! | `queue` | the pieces between the two | |
//! | `unseal` | sealed images: authentic, deciphered, unpacked | the format, no object |
//! | `source` | where the programmer's data come from: the queue, or a sealed image in it | both |
//! | `programmer` | erase, write, read back, verify | pieces and flash, no format, no object |
//! | `sequence` | sectors to erase and words to program, one operation at a time | |
//! | [`store`] | everything non-volatile | the journal |
//! | [`control`] | 1F51h, 1F57h: the rules that tie the three together | all of them |
//! | `session` | the state of a program's download, and blocks that come twice | block files |
//! | `resume` | what goes on after a cut | block files |
//! | `refusal` | a refusal: the status in 1F57h, and the abort for the client | |
//! | [`bootloader`] | the object dictionary over it | objects |
//! | `stored_version` | 100Ah: the version text, searched in a stored program | |
//! | [`program`] | the proof that a program may be started | |
//! | [`renewal`] | which RAM image of the bootloader is loaded, and whether one is good | |
//! | `keys` | whether the device takes sealed images, and whether it has keys and takes no others | |
//! | `choices` | what a bootloader has; for the rest it has no code | |
//! | [`crc`] | the CRCs of block file, program and journal | |
//! | [`policy`], [`profile`] | what a product may choose, and the rules for data that follow from it | |
//! | [`flash`] | the seam to the flash | |
#![no_std]
#![forbid(unsafe_code)]

pub mod bootloader;
mod choices;
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
pub mod renewal;
mod resume;
mod sequence;
mod session;
mod source;
pub mod store;
mod stored_version;
mod unseal;

/// Frames, node and transfers, used in the interface of the core: firmware that uses this crate
/// needs no further dependency for them.
pub use canopen;
pub use crc::crc32;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
