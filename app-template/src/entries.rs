//! The table of the application's object dictionary. It needs nothing of the chip, so that the EDS file can be made from it
//! on the host.

use canopen::device;
use canopen::emcy;
use canopen::od::{concat, Access, DataType, Entry};
use canopen::program::{FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_ID};

/// What coboot needs of an application: keep these when you add your own.
const PROGRAM_ENTRIES: [Entry; 6] = [
    Entry::array(PROGRAM_CONTROL, "Program control", 1),
    Entry::sub(PROGRAM_CONTROL, 1, "Program control 1", DataType::Unsigned8, Access::Rw).default(1),
    Entry::array(PROGRAM_ID, "Program software identification", 1),
    Entry::sub(PROGRAM_ID, 1, "Program software identification 1", DataType::Unsigned32, Access::Ro),
    Entry::array(FLASH_STATUS, "Flash status identification", 1),
    Entry::sub(FLASH_STATUS, 1, "Flash status identification 1", DataType::Unsigned32, Access::Ro).default(0),
];

/// The object dictionary.
pub static ENTRIES: [Entry; 23] =
    concat(concat::<11, 6, 17>(device::ENTRIES, emcy::ENTRIES), PROGRAM_ENTRIES);
