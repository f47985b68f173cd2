//! SDO block transfer, both ends, against frames written by hand from CiA 301 section 7.2.4.3.9 ff.

use canopen::sdo::client::{Block, Buffer, Config, Download, SdoError, Step, Transfer, Upload};
use canopen::sdo::server::Config as ServerConfig;
use canopen::{AbortCode, Address};
use kit::bus::{at, node, request, response, Bench, Event};
use kit::crc::crc16;

/// CRC of the bytes 1 to 9 (polynomial 1021h, start 0), from an independent calculation:
/// `python3 -c "import binascii; print(hex(binascii.crc_hqx(bytes(range(1, 10)), 0)))"`.
const CRC_9: [u8; 2] = [CRC_1_TO_9 as u8, (CRC_1_TO_9 >> 8) as u8];
const CRC_1_TO_9: u16 = 0x2378;
/// The CRC of the bytes 1 to 14, computed in the same way.
const CRC_14: [u8; 2] = [CRC_1_TO_14 as u8, (CRC_1_TO_14 >> 8) as u8];
const CRC_1_TO_14: u16 = 0x9B92;

fn bench(blksize: u8) -> Bench {
    Bench::with(ServerConfig {
        timeout_ms: 1000,
        pause_ms: 300,
        last_pause_ms: 300,
        blksize,
        ..ServerConfig::DEFAULT
    })
}

/// Requests with all their answers.
trait Dialogue {
    fn expect(&mut self, dialogue: &[([u8; 8], &[[u8; 8]])]);
    fn still_serves(&mut self);
}

impl Dialogue for Bench {
    #[track_caller]
    fn expect(&mut self, dialogue: &[([u8; 8], &[[u8; 8]])]) {
        for (asked, answered) in dialogue {
            let answered: Vec<_> = answered.iter().map(|bytes| response(*bytes)).collect();
            assert_eq!(self.ask(*asked), answered, "answers to {asked:02X?}");
        }
    }

    #[track_caller]
    fn still_serves(&mut self) {
        self.expect(&[([0x40, 0x00, 0x10, 0, 0, 0, 0, 0], &[[0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10]])]);
        assert!(self.server.is_idle());
    }
}

const INITIATE_9: [u8; 8] = [0xC6, 0x50, 0x1F, 1, 9, 0, 0, 0];
const FIRST: [u8; 8] = [0x01, 1, 2, 3, 4, 5, 6, 7];
const LAST_OF_9: [u8; 8] = [0x82, 8, 9, 0, 0, 0, 0, 0];
const END_OF_9: [u8; 8] = [0xD5, CRC_9[0], CRC_9[1], 0, 0, 0, 0, 0];
const ENDED: [u8; 8] = [0xA1, 0, 0, 0, 0, 0, 0, 0];

fn granted(blksize: u8) -> [u8; 8] {
    [0xA4, 0x50, 0x1F, 1, blksize, 0, 0, 0]
}

fn acked(ackseq: u8, blksize: u8) -> [u8; 8] {
    [0xA2, ackseq, blksize, 0, 0, 0, 0, 0]
}

fn nine() -> Vec<u8> {
    (1..=9).collect()
}

#[test]
fn server_takes_a_block_download() {
    let mut bench = bench(127);
    bench.expect(&[
        (INITIATE_9, &[granted(127)]),
        (FIRST, &[]),
        (LAST_OF_9, &[acked(2, 127)]),
        (END_OF_9, &[ENDED]),
    ]);
    assert_eq!(bench.device.events, [Event::Start(Some(9)), Event::End(nine())]);
    bench.still_serves();
    // Unknown size, and no CRC on the client's side.
    bench.device.events.clear();
    bench.expect(&[
        ([0xC0, 0x50, 0x1F, 1, 0, 0, 0, 0], &[granted(127)]),
        ([0x81, 1, 2, 3, 4, 5, 6, 7], &[acked(1, 127)]),
        ([0xC1, 0, 0, 0, 0, 0, 0, 0], &[ENDED]),
    ]);
    assert_eq!(bench.device.events, [Event::Start(None), Event::End((1..=7).collect())]);
    // A variable and a string can also be transferred this way.
    bench.expect(&[
        ([0xC2, 0x17, 0x10, 0, 2, 0, 0, 0], &[[0xA4, 0x17, 0x10, 0, 127, 0, 0, 0]]),
        ([0x81, 0xE8, 0x03, 0, 0, 0, 0, 0], &[acked(1, 127)]),
        ([0xD5, 0, 0, 0, 0, 0, 0, 0], &[ENDED]),
    ]);
    assert_eq!(bench.device.heartbeat, 1000);
    // No data at all.
    bench.expect(&[
        ([0xC2, 0x01, 0x20, 0, 0, 0, 0, 0], &[[0xA4, 0x01, 0x20, 0, 127, 0, 0, 0]]),
        ([0x81, 0, 0, 0, 0, 0, 0, 0], &[acked(1, 127)]),
        ([0xDD, 0, 0, 0, 0, 0, 0, 0], &[ENDED]),
    ]);
    assert!(bench.device.text.is_empty());
}

#[test]
fn server_asks_again_for_what_was_lost() {
    let mut bench = bench(3);
    let segment = |seqno: u8, first: u8| {
        let mut bytes = [seqno, 0, 0, 0, 0, 0, 0, 0];
        bytes[1..].iter_mut().zip(first..).for_each(|(byte, value)| *byte = value);
        bytes
    };
    bench.expect(&[
        ([0xC2, 0x50, 0x1F, 1, 28, 0, 0, 0], &[granted(3)]),
        (segment(1, 1), &[]),
        // Number 2 is lost.
        (segment(3, 15), &[acked(1, 3)]),
        (segment(1, 8), &[]),
        // A duplicate has no effect.
        (segment(1, 8), &[]),
        (segment(2, 15), &[]),
        (segment(0x83, 22), &[acked(3, 3)]),
        // The last segment twice, where the end is expected.
        (segment(0x83, 22), &[]),
        ([0xC1, 0, 0, 0, 0, 0, 0, 0], &[ENDED]),
    ]);
    assert_eq!(bench.device.domain, (1..=28).collect::<Vec<u8>>());
}

#[test]
fn server_acknowledges_a_sub_block_that_stops_short() {
    let mut bench = bench(127);
    bench.expect(&[(INITIATE_9, &[granted(127)])]);
    // No segment arrived: the client has its reasons, or its own time-out.
    bench.now += 900;
    assert_eq!(bench.sent(), []);
    bench.expect(&[(FIRST, &[])]);
    bench.now += 299;
    assert_eq!(bench.sent(), []);
    bench.now += 1;
    assert_eq!(bench.sent(), [response(acked(1, 127))]);
    // Only once; then the time-out counts from there.
    bench.now += 999;
    assert_eq!(bench.sent(), []);
    bench.expect(&[([0x81, 8, 9, 0, 0, 0, 0, 0], &[acked(1, 127)]), (END_OF_9, &[ENDED])]);
    assert_eq!(bench.device.domain, nine());
    // A client that does not return.
    bench.expect(&[(INITIATE_9, &[granted(127)]), (FIRST, &[])]);
    bench.now += 300;
    assert_eq!(bench.sent(), [response(acked(1, 127))]);
    bench.now += 1000;
    assert_eq!(bench.sent(), [response([0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x04, 0x05])]);
    assert_eq!(bench.device.events.last(), Some(&Event::Cancel));
    bench.still_serves();
}

#[test]
fn server_grants_what_the_consumer_has_room_for() {
    let mut bench = bench(127);
    bench.device.space = Some(6);
    bench.expect(&[(INITIATE_9, &[])]);
    // A segment before the grant does not belong to this sub-block.
    bench.expect(&[(FIRST, &[])]);
    bench.device.space = Some(13);
    assert_eq!(bench.sent(), [response(granted(1))]);
    bench.expect(&[(FIRST, &[])]);
    bench.device.space = Some(20);
    assert_eq!(bench.sent(), [response(acked(1, 2))]);
    // The last segment needs room only for itself.
    bench.expect(&[([0x81, 8, 9, 0, 0, 0, 0, 0], &[acked(1, 127)])]);
    bench.expect(&[(END_OF_9, &[ENDED])]);
    assert_eq!(bench.device.domain, nine());
    assert_eq!(bench.device.space, Some(18));
}

/// A dialogue that ends in an abort after the domain has begun.
#[track_caller]
fn breaks(dialogue: &[([u8; 8], &[[u8; 8]])]) {
    let mut bench = bench(4);
    bench.expect(dialogue);
    assert_eq!(bench.device.events.last(), Some(&Event::Cancel));
    bench.still_serves();
}

#[test]
fn server_aborts_a_block_download_that_is_wrong() {
    let abort = |code: u32| {
        let [a, b, c, d] = code.to_le_bytes();
        [0x80, 0x50, 0x1F, 1, a, b, c, d]
    };
    let start: ([u8; 8], &[[u8; 8]]) = (INITIATE_9, &[granted(4)]);
    let last: ([u8; 8], &[[u8; 8]]) = (LAST_OF_9, &[acked(2, 4)]);
    // CRC.
    breaks(&[
        start,
        (FIRST, &[]),
        last,
        ([0xD5, CRC_9[0], CRC_9[1] ^ 1, 0, 0, 0, 0, 0], &[abort(0x0504_0004)]),
    ]);
    // Numbers: 0, and above the block size.
    breaks(&[start, ([0x00, 1, 2, 3, 4, 5, 6, 7], &[abort(0x0504_0003)])]);
    breaks(&[start, ([0x05, 1, 2, 3, 4, 5, 6, 7], &[abort(0x0504_0003)])]);
    // Sizes: more and fewer than announced. (n = 4 instead of 5; n = 6.)
    breaks(&[start, (FIRST, &[]), ([0x02, 8, 9, 10, 11, 12, 13, 14], &[abort(0x0607_0010)])]);
    let [low, high] = crc16(&[1, 2, 3, 4, 5, 6, 7, 8]).to_le_bytes();
    breaks(&[start, (FIRST, &[]), last, ([0xD9, low, high, 0, 0, 0, 0, 0], &[abort(0x0607_0010)])]);
    let [low, high] = crc16(&[1, 2, 3, 4, 5, 6, 7, 8, 9, 0]).to_le_bytes();
    breaks(&[start, (FIRST, &[]), last, ([0xD1, low, high, 0, 0, 0, 0, 0], &[abort(0x0607_0010)])]);
    // Another frame where the end is expected.
    breaks(&[start, (FIRST, &[]), last, ([0x60, 0, 0, 0, 0, 0, 0, 0], &[abort(0x0504_0001)])]);
    // The client aborts: no answer.
    let give_up: ([u8; 8], &[[u8; 8]]) = ([0x80, 0x50, 0x1F, 1, 0, 0, 0, 8], &[]);
    breaks(&[start, give_up]);
    breaks(&[start, (FIRST, &[]), give_up]);
    breaks(&[start, (FIRST, &[]), last, give_up]);
    // A new initiate where it can be recognised.
    let read: ([u8; 8], &[[u8; 8]]) =
        ([0x40, 0x00, 0x10, 0, 0, 0, 0, 0], &[[0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10]]);
    breaks(&[start, (FIRST, &[]), last, read]);
    // Refused before anything began.
    let mut bench = bench(4);
    bench.expect(&[
        ([0xC6, 0x00, 0x10, 0, 4, 0, 0, 0], &[[0x80, 0x00, 0x10, 0, 0x02, 0x00, 0x01, 0x06]]),
        ([0xC6, 0x34, 0x12, 0, 4, 0, 0, 0], &[[0x80, 0x34, 0x12, 0, 0x00, 0x00, 0x02, 0x06]]),
        ([0xC6, 0x17, 0x10, 0, 4, 0, 0, 0], &[[0x80, 0x17, 0x10, 0, 0x12, 0x00, 0x07, 0x06]]),
        (END_OF_9, &[[0x80, 0, 0, 0, 0x01, 0x00, 0x04, 0x05]]),
    ]);
    // The refusal of the receiver at the end.
    bench.device.refuse_end = Some(AbortCode::STORE);
    bench.expect(&[
        (INITIATE_9, &[granted(4)]),
        (FIRST, &[]),
        (LAST_OF_9, &[acked(2, 4)]),
        (END_OF_9, &[[0x80, 0x50, 0x1F, 1, 0x20, 0x00, 0x00, 0x08]]),
    ]);
    bench.still_serves();
}

/// A device whose domain has the bytes 1 to 14.
fn bench_with_14() -> Bench {
    let mut bench = bench(127);
    bench.device.domain = (1..=14).collect();
    bench.device.tells_size = true;
    bench
}

const READ_14: [u8; 8] = [0xA4, 0x00, 0x20, 0, 127, 0, 0, 0];
const START: [u8; 8] = [0xA3, 0, 0, 0, 0, 0, 0, 0];
const LAST_OF_14: [u8; 8] = [0x82, 8, 9, 10, 11, 12, 13, 14];
const END_OF_14: [u8; 8] = [0xC1, CRC_14[0], CRC_14[1], 0, 0, 0, 0, 0];

#[test]
fn server_gives_a_block_upload() {
    let mut bench = bench_with_14();
    bench.expect(&[
        (READ_14, &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]),
        (START, &[FIRST, LAST_OF_14]),
        (acked(2, 127), &[END_OF_14]),
        (ENDED, &[]),
    ]);
    assert!(bench.server.is_idle());
    // Unknown size: the end is known only when no more data come. Sub-blocks of one segment, then
    // of two.
    bench.device.tells_size = false;
    bench.expect(&[
        ([0xA4, 0x00, 0x20, 0, 1, 0, 0, 0], &[[0xC4, 0x00, 0x20, 0, 0, 0, 0, 0]]),
        (START, &[FIRST]),
        (acked(1, 2), &[[0x01, 8, 9, 10, 11, 12, 13, 14], [0x82, 0, 0, 0, 0, 0, 0, 0]]),
        (acked(2, 2), &[[0xDD, CRC_14[0], CRC_14[1], 0, 0, 0, 0, 0]]),
        (ENDED, &[]),
    ]);
    // A string: 17 bytes.
    bench.expect(&[
        ([0xA0, 0x08, 0x10, 0, 10, 0, 0, 0], &[[0xC6, 0x08, 0x10, 0, 17, 0, 0, 0]]),
        (
            START,
            &[
                [0x01, b'c', b'o', b'b', b'o', b'o', b't', b' '],
                [0x02, b'b', b'o', b'o', b't', b'l', b'o', b'a'],
                [0x83, b'd', b'e', b'r', 0, 0, 0, 0],
            ],
        ),
    ]);
    let [low, high] = crc16(b"coboot bootloader").to_le_bytes();
    bench.expect(&[(acked(3, 10), &[[0xD1, low, high, 0, 0, 0, 0, 0]]), (ENDED, &[])]);
    assert!(bench.server.is_idle());
}

#[test]
fn server_repeats_what_the_client_did_not_get() {
    let mut bench = bench_with_14();
    bench.expect(&[
        (READ_14, &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]),
        (START, &[FIRST, LAST_OF_14]),
        (acked(0, 127), &[FIRST, LAST_OF_14]),
        (acked(1, 127), &[[0x81, 8, 9, 10, 11, 12, 13, 14]]),
        // A segment that was sent three times counts once in the CRC.
        (acked(1, 127), &[END_OF_14]),
        (acked(1, 127), &[]),
        (ENDED, &[]),
    ]);
    assert!(bench.server.is_idle());
    // A client that reports a gap before the end of the sub-block: segment by segment.
    bench.expect(&[(READ_14, &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]])]);
    bench.server.handle(&request(START), at(0), &mut bench.device);
    assert_eq!(bench.server.poll(at(0), &mut bench.device), Some(response(FIRST)));
    bench.expect(&[(acked(0, 127), &[FIRST, LAST_OF_14])]);
    // The acknowledgement of the previous sub-block, twice: before the next one has begun, and
    // after.
    bench.expect(&[(READ_14, &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]), (START, &[FIRST, LAST_OF_14])]);
    for _ in 0..2 {
        bench.server.handle(&request(acked(0, 127)), at(0), &mut bench.device);
    }
    assert_eq!(bench.server.poll(at(0), &mut bench.device), Some(response(FIRST)));
    bench.expect(&[(acked(2, 127), &[LAST_OF_14])]);
}

#[test]
fn server_switches_the_protocol_below_the_threshold() {
    let mut bench = bench_with_14();
    bench.expect(&[
        ([0xA4, 0x00, 0x20, 0, 127, 13, 0, 0], &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]),
        ([0xA4, 0x00, 0x20, 0, 127, 14, 0, 0], &[[0x41, 0x00, 0x20, 0, 14, 0, 0, 0]]),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], &[[0x00, 1, 2, 3, 4, 5, 6, 7]]),
        ([0x70, 0, 0, 0, 0, 0, 0, 0], &[[0x11, 8, 9, 10, 11, 12, 13, 14]]),
        ([0xA4, 0x00, 0x10, 0, 127, 4, 0, 0], &[[0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10]]),
        // An empty value, without a protocol switch.
        ([0xA4, 0x01, 0x20, 0, 127, 0, 0, 0], &[[0xC6, 0x01, 0x20, 0, 0, 0, 0, 0]]),
        (START, &[[0x81, 0, 0, 0, 0, 0, 0, 0]]),
        (acked(1, 127), &[[0xDD, 0, 0, 0, 0, 0, 0, 0]]),
        (ENDED, &[]),
    ]);
}

#[test]
fn server_aborts_a_block_upload_that_is_wrong() {
    let abort = |code: u32| {
        let [a, b, c, d] = code.to_le_bytes();
        [0x80, 0x00, 0x20, 0, a, b, c, d]
    };
    let breaks = |dialogue: &[([u8; 8], &[[u8; 8]])]| {
        let mut bench = bench_with_14();
        bench.expect(dialogue);
        bench.still_serves();
    };
    let read: ([u8; 8], &[[u8; 8]]) = (READ_14, &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]);
    let start: ([u8; 8], &[[u8; 8]]) = (START, &[FIRST, LAST_OF_14]);
    // Invalid block sizes, at the beginning and later.
    breaks(&[([0xA4, 0x00, 0x20, 0, 0, 0, 0, 0], &[abort(0x0504_0002)])]);
    breaks(&[([0xA4, 0x00, 0x20, 0, 128, 0, 0, 0], &[abort(0x0504_0002)])]);
    breaks(&[read, start, (acked(2, 0), &[abort(0x0504_0002)])]);
    breaks(&[read, start, (acked(2, 128), &[abort(0x0504_0002)])]);
    // An acknowledgement of more than was sent.
    breaks(&[read, start, (acked(3, 127), &[abort(0x0504_0003)])]);
    // Commands in the wrong place.
    breaks(&[read, (acked(0, 127), &[abort(0x0504_0001)])]);
    breaks(&[read, (ENDED, &[abort(0x0504_0001)])]);
    breaks(&[read, start, (START, &[abort(0x0504_0001)])]);
    breaks(&[read, start, (ENDED, &[abort(0x0504_0001)])]);
    breaks(&[read, start, (FIRST, &[abort(0x0504_0001)])]);
    breaks(&[(START, &[[0x80, 0, 0, 0, 0x01, 0x00, 0x04, 0x05]])]);
    // The client aborts.
    let give_up: ([u8; 8], &[[u8; 8]]) = ([0x80, 0x00, 0x20, 0, 0, 0, 0, 8], &[]);
    breaks(&[read, give_up]);
    breaks(&[read, start, give_up]);
    breaks(&[read, start, (acked(2, 127), &[END_OF_14]), give_up]);
    // Silence, at every stage.
    for stage in 1..=3 {
        let mut bench = bench_with_14();
        bench.expect(&[read, start, (acked(2, 127), &[END_OF_14])][..stage]);
        bench.now += 1000;
        assert_eq!(bench.sent(), [response(abort(0x0504_0000))]);
        bench.still_serves();
    }
    // An object that cannot be read.
    let mut bench = bench(127);
    bench.expect(&[([0xA4, 0x50, 0x1F, 1, 127, 0, 0, 0], &[[0x80, 0x50, 0x1F, 1, 0x01, 0x00, 0x01, 0x06]])]);
}

// The client.

const CONFIG: Config = Config { timeout_ms: 1000 };
const BLOCK: Block = Block { blksize: 127, pst: 0, repeat_ms: 300 };
const PROGRAM: Address = Address::new(0x1F50, 1);
const DOMAIN: Address = Address::new(0x2000, 0);

/// The frames that it sends now, before it waits.
#[track_caller]
fn sends(client: &mut impl Transfer, now: u32, frames: &[[u8; 8]]) {
    for bytes in frames {
        assert_eq!(client.poll(at(now)), Step::Send(request(*bytes)));
    }
    assert!(matches!(client.poll(at(now)), Step::Wait(_)));
}

#[track_caller]
fn hears(client: &mut impl Transfer, now: u32, frames: &[[u8; 8]]) {
    for bytes in frames {
        client.handle(&response(*bytes), at(now));
    }
}

/// The frames that it sends, and the answers to them.
#[track_caller]
fn asks(client: &mut impl Transfer, now: u32, sent: &[[u8; 8]], heard: &[[u8; 8]]) {
    sends(client, now, sent);
    hears(client, now, heard);
}

#[track_caller]
fn ends(client: &mut impl Transfer, now: u32, frames: &[[u8; 8]], result: Result<(), SdoError>) {
    for bytes in frames {
        assert_eq!(client.poll(at(now)), Step::Send(request(*bytes)));
    }
    assert_eq!(client.poll(at(now)), Step::Done(result));
}

#[test]
fn client_makes_a_block_download() {
    let mut client = Download::as_blocks(node(), PROGRAM, nine(), CONFIG);
    asks(&mut client, 0, &[INITIATE_9], &[granted(127)]);
    asks(&mut client, 0, &[FIRST, LAST_OF_9], &[acked(2, 127)]);
    assert_eq!(client.progress(), 9);
    asks(&mut client, 0, &[END_OF_9], &[ENDED]);
    ends(&mut client, 0, &[], Ok(()));
    // A server without CRC; sub-blocks of one segment.
    let mut client = Download::as_blocks(node(), PROGRAM, nine(), CONFIG);
    asks(&mut client, 0, &[INITIATE_9], &[[0xA0, 0x50, 0x1F, 1, 1, 0, 0, 0]]);
    asks(&mut client, 0, &[FIRST], &[acked(1, 1)]);
    assert_eq!(client.progress(), 7);
    asks(&mut client, 0, &[[0x81, 8, 9, 0, 0, 0, 0, 0]], &[acked(1, 1)]);
    asks(&mut client, 0, &[[0xD5, 0, 0, 0, 0, 0, 0, 0]], &[ENDED]);
    ends(&mut client, 0, &[], Ok(()));
    // Four bytes need no segment, an empty value one empty segment.
    let mut client = Download::as_blocks(node(), PROGRAM, [1, 2, 3, 4], CONFIG);
    sends(&mut client, 0, &[[0x23, 0x50, 0x1F, 1, 1, 2, 3, 4]]);
    let mut client = Download::as_blocks(node(), PROGRAM, [0; 0], CONFIG);
    asks(&mut client, 0, &[[0xC6, 0x50, 0x1F, 1, 0, 0, 0, 0]], &[granted(127)]);
    asks(&mut client, 0, &[[0x81, 0, 0, 0, 0, 0, 0, 0]], &[acked(1, 127)]);
    asks(&mut client, 0, &[[0xDD, 0, 0, 0, 0, 0, 0, 0]], &[ENDED]);
    ends(&mut client, 0, &[], Ok(()));
}

#[test]
fn client_repeats_what_the_server_did_not_get() {
    let mut client = Download::as_blocks(node(), PROGRAM, nine(), CONFIG);
    asks(&mut client, 0, &[INITIATE_9], &[granted(127)]);
    asks(&mut client, 0, &[FIRST, LAST_OF_9], &[acked(0, 2)]);
    asks(&mut client, 0, &[FIRST, LAST_OF_9], &[acked(1, 2)]);
    asks(&mut client, 0, &[[0x81, 8, 9, 0, 0, 0, 0, 0]], &[acked(1, 2)]);
    sends(&mut client, 0, &[END_OF_9]);
    // A repeated acknowledgement: after the last segment, in the middle, and before the first
    // segment.
    hears(&mut client, 0, &[acked(1, 2), ENDED]);
    ends(&mut client, 0, &[], Ok(()));
    let mut client = Download::as_blocks(node(), PROGRAM, nine(), CONFIG);
    asks(&mut client, 0, &[INITIATE_9], &[granted(1)]);
    asks(&mut client, 0, &[FIRST], &[acked(1, 1), acked(1, 1)]);
    sends(&mut client, 0, &[[0x81, 8, 9, 0, 0, 0, 0, 0]]);
    let mut client = Download::as_blocks(node(), PROGRAM, [0; 0], CONFIG);
    asks(&mut client, 0, &[[0xC6, 0x50, 0x1F, 1, 0, 0, 0, 0]], &[granted(127), acked(0, 127)]);
    sends(&mut client, 0, &[[0x81, 0, 0, 0, 0, 0, 0, 0]]);
    // A server that never receives anything is given up.
    let mut client = Download::as_blocks(node(), PROGRAM, nine(), CONFIG);
    asks(&mut client, 0, &[INITIATE_9], &[granted(127)]);
    for _ in 0..10 {
        asks(&mut client, 0, &[FIRST, LAST_OF_9], &[acked(0, 127)]);
    }
    let given_up = [0x80, 0x50, 0x1F, 1, 0x03, 0x00, 0x04, 0x05];
    ends(&mut client, 0, &[given_up], Err(SdoError::Client(AbortCode(0x0504_0003))));
}

#[test]
fn client_tells_a_server_without_blocks_from_other_refusals() {
    // A server may name the object of the transfer before: 100 ms after its abort, if no answer comes.
    let misnamed = [0x80, 0x08, 0x10, 0, 0x01, 0x00, 0x04, 0x05];
    let unknown = [0x80, 0x50, 0x1F, 1, 0x01, 0x00, 0x04, 0x05];
    // Aborts and their times, when the transfer ends, with which code, and whether blocks were the reason.
    type Case<'a> = (&'a [(u32, [u8; 8])], u32, u32, bool);
    let cases: [Case<'_>; 5] = [
        (&[(0, unknown)], 0, 0x0504_0001, true),
        (&[(30, misnamed)], 130, 0x0504_0001, true),
        (&[(30, misnamed), (90, misnamed)], 130, 0x0504_0001, true),
        (&[(0, [0x80, 0x50, 0x1F, 1, 0x22, 0x00, 0x00, 0x08])], 0, 0x0800_0022, false),
        (&[(0, [0x80, 0x50, 0x1F, 1, 0x01, 0x00, 0x01, 0x06])], 0, 0x0601_0001, false),
    ];
    for (aborts, end, code, is_told) in cases {
        let refused = |client: &mut dyn Transfer, initiate| {
            assert_eq!(client.poll(at(0)), Step::Send(request(initiate)));
            for (time, abort) in aborts {
                client.handle(&response(*abort), at(*time));
                assert!(end == 0 || client.poll(at(end - 1)) == Step::Wait(at(end)));
            }
            assert_eq!(client.poll(at(end)), Step::Done(Err(SdoError::Server(AbortCode(code)))));
        };
        let mut download = Download::as_blocks(node(), PROGRAM, nine(), CONFIG);
        refused(&mut download, INITIATE_9);
        let mut upload = Upload::as_blocks(node(), PROGRAM, Vec::new(), CONFIG, BLOCK);
        refused(&mut upload, [0xA4, 0x50, 0x1F, 1, 127, 0, 0, 0]);
        assert_eq!((download.refuses_blocks(), upload.refuses_blocks()), (is_told, is_told), "{code:X}");
    }
    // If the answer comes, it was the abort of the transfer before.
    let mut client = Download::as_blocks(node(), PROGRAM, nine(), CONFIG);
    asks(&mut client, 0, &[INITIATE_9], &[misnamed, granted(127)]);
    sends(&mut client, 101, &[FIRST, LAST_OF_9]);
}

#[test]
fn client_makes_a_block_upload() {
    let mut client = Upload::as_blocks(node(), DOMAIN, Vec::new(), CONFIG, BLOCK);
    asks(&mut client, 0, &[READ_14], &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]);
    asks(&mut client, 0, &[START], &[FIRST, LAST_OF_14]);
    sends(&mut client, 0, &[acked(2, 127)]);
    // The last segment twice, then the end.
    hears(&mut client, 0, &[LAST_OF_14, END_OF_14]);
    ends(&mut client, 0, &[ENDED], Ok(()));
    assert_eq!((client.progress(), client.into_sink()), (14, (1..=14).collect()));
    // A block has 1 to 127 segments, whatever the caller wants.
    for (wanted, blksize) in [(0, 1), (128, 127), (255, 127)] {
        let block = Block { blksize: wanted, pst: 0, ..BLOCK };
        let mut client = Upload::as_blocks(node(), DOMAIN, Vec::new(), CONFIG, block);
        sends(&mut client, 0, &[[0xA4, 0x00, 0x20, 0, blksize, 0, 0, 0]]);
        hears(&mut client, 0, &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]);
        asks(&mut client, 0, &[START], &[FIRST]);
        if blksize > 1 {
            hears(&mut client, 0, &[LAST_OF_14]);
        }
        sends(&mut client, 0, &[acked(if blksize > 1 { 2 } else { 1 }, blksize)]);
    }
    // Without size and CRC, in sub-blocks of one.
    let mut client =
        Upload::as_blocks(node(), DOMAIN, Vec::new(), CONFIG, Block { blksize: 1, pst: 20, ..BLOCK });
    asks(&mut client, 0, &[[0xA4, 0x00, 0x20, 0, 1, 20, 0, 0]], &[[0xC0, 0x00, 0x20, 0, 0, 0, 0, 0]]);
    asks(&mut client, 0, &[START], &[FIRST]);
    asks(&mut client, 0, &[acked(1, 1)], &[[0x81, 8, 9, 0, 0, 0, 0, 0]]);
    asks(&mut client, 0, &[acked(1, 1)], &[[0xD5, 0, 0, 0, 0, 0, 0, 0]]);
    ends(&mut client, 0, &[ENDED], Ok(()));
    assert_eq!(client.into_sink(), nine());
    // A server that answers without blocks.
    let mut client = Upload::as_blocks(node(), DOMAIN, Vec::new(), CONFIG, BLOCK);
    asks(&mut client, 0, &[READ_14], &[[0x4B, 0x00, 0x20, 0, 1, 2, 0, 0]]);
    ends(&mut client, 0, &[], Ok(()));
    assert_eq!(client.into_sink(), [1, 2]);
}

/// An upload whose first sub-block may come.
fn upload() -> Upload<Vec<u8>> {
    let mut client = Upload::as_blocks(node(), DOMAIN, Vec::new(), CONFIG, BLOCK);
    asks(&mut client, 0, &[READ_14], &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]);
    sends(&mut client, 0, &[START]);
    client
}

#[test]
fn client_asks_again_for_what_was_lost() {
    let mut client = upload();
    hears(&mut client, 0, &[LAST_OF_14]);
    asks(&mut client, 0, &[acked(0, 127)], &[FIRST, LAST_OF_14]);
    asks(&mut client, 0, &[acked(2, 127)], &[END_OF_14]);
    ends(&mut client, 0, &[ENDED], Ok(()));
    assert_eq!(client.into_sink(), (1..=14).collect::<Vec<u8>>());
    // The end of the sub-block is lost.
    let mut client = upload();
    hears(&mut client, 100, &[FIRST]);
    assert_eq!(client.poll(at(399)), Step::Wait(at(400)));
    asks(&mut client, 400, &[acked(1, 127)], &[[0x81, 8, 9, 10, 11, 12, 13, 14]]);
    asks(&mut client, 400, &[acked(1, 127)], &[END_OF_14]);
    ends(&mut client, 400, &[ENDED], Ok(()));
    assert_eq!(client.into_sink(), (1..=14).collect::<Vec<u8>>());
    // Everything is lost, or the server is gone.
    let mut client = upload();
    assert_eq!(client.poll(at(999)), Step::Wait(at(1000)));
    let timeout = [0x80, 0x00, 0x20, 0, 0x00, 0x00, 0x04, 0x05];
    ends(&mut client, 1000, &[timeout], Err(SdoError::NoAnswer));
}

#[test]
fn client_aborts_a_block_transfer_that_is_wrong() {
    let abort = |at: Address, code: u32| {
        let ([i, j], [a, b, c, d]) = (at.index.to_le_bytes(), code.to_le_bytes());
        [0x80, i, j, at.sub, a, b, c, d]
    };
    let refused = |client: &mut dyn Transfer, at: Address, code: u32| {
        assert_eq!(client.poll(kit::bus::at(0)), Step::Send(request(abort(at, code))));
        assert_eq!(client.poll(kit::bus::at(0)), Step::Done(Err(SdoError::Client(AbortCode(code)))));
    };
    let download = |heard: &[[u8; 8]]| {
        let mut client = Download::as_blocks(node(), PROGRAM, nine(), CONFIG);
        sends(&mut client, 0, &[INITIATE_9]);
        for bytes in heard {
            hears(&mut client, 0, &[*bytes]);
            while let Step::Send(frame) = client.poll(at(0)) {
                if frame.exactly::<8>().unwrap()[0] == 0x80 {
                    panic!("too early: {frame}");
                }
            }
        }
        client
    };
    // Invalid block sizes; an acknowledgement of too much; an answer in the wrong place.
    for (before, wrong, code) in [
        (&[][..], granted(0), 0x0504_0002),
        (&[], granted(128), 0x0504_0002),
        (&[granted(127)], acked(2, 0), 0x0504_0002),
        (&[granted(127)], acked(3, 127), 0x0504_0003),
        (&[granted(127)], ENDED, 0x0504_0001),
        (&[granted(127), acked(2, 127)], [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0], 0x0504_0001),
    ] {
        let mut client = download(before);
        hears(&mut client, 0, &[wrong]);
        refused(&mut client, PROGRAM, code);
    }
    // An abort in the middle of a sub-block is recognised.
    let mut client = download(&[]);
    hears(&mut client, 0, &[granted(127)]);
    assert_eq!(client.poll(at(0)), Step::Send(request(FIRST)));
    hears(&mut client, 0, &[[0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x06, 0x06]]);
    ends(&mut client, 0, &[], Err(SdoError::Server(AbortCode(0x0606_0000))));

    let upload = |heard: &[[u8; 8]]| {
        let mut client = upload();
        hears(&mut client, 0, heard);
        while let Step::Send(_) = client.poll(at(0)) {}
        client
    };
    let [low, high] = crc16(&(1..=13).collect::<Vec<u8>>()).to_le_bytes();
    for (before, wrong, code) in [
        (&[][..], [0x00, 1, 2, 3, 4, 5, 6, 7], 0x0504_0003),
        (&[FIRST, LAST_OF_14], [0xC1, CRC_14[0] ^ 0x80, CRC_14[1], 0, 0, 0, 0, 0], 0x0504_0004),
        // 13 of 14 bytes, with the CRC of 13.
        (&[FIRST, LAST_OF_14], [0xC5, low, high, 0, 0, 0, 0, 0], 0x0607_0010),
        (&[FIRST, LAST_OF_14], [0x20, 0, 0, 0, 0, 0, 0, 0], 0x0504_0001),
        (&[FIRST, [0x02, 8, 9, 10, 11, 12, 13, 14]], [0x03, 0, 0, 0, 0, 0, 0, 0], 0x0607_0010),
    ] {
        let mut client = upload(before);
        hears(&mut client, 0, &[wrong]);
        refused(&mut client, DOMAIN, code);
    }
    let mut client = upload(&[FIRST]);
    hears(&mut client, 0, &[[0x80, 0x00, 0x20, 0, 0x00, 0x00, 0x06, 0x06]]);
    ends(&mut client, 0, &[], Err(SdoError::Server(AbortCode(0x0606_0000))));
    // A number above the requested block size.
    let small = Block { blksize: 2, ..BLOCK };
    let mut client = Upload::as_blocks(node(), DOMAIN, Vec::new(), CONFIG, small);
    asks(&mut client, 0, &[[0xA4, 0x00, 0x20, 0, 2, 0, 0, 0]], &[[0xC6, 0x00, 0x20, 0, 14, 0, 0, 0]]);
    asks(&mut client, 0, &[START], &[[0x03, 1, 2, 3, 4, 5, 6, 7]]);
    refused(&mut client, DOMAIN, 0x0504_0003);
    // A target that is too small.
    let mut bytes = [0; 8];
    let mut client = Upload::as_blocks(node(), DOMAIN, Buffer::new(&mut bytes), CONFIG, BLOCK);
    asks(&mut client, 0, &[READ_14], &[[0xC4, 0x00, 0x20, 0, 0, 0, 0, 0]]);
    asks(&mut client, 0, &[START], &[FIRST, [0x02, 8, 9, 10, 11, 12, 13, 14]]);
    refused(&mut client, DOMAIN, 0x0504_0005);
}
