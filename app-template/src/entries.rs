//! The table of the application's object dictionary. It uses nothing of the chip, so that the EDS
//! file can be generated from it on the host.

use canopen::device;
use canopen::emcy;
use canopen::od::{Access, DataType, Entry, Table};
use canopen::pdo::{self, Preset};
use canopen::program::{control_count, Numbers, APPLICATION_STATE_ENTRIES, DATE_ENTRIES};
use coboot_app::layout::Layout;
use coboot_app::renewal;

/// The machine moves (1), or stands (0).
pub const COMMAND: u16 = 0x2200;
/// How fast it is to move, in 1/min.
pub const SETPOINT: u16 = 0x2201;
/// What it does: see `process::MACHINE`.
pub const STATE: u16 = 0x2202;
/// How fast it moves, in 1/min.
pub const ACTUAL_VALUE: u16 = 0x2203;

/// The objects of the process, from 2200h on: `process.rs` has their values, and PDOs may carry
/// each of them.
pub const PROCESS: [Entry; 4] = [
    Entry::var(COMMAND, "Command", DataType::Unsigned8, Access::Rw).default(0),
    Entry::var(SETPOINT, "Setpoint", DataType::Unsigned16, Access::Rw).default(0),
    Entry::var(STATE, "State", DataType::Unsigned8, Access::Ro).default(0),
    Entry::var(ACTUAL_VALUE, "Actual value", DataType::Unsigned16, Access::Ro).default(0),
];

/// The PDOs: an RPDO on 200h + node-ID, and a TPDO on 180h + node-ID, sent when a value has
/// changed, 10 ms after the one before at the earliest.
#[rustfmt::skip]
pub static PDOS: [Preset; 2] = [
    Preset { index: 0x1400, transmission: 254, inhibit: 0, event_ms: 0, mapping: &[PROCESS[0], PROCESS[1]] },
    Preset { index: 0x1800, transmission: 254, inhibit: 100, event_ms: 0, mapping: &[PROCESS[2], PROCESS[3]] },
];

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
        + pdo::entry_count(&PDOS)
        + PROCESS.len()
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
        .with_pdos(&PDOS)
        .with(&PROCESS)
}
