//! The update of devices: the procedure with its events, its dialects, its single steps, and the
//! update of many devices at once.

mod admission;
mod aftermath;
mod catch;
pub mod config;
mod content;
mod course;
pub mod dialect;
pub mod event;
mod flash;
mod held;
pub mod job;
mod judge;
mod left;
pub mod many;
mod options;
mod password;
mod phase;
mod reach;
mod report;
mod retry;
pub mod steps;
mod toml_line;
mod trial;

pub use self::catch::{catch, CatchOptions, Caught};
pub use self::content::{refusal_number, Program};
pub use self::event::{Event, Report};
pub use self::flash::{flash, flash_program, flash_sealed};
pub use self::held::{held, Difference, Held, Part};
pub use self::left::{DeviceState, Left, Look, Seen};
pub use self::many::{flash_in_turn, flash_many, ManyOptions};
pub use self::options::{FlashOptions, Target, GROUP_BLOCKS};
pub use self::password::Password;
