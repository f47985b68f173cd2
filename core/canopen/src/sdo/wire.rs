//! The eight bytes of an SDO frame as named fields (CiA 301 section 7.2.4.3).
//!
//! [`Request`] is a frame of a client, [`Response`] a frame of a server. The top three bits of byte
//! 0 are the command specifier. Reserved bits are sent as 0 and ignored when received. Multi-byte
//! fields are little-endian.
//!
//! Segments of a block transfer have no command specifier and a separate type: [`BlockSegment`].

use core::ops::Deref;

use crate::abort::AbortCode;
use crate::od::Address;
use crate::sdo::fields::{self, ccs, scs, with_address, without_address};

/// Up to `N` bytes of data of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chunk<const N: usize> {
    bytes: [u8; N],
    len: u8,
}

impl<const N: usize> Chunk<N> {
    /// The first `N` bytes of `data`, or all of them if there are fewer.
    #[must_use]
    pub fn new(data: &[u8]) -> Self {
        let len = data.len().min(N);
        let mut bytes = [0; N];
        bytes[..len].copy_from_slice(&data[..len]);
        Self { bytes, len: len as u8 }
    }

    /// How many of the `N` bytes are not data: the field "n" of the standard.
    const fn unused(&self) -> u8 {
        N as u8 - self.len
    }

    /// From the field "n" and the bytes of the frame.
    pub(super) fn with_unused(bytes: &[u8], unused: u8) -> Self {
        Self::new(&bytes[..N.saturating_sub(usize::from(unused))])
    }
}

impl<const N: usize> Deref for Chunk<N> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

/// The data of an initiate, or the announcement of segments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Payload {
    /// All of the data, 1 to 4 bytes (e = 1, s = 1).
    Expedited(Chunk<4>),
    /// All of the data; the frame does not give the number of data bytes among the four (e = 1, s =
    /// 0).
    Unsized([u8; 4]),
    /// Segments follow (e = 0), of this many bytes altogether if the size is given (s = 1).
    Segmented(Option<u32>),
}

impl Payload {
    fn parse(bytes: &[u8; 8]) -> Self {
        let command = bytes[0];
        let data = fields::data(bytes);
        match (command & fields::EXPEDITED != 0, command & fields::SIZE_INDICATED != 0) {
            (true, true) => Self::Expedited(Chunk::with_unused(&data, fields::unused_of_4(command))),
            (true, false) => Self::Unsized(data),
            (false, true) => Self::Segmented(Some(u32::from_le_bytes(data))),
            (false, false) => Self::Segmented(None),
        }
    }

    /// The low bits of byte 0, and bytes 4 to 7.
    fn emit(&self) -> (u8, [u8; 4]) {
        match self {
            Self::Expedited(data) => {
                ((data.unused() & 0x03) << 2 | fields::EXPEDITED | fields::SIZE_INDICATED, data.bytes)
            }
            Self::Unsized(data) => (fields::EXPEDITED, *data),
            Self::Segmented(Some(size)) => (fields::SIZE_INDICATED, size.to_le_bytes()),
            Self::Segmented(None) => (0x00, [0; 4]),
        }
    }
}

/// One segment of a segmented transfer, in either direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Toggle bit: starts with 0 and alternates.
    pub toggle: bool,
    /// No more segments follow ("c").
    pub last: bool,
    /// The data, 0 to 7 bytes.
    pub data: Chunk<7>,
}

impl Segment {
    fn parse(bytes: &[u8; 8]) -> Self {
        let data = Chunk::with_unused(&bytes[1..], fields::unused_of_7(bytes[0]));
        Self { toggle: toggle_of(bytes[0]), last: bytes[0] & fields::LAST != 0, data }
    }

    fn emit(&self, specifier: u8) -> [u8; 8] {
        let mut bytes = [0; 8];
        bytes[0] = specifier | toggle_bit(self.toggle) | self.data.unused() << 1 | u8::from(self.last);
        bytes[1..].copy_from_slice(&self.data.bytes);
        bytes
    }
}

/// One segment of a block transfer, in either direction. The end of the transfer gives the number
/// of data bytes in the last segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockSegment {
    /// No more segments follow ("c").
    pub last: bool,
    /// Its number in the sub-block, 1 to 127.
    pub seqno: u8,
    /// The data.
    pub data: [u8; 7],
}

impl BlockSegment {
    /// `None` for sequence number 0: no segment has it, so an abort (80h) differs from all
    /// segments.
    #[must_use]
    pub fn parse(bytes: &[u8; 8]) -> Option<Self> {
        let [head, data @ ..] = *bytes;
        let seqno = head & !fields::LAST_OF_BLOCKS;
        (seqno != 0).then_some(Self { last: head & fields::LAST_OF_BLOCKS != 0, seqno, data })
    }

    /// The bytes of the frame.
    #[must_use]
    pub fn emit(&self) -> [u8; 8] {
        let mut bytes = [0; 8];
        bytes[0] = u8::from(self.last) << 7 | self.seqno & 0x7F;
        bytes[1..].copy_from_slice(&self.data);
        bytes
    }
}

/// The end of a block transfer, from the side that sent the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockEnd {
    /// Bytes of the last segment that are not data, 0 to 7 ("n").
    pub unused: u8,
    /// CRC of all data, 0 if one side does not support it.
    pub crc: u16,
}

impl BlockEnd {
    fn parse(bytes: &[u8; 8]) -> Self {
        Self { unused: fields::unused_of_blocks(bytes[0]), crc: fields::crc(bytes) }
    }

    fn emit(&self, command: u8) -> [u8; 8] {
        let [low, high] = self.crc.to_le_bytes();
        without_address(command | (self.unused & 0x07) << 2, low, high)
    }
}

/// The acknowledgement of a sub-block, and the size of the next one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockAck {
    /// The number of the last segment of the sub-block received in order; 0 for none.
    pub ackseq: u8,
    /// Segments of the next sub-block, 1 to 127.
    pub blksize: u8,
}

impl BlockAck {
    const fn parse(bytes: &[u8; 8]) -> Self {
        Self { ackseq: bytes[1], blksize: bytes[2] }
    }

    const fn emit(self, command: u8) -> [u8; 8] {
        without_address(command, self.ackseq, self.blksize)
    }
}

/// A frame of the client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// Initiate download (ccs 1).
    InitiateDownload(Address, Payload),
    /// Download segment (ccs 0).
    DownloadSegment(Segment),
    /// Initiate upload (ccs 2).
    InitiateUpload(Address),
    /// Upload segment (ccs 3), with its toggle bit.
    UploadSegment(bool),
    /// Abort (cs 4).
    Abort(Address, AbortCode),
    /// Initiate block download (ccs 6, cs 0).
    InitiateBlockDownload {
        /// The object to write.
        at: Address,
        /// The client supports the CRC.
        crc: bool,
        /// Size in bytes, if given.
        size: Option<u32>,
    },
    /// End block download (ccs 6, cs 1).
    EndBlockDownload(BlockEnd),
    /// Initiate block upload (ccs 5, cs 0).
    InitiateBlockUpload {
        /// The object to read.
        at: Address,
        /// The client supports the CRC.
        crc: bool,
        /// Segments per sub-block, 1 to 127.
        blksize: u8,
        /// Protocol switch threshold: up to this many bytes the server may answer with another
        /// protocol; 0 for never.
        pst: u8,
    },
    /// End block upload (ccs 5, cs 1): the client has checked everything.
    EndBlockUpload,
    /// Block upload response (ccs 5, cs 2).
    AckBlockUpload(BlockAck),
    /// Start block upload (ccs 5, cs 3).
    StartBlockUpload,
}

impl Request {
    /// `None` for an unknown command specifier.
    #[must_use]
    pub fn parse(bytes: &[u8; 8]) -> Option<Self> {
        let command = bytes[0];
        let at = fields::address(bytes);
        Some(match fields::specifier(command) {
            ccs::DOWNLOAD_SEGMENT => Self::DownloadSegment(Segment::parse(bytes)),
            ccs::INITIATE_DOWNLOAD => Self::InitiateDownload(at, Payload::parse(bytes)),
            ccs::INITIATE_UPLOAD => Self::InitiateUpload(at),
            ccs::UPLOAD_SEGMENT => Self::UploadSegment(toggle_of(command)),
            fields::ABORT => Self::Abort(at, AbortCode(fields::number(bytes))),
            ccs::INITIATE_BLOCK_UPLOAD => {
                Self::InitiateBlockUpload { at, crc: crc_of(command), blksize: bytes[4], pst: bytes[5] }
            }
            ccs::END_BLOCK_UPLOAD => Self::EndBlockUpload,
            ccs::ACK_BLOCK_UPLOAD => Self::AckBlockUpload(BlockAck::parse(bytes)),
            ccs::START_BLOCK_UPLOAD => Self::StartBlockUpload,
            ccs::INITIATE_BLOCK_DOWNLOAD => {
                Self::InitiateBlockDownload { at, crc: crc_of(command), size: size_of(bytes) }
            }
            ccs::END_BLOCK_DOWNLOAD => Self::EndBlockDownload(BlockEnd::parse(bytes)),
            _ => return None,
        })
    }

    /// The bytes of the frame.
    #[must_use]
    pub fn emit(&self) -> [u8; 8] {
        match *self {
            Self::InitiateDownload(at, payload) => {
                let (bits, data) = payload.emit();
                with_address(ccs::INITIATE_DOWNLOAD | bits, at, data)
            }
            Self::DownloadSegment(segment) => segment.emit(ccs::DOWNLOAD_SEGMENT),
            Self::InitiateUpload(at) => with_address(ccs::INITIATE_UPLOAD, at, [0; 4]),
            Self::UploadSegment(toggle) => without_address(ccs::UPLOAD_SEGMENT | toggle_bit(toggle), 0, 0),
            Self::Abort(at, code) => with_address(fields::ABORT, at, code.0.to_le_bytes()),
            Self::InitiateBlockDownload { at, crc, size } => {
                let command = ccs::INITIATE_BLOCK_DOWNLOAD | crc_bit(crc) | size_bit(size);
                with_address(command, at, size.unwrap_or(0).to_le_bytes())
            }
            Self::EndBlockDownload(end) => end.emit(ccs::END_BLOCK_DOWNLOAD),
            Self::InitiateBlockUpload { at, crc, blksize, pst } => {
                with_address(ccs::INITIATE_BLOCK_UPLOAD | crc_bit(crc), at, [blksize, pst, 0, 0])
            }
            Self::EndBlockUpload => without_address(ccs::END_BLOCK_UPLOAD, 0, 0),
            Self::AckBlockUpload(ack) => ack.emit(ccs::ACK_BLOCK_UPLOAD),
            Self::StartBlockUpload => without_address(ccs::START_BLOCK_UPLOAD, 0, 0),
        }
    }
}

/// A frame of the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Response {
    /// Initiate download (scs 3).
    InitiateDownload(Address),
    /// Download segment (scs 1), with its toggle bit.
    DownloadSegment(bool),
    /// Initiate upload (scs 2).
    InitiateUpload(Address, Payload),
    /// Upload segment (scs 0).
    UploadSegment(Segment),
    /// Abort (cs 4).
    Abort(Address, AbortCode),
    /// Initiate block download (scs 5, ss 0).
    InitiateBlockDownload {
        /// The object to write.
        at: Address,
        /// The server checks a CRC.
        crc: bool,
        /// Segments of the first sub-block, 1 to 127.
        blksize: u8,
    },
    /// End block download (scs 5, ss 1).
    EndBlockDownload,
    /// Block download response (scs 5, ss 2).
    AckBlockDownload(BlockAck),
    /// Initiate block upload (scs 6, ss 0).
    InitiateBlockUpload {
        /// The object to read.
        at: Address,
        /// The server supports the CRC.
        crc: bool,
        /// Size in bytes, if given.
        size: Option<u32>,
    },
    /// End block upload (scs 6, ss 1).
    EndBlockUpload(BlockEnd),
}

impl Response {
    /// `None` for an unknown command specifier.
    #[must_use]
    pub fn parse(bytes: &[u8; 8]) -> Option<Self> {
        let command = bytes[0];
        let at = fields::address(bytes);
        Some(match fields::specifier(command) {
            scs::UPLOAD_SEGMENT => Self::UploadSegment(Segment::parse(bytes)),
            scs::DOWNLOAD_SEGMENT => Self::DownloadSegment(toggle_of(command)),
            scs::INITIATE_UPLOAD => Self::InitiateUpload(at, Payload::parse(bytes)),
            scs::INITIATE_DOWNLOAD => Self::InitiateDownload(at),
            fields::ABORT => Self::Abort(at, AbortCode(fields::number(bytes))),
            scs::INITIATE_BLOCK_DOWNLOAD => {
                Self::InitiateBlockDownload { at, crc: crc_of(command), blksize: bytes[4] }
            }
            scs::END_BLOCK_DOWNLOAD => Self::EndBlockDownload,
            scs::ACK_BLOCK_DOWNLOAD => Self::AckBlockDownload(BlockAck::parse(bytes)),
            scs::INITIATE_BLOCK_UPLOAD => {
                Self::InitiateBlockUpload { at, crc: crc_of(command), size: size_of(bytes) }
            }
            scs::END_BLOCK_UPLOAD => Self::EndBlockUpload(BlockEnd::parse(bytes)),
            _ => return None,
        })
    }

    /// The bytes of the frame.
    #[must_use]
    pub fn emit(&self) -> [u8; 8] {
        match *self {
            Self::InitiateDownload(at) => with_address(scs::INITIATE_DOWNLOAD, at, [0; 4]),
            Self::DownloadSegment(toggle) => {
                without_address(scs::DOWNLOAD_SEGMENT | toggle_bit(toggle), 0, 0)
            }
            Self::InitiateUpload(at, payload) => {
                let (bits, data) = payload.emit();
                with_address(scs::INITIATE_UPLOAD | bits, at, data)
            }
            Self::UploadSegment(segment) => segment.emit(scs::UPLOAD_SEGMENT),
            Self::Abort(at, code) => with_address(fields::ABORT, at, code.0.to_le_bytes()),
            Self::InitiateBlockDownload { at, crc, blksize } => {
                with_address(scs::INITIATE_BLOCK_DOWNLOAD | crc_bit(crc), at, [blksize, 0, 0, 0])
            }
            Self::EndBlockDownload => without_address(scs::END_BLOCK_DOWNLOAD, 0, 0),
            Self::AckBlockDownload(ack) => ack.emit(scs::ACK_BLOCK_DOWNLOAD),
            Self::InitiateBlockUpload { at, crc, size } => {
                let command = scs::INITIATE_BLOCK_UPLOAD | crc_bit(crc) | size_bit(size);
                with_address(command, at, size.unwrap_or(0).to_le_bytes())
            }
            Self::EndBlockUpload(end) => end.emit(scs::END_BLOCK_UPLOAD),
        }
    }
}

const fn toggle_of(command: u8) -> bool {
    command & fields::TOGGLE != 0
}

const fn toggle_bit(toggle: bool) -> u8 {
    if toggle {
        fields::TOGGLE
    } else {
        0
    }
}

const fn crc_of(command: u8) -> bool {
    command & fields::CRC != 0
}

const fn crc_bit(crc: bool) -> u8 {
    if crc {
        fields::CRC
    } else {
        0
    }
}

/// The size that an initiate of a block transfer announces.
fn size_of(bytes: &[u8; 8]) -> Option<u32> {
    (bytes[0] & fields::BLOCK_SIZE_INDICATED != 0).then(|| fields::number(bytes))
}

const fn size_bit(size: Option<u32>) -> u8 {
    match size {
        Some(_) => fields::BLOCK_SIZE_INDICATED,
        None => 0,
    }
}
