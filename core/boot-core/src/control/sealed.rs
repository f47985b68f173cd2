//! The memory of a device that takes sealed images, and its parts: the rights for `control`, the
//! processing of an image for the programmer.

use super::rights::{Access, Rights};
use crate::unseal::{Unsealer, Workshop};

/// The memory of a device that takes sealed images. It is large, and therefore not a part of the
/// bootloader's structure.
pub struct SealedMemory {
    access: Access,
    workshop: Workshop,
}

impl Default for SealedMemory {
    fn default() -> Self {
        Self::new()
    }
}

impl SealedMemory {
    /// The memory for one image at a time. All of it is zero, so that it takes no flash.
    #[must_use]
    pub const fn new() -> Self {
        Self { access: Access::new(), workshop: Workshop::new() }
    }

    /// For a device that takes sealed images.
    pub fn sealed(&mut self) -> Sealed<'_> {
        Sealed(Some(self))
    }
}

/// Whether a device takes sealed images: it does if it has a [`SealedMemory`] for them.
pub struct Sealed<'b>(Option<&'b mut SealedMemory>);

impl<'b> Sealed<'b> {
    /// For a device that takes no sealed images.
    pub const NONE: Self = Self(None);

    /// The two parts.
    pub(super) fn split(self) -> (Rights<'b>, Unsealer<'b>) {
        let (access, workshop) = self.0.map(|room| (&mut room.access, &mut room.workshop)).unzip();
        (Rights::new(access), Unsealer::new(workshop))
    }
}
