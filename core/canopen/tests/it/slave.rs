//! A device on the bus: node, layer setting services and line together.

use core::task::Poll;

use canopen::bit_rate::Heard;
use canopen::frame::Channel;
use canopen::line::{Confinement, LineEvent, Status};
use canopen::lss::{LssAddress, LssDevice, StoreError};
use canopen::od::{Access, DataType, Entry, Objects};
use canopen::slave::{Config, Output, Slave, SlaveDevice};
use canopen::{AbortCode, Address, BitRate, CobId, Frame, NodeId};
use kit::bus::at;

const ADDRESS: LssAddress = LssAddress { vendor_id: 1, product_code: 2, revision: 3, serial_number: 4 };
static ENTRIES: [Entry; 2] = [
    Entry::var(0x1000, "Device type", DataType::Unsigned32, Access::Const),
    Entry::var(0x2000, "Domain", DataType::Domain, Access::Rw),
];

/// A device with slow memory, with layer setting services or without.
#[derive(Default)]
struct Device<const LSS: bool = true> {
    events: Vec<LineEvent>,
    ids: Vec<Option<u8>>,
    stored: Option<(Option<NodeId>, Option<BitRate>)>,
    outcome: Option<Result<(), StoreError>>,
    /// SealedMemory for data of the domain.
    space: Option<usize>,
    cancelled: u32,
}

impl<const LSS: bool> Objects for Device<LSS> {
    fn entries(&self) -> &'static [Entry] {
        &ENTRIES
    }

    fn read(&mut self, _: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        buf[..4].copy_from_slice(&[1, 2, 3, 4]);
        Ok(4)
    }

    fn download_start(&mut self, _: Address, _: Option<u32>) -> Result<(), AbortCode> {
        Ok(())
    }

    fn download_space(&mut self, _: Address, _: bool) -> usize {
        self.space.unwrap_or(usize::MAX)
    }

    fn download_data(&mut self, _: Address, _: &[u8]) -> Result<(), AbortCode> {
        Ok(())
    }

    fn download_cancel(&mut self, _: Address) {
        self.cancelled += 1;
    }

    fn upload_start(&mut self, _: Address) -> Result<Option<u32>, AbortCode> {
        Ok(None)
    }

    fn upload_data(&mut self, _: Address, _: u32, buf: &mut [u8]) -> Result<usize, AbortCode> {
        Ok(buf.len())
    }
}

impl<const LSS: bool> LssDevice for Device<LSS> {
    fn has_lss() -> bool {
        LSS
    }

    fn supports(&mut self, rate: BitRate) -> bool {
        rate != BitRate::K800
    }

    fn store(&mut self, id: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        self.stored = Some((id, rate));
        Poll::Pending
    }

    fn stored(&mut self) -> Poll<Result<(), StoreError>> {
        self.outcome.map_or(Poll::Pending, Poll::Ready)
    }
}

impl<const LSS: bool> SlaveDevice for Device<LSS> {
    fn line_event(&mut self, event: LineEvent) {
        self.events.push(event);
    }

    fn node_id_changed(&mut self, id: Option<NodeId>) {
        self.ids.push(id.map(NodeId::get));
    }
}

struct Bench {
    slave: Slave,
    device: Device,
    now: u32,
}

impl Bench {
    fn new(id: u8, rate: BitRate) -> Self {
        let slave = Slave::new(ADDRESS, NodeId::new(id), rate, Config::default());
        Self { slave, device: Device::default(), now: 0 }
    }

    /// A device that has said its boot-up.
    fn joined() -> Self {
        let mut bench = Self::new(5, BitRate::K125);
        bench.outputs();
        bench
    }

    fn outputs(&mut self) -> Vec<Output> {
        core::iter::from_fn(|| self.slave.poll(at(self.now), true, &mut self.device)).take(20).collect()
    }

    fn put(&mut self, id: u16, data: &[u8]) -> bool {
        self.slave.handle(&frame(id, data), at(self.now), &mut self.device)
    }

    fn ask(&mut self, id: u16, data: &[u8]) -> Vec<Output> {
        self.put(id, data);
        self.outputs()
    }

    fn hear(&mut self, heard: Heard) {
        self.slave.observe(Status { heard, ..Status::default() }, at(self.now), &mut self.device);
    }
}

fn frame(id: u16, data: &[u8]) -> Frame {
    Frame::of(CobId::new(id).unwrap(), data)
}

/// Without a second SDO server.
fn accept([a, b, c]: [u16; 3]) -> Output {
    let [a, b, c] = [a, b, c].map(|id| CobId::new(id).unwrap());
    Output::Accept([a, b, c, a])
}

fn send(id: u16, data: &[u8]) -> Output {
    Output::Send(frame(id, data))
}

#[test]
fn sets_filters_and_bit_rate_before_it_says_its_boot_up() {
    let mut bench = Bench::new(5, BitRate::K250);
    assert!(!bench.put(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]), "not on the bus yet");
    assert_eq!(
        bench.outputs(),
        [accept([0x000, 0x7E5, 0x605]), Output::Join(BitRate::K250), send(0x705, &[0])]
    );
    let answer = bench.ask(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
    assert_eq!(answer, [send(0x585, &[0x43, 0, 0x10, 0, 1, 2, 3, 4])]);
}

#[test]
fn without_room_for_frames_the_controller_is_still_looked_after() {
    let mut bench = Bench::new(5, BitRate::K250);
    let mut poll = |slave: &mut Slave| slave.poll(at(0), false, &mut bench.device);
    assert_eq!(poll(&mut bench.slave), Some(accept([0x000, 0x7E5, 0x605])));
    assert_eq!(poll(&mut bench.slave), Some(Output::Join(BitRate::K250)));
    assert_eq!(poll(&mut bench.slave), None);
    let off = Status { confinement: Confinement::BusOff, ..Status::default() };
    bench.slave.observe(off, at(10), &mut bench.device);
    bench.slave.observe(off, at(210), &mut bench.device);
    assert_eq!(bench.slave.poll(at(210), false, &mut bench.device), Some(Output::RecoverFromBusOff));
    bench.slave.observe(Status::default(), at(220), &mut bench.device);
    assert_eq!(bench.device.events, [LineEvent::Recovered]);
}

#[test]
fn a_device_without_node_id_lets_lss_in_alone_and_boots_when_it_gets_one() {
    let mut bench = Bench::new(0xFF, BitRate::K125);
    assert_eq!(bench.outputs(), [accept([0x7E5; 3]), Output::Join(BitRate::K125)]);
    assert!(!bench.put(0x000, &[0x81, 0]), "NMT is for nodes");
    assert_eq!(bench.ask(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]), []);
    assert_eq!(bench.ask(0x7E5, &[0x11, 9, 0, 0, 0, 0, 0, 0]), [send(0x7E4, &[0x11, 0, 0, 0, 0, 0, 0, 0])]);
    let outputs = bench.ask(0x7E5, &[0x04, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(outputs, [accept([0x000, 0x7E5, 0x609]), send(0x709, &[0])]);
    assert_eq!(bench.device.ids, [None, Some(9)]);
}

/// A device whose crystal has failed. Identify remote slave, six frames (CiA 305), is answered without a
/// node-ID or a switch before it.
#[test]
fn a_silent_slave_says_nothing_until_a_request_of_lss_arrives() {
    let config = Config { is_silent: true, ..Config::default() };
    for rate in [BitRate::K250, BitRate::Auto] {
        let slave = Slave::new(ADDRESS, NodeId::new(5), rate, config);
        let mut bench = Bench { slave, device: Device::default(), now: 0 };
        let first = bench.outputs();
        assert_eq!(first[0], accept([0x000, 0x7E5, 0x605]));
        if rate == BitRate::Auto {
            // It hears a frame at its first rate, which proves the rate; the frame may be of anybody.
            assert_eq!(first[1..], [Output::Listen(BitRate::K125)]);
            bench.hear(Heard::Frame);
            assert_eq!(bench.outputs(), [Output::Listen(BitRate::K125)]);
        } else {
            assert_eq!(first[1..], [Output::Listen(BitRate::K250)]);
        }
        for now in [10, 1_000, 100_000] {
            bench.now = now;
            bench.hear(Heard::Error);
            bench.hear(Heard::Frame);
            assert_eq!(bench.ask(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]), [], "{rate:?}");
            assert!(!bench.put(0x000, &[0x81, 0]));
            assert_eq!(bench.outputs(), [], "{rate:?}");
        }
        let joins = Output::Join(if rate == BitRate::Auto { BitRate::K125 } else { rate });
        let identify = [(0x46, 1), (0x47, 2), (0x48, 3), (0x49, 3), (0x4A, 4), (0x4B, 4)];
        // The controller would hear nothing while it joins: it waits until the requests are over.
        for (command, number) in identify {
            assert_eq!(bench.ask(0x7E5, &[command, number, 0, 0, 0, 0, 0, 0]), []);
            bench.now += 1;
        }
        bench.now += 14;
        let (boot_up, is_he) = (send(0x705, &[0]), send(0x7E4, &[0x4F, 0, 0, 0, 0, 0, 0, 0]));
        assert_eq!(bench.outputs(), [joins, is_he, boot_up], "{rate:?}");
        let answer = bench.ask(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
        assert_eq!(answer, [send(0x585, &[0x43, 0, 0x10, 0, 1, 2, 3, 4])]);
    }
}

/// A product may disable layer setting services.
#[test]
fn a_slave_without_lss_neither_accepts_nor_answers_its_requests() {
    // It cannot wait for them either.
    let config = Config { is_silent: true, ..Config::default() };
    let mut slave = Slave::new(ADDRESS, NodeId::new(5), BitRate::K500, config);
    let mut device = Device::<false>::default();
    let mut outputs = |asked: Option<[u8; 8]>| -> Vec<Output> {
        let asked = asked.map(|request| Frame::full(CobId::LSS_REQUEST, request));
        assert!(!asked.is_some_and(|frame| slave.handle(&frame, at(0), &mut device)));
        core::iter::from_fn(|| slave.poll(at(0), true, &mut device)).collect()
    };
    let ids = [CobId::NMT, CobId::NMT, CobId::sdo_request(NodeId::new(5).unwrap()), CobId::NMT];
    let boot_up = Output::Send(Frame::of(CobId::new(0x705).unwrap(), &[0]));
    assert_eq!(outputs(None), [Output::Accept(ids), Output::Join(BitRate::K500), boot_up]);
    // Switch state global to configuration, inquire node-ID.
    for request in [[0x04, 1, 0, 0, 0, 0, 0, 0], [0x5E, 0, 0, 0, 0, 0, 0, 0]] {
        assert_eq!(outputs(Some(request)), []);
    }
}

#[test]
fn reset_communication_takes_over_what_lss_configured() {
    let mut bench = Bench::joined();
    bench.ask(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    bench.ask(0x7E5, &[0x11, 9, 0, 0, 0, 0, 0, 0]);
    let outputs = bench.ask(0x000, &[0x82, 5]);
    assert_eq!(outputs, [accept([0x000, 0x7E5, 0x609]), send(0x709, &[0])]);
    bench.ask(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    bench.ask(0x7E5, &[0x11, 0xFF, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.ask(0x000, &[0x82, 0]), [accept([0x7E5; 3])], "and falls silent without one");
    assert_eq!(bench.device.ids, [Some(5), Some(9), None]);
}

/// CiA 305: after a reset of communication the state machine is entered again, in LSS waiting; a
/// change between PRE-OPERATIONAL and STOPPED is not one of its transitions.
#[test]
fn reset_communication_ends_the_configuration_state() {
    let inquire = [0x5E, 0, 0, 0, 0, 0, 0, 0];
    let mut bench = Bench::joined();
    bench.ask(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    for command in [0x01, 0x02, 0x80] {
        assert_eq!(bench.ask(0x000, &[command, 5]), []);
        assert_eq!(bench.ask(0x7E5, &inquire), [send(0x7E4, &[0x5E, 5, 0, 0, 0, 0, 0, 0])]);
    }
    assert_eq!(bench.ask(0x000, &[0x82, 6]), [], "of another node");
    assert_eq!(bench.ask(0x7E5, &inquire).len(), 1);
    bench.ask(0x000, &[0x82, 5]);
    assert_eq!(bench.ask(0x7E5, &inquire), [], "inquire node-ID is not served in LSS waiting");
    // A device that starts in configuration state (not in the standard) is in that state again.
    let lss = canopen::lss::Config { start_in_configuration: true, ..Default::default() };
    let slave = Slave::new(ADDRESS, NodeId::new(5), BitRate::K125, Config { lss, ..Config::default() });
    let mut bench = Bench { slave, device: Device::default(), now: 0 };
    bench.outputs();
    bench.ask(0x7E5, &[0x04, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.ask(0x7E5, &inquire), []);
    bench.ask(0x000, &[0x82, 5]);
    assert_eq!(bench.ask(0x7E5, &inquire).len(), 1);
}

/// The kinds of open transfers: block download, within a sub-block and with a delayed
/// acknowledgement; segmented download; segmented and block upload.
#[test]
fn reset_node_ends_a_transfer_at_once() {
    const INITIATE: [u8; 8] = [0xC2, 0x00, 0x20, 0, 0, 1, 0, 0];
    const SEGMENT: [u8; 8] = [1, 1, 2, 3, 4, 5, 6, 7];
    let transfers: [(Option<usize>, &[[u8; 8]]); 6] = [
        (None, &[INITIATE]),
        (None, &[INITIATE, SEGMENT]),
        (Some(0), &[INITIATE]),
        (None, &[[0x20, 0x00, 0x20, 0, 0, 0, 0, 0]]),
        (None, &[[0x40, 0x00, 0x20, 0, 0, 0, 0, 0]]),
        (None, &[[0xA0, 0x00, 0x20, 0, 127, 0, 0, 0], [0xA3, 0, 0, 0, 0, 0, 0, 0]]),
    ];
    for (space, requests) in transfers {
        let mut bench = Bench::joined();
        bench.device.space = space;
        for request in requests {
            bench.ask(0x605, request);
        }
        assert_eq!(bench.slave.is_idle(), space.is_none(), "an answer is owed or not: {requests:02X?}");
        assert!(bench.put(0x000, &[0x81, 5]));
        assert!(bench.slave.is_idle());
        assert_eq!(bench.outputs(), []);
        let download = matches!(requests[0][0], 0x20 | 0xC2);
        assert_eq!(bench.device.cancelled, u32::from(download), "{requests:02X?}");
        // A client that sends requests before the restart gets answers until then.
        let answer = bench.ask(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
        assert_eq!(answer, [send(0x585, &[0x43, 0, 0x10, 0, 1, 2, 3, 4])]);
    }
}

/// The bit rate that is in use decides: for the last segment there are 50 ms, 100 at 20 kbit/s and less,
/// and a sub-block takes 80 ms at most.
#[test]
fn sub_blocks_follow_the_bit_rate() {
    for (index, rate, pause, blksize) in [
        (0, BitRate::K1000, 50, 127),
        (6, BitRate::K50, 50, 29),
        (7, BitRate::K20, 100, 11),
        (8, BitRate::K10, 100, 5),
    ] {
        // At the start, and after a change by layer setting services.
        for (from, anew) in [
            (rate, false),
            (rate, true),
            (BitRate::K125, false),
            (BitRate::K125, true),
            (BitRate::K10, false),
            (BitRate::K10, true),
        ] {
            let mut bench = Bench::new(5, from);
            bench.outputs();
            if from != rate {
                bench.ask(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
                bench.ask(0x7E5, &[0x13, 0, index, 0, 0, 0, 0, 0]);
                bench.ask(0x7E5, &[0x15, 0, 0, 0, 0, 0, 0, 0]);
            }
            if anew {
                bench.ask(0x000, &[0x82, 5]);
            }
            bench.ask(0x605, &[0xC2, 0x00, 0x20, 0, 14, 0, 0, 0]);
            assert_eq!(bench.ask(0x605, &[1, 1, 2, 3, 4, 5, 6, 7]), []);
            bench.now = pause - 1;
            assert_eq!(bench.outputs(), [], "{from:?} to {rate:?}");
            bench.now = pause;
            assert_eq!(
                bench.outputs(),
                [send(0x585, &[0xA2, 1, blksize, 0, 0, 0, 0, 0])],
                "{from:?} to {rate:?}"
            );
        }
    }
}

#[test]
fn reset_node_is_the_owners() {
    let mut bench = Bench::joined();
    assert!(!bench.put(0x000, &[0x81, 6]), "of another node");
    assert!(bench.put(0x000, &[0x81, 5]));
    assert!(bench.put(0x000, &[0x81, 0]));
}

#[test]
fn the_answer_to_store_waits_for_the_memory() {
    for (outcome, code) in [(Ok(()), 0), (Err(StoreError::Failed), 2)] {
        let mut bench = Bench::joined();
        bench.ask(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bench.ask(0x7E5, &[0x17, 0, 0, 0, 0, 0, 0, 0]), []);
        assert_eq!(bench.device.stored, Some((NodeId::new(5), None)));
        // Nothing else is answered meanwhile.
        assert_eq!(bench.ask(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0]), []);
        bench.device.outcome = Some(outcome);
        assert_eq!(bench.outputs(), [send(0x7E4, &[0x17, code, 0, 0, 0, 0, 0, 0])]);
        let inquired = bench.ask(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(inquired, [send(0x7E4, &[0x5E, 5, 0, 0, 0, 0, 0, 0])]);
    }
}

#[test]
fn listens_until_a_frame_proves_the_bit_rate() {
    let mut bench = Bench::new(5, BitRate::Auto);
    assert_eq!(bench.outputs(), [accept([0x000, 0x7E5, 0x605]), Output::Listen(BitRate::K125)]);
    bench.hear(Heard::Error);
    assert_eq!(bench.outputs(), [Output::Listen(BitRate::K100)]);
    bench.hear(Heard::Nothing);
    assert_eq!(bench.outputs(), []);
    assert_eq!(bench.ask(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]), [], "who listens cannot answer");
    bench.hear(Heard::Frame);
    assert_eq!(bench.outputs(), [Output::Join(BitRate::K100), send(0x705, &[0])]);
}

#[test]
fn activates_a_bit_rate_and_keeps_silent_meanwhile() {
    let mut bench = Bench::joined();
    bench.ask(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    bench.ask(0x7E5, &[0x13, 0, 2, 0, 0, 0, 0, 0]);
    bench.ask(0x7E5, &[0x15, 100, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.ask(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]), []);
    bench.now = 100;
    assert_eq!(bench.outputs(), [Output::Join(BitRate::K500)]);
    bench.now = 199;
    assert_eq!(bench.outputs(), []);
    bench.now = 200;
    // The answer that was waiting.
    assert_eq!(bench.outputs(), [send(0x585, &[0x43, 0, 0x10, 0, 1, 2, 3, 4])]);
}

/// The owner restarts the device when it is idle.
#[test]
fn a_slave_is_idle_when_no_answer_waits() {
    let mut bench = Bench::new(5, BitRate::K125);
    assert!(bench.slave.node().is_none() && bench.slave.is_idle());
    bench.outputs();
    assert_eq!(bench.slave.node().map(|node| node.id().get()), Some(5));
    bench.put(0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
    assert!(!bench.slave.is_idle());
    assert_eq!(bench.outputs(), [send(0x585, &[0x43, 0, 0x10, 0, 1, 2, 3, 4])]);
    assert!(bench.slave.is_idle());
}

#[test]
fn a_heartbeat_that_is_set_is_sent_and_stays_behind_a_restart() {
    let mut bench = Bench::joined();
    bench.slave.set_heartbeat_ms(100, at(0));
    bench.now = 99;
    assert_eq!(bench.outputs(), []);
    bench.now = 100;
    assert_eq!(bench.outputs(), [send(0x705, &[0x7F])]);
    assert!(bench.ask(0x000, &[0x82, 5]).contains(&send(0x705, &[0x00])));
    bench.now = 200;
    assert_eq!(bench.outputs(), [send(0x705, &[0x7F])]);
}

/// A device with a second SDO server, whose COB-IDs a write to 2000h sets.
#[derive(Default)]
struct Grouped(Option<Channel>);

impl Objects for Grouped {
    fn has_second_server() -> bool {
        true
    }

    fn entries(&self) -> &'static [Entry] {
        const { &[Entry::var(0x2000, "Group", DataType::Unsigned8, Access::Rw)] }
    }

    fn read(&mut self, _: Address, _: &mut [u8]) -> Result<usize, AbortCode> {
        Err(AbortCode::NO_DATA)
    }

    fn write(&mut self, _: Address, data: &[u8]) -> Result<(), AbortCode> {
        let id = |number| CobId::new(number).unwrap();
        self.0 =
            (data[0] != 0).then(|| Channel { request: id(0x6D0 + u16::from(data[0])), response: id(0x681) });
        Ok(())
    }

    fn second_server(&self) -> Channel {
        self.0.unwrap_or(Channel::NONE)
    }
}

impl LssDevice for Grouped {
    fn supports(&mut self, _: BitRate) -> bool {
        true
    }

    fn store(&mut self, _: Option<NodeId>, _: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        Poll::Ready(Ok(()))
    }
}

impl SlaveDevice for Grouped {}

/// The requests of a group are let in from the frame on that sets their COB-ID, and only that frame
/// changes the filters.
#[test]
fn the_filters_follow_the_second_server() {
    let mut device = Grouped::default();
    let mut slave = Slave::new(ADDRESS, NodeId::new(5), BitRate::K125, Config::default());
    let mut ask = |id: u16, data: &[u8]| -> Vec<Output> {
        slave.handle(&frame(id, data), at(0), &mut device);
        core::iter::from_fn(|| slave.poll(at(0), true, &mut device)).collect()
    };
    let write = |group: u8| [0x2F, 0x00, 0x20, 0, group, 0, 0, 0];
    let accept =
        |second: u16| Output::Accept([0x000, 0x7E5, 0x605, second].map(|id| CobId::new(id).unwrap()));
    let done = |id: u16| send(id, &[0x60, 0x00, 0x20, 0, 0, 0, 0, 0]);
    assert_eq!(ask(0x605, &write(1)), [accept(0x000), Output::Join(BitRate::K125), send(0x705, &[0])]);
    assert_eq!(ask(0x6D1, &write(2)), [], "nobody listens there");
    assert_eq!(ask(0x605, &write(1)), [accept(0x6D1), done(0x585)]);
    assert_eq!(ask(0x605, &write(1)), [done(0x585)]);
    // The answer to a request of the group comes from the server that took it.
    assert_eq!(ask(0x6D1, &write(2)), [accept(0x6D2), done(0x681)]);
    assert_eq!(ask(0x605, &write(0)), [accept(0x000), done(0x585)]);
}
