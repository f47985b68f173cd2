//! The LSS master against dialogues written by hand from CiA 305, and against devices that play the
//! standard's slave.

use std::collections::VecDeque;
use std::sync::atomic::AtomicBool;
use std::sync::Arc;
use std::time::Duration;

use canopen::{CobId, Frame, NodeId};
use coboot_can::{Adapter, AdapterError};
use coflash_core::device::error::{Error, LssFailure};
use coflash_core::device::lss::{BitRate, LssAddress, LssDoing, Master, ANSWER};

use crate::tap::Tap;

const ADDRESS: LssAddress = LssAddress {
    vendor_id: 0x0000_003F,
    product_code: 0x1122_3344,
    revision: 0x8001_0002,
    serial_number: 0xDEAD_BEEF,
};

fn answer(bytes: [u8; 8]) -> Frame {
    Frame::of(CobId::new(0x7E4).unwrap(), &bytes)
}

/// An independent slave: its identity, its progress in fastscan, and the received settings.
struct Slave {
    address: [u32; 4],
    node: u8,
    /// Set, but not active yet.
    pending: u8,
    selected: usize,
    configured: bool,
    fastscan: u8,
    bit_rate: Option<u8>,
    activated: Option<u16>,
    stored: Option<u8>,
    /// The answers to commands.
    refusal: (u8, u8),
}

impl Slave {
    fn new(address: LssAddress, node: u8) -> Self {
        let LssAddress { vendor_id, product_code, revision, serial_number } = address;
        Self {
            address: [vendor_id, product_code, revision, serial_number],
            node,
            pending: node,
            selected: 0,
            configured: false,
            fastscan: 0,
            bit_rate: None,
            activated: None,
            stored: None,
            refusal: (0, 0),
        }
    }

    fn listen(&mut self, bytes: [u8; 8]) -> Option<[u8; 8]> {
        let number = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
        let plain = |command| Some([command, 0, 0, 0, 0, 0, 0, 0]);
        let outcome = |command, (code, detail): (u8, u8)| Some([command, code, detail, 0, 0, 0, 0, 0]);
        match bytes[0] {
            0x04 => {
                self.configured = bytes[1] == 1;
                if !self.configured && self.node == 0xFF {
                    self.node = self.pending;
                }
                None
            }
            command @ 0x40..=0x43 => {
                let part = usize::from(command - 0x40);
                self.selected =
                    if part == self.selected && self.address[part] == number { part + 1 } else { 0 };
                if self.selected < 4 {
                    return None;
                }
                (self.selected, self.configured) = (0, true);
                plain(0x44)
            }
            0x51 if self.node == 0xFF && !self.configured => {
                let [.., bit, part, next] = bytes;
                if bit == 0x80 {
                    self.fastscan = 0;
                    return plain(0x4F);
                }
                if part != self.fastscan || (self.address[usize::from(part)] ^ number) >> bit != 0 {
                    return None;
                }
                if bit == 0 && next != part {
                    self.fastscan = next;
                    self.configured = next == 0;
                }
                plain(0x4F)
            }
            _ if !self.configured => None,
            0x11 => {
                if self.refusal == (0, 0) {
                    self.pending = bytes[1];
                }
                outcome(0x11, self.refusal)
            }
            0x13 => {
                assert_eq!(bytes[1], 0, "table 0");
                self.bit_rate = Some(bytes[2]);
                outcome(0x13, self.refusal)
            }
            0x15 => {
                self.activated = Some(u16::from_le_bytes([bytes[1], bytes[2]]));
                None
            }
            0x17 => {
                self.stored = Some(self.pending);
                outcome(0x17, self.refusal)
            }
            command @ 0x5A..=0x5D => {
                let [a, b, c, d] = self.address[usize::from(command - 0x5A)].to_le_bytes();
                Some([command, a, b, c, d, 0, 0, 0])
            }
            0x5E => Some([0x5E, self.node, 0, 0, 0, 0, 0, 0]),
            _ => None,
        }
    }
}

/// Slaves on a bus in virtual time. Answers that are the same are one frame on the bus.
#[derive(Default)]
struct Bus {
    slaves: Vec<Slave>,
    now: Duration,
    outbox: VecDeque<Frame>,
    sent: Vec<[u8; 8]>,
    /// The number of requests after which the devices are gone.
    gone_after: Option<usize>,
}

impl Adapter for Bus {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        assert_eq!(frame.cob_id(), CobId::new(0x7E5));
        let bytes = *frame.exactly().unwrap();
        self.sent.push(bytes);
        if self.gone_after.is_some_and(|requests| self.sent.len() > requests) {
            return Ok(());
        }
        let mut answers: Vec<[u8; 8]> =
            self.slaves.iter_mut().filter_map(|slave| slave.listen(bytes)).collect();
        answers.dedup();
        self.outbox.extend(answers.into_iter().map(answer));
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        if let Some(frame) = self.outbox.pop_front() {
            self.now += Duration::from_millis(1);
            return Ok(Some(frame));
        }
        self.now += timeout;
        Ok(None)
    }

    fn now(&self) -> Duration {
        self.now
    }
}

fn bus(slaves: impl IntoIterator<Item = Slave>) -> Bus {
    Bus { slaves: slaves.into_iter().collect(), ..Bus::default() }
}

#[test]
fn requests_are_those_of_the_standard() {
    let mut bus = bus([Slave::new(ADDRESS, 5)]);
    let mut master = Master::new(&mut bus, ANSWER);
    master.select(&ADDRESS).unwrap();
    assert_eq!(master.inquire_address().unwrap(), ADDRESS);
    assert_eq!(master.inquire_node_id().unwrap(), NodeId::new(5));
    master.set_node_id(NodeId::new(17)).unwrap();
    master.set_node_id(None).unwrap();
    master.set_bit_rate(BitRate::K125).unwrap();
    master.store().unwrap();
    master.activate(Duration::from_millis(500)).unwrap();
    master.switch_all(false).unwrap();
    master.switch_all(true).unwrap();
    let expected = [
        [0x40, 0x3F, 0, 0, 0, 0, 0, 0],
        [0x41, 0x44, 0x33, 0x22, 0x11, 0, 0, 0],
        [0x42, 0x02, 0x00, 0x01, 0x80, 0, 0, 0],
        [0x43, 0xEF, 0xBE, 0xAD, 0xDE, 0, 0, 0],
        [0x5A, 0, 0, 0, 0, 0, 0, 0],
        [0x5B, 0, 0, 0, 0, 0, 0, 0],
        [0x5C, 0, 0, 0, 0, 0, 0, 0],
        [0x5D, 0, 0, 0, 0, 0, 0, 0],
        [0x5E, 0, 0, 0, 0, 0, 0, 0],
        [0x11, 17, 0, 0, 0, 0, 0, 0],
        [0x11, 0xFF, 0, 0, 0, 0, 0, 0],
        [0x13, 0, 4, 0, 0, 0, 0, 0],
        [0x17, 0, 0, 0, 0, 0, 0, 0],
        [0x15, 0xF4, 0x01, 0, 0, 0, 0, 0],
        [0x04, 0, 0, 0, 0, 0, 0, 0],
        [0x04, 1, 0, 0, 0, 0, 0, 0],
    ];
    assert_eq!(bus.sent, expected);
}

#[test]
fn fastscan_finds_one_device_after_the_other() {
    let same_but = |serial_number| LssAddress { serial_number, ..ADDRESS };
    let addresses = [same_but(1), same_but(0x8000_0000), same_but(2), LssAddress { vendor_id: 0, ..ADDRESS }];
    let configured = Slave::new(same_but(3), 9);
    let mut bus = bus(addresses.map(|address| Slave::new(address, 0xFF)).into_iter().chain([configured]));
    let mut found = Vec::new();
    let mut master = Master::new(&mut bus, ANSWER);
    for node in 20.. {
        let mut known = 0;
        let Some(address) = master.fastscan(&mut |bits| known = bits).unwrap() else { break };
        assert_eq!(known, 128);
        master.set_node_id(NodeId::new(node)).unwrap();
        master.switch_all(false).unwrap();
        found.push(address);
    }
    // A device that has the bit 0 where others have 1 answers first: the lowest address is found
    // first.
    let lowest = [addresses[3], addresses[0], addresses[2], addresses[1]];
    assert_eq!(found, lowest);
    let nodes: Vec<u8> = bus.slaves.iter().map(|slave| slave.node).collect();
    assert_eq!(nodes, [21, 23, 22, 20, 9]);
}

#[test]
fn nobody_without_a_node_id_is_no_failure() {
    let mut bus = bus([Slave::new(ADDRESS, 9)]);
    let began = bus.now;
    assert_eq!(Master::new(&mut bus, ANSWER).fastscan(&mut |_| {}).unwrap(), None);
    assert_eq!((bus.sent.len(), bus.now - began), (1, ANSWER));
}

#[test]
fn a_device_that_goes_in_the_middle_ends_the_scan() {
    let mut bus = bus([Slave::new(ADDRESS, 0xFF)]);
    bus.gone_after = Some(20);
    let error = Master::new(&mut bus, ANSWER).fastscan(&mut |_| {}).unwrap_err();
    let is_silent = matches!(error, Error::Lss { doing: LssDoing::Fastscan, failure: LssFailure::NoAnswer });
    assert!(is_silent, "{error}");
    assert_eq!((error.number(), error.to_string().as_str()), (0x6000_0013, "no device answers (fastscan)"));
}

#[test]
fn nobody_there_and_refusals_have_words() {
    let mut empty = bus([]);
    let mut master = Master::new(&mut empty, ANSWER);
    let other = LssAddress { serial_number: 1, ..ADDRESS };
    for error in [
        master.select(&other).unwrap_err(),
        master.inquire_node_id().unwrap_err(),
        master.store().unwrap_err(),
    ] {
        assert_eq!(error.number(), 0x6000_0013, "{error}");
        assert!(!error.advice().to_string().is_empty());
    }
    let mut refusing = bus([Slave::new(ADDRESS, 5)]);
    refusing.slaves[0].refusal = (1, 0);
    let mut master = Master::new(&mut refusing, ANSWER);
    master.select(&ADDRESS).unwrap();
    let error = master.store().unwrap_err();
    let words = "the device refuses storing node-ID and bit rate: error 1";
    assert_eq!((error.number(), error.to_string().as_str()), (0x6000_0201, words));
    assert!(error.advice().to_string().contains("cannot store"));
    refusing.slaves[0].refusal = (0xFF, 7);
    let mut master = Master::new(&mut refusing, ANSWER);
    let error = master.set_bit_rate(BitRate::K800).unwrap_err();
    let words = "the device refuses setting the bit rate: error 255, manufacturer's code 7";
    assert_eq!((error.number(), error.to_string().as_str()), (0x6000_02FF, words));
    let mut wrong = bus([Slave::new(ADDRESS, 5)]);
    assert!(Master::new(&mut wrong, ANSWER).select(&other).is_err());
    assert!(!wrong.slaves[0].configured);
}

#[test]
fn what_others_say_is_passed_over_and_cancelling_ends_it() {
    let mut noisy = bus([Slave::new(ADDRESS, 5)]);
    noisy.slaves[0].configured = true;
    // A frame left over from before is dropped. Frames that are too short, or of another service,
    // are ignored.
    noisy.outbox.push_back(answer([0x5E, 99, 0, 0, 0, 0, 0, 0]));
    assert_eq!(Master::new(&mut noisy, ANSWER).inquire_node_id().unwrap(), NodeId::new(5));
    let flag = Arc::new(AtomicBool::new(true));
    let mut sent = 0;
    let mut counted = Tap::sending(noisy, |_, _| sent += 1);
    let mut master = Master::new(&mut counted, ANSWER);
    master.cancel_by(flag);
    assert!(matches!(master.fastscan(&mut |_| {}), Err(Error::Cancelled)));
    // A bus whose user has cancelled keeps its bit rate.
    assert!(matches!(master.activate(Duration::from_millis(20)), Err(Error::Cancelled)));
    drop(counted);
    assert_eq!(sent, 0);
}
