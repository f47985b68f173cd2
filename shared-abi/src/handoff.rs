//! The handoff: what the bootloader tells the application about how the device came up.
//!
//! Written by the bootloader right before the jump, at
//! [`Layout::handoff`](crate::layout::Layout::handoff), in no image's RAM. An application reads it
//! early and may read it again later.

use crate::check_word;

/// Tells a handoff ("CBHO" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBHO");

/// The layout version of this page. A reader accepts every version that is not older than the one
/// it knows: later versions only give names to reserved words.
pub const VERSION: u16 = 1;

/// Why the chip left reset, from `RCC_CSR` (RM0090 section 7.3.21).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum ResetCause {
    /// No flag was set, or a value from a later version.
    #[default]
    Unknown = 0,
    /// Power-on or power-down reset.
    PowerOn = 1,
    /// The NRST pin.
    Pin = 2,
    /// `SYSRESETREQ`.
    Software = 3,
    /// The independent watchdog.
    IndependentWatchdog = 4,
    /// The window watchdog.
    WindowWatchdog = 5,
    /// Illegal entry into a low-power mode.
    LowPower = 6,
    /// The supply fell below the brown-out level.
    BrownOut = 7,
}

impl ResetCause {
    /// From the byte in the handoff.
    #[must_use]
    pub const fn from_byte(byte: u8) -> Self {
        match byte {
            1 => Self::PowerOn,
            2 => Self::Pin,
            3 => Self::Software,
            4 => Self::IndependentWatchdog,
            5 => Self::WindowWatchdog,
            6 => Self::LowPower,
            7 => Self::BrownOut,
            _ => Self::Unknown,
        }
    }

    /// From the reset flags of `RCC_CSR` (RM0090 section 7.3.21).
    ///
    /// Every reset also pulls NRST low, and a power-on sets the brown-out flag as well; the most
    /// telling flag wins.
    #[must_use]
    pub const fn from_rcc_csr(csr: u32) -> Self {
        /// By bit, the most telling one first.
        const FLAGS: [(u8, ResetCause); 7] = [
            (27, ResetCause::PowerOn),             // PORRSTF
            (25, ResetCause::BrownOut),            // BORRSTF
            (29, ResetCause::IndependentWatchdog), // IWDGRSTF
            (30, ResetCause::WindowWatchdog),      // WWDGRSTF
            (31, ResetCause::LowPower),            // LPWRRSTF
            (28, ResetCause::Software),            // SFTRSTF
            (26, ResetCause::Pin),                 // PINRSTF
        ];
        let mut i = 0;
        while i < FLAGS.len() {
            let (bit, cause) = FLAGS[i];
            if csr >> bit & 1 != 0 {
                return cause;
            }
            i += 1;
        }
        Self::Unknown
    }
}

/// How the device came up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BootInfo {
    /// Node-ID in use, 1 to 127.
    pub node_id: u8,
    /// Bit rate of the CAN bus in bit/s; 0 for a device that finds it out by listening.
    pub bit_rate: u32,
    /// The program that was started, 1 to 254.
    pub program: u8,
    /// Why the chip left reset.
    pub reset_cause: ResetCause,
    /// The program carries no signature yet: after the next reset the bootloader stays.
    pub trial: bool,
    /// Version of the bootloader as in 1018h/3: major in the upper half, minor in the lower.
    pub bootloader_version: u32,
    /// Serial number as in 1018h/4.
    pub serial_number: u32,
}

/// The handoff as it lies in RAM: 48 bytes, little-endian.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Handoff {
    /// [`MAGIC`].
    pub magic: u32,
    /// [`VERSION`] of the bootloader that wrote it.
    pub version: u16,
    /// Bytes of the whole record.
    pub length: u16,
    /// Node-ID in use.
    pub node_id: u8,
    /// The program that was started.
    pub program: u8,
    /// A [`ResetCause`].
    pub reset_cause: u8,
    /// 1 for a trial, 0 otherwise.
    pub trial: u8,
    /// Bit rate in bit/s, 0 for one to be found out.
    pub bit_rate: u32,
    /// Version of the bootloader.
    pub bootloader_version: u32,
    /// Serial number of the device.
    pub serial_number: u32,
    /// 0; names for these words come with later versions.
    pub reserved: [u32; 5],
    /// [`check_word`] over the eleven words before.
    pub check: u32,
}

impl Handoff {
    /// The record that tells this.
    #[must_use]
    pub const fn new(info: &BootInfo) -> Self {
        let mut words = [0; WORDS];
        words[0] = MAGIC;
        words[1] = VERSION as u32 | (size_of::<Self>() as u32) << 16;
        words[2] = u32::from_le_bytes([info.node_id, info.program, info.reset_cause as u8, info.trial as u8]);
        words[3] = info.bit_rate;
        words[4] = info.bootloader_version;
        words[5] = info.serial_number;
        words[WORDS - 1] = check_of(&words);
        // SAFETY: both are 48 bytes, and any bits make a `Handoff`.
        unsafe { core::mem::transmute(words) }
    }

    /// What it tells, or `None` where no bootloader left a sound one (a debugger started the
    /// application, say).
    #[must_use]
    pub fn info(&self) -> Option<BootInfo> {
        // SAFETY: both are 48 bytes, and any bits make words.
        let words = unsafe { core::mem::transmute::<Self, [u32; WORDS]>(*self) };
        let sound = is_sound(&words)
            && self.version >= VERSION
            && usize::from(self.length) == size_of::<Self>()
            && matches!(self.node_id, 1..=127);
        sound.then_some(BootInfo {
            node_id: self.node_id,
            bit_rate: self.bit_rate,
            program: self.program,
            reset_cause: ResetCause::from_byte(self.reset_cause),
            trial: self.trial != 0,
            bootloader_version: self.bootloader_version,
            serial_number: self.serial_number,
        })
    }

    /// Reads the handoff that the bootloader left.
    ///
    /// # Safety
    /// `address` must be the layout's handoff region (word-aligned RAM of 48 bytes).
    #[must_use]
    pub unsafe fn read(address: *const Self) -> Option<BootInfo> {
        // SAFETY: the caller vouches for the address; any bits make a valid `Handoff`, `info`
        // judges them.
        unsafe { address.read_volatile() }.info()
    }

    /// The program that the handoff names, for the bootloader, which needs no more of what it has
    /// left itself; 0 where there is no sound one.
    ///
    /// # Safety
    /// As for [`read`](Self::read).
    #[must_use]
    pub unsafe fn read_program(address: *const Self) -> u8 {
        // SAFETY: the caller vouches for the address; nothing writes there while this reads.
        let words = unsafe { &*address.cast::<[u32; WORDS]>() };
        if is_sound(words) {
            words[2].to_le_bytes()[1]
        } else {
            0
        }
    }

    /// Leaves the handoff for the application.
    ///
    /// # Safety
    /// `address` must be the layout's handoff region (word-aligned RAM of 48 bytes that nothing
    /// else uses).
    pub unsafe fn write(self, address: *mut Self) {
        // SAFETY: the caller vouches for the address.
        unsafe { address.write_volatile(self) };
    }
}

/// Words of the record.
const WORDS: usize = size_of::<Handoff>() / 4;

/// The check word of a record: over all words but the last.
const fn check_of(words: &[u32; WORDS]) -> u32 {
    let (rest, _) = words.split_at(WORDS - 1);
    check_word(rest)
}

const fn is_sound(words: &[u32; WORDS]) -> bool {
    words[0] == MAGIC && words[WORDS - 1] == check_of(words)
}

#[cfg(test)]
mod tests {
    use super::*;

    const INFO: BootInfo = BootInfo {
        node_id: 5,
        bit_rate: 125_000,
        program: 1,
        reset_cause: ResetCause::Software,
        trial: true,
        bootloader_version: 0x0001_0002,
        serial_number: 0xDEAD_BEEF,
    };

    #[test]
    fn tells_what_it_was_told() {
        assert_eq!(Handoff::new(&INFO).info(), Some(INFO));
    }

    #[test]
    fn any_damage_is_seen() {
        let good = Handoff::new(&INFO);
        assert_eq!(Handoff { node_id: 6, ..good }.info(), None);
        assert_eq!(Handoff { trial: 0, ..good }.info(), None);
        assert_eq!(Handoff { reserved: [0, 0, 0, 0, 1], ..good }.info(), None);
        assert_eq!(Handoff { check: !good.check, ..good }.info(), None);
        let unusable = Handoff::new(&BootInfo { node_id: 0, ..INFO });
        assert_eq!(unusable.info(), None, "an application cannot use node-ID 0");
    }

    /// Flag positions from RM0090 section 7.3.21.
    #[test]
    fn the_most_telling_reset_flag_wins() {
        assert_eq!(ResetCause::from_rcc_csr(0x0E00_0003), ResetCause::PowerOn);
        assert_eq!(ResetCause::from_rcc_csr(0x1400_0000), ResetCause::Software);
        assert_eq!(ResetCause::from_rcc_csr(0x2400_0000), ResetCause::IndependentWatchdog);
        assert_eq!(ResetCause::from_rcc_csr(0x0400_0000), ResetCause::Pin);
        assert_eq!(ResetCause::from_rcc_csr(0), ResetCause::Unknown);
    }
}
