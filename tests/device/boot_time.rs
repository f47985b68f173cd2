//! The time from a device's reset to the first instruction of its application.

use canopen::program::ProgramControl;
use coboot_tests::bench::{control, press, Bench, ACKNOWLEDGED, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::{read, Format};
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::Options as ChipOptions;
use emulator::silicon::{Silicon, TYPICAL};
use emulator::time::{Span, Time};

/// The application, followed by other data up to 400 KiB.
fn large_program() -> Program {
    const SIZE: u32 = 400 * 1024;
    let place = firmware::board().programs[0];
    let mut bytes: Vec<u8> = (0..SIZE).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let image = firmware::raw(firmware::APP_V1);
    bytes[..image.len()].copy_from_slice(&image);
    let large = read(&bytes, Some(Format::Raw), Some(place.base)).expect("a raw image");
    let options = Options::default().region(Region::Strict(place.into())).block_size(16_384);
    program_of(large, &options).expect("it fits").program
}

/// Free slots of a journal: after one update, in the middle, and when a program finds no fewer.
const FILLS: [Option<usize>; 3] = [None, Some(292), Some(16)];
/// The four starts, and their budgets in us (the first three rows of docs/bench.md and STOP).
const STARTS: [(&str, u64); 4] = [
    ("power-on to the boot-up", 4_500),
    ("answer to 80h to the boot-up", 18_000),
    ("STOP to its answer", 25_000),
    ("power-on to the first instruction of 400 KiB", 5_000),
];

#[test]
fn a_full_journal_costs_2_ms_at_most() {
    fills(false, |budget| budget);
}

/// With the cycles of the manuals for loads, branches, and code in flash and SRAM it stays below the budget and a half.
#[test]
fn the_times_with_the_costs_of_code_are_not_longer_by_half() {
    fills(true, |budget| budget * 3 / 2);
}

/// The times of docs/bench.md: those with a fresh journal keep their budgets, and each other is at most 2 ms longer.
fn fills(costs: bool, limit: fn(u64) -> u64) {
    let mut bench = running_board(ChipOptions { costs, ..ChipOptions::default() });
    // Its two regions follow each other.
    let [journal, _] = firmware::board().parameters;
    let fresh = bench.memory(journal.base, 2 * journal.size as usize);
    let measured = FILLS.map(|left| {
        starts(&mut bench, |bench| {
            bench.machine().load_bin(journal.base, &fresh).unwrap();
            left.into_iter().for_each(|left| bench.fill_journal(left));
        })
    });
    for (n, (start, budget)) in STARTS.into_iter().enumerate() {
        let [fresh, half, full] = measured.map(|times| micros(times[n]));
        println!("costs {costs}, {start}: {fresh}, {half}, {full} us");
        assert!(
            fresh <= limit(budget) && half.max(full) <= fresh + 2_000,
            "{start}: {fresh}, {half}, {full} us"
        );
    }
}

/// The times of [`STARTS`] of a board that runs its program; `set` sets its journal before each.
fn starts(bench: &mut Bench, set: impl Fn(&mut Bench)) -> [Span; 4] {
    let start = |bench: &mut Bench| {
        bench.run_ms(20);
        // START waits until a full journal is compacted, which erases a sector.
        bench.session().command(1, ProgramControl::Start).unwrap();
        bench.await_boot_up(1000);
        bench.run_ms(20);
        set(bench);
    };
    set(bench);
    bench.power_off();
    bench.run_ms(10);
    let stays = press(bench.machine(), true);
    let from = bench.time();
    let power_on = bench.switch_on() - from;
    press(bench.machine(), false);
    // A board without the strap has started its program.
    if stays {
        start(bench);
    }
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    let answered = bench.time();
    let call_back = bench.await_boot_up(1000) - answered;
    // The application takes 11 ms of it (SYS TEC manual L-1112d_10, 4.5: at least 10).
    assert!(call_back >= Span::from_millis(10), "{} us", micros(call_back));
    start(bench);
    let asked = bench.time();
    let answer = bench.ask(REQUEST, &control(0), RESPONSE);
    let stop = bench.time() - asked;
    assert_eq!(answer.as_deref(), Some(&ACKNOWLEDGED[..]));
    start(bench);
    bench.power_off();
    bench.run_ms(10);
    let program = bench.power_on_to_first_instruction();
    bench.await_boot_up(100);
    [if stays { power_on } else { Span(0) }, call_back, stop, program]
}

/// SysTick holds anything after a reset (ARMv7-M B3.3.5). From FFFFFFh the first period is a tenth of a second.
/// The watchdog's values take longest with the slowest LSI. The application looks at its deadlines by a clock of its
/// own: a request meets it in any phase.
#[test]
fn the_bootloader_does_not_wait_for_what_systick_held() {
    let silicon = Silicon { systick_value: 0x00FF_FFFF, lsi_hz: 17_000, ..TYPICAL };
    let mut bench = running_board(ChipOptions { silicon, ..ChipOptions::default() });
    for phase in 0..4 {
        for ((start, budget), time) in STARTS.into_iter().zip(starts(&mut bench, |bench| bench.run_ms(phase)))
        {
            assert!(micros(time) <= budget, "{start}, {phase} ms later: {} us", micros(time));
        }
    }
}

/// A board that runs the large program, which was confirmed.
fn running_board(options: ChipOptions) -> Bench {
    let mut bench = Bench::with(options).switched_on();
    let options = FlashOptions::default().trial_run(false);
    flash(&mut bench.session(), large_program(), &options, &mut |_| {}).unwrap();
    bench.confirm_program();
    bench
}

/// The budget of the design is 4.5 ms with a crystal of 2 ms: 2.5 ms are for all the rest. A crystal that
/// never starts is given up after 50 ms (bsp/src/pll.rs), and not while a late one may still come (20
/// ms).
#[test]
fn the_boot_up_waits_for_a_late_crystal_and_for_none_at_all_a_bounded_time() {
    const REST_US: u64 = 2_500;
    for crystal_start_us in [300, 2_000, 10_000, 20_000] {
        let silicon = Silicon { crystal_start_us, ..TYPICAL };
        let mut bench = Bench::with(ChipOptions { silicon, ..ChipOptions::default() });
        let took = micros(bench.switch_on() - Time(0));
        println!("crystal after {crystal_start_us} us: boot-up {took} us after power-on");
        assert!(took <= u64::from(crystal_start_us) + REST_US, "{took} us");
    }
    // This product speaks without its crystal. A host understands it only if the internal oscillator is exact.
    for silicon in [TYPICAL, Silicon { hsi_hz: TYPICAL.hsi_hz, ..emulator::silicon::WORST }] {
        let chip = ChipOptions { hse_hz: 0, silicon, ..ChipOptions::default() };
        let mut bench = Bench::of_image_with(firmware::BOOTLOADER_LEAST, chip);
        let took = micros(bench.switch_on() - Time(0));
        println!("no crystal: boot-up {took} us after power-on, {silicon}");
        assert!((20_000..=50_000 + REST_US).contains(&took), "{took} us");
    }
}

fn micros(span: Span) -> u64 {
    span.0 / 1_000_000
}
