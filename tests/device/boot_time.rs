//! The time from a device's reset to the first instruction of its application.

use canopen::program::ProgramControl;
use coboot_tests::bench::{control, press, Bench, ACKNOWLEDGED, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::{read, Firmware, Format};
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::Options as ChipOptions;
use emulator::silicon::{Silicon, TYPICAL};
use emulator::time::{Span, Time};

/// The application, followed by other data up to 400 KiB.
fn large_program() -> Program {
    const SIZE: u32 = 400 * 1024;
    let base = firmware::board().programs[0].base;
    let Firmware::Image(image) = read(&firmware::elf(firmware::APP_V1), None, None).expect("an ELF of ours")
    else {
        panic!("an ELF is no block file");
    };
    let mut bytes: Vec<u8> = (0..SIZE).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    for (address, data) in image.segments() {
        let at = (address - base) as usize;
        bytes[at..at + data.len()].copy_from_slice(&data);
    }
    let large = read(&bytes, Some(Format::Raw), Some(base)).expect("a raw image");
    let options =
        Options::default().region(Region::Strict(firmware::board().programs[0].into())).block_size(16_384);
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

/// With a fresh, a half full and a full journal; and with the cycles of the manuals for loads, branches, and code
/// in flash and SRAM: the times of docs/bench.md. Nothing gets faster by costs, and it stays below the budget and
/// a half; by the journal each is at most 2 ms longer.
#[test]
fn a_full_journal_costs_2_ms_and_the_costs_of_code_not_half_of_the_budget() {
    let measured = [false, true].map(|costs| {
        let mut bench = Bench::with(ChipOptions { costs, ..ChipOptions::default() });
        bench.power_on();
        bench.await_boot_up(100);
        let options = FlashOptions::default().trial_run(false);
        flash(&mut bench.session(), &large_program(), &options, &mut |_| {}).unwrap();
        bench.confirm_program();
        // Its two regions follow each other.
        let [journal, _] = firmware::board().parameters;
        let mut fresh = vec![0; 2 * journal.size as usize];
        bench.machine().read_memory(journal.base, &mut fresh).unwrap();
        FILLS.map(|left| {
            let times = starts(&mut bench, |bench| {
                bench.machine().load_bin(journal.base, &fresh).unwrap();
                left.into_iter().for_each(|left| bench.fill_journal(left));
            });
            for ((start, _), time) in STARTS.iter().zip(times) {
                println!("costs {costs}, free slots {left:?}: {} us, {start}", micros(time));
            }
            times
        })
    });
    for (n, (start, budget)) in STARTS.into_iter().enumerate() {
        let [plain, costly] = measured.each_ref().map(|fills| fills.map(|times| micros(times[n])));
        for ([fresh, half, full], budget) in [(plain, budget), (costly, budget * 3 / 2)] {
            assert!(fresh <= budget, "{start}: {fresh} us");
            assert!(half.max(full) <= fresh + 2_000, "{start}: {fresh}, {half}, {full} us");
        }
        assert!(plain[0] <= costly[0], "{start}: {plain:?}, {costly:?} us");
    }
}

/// The times of [`STARTS`] of a board that runs its program; `set` sets its journal before each.
fn starts(bench: &mut Bench, set: impl Fn(&mut Bench)) -> [Span; 4] {
    let start = |bench: &mut Bench| {
        bench.run_ms(20);
        bench.session().command(1, ProgramControl::Start).unwrap();
        bench.await_boot_up(1000);
        bench.run_ms(20);
        set(bench);
    };
    set(bench);
    bench.power_off();
    bench.run_ms(10);
    press(bench.machine(), true);
    let from = bench.time();
    bench.power_on();
    let power_on = bench.await_boot_up(100) - from;
    press(bench.machine(), false);
    start(bench);
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    let answered = bench.time();
    let call_back = bench.await_boot_up(1000) - answered;
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
    [power_on, call_back, stop, program]
}

/// The start time of the bootloader: from power-on, and from the answer to 1F51h = 80h, to the end
/// of its boot-up message. This includes the copy of the RAM image. The limits are the budget of the design.
///
/// SysTick holds anything after a reset (ARMv7-M B3.3.5). From FFFFFFh the first period is a tenth of a second.
/// The watchdog's values take longest with the slowest LSI.
#[test]
fn the_bootloader_does_not_wait_for_what_systick_held() {
    let silicon = Silicon { systick_value: 0x00FF_FFFF, lsi_hz: 17_000, ..TYPICAL };
    let mut bench = Bench::with(ChipOptions { silicon, ..ChipOptions::default() });
    bench.power_on();
    let power_on = bench.await_boot_up(100) - Time(0);
    bench.install(firmware::APP_V1);
    println!("boot-up of the bootloader: {} us after power-on", micros(power_on));
    assert!(power_on <= Span::from_micros(4500), "{} us", micros(power_on));
    // The application looks at its deadlines by a clock of its own: the request meets it in any phase.
    for phase in 0..4 {
        bench.run_ms(phase);
        bench.session().command(1, ProgramControl::StartBootloader).unwrap();
        let answered = bench.time();
        let call_back = bench.await_boot_up(1000) - answered;
        println!("boot-up of the bootloader: {} us after the answer to 80h", micros(call_back));
        // The application takes 11 ms of it (SYS TEC manual L-1112d_10, 4.5: at least 10).
        assert!(call_back <= Span::from_millis(18), "{} us", micros(call_back));
        assert!(call_back >= Span::from_millis(10), "{} us", micros(call_back));
        bench.run_ms(20);
        bench.session().command(1, ProgramControl::Start).unwrap();
        bench.await_boot_up(1000);
    }
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
        bench.power_on();
        let took = micros(bench.await_boot_up(100) - Time(0));
        println!("crystal after {crystal_start_us} us: boot-up {took} us after power-on");
        assert!(took <= u64::from(crystal_start_us) + REST_US, "{took} us");
    }
    // This product speaks without its crystal. A host understands it only if the internal oscillator is exact.
    for silicon in [TYPICAL, Silicon { hsi_hz: TYPICAL.hsi_hz, ..emulator::silicon::WORST }] {
        let chip = ChipOptions { hse_hz: 0, silicon, ..ChipOptions::default() };
        let mut bench = Bench::of_image_with(firmware::BOOTLOADER_LEAST, chip);
        bench.power_on();
        let took = micros(bench.await_boot_up(100) - Time(0));
        println!("no crystal: boot-up {took} us after power-on, {silicon}");
        assert!((20_000..=50_000 + REST_US).contains(&took), "{took} us");
    }
}

fn micros(span: Span) -> u64 {
    span.0 / 1_000_000
}
