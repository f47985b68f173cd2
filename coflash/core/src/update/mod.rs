//! The update of devices: the procedure with its events, its dialects, its single steps, and the
//! update of many devices at once.

mod admission;
mod aftermath;
mod catch;
mod comparison;
pub mod config;
mod device_after;
pub mod dialect;
mod entry;
pub mod event;
mod history;
mod judge;
pub mod many;
mod options;
mod password;
mod payload;
mod phase;
mod pipeline;
mod reach;
mod reading;
mod report;
mod retry;
mod running;
pub mod steps;
mod toml_line;
mod trial;
mod watch;

pub use self::catch::{catch, CatchOptions, Caught};
pub use self::comparison::{compare_sealed, Comparison, Difference, Part};
pub use self::device_after::{Answers, DeviceAfterUpdate, DeviceAnswer, DeviceState};
pub use self::event::{Event, Report};
pub use self::history::{stamp, FailedUpdate, Histories};
pub use self::many::{flash_in_turn, flash_many, ManyOptions};
pub use self::options::{FlashOptions, JOINED_BLOCKS};
pub use self::password::Password;
pub use self::payload::{refusal_number, Installed, Marks, Payload};
pub use self::pipeline::flash;
pub use self::reading::{ContentFault, Judging, Loaded, Reading};
pub use self::report::Renewal;
pub use self::running::Known;
pub(crate) use self::toml_line::{line_in, line_of};
