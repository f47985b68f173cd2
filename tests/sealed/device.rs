//! The sealed device: the built bootloader with keys in its flash, on the emulated bus. It tests
//! which images the device accepts and refuses, and that the old program starts after every
//! refusal.

mod limits;

use std::process::Command;

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::Bench;
use coboot_tests::firmware;
use coboot_tests::listener::Listener;
use coboot_tests::sealed_board::{
    board, board_of, board_with_a_program, call_back, key, keys, open_board, root, seal, sealer, start,
    status, write, COUNTER, KEKS,
};
use coflash_core::device::access::{ask, challenge, events};
use coflash_core::device::debugger::Debugger;
use coflash_core::device::Transfers;
use coflash_core::file::sealed::{Sealer, SigningKey};
use seal::access::{event, right};

const CRC_OF_PROGRAM: Address = Address::new(0x1F56, 1);

/// The four kinds of payload.
fn kinds(counter: u32) -> [(&'static str, Sealer<'static>); 4] {
    let plain = sealer(counter);
    let encrypted = Sealer { encrypt_for: &*KEKS, ..plain.clone() };
    [
        ("plain", plain.clone()),
        ("encrypted", encrypted.clone()),
        ("compressed", Sealer { compress: true, ..plain }),
        ("encrypted and compressed", Sealer { compress: true, ..encrypted }),
    ]
}

/// 1F52h has the date of the manifest, also for the same program sealed again. (2000-02-29 12:00 and 2026-11-27
/// 18:30:15 by GNU date, and the days of a calendar.)
#[test]
fn the_date_of_a_sealed_program_is_that_of_its_manifest() {
    fn date(bench: &mut Bench) -> [u32; 2] {
        [1, 2].map(|sub| bench.session().read_number(Address::new(0x1F52, sub)).unwrap())
    }
    let mut bench = board().switched_on();
    for (counter, created, expected) in
        [(COUNTER, 951_825_600, [5903, 43_200_000]), (COUNTER + 1, 1_795_804_215, [15_671, 66_615_000])]
    {
        let file = seal(&Sealer { created, ..sealer(counter) }, firmware::APP_V1);
        assert_eq!(write(&mut bench, &file, Transfers::Blocks), (None, status::OK));
        assert_eq!(date(&mut bench), expected, "{created}");
        start(&mut bench, firmware::APP_V1, "1.0.0");
        assert_eq!(date(&mut bench), expected, "{created}, in the program");
        call_back(&mut bench);
        assert_eq!(date(&mut bench), expected, "{created}, after its return");
    }
}

/// Every kind, written by either transfer without checks by the host; each one replaces the
/// previous one.
#[test]
fn sealed_programs_are_taken_and_started() {
    let mut bench = board().switched_on();
    let versions = [(firmware::APP_V1, "1.0.0"), (firmware::APP_V2, "2.0.0")];
    for transfers in [Transfers::Segments, Transfers::Blocks] {
        for ((what, sealer), (image, version)) in kinds(COUNTER)
            .iter()
            .zip(versions.into_iter().cycle().skip(usize::from(transfers == Transfers::Blocks)))
        {
            let file = seal(sealer, image);
            assert_eq!(write(&mut bench, &file, transfers), (None, status::OK), "{what}, {transfers:?}");
            start(&mut bench, image, version);
            call_back(&mut bench);
        }
    }
    bench.assert_nothing_unmodelled();
}

/// With a log and with the debugger interface, which a developer needs in a sealed device as in any
/// other: an update is logged; the keys can be read, as in each image with the debugger.
#[test]
fn a_sealed_device_can_be_looked_into_during_development() {
    let file = seal(&sealer(COUNTER), firmware::APP_V1);
    let mut listener = Listener::probe();
    let mut bench = board_of(firmware::BOOTLOADER_SEALED_LOG_RTT).switched_on();
    assert_eq!(write(&mut bench, &file, Transfers::Blocks), (None, status::OK));
    let lines = listener.lines(&mut bench);
    assert!(lines.iter().any(|line| line == "1F51h; program and command 00000103"), "{lines:?}");
    start(&mut bench, firmware::APP_V1, "1.0.0");

    let mut bench = board_of(firmware::BOOTLOADER_SEALED_DEBUGGER).switched_on();
    assert_eq!(write(&mut bench, &file, Transfers::Blocks), (None, status::OK));
    let place = firmware::board().key_block().base;
    let read = Debugger::new(&mut bench.session()).read(place, 256, &mut |_| {}).unwrap();
    assert_eq!(read, keys());
    start(&mut bench, firmware::APP_V1, "1.0.0");
}

/// Without keys the same bootloader accepts programs like any other, and refuses sealed programs:
/// it has no root.
#[test]
fn without_keys_the_device_is_open() {
    let mut bench = open_board().switched_on();
    let sealed = seal(&sealer(COUNTER), firmware::APP_V1);
    assert_eq!(write(&mut bench, &sealed, Transfers::Blocks).1, status::KEY);
    assert_eq!(write(&mut bench, &firmware::raw(firmware::APP_V1), Transfers::Segments), (None, status::OK));
    start(&mut bench, firmware::APP_V1, "1.0.0");
    call_back(&mut bench);
    let file = firmware::blocks(firmware::APP_V2);
    coflash_core::update::flash(&mut bench.session(), &file, &Default::default(), &mut |_| {}).unwrap();
    assert_eq!(bench.text(0x100A), "2.0.0");
    bench.assert_nothing_unmodelled();
}

/// The demonstration runs to its end, which it does not if the device accepts or refuses the wrong
/// image.
#[test]
fn the_demonstration_succeeds() {
    let output = Command::new(env!("CARGO_BIN_EXE_demo")).arg("--sealed").output().unwrap();
    let reported = [output.stdout, output.stderr].concat();
    let reported = String::from_utf8_lossy(&reported);
    assert!(output.status.success(), "{reported}");
    for line in ["1F57h = 8Ah", "1F57h = 8Ch", "1F57h = 8Eh", "1F57h = 84h"] {
        assert!(reported.contains(line), "no {line:?} in:\n{reported}");
    }
    assert_eq!(reported.matches("the old program starts").count(), 5, "{reported}");
}

/// Destructive actions need the root key: they are requested by 2002h, permitted until the next
/// reset, and recorded in 2003h, which survives a power-off.
#[test]
fn the_holder_of_the_root_key_gets_rights_and_the_device_remembers() {
    let mut bench = board_with_a_program();
    let clear_twice = |bench: &mut Bench| {
        let first = bench.session().command(1, ProgramControl::Clear);
        first.and_then(|()| bench.session().command(1, ProgramControl::Clear))
    };
    assert!(clear_twice(&mut bench).is_err(), "nobody has the right yet");
    assert!(bench.session().read_number(CRC_OF_PROGRAM).unwrap() != 0, "and the program is there");

    let before = challenge(&mut bench.session()).unwrap();
    assert_eq!(before.granted(), 0);
    let ask_by = |bench: &mut Bench, signer: &SigningKey, claimed: &SigningKey| {
        let asked = (right::ERASE, 0, claimed.public().id());
        let challenge = challenge(&mut bench.session()).unwrap();
        ask(&mut bench.session(), asked, &signer.sign(&challenge.tbs(asked.0, asked.1, asked.2)))
    };
    let stranger = key(99);
    assert!(ask_by(&mut bench, &stranger, &stranger).is_err(), "not a root of the device");
    // Each wrong signature doubles the next wait; each attempt here takes two seconds.
    for _ in 0..3 {
        let granted = ask_by(&mut bench, &stranger, &root()).unwrap();
        assert!(!granted, "a root's id, and another one's signature");
    }
    assert!(ask_by(&mut bench, &root(), &root()).is_err(), "it waits after wrong signatures");
    bench.run_ms(3000);
    assert!(ask_by(&mut bench, &root(), &root()).unwrap());
    assert_ne!(
        challenge(&mut bench.session()).unwrap().tbs(0, 0, 0),
        before.tbs(0, 0, 0),
        "a nonce is used once"
    );
    // The refused one ended the row: only a second one from here erases at once.
    clear_twice(&mut bench).unwrap();
    assert_eq!(bench.session().read_number(CRC_OF_PROGRAM).unwrap(), 0, "erased");

    bench.power_cycle();
    bench.await_boot_up(100);
    assert_eq!(challenge(&mut bench.session()).unwrap().granted(), 0, "until the reset");
    let reported: Vec<u32> = events(&mut bench.session()).unwrap().iter().map(|event| event.what).collect();
    assert_eq!(reported, [event::UNLOCKED | right::ERASE, event::INSTALLED | 1]);
}

/// The holder of the root key can open the device permanently: from the next reset on, it accepts
/// and starts unsealed programs, also after a power-off, and sealed ones as before.
#[test]
fn the_holder_of_the_root_key_opens_the_device_for_good() {
    let mut bench = board_with_a_program();
    let ask_by = |bench: &mut Bench, signer: &SigningKey| {
        let asked = (right::OPEN, 0, root().public().id());
        let challenge = challenge(&mut bench.session()).unwrap();
        assert!(challenge.is_sealed());
        ask(&mut bench.session(), asked, &signer.sign(&challenge.tbs(asked.0, asked.1, asked.2))).unwrap()
    };
    let raw = firmware::raw(firmware::APP_V2);
    assert!(!ask_by(&mut bench, &key(99)), "a root's id, and another one's signature");
    bench.run_ms(3000);
    assert!(ask_by(&mut bench, &root()));
    assert_eq!(write(&mut bench, &raw, Transfers::Segments).1, status::NO_ACCESS, "not before the reset");
    for round in 0..2 {
        bench.power_cycle();
        bench.await_program(1000);
        call_back(&mut bench);
        assert!(!challenge(&mut bench.session()).unwrap().is_sealed(), "round {round}");
        assert_eq!(write(&mut bench, &raw, Transfers::Segments), (None, status::OK));
        start(&mut bench, firmware::APP_V2, "2.0.0");
        call_back(&mut bench);
    }
    let sealed = seal(&sealer(COUNTER), firmware::APP_V1);
    assert_eq!(write(&mut bench, &sealed, Transfers::Blocks), (None, status::OK));
    start(&mut bench, firmware::APP_V1, "1.0.0");
    bench.assert_nothing_unmodelled();
}
