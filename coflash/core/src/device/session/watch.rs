//! What a session observes besides its transfers: how long its node has been silent, and whether
//! another tool talks to the node.

use std::fmt;
use std::sync::atomic::AtomicBool;
use std::sync::Arc;
use std::time::Duration;

use canopen::emcy::code;
use canopen::nmt::parse_boot_up;
use canopen::program::{PROGRAM_CONTROL, PROGRAM_DATA};
use canopen::{Address, CobId, Frame, NodeId};
use serde::Serialize;

use crate::device::doing::Doing;
use crate::device::error::{Error, Intruder};
use crate::device::listen::listen;
use crate::json;
use coboot_can::echo::Echoes;
use coboot_can::Adapter;

/// Another tool that is working with a node sends requests at least this often: during the erase of
/// a sector, four times a second.
pub(super) const LISTEN: Duration = Duration::from_millis(300);
/// A silence of this length is reported while it lasts.
pub const SILENCE: Duration = Duration::from_secs(2);
/// The most requests for which an adapter may still return the echo: more than two sub-blocks of a
/// block download.
const OWN_MAX: usize = 256;

/// The node has not answered for a while, and the session waits for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Silence {
    /// The action that it was asked to do.
    #[serde(serialize_with = "json::words")]
    pub doing: Doing,
    /// How long it has been silent.
    #[serde(rename = "seconds", serialize_with = "json::seconds")]
    pub silent: Duration,
    /// How long the session waits in total.
    #[serde(rename = "limit_seconds", serialize_with = "json::seconds")]
    pub limit: Duration,
}

impl fmt::Display for Silence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { doing, silent, limit } = self;
        let [silent, limit] = [silent, limit].map(Duration::as_secs_f64);
        write!(f, "no answer for {silent:.0} s ({doing}), waiting up to {limit:.0} s")
    }
}

/// The observations so far.
#[derive(Debug, Default)]
pub(super) struct Watch {
    /// The time of the node's last frame: an answer, a heartbeat or an emergency.
    pub(super) heard: Option<Duration>,
    /// Whether this silence was reported.
    pub(super) reported: bool,
    /// The session's own requests without an echo, in their order.
    own: Echoes<OWN_MAX>,
    /// Whether an echo has arrived since the last answer.
    echoed: bool,
    /// The time and the object of the last request of another tool.
    pub(super) foreign: Option<Foreign>,
    /// The time of another tool's last request that changes a program.
    pub(super) commanded: Option<Duration>,
    /// The time of the node's last boot-up message.
    pub(super) booted: Option<Duration>,
    /// The last boot-up message of another node, and its time.
    pub(super) elsewhere: Option<(Duration, NodeId)>,
    /// The time of the node's last emergency for its software (6000h).
    pub(super) failed: Option<Duration>,
    /// The object that the session has asked for last, and how many answers are to come.
    asked: ([u8; 3], u32),
    /// Whether more answers to reads came than were asked for: a second device has the node-ID.
    pub(super) is_twice: bool,
    /// Since when the session hears the bus.
    pub(super) began: Option<Duration>,
}

/// The time of the last request of another tool, and its object.
pub(super) type Foreign = (Duration, Option<Address>);

impl Watch {
    /// The time of the node's last boot-up message, and the last request of another tool.
    pub(super) const fn boot_up_and_requests(&self) -> (Option<Duration>, Option<Foreign>) {
        (self.booted, self.foreign)
    }

    pub(super) fn sent(&mut self, frame: &Frame, node: NodeId) {
        if frame.cob_id() == Some(CobId::sdo_request(node)) {
            self.own.sent(frame);
            if let Some(&[_, a, b, c, ..]) = frame.exactly::<8>().filter(|bytes| asks(bytes[0])) {
                let (object, more) = self.asked;
                self.asked = ([a, b, c], if object == [a, b, c] { more + 1 } else { 1 });
            }
        }
    }

    /// A node has booted up: the session's own, `node`, or another.
    pub(super) fn heard_boot_up(&mut self, booted: NodeId, node: NodeId, now: Duration) {
        if booted == node {
            self.booted = Some(now);
        } else {
            self.elsewhere = Some((now, booted));
        }
    }

    /// Counts an answer to the read of an object: a value, the begin of a transfer, or an abort. What is in
    /// the segments of a transfer is none, as it does not begin with the object.
    fn count_answer(&mut self, frame: &Frame) {
        let (object, more) = self.asked;
        match frame.exactly::<8>().filter(|bytes| bytes[1..4] == object).map(|bytes| bytes[0] >> 5) {
            Some(2 | 4 | 6) if more > 0 => self.asked.1 -= 1,
            Some(2 | 6) => self.is_twice |= self.foreign.is_none(),
            _ => {}
        }
    }

    pub(super) fn received(&mut self, frame: &Frame, node: NodeId, now: Duration) {
        let Some(id) = frame.cob_id() else { return };
        if id == CobId::sdo_request(node) {
            if self.own.takes(frame) {
                self.echoed = true;
            } else {
                self.foreign = Some((now, object_of(frame)));
                if changes_program(frame) {
                    self.commanded = Some(now);
                }
            }
            return;
        }
        if [CobId::sdo_response(node), CobId::heartbeat(node), CobId::emcy(node)].contains(&id) {
            (self.heard, self.reported) = (Some(now), false);
        }
        if let Some(booted) = parse_boot_up(frame) {
            self.heard_boot_up(booted, node, now);
        }
        if is_failure(frame, node) {
            self.failed = Some(now);
        }
        if id == CobId::sdo_response(node) {
            self.count_answer(frame);
            // A request is on the bus before its answer, so an echo that has not arrived before the
            // answer will not arrive. If echoes do arrive, echoes of frames sent after that request
            // may follow.
            if !self.echoed {
                self.own.clear();
            }
            self.echoed = false;
        }
    }
}

/// Checks whether another tool is using any node of a bus, before anything is sent to it: listens as long as
/// a session does for its node.
///
/// # Errors
/// [`Error::NotAlone`], [`Error::Adapter`] or [`Error::Cancelled`].
pub fn ensure_bus_alone(adapter: &mut dyn Adapter, cancelled: &Arc<AtomicBool>) -> Result<(), Error> {
    let mut heard = None;
    listen(adapter, LISTEN, cancelled, &mut |frame| {
        let mut nodes = (1..=127).filter_map(NodeId::new);
        let asked = nodes.find(|node| frame.cob_id() == Some(CobId::sdo_request(*node)));
        heard = asked.map(|node| Error::NotAlone { node, who: Intruder::Requests(object_of(frame)) });
        heard.is_some()
    })?;
    heard.map_or(Ok(()), Err)
}

/// Whether a request with this command begins to read an object, in segments or as blocks (CiA 301 clause 7.2.4.3).
const fn asks(command: u8) -> bool {
    command >> 5 == 2 || command & 0xE3 == 0xA0
}

/// The object of a request; none for a segment, which does not name it.
fn object_of(frame: &Frame) -> Option<Address> {
    let [command, low, high, sub, ..] = *frame.exactly::<8>()?;
    let initiates = matches!(command >> 5, 1 | 2 | 4 | 5 | 6) && high >= 0x10;
    initiates.then(|| Address::new(u16::from_le_bytes([low, high]), sub))
}

/// Whether a node reports an error of its software, by an emergency 6000h.
fn is_failure(frame: &Frame, node: NodeId) -> bool {
    let is_of_software = |bytes: &[u8; 8]| bytes.starts_with(&code::SOFTWARE.to_le_bytes());
    frame.cob_id() == Some(CobId::emcy(node)) && frame.exactly().is_some_and(is_of_software)
}

/// Whether a request begins to write 1F50h or 1F51h, expedited, segmented or as blocks.
fn changes_program(frame: &Frame) -> bool {
    let writes = frame.exactly::<8>().is_some_and(|bytes| matches!(bytes[0] >> 5, 1 | 6));
    let at = object_of(frame).map(|at| at.index);
    writes && matches!(at, Some(PROGRAM_DATA | PROGRAM_CONTROL))
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

    /// Sent (true) or received frames; returns the object of the foreign request, if there was one.
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
        // No other tool: without and with echoes; a tool that talks to another node.
        assert_eq!(foreign(&[(true, 0x605, READ), (false, 0x585, ANSWER)]), None);
        assert_eq!(foreign(&[(true, 0x605, READ), (false, 0x605, READ), (false, 0x585, ANSWER)]), None);
        assert_eq!(foreign(&[(true, 0x605, READ), (false, 0x606, READ), (false, 0x585, ANSWER)]), None);
        // Another tool: another request, the same request after the answer, and the same request
        // twice.
        assert_eq!(foreign(&[(true, 0x605, READ), (false, 0x605, clear)]), at(0x1F51, 1));
        let after = [(true, 0x605, READ), (false, 0x585, ANSWER), (false, 0x605, READ)];
        assert_eq!(foreign(&after), at(0x1000, 0));
        let twice = [(true, 0x605, READ), (false, 0x605, READ), (false, 0x605, READ)];
        assert_eq!(foreign(&twice), at(0x1000, 0));
        // A segment does not name its object.
        assert_eq!(foreign(&[(false, 0x605, [0x10, 1, 2, 3, 4, 5, 6, 7])]), Some(None));
    }

    /// A node refuses in the middle of a burst; the echoes of the frames sent after that point
    /// arrive after its abort.
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
