//! Many devices on one bus, in virtual time.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use canopen::{CobId, Frame, NodeId};
use coboot_can::hub::{self, Act, Conversation};
use coboot_can::Adapter;
use coflash_core::device::Transfers;
use coflash_core::file::block_file;
use coflash_core::update::event::Phase;
use coflash_core::update::many::{flash_many, Failed, Job, ManyOptions};
use coflash_core::update::{DeviceState, Event, FlashOptions, Report};
use coflash_core::Error;
use kit::fake::{Blocks, Bus, Fake, Outcome, APPLICATION, BOOTLOADER};

const FILE: &[u8] = data!("identity-110.blk");

type Results = Vec<Result<Report, Failed>>;

fn devices(nodes: impl IntoIterator<Item = u8>) -> Bus {
    let device = |node| {
        let mut fake = Fake::new(if node % 2 == 0 { APPLICATION } else { BOOTLOADER });
        fake.node = node;
        fake.knows_blocks = if node % 3 == 0 { Blocks::Refused(0x0504_0001) } else { Blocks::Known(20) };
        fake
    };
    Bus(nodes.into_iter().map(device).collect())
}

fn jobs(nodes: impl IntoIterator<Item = u8>) -> Vec<Job> {
    let file = Arc::new(block_file::read(FILE).unwrap());
    let job = |node| Job::new(NodeId::new(node).unwrap(), file.clone(), FlashOptions::default());
    nodes.into_iter().map(job).collect()
}

fn options(at_once: usize) -> ManyOptions {
    ManyOptions::default().transfers(Transfers::Blocks).at_once(at_once)
}

fn run(bus: &mut Bus, jobs: &[Job], at_once: usize) -> (Results, Vec<(usize, Event)>) {
    let events = Mutex::new(Vec::new());
    let results =
        flash_many(bus, jobs, &options(at_once), &|job, event| events.lock().unwrap().push((job, event)));
    (results, events.into_inner().unwrap())
}

#[test]
fn one_erases_while_another_receives() {
    let nodes = [3, 4, 7, 8];
    let alone = {
        let mut bus = devices([7]);
        run(&mut bus, &jobs([7]), 1).0[0].as_ref().unwrap().took
    };
    let mut bus = devices(nodes);
    let before = bus.0[0].now;
    let (results, events) = run(&mut bus, &jobs(nodes), 4);
    for (result, fake) in results.iter().zip(&bus.0) {
        assert!(result.is_ok(), "{result:?}");
        assert_eq!(fake.blocks.concat(), FILE, "node {}", fake.node);
        assert_eq!(fake.running, Some(APPLICATION));
    }
    let took = bus.0[0].now - before;
    assert!(took < alone * 2, "four took {took:?}, one takes {alone:?}");
    // All devices erase before the first one has received a block.
    let first = events.iter().position(|(_, event)| matches!(event, Event::Progress { .. })).unwrap();
    let erasing = events[..first].iter().filter(|(_, event)| *event == Phase::Erasing.into()).count();
    assert_eq!(erasing, 4);
}

#[test]
fn the_same_devices_give_the_same_course_of_events() {
    let course = || {
        let mut bus = devices([1, 2, 3, 4, 5]);
        run(&mut bus, &jobs([1, 2, 3, 4, 5]), 5);
        let sent: Vec<String> = bus.0[0].sent.iter().map(|frame| frame.to_string()).collect();
        (sent, bus.0[0].now)
    };
    let first = course();
    for _ in 0..5 {
        assert!(course() == first);
    }
}

/// An adapter's promise: no frame means that the time has passed. And each port only receives the
/// frames of its own node.
#[test]
fn a_port_waits_as_long_as_it_says_and_hears_its_own_node() {
    let mut bus = Bus(vec![Fake::new(BOOTLOADER)]);
    let frame = |id: u16| Frame::of(CobId::new(id).unwrap(), &[0; 8]);
    for id in [0x583, 0x603, 0x703, 0x584, 0x7E4, 0x083] {
        bus.0[0].inject(frame(id));
    }
    let conversation = |wait: u64| -> Act<'static, (Duration, Vec<Frame>)> {
        Box::new(move |port| {
            let began = port.now();
            let mut heard = Vec::new();
            while let Some(frame) = port.receive(Duration::from_millis(wait)).unwrap() {
                heard.push(frame);
            }
            (port.now() - began, heard)
        })
    };
    let node = |number| NodeId::new(number).unwrap();
    let with = |number, wait| Conversation { node: node(number), channel: None, act: conversation(wait) };
    let limits = hub::Options { at_once: 3, answer: Duration::from_millis(500), cancelled: Arc::default() };
    let ended = hub::run(&mut bus, vec![with(3, 100), with(4, 7), with(5, 30)], &limits);
    let ms = Duration::from_millis;
    assert_eq!(ended[0], (ms(100), vec![frame(0x583), frame(0x603), frame(0x703), frame(0x083)]));
    assert_eq!(ended[1], (ms(7), vec![frame(0x584)]));
    assert_eq!(ended[2], (ms(30), vec![]));
}

/// Another client talks to one of the devices: that device is not changed.
#[test]
fn somebody_else_is_heard_through_the_hub() {
    let mut bus = devices([1, 2, 3]);
    bus.0[1].inject(Frame::of(CobId::new(0x602).unwrap(), &[0x40, 0x57, 0x1F, 1, 0, 0, 0, 0]));
    let results = flash_many(&mut bus, &jobs([1, 2, 3]), &ManyOptions::default(), &|_, _| {});
    assert!(matches!(results[1], Err(Failed { error: Error::NotAlone { .. }, .. })), "{results:?}");
    assert!(results[0].is_ok() && results[2].is_ok() && bus.0[1].writes().is_empty(), "{results:?}");
}

#[test]
fn a_failure_stops_nobody_else() {
    let nodes = [1, 2, 3, 4, 5, 6];
    let mut bus = devices(nodes);
    bus.0[0].running = None;
    bus.0[1].on_block = Box::new(|_| Outcome::Status(0x0C));
    bus.0[2].starts = None;
    bus.0[3].on_command = Box::new(|command| if command == 0x80 { Outcome::Ignore } else { Outcome::Accept });
    let (results, _) = run(&mut bus, &jobs(nodes), 3);
    let failed = |number: usize| results[number].as_ref().unwrap_err();
    assert_eq!((failed(0).error.number(), failed(0).left.state), (0x6000_0013, DeviceState::Untouched));
    assert_eq!((failed(1).error.number(), failed(1).left.state), (0x6000_0006, DeviceState::Erased));
    assert_eq!((failed(2).error.number(), failed(2).left.state), (0x6000_0014, DeviceState::Unreleased));
    assert_eq!((failed(3).error.number(), failed(3).left.state), (0x6000_0010, DeviceState::Untouched));
    for (result, fake) in results.iter().zip(&bus.0).skip(4) {
        assert!(result.is_ok(), "{result:?}");
        assert_eq!(fake.blocks.concat(), FILE);
    }
}

#[test]
fn no_more_than_allowed_are_at_work_at_once() {
    let nodes: Vec<u8> = (1..=9).collect();
    for at_once in [0, 1, 2, 20] {
        let mut bus = devices(nodes.clone());
        let (results, events) = run(&mut bus, &jobs(nodes.clone()), at_once);
        assert!(results.iter().all(Result::is_ok));
        let (mut most, mut now) = (0, 0);
        for (_, event) in events {
            match event {
                Event::Found(_) => now += 1,
                Event::Phase(Phase::Started(_)) => now -= 1,
                _ => {}
            }
            most = most.max(now);
        }
        assert!(most <= at_once.clamp(1, 9), "{most} with {at_once}");
        assert!(at_once < 2 || most >= 2);
    }
    assert!(run(&mut devices([]), &[], 4).0.is_empty());
}

#[test]
fn cancelling_ends_all_of_them() {
    let nodes = [1, 2, 4];
    let mut bus = devices(nodes);
    let options = options(3);
    let flag: Arc<AtomicBool> = options.cancelled.clone();
    let results = flash_many(&mut bus, &jobs(nodes), &options, &|_, event| {
        if matches!(event, Event::Progress { done, .. } if done > 300) {
            flag.store(true, Ordering::Relaxed);
        }
    });
    let is_cancelled = |result: &_| matches!(result, &Err(Failed { error: Error::Cancelled, .. }));
    assert!(results.iter().all(is_cancelled), "{results:?}");
}

#[test]
fn an_adapter_that_goes_away_ends_all_of_them() {
    let nodes = [1, 2, 4];
    for frames in (0..600).step_by(37) {
        let mut bus = devices(nodes);
        bus.0[0].frames_left = frames;
        let (results, _) = run(&mut bus, &jobs(nodes), 3);
        let mut failed = results.iter().filter_map(|result| result.as_ref().err());
        assert!(failed.all(|failed| failed.error.number() == 0x6000_0303), "{frames}: {results:?}");
        assert!(frames > 300 || results.iter().all(Result::is_err), "{frames}");
    }
}
