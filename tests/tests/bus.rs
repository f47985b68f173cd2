//! More than one device on the bus, and more on the bus than the device's own frames. All in virtual time; frames are
//! written by hand from CiA 301 and CiA 305.

use std::collections::BTreeSet;

use canopen::Address;
use coboot_tests::bench::{Bench, BIT_RATE, NODE};
use coboot_tests::firmware;
use coflash::error::Error;
use coflash::flash::{flash, Event, FlashOptions};
use coflash::session::{Doing, Session};
use emulator::bus::Outcome;
use emulator::frame::Frame;
use emulator::time::Span;

const DATA: Address = Address::new(0x1F50, 1);
const STATUS: Address = Address::new(0x1F57, 1);
const VERSION: Address = Address::new(0x100A, 0);
const LSS_REQUEST: u16 = 0x7E5;
const LSS_RESPONSE: u32 = 0x7E4;

/// Whether a node is there, and what runs on it.
fn running(bench: &mut Bench, node: u8) -> Option<&'static str> {
    let device_type = bench.session_with(node).device_type().unwrap()?;
    Some(if device_type.is_bootloader() { "bootloader" } else { "application" })
}

fn install(session: &mut Session<'_>, image: &str) {
    let report = flash(session, &firmware::blocks(image), &FlashOptions::default(), &mut |event| {
        assert!(!matches!(event, Event::Repeating { .. }), "{event}");
    });
    report.unwrap();
}

/// Three boards; two have node-IDs, the third has none until the master gives it one, picked by its identity.
#[test]
fn three_devices_are_updated_one_after_the_other_and_one_of_them_had_no_node_id() {
    let mut bench = Bench::of_boards(3);
    let boards = bench.boards();
    let nodes = [2, 3, 0xFF];
    let serials: Vec<u32> = boards.iter().zip(nodes).map(|(board, node)| bench.commission(*board, node)).collect();
    assert_eq!(serials.iter().collect::<BTreeSet<_>>().len(), 3, "no two devices share a serial number: {serials:X?}");

    bench.power_on();
    let from = bench.time();
    bench.run_ms(100);
    let boot_ups: BTreeSet<u32> =
        bench.frames_since(from).iter().filter(|(.., data)| data[..] == [0]).map(|(_, id, _)| *id).collect();
    assert_eq!(boot_ups, [0x702, 0x703].into(), "the third is silent");

    // The first two are updated while the third waits.
    install(&mut bench.session_with(2), firmware::APP_V1);
    install(&mut bench.session_with(3), firmware::APP_V1);

    // Is anybody without a node-ID? Then the one with this identity gets the next one that is free.
    let unconfigured = bench.ask(LSS_REQUEST, &[0x4C, 0, 0, 0, 0, 0, 0, 0], LSS_RESPONSE);
    assert_eq!(unconfigured.as_deref(), Some(&[0x50, 0, 0, 0, 0, 0, 0, 0][..]));
    // Vendor, product and revision as the board file has them: 0, 4007D151h, 00010000h.
    for part in [[0x40, 0, 0, 0, 0], [0x41, 0x51, 0xD1, 0x07, 0x40], [0x42, 0, 0, 1, 0]] {
        let [command, a, b, c, d] = part;
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

    // Each again, the last first, with another program: the others go on running theirs.
    for (done, node) in [4, 3, 2].into_iter().enumerate() {
        install(&mut bench.session_with(node), firmware::APP_V2);
        for (n, other) in [4, 3, 2].into_iter().enumerate() {
            let expected = if n <= done { "2.0.0" } else { "1.0.0" };
            assert_eq!(bench.session_with(other).read_text(VERSION).unwrap(), expected, "node {other}");
        }
    }
    bench.power_off();
    bench.run_ms(100);
    bench.power_on();
    bench.run_ms(200);
    for (node, serial) in [2, 3, 4].into_iter().zip(serials) {
        assert_eq!(running(&mut bench, node), Some("application"), "node {node}");
        let mut session = bench.session_with(node);
        assert_eq!(session.read_number(Address::new(0x1018, 4)).unwrap(), serial, "node {node}");
        assert_eq!(session.read_text(VERSION).unwrap(), "2.0.0", "node {node}");
    }
    assert_eq!(running(&mut bench, NODE), None, "nobody has the board file's node-ID any more");
    assert!(bench.records().iter().all(|record| record.outcome == Outcome::Good), "nobody disturbed anybody");
    bench.assert_nothing_unmodelled();
}
