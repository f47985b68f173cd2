//! Devices on the bus: conversations by SDO, information about devices, node-ID and bit rate by
//! LSS, and errors.

pub mod access;
pub mod debugger;
pub mod delivery;
mod device_type;
pub mod diagnose;
mod dialect;
mod doing;
pub mod eds;
pub mod error;
pub mod flying_master;
pub mod info;
pub mod legacy;
mod listen;
pub mod lock;
pub mod lss;
pub mod option_bytes;
pub mod partial_download;
pub mod read_state;
pub(crate) mod recognise;
pub mod region;
pub mod renewal;
pub mod scan;
pub mod session;
pub mod state;
mod timing;
pub mod value;

pub use self::delivery::{delivery, Delivery};
pub use self::device_type::DeviceType;
pub use self::dialect::{Dialect, Form};
pub use self::doing::{Doing, LssDoing};
pub use self::error::Error;
pub use self::info::{info, DeviceInfo};
pub use self::listen::listen;
pub use self::recognise::recognise;
pub use self::scan::{scan, ScanOptions};
pub use self::session::Session;
pub use self::timing::{Timing, Transfers};
