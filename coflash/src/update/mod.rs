//! The update of devices: the procedure with its events, what each dialect makes of it, its single
//! steps, and the same for many devices at once.

pub mod config;
mod course;
pub mod dialect;
mod event;
mod flash;
pub mod job;
mod judge;
pub mod many;
mod options;
mod password;
mod reach;
pub mod steps;
mod toml_line;
mod trial;

pub use self::event::{DeviceState, Event, RepeatReason};
pub use self::flash::{flash, Report};
pub use self::many::{flash_in_turn, flash_many, ManyOptions};
pub use self::options::{FlashOptions, Target};
pub use self::password::Password;
