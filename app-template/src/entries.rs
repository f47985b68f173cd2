//! The table of the application's object dictionary. It needs nothing of the chip, so that the EDS
//! file can be made from it on the host.

use canopen::device;
use canopen::emcy;
use canopen::od::{concat, Access, Address, DataType, Entry};
use canopen::program::{FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_ID, UNLOCK, UNLOCK_FIRMWARE};

/// What coboot needs of an application: keep these when you add your own. Each has an element for
/// each program of the device, whichever of them runs (SYS TEC manual L-1112d_10, 3.4.1).
const PROGRAM_OBJECTS: [(u16, &str, Entry); 3] = [
    (
        PROGRAM_CONTROL,
        "Program control",
        Entry::sub(PROGRAM_CONTROL, 1, "Program control of a program", DataType::Unsigned8, Access::Rw),
    ),
    (
        PROGRAM_ID,
        "Program software identification",
        Entry::sub(PROGRAM_ID, 1, "Identification of a program", DataType::Unsigned32, Access::Ro),
    ),
    (
        FLASH_STATUS,
        "Flash status identification",
        Entry::sub(FLASH_STATUS, 1, "Flash status of a program", DataType::Unsigned32, Access::Ro).default(0),
    ),
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

/// What a lift device has besides: a password.
pub const LIFT_ENTRIES: [Entry; 2] = [
    Entry::record(UNLOCK, "Lock/unlock parameters", UNLOCK_FIRMWARE),
    Entry::sub(UNLOCK, UNLOCK_FIRMWARE, "Firmware update", DataType::VisibleString, Access::Wo),
];

/// What does not depend on the programs.
const COMMON: [Entry; 19] = concat(concat::<11, 6, 17>(device::ENTRIES, emcy::ENTRIES), SHOW_ENTRIES);

/// How many entries the object dictionary of a device with `programs` programs has.
pub const fn entry_count(programs: u8) -> usize {
    COMMON.len() + PROGRAM_OBJECTS.len() * (1 + programs as usize)
}

/// The object dictionary of a device with `programs` programs, of [`entry_count`].
pub const fn entries<const LEN: usize>(programs: u8) -> [Entry; LEN] {
    let mut entries = [COMMON[0]; LEN];
    let mut len = 0;
    while len < COMMON.len() {
        entries[len] = COMMON[len];
        len += 1;
    }
    let mut object = 0;
    while object < PROGRAM_OBJECTS.len() {
        let (array, name, element) = PROGRAM_OBJECTS[object];
        entries[len] = Entry::array(array, name, programs);
        len += 1;
        let mut number = 1;
        while number <= programs {
            entries[len] = Entry { at: Address::new(array, number), ..element };
            len += 1;
            number += 1;
        }
        object += 1;
    }
    assert!(len == LEN, "entries: the length is not that of entry_count");
    entries
}
