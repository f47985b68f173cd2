//! The state of a device in its own words: object 2007h of coboot.

use std::fmt;

use canopen::program::{ClockSource, Supply, STATE_STARTS};
use serde::Serialize;
use shared_abi::boot_report::Reason;
use shared_abi::handoff::ResetCause;
use shared_abi::renewal::TrialEnd;
use shared_abi::warm_start::Damage;

use super::option_bytes::OptionBytes;
use crate::advice::{Advice, OfProgram};

/// Why a device stays in the bootloader, and how its program ended. `Display` shows what is so now in one line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct BootloaderState {
    /// 2007h/2: the number of the [`Reason`] why a power-on would leave the device in the bootloader now;
    /// 255 if a program would start.
    pub reason: u8,
    /// 2007h/11: the number of the [`Reason`] of the last stay. `None` from an older bootloader, whose
    /// `reason` is this one.
    pub last_reason: Option<u8>,
    /// 2007h/12: the programs that are released for autostart, number 1 in bit 0; `None` if they are not known.
    pub released: Option<u32>,
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
        let had_program = self.stayed() != Reason::NoProgram as u8;
        (had_program && cause != ResetCause::Unknown).then_some(cause)
    }

    /// The number of the [`Reason`] why the device stayed at its last reset.
    #[must_use]
    pub fn stayed(self) -> u8 {
        self.last_reason.unwrap_or(self.reason)
    }

    /// Why the device would stay in the bootloader now, in words; `None` if a program would start.
    #[must_use]
    pub fn stays(self) -> Option<String> {
        (self.reason != STATE_STARTS).then(|| reason(self.reason))
    }

    /// Whether a program (1 to 32) is released for autostart; `None` if that is not known.
    #[must_use]
    pub fn is_released(self, program: u8) -> Option<bool> {
        let place = program.checked_sub(1).filter(|place| *place < 32)?;
        self.released.map(|programs| programs >> place & 1 != 0)
    }

    /// The last reset in words: why the device stayed, and how its program ended. `None` from an older
    /// bootloader.
    #[must_use]
    pub fn last_reset(self) -> Option<String> {
        let stayed = past_reason(self.last_reason?);
        Some(format!("it stayed in the bootloader: {stayed}{}", self.ends()))
    }

    /// How the program ended, as the rest of a sentence.
    fn ends(self) -> String {
        let by = self.ended_by().map(|by| format!("; the program was ended by {}", source(by)));
        let resets = match self.crash_resets {
            0 => String::new(),
            1 => "; 1 reset that nobody requested".into(),
            255 => "; 255 or more resets in a row that nobody requested".into(),
            n => format!("; {n} resets in a row that nobody requested"),
        };
        by.unwrap_or_default() + &resets
    }

    /// What to do, with this program; `None` for a reason that this tool does not know.
    #[must_use]
    pub fn advice(self, program: u8) -> Option<Advice> {
        let program = OfProgram(program);
        let has_passed = self.reason == STATE_STARTS;
        Some(match Reason::from_byte(if has_passed { self.stayed() } else { self.reason })? {
            Reason::Fault => Advice::BootloaderFault { program },
            Reason::Rescue => Advice::AskedInWindow { program },
            Reason::Renewal => Advice::RenewalOpen { program },
            Reason::Compaction => Advice::Compacts,
            _ if has_passed => Advice::StartNow { program },
            Reason::Requested | Reason::TwoResets => Advice::StartNow { program },
            Reason::Strap => Advice::ReleaseStrap,
            Reason::CrashLoop => Advice::CrashLoop { program },
            Reason::NoAutostart => Advice::StartByCommand { program },
            Reason::NodeId => Advice::NodeIdForProduct,
            Reason::Unsigned => Advice::ReleaseIt { program },
            Reason::NoProgram => Advice::FlashFirst,
            Reason::Damaged => Advice::FlashAgain,
            Reason::Vectors => Advice::WrongFormat,
            Reason::Forbidden => Advice::StartForbidden,
        })
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
        Some(Reason::Damaged) => "its program is not the one that was downloaded",
        Some(Reason::Vectors) => "the first two words of its program are no stack and entry for this board",
        Some(Reason::Forbidden) => "the product has forbidden the start of its program",
        Some(Reason::Renewal) => "a new bootloader is on trial, or its trial has ended",
        Some(Reason::TwoResets) => "its reset pin (NRST) was pulled twice within half a second",
        Some(Reason::Compaction) => "its stored values are being compacted before the start of its program",
        None => return format!("for a reason that this tool does not know ({number})"),
    }
    .to_string()
}

/// Why a device stayed in the bootloader at its last reset: the words of [`reason`] for what may have passed.
fn past_reason(number: u8) -> String {
    reason(number).replace(" is ", " was ").replace(" has ", " had ").replace(" are ", " were ")
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
        match self.stays() {
            Some(why) => write!(f, "stays in the bootloader: {why}")?,
            None => write!(f, "in the bootloader; a reset starts its program")?,
        }
        if self.last_reason.is_none() {
            write!(f, "{}", self.ends())?;
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
        last_reason: None,
        released: None,
        program_reset: 0,
        crash_resets: 0,
        clock: 1,
        option_bytes: None,
        supply: 1,
    };

    /// An older bootloader says why it stayed, and nothing else.
    #[test]
    fn each_state_has_its_words() {
        let with = |reason, program_reset, crash_resets| BootloaderState {
            reason,
            program_reset,
            crash_resets,
            ..NOTHING
        };
        for (state, words) in [
            (
                with(5, 4, 1),
                "its program is not released for autostart; the program was ended by the independent watchdog; 1 reset \
                 that nobody requested",
            ),
            // After power-on, too: the power has ended no program.
            (with(6, 0, 0), "it has no program"),
            (with(6, 1, 0), "it has no program"),
            (with(6, 3, 0), "it has no program"),
            (with(200, 200, 0), "for a reason that this tool does not know (200)"),
            (
                BootloaderState { clock: 2, ..with(6, 0, 0) },
                "it has no program; its crystal has failed, and it runs from its internal oscillator",
            ),
            (BootloaderState { supply: 0, ..with(6, 0, 0) }, "it has no program"),
            (BootloaderState { supply: 7, ..with(6, 0, 0) }, "it has no program"),
            (
                BootloaderState { supply: 2, ..with(6, 0, 0) },
                "it has no program; its supply is too low to write its flash",
            ),
        ] {
            assert_eq!(state.to_string(), format!("stays in the bootloader: {words}"));
        }
    }

    /// What is so now is not what was so at the last reset; each reason has words of its own, and advice.
    #[test]
    fn a_reason_that_has_passed_is_in_the_past_tense() {
        let state = BootloaderState { reason: 5, last_reason: Some(6), released: Some(2), ..NOTHING };
        assert_eq!(state.to_string(), "stays in the bootloader: its program is not released for autostart");
        assert_eq!(state.last_reset().unwrap(), "it stayed in the bootloader: it had no program");
        assert_eq!([1, 2, 33].map(|program| state.is_released(program)), [Some(false), Some(true), None]);
        let crashed =
            BootloaderState { reason: 255, last_reason: Some(2), program_reset: 4, crash_resets: 3, ..state };
        assert_eq!(crashed.to_string(), "in the bootloader; a reset starts its program");
        assert!(crashed.last_reset().unwrap().ends_with(
            "had ended too often in a row by a reset that nobody requested; the program was ended by the independent \
             watchdog; 3 resets in a row that nobody requested"
        ));
        for words in [reason, past_reason] {
            let mut all: Vec<_> = Reason::ALL.map(|reason| words(reason as u8)).to_vec();
            all.sort();
            all.dedup();
            assert_eq!(all.len(), Reason::ALL.len());
        }
        let program = OfProgram(2);
        for (now, last, advice) in [
            (255, 0, Advice::StartNow { program }),
            (255, 5, Advice::StartNow { program }),
            (255, 7, Advice::BootloaderFault { program }),
            (255, 8, Advice::AskedInWindow { program }),
            (5, 8, Advice::ReleaseIt { program }),
            (1, 0, Advice::ReleaseStrap),
        ] {
            let state = BootloaderState { reason: now, last_reason: Some(last), ..NOTHING };
            assert_eq!(state.advice(2), Some(advice), "{now} after {last}");
        }
        let of = |reason| BootloaderState { reason, ..NOTHING }.advice(1);
        assert!(Reason::ALL.iter().all(|reason| of(*reason as u8).is_some()) && of(200).is_none());
    }
}
