//! Sealed images between the queue and the flash: an image is verified, deciphered and unpacked here.
//! Without the feature `sealed`, there is no code for sealed images, and every question is answered
//! with no. Other modules depend on the feature, too: where they ask what only a sealed image has.

#[cfg(not(feature = "sealed"))]
mod absent;
#[cfg(feature = "sealed")]
mod access;
#[cfg(feature = "sealed")]
mod image;

#[cfg(not(feature = "sealed"))]
pub use absent::{Room, Unsealer};
#[cfg(feature = "sealed")]
pub(crate) use image::proved;
#[cfg(feature = "sealed")]
pub use image::{Room, Unsealer};
