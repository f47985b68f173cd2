//! Several devices on the bus, and foreign frames on the bus. All in virtual time; frames are
//! written by hand from CiA 301 and CiA 305.

use std::collections::BTreeSet;

use canopen::program::ProgramControl;
use canopen::{Address, BitRate};
use coboot_tests::bench::{Bench, HEARTBEAT, NODE, REQUEST, RESCUE_WINDOW_MS, RESPONSE};
use coboot_tests::firmware;
use coflash_core::device::{Doing, Session};
use coflash_core::update::{flash, Event, FlashOptions};
use emulator::bus::{Outcome, Record};
use emulator::frame::Frame;
use emulator::time::{Span, Time};
use kit::bench::crc16;
use kit::rig::{block, crc32};

const DATA: Address = Address::new(0x1F50, 1);
const STATUS: Address = Address::new(0x1F57, 1);
const VERSION: Address = Address::new(0x100A, 0);
const LSS_REQUEST: u16 = 0x7E5;
const LSS_RESPONSE: u32 = 0x7E4;

/// One bit, and the shortest pause between two frames (ISO 11898-1: 3 bits), at 1 Mbit/s.
const BIT: Span = Span::from_micros(1);
const INTERMISSION: Span = Span(3 * BIT.0);

/// A board in its bootloader, without a program, at 1 Mbit/s.
fn fast_board() -> Bench {
    let mut bench = Bench::at_rate(BitRate::K1000);
    bench.run_ms(10);
    bench
}

/// Whether a node answers, and what runs on it.
fn running(bench: &mut Bench, node: u8) -> Option<&'static str> {
    let device_type = bench.session_with(node).device_type().unwrap()?;
    Some(if device_type.is_bootloader() { "bootloader" } else { "application" })
}

fn install(session: &mut Session<'_>, image: &str) {
    let options = FlashOptions::default().trial_run(false);
    let report = flash(session, firmware::blocks(image), &options, &mut |event| {
        assert!(!matches!(event, Event::Retry(_)), "{event}");
    });
    report.unwrap();
}

/// Three boards; two have node-IDs, the third gets one from the master, selected by its identity.
#[test]
fn three_devices_are_updated_one_after_the_other_and_one_of_them_had_no_node_id() {
    let mut bench = Bench::of_boards(3);
    let boards = bench.boards();
    let nodes = [2, 3, 0xFF];
    let serials: Vec<u32> =
        boards.iter().zip(nodes).map(|(board, node)| bench.commission(*board, node, BitRate::K125)).collect();
    assert_eq!(
        serials.iter().collect::<BTreeSet<_>>().len(),
        3,
        "no two devices share a serial number: {serials:X?}"
    );

    bench.power_on();
    let from = bench.time();
    bench.run_ms(100);
    let boot_ups: BTreeSet<u32> =
        bench.frames_since(from).iter().filter(|(.., data)| data[..] == [0]).map(|(_, id, _)| *id).collect();
    assert_eq!(boot_ups, [0x702, 0x703].into(), "the third is silent");

    // The first two are updated while the third waits.
    install(&mut bench.session_with(2), firmware::APP_V1);
    install(&mut bench.session_with(3), firmware::APP_V1);

    // Does any device have no node-ID? Then the device with this identity gets the next free one.
    bench.assert_answer(
        LSS_REQUEST,
        &[0x4C, 0, 0, 0, 0, 0, 0, 0],
        LSS_RESPONSE,
        &[0x50, 0, 0, 0, 0, 0, 0, 0],
    );
    // Vendor, product and revision from the board file.
    let identity = &bsp::IDENTITY;
    for (command, part) in
        [(0x40, identity.vendor_id), (0x41, identity.product_code), (0x42, identity.revision)]
    {
        let [a, b, c, d] = part.to_le_bytes();
        bench.post(LSS_REQUEST, &[command, a, b, c, d, 0, 0, 0]);
    }
    let [a, b, c, d] = serials[2].to_le_bytes();
    for (request, answer) in [
        ([0x43, a, b, c, d, 0, 0, 0], [0x44, 0, 0, 0, 0, 0, 0, 0]),
        ([0x11, 4, 0, 0, 0, 0, 0, 0], [0x11, 0, 0, 0, 0, 0, 0, 0]),
        ([0x17, 0, 0, 0, 0, 0, 0, 0], [0x17, 0, 0, 0, 0, 0, 0, 0]),
    ] {
        let answered = bench.ask(LSS_REQUEST, &request, LSS_RESPONSE);
        assert_eq!(answered.as_deref(), Some(&answer[..]), "to {request:02X?}");
    }
    bench.post(LSS_REQUEST, &[0x04, 0, 0, 0, 0, 0, 0, 0]);
    bench.await_boot_up_of(4, 100);
    install(&mut bench.session_with(4), firmware::APP_V1);

    // Each again, the last first, with another program: the other devices continue to run theirs.
    for (done, node) in [4, 3, 2].into_iter().enumerate() {
        install(&mut bench.session_with(node), firmware::APP_V2);
        for (n, other) in [4, 3, 2].into_iter().enumerate() {
            let expected = if n <= done { "2.0.0" } else { "1.0.0" };
            assert_eq!(bench.session_with(other).read_text(VERSION).unwrap(), expected, "node {other}");
        }
    }
    let off = bench.time();
    bench.power_cycle();
    // None of the programs was confirmed.
    bench.run_ms(RESCUE_WINDOW_MS + 200);
    for (node, serial) in [2, 3, 4].into_iter().zip(serials) {
        assert_eq!(running(&mut bench, node), Some("application"), "node {node}");
        let mut session = bench.session_with(node);
        assert_eq!(session.read_number(Address::new(0x1018, 4)).unwrap(), serial, "node {node}");
        assert_eq!(session.read_text(VERSION).unwrap(), "2.0.0", "node {node}");
    }
    assert_eq!(running(&mut bench, NODE), None, "nobody has the board file's node-ID any more");
    // Except for a frame that was being sent when the power was cut.
    let mut disturbed = bench.records();
    disturbed.retain(|record| record.outcome != Outcome::Good && !(record.start..=record.end).contains(&off));
    assert!(disturbed.is_empty(), "nobody disturbed anybody: {disturbed:?}");
    bench.assert_nothing_unmodelled();
}

/// Foreign frames that occur on a bus: none is for the device, some are similar to its frames.
fn foreign(n: usize) -> Frame {
    let byte = n as u8;
    let data = [byte, !byte, 0x55, byte ^ 0x0F, 0x33, byte, 0, byte];
    let frame = match n % 8 {
        0 => Frame::standard(0x181, &data),
        // TIME.
        1 => Frame::standard(0x100, &data[..6]),
        // The SDO channel of the next node.
        2 => Frame::standard(0x602, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]),
        // 29-bit identifiers that begin like, or are equal to, the identifier of the device's SDO
        // request.
        3 => Frame::extended(0x601 << 18, &data),
        4 => Frame::extended(0x601, &data),
        // Heartbeats of other nodes.
        5 => Frame::standard(0x77F, &[0x05]),
        // Answers of LSS slaves.
        6 => Frame::standard(0x7E4, &data),
        // Each data length code that means eight bytes.
        _ => Frame::standard(0x6FF, &data).and_then(|frame| frame.with_dlc(8 + byte / 8 % 8)),
    };
    frame.expect("an identifier and its data")
}

/// The frames on the device's SDO channel without the reads of 1F57h; their number depends on the
/// time.
fn sdo_trace(records: &[Record], from: Time) -> Vec<(u32, Vec<u8>)> {
    let of_channel = |record: &&Record| {
        let id = record.frame.raw_id();
        record.start >= from && !record.frame.is_extended() && (id == u32::from(REQUEST) || id == RESPONSE)
    };
    let frames =
        records.iter().filter(of_channel).inspect(|record| assert_eq!(record.outcome, Outcome::Good));
    frames
        .map(|record| (record.frame.raw_id(), record.frame.data().to_vec()))
        .filter(|(_, data)| data[1..4] != [0x57, 0x1F, 0x01])
        .collect()
}

/// A whole update at 1 Mbit/s, while other nodes leave no gap between two frames: the SDO channel
/// has exactly the same frames as on a quiet bus.
#[test]
fn a_bus_full_of_foreign_frames_costs_no_sdo_frame() {
    let mut quiet = fast_board();
    let from = quiet.time();
    install(&mut quiet.session(), firmware::APP_V1);
    let expected = sdo_trace(&quiet.records(), from);
    assert!(expected.len() > 2000, "{}", expected.len());

    let mut bench = fast_board();
    let others = bench.world.add_host_port(1_000_000);
    for n in 0..200_000 {
        bench.world.send(others, foreign(n));
    }
    let from = bench.time();
    let interrupts = receive_interrupts(&mut bench);
    install(&mut bench.session(), firmware::APP_V1);
    let interrupts = receive_interrupts(&mut bench) - interrupts;
    assert!(bench.world.port_mut(others).waiting() > 0, "the load lasted to the end");

    let records = bench.records();
    let loaded: Vec<&Record> = records.iter().filter(|record| record.start >= from).collect();
    for pair in loaded.windows(2) {
        assert!(pair[1].start - pair[0].end <= INTERMISSION, "a gap on the bus behind {:?}", pair[0]);
    }
    assert_eq!(sdo_trace(&records, from), expected);
    let requests = loaded
        .iter()
        .filter(|record| !record.frame.is_extended() && record.frame.raw_id() == u32::from(REQUEST));
    let requests = requests.count() as u64;
    assert!(
        interrupts <= requests,
        "{interrupts} interrupts for {requests} requests among {} frames",
        loaded.len()
    );
    assert_eq!(lost_frames(&bench, from), 0);
    assert_eq!(bench.text(0x100A), "1.0.0");
    bench.assert_nothing_unmodelled();
}

/// The number of receive interrupts of the device: CAN1_RX0 is interrupt 20 (RM0090 table 62), and
/// thus exception 36.
fn receive_interrupts(bench: &mut Bench) -> u64 {
    bench.machine().counters().exceptions[16 + 20]
}

/// Emergencies that report lost frames: 8110h.
fn lost_frames(bench: &Bench, from: Time) -> usize {
    bench.emergencies(from).iter().filter(|data| data[..2] == [0x10, 0x81]).count()
}

/// The most frames that a client may send without waiting, as fast as the wire carries them.
#[test]
fn a_burst_of_127_segments_back_to_back_at_1_mbit_is_taken_without_loss() {
    let mut bench = fast_board();
    bench.session().command(1, ProgramControl::Clear).unwrap();
    bench.session().await_idle(1, Doing::Read(STATUS)).unwrap();
    bench.session().write(DATA, &block(0, 0, &[0; 8]), Doing::Block(0), &mut |_| {}).unwrap();
    bench.session().await_idle(1, Doing::Read(STATUS)).unwrap();

    // Two sub-blocks of 127 segments; the data bits change so often that no stuff bit makes the
    // frames longer.
    let data = firmware::made_up(2 * 127 * 7 - 16, |n| if n % 64 == 0 { (n / 64) as u8 } else { 0x55 });
    let block = block(1, firmware::board().programs[0].base, &data);
    assert_eq!(block.len(), 1778);
    // During the first burst the device's own heartbeat finds no room on the bus: this delays
    // nothing else.
    let from = bench.time();
    while heartbeats(&bench, from).is_empty() {
        bench.run_ms(1);
    }
    bench.run_ms(996);
    bench.assert_answer(
        REQUEST,
        &[0xC6, 0x50, 0x1F, 0x01, 0xF2, 0x06, 0, 0],
        RESPONSE,
        &[0xA4, 0x50, 0x1F, 0x01, 127, 0, 0, 0],
    );
    let segments: Vec<&[u8]> = block.chunks(7).collect();
    for sub_block in segments.chunks(127) {
        let sent = bench.time();
        let mut frames: Vec<Vec<u8>> = Vec::new();
        for (n, segment) in sub_block.iter().enumerate() {
            let last = segment.as_ptr_range().end == block.as_ptr_range().end;
            let sequence = (n as u8 + 1) | if last { 0x80 } else { 0 };
            frames.push([&[sequence], *segment].concat());
        }
        let (last, before) = frames.split_last().expect("127 segments");
        before.iter().for_each(|frame| bench.post(REQUEST, frame));
        let answer = bench.ask(REQUEST, last, RESPONSE);
        // All were accepted, and as many may follow.
        assert_eq!(answer.as_deref(), Some(&[0xA2, 127, 127, 0, 0, 0, 0, 0][..]));
        let records = bench.records();
        let burst: Vec<&Record> = records
            .iter()
            .filter(|record| record.start >= sent && record.frame.raw_id() == u32::from(REQUEST))
            .collect();
        assert_eq!(burst.len(), 127);
        for pair in burst.windows(2) {
            assert!(pair[1].start - pair[0].end <= INTERMISSION, "a pause behind {:?}", pair[0]);
        }
    }
    let beats = heartbeats(&bench, from);
    let [first, second] = beats[..] else { panic!("{beats:?}") };
    let late = second - first;
    assert!(
        late > Span::from_millis(1008) && late < Span::from_millis(1015),
        "the second heartbeat had to wait for the end of the first burst: {} us",
        late.0 / BIT.0
    );
    let [low, high, ..] = crc16(&block).to_le_bytes();
    bench.assert_answer(REQUEST, &[0xC1, low, high, 0, 0, 0, 0, 0], RESPONSE, &[0xA1, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.session().await_idle(1, Doing::Read(STATUS)).unwrap().to_word(), 0);
    // The status is not busy as soon as there is room for the next block; the flash must still
    // erase and program.
    bench.run_ms(2000);
    let program = firmware::program_offset();
    assert!(bench.machine().flash()[program..].starts_with(&data));
    assert_eq!(lost_frames(&bench, from), 0);
}

/// The times of the device's heartbeats on the bus.
fn heartbeats(bench: &Bench, from: Time) -> Vec<Time> {
    bench.frames_of(HEARTBEAT, from).into_iter().map(|(at, _)| at).collect()
}

#[test]
fn the_checks_of_this_file_know_the_published_values() {
    assert_eq!(crc16(b"123456789"), 0x31C3);
    assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
}
