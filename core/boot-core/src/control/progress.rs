//! What the device knows about a renewal of its bootloader.

use shared_abi::renewal::{Origin, State, TrialEnd};

use crate::store::RenewalRecord;

/// What is known about a renewal.
#[derive(Clone, Copy)]
pub(super) struct Renewal {
    /// The stored record; a copy, because the flash cannot be read while it is busy.
    pub record: Option<RenewalRecord>,
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
        Self { record: None, origin: Origin::Home, trial_end: TrialEnd::None, version: 0, identification: 0 };

    pub(super) const fn state(&self) -> State {
        match self.record {
            Some(record) => record.state,
            None => State::None,
        }
    }
}
