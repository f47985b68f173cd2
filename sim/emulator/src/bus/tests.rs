//! The bus with host ports and bxCAN controllers on it. Times are worked out by hand from the frame
//! lengths that the tests of [`crate::frame`] fix: 080# has 48 bits without intermission, 701#00
//! has 56.

use std::cell::RefCell;
use std::rc::Rc;

use super::fault::{FrameMatch, When};
use super::node::Pins;
use super::port::{HostPort, Unplugged};
use super::*;
use crate::bxcan::BxCan;
use crate::peripheral::Peripheral;

const US: u64 = 1_000_000;

/// A node for the tests.
enum Node {
    Port(HostPort),
    Can(Box<BxCan>),
    Nothing(Unplugged),
}

struct Bench {
    bus: Bus,
    nodes: Vec<Node>,
    log: Rc<RefCell<Vec<Record>>>,
}

impl Bench {
    fn new(nodes: Vec<Node>) -> Self {
        let mut bus = Bus::new();
        let log = Rc::new(RefCell::new(Vec::new()));
        let sink = log.clone();
        bus.add_sink(move |record| sink.borrow_mut().push(*record));
        Self { bus, nodes, log }
    }

    fn ports(rates: &[u32]) -> Self {
        Self::new(rates.iter().map(|rate| Node::Port(HostPort::new(*rate))).collect())
    }

    /// Runs until so many microseconds.
    fn run(&mut self, until: u64) {
        self.bus.advance(Time(until * US), &mut refs(&mut self.nodes));
    }

    fn hold_dominant(&mut self, is_held: bool) {
        self.bus.hold_dominant(is_held, &mut refs(&mut self.nodes));
    }

    fn port(&mut self, n: usize) -> &mut HostPort {
        match &mut self.nodes[n] {
            Node::Port(port) => port,
            _ => panic!("node {n} is no port"),
        }
    }

    fn can(&mut self, n: usize) -> &mut BxCan {
        match &mut self.nodes[n] {
            Node::Can(can) => can,
            _ => panic!("node {n} is no controller"),
        }
    }

    fn send(&mut self, n: usize, at: u64, frame: Frame) {
        self.port(n).send(frame, Time(at * US));
    }

    fn received(&mut self, n: usize) -> Vec<(u64, String)> {
        let port = self.port(n);
        std::iter::from_fn(|| port.receive()).map(|(at, frame)| (at.0 / US, frame.to_string())).collect()
    }

    fn read(&mut self, n: usize, offset: u32) -> u32 {
        let now = self.bus.now();
        self.can(n).read(offset, now).unwrap()
    }

    fn write(&mut self, n: usize, offset: u32, value: u32) {
        let now = self.bus.now();
        self.can(n).write(offset, value, now).unwrap();
    }

    /// (start, end) in microseconds, identifier, outcome.
    fn log(&self) -> Vec<(u64, u64, u32, Outcome)> {
        let log = self.log.borrow();
        log.iter().map(|r| (r.start.0 / US, r.end.0 / US, r.frame.raw_id(), r.outcome)).collect()
    }
}

fn refs(nodes: &mut [Node]) -> Vec<&mut dyn BusNode> {
    let each = nodes.iter_mut().map(|node| match node {
        Node::Port(port) => port as &mut dyn BusNode,
        Node::Can(can) => can.as_mut(),
        Node::Nothing(nothing) => nothing,
    });
    each.collect()
}

fn port() -> Node {
    Node::Port(HostPort::new(1_000_000))
}

fn sync() -> Frame {
    Frame::standard(0x080, &[]).unwrap()
}

fn boot_up() -> Frame {
    Frame::standard(0x701, &[0]).unwrap()
}

/// A controller at 1 Mbit/s that is on the bus at `BASE` µs, all frames into FIFO 0. `btr`: SILM
/// and LBKM.
fn controller(btr: u32, mcr: u32) -> Node {
    let mut can = BxCan::new();
    can.resolved(Time(0));
    can.set_up(mcr, btr);
    Node::Can(Box::new(can))
}

#[test]
fn a_frame_takes_its_bits() {
    let mut bench = Bench::ports(&[1_000_000, 1_000_000]);
    bench.send(0, 100, sync());
    bench.send(0, 100, boot_up());
    bench.run(1000);
    // 48 bits, 3 of intermission, 56 bits. Receivers have it one bit earlier.
    assert_eq!(bench.log(), [(100, 148, 0x080, Outcome::Good), (151, 207, 0x701, Outcome::Good)]);
    assert_eq!(bench.received(1), [(147, "080#".into()), (206, "701#00".into())]);
    assert_eq!(bench.received(0), []);
    let sent: Vec<_> = std::iter::from_fn(|| bench.port(0).sent()).map(|(at, n, _)| (at.0 / US, n)).collect();
    assert_eq!(sent, [(148, 1), (207, 2)]);
    assert_eq!(bench.bus.totals(), (2, 0));

    let mut bench = Bench::ports(&[125_000, 125_000]);
    bench.send(0, 0, sync());
    bench.run(1000);
    assert_eq!(bench.log(), [(0, 384, 0x080, Outcome::Good)]);
}

#[test]
fn three_nodes_arbitrate() {
    let mut bench = Bench::ports(&[1_000_000; 4]);
    bench.send(0, 10, Frame::standard(0x701, &[0]).unwrap());
    bench.send(1, 10, Frame::extended(0x080 << 18, &[]).unwrap());
    bench.send(2, 10, Frame::standard(0x080, &[]).unwrap());
    // Comes while the first frame is on the wire, and is the strongest of those that wait at its
    // end.
    bench.send(3, 40, Frame::standard(0x000, &[]).unwrap());
    bench.run(1000);
    let order: Vec<_> = bench.log.borrow().iter().map(|record| record.frame.to_string()).collect();
    assert_eq!(order, ["080#", "000#", "02000000#", "701#00"]);
    assert_eq!(bench.log()[1].0, 10 + 48 + 3);
    let received: Vec<_> = bench.received(0).into_iter().map(|(_, frame)| frame).collect();
    assert_eq!(received, ["080#", "000#", "02000000#"]);
    for n in 0..4 {
        assert_eq!(bench.port(n).error_counters().tec(), 0, "losing is no error");
    }
}

#[test]
fn same_frame_from_two_nodes_is_one_frame() {
    let mut bench = Bench::ports(&[1_000_000; 3]);
    bench.send(0, 0, boot_up());
    bench.send(1, 0, boot_up());
    bench.run(500);
    assert_eq!(bench.log().len(), 1);
    assert_eq!(bench.received(2).len(), 1);
    assert_eq!((bench.port(0).waiting(), bench.port(1).waiting()), (0, 0));
}

#[test]
fn same_identifier_with_other_data_is_a_bit_error() {
    let mut bench = Bench::ports(&[1_000_000; 3]);
    bench.send(0, 0, Frame::standard(0x701, &[0x00]).unwrap());
    bench.send(1, 0, Frame::standard(0x701, &[0x7F]).unwrap());
    bench.run(45);
    // SOF 0, identifier 111 00000 (1) 001, RTR, IDE, r0 000, DLC 00 (1) 01, where (1) are stuff
    // bits: 21 bits. The first data bit is 0 in both, the second one differs: the 23rd.
    let (start, end, _, outcome) = bench.log()[0];
    assert_eq!((start, outcome), (0, Outcome::Bad(ErrorKind::BitRecessive)));
    assert_eq!(end, 23 + 12 + 8, "flag and echo, delimiter");
    assert_eq!(bench.port(0).error_counters().tec(), 8);
    assert_eq!(bench.port(2).error_counters().rec(), 1);
    // Neither node gives way: both go on until they are error passive, then bus-off.
    bench.run(20_000);
    assert_eq!(bench.received(2), []);
    assert_eq!(bench.port(0).error_counters().state(), ErrorState::BusOff);
    // ... and come back after 128 x 11 recessive bits, at the same time, to do it again.
    bench.run(21_000);
    let bad = bench.log().iter().filter(|(.., outcome)| matches!(outcome, Outcome::Bad(_))).count();
    assert!(bad > 32, "{bad}");
}

#[test]
fn one_shot_without_acknowledge() {
    let mut bench = Bench::new(vec![controller(0, 0x10)]); // NART
    bench.run(20);
    bench.write(0, 0x184, 0);
    bench.write(0, 0x180, 0x080 << 21 | 1);
    bench.run(500);
    assert_eq!(bench.log(), [(20, 74, 0x080, Outcome::Bad(ErrorKind::Acknowledge))]);
    assert_eq!(bench.read(0, 0x08), 0x1C00_0009, "RQCP0, TERR0, empty");
    assert_eq!(bench.read(0, 0x18), 8 << 16 | 3 << 4);
}

#[test]
fn a_controller_joins_after_eleven_recessive_bits() {
    let mut bench = Bench::new(vec![controller(0, 0), port()]);
    bench.run(10);
    assert_eq!(bench.read(0, 0x04) & 1, 1, "INAK");
    bench.run(11);
    assert_eq!(bench.read(0, 0x04) & 1, 0);
    // Out, and back in the middle of a frame: it waits for the end of it, and 11 recessive bits are
    // what lies between the ACK slot and the end of the intermission.
    bench.write(0, 0x00, 0x1_0001);
    bench.run(20);
    assert_eq!(bench.read(0, 0x04) & 1, 1);
    bench.nodes.push(port());
    bench.send(1, 30, boot_up());
    bench.send(1, 30, sync());
    bench.run(40);
    bench.write(0, 0x00, 0x1_0000);
    bench.run(30 + 56 + 2);
    assert_eq!(bench.read(0, 0x04) & 1, 1);
    bench.run(30 + 56 + 3);
    assert_eq!(bench.read(0, 0x04) & 1, 0);
    bench.run(500);
    assert_eq!(bench.read(0, 0x0C) & 3, 1, "it has the second frame and not the first");
    assert_eq!(bench.read(0, 0x1B0), 0x080 << 21);
    let readers: Vec<_> = bench.log.borrow().iter().map(|record| record.readers).collect();
    assert_eq!(readers, [0b100, 0b101], "and so says the record");
}

#[test]
fn a_controller_leaves_when_its_frame_is_over() {
    let mut bench = Bench::new(vec![controller(0, 0), port()]);
    bench.run(20);
    bench.write(0, 0x180, 0x080 << 21 | 1);
    bench.run(30);
    bench.write(0, 0x00, 0x1_0001);
    bench.run(67);
    assert_eq!(bench.read(0, 0x04) & 1, 0);
    bench.run(68);
    assert_eq!(bench.read(0, 0x04) & 1, 1, "INAK behind the last bit");
    assert_eq!(bench.read(0, 0x08) & 3, 3, "and the frame is out");
    assert_eq!(bench.received(1).len(), 1);
}

#[test]
fn overrun_on_the_bus() {
    for (rflm, kept) in [(0, [0x101, 0x102, 0x105]), (8, [0x101, 0x102, 0x103])] {
        let mut bench = Bench::new(vec![controller(0, rflm), port()]);
        bench.run(20);
        (0x101..=0x105).for_each(|id| bench.send(1, 20, Frame::standard(id, &[]).unwrap()));
        bench.run(1000);
        assert_eq!(bench.read(0, 0x0C), 3 | 8 | 16);
        for id in kept {
            assert_eq!(bench.read(0, 0x1B0) >> 21, id);
            bench.write(0, 0x0C, 0x20);
        }
    }
}

#[test]
fn wrong_bit_rate_disturbs_until_it_is_error_passive() {
    // Two nodes at 500 kbit/s, one listener at 1 Mbit/s.
    let mut bench = Bench::ports(&[500_000, 500_000, 1_000_000]);
    bench.send(0, 0, sync());
    bench.run(50);
    // 080h begins 0 000 1 0000 0 1 ...: the fast node samples each bit twice, in the middle of its
    // own. The sixth equal sample in a row is in the third bit: bit 2 of the slow ones, at (5 +
    // 7/8) us. Flag and echo 12 x 2 us, delimiter 8 x 2 us.
    let first = bench.log.borrow()[0];
    assert_eq!(first.outcome, Outcome::Bad(ErrorKind::BitRecessive));
    assert_eq!(first.end, Time(5_875_000 + 40 * US));
    assert_eq!(bench.port(0).error_counters().tec(), 8);
    assert_eq!(bench.port(1).error_counters().rec(), 1);
    assert_eq!(bench.port(2).error_counters().rec(), 9, "it saw it first");
    bench.run(5_000);
    // 15 errors of 9 make it error passive (135); the transmitter is at 120 then, and its next
    // attempt gets through.
    let log = bench.log();
    assert_eq!(log.len(), 16);
    assert_eq!(log[15].3, Outcome::Good);
    assert_eq!(bench.received(1).len(), 1);
    assert_eq!(bench.received(2), []);
    assert_eq!(bench.port(0).error_counters().tec(), 119);
    assert_eq!(bench.port(2).error_counters().state(), ErrorState::Passive);
}

#[test]
fn a_sender_at_the_wrong_bit_rate_gets_nothing_through() {
    let mut bench = Bench::ports(&[250_000, 500_000, 500_000]);
    bench.send(0, 0, boot_up());
    bench.run(50_000);
    // 15 errors of 9 make both receivers error passive (135).
    let kinds: Vec<_> = bench.log().iter().map(|(.., outcome)| *outcome).collect();
    assert_eq!(kinds[..15], [Outcome::Bad(ErrorKind::BitRecessive); 15]);
    assert!(kinds[15..].iter().all(|kind| *kind == Outcome::Bad(ErrorKind::Acknowledge)));
    assert!(bench.port(1).error_counters().rec() > 127 && bench.port(2).error_counters().rec() > 127);
    assert_eq!(bench.port(0).error_counters().tec(), 128, "then it misses the acknowledge only");
    assert_eq!(bench.received(1), []);
    // Two at different rates that start together destroy each other's frames.
    let mut bench = Bench::ports(&[250_000, 500_000, 500_000]);
    bench.send(0, 0, boot_up());
    bench.send(1, 0, sync());
    bench.run(140);
    assert!(matches!(bench.log()[0].3, Outcome::Bad(_)));
    assert_eq!(bench.port(0).error_counters().tec(), 8);
    assert_eq!(bench.port(1).error_counters().tec(), 8);
}

#[test]
fn nearly_the_same_bit_rate_is_the_same() {
    let mut bench = Bench::ports(&[500_000, 502_000, 510_000]);
    bench.port(2).set_silent(true);
    bench.send(0, 0, sync());
    bench.run(1_000);
    assert_eq!(bench.received(1).len(), 1);
    assert_eq!(bench.received(2), [], "2 % off");
}

/// ISO 11898-1, by hand. 14 quanta, segment 2 of two: with a jump width of one, 1/140 = 0.71 % between the two
/// clocks; with two, 2/140 = 1.43 % and 2/(13 × 14 - 2) = 1.11 %, of which the smaller counts.
#[test]
fn what_a_controller_tolerates_follows_from_its_bit_timing() {
    for (jump, rate, hears) in [
        (1, 1_000_000, true),
        (1, 1_007_000, true),
        (1, 1_007_500, false),
        (1, 992_500, false),
        (2, 1_007_500, true),
        (2, 1_011_000, true),
        (2, 1_011_500, false),
        (2, 989_200, true),
        (2, 988_500, false),
    ] {
        let port = || Node::Port(HostPort::new(rate));
        let mut bench = Bench::new(vec![controller((jump - 1) << 24, 0), port(), port()]);
        bench.run(50);
        bench.send(1, 60, boot_up());
        bench.run(200);
        let first = bench.log()[0].3;
        assert_eq!(first == Outcome::Good, hears, "jump width {jump}, {rate} bit/s: {first:?}");
    }
}

#[test]
fn a_silent_node_neither_acknowledges_nor_disturbs() {
    let mut bench = Bench::new(vec![controller(1 << 31, 0), port()]);
    bench.run(20);
    bench.send(1, 20, sync());
    bench.run(2_000);
    assert!(bench.log().iter().all(|(.., outcome)| *outcome == Outcome::Bad(ErrorKind::Acknowledge)));
    // The sender's passive error flag looks like the end of a good frame.
    assert!(bench.read(0, 0x0C) & 3 > 0);
    assert_eq!(bench.read(0, 0x1B0), 0x080 << 21);
    // It cannot send.
    bench.write(0, 0x180, 0x123 << 21 | 1);
    bench.run(4_000);
    assert_eq!(bench.read(0, 0x08) & 0xFF, 0);
    assert_eq!(bench.received(1), []);
}

#[test]
fn loop_back_receives_its_own_and_needs_no_acknowledge() {
    for (btr, on_the_wire) in [(1 << 30, 1), (3 << 30, 0)] {
        let mut bench = Bench::new(vec![controller(btr, 0), port()]);
        bench.run(20);
        bench.write(0, 0x180, 0x123 << 21 | 1);
        bench.run(500);
        assert_eq!(bench.read(0, 0x08) & 0xFF, 3, "RQCP0, TXOK0");
        assert_eq!(bench.read(0, 0x1B0), 0x123 << 21);
        assert_eq!(bench.received(1).len(), on_the_wire);
        bench.write(0, 0x0C, 0x20);
        bench.send(1, 500, sync());
        bench.run(600);
        assert_eq!(bench.read(0, 0x0C) & 3, 0, "it does not hear the others");
    }
}

#[test]
fn bus_off_ends_after_128_times_11_recessive_bits() {
    let mut bench = Bench::new(vec![controller(0, 0x40), port()]); // ABOM
    bench.run(20);
    let disturb = Fault {
        frames: FrameMatch { from: Some(0), ..FrameMatch::default() },
        when: When::Always,
        action: FaultAction::Disturb,
    };
    bench.bus.inject(disturb);
    bench.write(0, 0x180, 0x080 << 21 | 1);
    bench.run(3_000);
    assert_eq!(bench.read(0, 0x18) & 7, 7);
    assert_eq!(bench.log().len(), 32, "256 / 8");
    // The receivers see a CRC error: the flag begins after the ACK delimiter, 7 + 8 bits.
    assert_eq!(bench.log()[0], (20, 20 + 41 + 15, 0x080, Outcome::Bad(ErrorKind::BitRecessive)));
    let recessive = bench.bus.recessive_since.0 / US;
    assert_eq!(recessive, bench.log()[31].1 - 8);
    // The bits count from where the node went bus-off: the end of the last error delimiter.
    let since = bench.log()[31].1;
    bench.bus.clear_faults();
    bench.run(since + 1407);
    assert_eq!(bench.read(0, 0x18) & 7, 7);
    bench.run(since + 1408);
    assert_eq!(bench.read(0, 0x18) & 0xFFFF_0007, 0);
    bench.run(since + 2000);
    assert_eq!(bench.read(0, 0x08) & 0xFF, 3, "the frame was only waiting");
}

#[test]
fn bus_off_recovery_counts_between_frames() {
    let mut bench = Bench::new(vec![controller(0, 0x40), port(), port()]);
    bench.run(20);
    let now = bench.bus.now();
    for _ in 0..32 {
        bench.can(0).event(BusEvent::TransmitFailed { kind: ErrorKind::BitDominant, exempt: false }, now);
    }
    // 200 frames back to back: each leaves one sequence of 11 recessive bits after it.
    (0..200).for_each(|_| bench.send(1, 20, sync()));
    bench.run(20 + 127 * 51);
    assert_eq!(bench.read(0, 0x18) & 4, 4);
    bench.run(20 + 128 * 51);
    assert_eq!(bench.read(0, 0x18) & 4, 0);
}

#[test]
fn injected_faults() {
    let faulty = |action| {
        let mut bench = Bench::ports(&[1_000_000; 3]);
        let frames = FrameMatch::id(boot_up().id());
        bench.bus.inject(Fault { frames, when: When::Nth(2), action });
        for n in 0..3 {
            bench.send(0, 100 * n, boot_up());
        }
        bench.run(5_000);
        assert_eq!(bench.port(0).waiting(), 0, "the sender is content");
        bench
    };
    let mut bench = faulty(FaultAction::Drop);
    assert_eq!(bench.received(1), [(55, "701#00".into()), (255, "701#00".into())]);
    assert_eq!(bench.log()[1], (100, 156, 0x701, Outcome::KeptBack));

    let mut bench = faulty(FaultAction::Alter { byte: 0, mask: 0x81 });
    assert_eq!(bench.received(2)[1], (155, "701#81".into()));

    let mut bench = faulty(FaultAction::Delay(Span::from_micros(1_000)));
    // Kept back until 1156, then on the wire again.
    assert_eq!(bench.received(2).iter().map(|(at, _)| *at).collect::<Vec<_>>(), [55, 255, 1156 + 55]);
    assert_eq!(bench.received(0), [], "the sender does not get its own frame back");

    let mut bench = faulty(FaultAction::Duplicate);
    let times = bench.received(2).iter().map(|(at, _)| *at).collect::<Vec<_>>();
    // Repeated after the intermission: 159 to 215; the third one, requested at 200, waits until
    // 218.
    assert_eq!(times, [55, 155, 159 + 55, 218 + 55]);
    assert_eq!(bench.log.borrow()[2].from, None);

    let mut bench = faulty(FaultAction::Disturb);
    // 56 bits: the ACK delimiter is bit 48, the flag begins after it; 7 + 8 + 3 bits later it is
    // repeated.
    assert_eq!(bench.log()[1], (100, 100 + 49 + 15, 0x701, Outcome::Bad(ErrorKind::BitRecessive)));
    assert_eq!(bench.log()[2].0, 100 + 49 + 18);
    assert_eq!(bench.received(2).len(), 3);
    assert_eq!(bench.port(0).error_counters().tec(), 8 - 2);
    assert_eq!(bench.port(1).error_counters().rec(), 0, "1 for the error, down again with the next frame");
}

#[test]
fn who_vanishes_leaves_a_bad_frame() {
    // The sender loses its power in the middle of its frame.
    let mut bench = Bench::new(vec![controller(0, 0), port()]);
    bench.run(20);
    bench.write(0, 0x180, 0x080 << 21 | 1);
    bench.run(40);
    bench.can(0).reset();
    bench.run(200);
    assert!(matches!(bench.log()[0].3, Outcome::Bad(_)));
    assert_eq!(bench.received(1), []);
    assert_eq!(bench.port(1).error_counters().rec(), 1);
    // The only receiver is unplugged: no acknowledge.
    let mut bench = Bench::ports(&[1_000_000; 2]);
    bench.send(0, 0, sync());
    bench.run(20);
    bench.nodes[1] = Node::Nothing(Unplugged);
    bench.run(100);
    assert_eq!(bench.log()[0].3, Outcome::Bad(ErrorKind::Acknowledge));
    assert_eq!(bench.port(0).error_counters().tec(), 8);
}

#[test]
fn steps_do_not_matter() {
    // The same traffic in one go and in steps of 1 us gives the same trace.
    let run = |step: u64| {
        let mut bench =
            Bench::new(vec![controller(0, 0x40), port(), Node::Port(HostPort::new(500_000)), port()]);
        let when = When::OneIn { frames: 3, seed: 5 };
        bench.bus.inject(Fault { frames: FrameMatch::default(), when, action: FaultAction::Disturb });
        for n in 0..60 {
            bench.send(1, 13 * n, Frame::standard(0x100 + n as u16, &[n as u8; 8]).unwrap());
            bench.send(3, 17 * n, Frame::extended(0x1000 * n as u32, &[]).unwrap());
        }
        bench.send(2, 4_000, sync());
        bench.write(0, 0x180, 0x3FF << 21 | 1);
        let mut at = 0;
        while at < 30_000 {
            at += step;
            bench.run(at);
        }
        let log = bench.log.borrow().clone();
        log
    };
    let once = run(30_000);
    assert!(once.len() > 120, "{}", once.len());
    assert_eq!(once, run(1));
    assert_eq!(once, run(777).into_iter().filter(|record| record.end.0 <= 30_000 * US).collect::<Vec<_>>());
}

// --- pins
// ------------------------------------------------------------------------------------------------

fn with_pins(btr: u32, pins: Pins) -> Node {
    let mut node = controller(btr, 0x10);
    if let Node::Can(can) = &mut node {
        can.connect(pins, Time(0));
    }
    node
}

fn request(bench: &mut Bench, n: usize) {
    let now = bench.bus.now();
    // What is reported is tested beside the controller.
    let _ = bench.can(n).write(0x180, 0x080 << 21 | 1, now);
}

fn bench_with(node: Node) -> Bench {
    let mut bench = Bench::new(vec![node, port(), port()]);
    bench.run(100);
    bench
}

/// Without NART: 32 bit errors count 8 each up to 256, bus-off (RM0090 section 32.7.6). Nobody sees them.
#[test]
fn who_has_no_pin_for_tx_is_not_heard_and_goes_bus_off() {
    for rx in [true, false] {
        let mut bench = bench_with(controller(0, 0));
        bench.can(0).connect(Pins { rx, tx: false }, Time(100 * US));
        request(&mut bench, 0);
        bench.run(5_000);
        assert_eq!(bench.log(), []);
        assert_eq!(bench.read(0, 0x18) & 0x7, 0x7, "rx {rx}: BOFF");
        // It acknowledges nothing, either.
        bench.send(1, 6_000, boot_up());
        bench.run(7_000);
        assert!(bench.received(2) == [(6_055, "701#00".into())], "node 2 acknowledges");
    }
    let mut bench = Bench::new(vec![controller(0, 0), port()]);
    bench.run(100);
    bench.can(0).connect(Pins { rx: true, tx: false }, Time(100 * US));
    bench.send(1, 200, boot_up());
    bench.run(300);
    assert_eq!(bench.log()[0].3, Outcome::Bad(ErrorKind::Acknowledge));
}

#[test]
fn who_has_no_pin_for_rx_hears_nothing_and_destroys_the_frames_of_others_until_bus_off() {
    let mut bench = bench_with(with_pins(0, Pins { rx: false, tx: true }));
    bench.send(1, 200, boot_up());
    bench.run(300);
    assert_eq!(bench.read(0, 0x0C) & 3, 0, "nothing received");
    assert_eq!(bench.log()[0].3, Outcome::Good);
    // One attempt: the first bit and the flag are a stuff error to the others.
    request(&mut bench, 0);
    bench.run(400);
    assert_eq!(bench.log()[1].3, Outcome::Bad(ErrorKind::BitDominant));
    assert_eq!(bench.read(0, 0x18) >> 16 & 0xFF, 8);
    assert!(bench.port(2).error_counters().rec() > 0);
}

/// RM0090 section 32.4.2: it waits for 11 recessive bits. One that hears nothing has them at once; so has one
/// in loop-back mode (section 32.5.2), on a bus on which others speak.
#[test]
fn who_hears_nothing_is_synchronised_on_a_busy_bus() {
    for (btr, pins, hears) in [
        (0, Pins::BOTH, true),
        (0, Pins { rx: false, tx: true }, false),
        (0x4000_0000, Pins::BOTH, false),
        (0x4000_0000, Pins::NONE, false),
    ] {
        let mut bench = Bench::new(vec![with_pins(btr, pins), port(), port()]);
        bench.send(1, 0, boot_up());
        bench.run(20);
        assert_eq!(bench.read(0, 0x04) & 1, u32::from(hears), "{btr:08X} {pins:?}: INAK");
        bench.run(100);
        assert_eq!(bench.read(0, 0x04) & 1, 0);
    }
}

/// Loop-back without silent mode sends onto the bus; without a pin it is heard by itself alone.
#[test]
fn in_loop_back_mode_without_a_pin_it_plays_with_itself() {
    let mut bench = bench_with(with_pins(0x4000_0000, Pins::NONE));
    request(&mut bench, 0);
    bench.run(200);
    assert_eq!(bench.log(), []);
    assert_eq!(bench.read(0, 0x08) & 3, 3, "RQCP and TXOK");
    assert_eq!(bench.read(0, 0x0C) & 3, 1);
}

/// ISO 11898-1:2015, 12.1.4, for receivers: 1 for the stuff error and 8 for the first dominant bit
/// after the flag (rules a and b), then 8 with the 14th dominant bit from the beginning of the flag and
/// with each 8 more (rule f). The flag begins after 6 equal bits. So 129 are reached at bit 6 + 14 + 14 x
/// 8 = 132; a receiver never goes bus-off.
#[test]
fn on_a_line_that_stays_dominant_a_receiver_ends_error_passive() {
    const EPVF_BOFF: u32 = 0b110;
    let mut bench = Bench::new(vec![controller(0, 0), port()]);
    bench.run(1_000);
    bench.hold_dominant(true);
    bench.run(1_131);
    assert_eq!((bench.read(0, 0x18) >> 24, bench.read(0, 0x18) & EPVF_BOFF), (121, 0));
    bench.run(1_132);
    assert_eq!((bench.read(0, 0x18) >> 24, bench.read(0, 0x18) & EPVF_BOFF), (129, 0b010));
    bench.send(1, 1_200, sync());
    bench.run(600_000_000);
    assert_eq!((bench.read(0, 0x18) >> 24, bench.read(0, 0x18) & EPVF_BOFF), (255, 0b010));
    assert_eq!(bench.log(), []);
    // Eight bits of the error delimiter and three of intermission; the frame has 48.
    bench.hold_dominant(false);
    bench.run(600_000_059);
    assert_eq!(bench.log(), [(600_000_011, 600_000_059, 0x080, Outcome::Good)]);
    assert_eq!(bench.read(0, 0x18) >> 24, 120, "RM0090, CAN_ESR");
}

/// The bit error counts 8, and each 8 bits of rule f: 32 x 8 = 256 at bit 1 + 14 + 30 x 8 = 255. Bus-off
/// lasts until the line is free, and 128 x 11 bits longer.
#[test]
fn a_line_that_falls_in_the_middle_of_a_frame_takes_its_transmitter_to_bus_off() {
    let mut bench = Bench::ports(&[1_000_000, 1_000_000]);
    bench.send(0, 0, boot_up());
    bench.run(40);
    bench.hold_dominant(true);
    bench.run(40 + 254);
    assert_eq!(bench.port(0).error_counters().tec(), 248);
    bench.run(40 + 255);
    assert_eq!(bench.port(0).error_counters().state(), ErrorState::BusOff);
    assert_eq!(bench.port(1).error_counters().state(), ErrorState::Passive);
    bench.run(60_000_000);
    assert_eq!(bench.log(), [(0, 40, 0x701, Outcome::Bad(ErrorKind::BitRecessive))]);
    bench.hold_dominant(false);
    bench.run(60_000_000 + 128 * 11 - 1);
    assert_eq!(bench.port(0).error_counters().state(), ErrorState::BusOff);
    bench.run(60_010_000);
    assert_eq!(bench.log()[1], (60_001_408, 60_001_464, 0x701, Outcome::Good));
}

/// RM0090 sections 32.4.1 and 32.4.2: initialisation is entered when the activity on the bus is over, and
/// left after 11 recessive bits. MCR.RESET does not wait.
#[test]
fn a_line_that_stays_dominant_lets_nobody_in_and_nobody_out() {
    let mut bench = Bench::new(vec![controller(0, 0), controller(0, 0)]);
    bench.run(5);
    bench.write(1, 0x00, 0x1_0001);
    bench.run(20);
    bench.hold_dominant(true);
    bench.write(0, 0x00, 0x1_0001);
    bench.write(1, 0x00, 0x1_0000);
    bench.run(120_000_000);
    assert_eq!(bench.read(0, 0x04) & 1, 0, "INAK does not come");
    assert_eq!(bench.read(1, 0x04) & 1, 1, "INAK does not go");
    bench.hold_dominant(false);
    bench.run(120_000_010);
    assert_eq!(bench.read(1, 0x04) & 1, 1);
    bench.run(120_000_011);
    assert_eq!((bench.read(0, 0x04) & 1, bench.read(1, 0x04) & 1), (1, 0));
    bench.hold_dominant(true);
    bench.write(1, 0x00, 0x8000);
    assert_eq!(bench.read(1, 0x04) & 3, 2, "SLAK");
}

/// ISO 11898-1:2015, 12.1.4, rule c, exception 1: without an acknowledge the counter of a transmitter
/// ends at 128. A controller repeats the frame for ever (RM0090 section 32.7.1): 48 bits less ACK
/// delimiter and end of frame (8), 6 of error flag, 8 of delimiter, and 3, which are 57. Error
/// passive after the 16th: 8 bits more.
#[test]
fn a_controller_that_nobody_acknowledges_ends_error_passive_and_repeats() {
    let mut bench = Bench::new(vec![controller(0, 0)]);
    bench.run(20);
    bench.write(0, 0x184, 0);
    bench.write(0, 0x180, 0x080 << 21 | 1);
    bench.run(60_000_000);
    // TEC 128, LEC 3 (no acknowledge), EPVF and EWGF, no BOFF.
    assert_eq!(bench.read(0, 0x18), 128 << 16 | 3 << 4 | 0b011);
    assert_eq!(bench.read(0, 0x180), 0x080 << 21 | 1, "TXRQ");
    let log = bench.log();
    assert!(log.iter().all(|(.., outcome)| *outcome == Outcome::Bad(ErrorKind::Acknowledge)));
    let bits: Vec<u64> = log.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
    assert!(bits[..15].iter().all(|bits| *bits == 57) && bits[15..].iter().all(|bits| *bits == 65));
    bench.nodes.push(port());
    bench.run(60_001_000);
    assert_eq!(bench.read(0, 0x18) >> 16, 127);
    assert_eq!(bench.received(1).len(), 1);
}
