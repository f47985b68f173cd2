//! What a URL leads to: a CAN bus, or a gateway to one.

use std::fmt;

use super::adapter::{Adapter, AdapterError};
use super::gateway::Gateway;
use super::{cia309, open};

/// A way to devices. What needs frames takes the bus, what needs objects a
/// [`Session`](crate::Session::on).
pub enum Link {
    /// A CAN bus.
    Bus(Box<dyn Adapter + Send>),
    /// A gateway, which carries SDO alone.
    Gateway(Box<dyn Gateway + Send>),
}

impl fmt::Debug for Link {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bus(_) => "Bus(…)",
            Self::Gateway(_) => "Gateway(…)",
        })
    }
}

impl Link {
    /// Opens what a URL names ([`URLS`](super::URLS)), at this bit rate (in bit/s) if the URL names none
    /// and it is an adapter that sets it.
    ///
    /// # Errors
    /// The URL is no good, or what it names does not open.
    pub fn open(url: &str, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        match url.strip_prefix("cia309:") {
            Some(rest) => Ok(Self::Gateway(Box::new(cia309::open(url, rest)?))),
            None => open::open_at(url, bit_rate).map(Self::Bus),
        }
    }
}
