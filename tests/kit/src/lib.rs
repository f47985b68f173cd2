//! What the tests of several crates share. It is a crate, so that each of its parts is compiled once
//! and has one place; no crate that is handed out needs it, except for its own tests.
//!
//! | module | what it has |
//! |---|---|
//! | `random` | random numbers by a seed |
//! | `folder` | a folder of a test's own |
//! | `crc` | CRC-32 and CRC-16 from their definitions |
//! | `ihex` | Intel HEX as tools write it |
//! | `pages` | the commands on the pages of the documentation |
//! | `fake` | feature `fake`: devices with virtual time, as adapters and behind a socketcand server |
//! | `hawkbit` | feature `hawkbit`: a hawkBit server with faults |
//! | `http` | feature `http`: a page of `coflash ui` without a browser |
//! | `bus` | feature `bus`: a CANopen device with a domain, and frames to it and from it |
//! | `memory` | feature `debugger`: a device with the debugger interface, and its memory |
//! | `model` | feature `boot`: a strict flash that loses power on demand |
//! | `boot` | feature `boot`: the one way to make a bootloader |
//! | `driver` | feature `boot`: the demonstration that proves a flash driver |
//! | `bench` | feature `boot`: a bootloader on that flash, and the actions of a host |
//! | `renewal` | feature `boot`: RAM images, and the part of the resident part that loads one |
//! | `rig` | feature `boot`: a bootloader of any profile, driven by its objects alone |

#![allow(clippy::new_without_default, reason = "a device that has booted is no default value")]
#![deny(unsafe_code)]

#[cfg(feature = "boot")]
#[allow(missing_docs, reason = "names say it")]
pub mod bench;
#[cfg(feature = "boot")]
pub mod boot;
#[cfg(feature = "bus")]
#[allow(missing_docs, reason = "names say it")]
pub mod bus;
#[allow(missing_docs, reason = "names say it")]
pub mod crc;
#[cfg(feature = "boot")]
pub mod driver;
#[cfg(feature = "fake")]
#[allow(missing_docs, reason = "names say it")]
pub mod fake;
pub mod folder;
#[cfg(feature = "hawkbit")]
#[allow(missing_docs, reason = "names say it")]
pub mod hawkbit;
#[cfg(feature = "http")]
#[allow(missing_docs, reason = "names say it")]
pub mod http;
pub mod ihex;
#[cfg(feature = "debugger")]
#[allow(missing_docs, reason = "names say it")]
pub mod memory;
#[cfg(feature = "boot")]
#[allow(missing_docs, reason = "names say it")]
pub mod model;
pub mod pages;
pub mod random;
#[cfg(feature = "boot")]
#[allow(missing_docs, reason = "names say it")]
pub mod renewal;
#[cfg(feature = "boot")]
#[allow(missing_docs, reason = "names say it")]
pub mod rig;
