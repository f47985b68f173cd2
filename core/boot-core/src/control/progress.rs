//! What the device knows about a renewal of its bootloader.

use shared_abi::renewal::{Origin, TrialEnd};

/// What is known about a renewal.
#[derive(Clone, Copy)]
pub(super) struct Renewal {
    /// The place of the running image.
    pub origin: Origin,
    pub trial_end: TrialEnd,
    /// The version of the running image.
    pub version: u32,
    /// 1F56h of the running image.
    pub identification: u32,
}

impl Renewal {
    /// The running image is that of home.
    pub(super) const NONE: Self =
        Self { origin: Origin::Home, trial_end: TrialEnd::None, version: 0, identification: 0 };
}
