//! A device without the debugger interface, 1025h: no object, and no code. The feature `debugger`
//! puts the module `debugger.rs` in its place.

use canopen::od::Entry;

/// No objects.
pub const ENTRIES: [Entry; 0] = [];

/// An interface without function.
#[derive(Default)]
pub struct Debugger;

impl Debugger {
    /// An interface without function.
    #[must_use]
    pub const fn new() -> Self {
        Self
    }

    /// The device itself, unchanged.
    pub fn attach<'a, D>(&'a mut self, device: &'a mut D) -> &'a mut D {
        device
    }
}
