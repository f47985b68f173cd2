//! The table of the application's object dictionary. It uses nothing of the chip, so that the EDS
//! file can be generated from it on the host.

use canopen::device;
use canopen::emcy;
use canopen::od::{Access, DataType, Entry, Table};
use canopen::pdo::{self, Preset, EVENT_DRIVEN};
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

/// The objects of the process: `process.rs` has their values, and PDOs may carry each of them.
pub const PROCESS: [Entry; 4] = [
    Entry::var(COMMAND, "Command", DataType::Unsigned8, Access::Rw).default(0),
    Entry::var(SETPOINT, "Setpoint", DataType::Unsigned16, Access::Rw).default(0),
    Entry::var(STATE, "State", DataType::Unsigned8, Access::Ro).default(0),
    Entry::var(ACTUAL_VALUE, "Actual value", DataType::Unsigned16, Access::Ro).default(0),
];

/// The RPDOs, the first one on 200h + node-ID: add yours. A master may change them until the next reset.
pub static RECEIVE: [Preset; 1] = [Preset {
    transmission: EVENT_DRIVEN,
    inhibit: 0,
    event_ms: 0,
    mapping: &[of_process(COMMAND), of_process(SETPOINT)],
}];

/// The TPDOs, the first one on 180h + node-ID: sent when a value has changed, after 10 ms at the earliest.
pub static TRANSMIT: [Preset; 1] = [Preset {
    transmission: EVENT_DRIVEN,
    inhibit: 100,
    event_ms: 0,
    mapping: &[of_process(STATE), of_process(ACTUAL_VALUE)],
}];

/// The entry of this object.
const fn of_process(index: u16) -> Entry {
    let mut n = 0;
    while PROCESS[n].at.index != index {
        n += 1;
    }
    PROCESS[n]
}

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
        + pdo::entry_count(&RECEIVE, &TRANSMIT)
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
        .with_pdos(&RECEIVE, &TRANSMIT)
        .with(&PROCESS)
}
