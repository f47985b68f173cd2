//! Refusals: the status in 1F57h, and the abort for the client.

use canopen::program::FlashError;
use canopen::AbortCode;

/// The status in 1F57h, and the SDO abort for the client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Refusal(pub FlashError, pub AbortCode);

impl Refusal {
    /// The data cannot be stored because they are wrong (08000020h).
    pub(crate) const fn unfit(error: FlashError) -> Self {
        Self(error, AbortCode::STORE)
    }

    /// The data or the command are not possible in the present state of the device (08000022h).
    pub(crate) const fn untimely(error: FlashError) -> Self {
        Self(error, AbortCode::DEVICE_STATE)
    }
}
