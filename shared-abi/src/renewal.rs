//! The renewal of the bootloader: what the resident part, the RAM image and the tools say about it
//! (docs/renewal.md).
//!
//! The resident part never changes. It loads the RAM image from *home*, or from *staging*, where a new
//! image waits: once for a trial, and after its confirmation until it is installed at home.

use crate::handoff::ResetCause;
use crate::warm_start::Damage;

/// The number of the RAM image in the store and in a sealed image. (On the bus it is the sub-index in
/// 2007h/1, which follows the programs of the device.)
pub const BOOTLOADER: u8 = 255;

/// The place from which the running RAM image was loaded, and why.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Origin {
    /// From home.
    #[default]
    Home = 0,
    /// From staging, once, on trial.
    Trial = 1,
    /// From staging: it is confirmed, and not installed yet.
    Confirmed = 2,
    /// From staging: it is installed, but home is damaged.
    Spare = 3,
}

impl Origin {
    /// The origin with this number; any other number is [`Home`](Self::Home).
    #[must_use]
    pub const fn from_byte(byte: u8) -> Self {
        match byte {
            1 => Self::Trial,
            2 => Self::Confirmed,
            3 => Self::Spare,
            _ => Self::Home,
        }
    }
}

/// The state of a renewal, as stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum State {
    /// No image is in staging.
    #[default]
    None = 0,
    /// A complete image is in staging, and was not confirmed.
    Staged = 1,
    /// A master has confirmed the image in staging. It is being installed at home.
    Confirmed = 2,
    /// Home has the image, too. That in staging is a spare until a program needs its flash.
    Installed = 3,
}

/// How the last trial ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TrialEnd {
    /// There was none since the last power-on, or it was confirmed.
    #[default]
    None,
    /// It was not confirmed in time.
    Late,
    /// A master has given it up: 1F51h = 84h or 3.
    GivenUp,
    /// The image ended by a reset that nobody requested.
    Reset(ResetCause),
    /// The image could not be loaded.
    Damaged(Damage),
}

impl TrialEnd {
    /// Its number, and the number of the reset or the damage; otherwise 0.
    #[must_use]
    pub const fn bytes(self) -> [u8; 2] {
        match self {
            Self::None => [0, 0],
            Self::Late => [1, 0],
            Self::GivenUp => [2, 0],
            Self::Reset(cause) => [3, cause as u8],
            Self::Damaged(damage) => [4, damage as u8],
        }
    }

    /// From [`bytes`](Self::bytes); unknown numbers are [`None`](Self::None).
    #[must_use]
    pub const fn from_bytes([number, detail]: [u8; 2]) -> Self {
        match (number, Damage::from_number(detail)) {
            (1, _) => Self::Late,
            (2, _) => Self::GivenUp,
            (3, _) => Self::Reset(ResetCause::from_byte(detail)),
            (4, Some(damage)) => Self::Damaged(damage),
            _ => Self::None,
        }
    }
}

/// The word of a [boot report](crate::boot_report): the number of an origin in the lowest byte, then the
/// [bytes](TrialEnd::bytes) of the end of a trial.
#[must_use]
pub const fn word(origin: Origin, end: TrialEnd) -> u32 {
    let [number, detail] = end.bytes();
    u32::from_le_bytes([origin as u8, number, detail, 0])
}

/// From the [`word`].
#[must_use]
pub const fn of_word(word: u32) -> (Origin, TrialEnd) {
    let [origin, number, detail, _] = word.to_le_bytes();
    (Origin::from_byte(origin), TrialEnd::from_bytes([number, detail]))
}

/// 2007h/9: the state of a renewal. On the bus it has four bytes: the number of the [`State`], that of
/// the [`Origin`], and the two of the [`TrialEnd`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Progress {
    /// What is stored.
    pub state: State,
    /// What runs.
    pub origin: Origin,
    /// What became of the last trial.
    pub trial_end: TrialEnd,
}

impl Progress {
    /// The four bytes.
    #[must_use]
    pub const fn bytes(self) -> [u8; 4] {
        let [end, detail] = self.trial_end.bytes();
        [self.state as u8, self.origin as u8, end, detail]
    }

    /// From the four bytes; `None` for a state of a later version.
    #[must_use]
    pub const fn from_bytes([state, origin, end, detail]: [u8; 4]) -> Option<Self> {
        let state = match state {
            0 => State::None,
            1 => State::Staged,
            2 => State::Confirmed,
            3 => State::Installed,
            _ => return None,
        };
        let trial_end = TrialEnd::from_bytes([end, detail]);
        Some(Self { state, origin: Origin::from_byte(origin), trial_end })
    }
}

/// The sub-index of the bootloader in 1F50h, 1F51h, 1F56h and 1F57h of a device: it follows the
/// `programs` of the layout, and the number that the profile has for data of the application.
#[must_use]
pub const fn number(programs: u8, data: Option<u8>) -> u8 {
    let highest = match data {
        Some(data) if data > programs => data,
        _ => programs,
    };
    highest + 1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Written down by hand from the table in docs/protocol.md.
    #[test]
    fn the_bytes_are_frozen() {
        for (progress, bytes) in [
            (Progress::default(), [0, 0, 0, 0]),
            (Progress { state: State::Staged, origin: Origin::Trial, ..Progress::default() }, [1, 1, 0, 0]),
            (
                Progress { state: State::Confirmed, origin: Origin::Confirmed, trial_end: TrialEnd::Late },
                [2, 2, 1, 0],
            ),
            (
                Progress { state: State::Installed, origin: Origin::Spare, trial_end: TrialEnd::GivenUp },
                [3, 3, 2, 0],
            ),
            (
                Progress {
                    trial_end: TrialEnd::Reset(ResetCause::IndependentWatchdog),
                    ..Progress::default()
                },
                [0, 0, 3, 4],
            ),
            (Progress { trial_end: TrialEnd::Damaged(Damage::Crc), ..Progress::default() }, [0, 0, 4, 3]),
        ] {
            assert_eq!(progress.bytes(), bytes);
            assert_eq!(Progress::from_bytes(bytes), Some(progress));
        }
        assert_eq!(Progress::from_bytes([4, 0, 0, 0]), None);
        assert_eq!(Progress::from_bytes([0, 9, 9, 9]), Some(Progress::default()));
    }

    #[test]
    fn the_number_follows_programs_and_data() {
        assert_eq!([number(1, None), number(2, None), number(1, Some(2)), number(2, Some(2))], [2, 3, 3, 3]);
    }
}
