//! Wrong frames: none may be taken for a request, and the server works afterwards.

use canopen::{CobId, Frame, NodeId};
use embedded_can::{ExtendedId, Frame as _, StandardId};

use crate::bus::AdapterError;
use crate::device::Error;

use super::bench::{request, skipped, Bench, Stop};
use super::Check;

const UPLOAD: [u8; 8] = request(0x40, 0x1000, 0, [0; 4]);

pub(super) const CHECKS: &[Check] = &[
    Check::new("FRM-001", "a remote frame with the request's COB-ID is ignored", "CiA 301, 7.2.4.1", |b| {
        let id = StandardId::new(CobId::sdo_request(b.node).get());
        ignored(b, id.and_then(|id| Frame::new_remote(id, 8)))
    }),
    Check::new("FRM-002", "a 29-bit frame with the request's number is ignored", "CiA 301, 7.2.4.1", |b| {
        let id = ExtendedId::new(CobId::sdo_request(b.node).get().into());
        ignored(b, id.and_then(|id| Frame::new(id, &UPLOAD)))
    }),
    Check::new("FRM-003", "a request to another node-ID is not answered", "CiA 301, 7.3.3", |b| {
        let other = NodeId::new(b.node.get() ^ 1).unwrap_or(NodeId::MAX);
        ignored(b, Some(Frame::full(CobId::sdo_request(other), UPLOAD)))
    }),
    Check::new("FRM-004", "an empty frame with the request's COB-ID is ignored", "CiA 301, 7.2.4.3", |b| {
        let id = CobId::sdo_request(b.node);
        ignored(b, Some(Frame::of(id, &[])))
    }),
];

fn ignored(b: &mut Bench<'_>, frame: Option<Frame>) -> Result<(), Stop> {
    let id = CobId::sdo_response(b.node);
    match frame {
        Some(frame) => match b.ignores(&frame, id) {
            // The protocol of socketcand, for one, knows no remote frames.
            Err(Stop::Bus(Error::Adapter(AdapterError::Protocol { .. }))) => {
                skipped("this adapter does not send such a frame")
            }
            other => other,
        },
        None => skipped("the frame cannot be made"),
    }
}
