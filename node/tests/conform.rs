//! The conformance checks against `coboot-node`, alone and with faults between it and the bus.

mod bus;

use std::sync::Arc;
use std::time::Duration;

use bus::{Folder, Nodes};
use canopen::{CobId, Frame, NodeId};
use coflash::bus::{Adapter, AdapterError};
use coflash::conform::{checks, run, Outcome};
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

const UPLOAD: [u8; 8] = [0x40, 0, 0x10, 0, 0, 0, 0, 0];

const FAULTS: &[Fault] = &[
    // Wrong abort codes.
    answers(&["SDO-001"], |asked, f| general(asked, f, &[0x40, 0xFF, 0x0F])),
    answers(&["SDO-002"], |asked, f| general(asked, f, &[0x40, 0x18, 0x10, 0xC8])),
    answers(&["SDO-003"], |asked, f| general(asked, f, &[0x40, 0x00, 0x10, 1])),
    answers(&["SDO-004"], |asked, f| general(asked, f, &[0x23, 0x00, 0x10])),
    answers(&["SDO-005"], |asked, f| general(asked, f, &[0x23, 0x18, 0x10])),
    answers(&["SDO-006"], |asked, f| general(asked, f, &[0x23, 0xFF, 0x0F])),
    answers(&["SDO-007"], |asked, f| general(asked, f, &[0xE0])),
    answers(&["SDO-009"], |asked, f| general(asked, f, &[0x01])),
    // The abort names another object.
    answers(&["SDO-011"], |asked, f| {
        sdo(f, |data| {
            if asked.starts_with(&[0x40, 0x18, 0x10, 0xC8]) {
                data[3] = 0
            }
        })
    }),
    // Objects: a size that is wrong, and a number of entries that is.
    answers(&["OD-002"], |asked, f| altered(asked, f, &[0x40, 0x01, 0x10, 0], |data| data[0] = 0x43)),
    answers(&["BOOT-001", "BOOT-002"], |_, f| {
        (!f.has_cob_id(CobId::heartbeat(NODE)) || f.data() != [0]).then_some(f)
    }),
    // Frames that are not requests are taken for some.
    takes(&["FRM-001"], |f| if f.is_remote_frame() { Some(Frame::full(ASK, UPLOAD)) } else { Some(f) }),
    takes(&["FRM-002"], |f| if f.is_extended() { Some(Frame::full(ASK, UPLOAD)) } else { Some(f) }),
    takes(&["FRM-003"], |f| {
        let other = f.has_cob_id(CobId::sdo_request(NodeId::MAX));
        if other {
            Some(Frame::full(ASK, UPLOAD))
        } else {
            Some(f)
        }
    }),
    takes(&["FRM-004"], |f| {
        if f.has_cob_id(ASK) && f.data().is_empty() {
            Some(Frame::full(ASK, UPLOAD))
        } else {
            Some(f)
        }
    }),
];

/// The node stays in pre-operational state whatever it is told: a bootloader has no PDO.
const KNOWN: [&str; 3] = ["NMT-001", "NMT-002", "NMT-003"];

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
    let bus = coflash::bus::open(nodes.url()).unwrap();
    let mut bus = Faulty { bus, fault, asked: Vec::new() };
    let (mut failed, mut skipped) = (Vec::new(), Vec::new());
    // HB-002 depends on the clock of the host that runs the tests.
    let checks: Vec<_> = checks().into_iter().filter(|check| check.id != "HB-002").collect();
    run(&mut bus, NODE, &checks, Duration::from_millis(150), &Arc::default(), &mut |verdict| match &verdict
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
fn a_node_passes_all_but_the_states_of_nmt() {
    let (_folder, nodes) = device("conform");
    let (failed, skipped) = verdicts(&nodes, None);
    assert_eq!(ids(&failed), KNOWN, "{failed:#?}");
    // socketcand has no remote frames.
    assert_eq!(ids(&skipped), ["FRM-001"], "{skipped:#?}");
}

#[test]
fn each_fault_is_found_by_its_check_alone() {
    let (_folder, nodes) = device("conform-faults");
    for fault in FAULTS {
        let (failed, _) = verdicts(&nodes, Some(fault));
        let found: Vec<_> = ids(&failed).into_iter().filter(|id| !KNOWN.contains(id)).collect();
        assert_eq!(found, fault.found_by, "{failed:#?}");
    }
}
