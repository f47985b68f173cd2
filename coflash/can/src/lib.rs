//! Ways to a CAN bus, chosen by URL, and the formats of frames.
//!
//! This crate handles frames. Their meaning for a device is the subject of the crate that uses it.
#![forbid(unsafe_code)]

pub mod adapter;
mod beacons;
pub mod candump;
pub mod cia309;
pub mod decode;
mod digits;
#[cfg(any(feature = "peak", feature = "kvaser", feature = "gs_usb"))]
mod driven;
mod drivers;
pub mod echo;
mod found;
pub mod gateway;
#[cfg(feature = "gs_usb")]
mod gs_usb;
pub mod health;
pub mod hub;
mod in_time;
#[cfg(feature = "kvaser")]
mod kvaser;
mod link;
#[cfg(target_os = "linux")]
mod links;
mod list;
mod open;
#[cfg(feature = "peak")]
mod peak;
mod ports;
pub mod redact;
mod sdo_ids;
pub mod slcan;
#[cfg(target_os = "linux")]
mod socketcan;
pub mod socketcand;
mod tap;
mod target;
mod tcp;
mod trace;

pub use self::adapter::{Adapter, AdapterError, Obstacle, URLS};
pub use self::cia309::Cia309;
pub use self::found::{Found, Kind, Missing, State};
pub use self::gateway::{Gateway, GatewayError};
pub use self::health::{Health, Losses};
pub use self::link::Link;
pub use self::list::{list, List};
pub use self::open::{bit_rate_of, check, open, open_at};
pub use self::sdo_ids::SdoIds;
pub use self::slcan::{Line, Slcan};
#[cfg(target_os = "linux")]
pub use self::socketcan::SocketCan;
pub use self::socketcand::Socketcand;
pub use self::tap::{wall, Ear, Tap};
pub use self::trace::{trace, OnFailure};

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(test)]
mod tests {
    use canopen::{CobId, Frame};

    use super::*;

    /// A data frame of the tests.
    pub(super) fn frame(id: u16, data: &[u8]) -> Frame {
        Frame::of(CobId::new(id).unwrap(), data)
    }

    /// A link can be opened in one thread and used in another. This test only has to compile.
    #[test]
    fn whatever_leads_to_a_bus_can_move_to_a_thread() {
        fn moves<T: Send + 'static>() {}
        moves::<Link>();
        moves::<Box<dyn Adapter + Send>>();
        moves::<Box<dyn Gateway + Send>>();
        moves::<Slcan<std::net::TcpStream>>();
        moves::<Slcan<Box<dyn serialport::SerialPort>>>();
        moves::<Socketcand>();
        #[cfg(target_os = "linux")]
        moves::<SocketCan>();
        moves::<Cia309>();
        moves::<SdoIds<Box<dyn Adapter + Send>>>();
        moves::<Tap<Box<dyn Adapter + Send>>>();
        moves::<hub::Port>();
    }
}
