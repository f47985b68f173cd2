//! Sealed images, between the queue and the flash: the one seam of the feature `sealed`. Without it
//! nothing of them is there, and every question is answered by no.

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
