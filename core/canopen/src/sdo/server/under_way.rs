//! Segments that arrive after the end of their block download: the server has aborted it, or has taken a
//! client that stopped for one that is gone.
//!
//! A client reads this only after it has sent more segments. They are no requests: number 2Fh with
//! the data 51h 1Fh 01h 03h would be a CLEAR. What continues the sub-block is therefore
//! ignored: the next numbers in order, without a pause, until the client begins another transfer. Every
//! other frame is a request at once. So is the next number after a pause; if it is refused, its
//! successors continue the sub-block.
//!
//! The number of a segment and the command specifier of a request have the same place. Where a read
//! (40h) has the number that is due, it is answered: an answer that nobody asked for changes nothing.

use crate::frame::CobId;
use crate::od::{self, Objects};
use crate::sdo::block::BLKSIZE_MAX;
use crate::sdo::fields::{self, ccs};
use crate::time::Instant;

/// A frame after a pause of this many frames is a request.
pub(super) const FRAMES: u32 = 8;

/// The segments that continue a sub-block whose download has ended.
#[derive(Clone, Copy, Debug)]
pub(super) struct UnderWay {
    /// The COB-ID of the answers to their client.
    pub response: CobId,
    /// The number of the next one.
    pub next: u8,
    /// The time of the last one.
    pub heard: Instant,
}

impl UnderWay {
    /// What may follow a segment; `None` after the last one.
    pub fn behind(segment: &[u8; 8], response: CobId, heard: Instant) -> Option<Self> {
        let last = segment[0] & fields::LAST_OF_BLOCKS != 0;
        let next = (segment[0] & !fields::LAST_OF_BLOCKS) + 1;
        (!last && next <= BLKSIZE_MAX).then_some(Self { response, next, heard })
    }

    /// Whether a pause of this length has passed.
    pub fn is_over(&self, now: Instant, gap_ms: u8) -> bool {
        now.has_reached(self.heard + u32::from(gap_ms))
    }

    /// Whether a frame is the segment that is due.
    pub fn is_next(&self, bytes: &[u8; 8], response: CobId, objects: &impl Objects) -> bool {
        let is_due = bytes[0] & !fields::LAST_OF_BLOCKS == self.next && response == self.response;
        is_due && !is_read(bytes, objects)
    }
}

/// Whether a frame is a request to read an object that exists.
fn is_read(bytes: &[u8; 8], objects: &impl Objects) -> bool {
    bytes[0] == ccs::INITIATE_UPLOAD
        && fields::number(bytes) == 0
        && od::find(objects.entries(), fields::address(bytes)).is_ok()
}
