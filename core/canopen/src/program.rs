//! Program download: indices and values of CiA 302-3, for both sides, with the additions of the SYS
//! TEC bootloader (manual L-1112d_10, tables 1 to 3).

use core::fmt;
use core::num::NonZeroU8;

use crate::abort::AbortCode;
use crate::od::{Access, Address, DataType, Entry, Table};

/// Device type.
pub const DEVICE_TYPE: u16 = 0x1000;
/// Error register.
pub const ERROR_REGISTER: u16 = 0x1001;
/// Pre-defined error field.
pub const ERROR_FIELD: u16 = 0x1003;
/// Manufacturer device name.
pub const DEVICE_NAME: u16 = 0x1008;
/// Manufacturer hardware version.
pub const HARDWARE_VERSION: u16 = 0x1009;
/// Manufacturer software version.
pub const SOFTWARE_VERSION: u16 = 0x100A;
/// COB-ID of the emergency object.
pub const COB_ID_EMCY: u16 = 0x1014;
/// Producer heartbeat time, in milliseconds.
pub const HEARTBEAT_TIME: u16 = 0x1017;
/// Identity: 1 vendor-ID, 2 product code, 3 revision, 4 serial number.
pub const IDENTITY: u16 = 0x1018;
/// SDO server parameter of the second server.
pub const SECOND_SERVER: u16 = 0x1201;
/// Program data; the sub-index is the program's number.
pub const PROGRAM_DATA: u16 = 0x1F50;
/// Program control: takes a [`ProgramControl`].
pub const PROGRAM_CONTROL: u16 = 0x1F51;
/// Verify application software (CiA 302-3): date and time of a program.
pub const PROGRAM_DATE: u16 = 0x1F52;
/// Program software identification: the program's CRC.
pub const PROGRAM_ID: u16 = 0x1F56;
/// Flash status identification: gives a [`FlashStatus`].
pub const FLASH_STATUS: u16 = 0x1F57;

/// 1F52h: days since 1984-01-01, and milliseconds after midnight (UTC); zeros if they are not known. (In a
/// bootloader, of the installed program with the lowest number; in a program, its own.)
pub const DATE_ENTRIES: [Entry; 3] = [
    Entry::array(PROGRAM_DATE, "Verify application software", 2),
    Entry::sub(PROGRAM_DATE, 1, "Application software date", DataType::Unsigned32, Access::Ro),
    Entry::sub(PROGRAM_DATE, 2, "Application software time", DataType::Unsigned32, Access::Ro),
];

/// The names of 1F51h, 1F56h, 1F57h, 2004h and 2005h, and their elements. Bootloader and
/// application both have them, with an element for each program of the device, whichever program
/// runs (SYS TEC manual L-1112d_10, table 1 and 3.4.1).
pub const CONTROL_ARRAYS: [(&str, Entry); 5] = [
    (
        "Program control",
        // No default value, because a configuration tool might write it: a read returns a state,
        // but a write is a command.
        Entry::sub(PROGRAM_CONTROL, 1, "Program control of a program", DataType::Unsigned8, Access::Rw),
    ),
    (
        "Program software identification",
        Entry::sub(PROGRAM_ID, 1, "Identification of a program", DataType::Unsigned32, Access::Ro),
    ),
    (
        "Flash status identification",
        Entry::sub(FLASH_STATUS, 1, "Flash status of a program", DataType::Unsigned32, Access::Ro).default(0),
    ),
    (
        "Program region",
        Entry::sub(PROGRAM_REGION, 1, "Address and size of a program", DataType::Unsigned64, Access::Const),
    ),
    (
        "Program version",
        Entry::sub(PROGRAM_VERSION, 1, "Version of a program", DataType::Unsigned32, Access::Ro),
    ),
];

/// The sub-indices of the objects that have one for each program of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Numbers {
    /// The programs: 1 to this number.
    pub programs: u8,
    /// The number of the bootloader itself, if it can be renewed: it is higher.
    pub bootloader: Option<u8>,
}

impl Numbers {
    /// Of a device whose bootloader is not renewed.
    #[must_use]
    pub const fn of_programs(programs: u8) -> Self {
        Self { programs, bootloader: None }
    }

    /// The entries of an object with these sub-indices.
    #[must_use]
    pub const fn entries(self) -> usize {
        1 + self.programs as usize + self.bootloader.is_some() as usize
    }
}

/// The number of entries of [`CONTROL_ARRAYS`] on a device.
#[must_use]
pub const fn control_count(numbers: Numbers) -> usize {
    CONTROL_ARRAYS.len() * numbers.entries()
}

impl<const LEN: usize> Table<LEN> {
    /// Appends [`CONTROL_ARRAYS`], which have [`control_count`] entries.
    ///
    /// # Panics
    /// If the table has too few entries left.
    #[must_use]
    pub const fn with_program_control(mut self, numbers: Numbers) -> Self {
        let mut array = 0;
        while array < CONTROL_ARRAYS.len() {
            let (name, element) = CONTROL_ARRAYS[array];
            self = self.with_numbers(name, element, numbers);
            array += 1;
        }
        self
    }

    /// Appends an object with an element for each of these numbers, all like `element`; it has
    /// [`Numbers::entries`].
    ///
    /// # Panics
    /// If the table has too few entries left.
    #[must_use]
    pub const fn with_numbers(mut self, name: &'static str, element: Entry, numbers: Numbers) -> Self {
        let Numbers { programs, bootloader } = numbers;
        let index = element.at.index;
        let highest = match bootloader {
            Some(number) => number,
            None => programs,
        };
        self = self.with(&[Entry::array(index, name, highest)]);
        let mut sub = 1;
        while sub <= programs {
            self = self.with(&[Entry { at: Address::new(index, sub), ..element }]);
            sub += 1;
        }
        match bootloader {
            // The status of the bootloader without anything staged is not that of a program.
            Some(number) => {
                self.with(&[Entry { at: Address::new(index, number), ..element.without_default() }])
            }
            None => self,
        }
    }
}

/// The regions of the programs, an object of coboot: the sub-index is the program's number. The
/// lower 32 bits are the first address of its flash, the upper 32 bits its size in bytes.
pub const PROGRAM_REGION: u16 = 0x2004;

/// The versions of the stored programs, an object of coboot: the sub-index is the program's number.
/// The format is that of a control block: major in bits 0-7, minor in bits 8-15, release in bits
/// 16-31 (SYS TEC manual L-1112d_10, figure 13); 0 for a program without a version, or no program.
pub const PROGRAM_VERSION: u16 = 0x2005;

/// The download of a program that can go on after a cut, an object of coboot: the sub-index is the
/// program's number. The lower 32 bits are the CRC of its control block, the upper 32 bits the
/// address up to which its data have arrived; 0 if there is none.
pub const PROGRAM_PARTIAL: u16 = 0x2006;

/// The state of the device, an object of coboot.
pub const DEVICE_STATE: u16 = 0x2007;
/// In [`DEVICE_STATE`]: the program number of the bootloader itself, 0 if it cannot be renewed.
pub const STATE_BOOTLOADER: u8 = 1;
/// In [`DEVICE_STATE`]: why a power-on would leave the device in the bootloader now
/// (`shared_abi::boot_report::Reason`); [`STATE_STARTS`] if a program would start.
pub const STATE_REASON: u8 = 2;
/// The value of [`STATE_REASON`] if a program would start.
pub const STATE_STARTS: u8 = 0xFF;
/// In [`DEVICE_STATE`]: the reset by which the last program ended
/// (`shared_abi::handoff::ResetCause`).
pub const STATE_PROGRAM_RESET: u8 = 3;
/// In [`DEVICE_STATE`]: resets in a row by which a program ended and that nobody requested.
pub const STATE_CRASH_RESETS: u8 = 4;
/// In [`DEVICE_STATE`]: the [`ClockSource`]; 0 for a device without one.
pub const STATE_CLOCK: u8 = 5;
/// In [`DEVICE_STATE`]: the option bytes of the chip, as `FLASH_OPTCR` has them (RM0090 section 3.9.10);
/// 0 for a device without them.
pub const STATE_OPTION_BYTES: u8 = 6;
/// In [`DEVICE_STATE`]: the [`Supply`].
pub const STATE_SUPPLY: u8 = 7;
/// In [`DEVICE_STATE`]: the version of the running RAM image of the bootloader in the lower 32 bits, as
/// in 1018h/3; the version of the services of its resident part in the upper ones. Only with renewal.
pub const STATE_VERSIONS: u8 = 8;
/// In [`DEVICE_STATE`]: the state of a renewal of the bootloader (`shared_abi::renewal::Progress`). Only
/// with renewal.
pub const STATE_RENEWAL: u8 = 9;
/// In [`DEVICE_STATE`]: the [`ProgramStart`].
pub const STATE_PROGRAM_START: u8 = 10;
/// In [`DEVICE_STATE`]: why the device stayed in the bootloader at its last reset; the numbers are those of
/// [`STATE_REASON`].
pub const STATE_LAST_REASON: u8 = 11;
/// In [`DEVICE_STATE`]: the programs that are released for autostart, number 1 in bit 0.
pub const STATE_RELEASED: u8 = 12;

/// How the bootloader starts programs ([`STATE_PROGRAM_START`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProgramStart {
    /// The time in milliseconds within which a program must feed the independent watchdog, which the
    /// bootloader starts; 0 if it does not. Bits 0 to 15.
    pub watchdog_ms: u16,
    /// The programs that start by themselves after a reset, the preferred one first; 0 for none. Bits 16 to
    /// 23, and 24 to 31.
    pub by_itself: [u8; 2],
}

impl ProgramStart {
    /// Without a watchdog; no program starts by itself.
    pub const NONE: Self = Self { watchdog_ms: 0, by_itself: [0; 2] };
    /// In place of the preferred program, if the product decides at each start.
    pub const DECIDED: u8 = 0xFF;

    /// The word of the object.
    #[must_use]
    pub const fn to_word(self) -> u32 {
        let [first, second] = self.by_itself;
        let [low, high] = self.watchdog_ms.to_le_bytes();
        u32::from_le_bytes([low, high, first, second])
    }

    /// From the word of the object.
    #[must_use]
    pub const fn of_word(word: u32) -> Self {
        let [low, high, first, second] = word.to_le_bytes();
        Self { watchdog_ms: u16::from_le_bytes([low, high]), by_itself: [first, second] }
    }
}

/// The source of a device's clock ([`STATE_CLOCK`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ClockSource {
    /// The crystal of the board, or the clock that it gets from outside.
    Crystal = 1,
    /// The internal oscillator, because the crystal has failed.
    Internal = 2,
}

/// The supply of a device ([`STATE_SUPPLY`]), as far as its flash is concerned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Supply {
    /// The device does not watch it.
    Unknown = 0,
    /// It is good enough.
    Good = 1,
    /// It is too low to erase or program the flash.
    Low = 2,
}

/// The detail of [`FlashError::NoAccess`] in 1F57h: the [supply](Supply) is too low.
pub const SUPPLY_DETAIL: u8 = 1;

/// The entries of [`DEVICE_STATE`].
pub const STATE_ENTRIES: [Entry; 11] = [
    Entry::record(DEVICE_STATE, "Device state", STATE_RELEASED),
    Entry::sub(
        DEVICE_STATE,
        STATE_BOOTLOADER,
        "Program number of the bootloader",
        DataType::Unsigned8,
        Access::Const,
    ),
    Entry::sub(
        DEVICE_STATE,
        STATE_REASON,
        "Reason to stay in the bootloader",
        DataType::Unsigned8,
        Access::Ro,
    ),
    Entry::sub(
        DEVICE_STATE,
        STATE_PROGRAM_RESET,
        "Last reset of the program",
        DataType::Unsigned8,
        Access::Ro,
    ),
    Entry::sub(DEVICE_STATE, STATE_CRASH_RESETS, "Crash resets in a row", DataType::Unsigned8, Access::Ro),
    Entry::sub(DEVICE_STATE, STATE_CLOCK, "Source of the clock", DataType::Unsigned8, Access::Ro),
    Entry::sub(DEVICE_STATE, STATE_OPTION_BYTES, "Option bytes", DataType::Unsigned32, Access::Ro),
    Entry::sub(DEVICE_STATE, STATE_SUPPLY, "Supply", DataType::Unsigned8, Access::Ro),
    Entry::sub(DEVICE_STATE, STATE_PROGRAM_START, "Start of programs", DataType::Unsigned32, Access::Const),
    Entry::sub(DEVICE_STATE, STATE_LAST_REASON, "Reason of the last stay", DataType::Unsigned8, Access::Ro),
    Entry::sub(DEVICE_STATE, STATE_RELEASED, "Released programs", DataType::Unsigned32, Access::Ro),
];

/// The entries of [`DEVICE_STATE`] in an application.
pub const APPLICATION_STATE_ENTRIES: [Entry; 2] =
    [Entry::record(DEVICE_STATE, "Device state", STATE_BOOTLOADER), STATE_ENTRIES[1]];

/// The further entries of [`DEVICE_STATE`] of a device whose bootloader can be renewed.
pub const RENEWAL_ENTRIES: [Entry; 2] = [
    Entry::sub(
        DEVICE_STATE,
        STATE_VERSIONS,
        "Versions of the bootloader",
        DataType::Unsigned64,
        Access::Const,
    ),
    Entry::sub(DEVICE_STATE, STATE_RENEWAL, "State of a renewal", DataType::Unsigned32, Access::Ro),
];

/// The command that starts the loader in the ROM of the chip, an object of coboot: it takes
/// [`ROM_LOADER_SIGNATURE`] alone.
pub const ROM_LOADER: u16 = 0x2008;
/// The value that [`ROM_LOADER`] takes: "roml" read as little-endian bytes. A signature, as 1010h and 1011h have one,
/// so that a client that writes every object does not start the loader.
pub const ROM_LOADER_SIGNATURE: u32 = u32::from_le_bytes(*b"roml");
/// The object's entry in the bootloader of a product with this command.
pub const ROM_LOADER_ENTRIES: [Entry; 1] =
    [Entry::var(ROM_LOADER, "Start of the ROM loader", DataType::Unsigned32, Access::Wo)];

/// The value of [`PROGRAM_REGION`] for a program with flash from `base` on and a size of `size`
/// bytes.
#[must_use]
pub const fn region_value(base: u32, size: u32) -> [u8; 8] {
    ((size as u64) << 32 | base as u64).to_le_bytes()
}

/// First address and size of a program's flash, from the value of [`PROGRAM_REGION`].
#[must_use]
pub const fn region_of(value: [u8; 8]) -> (u32, u32) {
    let value = u64::from_le_bytes(value);
    (value as u32, (value >> 32) as u32)
}

/// Password of a lift device (CiA 417; CiA 814-1 clause 6.3): sub-index [`UNLOCK_FIRMWARE`] of
/// "Lock/unlock parameters".
pub const UNLOCK: u16 = 0x6005;
/// "Firmware update". CiA 814-1 names object and purpose but no sub-index; this one is coboot's.
pub const UNLOCK_FIRMWARE: u8 = 1;
/// The object's entries in the bootloader and the application of a lift device.
pub const UNLOCK_ENTRIES: [Entry; 2] = [
    Entry::record(UNLOCK, "Lock/unlock parameters", UNLOCK_FIRMWARE),
    Entry::sub(UNLOCK, UNLOCK_FIRMWARE, "Firmware update", DataType::VisibleString, Access::Wo),
];
/// Access to a sealed device, an object of coboot (docs/security.md).
pub const ACCESS: u16 = 0x2002;
/// The event log of a sealed device, an object of coboot: the last eight events.
pub const EVENTS: u16 = 0x2003;
/// The entries of both objects in a sealed device.
pub const SEALED_ENTRIES: [Entry; 13] = [
    Entry::record(ACCESS, "Access", 3),
    Entry::sub(ACCESS, 1, "Unique ID, nonce, rights", DataType::OctetString, Access::Ro),
    Entry::sub(ACCESS, 2, "Request and signature", DataType::OctetString, Access::Wo),
    Entry::sub(ACCESS, 3, "Roots, epoch, counters", DataType::OctetString, Access::Ro),
    Entry::array(EVENTS, "Events", 8),
    Entry::sub(EVENTS, 1, "Event 1", DataType::OctetString, Access::Ro),
    Entry::sub(EVENTS, 2, "Event 2", DataType::OctetString, Access::Ro),
    Entry::sub(EVENTS, 3, "Event 3", DataType::OctetString, Access::Ro),
    Entry::sub(EVENTS, 4, "Event 4", DataType::OctetString, Access::Ro),
    Entry::sub(EVENTS, 5, "Event 5", DataType::OctetString, Access::Ro),
    Entry::sub(EVENTS, 6, "Event 6", DataType::OctetString, Access::Ro),
    Entry::sub(EVENTS, 7, "Event 7", DataType::OctetString, Access::Ro),
    Entry::sub(EVENTS, 8, "Event 8", DataType::OctetString, Access::Ro),
];

/// Enable flash programming (ESAcademy): the password of a program; the sub-index is the program's
/// number.
pub const ENABLE_FLASH: u16 = 0x7F50;

/// 1000h of the bootloader. An application has another value, so a host can distinguish them.
pub const BOOTLOADER_DEVICE_TYPE: u32 = 0x1000_0000;

/// 1000h of a boot loader as ESAcademy describes it ("BOOT"), and of older lift bootloaders.
pub const ESACADEMY_DEVICE_TYPE: u32 = 0x424F_4F54;
/// 1000h of a lift bootloader (CiA 814-1 clause 6.3).
pub const LIFT_DEVICE_TYPE: u32 = 0xFE00_01A1;
/// The node-ID of a lift bootloader (CiA 814-1 clause 5).
pub const LIFT_NODE_ID: u8 = 126;
/// The default node-ID of a boot loader as ESAcademy describes it.
pub const ESACADEMY_NODE_ID: u8 = 64;

/// A command, written to 1F51h.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ProgramControl {
    /// Stop the program. The bootloader acknowledges it and does nothing.
    Stop = 0x00,
    /// Start the program.
    Start = 0x01,
    /// Set the flash status to "no error".
    ResetStat = 0x02,
    /// Erase the program.
    Clear = 0x03,
    /// Return from the application to the bootloader.
    StartBootloader = 0x80,
    /// Mark the program as valid, so that it starts by itself.
    SetSignature = 0x83,
    /// Mark the program as not valid.
    ClrSignature = 0x84,
}

/// The error is the abort for such a value: 06090030h.
impl TryFrom<u8> for ProgramControl {
    type Error = AbortCode;

    fn try_from(value: u8) -> Result<Self, AbortCode> {
        match value {
            0x00 => Ok(Self::Stop),
            0x01 => Ok(Self::Start),
            0x02 => Ok(Self::ResetStat),
            0x03 => Ok(Self::Clear),
            0x80 => Ok(Self::StartBootloader),
            0x83 => Ok(Self::SetSignature),
            0x84 => Ok(Self::ClrSignature),
            _ => Err(AbortCode::INVALID_VALUE),
        }
    }
}

/// The state of a program, read from 1F51h (CiA 302-3).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ProgramState {
    /// It does not run: this is the bootloader.
    Stopped = 0,
    /// It runs: this is the application.
    Running = 1,
    /// There is no program.
    Absent = 3,
}

/// The word of 1F57h.
///
/// Bit 0 busy, bits 1–7 error code, bits 8–15 reserved, bits 16–31 detail of the manufacturer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FlashStatus {
    /// A command is being carried out.
    pub busy: bool,
    /// The result of the last command; `None` if it succeeded.
    pub error: Option<FlashError>,
    /// More about the error, for the manufacturer.
    pub detail: u16,
}

impl FlashStatus {
    /// No command runs, and the last one succeeded.
    pub const OK: Self = Self { busy: false, error: None, detail: 0 };
    /// A command is being carried out.
    pub const BUSY: Self = Self { busy: true, error: None, detail: 0 };

    /// The last command ended with this error.
    #[must_use]
    pub const fn failed(error: FlashError, detail: u16) -> Self {
        Self { busy: false, error: Some(error), detail }
    }

    /// Parses the word of 1F57h.
    #[must_use]
    pub const fn from_word(word: u32) -> Self {
        let error = FlashError::from_code(word as u8);
        Self { busy: word & 1 != 0, error, detail: (word >> 16) as u16 }
    }

    /// The word of 1F57h.
    #[must_use]
    pub const fn to_word(self) -> u32 {
        let code = match self.error {
            Some(error) => error.code(),
            None => 0,
        };
        (self.detail as u32) << 16 | code as u32 | self.busy as u32
    }
}

/// Why a command to the bootloader failed: the error code of 1F57h at its position in the word, so
/// bit 0 is clear. A device may have codes that the manual does not define.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct FlashError(NonZeroU8);

impl FlashError {
    /// The error with the code in the lowest byte of the word; bit 0 is ignored. `None` for no
    /// error.
    #[must_use]
    pub const fn from_code(byte: u8) -> Option<Self> {
        match NonZeroU8::new(byte & 0xFE) {
            Some(code) => Some(Self(code)),
            None => None,
        }
    }

    /// The error code at its position in the word: 2 to FEh, bit 0 is clear.
    #[must_use]
    pub const fn code(self) -> u8 {
        self.0.get()
    }
}

/// Names and words of the manual's codes, from one list.
macro_rules! flash_errors {
    ($($name:ident = $code:literal, $doc:literal, $words:literal;)*) => {
        /// The codes of the manual, table 3; from 8Ah on those of sealed images.
        #[allow(non_upper_case_globals, reason = "they are used as the variants of an open enum")]
        impl FlashError {
            $(#[doc = $doc] pub const $name: Self = Self(NonZeroU8::new($code).unwrap());)*
        }

        impl fmt::Debug for FlashError {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self.code() {
                    $($code => f.write_str(stringify!($name)),)*
                    code => write!(f, "FlashError({code:02X}h)"),
                }
            }
        }

        impl fmt::Display for FlashError {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self.code() {
                    $($code => f.write_str($words),)*
                    code => write!(f, "unknown flash error {code:02X}h"),
                }
            }
        }
    };
}

flash_errors! {
    NoValidProgram = 0x02, "There is no valid program to start.",
        "there is no valid program to start";
    Format = 0x04, "The data written to 1F50h are not in the expected form.",
        "the data are not in the expected form";
    Crc = 0x06, "The CRC of the data is wrong.",
        "the CRC is wrong";
    NotCleared = 0x08, "The program's flash is not erased.",
        "the program has to be cleared first";
    Write = 0x0A, "The flash could not be written.",
        "the flash could not be written";
    Address = 0x0C, "An address outside the program's flash.",
        "an address lies outside the program's flash";
    Secured = 0x0E, "A protected part of the flash.",
        "this part of the flash is protected";
    NvData = 0x10, "The non-volatile parameters could not be read or written.",
        "the non-volatile parameters could not be read or written";
    Unspecified = 0x7E, "None of the others.",
        "unspecified error";
    WrongVendorId = 0x80, "The program is for another vendor's devices.",
        "the program is for another vendor's devices";
    WrongProductId = 0x82, "The program is for another product.",
        "the program is for another product";
    NoAccess = 0x84, "Programming is not allowed, or not at present.",
        "programming is not allowed at present";
    Busy = 0x86, "Data were written while a command was still being carried out.",
        "a command is still being carried out";
    Sequence = 0x88, "The blocks came in a wrong order.",
        "the blocks came in a wrong order";
    Signature = 0x8A, "A sealed image whose signature, certificate, chain or hash is wrong.",
        "the program's signature is wrong";
    Rollback = 0x8C, "A sealed image whose security counter or epoch is lower than the device's.",
        "its counter or the epoch of its key is too low for the device";
    Key = 0x8E, "A sealed image for which the device has no key.",
        "the device has no key for this program";
}

impl core::error::Error for FlashError {}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::format;

    /// Table 3 of the manual, copied.
    #[test]
    fn the_words_of_1f57_are_those_of_the_manual() {
        use FlashError as E;
        let table = [
            (0x0000_0002, E::NoValidProgram),
            (0x0000_0004, E::Format),
            (0x0000_0006, E::Crc),
            (0x0000_0008, E::NotCleared),
            (0x0000_000A, E::Write),
            (0x0000_000C, E::Address),
            (0x0000_000E, E::Secured),
            (0x0000_0010, E::NvData),
            (0x0000_007E, E::Unspecified),
            (0x0000_0080, E::WrongVendorId),
            (0x0000_0082, E::WrongProductId),
            (0x0000_0084, E::NoAccess),
            (0x0000_0086, E::Busy),
            (0x0000_0088, E::Sequence),
        ];
        for (word, error) in table {
            assert_eq!(FlashStatus::failed(error, 0).to_word(), word);
            assert_eq!(FlashStatus::from_word(word), FlashStatus::failed(error, 0));
        }
        assert_eq!((FlashStatus::OK.to_word(), FlashStatus::BUSY.to_word()), (0, 1));
        assert_eq!(FlashStatus::from_word(0), FlashStatus::OK);
        assert_eq!(FlashStatus::from_word(1), FlashStatus::BUSY);
    }

    #[test]
    fn detail_busy_and_foreign_codes_survive() {
        let status = FlashStatus::from_word(0x1234_0021);
        assert_eq!(status, FlashStatus { busy: true, error: FlashError::from_code(0x20), detail: 0x1234 });
        assert_eq!(status.error.unwrap().code(), 0x20);
        assert_eq!(format!("{}", status.error.unwrap()), "unknown flash error 20h");
        assert_eq!(status.to_word(), 0x1234_0021);
    }

    /// Table 2 of the manual, copied.
    #[test]
    fn program_control_knows_the_commands_of_the_manual_alone() {
        use ProgramControl as P;
        let table = [
            (0x00, P::Stop),
            (0x01, P::Start),
            (0x02, P::ResetStat),
            (0x03, P::Clear),
            (0x80, P::StartBootloader),
            (0x83, P::SetSignature),
            (0x84, P::ClrSignature),
        ];
        for value in 0..=u8::MAX {
            let known = table.iter().find(|(code, _)| *code == value).map(|(_, command)| *command);
            assert_eq!(P::try_from(value).ok(), known, "{value:02X}h");
        }
        assert_eq!(P::try_from(4), Err(AbortCode(0x0609_0030)));
    }
}
