//! The SDO client against answers written by hand from CiA 301 section 7.2.4.3.

use canopen::sdo::client::{Block, Buffer, Config, Download, SdoError, Step, Transfer, Upload};
use canopen::{AbortCode, Address, CobId, Frame};
use kit::bus::{at, node, request, response};

const CONFIG: Config = Config { timeout_ms: 1000 };
const BLOCK: Block = Block { blksize: 127, pst: 0, repeat_ms: 300 };
const OBJECT: Address = Address::new(0x2000, 3);
const NINE: &[u8] = &[1, 2, 3, 4, 5, 6, 7, 8, 9];

/// A client and the bytes that it must send next, or its end.
#[track_caller]
fn sends(client: &mut impl Transfer, now: u32, bytes: [u8; 8]) {
    assert_eq!(client.poll(at(now)), Step::Send(request(bytes)));
    assert_eq!(client.poll(at(now)), Step::Wait(at(now + 1000)));
}

/// The request that it must send, and the answer at the same time.
#[track_caller]
fn asks(client: &mut impl Transfer, now: u32, bytes: [u8; 8], answer: [u8; 8]) {
    sends(client, now, bytes);
    client.handle(&response(answer), at(now));
}

#[track_caller]
fn ends(client: &mut impl Transfer, now: u32, result: Result<(), SdoError>) {
    assert_eq!(client.poll(at(now)), Step::Done(result));
    // It does not continue after its end.
    client.handle(&response([0x60, 0, 0x20, 0, 0, 0, 0, 0]), at(now));
    client.handle(&response([0x80, 0, 0x20, 3, 0, 0, 0, 8]), at(now));
    client.abort(AbortCode::GENERAL);
    assert_eq!(client.poll(at(now)), Step::Done(result));
}

/// It sends this abort and then ends.
#[track_caller]
fn aborts(client: &mut impl Transfer, now: u32, bytes: [u8; 8], error: SdoError) {
    assert_eq!(client.poll(at(now)), Step::Send(request(bytes)));
    ends(client, now, Err(error));
}

fn download(data: &[u8]) -> Download<&[u8]> {
    Download::new(node(), OBJECT, data, CONFIG)
}

fn upload() -> Upload<Vec<u8>> {
    Upload::new(node(), OBJECT, Vec::new(), CONFIG)
}

#[test]
fn downloads_up_to_four_bytes_in_one_frame() {
    let table: [(&[u8], [u8; 8]); 4] = [
        (&[1], [0x2F, 0x00, 0x20, 3, 1, 0, 0, 0]),
        (&[1, 2], [0x2B, 0x00, 0x20, 3, 1, 2, 0, 0]),
        (&[1, 2, 3], [0x27, 0x00, 0x20, 3, 1, 2, 3, 0]),
        (&[1, 2, 3, 4], [0x23, 0x00, 0x20, 3, 1, 2, 3, 4]),
    ];
    for (data, bytes) in table {
        let mut client = download(data);
        sends(&mut client, 0, bytes);
        assert_eq!(client.progress(), 0);
        client.handle(&response([0x60, 0x00, 0x20, 3, 0, 0, 0, 0]), at(1));
        ends(&mut client, 1, Ok(()));
        assert_eq!(client.progress(), data.len() as u32);
    }
}

#[test]
fn downloads_more_in_segments() {
    let data: Vec<u8> = (1..=16).collect();
    let mut client = download(&data);
    asks(&mut client, 0, [0x21, 0x00, 0x20, 3, 16, 0, 0, 0], [0x60, 0x00, 0x20, 3, 0, 0, 0, 0]);
    sends(&mut client, 0, [0x00, 1, 2, 3, 4, 5, 6, 7]);
    assert_eq!(client.progress(), 0);
    client.handle(&response([0x20, 0, 0, 0, 0, 0, 0, 0]), at(0));
    sends(&mut client, 0, [0x10, 8, 9, 10, 11, 12, 13, 14]);
    assert_eq!(client.progress(), 7);
    client.handle(&response([0x30, 0, 0, 0, 0, 0, 0, 0]), at(0));
    asks(&mut client, 0, [0x0B, 15, 16, 0, 0, 0, 0, 0], [0x20, 0, 0, 0, 0, 0, 0, 0]);
    ends(&mut client, 0, Ok(()));
    assert_eq!(client.progress(), 16);

    // Seven bytes end in a full segment, none in an empty one.
    let mut client = download(&data[..7]);
    asks(&mut client, 0, [0x21, 0x00, 0x20, 3, 7, 0, 0, 0], [0x60, 0x00, 0x20, 3, 0, 0, 0, 0]);
    sends(&mut client, 0, [0x01, 1, 2, 3, 4, 5, 6, 7]);
    let mut client = download(&[]);
    asks(&mut client, 0, [0x21, 0x00, 0x20, 3, 0, 0, 0, 0], [0x60, 0x00, 0x20, 3, 0, 0, 0, 0]);
    sends(&mut client, 0, [0x0F, 0, 0, 0, 0, 0, 0, 0]);
}

#[test]
fn uploads_expedited() {
    let table: [([u8; 8], &[u8]); 5] = [
        ([0x4F, 0x00, 0x20, 3, 1, 9, 9, 9], &[1]),
        ([0x4B, 0x00, 0x20, 3, 1, 2, 9, 9], &[1, 2]),
        ([0x47, 0x00, 0x20, 3, 1, 2, 3, 9], &[1, 2, 3]),
        ([0x43, 0x00, 0x20, 3, 1, 2, 3, 4], &[1, 2, 3, 4]),
        // Unknown size.
        ([0x42, 0x00, 0x20, 3, 1, 2, 3, 4], &[1, 2, 3, 4]),
    ];
    for (bytes, data) in table {
        let mut client = upload();
        asks(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0], bytes);
        ends(&mut client, 0, Ok(()));
        assert_eq!(client.progress(), data.len() as u32);
        assert_eq!(client.into_sink(), data);
    }
}

#[test]
fn uploads_segmented() {
    for announce in [[0x41, 0x00, 0x20, 3, 9, 0, 0, 0], [0x40, 0x00, 0x20, 3, 0, 0, 0, 0]] {
        let mut client = upload();
        asks(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0], announce);
        asks(&mut client, 0, [0x60, 0, 0, 0, 0, 0, 0, 0], [0x00, 1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(client.progress(), 7);
        asks(&mut client, 0, [0x70, 0, 0, 0, 0, 0, 0, 0], [0x1B, 8, 9, 0, 0, 0, 0, 0]);
        ends(&mut client, 0, Ok(()));
        assert_eq!(client.into_sink(), (1..=9).collect::<Vec<u8>>());
    }
}

#[test]
fn a_buffer_takes_what_fits_and_no_more() {
    let mut bytes = [0; 4];
    let mut buffer = Buffer::new(&mut bytes);
    let mut client = Upload::new(node(), Address::new(0x1018, 1), &mut buffer, CONFIG);
    asks(&mut client, 0, [0x40, 0x18, 0x10, 1, 0, 0, 0, 0], [0x43, 0x18, 0x10, 1, 1, 2, 3, 4]);
    ends(&mut client, 0, Ok(()));
    assert_eq!(buffer.filled(), [1, 2, 3, 4]);

    let out_of_memory = [0x80, 0x18, 0x10, 1, 0x05, 0x00, 0x04, 0x05];
    let error = SdoError::Client(AbortCode(0x0504_0005));
    // Announced...
    let mut bytes = [0; 4];
    let mut client = Upload::new(node(), Address::new(0x1018, 1), Buffer::new(&mut bytes), CONFIG);
    asks(&mut client, 0, [0x40, 0x18, 0x10, 1, 0, 0, 0, 0], [0x41, 0x18, 0x10, 1, 5, 0, 0, 0]);
    aborts(&mut client, 0, out_of_memory, error);
    // ...and not announced.
    let mut client = Upload::new(node(), Address::new(0x1018, 1), Buffer::new(&mut bytes), CONFIG);
    asks(&mut client, 0, [0x40, 0x18, 0x10, 1, 0, 0, 0, 0], [0x40, 0x18, 0x10, 1, 0, 0, 0, 0]);
    asks(&mut client, 0, [0x60, 0, 0, 0, 0, 0, 0, 0], [0x01, 1, 2, 3, 4, 5, 6, 7]);
    aborts(&mut client, 0, out_of_memory, error);
}

/// The size is looked at when it is announced, through a reference, too; one that just fits is taken.
#[test]
fn a_buffer_is_asked_when_the_size_is_announced() {
    for (announced, next) in
        [(4, [0x60, 0, 0, 0, 0, 0, 0, 0]), (5, [0x80, 0x18, 0x10, 1, 0x05, 0x00, 0x04, 0x05])]
    {
        let mut bytes = [0; 4];
        let mut buffer = Buffer::new(&mut bytes);
        let mut client = Upload::new(node(), Address::new(0x1018, 1), &mut buffer, CONFIG);
        asks(&mut client, 0, [0x40, 0x18, 0x10, 1, 0, 0, 0, 0], [0x41, 0x18, 0x10, 1, announced, 0, 0, 0]);
        assert_eq!(client.poll(at(0)), Step::Send(request(next)), "{announced}");
    }
}

#[test]
fn an_abort_of_the_server_is_reported() {
    let abort = [0x80, 0x00, 0x20, 3, 0x30, 0x00, 0x09, 0x06];
    let error = Err(SdoError::Server(AbortCode(0x0609_0030)));
    let mut client = download(&[1]);
    asks(&mut client, 0, [0x2F, 0x00, 0x20, 3, 1, 0, 0, 0], abort);
    ends(&mut client, 0, error);
    let mut client = download(&[1, 2, 3, 4, 5]);
    asks(&mut client, 0, [0x21, 0x00, 0x20, 3, 5, 0, 0, 0], [0x60, 0x00, 0x20, 3, 0, 0, 0, 0]);
    asks(&mut client, 0, [0x05, 1, 2, 3, 4, 5, 0, 0], abort);
    ends(&mut client, 0, error);
    let mut client = upload();
    asks(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0], abort);
    ends(&mut client, 0, error);
    assert_eq!(
        SdoError::Server(AbortCode(0x0609_0030)).to_string(),
        "the device refused: 06090030h (invalid value for parameter)"
    );
}

#[test]
fn silence_is_a_time_out_that_the_server_is_told() {
    let mut client = upload();
    let start = u32::MAX - 100;
    assert_eq!(client.poll(at(start)), Step::Send(request([0x40, 0x00, 0x20, 3, 0, 0, 0, 0])));
    assert_eq!(client.poll(at(start.wrapping_add(999))), Step::Wait(at(899)));
    let timeout = [0x80, 0x00, 0x20, 3, 0x00, 0x00, 0x04, 0x05];
    aborts(&mut client, 899, timeout, SdoError::NoAnswer);
    let mut client = download(&[1, 2, 3, 4, 5]);
    sends(&mut client, 0, [0x21, 0x00, 0x20, 3, 5, 0, 0, 0]);
    client.handle(&response([0x60, 0x00, 0x20, 3, 0, 0, 0, 0]), at(999));
    sends(&mut client, 999, [0x05, 1, 2, 3, 4, 5, 0, 0]);
    assert_eq!(client.poll(at(1998)), Step::Wait(at(1999)));
    aborts(&mut client, 1999, timeout, SdoError::NoAnswer);
}

#[test]
fn answers_that_break_the_protocol_abort() {
    let command = [0x80, 0x00, 0x20, 3, 0x01, 0x00, 0x04, 0x05];
    let toggle = [0x80, 0x00, 0x20, 3, 0x00, 0x00, 0x03, 0x05];
    let length = [0x80, 0x00, 0x20, 3, 0x10, 0x00, 0x07, 0x06];
    let initiated = |data| {
        let mut client = download(data);
        let _ = client.poll(at(0));
        client.handle(&response([0x60, 0x00, 0x20, 3, 0, 0, 0, 0]), at(0));
        let _ = client.poll(at(0));
        client
    };
    let mut client = initiated(&[1, 2, 3, 4, 5]);
    client.handle(&response([0x30, 0, 0, 0, 0, 0, 0, 0]), at(0));
    aborts(&mut client, 0, toggle, SdoError::Client(AbortCode(0x0503_0000)));
    for wrong in [[0x00; 8], [0xE0; 8]] {
        let mut client = initiated(&[1, 2, 3, 4, 5]);
        client.handle(&response(wrong), at(0));
        aborts(&mut client, 0, command, SdoError::Client(AbortCode(0x0504_0001)));
    }
    let announced = || {
        let mut client = upload();
        let _ = client.poll(at(0));
        client.handle(&response([0x41, 0x00, 0x20, 3, 5, 0, 0, 0]), at(0));
        let _ = client.poll(at(0));
        client
    };
    // Toggle, too many, too few.
    for (bytes, abort, code) in [
        ([0x15, 1, 2, 3, 4, 5, 0, 0], toggle, 0x0503_0000),
        ([0x00, 1, 2, 3, 4, 5, 6, 7], length, 0x0607_0010),
        ([0x07, 1, 2, 3, 4, 0, 0, 0], length, 0x0607_0010),
        ([0x20, 0, 0, 0, 0, 0, 0, 0], command, 0x0504_0001),
    ] {
        let mut client = announced();
        client.handle(&response(bytes), at(0));
        aborts(&mut client, 0, abort, SdoError::Client(AbortCode(code)));
    }
}

#[test]
fn frames_of_others_and_late_answers_change_nothing() {
    let mut client = upload();
    // Before the first request, no frame is an answer.
    client.handle(&response([0x43, 0x00, 0x20, 3, 9, 9, 9, 9]), at(0));
    sends(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
    let other_node = canopen::NodeId::new(6).unwrap();
    for frame in [
        Frame::of(CobId::sdo_response(other_node), &[0x43, 0x00, 0x20, 3, 9, 9, 9, 9]),
        Frame::of(CobId::sdo_response(node()), &[0x43, 0x00, 0x20, 3, 9, 9, 9]),
        Frame::of(CobId::heartbeat(node()), &[0x7F]),
        // The answer to an earlier transfer that timed out.
        response([0x43, 0x00, 0x10, 0, 9, 9, 9, 9]),
        response([0x60, 0x00, 0x10, 0, 0, 0, 0, 0]),
    ] {
        client.handle(&frame, at(0));
        assert_eq!(client.poll(at(0)), Step::Wait(at(1000)), "{frame}");
    }
    client.handle(&response([0x4F, 0x00, 0x20, 3, 1, 0, 0, 0]), at(0));
    ends(&mut client, 0, Ok(()));
    assert_eq!(client.into_sink(), [1]);
}

#[test]
fn late_answers_do_not_put_off_the_time_out() {
    let mut client = upload();
    sends(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
    for now in [300, 600, 900] {
        client.handle(&response([0x43, 0x00, 0x10, 0, 9, 9, 9, 9]), at(now));
        assert_eq!(client.poll(at(now)), Step::Wait(at(1000)));
    }
    aborts(&mut client, 1000, [0x80, 0x00, 0x20, 3, 0, 0, 4, 5], SdoError::NoAnswer);
}

#[test]
fn a_caller_can_give_up() {
    let mut client = download(&[1, 2, 3, 4, 5]);
    sends(&mut client, 0, [0x21, 0x00, 0x20, 3, 5, 0, 0, 0]);
    client.abort(AbortCode::GENERAL);
    let general = [0x80, 0x00, 0x20, 3, 0x00, 0x00, 0x00, 0x08];
    aborts(&mut client, 0, general, SdoError::Client(AbortCode(0x0800_0000)));
    let mut client = upload();
    sends(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
    client.abort(AbortCode::GENERAL);
    aborts(&mut client, 0, general, SdoError::Client(AbortCode(0x0800_0000)));
}

/// A late answer about another object, or another sub-index, belongs to an earlier transfer: it is
/// neither success nor failure of this one.
#[test]
fn an_answer_about_another_object_is_no_answer() {
    /// A client that waits, the answer to it without the OBJECT, and what it sends next, if it has
    /// not ended.
    type Case = (Box<dyn Transfer>, u8, [u8; 4], Option<u8>);
    let cases: Vec<Case> = vec![
        (Box::new(download(&[1])), 0x60, [0; 4], None),
        (Box::new(download(NINE)), 0x60, [0; 4], Some(0x00)),
        (Box::new(upload()), 0x4F, [7, 0, 0, 0], None),
        (Box::new(upload()), 0x41, [9, 0, 0, 0], Some(0x60)),
        (Box::new(Download::as_blocks(node(), OBJECT, NINE, CONFIG)), 0xA4, [127, 0, 0, 0], Some(0x01)),
        (
            Box::new(Upload::as_blocks(node(), OBJECT, Vec::new(), CONFIG, BLOCK)),
            0xC6,
            [9, 0, 0, 0],
            Some(0xA3),
        ),
    ];
    for (mut client, command, [a, b, c, d], next) in cases {
        assert!(matches!(client.poll(at(0)), Step::Send(_)));
        for (index, sub) in [(0x2001_u16, 3), (0x2100, 3), (0x2000, 4), (0x2000, 0)] {
            let [low, high] = index.to_le_bytes();
            client.handle(&response([command, low, high, sub, a, b, c, d]), at(1));
            assert!(matches!(client.poll(at(1)), Step::Wait(_)), "{command:#x}, {index:#x}, {sub}");
        }
        client.handle(&response([command, 0x00, 0x20, 3, a, b, c, d]), at(2));
        match (client.poll(at(2)), next) {
            (Step::Send(frame), Some(next)) => {
                assert_eq!(frame.exactly::<8>().map(|bytes| bytes[0]), Some(next), "{command:#x}")
            }
            (Step::Done(Ok(())), None) => {}
            (other, _) => panic!("{command:#x}: {other:?}"),
        }
    }
}

/// An abort names the object of the transfer that it ends (CiA 301 clause 7.2.4.3.17): one for
/// another object does not end this transfer, wherever it comes.
#[test]
fn an_abort_for_another_object_is_no_answer() {
    let block_download = || Box::new(Download::as_blocks(node(), OBJECT, NINE, CONFIG));
    let block_upload = || Box::new(Upload::as_blocks(node(), OBJECT, Vec::new(), CONFIG, BLOCK));
    /// A client, and the answers after which it waits.
    type Case = (&'static str, Box<dyn Transfer>, Vec<[u8; 8]>);
    let cases: Vec<Case> = vec![
        ("expedited download", Box::new(download(&[1])), vec![]),
        ("segmented download", Box::new(download(NINE)), vec![[0x60, 0x00, 0x20, 3, 0, 0, 0, 0]]),
        ("upload", Box::new(upload()), vec![]),
        ("segmented upload", Box::new(upload()), vec![[0x41, 0x00, 0x20, 3, 9, 0, 0, 0]]),
        ("block download, begun", block_download(), vec![]),
        ("block download", block_download(), vec![[0xA4, 0x00, 0x20, 3, 127, 0, 0, 0]]),
        (
            "block download, ending",
            block_download(),
            vec![[0xA4, 0x00, 0x20, 3, 127, 0, 0, 0], [0xA2, 2, 127, 0, 0, 0, 0, 0]],
        ),
        ("block upload, begun", block_upload(), vec![]),
        ("block upload", block_upload(), vec![[0xC6, 0x00, 0x20, 3, 9, 0, 0, 0]]),
    ];
    for (name, mut client, answers) in cases {
        let until_it_waits = |client: &mut dyn Transfer| loop {
            match client.poll(at(1)) {
                Step::Send(_) => {}
                step => return step,
            }
        };
        until_it_waits(&mut *client);
        for answer in answers {
            client.handle(&response(answer), at(1));
            until_it_waits(&mut *client);
        }
        for (index, sub) in [(0x1F50_u16, 1), (0x2000, 4), (0x2001, 3)] {
            let [low, high] = index.to_le_bytes();
            client.handle(&response([0x80, low, high, sub, 0x01, 0x00, 0x04, 0x05]), at(1));
            assert!(matches!(until_it_waits(&mut *client), Step::Wait(_)), "{name}: {index:04X}h/{sub}");
        }
        client.handle(&response([0x80, 0x00, 0x20, 3, 0x30, 0x00, 0x09, 0x06]), at(2));
        let refused = Err(SdoError::Server(AbortCode(0x0609_0030)));
        assert_eq!(until_it_waits(&mut *client), Step::Done(refused), "{name}");
    }
    // Some servers name no object at all.
    let mut client = upload();
    asks(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0], [0x80, 0, 0, 0, 0, 0, 0x02, 0x06]);
    ends(&mut client, 0, Err(SdoError::Server(AbortCode::NO_OBJECT)));
}

/// A server answers in the order of the requests: what it still sends of a transfer that this side
/// has given up comes before its answer to the next initiate.
#[test]
fn answers_to_the_attempt_before_are_passed_over() {
    // The first attempt was given up in its segments.
    let mut client = upload();
    sends(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
    for late in [[0x00, 1, 2, 3, 4, 5, 6, 7], [0x1D, 1, 0, 0, 0, 0, 0, 0], [0x20, 0, 0, 0, 0, 0, 0, 0]] {
        client.handle(&response(late), at(5));
        assert_eq!(client.poll(at(5)), Step::Wait(at(1000)));
    }
    client.handle(&response([0x41, 0x00, 0x20, 3, 9, 0, 0, 0]), at(6));
    sends(&mut client, 6, [0x60, 0, 0, 0, 0, 0, 0, 0]);
    // It was given up at its initiate: that answer came first, and this one is the second.
    client.handle(&response([0x41, 0x00, 0x20, 3, 9, 0, 0, 0]), at(7));
    assert_eq!(client.poll(at(7)), Step::Wait(at(1006)));
    client.handle(&response([0x00, 1, 2, 3, 4, 5, 6, 7]), at(8));
    sends(&mut client, 8, [0x70, 0, 0, 0, 0, 0, 0, 0]);
    client.handle(&response([0x1B, 8, 9, 0, 0, 0, 0, 0]), at(9));
    ends(&mut client, 9, Ok(()));
    assert_eq!(client.into_sink(), [1, 2, 3, 4, 5, 6, 7, 8, 9]);
    // A download: the acknowledgement of a segment, and of a sub-block.
    let mut client = download(&[1]);
    sends(&mut client, 0, [0x2F, 0x00, 0x20, 3, 1, 0, 0, 0]);
    for late in [[0x20, 0, 0, 0, 0, 0, 0, 0], [0xA2, 127, 127, 0, 0, 0, 0, 0]] {
        client.handle(&response(late), at(5));
        assert_eq!(client.poll(at(5)), Step::Wait(at(1000)));
    }
    client.handle(&response([0x60, 0x00, 0x20, 3, 0, 0, 0, 0]), at(6));
    ends(&mut client, 6, Ok(()));
    // A download whose first initiate was answered late: the second answer comes in its segments.
    let mut client = download(NINE);
    sends(&mut client, 0, [0x21, 0x00, 0x20, 3, 9, 0, 0, 0]);
    client.handle(&response([0x60, 0x00, 0x20, 3, 0, 0, 0, 0]), at(5));
    sends(&mut client, 5, [0x00, 1, 2, 3, 4, 5, 6, 7]);
    client.handle(&response([0x60, 0x00, 0x20, 3, 0, 0, 0, 0]), at(6));
    assert_eq!(client.poll(at(6)), Step::Wait(at(1005)));
    client.handle(&response([0x20, 0, 0, 0, 0, 0, 0, 0]), at(7));
    sends(&mut client, 7, [0x1B, 8, 9, 0, 0, 0, 0, 0]);
    let mut client = Download::as_blocks(node(), OBJECT, NINE, CONFIG);
    sends(&mut client, 0, [0xC6, 0x00, 0x20, 3, 9, 0, 0, 0]);
    client.handle(&response([0xA4, 0x00, 0x20, 3, 127, 0, 0, 0]), at(5));
    assert_eq!(client.poll(at(5)), Step::Send(request([0x01, 1, 2, 3, 4, 5, 6, 7])));
    client.handle(&response([0xA4, 0x00, 0x20, 3, 127, 0, 0, 0]), at(6));
    sends(&mut client, 6, [0x82, 8, 9, 0, 0, 0, 0, 0]);
    // If nothing else comes, the answer was wrong, and the server not silent.
    let mut client = upload();
    sends(&mut client, 0, [0x40, 0x00, 0x20, 3, 0, 0, 0, 0]);
    client.handle(&response([0xE0; 8]), at(5));
    let command = [0x80, 0x00, 0x20, 3, 0x01, 0x00, 0x04, 0x05];
    aborts(&mut client, 1000, command, SdoError::Client(AbortCode::COMMAND));
}
