//! Drivers of others' own, as the pages show them, and the demonstration that proves one.

mod demonstration;
mod download;
mod files;
mod serial_flash;
