//! The CAN bus.

pub mod confinement;
pub mod node;
