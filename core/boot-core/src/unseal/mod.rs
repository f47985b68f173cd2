//! Sealed images between the queue and the flash: an image is verified, deciphered and unpacked here.
//!
//! A device that takes them has an [`Unsealer`] with a [`Room`]; in any other device, every question to
//! the [`Unsealer`] is answered with no. Other modules ask it, and never how the bootloader was built.

mod access;
mod image;

pub(crate) use image::proved;
pub use image::{Room, Unsealer};

/// The images that a device takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Images {
    /// Plain ones: it knows no sealed ones.
    Plain,
    /// Both: it has no keys yet.
    Both,
    /// Sealed ones alone.
    Sealed,
}

impl Images {
    /// Whether sealed images are among them.
    pub(crate) fn has_sealed(self) -> bool {
        LINKED && self != Self::Plain
    }

    /// Whether plain images are refused.
    pub(crate) fn only_sealed(self) -> bool {
        LINKED && self == Self::Sealed
    }
}

/// Whether the code for sealed images is linked. This is the only place that depends on it: the
/// compiler leaves out what follows a question that is always answered with no.
pub(crate) const LINKED: bool = cfg!(feature = "sealed");
