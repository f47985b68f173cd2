//! The update procedure against fake devices, in virtual time.

mod admission;
mod aftermath;
mod dialects;
mod events;
mod many;
mod master;
mod mastership;
mod procedure;
mod reading;
mod renew;
mod search;
mod watch;

use coflash_core::update::{DeviceState, Event};

/// The state of the device after a failed update, from its events.
pub fn left(events: &[Event]) -> DeviceState {
    match events.last() {
        Some(Event::Done(done)) => done.left.state,
        other => panic!("{other:?}"),
    }
}
