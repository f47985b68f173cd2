//! The SDO server against frames written by hand from CiA 301 section 7.2.4.3.

use canopen::sdo::server::{Config, SdoServer, VALUE_MAX};
use canopen::{AbortCode, CobId, Frame, Objects};
use embedded_can::{ExtendedId, Frame as _, StandardId};
use kit::bus::{at, node, request, response, Bench, Device, Event};

fn bench() -> Bench {
    Bench::with(Config { timeout_ms: 1000, ..Config::default() })
}

/// One request, one answer.
trait Dialogue {
    fn answer(&mut self, bytes: [u8; 8]) -> Option<[u8; 8]>;
    fn expect(&mut self, dialogue: &[([u8; 8], [u8; 8])]);
}

impl Dialogue for Bench {
    /// The single answer to a request, or none.
    fn answer(&mut self, bytes: [u8; 8]) -> Option<[u8; 8]> {
        self.send(&request(bytes));
        let answer = self.poll();
        assert_eq!(self.poll(), None);
        answer.map(|frame| {
            assert_eq!(frame.cob_id(), Some(CobId::sdo_response(node())));
            *frame.exactly().unwrap()
        })
    }

    #[track_caller]
    fn expect(&mut self, dialogue: &[([u8; 8], [u8; 8])]) {
        for (asked, answered) in dialogue {
            assert_eq!(self.answer(*asked), Some(*answered), "answer to {asked:02X?}");
        }
    }
}

/// These two frames are the ends of a service that works: a test shows with them that the server
/// still works.
#[track_caller]
fn still_serves(bench: &mut Bench) {
    bench.expect(&[([0x40, 0x00, 0x10, 0, 0, 0, 0, 0], [0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10])]);
    assert!(bench.server.is_idle());
}

#[test]
fn uploads_expedited() {
    let mut bench = bench();
    bench.device.heartbeat = 0x0102;
    bench.device.control = 0xA5;
    bench.expect(&[
        ([0x40, 0x00, 0x10, 0, 0, 0, 0, 0], [0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10]),
        ([0x40, 0x18, 0x10, 1, 0, 0, 0, 0], [0x43, 0x18, 0x10, 1, 0x04, 0x03, 0x02, 0x01]),
        ([0x40, 0x17, 0x10, 0, 0, 0, 0, 0], [0x4B, 0x17, 0x10, 0, 0x02, 0x01, 0, 0]),
        ([0x40, 0x51, 0x1F, 1, 0, 0, 0, 0], [0x4F, 0x51, 0x1F, 1, 0xA5, 0, 0, 0]),
        // The head of a record, answered from the table.
        ([0x40, 0x18, 0x10, 0, 0, 0, 0, 0], [0x4F, 0x18, 0x10, 0, 0x04, 0, 0, 0]),
    ]);
    // Three bytes: a string.
    bench.device.text = b"abc".to_vec();
    bench.expect(&[([0x40, 0x01, 0x20, 0, 0, 0, 0, 0], [0x47, 0x01, 0x20, 0, b'a', b'b', b'c', 0])]);
    assert!(bench.server.is_idle());
}

#[test]
fn downloads_expedited() {
    let mut bench = bench();
    bench.expect(&[
        ([0x2F, 0x51, 0x1F, 1, 0x83, 0, 0, 0], [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
        ([0x2B, 0x17, 0x10, 0, 0xE8, 0x03, 0, 0], [0x60, 0x17, 0x10, 0, 0, 0, 0, 0]),
        ([0x23, 0x02, 0x20, 0, 1, 2, 3, 4], [0x60, 0x02, 0x20, 0, 0, 0, 0, 0]),
    ]);
    assert_eq!((bench.device.control, bench.device.heartbeat), (0x83, 1000));
    // Unknown size (s = 0): the type's size is used, here 1 and 2 bytes.
    bench.expect(&[
        ([0x22, 0x51, 0x1F, 1, 0x02, 9, 9, 9], [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
        ([0x22, 0x17, 0x10, 0, 0x0A, 0x00, 9, 9], [0x60, 0x17, 0x10, 0, 0, 0, 0, 0]),
    ]);
    assert_eq!((bench.device.control, bench.device.heartbeat), (0x02, 10));
    // A domain of two bytes.
    bench.expect(&[([0x2B, 0x50, 0x1F, 1, 7, 8, 0, 0], [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0])]);
    assert_eq!(bench.device.events, [Event::Start(Some(2)), Event::End(vec![7, 8])]);
}

#[test]
fn uploads_segmented() {
    let mut bench = bench();
    // "coboot bootloader": 17 bytes = 7 + 7 + 3.
    bench.expect(&[
        ([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], [0x41, 0x08, 0x10, 0, 17, 0, 0, 0]),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], [0x00, b'c', b'o', b'b', b'o', b'o', b't', b' ']),
        ([0x70, 0, 0, 0, 0, 0, 0, 0], [0x10, b'b', b'o', b'o', b't', b'l', b'o', b'a']),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], [0x09, b'd', b'e', b'r', 0, 0, 0, 0]),
    ]);
    assert!(bench.server.is_idle());
    // A value of eight bytes, and an empty string.
    bench.device.long = 0x0807_0605_0403_0201;
    bench.expect(&[
        ([0x40, 0x03, 0x20, 0, 0, 0, 0, 0], [0x41, 0x03, 0x20, 0, 8, 0, 0, 0]),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], [0x00, 1, 2, 3, 4, 5, 6, 7]),
        ([0x70, 0, 0, 0, 0, 0, 0, 0], [0x1D, 8, 0, 0, 0, 0, 0, 0]),
        ([0x40, 0x01, 0x20, 0, 0, 0, 0, 0], [0x41, 0x01, 0x20, 0, 0, 0, 0, 0]),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], [0x0F, 0, 0, 0, 0, 0, 0, 0]),
    ]);
}

#[test]
fn uploads_a_domain_with_and_without_its_size() {
    let mut bench = bench();
    bench.device.domain = (1..=14).collect();
    bench.device.tells_size = true;
    bench.expect(&[
        ([0x40, 0x00, 0x20, 0, 0, 0, 0, 0], [0x41, 0x00, 0x20, 0, 14, 0, 0, 0]),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], [0x00, 1, 2, 3, 4, 5, 6, 7]),
        ([0x70, 0, 0, 0, 0, 0, 0, 0], [0x11, 8, 9, 10, 11, 12, 13, 14]),
    ]);
    assert!(bench.server.is_idle());
    // Without a size the end is known only when no more bytes come: an empty last segment.
    bench.device.tells_size = false;
    bench.expect(&[
        ([0x40, 0x00, 0x20, 0, 0, 0, 0, 0], [0x40, 0x00, 0x20, 0, 0, 0, 0, 0]),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], [0x00, 1, 2, 3, 4, 5, 6, 7]),
        ([0x70, 0, 0, 0, 0, 0, 0, 0], [0x10, 8, 9, 10, 11, 12, 13, 14]),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], [0x0F, 0, 0, 0, 0, 0, 0, 0]),
    ]);
    assert!(bench.server.is_idle());
}

#[test]
fn downloads_segmented() {
    let mut bench = bench();
    bench.expect(&[
        ([0x21, 0x50, 0x1F, 1, 9, 0, 0, 0], [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0]),
        ([0x00, 1, 2, 3, 4, 5, 6, 7], [0x20, 0, 0, 0, 0, 0, 0, 0]),
        ([0x1B, 8, 9, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0]),
    ]);
    assert_eq!(bench.device.events, [Event::Start(Some(9)), Event::End((1..=9).collect())]);
    assert!(bench.server.is_idle());
    // Unknown size.
    bench.device.events.clear();
    bench.expect(&[
        ([0x20, 0x50, 0x1F, 1, 0, 0, 0, 0], [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0]),
        ([0x01, 1, 2, 3, 4, 5, 6, 7], [0x20, 0, 0, 0, 0, 0, 0, 0]),
    ]);
    assert_eq!(bench.device.events, [Event::Start(None), Event::End((1..=7).collect())]);
    // A string and a long number use the same service.
    bench.expect(&[
        ([0x21, 0x01, 0x20, 0, 8, 0, 0, 0], [0x60, 0x01, 0x20, 0, 0, 0, 0, 0]),
        ([0x00, b'a', b'b', b'c', b'd', b'e', b'f', b'g'], [0x20, 0, 0, 0, 0, 0, 0, 0]),
        ([0x1D, b'h', 0, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0]),
        ([0x20, 0x03, 0x20, 0, 0, 0, 0, 0], [0x60, 0x03, 0x20, 0, 0, 0, 0, 0]),
        ([0x00, 8, 7, 6, 5, 4, 3, 2], [0x20, 0, 0, 0, 0, 0, 0, 0]),
        ([0x1D, 1, 0, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0]),
    ]);
    assert_eq!(bench.device.text, b"abcdefgh");
    assert_eq!(bench.device.long, 0x0102_0304_0506_0708);
}

/// Every access that the table forbids, with its code from CiA 301 table 22.
#[test]
fn refuses_what_the_table_does_not_allow() {
    #[rustfmt::skip]
    let refusals = [
        // No such object, by upload and download.
        ([0x40, 0x34, 0x12, 0, 0, 0, 0, 0], [0x80, 0x34, 0x12, 0, 0x00, 0x00, 0x02, 0x06]),
        ([0x2F, 0x34, 0x12, 0, 1, 0, 0, 0], [0x80, 0x34, 0x12, 0, 0x00, 0x00, 0x02, 0x06]),
        // No such sub-index.
        ([0x40, 0x18, 0x10, 5, 0, 0, 0, 0], [0x80, 0x18, 0x10, 5, 0x11, 0x00, 0x09, 0x06]),
        ([0x2F, 0x51, 0x1F, 2, 1, 0, 0, 0], [0x80, 0x51, 0x1F, 2, 0x11, 0x00, 0x09, 0x06]),
        // Write of const, const head, read of wo.
        ([0x23, 0x00, 0x10, 0, 1, 0, 0, 0], [0x80, 0x00, 0x10, 0, 0x02, 0x00, 0x01, 0x06]),
        ([0x2F, 0x50, 0x1F, 0, 1, 0, 0, 0], [0x80, 0x50, 0x1F, 0, 0x02, 0x00, 0x01, 0x06]),
        ([0x21, 0x00, 0x10, 0, 4, 0, 0, 0], [0x80, 0x00, 0x10, 0, 0x02, 0x00, 0x01, 0x06]),
        ([0x40, 0x50, 0x1F, 1, 0, 0, 0, 0], [0x80, 0x50, 0x1F, 1, 0x01, 0x00, 0x01, 0x06]),
        ([0x40, 0x02, 0x20, 0, 0, 0, 0, 0], [0x80, 0x02, 0x20, 0, 0x01, 0x00, 0x01, 0x06]),
        // Too long, too short; expedited and announced.
        ([0x2B, 0x51, 0x1F, 1, 1, 0, 0, 0], [0x80, 0x51, 0x1F, 1, 0x12, 0x00, 0x07, 0x06]),
        ([0x2F, 0x17, 0x10, 0, 1, 0, 0, 0], [0x80, 0x17, 0x10, 0, 0x13, 0x00, 0x07, 0x06]),
        ([0x21, 0x17, 0x10, 0, 3, 0, 0, 0], [0x80, 0x17, 0x10, 0, 0x12, 0x00, 0x07, 0x06]),
        ([0x21, 0x03, 0x20, 0, 7, 0, 0, 0], [0x80, 0x03, 0x20, 0, 0x13, 0x00, 0x07, 0x06]),
        ([0x22, 0x03, 0x20, 0, 1, 2, 3, 4], [0x80, 0x03, 0x20, 0, 0x13, 0x00, 0x07, 0x06]),
        ([0x21, 0x01, 0x20, 0, TOO_LONG, 0, 0, 0], [0x80, 0x01, 0x20, 0, 0x12, 0x00, 0x07, 0x06]),
        // A value that the device refuses: 06090030h.
        ([0x2F, 0x51, 0x1F, 1, 0x7F, 0, 0, 0], [0x80, 0x51, 0x1F, 1, 0x30, 0x00, 0x09, 0x06]),
    ];
    for refusal in refusals {
        let mut bench = bench();
        bench.expect(&[refusal]);
        assert!(bench.server.is_idle());
        assert_eq!(bench.device.events, []);
        still_serves(&mut bench);
    }
}

/// A dialogue that ends in an abort, and the calls to the domain's receiver.
#[track_caller]
fn breaks(dialogue: &[([u8; 8], [u8; 8])], events: &[Event]) {
    let mut bench = bench();
    bench.expect(dialogue);
    assert_eq!(bench.device.events, events);
    still_serves(&mut bench);
}

/// The bytes of a string that is too long (the feature `sealed` increases the limit).
const TOO_LONG: u8 = VALUE_MAX as u8 + 1;

const START_9: ([u8; 8], [u8; 8]) = ([0x21, 0x50, 0x1F, 1, 9, 0, 0, 0], [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0]);
const FIRST: ([u8; 8], [u8; 8]) = ([0x00, 1, 2, 3, 4, 5, 6, 7], [0x20, 0, 0, 0, 0, 0, 0, 0]);

#[test]
fn a_toggle_bit_that_does_not_alternate_aborts() {
    let toggle = [0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x03, 0x05];
    let cancelled = [Event::Start(Some(9)), Event::Cancel];
    breaks(&[START_9, ([0x10, 1, 2, 3, 4, 5, 6, 7], toggle)], &cancelled);
    breaks(&[START_9, FIRST, (FIRST.0, toggle)], &cancelled);
    breaks(
        &[
            ([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], [0x41, 0x08, 0x10, 0, 17, 0, 0, 0]),
            ([0x70, 0, 0, 0, 0, 0, 0, 0], [0x80, 0x08, 0x10, 0, 0x00, 0x00, 0x03, 0x05]),
        ],
        &[],
    );
}

#[test]
fn sizes_that_do_not_match_abort() {
    let length = [0x80, 0x50, 0x1F, 1, 0x10, 0x00, 0x07, 0x06];
    let cancelled = [Event::Start(Some(9)), Event::Cancel];
    // 8 of 9 bytes, then the end; 10 of 9 bytes.
    breaks(&[START_9, FIRST, ([0x1D, 8, 0, 0, 0, 0, 0, 0], length)], &cancelled);
    breaks(&[START_9, FIRST, ([0x18, 8, 9, 10, 0, 0, 0, 0], length)], &cancelled);
    // Without an announced size, and with the wrong size for the type.
    let start_long = ([0x20, 0x03, 0x20, 0, 0, 0, 0, 0], [0x60, 0x03, 0x20, 0, 0, 0, 0, 0]);
    let too_low = [0x80, 0x03, 0x20, 0, 0x13, 0x00, 0x07, 0x06];
    let too_high = [0x80, 0x03, 0x20, 0, 0x12, 0x00, 0x07, 0x06];
    breaks(&[start_long, ([0x01, 1, 2, 3, 4, 5, 6, 7], too_low)], &[]);
    breaks(&[start_long, FIRST, ([0x1B, 8, 9, 0, 0, 0, 0, 0], too_high)], &[]);
    // A string without an announced size that grows beyond every limit.
    let start = ([0x20, 0x01, 0x20, 0, 0, 0, 0, 0], [0x60, 0x01, 0x20, 0, 0, 0, 0, 0]);
    let mut dialogue = vec![start];
    let fits = TOO_LONG / 7;
    for i in 0..fits {
        let toggle = (i % 2) << 4;
        dialogue.push(([toggle, 1, 2, 3, 4, 5, 6, 7], [0x20 | toggle, 0, 0, 0, 0, 0, 0, 0]));
    }
    dialogue.push(([(fits % 2) << 4, 1, 2, 3, 4, 5, 6, 7], [0x80, 0x01, 0x20, 0, 0x12, 0x00, 0x07, 0x06]));
    breaks(&dialogue, &[]);
}

#[test]
fn commands_out_of_place_or_unknown_abort() {
    let unknown = |index: u16, sub| {
        let [low, high] = index.to_le_bytes();
        [0x80, low, high, sub, 0x01, 0x00, 0x04, 0x05]
    };
    // ccs 7 is undefined; segments without a transfer. The abort has the multiplexor of its request (CiA 301
    // clause 7.2.4.3.17), and these have none: not that of the transfer before, which has ended.
    let read = ([0x40, 0x18, 0x10, 1, 0, 0, 0, 0], [0x43, 0x18, 0x10, 1, 0x04, 0x03, 0x02, 0x01]);
    for command in [0xE0, 0x00, 0x60, 0xA1, 0xA2, 0xA3, 0xC1] {
        breaks(&[read, ([command, 1, 2, 3, 4, 5, 6, 7], unknown(0, 0))], &[]);
    }
    // The segment of the other direction.
    let cancelled = [Event::Start(Some(9)), Event::Cancel];
    breaks(&[START_9, ([0x60, 0, 0, 0, 0, 0, 0, 0], unknown(0x1F50, 1))], &cancelled);
    breaks(&[START_9, ([0xFF, 0, 0, 0, 0, 0, 0, 0], unknown(0x1F50, 1))], &cancelled);
    breaks(
        &[
            ([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], [0x41, 0x08, 0x10, 0, 17, 0, 0, 0]),
            (FIRST.0, unknown(0x1008, 0)),
        ],
        &[],
    );
}

#[test]
fn an_abort_of_the_client_is_not_answered() {
    let mut bench = bench();
    assert_eq!(bench.answer([0x80, 0x50, 0x1F, 1, 0, 0, 0, 8]), None);
    bench.expect(&[START_9, FIRST]);
    assert_eq!(bench.answer([0x80, 0x50, 0x1F, 1, 0, 0, 0, 8]), None);
    assert_eq!(bench.device.events, [Event::Start(Some(9)), Event::Cancel]);
    bench.expect(&[([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], [0x41, 0x08, 0x10, 0, 17, 0, 0, 0])]);
    assert_eq!(bench.answer([0x80, 0x08, 0x10, 0, 0, 0, 0, 8]), None);
    still_serves(&mut bench);
}

#[test]
fn a_new_initiate_ends_the_old_transfer() {
    let mut bench = bench();
    bench.expect(&[START_9, FIRST]);
    still_serves(&mut bench);
    assert_eq!(bench.device.events, [Event::Start(Some(9)), Event::Cancel]);
    bench.device.events.clear();
    bench.expect(&[
        START_9,
        FIRST,
        START_9,
        FIRST,
        ([0x1B, 8, 9, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0]),
    ]);
    let nine = (1..=9).collect();
    assert_eq!(
        bench.device.events,
        [Event::Start(Some(9)), Event::Cancel, Event::Start(Some(9)), Event::End(nine)]
    );
}

#[test]
fn a_silent_client_is_aborted() {
    let mut bench = bench();
    bench.now = u32::MAX - 500;
    bench.expect(&[START_9, FIRST]);
    bench.now = bench.now.wrapping_add(999);
    assert_eq!(bench.poll(), None);
    bench.now = bench.now.wrapping_add(1);
    assert_eq!(bench.poll(), Some(response([0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x04, 0x05])));
    assert_eq!(bench.poll(), None);
    assert_eq!(bench.device.events, [Event::Start(Some(9)), Event::Cancel]);
    still_serves(&mut bench);
    // An upload has a time-out, too.
    bench.expect(&[([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], [0x41, 0x08, 0x10, 0, 17, 0, 0, 0])]);
    bench.now = bench.now.wrapping_add(1000);
    assert_eq!(bench.poll(), Some(response([0x80, 0x08, 0x10, 0, 0x00, 0x00, 0x04, 0x05])));
}

#[test]
fn the_consumer_has_the_last_word() {
    let mut bench = bench();
    bench.device.refuse_end = Some(AbortCode::HARDWARE);
    let hardware = [0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x06, 0x06];
    bench.expect(&[START_9, FIRST, ([0x1B, 8, 9, 0, 0, 0, 0, 0], hardware)]);
    // The receiver has refused, so it needs no cancellation.
    assert_eq!(bench.device.events, [Event::Start(Some(9))]);
    still_serves(&mut bench);
}

#[test]
fn a_full_consumer_holds_the_answer_back() {
    let mut bench = bench();
    bench.device.space = Some(8);
    bench.expect(&[START_9]);
    assert_eq!(bench.answer(FIRST.0), None);
    bench.now = 900;
    bench.device.space = Some(7);
    assert_eq!(bench.poll(), Some(response(FIRST.1)));
    // The client's time starts with the answer.
    bench.now = 1899;
    bench.expect(&[([0x1B, 8, 9, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0])]);
    // A receiver that never finishes ends the client's transfer, but does not block the server.
    bench.device.space = Some(0);
    assert_eq!(bench.answer(START_9.0), None);
    bench.now += 1000;
    assert_eq!(bench.poll(), Some(response([0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x04, 0x05])));
    still_serves(&mut bench);
}

/// Slowed down, but not abandoned: a segment every 2 ms, until there is really no room.
#[test]
fn a_client_that_is_held_back_is_served_from_the_reserve() {
    let mut bench = bench();
    bench.device.space = Some(15);
    bench.device.reserve = 10;
    assert_eq!(bench.answer(START_9.0), None);
    bench.now += 1;
    assert_eq!(bench.poll(), None);
    bench.now += 1;
    assert_eq!(bench.poll(), Some(response(START_9.1)));
    assert_eq!(bench.answer(FIRST.0), None);
    bench.now += 2;
    assert_eq!(bench.poll(), Some(response(FIRST.1)), "8 bytes of the reserve are left");
    bench.expect(&[([0x1B, 8, 9, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0])]);
    // A sub-block from the reserve has one segment.
    bench.device.space = Some(100);
    bench.device.reserve = 100;
    assert_eq!(bench.answer([0xC0, 0x50, 0x1F, 1, 0, 0, 0, 0]), None);
    bench.now += 2;
    assert_eq!(bench.poll(), Some(response([0xA4, 0x50, 0x1F, 1, 1, 0, 0, 0])));
}

/// Found by fuzzing: the delayed answer did not slow down a client that did not wait for it.
#[test]
fn a_client_that_sends_regardless_of_room_is_refused() {
    let out_of_memory = [0x80, 0x50, 0x1F, 1, 0x05, 0x00, 0x04, 0x05];
    let mut bench = bench();
    bench.device.space = Some(8);
    bench.expect(&[START_9]);
    assert_eq!(bench.answer(FIRST.0), None);
    bench.expect(&[([0x1B, 8, 9, 0, 0, 0, 0, 0], out_of_memory)]);
    assert_eq!(bench.device.events.last(), Some(&Event::Cancel));
    bench.device.space = Some(3);
    bench.expect(&[([0x23, 0x50, 0x1F, 1, 1, 2, 3, 4], out_of_memory)]);
    assert_eq!(bench.device.events.last(), Some(&Event::Cancel));
    assert_eq!(bench.device.space, Some(3));
    bench.device.space = None;
    still_serves(&mut bench);
}

#[test]
fn what_is_no_sdo_gets_silence() {
    let mut bench = bench();
    let good = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
    let id = StandardId::new(0x605).unwrap();
    let others = [
        Frame::new(id, &good[..7]).unwrap(),
        Frame::new(id, &[]).unwrap(),
        Frame::new_remote(id, 8).unwrap(),
        Frame::new(ExtendedId::new(0x605).unwrap(), &good).unwrap(),
        Frame::new(StandardId::new(0x606).unwrap(), &good).unwrap(),
        Frame::new(StandardId::new(0x585).unwrap(), &good).unwrap(),
    ];
    bench.expect(&[START_9]);
    for frame in &others {
        bench.send(frame);
        assert_eq!(bench.poll(), None, "{frame}");
    }
    // The transfer was not affected.
    bench.expect(&[FIRST, ([0x1B, 8, 9, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0])]);
}

#[test]
fn reserved_bits_are_not_looked_at() {
    let mut bench = bench();
    bench.expect(&[
        ([0x5F, 0x00, 0x10, 0, 9, 9, 9, 9], [0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10]),
        ([0x3F, 0x51, 0x1F, 1, 0x01, 9, 9, 9], [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
    ]);
    assert_eq!(bench.device.control, 1);
}

/// A device with values that contradict its table.
#[test]
fn a_value_of_the_wrong_length_is_the_devices_fault() {
    struct Wrong(Device, usize);
    impl Objects for Wrong {
        fn entries(&self) -> &'static [canopen::od::Entry] {
            self.0.entries()
        }
        fn read(&mut self, _at: canopen::Address, _buf: &mut [u8]) -> Result<usize, AbortCode> {
            Ok(self.1)
        }
        fn upload_start(&mut self, _at: canopen::Address) -> Result<Option<u32>, AbortCode> {
            Ok(Some(8))
        }
        fn upload_data(
            &mut self,
            _at: canopen::Address,
            _offset: u32,
            _buf: &mut [u8],
        ) -> Result<usize, AbortCode> {
            Ok(self.1)
        }
    }
    let mut server = SdoServer::new(node(), Config::default());
    let mut device = Wrong(Device::default(), 0);
    for (len, asked, answered) in [
        (usize::MAX, [0x40, 0x00, 0x10, 0, 0, 0, 0, 0], [0x80, 0x00, 0x10, 0, 0x47, 0x00, 0x04, 0x06]),
        (usize::MAX, [0x40, 0x01, 0x20, 0, 0, 0, 0, 0], [0x80, 0x01, 0x20, 0, 0x47, 0x00, 0x04, 0x06]),
        (usize::MAX, [0x40, 0x00, 0x20, 0, 0, 0, 0, 0], [0x41, 0x00, 0x20, 0, 8, 0, 0, 0]),
        (usize::MAX, [0x60, 0, 0, 0, 0, 0, 0, 0], [0x00; 8]),
        (usize::MAX, [0x70, 0, 0, 0, 0, 0, 0, 0], [0x1D, 0, 0, 0, 0, 0, 0, 0]),
        // Three bytes of an Unsigned32; a domain that ends before its announced size.
        (3, [0x40, 0x00, 0x10, 0, 0, 0, 0, 0], [0x80, 0x00, 0x10, 0, 0x47, 0x00, 0x04, 0x06]),
        (3, [0x40, 0x00, 0x20, 0, 0, 0, 0, 0], [0x41, 0x00, 0x20, 0, 8, 0, 0, 0]),
        (3, [0x60, 0, 0, 0, 0, 0, 0, 0], [0x80, 0x00, 0x20, 0, 0x47, 0x00, 0x04, 0x06]),
    ] {
        device.1 = len;
        server.handle(&request(asked), at(0), &mut device);
        let answer = server.poll(at(0), &mut device).unwrap();
        assert_eq!(answer.exactly(), Some(&answered), "{len} bytes, {asked:02X?}");
    }
}

/// The longest value fills the server's room.
#[test]
fn a_value_of_the_greatest_length_is_read() {
    let mut bench = bench();
    bench.device.text = vec![b'x'; VALUE_MAX];
    let answer = bench.answer([0x40, 0x01, 0x20, 0, 0, 0, 0, 0]);
    assert_eq!(answer, Some([0x41, 0x01, 0x20, 0, VALUE_MAX as u8, 0, 0, 0]));
}

/// The confirmation of an expedited download names the object alone (CiA 301 clause 7.2.4.3.3), so
/// that another program can send it in this one's place. Those of segments and blocks belong to the
/// transfer.
#[test]
fn a_device_may_leave_the_confirmation_of_an_expedited_download_to_another_program() {
    let mut bench = bench();
    bench.device.withholds = true;
    assert!(bench.server.is_idle() && !bench.server.has_answer());
    // Nor is an answer sent that waits from before: its client has asked again.
    bench.send(&request([0x40, 0x00, 0x10, 0, 0, 0, 0, 0]));
    assert!(!bench.server.is_idle() && bench.server.has_answer());
    assert_eq!(bench.answer([0x2F, 0x51, 0x1F, 1, 0x83, 0, 0, 0]), None);
    assert!(bench.server.is_idle() && bench.device.control == 0x83);
    bench.expect(&[
        // A refusal is the object's own.
        ([0x2F, 0x51, 0x1F, 1, 0x7F, 0, 0, 0], [0x80, 0x51, 0x1F, 1, 0x30, 0, 0x09, 0x06]),
        ([0x21, 0x51, 0x1F, 1, 1, 0, 0, 0], [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
        ([0x0D, 0x84, 0, 0, 0, 0, 0, 0], [0x20, 0, 0, 0, 0, 0, 0, 0]),
        ([0xC2, 0x51, 0x1F, 1, 1, 0, 0, 0], [0xA4, 0x51, 0x1F, 1, 127, 0, 0, 0]),
        ([0x81, 0x85, 0, 0, 0, 0, 0, 0], [0xA2, 1, 127, 0, 0, 0, 0, 0]),
        ([0xD9, 0, 0, 0, 0, 0, 0, 0], [0xA1, 0, 0, 0, 0, 0, 0, 0]),
    ]);
    assert_eq!(bench.device.control, 0x85);
    // What ends a download that stands still is taken after a pause, by a poll.
    bench.expect(&[([0xC0, 0x00, 0x20, 0, 0, 0, 0, 0], [0xA4, 0x00, 0x20, 0, 127, 0, 0, 0])]);
    assert_eq!(bench.answer([1, 0, 0, 0, 0, 0, 0, 0]), None);
    assert_eq!(bench.answer([0x2F, 0x51, 0x1F, 1, 0x83, 0, 0, 0]), None);
    bench.now += 250;
    assert_eq!((bench.poll(), bench.device.control), (None, 0x83));
    // A transfer that goes on is no idleness, although no answer waits.
    bench.device.text = vec![b'x'; 20];
    assert!(bench.answer([0x40, 0x01, 0x20, 0, 0, 0, 0, 0]).is_some());
    assert!(!bench.server.is_idle() && !bench.server.has_answer());
    assert_eq!(bench.answer([0x80, 0x01, 0x20, 0, 0, 0, 0, 0]), None);
    still_serves(&mut bench);
}
