//! The effect of another client's transfer, or of an abandoned one, on the next client: the built
//! firmware in virtual time, with frames written by hand from CiA 301 sections 7.2.4.3 and 7.2.8.3
//! and the SYS TEC manual.

use canopen::{Address, BitRate};
use coboot_tests::bench::{Bench, HEARTBEAT, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coflash_core::device::{Doing, Transfers};
use emulator::time::{Span, Time};

/// The segments of a sub-block at 125 kbit/s: as many as fit into 80 ms, with 135 bits each.
const BLKSIZE: u8 = 74;
const DATA: Address = Address::new(0x1F50, 1);
const CONTROL: Address = Address::new(0x1F51, 1);
const READ_1000: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
const READ_1008: [u8; 8] = [0x40, 0x08, 0x10, 0, 0, 0, 0, 0];
const READ_STATUS: [u8; 8] = [0x40, 0x57, 0x1F, 1, 0, 0, 0, 0];
const CLEAR: [u8; 8] = [0x2F, 0x51, 0x1F, 1, 3, 0, 0, 0];
const MAN_BUSY: [u8; 8] = [0x80, 0x51, 0x1F, 1, 0x22, 0x00, 0x00, 0x08];

/// A board in its bootloader, without a program, at this bit rate.
fn board(rate: BitRate) -> Bench {
    let mut bench = Bench::at_rate(rate);
    bench.run_ms(50);
    bench
}

/// A board whose program was called back.
fn called_back() -> Bench {
    let mut bench = Bench::running(BitRate::K125, firmware::APP_V1);
    bench.call_back();
    bench.run_ms(20);
    bench
}

/// The device's frames on its SDO channel, with their time after `from`.
fn said(bench: &Bench, from: Time) -> Vec<(Span, Vec<u8>)> {
    bench.frames_of(RESPONSE, from).into_iter().map(|(at, data)| (at - from, data)).collect()
}

/// A block download is granted in sub-blocks of `blksize`, and its first segments are sent. Returns the
/// time of the last one on the bus.
fn abandon(bench: &mut Bench, at: Address, blksize: u8, segments: u8) -> Time {
    // Earlier frames were already checked.
    bench.forget_received();
    let [low, high] = at.index.to_le_bytes();
    let granted = bench.ask(REQUEST, &[0xC0, low, high, at.sub, 0, 0, 0, 0], RESPONSE).expect("an answer");
    assert_eq!(granted, [0xA4, low, high, at.sub, blksize, 0, 0, 0]);
    let from = bench.time();
    for seqno in 1..=segments {
        bench.post(REQUEST, &[seqno, 0, 0, 0, 0, 0, 0, 0]);
    }
    let sent = |bench: &Bench| bench.frames_of(REQUEST.into(), from);
    while sent(bench).len() < usize::from(segments) {
        bench.run_ms(1);
    }
    sent(bench).last().map_or(from, |(at, _)| *at)
}

/// Default clients wait 0.3 s (python-canopen) to 0.5 s for an acknowledgement.
#[test]
fn a_lost_last_segment_is_acknowledged_before_clients_give_up() {
    // As many segments as fit into 80 ms, with 135 bits each.
    for (rate, blksize, least, most) in [
        (BitRate::K1000, 127, 49, 54),
        (BitRate::K125, BLKSIZE, 49, 55),
        (BitRate::K50, 29, 49, 60),
        // Twice as long, and the acknowledgement itself takes 6 and 13 ms.
        (BitRate::K20, 11, 99, 112),
        (BitRate::K10, 5, 99, 120),
    ] {
        let mut bench = board(rate);
        let end = abandon(&mut bench, DATA, blksize, blksize - 1);
        bench.run_ms(300);
        let said = said(&bench, end);
        let [(after, answer)] = &said[..] else { panic!("{rate:?}: {said:?}") };
        assert_eq!(answer[..], [0xA2, blksize - 1, blksize, 0, 0, 0, 0, 0]);
        assert!(
            *after >= Span::from_millis(least) && *after <= Span::from_millis(most),
            "{rate:?}: {after:?}"
        );
    }
}

/// The frames of a bug report: 40 00 10 00 every 0.1 to 2.2 s, bootloader and application.
#[test]
fn an_abandoned_block_download_locks_nobody_out() {
    let mut bootloader = board(BitRate::K125);
    let mut application = Bench::running(BitRate::K125, firmware::APP_V1);
    for (bench, at) in [(&mut bootloader, DATA), (&mut application, CONTROL)] {
        let device_type = bench.ask(REQUEST, &READ_1000, RESPONSE).expect("an answer");
        for every in [100, 700, 2200] {
            for segments in [0, 3] {
                abandon(bench, at, BLKSIZE, segments);
                bench.run_ms(5);
                let asked = bench.time();
                for _ in 0..3 {
                    bench.post(REQUEST, &READ_1000);
                    bench.run_ms(every);
                }
                let said = said(bench, asked);
                assert_eq!(said.len(), 3, "{at}, {segments} segments, every {every} ms: {said:X?}");
                assert!(said.iter().all(|(_, data)| *data == device_type), "{said:X?}");
                // The frame itself takes 1 ms, and the application reads its clock every 5 ms.
                assert!(said[0].0 <= Span::from_millis(59), "{:?}", said[0].0);
            }
        }
        // With an abort before it, the answer comes at once.
        abandon(bench, at, BLKSIZE, 3);
        bench.post(REQUEST, &[0x80, 0, 0, 0, 0, 0, 0, 8]);
        let asked = bench.time();
        assert_eq!(bench.ask(REQUEST, &READ_1000, RESPONSE).expect("an answer"), device_type);
        assert!(bench.time() - asked <= Span::from_millis(5));
        bench.assert_nothing_unmodelled();
    }
}

/// The server takes such a request after its pause, in no answer to a frame: the bootloader carries
/// CLEAR out and confirms it all the same.
#[test]
fn a_clear_that_ends_an_abandoned_block_download_is_the_bootloaders() {
    let mut bench = Bench::running(BitRate::K125, firmware::APP_V1);
    abandon(&mut bench, CONTROL, BLKSIZE, 3);
    bench.run_ms(5);
    bench.assert_answer(REQUEST, &CLEAR, RESPONSE, &[0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]);
    assert!(bench.is_bootloader(NODE));
    // The second CLEAR erases, and the first one would not have. 3: there is no program.
    assert!(bench.ask(REQUEST, &CLEAR, RESPONSE).is_some());
    bench.run_ms(10_000);
    assert_eq!(bench.session().read_number(CONTROL).unwrap(), 3);
}

/// A transfer is abandoned, and a client sends a request every second: NMT reset node is carried
/// out.
#[test]
fn reset_node_waits_for_no_transfer() {
    let mut bench = Bench::running(BitRate::K125, firmware::APP_V1);
    for (index, transfer) in [
        (0x1F51, [0xC0, 0x51, 0x1F, 1, 0, 0, 0, 0]),
        (0x1F51, [0x21, 0x51, 0x1F, 1, 1, 0, 0, 0]),
        (0x1008, READ_1008),
        (0x1008, [0xA0, 0x08, 0x10, 0, 127, 0, 0, 0]),
        (0x1F50, [0xC0, 0x50, 0x1F, 1, 0, 0, 0, 0]),
        (0x1F50, [0x20, 0x50, 0x1F, 1, 0, 0, 0, 0]),
    ] {
        let is_bootloader = bench.is_bootloader(NODE);
        if index == 0x1F50 && !is_bootloader {
            bench.call_back();
            bench.run_ms(20);
        }
        for _ in 0..3 {
            let answer = bench.ask(REQUEST, &transfer, RESPONSE).expect("an answer");
            assert_ne!(answer[0], 0x80, "{transfer:02X?}: {answer:02X?}");
            bench.run_ms(20);
        }
        bench.post(0x000, &[0x81, NODE]);
        let from = bench.time();
        let boot_up = bench.await_boot_up(50);
        assert!(boot_up - from <= Span::from_millis(45), "{transfer:02X?}: {:?}", boot_up - from);
        // The rescue window, unless the program was confirmed.
        bench.run_ms(400);
    }
}

/// A client starts an upload every 30 ms and never continues it. START was acknowledged and is
/// carried out.
#[test]
fn uploads_that_are_never_ended_do_not_keep_the_program_from_starting() {
    let mut bench = called_back();
    assert!(bench.ask(REQUEST, &READ_1008, RESPONSE).is_some());
    bench.post(REQUEST, &[0x2F, 0x51, 0x1F, 1, 1, 0, 0, 0]);
    let from = bench.time();
    for _ in 0..10 {
        bench.post(REQUEST, &READ_1008);
        bench.run_ms(30);
    }
    let mut boot_ups = bench.frames_of(HEARTBEAT, from);
    boot_ups.retain(|(_, data)| data[..] == [0]);
    assert_eq!(boot_ups.len(), 1, "{boot_ups:?}");
    assert!(boot_ups[0].0 - from <= Span::from_millis(60), "{boot_ups:?}");
    assert!(!bench.is_bootloader(NODE));
}

/// A raw image is aborted while a sector is erased for it: the status is busy exactly as long as
/// commands are refused for this reason.
#[test]
fn behind_a_cut_raw_image_the_status_says_busy_while_commands_are_refused() {
    for command in [0x01, 0x02, 0x83] {
        let mut bench = called_back();
        assert!(bench.ask(REQUEST, &CLEAR, RESPONSE).is_some());
        let mut image = firmware::raw(firmware::APP_V2);
        image.truncate(2100);
        // Segments of seven bytes, and an abort.
        assert!(bench.ask(REQUEST, &[0x20, 0x50, 0x1F, 1, 0, 0, 0, 0], RESPONSE).is_some());
        for (n, segment) in image.chunks(7).enumerate() {
            let toggle = ((n % 2) as u8) << 4;
            let answer = bench.ask(REQUEST, &[&[toggle], segment].concat(), RESPONSE).expect("an answer");
            assert_eq!(answer[0], 0x20 | toggle);
        }
        bench.post(REQUEST, &[0x80, 0x50, 0x1F, 1, 0, 0, 0, 8]);
        bench.run_ms(2);
        let mut refused = 0;
        loop {
            let status = bench.ask(REQUEST, &READ_STATUS, RESPONSE).expect("an answer");
            assert_eq!(status[4] & 0xFE, 0x04, "FORMAT");
            let busy = status[4] & 1 != 0;
            let asked = bench.time();
            let answer =
                bench.ask(REQUEST, &[0x2F, 0x51, 0x1F, 1, command, 0, 0, 0], RESPONSE).expect("an answer");
            assert!(bench.time() - asked <= Span::from_millis(5));
            // The erase may end between the two requests.
            if !busy || answer[0] == 0x60 {
                assert_eq!(answer[..], [0x60, 0x51, 0x1F, 1, 0, 0, 0, 0], "{command:02X}h behind {refused}");
                break;
            }
            assert_eq!(answer[..], MAN_BUSY);
            refused += 1;
        }
        // 64 KiB take 550 ms, two dialogues some 5.
        assert!(refused > 50, "{refused}");
        assert_eq!(bench.machine().counters().flash_stalls, 0);
    }
}

/// CLEAR twice; returns its duration, and the longest time until an answer.
fn clear(bench: &mut Bench) -> (Span, Span) {
    let mut slowest = Span(0);
    let mut ask = |bench: &mut Bench, bytes: &[u8; 8]| {
        let asked = bench.time();
        let answer = bench.ask(REQUEST, bytes, RESPONSE).expect("an answer");
        slowest = slowest.max(bench.time() - asked);
        answer
    };
    let from = bench.time();
    assert_eq!(ask(bench, &CLEAR)[0], 0x60);
    while ask(bench, &READ_STATUS)[4] & 1 != 0 {}
    assert_eq!(ask(bench, &CLEAR)[0], 0x60);
    loop {
        let status = ask(bench, &READ_STATUS);
        if status[4] & 1 == 0 {
            assert_eq!(status[4..], [0, 0, 0, 0]);
            let all = firmware::board().programs[0];
            let offset = (all.base - firmware::board().chip.flash.base) as usize;
            assert!(bench.machine().flash()[offset..][..all.size as usize].iter().all(|byte| *byte == 0xFF));
            return (bench.time() - from, slowest);
        }
    }
}

/// Flash that was never written takes no time to erase; and the bus works during the check.
#[test]
fn a_second_clear_takes_as_long_as_there_is_something_to_erase() {
    let mut bench = board(BitRate::K125);
    let (took, slowest) = clear(&mut bench);
    println!("a new device: {took:?}, slowest answer {slowest:?}");
    assert!(took <= Span::from_millis(100), "a new device: {took:?}");
    assert!(slowest <= Span::from_millis(5), "{slowest:?}");
    // About 20 KiB: one sector of 128 KiB, by 32 bits 1 s, by 16 bits 1.3 s (DS8626, flash memory programming).
    let sector = Span::from_millis(if bsp::FLASH_WIDTH == 4 { 1_150 } else { 1_450 });
    bench.session().transfer_by(Transfers::Blocks);
    let image = firmware::raw(firmware::APP_V1);
    bench.session().write(DATA, &image, Doing::Block(0), &mut |_| {}).expect("a good program");
    bench.session().await_idle(1, Doing::Read(DATA)).expect("it is verified");
    let (took, slowest) = clear(&mut bench);
    println!("{} bytes: {took:?}, slowest answer {slowest:?}", image.len());
    assert!(took <= sector, "{} bytes: {took:?}", image.len());
    assert!(slowest <= Span::from_millis(5), "{slowest:?}");
    // After a reset.
    bench.post(0x000, &[0x81, 0]);
    bench.await_boot_up(100);
    bench.run_ms(20);
    assert!(clear(&mut bench).0 <= Span::from_millis(100));
    // A debugger has written to the last sector, which ends with a reset.
    let end = firmware::board().programs[0].end();
    bench.machine().load_bin(end - 1, &[0]).expect("it is in flash");
    bench.post(0x000, &[0x81, 0]);
    bench.await_boot_up(100);
    bench.run_ms(20);
    let (took, slowest) = clear(&mut bench);
    assert!(took >= Span::from_millis(500) && took <= sector, "{took:?}");
    assert!(slowest <= Span::from_millis(5), "{slowest:?}");
    assert_eq!(bench.machine().counters().flash_stalls, 0);
    bench.assert_nothing_unmodelled();
}
