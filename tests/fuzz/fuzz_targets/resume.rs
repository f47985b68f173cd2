//! Downloads of block files by both SDO servers, in any order: blocks that come twice or are left in
//! the middle, another file, CLEAR, any value in 1201h, and power cuts at any operation of the flash.
//!
//! Must hold: a program that verifies is one of the files, byte for byte; 2006h never reports an
//! address up to which the flash does not have the data of the file that it names; and afterwards
//! CLEAR and a whole file install a program (tried after each eighth input, because it takes longer
//! than most of them).
#![cfg_attr(fuzzing, no_main)]

use std::sync::OnceLock;

use boot_core::bootloader::{Bootloader, Config};
use boot_core::control::{SealedMemory, Step as Work};
use boot_core::crc::CrcKind;
use boot_core::program::verify;
use boot_core::store::Journal;
use canopen::od::Objects;
use canopen::program::SECOND_SERVER;
use canopen::sdo::client::{Config as ClientConfig, Download, Step, Transfer};
use canopen::slave::{self, Output, Slave};
use canopen::{Address, BitRate, CobId, Frame, Instant, NodeId};
use coboot_fuzz::{is_eighth, Input};
use kit::bench::{self, block, crc32, CLEAR, CONTROL, DATA, DEVICE, LAYOUT, PROGRAM};
use kit::boot::Boot;
use kit::model::{until_power_cut, Cut, ModelFlash, CHIP};
use kit::rig::{program, words, BOARD_NODE};

static CONFIG: Config = bench::CONFIG;
/// 2006h/1: the CRC of block 0, and the address.
const PARTIAL: Address = Address::new(0x2006, 1);
/// COB-IDs that a client may give the second server.
const SECOND: [u16; 2] = [0x6A0, 0x6A1];
/// The most frames of one transfer, both ways.
const FRAMES: u32 = 20_000;
/// The data of a block.
const CHUNK: usize = 64;

fn node() -> NodeId {
    NodeId::new(5).expect("1 to 127")
}

/// A program and its blocks.
struct File {
    image: Vec<u8>,
    blocks: Vec<Vec<u8>>,
}

impl File {
    /// From the middle of a sector to the middle of another one.
    fn new(len: usize, seed: u8) -> Self {
        let image = program(PROGRAM, 0, len, seed);
        // Block 0 with an identity: reserved word, vendor-ID, product code (L-1112d_10, figure 13).
        let size = len as u32;
        let mut blocks = vec![block(0, 0, &words(&[size, 0, 0]))];
        for (number, data) in (0..).zip(image.chunks(CHUNK)) {
            blocks.push(block(number + 1, PROGRAM.base + number * CHUNK as u32, data));
        }
        blocks.push(block(u32::MAX, 0, &words(&[size, crc32(&image)])));
        Self { image, blocks }
    }

    /// The CRC of block 0, by which 2006h names the file.
    fn id(&self) -> u32 {
        let control = &self.blocks[0];
        u32::from_le_bytes(control[control.len() - 4..].try_into().expect("four bytes"))
    }
}

fn files() -> &'static [File; 2] {
    static FILES: OnceLock<[File; 2]> = OnceLock::new();
    FILES.get_or_init(|| [File::new(0x1240, 0x11), File::new(0xC08, 0x22)])
}

/// The device on its bus, from a reset to the next one.
struct World<'b, 'f> {
    device: Bootloader<'b, &'f mut ModelFlash, Journal, 1>,
    slave: Slave,
    now: u32,
    /// Answers of each server that were not read yet.
    answers: [Vec<[u8; 8]>; 2],
}

impl World<'_, '_> {
    fn put(&mut self, frame: &Frame) {
        self.slave.handle(frame, Instant::from_millis(self.now), &mut self.device);
        self.turn();
    }

    fn turn(&mut self) {
        let now = Instant::from_millis(self.now);
        self.device.set_time(now);
        while let Some(output) = self.slave.poll(now, true, &mut self.device) {
            let Output::Send(frame) = output else { continue };
            let ids = [Some(CobId::sdo_response(node())), CobId::new(SECOND[1])];
            for (id, answers) in ids.into_iter().zip(&mut self.answers) {
                if frame.cob_id() == id {
                    answers.push(*frame.exactly().expect("8 bytes"));
                }
            }
        }
    }

    fn wait(&mut self, ms: u32) {
        for _ in 0..ms {
            self.now += 1;
            for _ in 0..20 {
                if self.device.step() == Work::Idle {
                    break;
                }
            }
            self.turn();
        }
    }

    fn settle(&mut self) {
        for _ in 0..1_000_000 {
            if self.device.step() == Work::Idle {
                return;
            }
        }
        panic!("the work never ends");
    }

    /// Writes an object by a server, at most `frames` of its frames; returns whether the device
    /// has confirmed it.
    fn write(&mut self, second: bool, at: Address, data: &[u8], blocks: bool, frames: u32) -> bool {
        let config = ClientConfig::default();
        let mut transfer = if blocks {
            Download::as_blocks(node(), at, data, config)
        } else {
            Download::new(node(), at, data, config)
        };
        self.answers = Default::default();
        let mut sent = 0;
        for _ in 0..FRAMES {
            for answer in std::mem::take(&mut self.answers[usize::from(second)]) {
                let frame = Frame::of(CobId::sdo_response(node()), &answer);
                transfer.handle(&frame, Instant::from_millis(self.now));
            }
            match transfer.poll(Instant::from_millis(self.now)) {
                Step::Send(frame) => {
                    if sent == frames {
                        return false;
                    }
                    sent += 1;
                    let id = if second { CobId::new(SECOND[0]) } else { frame.cob_id() };
                    let bytes: [u8; 8] = *frame.exactly().expect("8 bytes");
                    self.put(&Frame::of(id.expect("11 bits"), &bytes));
                }
                Step::Wait(_) => self.wait(1),
                Step::Done(result) => {
                    self.settle();
                    return result.is_ok();
                }
            }
        }
        panic!("the transfer never ends");
    }

    /// Checks 2006h against the flash; `honest`: all data were those of the named file.
    fn look(&mut self, honest: bool) -> (u32, u32) {
        let mut bytes = [0; 8];
        assert_eq!(self.device.read(PARTIAL, &mut bytes), Ok(8));
        let [id, end] = [0, 4].map(|at| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four")));
        assert!(end == 0 || (PROGRAM.base..=PROGRAM.end()).contains(&end), "{end:#x}");
        if let (true, Some(file)) = (honest, files().iter().find(|file| file.id() == id)) {
            assert!((end - PROGRAM.base) as usize <= file.image.len(), "{end:#x}");
        }
        (id, end)
    }
}

/// What the host knows over all lives of the device.
struct Host {
    /// The file whose block 0 was confirmed last in this life.
    file: Option<usize>,
    /// The next block.
    next: usize,
    /// Each block of data went where the device expected its file.
    honest: bool,
}

/// One life of the device, from reset to reset; returns whether there are bytes left.
fn live(flash: &mut ModelFlash, input: &mut Input<'_>, host: &mut Host) -> bool {
    let mut buffer = [0; 256];
    let mut room = Box::<SealedMemory>::default();
    let device = Boot::new(&CONFIG, BOARD_NODE).on(flash, &mut buffer, room.sealed());
    let slave = Slave::new(DEVICE.lss_address(), Some(node()), BitRate::K125, slave::Config::default());
    let mut world = World { device, slave, now: 0, answers: Default::default() };
    world.turn();
    world.look(host.honest);
    while let Some(action) = input.byte() {
        let (second, blocks) = (action & 1 != 0, action & 2 != 0);
        match action {
            // Block 0 of a file, and on from where the device is.
            0..=39 => {
                let which = usize::from(action >> 2 & 1);
                let file = &files()[which];
                if world.write(second, DATA, &file.blocks[0], blocks, u32::MAX) {
                    let (id, end) = world.look(host.honest);
                    let resumes = id == file.id() && action & 8 != 0;
                    let done = if resumes { end.saturating_sub(PROGRAM.base) as usize / CHUNK } else { 0 };
                    (host.file, host.next) = (Some(which), 1 + done);
                } else {
                    host.file = None;
                }
            }
            // The next blocks of the file.
            40..=139 => {
                let Some(file) = host.file.map(|which| &files()[which]) else { continue };
                for _ in 0..=action >> 2 & 15 {
                    let Some(block) = file.blocks.get(host.next) else { break };
                    if !world.write(second, DATA, block, blocks, u32::MAX) {
                        break;
                    }
                    host.next += 1;
                }
            }
            // The last block again, or any block of any file: the device has to distinguish them.
            140..=149 => {
                let Some(file) = host.file.map(|which| &files()[which]) else { continue };
                let _ = world.write(second, DATA, &file.blocks[host.next - 1], blocks, u32::MAX);
            }
            150..=159 => {
                let Some([which, number]) = input.array() else { break };
                let file = &files()[usize::from(which & 1)];
                let block = &file.blocks[usize::from(number) % file.blocks.len()];
                // Before the block: the power may be cut in it.
                (host.honest, host.file) = (false, None);
                let _ = world.write(second, DATA, block, blocks, u32::MAX);
            }
            // The next block, left in the middle.
            160..=179 => {
                let Some(file) = host.file.map(|which| &files()[which]) else { continue };
                let Some(block) = file.blocks.get(host.next) else { continue };
                let frames = input.byte().unwrap_or(0).into();
                let _ = world.write(second, DATA, block, blocks, frames);
            }
            180..=189 => {
                world.write(second, CONTROL, &[CLEAR], false, u32::MAX);
                host.file = None;
            }
            // The second server gets its COB-IDs.
            190..=209 => {
                for (sub, id) in (1..).zip(SECOND) {
                    let id = u32::from(id).to_le_bytes();
                    world.write(false, Address::new(SECOND_SERVER, sub), &id, false, u32::MAX);
                }
            }
            210..=219 => {
                let Some([sub, a, b, c, d]) = input.array() else { break };
                let at = Address::new(SECOND_SERVER, sub & 3);
                world.write(second, at, &[a, b, c, d], false, u32::MAX);
            }
            220..=229 => world.wait(u32::from(input.byte().unwrap_or(0))),
            230..=244 => drop(world.look(host.honest)),
            // A reset.
            _ => return true,
        }
    }
    false
}

/// The program in flash is one of the files, if it verifies.
fn judge(flash: &ModelFlash) {
    let journal = Journal::open(flash, LAYOUT.parameters);
    if verify(flash, &journal, &LAYOUT, CrcKind::Crc32, 1).is_ok() {
        let is = |file: &File| flash.cells(PROGRAM).starts_with(&file.image);
        assert!(files().iter().any(is), "what verifies was never sent");
    }
}

/// The flash that 2006h reports, as a probe sees it after a reset.
fn is_in_flash(flash: &mut ModelFlash) {
    let mut buffer = [0; 256];
    let mut room = Box::<SealedMemory>::default();
    let mut bytes = [0; 8];
    {
        let mut device = Boot::new(&CONFIG, BOARD_NODE).on::<_, 1>(&mut *flash, &mut buffer, room.sealed());
        assert_eq!(device.read(PARTIAL, &mut bytes), Ok(8));
    }
    let [id, end] = [0, 4].map(|at| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four")));
    let Some(file) = files().iter().find(|file| file.id() == id) else { return };
    let done = end.saturating_sub(PROGRAM.base) as usize;
    assert!(done <= file.image.len(), "{end:#x} is behind the file");
    assert!(flash.cells(PROGRAM)[..done] == file.image[..done], "2006h tells {end:#x}, beyond the data");
}

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut flash = ModelFlash::new(&CHIP);
    let mut input = Input::new(bytes);
    let mut host = Host { file: None, next: 1, honest: true };
    // When the power is cut in this life, and in what state of the operation.
    while let Some([how, low, high]) = input.array() {
        let operation = u32::from(u16::from_le_bytes([low, high])) % 2000 + 1;
        flash.cut = match how & 7 {
            0 => Some((operation, Cut::Before)),
            1 => Some((operation, Cut::After)),
            2 | 3 => Some((operation, Cut::Torn(how.into()))),
            4 => Some((operation, Cut::Unstable(how.into()))),
            _ => None,
        };
        let mut more = true;
        let cut = until_power_cut(|| more = live(&mut flash, &mut input, &mut host));
        flash.power_on();
        host.file = None;
        judge(&flash);
        if host.honest {
            is_in_flash(&mut flash);
        }
        if !cut && !more {
            break;
        }
    }

    if !is_eighth(bytes) {
        return;
    }
    let file = &files()[0];
    let mut buffer = [0; 256];
    let mut room = Box::<SealedMemory>::default();
    {
        let device = Boot::new(&CONFIG, BOARD_NODE).on(&mut flash, &mut buffer, room.sealed());
        let slave = Slave::new(DEVICE.lss_address(), Some(node()), BitRate::K125, slave::Config::default());
        let mut world = World { device, slave, now: 0, answers: Default::default() };
        world.turn();
        assert!(world.write(false, CONTROL, &[CLEAR], false, u32::MAX), "CLEAR is refused");
        for (number, block) in file.blocks.iter().enumerate() {
            assert!(world.write(false, DATA, block, true, u32::MAX), "block {number} is refused");
        }
    }
    let journal = Journal::open(&flash, LAYOUT.parameters);
    assert!(verify(&flash, &journal, &LAYOUT, CrcKind::Crc32, 1).is_ok(), "no program is installed");
    assert!(flash.cells(PROGRAM).starts_with(&file.image));
});
