//! Events between the segments of a block download: requests of another client or of a client that
//! has aborted, silence, a reset. Frames written by hand from CiA 301 sections 7.2.4.3 and 7.2.8.3.

use canopen::frame::Channel;
use canopen::od::Objects;
use canopen::sdo::client::{Config as ClientConfig, Download, Step, Transfer};
use canopen::sdo::server::{Config, SdoServer};
use canopen::{Address, BitRate, CobId, Frame};
use kit::bus::{at, node, request, response, Bench, Device, DeviceOf, Event};
use kit::random::Random;

/// The clock, and the beginning of a download.
trait Scene {
    fn wait(&mut self, ms: u32) -> Vec<(u32, Frame)>;
    fn begin(&mut self, segments: u8);
    fn sends(&mut self, numbers: impl Iterator<Item = u8>, data: [u8; 7]);
}

impl Scene for Bench {
    /// Advances the time by one millisecond after another; returns the frames sent meanwhile, and
    /// their times.
    fn wait(&mut self, ms: u32) -> Vec<(u32, Frame)> {
        let mut sent = Vec::new();
        for _ in 0..ms {
            self.now += 1;
            let now = self.now;
            sent.extend(self.sent().into_iter().map(|frame| (now, frame)));
        }
        sent
    }

    /// Opens a block download of 1F50h/1 and sends its first segments.
    #[track_caller]
    fn begin(&mut self, segments: u8) {
        assert_eq!(self.ask(INITIATE), [response(GRANTED)]);
        self.sends(1..=segments, [1, 2, 3, 4, 5, 6, 7]);
    }

    /// Sends segments with these numbers, none of which is answered.
    #[track_caller]
    fn sends(&mut self, numbers: impl Iterator<Item = u8>, [a, b, c, d, e, f, g]: [u8; 7]) {
        for seqno in numbers {
            assert_eq!(self.ask([seqno, a, b, c, d, e, f, g]), [], "{seqno}");
        }
    }
}

const FAST: Config = Config { bit_rate: BitRate::K1000, ..Config::DEFAULT };
const CLEAR: [u8; 8] = [0x2F, 0x51, 0x1F, 1, 3, 0, 0, 0];
const CLEARED: [u8; 8] = [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0];
/// A block download of 4096 bytes.
const INITIATE: [u8; 8] = [0xC2, 0x50, 0x1F, 1, 0, 0x10, 0, 0];
const GRANTED: [u8; 8] = [0xA4, 0x50, 0x1F, 1, 127, 0, 0, 0];
const READ_1000: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
const IS_1000: [u8; 8] = [0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10];
const TIMED_OUT: [u8; 8] = [0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x04, 0x05];

fn acked(ackseq: u8) -> [u8; 8] {
    [0xA2, ackseq, 127, 0, 0, 0, 0, 0]
}

/// Time-outs of clients: 0.3 s (python-canopen) to 0.5 s. A client that has sent the whole sub-block
/// waits for the acknowledgement; one that has not is busy elsewhere for 60 to 200 ms.
#[test]
fn a_lost_last_segment_is_acknowledged_after_50_ms_and_a_pause_after_250() {
    for (segments, pause) in [(1, 250), (40, 250), (125, 250), (126, 50)] {
        let mut bench = Bench::with(Config::DEFAULT);
        bench.begin(segments);
        assert_eq!(bench.wait(300), [(pause, response(acked(segments)))], "{segments}");
        // The client repeats the missing part. The end of the transfer may be lost as well.
        assert_eq!(bench.ask([1, 1, 2, 3, 4, 5, 6, 7]), []);
        assert_eq!(bench.wait(300), [(550, response(acked(1)))], "{segments}");
    }
    // Segment 100 is lost, and so is the last one.
    let mut bench = Bench::with(Config::DEFAULT);
    bench.begin(99);
    bench.sends(101..=126, [1, 2, 3, 4, 5, 6, 7]);
    assert_eq!(bench.wait(300), [(250, response(acked(99)))]);
    // The last segment of the transfer, in a sub-block that has room for more: 15 bytes are announced.
    for (size, pause) in [(15, 50), (21, 50), (22, 250)] {
        let mut bench = Bench::with(Config::DEFAULT);
        assert_eq!(bench.ask([0xC2, 0x50, 0x1F, 1, size, 0, 0, 0]), [response(GRANTED)]);
        bench.sends(1..=2, [1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(bench.wait(300), [(pause, response(acked(2)))], "{size} bytes");
    }
    // On a bus at 10 or 20 kbit/s the short time is doubled.
    for (bit_rate, pause) in [(BitRate::K50, 50), (BitRate::K20, 100), (BitRate::K10, 100)] {
        let mut bench = Bench::with(Config { blksize: 3, bit_rate, ..Config::DEFAULT });
        let granted = [0xA4, 0x50, 0x1F, 1, 3, 0, 0, 0];
        assert_eq!(bench.ask(INITIATE), [response(granted)]);
        bench.sends(1..=2, [1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(bench.wait(300), [(pause, response([0xA2, 2, 3, 0, 0, 0, 0, 0]))], "{bit_rate:?}");
    }
}

/// A sub-block takes 80 ms at most: Lely's client gives up after 100. A frame of eight bytes has 135 bits
/// at most (ISO 11898-1: 111, and 24 stuff bits), so that 80 ms at 125 kbit/s are 74.07 frames.
#[test]
fn a_sub_block_fits_into_the_time_out_of_a_client_at_each_bit_rate() {
    for (bit_rate, segments) in [
        (BitRate::K1000, 127),
        (BitRate::K800, 127),
        (BitRate::K500, 127),
        (BitRate::K250, 127),
        (BitRate::K125, 74),
        (BitRate::K50, 29),
        (BitRate::K20, 11),
        (BitRate::K10, 5),
        (BitRate::Auto, 127),
    ] {
        let mut bench = Bench::with(Config { bit_rate, ..Config::DEFAULT });
        let granted = [0xA4, 0x50, 0x1F, 1, segments, 0, 0, 0];
        assert_eq!(bench.ask(INITIATE), [response(granted)], "{bit_rate:?}");
        for seqno in 1..segments {
            assert_eq!(bench.ask([seqno, 1, 2, 3, 4, 5, 6, 7]), [], "{bit_rate:?}");
        }
        let acked = [0xA2, segments, segments, 0, 0, 0, 0, 0];
        assert_eq!(bench.ask([segments, 1, 2, 3, 4, 5, 6, 7]), [response(acked)], "{bit_rate:?}");
    }
}

/// The server aborts a download at this segment, because there are more data than were announced.
fn aborted_at(place: u8, second: Option<Channel>) -> Bench {
    let mut bench = Bench::with(FAST);
    bench.device.second = second;
    let [low, high] = (7 * u16::from(place) - 1).to_le_bytes();
    assert_eq!(bench.ask([0xC2, 0x50, 0x1F, 1, low, high, 0, 0]), [response(GRANTED)]);
    bench.sends(1..place, [1, 2, 3, 4, 5, 6, 7]);
    let abort = [0x80, 0x50, 0x1F, 1, 0x10, 0, 0x07, 0x06];
    assert_eq!(bench.ask([place, 1, 2, 3, 4, 5, 6, 7]), [response(abort)]);
    bench.device.events.clear();
    bench
}

/// What a client sends until it reads the abort is no request: neither an unknown one nor, with such
/// data, CLEAR. A read that comes right after the abort is answered at each of the 127 places.
#[test]
fn segments_after_an_abort_are_no_requests_and_a_read_is() {
    for place in 1..127 {
        for more in [0, 1, 5, 126] {
            let mut bench = aborted_at(place, None);
            let last = place.saturating_add(more).min(127);
            for seqno in place + 1..=last {
                // CLEAR, if it were a request.
                assert_eq!(bench.ask([seqno, 0x51, 0x1F, 1, 3, 0, 0, 0]), [], "{seqno} after {place}");
                assert_eq!(bench.device.control, 0, "{seqno} after {place}");
            }
            assert_eq!(bench.ask(READ_1000), [response(IS_1000)], "{last} after {place}");
            // The rest of the sub-block after the read, which may come from somebody else.
            for seqno in last + 1..=127 {
                assert_eq!(bench.ask([seqno, 0x51, 0x1F, 1, 3, 0, 0, 0]), [], "{seqno} after {place}");
            }
            assert_eq!(bench.device.control, 0, "after {place}");
        }
    }
}

/// Only what continues the sub-block is passed over: not another number, not a number behind a gap or the
/// last segment, and nothing after a pause.
#[test]
fn any_other_frame_after_an_abort_is_a_request_at_once() {
    for place in (1..127).filter(|place| *place != 0x2E) {
        let mut bench = aborted_at(place, None);
        assert_eq!(bench.ask(CLEAR), [response(CLEARED)], "after {place}");
        assert_eq!(bench.device.control, 3);
    }
    // The number is due: it is a segment, and a request after a pause of some frames.
    let mut bench = aborted_at(0x2E, None);
    assert_eq!(bench.ask(CLEAR), []);
    assert_eq!(bench.ask(CLEAR), [response(CLEARED)], "a client that repeats it");
    let mut bench = aborted_at(0x2E, None);
    bench.now += 3;
    assert_eq!(bench.ask(CLEAR), [response(CLEARED)]);
    // The last segment of the transfer ends it: no number follows.
    let mut bench = aborted_at(0x2D, None);
    assert_eq!(bench.ask([0x80 | 0x2E, 1, 2, 3, 4, 5, 6, 7]), []);
    assert_eq!(bench.ask(CLEAR), [response(CLEARED)]);
    // A read of an object that does not exist is a segment if its number is due, as is any other.
    let mut bench = aborted_at(0x3F, None);
    assert_eq!(bench.ask([0x40, 0x34, 0x12, 0, 0, 0, 0, 0]), []);
    // The other server has numbers of its own.
    let second = Channel { request: CobId::new(0x6A0).unwrap(), response: CobId::new(0x1A0).unwrap() };
    let mut bench = aborted_at(0x2E, Some(second));
    let clear = Frame::full(second.request, CLEAR);
    bench.server.handle(&clear, at(bench.now), &mut bench.device);
    assert_eq!(bench.sent(), [Frame::full(second.response, CLEARED)]);
    // A new download begins at once. Where its request (C2h) has the number that is due, 42h, with the mark
    // of the last segment, it begins when the client repeats it.
    for place in 1..127 {
        let mut bench = aborted_at(place, None);
        if place == 0x41 {
            assert_eq!(bench.ask(INITIATE), []);
        }
        bench.begin(126);
        assert_eq!(bench.ask([127, 1, 2, 3, 4, 5, 6, 7]), [response(acked(127))], "after {place}");
    }
}

/// The time-out ends the download of a client that stopped for seconds, or another client's request ends
/// that of one that stopped for 50 ms; then the client sends the rest of its sub-block. Its first segment
/// may be a request; the others are none.
#[test]
fn the_rest_of_a_sub_block_after_the_end_of_its_download_is_no_request() {
    // Not 2Ah: the other client's request would have the number that is due.
    for place in (1..126).filter(|place| *place != 0x2A) {
        for is_timed_out in [true, false] {
            let mut bench = Bench::with(FAST);
            bench.begin(place);
            if is_timed_out {
                let said = bench.wait(2300);
                assert_eq!(said.last(), Some(&(2250, response(TIMED_OUT))), "{place}");
            } else {
                bench.wait(5);
                assert_eq!(bench.ask([0x2B, 0x17, 0x10, 0, 100, 0, 0, 0]), []);
                let said = bench.wait(60);
                assert_eq!(said, [(55, response([0x60, 0x17, 0x10, 0, 0, 0, 0, 0]))], "{place}");
            }
            let first = bench.ask([place + 1, 9, 9, 9, 9, 9, 9, 9]);
            assert_eq!(first.len(), 1, "{place}: {first:?}");
            for seqno in place + 2..=126 {
                // CLEAR, if it were a request.
                assert_eq!(bench.ask([seqno, 0x51, 0x1F, 1, 3, 0, 0, 0]), [], "{seqno} after {place}");
            }
            assert_eq!(bench.device.control, 0, "after {place}");
            // Any other frame, and any frame after a pause, is a request.
            assert_eq!(bench.ask(READ_1000), [response(IS_1000)]);
            bench.now += 3;
            assert_eq!(bench.ask(CLEAR), [response(CLEARED)]);
        }
    }
    // A request with the number that is due, and the next one with its successor's.
    let mut bench = Bench::with(FAST);
    bench.begin(0x21);
    bench.wait(2300);
    for (asked, at) in [(0x22, 0x2002), (0x23, 0x2002)] {
        let [low, high] = u16::to_le_bytes(at);
        let answer = bench.ask([asked, low, high, 0, 1, 2, 3, 4]);
        assert_eq!(answer.len(), 1, "{asked:02X}: {answer:?}");
    }
}

/// The time-out of a device that has no second server.
#[test]
fn a_server_that_is_alone_passes_the_rest_of_a_sub_block_over_too() {
    for place in 1..126 {
        let mut device = DeviceOf::<false>::default();
        let mut server = SdoServer::new(node(), FAST);
        let mut ask = |ms, bytes: Option<[u8; 8]>| {
            if let Some(bytes) = bytes {
                server.handle(&request(bytes), at(ms), &mut device);
            }
            let answer = server.poll(at(ms), &mut device);
            (answer, device.control)
        };
        assert_eq!(ask(0, Some(INITIATE)).0, Some(response(GRANTED)));
        for seqno in 1..=place {
            assert_eq!(ask(0, Some([seqno, 1, 2, 3, 4, 5, 6, 7])).0, None);
        }
        assert_eq!(ask(250, None).0, Some(response(acked(place))));
        assert_eq!(ask(2250, None).0, Some(response(TIMED_OUT)));
        assert!(ask(2300, Some([place + 1, 9, 9, 9, 9, 9, 9, 9])).0.is_some());
        for seqno in place + 2..=126 {
            // CLEAR, if it were a request.
            let after = ask(2300, Some([seqno, 0x51, 0x1F, 1, 3, 0, 0, 0]));
            assert_eq!(after, (None, 0), "{seqno} after {place}");
        }
        // A new download is served from its first segment on.
        assert_eq!(ask(2300, Some(INITIATE)).0, Some(response(GRANTED)));
        for seqno in 1..=126 {
            assert_eq!(ask(2300, Some([seqno, 1, 2, 3, 4, 5, 6, 7])).0, None);
        }
        assert_eq!(ask(2300, Some([127, 1, 2, 3, 4, 5, 6, 7])).0, Some(response(acked(127))));
    }
}

/// A client has read the abort and begun another transfer: its requests are answered, whatever number they
/// would be. Segment upload 60h follows place 5Fh, segment download 10h place 0Fh.
#[test]
fn a_transfer_after_an_abort_is_served_at_each_place() {
    for place in 1..126 {
        let mut bench = aborted_at(place, None);
        if place != 0x3F {
            assert_eq!(bench.ask([0x40, 0x08, 0x10, 0, 0, 0, 0, 0]).len(), 1, "after {place}");
            for toggle in [0x60, 0x70, 0x60] {
                let answer = bench.ask([toggle, 0, 0, 0, 0, 0, 0, 0]);
                assert_eq!(answer.len(), 1, "{toggle:02X} after {place}");
            }
        }
        let mut bench = aborted_at(place, None);
        if place != 0x20 {
            assert_eq!(bench.ask([0x21, 0x00, 0x20, 0, 14, 0, 0, 0]).len(), 1, "after {place}");
            for segment in [0x00, 0x11] {
                assert_eq!(bench.ask([segment, 1, 2, 3, 4, 5, 6, 7]).len(), 1, "{segment:02X} after {place}");
            }
        }
    }
}

/// Another client ends a download by its own through the second server, and the first one's segments come.
#[test]
fn another_servers_download_makes_no_requests_of_segments() {
    let second = Channel { request: CobId::new(0x6A0).unwrap(), response: CobId::new(0x1A0).unwrap() };
    for place in 1..126 {
        let mut bench = Bench::with(FAST);
        bench.device.second = Some(second);
        bench.begin(place);
        let initiate = Frame::full(second.request, INITIATE);
        bench.server.handle(&initiate, at(bench.now), &mut bench.device);
        assert_eq!(bench.sent(), [Frame::full(second.response, GRANTED)]);
        for seqno in place + 1..=126 {
            assert_eq!(bench.ask([seqno, 0x51, 0x1F, 1, 3, 0, 0, 0]), [], "{seqno} after {place}");
        }
        assert_eq!(bench.device.control, 0, "after {place}");
        let segment = Frame::full(second.request, [1, 1, 2, 3, 4, 5, 6, 7]);
        bench.server.handle(&segment, at(bench.now), &mut bench.device);
        assert_eq!(bench.device.taken.last_chunk(), Some(&[1, 2, 3, 4, 5, 6, 7]), "it goes on");
    }
}

/// A client on a busy machine stops for up to 200 ms anywhere in a sub-block, and goes on as if nothing
/// had happened.
#[test]
fn a_client_that_stops_for_200_ms_inside_a_sub_block_is_not_answered() {
    for place in 1..=126 {
        for pause in [60, 100, 200, 249] {
            // Right before the last segment the client is answered, and it expects that.
            let pause = if place == 126 { 49 } else { pause };
            let mut bench = Bench::with(Config::DEFAULT);
            bench.begin(place);
            assert_eq!(bench.wait(pause), [], "{place}");
            for seqno in place + 1..=126 {
                assert_eq!(bench.ask([seqno, 1, 2, 3, 4, 5, 6, 7]), [], "{place}");
            }
            assert_eq!(bench.ask([127, 1, 2, 3, 4, 5, 6, 7]), [response(acked(127))], "{place}");
        }
    }
}

/// A client with a pause longer than the server's limit continues, and reads the acknowledgement
/// after its sub-block: the segments in between are neither data nor a reason for another
/// acknowledgement.
#[test]
fn the_rest_of_a_sub_block_that_was_acknowledged_early_is_passed_over() {
    let mut bench = Bench::with(Config::DEFAULT);
    bench.begin(40);
    assert_eq!(bench.wait(260), [(250, response(acked(40)))]);
    bench.sends(41..=127, [9, 9, 9, 9, 9, 9, 9]);
    // The same with every frame twice, as CAN may deliver it.
    assert_eq!(bench.ask([127, 9, 9, 9, 9, 9, 9, 9]), []);
    assert_eq!(bench.wait(60), []);
    assert_eq!(bench.ask([1, 8, 8, 8, 8, 8, 8, 8]), []);
    assert_eq!(bench.ask([0x82, 7, 7, 7, 7, 7, 7, 7]), [response(acked(2))]);
    assert_eq!(
        bench.ask([0xC1, 0, 0, 0, 0, 0, 0, 0]),
        [response([0x80, 0x50, 0x1F, 1, 0x10, 0, 0x07, 0x06])]
    );
    let mut expected = [1, 2, 3, 4, 5, 6, 7].repeat(40);
    expected.extend([[8; 7], [7; 7]].concat());
    assert_eq!(bench.device.taken, expected);
    // A client that begins again at the acknowledgement, and loses its first segment.
    let mut bench = Bench::with(Config::DEFAULT);
    bench.begin(40);
    assert_eq!(bench.wait(260), [(250, response(acked(40)))]);
    bench.sends(2..=126, [9, 9, 9, 9, 9, 9, 9]);
    assert_eq!(bench.ask([127, 9, 9, 9, 9, 9, 9, 9]), [response(acked(0))]);
}

/// The client of a download was switched off. Another client repeats its request: it gets the first
/// answer after 50 ms without a frame of the download.
#[test]
fn a_request_ends_a_download_that_stands_still() {
    for (segments, every) in [(0, 100), (0, 2200), (3, 100), (3, 2200), (3, 20), (126, 300)] {
        let mut bench = Bench::with(Config::DEFAULT);
        bench.begin(segments);
        bench.now = 10;
        let mut answers = bench.ask(READ_1000).into_iter().map(|frame| (10, frame)).collect::<Vec<_>>();
        while bench.now < 4000 {
            answers.extend(bench.wait(every));
            let now = bench.now;
            answers.extend(bench.ask(READ_1000).into_iter().map(|frame| (now, frame)));
        }
        assert_eq!(answers[0], (60, response(IS_1000)), "{segments} segments, every {every} ms");
        assert!(answers.iter().all(|(_, frame)| *frame == response(IS_1000)), "{answers:?}");
        assert_eq!(bench.device.events, [Event::Start(Some(4096)), Event::Cancel]);
        assert!(bench.server.is_idle());
    }
}

#[test]
fn each_kind_of_request_ends_a_download() {
    for (asked, answered) in [
        ([0x2F, 0x51, 0x1F, 1, 3, 0, 0, 0], [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
        ([0x22, 0x51, 0x1F, 1, 3, 0, 0, 0], [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
        ([0x23, 0x02, 0x20, 0, 1, 2, 3, 4], [0x60, 0x02, 0x20, 0, 0, 0, 0, 0]),
        ([0x2B, 0x17, 0x10, 0, 100, 0, 0, 0], [0x60, 0x17, 0x10, 0, 0, 0, 0, 0]),
        ([0x21, 0x01, 0x20, 0, 9, 0, 0, 0], [0x60, 0x01, 0x20, 0, 0, 0, 0, 0]),
        ([0x20, 0x50, 0x1F, 1, 0, 0, 0, 0], [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0]),
        ([0x40, 0x18, 0x10, 1, 0, 0, 0, 0], [0x43, 0x18, 0x10, 1, 4, 3, 2, 1]),
        ([0x40, 0x50, 0x1F, 1, 0, 0, 0, 0], [0x80, 0x50, 0x1F, 1, 0x01, 0x00, 0x01, 0x06]),
        ([0xA0, 0x08, 0x10, 0, 127, 0, 0, 0], [0xC6, 0x08, 0x10, 0, 17, 0, 0, 0]),
        ([0xA4, 0x00, 0x10, 0, 127, 4, 0, 0], [0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10]),
        ([0xC0, 0x50, 0x1F, 1, 0, 0, 0, 0], GRANTED),
        ([0xC6, 0x50, 0x1F, 1, 9, 0, 0, 0], GRANTED),
    ] {
        for segments in [0, 3] {
            let mut bench = Bench::with(Config::DEFAULT);
            bench.begin(segments);
            assert_eq!(bench.ask(asked), []);
            assert_eq!(bench.wait(50), [(50, response(answered))], "{asked:02X?} behind {segments}");
            assert_eq!(bench.device.events[..2], [Event::Start(Some(4096)), Event::Cancel]);
        }
        // The server delays its acknowledgement, because there is no room.
        let mut bench = Bench::with(Config { blksize: 2, ..Config::DEFAULT });
        bench.device.space = Some(14);
        let granted = [0xA4, 0x50, 0x1F, 1, 2, 0, 0, 0];
        assert_eq!(bench.ask(INITIATE), [response(granted)]);
        assert_eq!(bench.ask([1, 1, 2, 3, 4, 5, 6, 7]), []);
        assert_eq!(bench.ask([2, 1, 2, 3, 4, 5, 6, 7]), []);
        assert_eq!(bench.wait(10), []);
        assert_eq!(bench.ask(asked), []);
        bench.device.space = Some(0);
        let sent = bench.wait(60);
        // Another download finds no room either; it is granted when there is room.
        let held = matches!(asked[0], 0x20 | 0xC0 | 0xC6) && asked[1] == 0x50;
        assert_eq!(sent.is_empty(), held, "{asked:02X?}: {sent:?}");
        assert_eq!(bench.device.events[..2], [Event::Start(Some(4096)), Event::Cancel]);
    }
    // An abort takes effect at once, and is not answered.
    let mut bench = Bench::with(Config::DEFAULT);
    bench.begin(3);
    assert_eq!(bench.ask([0x80, 0, 0, 0, 0, 0, 0, 8]), []);
    assert_eq!(bench.ask(READ_1000), [response(IS_1000)]);
}

/// Data that read as a request are data if they are in order, repeated, or after a gap while the
/// client continues.
#[test]
fn segments_that_read_as_requests_are_data() {
    let mut data = vec![[9; 7]; 127];
    for (seqno, bytes) in [
        (0x21, [0x50, 0x1F, 1, 9, 0, 0, 0]),
        (0x2F, [0x51, 0x1F, 1, 3, 0, 0, 0]),
        (0x40, [0x00, 0x10, 0, 0, 0, 0, 0]),
        (0x41, [0x00, 0x10, 0, 0, 0, 0, 0]),
        (0x7F, [0x51, 0x1F, 1, 3, 0, 0, 0]),
    ] {
        data[seqno - 1] = bytes;
    }
    let segment = |seqno: u8| {
        let [a, b, c, d, e, f, g] = data[usize::from(seqno) - 1];
        [seqno, a, b, c, d, e, f, g]
    };
    for lost in [None, Some(0x20), Some(0x2E), Some(0x3F), Some(0x40)] {
        for pause in [0, 49] {
            let mut bench = Bench::with(Config::DEFAULT);
            bench.begin(0);
            for seqno in (1..=126).filter(|seqno| Some(*seqno) != lost) {
                bench.wait(if [0x2F, 0x40, 0x41, 0x42].contains(&seqno) { pause } else { 1 });
                assert_eq!(bench.ask(segment(seqno)), [], "{seqno:02X}");
                assert_eq!(bench.ask(segment(seqno)), [], "{seqno:02X} twice");
            }
            let arrived = lost.map_or(127, |lost| lost - 1);
            assert_eq!(bench.ask(segment(127)), [response(acked(arrived))]);
            assert_eq!(bench.device.taken, data[..usize::from(arrived)].concat());
            assert_eq!(bench.device.events, [Event::Start(Some(4096))]);
        }
    }
}

/// The time counts from the last accepted segment, whatever else arrives.
#[test]
fn a_download_that_makes_no_progress_times_out() {
    // A segment out of order, and a request for an object that the device does not have.
    for noise in [[0x7E, 0, 0, 0, 0, 0, 0, 0], [0x40, 0x34, 0x12, 0, 0, 0, 0, 0]] {
        for (segments, every) in [(0, 10), (0, 100), (2, 10), (2, 100), (2, 700)] {
            let mut bench = Bench::with(Config::DEFAULT);
            bench.begin(segments);
            let mut sent = Vec::new();
            let mut noise = noise;
            while bench.now < 6000 && !sent.iter().any(|(_, frame)| *frame == response(TIMED_OUT)) {
                sent.extend(bench.wait(every));
                noise[7] ^= 1;
                bench.ask(noise);
            }
            let (when, last) = sent.last().unwrap();
            assert_eq!(*last, response(TIMED_OUT));
            // 2 s after the last segment, or after its acknowledgement if that came later.
            assert!((2000..=2250).contains(when), "{when} ms, every {every} ms, {noise:02X?}");
            assert_eq!(bench.device.events, [Event::Start(Some(4096)), Event::Cancel]);
        }
    }
    // The last segment repeated, where the end is expected.
    let mut bench = Bench::with(Config::DEFAULT);
    bench.begin(0);
    let mut sent =
        bench.ask([0x81, 1, 2, 3, 4, 5, 6, 7]).into_iter().map(|frame| (0, frame)).collect::<Vec<_>>();
    for _ in 0..40 {
        sent.extend(bench.wait(100));
        bench.ask([0x81, 1, 2, 3, 4, 5, 6, 7]);
    }
    assert_eq!(sent[..2], [(0, response(acked(1))), (2000, response(TIMED_OUT))]);
}

/// Downloads with lost and repeated segments, and with data in which many segments read as requests
/// for existing objects: none is disturbed. The client makes pauses like one on a busy machine.
#[test]
fn no_lost_or_doubled_segment_makes_a_request_of_data() {
    let device = Device::default();
    let objects: Vec<Address> = device.entries().iter().map(|entry| entry.at).collect();
    for seed in 0..400 {
        let mut random = Random(seed);
        let segments = 1 + random.below(500);
        let tells_request = random.below(4);
        let mut data = Vec::new();
        for _ in 0..segments {
            let at = random.pick(&objects);
            let [low, high] = at.index.to_le_bytes();
            let mut bytes = [low, high, at.sub, 0, 0, 0, 0];
            if random.below(4) < tells_request {
                bytes[3] = random.below(128) as u8;
            } else {
                bytes.iter_mut().for_each(|byte| *byte = random.below(256) as u8);
            }
            data.extend(bytes);
        }
        // The last segment of the transfer does not read as a request: see below.
        let len = data.len();
        data[len - 7..].fill(0xEE);
        let per_mille = random.pick(&[0, 5, 50]);
        let mut client = Download::as_blocks(node(), Address::new(0x1F50, 1), &data, ClientConfig::default());
        let mut bench = Bench::with(Config { blksize: 1 + random.below(127) as u8, ..Config::DEFAULT });
        let (mut good, mut outcome) = (0, None);
        while outcome.is_none() {
            match client.poll(at(bench.now)) {
                Step::Send(frame) => {
                    let [first, rest @ ..] = *frame.exactly::<8>().unwrap();
                    // If no segment of a sub-block arrives, its beginning is unknown.
                    let is_segment = (first < 0x80 || rest == [0xEE; 7]) && first & 0x7F != 1;
                    // Two segments follow each missing one: see the server's rule.
                    let lost = is_segment && good >= 2 && random.below(1000) < per_mille;
                    good = if lost { 0 } else { good + 1 };
                    let doubled = is_segment && random.below(1000) < per_mille;
                    let times = if lost { 0 } else { 1 + u32::from(doubled) };
                    for _ in 0..times {
                        bench.server.handle(&frame, at(bench.now), &mut bench.device);
                    }
                    bench.now += if random.below(100) == 0 { random.below(45) as u32 } else { 0 };
                }
                Step::Wait(_) => bench.now += 1,
                Step::Done(result) => outcome = Some(result),
            }
            for answer in bench.sent() {
                client.handle(&answer, at(bench.now));
            }
        }
        assert_eq!(outcome, Some(Ok(())), "seed {seed}");
        assert_eq!(bench.device.domain, data, "seed {seed}");
    }
}
