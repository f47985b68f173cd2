//! Node-ID and bit rate as the layer setting services store them, for bootloader and application.

use canopen::bit_rate::BitRate;
use canopen::NodeId;
use shared_abi::journal::{self, Key, Value};

use super::parameters::Parameters;
use crate::flash::Flash;

/// The node-ID and the bit rate of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NodeParameters {
    /// `None` for a device that waits for a node-ID from layer setting services.
    pub id: Option<NodeId>,
    /// May be [`BitRate::Auto`].
    pub bit_rate: BitRate,
}

/// The stored form of "no node-ID" (CiA 305).
const NO_NODE_ID: u8 = 0xFF;

impl NodeParameters {
    /// The stored values; the board's own values if nothing is stored, or nothing that this
    /// firmware supports.
    pub fn load<F: Flash>(
        parameters: &impl Parameters,
        flash: &F,
        board: Self,
        supports: impl FnOnce(BitRate) -> bool,
    ) -> Self {
        parameters
            .get(flash, Key::NODE)
            .and_then(Self::from_value)
            .filter(|stored| supports(stored.bit_rate))
            .unwrap_or(board)
    }

    fn from_value([id, rate, ..]: Value) -> Option<Self> {
        let id = match id {
            id if id == u32::from(NO_NODE_ID) => None,
            id => Some(NodeId::new(u8::try_from(id).ok()?)?),
        };
        Some(Self { id, bit_rate: BitRate::from_index(u8::try_from(rate).ok()?)? })
    }

    /// The stored form.
    #[must_use]
    pub fn value(&self) -> Value {
        journal::node(self.id_or_none(), self.bit_rate as u8)
    }

    /// The node-ID; 255 for none.
    #[must_use]
    pub fn id_or_none(&self) -> u8 {
        self.id.map_or(NO_NODE_ID, NodeId::get)
    }
}
