//! Sessions with a device.

mod answers;
mod lss;
