//! The state of a program's download.

use canopen::program::FlashError;

use crate::policy::Policy;
use crate::refusal::Refusal;

/// The state of a program's download. It continues from one SDO transfer to the next.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Session {
    /// No block was accepted yet.
    Idle,
    /// CLEAR was acknowledged; nothing is lost yet. `just`: no block has arrived since.
    Cleared { just: bool },
    /// Blocks are being accepted; `next` is the number of the next one, 0 for a download that
    /// goes on.
    Open { next: u32 },
    /// The flash contains an incomplete program: only CLEAR allows a new download.
    Failed,
}

impl Session {
    /// Whether a new download may begin. `installed`: a program exists.
    pub(crate) fn may_begin(self, policy: &Policy, installed: bool) -> Result<(), Refusal> {
        match self {
            Self::Idle if installed && !policy.replaces => Err(Refusal::untimely(FlashError::NotCleared)),
            Self::Failed if !policy.replaces => Err(Refusal::untimely(FlashError::Sequence)),
            Self::Open { .. } => Err(Refusal::untimely(FlashError::Sequence)),
            _ if (policy.allowed)() => Ok(()),
            _ => Err(Refusal::untimely(FlashError::NoAccess)),
        }
    }

    /// Whether a download that begins now first erases the flash. Otherwise each piece must find
    /// its place erased.
    pub(crate) fn erases(self, policy: &Policy) -> bool {
        matches!(self, Self::Cleared { .. }) || policy.replaces && !matches!(self, Self::Open { .. })
    }
}
