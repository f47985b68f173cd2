//! Many boards on one bus, updated with the same program by `coflash`'s own procedure.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use canopen::{BitRate, NodeId};
use coboot_can::{Adapter, AdapterError};
use coflash_core::file::convert::DEFAULT_BLOCK_SIZE;
use coflash_core::file::sealed::SealedFile;
use coflash_core::file::Program;
use coflash_core::update::many::{flash_many, Failed, Job, ManyOptions};
use coflash_core::update::{Event, FlashOptions, Payload, Report, JOINED_BLOCKS};
use emulator::bus::fault::{Fault, FaultAction, FrameMatch, When};

use crate::bench::Bench;
use crate::firmware;
use crate::throughput::{blocks, program};

/// Boards with the node-IDs 1, 2 and so on.
pub struct Fleet {
    /// The boards and their bus.
    pub bench: Bench,
}

/// What an update of a fleet took and did.
pub struct Update {
    /// From its begin to the end of its last device, in virtual time.
    pub took: Duration,
    /// The result of each device.
    pub results: Vec<Result<Report, Failed>>,
    /// The events, with the number of the device.
    pub events: Vec<(usize, Event)>,
}

impl Update {
    /// The number of devices that are done.
    pub fn done(&self) -> usize {
        self.results.iter().filter(|result| result.is_ok()).count()
    }
}

/// Something that happens on the bus, at each access of the host.
pub type Happens<'h> = &'h mut dyn FnMut(&mut Bench);

/// A bus on which something happens.
pub struct Eventful<'b> {
    /// The boards.
    pub bench: &'b mut Bench,
    /// What happens.
    pub happens: Happens<'b>,
}

impl Adapter for Eventful<'_> {
    fn send(&mut self, frame: &canopen::Frame) -> Result<(), AdapterError> {
        self.bench.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<canopen::Frame>, AdapterError> {
        (self.happens)(self.bench);
        self.bench.receive(timeout)
    }

    fn now(&self) -> Duration {
        self.bench.now()
    }
}

/// The options of an update that ends with the start: the tests compare the times of downloads.
fn unwatched() -> FlashOptions {
    FlashOptions::default().watch(Some(std::time::Duration::ZERO))
}

impl Fleet {
    /// `boards` running boards at this bit rate, which share a bus.
    ///
    /// # Panics
    /// If a board refuses its node-ID, or the firmware was not built.
    pub fn new(boards: u8, rate: BitRate) -> Self {
        Self::of_image(firmware::BOOTLOADER, boards, rate)
    }

    /// The same with this bootloader.
    ///
    /// # Panics
    /// As [`new`](Self::new).
    pub fn of_image(bootloader: &str, boards: u8, rate: BitRate) -> Self {
        let mut bench = Bench::of_boards_with(bootloader, boards.into());
        for (board, node) in bench.boards().into_iter().zip(1..) {
            bench.commission(board, node, rate);
        }
        bench.set_host_bit_rate(rate.bits_per_second().expect("a rate that can be set"));
        bench.power_on();
        bench.run_ms(50);
        Self { bench }
    }

    /// Does this to one of so many frames on the bus from now on, on average.
    pub fn to_one_in(&mut self, frames: u32, seed: u64, action: FaultAction) {
        let when = When::OneIn { frames, seed };
        self.bench.world.inject(Fault { frames: FrameMatch::default(), when, action });
    }

    /// Updates the first `devices` boards with this program.
    ///
    /// # Panics
    /// If a thread of the update panics.
    pub fn update(&mut self, devices: u8, file: &Arc<Program>, options: &ManyOptions) -> Update {
        self.update_while(devices, file, options, &mut |_| {})
    }

    /// The same while something happens.
    ///
    /// # Panics
    /// If a thread of the update panics.
    pub fn update_while(
        &mut self,
        devices: u8,
        file: &Arc<Program>,
        options: &ManyOptions,
        happens: Happens<'_>,
    ) -> Update {
        let program = Payload::Program(file.clone());
        self.update_as(devices, &program, &unwatched(), options, happens)
    }

    /// The same with a sealed image, and everything else by default.
    ///
    /// # Panics
    /// As [`update`](Self::update).
    pub fn update_sealed(&mut self, devices: u8, file: &Arc<SealedFile>) -> Update {
        let program = Payload::Sealed(file.clone());
        let (each, options) = (unwatched(), ManyOptions::default());
        self.update_as(devices, &program, &each, &options, &mut |_| {})
    }

    fn update_as(
        &mut self,
        devices: u8,
        file: &Payload,
        each: &FlashOptions,
        options: &ManyOptions,
        happens: Happens<'_>,
    ) -> Update {
        let began = self.bench.time();
        let job = |node| {
            let node = NodeId::new(node).expect("1 to 127");
            Job::new(node, file.clone(), *each)
        };
        let jobs: Vec<Job> = (1..=devices).map(job).collect();
        let events = Mutex::new(Vec::new());
        let record = |device, event| events.lock().expect("no panic").push((device, event));
        let mut bus = Eventful { bench: &mut self.bench, happens };
        let results = flash_many(&mut bus, &jobs, options, &record);
        let took = Duration::from_nanos((self.bench.time() - began).0 / 1000);
        Update { took, results, events: events.into_inner().expect("no panic") }
    }
}

/// The application, extended to so many KiB, in blocks of the default size.
pub fn file(kib: u32) -> Arc<Program> {
    Arc::new(blocks(&program(kib), DEFAULT_BLOCK_SIZE))
}

/// How a program gets to several boards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Distribution {
    /// In one download for all.
    Together,
    /// In a download for each, at the same time.
    OneByOne,
}

/// One measurement of an update of boards at 1 Mbit/s.
#[derive(Clone, Copy, Debug)]
pub struct Measurement {
    /// The number of boards.
    pub boards: u8,
    /// How it gets to them.
    pub distribution: Distribution,
    /// Bytes of a block, including framing.
    pub block_size: usize,
    /// One of so many frames is lost; 0 for none.
    pub lost_one_in: u32,
    /// From the first request until the last board runs its program.
    pub took: Duration,
    /// The duration for one board and no lost frames.
    pub one: Duration,
}

/// The rows of the bench: a program of 256 KiB at 1 Mbit/s.
///
/// # Panics
/// If an update fails, or the firmware was not built.
pub fn measure(mut row: impl FnMut(Measurement)) {
    let mut fleet = Fleet::new(8, BitRate::K1000);
    let file = file(256);
    let own = DEFAULT_BLOCK_SIZE;
    let rows = [
        (1, Distribution::OneByOne, own, 0),
        (2, Distribution::Together, JOINED_BLOCKS, 0),
        (4, Distribution::Together, JOINED_BLOCKS, 0),
        (8, Distribution::Together, JOINED_BLOCKS, 0),
        (8, Distribution::OneByOne, own, 0),
        (8, Distribution::Together, JOINED_BLOCKS, 100_000),
        (8, Distribution::Together, JOINED_BLOCKS, 1000),
        (1, Distribution::OneByOne, own, 1000),
        (8, Distribution::Together, own, 0),
        (8, Distribution::Together, own, 1000),
    ];
    let mut one = None;
    for (boards, distribution, block_size, lost_one_in) in rows {
        fleet.bench.world.clear_faults();
        if lost_one_in != 0 {
            fleet.to_one_in(lost_one_in, 1, FaultAction::Drop);
        }
        let options = ManyOptions::default().together(distribution == Distribution::Together);
        let each = unwatched().joined_blocks(Some(block_size));
        let update = fleet.update_as(boards, &Payload::Program(file.clone()), &each, &options, &mut |_| {});
        assert_eq!(update.done(), usize::from(boards), "{distribution:?}, one of {lost_one_in} lost");
        let (took, one) = (update.took, *one.get_or_insert(update.took));
        row(Measurement { boards, distribution, block_size, lost_one_in, took, one });
    }
}
