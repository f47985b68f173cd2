//! The state of a device after a failed update: the tool asks the device, in addition to what it
//! knows itself.

use std::time::Duration;

use canopen::program::{self, FlashError, ProgramState};
use canopen::Address;

use super::device_after::{Answers, DeviceAfterUpdate, DeviceAnswer, DeviceState};
use super::running::RunningUpdate;
use crate::device::error::{reported, Error};
use crate::device::{DeviceType, Doing, Session, Timing};

/// How long the device may take for its answer; there are two attempts.
const ANSWER: Duration = Duration::from_millis(500);
/// How long the device may take for the last data that it got: with them, its program may become complete.
const LAST_DATA: Duration = Duration::from_secs(2);

/// Asks the device for its state after the update. `crcs` are the values that 1F56h may have with the
/// file's program.
pub(super) fn state_after(
    session: &mut Session<'_>,
    error: &Error,
    update: &RunningUpdate<'_>,
    number: u8,
    crcs: [u32; 2],
) -> DeviceAfterUpdate {
    let without = |answer| DeviceAfterUpdate { state: update.last_known(), answer };
    let untouched = update.known.state == DeviceState::Untouched && !update.known.touched;
    if untouched || matches!(error, Error::Adapter(_)) {
        return without(DeviceAnswer::NotAsked);
    }
    let (current, original) = (session.node(), update.original);
    let nodes = [current, original];
    for node in &nodes[..if current == original { 1 } else { 2 }] {
        let timing = Timing {
            sdo: ANSWER.min(session.timing().sdo),
            attempts: 2,
            command: LAST_DATA.min(session.timing().command),
            ..*session.timing()
        };
        let mut asked = session.with(*node, timing);
        asked.cancel_by_nobody();
        match ask(&mut asked, number, update.known.wrote) {
            Ok(answers) => {
                return DeviceAfterUpdate {
                    state: judge(update, &answers, crcs, error),
                    answer: DeviceAnswer::Given(answers),
                }
            }
            Err(Error::Adapter(_)) => return without(DeviceAnswer::NotAsked),
            Err(_) => {}
        }
    }
    without(DeviceAnswer::Silent)
}

/// Its answers, once it has done with the data that it got, if it got any.
fn ask(session: &mut Session<'_>, number: u8, wrote: bool) -> Result<Answers, Error> {
    let running = DeviceType(session.read_number(Address::new(program::DEVICE_TYPE, 0))?);
    if wrote && running.is_bootloader() {
        // Without an answer, it is asked all the same.
        let _ = session.await_idle(number, Doing::Program);
    }
    let mut object = |index| reported(session.read_number(Address::new(index, number)));
    let control = object(program::PROGRAM_CONTROL)?;
    let crc = object(program::PROGRAM_ID)?;
    Ok(Answers { running, program: number, control, crc })
}

/// Whether a sealed image was refused as not authentic, too old, or for other keys: a device erases
/// nothing before that is judged. One that refuses a later part has erased, and then says so.
fn is_not_admitted(error: &Error) -> bool {
    let Error::Failed { error, .. } = error else { return false };
    matches!(*error, FlashError::Signature | FlashError::Rollback | FlashError::Key)
}

/// The state of a device, from the course of the update, its error and the device's answers.
fn judge(update: &RunningUpdate<'_>, answers: &Answers, crcs: [u32; 2], error: &Error) -> DeviceState {
    let wrote = update.known.wrote && !is_not_admitted(error);
    let has_new = answers.crc.is_some_and(|crc| crcs.contains(&crc));
    match update.known.state {
        // An earlier attempt has written it.
        DeviceState::Begun if !answers.running.is_bootloader() && has_new => DeviceState::Written,
        // The application was called and has stayed, or is back.
        DeviceState::Called | DeviceState::Begun if !answers.running.is_bootloader() => {
            DeviceState::Untouched
        }
        DeviceState::Begun if answers.empty() => DeviceState::Erased,
        DeviceState::Begun => DeviceState::Called,
        DeviceState::Erased if !answers.empty() => match answers.crc {
            // A device that erases with the first good block has received none.
            reported @ Some(_) if !wrote && reported == update.known.before => update.known.state_before,
            // The new one runs: the device has started it by itself.
            _ if wrote
                && has_new
                && answers.crc != update.known.before
                && !answers.running.is_bootloader() =>
            {
                DeviceState::Written
            }
            // It runs, so it is whole.
            _ if answers.control == Some(ProgramState::Running as u32)
                && !answers.running.is_bootloader() =>
            {
                match update.known.state_before {
                    DeviceState::Called | DeviceState::Begun => DeviceState::Untouched,
                    state => state,
                }
            }
            // The old program may have the same CRC.
            reported if update.known.postponed && reported == update.known.before => DeviceState::Postponed,
            Some(reported) if wrote && crcs.contains(&reported) && answers.control.is_some() => {
                DeviceState::Unreleased
            }
            _ => DeviceState::Erased,
        },
        state => state,
    }
}

#[cfg(test)]
mod tests {
    use canopen::AbortCode;

    use super::super::event::Phase;
    use super::super::running::Known;
    use super::*;
    use crate::update::options::FlashOptions;

    /// A program that runs is the new one if the device says so and had another CRC before; otherwise the old one.
    #[test]
    fn a_program_that_runs_is_the_one_with_its_crc() {
        const NEW: u32 = 2;
        let erased = |before| Known {
            state: DeviceState::Erased,
            touched: true,
            state_before: DeviceState::Called,
            before: Some(before),
            postponed: false,
            wrote: true,
        };
        for (mut known, crc, left) in [
            (erased(1), NEW, DeviceState::Written),
            (erased(1), 1, DeviceState::Untouched),
            (erased(NEW), NEW, DeviceState::Untouched),
            (Known::begun(), NEW, DeviceState::Written),
            (Known::begun(), 1, DeviceState::Untouched),
        ] {
            let answers = Answers {
                running: DeviceType(0),
                program: 1,
                control: Some(ProgramState::Running as u32),
                crc: Some(crc),
            };
            let nobody = &mut |_| {};
            let node = canopen::NodeId::MAX;
            let update = RunningUpdate::new(node, FlashOptions::default(), &mut known, nobody);
            assert_eq!(judge(&update, &answers, [NEW, 0xBEEF], &Error::Cancelled), left, "{crc}");
        }
    }

    /// An earlier attempt has seen the end of the erase, or this one sees that there is no program: a refusal and a
    /// short erase say nothing more.
    #[test]
    fn a_second_attempt_knows_what_the_first_one_did() {
        for (postponed, crc) in [(false, Some(0)), (false, None), (true, Some(0))] {
            let mut known = Known::default();
            let (node, nobody) = (canopen::NodeId::MAX, &mut |_| {});
            let mut first = RunningUpdate::new(node, FlashOptions::default(), &mut known, nobody);
            first.erases(crc.map(|_| 0x0BAD_CAFE));
            first.report(Phase::Erased { took: Duration::ZERO, postponed: Some(postponed) }.into());
            let mut second = RunningUpdate::new(node, FlashOptions::default(), &mut known, nobody);
            second.erases(crc);
            assert_eq!(second.last_known(), DeviceState::Erased, "{postponed}, {crc:?}");
            if crc.is_some() {
                second.report(Phase::Erased { took: Duration::ZERO, postponed: None }.into());
                second.erase_failed(&Error::Refused {
                    node,
                    doing: Doing::Program,
                    code: AbortCode::GENERAL,
                });
                assert_eq!(second.last_known(), DeviceState::Erased, "{postponed}, {crc:?}");
            }
        }
    }
}
