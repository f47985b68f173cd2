//! What a URL leads to: a CAN bus, or a gateway to one.

use std::fmt;

use canopen::NodeId;

use crate::adapter::{self, Adapter, AdapterError};
use crate::gateway::{self, Gateway};
use crate::session::{Session, Timing};

/// A way to devices. What needs frames takes the bus, what needs objects a
/// [`session`](Self::session).
pub enum Link {
    /// A CAN bus.
    Bus(Box<dyn Adapter>),
    /// A gateway, which carries SDO alone.
    Gateway(Box<dyn Gateway>),
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
    /// Opens what a URL names ([`adapter::URLS`]), at this bit rate (in bit/s) if the URL names none
    /// and it is an adapter that sets it.
    ///
    /// # Errors
    /// The URL is no good, or what it names does not open.
    pub fn open(url: &str, bit_rate: Option<u32>) -> Result<Self, AdapterError> {
        match gateway::open(url) {
            Some(gateway) => gateway.map(Self::Gateway),
            None => adapter::open_at(url, bit_rate).map(Self::Bus),
        }
    }

    /// A conversation with a node. Nothing is sent yet.
    pub fn session(&mut self, node: NodeId, timing: Timing) -> Session<'_> {
        match self {
            Self::Bus(adapter) => Session::new(&mut **adapter, node, timing),
            Self::Gateway(gateway) => Session::through(&mut **gateway, node, timing),
        }
    }
}
