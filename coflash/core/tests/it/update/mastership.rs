//! Before and during the update of a lift (CiA 814-1 clause 6.3): the device's information, another
//! device with node-ID 126, and the NMT mastership of flying masters (CiA 302-2).

use std::collections::VecDeque;
use std::time::Duration;

use canopen::{CobId, Frame, NodeId};
use coboot_can::{Adapter, AdapterError};
use coflash_core::device::Dialect;
use coflash_core::file::block_file;
use coflash_core::update::event::{Note, Warning};
use coflash_core::update::{Event, FlashOptions, Password, Report};
use coflash_core::Error;

use super::update;
use crate::tap::Tap;
use kit::fake::{Deed, Fake, Maker, APPLICATION, NODE};

const LIFT: u32 = 0xFE00_01A1;

/// A lift device as the document has it, in short.
struct Lift {
    armed: bool,
}

impl Maker for Lift {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        match at {
            (0x6005, 1) => Some(Err(0x0601_0001)),
            (0x1F50 | 0x1F56 | 0x1F57, _) => Some(Err(0x0602_0000)),
            (0x1008, 0) => Some(Ok(b"Door drive".to_vec())),
            (0x1009, 0) => Some(Ok(b"B2".to_vec())),
            (0x100A, 0) => Some(Ok(b"1.2.0".to_vec())),
            (0x1018, sub) => Some(Ok(vec![sub, 0, 0, 0x10])),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], running: u32) -> Option<Result<Deed, u32>> {
        Some(match (at, data) {
            ((0x6005, 1), b"open") => {
                self.armed = running == APPLICATION;
                Ok(Deed::Nothing)
            }
            ((0x6005, 1), _) => Err(0x0609_0030),
            ((0x1F51, 1), [2]) if self.armed => {
                self.armed = false;
                Ok(Deed::Restart(126, LIFT))
            }
            ((0x1F51, 1), [2]) => Ok(Deed::Restart(NODE, APPLICATION)),
            _ => Ok(Deed::Nothing),
        })
    }
}

fn lift() -> Fake {
    let mut fake = Fake::new(APPLICATION);
    fake.maker = Some(Box::new(Lift { armed: false }));
    fake
}

fn run(adapter: &mut dyn Adapter, options: &FlashOptions) -> (Result<Report, Error>, Vec<Event>) {
    // A program that names no product.
    update(adapter, block_file::read(data!("plain-400.blk")).unwrap(), options)
}

/// Whether an event begins with this text.
fn told_of_mastership(events: &[Event], words: &str) -> bool {
    events.iter().any(|event| event.to_string().contains(words))
}

fn options() -> FlashOptions {
    FlashOptions::default().unlock(Password::new("open"))
}

fn frame(id: u16, data: &[u8]) -> Frame {
    Frame::of(CobId::new(id).unwrap(), data)
}

fn node(id: u8) -> NodeId {
    NodeId::new(id).unwrap()
}

/// The reaction of a flying master to 076h. Two existing stacks differ here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Forced {
    /// The active master begins a negotiation at once.
    Negotiates,
    /// It waits for 500 ms (1F90h/2) and then looks for an active master; negotiates if there is
    /// none.
    Detects,
    /// It does not know 076h.
    Ignores,
    /// It always answers that it is the master.
    Stays,
}

/// A network with a lift device and a flying master, played from the services' description: the
/// data of 071h are priority and node-ID, slots are 1500 ms a priority and 10 ms a node-ID.
struct Network {
    fake: Fake,
    priority: u8,
    id: u8,
    active: bool,
    forced: Forced,
    /// When its timer ends, and its frame then: 0x71, 0x72 or 0x73.
    timer: Option<(Duration, u16)>,
    outbox: VecDeque<Frame>,
    /// Who said what of the protocol: from the tool `>`, from the master `<`.
    log: Vec<String>,
}

impl Network {
    fn new(priority: u8, id: u8, forced: Forced) -> Self {
        let (outbox, log) = (VecDeque::new(), Vec::new());
        Self { fake: lift(), priority, id, active: true, forced, timer: None, outbox, log }
    }

    fn say(&mut self, id: u16) {
        let data = [self.priority, self.id];
        let data = if id == 0x71 { &data[..] } else { &[] };
        self.log.push(format!("<{id:02X} {data:?}"));
        self.outbox.push_back(frame(id, data));
        let slot = u64::from(self.priority) * 1500 + u64::from(self.id) * 10;
        self.timer = match id {
            0x72 => Some((self.fake.now + Duration::from_millis(slot), 0x71)),
            0x73 => Some((self.fake.now + Duration::from_millis(100), 0x72)),
            _ => None,
        };
        self.active |= id == 0x71;
    }

    fn hear(&mut self, id: u16, data: &[u8]) {
        self.log.push(format!(">{id:02X} {data:?}"));
        match (id, data) {
            (0x71, &[priority, _]) if self.forced != Forced::Stays => {
                assert!(priority < self.priority);
                (self.active, self.timer) = (false, None);
            }
            (0x72, []) if self.forced != Forced::Stays => {
                let slot = u64::from(self.priority) * 1500 + u64::from(self.id) * 10;
                self.active = false;
                self.timer = Some((self.fake.now + Duration::from_millis(slot), 0x71));
            }
            (0x73, []) if self.active => self.say(0x71),
            (0x76, []) if self.active => match self.forced {
                Forced::Negotiates => {
                    self.active = false;
                    self.say(0x72);
                }
                Forced::Detects => {
                    self.active = false;
                    self.timer = Some((self.fake.now + Duration::from_millis(500), 0x73));
                }
                Forced::Ignores | Forced::Stays => {}
            },
            _ => {}
        }
    }
}

impl Adapter for Network {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        use embedded_can::Frame as _;
        self.fake.send(frame)?;
        match frame.cob_id().map(|id| id.get()) {
            Some(id @ 0x71..=0x76) => self.hear(id, frame.data()),
            Some(id) if id > 0x600 && self.log.last().is_none_or(|last| last != "sdo") => {
                self.log.push("sdo".to_string());
            }
            _ => {}
        }
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.fake.now + timeout;
        loop {
            if let Some((_, id)) = self.timer.filter(|(at, _)| *at <= self.fake.now) {
                self.timer = None;
                self.say(id);
            }
            if let Some(frame) = self.outbox.pop_front() {
                return Ok(Some(frame));
            }
            let next = self.timer.map_or(until, |(at, _)| at.min(until));
            let left = next.saturating_sub(self.fake.now);
            match self.fake.receive(left)? {
                Some(frame) => return Ok(Some(frame)),
                None if self.fake.now >= until => return Ok(None),
                None => {}
            }
        }
    }

    fn now(&self) -> Duration {
        self.fake.now
    }
}

#[test]
fn what_a_lift_tells_of_itself_is_shown_before_anything_is_done_to_it() {
    let mut fake = lift();
    let (result, events) = run(&mut fake, &options());
    assert_eq!(result.unwrap().dialect, Dialect::Lift);
    let shown = events.iter().position(|event| matches!(event, Event::Note(Note::Nameplate(_)))).unwrap();
    let unlocked = events.iter().position(|event| *event == Note::Unlocked.into()).unwrap();
    assert!(shown < unlocked, "{events:?}");
    assert_eq!(
        events[shown].to_string(),
        "device: Door drive, hardware B2, software 1.2.0, vendor-ID 10000001h, product code 10000002h, revision \
         10000003h, serial number 10000004h"
    );
    // Only the question for the active master was sent, and there is none.
    let sent = fake.sent.iter().filter_map(|frame| frame.cob_id()).map(|id| id.get());
    assert_eq!(sent.filter(|id| (0x71..=0x76).contains(id)).collect::<Vec<_>>(), [0x73]);
}

/// A node 126 without SDO that sends a heartbeat every second is another device in its bootloader.
#[test]
fn a_node_126_that_only_sends_heartbeats_is_noticed() {
    let fake = lift();
    let mut next = fake.now + Duration::from_millis(990);
    let mut bus = Tap::receiving(fake, |fake, timeout| {
        if next <= fake.now + timeout {
            fake.now = fake.now.max(next);
            next += Duration::from_secs(1);
            return Ok(Some(frame(0x77E, &[0x7F])));
        }
        fake.receive(timeout)
    });
    let (result, _) = run(&mut bus, &options());
    assert!(matches!(result, Err(Error::Occupied { node }) if node.get() == 126), "{result:?}");
    assert!(bus.of.writes().is_empty(), "{:?}", bus.of.writes());
    let advice = result.unwrap_err().advice().to_string();
    assert!(advice.contains("node 126"), "{advice}");
}

#[test]
fn the_mastership_is_asked_for_and_given_back_around_the_update() {
    for (forced, asking) in [
        (
            Forced::Negotiates,
            &[">73 []", "<71 [1, 3]", "sdo", ">76 []", "<72 []", ">71 [0, 127]", ">73 []"][..],
        ),
        (Forced::Detects, &[">73 []", "<71 [1, 3]", "sdo", ">76 []", "<73 []", ">71 [0, 127]", ">73 []"]),
        (Forced::Ignores, &[">73 []", "<71 [1, 3]", "sdo", ">76 []", ">72 []", ">71 [0, 127]", ">73 []"]),
    ] {
        let mut network = Network::new(1, 3, forced);
        let (result, events) = run(&mut network, &options());
        assert!(result.is_ok(), "{forced:?}: {result:?}");
        let log: Vec<&str> =
            network.log.iter().map(String::as_str).skip_while(|entry| *entry == "sdo").collect();
        assert_eq!(log[..asking.len()], *asking, "{forced:?}: {log:?}");
        // The update, and then a negotiation without the tool.
        assert_eq!(log[asking.len()..], ["sdo", ">72 []", "<71 [1, 3]"], "{forced:?}: {log:?}");
        let place = |wanted: &Event| events.iter().position(|event| event == wanted);
        let taken = Note::MasterTaken { node: node(3) }.into();
        let back = Note::MasterBack { node: node(3) }.into();
        assert!(place(&taken) < place(&Note::Unlocked.into()), "{events:?}");
        assert!(place(&back) > place(&Note::Moved { node: node(126) }.into()), "{events:?}");
        assert!(network.active);
    }
    // The mastership is also given back after a failed update.
    let mut network = Network::new(2, 10, Forced::Negotiates);
    let (result, events) = run(&mut network, &options().unlock(Password::new("no")));
    assert!(result.is_err() && network.active);
    assert!(events.contains(&Note::MasterBack { node: node(10) }.into()), "{events:?}");
    // The option leaves the master alone.
    let mut network = Network::new(1, 3, Forced::Negotiates);
    let (result, events) = run(&mut network, &options().mastership(false));
    assert!(result.is_ok() && network.log.iter().all(|entry| entry == "sdo"), "{events:?}");
}

#[test]
fn a_master_that_does_not_let_go_is_told_and_the_update_goes_on() {
    for (priority, forced) in [(0, Forced::Negotiates), (1, Forced::Stays)] {
        let mut network = Network::new(priority, 3, forced);
        let (result, events) = run(&mut network, &options());
        assert!(result.is_ok(), "{result:?}");
        assert!(events.contains(&Warning::MasterKept { node: node(3) }.into()), "{events:?}");
        assert!(!told_of_mastership(&events, "NMT mastership given back"));
        let forces = network.log.iter().filter(|entry| *entry == ">76 []").count();
        assert_eq!(forces, usize::from(priority > 0), "{:?}", network.log);
    }
}

/// A flying master that comes up in the middle asks who is the master: without an answer it would
/// restart the network.
#[test]
fn while_the_tool_is_the_master_it_says_so() {
    let mut network = Network::new(1, 3, Forced::Negotiates);
    // The lift's bootloader answers at node-ID 126; then somebody asks.
    let (mut asked, mut before) = (false, None);
    let mut asking = Tap::receiving(&mut network, |network, timeout| {
        let is_master = network.log.contains(&">71 [0, 127]".into());
        let lift = |sent: &&Frame| sent.cob_id().is_some_and(|id| id.get() == 0x67E);
        let sent = network.fake.sent.iter().filter(lift).count();
        if is_master && !asked && sent > *before.get_or_insert(sent) {
            asked = true;
            network.log.push("asked".into());
            return Ok(Some(frame(0x73, &[])));
        }
        network.receive(timeout)
    });
    let (result, _) = run(&mut asking, &options());
    drop(asking);
    assert!(result.is_ok(), "{result:?}");
    let at = network.log.iter().position(|entry| entry == "asked").unwrap();
    assert_eq!(network.log[at + 1], ">71 [0, 127]", "{:?}", network.log);
}

/// 071h with another length, with no node-ID, or from nobody.
#[test]
fn damaged_answers_are_no_masters() {
    for data in [&[][..], &[1], &[1, 0], &[1, 128], &[1, 3, 0], &[1, 3, 0, 0, 0, 0, 0, 0]] {
        let mut fake = lift();
        fake.noise.push(frame(0x71, data));
        let (result, events) = run(&mut fake, &options());
        assert!(result.is_ok(), "{data:?}: {result:?}");
        assert!(!told_of_mastership(&events, "NMT mastership"));
    }
}
