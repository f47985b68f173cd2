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

use canopen::NodeId;
use coboot_can::Adapter;
use coflash_core::device::{Session, Timing};
use coflash_core::file::block_file;
use coflash_core::file::Program;
use coflash_core::update::{flash, DeviceState, Event, FlashOptions, Payload, Report};
use coflash_core::Error;
use kit::fake::{Outcome, NODE};

pub fn node() -> NodeId {
    NodeId::new(NODE).unwrap()
}

/// A program with block 0, four blocks of data and the last block.
pub fn file() -> Program {
    block_file::read(data!("identity-110.blk")).unwrap()
}

/// The result of an update of the node, and its events.
pub fn update(
    adapter: &mut dyn Adapter,
    file: impl Into<Payload>,
    options: &FlashOptions,
) -> (Result<Report, Error>, Vec<Event>) {
    let mut session = Session::new(adapter, node(), Timing::default());
    let mut events = Vec::new();
    let result = flash(&mut session, file, options, &mut |event| events.push(event));
    (result, events)
}

/// The state of the device after a failed update, from its events.
pub fn left(events: &[Event]) -> DeviceState {
    match events.last() {
        Some(Event::Done(done)) => done.left.state,
        other => panic!("{other:?}"),
    }
}

/// For the first `times` times of `number` this result, then normal.
pub fn script<T: PartialEq + Copy + Send + 'static>(
    number: T,
    times: usize,
    outcome: Outcome,
) -> Box<dyn FnMut(T) -> Outcome + Send> {
    let mut left = times;
    Box::new(move |came| {
        if came == number && left > 0 {
            left -= 1;
            return outcome;
        }
        Outcome::Accept
    })
}
