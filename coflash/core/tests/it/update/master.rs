//! An update beside a CANopen master that starts the nodes of its network (CiA 302-2), and beside
//! others that go on asking.

use std::collections::VecDeque;
use std::time::Duration;

use canopen::{CobId, Frame, NodeId};
use coboot_can::{Adapter, AdapterError};
use coflash_core::device::{Session, Timing};
use coflash_core::file::block_file;
use coflash_core::update::event::Phase;
use coflash_core::update::{flash, DeviceState, Event, FlashOptions, Payload, Report};
use coflash_core::Error;

use super::{file, left, update};
use kit::fake::{Blocks, Fake, APPLICATION, BOOTLOADER, NODE};

const fn ms(time: u64) -> Duration {
    Duration::from_millis(time)
}

/// What a master reads of a node that has booted up: 1000h and 1018h/1 to 4.
const START_UP: [[u8; 8]; 5] = [
    [0x40, 0x00, 0x10, 0, 0, 0, 0, 0],
    [0x40, 0x18, 0x10, 1, 0, 0, 0, 0],
    [0x40, 0x18, 0x10, 2, 0, 0, 0, 0],
    [0x40, 0x18, 0x10, 3, 0, 0, 0, 0],
    [0x40, 0x18, 0x10, 4, 0, 0, 0, 0],
];
/// CLEAR of program 1.
const CLEAR: [u8; 8] = [0x2F, 0x51, 0x1F, 1, 3, 0, 0, 0];

/// Another client on the bus of a device.
struct Beside {
    fake: Fake,
    /// How long after the boot-up of the node it begins.
    waits: Duration,
    /// The pause between two of its requests.
    pause: Duration,
    /// Its requests after a boot-up.
    requests: Vec<[u8; 8]>,
    /// They are repeated for ever.
    for_ever: bool,
    due: VecDeque<(Duration, [u8; 8])>,
}

impl Beside {
    fn new(fake: Fake, waits: Duration, pause: Duration, for_ever: bool) -> Self {
        Self { fake, waits, pause, requests: START_UP.to_vec(), for_ever, due: VecDeque::new() }
    }

    fn begin(&mut self, at: Duration) {
        self.due = self.requests.iter().zip(0..).map(|(bytes, n)| (at + self.pause * n, *bytes)).collect();
    }

    /// Sends the request that is due.
    fn ask(&mut self) -> Result<Frame, AdapterError> {
        let (at, bytes) = self.due.pop_front().unwrap();
        if self.for_ever {
            self.due.push_back((at + self.pause * self.requests.len() as u32, bytes));
        }
        let request = Frame::of(CobId::new(0x600 + u16::from(NODE)).unwrap(), &bytes);
        self.fake.send(&request)?;
        Ok(request)
    }
}

impl Adapter for Beside {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.fake.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.fake.now + timeout;
        let due = self.due.front().map(|(at, _)| (*at).max(self.fake.now)).filter(|at| *at <= until);
        let frame = match due {
            Some(at) if self.fake.next_at(at).is_none() => {
                self.fake.receive(at - self.fake.now)?;
                return Ok(Some(self.ask()?));
            }
            _ => self.fake.receive(timeout)?,
        };
        if frame == Some(Frame::of(CobId::new(0x700 + u16::from(NODE)).unwrap(), &[0])) {
            self.begin(self.fake.now + self.waits);
        }
        Ok(frame)
    }

    fn now(&self) -> Duration {
        self.fake.now
    }
}

fn run(adapter: &mut dyn Adapter) -> (Result<Report, Error>, Vec<Event>) {
    run_with(adapter, &file().into())
}

fn run_with(adapter: &mut dyn Adapter, file: &Payload) -> (Result<Report, Error>, Vec<Event>) {
    update(adapter, file, &FlashOptions::default())
}

/// Whenever the master begins after a boot-up, its reads end by themselves: twenty updates each, of
/// a device and on a bus that are sometimes faster and sometimes slower.
#[test]
fn a_master_that_starts_the_node_ends_no_update() {
    for waits in [0, 1, 5, 20, 100] {
        for course in 0..20 {
            let mut fake = Fake::new(APPLICATION);
            fake.restart_time = ms(40 + 17 * course);
            fake.latency = Duration::from_micros(200 + 150 * course);
            fake.knows_blocks =
                if course % 2 == 0 { Blocks::Known(127) } else { Blocks::Refused(0x0504_0001) };
            let mut bus = Beside::new(fake, ms(waits), ms(1 + course / 5), false);
            let (result, _) = run(&mut bus);
            result.unwrap_or_else(|error| panic!("after {waits} ms, course {course}: {error}"));
            assert_eq!(bus.fake.blocks.concat(), data!("identity-110.blk"));
            // The trial, and then the program; nothing was done twice.
            let commands = ["command 80", "command 03", "command 01", "command 83"];
            assert_eq!(commands.map(|command| bus.fake.count(command)), [2, 1, 2, 1]);
            assert_eq!(bus.fake.running, Some(APPLICATION));
        }
    }
}

/// A master that never ends, and another tool that waits for the end of an erase: the program that
/// was called back starts again, and the tool says why. A new bootloader is no exception.
#[test]
fn who_goes_on_asking_after_the_call_back_is_told_and_the_program_starts_again() {
    let (program, new) = (Payload::from(file()), super::renew::new());
    for (waits, pause, file) in
        [(0, 20, &program), (100, 20, &program), (0, 250, &program), (250, 250, &program), (0, 20, &new)]
    {
        let mut fake = Fake::new(APPLICATION);
        fake.restart_time = ms(50);
        let mut bus = Beside::new(fake, ms(waits), ms(pause), true);
        let began = bus.now();
        let (result, events) = run_with(&mut bus, file);
        let error = result.unwrap_err();
        assert_eq!(error.number(), 0x6000_0012, "{error}");
        let words = "another tool is using node 5: it sends SDO requests, the last one for 10";
        assert!(error.to_string().starts_with(words), "{error}");
        assert_eq!(bus.fake.writes(), ["command 80", "command 01"]);
        assert_eq!(bus.fake.running, Some(APPLICATION));
        assert!(events.contains(&Phase::StartingAgain.into()), "{events:?}");
        assert_eq!(left(&events), DeviceState::Untouched);
        assert!(bus.now() - began < Duration::from_secs(10), "{:?}", bus.now() - began);
    }
}

/// Another tool that commands the bootloader has the device: it is left to it.
#[test]
fn who_commands_the_bootloader_has_the_device() {
    let (program, new) = (Payload::from(file()), super::renew::new());
    for (waits, file) in [(0, &program), (100, &program), (250, &program), (100, &new)] {
        let mut fake = Fake::new(APPLICATION);
        fake.restart_time = ms(50);
        let mut bus = Beside::new(fake, ms(waits), ms(1), false);
        bus.requests = vec![CLEAR];
        let error = run_with(&mut bus, file).0.unwrap_err();
        let words = "another tool is using node 5: it sends SDO requests, the last one for 1F51h/1";
        assert_eq!(error.to_string(), words);
        assert_eq!(bus.fake.writes(), ["command 80", "command 03"]);
    }
}

/// If the program does not start again, the reason for the refusal stays the error, and the state of
/// the device is told.
#[test]
fn a_program_that_does_not_start_again_is_told_by_the_state() {
    let mut fake = Fake::new(APPLICATION);
    fake.starts = Some(BOOTLOADER);
    let (result, events) = run(&mut Beside::new(fake, ms(0), ms(20), true));
    assert!(matches!(result, Err(Error::NotAlone { .. })));
    assert_eq!(left(&events), DeviceState::Called);
}

/// Who asks before the call back is refused before it.
#[test]
fn who_can_be_heard_before_the_call_back_costs_the_program_nothing() {
    for pause in [20, 250] {
        let mut bus = Beside::new(Fake::new(APPLICATION), ms(0), ms(pause), true);
        bus.begin(bus.now() + ms(pause));
        let (result, events) = run(&mut bus);
        assert!(matches!(result, Err(Error::NotAlone { .. })));
        assert_eq!((bus.fake.writes().len(), left(&events)), (0, DeviceState::Untouched));
    }
}

/// The 0.3 s for another tool, and the 0.3 s for a master after the call back, go on while the session
/// asks what it has to ask anyway.
#[test]
fn listening_takes_no_time_of_its_own() {
    let mut fake = Fake::new(APPLICATION);
    fake.latency = ms(5);
    let opened = fake.now;
    let mut session = Session::new(&mut fake, NodeId::new(NODE).unwrap(), Timing::default());
    // The session has listened for a while when the update begins.
    session.wait(ms(200)).unwrap();
    let file = block_file::read(data!("identity-110.blk")).unwrap();
    flash(&mut session, &file, &FlashOptions::default(), &mut |_| {}).unwrap();
    let requests =
        || fake.sent.iter().zip(&fake.sent_at).filter_map(|(sent, at)| Some((sent.exactly::<8>()?, *at)));
    assert_eq!(requests().next().unwrap().1 - opened, ms(300));
    let at = |bytes: [u8; 8]| requests().find(|(sent, _)| **sent == bytes).unwrap().1;
    let called = at([0x2F, 0x51, 0x1F, 1, 0x80, 0, 0, 0]);
    let booted = called + fake.restart_time;
    let asked = |from| requests().filter(|(_, time)| *time > from && *time < at(CLEAR)).count();
    // Before that, 1000h, 2002h and 2004h; then 2004h, 2006h and 1F56h for the download itself.
    assert_eq!((asked(booted), asked(booted + ms(300))), (6, 3), "{:?}", fake.sent);
}
