//! Why something is refused: what 1F57h shows, and what the client is answered.

use canopen::program::FlashError;
use canopen::AbortCode;

/// The status that 1F57h shows, and the SDO abort that the client gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Refusal(pub FlashError, pub AbortCode);

impl Refusal {
    /// The data cannot be stored: they are wrong in themselves (08000020h).
    pub(crate) const fn unfit(error: FlashError) -> Self {
        Self(error, AbortCode::STORE)
    }

    /// The data or the command may be right, but not in this state of the device (08000022h).
    #[inline(never)]
    pub(crate) const fn untimely(error: FlashError) -> Self {
        Self(error, AbortCode::DEVICE_STATE)
    }
}
