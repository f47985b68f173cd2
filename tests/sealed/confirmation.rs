//! Storing by a sealed program: the flash is locked while it runs, so its confirmation goes through
//! the warm-start cell and a reset (`shared_abi::warm_start::BootRequest::Confirm`).

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{control, Bench, ACKNOWLEDGED, NODE, REQUEST, RESCUE_WINDOW_MS, RESPONSE};
use coboot_tests::firmware;
use coboot_tests::sealed_board::{board, seal, sealer, write, COUNTER};
use coflash_core::device::Transfers;
use shared_abi::warm_start::{BootRequest, StoredNode, WarmStart};

const APPLICATIONS: [&str; 2] = [firmware::APP_V1, firmware::APP_C];
const CRC: Address = Address::new(0x1F56, 1);

/// 1F51h/1, refused because of the device's state (CiA 301, 7.2.4.3.17).
const REFUSED: [u8; 8] = [0x80, 0x51, 0x1F, 1, 0x22, 0, 0, 0x08];

/// A sealed board with a sealed program that was downloaded in one transfer and started.
fn fresh_board(image: &str) -> Bench {
    let mut bench = board().switched_on();
    let file = seal(&sealer(COUNTER), image);
    assert_eq!(write(&mut bench, &file, Transfers::Segments), (None, 0), "{image}");
    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.await_boot_up(1000);
    bench.run_ms(50);
    bench
}

fn ask(bench: &mut Bench, value: u8) -> Option<Vec<u8>> {
    bench.ask(REQUEST, &control(value), RESPONSE)
}

/// As on a device that is not sealed, except for the reset: acknowledged, confirmed permanently,
/// and the next 80h is a call.
#[test]
fn the_first_80h_confirms_a_sealed_program_through_a_reset() {
    for image in APPLICATIONS {
        let mut bench = fresh_board(image);
        let crc = bench.session().read_number(CRC).unwrap();
        assert_eq!(ask(&mut bench, 0x80).as_deref(), Some(&ACKNOWLEDGED[..]), "{image}");
        bench.await_boot_up(1000);
        bench.run_ms(50);
        assert!(!bench.is_bootloader(NODE), "{image}: the program is back");
        assert_eq!(bench.session().read_number(CRC).unwrap(), crc, "{image}");
        assert_eq!(bench.boot_ups(Bench::power_cycle), 1, "{image}: confirmed for good");
        assert_eq!(ask(&mut bench, 0x80).as_deref(), Some(&ACKNOWLEDGED[..]), "{image}");
        bench.await_boot_up(1000);
        bench.run_ms(50);
        assert!(bench.is_bootloader(NODE), "{image}: the second is a call");
        bench.assert_nothing_unmodelled();
    }
}

/// Between the answer and the reset: a repeated 80h gets the same answer, no command removes the
/// confirmation, and the device still resets.
#[test]
fn nothing_takes_the_confirmation_away() {
    for image in APPLICATIONS {
        for (what, value, answer) in [
            ("80h again", 0x80, ACKNOWLEDGED),
            ("STOP", 0x00, REFUSED),
            ("CLEAR", 0x03, REFUSED),
            ("reset program", 0x02, REFUSED),
        ] {
            let mut bench = fresh_board(image);
            assert_eq!(ask(&mut bench, 0x80).as_deref(), Some(&ACKNOWLEDGED[..]));
            assert_eq!(ask(&mut bench, value).as_deref(), Some(&answer[..]), "{image}, {what}");
            bench.await_boot_up(1000);
            bench.run_ms(50);
            assert!(!bench.is_bootloader(NODE), "{image}, {what}");
            assert_eq!(bench.boot_ups(Bench::power_cycle), 1, "{image}, {what}");
        }
        let mut bench = fresh_board(image);
        assert!(ask(&mut bench, 0x80).is_some());
        // NMT reset node.
        bench.post(0x000, &[0x81, NODE]);
        bench.await_boot_up(1000);
        assert_eq!(bench.boot_ups(Bench::power_cycle), 1, "{image}, NMT");
    }
}

/// A machine that moves refuses what needs a reset: the confirmation, too. Nothing is stored; an
/// NMT reset, which is not refused, opens the rescue window.
#[test]
fn a_sealed_program_that_may_not_leave_stays() {
    let image = firmware::APP_V1;
    let mut bench = fresh_board(image);
    assert!(ask(&mut bench, 0x80).is_some());
    bench.await_boot_up(1000);
    bench.run_ms(50);
    let stored = bench.machine().flash().to_vec();
    bench.move_machine(image, true);
    for value in [0x80, 0x00, 0x02, 0x03] {
        assert_eq!(ask(&mut bench, value).as_deref(), Some(&REFUSED[..]), "{value}");
    }
    bench.run_ms(700);
    assert!(!bench.is_bootloader(NODE) && bench.machine().flash() == stored);
    assert_eq!(bench.boot_ups(|bench| bench.post(0, &[0x81, NODE])), 2, "the window, and the program");
    assert_eq!(bench.boot_ups(Bench::power_cycle), 1, "it is confirmed still");
    let mut bench = fresh_board(image);
    bench.move_machine(image, true);
    assert_eq!(ask(&mut bench, 0x80).as_deref(), Some(&REFUSED[..]), "a confirmation needs a reset");
}

/// A power cut before the reset only loses the confirmation.
#[test]
fn a_power_cut_before_the_reset_leaves_an_unconfirmed_program() {
    for image in APPLICATIONS {
        let mut bench = fresh_board(image);
        assert!(ask(&mut bench, 0x80).is_some());
        assert_eq!(bench.boot_ups(Bench::power_cycle), 2, "{image}: a rescue window, and the program");
        assert!(!bench.is_bootloader(NODE), "{image}");
    }
}

/// The other two requests of an application, and invalid ones.
#[test]
fn the_boot_stage_stores_what_the_callgate_could_not() {
    let leave = |bench: &mut Bench, request: BootRequest| {
        let WarmStart { magic, request, argument, check } = WarmStart::new(request);
        let bytes: Vec<u8> =
            [magic, request, argument, check].iter().flat_map(|word| word.to_le_bytes()).collect();
        bench.machine().write_ram(firmware::board().warm_start.base, &bytes).unwrap();
        bench.machine().reset_pin();
    };
    let mut bench = fresh_board(firmware::APP_V1);
    for nonsense in [
        BootRequest::Confirm(200),
        BootRequest::Invalidate(200),
        BootRequest::StoreNode(StoredNode { node_id: 0, bit_rate: 100 }),
        BootRequest::StoreNode(StoredNode { node_id: 200, bit_rate: 25 }),
        BootRequest::StoreNode(StoredNode { node_id: 9, bit_rate: 7 }),
    ] {
        leave(&mut bench, nonsense);
        bench.await_boot_up(1000);
        bench.run_ms(RESCUE_WINDOW_MS + 100);
        if nonsense == BootRequest::Confirm(200) {
            // A requested start of a missing program.
            assert!(bench.is_bootloader(NODE), "{nonsense:?}");
        } else {
            assert!(!bench.is_bootloader(NODE), "{nonsense:?}");
        }
    }
    leave(&mut bench, BootRequest::StoreNode(StoredNode::new(9, 125_000)));
    bench.await_program_of(9, 1000);
    leave(&mut bench, BootRequest::Invalidate(1));
    bench.await_boot_up_of(9, 1000);
    bench.run_ms(RESCUE_WINDOW_MS + 100);
    assert!(bench.is_bootloader(9), "it is not released any more");
    leave(&mut bench, BootRequest::Confirm(1));
    bench.await_boot_up_of(9, 1000);
    bench.run_ms(100);
    assert!(!bench.is_bootloader(9), "and now it is again");
    bench.assert_nothing_unmodelled();
}
