//! Knocking: a device that is switched on is caught in its bootloader before its program starts.
//!
//! A program that was never confirmed is held back for 300 ms, and an SDO request to the node, or any
//! layer setting service, keeps the device in its bootloader. So it is asked ten times a second.

use std::time::Duration;

use canopen::nmt::{parse_state_message, NmtState};
use canopen::{program, Address, CobId, Frame, NodeId};

use super::event::{Event, Phase};
use super::steps::call_back;
use crate::device::{DeviceType, Doing, Error, Session, Timing};

/// The longest pause between two knocks, waiting for the answer included: a rescue window is three
/// times as long.
const KNOCK: Duration = Duration::from_millis(100);

/// "Identify non-configured remote slave" (CiA 305): a device without node-ID answers it by 50h, and
/// all others pass over it; it changes nothing in any of them.
const ANYBODY: [u8; 8] = [0x4C, 0, 0, 0, 0, 0, 0, 0];
/// The answer.
const NOBODY_YET: u8 = 0x50;

/// Whom to catch, and for how long.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct CatchOptions {
    /// Whichever device comes up, and not the session's node alone. It knocks by a layer setting
    /// service, which holds every device that comes up meanwhile in its bootloader.
    pub any: bool,
    /// Gives up after this time; `None` for never.
    pub within: Option<Duration>,
}

impl CatchOptions {
    setters! {
        any: bool,
        within: Option<Duration>,
    }
}

/// A device that is held in its bootloader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Caught {
    /// Its node-ID; `None` where it has none.
    pub node: Option<NodeId>,
    /// What its bootloader says it is; `None` without a node-ID, where it says nothing.
    pub running: Option<DeviceType>,
}

/// Knocks until a device answers in its bootloader, and stays there. One whose application answers is
/// called back, again and again; with [`any`](CatchOptions::any) no application is called.
///
/// # Errors
/// [`Error::NoAnswer`] or [`Error::NoBootloader`] when [`within`](CatchOptions::within) has passed,
/// [`Error::Adapter`] and [`Error::Cancelled`].
pub fn catch(
    session: &mut Session<'_>,
    options: &CatchOptions,
    tell: &mut dyn FnMut(Event),
) -> Result<Caught, Error> {
    let deadline = options.within.map(|time| session.now() + time);
    if options.any {
        return catch_anybody(session, deadline, tell);
    }
    loop {
        let running = knock(session, deadline, tell)?;
        tell(Event::Found(running));
        if running.is_bootloader() {
            return Ok(Caught { node: Some(session.node()), running: Some(running) });
        }
        tell(Phase::CallingBack.into());
        match call_back(session) {
            Ok(running) => {
                tell(Phase::InBootloader.into());
                return Ok(Caught { node: Some(session.node()), running: Some(running) });
            }
            Err(error @ (Error::NoAnswer { .. } | Error::NoBootloader { .. })) => {
                if deadline.is_some_and(|deadline| session.now() >= deadline) {
                    return Err(error);
                }
                tell(Phase::Searching { reason: error.to_string() }.into());
                let pause = session.timing().poll_most;
                session.wait(pause)?;
            }
            Err(error) => return Err(error),
        }
    }
}

/// Asks until something answers; gives what that says it is.
///
/// # Errors
/// [`Error::NoAnswer`] at the deadline, [`Error::Adapter`], [`Error::Cancelled`].
pub(super) fn knock(
    session: &mut Session<'_>,
    deadline: Option<Duration>,
    tell: &mut dyn FnMut(Event),
) -> Result<DeviceType, Error> {
    let node = session.node();
    let timing = Timing { sdo: KNOCK.min(session.timing().sdo), attempts: 1, ..*session.timing() };
    let mut told = false;
    loop {
        if let Some(running) = session.with(node, timing).device_type()? {
            return Ok(running);
        }
        let error = Error::NoAnswer { node, doing: Doing::Read(Address::new(program::DEVICE_TYPE, 0)) };
        if deadline.is_some_and(|deadline| session.now() >= deadline) {
            return Err(error);
        }
        if !std::mem::replace(&mut told, true) {
            tell(Phase::Searching { reason: error.to_string() }.into());
        }
        let pause = session.timing().poll_first;
        session.await_boot_up(pause)?;
    }
}

/// What is heard while everybody is knocked at.
enum Heard {
    BootUp(NodeId),
    WithoutNodeId,
}

fn catch_anybody(
    session: &mut Session<'_>,
    deadline: Option<Duration>,
    tell: &mut dyn FnMut(Event),
) -> Result<Caught, Error> {
    tell(Phase::Searching { reason: "no device has come up".to_string() }.into());
    loop {
        session.send(&Frame::of(CobId::LSS_REQUEST, &ANYBODY))?;
        let mut heard = None;
        session.observe_until(KNOCK, &mut |frame| {
            let answer = frame.exactly::<8>().is_some_and(|bytes| bytes[0] == NOBODY_YET);
            heard = match parse_state_message(frame) {
                Some((node, NmtState::Initialisation)) => Some(Heard::BootUp(node)),
                _ if answer && frame.cob_id() == Some(CobId::LSS_RESPONSE) => Some(Heard::WithoutNodeId),
                _ => None,
            };
            heard.is_some()
        })?;
        match heard {
            Some(Heard::WithoutNodeId) => return Ok(Caught { node: None, running: None }),
            Some(Heard::BootUp(node)) => {
                session.talk_to(node);
                if let Some(running) = session.device_type()? {
                    tell(Event::Found(running));
                    if running.is_bootloader() {
                        return Ok(Caught { node: Some(node), running: Some(running) });
                    }
                }
            }
            None => {}
        }
        if deadline.is_some_and(|deadline| session.now() >= deadline) {
            let doing = Doing::Read(Address::new(program::DEVICE_TYPE, 0));
            return Err(Error::NoAnswer { node: session.node(), doing });
        }
    }
}
