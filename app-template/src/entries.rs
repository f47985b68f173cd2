//! The table of the application's object dictionary. It needs nothing of the chip, so that the EDS
//! file can be made from it on the host.

use canopen::device;
use canopen::emcy;
use canopen::od::{concat, Access, DataType, Entry};
use canopen::program::{FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_ID, UNLOCK, UNLOCK_FIRMWARE};

/// What coboot needs of an application: keep these when you add your own.
const PROGRAM_ENTRIES: [Entry; 6] = [
    Entry::array(PROGRAM_CONTROL, "Program control", 1),
    Entry::sub(PROGRAM_CONTROL, 1, "Program control 1", DataType::Unsigned8, Access::Rw).default(1),
    Entry::array(PROGRAM_ID, "Program software identification", 1),
    Entry::sub(PROGRAM_ID, 1, "Program software identification 1", DataType::Unsigned32, Access::Ro),
    Entry::array(FLASH_STATUS, "Flash status identification", 1),
    Entry::sub(FLASH_STATUS, 1, "Flash status identification 1", DataType::Unsigned32, Access::Ro).default(0),
];

/// How 1F51h = 80h leads back into the bootloader: 0 system reset, 1 watchdog reset, 2 jump.
pub const REENTRY_PATH: u16 = 0x2000;
/// What the bootloader knows of this program: bit 0 installed, bit 1 signed. Writing with bit 1 set
/// confirms it, without takes the signature away.
pub const CONFIRMATION: u16 = 0x2001;

/// What shows the rest of coboot's services. A product has its own use for them.
const SHOW_ENTRIES: [Entry; 2] = [
    Entry::var(REENTRY_PATH, "Re-entry path into the bootloader", DataType::Unsigned8, Access::Rw).default(0),
    Entry::var(CONFIRMATION, "Confirmation", DataType::Unsigned8, Access::Rw),
];

/// The object dictionary.
pub static ENTRIES: [Entry; 25] = COMMON;

/// The object dictionary of a lift device: with a password.
pub static LIFT_ENTRIES: [Entry; 27] = concat(
    COMMON,
    [
        Entry::record(UNLOCK, "Lock/unlock parameters", UNLOCK_FIRMWARE),
        Entry::sub(UNLOCK, UNLOCK_FIRMWARE, "Firmware update", DataType::VisibleString, Access::Wo),
    ],
);

const COMMON: [Entry; 25] = concat(
    concat::<17, 6, 23>(concat::<11, 6, 17>(device::ENTRIES, emcy::ENTRIES), PROGRAM_ENTRIES),
    SHOW_ENTRIES,
);
