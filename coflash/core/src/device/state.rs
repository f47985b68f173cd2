//! The state of a device in its own words: object 2007h of coboot.

use std::fmt;

use canopen::program::{ClockSource, Supply};
use serde::Serialize;
use shared_abi::boot_report::Reason;
use shared_abi::handoff::ResetCause;
use shared_abi::renewal::TrialEnd;
use shared_abi::warm_start::Damage;

use super::option_bytes::OptionBytes;

/// Why a device stays in the bootloader, and how its program ended. `Display` shows it in one line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct BootloaderState {
    /// 2007h/2: the number of a [`Reason`].
    pub reason: u8,
    /// 2007h/3: the number of a [`ResetCause`]; 0 if it is not known.
    pub program_reset: u8,
    /// 2007h/4: resets in a row by which a program ended and that nobody requested.
    pub crash_resets: u8,
    /// 2007h/5: the number of a [`ClockSource`]; 0 if it is not known.
    pub clock: u8,
    /// 2007h/6; `None` if they are not known.
    pub option_bytes: Option<OptionBytes>,
    /// 2007h/7: the number of a [`Supply`]; 0 if it is not known.
    pub supply: u8,
}

impl BootloaderState {
    /// The reset by which the program ended, if there is one and the reset is known.
    #[must_use]
    pub fn ended_by(self) -> Option<ResetCause> {
        let cause = ResetCause::from_byte(self.program_reset);
        let has_program = Reason::from_byte(self.reason) != Some(Reason::NoProgram);
        (has_program && cause != ResetCause::Unknown).then_some(cause)
    }
}

/// The source of a reset, in words.
#[must_use]
pub const fn source(cause: ResetCause) -> &'static str {
    match cause {
        ResetCause::Unknown => "an unknown source",
        ResetCause::PowerOn => "the power",
        ResetCause::Pin => "the reset pin",
        ResetCause::Software => "software",
        ResetCause::IndependentWatchdog => "the independent watchdog",
        ResetCause::WindowWatchdog => "the window watchdog",
        ResetCause::LowPower => "a low-power mode that the option bytes forbid",
        ResetCause::BrownOut => "a supply below the brown-out level",
        ResetCause::Standby => "a wake-up from Standby",
    }
}

/// The supply of a device, in words; `None` if it is not known.
#[must_use]
pub const fn supply(number: u8) -> Option<&'static str> {
    const GOOD: u8 = Supply::Good as u8;
    const LOW: u8 = Supply::Low as u8;
    match number {
        GOOD => Some("good"),
        LOW => Some("too low to write its flash"),
        _ => None,
    }
}

/// Why a device stays in the bootloader, in words.
#[must_use]
pub fn reason(number: u8) -> String {
    match Reason::from_byte(number) {
        Some(Reason::Requested) => "it was called back",
        Some(Reason::Strap) => "its entry strap is set",
        Some(Reason::CrashLoop) => {
            "its program has ended too often in a row by a reset that nobody requested"
        }
        Some(Reason::NoAutostart) => "no program starts by itself on this product",
        Some(Reason::NodeId) => "its node-ID is outside the range with which a program may start",
        Some(Reason::Unsigned) => "its program is not released for autostart",
        Some(Reason::NoProgram) => "it has no program",
        Some(Reason::Fault) => "the bootloader had a fault",
        Some(Reason::Rescue) => "somebody spoke to it in its rescue window",
        Some(Reason::Damaged) => "its program differs from the one that was downloaded",
        Some(Reason::Vectors) => "the first two words of its program are no stack and entry for this board",
        Some(Reason::Forbidden) => "the product forbids the start of its program at present",
        Some(Reason::Renewal) => "a new bootloader is on trial, or its trial has ended",
        Some(Reason::TwoResets) => "its reset pin (NRST) was pulled twice within half a second",
        Some(Reason::Compaction) => "it compacts its stored values, and starts its program then",
        None => return format!("for a reason that this tool does not know ({number})"),
    }
    .to_string()
}

/// The end of a trial, in words: the rest of a sentence about the new bootloader.
#[must_use]
pub fn trial_end(end: TrialEnd) -> String {
    match end {
        TrialEnd::None => "did not run".to_string(),
        TrialEnd::Late => "was not confirmed in time".to_string(),
        TrialEnd::GivenUp => "was given up by a master".to_string(),
        TrialEnd::Reset(cause) => format!("ended by a reset: {}", source(cause)),
        TrialEnd::Damaged(damage) => format!("could not be loaded: {}", damage_words(damage)),
    }
}

/// A damage of a RAM image, in words.
const fn damage_words(damage: Damage) -> &'static str {
    match damage {
        Damage::Header => "its header is wrong",
        Damage::Services => "it needs a newer resident part, or another ability of it",
        Damage::Crc => "its CRC is wrong",
        Damage::Board => "it is for another board",
        Damage::Vectors => "its stack or its entry is outside its RAM",
        Damage::Facts => "it was built for a resident part that decides by other choices",
    }
}

impl fmt::Display for BootloaderState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "stays in the bootloader: {}", reason(self.reason))?;
        if let Some(how) = self.ended_by() {
            write!(f, "; the program was ended by {}", source(how))?;
        }
        match self.crash_resets {
            0 => {}
            1 => write!(f, "; 1 reset that nobody requested")?,
            255 => write!(f, "; 255 or more resets in a row that nobody requested")?,
            n => write!(f, "; {n} resets in a row that nobody requested")?,
        }
        if self.clock == ClockSource::Internal as u8 {
            write!(f, "; its crystal has failed, and it runs from its internal oscillator")?;
        }
        if self.supply == Supply::Low as u8 {
            write!(f, "; its supply is too low to write its flash")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOTHING: BootloaderState = BootloaderState {
        reason: 0,
        program_reset: 0,
        crash_resets: 0,
        clock: 1,
        option_bytes: None,
        supply: 1,
    };

    #[test]
    fn each_state_has_its_words() {
        let state = |reason, program_reset, crash_resets| {
            BootloaderState { reason, program_reset, crash_resets, ..NOTHING }.to_string()
        };
        assert_eq!(
            state(5, 4, 1),
            "stays in the bootloader: its program is not released for autostart; the program was ended by the \
             independent watchdog; 1 reset that nobody requested"
        );
        // After power-on, too: the power has ended no program.
        for program_reset in [0, 1, 3] {
            assert_eq!(state(6, program_reset, 0), "stays in the bootloader: it has no program");
        }
        assert_eq!(
            state(200, 200, 0),
            "stays in the bootloader: for a reason that this tool does not know (200)"
        );
        let failed = BootloaderState { reason: 6, clock: 2, ..NOTHING };
        assert_eq!(
            failed.to_string(),
            "stays in the bootloader: it has no program; its crystal has failed, and it runs from its internal \
             oscillator"
        );
        for supply in [0, 1, 7] {
            let state = BootloaderState { reason: 6, supply, ..NOTHING };
            assert_eq!(state.to_string(), "stays in the bootloader: it has no program");
        }
        let low = BootloaderState { reason: 6, supply: 2, ..NOTHING };
        assert_eq!(
            low.to_string(),
            "stays in the bootloader: it has no program; its supply is too low to write its flash"
        );
        // No two reasons share their words.
        let mut words: Vec<_> = (0..=12).map(reason).collect();
        words.sort();
        words.dedup();
        assert_eq!(words.len(), 13);
    }
}
