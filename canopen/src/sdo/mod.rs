//! Service data objects (CiA 301 section 7.2.4): access to the object dictionary of a node.
//!
//! **Download** is the client writing, **upload** the client reading. Up to four bytes go *expedited* in one frame,
//! more go *segmented* with an answer to each seven bytes.

pub mod abort;
pub mod client;
pub mod server;
pub mod wire;

pub use abort::AbortCode;
pub use client::{Download, SdoError, Step, Transfer, Upload};
pub use server::SdoServer;
