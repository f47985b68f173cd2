//! A slave on the bus; frames from CiA 301 sections 7.2.8.2 and 7.2.8.3.

use canopen::nmt::{parse_state_message, NmtCommand, NmtState};
use canopen::node::{Config, NmtPolicy, Node};
use canopen::od::{Address, Entry, Exchange, Objects};
use canopen::{AbortCode, CobId, Frame, Instant, NodeId};
use embedded_can::{ExtendedId, Frame as _, StandardId};
use kit::bus::{at, node, request, response, Device, Event};

struct Bench {
    node: Node,
    device: Device,
}

impl Bench {
    fn new(config: Config) -> Self {
        Self { node: Node::new(node(), config), device: Device::default() }
    }

    fn handle(&mut self, frame: &Frame, now: u32) -> Option<NmtCommand> {
        self.node.handle(frame, at(now), &mut self.device)
    }

    /// All frames that the node sends at this time.
    fn sent(&mut self, now: u32) -> Vec<Frame> {
        core::iter::from_fn(|| self.node.poll(at(now), &mut self.device)).collect()
    }
}

fn nmt(bytes: &[u8]) -> Frame {
    Frame::of(CobId::NMT, bytes)
}

fn state(byte: u8) -> Frame {
    Frame::of(CobId::new(0x705).unwrap(), &[byte])
}

const READ_1000: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
const IS_1000: [u8; 8] = [0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10];

/// A device whose process data are others at each moment.
#[derive(Default)]
struct Eager(Device);

impl Objects for Eager {
    fn entries(&self) -> &'static [Entry] {
        self.0.entries()
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        self.0.read(at, buf)
    }

    fn exchange(&mut self) -> Option<&mut dyn Exchange> {
        Some(self)
    }
}

impl Exchange for Eager {
    fn state_changed(&mut self, _: NmtState) {}

    fn handle(&mut self, _: &Frame) {}

    fn poll(&mut self, _: Instant) -> Option<Frame> {
        Some(Frame::of(CobId::new(0x185).unwrap(), &[1]))
    }

    fn identifier(&self, _: usize) -> Option<CobId> {
        None
    }

    fn identifiers_changed(&mut self) -> bool {
        false
    }
}

#[test]
fn a_node_with_a_pdo_at_each_moment_sends_its_heartbeat() {
    let mut device = Eager::default();
    let config = Config { heartbeat_ms: 100, nmt: NmtPolicy::Follow, ..Config::default() };
    let mut node = Node::new(node(), config);
    assert_eq!(node.poll(at(0), &mut device), Some(state(0x00)));
    node.handle(&nmt(&[0x01, 0]), at(0), &mut device);
    assert_eq!(
        [99, 100, 100].map(|now| node.poll(at(now), &mut device) == Some(state(0x05))),
        [false, true, false]
    );
}

#[test]
fn says_its_boot_up_once_and_then_its_heartbeat() {
    let mut bench = Bench::new(Config { heartbeat_ms: 100, ..Config::default() });
    assert_eq!(bench.node.state(), NmtState::Initialisation);
    // Before the boot-up message the node does not answer.
    assert_eq!(bench.handle(&nmt(&[0x81, 0]), 0), None);
    assert_eq!(bench.handle(&request(READ_1000), 0), None);
    assert_eq!(bench.sent(50), [state(0x00)]);
    assert_eq!(bench.node.state(), NmtState::PreOperational);
    assert_eq!(bench.sent(149), []);
    assert_eq!(bench.sent(150), [state(0x7F)]);
    assert_eq!(bench.sent(150), []);
    bench.handle(&request(READ_1000), 160);
    assert_eq!(bench.sent(160), [response(IS_1000)]);
    bench.node.set_heartbeat_ms(10, at(170));
    assert_eq!(bench.sent(180), [state(0x7F)]);
    bench.node.set_heartbeat_ms(0, at(180));
    assert_eq!(bench.sent(10_000), []);
}

#[test]
fn a_bootloader_stays_pre_operational_and_reports() {
    let mut bench = Bench::new(Config { heartbeat_ms: 100, ..Config::default() });
    assert_eq!(bench.sent(0), [state(0x00)]);
    for (byte, command) in [
        (0x01, NmtCommand::Start),
        (0x02, NmtCommand::Stop),
        (0x80, NmtCommand::EnterPreOperational),
        (0x81, NmtCommand::ResetNode),
        (0x82, NmtCommand::ResetCommunication),
    ] {
        for addressed in [0, 5] {
            assert_eq!(bench.handle(&nmt(&[byte, addressed]), 1), Some(command));
            assert_eq!(bench.node.state(), NmtState::PreOperational);
        }
        assert_eq!(command.emit(NodeId::new(5)), nmt(&[byte, 5]));
        assert_eq!(command.emit(None), nmt(&[byte, 0]));
    }
    bench.handle(&request(READ_1000), 1);
    assert_eq!(bench.sent(100), [response(IS_1000), state(0x7F)]);
}

#[test]
fn an_application_follows_its_master() {
    let config = Config { heartbeat_ms: 100, nmt: NmtPolicy::Follow, ..Config::default() };
    let mut bench = Bench::new(config);
    assert_eq!(bench.sent(0), [state(0x00)]);
    bench.handle(&nmt(&[0x01, 5]), 1);
    assert_eq!(bench.sent(100), [state(0x05)]);
    // Stop ends a transfer, and SDO no longer works.
    bench.handle(&request([0x21, 0x50, 0x1F, 1, 9, 0, 0, 0]), 101);
    bench.handle(&nmt(&[0x02, 0]), 102);
    assert_eq!(bench.device.events, [Event::Start(Some(9)), Event::Cancel]);
    bench.handle(&request(READ_1000), 103);
    assert_eq!(bench.sent(200), [state(0x04)]);
    bench.handle(&nmt(&[0x80, 5]), 201);
    bench.handle(&request(READ_1000), 202);
    assert_eq!(bench.sent(300), [response(IS_1000), state(0x7F)]);
}

#[test]
fn what_is_no_nmt_command_is_none() {
    let mut bench = Bench::new(Config::default());
    bench.sent(0);
    let id = StandardId::new(0).unwrap();
    for frame in [
        nmt(&[0x81]),
        nmt(&[0x81, 5, 0]),
        nmt(&[]),
        nmt(&[0x81, 6]),
        nmt(&[0x81, 0x85]),
        nmt(&[0x03, 0]),
        nmt(&[0xFF, 0]),
        Frame::new_remote(id, 2).unwrap(),
        Frame::new(ExtendedId::new(0).unwrap(), &[0x81, 0]).unwrap(),
    ] {
        assert_eq!(bench.handle(&frame, 1), None, "{frame}");
    }
    assert_eq!(bench.sent(1), []);
}

#[test]
fn a_listener_reads_boot_up_and_heartbeat() {
    let id = NodeId::new(5).unwrap();
    assert_eq!(parse_state_message(&state(0x00)), Some((id, NmtState::Initialisation)));
    assert_eq!(parse_state_message(&state(0x04)), Some((id, NmtState::Stopped)));
    assert_eq!(parse_state_message(&state(0x05)), Some((id, NmtState::Operational)));
    assert_eq!(parse_state_message(&state(0x7F)), Some((id, NmtState::PreOperational)));
    assert_eq!(parse_state_message(&state(0x01)), None);
    assert_eq!(parse_state_message(&Frame::of(CobId::new(0x700).unwrap(), &[0x05])), None);
    assert_eq!(parse_state_message(&Frame::of(CobId::new(0x7E5).unwrap(), &[0x04, 0])), None);
    assert_eq!(parse_state_message(&Frame::of(CobId::new(0x685).unwrap(), &[0x05])), None);
}
