//! Describes frames in words, for `monitor`.

use std::collections::HashMap;
use std::fmt::Write as _;

use canopen::debugger::{Stop, DEBUGGER, USER_SOFTWARE};
use canopen::emcy::Emergency;
use canopen::nmt::{parse_state_message, NmtState};
use canopen::program::{self, FlashStatus, ProgramControl, BOOTLOADER_DEVICE_TYPE};
use canopen::sdo::wire::{BlockSegment, Payload, Request, Response};
use canopen::{Address, CobId, Frame, NodeId};
use embedded_can::Frame as _;

/// Describes frames in words. It remembers the transfers whose start it has seen, because a segment
/// of a block transfer does not say that it is one.
#[derive(Debug, Default)]
pub struct Decoder {
    blocks: HashMap<NodeId, Block>,
    /// The object that a node's current transfer reads or writes.
    at: HashMap<NodeId, Address>,
}

/// A block transfer in progress.
#[derive(Clone, Copy, Debug)]
struct Block {
    /// The client sends the data.
    download: bool,
    blksize: u8,
    part: Part,
}

#[derive(Clone, Copy, Debug)]
enum Part {
    /// The next frames are segments.
    Segments,
    /// The next frame is an acknowledgement. `last`: the last segment was marked as the last one.
    Ack { seqno: u8, last: bool },
    /// The next frame ends the transfer.
    End,
}

impl Decoder {
    /// A decoder that has seen no frame yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Describes a frame.
    pub fn decode(&mut self, frame: &Frame) -> String {
        let Some(id) = frame.cob_id() else {
            return if frame.is_remote_frame() {
                format!("remote frame of {} bytes", frame.dlc())
            } else {
                "29-bit identifier: not CANopen".to_string()
            };
        };
        let node = NodeId::new((id.get() & 0x7F) as u8);
        match (id.get() & 0x780, node) {
            _ if id == CobId::NMT => nmt(frame.data()),
            _ if id == CobId::LSS_REQUEST => lss(frame, "master"),
            _ if id == CobId::LSS_RESPONSE => lss(frame, "slave"),
            (0x080, None) => "SYNC".to_string(),
            (0x100, None) => "TIME".to_string(),
            (0x080, Some(node)) => emergency(node, frame),
            (0x580, Some(node)) => match frame.exactly() {
                Some(bytes) => format!("node {node}: {}", self.response(node, bytes)),
                None => format!("node {node}: SDO answer of {} bytes, not 8", frame.dlc()),
            },
            (0x600, Some(node)) => match frame.exactly() {
                Some(bytes) => format!("to node {node}: {}", self.request(node, bytes)),
                None => format!("to node {node}: SDO request of {} bytes, not 8", frame.dlc()),
            },
            (0x700, Some(node)) => match (parse_state_message(frame), frame.data()) {
                (Some((_, NmtState::Initialisation)), _) => format!("node {node}: boot-up"),
                (Some((_, state)), _) => format!("node {node}: heartbeat, {}", state_words(state)),
                (None, [byte]) => format!("node {node}: heartbeat with unknown state {byte:02X}h"),
                (None, _) => format!("node {node}: heartbeat of {} bytes, not 1", frame.dlc()),
            },
            (function @ 0x180..=0x500, Some(node)) => {
                let (kind, first) = if function & 0x80 != 0 { ("TPDO", 0x180) } else { ("RPDO", 0x200) };
                let number = (function - first) / 0x100 + 1;
                format!("node {node}: {kind}{number}")
            }
            _ => "unknown identifier".to_string(),
        }
    }

    fn request(&mut self, node: NodeId, bytes: &[u8; 8]) -> String {
        if let Some(words) = self.block_data(node, bytes, true) {
            return words;
        }
        let Some(request) = Request::parse(bytes) else {
            return format!("SDO request with unknown command {:02X}h", bytes[0]);
        };
        match request {
            Request::InitiateDownload(at, payload) => {
                self.at.insert(node, at);
                match value(payload) {
                    Ok(data) => format!("write {} = {}", object(at), worded(at, &data)),
                    Err(size) => format!("write {}, {} in segments", object(at), size_words(size)),
                }
            }
            Request::DownloadSegment(segment) => self.segment(node, &segment.data, segment.last, "write"),
            Request::InitiateUpload(at) => {
                self.at.insert(node, at);
                format!("read {}", object(at))
            }
            Request::UploadSegment(_) => format!("read on {}", self.whose(node)),
            Request::Abort(at, code) => {
                self.blocks.remove(&node);
                format!("abort {}: {code}", object(at))
            }
            Request::InitiateBlockDownload { at, size, .. } => {
                self.at.insert(node, at);
                format!("write {}, {} as blocks", object(at), size_words(size))
            }
            Request::EndBlockDownload(end) => {
                format!("end of blocks {}, CRC {:04X}h", self.whose(node), end.crc)
            }
            Request::InitiateBlockUpload { at, blksize, .. } => {
                self.at.insert(node, at);
                let block = Block { download: false, blksize, part: Part::End };
                self.blocks.insert(node, block);
                format!("read {} as blocks of {blksize} segments", object(at))
            }
            Request::StartBlockUpload => {
                if let Some(block) = self.blocks.get_mut(&node) {
                    block.part = Part::Segments;
                }
                "start of blocks".to_string()
            }
            Request::AckBlockUpload(ack) => self.ack(node, ack.ackseq, ack.blksize),
            Request::EndBlockUpload => {
                self.blocks.remove(&node);
                format!("all blocks {} have arrived", self.whose(node))
            }
        }
    }

    fn response(&mut self, node: NodeId, bytes: &[u8; 8]) -> String {
        if let Some(words) = self.block_data(node, bytes, false) {
            return words;
        }
        let Some(response) = Response::parse(bytes) else {
            return format!("SDO answer with unknown command {:02X}h", bytes[0]);
        };
        match response {
            Response::InitiateDownload(at) => format!("{} is taken", object(at)),
            Response::DownloadSegment(_) => format!("segment {} is taken", self.whose(node)),
            Response::InitiateUpload(at, payload) => match value(payload) {
                Ok(data) => format!("{} is {}", object(at), worded(at, &data)),
                Err(size) => format!("{} has {} in segments", object(at), size_words(size)),
            },
            Response::UploadSegment(segment) => self.segment(node, &segment.data, segment.last, "read"),
            Response::Abort(at, code) => {
                self.blocks.remove(&node);
                format!("abort {}: {code}", object(at))
            }
            Response::InitiateBlockDownload { at, blksize, .. } => {
                self.blocks.insert(node, Block { download: true, blksize, part: Part::Segments });
                format!("{} may come, {blksize} segments at a time", object(at))
            }
            Response::AckBlockDownload(ack) => self.ack(node, ack.ackseq, ack.blksize),
            Response::EndBlockDownload => {
                let words = format!("blocks {} are taken", self.whose(node));
                self.blocks.remove(&node);
                words
            }
            Response::InitiateBlockUpload { at, size, .. } => {
                format!("{} has {} as blocks", object(at), size_words(size))
            }
            Response::EndBlockUpload(end) => {
                format!("end of blocks {}, CRC {:04X}h", self.whose(node), end.crc)
            }
        }
    }

    /// A segment of a block transfer, if the sender of the frame is the side that sends the data.
    fn block_data(&mut self, node: NodeId, bytes: &[u8; 8], by_client: bool) -> Option<String> {
        let block = self.blocks.get_mut(&node).filter(|block| block.download == by_client)?;
        let Part::Segments = block.part else { return None };
        // Segment number 0 does not exist: a frame with this first byte is an abort.
        let segment = BlockSegment::parse(bytes)?;
        let BlockSegment { seqno, last, data } = segment;
        block.part = if last || seqno >= block.blksize { Part::Ack { seqno, last } } else { Part::Segments };
        let end = if last { ", the last one" } else { "" };
        Some(format!("block segment {seqno}{end}: {}", hex(&data)))
    }

    fn ack(&mut self, node: NodeId, ackseq: u8, blksize: u8) -> String {
        if let Some(block) = self.blocks.get_mut(&node) {
            let done = matches!(block.part, Part::Ack { seqno, last: true } if seqno == ackseq);
            block.blksize = blksize;
            block.part = if done { Part::End } else { Part::Segments };
        }
        format!("segments up to {ackseq} have arrived, {blksize} may follow")
    }

    fn segment(&self, node: NodeId, data: &[u8], last: bool, what: &str) -> String {
        let end = if last { ", the last one" } else { "" };
        format!("{what} segment {}{end}: {}", self.whose(node), hex(data))
    }

    /// The words for the object that a segment belongs to.
    fn whose(&self, node: NodeId) -> String {
        match self.at.get(&node) {
            Some(at) => format!("of {}", object(*at)),
            None => "of an unknown object".to_string(),
        }
    }
}

fn nmt(data: &[u8]) -> String {
    let [command, node] = data else { return format!("NMT of {} bytes, not 2", data.len()) };
    let command = match command {
        0x01 => "start".to_string(),
        0x02 => "stop".to_string(),
        0x80 => "enter pre-operational".to_string(),
        0x81 => "reset node".to_string(),
        0x82 => "reset communication".to_string(),
        other => format!("unknown command {other:02X}h"),
    };
    match node {
        0 => format!("NMT to all nodes: {command}"),
        node => format!("NMT to node {node}: {command}"),
    }
}

/// The words for an NMT state.
#[must_use]
pub fn state_words(state: NmtState) -> &'static str {
    match state {
        NmtState::Initialisation => "boot-up",
        NmtState::Stopped => "stopped",
        NmtState::Operational => "operational",
        NmtState::PreOperational => "pre-operational",
    }
}

fn emergency(node: NodeId, frame: &Frame) -> String {
    let Some(bytes) = frame.exactly() else {
        return format!("node {node}: EMCY of {} bytes, not 8", frame.dlc());
    };
    let Emergency { code, register, detail } = Emergency::parse(bytes);
    // CiA 301 table 26, by the first digits of the error code.
    let words = match code {
        0x0000..=0x00FF => "no error any more",
        0x1000..=0x10FF => "generic error",
        0x2000..=0x2FFF => "current",
        0x3000..=0x3FFF => "voltage",
        0x4000..=0x4FFF => "temperature",
        0x5000..=0x50FF => "device hardware",
        0x6100..=0x61FF => "internal software",
        USER_SOFTWARE => match Stop::from_number(detail[0]) {
            Some(Stop::Breakpoint) => "user software; from a debugger: stopped at a breakpoint",
            Some(Stop::Step) => "user software; from a debugger: stopped",
            Some(Stop::OutOfReach) => "user software; from a debugger: a breakpoint out of reach",
            None => "user software",
        },
        0x6201..=0x62FF => "user software",
        0x6300..=0x63FF => "data set",
        0x6000..=0x6FFF => "device software",
        0x7000..=0x70FF => "additional modules",
        0x8110 => "CAN overrun, frames were lost",
        0x8120 => "CAN in error passive mode",
        0x8130 => "life guard or heartbeat error",
        0x8140 => "recovered from bus-off",
        0x8150 => "CAN identifier collision",
        0x8100..=0x81FF => "communication",
        0x8200..=0x82FF => "protocol error",
        0x8000..=0x80FF => "monitoring",
        0x9000..=0x90FF => "external error",
        0xF000..=0xF0FF => "additional functions",
        0xFF00..=0xFFFF => "device specific",
        _ => "unknown",
    };
    format!(
        "node {node}: EMCY {code:04X}h ({words}), error register {register:02X}h, detail {}",
        hex(&detail)
    )
}

fn lss(frame: &Frame, who: &str) -> String {
    let Some(bytes) = frame.exactly::<8>() else {
        return format!("LSS of {} bytes, not 8", frame.dlc());
    };
    let [command, a, b, c, d, bit, part, next] = *bytes;
    let number = u32::from_le_bytes([a, b, c, d]);
    let result = |what: &str| match (a, b) {
        (0, _) => format!("{what} is taken"),
        (code, 0) => format!("{what} is refused, error {code}"),
        (code, detail) => format!("{what} is refused, error {code}, manufacturer's code {detail}"),
    };
    const PARTS: [&str; 4] = ["vendor-ID", "product code", "revision", "serial number"];
    let slave = who == "slave";
    let words = match command {
        0x04 if a == 0 => "all devices wait".to_string(),
        0x04 => "all devices to configuration".to_string(),
        0x11 if slave => result("node-ID"),
        0x11 if a == 0xFF => "take the node-ID away".to_string(),
        0x11 => format!("take node-ID {a}"),
        0x13 if slave => result("bit rate"),
        0x13 => format!("take bit rate {b} of table {a}"),
        0x15 => format!("change over to the bit rate after {} ms", u16::from_le_bytes([a, b])),
        0x17 if slave => result("storing"),
        0x17 => "store".to_string(),
        0x40..=0x43 => format!("select {} {number:08X}h", PARTS[usize::from(command - 0x40)]),
        0x44 => "selected".to_string(),
        0x46..=0x4B => format!("identify, step {}: {number:08X}h", command - 0x45),
        0x4C => "who has no node-ID?".to_string(),
        0x4F => "here".to_string(),
        0x50 => "here, without node-ID".to_string(),
        0x51 if bit == 0x80 => "fastscan: who has no node-ID?".to_string(),
        0x51 => {
            let part = PARTS.get(usize::from(part)).copied().unwrap_or("unknown part");
            format!("fastscan: {part} {number:08X}h down to bit {bit}, then part {next}")
        }
        0x5A..=0x5D if slave => format!("{} is {number:08X}h", PARTS[usize::from(command - 0x5A)]),
        0x5A..=0x5D => format!("ask for the {}", PARTS[usize::from(command - 0x5A)]),
        0x5E if slave && a == 0xFF => "no node-ID".to_string(),
        0x5E if slave => format!("node-ID is {a}"),
        0x5E => "ask for the node-ID".to_string(),
        other => format!("unknown command {other:02X}h"),
    };
    format!("LSS {who}: {words}")
}

/// The data of an initiate frame, or the number of bytes that follow.
fn value(payload: Payload) -> Result<Vec<u8>, Option<u32>> {
    match payload {
        Payload::Expedited(data) => Ok(data.to_vec()),
        Payload::Unsized(data) => Ok(data.to_vec()),
        Payload::Segmented(size) => Err(size),
    }
}

fn size_words(size: Option<u32>) -> String {
    match size {
        Some(size) => format!("{size} bytes"),
        None => "an unknown number of bytes".to_string(),
    }
}

/// An object with its name, if this tool knows the name.
fn object(at: Address) -> String {
    let name = match (at.index, at.sub) {
        (program::DEVICE_TYPE, _) => "device type",
        (program::ERROR_REGISTER, _) => "error register",
        (program::ERROR_FIELD, _) => "error field",
        (program::DEVICE_NAME, _) => "device name",
        (program::HARDWARE_VERSION, _) => "hardware version",
        (program::SOFTWARE_VERSION, _) => "software version",
        (DEBUGGER, 1) => "debugger command",
        (DEBUGGER, 2) => "debugger status",
        (DEBUGGER, 4) => "debugger data",
        (program::COB_ID_EMCY, _) => "COB-ID of EMCY",
        (program::HEARTBEAT_TIME, _) => "heartbeat time",
        (program::IDENTITY, 1) => "vendor-ID",
        (program::IDENTITY, 2) => "product code",
        (program::IDENTITY, 3) => "revision",
        (program::IDENTITY, 4) => "serial number",
        (program::PROGRAM_DATA, _) => "program data",
        (program::PROGRAM_CONTROL, _) => "program control",
        (program::PROGRAM_DATE, 1) => "program date",
        (program::PROGRAM_DATE, 2) => "program time",
        (program::PROGRAM_ID, _) => "program CRC",
        (program::FLASH_STATUS, _) => "flash status",
        _ => return at.to_string(),
    };
    format!("{at} ({name})")
}

/// A value with its meaning, if this tool knows the meaning.
fn worded(at: Address, data: &[u8]) -> String {
    let number = data.iter().rev().fold(0u32, |number, byte| number << 8 | u32::from(*byte));
    let digits = data.len() * 2;
    let mut words = format!("{number:0digits$X}h");
    let meaning = match (at.index, at.sub) {
        (program::DEVICE_TYPE, 0) if number == BOOTLOADER_DEVICE_TYPE => Some("bootloader".to_string()),
        (program::DEVICE_TYPE, 0) => Some("application".to_string()),
        (program::PROGRAM_CONTROL, 1..) => u8::try_from(number).ok().and_then(|value| {
            Some(
                match ProgramControl::try_from(value).ok()? {
                    ProgramControl::Stop => "stop, or stopped",
                    ProgramControl::Start => "start, or running",
                    ProgramControl::ResetStat => "reset status",
                    ProgramControl::Clear => "clear",
                    ProgramControl::StartBootloader => "start the bootloader",
                    ProgramControl::SetSignature => "release for autostart",
                    ProgramControl::ClrSignature => "withdraw the release",
                }
                .to_string(),
            )
        }),
        (program::FLASH_STATUS, 1..) => {
            let status = FlashStatus::from_word(number);
            Some(match (status.busy, status.error) {
                (true, _) => "busy".to_string(),
                (false, None) => "ok".to_string(),
                (false, Some(error)) => error.to_string(),
            })
        }
        _ => None,
    };
    if let Some(meaning) = meaning {
        // Writing to a String cannot fail.
        let _ = write!(words, " ({meaning})");
    }
    words
}

fn hex(bytes: &[u8]) -> String {
    let words: Vec<String> = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
    words.join(" ")
}
