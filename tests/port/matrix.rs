//! The possible combinations of a product: each dialect with each log, with CAN over UART, with
//! LSS, HEX and two programs. The sessions of `tests/expected` run on the board with two programs,
//! which has room for all of them.

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::listener::Listener;
use coboot_tests::script::{play_on, Wire};
use coboot_tests::serial::TextBus;
use coboot_tests::{firmware, script};
use coflash_core::device::{Doing, Session};
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::read;
use coflash_core::update::{flash, FlashOptions};
use emulator::time::{Span, Time};
use kit::ihex::intel_hex;
use shared_abi::layout::stm32f407g_disc1_two::LAYOUT;

/// A dialect: the names of its images, its session, and the node-ID of its device.
struct Dialect {
    name: &'static str,
    session: &'static str,
    node: u8,
}

const LIFT: Dialect = Dialect { name: "-lift", session: "lift.candump", node: 126 };
const DIALECTS: [Dialect; 4] = [
    Dialect { name: "", session: "cia302.candump", node: NODE },
    Dialect { name: "-paulus", session: "paulus.candump", node: NODE },
    Dialect { name: "-esacademy", session: "esacademy.candump", node: 64 },
    LIFT,
];

/// A running board with this bootloader.
fn board(bootloader: &str) -> Bench {
    println!("{bootloader}");
    let mut bench = Bench::of_image(&firmware::of_board(LAYOUT.board, &format!("{bootloader}.elf")));
    bench.power_on();
    bench.run_ms(50);
    bench
}

/// An image with CAN.
fn image(name: &str) -> String {
    firmware::of_board(LAYOUT.board, name)
}

/// The image with UART in its place.
fn serial_image(name: &str) -> String {
    let name = match name {
        firmware::APP_V1 => "app-virtual-can.elf",
        firmware::APP_V2 => "app-virtual-can-v2.elf",
        _ => panic!("{name}: no image for UART"),
    };
    firmware::of_board(LAYOUT.board, name)
}

fn write(session: &mut Session, index: u16, sub: u8, data: &[u8]) {
    session.write(Address::new(index, sub), data, Doing::Block(0), &mut |_| {}).unwrap();
}

/// Runs the session of a dialect. A lift device must have a running application: it first gets
/// `application`.
fn play(wire: &mut dyn Wire, dialect: &Dialect, application: &str, image: &dyn Fn(&str) -> String) {
    if dialect.name == LIFT.name {
        let program =
            firmware::raw_from(LAYOUT.programs[0].base, &firmware::of_board(LAYOUT.board, application));
        let mut session = wire.session_with(LIFT.node);
        write(&mut session, 0x6005, 1, shared_abi::LIFT_PASSWORD);
        write(&mut session, 0x1F50, 1, &program);
        session.await_idle(1, Doing::Block(0)).unwrap();
        session.command(1, ProgramControl::ResetStat).unwrap();
        wire.run_ms(500);
    }
    play_on(wire, dialect.session, &LAYOUT, image);
}

/// Each dialect writes each kind of log, and its session is the same as without a log.
fn logs(way: &str, listener: impl Fn(&str) -> Listener) {
    for dialect in &DIALECTS {
        let name = format!("bootloader-log-{way}{}", dialect.name);
        let mut bench = board(&name);
        let mut listener = listener(&firmware::of_board(LAYOUT.board, &format!("{name}.elf")));
        // 6: no valid program.
        let lines = listener.lines(&mut bench);
        assert_eq!(lines.first().map(String::as_str), Some("stayed in the bootloader; why 00000006"));
        play(&mut bench, dialect, "app-lift.elf", &image);
        // A session ends in the application or in the bootloader, which then logs its refusal.
        if bench.is_bootloader(dialect.node) {
            listener.lines(&mut bench);
            // 1F51h/1 = 7Fh (CiA 301 section 7.2.4.3.3: expedited, one byte).
            bench.post(0x600 + u16::from(dialect.node), &[0x2F, 0x51, 0x1F, 0x01, 0x7F, 0, 0, 0]);
            bench.run_ms(20);
            let lines = listener.lines(&mut bench);
            assert!(lines.iter().any(|line| line == "1F51h; program and command 0000017F"), "{lines:?}");
        }
        bench.assert_nothing_unmodelled();
    }
}

#[test]
fn each_dialect_tells_a_debug_probe_text() {
    logs("rtt", |_| Listener::probe());
}

#[test]
fn each_dialect_tells_a_debug_probe_frames_of_defmt() {
    logs("defmt", Listener::probe_of);
}

#[test]
fn each_dialect_tells_a_terminal() {
    logs("uart", |_| Listener::terminal());
}

/// CAN over UART: the same sessions, and no frame on the CAN bus. A UART has no bit rate to detect,
/// and no arbitration; no session uses either.
#[test]
fn each_dialect_plays_its_session_over_uart() {
    for dialect in &DIALECTS {
        let bench = board(&format!("bootloader-virtual-can{}", dialect.name));
        let mut bus = TextBus::new(bench);
        play(&mut bus, dialect, "app-virtual-can-lift.elf", &serial_image);
        assert!(bus.bench.records().is_empty(), "something was on the CAN bus");
        bus.bench.assert_nothing_unmodelled();
    }
}

#[test]
fn a_lift_takes_hex_and_a_set_of_parameters_and_speaks_lss() {
    let mut bench = board("bootloader-lift");
    play_on(&mut bench, "lift_lss_hex.candump", &LAYOUT, &image);
    // The received text was stored as the image.
    let mut session = bench.session();
    write(&mut session, 0x6005, 1, shared_abi::LIFT_PASSWORD);
    session.command(1, ProgramControl::ResetStat).unwrap();
    bench.await_boot_up_of(LIFT.node, 2000);
    let mut session = bench.session_with(LIFT.node);
    write(&mut session, 0x6005, 1, shared_abi::LIFT_PASSWORD);
    let stored = session.upload(Address::new(0x1F50, 1), &mut |_| {}).unwrap();
    assert_eq!(stored, firmware::raw_from(LAYOUT.programs[0].base, &image("app-lift-v2.elf")));
    bench.assert_nothing_unmodelled();
}

#[test]
fn the_boot_loader_of_esacademy_has_two_programs() {
    let mut bench = board("bootloader-esacademy");
    script::play_on(&mut bench, "esacademy_two.candump", &LAYOUT, &image);
    bench.assert_nothing_unmodelled();
}

/// Bit timing 9 of table 0 (CiA 305), stored: the device without a program listens, and answers a
/// single master under the node-ID of this dialect.
#[test]
fn the_boot_loader_of_esacademy_finds_the_bit_rate() {
    let mut bench = board("bootloader-esacademy");
    bench.post(0x7E5, &[0x04, 0x01, 0, 0, 0, 0, 0, 0]);
    for request in [[0x13, 0, 9, 0, 0, 0, 0, 0], [0x17, 0, 0, 0, 0, 0, 0, 0]] {
        bench.assert_answer(0x7E5, &request, 0x7E4, &[request[0], 0, 0, 0, 0, 0, 0, 0]);
    }
    for rate in [500_000, 50_000] {
        bench.power_off();
        bench.run_ms(50);
        bench.set_host_bit_rate(rate);
        bench.power_on();
        let answered = (0..80).any(|_| {
            let until = bench.time() + Span::from_millis(125);
            let answer = bench.ask(0x640, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0], 0x5C0);
            bench.world.run_until(until);
            // 424F4F54h, "BOOT".
            answer.as_deref() == Some(&[0x43, 0x00, 0x10, 0, 0x54, 0x4F, 0x4F, 0x42])
        });
        assert!(answered, "{rate} bit/s: no answer within 10 s");
        // A program can be downloaded at this rate: "INIT".
        let password = [0x23, 0x50, 0x7F, 0x02, 0x54, 0x49, 0x4E, 0x49];
        let from = bench.time();
        bench.post(0x640, &password);
        bench.run_ms(50);
        let opened = |(_, id, data): &(Time, u32, Vec<u8>)| {
            *id == 0x5C0 && data[..] == [0x60, 0x50, 0x7F, 2, 0, 0, 0, 0]
        };
        assert!(bench.frames_since(from).iter().any(opened), "{rate} bit/s");
    }
    bench.assert_nothing_unmodelled();
}

/// The interface shows the data decoded from the text.
#[test]
fn a_bootloader_with_the_debugger_takes_hex() {
    let mut bench = board("bootloader-debugger");
    let base = LAYOUT.programs[0].base;
    let program = firmware::raw_from(base, &image(firmware::APP_V1));
    let mut session = bench.session();
    session.command(1, ProgramControl::Clear).unwrap();
    write(&mut session, 0x1F50, 1, intel_hex(base, &program).as_bytes());
    assert_eq!(session.await_idle(1, Doing::Block(0)).unwrap().to_word(), 0);
    // 1025h/1: read 64 bytes of the program; 1025h/4 returns them.
    let [a, b, c, d] = base.to_le_bytes();
    write(&mut session, 0x1025, 1, &[0, 0, 64, 0, a, b, c, d]);
    let seen = session.upload(Address::new(0x1025, 4), &mut |_| {}).unwrap();
    assert_eq!(seen, program[..64]);
    session.command(1, ProgramControl::Start).unwrap();
    bench.await_boot_up(1000);
    assert!(!bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();
}

/// A product with CRC-16: `coflash convert --crc16` makes its files. A file with the other CRC is
/// refused at its first block (CRC, 06h), 1F56h reads 16 bits, and the boot stage accepts the
/// program.
#[test]
fn a_product_with_crc_16_is_updated_by_block_file() {
    use coflash_core::file::checksum::Checksum;

    let mut bench = board("bootloader-crc-16");
    let file = |checksum| {
        let firmware = read(&firmware::elf(&image(firmware::APP_V1)), None, None).unwrap();
        let region = Region::Strict(LAYOUT.programs[0].into());
        program_of(firmware, &Options::default().region(region).checksum(checksum)).unwrap().program
    };
    let options = FlashOptions::default().start(false).repeats(0).verify(true);
    let refused = flash(&mut bench.session(), file(Checksum::Crc32), &options, &mut |_| {});
    assert!(refused.is_err());
    assert_eq!(bench.session().status(1).unwrap().to_word() & 0xFFFF, 0x06);

    let file = file(Checksum::Crc16);
    let crc = firmware::raw_from(LAYOUT.programs[0].base, &image(firmware::APP_V1));
    let crc = kit::bench::crc16(&crc[..file.size() as usize]);
    flash(&mut bench.session(), &file, &options, &mut |_| {}).unwrap();
    let mut session = bench.session();
    coflash_core::update::steps::release(&mut session, 1, &mut |_| {}).unwrap();
    assert_eq!(session.read_number(Address::new(0x1F56, 1)).unwrap(), crc);

    // It is not confirmed yet: boot-up message of the bootloader, and of the program 300 ms later.
    bench.power_cycle();
    bench.await_boot_up(100);
    bench.await_boot_up(400);
    assert!(!bench.is_bootloader(NODE));
    // Called back, it is confirmed; after START, and after the next power-on, only the program
    // sends a boot-up message.
    bench.call_back();
    assert!(bench.is_bootloader(NODE));
    bench.start_program();
    assert!(!bench.is_bootloader(NODE));
    bench.power_cycle();
    bench.await_boot_up(100);
    assert!(!bench.is_bootloader(NODE));
    assert_eq!(bench.number(0x1F56, 1), crc);

    // The boot stage detects one changed bit.
    bench.power_off();
    let at = LAYOUT.programs[0].base + 0x1000;
    let byte = bench.machine().flash()[(at - LAYOUT.chip.flash.base) as usize];
    bench.machine().load_bin(at, &[byte ^ 1]).unwrap();
    bench.switch_on();
    assert!(bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();
}
