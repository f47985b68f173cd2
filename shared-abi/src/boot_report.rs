//! The boot report: a record in which the resident part informs the RAM image why it runs, and what
//! is left to do.
//!
//! It is in the [`handoff`](crate::handoff)'s place: the resident part starts a program or the RAM
//! image, never both.

use crate::check_word;
use crate::warm_start::Owed;

/// Identifies a boot report ("CBBR" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBBR");

/// The version of the record; a reader takes every one from 1 on.
pub const VERSION: u16 = 1;

/// Why a device stays in the bootloader: 2007h/2, and the last byte of the emergency after the boot-up
/// message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Reason {
    /// The application, or a tool through it, has requested the bootloader.
    Requested = 0,
    /// The entry strap is set.
    Strap = 1,
    /// The program has ended too often in a row by a reset that nobody requested.
    CrashLoop = 2,
    /// No program starts by itself, and none was requested.
    NoAutostart = 3,
    /// The node-ID is outside the range with which a program may start.
    NodeId = 4,
    /// The program is not released for autostart.
    Unsigned = 5,
    /// There is no program.
    NoProgram = 6,
    /// The bootloader had a fault or a panic.
    Fault = 7,
    /// A program could start, and waits until the rescue window ends.
    Rescue = 8,
    /// The program in flash differs from the one that was downloaded.
    Damaged = 9,
    /// The first two words of the program are no vectors for its flash and the RAM.
    Vectors = 10,
    /// The product forbids the start at present.
    Forbidden = 11,
    /// The RAM image is on trial, or its trial has just ended ([`crate::renewal`]).
    Renewal = 12,
    /// The NRST pin has reset the device twice within half a second.
    TwoResets = 13,
    /// A program could start, and waits until the stored values are compacted.
    Compaction = 14,
}

impl Reason {
    /// All reasons, in the order of their numbers.
    pub const ALL: [Self; 15] = [
        Self::Requested,
        Self::Strap,
        Self::CrashLoop,
        Self::NoAutostart,
        Self::NodeId,
        Self::Unsigned,
        Self::NoProgram,
        Self::Fault,
        Self::Rescue,
        Self::Damaged,
        Self::Vectors,
        Self::Forbidden,
        Self::Renewal,
        Self::TwoResets,
        Self::Compaction,
    ];

    /// The reason with this number; `None` for a number from a later version.
    #[must_use]
    pub fn from_byte(byte: u8) -> Option<Self> {
        Self::ALL.get(usize::from(byte)).copied()
    }
}

/// The reason why the bootloader runs, and the work that is left for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BootReport {
    /// The number of a [`Reason`].
    pub reason: u8,
    /// The program that should have started and may not; 0 for none.
    pub refused: u8,
    /// The reset by which the program ended, as the number of a
    /// [`ResetCause`](crate::handoff::ResetCause); 0 after a reset of the bootloader itself.
    pub program_reset: u8,
    /// Resets in a row by which a program ended and that nobody requested; 255 for more.
    pub crash_resets: u8,
    /// The program that starts when the rescue window or the compaction is over; 0 for none.
    pub held_program: u8,
    /// Length of the rescue window, in ms; 0 for none.
    pub window_ms: u16,
    /// The write of 1F51h that the application received and the bootloader answers; its node-ID is
    /// 0 if there is none.
    pub owed: Owed,
    /// The program that returned control to the bootloader; 0 for none.
    pub returned: u8,
    /// Node-ID in force from this reset on; 255 for none.
    pub node_id: u8,
    /// Bit rate in force from this reset on, as the index of CiA 305 table 1.
    pub bit_rate: u8,
    /// Where the RAM image was loaded from, and how the last trial of one ended:
    /// see [`renewal::word`](crate::renewal::word).
    pub renewal: u32,
}

/// The record in RAM: twelve words, little-endian.
///
/// | word | contents |
/// |---|---|
/// | 0 | [`MAGIC`] |
/// | 1 | [`VERSION`] in the lower half, 48 (bytes) in the upper one |
/// | 2 | reason, held program, length of the window (16 bits) |
/// | 3 | owed: program, value, node-ID; then the program that returned |
/// | 4 | node-ID, bit rate, the reset that ended the program, crash resets |
/// | 5 | refused program |
/// | 6 | origin, the end of the last trial (2 bytes), 0 |
/// | 7–10 | 0 |
/// | 11 | [`check_word`] of the words before |
pub type Words = [u32; 12];

impl BootReport {
    /// The report of a debugger that starts the image alone: it stays for a fault, without node-ID, and
    /// detects the bit rate.
    pub const NONE: Self = Self {
        reason: Reason::Fault as u8,
        refused: 0,
        program_reset: 0,
        crash_resets: 0,
        held_program: 0,
        window_ms: 0,
        owed: Owed::NOTHING,
        returned: 0,
        node_id: 255,
        bit_rate: 9,
        renewal: 0,
    };

    /// The record with this report.
    #[must_use]
    pub const fn words(&self) -> Words {
        let Owed { program, value, node_id } = self.owed;
        let [window, window_high] = self.window_ms.to_le_bytes();
        let mut words = [0; 12];
        words[0] = MAGIC;
        words[1] = VERSION as u32 | (size_of::<Words>() as u32) << 16;
        words[2] = u32::from_le_bytes([self.reason, self.held_program, window, window_high]);
        words[3] = u32::from_le_bytes([program, value, node_id, self.returned]);
        words[4] = u32::from_le_bytes([self.node_id, self.bit_rate, self.program_reset, self.crash_resets]);
        words[5] = self.refused as u32;
        words[6] = self.renewal;
        words[11] = check_of(&words);
        words
    }

    /// The report in a record; `None` if the record is damaged.
    #[must_use]
    pub const fn parse(words: &Words) -> Option<Self> {
        let (version, length) = (words[1] as u16, words[1] as usize >> 16);
        if words[0] != MAGIC || version == 0 || length != size_of::<Words>() || words[11] != check_of(words) {
            return None;
        }
        let [reason, held_program, window, window_high] = words[2].to_le_bytes();
        let [program, value, node, returned] = words[3].to_le_bytes();
        let [node_id, bit_rate, program_reset, crash_resets] = words[4].to_le_bytes();
        let [refused, ..] = words[5].to_le_bytes();
        Some(Self {
            reason,
            refused,
            program_reset,
            crash_resets,
            held_program,
            window_ms: u16::from_le_bytes([window, window_high]),
            owed: Owed { program, value, node_id: node },
            returned,
            node_id,
            bit_rate,
            renewal: words[6],
        })
    }
}

const fn check_of(words: &Words) -> u32 {
    let (rest, _) = words.split_at(words.len() - 1);
    check_word(rest)
}
