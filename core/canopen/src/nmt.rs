//! Network management of a slave (CiA 301 section 7.3.2).

use embedded_can::Frame as _;

use crate::frame::{CobId, Frame, NodeId};

/// The state of a node; the values are the byte in boot-up and heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum NmtState {
    /// The node starts; on the bus it shows as the boot-up message.
    Initialisation = 0x00,
    /// Neither SDO nor PDO works.
    Stopped = 0x04,
    /// SDO and PDO work.
    Operational = 0x05,
    /// SDO works, PDO does not.
    PreOperational = 0x7F,
}

impl NmtState {
    /// From the byte of a heartbeat; the toggle bit of node guarding is ignored. `None` for an
    /// invalid value.
    #[must_use]
    pub const fn from_byte(byte: u8) -> Option<Self> {
        match byte & 0x7F {
            0x00 => Some(Self::Initialisation),
            0x04 => Some(Self::Stopped),
            0x05 => Some(Self::Operational),
            0x7F => Some(Self::PreOperational),
            _ => None,
        }
    }
}

/// A command of the NMT master; the values are the command specifiers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum NmtCommand {
    /// Enter OPERATIONAL.
    Start = 0x01,
    /// Enter STOPPED.
    Stop = 0x02,
    /// Enter PRE-OPERATIONAL.
    EnterPreOperational = 0x80,
    /// Restart the device.
    ResetNode = 0x81,
    /// Restart communication: a configured node-ID takes effect.
    ResetCommunication = 0x82,
}

impl NmtCommand {
    /// The command in a frame that addresses `node` or all nodes; `None` for every other frame.
    #[must_use]
    pub fn parse(frame: &Frame, node: NodeId) -> Option<Self> {
        if !frame.has_cob_id(CobId::NMT) {
            return None;
        }
        let [command, addressed] = *frame.exactly()?;
        if addressed != 0 && addressed != node.get() {
            return None;
        }
        match command {
            0x01 => Some(Self::Start),
            0x02 => Some(Self::Stop),
            0x80 => Some(Self::EnterPreOperational),
            0x81 => Some(Self::ResetNode),
            0x82 => Some(Self::ResetCommunication),
            _ => None,
        }
    }

    /// The frame of a master; without a node it addresses all nodes.
    #[must_use]
    pub fn emit(self, node: Option<NodeId>) -> Frame {
        Frame::of(CobId::NMT, &[self as u8, node.map_or(0, NodeId::get)])
    }
}

/// The boot-up message of a node.
#[must_use]
pub fn boot_up(node: NodeId) -> Frame {
    state_message(node, NmtState::Initialisation)
}

/// The node that has sent this boot-up message; `None` for every other frame.
#[must_use]
pub fn parse_boot_up(frame: &Frame) -> Option<NodeId> {
    match parse_state_message(frame)? {
        (node, NmtState::Initialisation) => Some(node),
        _ => None,
    }
}

/// The heartbeat of a node in this state.
#[must_use]
pub fn state_message(node: NodeId, state: NmtState) -> Frame {
    Frame::of(CobId::heartbeat(node), &[state as u8])
}

/// The node and its state in a boot-up or heartbeat message; `None` for every other frame.
#[must_use]
pub fn parse_state_message(frame: &Frame) -> Option<(NodeId, NmtState)> {
    let id = frame.cob_id()?.get();
    if id & !0x7F != 0x700 {
        return None;
    }
    let node = NodeId::new((id & 0x7F) as u8)?;
    match frame.data() {
        [byte] => Some((node, NmtState::from_byte(*byte)?)),
        _ => None,
    }
}
