//! What a failed update leaves behind: the device is asked, and not only what was done to it is told.

use std::time::Duration;

use canopen::program;
use canopen::{Address, NodeId};

use super::course::Course;
use super::left::{DeviceState, Left, Look, Seen};
use crate::device::error::{optional, Error};
use crate::device::{DeviceType, Session, Timing};

/// How long the device may take for its answer, which is asked for twice.
const ANSWER: Duration = Duration::from_millis(500);

/// Asks the device in what state the update has left it, `original` being the node-ID that this was
/// begun with, and `crc` that of the file.
pub(super) fn look(
    session: &mut Session<'_>,
    error: &Error,
    course: &Course<'_>,
    original: NodeId,
    number: u8,
    crc: u32,
) -> Left {
    let unseen = |look| Left { state: course.state, look };
    let untouched = course.state == DeviceState::Untouched && !course.touched;
    if untouched || matches!(error, Error::Adapter(_)) {
        return unseen(Look::NotAsked);
    }
    let current = session.node();
    let nodes = [current, original];
    for node in &nodes[..if current == original { 1 } else { 2 }] {
        let timing = Timing { sdo: ANSWER.min(session.timing().sdo), attempts: 2, ..*session.timing() };
        let mut asked = session.with(*node, timing);
        asked.cancel_by_nobody();
        match ask(&mut asked, number) {
            Ok(seen) => return Left { state: judge(course, &seen, crc), look: Look::Seen(seen) },
            Err(Error::Adapter(_)) => return unseen(Look::NotAsked),
            Err(_) => {}
        }
    }
    unseen(Look::Silent)
}

fn ask(session: &mut Session<'_>, number: u8) -> Result<Seen, Error> {
    let running = DeviceType(session.read_number(Address::new(program::DEVICE_TYPE, 0))?);
    let mut object = |index| match optional(session.read_number(Address::new(index, number))) {
        // What is refused in another way, or of another length, is not told.
        Err(Error::Refused { .. } | Error::Protocol { .. }) => Ok(None),
        told => told,
    };
    let control = object(program::PROGRAM_CONTROL)?;
    let crc = object(program::PROGRAM_ID)?;
    Ok(Seen { running, control, crc })
}

/// What is in a device that was last known as the course has it, and tells this.
fn judge(course: &Course<'_>, seen: &Seen, crc: u32) -> DeviceState {
    match course.state {
        // It was called, and its application stays, or is back.
        DeviceState::Called if !seen.running.is_bootloader() => DeviceState::Untouched,
        DeviceState::Erased if !seen.empty() => match seen.crc {
            // A device that erases with the first block that it finds good has found none.
            told @ Some(_) if !course.wrote && told == course.before => course.resting,
            Some(told) if course.wrote && told == crc && seen.control.is_some() => DeviceState::Unreleased,
            _ => DeviceState::Erased,
        },
        state => state,
    }
}
