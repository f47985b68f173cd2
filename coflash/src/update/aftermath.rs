//! The state of a device after a failed update: the tool asks the device, in addition to what it
//! knows itself.

use std::time::Duration;

use canopen::program;
use canopen::{Address, NodeId};

use super::device_after::{DeviceAfterUpdate, DeviceAnswer, DeviceState, Seen};
use super::running::RunningUpdate;
use crate::device::error::{optional, Error};
use crate::device::{DeviceType, Session, Timing};

/// How long the device may take for its answer; there are two attempts.
const ANSWER: Duration = Duration::from_millis(500);

/// Asks the device for its state after the update. `original` is the node-ID at the start of the
/// update, and `crc` the CRC of the file.
pub(super) fn look(
    session: &mut Session<'_>,
    error: &Error,
    update: &RunningUpdate<'_>,
    original: NodeId,
    number: u8,
    crc: u32,
) -> DeviceAfterUpdate {
    let unseen = |answer| DeviceAfterUpdate { state: update.state, answer };
    let untouched = update.state == DeviceState::Untouched && !update.touched;
    if untouched || matches!(error, Error::Adapter(_)) {
        return unseen(DeviceAnswer::NotAsked);
    }
    let current = session.node();
    let nodes = [current, original];
    for node in &nodes[..if current == original { 1 } else { 2 }] {
        let timing = Timing { sdo: ANSWER.min(session.timing().sdo), attempts: 2, ..*session.timing() };
        let mut asked = session.with(*node, timing);
        asked.cancel_by_nobody();
        match ask(&mut asked, number) {
            Ok(seen) => {
                return DeviceAfterUpdate {
                    state: judge(update, &seen, crc),
                    answer: DeviceAnswer::Seen(seen),
                }
            }
            Err(Error::Adapter(_)) => return unseen(DeviceAnswer::NotAsked),
            Err(_) => {}
        }
    }
    unseen(DeviceAnswer::Silent)
}

fn ask(session: &mut Session<'_>, number: u8) -> Result<Seen, Error> {
    let running = DeviceType(session.read_number(Address::new(program::DEVICE_TYPE, 0))?);
    let mut object = |index| match optional(session.read_number(Address::new(index, number))) {
        // Any other refusal, or a value of another length, counts as not reported.
        Err(Error::Refused { .. } | Error::Protocol { .. }) => Ok(None),
        told => told,
    };
    let control = object(program::PROGRAM_CONTROL)?;
    let crc = object(program::PROGRAM_ID)?;
    Ok(Seen { running, control, crc })
}

/// The state of a device, from the course of the update and the device's answers.
fn judge(update: &RunningUpdate<'_>, seen: &Seen, crc: u32) -> DeviceState {
    match update.state {
        // The application was called and has stayed, or is back.
        DeviceState::Called if !seen.running.is_bootloader() => DeviceState::Untouched,
        DeviceState::Erased if !seen.empty() => match seen.crc {
            // A device that erases with the first good block has received none.
            told @ Some(_) if !update.wrote && told == update.before => update.resting,
            Some(told) if update.wrote && told == crc && seen.control.is_some() => DeviceState::Unreleased,
            _ => DeviceState::Erased,
        },
        state => state,
    }
}
