//! What the bootloader tells a debug probe, and that a release tells nothing.

use canopen::program::ProgramControl;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use emulator::rtt::Reader;
use object::{Object, ObjectSymbol};

fn told(bench: &mut Bench, reader: &mut Reader) -> Vec<String> {
    reader.lines(bench.machine(), firmware::board().chip.sram)
}

/// Codes from docs/protocol.md: 6 no valid program; 02 NOVALPROG; 06090030h an unknown command, and request 5 as after a power-on.
#[test]
fn a_probe_is_told_why_it_stayed_what_it_refuses_and_that_it_leaves() {
    let mut bench = Bench::of_image(firmware::BOOTLOADER_LOG);
    let mut reader = Reader::default();
    bench.power_on();
    bench.await_boot_up(100);
    bench.run_ms(5);
    assert_eq!(
        told(&mut bench, &mut reader),
        ["stayed in the bootloader; why 00000006", "emergency; code and detail FF000042"]
    );

    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.run_ms(5);
    assert_eq!(
        told(&mut bench, &mut reader),
        ["1F51h; program and command 00000101", "1F57h; program and status 00010002"]
    );

    // 1F51h/1 = 7Fh (CiA 301 section 7.2.4.3.3: expedited, one byte).
    bench.post(0x600 + u16::from(NODE), &[0x2F, 0x51, 0x1F, 0x01, 0x7F, 0, 0, 0]);
    bench.run_ms(10);
    assert_eq!(
        told(&mut bench, &mut reader),
        ["1F51h; program and command 0000017F", "refused; abort code 06090030"]
    );

    // NMT: reset node.
    bench.post(0x000, &[0x81, 0]);
    bench.run_ms(10);
    assert_eq!(told(&mut bench, &mut reader), ["leaving; request 00000005"]);
    bench.assert_nothing_unmodelled();
}

/// Without a probe nobody takes the lines away: what finds no room is left out, and the device goes on.
#[test]
fn nobody_waits_for_a_probe() {
    let mut bench = Bench::of_image(firmware::BOOTLOADER_LOG);
    bench.power_on();
    bench.await_boot_up(100);
    for _ in 0..100 {
        bench.session().command(1, ProgramControl::Start).unwrap();
    }
    let lines = told(&mut bench, &mut Reader::default());
    // A kibibyte of them, and none of them cut.
    assert!((20..40).contains(&lines.len()), "{}", lines.len());
    assert!(lines.iter().all(|line| line.len() > 9 && line.as_bytes()[line.len() - 9] == b' '), "{lines:?}");
}

#[test]
fn a_release_has_nothing_of_it() {
    let has = |image: &str| {
        let bytes = firmware::elf(image);
        let elf = object::File::parse(&bytes[..]).expect("an ELF of ours");
        let symbol = elf.symbols().any(|symbol| symbol.name() == Ok("_SEGGER_RTT"));
        let words = bytes.windows(14).any(|part| part == b"leaving; reque");
        (symbol, words)
    };
    assert_eq!(has(firmware::BOOTLOADER_LOG), (true, true));
    for image in [firmware::BOOTLOADER, firmware::BOOTLOADER_COMPLETE, firmware::BOOTLOADER_MINIMAL] {
        assert_eq!(has(image), (false, false), "{image}");
    }
}
