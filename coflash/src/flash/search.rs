//! The search for a device and its bootloader.

use std::time::Duration;

use canopen::{program, Address};

use super::{check_target, enter, find, DeviceState, Event, FlashOptions};
use crate::dialect::Dialect;
use crate::error::Error;
use crate::flying_master::Mastership;
use crate::session::{Doing, Session, Timing};

/// Steps 2 and 3: finds the device, and brings it into its bootloader; again and again until it
/// works or the user gives up, if that is asked for.
pub(super) fn reach(
    session: &mut Session<'_>,
    options: &FlashOptions,
    state: &mut DeviceState,
    mastership: &mut Option<Mastership>,
    tell: &mut dyn FnMut(Event),
) -> Result<Dialect, Error> {
    let mut attempt = |session: &mut Session<'_>, tell: &mut dyn FnMut(Event)| {
        let running = find(session)?;
        tell(Event::Found(running));
        if let Some(target) = options.check_target {
            check_target(session, target)?;
            tell(Event::TargetRight(target));
        }
        enter(session, running, options, state, mastership, tell)
    };
    if !options.wait {
        return attempt(session, tell);
    }
    // Each thing is told once.
    let mut told: Vec<Event> = Vec::new();
    let mut tell = |event: Event| {
        if !told.contains(&event) {
            tell(event.clone());
            told.push(event);
        }
    };
    loop {
        knock(session, &mut tell)?;
        match attempt(session, &mut tell) {
            Err(error @ (Error::NoAnswer { .. } | Error::NoBootloader { .. })) => {
                tell(Event::Searching(error.to_string()));
                let pause = session.timing().poll_most;
                session.wait(pause)?;
            }
            result => return result,
        }
    }
}

/// A device that is only just switched on is caught if it is asked often enough: a program that was
/// never confirmed is held back for 300 ms.
const KNOCK: Duration = Duration::from_millis(100);

/// Asks until something answers.
fn knock(session: &mut Session<'_>, tell: &mut dyn FnMut(Event)) -> Result<(), Error> {
    let node = session.node();
    let timing = Timing { sdo: KNOCK.min(session.timing().sdo), attempts: 1, ..*session.timing() };
    while session.with(node, timing).device_type()?.is_none() {
        let doing = Doing::Read(Address::new(program::DEVICE_TYPE, 0));
        tell(Event::Searching(Error::NoAnswer { node, doing }.to_string()));
        let pause = session.timing().poll_first;
        session.await_boot_up(pause)?;
    }
    Ok(())
}
