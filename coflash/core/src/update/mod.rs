//! The update of devices: the procedure with its events, its dialects, its single steps, and the
//! update of many devices at once.

mod admission;
mod aftermath;
mod catch;
mod comparison;
pub mod config;
mod content;
mod device_after;
pub mod dialect;
mod entry;
pub mod event;
mod flash;
mod history;
pub mod job;
mod judge;
pub mod many;
mod new_bootloader;
mod options;
mod password;
mod phase;
mod reach;
mod reading;
pub mod renew;
mod renewal;
mod report;
mod retry;
mod running;
pub mod steps;
mod toml_line;
mod trial;
mod watch;

pub use self::catch::{catch, CatchOptions, Caught};
pub use self::comparison::{compare_sealed, Comparison, Difference, Part};
pub use self::content::{refusal_number, Payload};
pub use self::device_after::{DeviceAfterUpdate, DeviceAnswer, DeviceState, Seen};
pub use self::event::{Event, Report};
pub use self::flash::{flash, flash_program, flash_sealed};
pub use self::history::{stamp, FailedUpdate, Histories};
pub use self::many::{flash_in_turn, flash_many, ManyOptions};
pub use self::new_bootloader::NewBootloader;
pub use self::options::{FlashOptions, JOINED_BLOCKS};
pub use self::password::Password;
pub use self::reading::{ContentFault, Judging, Loaded, Reading};
pub use self::renew::renew;
pub use self::renewal::Renewal;
pub(crate) use self::toml_line::line_of;
