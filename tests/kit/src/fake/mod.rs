//! A fake device: an adapter with virtual time that plays a bootloader and an application, written
//! from the manual and from CiA 301 byte by byte, without the product's own server.

use std::collections::VecDeque;
use std::io;
use std::time::Duration;

use canopen::{CobId, Frame};
use coboot_can::{Adapter, AdapterError};

pub mod lift;
pub mod renewal;
mod serve;
pub mod vault;

pub use self::serve::serve;
pub use crate::crc::crc16;

/// In place of the abort code for an object: no answer at all.
pub const SILENT: u32 = 0;
pub const NODE: u8 = 5;
pub const APPLICATION: u32 = 0x0002_0192;
pub const BOOTLOADER: u32 = 0x1000_0000;

/// The fake's reaction to a block or a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Normal.
    Accept,
    /// Acknowledged; then 1F57h has this value.
    Status(u32),
    /// Refused with an abort.
    Abort(u32),
    /// Refused with an abort; then 1F57h has the second value.
    AbortStatus(u32, u32),
    /// Carried out, but the acknowledgement is lost.
    LoseAnswer,
    /// Lost.
    LoseRequest,
    /// Acknowledged, but not carried out.
    Ignore,
}

/// The fake's reaction to a block download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blocks {
    /// It supports block transfer, with this many segments in a sub-block.
    Known(u8),
    /// It aborts block transfer with this code.
    Refused(u32),
    /// It does not know block transfer and does not answer.
    Ignored,
}

/// Objects of another manufacturer, which precede the fake's own.
pub trait Maker: Send {
    /// The value of an object while this device type runs; `None` for the fake's own value.
    fn value(&mut self, _at: (u16, u8), _running: u32) -> Option<Result<Vec<u8>, u32>> {
        None
    }
    /// The result of writing a value; `None` for the fake's own.
    fn write(&mut self, _at: (u16, u8), _data: &[u8], _running: u32) -> Option<Result<Deed, u32>> {
        None
    }
    /// The state after NMT reset node: node-ID and device type; `None` for the fake's own.
    fn reset(&mut self, _running: u32) -> Option<(u8, u32)> {
        None
    }
}

/// The action of a device after its answer.
pub enum Deed {
    Nothing,
    /// It restarts with this node-ID and this device type.
    Restart(u8, u32),
    /// The same, with this time in place of the usual one.
    RestartIn(Duration, u8, u32),
}

/// The end of a program that the fake has started.
#[derive(Clone, Copy, Debug)]
pub enum End {
    /// A reset, after which this device type runs; nothing if it stays silent.
    Reset { after: Duration, into: Option<u32> },
    /// It sends an emergency 6000h, and goes on.
    Panic { after: Duration },
}

type Script<T> = Box<dyn FnMut(T) -> Outcome + Send>;

pub struct Fake {
    pub node: u8,
    /// Its program: the sub-index of 1F50h, 1F51h, 1F56h and 1F57h.
    pub program: u8,
    pub now: Duration,
    /// The device type of what runs; `None` while it restarts or is absent.
    pub running: Option<u32>,
    restart: Option<(Duration, Option<u32>)>,
    busy_until: Duration,
    status: u32,
    /// What 1F56h reads instead of the last block's CRC.
    pub crc: Option<u32>,
    /// The same while the application runs.
    pub crc_of_application: Option<u32>,
    /// Whether the device does not answer while it is busy.
    pub deaf_while_busy: bool,
    /// What 1F50h/1 reads, if the device allows that.
    pub readable: Option<Vec<u8>>,
    pub erase_time: Duration,
    /// The CRC of the program that it has, and how many commands CLEAR erase it if no data come.
    pub had: Option<(u32, u32)>,
    pub restart_time: Duration,
    /// How long it still answers before it restarts.
    pub leave_time: Duration,
    leaves_at: Option<Duration>,
    /// What START starts.
    pub starts: Option<u32>,
    /// The ends of the next programs that it starts; `None` for one that goes on.
    pub ends: VecDeque<Option<End>>,
    /// 2007h/2 to 4, if the device has them.
    pub state: Option<[u8; 3]>,
    /// 2007h/6 and 7, if the device has them: option bytes and supply.
    pub chip: Option<(u32, u8)>,
    /// 2007h/10, if the device has it.
    pub watchdog_ms: Option<u16>,
    /// How long an answer takes.
    pub latency: Duration,
    /// How much longer each of the next answers takes.
    pub delays: VecDeque<Duration>,
    pub on_block: Script<u32>,
    pub on_command: Script<u8>,
    pub knows_blocks: Blocks,
    /// Lost segments of block downloads, counted from the start.
    pub lost_segments: Vec<usize>,
    /// Altered segments of block downloads, counted from the start: the CRC of the transfer finds
    /// them.
    pub altered_segments: Vec<usize>,
    /// The largest value that 1F50h takes, as its announced size: a larger one is refused with
    /// 06070012h.
    pub room: usize,
    /// The CRC that it checks blocks with; `None` checks none.
    pub crc_of_blocks: Option<fn(&[u8]) -> u32>,
    /// The segment of a block download at which the device aborts; from then on 1F57h has this
    /// value.
    pub refuses_segment: Option<(usize, u32)>,
    segments: usize,
    /// The number of block downloads that were started.
    pub block_downloads: usize,
    /// Frames that come before each answer.
    pub noise: Vec<Frame>,
    /// The number of frames after which the adapter is gone.
    pub frames_left: usize,
    /// The received requests, in short words.
    pub log: Vec<String>,
    /// The accepted blocks, without the framing of SDO.
    pub blocks: Vec<Vec<u8>>,
    next_block: u32,
    download: Option<Download>,
    upload: Option<(Vec<u8>, u8)>,
    outbox: VecDeque<(Duration, Frame)>,
    emergency: Option<(Duration, Frame)>,
    pub sent: Vec<Frame>,
    /// When each of them was sent.
    pub sent_at: Vec<Duration>,
    /// The other manufacturer's objects, if there are any.
    pub maker: Option<Box<dyn Maker>>,
    next_node: u8,
}

struct Download {
    at: (u16, u8),
    size: usize,
    data: Vec<u8>,
    toggle: u8,
    /// Of a block download: the last segment in order of this sub-block, and whether it was the
    /// last of all.
    sub_block: Option<(u8, bool)>,
}

impl Fake {
    pub fn new(running: u32) -> Self {
        Self {
            node: NODE,
            program: 1,
            now: Duration::from_secs(1000),
            running: Some(running),
            restart: None,
            busy_until: Duration::ZERO,
            status: 0,
            crc: None,
            had: None,
            crc_of_application: None,
            deaf_while_busy: false,
            readable: None,
            erase_time: Duration::from_secs(2),
            restart_time: Duration::from_millis(300),
            leave_time: Duration::ZERO,
            leaves_at: None,
            starts: Some(APPLICATION),
            ends: VecDeque::new(),
            state: None,
            chip: None,
            watchdog_ms: None,
            latency: Duration::from_micros(500),
            delays: VecDeque::new(),
            on_block: Box::new(|_| Outcome::Accept),
            on_command: Box::new(|_| Outcome::Accept),
            knows_blocks: Blocks::Refused(0x0504_0001),
            lost_segments: Vec::new(),
            altered_segments: Vec::new(),
            room: usize::MAX,
            crc_of_blocks: None,
            refuses_segment: None,
            segments: 0,
            block_downloads: 0,
            noise: Vec::new(),
            frames_left: usize::MAX,
            log: Vec::new(),
            blocks: Vec::new(),
            next_block: 0,
            download: None,
            upload: None,
            outbox: VecDeque::new(),
            emergency: None,
            sent: Vec::new(),
            sent_at: Vec::new(),
            maker: None,
            next_node: NODE,
        }
    }

    /// The same device with another node-ID, which it keeps, and with its program under another number.
    pub fn at(self, node: u8, program: u8) -> Self {
        Self { node, next_node: node, program, ..self }
    }

    /// The log without reads.
    pub fn writes(&self) -> Vec<&str> {
        self.log.iter().map(String::as_str).filter(|entry| !entry.starts_with("read")).collect()
    }

    pub fn count(&self, entry: &str) -> usize {
        self.log.iter().filter(|found| *found == entry).count()
    }

    fn answer(&mut self, data: [u8; 8]) {
        self.outbox.extend(self.noise.iter().map(|frame| (self.now, *frame)));
        let id = CobId::new(0x580 + u16::from(self.node)).unwrap();
        let delay = self.delays.pop_front().unwrap_or_default();
        self.outbox.push_back((self.now + self.latency + delay, Frame::of(id, &data)));
    }

    fn abort(&mut self, at: (u16, u8), code: u32) {
        (self.download, self.upload) = (None, None);
        self.answer(initiate(0x80, at, code));
    }

    fn busy(&self) -> bool {
        self.now < self.busy_until
    }

    /// What 1F57h reads from now on.
    pub fn status(&mut self, word: u32) {
        self.status = word;
    }

    /// A frame of somebody else's, so long from now.
    pub fn later(&mut self, after: Duration, frame: Frame) {
        self.outbox.push_back((self.now + after, frame));
    }

    /// A frame that is on the bus already.
    pub fn inject(&mut self, frame: Frame) {
        self.outbox.push_back((self.now, frame));
    }

    fn tick(&mut self) {
        if let Some((at, frame)) = self.emergency.take_if(|(at, _)| *at <= self.now) {
            self.outbox.push_back((at, frame));
        }
        if self.leaves_at.is_some_and(|at| at <= self.now) {
            self.leaves_at = None;
            self.running = None;
            (self.download, self.upload) = (None, None);
        }
        if let Some((at, next)) = self.restart.filter(|(at, _)| *at <= self.now) {
            (self.restart, self.running) = (None, next);
            if self.maker.is_some() {
                self.node = self.next_node;
            }
            if next.is_some() {
                let id = CobId::new(0x700 + u16::from(self.node)).unwrap();
                self.outbox.push_back((at, Frame::of(id, &[0])));
            }
            if next == Some(APPLICATION) {
                if let Some(Some(end)) = self.ends.pop_front() {
                    self.end_later(at, end);
                }
            }
        }
    }

    /// A program that started at this time ends.
    fn end_later(&mut self, at: Duration, end: End) {
        match end {
            End::Reset { after, into } => self.restart = Some((at + after, into)),
            End::Panic { after } => {
                let id = CobId::new(0x80 + u16::from(self.node)).unwrap();
                self.emergency = Some((at + after, Frame::of(id, &[0x00, 0x60, 0x01, 0, 0, 0, 0, 0])));
            }
        }
    }

    /// Waits for its next frame, at most until `until`.
    pub fn next_at(&self, until: Duration) -> Option<Duration> {
        let frame = self.outbox.front().map(|(at, _)| (*at).max(self.now));
        let boot_up = self.restart.filter(|(_, next)| next.is_some()).map(|(at, _)| at.max(self.now));
        [frame, boot_up].into_iter().flatten().min().filter(|at| *at <= until)
    }

    fn restart_into(&mut self, next: Option<u32>) {
        self.restart_within(self.restart_time, next);
    }

    fn restart_within(&mut self, time: Duration, next: Option<u32>) {
        self.leaves_at = Some(self.now + self.leave_time);
        self.restart = Some((self.now + self.leave_time + time, next));
    }

    /// A frame of a block download (CiA 301, 7.2.4.3.9 to 11), if one is under way; says whether
    /// it was one.
    fn block_frame(&mut self, bytes: [u8; 8]) -> bool {
        let Blocks::Known(blksize) = self.knows_blocks else { return false };
        let Some(Download { at, data, size, sub_block: Some((seqno, ended)), .. }) = &mut self.download
        else {
            return false;
        };
        let download_at = *at;
        if !*ended {
            // An abort looks like a segment with number 0, which does not exist.
            if bytes[0] == 0x80 {
                return false;
            }
            self.segments += 1;
            if let Some((_, status)) = self.refuses_segment.filter(|(segment, _)| *segment == self.segments) {
                self.status = status;
                self.abort((0x1F50, 1), 0x0800_0020);
                return true;
            }
            let (number, last) = (bytes[0] & 0x7F, bytes[0] & 0x80 != 0);
            if !self.lost_segments.contains(&self.segments) && number == *seqno + 1 {
                *seqno = number;
                *ended = last;
                data.extend_from_slice(&bytes[1..]);
                if self.altered_segments.contains(&self.segments) {
                    *data.last_mut().unwrap() ^= 1;
                }
            }
            // A sub-block ends with its last segment, even if segments are missing.
            if number == blksize || last {
                let ackseq = std::mem::take(seqno);
                self.answer([0xA2, ackseq, blksize, 0, 0, 0, 0, 0]);
            }
            return true;
        }
        if bytes[0] & 0xE3 != 0xC1 {
            return false;
        }
        data.truncate(data.len() - usize::from(bytes[0] >> 2 & 7));
        assert_eq!(data.len(), *size);
        if u16::from_le_bytes([bytes[1], bytes[2]]) != crc16(data) {
            assert!(!self.altered_segments.is_empty());
            let at = download_at;
            self.abort(at, 0x0504_0004);
            return true;
        }
        let Some(download) = self.download.take() else { return true };
        self.write(download.at, download.data, [0xA1, 0, 0, 0, 0, 0, 0, 0]);
        true
    }

    fn request(&mut self, bytes: [u8; 8]) {
        if self.block_frame(bytes) {
            return;
        }
        let at = (u16::from_le_bytes([bytes[1], bytes[2]]), bytes[3]);
        let word = u32::from_le_bytes(bytes[4..].try_into().unwrap());
        match bytes[0] {
            0x40 => self.initiate_upload(at),
            command @ (0x60 | 0x70) => self.upload_segment(command),
            // Initiate download, segmented with size.
            0x21 => {
                self.download =
                    Some(Download { at, size: word as usize, data: Vec::new(), toggle: 0, sub_block: None });
                if at.0 == 0x1F50 && self.busy() {
                    self.status = 0x86;
                    return self.abort(at, 0x0800_0022);
                }
                self.answer(initiate(0x60, at, 0));
            }
            // Initiate download, expedited with size.
            command if command & 0xE3 == 0x23 => {
                let len = 4 - usize::from(command >> 2 & 3);
                self.write(at, bytes[4..4 + len].to_vec(), initiate(0x60, at, 0));
            }
            command if command & 0xE0 == 0 => self.download_segment(bytes),
            // Initiate block download with size and CRC.
            0xC6 => self.initiate_block_download(at, word as usize),
            // Initiate block upload: a server may answer it without blocks (CiA 301, 7.2.4.3.15).
            0xA4 if matches!(self.knows_blocks, Blocks::Known(_)) => self.initiate_upload(at),
            0xA4 => self.abort(at, 0x0504_0001),
            0x80 => {
                self.log.push(format!("abort {word:08X}"));
                (self.download, self.upload) = (None, None);
            }
            // Segments of an ended transfer.
            _ if self.refuses_segment.is_some() => self.abort((0, 0), 0x0504_0001),
            other => panic!("unexpected command {other:02X}"),
        }
    }

    fn initiate_upload(&mut self, at: (u16, u8)) {
        self.log.push(format!("read {:04X}/{}", at.0, at.1));
        match self.value(at) {
            Ok(value) if value.len() <= 4 => {
                let mut word = [0; 4];
                word[..value.len()].copy_from_slice(&value);
                let command = 0x43 | ((4 - value.len() as u8) << 2);
                self.answer(initiate(command, at, u32::from_le_bytes(word)));
            }
            Ok(value) => {
                self.answer(initiate(0x41, at, value.len() as u32));
                self.upload = Some((value, 0));
            }
            Err(SILENT) => {}
            Err(code) => self.abort(at, code),
        }
    }

    fn upload_segment(&mut self, command: u8) {
        let Some((value, toggle)) = &mut self.upload else { return self.abort((0, 0), 0x0504_0001) };
        assert_eq!(command & 0x10, *toggle);
        let chunk: Vec<u8> = value.drain(..value.len().min(7)).collect();
        let last = u8::from(value.is_empty());
        let mut data = [0; 8];
        data[0] = *toggle | (7 - chunk.len() as u8) << 1 | last;
        data[1..=chunk.len()].copy_from_slice(&chunk);
        *toggle ^= 0x10;
        self.answer(data);
    }

    fn download_segment(&mut self, bytes: [u8; 8]) {
        let command = bytes[0];
        let Some(download) = &mut self.download else { return self.abort((0, 0), 0x0504_0001) };
        assert_eq!(command & 0x10, download.toggle);
        let len = 7 - usize::from(command >> 1 & 7);
        download.data.extend_from_slice(&bytes[1..=len]);
        let answer = [0x20 | download.toggle, 0, 0, 0, 0, 0, 0, 0];
        download.toggle ^= 0x10;
        if command & 1 == 0 {
            return self.answer(answer);
        }
        let Some(download) = self.download.take() else { return };
        assert_eq!(download.data.len(), download.size);
        self.write(download.at, download.data, answer);
    }

    fn initiate_block_download(&mut self, at: (u16, u8), size: usize) {
        self.block_downloads += 1;
        match self.knows_blocks {
            Blocks::Known(_) if at.0 == 0x1F50 && self.busy() => {
                self.status = 0x86;
                self.abort(at, 0x0800_0022);
            }
            Blocks::Known(_) if at.0 == 0x1F50 && size > self.room => {
                self.status = 0x04;
                self.abort(at, 0x0607_0012);
            }
            Blocks::Known(blksize) => {
                let sub_block = Some((0, false));
                self.download = Some(Download { at, size, data: Vec::new(), toggle: 0, sub_block });
                self.answer(initiate(0xA4, at, blksize.into()));
            }
            Blocks::Refused(code) => self.abort(at, code),
            Blocks::Ignored => {}
        }
    }

    fn value(&mut self, at: (u16, u8)) -> Result<Vec<u8>, u32> {
        let running = self.running.unwrap();
        if let Some(value) = self.maker.as_mut().and_then(|maker| maker.value(at, running)) {
            return value;
        }
        let number = |value: u32| Ok(value.to_le_bytes().to_vec());
        match at {
            (0x1000, 0) => number(self.running.unwrap()),
            (0x1001, 0) => Ok(vec![0]),
            (0x1008, 0) => Ok(b"a device with a long name".to_vec()),
            (0x100A, 0) => Ok(b"v1\x1B\0junk".to_vec()),
            (0x1018, 1) => number(0x03F),
            (0x1018, 2) => number(1234),
            (0x1F51, 0) => Ok(vec![1]),
            (0x1F51, sub) if sub == self.program => Ok(vec![u8::from(self.running == Some(APPLICATION))]),
            (0x1F56, sub) if sub == self.program => {
                let last = self.blocks.last().filter(|block| block[0] == 0xFF && !self.busy());
                let crc = last.map_or(0, |block| u32::from_le_bytes(block[16..20].try_into().unwrap()));
                let application = self.crc_of_application.filter(|_| self.running == Some(APPLICATION));
                let had = self.had.map(|(crc, _)| crc);
                number(application.or(self.crc).or(had).unwrap_or(crc))
            }
            (0x2007, sub @ 2..=4) => {
                self.state.map(|state| vec![state[usize::from(sub) - 2]]).ok_or(0x0602_0000)
            }
            (0x2007, 6) => self.chip.map(|(options, _)| options.to_le_bytes().to_vec()).ok_or(0x0602_0000),
            (0x2007, 7) => self.chip.map(|(_, supply)| vec![supply]).ok_or(0x0602_0000),
            // Program 1 starts by itself.
            (0x2007, 10) => self.watchdog_ms.map(|ms| [ms.to_le_bytes(), [1, 0]].concat()).ok_or(0x0602_0000),
            (0x1F57, sub) if sub == self.program => number(if self.busy() { 1 } else { self.status }),
            (0x1F50, sub) if sub == self.program => self.readable.clone().ok_or(0x0601_0001),
            (0x1018 | 0x1F50 | 0x1F51 | 0x1F56 | 0x1F57, _) => Err(0x0609_0011),
            _ => Err(0x0602_0000),
        }
    }

    fn write(&mut self, at: (u16, u8), data: Vec<u8>, answer: [u8; 8]) {
        let running = self.running.unwrap();
        if let Some(deed) = self.maker.as_mut().and_then(|maker| maker.write(at, &data, running)) {
            self.log.push(format!("{}: {:04X}/{}, {} bytes", self.node, at.0, at.1, data.len()));
            match deed {
                Err(code) => self.abort(at, code),
                Ok(deed) => {
                    self.answer(answer);
                    let (time, node, next) = match deed {
                        Deed::Nothing => return,
                        Deed::Restart(node, next) => (self.restart_time, node, next),
                        Deed::RestartIn(time, node, next) => (time, node, next),
                    };
                    self.next_node = node;
                    self.restart_within(time, Some(next));
                }
            }
            return;
        }
        let outcome = match at {
            (0x1F51, sub) if sub == self.program => {
                self.log.push(format!("command {:02X}", data[0]));
                (self.on_command)(data[0])
            }
            (0x1F50, sub) if sub == self.program => {
                let number = u32::from_le_bytes(data[..4].try_into().unwrap());
                self.log.push(format!("block {}", number as i32));
                (self.on_block)(number)
            }
            _ => return self.abort(at, 0x0602_0000),
        };
        match outcome {
            Outcome::Abort(code) => return self.abort(at, code),
            Outcome::AbortStatus(code, status) => {
                self.status = status;
                return self.abort(at, code);
            }
            Outcome::LoseRequest => return,
            Outcome::LoseAnswer => {}
            _ => self.answer(answer),
        }
        match outcome {
            Outcome::Ignore => {}
            Outcome::Status(status) => {
                self.status = status;
                self.busy_until = self.now + Duration::from_millis(30);
            }
            _ => self.carry_out(at, data),
        }
    }

    fn finds_wrong_crc(&self, block: &[u8]) -> bool {
        let (checked, crc) = block.split_last_chunk().unwrap();
        self.crc_of_blocks.is_some_and(|of| of(checked) != u32::from_le_bytes(*crc))
    }

    fn carry_out(&mut self, at: (u16, u8), data: Vec<u8>) {
        self.status = 0;
        let in_bootloader = self.running == Some(BOOTLOADER);
        match (at.0, data[0]) {
            (0x1F50, _) if in_bootloader && self.finds_wrong_crc(&data) => self.status = 0x06,
            (0x1F50, _) if in_bootloader => {
                let number = u32::from_le_bytes(data[..4].try_into().unwrap());
                let last = number == u32::MAX && self.next_block > 0;
                if number != self.next_block && !last {
                    self.status = 0x88;
                    return;
                }
                self.next_block = number.wrapping_add(1);
                self.had = self.had.filter(|_| number == 0);
                self.busy_until = self.now + Duration::from_millis(4);
                self.blocks.push(data);
            }
            (0x1F51, 0x03) if in_bootloader => {
                self.busy_until = self.now + self.erase_time;
                self.had = self.had.map(|(crc, clears)| (crc, clears - 1)).filter(|(_, clears)| *clears > 0);
                self.blocks.clear();
                self.next_block = 0;
            }
            (0x1F51, 0x83) if in_bootloader => self.busy_until = self.now + Duration::from_millis(20),
            (0x1F51, 0x01) if in_bootloader => match self.starts {
                Some(BOOTLOADER) => self.status = 0x02,
                next => self.restart_into(next),
            },
            (0x1F51, 0x80) if !in_bootloader => self.restart_into(Some(BOOTLOADER)),
            (0x1F51, 0x80 | 0x84 | 0x02) => {}
            other => panic!("unexpected write {other:X?}"),
        }
    }
}

/// An initiate frame or an abort: command, index, sub-index, 32 bits.
fn initiate(command: u8, (index, sub): (u16, u8), word: u32) -> [u8; 8] {
    let [low, high] = index.to_le_bytes();
    let [a, b, c, d] = word.to_le_bytes();
    [command, low, high, sub, a, b, c, d]
}

impl Adapter for Fake {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        let began = self.now;
        // About what a frame takes at 500 kbit/s.
        self.now += Duration::from_micros(250);
        self.tick();
        if self.frames_left == 0 {
            let source = io::Error::from(io::ErrorKind::BrokenPipe).into();
            return Err(AdapterError::Lost { adapter: "fake".to_string(), source });
        }
        self.frames_left -= 1;
        self.sent.push(*frame);
        self.sent_at.push(began);
        if frame.cob_id() == CobId::new(0) && self.running.is_some() {
            match frame.exactly().copied() {
                Some([command @ (0x81 | 0x82), node]) if node == 0 || node == self.node => {
                    self.log.push(format!("nmt {command:02X}"));
                    let running = self.running.unwrap();
                    match self.maker.as_mut().and_then(|maker| maker.reset(running)) {
                        Some((node, next)) => {
                            self.next_node = node;
                            self.restart_into(Some(next));
                        }
                        None => self.restart_into(self.running),
                    }
                }
                _ => {}
            }
        }
        let request = frame.cob_id() == CobId::new(0x600 + u16::from(self.node));
        let hears = self.running.is_some() && !(self.deaf_while_busy && self.busy());
        match frame.exactly() {
            Some(bytes) if request && hears => self.request(*bytes),
            _ => {}
        }
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now + timeout;
        loop {
            self.tick();
            match self.outbox.front() {
                Some((at, _)) if *at <= until => {
                    let (at, frame) = self.outbox.pop_front().unwrap();
                    self.now = self.now.max(at);
                    return Ok(Some(frame));
                }
                _ => {}
            }
            match self.restart {
                Some((at, _)) if at <= until => self.now = self.now.max(at),
                _ => {
                    self.now = until;
                    return Ok(None);
                }
            }
        }
    }

    fn now(&self) -> Duration {
        self.now
    }
}

/// Several devices on one bus.
pub struct Bus(pub Vec<Fake>);

impl Adapter for Bus {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        // The frame takes its time once; then all devices receive it at the same time.
        self.0.iter_mut().try_for_each(|fake| fake.send(frame))
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now() + timeout;
        // The device with the earliest frame sends first; the others' clocks follow.
        let next = (0..self.0.len()).filter_map(|at| self.0[at].next_at(until).map(|when| (when, at))).min();
        let (when, frame) = match next {
            Some((when, at)) => {
                let fake = &mut self.0[at];
                (when, fake.receive(when.saturating_sub(fake.now))?)
            }
            None => (until, None),
        };
        for fake in &mut self.0 {
            fake.now = fake.now.max(when);
            fake.tick();
        }
        Ok(frame)
    }

    fn now(&self) -> Duration {
        self.0.iter().map(|fake| fake.now).max().unwrap_or_default()
    }
}
