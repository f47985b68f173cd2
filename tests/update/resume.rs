//! Updates of the real firmware that are cut at a random point: the next one goes on where they
//! stopped. `sim/node/tests/it/cuts.rs` does the same on the model of the flash, many more times.

use std::io;
use std::time::Duration;

use canopen::program::PROGRAM_ID;
use canopen::{Address, BitRate};
use coboot_can::{Adapter, AdapterError};
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::fleet::file;
use coflash_core::device::{Session, Timing};
use coflash_core::file::Program;
use coflash_core::update::event::{Phase, Warning};
use coflash_core::update::{flash, Event, FlashOptions, Report};
use coflash_core::Error;
use emulator::bus::fault::{Fault, FaultAction, FrameMatch, When};
use emulator::machine::{Cut, FlashCut};
use kit::random::Random;

/// The data of a block of the file.
const BLOCK: usize = 1008;

/// The way in which an update is cut.
#[derive(Clone, Copy, Debug)]
enum Way {
    /// The host stops instead of sending this frame, counted from 0.
    Host(usize),
    /// From this frame of the bus on, frames are lost; counted from 1.
    Bus(u64),
    /// The board loses its power in an operation of its flash.
    Power(FlashCut),
}

/// The host's access to the bus.
struct Host<'b> {
    bench: &'b mut Bench,
    /// The frames that it has sent.
    sent: usize,
    /// It stops instead of sending this frame.
    stops_at: Option<usize>,
}

impl Adapter for Host<'_> {
    fn send(&mut self, frame: &canopen::Frame) -> Result<(), AdapterError> {
        if self.stops_at == Some(self.sent) {
            let source = io::Error::from(io::ErrorKind::NotConnected).into();
            return Err(AdapterError::Lost { adapter: "the host".into(), source });
        }
        self.sent += 1;
        self.bench.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<canopen::Frame>, AdapterError> {
        self.bench.receive(timeout)
    }

    fn now(&self) -> Duration {
        self.bench.now()
    }
}

/// What an update came to.
struct Ended {
    result: Result<Report, Error>,
    events: Vec<Event>,
    /// Frames of the host.
    sent: usize,
}

impl Ended {
    /// The data that had arrived, in bytes.
    fn arrived(&self) -> usize {
        let done = |event: &Event| match event {
            Event::Progress { done, .. } => Some(*done),
            _ => None,
        };
        self.events.iter().filter_map(done).max().unwrap_or(0)
    }

    /// The bytes with which it went on.
    fn went_on(&self) -> Option<usize> {
        self.events.iter().find_map(|event| match event {
            Event::Phase(Phase::GoingOn { done, .. }) => Some(*done),
            _ => None,
        })
    }

    fn began_again(&self) -> bool {
        self.events.iter().any(|event| matches!(event, Event::Warning(Warning::BeginsAgain { .. })))
    }
}

fn update(bench: &mut Bench, file: &Program, stops_at: Option<usize>) -> Ended {
    let mut host = Host { bench, sent: 0, stops_at };
    let mut events = Vec::new();
    let node = canopen::NodeId::new(NODE).expect("a node-ID");
    let mut session = Session::new(&mut host, node, Timing::default());
    let result = flash(&mut session, file, &FlashOptions::default(), &mut |event| events.push(event));
    Ended { result, events, sent: host.sent }
}

/// A board with this flash that runs, or a new one for this bit rate.
fn board(rate: BitRate, flash: Option<&[u8]>) -> Bench {
    let mut bench = Bench::new();
    match flash {
        Some(flash) => {
            let base = firmware::board().chip.flash.base;
            bench.machine().load_bin(base, flash).expect("the flash of the same chip");
        }
        None => {
            let board = bench.boards()[0];
            bench.commission(board, NODE, rate);
        }
    }
    bench.set_host_bit_rate(rate.bits_per_second().expect("a rate that can be set"));
    bench.power_on();
    bench.run_ms(500);
    bench
}

fn operations(bench: &mut Bench) -> u64 {
    let counters = bench.machine().counters();
    counters.sectors_erased + counters.units_programmed
}

/// The first bytes of the program that are in flash.
fn in_flash(bench: &mut Bench, file: &Program) -> usize {
    let program = &bench.machine().flash()[firmware::program_offset()..];
    let both = program.iter().zip(file.flash_image().into_owned());
    both.take_while(|(cell, byte)| **cell == *byte).count()
}

/// The device stores its progress in steps of this many bytes, at the end of a block.
fn step(file: &Program) -> usize {
    BLOCK + (file.size() as usize / 16).max(1024)
}

/// Cuts updates with this file in all ways; returns how many went on.
fn cut_updates(rate: BitRate, file: &Program, seeds: std::ops::Range<u64>) -> usize {
    let mut bench = board(rate, None);
    update(&mut bench, &firmware::blocks(firmware::APP_V2), None).result.expect("the old program");
    bench.power_off();
    let installed = bench.machine().flash().to_vec();

    let mut bench = board(rate, Some(&installed));
    let (frames, writes) = (bench.records().len(), operations(&mut bench));
    let uncut = update(&mut bench, file, None);
    uncut.result.as_ref().expect("it works without a cut");
    let frames = bench.records().len() - frames;
    let writes = operations(&mut bench) - writes;

    let mut going_on = 0;
    for seed in seeds {
        let random = &mut Random(seed);
        let way = match seed % 3 {
            0 => Way::Host(random.below(uncut.sent)),
            1 => Way::Bus(1 + random.below(frames) as u64),
            _ => {
                let when = random.pick(&[Cut::Before, Cut::After, Cut::Torn { seed }]);
                Way::Power(FlashCut { operation: random.below(writes as usize) as u64, when })
            }
        };
        let mut bench = board(rate, Some(&installed));
        let mut stops_at = None;
        match way {
            Way::Host(frame) => stops_at = Some(frame),
            Way::Bus(frame) => {
                let all = FrameMatch::default();
                let when = When::FromNth(frame);
                bench.world.inject(Fault { frames: all, when, action: FaultAction::Drop });
            }
            Way::Power(cut) => bench.machine().cut_power_at(Some(cut)),
        }
        let first = update(&mut bench, file, stops_at);
        let in_flash = in_flash(&mut bench, file);
        bench.world.clear_faults();
        bench.machine().cut_power_at(None);
        bench.power_on();
        bench.run_ms(random.below(3000) as u64);

        let second = update(&mut bench, file, None);
        let reported = format!("update {seed}, {way:?}: {:?}", second.events);
        second.result.as_ref().unwrap_or_else(|error| panic!("{error}, {reported}"));
        assert!(!second.began_again(), "{reported}");
        // Nothing is on record before the first step, and a program that is complete comes
        // once more as a whole, or not at all.
        if in_flash > step(file) && first.arrived() < file.size() as usize {
            assert!(first.result.is_err(), "{reported}");
            let done = second.went_on().unwrap_or_else(|| panic!("from the start, {reported}"));
            going_on += 1;
            // With the power the device loses what waits in RAM for the flash.
            let waited = match way {
                Way::Power(_) => first.arrived().saturating_sub(in_flash),
                Way::Host(_) | Way::Bus(_) => 0,
            };
            assert!(
                done + step(file) >= first.arrived() - waited,
                "{done} of {}, {reported}",
                first.arrived()
            );
            let twice = first.sent + second.sent - uncut.sent;
            let limit = uncut.sent / 10 + waited / 6;
            println!("{rate:?} {way:?}: {twice} of {} frames twice, {waited} bytes waited", uncut.sent);
            assert!(twice <= limit, "{twice} of {} frames, {reported}", uncut.sent);
        }
        assert!(!bench.is_bootloader(NODE), "{reported}");
        let crc = bench.session().read_number(Address::new(PROGRAM_ID, 1)).unwrap();
        assert_eq!(crc, file.crc(), "{reported}");
        bench.assert_nothing_unmodelled();
    }
    going_on
}

#[test]
fn an_update_of_a_board_that_is_cut_anywhere_goes_on() {
    // Longer than what comes while the first sector, of 128 KiB, is erased.
    let went_on = cut_updates(BitRate::K1000, &file(160), 0..18);
    assert!(went_on > 7, "{went_on} of 18 went on");
}

/// At the bit rate of a new board nearly nothing waits for the flash.
#[test]
fn on_a_slow_bus_a_cut_costs_a_tenth_at_most() {
    let went_on = cut_updates(BitRate::K125, &file(96), 18..27);
    assert!(went_on > 4, "{went_on} of 9 went on");
}
