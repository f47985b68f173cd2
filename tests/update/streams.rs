//! A whole program in one SDO download, with the built images: raw and Intel HEX, segmented and by
//! block transfer.

use canopen::{Address, BitRate};
use coboot_tests::bench::{Bench, HEARTBEAT, NODE, REQUEST, RESPONSE};
use coboot_tests::{firmware, throughput};
use coflash_core::device::{Doing, Transfers};
use emulator::machine::{FlashTimes, Options};
use emulator::time::{Span, Time};
use kit::ihex::intel_hex;
use kit::rig::crc32;

const DATA: Address = Address::new(0x1F50, 1);
const CONTROL: Address = Address::new(0x1F51, 1);
const IDENTIFICATION: Address = Address::new(0x1F56, 1);
const VERSION: Address = Address::new(0x100A, 0);

const CLEAR: u8 = 3;
const RESET: u8 = 2;

fn write(bench: &mut Bench, at: Address, data: &[u8], transfers: Transfers) {
    let mut session = bench.session();
    session.transfer_by(transfers);
    session.write(at, data, Doing::Block(0), &mut |_| {}).unwrap();
}

fn board_at_1_mbit(options: Options) -> Bench {
    let mut bench = Bench::with(options);
    let board = bench.boards()[0];
    bench.commission(board, NODE, BitRate::K1000);
    bench.set_host_bit_rate(1_000_000);
    bench.power_on();
    bench.run_ms(50);
    bench
}

/// A master that only supports CiA 302-3: clear, one download, and 1F51h = 2 directly after it,
/// without reading 1F57h.
#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn a_program_in_one_download_starts_by_reset_program() {
    let raw = throughput::program(24);
    let hex = intel_hex(firmware::board().programs[0].base, &raw).into_bytes();
    for (data, transfers) in [
        (&raw, Transfers::Segments),
        (&raw, Transfers::Blocks),
        (&hex, Transfers::Segments),
        (&hex, Transfers::Blocks),
    ] {
        let mut bench = board_at_1_mbit(Options::default());
        assert_eq!(bench.session().read_number(CONTROL).unwrap(), 3, "no program");
        write(&mut bench, CONTROL, &[CLEAR], transfers);
        write(&mut bench, DATA, data, transfers);
        write(&mut bench, CONTROL, &[RESET], transfers);
        bench.await_boot_up(2000);
        let mut session = bench.session();
        assert_eq!(session.read_text(VERSION).unwrap(), "1.0.0");
        assert_eq!(session.read_number(CONTROL).unwrap(), 1, "running");
        assert_eq!(session.read_number(IDENTIFICATION).unwrap(), crc32(&raw));
        // Valid without a release: it starts by itself.
        bench.restart();
        assert_eq!(bench.text(0x100A), "1.0.0");
        bench.assert_nothing_unmodelled();
    }
}

/// The same with NMT reset node directly after the last segment.
#[test]
fn a_reset_right_behind_the_download_does_not_lose_it() {
    let raw = throughput::program(24);
    let mut bench = board_at_1_mbit(Options::default());
    write(&mut bench, CONTROL, &[CLEAR], Transfers::Blocks);
    write(&mut bench, DATA, &raw, Transfers::Blocks);
    bench.post(0, &[0x81, NODE]);
    bench.await_boot_up(2000);
    assert_eq!(bench.text(0x100A), "1.0.0");
}

/// At 1 Mbit/s with a flash as slow as the data sheet permits, half as fast as the bus: each answer
/// still comes within 5 ms, and the heartbeat keeps its period within 10 %.
#[test]
fn never_silent_while_the_flash_is_slower_than_the_bus() {
    let raw = throughput::program(300);
    for transfers in [Transfers::Blocks, Transfers::Segments] {
        let options = Options { flash_times: FlashTimes::Worst, ..Options::default() };
        let mut bench = board_at_1_mbit(options);
        let from = bench.time();
        write(&mut bench, CONTROL, &[CLEAR], transfers);
        write(&mut bench, DATA, &raw, transfers);
        let to = bench.time();
        let mut asked = from;
        let mut slowest = Span(0);
        let mut beats: Vec<Time> = Vec::new();
        for (at, id, _) in bench.frames_since(from) {
            match id {
                id if id == u32::from(REQUEST) => asked = at,
                RESPONSE => slowest = slowest.max(at - asked),
                HEARTBEAT => beats.push(at),
                _ => {}
            }
        }
        assert!(slowest <= Span::from_millis(5), "{transfers:?}: {} us", slowest.0 / 1_000_000);
        // Three sectors of 128 KiB and smaller ones, at least 2 s each.
        assert!(to - from > Span::from_millis(8000), "{transfers:?}: the flash was not the slower one");
        assert!(beats.len() >= 7, "{beats:?}");
        for pair in beats.windows(2) {
            let period = pair[1] - pair[0];
            assert!((900..=1100).contains(&(period.0 / 1_000_000_000)), "{} ms", period.0 / 1_000_000_000);
        }
        write(&mut bench, CONTROL, &[RESET], transfers);
        bench.await_boot_up(5000);
        assert_eq!(bench.session().read_number(IDENTIFICATION).unwrap(), crc32(&raw));
        assert_eq!(bench.machine().counters().flash_stalls, 0);
    }
}

/// Reset program, written to the application, restarts it; after a CLEAR to the application no
/// second CLEAR is necessary.
#[test]
fn reset_program_starts_the_application_anew() {
    let mut bench = board_at_1_mbit(Options::default());
    write(&mut bench, CONTROL, &[CLEAR], Transfers::Blocks);
    write(&mut bench, DATA, &throughput::program(24), Transfers::Blocks);
    write(&mut bench, CONTROL, &[RESET], Transfers::Blocks);
    bench.await_boot_up(2000);
    write(&mut bench, CONTROL, &[RESET], Transfers::Blocks);
    bench.await_boot_up(1000);
    assert_eq!(bench.text(0x100A), "1.0.0");
}
