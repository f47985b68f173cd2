//! The table of the application's object dictionary. It uses nothing of the chip, so that the EDS
//! file can be generated from it on the host.

use canopen::device;
use canopen::emcy;
use canopen::od::Table;
use canopen::program::{control_count, Numbers, APPLICATION_STATE_ENTRIES, DATE_ENTRIES};
use coboot_app::layout::Layout;
use coboot_app::renewal;

/// The sub-indices of program control on a device with this memory map: its programs, and the bootloader
/// itself where the map has room for a new one (docs/renewal.md).
pub const fn numbers(layout: &Layout) -> Numbers {
    let programs = layout.programs.len() as u8;
    let bootloader = if layout.staging.is_some() { Some(renewal::number(programs, None)) } else { None };
    Numbers { programs, bootloader }
}

/// How many entries the object dictionary has.
pub const fn entry_count(numbers: Numbers) -> usize {
    device::ENTRIES.len()
        + emcy::ENTRIES.len()
        + control_count(numbers)
        + APPLICATION_STATE_ENTRIES.len()
        + DATE_ENTRIES.len()
}

/// The object dictionary of a device with these [`numbers`], [`entry_count`] entries long. coboot
/// needs program control in an application: keep it when you add your own objects.
pub const fn entries<const LEN: usize>(numbers: Numbers) -> Table<LEN> {
    Table::EMPTY
        .with(&device::ENTRIES)
        .with(&emcy::ENTRIES)
        .with_program_control(numbers)
        .with(&APPLICATION_STATE_ENTRIES)
        .with(&DATE_ENTRIES)
}
