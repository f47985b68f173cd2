//! Sealed images, on the model of the flash and on the emulated chip.
#![cfg(split_map)]

mod access;
mod blocks;
mod client;
mod confirmation;
#[cfg(staging)]
mod conform;
mod device;
mod dictionary;
mod factory;
mod flash_lock;
mod model;
mod pieces;
mod provisioning;
mod refusals;
#[cfg(staging)]
mod renewal;
mod strangers;
