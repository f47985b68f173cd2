//! The layout of the eight bytes of an SDO frame (CiA 301 section 7.2.4.3), for the server, which
//! works on the bytes, and for [`wire`](crate::sdo::wire), which names all fields.
//!
//! The command specifier is in byte 0: the top three bits, in block transfers also the lowest one
//! or two. Reserved bits are sent as 0 and ignored when received.

use crate::od::Address;

/// Command specifiers of requests.
pub mod ccs {
    pub const DOWNLOAD_SEGMENT: u8 = 0x00;
    pub const INITIATE_DOWNLOAD: u8 = 0x20;
    pub const INITIATE_UPLOAD: u8 = 0x40;
    pub const UPLOAD_SEGMENT: u8 = 0x60;
    pub const INITIATE_BLOCK_UPLOAD: u8 = 0xA0;
    pub const END_BLOCK_UPLOAD: u8 = 0xA1;
    pub const ACK_BLOCK_UPLOAD: u8 = 0xA2;
    pub const START_BLOCK_UPLOAD: u8 = 0xA3;
    pub const INITIATE_BLOCK_DOWNLOAD: u8 = 0xC0;
    pub const END_BLOCK_DOWNLOAD: u8 = 0xC1;
}

/// Command specifiers of answers.
pub mod scs {
    pub const UPLOAD_SEGMENT: u8 = 0x00;
    pub const DOWNLOAD_SEGMENT: u8 = 0x20;
    pub const INITIATE_UPLOAD: u8 = 0x40;
    pub const INITIATE_DOWNLOAD: u8 = 0x60;
    pub const INITIATE_BLOCK_DOWNLOAD: u8 = 0xA0;
    pub const END_BLOCK_DOWNLOAD: u8 = 0xA1;
    pub const ACK_BLOCK_DOWNLOAD: u8 = 0xA2;
    pub const INITIATE_BLOCK_UPLOAD: u8 = 0xC0;
    pub const END_BLOCK_UPLOAD: u8 = 0xC1;
}

/// Abort, from either side.
pub const ABORT: u8 = 0x80;

/// Initiate, "e": the data are in the frame itself.
pub const EXPEDITED: u8 = 0x02;
/// Initiate, "s": the frame has the size.
pub const SIZE_INDICATED: u8 = 0x01;
/// Initiate of a block transfer, "s": the frame has the size. It is another bit than elsewhere.
pub const BLOCK_SIZE_INDICATED: u8 = 0x02;
/// Initiate of a block transfer: this side supports the CRC.
pub const CRC: u8 = 0x04;
/// Segment, "t": alternates, starting with 0.
pub const TOGGLE: u8 = 0x10;
/// Segment, "c": no more follow.
pub const LAST: u8 = 0x01;
/// Segment of a block transfer, "c": no more follow. The other bits of byte 0 are its number.
pub const LAST_OF_BLOCKS: u8 = 0x80;

/// The command specifier in byte 0 without the other fields: one of [`ccs`] for a request, one of
/// [`scs`] for an answer, [`ABORT`] for either, and another value for an unknown command.
#[must_use]
pub const fn specifier(command: u8) -> u8 {
    match command >> 5 {
        5 => command & 0xE3,
        6 => command & 0xE1,
        _ => command & 0xE0,
    }
}

/// Whether byte 0 may belong to a request with an address, an initiate: 1, 2, 5 or 6 in the top
/// three bits. (5 and 6 have other requests, too.)
#[must_use]
pub const fn may_initiate(command: u8) -> bool {
    0b0110_0110 >> (command >> 5) & 1 != 0
}

/// Index and sub-index of an initiate or abort.
#[must_use]
pub const fn address(bytes: &[u8; 8]) -> Address {
    Address { index: u16::from_le_bytes([bytes[1], bytes[2]]), sub: bytes[3] }
}

/// Bytes 4 to 7 of an initiate or abort.
#[must_use]
pub const fn data(bytes: &[u8; 8]) -> [u8; 4] {
    [bytes[4], bytes[5], bytes[6], bytes[7]]
}

/// Bytes 4 to 7 of an initiate or abort as a number.
#[must_use]
pub const fn number(bytes: &[u8; 8]) -> u32 {
    u32::from_le_bytes(data(bytes))
}

/// How many of the four bytes of an expedited initiate are not data ("n").
#[must_use]
pub const fn unused_of_4(command: u8) -> u8 {
    command >> 2 & 0x03
}

/// How many of the seven bytes of a segment are not data ("n").
#[must_use]
pub const fn unused_of_7(command: u8) -> u8 {
    command >> 1 & 0x07
}

/// How many of the seven bytes of the last segment of a block transfer are not data ("n" of its
/// end).
#[must_use]
pub const fn unused_of_blocks(command: u8) -> u8 {
    command >> 2 & 0x07
}

/// The CRC in the end of a block transfer.
#[must_use]
pub const fn crc(bytes: &[u8; 8]) -> u16 {
    u16::from_le_bytes([bytes[1], bytes[2]])
}

/// A frame with an address: an initiate or an abort.
#[must_use]
pub const fn with_address(command: u8, at: Address, data: [u8; 4]) -> [u8; 8] {
    let [low, high] = at.index.to_le_bytes();
    let [a, b, c, d] = data;
    [command, low, high, at.sub, a, b, c, d]
}

/// A frame of two numbers at most.
#[must_use]
pub const fn without_address(command: u8, a: u8, b: u8) -> [u8; 8] {
    [command, a, b, 0, 0, 0, 0, 0]
}
