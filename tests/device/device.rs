//! The device on the bus: its refusals, its robustness, and its answer times.

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{abort_code, press, Bench, HEARTBEAT, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coflash_core::device::Doing;
use coflash_core::update::event::Phase;
use coflash_core::update::steps::enter_bootloader;
use coflash_core::update::{flash, Event, FlashOptions};
use emulator::machine::Options;
use emulator::time::Span;
use kit::rig::block;

const DATA: Address = Address::new(0x1F50, 1);
const STATUS: Address = Address::new(0x1F57, 1);
const VERSION: u16 = 0x100A;

/// A board that runs version 1.
pub(super) fn running_board() -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.update(firmware::APP_V1);
    bench
}

/// Saves the flash of program 1, to detect changes.
fn program_flash(bench: &mut Bench) -> Vec<u8> {
    bench.machine().flash()[firmware::program_offset()..].to_vec()
}

/// The address of program 1.
fn program_start() -> u32 {
    firmware::board().programs[0].base
}

/// Sends a block; returns the abort code and the status after all work.
fn send(bench: &mut Bench, block: &[u8]) -> (Option<u32>, u32) {
    let mut session = bench.session();
    let abort = abort_code(session.write(DATA, block, Doing::Block(0), &mut |_| {}));
    let status = session.await_idle(1, Doing::Read(STATUS)).unwrap();
    (abort, status.to_word())
}

#[test]
fn the_largest_block_of_the_manual_is_taken() {
    let mut bench = Bench::new().switched_on();
    bench.session().command(1, ProgramControl::Clear).unwrap();
    bench.session().await_idle(1, Doing::Read(STATUS)).unwrap();
    assert_eq!(send(&mut bench, &block(0, 0, &[0; 8])), (None, 0));
    let data = firmware::made_up(16384 - 16, |i| (i % 251) as u8);
    assert_eq!(send(&mut bench, &block(1, program_start(), &data)), (None, 0));
    // Erased and programmed in the background.
    bench.run_ms(2000);
    assert_eq!(program_flash(&mut bench)[..data.len()], data);
}

#[test]
fn a_trial_run_comes_back_to_the_bootloader_and_an_unsigned_program_does_not_start_by_itself() {
    let mut bench = Bench::new().switched_on();
    let file = firmware::blocks(firmware::APP_V1);
    let options = FlashOptions::default();
    let mut trial_passed = false;
    flash(&mut bench.session(), &file, &options, &mut |event| {
        trial_passed |= matches!(event, Event::Phase(Phase::TrialPassed(_)));
    })
    .unwrap();
    assert!(trial_passed);
    // It runs, and is called back for the next part.
    enter_bootloader(&mut bench.session(), &mut |_| {}).unwrap();
    bench.session().command(1, ProgramControl::ClrSignature).unwrap();
    bench.session().await_idle(1, Doing::Command(ProgramControl::ClrSignature)).unwrap();
    let stays = |bench: &mut Bench| {
        bench.power_cycle();
        bench.await_boot_up(1000);
        bench.is_bootloader(NODE)
    };
    assert!(stays(&mut bench));
    bench.start_program();
    assert!(!bench.is_bootloader(NODE), "started on request, for once");
    assert!(stays(&mut bench), "and not again");
}

/// Reads 1F57h every 7 ms until it is not busy; returns the longest time until an answer, and the
/// number of busy values.
fn slowest_answer(bench: &mut Bench) -> (Span, u32) {
    let mut slowest = Span(0);
    let mut busy = 0;
    loop {
        bench.run_ms(7);
        let asked = bench.time();
        let answer = bench.ask(REQUEST, &[0x40, 0x57, 0x1F, 0x01, 0, 0, 0, 0], RESPONSE).expect("an answer");
        slowest = slowest.max(bench.time() - asked);
        if answer[4] & 1 == 0 {
            break;
        }
        busy += 1;
    }
    (slowest, busy)
}

/// While the whole flash of the program is erased, each SDO request is answered within 5 ms, and
/// the heartbeat keeps its period within 10 %.
#[test]
fn never_silent_during_an_erase() {
    let mut bench = running_board();
    bench.call_back();
    bench.soil_programs();
    let from = bench.time();
    // Twice in a row: erase everything at once.
    bench.session().command(1, ProgramControl::Clear).unwrap();
    bench.session().command(1, ProgramControl::Clear).unwrap();
    let (slowest, busy) = slowest_answer(&mut bench);
    assert!(busy > 300, "the erase must have lasted: {busy} busy answers");
    // Both frames of the exchange are part of the measured time.
    assert!(slowest <= Span::from_millis(5), "{} us", slowest.0 / 1_000_000);
    let beats = bench.frames_of(HEARTBEAT, from);
    // Typical erase times (DS8626 table 39 and similar): a second for 128 KiB.
    let seconds = (firmware::board().programs[0].size / (128 * 1024)) as usize;
    assert!(beats.len() >= seconds, "{beats:?}");
    for pair in beats.windows(2) {
        let period = pair[1].0 - pair[0].0;
        assert!((900..=1100).contains(&(period.0 / 1_000_000_000)), "{} ms", period.0 / 1_000_000_000);
    }
    assert_eq!(bench.machine().counters().flash_stalls, 0);
}

#[test]
fn the_entry_strap_holds_the_device_in_the_bootloader() {
    let mut bench = running_board();
    bench.power_off();
    if !press(bench.machine(), true) {
        println!("this board has no strap");
        return;
    }
    bench.switch_on();
    assert!(bench.is_bootloader(NODE));
    press(bench.machine(), false);
    bench.restart();
    assert!(!bench.is_bootloader(NODE));
}

#[test]
fn nmt_resets_restart_the_device_or_the_communication() {
    let mut bench = running_board();
    bench.call_back();
    bench.events();
    // Reset communication (82h) to this node: a boot-up message, and no reset of the chip.
    bench.assert_answer(0, &[0x82, NODE], HEARTBEAT, &[0]);
    assert_eq!(bench.events(), []);
    // Start (01h) to all: the bootloader stays PRE-OPERATIONAL (7Fh).
    bench.post(0, &[0x01, 0]);
    let from = bench.time();
    bench.run_ms(1100);
    assert!(bench.frames_since(from).iter().any(|(_, id, data)| *id == HEARTBEAT && data[..] == [0x7F]));
    // Reset node (81h) to another node has no effect; to all nodes it resets the device, and then
    // the autostart applies.
    bench.post(0, &[0x81, NODE + 1]);
    bench.run_ms(100);
    assert_eq!(bench.events(), []);
    bench.post(0, &[0x81, 0]);
    bench.await_boot_up(1000);
    assert_eq!(bench.text(VERSION), "1.0.0");
}

/// Noise in the RAM at power-on (including the warm-start cell and the handoff) is not a request.
#[test]
fn noise_in_the_ram_is_no_request() {
    let mut installed = running_board();
    let flash_image = installed.machine().flash().to_vec();
    for seed in 0..20 {
        let mut bench = Bench::with(Options { seed, ..Options::default() });
        bench.machine().load_bin(firmware::board().chip.flash.base, &flash_image).unwrap();
        bench.power_on();
        bench.await_program(1000);
        assert!(!bench.is_bootloader(NODE), "seed {seed}: the program starts as after any power-on");
    }
}

/// The proof of the test above: with eight bytes of code left in flash it fails. The CAN interrupt
/// jumps through these bytes, as it would if its handler had not been copied to RAM.
#[test]
fn code_left_in_flash_would_not_answer_in_time() {
    let mut bench = running_board();
    bench.call_back();
    // After the bootloader's image, in its own flash. ARMv7-M A7.7.44: ldr.w pc, [pc, #0], and the
    // address after it.
    let stub_address = firmware::board().bootloader.end() - 0x100;
    // CAN1_TX is interrupt 19 (RM0090 table 61); the vector table is at the beginning of the RAM.
    let vector = firmware::board().ram.base + (16 + 19) * 4;
    let stub = [&[0xDF, 0xF8, 0x00, 0xF0], &bench.memory(vector, 4)[..]].concat();
    bench.machine().load_bin(stub_address, &stub).unwrap();
    bench.machine().write_ram(vector, &(stub_address | 1).to_le_bytes()).unwrap();
    assert!(bench.is_bootloader(NODE), "it works as long as nothing is erased");

    bench.session().command(1, ProgramControl::Clear).unwrap();
    bench.post(REQUEST, &[0x2F, 0x51, 0x1F, 0x01, 0x03, 0, 0, 0]);
    bench.run_ms(20);
    let from = bench.time();
    bench.post(REQUEST, &[0x40, 0x57, 0x1F, 0x01, 0, 0, 0, 0]);
    bench.run_ms(2000);
    let frames = bench.frames_since(from);
    // It answers when the sector is erased, which takes a second; or the watchdog restarts it, which bites after
    // a second.
    let (at, ..) = frames
        .iter()
        .find(|(_, id, _)| *id == RESPONSE || *id == HEARTBEAT)
        .expect("an answer or a boot-up, at some time");
    assert!(*at - from > Span::from_millis(100), "{} us", (*at - from).0 / 1_000_000);
}
