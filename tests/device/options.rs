//! Options of a product that differ from the default: node-ID and bit rate by switches, other
//! COB-IDs, no boot-up message, layer setting services that start in configuration state and store
//! nothing, an immediate erase, and a pin that shows whether a program is valid.

use canopen::program::ProgramControl;
use canopen::{BitRate, NodeId};
use coboot_can::SdoIds;
use coboot_tests::bench::{Bench, NODE as BOARD_NODE};
use coboot_tests::firmware;
use coflash_core::device::{Doing, Session, Timing};
use coflash_core::update::{flash, FlashOptions};
use emulator::time::Time;

/// Pins of port E that the product `switches` reads: the node-ID on 8 to 14, the index of the bit
/// rate on 4 to 7.
pub(crate) fn set_switches(bench: &mut Bench, node: u8, index: u8) {
    let pins = u16::from(node) << 8 | u16::from(index) << 4;
    for pin in 4..15 {
        bench.machine().set_pin('E', pin, Some(pins >> pin & 1 == 1));
    }
}

/// The node-ID of most tests.
pub(crate) const NODE: u8 = 42;

/// Uses a session with this node by the COB-IDs of the product.
pub(crate) fn with<T>(bench: &mut Bench, what: impl FnOnce(&mut Session<'_>) -> T) -> T {
    let mut ids = SdoIds::new(bench, 0x300, 0x480);
    what(&mut Session::new(&mut ids, NodeId::new(NODE).unwrap(), Timing::default()))
}

/// A running device with these switches, on a bus with 500 kbit/s.
fn switched_on(node: u8, rate: BitRate) -> Bench {
    let mut bench = Bench::of_image(firmware::BOOTLOADER_SWITCHES);
    bench.set_host_bit_rate(500_000);
    set_switches(&mut bench, node, rate as u8);
    bench.power_on();
    bench.run_ms(50);
    bench
}

/// A request for 1000h on 300h plus the node-ID is answered on 480h plus the node-ID, and the
/// predefined COB-IDs are unused.
#[test]
fn node_id_bit_rate_and_cob_ids_are_the_products() {
    for (node, rate) in [(2, BitRate::K500), (42, BitRate::K500), (100, BitRate::K500)] {
        let mut bench = switched_on(node, rate);
        assert!(bench.records().is_empty(), "no boot-up message, no emergency");
        let id = u32::from(node);
        let request = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
        let answer = bench.ask(0x300 + u16::from(node), &request, 0x480 + id);
        assert_eq!(answer.unwrap(), [0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10]);
        assert_eq!(bench.ask(0x600 + u16::from(node), &request, 0x580 + id), None);
        bench.run_ms(1000);
        // The heartbeat is sent, with state PRE-OPERATIONAL.
        assert!(bench
            .frames_since(Time::default())
            .iter()
            .any(|(_, cob, data)| { *cob == 0x700 + id && data == &[0x7F] }));
        bench.assert_nothing_unmodelled();
    }
}

/// A bit rate outside the product's range (1 Mbit/s; 20 kbit/s) and invalid switches select the
/// board's 125 kbit/s; with an invalid node-ID the device waits for LSS, and announces it.
#[test]
fn switches_out_of_range_stand_for_the_boards() {
    for index in [0, 7, 15] {
        let mut bench = Bench::of_image(firmware::BOOTLOADER_SWITCHES);
        set_switches(&mut bench, 42, index);
        bench.power_on();
        bench.run_ms(50);
        let answer = bench.ask(0x32A, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0], 0x4AA);
        assert!(answer.is_some(), "index {index}: at 125 kbit/s");
    }
    let bench = switched_on(0, BitRate::K500);
    // 50h, "non-configured slave" (CiA 305): the product's announcement in place of the boot-up
    // message.
    let announced = bench.frames_since(Time::default());
    assert_eq!(announced.len(), 1, "{announced:x?}");
    assert_eq!((announced[0].1, announced[0].2[0]), (0x7E4, 0x50));
}

/// Layer setting services start in configuration state, set a node-ID, and store nothing.
#[test]
fn lss_starts_in_configuration_and_stores_nothing() {
    let mut bench = switched_on(NODE, BitRate::K500);
    // 5Eh: inquire node-ID, without a selection.
    let answer = bench.ask(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0], 0x7E4).unwrap();
    assert_eq!(answer[..2], [0x5E, 42]);
    // 11h: configure node-ID; 1: outside the product's 2 to 100.
    for (id, refused) in [(1, 1), (2, 0), (100, 0), (101, 1), (127, 1), (255, 0)] {
        let answer = bench.ask(0x7E5, &[0x11, id, 0, 0, 0, 0, 0, 0], 0x7E4).unwrap();
        assert_eq!(answer[..2], [0x11, refused], "{id}");
    }
    // 17h: store configuration; 1: storing is not supported.
    let answer = bench.ask(0x7E5, &[0x17, 0, 0, 0, 0, 0, 0, 0], 0x7E4).unwrap();
    assert_eq!(answer[..2], [0x17, 1]);
}

/// CiA 301 clause 7.2.4.3.9: the answer to an initiate (A4h: with CRC) has the segments of a sub-block; a
/// device without block download knows no such request (05040001h), and a tool goes on in segments.
#[test]
fn block_download_has_the_products_sub_blocks_or_is_not_there() {
    let initiate = [0xC6, 0x50, 0x1F, 1, 100, 0, 0, 0];
    let mut bench = switched_on(NODE, BitRate::K500);
    let answer = bench.ask(0x32A, &initiate, 0x4AA).unwrap();
    assert_eq!(answer, [0xA4, 0x50, 0x1F, 1, 20, 0, 0, 0]);

    let mut bench = Bench::of_image(firmware::BOOTLOADER_LEAST).switched_on();
    let refused = bench.ask(0x601, &initiate, 0x581).unwrap();
    assert_eq!((refused[0], refused[4..].to_vec()), (0x80, vec![0x01, 0, 0x04, 0x05]));
    bench.update(firmware::APP_V1);
    assert!(!bench.is_bootloader(BOARD_NODE));
}

/// A program gets the COB-IDs with the handoff: trial, start and call back go by the same ones.
#[test]
fn an_update_keeps_the_cob_ids_of_the_product() {
    let mut bench = switched_on(NODE, BitRate::K500);
    bench.machine().set_pin('C', 0, Some(true));
    for program in [firmware::APP_V1, firmware::APP_V2, firmware::APP_C, firmware::APP_TEST] {
        let file = firmware::blocks(program);
        let options = FlashOptions::default();
        let report = with(&mut bench, |session| flash(session, &file, &options, &mut |_| {}).unwrap());
        assert!(!report.running.unwrap().is_bootloader(), "{program}");
        // By the predefined ones nobody answers.
        assert_eq!(bench.ask(0x62A, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0], 0x5AA), None, "{program}");
    }
}

/// A released program only starts while PC0 is high; CLEAR of this product erases at once.
#[test]
fn a_pin_says_whether_a_program_is_valid() {
    let mut bench = switched_on(NODE, BitRate::K500);
    bench.machine().set_pin('C', 0, Some(true));
    let file = firmware::blocks(firmware::APP_V1);
    let in_bootloader = |bench: &mut Bench| {
        let answer = bench.ask(0x32A, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0], 0x4AA);
        answer.unwrap() == [0x43, 0x00, 0x10, 0, 0x00, 0x00, 0x00, 0x10]
    };
    with(&mut bench, |session| {
        flash(session, &file, &FlashOptions::default().start(false), &mut |_| {}).unwrap();
        coflash_core::update::steps::release(session, 1, &mut |_| {}).unwrap();
    });
    let restart = |bench: &mut Bench, valid: bool| {
        bench.power_off();
        bench.machine().set_pin('C', 0, Some(valid));
        bench.power_on();
        bench.run_ms(600);
        in_bootloader(bench)
    };
    assert!(restart(&mut bench, false), "low: the bootloader stays, without a rescue window");
    bench.run_ms(600);
    assert!(in_bootloader(&mut bench));
    assert!(!restart(&mut bench, true), "high: behind the rescue window the program runs");
    // The first CLEAR erases the whole program.
    bench.power_off();
    bench.machine().set_pin('C', 0, Some(false));
    bench.power_on();
    bench.run_ms(50);
    with(&mut bench, |session| {
        session.command(1, ProgramControl::Clear).unwrap();
        session.await_idle(1, Doing::Block(0)).unwrap();
    });
    let program = firmware::board().programs[0];
    let at = (program.base - firmware::board().chip.flash.base) as usize;
    assert!(bench.machine().flash()[at..at + 4096].iter().all(|byte| *byte == 0xFF));
}
