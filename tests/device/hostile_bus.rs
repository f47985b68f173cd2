//! How long a request waits for its answer on a hostile bus, with the built firmware in virtual
//! time: while a flood lasts, after it, and after bus-off. The limits are counted in bits of ISO
//! 11898-1 and in the waits of the device (`core/canopen/src/line.rs`).

use coboot_tests::bench::{Bench, BIT_RATE, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use emulator::bus::fault::{Fault, FaultAction, FrameMatch, When};
use emulator::bus::Outcome;
use emulator::frame::Frame;
use emulator::time::{Span, Time};
use emulator::world::PortId;

const READ_1000: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
const IS_BOOTLOADER: [u8; 8] = [0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10];
/// The longest frame (29-bit identifier, 8 bytes, all stuff bits) with its intermission, and a frame
/// of SDO likewise.
const LONGEST_BITS: u64 = 160 + 3;
const SDO_BITS: u64 = 135 + 3;
/// From a request to its answer in the mailbox, in us: two ticks of the protocol task, of 2 ms.
const DEVICE_US: u64 = 4000;

/// The time of so many bits, in us.
fn bits(bits: u64) -> u64 {
    bits * 1_000_000 / u64::from(BIT_RATE)
}

fn micros(span: Span) -> u64 {
    span.0 / Span::from_micros(1).0
}

/// A board in its bootloader, without a program.
fn board() -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.run_ms(50);
    bench
}

/// The end of each answer to a read of 1000h since then.
fn answers(bench: &Bench, from: Time) -> Vec<Time> {
    let frames = bench.frames_since(from).into_iter();
    frames.filter(|(_, id, data)| *id == RESPONSE && data[..] == IS_BOOTLOADER).map(|(at, ..)| at).collect()
}

/// Runs until an answer is complete that begins at or after `from`; returns the time from `since` to
/// it, in us.
///
/// # Panics
/// If there is none within 20 s.
fn await_answer(bench: &mut Bench, from: Time, since: Time) -> u64 {
    let deadline = from + Span::from_millis(20_000);
    while bench.time() < deadline {
        if let Some(at) = answers(bench, from).first() {
            return micros(*at - since);
        }
        bench.world.run_for(Span::from_micros(500));
    }
    panic!("no answer within 20 s");
}

/// Fills the bus from this port with these frames, again and again.
fn flood(bench: &mut Bench, port: PortId, frames: &[Frame], count: usize) {
    for frame in frames.iter().cycle().take(count) {
        bench.world.send(port, *frame);
    }
}

/// One such frame reset every node of the bus: bxCAN hands the data length code on as it was on the bus
/// (ST's HAL and Linux limit it), and a driver took it for a length.
#[test]
fn a_data_length_code_above_8_is_eight_bytes_to_bootloader_and_program() {
    let mut bench = board();
    bench.assert_takes_every_dlc();
    bench.install(firmware::APP_V1);
    assert!(!bench.is_bootloader(NODE));
    bench.assert_takes_every_dlc();
}

/// Frames of higher priority than the heartbeat and lower priority than the request keep the bus
/// full for five periods of the heartbeat. The heartbeats wait, and hold up no answer.
#[test]
fn a_flood_of_lower_priority_holds_up_no_answer() {
    let mut bench = board();
    let others = bench.world.add_host_port(BIT_RATE);
    let long = |raw: u32| Frame::extended(raw, &[0; 8]).expect("29 bits");
    // The base identifiers are 602h and 6FFh.
    let frames = [
        Frame::standard(0x602, &[0xFF; 8]).expect("11 bits"),
        long(0x602 << 18),
        Frame::standard(0x6FF, &[]).expect("11 bits"),
        long(0x6FF << 18 | 0x3_FFFF),
    ];
    let from = bench.time();
    flood(&mut bench, others, &frames, 10_000);
    // The request waits for a frame, and so does the answer.
    let limit = bits(2 * LONGEST_BITS + 2 * SDO_BITS) + DEVICE_US;
    let mut slowest = 0;
    while bench.time() < from + Span::from_millis(5500) {
        let asked = bench.time();
        bench.post(REQUEST, &READ_1000);
        slowest = slowest.max(await_answer(&mut bench, asked, asked));
        bench.run_ms(37);
    }
    assert!(bench.world.port_mut(others).waiting() > 0, "the flood lasted to the end");
    let heartbeat = 0x700 + u32::from(NODE);
    let beats = bench.frames_since(from).into_iter().filter(|(_, id, _)| *id == heartbeat);
    assert_eq!(beats.count(), 0, "the heartbeats had to wait");
    println!("slowest answer: {slowest} us, limit {limit} us");
    assert!(slowest <= limit, "{slowest} us of {limit} us");
}

/// Frames of the highest priority leave room for nothing. After the last one the request, which
/// waited as long as the heartbeats, is answered at once; and so is the next one.
#[test]
fn behind_a_flood_of_higher_priority_the_answer_comes_at_once() {
    let mut bench = board();
    let others = bench.world.add_host_port(BIT_RATE);
    // NMT commands of a length that is none: the device takes them from its FIFO.
    let frames =
        [Frame::standard(0x000, &[]).expect("11 bits"), Frame::extended(5, &[0; 8]).expect("29 bits")];
    let asked = bench.time();
    flood(&mut bench, others, &frames, 6000);
    bench.run_ms(1);
    bench.post(REQUEST, &READ_1000);
    while bench.world.port_mut(others).waiting() > 0 {
        bench.run_ms(1);
    }
    let end = bench.time();
    assert!(micros(end - asked) > 4_000_000, "the heartbeats had to wait");
    // The request and the answer; a heartbeat may be on the bus before each of them.
    let limit = bits(4 * SDO_BITS) + DEVICE_US;
    let after = await_answer(&mut bench, asked, end);
    println!("answer after {after} us, limit {limit} us");
    assert!(after <= limit, "{after} us of {limit} us");
    let asked = bench.time();
    bench.post(REQUEST, &READ_1000);
    let after = await_answer(&mut bench, asked, asked);
    assert!(after <= limit, "{after} us of {limit} us");
}

/// Somebody destroys the device's frames (a second node with its node-ID does that, too): after 32
/// errors it is bus-off. It returns after its wait of 200 ms, which doubles up to 5 s while it fails
/// again within 10 s, and then after 128 sequences of 11 recessive bits (ISO 11898-1, 12.1.4.4; RM0090
/// section 32.7.6). A master that repeats its request, because nobody acknowledges it, leaves one
/// sequence after each attempt. No answer can be slower.
#[test]
fn behind_bus_off_an_answer_waits_for_the_patience_and_the_recovery_and_no_longer() {
    let mut bench = board();
    let mine = FrameMatch { from: Some(bench.device.node()), ..FrameMatch::default() };
    for (round, patience_ms) in [200, 400, 800, 1600, 3200, 5000, 5000].into_iter().enumerate() {
        let fault = Fault { frames: mine.clone(), when: When::Always, action: FaultAction::Disturb };
        let fault = bench.world.inject(fault);
        let asked = bench.time();
        bench.post(REQUEST, &READ_1000);
        while bench.world.bus().fault_hits(fault) < 32 {
            bench.world.run_for(Span::from_micros(100));
        }
        bench.world.clear_faults();
        bench.run_ms(3);
        let records = bench.records();
        let last = records.iter().rfind(|record| record.outcome != Outcome::Good);
        let off = last.expect("errors").end;
        // The recessive bits come from an idle bus and from the master's attempts, in turn.
        let is_idle = round % 2 == 0;
        if !is_idle {
            bench.post(REQUEST, &READ_1000);
        }
        let after = await_answer(&mut bench, asked, off);
        let sequences = bits(128 * if is_idle { 11 } else { LONGEST_BITS + 8 });
        let least = patience_ms * 1000 + bits(128 * 11);
        // Ticks see bus-off, the end of the wait, and the recovery. Two emergencies (error passive,
        // recovered) and a heartbeat may be on the bus before.
        let most = patience_ms * 1000 + sequences + bits(4 * SDO_BITS) + DEVICE_US / 2 * 3;
        println!("answer {} ms after bus-off, limit {} ms", after / 1000, most / 1000);
        assert!((least..=most).contains(&after), "{after} us, not {least} to {most} us");
        bench.run_ms(20);
    }
    bench.assert_nothing_unmodelled();
}
