//! NMT mastership of a network with flying masters (CiA 302-2, "NMT flying master"). The tool asks
//! for the mastership before it restarts devices of a lift, and gives it back afterwards (CiA 814-1
//! clause 6.3).
//! | CAN-ID | data | meaning |
//! |---|---|---|
//! | 071h | priority, node-ID | the active master announces itself |
//! | 072h | none | negotiation: each candidate waits for its time slot, the first to end it is master |
//! | 073h | none | who is the active master? |
//! | 076h | none | the active master is to let the others negotiate |
//!
//! A candidate's time slot begins at priority × 1F90h/4 + node-ID × 1F90h/5 milliseconds; priority
//! 0 is the highest. The tool takes part with the highest priority during its work.

use std::time::Duration;

use canopen::{Address, CobId, Frame, NodeId};

use super::error::Error;
use super::session::Session;
use super::timing::Timing;

/// "NMT master node-ID": sent by the active master.
const ACTIVE_MASTER: CobId = id(0x071);
/// "NMT flying master negotiation".
const NEGOTIATION: CobId = id(0x072);
/// "Active NMT master detection".
const DETECTION: CobId = id(0x073);
/// "Force NMT flying master negotiation".
const FORCE: CobId = id(0x076);

/// "NMT flying master timing parameters". Sub-indices 2, 4 and 5, with their defaults, in
/// milliseconds.
const TIMING: u16 = 0x1F90;
const NEGOTIATION_DELAY: (u8, u32) = (2, 500);
const PRIORITY_SLOT: (u8, u32) = (4, 1500);
const DEVICE_SLOT: (u8, u32) = (5, 10);

/// The active master has answered within this time (1F90h/1: 100 ms), even on a slow bus.
const ANSWER: Duration = Duration::from_millis(200);
/// The longest time in 1F90h: 16 bits of milliseconds.
const LONGEST: u32 = 0xFFFF;

/// A master, as 071h describes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Master {
    /// 0 is the highest, 2 the lowest.
    pub priority: u8,
    /// Its node-ID.
    pub node: NodeId,
}

/// The tool's own data in a negotiation: the highest priority, and the node-ID of the manual's tool
/// (L-1112d_10, table 11).
pub const TOOL: Master = Master { priority: 0, node: NodeId::new(127).expect("1 to 127") };

impl Master {
    fn frame(self) -> Frame {
        Frame::of(ACTIVE_MASTER, &[self.priority, self.node.get()])
    }

    fn parse(frame: &Frame) -> Option<Self> {
        let &[priority, node] = frame.exactly::<2>()?;
        let node = NodeId::new(node).filter(|_| frame.cob_id() == Some(ACTIVE_MASTER))?;
        Some(Self { priority, node })
    }
}

/// The result of asking for the mastership.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Asked {
    /// The network has no flying master.
    Nobody,
    /// This master keeps the mastership: it also has the highest priority, or does not release it.
    Kept(Master),
    /// The tool has the mastership.
    Taken(Mastership),
}

/// The mastership that the tool has taken over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mastership {
    /// The previous master.
    pub from: Master,
    /// The start of the tool's time slot in a negotiation.
    slot: Duration,
}

/// The answer of the tool, as the active master, to a frame of the protocol, if one is due: the
/// tool announces itself and stays the master.
fn answer(frame: &Frame) -> Option<Frame> {
    let asked = [DETECTION, NEGOTIATION].iter().any(|id| frame.cob_id() == Some(*id));
    asked.then(|| TOOL.frame())
}

/// Asks for the NMT mastership. In a network without a flying master, this sends only one question.
///
/// # Errors
/// [`Error::Adapter`] or [`Error::Cancelled`].
pub fn ask(session: &mut Session<'_>) -> Result<Asked, Error> {
    if !session.hears_the_bus() {
        // Behind a gateway, the mastership is the gateway's concern.
        return Ok(Asked::Nobody);
    }
    let Some(active) = detect(session)? else { return Ok(Asked::Nobody) };
    if active.priority == TOOL.priority {
        return Ok(Asked::Kept(active));
    }
    let delay = milliseconds(session, active.node, NEGOTIATION_DELAY)?;
    let priority_slot = milliseconds(session, active.node, PRIORITY_SLOT)?;
    let device_slot = milliseconds(session, active.node, DEVICE_SLOT)?;
    session.send(&Frame::of(FORCE, &[]))?;
    let mut begun = None;
    session.observe_until(delay + ANSWER, &mut |frame| {
        begun = frame.cob_id().filter(|id| *id == NEGOTIATION || *id == DETECTION);
        begun.is_some()
    })?;
    // A candidate that first asks for the active master gets its answer at once.
    if begun != Some(DETECTION) {
        if begun.is_none() {
            session.send(&Frame::of(NEGOTIATION, &[]))?;
        }
        let mut other = None;
        session.observe_until(device_slot * u32::from(TOOL.node.get()), &mut |frame| {
            other = Master::parse(frame);
            other.is_some()
        })?;
        if let Some(other) = other.filter(|other| other.priority == TOOL.priority) {
            return Ok(Asked::Kept(other));
        }
    }
    session.send(&TOOL.frame())?;
    if let Some(other) = detect(session)? {
        return Ok(Asked::Kept(other));
    }
    session.answer_by(Some(answer));
    let slot = priority_slot * u32::from(active.priority) + device_slot * u32::from(active.node.get());
    Ok(Asked::Taken(Mastership { from: active, slot }))
}

/// Gives the mastership back: the other masters negotiate without the tool. Returns the new master;
/// `None` if none announces itself in time.
///
/// # Errors
/// [`Error::Adapter`] or [`Error::Cancelled`].
pub fn give_back(session: &mut Session<'_>, taken: Mastership) -> Result<Option<Master>, Error> {
    session.answer_by(None);
    session.send(&Frame::of(NEGOTIATION, &[]))?;
    let mut active = None;
    session.observe_until(taken.slot + ANSWER, &mut |frame| {
        active = Master::parse(frame);
        active.is_some()
    })?;
    Ok(active)
}

/// Asks for the active master.
fn detect(session: &mut Session<'_>) -> Result<Option<Master>, Error> {
    session.send(&Frame::of(DETECTION, &[]))?;
    let mut active = None;
    session.observe_until(ANSWER, &mut |frame| {
        active = Master::parse(frame);
        active.is_some()
    })?;
    Ok(active)
}

/// A time of 1F90h, or its default if the master does not report it.
fn milliseconds(
    session: &mut Session<'_>,
    node: NodeId,
    (sub, default): (u8, u32),
) -> Result<Duration, Error> {
    let timing = Timing { attempts: 1, ..*session.timing() };
    let time = match session.with(node, timing).read_number(Address::new(TIMING, sub)) {
        Ok(time) => time,
        Err(error @ (Error::Adapter(_) | Error::Cancelled)) => return Err(error),
        Err(_) => default,
    };
    Ok(Duration::from_millis(time.min(LONGEST).into()))
}

/// The CAN-ID of a service.
const fn id(number: u16) -> CobId {
    CobId::new(number).expect("below 800h")
}
