//! What a session notices beside its transfers: how long its node has been silent, and whether
//! somebody else speaks to it.

use std::collections::VecDeque;
use std::time::Duration;

use canopen::{Address, CobId, Frame, NodeId};

use crate::device::doing::Doing;

/// Silence of this length is told while it lasts.
pub const SILENCE: Duration = Duration::from_secs(2);
/// Requests of which an adapter may still bring the echo: more than two sub-blocks of a block
/// download.
const OWN_MAX: usize = 256;

/// A node that has not answered for a while, and is waited for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Silence {
    /// Which node.
    pub node: NodeId,
    /// What it was told.
    pub doing: Doing,
    /// How long nothing has been heard of it.
    pub silent: Duration,
    /// How long it is waited for in all.
    pub limit: Duration,
}

/// What was noticed so far.
#[derive(Debug, Default)]
pub(super) struct Watch {
    /// When the node was last heard: an answer, a heartbeat, an emergency.
    pub(super) heard: Option<Duration>,
    /// Whether this silence was told.
    pub(super) told: bool,
    /// Requests of ours of which no echo has come, in their order.
    own: VecDeque<Frame>,
    /// Whether one has come since the last answer.
    echoed: bool,
    /// When somebody else has last asked the node, and for what.
    pub(super) foreign: Option<(Duration, Option<Address>)>,
}

impl Watch {
    pub(super) fn sent(&mut self, frame: &Frame, node: NodeId) {
        if frame.cob_id() == Some(CobId::sdo_request(node)) {
            if self.own.len() == OWN_MAX {
                self.own.pop_front();
            }
            self.own.push_back(*frame);
        }
    }

    pub(super) fn received(&mut self, frame: &Frame, node: NodeId, now: Duration) {
        let Some(id) = frame.cob_id() else { return };
        if id == CobId::sdo_request(node) {
            // An adapter that brings back what it sends brings all of it, in its order.
            if let Some(at) = self.own.iter().position(|own| own == frame) {
                self.own.drain(..=at);
                self.echoed = true;
            } else {
                self.foreign = Some((now, object_of(frame)));
            }
            return;
        }
        if [CobId::sdo_response(node), CobId::heartbeat(node), CobId::emcy(node)].contains(&id) {
            (self.heard, self.told) = (Some(now), false);
        }
        if id == CobId::sdo_response(node) {
            // A request is on the bus before its answer: an echo that has not come by now does not
            // come any more. Where echoes come, those of frames behind that request may.
            if !self.echoed {
                self.own.clear();
            }
            self.echoed = false;
        }
    }
}

/// The object that a request is about; none for a segment, which does not say it.
fn object_of(frame: &Frame) -> Option<Address> {
    let [command, low, high, sub, ..] = *frame.exactly::<8>()?;
    let initiates = matches!(command >> 5, 1 | 2 | 4 | 5 | 6) && high >= 0x10;
    initiates.then(|| Address::new(u16::from_le_bytes([low, high]), sub))
}

#[cfg(test)]
mod tests {
    use super::*;

    const READ: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
    const ANSWER: [u8; 8] = [0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10];

    fn node() -> NodeId {
        NodeId::new(5).unwrap()
    }

    fn frame(id: u16, data: [u8; 8]) -> Frame {
        Frame::of(CobId::new(id).unwrap(), &data)
    }

    /// Sent (true) or received frames; the object of the foreign request that was found, if one was.
    fn foreign(course: &[(bool, u16, [u8; 8])]) -> Option<Option<Address>> {
        let mut watch = Watch::default();
        for (sent, id, data) in course {
            let frame = frame(*id, *data);
            if *sent {
                watch.sent(&frame, node());
            } else {
                watch.received(&frame, node(), Duration::ZERO);
            }
        }
        watch.foreign.map(|(_, what)| what)
    }

    #[test]
    fn requests_of_others_are_told_from_echoes() {
        let clear = [0x2F, 0x51, 0x1F, 1, 3, 0, 0, 0];
        let at = |index, sub| Some(Some(Address::new(index, sub)));
        // Nobody else; with and without echoes; somebody who speaks to another node.
        assert_eq!(foreign(&[(true, 0x605, READ), (false, 0x585, ANSWER)]), None);
        assert_eq!(foreign(&[(true, 0x605, READ), (false, 0x605, READ), (false, 0x585, ANSWER)]), None);
        assert_eq!(foreign(&[(true, 0x605, READ), (false, 0x606, READ), (false, 0x585, ANSWER)]), None);
        // Somebody else: another request, the same one behind the answer, and the same one twice.
        assert_eq!(foreign(&[(true, 0x605, READ), (false, 0x605, clear)]), at(0x1F51, 1));
        let behind = [(true, 0x605, READ), (false, 0x585, ANSWER), (false, 0x605, READ)];
        assert_eq!(foreign(&behind), at(0x1000, 0));
        let twice = [(true, 0x605, READ), (false, 0x605, READ), (false, 0x605, READ)];
        assert_eq!(foreign(&twice), at(0x1000, 0));
        // A segment does not say of what.
        assert_eq!(foreign(&[(false, 0x605, [0x10, 1, 2, 3, 4, 5, 6, 7])]), Some(None));
    }

    /// A node refuses in the middle of a burst; the echoes of what was sent behind that come after
    /// its abort.
    #[test]
    fn echoes_behind_an_abort_are_still_echoes() {
        let segment = |number| [number, 1, 2, 3, 4, 5, 6, 7];
        let sent = (1..=100).map(|number| (true, 0x605, segment(number)));
        let back =
            |numbers: std::ops::RangeInclusive<u8>| numbers.map(|number| (false, 0x605, segment(number)));
        let abort = [(false, 0x585, [0x80, 0x50, 0x1F, 1, 0, 0, 0, 8])];
        let course: Vec<_> = sent.chain(back(1..=40)).chain(abort).chain(back(41..=100)).collect();
        assert_eq!(foreign(&course), None);
    }
}
