//! Reads the state of a device, object 2007h of coboot.

use std::time::Duration;

use canopen::program::{
    ProgramStart, DEVICE_STATE, STATE_CLOCK, STATE_CRASH_RESETS, STATE_LAST_REASON, STATE_OPTION_BYTES,
    STATE_PROGRAM_RESET, STATE_PROGRAM_START, STATE_REASON, STATE_RELEASED, STATE_SUPPLY,
};
use canopen::Address;

use super::error::{reported, Error};
use super::option_bytes::OptionBytes;
use super::session::Session;
use super::state::BootloaderState;

/// Reads the state; `None` from a device without the object, such as an application.
///
/// # Errors
/// Those of a [read](Session::read).
pub fn read_state(session: &mut Session<'_>) -> Result<Option<BootloaderState>, Error> {
    let mut number = |sub| reported(session.read_number(Address::new(DEVICE_STATE, sub)));
    let mut byte = |sub| Ok::<_, Error>(number(sub)?.map(|value| value as u8));
    let Some(reason) = byte(STATE_REASON)? else { return Ok(None) };
    let last_reason = byte(STATE_LAST_REASON)?;
    let program_reset = byte(STATE_PROGRAM_RESET)?.unwrap_or(0);
    let crash_resets = byte(STATE_CRASH_RESETS)?.unwrap_or(0);
    let clock = byte(STATE_CLOCK)?.unwrap_or(0);
    let supply = byte(STATE_SUPPLY)?.unwrap_or(0);
    let option_bytes = number(STATE_OPTION_BYTES)?.filter(|value| *value != 0).map(OptionBytes);
    let released = number(STATE_RELEASED)?;
    Ok(Some(BootloaderState {
        reason,
        last_reason,
        released,
        program_reset,
        crash_resets,
        clock,
        option_bytes,
        supply,
    }))
}

/// The state of a device that is in trouble already: an error of the read is no news.
pub(crate) fn state_after_failure(session: &mut Session<'_>) -> Option<BootloaderState> {
    read_state(session).ok().flatten()
}

/// 2007h/10: how the bootloader starts programs; `None` if the device does not say.
///
/// # Errors
/// Those of a [read](Session::read).
pub fn program_start(session: &mut Session<'_>) -> Result<Option<ProgramStart>, Error> {
    let word = reported(session.read_number(Address::new(DEVICE_STATE, STATE_PROGRAM_START)))?;
    Ok(word.map(ProgramStart::of_word))
}

/// What a device says of a program that was released for autostart, in words; `None` if the program starts
/// by itself, or the device does not say.
pub(crate) fn autostart_words(start: ProgramStart, number: u8) -> Option<String> {
    match start.by_itself {
        [first, _] if first == number => None,
        [ProgramStart::DECIDED, _] => {
            Some("the device decides at each start which program starts by itself".into())
        }
        [0, _] => Some("no program starts by itself on this product".into()),
        [first, second] if second == number => Some(format!("it starts by itself if program {first} cannot")),
        [first, 0] => Some(format!("it does not start by itself: program {first} does")),
        [first, second] => {
            Some(format!("it does not start by itself: program {first} does, or program {second}"))
        }
    }
}

/// The time within which a program must feed the watchdog that the bootloader starts; `None` if there is no
/// such watchdog, or the device does not say.
///
/// # Errors
/// Those of a [read](Session::read).
pub fn program_watchdog(session: &mut Session<'_>) -> Result<Option<Duration>, Error> {
    let ms = program_start(session)?.map_or(0, |start| start.watchdog_ms);
    Ok((ms > 0).then(|| Duration::from_millis(ms.into())))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 2007h/10, docs/protocol.md: the preferred program, then the next one; FFh if the product decides.
    #[test]
    fn a_program_that_does_not_start_first_is_told() {
        let words = |by_itself, number| autostart_words(ProgramStart { watchdog_ms: 0, by_itself }, number);
        assert_eq!([words([1, 0], 1), words([2, 1], 2)], [None, None]);
        for (by_itself, number, expected) in [
            ([0, 0], 1, "no program starts by itself"),
            ([1, 2], 2, "if program 1 cannot"),
            ([1, 0], 2, "it does not start by itself: program 1 does"),
            ([1, 2], 3, "program 1 does, or program 2"),
            ([0xFF, 0], 1, "the device decides"),
        ] {
            let words = words(by_itself, number).unwrap();
            assert!(words.contains(expected), "{by_itself:?}, {number}: {words}");
        }
    }
}
