//! The handoff: a record in which the bootloader informs the application about the start of the
//! device.
//!
//! The bootloader writes it directly before the jump, at
//! [`Layout::handoff`](crate::layout::Layout::handoff), outside the RAM of the images. An
//! application reads it early and may read it again later.

use crate::check_word;

/// Identifies a handoff ("CBHO" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBHO");

/// The version of the record; a reader takes every one from [`OLDEST`] on.
///
/// | version | new fields |
/// |---|---|
/// | 1 | |
/// | 2 | [`Handoff::flags`] |
/// | 3 | [`Handoff::bootloader_number`] |
/// | 4 | [`Handoff::sdo_request_base`], [`Handoff::sdo_response_base`] |
/// | 5 | [`FLAG_NAMEPLATE`], [`Handoff::program_date`] |
pub const VERSION: u16 = 5;
/// The oldest version that a reader accepts.
pub const OLDEST: u16 = 1;

/// In [`Handoff::flags`]: [`BootInfo::fresh`].
pub const FLAG_FRESH: u32 = 1 << 0;
/// In [`Handoff::flags`]: [`BootInfo::nameplate`]. Since version 5.
pub const FLAG_NAMEPLATE: u32 = 1 << 1;

/// Why the chip left reset, from `RCC_CSR` and `PWR_CSR` (RM0090 sections 7.3.21 and 5.4.2).
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
    /// The chip woke up from Standby (`PWR_CSR.SBF`), by whatever.
    Standby = 8,
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
            8 => Self::Standby,
            _ => Self::Unknown,
        }
    }

    /// From the reset flags of `RCC_CSR` (RM0090 section 7.3.21), and whether the chip has woken up from
    /// Standby, after which these flags say nothing reliable.
    ///
    /// Every reset also pulls NRST low, and a power-on also sets the brown-out flag; the most
    /// specific flag determines the result.
    #[must_use]
    pub const fn from_flags(csr: u32, woke_up: bool) -> Self {
        /// The bits, the most specific one first. Bit 0 is free: it is no reset flag.
        const FLAGS: [(u8, ResetCause); 8] = [
            (0, ResetCause::Standby),
            (27, ResetCause::PowerOn),             // PORRSTF
            (25, ResetCause::BrownOut),            // BORRSTF
            (29, ResetCause::IndependentWatchdog), // IWDGRSTF
            (30, ResetCause::WindowWatchdog),      // WWDGRSTF
            (31, ResetCause::LowPower),            // LPWRRSTF
            (28, ResetCause::Software),            // SFTRSTF
            (26, ResetCause::Pin),                 // PINRSTF
        ];
        let flags = csr & !1 | woke_up as u32;
        let mut i = 0;
        while i < FLAGS.len() {
            let (bit, cause) = FLAGS[i];
            if flags >> bit & 1 != 0 {
                return cause;
            }
            i += 1;
        }
        Self::Unknown
    }
}

/// Information about the start of the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BootInfo {
    /// The active node-ID, 1 to 127.
    pub node_id: u8,
    /// Bit rate of the CAN bus in bit/s; 0 for a device that detects it by listening.
    pub bit_rate: u32,
    /// The program that was started, 1 to 254.
    pub program: u8,
    /// Why the chip left reset.
    pub reset_cause: ResetCause,
    /// The program is not released for autostart yet: after the next reset the device stays in the
    /// bootloader.
    pub trial: bool,
    /// The program was started directly after its download as a raw image, Intel HEX or a sealed
    /// image: the first 1F51h = 80h confirms it and does not call the bootloader.
    pub fresh: bool,
    /// Version of the bootloader as in 1018h/3: major in the upper half, minor in the lower.
    pub bootloader_version: u32,
    /// Serial number as in 1018h/4.
    pub serial_number: u32,
    /// The sub-index of the bootloader itself in 1F51h, 1F56h and 1F57h; `None` if it cannot be renewed
    /// over CAN.
    pub bootloader_number: Option<u8>,
    /// The bases of the COB-IDs of SDO.
    pub sdo: SdoBases,
    /// The creation date of the program, from its block 0 or its label, in seconds since 1970-01-01 UTC; 0 if
    /// unknown.
    pub program_date: u32,
    /// The identity of the device is that of its [`Nameplate`](crate::nameplate::Nameplate), and not that of
    /// its board.
    pub nameplate: bool,
}

/// The bases of the COB-IDs of SDO, to which the node-ID is added; 80h to 780h.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SdoBases {
    /// Of requests to the device.
    pub request: u16,
    /// Of its answers.
    pub response: u16,
}

impl SdoBases {
    /// Those of the predefined connection set (CiA 301 table 69).
    pub const PREDEFINED: Self = Self { request: 0x600, response: 0x580 };

    /// From the two words of the record.
    const fn of_record(request: u16, response: u16) -> Self {
        match (request, response) {
            (0x80..=0x780, 0x80..=0x780) => Self { request, response },
            _ => Self::PREDEFINED,
        }
    }

    const fn is_predefined(self) -> bool {
        self.request == Self::PREDEFINED.request && self.response == Self::PREDEFINED.response
    }
}

/// The handoff in RAM: 48 bytes, little-endian.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Handoff {
    /// [`MAGIC`].
    pub magic: u32,
    /// [`VERSION`] of the bootloader that wrote it.
    pub version: u16,
    /// Size of the whole record in bytes.
    pub length: u16,
    /// The active node-ID.
    pub node_id: u8,
    /// The program that was started.
    pub program: u8,
    /// A [`ResetCause`].
    pub reset_cause: u8,
    /// 1 for a trial, 0 otherwise.
    pub trial: u8,
    /// Bit rate in bit/s, 0 if it must be detected.
    pub bit_rate: u32,
    /// Version of the bootloader.
    pub bootloader_version: u32,
    /// Serial number of the device.
    pub serial_number: u32,
    /// [`FLAG_FRESH`] and [`FLAG_NAMEPLATE`]; the other bits are 0. Since version 2.
    pub flags: u32,
    /// The sub-index of the bootloader itself, 0 for none. Since version 3.
    pub bootloader_number: u32,
    /// The base of the COB-ID of SDO requests; 0 for those of the predefined connection set. Since version
    /// 4.
    pub sdo_request_base: u16,
    /// The base of the COB-ID of SDO answers, in the same way. Since version 4.
    pub sdo_response_base: u16,
    /// The creation date of the program in seconds since 1970-01-01 UTC, 0 if unknown. Since version 5.
    pub program_date: u32,
    /// 0; later versions may define this word.
    pub reserved: u32,
    /// [`check_word`] of the eleven words before.
    pub check: u32,
}

impl Handoff {
    /// The record with this information.
    #[must_use]
    pub const fn new(info: &BootInfo) -> Self {
        let mut words = [0; WORDS];
        words[0] = MAGIC;
        words[1] = VERSION as u32 | (size_of::<Self>() as u32) << 16;
        words[2] = u32::from_le_bytes([info.node_id, info.program, info.reset_cause as u8, info.trial as u8]);
        words[3] = info.bit_rate;
        words[4] = info.bootloader_version;
        words[5] = info.serial_number;
        words[6] = if info.fresh { FLAG_FRESH } else { 0 } | if info.nameplate { FLAG_NAMEPLATE } else { 0 };
        words[7] = match info.bootloader_number {
            Some(number) => number as u32,
            None => 0,
        };
        if !info.sdo.is_predefined() {
            words[8] = info.sdo.request as u32 | (info.sdo.response as u32) << 16;
        }
        words[9] = info.program_date;
        words[WORDS - 1] = check_of(&words);
        // SAFETY: both are 48 bytes, and every bit pattern is a valid `Handoff`.
        unsafe { core::mem::transmute(words) }
    }

    /// The information, or `None` if there is no valid record (for example because a debugger has
    /// started the application).
    #[must_use]
    pub fn info(&self) -> Option<BootInfo> {
        // SAFETY: both are 48 bytes, and every bit pattern is a valid array of words.
        let words = unsafe { core::mem::transmute::<Self, [u32; WORDS]>(*self) };
        let sound = is_sound(&words)
            && self.version >= OLDEST
            && usize::from(self.length) == size_of::<Self>()
            && matches!(self.node_id, 1..=127);
        sound.then_some(BootInfo {
            node_id: self.node_id,
            bit_rate: self.bit_rate,
            program: self.program,
            reset_cause: ResetCause::from_byte(self.reset_cause),
            trial: self.trial != 0,
            fresh: self.flags & FLAG_FRESH != 0,
            bootloader_version: self.bootloader_version,
            serial_number: self.serial_number,
            bootloader_number: u8::try_from(self.bootloader_number).ok().filter(|number| *number != 0),
            sdo: SdoBases::of_record(self.sdo_request_base, self.sdo_response_base),
            program_date: self.program_date,
            nameplate: self.flags & FLAG_NAMEPLATE != 0,
        })
    }

    /// Reads the handoff of the bootloader.
    ///
    /// # Safety
    /// `address` must be the layout's handoff region (word-aligned RAM of 48 bytes).
    #[must_use]
    pub unsafe fn read(address: *const Self) -> Option<BootInfo> {
        // SAFETY: the caller guarantees the address; every bit pattern is a valid `Handoff`, and
        // `info` checks it.
        unsafe { address.read_volatile() }.info()
    }

    /// The program number in the handoff, for the bootloader, which needs no other part of its own
    /// record; 0 if there is no valid record.
    ///
    /// # Safety
    /// As for [`read`](Self::read).
    #[must_use]
    pub unsafe fn read_program(address: *const Self) -> u8 {
        // SAFETY: the caller guarantees the address; nothing writes there during the read.
        let words = unsafe { &*address.cast::<[u32; WORDS]>() };
        if is_sound(words) {
            words[2].to_le_bytes()[1]
        } else {
            0
        }
    }

    /// Makes the record invalid: no program was started.
    ///
    /// # Safety
    /// As for [`write`](Self::write).
    pub unsafe fn erase(address: *mut Self) {
        // SAFETY: the caller guarantees the address. Without its magic a record is invalid.
        unsafe { address.cast::<u32>().write_volatile(0) };
    }

    /// Writes the handoff for the application.
    ///
    /// # Safety
    /// `address` must be the layout's handoff region (word-aligned RAM of 48 bytes that nothing
    /// else uses).
    pub unsafe fn write(self, address: *mut Self) {
        // SAFETY: the caller guarantees the address.
        unsafe { address.write_volatile(self) };
    }
}

/// Words of the record.
const WORDS: usize = size_of::<Handoff>() / 4;

/// The check word of a record: the fold of all words but the last.
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

    /// Flag positions from RM0090 section 7.3.21.
    #[test]
    fn the_most_telling_reset_flag_wins() {
        for (csr, cause) in [
            (0x0E00_0003, ResetCause::PowerOn),
            (0x0600_0000, ResetCause::BrownOut),
            (0x1400_0000, ResetCause::Software),
            (0x2400_0000, ResetCause::IndependentWatchdog),
            (0x4400_0000, ResetCause::WindowWatchdog),
            (0x8400_0000, ResetCause::LowPower),
            (0x0400_0000, ResetCause::Pin),
            (0, ResetCause::Unknown),
            // LSION and LSIRDY are no reset flags.
            (3, ResetCause::Unknown),
        ] {
            assert_eq!(ResetCause::from_flags(csr, false), cause, "{csr:08X}h");
            assert_eq!(ResetCause::from_flags(csr, true), ResetCause::Standby, "{csr:08X}h");
        }
    }
}
