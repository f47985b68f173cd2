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

    /// Does something with the device itself.
    #[inline(always)]
    pub fn with<D, R>(&mut self, device: &mut D, action: impl FnOnce(&mut D) -> R) -> R {
        action(device)
    }
}
