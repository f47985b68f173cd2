//! A bootloader on the model of the flash, and the actions of a host.

use boot_core::bootloader::{entries, entry_count, Bootloader, Config, Extras};
use boot_core::control::{Policy, Step};
use boot_core::crc::CrcKind;
use boot_core::program::{verify, Invalid};
use boot_core::store::Journal;
use boot_core::store::NodeParameters;
use canopen::device::Device;
use canopen::od::{Address, Entry, Objects};
use canopen::{AbortCode, BitRate, NodeId};
use shared_abi::geometry::Region;
use shared_abi::layout::Layout;

use crate::boot::{leaked, Boot};
pub use crate::rig::{block, crc32};
use crate::rig::{go_on, words};

use crate::model::{ModelFlash, CHIP, ONE_PROGRAM};

pub const LAYOUT: Layout = ONE_PROGRAM;
pub const PROGRAM: Region = LAYOUT.programs[0];

pub const DATA: Address = Address::new(0x1F50, 1);
pub const CONTROL: Address = Address::new(0x1F51, 1);
pub const IDENTIFICATION: Address = Address::new(0x1F56, 1);
pub const STATUS: Address = Address::new(0x1F57, 1);

pub const CLEAR: u8 = 0x03;
pub const START: u8 = 0x01;
pub const SET_SIGNATURE: u8 = 0x83;
pub const CLR_SIGNATURE: u8 = 0x84;

pub static ENTRIES: [Entry; entry_count(1, Extras::STANDARD)] = entries(1, Extras::STANDARD).entries();

pub const CONFIG: Config = Config {
    entries: &ENTRIES,
    device: DEVICE,
    node_id: None,
    layout: &LAYOUT,
    supports: |rate| rate != BitRate::K800,
    boot_up_emergency: false,
    download: Policy::DEFAULT,
    password: b"",
};

pub fn node() -> NodeParameters {
    NodeParameters { id: NodeId::new(5), bit_rate: BitRate::K125 }
}

pub const DEVICE: Device = Device {
    device_type: 0x1000_0000,
    name: "model",
    hardware_version: "0",
    software_version: "0",
    heartbeat_ms: 0,
    vendor_id: 0,
    product_code: 0,
    revision: 0,
    serial_number: 0,
};

/// The empty flash of a new device, for a test that does not read it beside the device.
pub fn new_flash() -> &'static mut ModelFlash {
    Box::leak(Box::new(ModelFlash::new(&CHIP)))
}

pub struct Bench<'f> {
    pub node: Bootloader<'static, &'f mut ModelFlash, Journal, 1>,
}

impl<'f> Bench<'f> {
    pub fn new(flash: &'f mut ModelFlash) -> Self {
        Self::with(flash, Policy::DEFAULT)
    }

    /// After CLEAR.
    pub fn cleared(flash: &'f mut ModelFlash) -> Self {
        let mut bench = Self::new(flash);
        assert_eq!(bench.command(CLEAR), 0);
        bench
    }

    pub fn with(flash: &'f mut ModelFlash, download: Policy) -> Self {
        Self::with_buffer(flash, download, 256)
    }

    pub fn with_buffer(flash: &'f mut ModelFlash, download: Policy, size: usize) -> Self {
        Self::with_config(flash, Config { download, ..CONFIG }, size)
    }

    pub fn with_config(flash: &'f mut ModelFlash, config: Config, size: usize) -> Self {
        let (buffer, sealed) = leaked(size);
        let config = Box::leak(Box::new(config));
        Self { node: Boot::new(config, node()).on(flash, buffer, sealed) }
    }

    pub fn settle(&mut self) {
        assert!((0..1_000_000).any(|_| self.node.step() == Step::Idle), "the work does not end");
    }

    pub fn word(&mut self, at: Address) -> u32 {
        let mut bytes = [0; 4];
        let len = self.node.read(at, &mut bytes).unwrap();
        assert!(len <= 4);
        u32::from_le_bytes(bytes)
    }

    /// 1F51h.
    pub fn read_state(&mut self) -> u8 {
        let mut byte = [0];
        assert_eq!(self.node.read(CONTROL, &mut byte), Ok(1));
        byte[0]
    }

    /// The first bytes of a program, in segments.
    pub fn begin(&mut self, data: &[u8]) {
        self.node.download_start(DATA, None).unwrap();
        go_on(&mut self.node, 1, data, 7).unwrap();
    }

    pub fn status(&mut self) -> u32 {
        self.word(STATUS)
    }

    /// Carries out a command; returns the status.
    pub fn command(&mut self, command: u8) -> u32 {
        self.node.write(CONTROL, &[command]).unwrap();
        self.settle();
        self.status()
    }

    /// Sends a block in SDO segments; returns the abort, if any, and the status after all work.
    pub fn block(&mut self, block: &[u8]) -> (Result<(), AbortCode>, u32) {
        let outcome = self.transfer(block);
        self.settle();
        (outcome, self.status())
    }

    pub fn transfer(&mut self, block: &[u8]) -> Result<(), AbortCode> {
        self.node.download_start(DATA, Some(block.len() as u32))?;
        for segment in block.chunks(7) {
            // As the SDO server does: an error ends the transfer and cancels the receiver.
            if let Err(abort) = self.node.download_data(DATA, segment) {
                self.node.download_cancel(DATA);
                return Err(abort);
            }
        }
        self.node.download_end(DATA)
    }

    /// Sends a whole program in one download, `pieces` of it at a time, and lets the flash work
    /// when there is no room; returns the abort, if any, and the status after all work.
    pub fn stream(&mut self, data: &[u8], size: Option<u32>, pieces: usize) -> (Result<(), AbortCode>, u32) {
        let outcome = self.pour(data, size, pieces);
        self.settle();
        (outcome, self.status())
    }

    /// The same without the work that is left after the download.
    pub fn pour(&mut self, data: &[u8], size: Option<u32>, pieces: usize) -> Result<(), AbortCode> {
        self.node.download_start(DATA, size)?;
        go_on(&mut self.node, 1, data, pieces)?;
        self.node.download_end(DATA)
    }

    #[track_caller]
    pub fn good(&mut self, block: &[u8]) {
        assert_eq!(self.block(block), (Ok(()), 0));
    }

    /// Blocks that are taken, one after another.
    #[track_caller]
    pub fn all_good<B: AsRef<[u8]>>(&mut self, blocks: impl IntoIterator<Item = B>) {
        blocks.into_iter().for_each(|block| self.good(block.as_ref()));
    }

    pub fn install(&mut self, program: &[u8]) {
        assert_eq!(self.command(CLEAR), 0);
        self.all_good(block_file(program, 96));
    }

    /// The same, and its release.
    #[track_caller]
    pub fn release(&mut self, program: &[u8]) {
        self.install(program);
        assert_eq!(self.command(SET_SIGNATURE), 0);
    }
}

/// CRC-16 in the words of blocks and programs.
pub fn crc16(bytes: &[u8]) -> u32 {
    crate::crc::crc16(bytes).into()
}

pub fn last(program: &[u8]) -> Vec<u8> {
    block(u32::MAX, 0, &words(&[program.len() as u32, crc32(program)]))
}

pub fn block_file(program: &[u8], chunk: usize) -> Vec<Vec<u8>> {
    block_file_at(program, PROGRAM.base, chunk)
}

pub fn block_file_at(program: &[u8], base: u32, chunk: usize) -> Vec<Vec<u8>> {
    let mut file = vec![block(0, 0, &[0; 8])];
    for (i, data) in program.chunks(chunk).enumerate() {
        file.push(block(1 + i as u32, base + (i * chunk) as u32, data));
    }
    file.push(last(program));
    file
}

/// A program with a plausible vector table, filled with `seed`.
pub fn program(len: usize, seed: u8) -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..len).map(|i| (i as u8).wrapping_mul(31) ^ seed).collect();
    bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&(PROGRAM.base + 0x101).to_le_bytes());
    bytes
}

/// The program that would start after a reset, identified by its first data byte; `Err` for none.
pub fn autostart(flash: &ModelFlash) -> Result<u8, Invalid> {
    let journal = Journal::open(flash, LAYOUT.parameters);
    let verified = verify(flash, &journal, &LAYOUT, CrcKind::Crc32, 1)?;
    if verified.signed {
        Ok(flash.cells(PROGRAM)[8] ^ 8_u8.wrapping_mul(31))
    } else {
        Err(Invalid::Absent)
    }
}
