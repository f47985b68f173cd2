//! Gateways: ways to devices whose CAN bus is somewhere else, at the level of SDO.
//!
//! A gateway is told "read this object of that node" and does the transfer on its bus by itself. So
//! there are no frames to see: what listens to the bus (scan, monitor, LSS) needs an
//! [`Adapter`](super::Adapter). What reads and writes objects, the update among it, works
//! over either, since a [`Session`](crate::Session) hides which of them it has.
//!
//! Another gateway is one file beside [`cia309`](super::cia309) and one line of
//! [`Link::open`](super::Link::open).

use std::time::Duration;

use canopen::{AbortCode, Address, NodeId};

use super::adapter::AdapterError;

/// Their URLs, for messages and help texts.
pub const URLS: &str = "cia309://HOST:PORT/NET";

/// A way to the object dictionaries of devices.
pub trait Gateway {
    /// Reads an object. `progress` is told how many bytes are here.
    ///
    /// # Errors
    /// See [`GatewayError`].
    fn upload(&mut self, ask: &Ask<'_>, progress: &mut dyn FnMut(u32)) -> Result<Vec<u8>, GatewayError>;

    /// Writes an object. `progress` is told how many bytes the gateway has taken.
    ///
    /// # Errors
    /// See [`GatewayError`].
    fn download(
        &mut self,
        ask: &Ask<'_>,
        data: &[u8],
        progress: &mut dyn FnMut(u32),
    ) -> Result<(), GatewayError>;

    /// Has a node reset by network management (NMT reset node).
    ///
    /// # Errors
    /// See [`GatewayError`].
    fn reset_node(&mut self, node: NodeId) -> Result<(), GatewayError>;

    /// Lets time pass; gives the node whose boot-up message the gateway tells of meanwhile. Many tell
    /// nothing.
    ///
    /// # Errors
    /// [`GatewayError::Adapter`].
    fn wait(&mut self, time: Duration) -> Result<Option<NodeId>, GatewayError>;

    /// The time since an origin of the gateway's choice.
    fn now(&self) -> Duration;
}

/// One object of one node, and how long to wait for it.
#[derive(Clone, Copy)]
pub struct Ask<'c> {
    /// The node.
    pub node: NodeId,
    /// The object.
    pub at: Address,
    /// How long the node may take for an answer, as the gateway counts it on its bus.
    pub sdo: Duration,
    /// How long the gateway may say nothing, or take nothing, until it is given up.
    pub patience: Duration,
    /// Whether the user has given up.
    pub cancelled: &'c dyn Fn() -> bool,
}

/// Why a gateway did not do what it was asked.
#[derive(Debug)]
pub enum GatewayError {
    /// The gateway itself failed.
    Adapter(AdapterError),
    /// The node does not answer it.
    NoAnswer,
    /// The node refused, or the gateway's SDO client did.
    Abort(AbortCode),
    /// The user gave up.
    Cancelled,
}

impl From<AdapterError> for GatewayError {
    fn from(error: AdapterError) -> Self {
        Self::Adapter(error)
    }
}
