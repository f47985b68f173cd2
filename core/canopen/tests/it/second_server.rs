//! The second SDO server (1201h): its COB-IDs, and one transfer for two servers. Frames written by
//! hand from CiA 301 section 7.2.4.3.

use canopen::frame::Channel;
use canopen::sdo::second::{SecondServer, INVALID, REQUEST, RESPONSE};
use canopen::sdo::server::Config;
use canopen::{AbortCode, CobId, Frame};
use kit::bus::{response, Bench, Event};

const GROUP: u16 = 0x6DF;
const OWN: u16 = 0x681;
const READ_1000: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
const IS_1000: [u8; 8] = [0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10];
const BEGIN: [u8; 8] = [0xC2, 0x50, 0x1F, 1, 0, 0x10, 0, 0];
const GRANTED: [u8; 8] = [0xA4, 0x50, 0x1F, 1, 127, 0, 0, 0];

fn id(number: u16) -> CobId {
    CobId::new(number).unwrap()
}

fn to_group(bytes: [u8; 8]) -> Frame {
    Frame::of(id(GROUP), &bytes)
}

fn from_group(bytes: [u8; 8]) -> Frame {
    Frame::of(id(OWN), &bytes)
}

fn bench() -> Bench {
    let mut bench = Bench::with(Config::DEFAULT);
    bench.device.second = Some(Channel { request: id(GROUP), response: id(OWN) });
    bench
}

/// CiA 301 table 40, restricted CAN-IDs: 000h–07Fh, 101h–180h, 581h–5FFh, 601h–67Fh, 6E0h–6FFh,
/// 701h–7FFh. (80h–100h, 580h, 600h and 700h are SYNC, EMCY and TIME and their neighbours.)
#[test]
fn only_free_cob_ids_are_taken() {
    for value in 0..=0x7FF {
        let restricted = matches!(value, 0..=0x180 | 0x580..=0x67F | 0x6E0..=0x7FF);
        let written = SecondServer::NONE.clone().write(REQUEST, value);
        assert_eq!(written.is_err(), restricted, "{value:03X}h");
    }
    // A dynamic COB-ID (bit 30), one of 29 bits (bit 29), and more than 11 bits.
    for value in [0x4000_06DF, 0x2000_06DF, 0x0000_0EDF, 0x0001_06DF] {
        assert_eq!(SecondServer::NONE.clone().write(RESPONSE, value), Err(AbortCode::INVALID_VALUE));
    }
}

#[test]
fn a_server_exists_while_both_cob_ids_are_valid_and_changes_only_when_it_does_not() {
    let mut second = SecondServer::NONE;
    assert_eq!((second.read(REQUEST), second.read(RESPONSE)), (INVALID, INVALID));
    assert_eq!(second.channel(), Channel::NONE);
    assert_eq!(second.write(REQUEST, GROUP.into()), Ok(()));
    assert_eq!(second.channel(), Channel::NONE);
    assert_eq!(second.write(RESPONSE, GROUP.into()), Err(AbortCode::INVALID_VALUE), "the group's own");
    assert_eq!(second.write(RESPONSE, OWN.into()), Ok(()));
    assert_eq!(second.channel(), Channel { request: id(GROUP), response: id(OWN) });
    // CiA 301: bits 0 to 29 must not change while the object is valid.
    assert_eq!(second.write(REQUEST, 0x6DE), Err(AbortCode::INVALID_VALUE));
    assert_eq!(second.write(REQUEST, GROUP.into()), Ok(()), "the same value");
    assert_eq!(second.write(REQUEST, INVALID | u32::from(GROUP)), Ok(()));
    assert_eq!(second.channel(), Channel::NONE);
    assert_eq!(second.read(REQUEST), INVALID | u32::from(GROUP));
    assert_eq!(second.write(REQUEST, 0x6DE), Ok(()));
    assert_eq!(second.channel(), Channel { request: id(0x6DE), response: id(OWN) });
}

#[test]
fn each_server_answers_with_its_own_cob_id() {
    let mut bench = bench();
    bench.send(&to_group(READ_1000));
    assert_eq!(bench.sent(), [from_group(IS_1000)]);
    assert_eq!(bench.ask(READ_1000), [response(IS_1000)]);
    bench.device.second = None;
    bench.send(&to_group(READ_1000));
    assert_eq!(bench.sent(), []);
}

/// Frames that are no requests do not change the server that an answer comes from.
#[test]
fn a_frame_of_another_length_moves_no_answer() {
    let mut bench = bench();
    bench.send(&kit::bus::request(READ_1000));
    bench.send(&Frame::of(id(GROUP), &READ_1000[..7]));
    assert_eq!(bench.sent(), [response(IS_1000)]);
}

/// A request to the other server is never taken for a segment, whatever its first byte is: 40h here
/// could be segment 64.
#[test]
fn a_request_to_the_other_server_in_a_block_download_is_answered_at_once() {
    type Send = fn([u8; 8]) -> Frame;
    for (one, other, answer) in [
        (to_group as Send, kit::bus::request as Send, response as Send),
        (kit::bus::request as Send, to_group as Send, from_group as Send),
    ] {
        let mut bench = bench();
        bench.send(&one(BEGIN));
        assert_eq!(bench.sent().len(), 1);
        for seqno in 1..=63 {
            bench.send(&one([seqno, 1, 2, 3, 4, 5, 6, 7]));
        }
        assert_eq!(bench.sent(), []);
        bench.send(&other(READ_1000));
        assert_eq!(bench.sent(), [answer(IS_1000)]);
        assert_eq!(bench.device.events, [Event::Start(Some(0x1000)), Event::Cancel]);
    }
}

/// Several devices with one COB-ID for requests: each acknowledges for itself.
#[test]
fn devices_of_a_group_take_one_download() {
    let mut benches: Vec<Bench> = (1..=3)
        .map(|number| {
            let mut bench = bench();
            bench.device.second = Some(Channel { request: id(GROUP), response: id(0x680 + number) });
            bench
        })
        .collect();
    let mut ask = |bytes: [u8; 8]| -> Vec<Frame> {
        benches
            .iter_mut()
            .flat_map(|bench| {
                bench.send(&to_group(bytes));
                bench.sent()
            })
            .collect()
    };
    let all = |bytes: [u8; 8]| [0x681, 0x682, 0x683].map(|number| Frame::of(id(number), &bytes));
    // 14 bytes without a CRC.
    assert_eq!(ask([0xC2, 0x50, 0x1F, 1, 14, 0, 0, 0]), all(GRANTED));
    assert_eq!(ask([1, 1, 2, 3, 4, 5, 6, 7]), []);
    assert_eq!(ask([0x82, 8, 9, 10, 11, 12, 13, 14]), all([0xA2, 2, 127, 0, 0, 0, 0, 0]));
    assert_eq!(ask([0xC1, 0, 0, 0, 0, 0, 0, 0]), all([0xA1, 0, 0, 0, 0, 0, 0, 0]));
    for bench in &benches {
        assert_eq!(bench.device.events, [Event::Start(Some(14)), Event::End((1..=14).collect())]);
    }
}
