//! Host side of coboot: firmware files, bus adapters, and the update of a device over CANopen.
//!
//! | module | what it does |
//! |---|---|
//! | [`read`] | Intel HEX, S-record, ELF, raw and block files into memory, with the place of every fault |
//! | [`image`] | memory contents with holes |
//! | [`convert`] | an image into blocks |
//! | [`block_file`] | the container that 1F50h takes: read, verified, written |
#![forbid(unsafe_code)]

pub mod block_file;
pub mod convert;
pub mod image;
pub mod read;
