//! CAN frames, node-IDs and the identifiers of the predefined connection set (CiA 301 section
//! 7.3.5).

use core::fmt;

use embedded_can::{ExtendedId, Frame as _, Id, StandardId};

/// The number of a node: 1 to 127.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeId(u8);

impl NodeId {
    /// The lowest and the highest node-ID.
    pub const MIN: Self = Self(1);
    /// The highest node-ID.
    pub const MAX: Self = Self(127);

    /// `None` for 0 (which addresses all nodes) and for 128 and above.
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        match number {
            1..=127 => Some(Self(number)),
            _ => None,
        }
    }

    /// The number, 1 to 127.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }
}

impl fmt::Display for NodeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The 11-bit identifier of a communication object.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CobId(u16);

impl CobId {
    /// NMT node control, from the master.
    pub const NMT: Self = Self(0x000);
    /// LSS, slave to master (CiA 305).
    pub const LSS_RESPONSE: Self = Self(0x7E4);
    /// LSS, master to slave (CiA 305).
    pub const LSS_REQUEST: Self = Self(0x7E5);

    /// `None` for a number that does not fit into 11 bits.
    #[must_use]
    pub const fn new(number: u16) -> Option<Self> {
        if number <= 0x7FF {
            Some(Self(number))
        } else {
            None
        }
    }

    /// The number, 000h to 7FFh.
    #[must_use]
    pub const fn get(self) -> u16 {
        self.0
    }

    /// Emergency of a node.
    #[must_use]
    pub const fn emcy(node: NodeId) -> Self {
        Self(0x080 + node.0 as u16)
    }

    /// SDO, server to client.
    #[must_use]
    pub const fn sdo_response(node: NodeId) -> Self {
        Self(0x580 + node.0 as u16)
    }

    /// SDO, client to server.
    #[must_use]
    pub const fn sdo_request(node: NodeId) -> Self {
        Self(0x600 + node.0 as u16)
    }

    /// Boot-up and heartbeat of a node.
    #[must_use]
    pub const fn heartbeat(node: NodeId) -> Self {
        Self(0x700 + node.0 as u16)
    }
}

impl fmt::Display for CobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:03X}h", self.0)
    }
}

impl From<CobId> for Id {
    fn from(id: CobId) -> Self {
        // A CobId has 11 bits, so the mask changes nothing; it spares the unreachable branch.
        Id::Standard(StandardId::new(id.0 & 0x7FF).unwrap_or(StandardId::ZERO))
    }
}

/// A classic CAN frame.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    id: Id,
    remote: bool,
    dlc: u8,
    data: [u8; 8],
}

impl Frame {
    /// A data frame of CANopen. Bytes behind the eighth are left out.
    #[must_use]
    pub fn of(id: CobId, data: &[u8]) -> Self {
        let len = data.len().min(8);
        let mut bytes = [0; 8];
        bytes[..len].copy_from_slice(&data[..len]);
        Self { id: id.into(), remote: false, dlc: len as u8, data: bytes }
    }

    /// The COB-ID, if this is a data frame with an 11-bit identifier. CANopen of this crate uses no
    /// others, so that whoever dispatches by it never sees an extended or a remote frame.
    #[must_use]
    pub fn cob_id(&self) -> Option<CobId> {
        match self.id {
            Id::Standard(id) if !self.remote => Some(CobId(id.as_raw())),
            _ => None,
        }
    }

    /// The data, if this is a data frame of exactly `N` bytes.
    #[must_use]
    pub fn exactly<const N: usize>(&self) -> Option<&[u8; N]> {
        self.data().try_into().ok()
    }
}

impl embedded_can::Frame for Frame {
    fn new(id: impl Into<Id>, data: &[u8]) -> Option<Self> {
        let mut bytes = [0; 8];
        bytes.get_mut(..data.len())?.copy_from_slice(data);
        Some(Self { id: id.into(), remote: false, dlc: data.len() as u8, data: bytes })
    }

    fn new_remote(id: impl Into<Id>, dlc: usize) -> Option<Self> {
        let dlc = u8::try_from(dlc).ok().filter(|dlc| *dlc <= 8)?;
        Some(Self { id: id.into(), remote: true, dlc, data: [0; 8] })
    }

    fn is_extended(&self) -> bool {
        matches!(self.id, Id::Extended(_))
    }

    fn is_remote_frame(&self) -> bool {
        self.remote
    }

    fn id(&self) -> Id {
        self.id
    }

    fn dlc(&self) -> usize {
        usize::from(self.dlc)
    }

    /// The data; of a remote frame none, whatever its DLC asks for.
    fn data(&self) -> &[u8] {
        let len = if self.remote { 0 } else { self.dlc };
        &self.data[..usize::from(len.min(8))]
    }
}

/// As candump writes it: `601#4000100000000000`.
impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.id {
            Id::Standard(id) => write!(f, "{:03X}#", id.as_raw())?,
            Id::Extended(id) => write!(f, "{:08X}#", ExtendedId::as_raw(&id))?,
        }
        if self.remote {
            write!(f, "R{}", self.dlc)?;
        }
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::format;

    /// CiA 301 table 38, node-ID 5.
    #[test]
    fn identifiers_are_those_of_the_predefined_connection_set() {
        let node = NodeId::new(5).unwrap();
        assert_eq!(CobId::NMT.get(), 0x000);
        assert_eq!(CobId::emcy(node).get(), 0x085);
        assert_eq!(CobId::sdo_response(node).get(), 0x585);
        assert_eq!(CobId::sdo_request(node).get(), 0x605);
        assert_eq!(CobId::heartbeat(node).get(), 0x705);
        assert_eq!((NodeId::new(0), NodeId::new(128), CobId::new(0x800)), (None, None, None));
    }

    #[test]
    fn extended_and_remote_frames_have_no_cob_id() {
        let standard = StandardId::new(0x605).unwrap();
        let extended = ExtendedId::new(0x605).unwrap();
        assert_eq!(Frame::new(standard, &[0; 8]).unwrap().cob_id(), CobId::new(0x605));
        assert_eq!(Frame::new(extended, &[0; 8]).unwrap().cob_id(), None);
        let remote = Frame::new_remote(standard, 8).unwrap();
        assert_eq!((remote.cob_id(), remote.data(), remote.dlc()), (None, &[][..], 8));
        assert!(Frame::new(standard, &[0; 9]).is_none());
        assert!(Frame::new_remote(standard, 9).is_none());
    }

    #[test]
    fn reads_like_a_candump_log() {
        let frame = Frame::of(CobId::heartbeat(NodeId::MAX), &[0x7F]);
        assert_eq!(format!("{frame}"), "77F#7F");
        let remote = Frame::new_remote(ExtendedId::new(0x12345).unwrap(), 2).unwrap();
        assert_eq!(format!("{remote}"), "00012345#R2");
    }
}
