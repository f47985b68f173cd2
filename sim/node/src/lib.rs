//! Bootloader nodes without a chip: the firmware's `boot-core` on a bus of the host, with a file in
//! place of flash.
//!
//! For developers of tools and CANopen masters who need one or many devices for their tests.
//!
//! | module | what it does |
//! |---|---|
//! | [`args`] | the words of the command line |
//! | [`file_flash`] | the flash of a chip in a file |
//! | [`device`] | a device: boot decision, bootloader, and the replacement of a program |
//! | [`stand_in`] | the replacement of a program: the objects that a host reads from a running
//! application |
//! | [`run`] | the program as a process of the host |
//! | [`server`] | a separate bus for socketcand clients |
//!
//! `docs/node.md` describes the properties and limits of a node.
#![forbid(unsafe_code)]

pub mod args;
pub mod device;
pub mod file_flash;
pub mod run;
pub mod server;
pub mod stand_in;

use boot_core::canopen::BitRate;

/// Whether a device supports this bit rate. The bus has no bit rate, so a device supports all fixed
/// ones and cannot detect one.
#[must_use]
pub fn supports(rate: BitRate) -> bool {
    rate != BitRate::Auto
}

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
