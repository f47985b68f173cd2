//! Sessions with a device.

mod lss;
