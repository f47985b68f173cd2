//! Drivers of others' own, as the pages show them, and the demonstration that proves one.

mod demonstration;
mod download;
mod eeprom;
mod files;
mod parameters;
mod serial_flash;
