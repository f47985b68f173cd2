//! The duration of a download, compared with the limits of wire and flash.

use std::time::Duration;

use canopen::program::ProgramControl;
use canopen::sdo::wire::{BlockAck, BlockEnd, Request, Response};
use canopen::{Address, BitRate, NodeId};
use coflash_core::device::{Doing, Session, Timing, Transfers};
use coflash_core::file::block_file::BlockFile;
use coflash_core::file::convert::{program_of, Label, Options, Region};
use coflash_core::file::read::{read, Format};
use coflash_core::file::sealed::Sealer;
use coflash_core::file::Program;
use coflash_core::update::event::Phase;
use coflash_core::update::{flash, Event, FlashOptions};
use emulator::frame::Frame;

use crate::bench::{Bench, NODE};
use crate::firmware;
use crate::sealed_board;
use kit::random::Random;

const DATA: Address = Address::new(0x1F50, 1);
const STATUS: Address = Address::new(0x1F57, 1);
/// Bytes of a block, including framing: large enough that the framing hardly matters on the wire,
/// small enough that the last block is programmed in a short time.
const BLOCK_SIZE: usize = 4096;
/// Typical erase times of the STM32F405/407 by words, in ms (datasheet DocID022152, flash memory
/// programming).
const ERASE_MS: [(u32, u64); 3] = [(16 * 1024, 250), (64 * 1024, 550), (128 * 1024, 1000)];
/// Typical time to program a word, in us (the same table).
const PROGRAM_US: u64 = 16;

/// One measurement; all times in us.
#[derive(Clone, Copy, Debug)]
pub struct Measurement {
    /// Bit rate in bit/s.
    pub bit_rate: u32,
    /// Size of the program in KiB.
    pub kib: u32,
    /// From the CLEAR command to the status "verified".
    pub took: u64,
    /// The duration of one SDO block transfer of these bytes on the wire without a pause, including
    /// stuff bits, acknowledgements and intermissions.
    pub wire: u64,
    /// The duration of erasing the sectors and programming the words.
    pub flash: u64,
}

impl Measurement {
    /// The lower limit: the larger one of both.
    #[must_use]
    pub fn limit(&self) -> u64 {
        self.wire.max(self.flash)
    }

    /// The efficiency in percent.
    pub fn percent(&self) -> u64 {
        self.limit() * 100 / self.took.max(1)
    }
}

/// Downloads a program of this size at this bit rate, in virtual time.
///
/// # Panics
/// If the device refuses it, or the firmware was not built.
pub fn measure(rate: BitRate, kib: u32) -> Measurement {
    let (mut bench, bit_rate) = board_at(rate);
    let bytes = program(kib);
    let file = blocks(&bytes, BLOCK_SIZE);
    let from = bench.time();
    let poll = Timing::default().poll_first(Duration::from_millis(2)).poll_most(Duration::from_millis(10));
    let mut session = Session::new(&mut bench, NodeId::new(NODE).expect("1 to 127"), poll);
    session.command(1, ProgramControl::Clear).expect("CLEAR");
    for block in BlockFile::of(&file).blocks() {
        session.write(DATA, &block.emit(), Doing::Block(block.number), &mut |_| {}).expect("a good block");
        let status = session.await_idle(1, Doing::Read(STATUS)).expect("the status");
        assert_eq!(status.to_word(), 0, "behind block {}", block.number);
    }
    let took = (bench.time() - from).0 / 1_000_000;
    Measurement { bit_rate, kib, took, wire: wire_us(&bytes, bit_rate), flash: flash_us(bytes.len() as u32) }
}

/// A running board at this bit rate, and the bit rate in bit/s.
fn board_at(rate: BitRate) -> (Bench, u32) {
    let mut bench = Bench::at_rate(rate);
    bench.run_ms(50);
    (bench, rate.bits_per_second().expect("a rate that can be set"))
}

/// Sets another bit rate of a new board, and switches it off; returns the bit rate in bit/s.
///
/// # Panics
/// If the board refuses.
pub fn change_over(bench: &mut Bench, rate: BitRate) -> u32 {
    let bit_rate = rate.bits_per_second().expect("a rate that can be set");
    let board = bench.boards()[0];
    bench.commission(board, NODE, rate);
    bench.set_host_bit_rate(bit_rate);
    bit_rate
}

/// The form in which a program is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// As it lies in flash, to a device without keys.
    Raw,
    /// Sealed, to a device with keys.
    Sealed,
    /// Sealed and compressed.
    Compressed,
}

/// One measurement of a program in one form; all times in us.
#[derive(Clone, Copy, Debug)]
pub struct OfForm {
    /// Bit rate in bit/s.
    pub bit_rate: u32,
    /// Size of the program in KiB.
    pub kib: u32,
    /// The form of the program.
    pub form: Form,
    /// Bytes that are sent.
    pub file: usize,
    /// From the CLEAR command to the status "verified".
    pub took: u64,
    /// The duration of one SDO block transfer of the raw program on the wire, see
    /// [`Measurement::wire`].
    pub wire: u64,
    /// See [`Measurement::flash`].
    pub flash: u64,
}

impl OfForm {
    /// The duration in percent of the raw program's time on the wire.
    pub fn percent(&self) -> u64 {
        self.took * 100 / self.wire.max(1)
    }
}

/// Writes a program of this size into 1F50h as one file, in virtual time.
///
/// # Panics
/// If the device refuses it, or the firmware was not built.
pub fn measure_form(rate: BitRate, kib: u32, form: Form) -> OfForm {
    let mut bench = sealed_board::open_board();
    let bit_rate = change_over(&mut bench, rate);
    if form != Form::Raw {
        sealed_board::provision(&mut bench);
    }
    bench.power_on();
    bench.run_ms(50);
    let bytes = code(kib);
    let sealer = Sealer { compress: form == Form::Compressed, ..sealed_board::sealer(sealed_board::COUNTER) };
    let file = match form {
        Form::Raw => bytes.clone(),
        _ => sealer.seal(&bytes, &sealed_board::release()).expect("it can be sealed"),
    };
    let from = bench.time();
    let outcome = sealed_board::write(&mut bench, &file, Transfers::Blocks);
    assert_eq!(outcome, (None, 0), "{form:?} at {bit_rate} bit/s");
    let took = (bench.time() - from).0 / 1_000_000;
    let (wire, flash) = (wire_us(&bytes, bit_rate), flash_us(bytes.len() as u32));
    OfForm { bit_rate, kib, form, file: file.len(), took, wire, flash }
}

/// The application, extended to this many KiB by half-words drawn from its own. For LZMA they are
/// less similar than code: they compress to 80 %, and the application to 71 %.
///
/// # Panics
/// If it was not built.
pub fn code(kib: u32) -> Vec<u8> {
    let mut bytes = firmware::raw(firmware::APP_V1);
    let words: Vec<[u8; 2]> = bytes.chunks_exact(2).map(|word| [word[0], word[1]]).collect();
    let mut random = Random(1);
    let size = kib as usize * 1024;
    bytes.resize(bytes.len().next_multiple_of(2), 0xFF);
    while bytes.len() < size {
        bytes.extend(words[random.below(words.len())]);
    }
    bytes
}

/// The load of the bus while `coflash flash` sends a program.
#[derive(Clone, Copy, Debug)]
pub struct Load {
    /// Bit rate in bit/s.
    pub bit_rate: u32,
    /// Size of the program in KiB.
    pub kib: u32,
    /// Bytes of a block, including framing.
    pub block_size: usize,
    /// From the first block to the status "verified", in us.
    pub took: u64,
    /// The part of this time with a frame on the bus or in the following intermission, in us.
    pub busy: u64,
    /// The number of frames in both directions.
    pub frames: usize,
}

impl Load {
    /// The load, in percent.
    pub fn percent(&self) -> u64 {
        self.busy * 100 / self.took.max(1)
    }
}

/// Runs the procedure of `coflash flash`, with no option but `--no-start`, to download a program of
/// this size into a board in virtual time. Idle times of the bus are therefore caused by the
/// procedure and the device, not by the computer.
///
/// # Panics
/// If the device refuses it, or the firmware was not built.
pub fn load(rate: BitRate, kib: u32, block_size: usize) -> Load {
    let (mut bench, bit_rate) = board_at(rate);
    let file = blocks(&program(kib), block_size);
    let (clock, mut from, mut to) = (bench.clock(), None, None);
    let options = FlashOptions::default().start(false);
    flash(&mut bench.session(), &file, &options, &mut |event| match event {
        Event::Phase(Phase::Erased { .. }) => from = Some(clock.get()),
        Event::Phase(Phase::Verified { .. }) => to = Some(clock.get()),
        _ => {}
    })
    .expect("a board that is well");
    let (from, to) = (from.expect("CLEAR"), to.expect("verified"));
    let frames: Vec<_> =
        bench.records().into_iter().filter(|record| record.start >= from && record.end <= to).collect();
    let intermission = 3 * 1_000_000_000_000 / u64::from(bit_rate);
    let busy: u64 = frames.iter().map(|record| (record.end - record.start).0 + intermission).sum();
    let [took, busy] = [(to - from).0, busy].map(|picoseconds| picoseconds / 1_000_000);
    Load { bit_rate, kib, block_size, took, busy, frames: frames.len() }
}

/// The application, extended to this many KiB by bytes that cause stuff bits like code.
///
/// # Panics
/// If it was not built.
pub fn program(kib: u32) -> Vec<u8> {
    let image = firmware::raw(firmware::APP_V1);
    let mut bytes: Vec<u8> =
        (0..kib * 1024).map(|i| (i.wrapping_mul(2_654_435_761).rotate_left(9) >> 24) as u8).collect();
    bytes[..image.len()].copy_from_slice(&image);
    bytes
}

pub(crate) fn blocks(bytes: &[u8], block_size: usize) -> Program {
    let region = firmware::board().programs[0];
    let image = read(bytes, Some(Format::Raw), Some(region.base)).expect("a raw image");
    let options = Options::default()
        .region(Region::Strict(region.into()))
        .block_size(block_size)
        // Sends the size, so that sectors are erased ahead of the data.
        .label(Label::Device {
            vendor_id: bsp::IDENTITY.vendor_id,
            product_code: bsp::IDENTITY.product_code,
        });
    program_of(image, &options).expect("it fits").program
}

/// The duration of one block transfer in us, each frame with its stuff bits and the following
/// intermission.
fn wire_us(bytes: &[u8], bit_rate: u32) -> u64 {
    let node = u16::from(NODE);
    let bits = |id: u16, data: [u8; 8]| u64::from(Frame::standard(id, &data).expect("8 bytes").bus_bits());
    let (asked, answered) = (0x600 + node, 0x580 + node);
    let size = Some(bytes.len() as u32);
    let mut all = bits(asked, Request::InitiateBlockDownload { at: DATA, crc: true, size }.emit())
        + bits(answered, Response::InitiateBlockDownload { at: DATA, crc: true, blksize: 127 }.emit());
    for sub_block in bytes.chunks(7 * 127) {
        let mut seqno = 0;
        for data in sub_block.chunks(7) {
            seqno += 1;
            let mut segment = [0; 8];
            segment[0] = seqno;
            segment[1..=data.len()].copy_from_slice(data);
            all += bits(asked, segment);
        }
        all += bits(answered, Response::AckBlockDownload(BlockAck { ackseq: seqno, blksize: 127 }).emit());
    }
    all += bits(asked, Request::EndBlockDownload(BlockEnd { unused: 0, crc: 0xA5A5 }).emit());
    all += bits(answered, Response::EndBlockDownload.emit());
    all * 1_000_000 / u64::from(bit_rate)
}

fn flash_us(size: u32) -> u64 {
    let board = firmware::board();
    let region = board.programs[0];
    let mut erase = 0;
    let mut next = region.base;
    while next < region.base + size {
        let sector = board.chip.sector_at(next).expect("inside the flash").region;
        let of_size = ERASE_MS.iter().find(|(bytes, _)| *bytes == sector.size);
        erase += of_size.expect("a sector of the F4").1 * 1000;
        next = sector.end();
    }
    erase + u64::from(size / 4) * PROGRAM_US
}
