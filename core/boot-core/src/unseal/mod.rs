//! The interface between the queue, the flash and sealed images: the only place that depends on the
//! feature `sealed`. Without the feature, there is no code for sealed images, and every question is
//! answered with no.

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
