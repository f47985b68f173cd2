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
        const LPWRRSTF: u32 = 1 << 31;
        const WWDGRSTF: u32 = 1 << 30;
        const IWDGRSTF: u32 = 1 << 29;
        const SFTRSTF: u32 = 1 << 28;
        const PORRSTF: u32 = 1 << 27;
        const PINRSTF: u32 = 1 << 26;
        const BORRSTF: u32 = 1 << 25;
        if csr & PORRSTF != 0 {
            Self::PowerOn
        } else if csr & BORRSTF != 0 {
            Self::BrownOut
        } else if csr & IWDGRSTF != 0 {
            Self::IndependentWatchdog
        } else if csr & WWDGRSTF != 0 {
            Self::WindowWatchdog
        } else if csr & LPWRRSTF != 0 {
            Self::LowPower
        } else if csr & SFTRSTF != 0 {
            Self::Software
        } else if csr & PINRSTF != 0 {
            Self::Pin
        } else {
            Self::Unknown
        }
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
        let mut handoff = Self {
            magic: MAGIC,
            version: VERSION,
            length: size_of::<Self>() as u16,
            node_id: info.node_id,
            program: info.program,
            reset_cause: info.reset_cause as u8,
            trial: info.trial as u8,
            bit_rate: info.bit_rate,
            bootloader_version: info.bootloader_version,
            serial_number: info.serial_number,
            reserved: [0; 5],
            check: 0,
        };
        handoff.check = handoff.expected_check();
        handoff
    }

    /// What it tells, or `None` where no bootloader left a sound one (a debugger started the
    /// application, say).
    #[must_use]
    pub fn info(&self) -> Option<BootInfo> {
        let sound = self.magic == MAGIC
            && self.version >= VERSION
            && usize::from(self.length) == size_of::<Self>()
            && self.check == self.expected_check()
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

    const fn expected_check(&self) -> u32 {
        let [r0, r1, r2, r3, r4] = self.reserved;
        check_word(&[
            self.magic,
            self.version as u32 | (self.length as u32) << 16,
            u32::from_le_bytes([self.node_id, self.program, self.reset_cause, self.trial]),
            self.bit_rate,
            self.bootloader_version,
            self.serial_number,
            r0,
            r1,
            r2,
            r3,
            r4,
        ])
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
