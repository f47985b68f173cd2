//! How far the download of a program is.

use canopen::program::FlashError;

use crate::policy::Policy;
use crate::refusal::Refusal;

/// How far the download of a program is. It lasts from one SDO transfer to the next.
// Not to be compared as a whole, which costs 140 bytes of flash: `matches!` looks at what is asked
// for.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Session {
    /// No block was taken yet.
    Idle,
    /// CLEAR was acknowledged; nothing is lost yet. `just`: no block was sent since.
    Cleared { just: bool },
    /// Blocks are being taken; `next` is the number of the next one.
    Open { next: u32 },
    /// Half a program is in flash: only CLEAR makes a new beginning.
    Failed,
}

impl Session {
    /// Whether a new download may begin. `installed`: there is a program.
    pub(crate) fn may_begin(self, policy: &Policy, installed: bool) -> Result<(), Refusal> {
        match self {
            Self::Idle if installed && !policy.replaces => Err(Refusal::untimely(FlashError::NotCleared)),
            Self::Failed if !policy.replaces => Err(Refusal::untimely(FlashError::Sequence)),
            Self::Open { .. } => Err(Refusal::untimely(FlashError::Sequence)),
            _ if (policy.allowed)() => Ok(()),
            _ => Err(Refusal::untimely(FlashError::NoAccess)),
        }
    }

    /// Whether a download that begins now erases what is there first. Otherwise each piece has to
    /// find its place blank.
    pub(crate) fn erases(self, policy: &Policy) -> bool {
        matches!(self, Self::Cleared { .. }) || policy.replaces && !matches!(self, Self::Open { .. })
    }
}
