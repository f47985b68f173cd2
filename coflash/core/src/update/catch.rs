//! Catches a device when it is switched on: holds it in its bootloader before its program starts.
//!
//! The bootloader holds back a program that was never confirmed for 300 ms. An SDO request to the
//! node, or any layer setting service, during this time keeps the device in its bootloader. The
//! tool therefore sends a request ten times a second.

use std::time::Duration;

use canopen::nmt::{parse_state_message, NmtState};
use canopen::{program, Address, CobId, Frame, NodeId};

use super::event::{Event, Phase};
use super::steps::call_back;
use crate::device::{DeviceType, Doing, Error, Session, Timing};

/// The longest pause between two requests, including the wait for the answer: a third of the rescue
/// window.
const REQUEST_PERIOD: Duration = Duration::from_millis(100);

/// "Identify non-configured remote slave" (CiA 305): a device without a node-ID answers it with
/// 50h, and all other devices ignore it. It changes nothing in a device.
const ANYBODY: [u8; 8] = [0x4C, 0, 0, 0, 0, 0, 0, 0];
/// The answer.
const NOBODY_YET: u8 = 0x50;

options! {
    /// The device to catch, and the time limit.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct CatchOptions {
        /// Catch any device, not only the node of the session. The requests are then a layer
        /// setting service, which holds every device that starts meanwhile in its bootloader.
        pub any: bool = false,
        /// Give up after this time; `None` for no limit.
        pub within: Option<Duration> = None,
    }
}

/// A device that is held in its bootloader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Caught {
    /// Its node-ID; `None` if it has none.
    pub node: Option<NodeId>,
    /// Its device type; `None` for a device without a node-ID, which cannot report it.
    pub running: Option<DeviceType>,
}

/// Sends requests until a device answers in its bootloader and stays there. A device whose
/// application answers is called back, again and again; with [`any`](CatchOptions::any) no
/// application is called.
///
/// # Errors
/// [`Error::NoAnswer`] or [`Error::NoBootloader`] when [`within`](CatchOptions::within) has passed,
/// [`Error::Adapter`] and [`Error::Cancelled`].
pub fn catch(
    session: &mut Session<'_>,
    options: &CatchOptions,
    on_event: &mut dyn FnMut(Event),
) -> Result<Caught, Error> {
    let deadline = options.within.map(|time| session.now() + time);
    if options.any {
        return catch_anybody(session, deadline, on_event);
    }
    loop {
        let running = search(session, deadline, on_event)?;
        on_event(Event::Found(running));
        if running.is_bootloader() {
            return Ok(Caught { node: Some(session.node()), running: Some(running) });
        }
        on_event(Phase::CallingBack.into());
        match call_back(session) {
            Ok(running) => {
                on_event(Phase::InBootloader.into());
                return Ok(Caught { node: Some(session.node()), running: Some(running) });
            }
            Err(error @ (Error::NoAnswer { .. } | Error::NoBootloader { .. })) => {
                if deadline.is_some_and(|deadline| session.now() >= deadline) {
                    return Err(error);
                }
                on_event(Phase::Searching { reason: error.to_string() }.into());
                let pause = session.timing().poll_most;
                session.wait(pause)?;
            }
            Err(error) => return Err(error),
        }
    }
}

/// Sends requests until a device answers; returns its device type.
/// # Errors
/// [`Error::NoAnswer`] at the deadline, [`Error::Adapter`], [`Error::Cancelled`].
pub(super) fn search(
    session: &mut Session<'_>,
    deadline: Option<Duration>,
    on_event: &mut dyn FnMut(Event),
) -> Result<DeviceType, Error> {
    let node = session.node();
    let timing = Timing { sdo: REQUEST_PERIOD.min(session.timing().sdo), attempts: 1, ..*session.timing() };
    let mut reported = false;
    loop {
        if let Some(running) = session.with(node, timing).device_type()? {
            return Ok(running);
        }
        let error = Error::NoAnswer { node, doing: Doing::Read(Address::new(program::DEVICE_TYPE, 0)) };
        if deadline.is_some_and(|deadline| session.now() >= deadline) {
            return Err(error);
        }
        if !std::mem::replace(&mut reported, true) {
            on_event(Phase::Searching { reason: error.to_string() }.into());
        }
        let pause = session.timing().poll_first;
        session.await_boot_up(pause)?;
    }
}

/// The answers while the requests go to all devices.
enum Heard {
    BootUp(NodeId),
    WithoutNodeId,
}

fn catch_anybody(
    session: &mut Session<'_>,
    deadline: Option<Duration>,
    on_event: &mut dyn FnMut(Event),
) -> Result<Caught, Error> {
    on_event(Phase::Searching { reason: "no device has started".to_string() }.into());
    loop {
        session.send(&Frame::of(CobId::LSS_REQUEST, &ANYBODY))?;
        let mut heard = None;
        session.observe_until(REQUEST_PERIOD, &mut |frame| {
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
                    on_event(Event::Found(running));
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
