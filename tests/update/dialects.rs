//! The dialects of 1F50h and 1F51h (docs/dialects.md): scripted sessions with the frames from their
//! documents.

use canopen::program::ProgramControl;
use canopen::{AbortCode, Address};
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::{firmware, script};
use coflash_core::device::Doing;
use coflash_core::Error;
use emulator::time::{Span, Time};
use shared_abi::label::Label;
use shared_abi::layout::stm32f407g_disc1_two::LAYOUT;

const VERSION: Address = Address::new(0x100A, 0);

fn bench(bootloader: &str) -> Bench {
    let mut bench = Bench::of_image(bootloader);
    bench.power_on();
    bench.run_ms(50);
    bench
}

#[test]
fn a_master_that_knows_one_dialect_alone() {
    for (bootloader, recording) in [
        (firmware::BOOTLOADER, "cia302.candump"),
        (firmware::BOOTLOADER_PAULUS, "paulus.candump"),
        (firmware::BOOTLOADER_ESACADEMY, "esacademy.candump"),
    ] {
        let mut bench = bench(bootloader);
        script::play(&mut bench, recording);
        bench.assert_nothing_unmodelled();
    }
}

/// The boards with a region for a set of parameters have the chip of one board.
fn lift() -> Option<Bench> {
    if firmware::board().chip != LAYOUT.chip {
        println!("not run: {} has the chip of another board", LAYOUT.board);
        return None;
    }
    let mut bench = bench(&firmware::of_board(LAYOUT.board, firmware::BOOTLOADER_LIFT));
    unlock(&mut bench, LIFT);
    write(&mut bench, LIFT, 1, &app(0));
    bench.session_with(LIFT).command(1, ProgramControl::ResetStat).unwrap();
    bench.await_boot_up_of(NODE, 2000);
    Some(bench)
}

const LIFT: u8 = 126;
const UNLOCK: Address = Address::new(0x6005, 1);

fn app(version: usize) -> Vec<u8> {
    firmware::raw(&firmware::of_board(LAYOUT.board, firmware::APP_LIFT[version]))
}

fn unlock(bench: &mut Bench, node: u8) {
    bench.session_with(node).write(UNLOCK, shared_abi::LIFT_PASSWORD, Doing::Block(0), &mut |_| {}).unwrap();
}

fn write(bench: &mut Bench, node: u8, sub: u8, data: &[u8]) {
    let mut session = bench.session_with(node);
    session.write(Address::new(0x1F50, sub), data, Doing::Block(0), &mut |_| {}).unwrap();
    let status = session.await_idle(sub, Doing::Block(0)).unwrap();
    assert_eq!(status.to_word(), 0);
}

/// CiA 814-1 clause 6.3 and the following steps: the update, the backup of the stored data, and the
/// return to the device's own node-ID.
#[test]
fn a_lift_tool() {
    let Some(mut bench) = lift() else { return };
    script::play(&mut bench, "lift.candump");

    // The backup is equal to the stored data.
    let backup = bench.session_with(LIFT).upload(Address::new(0x1F50, 1), &mut |_| {}).unwrap();
    assert_eq!(backup, app(0));
    let parameters: Vec<u8> = (0..5000_u32).map(|i| (i * 7) as u8).collect();
    write(&mut bench, LIFT, 2, &parameters);
    write(&mut bench, LIFT, 1, &app(1));
    let mut session = bench.session_with(LIFT);
    assert_eq!(session.upload(Address::new(0x1F50, 2), &mut |_| {}).unwrap(), parameters);
    assert_eq!(session.upload(Address::new(0x1F50, 1), &mut |_| {}).unwrap(), app(1));
    assert_eq!(session.read_text(VERSION).unwrap(), "2.0.0", "100Ah is the stored image's");
    session.command(1, ProgramControl::ResetStat).unwrap();
    bench.await_boot_up_of(NODE, 2000);
    assert_eq!(bench.text(0x100A), "2.0.0");

    // The parameters survive all of this.
    unlock(&mut bench, NODE);
    bench.post(0, &[0x81, NODE]);
    bench.await_boot_up_of(LIFT, 2000);
    unlock(&mut bench, LIFT);
    assert_eq!(bench.session_with(LIFT).upload(Address::new(0x1F50, 2), &mut |_| {}).unwrap(), parameters);
    bench.assert_nothing_unmodelled();
}

/// A program of another vendor, for another product, or without a label: 08000020h, and the old
/// program stays.
#[test]
fn a_lift_takes_what_is_for_it_alone() {
    let Some(mut bench) = lift() else { return };
    unlock(&mut bench, NODE);
    bench.session().command(1, ProgramControl::ResetStat).unwrap();
    bench.await_boot_up_of(LIFT, 2000);
    unlock(&mut bench, LIFT);
    let bsp::Identity { vendor_id, product_code, .. } = bsp::IDENTITY;
    let labels = [
        (Label::new(vendor_id.wrapping_add(0x123), product_code, 1), 0x80),
        (Label::new(vendor_id, product_code ^ 1, 1), 0x82),
        (Label { magic: 0, ..Label::new(vendor_id, product_code, 1) }, 0x04),
    ];
    for (label, status) in labels {
        let image = firmware::with_label(app(1), &label);
        let mut session = bench.session_with(LIFT);
        let refused = session.write(Address::new(0x1F50, 1), &image, Doing::Block(0), &mut |_| {});
        let Err(Error::Refused { code, .. }) = refused else { panic!("{refused:?}") };
        assert_eq!(code, AbortCode(0x0800_0020));
        assert_eq!(session.status(1).unwrap().to_word(), status);
        assert_eq!(session.upload(Address::new(0x1F50, 1), &mut |_| {}).unwrap(), app(0));
    }
}

/// The tool reads 1000h of node 126 every 125 ms, on a bus without other nodes: the device detects
/// the bit rate from this and answers within 10 s.
#[test]
fn a_lift_device_alone_with_the_tool_finds_the_bit_rate() {
    let Some(mut bench) = lift() else { return };
    // By layer setting services of the application (CiA 305): configuration state, bit timing 9 of
    // table 0 (detect), store.
    for (request, answer) in [
        (&[0x04, 0x01, 0, 0, 0, 0, 0, 0], None),
        (&[0x13, 0x00, 0x09, 0, 0, 0, 0, 0], Some(&[0x13, 0, 0, 0, 0, 0, 0, 0][..])),
        (&[0x17, 0, 0, 0, 0, 0, 0, 0], Some(&[0x17, 0, 0, 0, 0, 0, 0, 0][..])),
    ] {
        assert_eq!(bench.ask(0x7E5, request, 0x7E4).as_deref(), answer);
    }
    // The program is made invalid, so that the device stays in the bootloader.
    bench.session().write(Address::new(0x2001, 0), &[0], Doing::Block(0), &mut |_| {}).unwrap();
    bench.power_off();
    for rate in [250_000, 10_000, 1_000_000] {
        bench.set_host_bit_rate(rate);
        bench.power_on();
        let from = bench.time();
        let answered = (0..80).any(|_| {
            let until = bench.time() + Span::from_millis(125);
            let answer = bench.ask(0x67E, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0], 0x5FE);
            bench.world.run_until(until);
            answer.as_deref() == Some(&[0x43, 0x00, 0x10, 0, 0xA1, 0x01, 0x00, 0xFE])
        });
        assert!(answered, "{rate} bit/s: no answer within 10 s");
        let heartbeat = |(_, id, data): &(Time, u32, Vec<u8>)| *id == 0x77E && data[..] == [0x7F];
        bench.run_ms(1200);
        assert!(bench.frames_since(from).iter().any(heartbeat), "{rate} bit/s");
        bench.power_off();
        bench.run_ms(50);
    }
}
