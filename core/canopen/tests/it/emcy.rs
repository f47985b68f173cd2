//! Emergencies on the bus, and the objects 1001h, 1003h and 1014h (CiA 301 sections 7.2.7 and
//! 7.5.2).

use canopen::device::{self, Device};
use canopen::emcy::{self, code, register, Emcy, Emergency};
use canopen::nmt::NmtCommand;
use canopen::node::{Config, NmtPolicy, Node};
use canopen::od::{Entry, Table};
use canopen::{AbortCode, Address, CobId, Frame, Objects};
use kit::bus::{at, node, request, response};

const ENTRIES: &[Entry] = &Table::<17>::EMPTY.with(&device::ENTRIES).with(&emcy::ENTRIES).entries();

const DEVICE: Device = Device {
    device_type: 0x1000_0000,
    name: "coboot",
    hardware_version: "1",
    software_version: "2.0",
    heartbeat_ms: 500,
    vendor_id: 1,
    product_code: 2,
    revision: 3,
    serial_number: 4,
};

struct Application(Emcy);

impl Objects for Application {
    fn entries(&self) -> &'static [Entry] {
        ENTRIES
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        let own = self.0.read(node(), at, buf);
        own.or_else(|| DEVICE.read(at, buf)).unwrap_or(Err(AbortCode::NO_DATA))
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        self.0.write(at, data).unwrap_or(Err(AbortCode::UNSUPPORTED_ACCESS))
    }

    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        self.0.next_message()
    }
}

struct Bench {
    node: Node,
    application: Application,
}

impl Bench {
    fn new() -> Self {
        let config = Config { nmt: NmtPolicy::Follow, ..Config::default() };
        Self { node: Node::new(node(), config), application: Application(Emcy::new()) }
    }

    fn sent(&mut self) -> Vec<Frame> {
        core::iter::from_fn(|| self.node.poll(at(0), &mut self.application)).collect()
    }

    #[track_caller]
    fn expect(&mut self, dialogue: &[([u8; 8], [u8; 8])]) {
        for (asked, answered) in dialogue {
            self.node.handle(&request(*asked), at(0), &mut self.application);
            assert_eq!(self.sent(), [response(*answered)], "answer to {asked:02X?}");
        }
    }
}

fn emergency(bytes: [u8; 8]) -> Frame {
    Frame::of(CobId::new(0x085).unwrap(), &bytes)
}

fn read(index: u16, sub: u8) -> [u8; 8] {
    let [low, high] = index.to_le_bytes();
    [0x40, low, high, sub, 0, 0, 0, 0]
}

#[test]
fn an_error_is_sent_behind_the_boot_up_and_remembered() {
    let mut bench = Bench::new();
    bench.application.0.raise(code::DATA_SET, register::MANUFACTURER, [1, 2, 3, 4, 5]);
    assert_eq!(
        bench.sent(),
        [Frame::of(CobId::new(0x705).unwrap(), &[0]), emergency([0x00, 0x63, 0x81, 1, 2, 3, 4, 5])]
    );
    bench.application.0.raise(
        code::CAN_OVERRUN,
        register::COMMUNICATION,
        emcy::driver_status(canopen::line::CONTROLLER_OVERRUN | canopen::line::QUEUE_OVERRUN),
    );
    assert_eq!(bench.sent(), [emergency([0x10, 0x81, 0x91, 0, 0, 0x20, 0x10, 0])]);
    bench.expect(&[
        (read(0x1001, 0), [0x4F, 0x01, 0x10, 0, 0x91, 0, 0, 0]),
        (read(0x1003, 0), [0x4F, 0x03, 0x10, 0, 2, 0, 0, 0]),
        (read(0x1003, 1), [0x43, 0x03, 0x10, 1, 0x10, 0x81, 0, 0]),
        (read(0x1003, 2), [0x43, 0x03, 0x10, 2, 0x00, 0x63, 1, 2]),
        // No third error: 08000024h.
        (read(0x1003, 3), [0x80, 0x03, 0x10, 3, 0x24, 0x00, 0x00, 0x08]),
        (read(0x1014, 0), [0x43, 0x14, 0x10, 0, 0x85, 0, 0, 0]),
        // The other objects of the device still work.
        (read(0x1017, 0), [0x4B, 0x17, 0x10, 0, 0xF4, 0x01, 0, 0]),
    ]);
}

#[test]
fn the_history_keeps_the_latest_and_can_be_forgotten() {
    let mut bench = Bench::new();
    bench.sent();
    for number in 1..=5 {
        bench.application.0.raise(0x1000 + number, 0, [0; 5]);
    }
    bench.sent();
    bench.expect(&[
        (read(0x1003, 0), [0x4F, 0x03, 0x10, 0, 4, 0, 0, 0]),
        (read(0x1003, 1), [0x43, 0x03, 0x10, 1, 0x05, 0x10, 0, 0]),
        (read(0x1003, 4), [0x43, 0x03, 0x10, 4, 0x02, 0x10, 0, 0]),
        // Only 0 may be written, and only to sub-index 0.
        ([0x2F, 0x03, 0x10, 0, 1, 0, 0, 0], [0x80, 0x03, 0x10, 0, 0x30, 0x00, 0x09, 0x06]),
        ([0x23, 0x03, 0x10, 1, 0, 0, 0, 0], [0x80, 0x03, 0x10, 1, 0x02, 0x00, 0x01, 0x06]),
        (read(0x1003, 0), [0x4F, 0x03, 0x10, 0, 4, 0, 0, 0]),
        ([0x2F, 0x03, 0x10, 0, 0, 0, 0, 0], [0x60, 0x03, 0x10, 0, 0, 0, 0, 0]),
        (read(0x1003, 0), [0x4F, 0x03, 0x10, 0, 0, 0, 0, 0]),
        (read(0x1003, 1), [0x80, 0x03, 0x10, 1, 0x24, 0x00, 0x00, 0x08]),
    ]);
}

#[test]
fn errors_go_as_they_came() {
    let mut bench = Bench::new();
    bench.sent();
    let errors = &mut bench.application.0;
    errors.raise(code::HARDWARE, register::MANUFACTURER, [0; 5]);
    errors.raise(code::CAN_PASSIVE, register::COMMUNICATION, [0; 5]);
    errors.clear(register::COMMUNICATION);
    errors.clear(register::COMMUNICATION);
    assert_eq!(
        bench.sent(),
        [
            emergency([0x00, 0x50, 0x81, 0, 0, 0, 0, 0]),
            emergency([0x20, 0x81, 0x91, 0, 0, 0, 0, 0]),
            emergency([0x00, 0x00, 0x81, 0, 0, 0, 0, 0]),
        ]
    );
    let errors = &mut bench.application.0;
    errors.clear(register::MANUFACTURER);
    assert_eq!(errors.register(), 0);
    // A generic error.
    errors.raise(code::GENERIC, 0, [0; 5]);
    errors.clear(register::GENERIC);
    assert_eq!(
        bench.sent(),
        [
            emergency([0x00, 0x00, 0x00, 0, 0, 0, 0, 0]),
            emergency([0x00, 0x10, 0x01, 0, 0, 0, 0, 0]),
            emergency([0x00, 0x00, 0x00, 0, 0, 0, 0, 0]),
        ]
    );
    bench.application.0.clear(0xFF);
    assert_eq!(bench.sent(), []);
}

#[test]
fn an_announcement_is_no_error() {
    let mut bench = Bench::new();
    bench.sent();
    bench.application.0.announce(0xFF00, [0x80, 0, 0, 0, 0]);
    assert_eq!(bench.sent(), [emergency([0x00, 0xFF, 0x00, 0x80, 0, 0, 0, 0])]);
    bench.expect(&[(read(0x1003, 0), [0x4F, 0x03, 0x10, 0, 0, 0, 0, 0])]);
    assert_eq!(
        Emergency::parse(&[0x10, 0x81, 0x91, 0, 0, 0x20, 0x10, 0]),
        Emergency { code: 0x8110, register: 0x91, detail: [0, 0, 0x20, 0x10, 0] }
    );
}

#[test]
fn a_stopped_node_keeps_its_emergencies() {
    let mut bench = Bench::new();
    bench.sent();
    let stop = NmtCommand::Stop.emit(None);
    bench.node.handle(&stop, at(0), &mut bench.application);
    for number in 1..=6 {
        bench.application.0.raise(0x1000 + number, 0, [0; 5]);
    }
    assert_eq!(bench.sent(), []);
    let start = NmtCommand::Start.emit(None);
    bench.node.handle(&start, at(0), &mut bench.application);
    // The first four, in their order; 1003h contains the latest.
    let first_four: Vec<_> = (1..=4).map(|number| emergency([number, 0x10, 0x01, 0, 0, 0, 0, 0])).collect();
    assert_eq!(bench.sent(), first_four);
}

/// CiA 301 table 51: bit 0 is set with each of the others, and stays when it is reported by itself.
#[test]
fn the_generic_bit_is_set_with_each_error() {
    for bits in [0, register::GENERIC, register::COMMUNICATION, register::GENERIC | register::MANUFACTURER] {
        let mut emcy = Emcy::new();
        emcy.raise(code::GENERIC, bits, [0; 5]);
        assert_eq!(emcy.register(), bits | 1, "{bits:#x}");
    }
}

/// Events of the line: lost frames and bus-off have ended when they are reported, error passive has
/// not.
#[test]
fn events_of_the_line_are_errors_that_end() {
    use canopen::line::LineEvent;
    for (event, code, stays) in [
        (LineEvent::Passive, 0x8120, true),
        (LineEvent::Lost(0x1234), 0x8110, false),
        (LineEvent::Recovered, 0x8140, false),
    ] {
        let mut emcy = Emcy::new();
        emcy.line_event(event);
        let told = emcy.next_message().map(|bytes| Emergency::parse(&bytes)).unwrap();
        assert_eq!((told.code, told.register), (code, 0x11), "{event:?}");
        assert_eq!(emcy.register(), if stays { 0x11 } else { 0 }, "{event:?}");
        emcy.line_event(LineEvent::Active);
        let ended = emcy.next_message().map(|bytes| Emergency::parse(&bytes)).unwrap();
        assert_eq!((ended.code, ended.register, emcy.next_message()), (0, 0, None), "{event:?}");
        // 1003h keeps it; the places after it are empty.
        let mut bytes = [0; 4];
        assert_eq!(emcy.read(node(), Address::new(0x1003, 1), &mut bytes), Some(Ok(4)));
        assert_eq!(bytes[..2], code.to_le_bytes());
        let empty = emcy.read(node(), Address::new(0x1003, 2), &mut bytes);
        assert_eq!(empty, Some(Err(AbortCode(0x0800_0024))));
    }
}
