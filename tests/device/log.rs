//! The bootloader's log for developers of ports, in each of its forms; and a release has no log.

use canopen::program::ProgramControl;
use coboot_tests::bench::{Bench, BIT_RATE, NODE};
use coboot_tests::firmware;
use coboot_tests::listener::{decoder, heard, Listener};
use coflash_core::update::{flash, FlashOptions};
use emulator::defmt::Decoder;
use emulator::machine::Options;
use emulator::peripheral::Peripheral;
use emulator::time::Span;
use object::{Object, ObjectSection, ObjectSymbol};

/// The images with a log, and the reader of each.
fn ways() -> [(&'static str, Listener); 4] {
    [
        (firmware::BOOTLOADER_SEALED_LOG_RTT, Listener::probe()),
        (firmware::BOOTLOADER_LOG_RTT, Listener::probe()),
        (firmware::BOOTLOADER_LOG_DEFMT, Listener::probe_of(firmware::BOOTLOADER_LOG_DEFMT)),
        (firmware::BOOTLOADER_LOG_UART, Listener::terminal()),
    ]
}

/// Codes from docs/protocol.md: 6 no valid program; 02 NOVALPROG; 06090030h an unknown command, and
/// request 5 as after a power-on.
#[test]
fn it_tells_why_it_stayed_what_it_refuses_and_that_it_leaves() {
    for (image, mut listener) in ways() {
        println!("{image}");
        let mut bench = Bench::of_image(image).switched_on();
        bench.run_ms(10);
        assert_eq!(
            listener.lines(&mut bench),
            ["stayed in the bootloader; why 00000006", "emergency; code and detail FF000042"]
        );

        bench.session().command(1, ProgramControl::Start).unwrap();
        bench.run_ms(10);
        assert_eq!(
            listener.lines(&mut bench),
            ["1F51h; program and command 00000101", "1F57h; program and status 00010002"]
        );

        // 1F51h/1 = 7Fh (CiA 301 section 7.2.4.3.3: expedited, one byte).
        bench.post(0x600 + u16::from(NODE), &[0x2F, 0x51, 0x1F, 0x01, 0x7F, 0, 0, 0]);
        bench.run_ms(10);
        assert_eq!(
            listener.lines(&mut bench),
            ["1F51h; program and command 0000017F", "refused; abort code 06090030"]
        );

        // NMT: reset node.
        bench.post(0x000, &[0x81, 0]);
        bench.run_ms(10);
        let longest = longest_between_feeds(&mut bench);
        let lines = listener.lines(&mut bench);
        assert_eq!(lines.len(), 2, "{lines:?}");
        assert_eq!(lines[0], "leaving; request 00000005");
        assert_same_time(&lines[1], longest);
        bench.assert_nothing_unmodelled();
    }
}

/// The longest time between two feeds, as the watchdog of the chip saw it, in us.
fn longest_between_feeds(bench: &mut Bench) -> u64 {
    bench.machine().counters().longest_between_feeds.0 / Span::from_micros(1).0
}

/// The line has this time, in us: two clocks are read at both ends, and each has its own last digit; a feed
/// and the look at the clock are some instructions and an interrupt apart.
fn assert_same_time(line: &str, us: u64) {
    let said = line.strip_prefix("longest between two feeds; us ").unwrap_or_else(|| panic!("{line:?}"));
    let said = u64::from_str_radix(said, 16).expect("eight digits");
    println!("the longest time between two feeds: the bootloader says {said} us, the watchdog saw {us} us");
    assert!(said.abs_diff(us) <= 10, "{said} us, {us} us");
}

/// SYS TEC manual L-1112d_10, 3.4.8: the longest time is kept, and read "shortly before the start of the
/// application". The other observer is the watchdog itself (RM0090 section 21.4.1: AAAAh).
#[test]
fn the_longest_time_between_two_feeds_is_what_the_watchdog_saw() {
    /// ARMv7-M A7.7.12: a branch to itself.
    const HANG: [u8; 2] = 0xE7FE_u16.to_le_bytes();
    let said = |listener: &mut Listener, bench: &mut Bench| {
        let lines = listener.lines(bench).into_iter();
        let mut lines: Vec<_> = lines.filter(|line| line.starts_with("longest ")).collect();
        assert_eq!(lines.len(), 1, "{lines:?}");
        lines.remove(0)
    };
    // A whole update; the program starts.
    for (image, mut listener) in ways() {
        println!("{image}: an update");
        let mut bench = Bench::of_image(image).switched_on();
        let file = firmware::blocks(firmware::APP_V1);
        flash(&mut bench.session(), &file, &FlashOptions::default().start(false), &mut |_| {}).unwrap();
        // Room for the lines to come.
        listener.lines(&mut bench);
        bench.session().command(1, ProgramControl::Start).unwrap();
        // Two lines on a UART take 6 ms; the reset comes 15 ms after the answer.
        bench.run_ms(9);
        let longest = longest_between_feeds(&mut bench);
        assert_same_time(&said(&mut listener, &mut bench), longest);
    }
    // The crystal does not start: the watchdog runs while it is waited for.
    let dead = Options { hse_hz: 0, ..Options::default() };
    for (what, options, hangs_ms, range) in [
        // The last feed was up to 2 ms before, and the next one is up to 2 ms later.
        ("a task that hangs for 60 ms", Options::default(), 60, 60_000..=64_000),
        // Ten times the start-up time of a crystal (bsp/src/pll.rs).
        ("no crystal", dead, 0, 40_000..=170_000),
    ] {
        println!("{what}");
        let mut bench = Bench::of_image_with(firmware::BOOTLOADER_LOG_RTT, options);
        bench.world.add_host_port(BIT_RATE);
        bench.power_on();
        bench.run_ms(300);
        let sleeps_at = bench.machine().pc();
        let mut there = [0; 2];
        bench.machine().read_memory(sleeps_at, &mut there).expect("idle sleeps in RAM");
        bench.machine().write_ram(sleeps_at, &HANG).expect("idle sleeps in RAM");
        bench.run_ms(hangs_ms);
        bench.machine().write_ram(sleeps_at, &there).expect("idle sleeps in RAM");
        // Without its crystal the device takes part after a request of LSS alone: switch state global,
        // waiting (CiA 305).
        bench.post(0x7E5, &[0x04, 0, 0, 0, 0, 0, 0, 0]);
        bench.run_ms(30);
        // NMT: reset node.
        bench.post(0x000, &[0x81, 0]);
        bench.run_ms(10);
        let longest = longest_between_feeds(&mut bench);
        let mut listener = Listener::probe();
        assert_same_time(&said(&mut listener, &mut bench), longest);
        assert!(range.contains(&longest), "{what}: {longest} us");
    }
}

/// Without a probe the lines are not read, and a UART is slower than the bus: lines without room
/// are left out, and the device continues.
#[test]
fn nobody_waits_for_who_reads_it() {
    for (image, mut listener) in ways() {
        println!("{image}");
        let mut bench = Bench::of_image(image).switched_on();
        bench.set_host_bit_rate(125_000);
        for _ in 0..100 {
            // Two lines of about 40 characters, which take 7 ms on a UART.
            bench.post(0x600 + u16::from(NODE), &[0x2F, 0x51, 0x1F, 0x01, 0x7F, 0, 0, 0]);
            bench.run_ms(2);
        }
        bench.run_ms(200);
        let lines = listener.lines(&mut bench);
        // 202 lines were logged; a kibibyte holds about 25 of them as text, and 150 as frames.
        assert!((20..190).contains(&lines.len()), "{}", lines.len());
        // None of them is truncated.
        let whole = |line: &String| {
            line.len() > 9 && line.split_at(line.len() - 9).1.bytes().skip(1).all(|c| c.is_ascii_hexdigit())
        };
        assert!(lines.iter().all(whole), "{lines:?}");
        assert!(lines.iter().any(|line| line == "refused; abort code 06090030"), "{lines:?}");
        bench.session().command(1, ProgramControl::ResetStat).unwrap();
    }
}

/// The UART is served from RAM: a line during the erase of a sector is sent at once, and the erase
/// does not wait.
#[test]
fn the_uart_speaks_while_the_flash_erases() {
    let mut bench = Bench::of_image(firmware::BOOTLOADER_LOG_UART).switched_on();
    bench.install(firmware::APP_V1);
    bench.call_back();
    bench.soil_programs();
    // Twice in a row: erase everything at once.
    bench.session().command(1, ProgramControl::Clear).unwrap();
    bench.session().command(1, ProgramControl::Clear).unwrap();
    bench.run_ms(50);
    heard(bench.machine());
    let mut terminal = Listener::terminal();
    for _ in 0..20 {
        bench.post(0x600 + u16::from(NODE), &[0x2F, 0x51, 0x1F, 0x01, 0x7F, 0, 0, 0]);
        // Two frames at 125 kbit/s, 2 ms; 67 characters, 5.9 ms.
        bench.run_ms(9);
        assert_eq!(
            terminal.lines(&mut bench),
            ["1F51h; program and command 0000017F", "refused; abort code 06090030"]
        );
    }
    assert!(bench.session().status(1).unwrap().busy, "the erase must have lasted");
    assert_eq!(bench.machine().counters().flash_stalls, 0);
}

/// A viewer with the wrong ELF file, or one that starts in the middle of a frame.
#[test]
fn frames_that_mean_nothing_are_told_as_such() {
    let mut decoder = decoder(firmware::BOOTLOADER_LOG_DEFMT);
    for index in 0..=u16::MAX {
        let [low, high] = index.to_le_bytes();
        for frame in [&[low, high, 0][..], &[low, high, 0x7F, 0], &[low, 1, high, 0xFF, 0x80, 0]] {
            decoder.messages(frame);
        }
    }
    let messages = decoder.messages(&[0xFF, 0xFF, 0xFF, 0]);
    assert_eq!(messages, ["a frame of defmt that this program's ELF file does not explain"]);
    assert!(decoder.messages(&vec![0x55; 100_000]).is_empty());
    assert!(Decoder::of_elf(&firmware::elf(firmware::BOOTLOADER)).unwrap().is_none());
    assert!(Decoder::of_elf(b"no ELF file").is_err());
}

#[test]
fn a_release_has_nothing_of_it() {
    let has = |image: &str| {
        let bytes = firmware::elf(image);
        let elf = object::File::parse(&bytes[..]).expect("an ELF of ours");
        let symbol = elf.symbols().any(|symbol| symbol.name() == Ok("_SEGGER_RTT"));
        let frames =
            elf.sections().any(|section| section.name().is_ok_and(|name| name.starts_with(".defmt")));
        let words = bytes.windows(14).any(|part| part == b"leaving; reque");
        (symbol, frames, words)
    };
    assert_eq!(has(firmware::BOOTLOADER_LOG_RTT), (true, false, true));
    assert_eq!(has(firmware::BOOTLOADER_SEALED_LOG_RTT), (true, false, true));
    assert_eq!(has(firmware::BOOTLOADER_LOG_UART), (false, false, true));
    assert_eq!(has(firmware::BOOTLOADER_LOG_DEFMT), (true, true, true));
    for image in [firmware::BOOTLOADER, firmware::BOOTLOADER_PAULUS, firmware::BOOTLOADER_LEAST] {
        assert_eq!(has(image), (false, false, false), "{image}");
        let mut bench = Bench::of_image(image).switched_on();
        bench.session().command(1, ProgramControl::Start).unwrap();
        bench.run_ms(20);
        let touched = bench.machine().usarts_mut().iter().find(|usart| usart.accesses() > 0);
        assert!(touched.is_none(), "{image} uses {}", touched.unwrap().name());
    }
}
