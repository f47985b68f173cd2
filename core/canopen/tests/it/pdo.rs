//! PDOs and SYNC: CiA 301 sections 7.2.2 and 7.2.5, codes of its tables 22 and 26. Where it leaves
//! a choice, a comment says which other stack has made the same one.

use std::collections::BTreeMap;

use canopen::nmt::NmtState::{Operational, PreOperational};
use canopen::od::{find, put, Access, DataType, DefaultValue, Entry, Objects, Table};
use canopen::pdo::{entry_count, Pdos, Preset};
use canopen::{AbortCode, Address, CobId, Frame};
use embedded_can::{ExtendedId, Frame as _, StandardId};
use kit::bus::{at, node};

const BYTE: Entry = Entry::var(0x2000, "Byte", DataType::Unsigned8, Access::Rw);
const HALF: Entry = Entry::var(0x2001, "Half", DataType::Unsigned16, Access::Rw);
const INPUT: Entry = Entry::var(0x2002, "Input", DataType::Unsigned8, Access::Ro);
const LONG: Entry = Entry::var(0x2003, "Long", DataType::Unsigned64, Access::Ro);
const SINK: Entry = Entry::var(0x2004, "Sink", DataType::Unsigned8, Access::Wo);
static PROCESS: [Entry; 5] = [BYTE, HALF, INPUT, LONG, SINK];
static PRESETS: [Preset; 2] = [
    Preset { index: 0x1400, transmission: 255, inhibit: 0, event_ms: 0, mapping: &[BYTE, HALF] },
    Preset { index: 0x1800, transmission: 254, inhibit: 100, event_ms: 0, mapping: &[INPUT, HALF] },
];
const DEVICE_TYPE: Entry = Entry::var(0x1000, "Device type", DataType::Unsigned32, Access::Const);
static TABLE: [Entry; 6 + entry_count(&PRESETS)] =
    Table::EMPTY.with(&[DEVICE_TYPE]).with_pdos(&PRESETS).with(&PROCESS).entries();
const SYNC: u16 = 0x080;

/// The values that are not 0.
struct Process(BTreeMap<u16, Vec<u8>>);

impl Objects for Process {
    fn entries(&self) -> &'static [Entry] {
        &PROCESS
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        let size = find(&PROCESS, at)?.data_type.size().expect("a number") as usize;
        put(buf, self.0.get(&at.index).unwrap_or(&vec![0; size]))
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        self.0.insert(at.index, data.to_vec());
        Ok(())
    }
}

/// Node 5.
struct Bench {
    pdos: Pdos<2>,
    process: Process,
    now: u32,
}

impl Bench {
    fn operational() -> Self {
        let pdos = Pdos::new(&PRESETS, Some(node()));
        let mut bench = Self { pdos, process: Process(BTreeMap::new()), now: 0 };
        bench.pdos.state_changed(Operational);
        assert_eq!(bench.sent(), tpdo(0), "with the present values");
        bench
    }

    fn put(&mut self, id: u16, data: &[u8]) -> Option<u16> {
        self.pdos.handle(&Frame::of(CobId::new(id).unwrap(), data), &mut self.process)
    }

    fn sent(&mut self) -> Option<Frame> {
        self.pdos.poll(at(self.now), &mut self.process)
    }

    /// The abort code, 0 for none.
    fn write(&mut self, index: u16, sub: u8, value: u32) -> u32 {
        let at = Address::new(index, sub);
        let size = find(&TABLE, at).unwrap().data_type.size().unwrap() as usize;
        let written = self.pdos.write(at, &value.to_le_bytes()[..size], &TABLE, &self.process);
        written.unwrap().err().map_or(0, |code| code.0)
    }

    fn input(&mut self, value: u8) {
        self.process.0.insert(0x2002, vec![value]);
    }

    fn byte(&self) -> u8 {
        self.process.0.get(&0x2000).map_or(0, |data| data[0])
    }
}

/// The TPDO with this value of 2002h, and 0 of 2001h.
fn tpdo(input: u8) -> Option<Frame> {
    Some(Frame::of(CobId::new(0x185).unwrap(), &[input, 0, 0]))
}

/// An error of length is reported once, until a frame has another one, as by CANopenNode. The
/// controller gives eight bytes for the codes 9 to 15.
#[test]
fn frames_of_every_kind_and_length_arrive_in_operational_alone() {
    let mut bench = Bench::operational();
    let (id, long) = (StandardId::new(0x205).unwrap(), ExtendedId::new(0x205).unwrap());
    for frame in [Frame::new_remote(id, 3), Frame::new(long, &[9, 9, 9])] {
        assert_eq!(bench.pdos.handle(&frame.unwrap(), &mut bench.process), None);
    }
    assert_eq!(bench.byte(), 0);
    for (len, byte, emergency) in [
        (0, 0, Some(0x8210)),
        (2, 0, None),
        (3, 3, None),
        (2, 3, Some(0x8210)),
        (4, 4, Some(0x8220)),
        (8, 8, None),
    ] {
        let said = bench.put(0x205, &[len; 8][..len.into()]);
        assert_eq!((bench.byte(), said), (byte, emergency), "{len} bytes");
    }
    bench.pdos.state_changed(PreOperational);
    bench.now = 100;
    assert_eq!((bench.put(0x205, &[7, 7, 7]), bench.byte(), bench.sent()), (None, 8, None));
}

/// The transmission types of 1400h and 1800h. A SYNC with data counts, as in Lely's stack.
#[test]
fn synchronous_pdos_wait_for_sync() {
    let mut bench = Bench::operational();
    for (transmission, byte) in [(1, 1), (0, 2), (240, 3)] {
        assert_eq!(bench.write(0x1400, 2, transmission), 0);
        bench.put(0x205, &[byte, 0, 0]);
        assert_ne!(bench.byte(), byte);
        bench.put(SYNC, &[]);
        assert_eq!(bench.byte(), byte);
    }
    assert_eq!(bench.write(0x1800, 2, 3), 0);
    for round in 1..=7 {
        bench.input(round);
        bench.put(SYNC, &[]);
        // The values of SYNC, not of the moment of sending.
        bench.input(0xFF);
        assert_eq!(bench.sent(), tpdo(round).filter(|_| round % 3 == 0), "SYNC {round}");
    }
    // Type 0: only after an event.
    assert_eq!(bench.write(0x1800, 2, 0), 0);
    for (id, input, fault, expected) in [
        (SYNC, 7, None, tpdo(7)),
        (SYNC, 7, None, None),
        (SYNC, 8, Some(0x8240), tpdo(8)),
        (SYNC, 9, None, tpdo(9)),
        // The COB-ID of another producer.
        (0x0FF, 9, None, None),
        (SYNC, 10, None, None),
        (0x0FF, 10, None, tpdo(10)),
    ] {
        assert!(id == SYNC || bench.write(0x1005, 0, id.into()) == 0);
        bench.input(input);
        // Frames with a counter, which the device does not have.
        let data: &[u8] = if matches!(input, 8 | 9) && id == SYNC { &[1] } else { &[] };
        assert_eq!((bench.put(id, data), bench.sent()), (fault, expected), "{input}");
    }
}

/// The inhibit time is in units of 100 µs, the event timer in ms.
#[test]
fn an_event_is_a_new_value_or_the_end_of_the_event_timer() {
    let mut bench = Bench::operational();
    bench.input(1);
    for (now, expected) in [(9, None), (11, tpdo(1)), (1_000_000, None)] {
        bench.now = now;
        assert_eq!(bench.sent(), expected, "{now} ms");
    }
    // Without bit 30 it is the same COB-ID.
    assert_eq!((bench.write(0x1800, 1, 0x185), bench.sent()), (0, None));
    assert_eq!(bench.write(0x1800, 5, 50), 0);
    assert_eq!((bench.sent(), bench.sent()), (tpdo(1), None));
    for _ in 0..3 {
        bench.now += 49;
        assert_eq!(bench.sent(), None);
        bench.now += 1;
        assert_eq!(bench.sent(), tpdo(1));
    }
}

/// What exists keeps its COB-ID, inhibit time and mapping. Lely's stack and CANopenNode have the
/// same order; the code for another one differs between the two.
#[test]
fn a_pdo_is_changed_by_the_procedure_of_the_standard_alone() {
    const NO_OBJECT: u32 = 0x0602_0000;
    const NOT_MAPPABLE: u32 = 0x0604_0041;
    const PDO_LENGTH: u32 = 0x0604_0042;
    const PARAMETER: u32 = 0x0604_0043;
    const NO_SUB_INDEX: u32 = 0x0609_0011;
    const VALUE: u32 = 0x0609_0030;
    #[rustfmt::skip]
    const STEPS: [(u16, u8, u32, u32); 44] = [
        // The present values again.
        (0x1400, 1, 0x205, 0), (0x1600, 0, 2, 0), (0x1600, 1, 0x2000_0008, 0), (0x1800, 3, 100, 0),
        // It exists.
        (0x1400, 1, 0x206, VALUE), (0x1800, 3, 50, VALUE),
        (0x1600, 0, 0, PARAMETER), (0x1600, 1, 0x2001_0010, PARAMETER),
        // It does not: the number, then the objects.
        (0x1400, 1, 0x8000_0205, 0), (0x1600, 1, 0x2001_0010, PARAMETER), (0x1600, 0, 0, 0),
        (0x1600, 1, 0x2FFF_0008, NO_OBJECT), (0x1600, 1, 0x2000_0108, NO_SUB_INDEX),
        (0x1600, 1, 0x1000_0020, NOT_MAPPABLE), (0x1600, 1, 0x2001_0008, NOT_MAPPABLE),
        (0x1600, 1, 0x2002_0008, NOT_MAPPABLE), (0x1600, 1, 0x2001_0010, 0), (0x1600, 2, 0, 0),
        (0x1600, 3, 0x2004_0008, 0), (0x1600, 0, 3, PARAMETER), (0x1600, 0, 9, PDO_LENGTH),
        (0x1600, 2, 0x2000_0008, 0), (0x1600, 0, 2, 0),
        // Restricted, 29 bits, and out of range (CiA 301 table 40).
        (0x1400, 1, 0x000, VALUE), (0x1400, 1, 0x180, VALUE), (0x1400, 1, 0x605, VALUE),
        (0x1400, 1, 0x2000_0206, VALUE), (0x1400, 1, 0x0000_0A06, VALUE), (0x1400, 1, 0x206, 0),
        (0x1400, 2, 241, VALUE), (0x1400, 2, 253, VALUE), (0x1400, 2, 254, 0),
        // A TPDO of more than eight bytes. As those two stacks do, it takes a COB-ID without bit
        // 30.
        (0x1800, 1, 0xC000_0185, 0), (0x1A00, 0, 0, 0), (0x1A00, 1, 0x2004_0008, NOT_MAPPABLE),
        (0x1A00, 1, 0x2003_0040, 0), (0x1A00, 0, 2, PDO_LENGTH), (0x1A00, 0, 1, 0),
        (0x1800, 2, 252, VALUE), (0x1800, 1, 0x285, 0),
        // The producer of SYNC, 29 bits, restricted.
        (0x1005, 0, 0x4000_0080, VALUE), (0x1005, 0, 0x2000_0080, VALUE), (0x1005, 0, 0x601, VALUE),
        (0x1005, 0, 0x8000_0081, 0),
    ];
    let mut bench = Bench::operational();
    for (step, (index, sub, value, code)) in STEPS.into_iter().enumerate() {
        let got = bench.write(index, sub, value);
        assert_eq!(got, code, "{got:08X}h: step {step}, {value:X}h to {index:04X}h/{sub}");
        // The filters are set again only for another COB-ID: a frame may be lost meanwhile.
        let is_cob_id = matches!((index, sub), (0x1400, 1) | (0x1005, 0));
        assert_eq!(bench.pdos.identifiers_changed(), is_cob_id && code == 0 && step > 0, "step {step}");
    }
    let read = |pdos: &mut Pdos<2>| {
        let mut buf = [0; 4];
        assert_eq!(pdos.read(Address::new(0x1800, 1), &mut buf), Some(Ok(4)));
        (u32::from_le_bytes(buf), pdos.identifiers().map(CobId::get).collect::<Vec<_>>())
    };
    assert_eq!(read(&mut bench.pdos), (0x4000_0285, vec![0x081, 0x206]));
    bench.process.0.insert(0x2003, vec![1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(bench.sent(), Some(Frame::of(CobId::new(0x285).unwrap(), &[1, 2, 3, 4, 5, 6, 7, 8])));
    bench.put(0x206, &[0x34, 0x12, 6]);
    assert_eq!((bench.byte(), &bench.process.0[&0x2001][..]), (6, &[0x34, 0x12][..]));

    // Reset communication: all is as after a power-on, and as the table says.
    bench.pdos = Pdos::new(&PRESETS, Some(node()));
    assert_eq!(read(&mut bench.pdos), (0x4000_0185, vec![SYNC, 0x205]));
    let default = |index| find(&TABLE, Address::new(index, 1)).unwrap().default;
    assert_eq!(default(0x1800), DefaultValue::Text("$NODEID+0x40000180"));
    assert_eq!(default(0x1A00), DefaultValue::Number(0x2002_0008));
}
