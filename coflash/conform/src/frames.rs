//! Wrong frames: none may be taken for a request or a command, and the server works afterwards.

use std::time::Duration;

use canopen::nmt::NmtCommand;
use canopen::{CobId, Frame, NodeId};
use embedded_can::{ExtendedId, Frame as _, StandardId};

use super::bench::{ensure, request, skipped, Bench, Stop};
use super::check::Check;
use coboot_can::AdapterError;
use coflash_core::device::Error;

const UPLOAD: [u8; 8] = request(0x40, 0x1000, 0, [0; 4]);
const FRAME: &str = "CiA 301 4.2, SDO protocols";
const NMT: &str = "CiA 301 4.2, NMT protocols";
/// How long a reaction to a command is waited for that must not come.
pub(super) const REACTION: Duration = Duration::from_millis(200);
/// Reset communication: a device that takes it sends a boot-up message.
const RESET: u8 = 0x82;

const fn short(id: &'static str, title: &'static str, run: fn(&mut Bench<'_>) -> Result<(), Stop>) -> Check {
    Check::new(id, title, FRAME, run)
}

#[rustfmt::skip]
pub(super) const CHECKS: &[Check] = &[
    Check::new("FRM-001", "a remote frame with the request's COB-ID is ignored", FRAME, |b| {
        let id = StandardId::new(CobId::sdo_request(b.node).get());
        match id.and_then(|id| Frame::new_remote(id, 8)) {
            Some(frame) => unless_refused(b.ignores(&frame, CobId::sdo_response(b.node))),
            None => skipped("the frame cannot be made"),
        }
    }),
    Check::new("FRM-002", "a 29-bit frame with the request's number is ignored", FRAME, |b| {
        let id = CobId::sdo_request(b.node);
        let frame = extended(id, &UPLOAD)?;
        b.ignores(&frame, CobId::sdo_response(b.node))
    }),
    Check::new("FRM-003", "a request to another node-ID is not answered", "CiA 301 4.2, pre-defined connection set", |b| {
        let other = NodeId::new(b.node.get() ^ 1).unwrap_or(NodeId::MAX);
        b.ignores(&Frame::full(CobId::sdo_request(other), UPLOAD), CobId::sdo_response(b.node))
    }),
    short("FRM-004", "a request of 0 bytes is ignored", |b| cut(b, 0)),
    short("FRM-005", "a request of 1 byte is ignored", |b| cut(b, 1)),
    short("FRM-006", "a request of 2 bytes is ignored", |b| cut(b, 2)),
    short("FRM-007", "a request of 3 bytes is ignored", |b| cut(b, 3)),
    short("FRM-008", "a request of 4 bytes is ignored", |b| cut(b, 4)),
    short("FRM-009", "a request of 5 bytes is ignored", |b| cut(b, 5)),
    short("FRM-010", "a request of 6 bytes is ignored", |b| cut(b, 6)),
    short("FRM-011", "a request of 7 bytes is ignored", |b| cut(b, 7)),
    Check::new("FRM-012", "an NMT frame of 0 bytes is ignored", NMT, |b| no_boot_up(b, &Frame::of(CobId::NMT, &[]))),
    Check::new("FRM-013", "an NMT frame of 1 byte is ignored", NMT, |b| {
        no_boot_up(b, &Frame::of(CobId::NMT, &[RESET]))
    }),
    Check::new("FRM-014", "NMT frames of 3 to 7 bytes are ignored", NMT, |b| {
        let bytes = [RESET, b.node.get(), 0, 0, 0, 0, 0];
        (3..=7).try_for_each(|len| no_boot_up(b, &Frame::of(CobId::NMT, &bytes[..len])))
    }),
    Check::new("FRM-015", "an NMT frame of 8 bytes is ignored", NMT, |b| {
        let node = b.node.get();
        no_boot_up(b, &Frame::full(CobId::NMT, [RESET, node, 0, 0, 0, 0, 0, 0]))
    }),
    Check::new("FRM-016", "a 29-bit NMT frame is ignored", NMT, |b| {
        let frame = extended(CobId::NMT, NmtCommand::ResetCommunication.emit(Some(b.node)).data())?;
        no_boot_up(b, &frame)
    }),
    Check::new("FRM-017", "a frame with the answer's COB-ID is no request", FRAME, |b| {
        let id = CobId::sdo_response(b.node);
        b.ignores(&Frame::full(id, UPLOAD), id)
    }),
];

/// A frame with the same number in 29 bits.
pub(super) fn extended(id: CobId, data: &[u8]) -> Result<Frame, Stop> {
    match ExtendedId::new(id.get().into()).and_then(|id| Frame::new(id, data)) {
        Some(frame) => Ok(frame),
        None => skipped("the frame cannot be made"),
    }
}

/// An adapter may refuse remote frames: the protocol of socketcand, for one, has none.
fn unless_refused(result: Result<(), Stop>) -> Result<(), Stop> {
    match result {
        Err(Stop::Bus(Error::Adapter(AdapterError::Protocol { .. }))) => {
            skipped("this adapter sends no remote frames")
        }
        other => other,
    }
}

fn cut(b: &mut Bench<'_>, len: usize) -> Result<(), Stop> {
    let id = CobId::sdo_request(b.node);
    b.ignores(&Frame::of(id, &UPLOAD[..len]), CobId::sdo_response(b.node))
}

/// Expects that a frame leads to no boot-up message, and that the server works afterwards.
pub(super) fn no_boot_up(b: &mut Bench<'_>, frame: &Frame) -> Result<(), Stop> {
    b.send(frame)?;
    let id = CobId::heartbeat(b.node);
    let end = b.now() + REACTION;
    while let Some(heard) = b.hear(id, end.saturating_sub(b.now()))? {
        ensure!(heard.data() != [0], "{frame} led to a boot-up message");
    }
    b.works()
}
