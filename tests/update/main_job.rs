//! The main job, with the built images on the emulated chip: flash, start, call back, flash again,
//! survive a power cut.

use canopen::Address;
use coboot_tests::bench::Bench;
use coboot_tests::firmware;
use coflash_core::update::event::Phase;
use coflash_core::update::{flash, Event, FlashOptions};

#[test]
fn an_empty_board_says_boot_up_and_serves_its_objects() {
    let mut bench = Bench::new().switched_on();
    let mut session = bench.session();
    assert_eq!(session.read_number(Address::new(0x1000, 0)).unwrap(), 0x1000_0000);
    assert_eq!(session.read_number(Address::new(0x1F57, 1)).unwrap(), 0);
    assert_eq!(session.read_number(Address::new(0x1018, 0)).unwrap(), 4);
    bench.assert_nothing_unmodelled();
}

#[test]
fn the_main_job() {
    let mut bench = Bench::new().switched_on();

    let mut events = Vec::new();
    let report = flash(
        &mut bench.session(),
        firmware::blocks(firmware::APP_V1),
        &FlashOptions::default(),
        &mut |event| {
            events.push(event);
        },
    )
    .unwrap();
    assert!(matches!(events.as_slice(), [.., Event::Phase(Phase::Started(_)), Event::Done(_)]), "{events:?}");
    let mut session = bench.session();
    assert_eq!(session.read_text(Address::new(0x100A, 0)).unwrap(), "1.0.0");
    assert_eq!(
        session.read_number(Address::new(0x1F56, 1)).unwrap(),
        report.program_crc,
        "through the callgate"
    );
    assert_eq!(session.read_number(Address::new(0x1F51, 1)).unwrap(), 1, "running");

    bench.install(firmware::APP_V2);
    assert_eq!(bench.text(0x100A), "2.0.0");

    bench.restart();
    assert_eq!(bench.text(0x100A), "2.0.0");
    bench.assert_nothing_unmodelled();
}
