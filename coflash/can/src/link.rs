//! The target of a URL: a CAN bus, or a gateway to one.

use std::fmt;

use super::adapter::{Adapter, AdapterError};
use super::cia309::Cia309;
use super::gateway::Gateway;
use super::open;
use super::target::Target;

/// Access to devices. Commands that need frames use the bus; commands that need objects use a
/// `Session` of `coflash-core`.
pub enum Link {
    /// A CAN bus.
    Bus(Box<dyn Adapter + Send>),
    /// A gateway, which carries only SDO.
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
    /// Opens the target of a URL ([`URLS`](super::URLS)). `bit_rate` (in bit/s) applies if the URL
    /// contains none and the adapter sets the bit rate.
    ///
    /// # Errors
    /// The URL is invalid, or its target does not open.
    pub fn open(url: &str, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        match open::target(url)? {
            Target::Gateway { server, network } => {
                Ok(Self::Gateway(Box::new(Cia309::connect(&server, network)?)))
            }
            _ => open::open_at(url, bit_rate).map(Self::Bus),
        }
    }
}
