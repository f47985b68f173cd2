//! Two masters at one device, in virtual time: the first one updates it; the second one sends
//! requests, aborts, meaningless segments, NMT commands and noise at any moment; and both pause and
//! disappear. The device must answer a request when the others are silent, reset when it is
//! commanded to, and never have a record of a missing program. The same seed gives the same attack:
//!
//! ```sh
//! COBOOT_ATTACKS=20000 cargo test --release -p coboot-core masters::
//! ```

use boot_core::control::{Policy, Step as Work};
use boot_core::store::{Journal, ProgramRecord};
use canopen::sdo::client::{Config as ClientConfig, Download, SdoError, Step, Transfer};
use canopen::slave::{self, Output, Slave};
use canopen::{Address, BitRate, CobId, Frame, Instant, NodeId};
use kit::bench::{block_file, crc32, program, Bench as Device, CLEAR, CONTROL, DATA, DEVICE, PROGRAM};
use kit::model::{ModelFlash, CHIP};
use kit::random::Random;

const NODE: u8 = 5;
const READ_1000: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
const IS_1000: [u8; 8] = [0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10];
/// Longer than the pause of a sub-block plus two checks of the clock.
const ANSWER_MS: u32 = 54;
/// A client's time-out in an abandoned transfer.
const TIMEOUT_MS: u32 = 2000;

/// The device on its bus.
struct World<'f> {
    device: Device<'f>,
    slave: Slave,
    now: u32,
    /// SDO answers that were not read yet.
    answers: Vec<[u8; 8]>,
    /// A reset was commanded.
    resets: bool,
}

fn sdo(bytes: [u8; 8]) -> Frame {
    Frame::of(CobId::sdo_request(NodeId::new(NODE).unwrap()), &bytes)
}

impl<'f> World<'f> {
    fn new(flash: &'f mut ModelFlash) -> Self {
        let device = Device::with_buffer(flash, Policy::DEFAULT, 4096);
        let slave =
            Slave::new(DEVICE.lss_address(), NodeId::new(NODE), BitRate::K125, slave::Config::default());
        let mut world = Self { device, slave, now: 0, answers: Vec::new(), resets: false };
        world.turn();
        world
    }

    fn at(&self) -> Instant {
        Instant::from_millis(self.now)
    }

    fn put(&mut self, frame: &Frame) {
        self.resets |= self.slave.handle(frame, self.at(), &mut self.device.node);
        self.turn();
    }

    /// Sends the device's frames, and runs a part of its work.
    fn turn(&mut self) {
        self.device.node.set_time(self.at());
        while let Some(output) = self.slave.poll(Instant::from_millis(self.now), true, &mut self.device.node)
        {
            if let Output::Send(frame) = output {
                if frame.cob_id() == Some(CobId::sdo_response(NodeId::new(NODE).unwrap())) {
                    self.answers.push(*frame.exactly().expect("8 bytes"));
                }
            }
        }
    }

    fn wait(&mut self, ms: u32) {
        for _ in 0..ms {
            self.now += 1;
            for _ in 0..20 {
                if self.device.node.step() == Work::Idle {
                    break;
                }
            }
            self.turn();
        }
    }

    /// The answer to a request within the time; the request is sent once.
    fn ask(&mut self, bytes: [u8; 8], within: u32) -> Option<[u8; 8]> {
        self.answers.clear();
        self.put(&sdo(bytes));
        for _ in 0..within {
            if !self.answers.is_empty() {
                break;
            }
            self.wait(1);
        }
        self.answers.first().copied()
    }
}

/// The master that updates.
struct Updater {
    files: Vec<(Address, Vec<u8>)>,
    at: usize,
    transfer: Option<Download<Vec<u8>>>,
}

impl Updater {
    fn new(random: &mut Random) -> Self {
        let image = program(200 + random.below(2500), random.below(256) as u8);
        let mut files = vec![(CONTROL, vec![CLEAR])];
        if random.chance(60) {
            files.extend(block_file(&image, 96 + random.below(800)).into_iter().map(|block| (DATA, block)));
        } else {
            files.push((DATA, image));
        }
        Self { files, at: 0, transfer: None }
    }

    /// Sends its next frame if it is its turn; returns whether it continues.
    fn turn(&mut self, world: &mut World<'_>, random: &mut Random) -> bool {
        let Some((at, data)) = self.files.get(self.at) else { return false };
        let transfer = self.transfer.get_or_insert_with(|| {
            let node = NodeId::new(NODE).unwrap();
            if random.chance(80) {
                Download::as_blocks(node, *at, data.clone(), ClientConfig::default())
            } else {
                Download::new(node, *at, data.clone(), ClientConfig::default())
            }
        });
        // Both masters get all frames of the device: there is only one identifier.
        for answer in std::mem::take(&mut world.answers) {
            let frame = Frame::of(CobId::sdo_response(NodeId::new(NODE).unwrap()), &answer);
            transfer.handle(&frame, world.at());
        }
        match transfer.poll(world.at()) {
            Step::Send(frame) => {
                // Sometimes a frame is lost or repeated.
                let times = if random.chance(2) { 2 * random.below(2) } else { 1 };
                (0..times).for_each(|_| world.put(&frame));
            }
            Step::Wait(_) => world.wait(1),
            Step::Done(result) => {
                self.transfer = None;
                // It repeats what was refused or aborted; after a wrong order it begins again.
                match result {
                    Ok(()) => self.at += 1,
                    Err(SdoError::Server(_)) => self.at = 0,
                    Err(_) => {}
                }
                return random.chance(98);
            }
        }
        true
    }
}

/// The frames of the other master.
fn meddle(world: &mut World<'_>, random: &mut Random) {
    let objects = [(0x1000, 0), (0x1008, 0), (0x1018, 1), (0x1F50, 1), (0x1F51, 1), (0x1F57, 1), (0x1234, 0)];
    let (index, sub): (u16, u8) = random.pick(&objects);
    let [low, high] = index.to_le_bytes();
    let value = random.next().to_le_bytes();
    let request = |command: u8| [command, low, high, sub, value[0], value[1], value[2], value[3]];
    let frame = match random.below(12) {
        0..=2 => sdo([0x40, low, high, sub, 0, 0, 0, 0]),
        3 => sdo([random.pick(&[0x2F, 0x2B, 0x23, 0x22, 0x21, 0x20]), low, high, sub, value[0], 0, 0, 0]),
        4 => sdo([random.pick(&[0xA0, 0xA4]), low, high, sub, 1 + value[0] % 127, value[1] % 32, 0, 0]),
        5 => sdo(request(random.pick(&[0xC0, 0xC2, 0xC4, 0xC6]))),
        6 => sdo(request(0x80)),
        // Segments, acknowledgements and ends of possible transfers.
        7 => sdo(request(random.pick(&[0x00, 0x10, 0x60, 0x70, 0xA1, 0xA2, 0xA3, 0xC1]))),
        8 => sdo(request(random.below(256) as u8)),
        9 => Frame::of(CobId::NMT, &[random.pick(&[0x01, 0x02, 0x80, 0x82]), random.pick(&[0, NODE, 9])]),
        10 => Frame::of(
            CobId::LSS_REQUEST,
            &[random.pick(&[0x04, 0x5E, 0x17]), random.below(2) as u8, 0, 0, 0, 0, 0, 0],
        ),
        _ => {
            world.wait(random.pick(&[1, 10, 49, 51, 300, 2100]));
            return;
        }
    };
    world.put(&frame);
}

/// The checks when both masters are silent.
fn observe(world: &mut World<'_>, seed: u64, random: &mut Random) {
    match random.below(4) {
        // A client that aborts the open transfer gets an answer at once.
        0 => {
            world.put(&sdo([0x80, 0, 0, 0, 0, 0, 0, 8]));
            assert_eq!(world.ask(READ_1000, 1), Some(IS_1000), "seed {seed}, after an abort");
        }
        // Other clients get an answer after the pause of a sub-block; one request may be taken for
        // the segment that is due, or for the rest of the previous answer.
        1 => {
            world.wait(260);
            let first = world.ask(READ_1000, ANSWER_MS);
            let answer = if first == Some(IS_1000) { first } else { world.ask(READ_1000, ANSWER_MS) };
            assert_eq!(answer, Some(IS_1000), "seed {seed}, asked twice; the first time {first:02X?}");
        }
        // A reset does not wait for the end of anything.
        2 => {
            world.resets = false;
            world.put(&Frame::of(CobId::NMT, &[0x81, NODE]));
            assert!(world.resets && world.slave.is_idle(), "seed {seed}: it owes an answer");
        }
        // At the end, nothing is left of a transfer.
        _ => {
            world.wait(2 * TIMEOUT_MS + 200);
            assert!(world.slave.is_idle());
            assert_eq!(world.ask(READ_1000, 1), Some(IS_1000), "seed {seed}, behind the time-out");
        }
    }
}

/// Whether the record of program 1, if there is one, matches the flash.
fn record_is_true(flash: &ModelFlash) -> bool {
    let journal = Journal::open(flash, kit::bench::LAYOUT.parameters);
    let Some(record) = ProgramRecord::load(&journal, flash, 1) else { return true };
    crc32(&flash.cells(PROGRAM)[..record.size as usize]) == record.crc
}

#[test]
fn two_masters_at_once_and_whatever_else_comes() {
    let attacks = std::env::var("COBOOT_ATTACKS").ok().and_then(|n| n.parse().ok()).unwrap_or(300);
    for seed in 0..attacks {
        let mut random = Random(seed);
        let mut flash = ModelFlash::new(&CHIP);
        let mut world = World::new(&mut flash);
        let meddling = random.pick(&[0, 1, 5, 30, 70]);
        for _ in 0..1 + random.below(4) {
            let mut updater = Updater::new(&mut random);
            for _ in 0..random.below(1500) {
                if random.chance(meddling) {
                    meddle(&mut world, &mut random);
                }
                if !updater.turn(&mut world, &mut random) {
                    break;
                }
            }
            observe(&mut world, seed, &mut random);
        }
        // A master that is alone with the device.
        world.put(&Frame::of(CobId::LSS_REQUEST, &[0x04, 0, 0, 0, 0, 0, 0, 0]));
        world.put(&sdo([0x80, 0, 0, 0, 0, 0, 0, 8]));
        world.wait(200);
        let image = program(300 + random.below(2000), 0xA5);
        let blocks = block_file(&image, 256).into_iter().map(|block| (DATA, block));
        for (at, data) in [(CONTROL, vec![CLEAR])].into_iter().chain(blocks) {
            let config = ClientConfig::default();
            let mut transfer = Download::as_blocks(NodeId::new(NODE).unwrap(), at, data, config);
            world.answers.clear();
            loop {
                match transfer.poll(world.at()) {
                    Step::Send(frame) => world.put(&frame),
                    Step::Wait(_) => world.wait(1),
                    Step::Done(result) => {
                        assert_eq!(result, Ok(()), "seed {seed}, {at}");
                        break;
                    }
                }
                for answer in std::mem::take(&mut world.answers) {
                    transfer.handle(
                        &Frame::of(CobId::sdo_response(NodeId::new(NODE).unwrap()), &answer),
                        world.at(),
                    );
                }
            }
            world.wait(100);
            assert_eq!(world.device.status(), 0, "seed {seed}, {at}");
        }
        drop(world);
        assert!(record_is_true(&flash), "seed {seed}");
        assert_eq!(&flash.cells(PROGRAM)[..image.len()], image, "seed {seed}");
    }
}
