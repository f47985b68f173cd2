//! What the built firmware does, on the emulated chip.

mod abi;
mod application;
mod boot_time;
mod bus;
mod c_application;
mod contention;
mod crystal;
#[cfg(split_map)]
mod debugger;
mod device;
#[cfg(split_map)]
mod eeprom;
mod factory;
mod handover;
mod hostile_bus;
mod image;
mod leftovers;
mod line;
#[cfg(split_map)]
mod log;
mod mute;
mod nameplate;
mod options;
mod program_control;
mod reentry;
#[cfg(staging)]
mod renewal;
mod silicon;
mod slcan;
#[cfg(split_map)]
mod software_date;
mod stack;
mod standby;
mod stuck_bus;
mod supply;
mod uart;
#[cfg(split_map)]
mod virtual_can;
mod watchdog;
mod ways_in;
