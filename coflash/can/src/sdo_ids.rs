//! SDO on other identifiers than those of the predefined connection set.

use std::time::Duration;

use canopen::{CobId, Frame, NodeId};
use embedded_can::Frame as _;

use super::adapter::{passes_on, Adapter, AdapterError};
use super::health::{Health, Losses};

/// An adapter for devices that use their own identifiers for SDO requests and answers
/// (`BLCOP_BASE_REQUEST` and `BLCOP_BASE_RESPONSE` of the manual). The adapter's user sees the
/// identifiers of the predefined connection set, 600h and 580h plus the node-ID.
///
/// Frames that really have the identifiers 580h or 600h plus a node-ID belong to other devices, and
/// the adapter drops them.
#[derive(Debug)]
pub struct SdoIds<A> {
    adapter: A,
    request: u16,
    response: u16,
}

const REQUEST: u16 = 0x600;
const RESPONSE: u16 = 0x580;

impl<A: Adapter> SdoIds<A> {
    /// Requests go to `request` plus the node-ID, answers come from `response` plus the node-ID.
    /// Both are 80h to 780h.
    pub fn new(adapter: A, request: u16, response: u16) -> Self {
        Self { adapter, request, response }
    }
}

/// The same frame with another base of its identifier; `None` if its identifier is not `from` plus
/// a node-ID.
fn moved(frame: &Frame, from: u16, to: u16) -> Option<Frame> {
    let node = frame.cob_id()?.get().checked_sub(from)?;
    let node = NodeId::new(u8::try_from(node).ok()?)?;
    Some(Frame::of(CobId::from_base(to, node)?, frame.data()))
}

impl<A: Adapter> Adapter for SdoIds<A> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        match moved(frame, REQUEST, self.request) {
            Some(request) => self.adapter.send(&request),
            // It is for a group, and would be a request to one node here.
            None if moved(frame, self.request, self.request).is_some() => Ok(()),
            None => self.adapter.send(frame),
        }
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now() + timeout;
        loop {
            let Some(frame) = self.adapter.receive(until.saturating_sub(self.now()))? else {
                return Ok(None);
            };
            if let Some(answer) = moved(&frame, self.response, RESPONSE) {
                return Ok(Some(answer));
            }
            // Requests of other clients to the node.
            if let Some(request) = moved(&frame, self.request, REQUEST) {
                return Ok(Some(request));
            }
            if [RESPONSE, REQUEST].iter().all(|base| moved(&frame, *base, *base).is_none()) {
                return Ok(Some(frame));
            }
        }
    }

    passes_on!(this => this.adapter);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::frame;

    /// The frames to receive, and the frames that were sent.
    #[derive(Default)]
    struct Script {
        sent: Vec<Option<CobId>>,
        coming: Vec<Frame>,
    }

    impl Adapter for Script {
        fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
            self.sent.push(frame.cob_id());
            Ok(())
        }

        fn receive(&mut self, _timeout: Duration) -> Result<Option<Frame>, AdapterError> {
            Ok((!self.coming.is_empty()).then(|| self.coming.remove(0)))
        }

        fn now(&self) -> Duration {
            Duration::ZERO
        }
    }

    #[test]
    fn sdo_goes_by_other_identifiers_and_all_else_as_it_is() {
        let coming = vec![
            frame(0x4AA, &[0x60, 0, 0, 0, 0, 0, 0, 0]),
            // Another device, which uses the predefined connection set.
            frame(0x5AA, &[0x60, 1, 1, 1, 1, 1, 1, 1]),
            frame(0x62A, &[0x40, 1, 1, 1, 1, 1, 1, 1]),
            frame(0x72A, &[0x7F]),
            // Another client sends a request to the device.
            frame(0x6AA, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]),
        ];
        let mut adapter = SdoIds::new(Script { coming, ..Script::default() }, 0x680, 0x480);
        adapter.send(&frame(0x62A, &[0x40, 0, 0x10, 0, 0, 0, 0, 0])).unwrap();
        adapter.send(&frame(0x000, &[0x81, 0x2A])).unwrap();
        // To a group, if node 95 had no request there.
        adapter.send(&frame(0x6DF, &[0xC6, 0x50, 0x1F, 1, 9, 0, 0, 0])).unwrap();
        assert_eq!(adapter.adapter.sent, [CobId::new(0x6AA), CobId::new(0x000)]);
        let mut received = || adapter.receive(Duration::ZERO).unwrap().and_then(|frame| frame.cob_id());
        let all = [received(), received(), received(), received()];
        assert_eq!(all, [CobId::new(0x5AA), CobId::new(0x72A), CobId::new(0x62A), None]);
    }
}
