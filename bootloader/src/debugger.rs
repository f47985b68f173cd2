//! The device without the debugger interface, 1025h: no object and no code. With the feature
//! `debugger`, `bsp::debugger` takes this place: **every node on the bus can then read and write
//! this device's memory**.

use boot_core::canopen::od::Entry;

/// No objects.
pub const ENTRIES: [Entry; 0] = [];

/// An interface without function.
pub struct Debugger;

impl Debugger {
    /// An interface without function.
    pub const fn new() -> Self {
        Self
    }

    /// The device itself, unchanged.
    pub fn attach<'a, D>(&'a mut self, device: &'a mut D) -> &'a mut D {
        device
    }
}
