//! Gateways: access to devices on a remote CAN bus at the level of SDO.
//!
//! A gateway takes requests such as "read this object of that node" and does the transfer on its
//! bus by itself. The tool sees no frames: commands that listen to the bus (scan, monitor, LSS)
//! need an [`Adapter`](super::Adapter). Commands that read and write objects, the update among
//! them, work with both, because a `Session` of `coflash-core` hides the difference.
//!
//! To add a gateway, add one file beside [`cia309`](super::cia309) and one line to
//! [`Link::open`](super::Link::open).

use std::time::Duration;

use canopen::{AbortCode, Address, NodeId};

use super::adapter::AdapterError;

/// Access to the object dictionaries of devices.
pub trait Gateway {
    /// Reads an object. Calls `progress` with the number of bytes that have arrived.
    ///
    /// # Errors
    /// See [`GatewayError`].
    fn upload(&mut self, ask: &Ask<'_>, progress: &mut dyn FnMut(u32)) -> Result<Vec<u8>, GatewayError>;

    /// Writes an object. Calls `progress` with the number of bytes that the gateway has accepted.
    ///
    /// # Errors
    /// See [`GatewayError`].
    fn download(
        &mut self,
        ask: &Ask<'_>,
        data: &[u8],
        progress: &mut dyn FnMut(u32),
    ) -> Result<(), GatewayError>;

    /// Makes the gateway reset a node by network management (NMT reset node).
    ///
    /// # Errors
    /// See [`GatewayError`].
    fn reset_node(&mut self, node: NodeId) -> Result<(), GatewayError>;

    /// Waits for a word of the gateway: sends a command that changes nothing on the bus, with `sdo`
    /// as the time that a node may take for an answer.
    ///
    /// # Errors
    /// No gateway is at the other end.
    fn greet(&mut self, sdo: Duration) -> Result<(), AdapterError>;

    /// Waits for `time`. Returns early with the node-ID if the gateway reports a boot-up message.
    /// Many gateways report none.
    ///
    /// # Errors
    /// [`GatewayError::Adapter`].
    fn wait(&mut self, time: Duration) -> Result<Option<NodeId>, GatewayError>;

    /// The time since an origin of the gateway's choice.
    fn now(&self) -> Duration;
}

/// A request for one object of one node, with its time limits.
#[derive(Clone, Copy)]
pub struct Ask<'c> {
    /// The node.
    pub node: NodeId,
    /// The object.
    pub at: Address,
    /// How long the node may take for an answer, measured by the gateway on its bus.
    pub sdo: Duration,
    /// How long the gateway may send nothing of its answer, or accept nothing, before the request is
    /// given up.
    pub patience: Duration,
    /// The longest value that is accepted, in bytes.
    pub longest: usize,
    /// Whether the user has cancelled.
    pub cancelled: &'c dyn Fn() -> bool,
}

/// Why a gateway did not do what it was asked to do.
#[derive(Debug)]
pub enum GatewayError {
    /// The gateway itself failed.
    Adapter(AdapterError),
    /// The node does not answer the gateway.
    NoAnswer,
    /// The node, or the gateway's SDO client, aborted the transfer.
    Abort(AbortCode),
    /// The user cancelled.
    Cancelled,
}

impl From<AdapterError> for GatewayError {
    fn from(error: AdapterError) -> Self {
        Self::Adapter(error)
    }
}
