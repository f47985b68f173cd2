//! The renewal of the bootloader as a demonstration: `cargo xtask demo --renew`.

use bsp::can::BitTiming;
use canopen::program::{ProgramStart, DEVICE_STATE, STATE_PROGRAM_START};
use coboot_tests::bench::{Bench, BIT_RATE, NODE};
use coboot_tests::firmware;
use coboot_tests::renewal::{image_of, plain, with_crc};
use coboot_tests::sealed_board;
use coflash_core::update::{flash, Event, FlashOptions, Payload};
use emulator::machine::{Cut, FlashCut};

use crate::steps::{chapter, convert, install, introduce, print_line, Outcome};

/// A bootloader is exchanged over CAN; a broken one ends by itself; the power fails.
pub fn run(bench: &mut Bench) -> Outcome<()> {
    chapter("A board runs version 1 of its program");
    bench.switch_on();
    install(bench, &convert(firmware::APP_V1))?;
    introduce(bench)?;

    chapter("A new bootloader: it starts programs with a watchdog of a second");
    renewed(bench, &plain(&image_of(firmware::BOOTLOADER_WATCHDOG)))?;
    introduce(bench)?;
    call_back(bench)?;

    chapter("A broken bootloader: its bit rate is wrong, so nobody can reach it");
    let broken = plain(&with_wrong_bit_rate(image_of(firmware::BOOTLOADER))?);
    match renewed(bench, &broken) {
        Ok(()) => return Err("the device has installed it".into()),
        Err(error) => print_line(bench.time(), &error.to_string()),
    }
    introduce(bench)?;

    chapter("The power fails while the device installs another bootloader");
    let next = plain(&image_of(firmware::BOOTLOADER));
    let words = image_of(firmware::BOOTLOADER).len() as u64 / 4;
    bench
        .machine()
        .cut_power_at(Some(FlashCut { operation: words + words / 2, when: Cut::Torn { seed: 1 } }));
    match renewed(bench, &next) {
        Ok(()) => return Err("the power did not fail".into()),
        Err(_) => print_line(bench.time(), "the power has failed: a half of its place is written"),
    }
    bench.machine().cut_power_at(None);
    bench.power_off();
    bench.run_ms(1000);
    bench.power_on();
    let up = bench.await_program(1000);
    print_line(up, "power on, boot-up: the program starts as ever");
    renewed(bench, &next)?;
    introduce(bench)?;
    call_back(bench)?;
    bench.assert_nothing_unmodelled();

    chapter("A sealed device, and a bootloader that nobody has signed");
    let mut sealed = sealed_board::board();
    sealed.switch_on();
    match renewed(&mut sealed, &next) {
        Ok(()) => Err("the device took it".into()),
        Err(error) => {
            print_line(sealed.time(), &error.to_string());
            introduce(&mut sealed)
        }
    }
}

/// The whole procedure of the tool, printed step by step.
fn renewed(bench: &mut Bench, new: &Payload) -> Outcome<()> {
    let clock = bench.clock();
    let outcome = flash(&mut bench.session(), new, &FlashOptions::default(), &mut |event| match event {
        Event::Progress { .. } | Event::Done(_) => {}
        event => print_line(clock.get(), &event.to_string()),
    });
    print_line(bench.time(), &outcome?.to_string());
    Ok(())
}

fn call_back(bench: &mut Bench) -> Outcome<()> {
    bench.call_back();
    let watchdog = ProgramStart::of_word(bench.number(DEVICE_STATE, STATE_PROGRAM_START)).watchdog_ms;
    print_line(bench.time(), &format!("watchdog of a program (2007h/10): {watchdog} ms"));
    introduce(bench)?;
    bench.start_program();
    if bench.is_bootloader(NODE) {
        return Err("the program does not start".into());
    }
    Ok(())
}

/// The image with another prescaler in the table of its bit rates, as if it were built for another crystal.
fn with_wrong_bit_rate(mut image: Vec<u8>) -> Outcome<Vec<u8>> {
    let table: Vec<u8> = bsp::line::TIMINGS.iter().flat_map(|timing| timing.to_le_bytes()).collect();
    let at = image.windows(table.len()).position(|bytes| bytes == table);
    let at = at.ok_or("the table of the bit rates is elsewhere")?;
    let timing = BitTiming::new(bsp::CAN_CLOCK, BIT_RATE).ok_or("the board cannot run at this bit rate")?;
    let own = bsp::line::TIMINGS.iter().position(|register| *register == timing.register());
    let at = at + 4 * own.ok_or("the bit rate is none of CANopen")?;
    let wrong = BitTiming { prescaler: 2 * timing.prescaler, ..timing };
    image[at..at + 4].copy_from_slice(&wrong.register().to_le_bytes());
    Ok(with_crc(image))
}
