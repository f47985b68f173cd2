//! Sealed images between the queue and the flash: an image is verified, deciphered and unpacked here.
//!
//! A device that takes them has an [`Unsealer`] with a [`Room`]; in any other device, every question to
//! the [`Unsealer`] is answered with no. Other modules ask it, and never how the bootloader was built.

mod access;
mod image;

pub(crate) use image::proved;
pub use image::{Room, Unsealer};
