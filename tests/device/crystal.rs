//! A board whose crystal has failed: the bootloader runs from the internal oscillator, whose error CAN
//! does not tolerate (2007h/5, and the choice `crystal_failure` of the product).

use std::time::Duration;

use canopen::NodeId;
use coboot_can::{Adapter, AdapterError};
use coboot_tests::bench::{Bench, BIT_RATE, HEARTBEAT, NODE, REQUEST, RESPONSE};
use coboot_tests::{dead_crystal, firmware};
use coflash_core::device::{Session, Timing};
use coflash_core::update::{flash, FlashOptions};
use emulator::bus::Outcome;
use emulator::machine::{Options, ResetCause, Stop};
use emulator::time::{Span, Time};

/// The emergency after the boot-up (CiA 301 section 7.2.7: COB-ID 80h + node-ID).
const EMERGENCY: u32 = 0x80 + NODE as u32;
const READ_1000: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];

/// A board without a crystal, with this bootloader.
fn failed(image: &str) -> Bench {
    Bench::of_image_with(image, Options { hse_hz: 0, ..Options::default() })
}

/// The reason in the emergency after the boot-up.
fn announced(bench: &Bench) -> Option<u8> {
    bench.emergencies(Time(0)).first().map(|data| data[7])
}

/// The PLL's second output, which nothing uses, is within its limit too: 75 MHz (DS8626, main PLL characteristics),
/// by PLLCFGR's M, N and Q (RM0090 section 7.3.2) and the source's highest frequency.
#[test]
fn each_output_of_the_pll_is_within_its_limit() {
    for (hse_hz, fastest) in [(8_000_000, 8_000_000), (0, 16_800_000)] {
        let mut bench = Bench::with(Options { hse_hz, ..Options::default() });
        bench.world.add_host_port(BIT_RATE);
        bench.power_on();
        bench.run_ms(300);
        let pll = bench.machine().register(0x4002_3804).expect("PLLCFGR");
        let (m, n, q) = (pll & 0x3F, pll >> 6 & 0x1FF, pll >> 24 & 0xF);
        assert_eq!(pll >> 22 & 1, u32::from(hse_hz != 0), "its source");
        let output = fastest / m * n / q;
        assert!(q >= 2 && (30_000_000..=75_000_000).contains(&output), "{hse_hz}: {output} Hz");
    }
}

/// Another node acknowledges the host's frames.
#[test]
fn without_its_crystal_a_device_only_listens_until_lss_speaks() {
    let mut bench = failed(firmware::BOOTLOADER);
    bench.world.add_host_port(BIT_RATE);
    bench.power_on();
    // Reset communication, a request, another node's heartbeat.
    for _ in 0..20 {
        bench.run_ms(100);
        bench.post(0x000, &[0x82, 0]);
        bench.post(REQUEST, &READ_1000);
        bench.post(0x70F, &[0x7F]);
    }
    assert!(bench.frames_since(Time(0)).iter().all(|(_, id, _)| *id < 0x080 || *id > 0x600));
    let of_device = |(_, id, _): &(_, u32, Vec<u8>)| [RESPONSE, HEARTBEAT, EMERGENCY, 0x7E4].contains(id);
    assert_eq!(bench.frames_since(Time(0)).into_iter().filter(of_device).count(), 0);
    assert!(bench.records().iter().all(|record| record.outcome == Outcome::Good));

    // Switch state global to configuration, inquire node-ID (CiA 305).
    let from = bench.time();
    bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    bench.assert_answer(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0], 0x7E4, &[0x5E, NODE, 0, 0, 0, 0, 0, 0]);
    bench.post(0x7E5, &[0x04, 0, 0, 0, 0, 0, 0, 0]);
    bench.run_ms(20);
    let said = bench.frames_since(from);
    assert!(said.iter().any(|(_, id, data)| *id == HEARTBEAT && data == &[0]), "{said:X?}");
    assert_eq!(announced(&bench), Some(0x80 | 6));
    assert_eq!(bench.number(0x2007, 5), 2);
}

/// The rescue window of a device that cannot answer ends as if nobody had asked.
#[test]
fn a_request_that_is_not_heard_does_not_keep_a_device_from_its_program() {
    let mut installed = Bench::new().switched_on();
    installed.install(firmware::APP_V1);
    let cells = installed.machine().flash().to_vec();

    let mut bench = failed(firmware::BOOTLOADER);
    bench.world.add_host_port(BIT_RATE);
    bench.machine().load_bin(firmware::board().chip.flash.base, &cells).unwrap();
    bench.power_on();
    // The program gives up its crystal after some 50 ms.
    let mut runs = false;
    for _ in 0..30 {
        bench.run_ms(20);
        bench.post(REQUEST, &READ_1000);
        runs |= firmware::board().programs[0].contains(bench.machine().pc(), 2);
    }
    assert!(runs, "the program is started");
}

#[test]
fn the_applications_leave_for_the_bootloader_when_their_crystal_fails() {
    for image in [firmware::APP_V1, firmware::APP_C] {
        println!("{image}");
        dead_crystal::brings_the_bootloader(&firmware::blocks(image));
    }
}

/// Nobody acknowledges the host: its frames are good only when it is error passive (ISO 11898-1).
#[test]
fn a_silent_device_hears_a_host_that_is_alone() {
    let mut bench = failed(firmware::BOOTLOADER);
    bench.power_on();
    bench.run_ms(200);
    bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    bench.run_ms(200);
    assert!(bench.is_bootloader(NODE));
}

/// The clock security system sees it, and the reset is software's (RM0090 section 7.2.7); from there on it is a board
/// whose crystal has failed. With its crystal again it is as before.
#[test]
fn a_crystal_that_stops_is_a_reset_and_then_silence_until_lss_speaks() {
    let mut bench = Bench::new();
    bench.world.add_host_port(BIT_RATE);
    bench.switch_on();
    bench.run_ms(20);
    bench.events();
    let stopped = bench.time();
    bench.machine().set_crystal(0);
    bench.run_ms(2_500);
    let events = bench.events();
    let [(at, Stop::Reset(ResetCause::Software))] = events[..] else { panic!("{events:?}") };
    assert!(at - stopped < Span::from_millis(1), "{events:?}");
    assert_eq!(bench.frames_since(at), []);
    bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    bench.assert_answer(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0], 0x7E4, &[0x5E, NODE, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.number(0x2007, 5), 2);

    bench.power_off();
    bench.machine().set_crystal(bsp::CLOCK_TREE.hse);
    bench.switch_on();
    assert_eq!(bench.number(0x2007, 5), 1);
}

/// Four gaps, of which three would be a crash loop, are none of a good program's crashes; each ends in a reset at once,
/// and no frame of another node is disturbed meanwhile.
#[test]
fn a_crystal_that_flickers_costs_a_program_a_restart_and_not_its_release() {
    let mut bench = Bench::new();
    bench.world.add_host_port(BIT_RATE);
    bench.switch_on();
    bench.install(firmware::APP_V1);
    bench.confirm_program();
    let from = bench.time();
    for _ in 0..4 {
        bench.events();
        bench.machine().set_crystal(0);
        bench.run_ms(2);
        assert_eq!(bench.stops(), [Stop::Reset(ResetCause::Software)]);
        bench.machine().set_crystal(bsp::CLOCK_TREE.hse);
        for n in 0..30 {
            bench.post(0x300, &[n; 8]);
            bench.run_ms(10);
        }
        assert!(!bench.is_bootloader(NODE));
    }
    let bad =
        bench.records().into_iter().filter(|it| it.start >= from && it.outcome != Outcome::Good).count();
    assert!(bad <= 4, "{bad} frames, where a frame of the device is cut at each gap");
    bench.call_back();
    // Nothing keeps it back (docs/protocol.md).
    assert_eq!(bench.number(0x2007, 2), 255);
}

/// A host whose device loses its crystal with the host's frame of this number, for this many ms.
struct Gap<'b>(&'b mut Bench, u32, u64);

impl Adapter for Gap<'_> {
    fn send(&mut self, frame: &canopen::Frame) -> Result<(), AdapterError> {
        let Self(bench, frames, ms) = self;
        Adapter::send(*bench, frame)?;
        *frames = frames.wrapping_sub(1);
        if *frames == 0 {
            bench.machine().set_crystal(0);
            bench.run_ms(*ms);
            bench.machine().set_crystal(bsp::CLOCK_TREE.hse);
        }
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<canopen::Frame>, AdapterError> {
        Adapter::receive(self.0, timeout)
    }

    fn now(&self) -> Duration {
        Adapter::now(self.0)
    }
}

/// Whatever a gap comes into, the device is there after it, at once if the crystal starts again and after a power-off
/// otherwise, and takes the program.
#[test]
fn a_gap_of_the_crystal_at_any_point_of_an_update_costs_the_attempt_alone() {
    let mut before = Bench::new().switched_on();
    before.install(firmware::APP_V1);
    let cells = before.machine().flash().to_vec();
    let update = |bench: &mut Bench, frame, ms| {
        let mut host = Gap(bench, frame, ms);
        let mut session = Session::new(&mut host, NodeId::new(NODE).unwrap(), Timing::default());
        let file = firmware::blocks(firmware::APP_V2);
        let result = flash(&mut session, file, &FlashOptions::default(), &mut |_| {});
        (result.is_ok(), frame.wrapping_sub(host.1))
    };
    let start = || {
        let mut bench = Bench::new();
        bench.machine().load_bin(firmware::board().chip.flash.base, &cells).unwrap();
        bench.power_on();
        bench.await_program(1_000);
        bench
    };
    let (is_done, frames) = update(&mut start(), 0, 0);
    assert!(is_done);
    let mut failed = 0;
    for frame in [1, 3, 8, frames / 3, frames - 3, frames] {
        for ms in [1, 2_000] {
            let mut bench = start();
            let (is_done, _) = update(&mut bench, frame, ms);
            failed += u32::from(!is_done);
            if ms > 1 {
                bench.power_cycle();
            }
            bench.run_ms(1_000);
            assert!(update(&mut bench, 0, 0).0, "frame {frame} of {frames}, {ms} ms");
        }
    }
    assert!(failed > 3, "{failed}");
}

#[test]
fn a_product_that_is_to_speak_in_any_case_does_and_says_so() {
    let mut bench = failed(firmware::BOOTLOADER_LEAST);
    bench.switch_on();
    bench.run_ms(20);
    assert_eq!(bench.number(0x2007, 5), 2);
}
