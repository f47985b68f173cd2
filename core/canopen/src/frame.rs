//! CAN frames, node-IDs and the identifiers of the predefined connection set (CiA 301 section
//! 7.3.5).

use core::fmt;
use core::num::NonZeroU8;

use embedded_can::{ExtendedId, Frame as _, Id, StandardId};

/// The number of a node: 1 to 127.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeId(NonZeroU8);

impl NodeId {
    /// The lowest node-ID, 1.
    pub const MIN: Self = Self::new(1).unwrap();
    /// The highest node-ID, 127.
    pub const MAX: Self = Self::new(127).unwrap();

    /// `None` for 0 (which addresses all nodes) and for 128 and above.
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        match NonZeroU8::new(number) {
            Some(number) if number.get() <= 127 => Some(Self(number)),
            _ => None,
        }
    }

    /// The number, 1 to 127.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0.get()
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

    /// The COB-ID that no frame has: it has more than 11 bits.
    pub const NONE: Self = Self(u16::MAX);

    /// A COB-ID whose word in the object dictionary was found to be valid.
    pub(crate) const fn of_word(word: u32) -> Self {
        Self(word as u16)
    }

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
        Self(0x080 + node.get() as u16)
    }

    /// A base COB-ID plus the node-ID, as in the predefined connection set; `None` if the sum has
    /// more than 11 bits.
    #[must_use]
    pub const fn from_base(base: u16, node: NodeId) -> Option<Self> {
        Self::new(base + node.get() as u16)
    }

    /// SDO, server to client.
    #[must_use]
    pub const fn sdo_response(node: NodeId) -> Self {
        Self(0x580 + node.get() as u16)
    }

    /// SDO, client to server.
    #[must_use]
    pub const fn sdo_request(node: NodeId) -> Self {
        Self(0x600 + node.get() as u16)
    }

    /// Boot-up and heartbeat of a node.
    #[must_use]
    pub const fn heartbeat(node: NodeId) -> Self {
        Self(0x700 + node.get() as u16)
    }
}

impl fmt::Display for CobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:03X}h", self.0)
    }
}

/// The two COB-IDs of an SDO server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Of requests.
    pub request: CobId,
    /// Of answers.
    pub response: CobId,
}

impl Channel {
    /// No server: no frame has these COB-IDs.
    pub const NONE: Self = Self { request: CobId::NONE, response: CobId::NONE };
}

/// A classic CAN frame. Data bytes beyond its length are 0, so that equal frames compare equal.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    /// The identifier with the flags [`EXTENDED`] and [`REMOTE`]. A data frame with an 11-bit
    /// identifier has neither, so its word is its COB-ID.
    id: u32,
    len: u8,
    data: [u8; 8],
}

/// The identifier has 29 bits.
const EXTENDED: u32 = 1 << 31;
/// A remote frame.
const REMOTE: u32 = 1 << 30;
const FLAGS: u32 = EXTENDED | REMOTE;

impl Frame {
    /// A data frame of CANopen. Bytes after the eighth are dropped.
    #[must_use]
    pub fn of(id: CobId, data: &[u8]) -> Self {
        Self::with_word(id.0.into(), &data[..data.len().min(8)])
    }

    /// A data frame of eight bytes, the length of all SDO, LSS and EMCY frames.
    #[must_use]
    pub const fn full(id: CobId, data: [u8; 8]) -> Self {
        Self { id: id.0 as u32, len: 8, data }
    }

    /// `data` are at most 8 bytes.
    fn with_word(id: u32, data: &[u8]) -> Self {
        let mut bytes = [0; 8];
        bytes[..data.len()].copy_from_slice(data);
        Self { id, len: data.len() as u8, data: bytes }
    }

    /// The COB-ID of a data frame with an 11-bit identifier; `None` for extended and remote frames,
    /// which CANopen does not use.
    #[must_use]
    pub const fn cob_id(&self) -> Option<CobId> {
        if self.id <= 0x7FF {
            Some(CobId(self.id as u16))
        } else {
            None
        }
    }

    /// Whether this is a data frame with this COB-ID.
    #[must_use]
    pub const fn has_cob_id(&self, id: CobId) -> bool {
        self.id == id.0 as u32
    }

    /// The data, if this is a data frame of exactly `N` bytes.
    #[must_use]
    pub fn exactly<const N: usize>(&self) -> Option<&[u8; N]> {
        self.data().try_into().ok()
    }
}

impl embedded_can::Frame for Frame {
    fn new(id: impl Into<Id>, data: &[u8]) -> Option<Self> {
        (data.len() <= 8).then(|| Self::with_word(word(id.into()), data))
    }

    fn new_remote(id: impl Into<Id>, dlc: usize) -> Option<Self> {
        let id = word(id.into()) | REMOTE;
        (dlc <= 8).then_some(Self { id, len: dlc as u8, data: [0; 8] })
    }

    fn is_extended(&self) -> bool {
        self.id & EXTENDED != 0
    }

    fn is_remote_frame(&self) -> bool {
        self.id & REMOTE != 0
    }

    fn id(&self) -> Id {
        // Both identifiers are in range, so the fallbacks are never used.
        let id = self.id & !FLAGS;
        if self.is_extended() {
            Id::Extended(ExtendedId::new(id).unwrap_or(ExtendedId::ZERO))
        } else {
            Id::Standard(StandardId::new(id as u16).unwrap_or(StandardId::ZERO))
        }
    }

    fn dlc(&self) -> usize {
        self.len.into()
    }

    /// The data; a remote frame has none, whatever its DLC.
    fn data(&self) -> &[u8] {
        let len = if self.is_remote_frame() { 0 } else { self.len };
        &self.data[..usize::from(len.min(8))]
    }
}

/// The identifier's word in [`Frame`].
fn word(id: Id) -> u32 {
    match id {
        Id::Standard(id) => id.as_raw().into(),
        Id::Extended(id) => id.as_raw() | EXTENDED,
    }
}

/// In the format of candump: `601#4000100000000000`.
impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let id = self.id & !FLAGS;
        if self.is_extended() {
            write!(f, "{id:08X}#")?;
        } else {
            write!(f, "{id:03X}#")?;
        }
        if self.is_remote_frame() {
            write!(f, "R{}", self.len)?;
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
        assert_eq!(format!("{remote:?}"), "00012345#R2");
    }

    #[test]
    fn an_identifier_is_given_back_as_it_was_given() {
        let standard = Id::from(StandardId::new(0x605).unwrap());
        let extended = Id::from(ExtendedId::new(0x1234_5678).unwrap());
        for id in [standard, extended] {
            assert_eq!(Frame::new(id, &[]).unwrap().id(), id);
            assert_eq!(Frame::new_remote(id, 0).unwrap().id(), id);
        }
    }
}
