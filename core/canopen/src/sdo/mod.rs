//! Service data objects (CiA 301 section 7.2.4): access to the object dictionary of a node.
//!
//! **Download**: the client writes. **Upload**: the client reads. Up to four bytes are transferred
//! *expedited*, in one frame; more are transferred *segmented*, with an answer to each seven bytes,
//! or as *blocks*, with an answer to up to 127 times seven bytes and a CRC over all data.

pub mod block;
pub mod client;
mod fields;
pub mod second;
pub mod server;
pub mod wire;

pub use client::{Download, SdoError, Step, Transfer, Upload};
pub use server::SdoServer;
