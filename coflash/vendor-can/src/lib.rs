//! The libraries of two manufacturers of CAN adapters, loaded at run time: they are not necessary
//! to build the program, or to use another adapter.
//!
//! | module | library | from |
//! |---|---|---|
//! | [`pcan`] | PCANBasic | PEAK-System |
//! | [`canlib`] | CANlib | Kvaser |
//!
//! This crate has the only `unsafe` code of the host tools: each module holds the signatures of one
//! library, calls its functions, and returns plain values. Other code (`coboot_can`) checks
//! these values. Nothing can stop a library that writes beyond its buffers; but a library may
//! return invalid values, and callers must expect them in every value.
//!
//! **Not tested on hardware**: the signatures are those of the public headers, and the tests call
//! stand-ins that are compiled from the same headers.

pub mod canlib;
mod load;
pub mod pcan;

pub use load::LoadError;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
