//! Service data objects (CiA 301 section 7.2.4): access to the object dictionary of a node.
//!
//! **Download** is the client writing, **upload** the client reading. Up to four bytes go
//! *expedited* in one frame, more go *segmented* with an answer to each seven bytes, or as *blocks*
//! with an answer to up to 127 times seven bytes and a CRC over everything.

pub mod abort;
pub mod block;
pub mod client;
mod fields;
pub mod server;
pub mod wire;

pub use abort::AbortCode;
pub use client::{Download, SdoError, Step, Transfer, Upload};
pub use server::SdoServer;
