//! What the built firmware does, on the emulated chip.

mod abi;
mod application;
mod boot_time;
mod bus;
mod c_application;
mod contention;
mod crystal;
mod debugger;
mod device;
mod handover;
mod hostile_bus;
mod image;
mod leftovers;
mod line;
mod log;
mod mute;
mod options;
mod program_control;
mod reentry;
mod silicon;
mod slcan;
mod standby;
mod supply;
mod uart;
mod virtual_can;
mod watchdog;
