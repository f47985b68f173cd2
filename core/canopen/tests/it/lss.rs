//! The LSS slave against frames written by hand from CiA 305.

use core::task::Poll;

use canopen::lss::{BitRate, Config, Lss, LssAddress, LssDevice, Output, StoreError};
use canopen::{CobId, Frame, NodeId};
use embedded_can::{ExtendedId, Frame as _, StandardId};
use kit::bus::at;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

const ADDRESS: LssAddress = LssAddress {
    vendor_id: 0x0000_0123,
    product_code: 0x1122_3344,
    revision: 0x0001_0002,
    serial_number: 0xDEAD_BEEF,
};

#[derive(Default)]
struct Device {
    stored: Vec<(Option<NodeId>, Option<BitRate>)>,
    fails: Option<StoreError>,
}

impl LssDevice for Device {
    fn supports(&mut self, rate: BitRate) -> bool {
        rate != BitRate::K800
    }

    fn store(&mut self, node: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        self.stored.push((node, rate));
        Poll::Ready(self.fails.map_or(Ok(()), Err))
    }
}

struct Bench {
    lss: Lss,
    device: Device,
    now: u32,
}

fn request(bytes: [u8; 8]) -> Frame {
    Frame::of(CobId::new(0x7E5).unwrap(), &bytes)
}

fn response(bytes: [u8; 8]) -> Output {
    Output::Send(Frame::of(CobId::new(0x7E4).unwrap(), &bytes))
}

impl Bench {
    fn new(node: u8) -> Self {
        let lss = Lss::new(ADDRESS, NodeId::new(node), Config::default());
        Self { lss, device: Device::default(), now: 0 }
    }

    fn in_configuration(node: u8) -> Self {
        let mut bench = Self::new(node);
        bench.silent(&[[0x04, 1, 0, 0, 0, 0, 0, 0]]);
        bench
    }

    fn outputs(&mut self) -> Vec<Output> {
        core::iter::from_fn(|| self.lss.poll(at(self.now))).collect()
    }

    fn ask(&mut self, bytes: [u8; 8]) -> Vec<Output> {
        self.lss.handle(&request(bytes), at(self.now), &mut self.device);
        self.outputs()
    }

    #[track_caller]
    fn expect(&mut self, dialogue: &[([u8; 8], [u8; 8])]) {
        for (asked, answered) in dialogue {
            assert_eq!(self.ask(*asked), [response(*answered)], "answer to {asked:02X?}");
        }
    }

    #[track_caller]
    fn silent(&mut self, requests: &[[u8; 8]]) {
        for bytes in requests {
            assert_eq!(self.ask(*bytes), [], "answer to {bytes:02X?}");
        }
    }

    /// Whether it is in configuration state, where it answers an inquiry.
    fn is_in_configuration(&mut self) -> bool {
        !self.ask([0x5E, 0, 0, 0, 0, 0, 0, 0]).is_empty()
    }
}

#[test]
fn switches_state_global() {
    let mut bench = Bench::new(5);
    assert!(!bench.is_in_configuration());
    bench.silent(&[[0x04, 1, 0, 0, 0, 0, 0, 0]]);
    assert!(bench.is_in_configuration());
    bench.silent(&[[0x04, 2, 0, 0, 0, 0, 0, 0]]);
    assert!(bench.is_in_configuration());
    bench.silent(&[[0x04, 0, 0, 0, 0, 0, 0, 0]]);
    assert!(!bench.is_in_configuration());
}

const SELECT: [[u8; 8]; 4] = [
    [0x40, 0x23, 0x01, 0x00, 0x00, 0, 0, 0],
    [0x41, 0x44, 0x33, 0x22, 0x11, 0, 0, 0],
    [0x42, 0x02, 0x00, 0x01, 0x00, 0, 0, 0],
    [0x43, 0xEF, 0xBE, 0xAD, 0xDE, 0, 0, 0],
];

#[test]
fn switches_state_selective() {
    let mut bench = Bench::new(5);
    bench.silent(&SELECT[..3]);
    bench.expect(&[(SELECT[3], [0x44, 0, 0, 0, 0, 0, 0, 0])]);
    assert!(bench.is_in_configuration());
    // In this state it is not selected again.
    bench.silent(&SELECT);

    // One number wrong, one left out, the order wrong.
    for wrong in 0..4 {
        let mut bench = Bench::new(5);
        let mut requests = SELECT;
        requests[wrong][1] ^= 1;
        bench.silent(&requests);
        assert!(!bench.is_in_configuration(), "{wrong}");
        let mut requests = SELECT.to_vec();
        requests.remove(wrong);
        bench.silent(&requests);
        assert!(!bench.is_in_configuration(), "{wrong}");
        let mut bench = Bench::new(5);
        let mut requests = SELECT;
        requests.swap(wrong, (wrong + 1) % 4);
        bench.silent(&requests);
        assert!(!bench.is_in_configuration(), "{wrong}");
        // This leaves no state behind.
        bench.silent(&SELECT[..3]);
        bench.expect(&[(SELECT[3], [0x44, 0, 0, 0, 0, 0, 0, 0])]);
    }
}

#[test]
fn inquires_identity_and_node_id() {
    let mut bench = Bench::in_configuration(5);
    bench.expect(&[
        ([0x5A, 0, 0, 0, 0, 0, 0, 0], [0x5A, 0x23, 0x01, 0x00, 0x00, 0, 0, 0]),
        ([0x5B, 0, 0, 0, 0, 0, 0, 0], [0x5B, 0x44, 0x33, 0x22, 0x11, 0, 0, 0]),
        ([0x5C, 0, 0, 0, 0, 0, 0, 0], [0x5C, 0x02, 0x00, 0x01, 0x00, 0, 0, 0]),
        ([0x5D, 0, 0, 0, 0, 0, 0, 0], [0x5D, 0xEF, 0xBE, 0xAD, 0xDE, 0, 0, 0]),
        ([0x5E, 0, 0, 0, 0, 0, 0, 0], [0x5E, 5, 0, 0, 0, 0, 0, 0]),
    ]);
    let mut bench = Bench::in_configuration(0xFF);
    bench.expect(&[([0x5E, 0, 0, 0, 0, 0, 0, 0], [0x5E, 0xFF, 0, 0, 0, 0, 0, 0])]);
}

#[test]
fn a_device_without_node_id_takes_one_and_starts() {
    let mut bench = Bench::in_configuration(0xFF);
    bench.expect(&[([0x11, 42, 0, 0, 0, 0, 0, 0], [0x11, 0, 0, 0, 0, 0, 0, 0])]);
    assert_eq!(bench.lss.node_id(), None);
    assert_eq!(bench.ask([0x04, 0, 0, 0, 0, 0, 0, 0]), [Output::NodeId(NodeId::new(42).unwrap())]);
    assert_eq!(bench.lss.node_id(), NodeId::new(42));
    // Only once.
    bench.silent(&[[0x04, 1, 0, 0, 0, 0, 0, 0], [0x04, 0, 0, 0, 0, 0, 0, 0]]);
}

/// A reset that comes before the start was reported: the node must not start with the earlier node-ID
/// after it.
#[test]
fn a_reset_communication_takes_the_place_of_a_start_that_was_not_reported() {
    let mut bench = Bench::in_configuration(0xFF);
    bench.expect(&[([0x11, 42, 0, 0, 0, 0, 0, 0], [0x11, 0, 0, 0, 0, 0, 0, 0])]);
    for unreported in [[0x04, 0], [0x04, 1], [0x11, 43]].map(|[a, b]| [a, b, 0, 0, 0, 0, 0, 0]) {
        bench.lss.handle(&request(unreported), at(0), &mut bench.device);
    }
    assert_eq!(bench.lss.reset_communication(), NodeId::new(43));
    assert_eq!(bench.outputs(), [response([0x11, 0, 0, 0, 0, 0, 0, 0])]);
}

#[test]
fn a_device_with_node_id_takes_a_new_one_at_reset_communication() {
    let mut bench = Bench::in_configuration(5);
    bench.expect(&[
        ([0x11, 42, 0, 0, 0, 0, 0, 0], [0x11, 0, 0, 0, 0, 0, 0, 0]),
        // An invalid node-ID is refused and changes nothing.
        ([0x11, 0, 0, 0, 0, 0, 0, 0], [0x11, 1, 0, 0, 0, 0, 0, 0]),
        ([0x11, 128, 0, 0, 0, 0, 0, 0], [0x11, 1, 0, 0, 0, 0, 0, 0]),
        ([0x11, 0xFE, 0, 0, 0, 0, 0, 0], [0x11, 1, 0, 0, 0, 0, 0, 0]),
        // The active node-ID is reported.
        ([0x5E, 0, 0, 0, 0, 0, 0, 0], [0x5E, 5, 0, 0, 0, 0, 0, 0]),
    ]);
    bench.silent(&[[0x04, 0, 0, 0, 0, 0, 0, 0]]);
    assert_eq!(bench.lss.node_id(), NodeId::new(5));
    assert_eq!(bench.lss.reset_communication(), NodeId::new(42));
    assert_eq!(bench.lss.node_id(), NodeId::new(42));
    // FFh removes the node-ID.
    bench.silent(&[[0x04, 1, 0, 0, 0, 0, 0, 0]]);
    bench.expect(&[([0x11, 0xFF, 0, 0, 0, 0, 0, 0], [0x11, 0, 0, 0, 0, 0, 0, 0])]);
    assert_eq!(bench.lss.reset_communication(), None);
}

#[test]
fn configures_bit_timing() {
    // Table 0 of CiA 305, and the rates that this device supports (all but 800 kbit/s).
    let table = [
        (0, Some(1_000_000)),
        (1, Some(800_000)),
        (2, Some(500_000)),
        (3, Some(250_000)),
        (4, Some(125_000)),
        (5, Some(100_000)),
        (6, Some(50_000)),
        (7, Some(20_000)),
        (8, Some(10_000)),
        (9, None),
    ];
    let mut bench = Bench::in_configuration(5);
    for (index, rate) in table {
        let known = BitRate::from_index(index).unwrap();
        assert_eq!((known as u8, known.bits_per_second()), (index, rate));
        let error = u8::from(index == 1);
        bench.expect(&[([0x13, 0, index, 0, 0, 0, 0, 0], [0x13, error, 0, 0, 0, 0, 0, 0])]);
    }
    bench.expect(&[
        ([0x13, 0, 10, 0, 0, 0, 0, 0], [0x13, 1, 0, 0, 0, 0, 0, 0]),
        ([0x13, 1, 2, 0, 0, 0, 0, 0], [0x13, 1, 0, 0, 0, 0, 0, 0]),
        ([0x13, 0, 2, 0, 0, 0, 0, 0], [0x13, 0, 0, 0, 0, 0, 0, 0]),
        // A refusal does not remove the configured values.
        ([0x13, 0, 1, 0, 0, 0, 0, 0], [0x13, 1, 0, 0, 0, 0, 0, 0]),
        ([0x17, 0, 0, 0, 0, 0, 0, 0], [0x17, 0, 0, 0, 0, 0, 0, 0]),
    ]);
    assert_eq!(bench.device.stored, [(NodeId::new(5), Some(BitRate::K500))]);
}

#[test]
fn activates_bit_timing_after_one_delay_and_speaks_after_two() {
    let mut bench = Bench::in_configuration(5);
    // Without a configured rate there is nothing to activate.
    bench.silent(&[[0x15, 100, 0, 0, 0, 0, 0, 0]]);
    assert!(!bench.lss.is_silent(at(0)));
    bench.expect(&[([0x13, 0, 3, 0, 0, 0, 0, 0], [0x13, 0, 0, 0, 0, 0, 0, 0])]);
    // 300 ms = 012Ch.
    bench.silent(&[[0x15, 0x2C, 0x01, 0, 0, 0, 0, 0]]);
    bench.now = 299;
    assert_eq!(bench.outputs(), []);
    assert!(bench.lss.is_silent(at(299)));
    bench.now = 305;
    assert_eq!(bench.outputs(), [Output::BitRate(BitRate::K250)]);
    // In between it neither receives nor sends.
    bench.silent(&[[0x5E, 0, 0, 0, 0, 0, 0, 0]]);
    assert!(bench.lss.is_silent(at(599)));
    bench.now = 600;
    assert!(!bench.lss.is_silent(at(600)));
    assert_eq!(bench.outputs(), []);
    bench.expect(&[([0x5E, 0, 0, 0, 0, 0, 0, 0], [0x5E, 5, 0, 0, 0, 0, 0, 0])]);
    // An answer that was not fetched before waits, too.
    for bytes in [[0x5E, 0, 0, 0, 0, 0, 0, 0], [0x15, 10, 0, 0, 0, 0, 0, 0]] {
        bench.lss.handle(&request(bytes), at(600), &mut bench.device);
    }
    assert_eq!(bench.outputs(), []);
    bench.now = 610;
    assert_eq!(bench.outputs(), [Output::BitRate(BitRate::K250)]);
    bench.now = 620;
    assert_eq!(bench.outputs(), [response([0x5E, 5, 0, 0, 0, 0, 0, 0])]);
}

#[test]
fn stores() {
    let mut bench = Bench::in_configuration(0xFF);
    bench.expect(&[
        ([0x17, 0, 0, 0, 0, 0, 0, 0], [0x17, 0, 0, 0, 0, 0, 0, 0]),
        ([0x11, 42, 0, 0, 0, 0, 0, 0], [0x11, 0, 0, 0, 0, 0, 0, 0]),
        ([0x17, 0, 0, 0, 0, 0, 0, 0], [0x17, 0, 0, 0, 0, 0, 0, 0]),
    ]);
    assert_eq!(bench.device.stored, [(None, None), (NodeId::new(42), None)]);
    bench.device.fails = Some(StoreError::Unsupported);
    bench.expect(&[([0x17, 0, 0, 0, 0, 0, 0, 0], [0x17, 1, 0, 0, 0, 0, 0, 0])]);
    bench.device.fails = Some(StoreError::Failed);
    bench.expect(&[([0x17, 0, 0, 0, 0, 0, 0, 0], [0x17, 2, 0, 0, 0, 0, 0, 0])]);
}

#[test]
fn identifies_itself_within_bounds() {
    let range = |revision: [u8; 2], serial: [u8; 2]| {
        [
            [0x46, 0x23, 0x01, 0x00, 0x00, 0, 0, 0],
            [0x47, 0x44, 0x33, 0x22, 0x11, 0, 0, 0],
            [0x48, revision[0], 0x00, 0x01, 0x00, 0, 0, 0],
            [0x49, revision[1], 0x00, 0x01, 0x00, 0, 0, 0],
            [0x4A, serial[0], 0xBE, 0xAD, 0xDE, 0, 0, 0],
            [0x4B, serial[1], 0xBE, 0xAD, 0xDE, 0, 0, 0],
        ]
    };
    let identified = [response([0x4F, 0, 0, 0, 0, 0, 0, 0])];
    for mut bench in [Bench::new(5), Bench::in_configuration(0xFF)] {
        for (revision, serial, within) in [
            ([0x02, 0x02], [0xEF, 0xEF], true),
            ([0x00, 0xFF], [0x00, 0xFF], true),
            ([0x03, 0xFF], [0x00, 0xFF], false),
            ([0x00, 0x01], [0x00, 0xFF], false),
            ([0x00, 0xFF], [0xF0, 0xFF], false),
            ([0x00, 0xFF], [0x00, 0xEE], false),
        ] {
            let requests = range(revision, serial);
            bench.silent(&requests[..5]);
            let expected: &[Output] = if within { &identified } else { &[] };
            assert_eq!(bench.ask(requests[5]), expected, "{revision:02X?} {serial:02X?}");
        }
        // Another vendor, another product; one request left out.
        let good = range([0x02, 0x02], [0xEF, 0xEF]);
        for step in 0..2 {
            let mut wrong = good;
            wrong[step][1] ^= 1;
            bench.silent(&wrong);
        }
        for step in 0..5 {
            let mut wrong = good.to_vec();
            wrong.remove(step);
            bench.silent(&wrong);
        }
    }
}

#[test]
fn says_that_it_has_no_node_id() {
    let asked = [0x4C, 0, 0, 0, 0, 0, 0, 0];
    let mut bench = Bench::new(0xFF);
    bench.expect(&[(asked, [0x50, 0, 0, 0, 0, 0, 0, 0])]);
    Bench::new(5).silent(&[asked]);
    // With a node-ID it counts as configured.
    bench.silent(&[[0x04, 1, 0, 0, 0, 0, 0, 0]]);
    bench.expect(&[([0x11, 42, 0, 0, 0, 0, 0, 0], [0x11, 0, 0, 0, 0, 0, 0, 0])]);
    bench.silent(&[asked]);
    // Without a request, if it is configured to announce itself.
    let config = Config { announce: true, start_in_configuration: true };
    let mut bench = Bench::new(0xFF);
    bench.lss = Lss::new(ADDRESS, None, config);
    assert_eq!(bench.outputs(), [response([0x50, 0, 0, 0, 0, 0, 0, 0])]);
    assert!(bench.is_in_configuration());
    bench.lss = Lss::new(ADDRESS, NodeId::new(5), config);
    assert_eq!(bench.outputs(), []);
}

fn fastscan(number: u32, bit: u8, part: u8, next: u8) -> [u8; 8] {
    let [a, b, c, d] = number.to_le_bytes();
    [0x51, a, b, c, d, bit, part, next]
}

#[test]
fn fastscan_asks_bit_by_bit() {
    let yes = [0x4F, 0, 0, 0, 0, 0, 0, 0];
    let mut bench = Bench::new(0xFF);
    bench.expect(&[
        (fastscan(0, 0x80, 0, 0), yes),
        // The vendor-ID is 0000_0123h: bit 31 clear, all down to bit 8 as in 0000_01xxh.
        (fastscan(0, 31, 0, 0), yes),
        (fastscan(0x0000_0100, 8, 0, 0), yes),
    ]);
    bench.silent(&[fastscan(0, 8, 0, 0), fastscan(0x8000_0000, 31, 0, 0)]);
    // Another part than the current one; fields out of range.
    bench.silent(&[
        fastscan(0x1122_3344, 0, 1, 2),
        fastscan(0, 32, 0, 0),
        fastscan(0, 0x7F, 0, 0),
        fastscan(0x0000_0123, 0, 0, 4),
        fastscan(0, 31, 4, 0),
    ]);
    bench.expect(&[
        (fastscan(0x0000_0123, 0, 0, 1), yes),
        (fastscan(0x1122_3344, 0, 1, 2), yes),
        (fastscan(0x0001_0002, 0, 2, 3), yes),
    ]);
    assert!(!bench.is_in_configuration());
    // A match of all but the last bit is not enough, whatever follows.
    bench.expect(&[(fastscan(0xDEAD_BEEE, 1, 3, 2), yes), (fastscan(0x0001_0002, 0, 2, 3), yes)]);
    assert!(!bench.is_in_configuration());
    bench.expect(&[(fastscan(0xDEAD_BEEF, 0, 3, 0), yes)]);
    assert!(bench.is_in_configuration());
    bench.silent(&[fastscan(0, 0x80, 0, 0)]);
    // With a node-ID it takes no part.
    Bench::new(5).silent(&[fastscan(0, 0x80, 0, 0)]);
}

#[test]
fn what_is_not_asked_of_it_gets_silence() {
    let mut bench = Bench::new(5);
    // Requests of the configuration state, in waiting state.
    bench.silent(&[
        [0x11, 42, 0, 0, 0, 0, 0, 0],
        [0x13, 0, 2, 0, 0, 0, 0, 0],
        [0x15, 0, 0, 0, 0, 0, 0, 0],
        [0x17, 0, 0, 0, 0, 0, 0, 0],
        [0x5A, 0, 0, 0, 0, 0, 0, 0],
        [0x5E, 0, 0, 0, 0, 0, 0, 0],
    ]);
    assert!(bench.device.stored.is_empty());
    assert_eq!(bench.lss.reset_communication(), NodeId::new(5));
    // Frames other than a master's LSS requests.
    bench.silent(&[[0x04, 1, 0, 0, 0, 0, 0, 0]]);
    bench.silent(&[[0; 8], [0xFF; 8], [0x44, 0, 0, 0, 0, 0, 0, 0], [0x45, 0, 0, 0, 0, 0, 0, 0]]);
    let good = [0x5E, 0, 0, 0, 0, 0, 0, 0];
    let id = StandardId::new(0x7E5).unwrap();
    for frame in [
        Frame::new(id, &good[..7]).unwrap(),
        Frame::new(id, &[0x04, 0]).unwrap(),
        Frame::new_remote(id, 8).unwrap(),
        Frame::new(ExtendedId::new(0x7E5).unwrap(), &good).unwrap(),
        Frame::new(StandardId::new(0x7E4).unwrap(), &good).unwrap(),
    ] {
        bench.lss.handle(&frame, at(0), &mut bench.device);
        assert_eq!(bench.outputs(), [], "{frame}");
    }
    assert!(bench.is_in_configuration());
}

/// A master's fastscan on a bus with several slaves, by CiA 305: an answer of any slave means yes.
fn scan(slaves: &mut [(Lss, Device)]) -> Option<[u32; 4]> {
    let mut ask = |bytes: [u8; 8]| {
        let mut yes = false;
        for (lss, device) in slaves.iter_mut() {
            lss.handle(&request(bytes), at(0), device);
            yes |= lss.poll(at(0)) == Some(response([0x4F, 0, 0, 0, 0, 0, 0, 0]));
        }
        yes
    };
    if !ask(fastscan(0, 0x80, 0, 0)) {
        return None;
    }
    let mut found = [0; 4];
    for part in 0..4_u8 {
        let number = &mut found[usize::from(part)];
        for bit in (0..32).rev() {
            if !ask(fastscan(*number, bit, part, part)) {
                *number |= 1 << bit;
            }
        }
        assert!(ask(fastscan(*number, 0, part, (part + 1) % 4)));
    }
    Some(found)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, rng_seed: RngSeed::Fixed(305), ..ProptestConfig::default() })]

    /// Every slave without a node-ID is found, one after another, and gets its own node-ID.
    #[test]
    fn fastscan_finds_all(addresses in proptest::collection::hash_set(prop::array::uniform4(prop_oneof![0..3_u32, any::<u32>()]), 1..5)) {
        let mut slaves: Vec<_> = addresses
            .iter()
            .map(|[vendor_id, product_code, revision, serial_number]| {
                let address = LssAddress {
                    vendor_id: *vendor_id,
                    product_code: *product_code,
                    revision: *revision,
                    serial_number: *serial_number,
                };
                (Lss::new(address, None, Config::default()), Device::default())
            })
            .collect();
        let mut left = addresses.clone();
        for id in 1..=addresses.len() as u8 {
            let found = scan(&mut slaves).unwrap();
            prop_assert!(left.remove(&found));
            for (lss, device) in &mut slaves {
                lss.handle(&request([0x11, id, 0, 0, 0, 0, 0, 0]), at(0), device);
                lss.handle(&request([0x04, 0, 0, 0, 0, 0, 0, 0]), at(0), device);
                while lss.poll(at(0)).is_some() {}
            }
        }
        prop_assert_eq!(scan(&mut slaves), None);
        let mut ids: Vec<_> = slaves.iter().map(|(lss, _)| lss.node_id().unwrap().get()).collect();
        ids.sort_unstable();
        prop_assert_eq!(ids, (1..=addresses.len() as u8).collect::<Vec<_>>());
    }

    /// After any previous events, a slave works when it is selected by its address.
    #[test]
    fn any_frames_leave_a_slave_that_serves(
        frames in proptest::collection::vec((prop_oneof![Just(0x04_u8), 0x11..0x18_u8, 0x40..0x5F_u8, any::<u8>()], any::<[u8; 7]>()), 0..60),
        node: u8,
    ) {
        let mut bench = Bench::new(node);
        for (command, rest) in frames {
            let mut bytes = [command; 8];
            bytes[1..].copy_from_slice(&rest);
            bench.ask(bytes);
        }
        // Twice the longest delay of a bit rate's activation.
        bench.now += 131_070;
        bench.outputs();
        bench.now += 131_070;
        bench.ask([0x04, 0, 0, 0, 0, 0, 0, 0]);
        bench.silent(&SELECT[..3]);
        bench.expect(&[(SELECT[3], [0x44, 0, 0, 0, 0, 0, 0, 0])]);
    }
}
