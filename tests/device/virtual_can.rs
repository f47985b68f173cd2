//! CAN over UART: the bootloader and the application use the board's serial port, with `coflash`
//! and its adapter.

use std::time::Duration;

use canopen::program::ProgramControl;
use canopen::{Address, NodeId};
use coboot_can::slcan::Slcan;
use coboot_can::Adapter;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::serial::SerialLine;
use coboot_tests::{firmware, tools};
use coflash_core::device::{Session, Timing};
use coflash_core::file::block_file::emit;
use coflash_core::update::{flash, FlashOptions};

/// A board in its bootloader, with no program installed.
fn empty_board() -> Bench {
    let mut bench = Bench::of_image(firmware::BOOTLOADER_VIRTUAL_CAN);
    bench.power_on();
    bench.run_ms(50);
    bench
}

/// The text that the board has sent on its line since the previous call.
fn said(bench: &mut Bench) -> String {
    String::from_utf8(bench.usart().take_sent().iter().map(|character| character.byte).collect())
        .expect("ASCII")
}

/// Sends text to the board and returns its output of the next `ms`.
fn ask(bench: &mut Bench, text: &[u8], ms: u64) -> String {
    let now = bench.time();
    assert_eq!(bench.usart().receive(text, now), text.len());
    bench.run_ms(ms);
    said(bench)
}

fn adapter(bench: &mut Bench) -> Slcan<SerialLine<&mut Bench>> {
    Slcan::open(SerialLine::new(bench), "the board's line".into(), Some(125_000)).expect("it opens")
}

fn session(adapter: &mut dyn Adapter) -> Session<'_> {
    Session::new(adapter, NodeId::new(NODE).unwrap(), Timing::default())
}

/// Boot-up and emergency (docs/protocol.md) in the text format of the CAN232's manual, and an SDO
/// upload of 1000h (CiA 301 section 7.2.4.3.5), all by hand: 10000000h is the bootloader's device
/// type.
#[test]
fn the_text_on_the_line() {
    let mut bench = empty_board();
    let sent = said(&mut bench);
    assert_eq!(sent, "t701100\rt081800FF00424F4F5406\r");
    assert_eq!(ask(&mut bench, b"C\rS4\rO\r", 20), "\r\r\r");
    assert_eq!(ask(&mut bench, b"t60184000100000000000\r", 20), "z\rt58184300100000000010\r");
    // A data length code above 8, as on a bus (ISO 11898-1:2015, table 5).
    assert_eq!(ask(&mut bench, b"t601F4000100000000000\r", 20), "z\rt58184300100000000010\r");
    // A frame for another node, NMT for another node, a remote frame and one with 29 bits: they are
    // acknowledged, as by any node of a bus.
    assert_eq!(
        ask(&mut bench, b"t60284000100000000000\rt00028105\rr6010\rT0000060184000100000000000\r", 30),
        "z\rz\rz\rZ\r"
    );
    // With a closed channel it receives and sends nothing; heartbeats come every second.
    assert_eq!(ask(&mut bench, b"C\rt60184000100000000000\r", 2500), "\r\x07");
    assert_eq!(ask(&mut bench, b"O\r", 2000).matches("t70117F\r").count(), 2);
    bench.assert_nothing_unmodelled();
}

/// The main job over the line: install, verify, start, call back, update. Meanwhile the CAN bus has
/// no frame.
#[test]
fn coflash_updates_the_device_through_its_serial_port() {
    let mut bench = empty_board();
    let blocks = firmware::blocks(firmware::APP_VIRTUAL_CAN);
    let options = FlashOptions::default().verify(true);
    let mut adapter = adapter(&mut bench);
    for round in 0..2 {
        let mut session = session(&mut adapter);
        flash(&mut session, &blocks, &options, &mut |_| {})
            .unwrap_or_else(|error| panic!("{round}: {error}"));
        assert!(!session.device_type().unwrap().unwrap().is_bootloader(), "the application runs");
        assert_eq!(session.read_number(Address::new(0x1F51, 1)).unwrap(), 1);
        // The second time the application is called back.
    }
    let mut session = session(&mut adapter);
    session.command(1, ProgramControl::StartBootloader).unwrap();
    assert!(session.await_boot_up(Duration::from_secs(1)).unwrap());
    assert!(session.device_type().unwrap().unwrap().is_bootloader());
    session.command(1, ProgramControl::Clear).unwrap();
    session.command(1, ProgramControl::Clear).unwrap();
    assert!(session.status(1).unwrap().busy);
    drop(adapter);
    assert!(bench.records().is_empty(), "something was on the CAN bus");
    assert_eq!(bench.machine().counters().flash_stalls, 0, "the line is served from RAM");
    bench.assert_nothing_unmodelled();
}

/// Requests 1F57h/1 by hand; returns whether the answer comes within 10 ms: the request takes 2.3
/// ms on the line, the answer 2 ms.
fn is_answered(bench: &mut Bench) -> bool {
    ask(bench, b"t601840571F0100000000\r", 10).contains("t581843571F01")
}

/// Invalid input: it is refused line by line, the device stays reachable, and its heartbeats come.
#[test]
fn noise_on_the_line_costs_nothing_but_itself() {
    let mut bench = empty_board();
    said(&mut bench);
    let mut state = 0x0123_4567_89AB_CDEF_u64;
    let noise: Vec<u8> = std::iter::repeat_with(|| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    })
    // The noise must not close the channel by chance.
    .filter(|byte| *byte != b'C')
    .take(40_000)
    .collect();
    // 40 000 characters take 3.5 s.
    let sent = ask(&mut bench, &noise, 3600);
    assert!(sent.matches('\x07').count() > 100, "{} refusals", sent.matches('\x07').count());
    assert!((3..=4).contains(&sent.matches("t70117F\r").count()), "{sent:?}");
    ask(&mut bench, b"\r", 10);
    assert!(is_answered(&mut bench));
    // A host requests twice as many answers as the line can carry. The device's own frames are
    // still sent.
    let flood = b"V\r".repeat(15_000);
    let sent = ask(&mut bench, &flood, 2700);
    assert!((2..=3).contains(&sent.matches("t70117F\r").count()), "heartbeats in a flood");
    bench.run_ms(100);
    assert!(is_answered(&mut bench));
    // After half a line, the host starts a new one.
    assert_eq!(ask(&mut bench, b"t60184057\r", 10), "\x07");
    assert!(is_answered(&mut bench));
    assert_eq!(ask(&mut bench, &[b'x'; 3000], 300).trim_matches(|c: char| c != '\x07'), "");
    assert_eq!(ask(&mut bench, b"\r", 5), "\x07");
    assert!(is_answered(&mut bench));
    bench.assert_nothing_unmodelled();
}

/// The host's terminal runs at another bit rate: none of its text is taken for a frame, an
/// emergency reports that something was lost (8110h, controller overrun), and text at the right bit
/// rate is understood at once.
#[test]
fn another_bit_rate_is_noticed() {
    let mut bench = empty_board();
    said(&mut bench);
    bench.usart().set_outside_bit_rate(38_400);
    let sent = ask(&mut bench, b"t60182F511F018000000000\rt60182F511F018000000000\r", 50);
    assert!(sent.contains("t08181081110000200000\r"), "{sent:?}");
    assert!(!sent.contains("t5818"), "{sent:?}");
    bench.usart().set_outside_bit_rate(115_200);
    ask(&mut bench, b"\r", 10);
    assert!(ask(&mut bench, b"F\r", 10).contains("F08\r"));
    assert!(is_answered(&mut bench));
}

/// While all of the program's flash is erased, each SDO is answered as soon as the line allows.
#[test]
fn never_silent_during_an_erase() {
    let mut bench = empty_board();
    bench.soil_programs();
    let mut adapter = adapter(&mut bench);
    let blocks = firmware::blocks(firmware::APP_VIRTUAL_CAN);
    let mut session_ = session(&mut adapter);
    flash(&mut session_, &blocks, &FlashOptions::default().start(false), &mut |_| {}).unwrap();
    session_.command(1, ProgramControl::Clear).unwrap();
    session_.command(1, ProgramControl::Clear).unwrap();
    drop(adapter);
    // The adapter closed the channel when it ended. A heartbeat may come in these 10 ms.
    assert_eq!(ask(&mut bench, b"O\r", 10).replace("t70117F\r", ""), "\r\r");
    let answers = (0..100).filter(|_| is_answered(&mut bench)).count();
    assert_eq!(answers, 100);
    assert!(
        ask(&mut bench, b"t601840571F0100000000\r", 10).contains("t581843571F0101"),
        "the erase must have lasted"
    );
    assert_eq!(bench.machine().counters().flash_stalls, 0);
}

/// The command line in real time, with a terminal as its serial port.
#[cfg(unix)]
#[test]
fn the_coflash_command_finds_the_device_at_its_serial_port() {
    let mut endpoint = Endpoint::serial(empty_board());
    let url = endpoint.url();
    let sent = endpoint.succeed(tools::coflash().args(["--bus", &url, "info"]));
    assert!(sent.contains("the bootloader") && sent.contains(bsp::IDENTITY.device_name), "{sent}");
}

/// python-can's adapter and python-canopen, both without knowledge of the device's own adapter,
/// install and start the application.
#[cfg(unix)]
#[test]
fn python_canopen_flashes_the_device_through_its_serial_port() {
    let folder = kit::folder!("virtual-can");
    let file = folder.write("program.blk", emit(&firmware::blocks(firmware::APP_VIRTUAL_CAN)));
    let mut endpoint = Endpoint::serial(empty_board());
    let port = endpoint.url().replace("@125k", "");
    let sent = endpoint.succeed(tools::script("canopen_client.py").arg(port).arg(file));
    assert!(sent.contains("the application reports 1F51h = 01h and the same 1F56h"), "{sent}");
    assert!(endpoint.bench.records().is_empty(), "something was on the CAN bus");
    endpoint.bench.assert_nothing_unmodelled();
}

#[test]
fn a_release_has_nothing_of_it() {
    let has = |image| firmware::elf(image).windows(5).any(|part| part == b"V1013");
    assert!(has(firmware::BOOTLOADER_VIRTUAL_CAN) && has(firmware::APP_VIRTUAL_CAN));
    for image in [firmware::BOOTLOADER, firmware::BOOTLOADER_PAULUS, firmware::APP_V1] {
        assert!(!has(image), "{image}");
    }
}
