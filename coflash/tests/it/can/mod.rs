//! Adapters and frames.

mod gateway;
