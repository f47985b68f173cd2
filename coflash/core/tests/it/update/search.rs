//! The search for a bootloader "until the user gives up", and the identity of a program on trial
//! (manual L-1112d_10, chapter 5.2, steps 1 and 6).

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use canopen::{CobId, Frame, NodeId};
use coboot_can::{Adapter, AdapterError};
use coflash_core::device::error::{Error, IdentityPart};
use coflash_core::device::{Session, Timing};
use coflash_core::update::event::Phase;
use coflash_core::update::{catch, flash, CatchOptions, Event, FlashOptions, Report};

use super::{file, node, script, update};
use crate::tap::Tap;
use kit::fake::{Fake, Maker, Outcome, APPLICATION, BOOTLOADER, NODE};

fn run(adapter: &mut dyn Adapter, options: &FlashOptions) -> (Result<Report, Error>, Vec<Event>) {
    update(adapter, file(), options)
}

/// A device that is switched on after this time, with a program that starts 300 ms later unless a
/// client sends a request; and when that is.
fn late(millis: u64) -> (Tap<'static, Fake>, Duration) {
    let fake = Fake::new(BOOTLOADER);
    let on = fake.now + Duration::from_millis(millis);
    let mut asked = false;
    let late = Tap::sending(fake, move |fake, frame| {
        assert!(fake.now < on + Duration::from_secs(60), "it was not caught");
        let until = on + Duration::from_millis(300);
        asked |= (on..until).contains(&fake.now) && frame.cob_id().unwrap().get() == 0x605;
        fake.running = match () {
            () if fake.now < on => None,
            () if asked || fake.now < until => Some(BOOTLOADER),
            () => Some(0xDEAD),
        };
    });
    (late, on)
}

#[test]
fn a_device_that_is_switched_on_later_is_waited_for_and_caught_in_its_rescue_window() {
    for millis in [0, 50, 999, 60_000, 60_037] {
        let options = FlashOptions::default().wait(true).start(false);
        let (result, events) = run(&mut late(millis).0, &options);
        assert!(result.is_ok(), "{millis}: {result:?}");
        // It is reported once, however long it takes.
        let searching =
            events.iter().filter(|event| matches!(event, Event::Phase(Phase::Searching { .. }))).count();
        assert_eq!(searching, usize::from(millis > 0), "{events:?}");
    }
    let (result, _) = run(&mut late(60_000).0, &FlashOptions::default());
    assert!(matches!(result, Err(Error::NoAnswer { .. })), "{result:?}");
}

/// The same as a separate command: the device stays in its bootloader, and is not changed.
#[test]
fn a_device_that_is_switched_on_is_caught() {
    for (millis, within) in [(0, None), (50, None), (60_037, None), (59_000, Some(Duration::from_secs(60)))] {
        let (mut late, on) = late(millis);
        let mut session = Session::new(&mut late, node(), Timing::default());
        let mut events = Vec::new();
        let options = CatchOptions::default().within(within);
        let caught = catch(&mut session, &options, &mut |event| events.push(event)).unwrap();
        assert_eq!(caught.node, Some(node()));
        assert!(caught.running.is_some_and(|running| running.is_bootloader()), "{caught:?}");
        let searching =
            events.iter().filter(|event| matches!(event, Event::Phase(Phase::Searching { .. }))).count();
        assert_eq!(searching, usize::from(millis > 0), "{events:?}");
        let took = session.now().saturating_sub(on);
        assert!(took < Duration::from_millis(300), "{took:?}");
        // Requests that were given up are aborted.
        assert!(late.of.writes().iter().all(|entry| entry.starts_with("abort ")), "{:?}", late.of.log);
    }
    let mut late = late(59_000).0;
    let from = late.of.now;
    let mut session = Session::new(&mut late, node(), Timing::default());
    let options = CatchOptions::default().within(Some(Duration::from_secs(30)));
    assert!(matches!(catch(&mut session, &options, &mut |_| {}), Err(Error::NoAnswer { .. })));
    let took = session.now() - from;
    assert!(took >= Duration::from_secs(30) && took < Duration::from_secs(31), "{took:?}");
}

#[test]
fn an_application_that_answers_is_called_back_until_it_goes() {
    let caught = |outcome, times, within| {
        let mut fake = Fake::new(APPLICATION);
        fake.on_command = script(0x80, times, outcome);
        let mut session = Session::new(&mut fake, node(), Timing::default());
        let caught = catch(&mut session, &CatchOptions::default().within(within), &mut |_| {});
        (caught, fake.writes().len())
    };
    for outcome in [Outcome::Ignore, Outcome::Abort(0x0800_0022)] {
        let (result, calls) = caught(outcome, 5, None);
        assert_eq!((result.unwrap().node, calls), (Some(node()), 6));
        let (result, _) = caught(outcome, usize::MAX, Some(Duration::from_secs(20)));
        assert!(matches!(result, Err(Error::NoBootloader { .. })), "{result:?}");
    }
}

/// A device whose node-ID is unknown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// A bootloader that starts its program 300 ms later unless it is asked, or a layer setting
    /// service comes.
    Bootloader,
    /// An application.
    Application,
    /// A bootloader without node-ID, which answers "identify non-configured slave" alone (CiA 305).
    WithoutNodeId,
}

struct Unknown {
    fake: Fake,
    on: Duration,
    kind: Kind,
    up: bool,
    held: bool,
}

impl Adapter for Unknown {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        let (there, window) = (self.fake.now >= self.on, self.on + Duration::from_millis(300));
        self.held |= there && self.fake.now < window;
        if frame.cob_id().unwrap().get() == 0x7E5 {
            let question = Some(&[0x4C, 0, 0, 0, 0, 0, 0, 0]);
            assert_eq!(frame.exactly(), question, "nothing that changes a device");
            if there && self.kind == Kind::WithoutNodeId {
                self.fake.inject(Frame::of(CobId::LSS_RESPONSE, &[0x50, 0, 0, 0, 0, 0, 0, 0]));
            }
            self.fake.now += Duration::from_micros(250);
            return Ok(());
        }
        self.fake.running = match self.kind {
            _ if !there => None,
            Kind::WithoutNodeId => None,
            Kind::Bootloader if self.held => Some(BOOTLOADER),
            Kind::Bootloader | Kind::Application => Some(APPLICATION),
        };
        self.fake.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let there = self.fake.now >= self.on && self.kind != Kind::WithoutNodeId;
        if there && !std::mem::replace(&mut self.up, true) {
            self.fake.inject(Frame::of(CobId::new(0x700 + u16::from(NODE)).unwrap(), &[0]));
        }
        self.fake.receive(timeout)
    }

    fn now(&self) -> Duration {
        self.fake.now
    }
}

#[test]
fn whoever_comes_up_is_caught_under_whatever_node_id() {
    for kind in [Kind::Bootloader, Kind::Application, Kind::WithoutNodeId] {
        let fake = Fake::new(BOOTLOADER);
        let on = fake.now + Duration::from_millis(4_321);
        let mut unknown = Unknown { fake, on, kind, up: false, held: false };
        let mut session = Session::new(&mut unknown, NodeId::new(1).unwrap(), Timing::default());
        let options = CatchOptions::default().any(true).within(Some(Duration::from_secs(10)));
        let caught = catch(&mut session, &options, &mut |_| {});
        match kind {
            Kind::Bootloader => assert_eq!(caught.unwrap().node, Some(node())),
            Kind::WithoutNodeId => assert_eq!(caught.unwrap().node, None),
            // It may be another device than the expected one: it is not changed.
            Kind::Application => assert!(matches!(caught, Err(Error::NoAnswer { .. })), "{caught:?}"),
        }
        assert!(unknown.fake.writes().is_empty());
    }
}

#[test]
fn an_application_that_stays_is_asked_until_it_goes() {
    let stubborn = |refusal: Outcome| {
        let mut fake = Fake::new(APPLICATION);
        fake.on_command = script(0x80, 5, refusal);
        fake
    };
    for refusal in [Outcome::Abort(0x0800_0022), Outcome::Ignore] {
        let mut fake = stubborn(refusal);
        let options = FlashOptions::default().wait(true);
        run(&mut fake, &options).0.unwrap();
        assert_eq!(fake.count("command 80"), 7, "the last one ends the trial");
        let error = run(&mut stubborn(refusal), &FlashOptions::default()).0.unwrap_err();
        assert!(matches!(error, Error::NoBootloader { .. }), "{error}");
    }
}

#[test]
fn the_user_gives_up() {
    for running in [None, Some(APPLICATION)] {
        let mut fake = Fake::new(APPLICATION);
        fake.running = running;
        fake.on_command = Box::new(|_| Outcome::Ignore);
        let (end, flag) = (fake.now + Duration::from_secs(120), Arc::new(AtomicBool::new(false)));
        let sees = flag.clone();
        let mut bus = Tap::sending(fake, |fake, _| {
            sees.fetch_or(fake.now >= end, Ordering::Relaxed);
        });
        let mut session = Session::new(&mut bus, node(), Timing::default());
        session.cancel_by(flag);
        let options = FlashOptions::default().wait(true);
        let result = flash(&mut session, file(), &options, &mut |_| {});
        assert!(matches!(result, Err(Error::Cancelled)), "{result:?}");
        assert!(bus.of.now < end + Duration::from_secs(1));
    }
}

/// A sub-index of 1018h of the program on trial that has its own value or abort code, and the serial
/// number of the bootloader, which has vendor-ID 3Fh and product code 1234.
struct Told(Option<(u8, Result<u32, u32>)>, Option<u32>);

impl Maker for Told {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        let number = |number: u32| number.to_le_bytes().to_vec();
        match at {
            (0x1018, 4) if running == BOOTLOADER => Some(self.1.map(number).ok_or(0x0609_0011)),
            (0x1018, sub) if running == APPLICATION => {
                self.0.filter(|(own, _)| *own == sub).map(|(_, value)| value.map(number))
            }
            _ => None,
        }
    }
}

#[test]
fn a_program_on_trial_that_is_another_device_is_called_back_and_never_released() {
    let trial = FlashOptions::default();
    let fake = |reported: Told, options: &FlashOptions| {
        let mut fake = Fake::new(BOOTLOADER);
        fake.maker = Some(Box::new(reported));
        let result = run(&mut fake, options).0;
        let commands: Vec<String> =
            fake.log.iter().filter(|entry| entry.starts_with("command")).cloned().collect();
        (result, commands, fake.running)
    };
    // The identity of the test's device; no serial number on one side; another revision; a product
    // code of 0.
    for reported in [
        Told(None, None),
        Told(None, Some(7)),
        Told(Some((4, Ok(9))), None),
        Told(Some((4, Ok(0))), Some(7)),
        Told(Some((4, Ok(7))), Some(7)),
        Told(Some((3, Ok(0x0002_0001))), None),
        Told(Some((2, Ok(0))), None),
    ] {
        let (result, commands, _) = fake(reported, &trial);
        assert!(result.is_ok(), "{result:?}");
        assert_eq!(commands[commands.len() - 2..], ["command 83", "command 01"]);
    }
    for (reported, serial, part, tells, has) in [
        ((1, Ok(0x40)), None, IdentityPart::VendorId, "vendor-ID 00000040h", "0000003Fh"),
        ((1, Err(0x0602_0000)), None, IdentityPart::VendorId, "vendor-ID none", "0000003Fh"),
        ((2, Ok(1235)), None, IdentityPart::ProductCode, "product code 000004D3h", "000004D2h"),
        ((4, Ok(8)), Some(7), IdentityPart::SerialNumber, "serial number 00000008h", "00000007h"),
    ] {
        let (result, commands, running) = fake(Told(Some(reported), serial), &trial);
        let error = result.unwrap_err();
        assert!(matches!(error, Error::OtherIdentity { what, .. } if what == part), "{error}");
        let words = &*format!("the program on trial tells {tells}, and the bootloader of node 5 {has}");
        assert_eq!((error.to_string().as_str(), error.number()), (words, 0x6000_0014));
        assert_eq!(commands[commands.len() - 2..], ["command 01", "command 80"]);
        assert_eq!(running, Some(BOOTLOADER));
    }
    // Without a trial the identity is not compared.
    let other = Told(Some((1, Ok(0x40))), None);
    assert!(fake(other, &FlashOptions::default().trial_run(false)).0.is_ok());
}
