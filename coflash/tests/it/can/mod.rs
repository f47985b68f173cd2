//! Adapters and frames.

mod decode;
mod gateway;
