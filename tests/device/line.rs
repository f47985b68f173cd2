//! The device on its line: node-ID and bit rate by layer setting services, detection of the bit
//! rate, errors of the bus and the recovery from them. Frames are written by hand from CiA 301 and
//! CiA 305.

use std::time::Duration;

use canopen::{Address, BitRate};
use coboot_can::Adapter;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash_core::device::Doing;
use emulator::bus::fault::{Fault, FaultAction, FrameMatch, When};
use emulator::bus::Outcome;
use emulator::frame::Frame;
use emulator::time::{Span, Time};

const LSS_REQUEST: u16 = 0x7E5;
const LSS_RESPONSE: u32 = 0x7E4;

/// A board in its bootloader, without a program.
fn empty_board() -> Bench {
    let mut bench = Bench::new().switched_on();
    // The emergency after the boot-up message.
    bench.run_ms(5);
    bench
}

/// An LSS request with an answer.
#[track_caller]
fn lss(bench: &mut Bench, request: [u8; 8]) -> [u8; 8] {
    let answer = bench.ask(LSS_REQUEST, &request, LSS_RESPONSE).expect("an answer");
    answer.try_into().expect("8 bytes")
}

fn configuration_state(bench: &mut Bench) {
    bench.post(LSS_REQUEST, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
}

/// Whether a node has sent its boot-up message since then, and the time of it.
fn boot_up(bench: &Bench, node: u8, since: Time) -> Option<Time> {
    let frames = bench.frames_of(0x700 + u32::from(node), since);
    frames.into_iter().find(|(_, data)| *data == [0]).map(|(at, _)| at)
}

#[test]
fn every_bit_rate_of_the_table_is_served_and_the_others_are_refused() {
    for (index, rate) in [
        (0, 1_000_000),
        (2, 500_000),
        (3, 250_000),
        (4, 125_000),
        (5, 100_000),
        (6, 50_000),
        (7, 20_000),
        (8, 10_000),
    ] {
        let mut bench = empty_board();
        bench.store_by_lss(3, BitRate::from_index(index).unwrap());
        bench.power_cycle();
        bench.set_host_bit_rate(rate);
        let from = bench.time();
        bench.run_ms(100);
        assert!(boot_up(&bench, 3, from).is_some(), "{rate} bit/s: {:?}", bench.records());
        assert!(bench.records().iter().all(|record| record.outcome == Outcome::Good), "{rate} bit/s");
    }
    let mut bench = empty_board();
    configuration_state(&mut bench);
    // 42 MHz is not a multiple of 800 kbit/s, 40 MHz is. Index 10 and table 1 are undefined.
    let unserved = (!bsp::CAN_CLOCK.is_multiple_of(800_000)).then_some((0, 1));
    for (table, index) in unserved.into_iter().chain([(0, 10), (0, 255), (1, 4)]) {
        let request = [0x13, table, index, 0, 0, 0, 0, 0];
        assert_eq!(lss(&mut bench, request), [0x13, 1, 0, 0, 0, 0, 0, 0], "table {table} index {index}");
    }
}

#[test]
fn a_device_without_node_id_is_silent_until_it_gets_one() {
    let mut bench = empty_board();
    bench.store_by_lss(0xFF, BitRate::K125);
    bench.power_cycle();
    let from = bench.time();
    bench.run_ms(3000);
    // NMT and SDO need a node-ID.
    bench.post(0x000, &[0x81, 0]);
    bench.post(0x000, &[0x01, 0]);
    bench.post(0x600 + u16::from(NODE), &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    bench.run_ms(100);
    let spoken: Vec<_> =
        bench.frames_since(from).into_iter().filter(|(_, id, _)| *id > 0 && *id != 0x601).collect();
    assert_eq!(spoken, [], "a word without being asked");

    assert_eq!(lss(&mut bench, [0x4C, 0, 0, 0, 0, 0, 0, 0]), [0x50, 0, 0, 0, 0, 0, 0, 0]);
    configuration_state(&mut bench);
    assert_eq!(lss(&mut bench, [0x5E, 0, 0, 0, 0, 0, 0, 0]), [0x5E, 0xFF, 0, 0, 0, 0, 0, 0]);
    assert_eq!(lss(&mut bench, [0x11, 7, 0, 0, 0, 0, 0, 0]), [0x11, 0, 0, 0, 0, 0, 0, 0]);
    let from = bench.time();
    bench.post(LSS_REQUEST, &[0x04, 0, 0, 0, 0, 0, 0, 0]);
    bench.run_ms(20);
    assert!(boot_up(&bench, 7, from).is_some(), "{:?}", bench.frames_since(from));
    assert!(bench.is_bootloader(7));
}

#[test]
fn a_bit_rate_is_activated_after_the_delay() {
    let mut bench = empty_board();
    configuration_state(&mut bench);
    assert_eq!(lss(&mut bench, [0x13, 0, 0, 0, 0, 0, 0, 0]), [0x13, 0, 0, 0, 0, 0, 0, 0]);
    // 200 ms.
    bench.post(LSS_REQUEST, &[0x15, 200, 0, 0, 0, 0, 0, 0]);
    bench.run_ms(100);
    let asked = bench.time();
    assert_eq!(bench.ask(0x601, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0], 0x581), None, "before the delay is over");
    bench.set_host_bit_rate(1_000_000);
    assert!(bench.time() - asked >= Span::from_millis(100));
    bench.run_ms(250);
    // It was not stored, and the device did not restart.
    assert!(bench.is_bootloader(NODE));
    assert_eq!(boot_up(&bench, NODE, asked), None);
}

/// A device that must detect its bit rate: the time until its boot-up message.
fn found_after(bench: &mut Bench, within_ms: u64) -> Option<Span> {
    let from = bench.time();
    for _ in 0..within_ms / 10 {
        bench.run_ms(10);
        if let Some(at) = boot_up(bench, NODE, from) {
            return Some(at - from);
        }
    }
    None
}

#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn finds_the_bit_rate_of_a_bus_with_traffic_and_disturbs_nobody() {
    for rate in [1_000_000, 250_000, 50_000] {
        let mut bench = empty_board();
        bench.store_by_lss(NODE, BitRate::Auto);
        bench.power_cycle();
        bench.set_host_bit_rate(rate);
        // Another node of that bus acknowledges; the host sends every 20 ms.
        bench.world.add_host_port(rate);
        let from = bench.time();
        for i in 0..250 {
            bench.post(0x300, &[i as u8; 5]);
            bench.run_ms(20);
        }
        let at = boot_up(&bench, NODE, from).unwrap_or_else(|| panic!("{rate} bit/s not found"));
        assert!(at - from < Span::from_millis(2000), "{rate} bit/s found after {:?}", at - from);
        let records = bench.records();
        let bad = records.iter().filter(|record| record.start >= from && record.outcome != Outcome::Good);
        assert_eq!(bad.count(), 0, "{rate} bit/s: a listener destroyed frames");
        assert!(bench.is_bootloader(NODE));
    }
}

#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn finds_the_bit_rate_of_a_bus_where_it_is_alone_with_the_master() {
    for rate in [1_000_000, 250_000, 20_000] {
        let mut bench = empty_board();
        bench.store_by_lss(NODE, BitRate::Auto);
        bench.power_cycle();
        bench.set_host_bit_rate(rate);
        let from = bench.time();
        bench.run_ms(2000);
        assert!(bench.frames_since(from).is_empty(), "a word before it knows the bit rate");
        // One request, which no node acknowledges at first.
        bench.post(0x601, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
        assert!(found_after(&mut bench, 5000).is_some(), "{rate} bit/s not found");
        assert!(bench.is_bootloader(NODE));
    }
}

#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn an_application_finds_the_bit_rate_too() {
    let mut bench = empty_board();
    bench.install(firmware::APP_V1);
    bench.call_back();
    bench.store_by_lss(NODE, BitRate::Auto);
    bench.power_cycle();
    bench.set_host_bit_rate(500_000);
    bench.post(0x601, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    let found = found_after(&mut bench, 5000);
    assert!(found.is_some());
    assert!(!bench.is_bootloader(NODE));
}

#[test]
fn the_boot_up_of_the_bootloader_is_followed_by_an_emergency() {
    let mut bench = empty_board();
    bench.run_ms(20);
    // Device specific, no error in the register, "BOOT", and the reason: no program.
    assert_eq!(bench.emergencies(Time::default()), [[0x00, 0xFF, 0, b'B', b'O', b'O', b'T', 6]]);
}

#[test]
fn comes_back_from_bus_off_with_growing_patience_and_tells() {
    let mut bench = empty_board();
    let device = bench.device.node();
    // Every frame of the device is destroyed: after 32 attempts it is bus-off.
    let mine = FrameMatch { from: Some(device), ..FrameMatch::default() };
    bench.world.inject(Fault { frames: mine, when: When::Always, action: FaultAction::Disturb });
    let from = bench.time();
    bench.post(0x601, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    bench.run_ms(4000);
    let bursts = bursts(&bench, from, device);
    // Each recovery ends in bus-off again, and each pause is longer than the previous one.
    assert!((3..=6).contains(&bursts.len()), "{bursts:?}");
    let pauses: Vec<Span> = bursts.windows(2).map(|pair| pair[1].0 - pair[0].1).collect();
    assert!(pauses.windows(2).all(|pair| pair[1] > pair[0]), "{pauses:?}");
    // An error passive node waits a little longer between attempts; after 32 it is bus-off in any
    // case.
    assert!(bursts.iter().all(|burst| burst.2 == 32), "{bursts:?}");

    bench.world.clear_faults();
    let from = bench.time();
    bench.run_ms(5500);
    let emergencies = bench.emergencies(from);
    assert!(emergencies.iter().any(|bytes| bytes[..3] == [0x40, 0x81, 0x11]), "{emergencies:02X?}");
    assert_eq!(emergencies.last().unwrap()[..3], [0x00, 0x00, 0x00], "and it is over: {emergencies:02X?}");
    assert!(bench.is_bootloader(NODE));
    // 1003h, newest first.
    let history = bench.ask(0x601, &[0x40, 0x03, 0x10, 1, 0, 0, 0, 0], 0x581).unwrap();
    assert_eq!(history[..6], [0x43, 0x03, 0x10, 1, 0x40, 0x81]);
}

/// The attempts of a node, as bursts: first start, last end, number.
fn bursts(bench: &Bench, from: Time, node: usize) -> Vec<(Time, Time, u32)> {
    let mut bursts: Vec<(Time, Time, u32)> = Vec::new();
    for record in bench.records() {
        if record.from != Some(node) || record.start < from {
            continue;
        }
        match bursts.last_mut() {
            Some((_, end, count)) if record.start - *end < Span::from_millis(50) => {
                *end = record.end;
                *count += 1;
            }
            _ => bursts.push((record.start, record.end, 1)),
        }
    }
    bursts
}

#[test]
fn error_passive_is_told_and_its_end_too() {
    let mut bench = empty_board();
    let device = bench.device.node();
    let mine = FrameMatch { from: Some(device), ..FrameMatch::default() };
    // 16 errors and a few more: error passive, not bus-off.
    let rule = bench.world.inject(Fault { frames: mine, when: When::Always, action: FaultAction::Disturb });
    let from = bench.time();
    bench.post(0x601, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    while bench.world.bus().fault_hits(rule) < 20 {
        bench.run_ms(1);
    }
    bench.world.clear_faults();
    bench.run_ms(50);
    assert_eq!(bench.emergencies(from)[0][..3], [0x20, 0x81, 0x11]);
    // Each successful frame decreases the counter by one; the heartbeats do so in time.
    for _ in 0..64 {
        bench.ask(0x601, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0], 0x581).unwrap();
    }
    bench.run_ms(50);
    assert_eq!(bench.emergencies(from).last().unwrap()[..3], [0x00, 0x00, 0x00]);
}

#[test]
fn a_damaged_block_is_told_by_an_emergency_and_the_next_good_one_ends_it() {
    let mut bench = empty_board();
    let from = bench.time();
    // A control block of 8 zero bytes with a wrong CRC.
    let mut block = [0; 24];
    block[8] = 8;
    let address = canopen::Address::new(0x1F50, 1);
    let doing = coflash_core::device::Doing::Block(0);
    bench.session().write(address, &block, doing, &mut |_| {}).unwrap_err();
    bench.run_ms(20);
    assert_eq!(bench.emergencies(from), [[0x00, 0x63, 0x81, 0x06, 1, 0, 0, 0]]);
    let register = bench.ask(0x601, &[0x40, 0x01, 0x10, 0, 0, 0, 0, 0], 0x581).unwrap();
    assert_eq!(register[4], 0x81);
    // Twice: this erases, and succeeds.
    bench.session().command(1, canopen::program::ProgramControl::Clear).unwrap();
    bench.session().command(1, canopen::program::ProgramControl::Clear).unwrap();
    bench.session().await_idle(1, doing).unwrap();
    bench.run_ms(20);
    assert_eq!(bench.emergencies(from).last().unwrap()[..3], [0x00, 0x00, 0x00]);
}

#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn frames_lost_in_a_flood_are_told_once() {
    // It computes a CRC of 64 KiB in one step, without the chip's unit: frames are lost meanwhile.
    let mut bench = Bench::of_image(firmware::BOOTLOADER_CRC_16).switched_on();
    bench.store_by_lss(NODE, BitRate::K1000);
    bench.power_cycle();
    bench.set_host_bit_rate(1_000_000);
    bench.run_ms(50);
    let mut image = firmware::raw(firmware::APP_V1);
    image.resize(100 * 1024, 0xA5);
    let data = Address::new(0x1F50, 1);
    bench.session().write(data, &image, Doing::Block(0), &mut |_| {}).unwrap();
    let from = bench.time();
    // Until the verification ends, a flood of the shortest frames that pass its filters: NMT
    // commands without data, which are invalid.
    let flood = bench.world.add_host_port(1_000_000);
    for _ in 0..20 {
        for _ in 0..500 {
            bench.world.send(flood, Frame::standard(0x000, &[]).unwrap());
        }
        bench.run_ms(50);
    }
    bench.run_ms(2000);
    let emergencies = bench.emergencies(from);
    let lost: Vec<_> = emergencies.iter().filter(|bytes| bytes[..2] == [0x10, 0x81]).collect();
    assert!((1..=3).contains(&lost.len()), "more than one a second, or none: {lost:02X?}");
    // Bytes 5 and 6: the driver's status, 0020h and 1000h.
    assert!(
        lost.iter().all(|bytes| matches!((bytes[5], bytes[6]), (0x20, 0) | (0, 0x10) | (0x20, 0x10))),
        "{lost:02X?}"
    );
    // The abort of the block, which was not read yet.
    while bench.receive(Duration::ZERO).unwrap().is_some() {}
    assert!(bench.is_bootloader(NODE));
}

/// Code in flash stops while the journal is erased (RM0090 section 3.5.1), and the watchdog with it.
#[test]
fn a_value_that_comes_while_the_journal_is_erased_does_not_stop_the_core() {
    for ms in [30, 100, 200] {
        let mut bench = empty_board();
        bench.store_by_lss(NODE, BitRate::K125);
        // From 256 used places on it is compacted at once.
        bench.fill_journal(300);
        bench.power_cycle();
        bench.run_ms(ms);
        configuration_state(&mut bench);
        bench.post(LSS_REQUEST, &[0x11, 9, 0, 0, 0, 0, 0, 0]);
        bench.run_ms(5);
        bench.post(LSS_REQUEST, &[0x17, 0, 0, 0, 0, 0, 0, 0]);
        bench.run_ms(500);
        assert_eq!(bench.machine().counters().flash_stalls, 0, "{ms} ms");
        bench.power_cycle();
        let from = bench.time();
        bench.run_ms(50);
        assert!(boot_up(&bench, 9, from).is_some(), "{ms} ms: it is stored");
    }
}
