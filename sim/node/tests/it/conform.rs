//! The conformance checks against `coboot-node`, alone and with faults between it and the bus.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use crate::bus::{Folder, Nodes};
use canopen::{CobId, Frame, NodeId};
use coboot_can::{Adapter, AdapterError};
use coflash_conform::{checks, run, Check, Means, Outcome};
use embedded_can::Frame as _;

/// A fault: what the device gets, and what it answers. `asked` is the last SDO request.
struct Fault {
    found_by: &'static [&'static str],
    request: fn(Frame) -> Option<Frame>,
    answer: fn(asked: &[u8], Frame) -> Option<Frame>,
}

const NODE: NodeId = NodeId::MIN;
const ASK: CobId = CobId::sdo_request(NODE);

fn same(frame: Frame) -> Option<Frame> {
    Some(frame)
}

fn unchanged(_: &[u8], frame: Frame) -> Option<Frame> {
    Some(frame)
}

/// The answer with its bytes altered, if it is an SDO answer.
fn sdo(frame: Frame, alter: impl FnOnce(&mut [u8; 8])) -> Option<Frame> {
    match frame.exactly::<8>().filter(|_| frame.has_cob_id(CobId::sdo_response(NODE))) {
        Some(data) => {
            let mut data = *data;
            alter(&mut data);
            Some(Frame::full(CobId::sdo_response(NODE), data))
        }
        None => Some(frame),
    }
}

/// The abort code of one refusal replaced by "general error".
fn general(asked: &[u8], frame: Frame, of: &[u8]) -> Option<Frame> {
    sdo(frame, |data| {
        if asked.starts_with(of) && data[0] == 0x80 {
            data[4..].copy_from_slice(&0x0800_0000_u32.to_le_bytes());
        }
    })
}

/// This abort code alone, of those that a command byte may get, replaced in the same way.
fn general_for(asked: &[u8], frame: Frame, command: u8, code: u32) -> Option<Frame> {
    sdo(frame, |data| {
        if asked.first() == Some(&command) && data[0] == 0x80 && data[4..] == code.to_le_bytes() {
            data[4..].copy_from_slice(&0x0800_0000_u32.to_le_bytes());
        }
    })
}

/// The value of one object altered.
fn altered(asked: &[u8], frame: Frame, of: &[u8], alter: fn(&mut [u8; 8])) -> Option<Frame> {
    sdo(frame, |data| {
        if asked.starts_with(of) && data[0] != 0x80 {
            alter(data);
        }
    })
}

const fn answers(found_by: &'static [&'static str], answer: fn(&[u8], Frame) -> Option<Frame>) -> Fault {
    Fault { found_by, request: same, answer }
}

const fn takes(found_by: &'static [&'static str], request: fn(Frame) -> Option<Frame>) -> Fault {
    Fault { found_by, request, answer: unchanged }
}

/// The checks that change no program.
fn harmless() -> Vec<Check> {
    checks().into_iter().filter(|check| !check.installs).collect()
}

const UPLOAD: [u8; 8] = [0x40, 0, 0x10, 0, 0, 0, 0, 0];

#[rustfmt::skip]
const FAULTS: &[Fault] = &[
    // Wrong abort codes.
    answers(&["SDO-001", "SDO-027"], |asked, f| general(asked, f, &[0x40, 0xFF, 0x0F])),
    answers(&["SDO-002"], |asked, f| general(asked, f, &[0x40, 0x18, 0x10, 0xC8])),
    answers(&["SDO-003"], |asked, f| general(asked, f, &[0x40, 0x00, 0x10, 1])),
    answers(&["SDO-004", "SDO-027"], |asked, f| general(asked, f, &[0x23, 0x00, 0x10, 0])),
    answers(&["SDO-005"], |asked, f| general(asked, f, &[0x23, 0x18, 0x10, 1])),
    answers(&["SDO-006"], |asked, f| general(asked, f, &[0x23, 0xFF, 0x0F])),
    answers(&["SDO-007"], |asked, f| general(asked, f, &[0xE0])),
    answers(&["SDO-022"], |asked, f| general(asked, f, &[0x20, 0x00, 0x10])),
    answers(&["PRG-009"], |asked, f| general(asked, f, &[0x40, 0x50, 0x1F, 1])),
    answers(&["PRG-018"], |asked, f| general(asked, f, &[0x2F, 0x51, 0x1F, 1])),
    answers(&["PRG-020"], |asked, f| general(asked, f, &[0x23, 0x51, 0x1F, 1])),
    answers(&["PRG-028"], |asked, f| general_for(asked, f, 0xD9, 0x0609_0030)),
    answers(&["PRG-029"], |asked, f| general_for(asked, f, 0xD9, 0x0504_0004)),
    // A wrong toggle bit is taken for another error.
    answers(&["SEG-002"], |asked, f| {
        sdo(f, |data| if asked[0] == 0x70 && data[4..] == [0, 0, 3, 5] { data[4..].copy_from_slice(&[1, 0, 4, 5]) })
    }),
    // The abort names another object.
    answers(&["SDO-002", "SDO-011"], |asked, f| {
        sdo(f, |data| if asked.starts_with(&[0x40, 0x18, 0x10, 0xC8]) { data[3] = 0 })
    }),
    // One service is aborted with the object of another request; a segment with none in place of its transfer's.
    answers(&["SDO-011", "PRG-034", "PRG-035"], |asked, f| {
        sdo(f, |data| if asked[0] == 0xC6 && data[0] == 0x80 { data[1..4].copy_from_slice(&[0x18, 0x10, 4]) })
    }),
    answers(&["SEG-006"], |asked, f| {
        sdo(f, |data| if asked[0] == 0 && data[..4] == [0x80, 0x08, 0x10, 0] { data[1..3].fill(0) })
    }),
    // The CRC of a block upload.
    answers(&["BLK-003", "BLK-005"], |asked, f| {
        sdo(f, |data| if asked[0] == 0xA2 && data[0] & 0xE3 == 0xC1 { data[1] ^= 1 })
    }),
    // One abort code of several that a request may get.
    answers(&["BLK-008"], |asked, f| general_for(asked, f, 0xA2, 0x0504_0003)),
    // Objects of another size.
    answers(&["OD-002"], |asked, f| altered(asked, f, &[0x40, 0x01, 0x10, 0], |data| data[0] = 0x43)),
    answers(&["PRG-003", "PRG-005"], |asked, f| altered(asked, f, &[0x40, 0x56, 0x1F, 0], |data| data[0] = 0x43)),
    // The flash status is not cleared.
    answers(&["PRG-041"], |asked, f| altered(asked, f, &[0x40, 0x57, 0x1F, 1], |data| data[4] |= 4)),
    // Boot-up messages are missing.
    answers(&["BOOT-001", "BOOT-002", "BOOT-003", "BOOT-004", "LSS-026"], |_, f| {
        (!f.has_cob_id(CobId::heartbeat(NODE)) || f.data() != [0]).then_some(f)
    }),
    // The heartbeat reports operational.
    answers(&["HB-001", "NMT-005"], |_, f| {
        let beat = f.has_cob_id(CobId::heartbeat(NODE)) && f.data() == [0x7F];
        Some(if beat { Frame::of(CobId::heartbeat(NODE), &[5]) } else { f })
    }),
    // Frames that are not requests are taken for some.
    takes(&["FRM-002"], |f| Some(if f.is_extended() && f.data()[0] == 0x40 { Frame::full(ASK, UPLOAD) } else { f })),
    takes(&["FRM-003"], |f| {
        let other = f.has_cob_id(CobId::sdo_request(NodeId::MAX));
        Some(if other { Frame::full(ASK, UPLOAD) } else { f })
    }),
    takes(&["FRM-004"], |f| short(f, 0)),
    takes(&["FRM-007"], |f| short(f, 3)),
    takes(&["FRM-011"], |f| short(f, 7)),
    // NMT frames of another form or for nobody are obeyed.
    takes(&["FRM-013"], |f| obeys(f, |f| f.has_cob_id(CobId::NMT) && f.data().len() == 1)),
    takes(&["FRM-014"], |f| obeys(f, |f| f.has_cob_id(CobId::NMT) && f.data().len() == 6)),
    takes(&["FRM-016"], |f| obeys(f, |f| f.is_extended() && f.data().len() == 2)),
    takes(&["NMT-004"], |f| obeys(f, |f| f.has_cob_id(CobId::NMT) && f.data().get(1) == Some(&0x81))),
    takes(&["NMT-005"], |f| obeys(f, |f| f.has_cob_id(CobId::NMT) && f.data().first() == Some(&0x83))),
    // Wrong values of layer setting services are taken for right ones.
    takes(&["LSS-015"], |f| lss(f, [0x11, 0], [0x11, 1])),
    takes(&["LSS-014"], |f| lss(f, [0x04, 2], [0x04, 0])),
    // Parts of the LSS address that are not compared: a serial number next to the device's.
    takes(&["LSS-003"], |f| serial(f, &[0x43])),
    takes(&["LSS-022"], |f| serial(f, &[0x4A, 0x4B])),
    // The inquiry tells a node-ID that nobody has.
    answers(
        &["LSS-002", "LSS-012", "LSS-014", "LSS-015", "LSS-016", "LSS-017", "LSS-018", "LSS-019"],
        |_, f| Some(if is_inquiry(&f) { Frame::full(CobId::LSS_RESPONSE, [0x5E, 77, 0, 0, 0, 0, 0, 0]) } else { f }),
    ),
    // Answers of layer setting services.
    answers(&["LSS-008"], |_, f| {
        let data = f.exactly::<8>().copied().filter(|data| f.has_cob_id(CobId::LSS_RESPONSE) && data[0] == 0x5B);
        Some(data.map_or(f, |mut data| { data[1] ^= 1; Frame::full(CobId::LSS_RESPONSE, data) }))
    }),
];

/// A request of so many bytes completed.
fn short(frame: Frame, len: usize) -> Option<Frame> {
    Some(if frame.has_cob_id(ASK) && frame.data().len() == len { Frame::full(ASK, UPLOAD) } else { frame })
}

/// Reset communication in the place of a frame.
fn obeys(frame: Frame, which: fn(&Frame) -> bool) -> Option<Frame> {
    Some(if which(&frame) { Frame::of(CobId::NMT, &[0x82, NODE.get()]) } else { frame })
}

/// A request of layer setting services in the place of another one.
fn lss(frame: Frame, of: [u8; 2], to: [u8; 2]) -> Option<Frame> {
    let is = frame.has_cob_id(CobId::LSS_REQUEST) && frame.data().starts_with(&of);
    Some(if is { Frame::full(CobId::LSS_REQUEST, [to[0], to[1], 0, 0, 0, 0, 0, 0]) } else { frame })
}

/// The device's own serial number, 1, in place of the one of these requests.
fn serial(frame: Frame, commands: &[u8]) -> Option<Frame> {
    let of = frame.has_cob_id(CobId::LSS_REQUEST) && commands.contains(&frame.data()[0]);
    Some(if of { Frame::full(CobId::LSS_REQUEST, [frame.data()[0], 1, 0, 0, 0, 0, 0, 0]) } else { frame })
}

/// The answer to the inquiry of the node-ID.
fn is_inquiry(frame: &Frame) -> bool {
    frame.has_cob_id(CobId::LSS_RESPONSE) && frame.data()[0] == 0x5E
}

/// What the node has not, or need not have: remote frames are not in socketcand's protocol, 1017h
/// is const, and a bootloader has no operational state.
const SKIPPED: [&str; 6] = ["HB-004", "NMT-001", "NMT-002", "NMT-003", "NMT-006", "FRM-001"];

/// The bus with the fault in between.
struct Faulty<'f> {
    bus: Box<dyn Adapter + Send>,
    fault: Option<&'f Fault>,
    asked: Vec<u8>,
}

impl Adapter for Faulty<'_> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        if frame.has_cob_id(ASK) {
            self.asked = frame.data().to_vec();
        }
        match self.fault.map_or(Some(*frame), |fault| (fault.request)(*frame)) {
            Some(frame) => self.bus.send(&frame),
            None => Ok(()),
        }
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let frame = self.bus.receive(timeout)?;
        Ok(frame.and_then(|frame| match self.fault {
            Some(fault) => (fault.answer)(&self.asked, frame),
            None => Some(frame),
        }))
    }

    fn now(&self) -> Duration {
        self.bus.now()
    }
}

/// The checks that fail, and those that cannot be judged.
fn verdicts(nodes: &Nodes, fault: Option<&Fault>) -> (Vec<String>, Vec<String>) {
    let bus = coboot_can::open(nodes.url()).unwrap();
    judge(&mut Faulty { bus, fault, asked: Vec::new() }, &harmless())
}

fn judge(bus: &mut dyn Adapter, checks: &[Check]) -> (Vec<String>, Vec<String>) {
    let (mut failed, mut skipped) = (Vec::new(), Vec::new());
    run(bus, NODE, checks, Means::of(Duration::from_secs(1)), &Arc::default(), &mut |verdict| match &verdict
        .outcome
    {
        Outcome::Passed => {}
        Outcome::Failed(what) => failed.push(format!("{}: {what}", verdict.check.id)),
        Outcome::Skipped(why) => skipped.push(format!("{}: {why}", verdict.check.id)),
    })
    .unwrap();
    (failed, skipped)
}

fn ids(lines: &[String]) -> Vec<&str> {
    lines.iter().filter_map(|line| line.split(':').next()).collect()
}

fn device(test: &str) -> (Folder, Nodes) {
    let folder = Folder::new(test);
    let nodes = Nodes::start(&folder, &["--node", "1", "--flash", "instant", "--heartbeat", "50"]);
    (folder, nodes)
}

#[test]
fn a_node_passes() {
    let (_folder, nodes) = device("conform");
    let (failed, skipped) = verdicts(&nodes, None);
    assert!(failed.is_empty(), "{failed:#?}");
    // A node has no RAM image that could be renewed.
    let (of_renewal, others): (Vec<_>, Vec<_>) =
        ids(&skipped).into_iter().partition(|id| id.starts_with("REN-"));
    assert_eq!(others, SKIPPED, "{skipped:#?}");
    assert_eq!(of_renewal.len(), 11, "{of_renewal:?}");
}

/// Each fault has its own node, and most of a run is waiting: all run at the same time.
#[test]
fn each_fault_is_found_by_its_checks_alone() {
    assert!(FAULTS.len() >= 25, "{}", FAULTS.len());
    let wrong: Vec<String> = thread::scope(|scope| {
        let runs: Vec<_> = (0..)
            .zip(FAULTS)
            .map(|(number, fault): (u32, _)| {
                scope.spawn(move || {
                    let (_folder, nodes) = device(&format!("conform-{number}"));
                    let (failed, _) = verdicts(&nodes, Some(fault));
                    let expected = fault.found_by;
                    (ids(&failed) != expected).then(|| format!("fault {number}, {expected:?}: {failed:#?}"))
                })
            })
            .collect();
        runs.into_iter().filter_map(|run| run.join().unwrap()).collect()
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The checks of these groups.
fn of(groups: &[&str]) -> Vec<Check> {
    harmless().into_iter().filter(|check| groups.contains(&check.group())).collect()
}

/// The next devices of the lot: their serial numbers are the neighbours of this device's.
#[test]
fn answers_of_other_devices_are_not_blamed_on_this_one() {
    for serial in ["1", "2", "0x7FFFFFFF"] {
        let folder = Folder::new(&format!("conform-lot-{serial}"));
        let lot = ["--node", "1", "--count", "5", "--serial", serial, "--flash", "instant"];
        let nodes = Nodes::start(&folder, &lot);
        let mut bus = coboot_can::open(nodes.url()).unwrap();
        assert_eq!(judge(&mut bus, &of(&["LSS"])), (Vec::new(), Vec::new()), "{serial}");
    }
}

/// The identities of the nodes are equal, as those of examples often are.
#[test]
fn a_device_with_the_same_lss_address_is_named() {
    let node_9 = (&["--node", "9"][..], Frame::full(CobId::sdo_request(NodeId::new(9).unwrap()), UPLOAD));
    // LSS identify non-configured remote slave.
    let unconfigured =
        (&["--unconfigured"][..], Frame::full(CobId::LSS_REQUEST, [0x4C, 0, 0, 0, 0, 0, 0, 0]));
    for ((arguments, ask), answer, name) in [
        (node_9, CobId::sdo_response(NodeId::new(9).unwrap()), "node 9"),
        (unconfigured, CobId::LSS_RESPONSE, "a device without node-ID"),
    ] {
        let folder = Folder::new(&format!("conform-twin-of-{}", name.len()));
        let twin = Folder::new(&format!("conform-twin-{}", name.len()));
        let nodes = Nodes::start(&folder, &["--node", "1", "--flash", "instant"]);
        let _twin = Nodes::join(&twin, nodes.url(), &[arguments, &["--flash", "instant"]].concat());
        let mut bus = coboot_can::open(nodes.url()).unwrap();
        // It has joined when it answers.
        let mut answered = false;
        while !answered {
            bus.send(&ask).unwrap();
            let heard = bus.receive(Duration::from_millis(100)).unwrap();
            answered = heard.is_some_and(|frame| frame.has_cob_id(answer));
        }
        let (failed, skipped) = judge(&mut bus, &of(&["LSS"]));
        assert!(failed.is_empty(), "{failed:#?}");
        assert_eq!(skipped.len(), of(&["LSS"]).len());
        let words = format!("{name} has the same LSS address");
        assert!(skipped.iter().all(|line| line.contains(&words)), "{skipped:#?}");
    }
}

/// A bus with a device that answers the inquiry of the node-ID without having been selected.
struct Intruder {
    bus: Box<dyn Adapter + Send>,
    node: u8,
    answers: Vec<Frame>,
}

impl Adapter for Intruder {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        if frame.has_cob_id(CobId::LSS_REQUEST) && frame.exactly::<8>().is_some_and(|data| data[0] == 0x5E) {
            self.answers.push(Frame::full(CobId::LSS_RESPONSE, [0x5E, self.node, 0, 0, 0, 0, 0, 0]));
        }
        self.bus.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        match self.answers.pop() {
            Some(frame) => Ok(Some(frame)),
            None => self.bus.receive(timeout),
        }
    }

    fn now(&self) -> Duration {
        self.bus.now()
    }
}

#[test]
fn a_device_that_answers_without_being_selected_is_named() {
    let folder = Folder::new("conform-intruder");
    let nodes = Nodes::start(&folder, &["--node", "1", "--count", "2", "--flash", "instant"]);
    let mut bus = Intruder { bus: coboot_can::open(nodes.url()).unwrap(), node: 2, answers: Vec::new() };
    let (failed, skipped) = judge(&mut bus, &of(&["LSS"]));
    assert!(failed.is_empty(), "{failed:#?}");
    assert!(skipped.iter().all(|line| line.contains("node 2 answers in LSS waiting state")), "{skipped:#?}");
    // Nobody has node-ID 77: it is this device that answers.
    bus.node = 77;
    let (failed, _) = judge(&mut bus, &of(&["LSS"]));
    assert!(ids(&failed).contains(&"LSS-001"), "{failed:#?}");
}

/// 1017h is optional (CiA 301): a master may guard its nodes.
#[test]
fn a_device_without_heartbeat_time_is_not_blamed() {
    let (_folder, nodes) = device("conform-no-1017");
    let absent = answers(&[], |asked, f| {
        sdo(f, |data| {
            if asked.get(1..3) == Some(&[0x17, 0x10]) {
                *data = [0x80, 0x17, 0x10, 0, 0, 0, 2, 6];
            }
        })
    });
    let bus = coboot_can::open(nodes.url()).unwrap();
    let mut bus = Faulty { bus, fault: Some(&absent), asked: Vec::new() };
    let (failed, skipped) = judge(&mut bus, &of(&["HB", "OD"]));
    assert!(failed.is_empty(), "{failed:#?}");
    assert_eq!(ids(&skipped), ["HB-002", "HB-003", "HB-004", "HB-005", "OD-007"], "{skipped:#?}");
}
