//! The tests of the bootloader without hardware. They run with the feature `sealed` and without it;
//! sealed images themselves are tested in `tests/`.

mod attacker;
mod clear;
mod decision;
mod download;
mod faults;
mod label;
mod masters;
mod objects;
mod parameters;
#[cfg(not(feature = "sealed"))]
mod resume;
mod streams;
