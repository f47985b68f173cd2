//! The libraries of two makers of CAN adapters, loaded while the program runs: nobody needs them to
//! build it, or to use another adapter.
//!
//! | module | library | from |
//! |---|---|---|
//! | [`pcan`] | PCANBasic | PEAK-System |
//! | [`canlib`] | CANlib | Kvaser |
//!
//! This crate has the host tools' only `unsafe`: each module holds the signatures of one library, calls
//! its functions, and hands out plain values. What these mean is judged elsewhere (`coflash::adapter`).
//! A library that writes beyond the buffers that it is given cannot be held back by anybody; one that
//! returns nonsense can, and callers have to expect it in every value.
//!
//! **Not tried on hardware**: the signatures are those of the public headers, and the tests call
//! stand-ins that are compiled from the same.

pub mod canlib;
mod load;
pub mod pcan;

pub use load::LoadError;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
