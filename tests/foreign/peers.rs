//! python-canopen, unmodified, as the master of a bus with three emulated devices, through the
//! socketcand endpoint.

use canopen::{Address, BitRate};
use coboot_tests::bench::Bench;
use coboot_tests::endpoint::Endpoint;
use coboot_tests::{firmware, tools};
use coflash_core::file::block_file::emit;
use emulator::bus::Outcome;

const NODES: [u8; 3] = [10, 11, 12];

/// Runs the script on the endpoint; returns its output.
fn master(endpoint: &mut Endpoint, arguments: &[&str]) -> String {
    let mut client = tools::script("master_client.py");
    client.arg(endpoint.address()).args(arguments).args(NODES.map(|node| node.to_string()));
    endpoint.succeed(&mut client)
}

/// Three devices without node-ID are found by fastscan and get node-ID and bit rate; after a
/// power-off they form a bus at that bit rate, on which one is updated.
#[test]
fn python_canopen_commissions_three_devices_and_works_with_them() {
    let mut bench = Bench::of_boards(3);
    let boards = bench.boards();
    let mut serials: Vec<u32> =
        boards.into_iter().map(|board| bench.commission(board, 0xFF, BitRate::K125)).collect();
    bench.power_on();
    let mut endpoint = Endpoint::new(bench);
    // 800 kbit/s (index 1) if the clock is not a multiple of it; index 10 is undefined.
    let refused = if bsp::CAN_CLOCK.is_multiple_of(800_000) { "10" } else { "1" };
    let said = master(&mut endpoint, &["commission", "--refused-bit-rate", refused]);
    // Fastscan finds the lowest number first.
    serials.sort_unstable();
    let bsp::Identity { vendor_id, product_code, revision, .. } = bsp::IDENTITY;
    for (node, serial) in NODES.iter().zip(&serials) {
        let line =
            format!("found {vendor_id:08X} {product_code:08X} {revision:08X} {serial:08X}: node-ID {node}");
        assert!(said.contains(&line), "no {line:?} in:\n{said}");
    }

    let bench = &mut endpoint.bench;
    let off = bench.time();
    bench.power_off();
    bench.run_ms(100);
    bench.set_host_bit_rate(250_000);
    bench.power_on();
    bench.run_ms(100);
    let folder = kit::folder!("peers");
    let path = folder.write("program.blk", emit(&firmware::blocks(firmware::APP_V1)));
    let path = path.to_str().expect("a path of this repository");
    master(&mut endpoint, &["use", "--device-name", bsp::IDENTITY.device_name, path]);

    let bench = &mut endpoint.bench;
    for (node, serial) in NODES.iter().zip(&serials) {
        let mut session = bench.session_with(*node);
        assert_eq!(session.read_number(Address::new(0x1018, 4)).unwrap(), *serial, "node {node}");
        let running = session.device_type().unwrap().expect("an answer");
        assert_eq!(running.is_bootloader(), *node != 12, "node {node}");
    }
    // Except for a frame that was being sent when the power was cut.
    let mut disturbed = bench.records();
    disturbed.retain(|record| record.outcome != Outcome::Good && !(record.start..=record.end).contains(&off));
    assert!(disturbed.is_empty(), "nobody disturbed anybody: {disturbed:?}");
    bench.assert_nothing_unmodelled();
}
