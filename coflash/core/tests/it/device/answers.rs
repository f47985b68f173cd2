//! Answers that do not fit: late ones, those for others, short ones, and refusals of single objects.

use std::sync::Arc;
use std::time::Duration;

use canopen::{AbortCode, Address, CobId, Frame, NodeId};
use coboot_can::Adapter;
use coflash_core::device::info::info;
use coflash_core::device::scan::{scan, ScanOptions};
use coflash_core::device::{Session, Timing, Transfers};
use coflash_core::Error;
use embedded_can::Frame as _;

use crate::tap::Tap;
use kit::fake::{Bus, Fake, Maker, APPLICATION, BOOTLOADER, NODE, SILENT};

const NAME: Address = Address::new(0x1008, 0);
const TYPE: Address = Address::new(0x1000, 0);

fn node() -> NodeId {
    NodeId::new(NODE).unwrap()
}

fn session(fake: &mut dyn Adapter) -> Session<'_> {
    Session::new(fake, node(), Timing::default())
}

/// An abort for 1F50h/1 in front of each answer.
fn with_stale_aborts() -> Fake {
    let mut fake = Fake::new(APPLICATION);
    let id = CobId::new(0x580 + u16::from(NODE)).unwrap();
    fake.noise = vec![Frame::of(id, &[0x80, 0x50, 0x1F, 1, 0x01, 0x00, 0x04, 0x05])];
    fake
}

#[test]
fn an_abort_for_another_object_spoils_no_read() {
    for transfers in [Transfers::Blocks, Transfers::Segments] {
        let mut fake = with_stale_aborts();
        let mut session = session(&mut fake);
        session.transfer_by(transfers);
        assert_eq!(session.upload(TYPE, &mut |_| {}).unwrap(), APPLICATION.to_le_bytes());
        assert_eq!(session.upload(NAME, &mut |_| {}).unwrap(), b"a device with a long name");
        assert_eq!(session.read(NAME).unwrap(), b"a device with a long name");
        // The real reason is not hidden.
        let error = session.read(Address::new(0x2FFF, 0)).unwrap_err();
        assert!(matches!(error, Error::Refused { code: AbortCode::NO_OBJECT, .. }), "{error}");
    }
}

/// A late answer costs one attempt, whichever answer of the read it is: the next attempt passes over
/// what belongs to the one before.
#[test]
fn a_late_answer_costs_one_attempt() {
    for which in 0..6 {
        for late in [510, 600, 900] {
            let mut fake = Fake::new(APPLICATION);
            fake.delays =
                (0..=which).map(|at| Duration::from_millis(if at == which { late } else { 0 })).collect();
            let mut session = session(&mut fake);
            assert_eq!(session.read(NAME).unwrap(), b"a device with a long name", "{which}, {late} ms");
            assert_eq!(session.read(TYPE).unwrap(), APPLICATION.to_le_bytes(), "{which}, {late} ms");
            assert!(fake.count("read 1008/0") <= 2, "{which}, {late} ms: {:?}", fake.log);
        }
    }
}

/// The number of attempts is that of the time limits, also of a value of any length.
#[test]
fn a_read_is_repeated_as_often_as_asked() {
    for attempts in [1, 2, 7] {
        let mut fake = Fake::new(APPLICATION);
        fake.running = None;
        let timing = Timing::default().attempts(attempts);
        let mut session = Session::new(&mut fake, node(), timing);
        let error = session.upload(NAME, &mut |_| {}).unwrap_err();
        assert!(matches!(error, Error::NoAnswer { .. }), "{error}");
        let initiates = |frame: &&Frame| matches!(frame.data()[0], 0x40 | 0xA0..=0xA7);
        assert_eq!(fake.sent.iter().filter(initiates).count(), attempts as usize);
    }
}

/// The answer has come in time; it only lies after the frames of others.
#[test]
fn a_host_that_is_held_up_finds_the_answer_that_is_there() {
    let mut fake = Fake::new(APPLICATION);
    let heartbeat = Frame::of(CobId::new(0x706).unwrap(), &[5]);
    fake.noise = vec![heartbeat; 20];
    // It is held up in each of so many receptions.
    let mut receptions = 100;
    let mut held_up = Tap::receiving(fake, |fake, timeout| {
        if timeout.is_zero() || receptions == 0 {
            return fake.receive(timeout);
        }
        receptions -= 1;
        fake.now += Duration::from_secs(2);
        fake.receive(Duration::ZERO)
    });
    assert_eq!(session(&mut held_up).read(NAME).unwrap(), b"a device with a long name");
    assert_eq!(held_up.of.count("read 1008/0"), 1);
}

#[test]
fn a_node_with_short_answers_is_not_one_without() {
    for len in [0, 4, 5, 7] {
        let mut short = Tap::shortened(Fake::new(APPLICATION), len);
        let error = info(&mut session(&mut short)).unwrap_err();
        assert!(matches!(error, Error::ShortAnswer { len: found, .. } if found == len), "{error}");
        let words = format!("node 5 answers, but with frames of {len} bytes where SDO has 8");
        assert!(error.to_string().starts_with(&words), "{error}");
        let found = scan(&mut short, &ScanOptions::default().nodes(vec![node()]), &Arc::default()).unwrap();
        let but = found[&node()].but.as_deref();
        assert_eq!(but, Some(format!("with frames of {len} bytes where SDO has 8").as_str()));
    }
}

/// A device that refuses an object, or gives it another length than its type has.
struct Peculiar((u16, u8), Result<Vec<u8>, u32>);

impl Maker for Peculiar {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        (at == self.0).then(|| self.1.clone())
    }
}

/// A device that says nothing about an object that it does not have still answers.
#[test]
fn silence_about_an_object_costs_its_own_cell() {
    for at in [(0x1001, 0), (0x1009, 0), (0x1018, 4), (0x1F51, 0), (0x2002, 1), (0x6005, 1)] {
        let mut fake = Fake::new(APPLICATION);
        fake.maker = Some(Box::new(Peculiar(at, Err(SILENT))));
        let reported = info(&mut session(&mut fake)).unwrap_or_else(|error| panic!("{at:X?}: {error}"));
        assert_eq!((reported.identity[0], reported.identity[3]), (Some(0x3F), None), "{at:X?}");
    }
    // One that falls silent is gone.
    let mut fake = Fake::new(APPLICATION);
    fake.maker = Some(Box::new(Peculiar((0x1000, 0), Err(SILENT))));
    assert!(matches!(info(&mut session(&mut fake)), Err(Error::NoAnswer { .. })));
}

/// One object that cannot be read costs its own cell, and nothing else.
#[test]
fn a_refused_object_costs_its_own_cell() {
    let records = [(0x1018, 1..=4), (0x1F51, 0..=1)].into_iter();
    let records = records.flat_map(|(index, subs)| subs.map(move |sub| (index, sub)));
    let variables = [0x1001, 0x1008, 0x1009, 0x100A].map(|index| (index, 0));
    let programs = [0x1F56, 0x1F57, 0x2002, 0x2003, 0x2005].map(|index| (index, 1));
    // Resource not available, hardware error, general error, device state, of no known meaning.
    let refusals = [0x060A_0023, 0x0606_0000, 0x0800_0000, 0x0800_0022, 0x1234_5678].map(Err);
    for at in records.chain(variables).chain(programs) {
        for value in refusals.iter().cloned().chain([Ok(vec![1, 2, 3, 4, 5, 6, 7, 8, 9])]) {
            let mut fake = Fake::new(BOOTLOADER);
            fake.maker = Some(Box::new(Peculiar(at, value.clone())));
            let reported =
                info(&mut session(&mut fake)).unwrap_or_else(|error| panic!("{at:X?}, {value:X?}: {error}"));
            assert_eq!(reported.device_type.0, BOOTLOADER);
            let vendor = (at != (0x1018, 1)).then_some(0x3F);
            assert_eq!(reported.identity[0], vendor, "{at:X?}, {value:X?}");
            let found =
                scan(&mut fake, &ScanOptions::default().nodes(vec![node()]), &Arc::default()).unwrap();
            assert_eq!(found[&node()].info, Some(reported), "{at:X?}");
        }
    }
}

#[test]
fn two_devices_with_one_node_id_are_noticed() {
    for count in [1, 2] {
        let mut bus = Bus((0..count).map(|_| Fake::new(BOOTLOADER)).collect());
        let found = scan(&mut bus, &ScanOptions::default().nodes(vec![node()]), &Arc::default()).unwrap();
        let but = found[&node()].but.as_ref().map(|but| but.starts_with("so does a second device"));
        assert_eq!((but, found[&node()].info.is_none()), ((count == 2).then_some(true), count == 2));
        let mut session = Session::new(&mut bus, node(), Timing::default());
        for _ in 0..3 {
            assert_eq!(session.read_number(Address::new(0x1000, 0)).unwrap(), BOOTLOADER);
            // As blocks, which the device need not do.
            session.upload(Address::new(0x1000, 0), &mut |_| {}).unwrap();
        }
        assert_eq!(session.is_answered_twice().unwrap(), count == 2);
    }
}
