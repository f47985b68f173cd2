//! Bootloader nodes without a chip: the `boot-core` of the firmware on a bus of the host, with a
//! file in place of flash.
//!
//! For whoever writes a tool or a CANopen master and wants a device to try it on, or many; and for
//! tests.
//!
//! | module | what it does |
//! |---|---|
//! | [`file_flash`] | the flash of a chip in a file |
//! | [`device`] | a device: boot decision, bootloader, and what is there in place of a program |
//! | [`stand_in`] | a program that is none: the objects that a host asks a running application for |
//! | [`server`] | a bus of its own, for socketcand clients |
//!
//! What a node is and is not stands in `docs/node.md`.
#![forbid(unsafe_code)]

pub mod device;
pub mod file_flash;
pub mod server;
pub mod stand_in;

use boot_core::canopen::BitRate;

/// Whether a device can be set to this bit rate. The bus has none of its own, so any can be; there
/// is nothing to find out.
#[must_use]
pub fn supports(rate: BitRate) -> bool {
    rate != BitRate::Auto
}

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
