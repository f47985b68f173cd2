//! PDOs and SYNC over the bus: CiA 301 sections 7.2.2 and 7.2.5, codes of its tables 22 and 26. Where
//! it leaves a choice, a comment says which other stack has made the same one.

use std::collections::BTreeMap;
use std::task::Poll;

use canopen::lss::{LssAddress, LssDevice, StoreError};
use canopen::nmt::NmtState;
use canopen::node::{self, NmtPolicy};
use canopen::od::{find, put, Access, DataType, DefaultValue, Entry, Exchange, Objects, Table};
use canopen::pdo::{entry_count, Pdos, Preset};
use canopen::slave::{Config, Output, Slave, SlaveDevice};
use canopen::{AbortCode, Address, BitRate, CobId, Frame, Instant, NodeId};
use embedded_can::{ExtendedId, Frame as _, StandardId};
use kit::bus::at;

const BYTE: Entry = Entry::var(0x2000, "Byte", DataType::Unsigned8, Access::Rw);
const HALF: Entry = Entry::var(0x2001, "Half", DataType::Unsigned16, Access::Rw);
const INPUT: Entry = Entry::var(0x2002, "Input", DataType::Unsigned8, Access::Ro);
const LONG: Entry = Entry::var(0x2003, "Long", DataType::Unsigned64, Access::Ro);
const SINK: Entry = Entry::var(0x2004, "Sink", DataType::Unsigned8, Access::Wo);
static PROCESS: [Entry; 5] = [BYTE, HALF, INPUT, LONG, SINK];
static RECEIVE: [Preset; 1] = [Preset { transmission: 255, inhibit: 0, event_ms: 0, mapping: &[BYTE, HALF] }];
static TRANSMIT: [Preset; 1] =
    [Preset { transmission: 254, inhibit: 100, event_ms: 0, mapping: &[INPUT, HALF] }];
const LEN: usize = 1 + entry_count(&RECEIVE, &TRANSMIT) + PROCESS.len();
static TABLE: [Entry; LEN] = Table::EMPTY
    .with(&[Entry::var(0x1000, "Device type", DataType::Unsigned32, Access::Const)])
    .with_pdos(&RECEIVE, &TRANSMIT)
    .with(&PROCESS)
    .entries();

/// The values of the process that are not 0.
#[derive(Default)]
struct Process(BTreeMap<u16, Vec<u8>>);

impl Objects for Process {
    fn entries(&self) -> &'static [Entry] {
        &PROCESS
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        let size = find(&PROCESS, at)?.data_type.size().expect("a number");
        put(buf, self.0.get(&at.index).unwrap_or(&vec![0; size as usize]))
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        self.0.insert(at.index, data.to_vec());
        Ok(())
    }
}

struct Device {
    pdos: Pdos<1, 1>,
    process: Process,
    emergencies: Vec<u16>,
}

impl Objects for Device {
    fn entries(&self) -> &'static [Entry] {
        &TABLE
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        self.pdos.read(at, buf).unwrap_or_else(|| self.process.read(at, buf))
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        let written = self.pdos.write(at, data, &TABLE, &self.process);
        written.unwrap_or_else(|| self.process.write(at, data))
    }

    fn exchange(&mut self) -> Option<&mut dyn Exchange> {
        Some(self)
    }
}

impl Exchange for Device {
    fn state_changed(&mut self, state: NmtState) {
        self.pdos.state_changed(state);
    }

    fn handle(&mut self, frame: &Frame) {
        self.emergencies.extend(self.pdos.handle(frame, &mut self.process));
    }

    fn poll(&mut self, now: Instant) -> Option<Frame> {
        self.pdos.poll(now, &mut self.process)
    }

    fn identifier(&self, place: usize) -> Option<CobId> {
        self.pdos.identifiers().nth(place)
    }

    fn identifiers_changed(&mut self) -> bool {
        self.pdos.identifiers_changed()
    }
}

impl LssDevice for Device {
    fn supports(&mut self, _: BitRate) -> bool {
        true
    }

    fn store(&mut self, _: Option<NodeId>, _: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        Poll::Ready(Ok(()))
    }
}

impl SlaveDevice for Device {
    fn node_id_changed(&mut self, id: Option<NodeId>) {
        self.pdos.reset(id);
    }
}

/// Node 5.
struct Bench {
    slave: Slave,
    device: Device,
    now: u32,
    /// The identifiers that the device has asked for last, beside its slave's.
    accepted: Vec<u16>,
}

impl Bench {
    /// In PRE-OPERATIONAL.
    fn new() -> Self {
        let address = LssAddress { vendor_id: 1, product_code: 2, revision: 3, serial_number: 4 };
        let node = node::Config { nmt: NmtPolicy::Follow, ..node::Config::default() };
        let slave = Slave::new(address, NodeId::new(5), BitRate::K500, Config { node, ..Config::default() });
        let pdos = Pdos::new(&RECEIVE, &TRANSMIT);
        let device = Device { pdos, process: Process::default(), emergencies: Vec::new() };
        let mut bench = Self { slave, device, now: 0, accepted: Vec::new() };
        assert_eq!(bench.sent(), [(0x705, vec![0])]);
        bench
    }

    fn operational() -> Self {
        let mut bench = Self::new();
        assert_eq!(bench.put(0, &[1, 5]), [tpdo(0, 0)], "with the present values");
        bench
    }

    /// What the device sends now, as identifier and data.
    fn sent(&mut self) -> Vec<(u16, Vec<u8>)> {
        let mut sent = Vec::new();
        while let Some(output) = self.slave.poll(at(self.now), true, &mut self.device) {
            match output {
                Output::Send(frame) => {
                    sent.push((frame.cob_id().expect("a data frame").get(), frame.data().to_vec()));
                }
                Output::Accept(_) => {
                    let own = |n| self.device.identifier(n).map(CobId::get);
                    self.accepted = (0..).map_while(own).collect();
                }
                _ => {}
            }
        }
        sent
    }

    fn put(&mut self, id: u16, data: &[u8]) -> Vec<(u16, Vec<u8>)> {
        self.put_frame(&Frame::of(CobId::new(id).expect("11 bits"), data))
    }

    fn put_frame(&mut self, frame: &Frame) -> Vec<(u16, Vec<u8>)> {
        self.slave.handle(frame, at(self.now), &mut self.device);
        self.sent()
    }

    /// Expedited, with as many bytes as the object has; the abort code, 0 for none.
    fn write(&mut self, index: u16, sub: u8, value: u32) -> u32 {
        let size = find(&TABLE, Address::new(index, sub)).map_or(4, |entry| entry.data_type.size().unwrap());
        let [low, high] = index.to_le_bytes();
        let [a, b, c, d] = value.to_le_bytes();
        let answers = self.put(0x605, &[0x23 | (4 - size as u8) << 2, low, high, sub, a, b, c, d]);
        let answer = &answers.iter().find(|(id, _)| *id == 0x585).expect("an answer").1;
        if answer[0] == 0x60 {
            0
        } else {
            u32::from_le_bytes(answer[4..].try_into().expect("eight bytes"))
        }
    }

    fn input(&mut self, value: u8) {
        self.device.process.0.insert(0x2002, vec![value]);
    }

    fn byte(&mut self) -> u8 {
        self.device.process.0.get(&0x2000).map_or(0, |data| data[0])
    }
}

/// The TPDO with these values of 2002h and 2001h.
fn tpdo(input: u8, half: u16) -> (u16, Vec<u8>) {
    let [low, high] = half.to_le_bytes();
    (0x185, vec![input, low, high])
}

const SYNC: u16 = 0x080;

#[test]
fn pdos_are_exchanged_in_operational_alone() {
    let mut bench = Bench::new();
    assert_eq!(bench.accepted, [SYNC, 0x205]);
    for (command, state) in [(0x80, "PRE-OPERATIONAL"), (2, "STOPPED")] {
        bench.put(0, &[command, 0]);
        bench.input(1);
        assert_eq!(bench.put(0x205, &[7, 0, 0]), [], "{state}");
        assert_eq!((bench.put(SYNC, &[]), bench.byte()), (vec![], 0), "{state}");
    }
    assert_eq!(bench.put(0, &[1, 0]), [tpdo(1, 0)]);
    bench.now = 20;
    assert_eq!(bench.put(0x205, &[7, 0x34, 0x12]), [tpdo(1, 0x1234)]);
    assert_eq!(bench.byte(), 7);
    bench.put(0, &[0x80, 0]);
    bench.input(2);
    bench.now = 40;
    assert_eq!(bench.sent(), []);
}

/// 8210h and 8220h: CANopenNode, too, reports an error once, until a frame has another length.
#[test]
fn frames_of_every_kind_and_length_arrive() {
    let mut bench = Bench::operational();
    let id = StandardId::new(0x205).expect("11 bits");
    let long = ExtendedId::new(0x205).expect("29 bits");
    for frame in [Frame::new_remote(id, 3), Frame::new(long, &[9, 9, 9]), Frame::new_remote(id, 8)] {
        bench.put_frame(&frame.expect("a frame"));
    }
    assert_eq!(bench.byte(), 0);
    // The controller gives eight bytes for the codes 9 to 15.
    for (len, expected, emergencies) in [
        (0, 0, &[0x8210][..]),
        (2, 0, &[0x8210]),
        (3, 3, &[0x8210]),
        (2, 3, &[0x8210, 0x8210]),
        (4, 4, &[0x8210, 0x8210, 0x8220]),
        (8, 8, &[0x8210, 0x8210, 0x8220]),
        (3, 3, &[0x8210, 0x8210, 0x8220]),
    ] {
        bench.put(0x205, &[len; 8][..len.into()]);
        assert_eq!((bench.byte(), &bench.device.emergencies[..]), (expected, emergencies), "{len} bytes");
    }
}

/// The transmission types of CiA 301, objects 1400h and 1800h. A SYNC with data counts, as in Lely's stack.
#[test]
fn synchronous_pdos_wait_for_sync() {
    let mut bench = Bench::operational();
    for transmission in [1, 0, 240] {
        assert_eq!(bench.write(0x1400, 2, transmission), 0);
        bench.put(0x205, &[transmission as u8 + 1, 0, 0]);
        assert_ne!(bench.byte(), transmission as u8 + 1);
        bench.put(SYNC, &[]);
        assert_eq!(bench.byte(), transmission as u8 + 1);
    }

    assert_eq!(bench.write(0x1800, 2, 3), 0);
    for round in 1..=7 {
        bench.now += 1;
        bench.input(round);
        let expected = if round % 3 == 0 { vec![tpdo(round, 0)] } else { vec![] };
        assert_eq!(bench.put(SYNC, &[]), expected, "SYNC {round}");
        assert_eq!(bench.sent(), []);
    }
    // Type 0: only after an event.
    assert_eq!(bench.write(0x1800, 2, 0), 0);
    assert_eq!(bench.put(SYNC, &[]), [tpdo(7, 0)]);
    assert_eq!(bench.put(SYNC, &[]), []);
    bench.input(8);
    assert_eq!(bench.sent(), []);
    assert_eq!(bench.put(SYNC, &[1]), [tpdo(8, 0)]);
    bench.put(SYNC, &[2]);
    assert_eq!(bench.device.emergencies, [0x8240]);
    // Another COB-ID for SYNC: the filters are set again.
    assert_eq!(bench.write(0x1005, 0, 0x0FF), 0);
    assert_eq!(bench.accepted, [0x0FF, 0x205]);
    bench.input(9);
    assert_eq!((bench.put(SYNC, &[]), bench.put(0x0FF, &[])), (vec![], vec![tpdo(9, 0)]));
}

/// The inhibit time is in units of 100 µs, the event timer in ms.
#[test]
fn an_event_is_a_new_value_or_the_end_of_the_event_timer() {
    let mut bench = Bench::operational();
    bench.input(1);
    bench.now = 9;
    assert_eq!(bench.sent(), [], "10 ms are not over");
    bench.now = 11;
    assert_eq!(bench.sent(), [tpdo(1, 0)]);
    bench.now = 1_000_000;
    assert_eq!(bench.sent(), []);
    assert_eq!(bench.write(0x1800, 5, 50), 0);
    assert_eq!(bench.sent(), [], "since the last one");
    for _ in 0..3 {
        bench.now += 49;
        assert_eq!(bench.sent(), []);
        bench.now += 1;
        assert_eq!(bench.sent(), [tpdo(1, 0)]);
    }
}

/// What exists keeps its COB-ID, inhibit time and mapping. Lely's stack and CANopenNode have the same
/// order; the code for another one differs between the two.
#[test]
fn a_pdo_is_changed_by_the_procedure_of_the_standard_alone() {
    const NO_OBJECT: u32 = 0x0602_0000;
    const NOT_MAPPABLE: u32 = 0x0604_0041;
    const PDO_LENGTH: u32 = 0x0604_0042;
    const PARAMETER: u32 = 0x0604_0043;
    const NO_SUB_INDEX: u32 = 0x0609_0011;
    const VALUE: u32 = 0x0609_0030;
    let mut bench = Bench::operational();
    for (step, (index, sub, value, code)) in [
        // The present values again.
        (0x1400, 1, 0x205, 0),
        (0x1600, 0, 2, 0),
        (0x1600, 1, 0x2000_0008, 0),
        (0x1800, 1, 0x4000_0185, 0),
        (0x1800, 3, 100, 0),
        // It exists.
        (0x1400, 1, 0x206, VALUE),
        (0x1600, 0, 0, PARAMETER),
        (0x1600, 1, 0x2001_0010, PARAMETER),
        (0x1800, 3, 50, VALUE),
        // It does not: the number, then the objects.
        (0x1400, 1, 0x8000_0205, 0),
        (0x1600, 1, 0x2001_0010, PARAMETER),
        (0x1600, 0, 0, 0),
        (0x1600, 1, 0x2FFF_0008, NO_OBJECT),
        (0x1600, 1, 0x2000_0108, NO_SUB_INDEX),
        (0x1600, 1, 0x1000_0020, NOT_MAPPABLE),
        (0x1600, 1, 0x2001_0008, NOT_MAPPABLE),
        (0x1600, 1, 0x2002_0008, NOT_MAPPABLE),
        (0x1600, 1, 0x2001_0010, 0),
        (0x1600, 2, 0, 0),
        (0x1600, 3, 0x2004_0008, 0),
        (0x1600, 0, 3, PARAMETER),
        (0x1600, 0, 9, PDO_LENGTH),
        (0x1600, 9, 0, NO_SUB_INDEX),
        (0x1600, 2, 0x2000_0008, 0),
        (0x1600, 0, 2, 0),
        // Restricted, 29 bits, and out of range (CiA 301 table 40).
        (0x1400, 1, 0x000, VALUE),
        (0x1400, 1, 0x180, VALUE),
        (0x1400, 1, 0x605, VALUE),
        (0x1400, 1, 0x2000_0206, VALUE),
        (0x1400, 1, 0x0000_0A06, VALUE),
        (0x1400, 1, 0x206, 0),
        (0x1400, 2, 241, VALUE),
        (0x1400, 2, 253, VALUE),
        (0x1400, 2, 254, 0),
        // A TPDO of more than eight bytes; none is asked for by a remote frame. As those two stacks do,
        // it takes a COB-ID without bit 30.
        (0x1800, 1, 0xC000_0185, 0),
        (0x1800, 3, 50, 0),
        (0x1A00, 0, 0, 0),
        (0x1A00, 1, 0x2004_0008, NOT_MAPPABLE),
        (0x1A00, 1, 0x2003_0040, 0),
        (0x1A00, 0, 2, PDO_LENGTH),
        (0x1A00, 0, 1, 0),
        (0x1800, 2, 252, VALUE),
        (0x1800, 1, 0x285, 0),
        // The producer of SYNC, 29 bits, restricted.
        (0x1005, 0, 0x4000_0080, VALUE),
        (0x1005, 0, 0x2000_0080, VALUE),
        (0x1005, 0, 0x601, VALUE),
        (0x1005, 0, 0x8000_0080, 0),
    ]
    .into_iter()
    .enumerate()
    {
        let got = bench.write(index, sub, value);
        assert_eq!(got, code, "{got:08X}h: step {step}, {value:X}h to {index:04X}h/{sub}");
    }
    assert_eq!(bench.accepted, [SYNC, 0x206]);
    let read = |bench: &mut Bench| bench.put(0x605, &[0x40, 0x00, 0x18, 1, 0, 0, 0, 0]).remove(0);
    assert_eq!(read(&mut bench), (0x585, vec![0x43, 0x00, 0x18, 1, 0x85, 0x02, 0, 0x40]));
    bench.now = 100;
    bench.device.process.0.insert(0x2003, vec![1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(bench.sent(), [(0x285, vec![1, 2, 3, 4, 5, 6, 7, 8])]);
    bench.put(0x206, &[0x34, 0x12, 6]);
    assert_eq!((bench.byte(), &bench.device.process.0[&0x2001][..]), (6, &[0x34, 0x12][..]));

    // Reset communication: all is as after a power-on.
    assert_eq!(bench.put(0, &[0x82, 0]), [(0x705, vec![0])]);
    assert_eq!(bench.accepted, [SYNC, 0x205]);
    assert_eq!(read(&mut bench), (0x585, vec![0x43, 0x00, 0x18, 1, 0x85, 0x01, 0, 0x40]));
    assert_eq!(bench.put(0, &[1, 0]), [tpdo(0, 0x1234)]);
}

/// A fifth PDO has no COB-ID in the pre-defined connection set.
#[test]
fn the_table_has_the_values_of_a_power_on() {
    const NONE: Preset = Preset { transmission: 0, inhibit: 0, event_ms: 0, mapping: &[] };
    const FIVE: [Preset; 5] = [NONE; 5];
    let table = Table::<{ entry_count(&FIVE, &[]) }>::EMPTY.with_pdos(&FIVE, &[]).entries();
    let of = |table: &[Entry], index| find(table, Address::new(index, 1)).unwrap().default;
    assert_eq!(of(&table, 0x1403), DefaultValue::Text("$NODEID+0x500"));
    assert_eq!(of(&table, 0x1404), DefaultValue::Number(0x8000_0000));
    assert_eq!(of(&TABLE, 0x1800), DefaultValue::Text("$NODEID+0x40000180"));
    assert_eq!(of(&TABLE, 0x1A00), DefaultValue::Number(0x2002_0008));
}
