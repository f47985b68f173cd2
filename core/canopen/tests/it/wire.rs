//! Frames of every SDO service, written by hand from the figures of CiA 301 section 7.2.4.3: each
//! is parsed and emitted again.

use canopen::sdo::wire::Payload::{Expedited, Segmented, Unsized};
use canopen::sdo::wire::{BlockAck, BlockEnd, BlockSegment, Chunk, Request, Response, Segment};
use canopen::AbortCode;
use canopen::Address;

const AT: Address = Address::new(0x1F50, 2);

fn segment(toggle: bool, last: bool, data: &[u8]) -> Segment {
    Segment { toggle, last, data: Chunk::new(data) }
}

#[test]
fn requests() {
    use Request::*;
    let table = [
        ([0x27, 0x50, 0x1F, 2, 1, 2, 3, 0], InitiateDownload(AT, Expedited(Chunk::new(&[1, 2, 3])))),
        ([0x22, 0x50, 0x1F, 2, 1, 2, 3, 4], InitiateDownload(AT, Unsized([1, 2, 3, 4]))),
        ([0x21, 0x50, 0x1F, 2, 0x78, 0x56, 0x34, 0x12], InitiateDownload(AT, Segmented(Some(0x1234_5678)))),
        ([0x20, 0x50, 0x1F, 2, 0, 0, 0, 0], InitiateDownload(AT, Segmented(None))),
        ([0x00, 1, 2, 3, 4, 5, 6, 7], DownloadSegment(segment(false, false, &[1, 2, 3, 4, 5, 6, 7]))),
        ([0x1B, 1, 2, 0, 0, 0, 0, 0], DownloadSegment(segment(true, true, &[1, 2]))),
        ([0x40, 0x50, 0x1F, 2, 0, 0, 0, 0], InitiateUpload(AT)),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], UploadSegment(false)),
        ([0x70, 0, 0, 0, 0, 0, 0, 0], UploadSegment(true)),
        ([0x80, 0x50, 0x1F, 2, 0x01, 0x00, 0x04, 0x05], Abort(AT, AbortCode(0x0504_0001))),
        (
            [0xC6, 0x50, 0x1F, 2, 0x00, 0x01, 0, 0],
            InitiateBlockDownload { at: AT, crc: true, size: Some(256) },
        ),
        ([0xC0, 0x50, 0x1F, 2, 0, 0, 0, 0], InitiateBlockDownload { at: AT, crc: false, size: None }),
        ([0xC1, 0x34, 0x12, 0, 0, 0, 0, 0], EndBlockDownload(BlockEnd { unused: 0, crc: 0x1234 })),
        ([0xD9, 0x34, 0x12, 0, 0, 0, 0, 0], EndBlockDownload(BlockEnd { unused: 6, crc: 0x1234 })),
        (
            [0xA4, 0x50, 0x1F, 2, 127, 20, 0, 0],
            InitiateBlockUpload { at: AT, crc: true, blksize: 127, pst: 20 },
        ),
        ([0xA1, 0, 0, 0, 0, 0, 0, 0], EndBlockUpload),
        ([0xA2, 5, 64, 0, 0, 0, 0, 0], AckBlockUpload(BlockAck { ackseq: 5, blksize: 64 })),
        ([0xA3, 0, 0, 0, 0, 0, 0, 0], StartBlockUpload),
    ];
    for (bytes, fields) in table {
        assert_eq!(Request::parse(&bytes), Some(fields));
        assert_eq!(fields.emit(), bytes);
    }
    assert_eq!(Request::parse(&[0xE0; 8]), None);
}

#[test]
fn responses() {
    use Response::*;
    let table = [
        ([0x60, 0x50, 0x1F, 2, 0, 0, 0, 0], InitiateDownload(AT)),
        ([0x20, 0, 0, 0, 0, 0, 0, 0], DownloadSegment(false)),
        ([0x30, 0, 0, 0, 0, 0, 0, 0], DownloadSegment(true)),
        ([0x4F, 0x50, 0x1F, 2, 1, 0, 0, 0], InitiateUpload(AT, Expedited(Chunk::new(&[1])))),
        ([0x42, 0x50, 0x1F, 2, 1, 2, 3, 4], InitiateUpload(AT, Unsized([1, 2, 3, 4]))),
        ([0x41, 0x50, 0x1F, 2, 8, 0, 0, 0], InitiateUpload(AT, Segmented(Some(8)))),
        ([0x40, 0x50, 0x1F, 2, 0, 0, 0, 0], InitiateUpload(AT, Segmented(None))),
        ([0x10, 1, 2, 3, 4, 5, 6, 7], UploadSegment(segment(true, false, &[1, 2, 3, 4, 5, 6, 7]))),
        ([0x0F, 0, 0, 0, 0, 0, 0, 0], UploadSegment(segment(false, true, &[]))),
        ([0x80, 0x50, 0x1F, 2, 0x11, 0x00, 0x09, 0x06], Abort(AT, AbortCode(0x0609_0011))),
        ([0xA4, 0x50, 0x1F, 2, 127, 0, 0, 0], InitiateBlockDownload { at: AT, crc: true, blksize: 127 }),
        ([0xA1, 0, 0, 0, 0, 0, 0, 0], EndBlockDownload),
        ([0xA2, 127, 10, 0, 0, 0, 0, 0], AckBlockDownload(BlockAck { ackseq: 127, blksize: 10 })),
        ([0xC6, 0x50, 0x1F, 2, 3, 0, 0, 0], InitiateBlockUpload { at: AT, crc: true, size: Some(3) }),
        ([0xC0, 0x50, 0x1F, 2, 0, 0, 0, 0], InitiateBlockUpload { at: AT, crc: false, size: None }),
        ([0xD1, 0xCD, 0xAB, 0, 0, 0, 0, 0], EndBlockUpload(BlockEnd { unused: 4, crc: 0xABCD })),
    ];
    for (bytes, fields) in table {
        assert_eq!(Response::parse(&bytes), Some(fields));
        assert_eq!(fields.emit(), bytes);
    }
    assert_eq!(Response::parse(&[0xE0; 8]), None);
    assert_eq!(Response::parse(&[0xA3; 8]), None);
}

#[test]
fn block_segments() {
    let segment = BlockSegment { last: true, seqno: 127, data: [1, 2, 3, 4, 5, 6, 7] };
    assert_eq!(BlockSegment::parse(&[0xFF, 1, 2, 3, 4, 5, 6, 7]), Some(segment));
    assert_eq!(segment.emit(), [0xFF, 1, 2, 3, 4, 5, 6, 7]);
    let segment = BlockSegment { last: false, seqno: 1, data: [0; 7] };
    assert_eq!(BlockSegment::parse(&[0x01, 0, 0, 0, 0, 0, 0, 0]), Some(segment));
    // An abort is not a segment.
    assert_eq!(BlockSegment::parse(&[0x80, 0x50, 0x1F, 2, 0x11, 0x00, 0x09, 0x06]), None);
    assert_eq!(BlockSegment::parse(&[0x00; 8]), None);
}

/// CiA 301 table 22, copied.
#[test]
fn abort_codes() {
    let table = [
        (AbortCode::TOGGLE, 0x0503_0000_u32),
        (AbortCode::TIMEOUT, 0x0504_0000),
        (AbortCode::COMMAND, 0x0504_0001),
        (AbortCode::BLOCK_SIZE, 0x0504_0002),
        (AbortCode::SEQUENCE_NUMBER, 0x0504_0003),
        (AbortCode::CRC, 0x0504_0004),
        (AbortCode::OUT_OF_MEMORY, 0x0504_0005),
        (AbortCode::UNSUPPORTED_ACCESS, 0x0601_0000),
        (AbortCode::WRITE_ONLY, 0x0601_0001),
        (AbortCode::READ_ONLY, 0x0601_0002),
        (AbortCode::NO_OBJECT, 0x0602_0000),
        (AbortCode::NOT_MAPPABLE, 0x0604_0041),
        (AbortCode::PDO_LENGTH, 0x0604_0042),
        (AbortCode::PARAMETER, 0x0604_0043),
        (AbortCode::INTERNAL, 0x0604_0047),
        (AbortCode::HARDWARE, 0x0606_0000),
        (AbortCode::LENGTH, 0x0607_0010),
        (AbortCode::LENGTH_TOO_HIGH, 0x0607_0012),
        (AbortCode::LENGTH_TOO_LOW, 0x0607_0013),
        (AbortCode::NO_SUB_INDEX, 0x0609_0011),
        (AbortCode::INVALID_VALUE, 0x0609_0030),
        (AbortCode::VALUE_TOO_HIGH, 0x0609_0031),
        (AbortCode::VALUE_TOO_LOW, 0x0609_0032),
        (AbortCode::RANGE, 0x0609_0036),
        (AbortCode::RESOURCE, 0x060A_0023),
        (AbortCode::GENERAL, 0x0800_0000),
        (AbortCode::STORE, 0x0800_0020),
        (AbortCode::LOCAL_CONTROL, 0x0800_0021),
        (AbortCode::DEVICE_STATE, 0x0800_0022),
        (AbortCode::NO_DICTIONARY, 0x0800_0023),
        (AbortCode::NO_DATA, 0x0800_0024),
    ];
    for (name, code) in table {
        assert_eq!(name, AbortCode(code));
        assert!(!name.to_string().contains("manufacturer"), "{name}");
    }
    assert_eq!(AbortCode(0x0503_0000).to_string(), "05030000h (toggle bit not alternated)");
    assert_eq!(AbortCode(0xDEAD_BEEF).to_string(), "DEADBEEFh (code of the manufacturer)");
}
