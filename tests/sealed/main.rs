//! Sealed images, on the model of the flash and on the emulated chip.

mod access;
mod attacker;
mod blocks;
mod client;
mod confirmation;
mod conform;
mod device;
mod dictionary;
mod flash_lock;
mod model;
mod pieces;
mod powercut;
mod provisioning;
mod refusals;
mod renewal;
mod strangers;
