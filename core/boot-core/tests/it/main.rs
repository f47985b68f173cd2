//! The tests of the bootloader without hardware, of a device without keys. They run twice: for one that
//! takes sealed images, and for one that does not (`kit::boot`). Sealed images themselves are tested in
//! `tests/`.

mod blocks;
mod choice;
mod clear;
mod decision;
mod download;
mod faults;
mod label;
mod objects;
mod parameters;
mod protection;
mod renewal;
mod resume;
mod rom_loader;
mod streams;
mod supply;
