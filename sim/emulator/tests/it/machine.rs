//! Tests of the machine through its public interface. The programs are in `programs/`; the expected
//! results come from the architecture and the reference manuals.

mod can_pins;
mod crystal;
mod debug;
mod flash;
mod option_bytes;
mod over_drive;
mod programs;
mod rtc;
mod supply;

use emulator::machine::{Access, Cut, FlashCut, FlashTimes, Machine, Options, ResetCause, Stop};
use emulator::silicon::{Silicon, TYPICAL};
use emulator::time::{Span, Time};
use flash::UNLOCK;
use programs::Program;
use shared_abi::geometry::{Region, STM32F407VG};

const MS: u64 = 1_000_000_000;
const STACK: u32 = 0x2001_0000;
/// The programs log here.
const OUT: u32 = 0x2000_0000;
/// The programs read their arguments here.
const ARGUMENT: u32 = 0x2000_0100;

fn ms(n: u64) -> Time {
    Time(n * MS)
}

fn bytes(code: &[u16]) -> Vec<u8> {
    code.iter().flat_map(|half| half.to_le_bytes()).collect()
}

/// The vector table of a program.
fn table(program: &Program) -> Vec<u8> {
    let mut table = [0_u32; 128];
    table[0] = STACK;
    table[1] = program.base | 1;
    for &(exception, vector) in &program.vectors {
        table[exception] = vector;
    }
    table.iter().flat_map(|word| word.to_le_bytes()).collect()
}

fn load(machine: &mut Machine, program: &Program) {
    machine.load_bin(0x0800_0000, &table(program)).unwrap();
    machine.load_bin(program.base, &program.code).unwrap();
}

fn with_options(program: &Program, options: Options) -> Machine {
    let mut machine = Machine::new(&STM32F407VG, options).unwrap();
    load(&mut machine, program);
    machine.power_on(Time(0));
    machine
}

fn machine(program: &Program) -> Machine {
    with_options(program, Options::default())
}

/// The same at this time.
fn ran(program: &Program, until: Time) -> Machine {
    let mut machine = machine(program);
    machine.run_until(until);
    machine
}

/// The machine with `argument` at [`ARGUMENT`].
fn with_argument(program: &Program, argument: u32) -> Machine {
    let mut machine = machine(program);
    put(&mut machine, ARGUMENT, argument);
    machine
}

/// A machine that is about to run the program in RAM, with `argument` at [`ARGUMENT`].
fn machine_in_ram(program: &Program, argument: u32, options: Options) -> Machine {
    let mut machine = with_options(&programs::TO_RAM, options);
    machine.write_ram(program.base, &program.code).unwrap();
    put(&mut machine, ARGUMENT, argument);
    put(&mut machine, 0x2000_0200, 1);
    machine
}

fn word(machine: &Machine, address: u32) -> u32 {
    let mut buffer = [0; 4];
    machine.read_memory(address, &mut buffer).unwrap();
    u32::from_le_bytes(buffer)
}

fn words(machine: &Machine, count: u32) -> Vec<u32> {
    (0..count).map(|n| word(machine, OUT + 4 * n)).collect()
}

fn put(machine: &mut Machine, address: u32, value: u32) {
    machine.write_ram(address, &value.to_le_bytes()).unwrap();
}

// --- start and time

#[test]
fn reset_fetches_stack_pointer_and_entry_and_wfi_costs_nothing() {
    let mut machine = machine(&programs::STORES_AND_SLEEPS);
    assert_eq!(machine.run_until(ms(1_000)), Stop::Deadline);
    assert_eq!(words(&machine, 2), [42, STACK]);
    assert_eq!(machine.counters().instructions, 6, "up to WFI, once");
    assert_eq!(machine.counters().cycles, 16_000_000, "a second of the HSI");
    assert_eq!(machine.reports(), []);
}

#[test]
fn without_a_program_the_chip_locks_up() {
    let mut machine = Machine::new(&STM32F407VG, Options::default()).unwrap();
    assert_eq!(machine.run_until(ms(1)), Stop::Deadline, "no power, no program");
    machine.power_on(ms(1));
    assert_eq!(machine.run_until(ms(2)), Stop::Lockup);
    let cause = machine.fault_cause();
    assert!(cause.starts_with("code in a place that is never executable, "), "{cause}");
    assert!(cause.ends_with("; pc FFFFFFFEh"), "{cause}");
    assert_eq!(machine.run_until(ms(3)), Stop::Deadline);
    load(&mut machine, &programs::STORES_AND_SLEEPS);
    machine.reset_pin();
    assert_eq!(machine.run_until(ms(4)), Stop::Deadline);
    assert_eq!(word(&machine, OUT), 42);
}

#[test]
fn systick_comes_once_a_millisecond() {
    let mut machine = ran(&programs::SYSTICK, Time(100 * MS + MS / 2));
    assert_eq!(words(&machine, 2), [100, 100]);
    assert_eq!(machine.counters().exceptions[15], 100);
    machine.run_until(Time(1_000 * MS + MS / 2));
    assert_eq!(words(&machine, 2), [1_000, 1_000]);
}

/// The cost of a sleeping program: each tick enters translated code for the handler, and for the
/// way back to WFI. Shorter runs of the machine add no entries.
#[test]
fn a_sleeping_program_is_entered_for_its_ticks_alone() {
    let entries = |slice: u64| {
        let mut machine = machine(&programs::SYSTICK);
        for end in (slice..=1_000 * MS).step_by(slice as usize) {
            machine.run_until(Time(end));
        }
        assert_eq!(word(&machine, OUT) / 10, 99, "1000 ticks, or one less");
        machine.entries()
    };
    let (whole, often) = (entries(1_000 * MS), entries(MS / 50));
    assert!(whole <= 2 * 1_000 + 10, "{whole} entries in a second");
    assert!(often <= whole + 10, "{often} entries in 50 000 runs of 20 µs");
}

#[test]
fn two_runs_are_the_same_however_they_are_cut_into_slices() {
    let run = |slice: u64| {
        let mut machine = machine(&programs::BUSY);
        let end = 20 * MS + 77;
        let mut next = 0;
        while next < end {
            next = (next + slice).min(end);
            assert_eq!(machine.run_until(Time(next)), Stop::Deadline);
        }
        let mut ram = vec![0; 0x2_0000];
        machine.read_memory(0x2000_0000, &mut ram).unwrap();
        (machine.now(), machine.pc(), machine.counters(), ram)
    };
    let whole = run(u64::MAX / 2);
    assert_eq!(whole.2.exceptions[15], 319, "20 ms of 62.5 µs, less the last one or so");
    assert!(whole == run(u64::MAX / 2), "twice the same");
    assert!(whole == run(1_234_567), "in slices of 1.2 µs");
    assert!(whole == run(MS / 3), "in slices of 0.3 ms");
}

#[test]
fn ram_is_noise_at_power_on_and_kept_over_a_reset() {
    let snapshot = |machine: &Machine| {
        let mut ram = vec![0; 0x1000];
        machine.read_memory(0x2000_2000, &mut ram).unwrap();
        ram
    };
    let mut machine = machine(&programs::STORES_AND_SLEEPS);
    let first = snapshot(&machine);
    machine.run_until(ms(1));
    machine.reset_pin();
    assert!(snapshot(&machine) == first, "a reset leaves RAM alone");
    machine.power_off();
    assert!(!machine.is_powered());
    machine.power_on(ms(10));
    assert_eq!(machine.now(), ms(10));
    let second = snapshot(&machine);
    assert!(second != first, "new noise");
    let ones: u32 = second.iter().map(|byte| byte.count_ones()).sum();
    assert!((14_000..18_800).contains(&ones), "half of the bits are ones, give or take: {ones}");
    let again = with_options(&programs::STORES_AND_SLEEPS, Options::default());
    assert!(snapshot(&again) == first, "the same seed, the same noise");
    let other = with_options(&programs::STORES_AND_SLEEPS, Options { seed: 2, ..Options::default() });
    assert!(snapshot(&other) != first);
}

/// One cycle for each instruction. SysTick counts from the reload value with the clock after the store that
/// starts it (ARMv7-M B3.3.1).
#[test]
fn time_passes_inside_a_straight_run_of_code() {
    let machine = ran(&programs::TIME_IN_A_BLOCK, ms(1));
    let [distance, count, first, second, border] = words(&machine, 5)[..] else { panic!() };
    assert_eq!([distance, count], [100, 10]);
    assert!((979..=981).contains(&first), "{first}: 1000 is loaded, and 20 instructions passed");
    assert_eq!(first - second, 50);
    assert_eq!(border, 2, "the branch, and the load");
}

/// A loop in flash without wait states, 1 024 instructions in 512 rounds: `subs` takes a cycle, `bne` one and
/// two for the refill (DDI 0439, table 3-1). Code costs more from SRAM, by a cycle for each word (section 2.3.1).
#[test]
fn code_costs_what_the_manuals_say_if_it_is_asked_for() {
    let cycles = |costs: bool| {
        let mut machine = with_options(&programs::COUNTS_DOWN, Options { costs, ..Options::default() });
        machine.run_until(ms(1));
        words(&machine, 2)
    };
    let (plain, with_costs) = (cycles(false), cycles(true));
    let about = |value: u32, expected: u32| assert!(value.abs_diff(expected) < 24, "{value}, not {expected}");
    about(plain[0], 2 * 512);
    about(plain[1], 2 * 512);
    about(with_costs[0], 4 * 512);
    about(with_costs[1], 5 * 512);
}

// --- timers and pins

/// 1 s of microseconds has 15 overflows of 65 536 and 15 times its middle. RM0090 section 18.3.2.
#[test]
fn a_timer_interrupts_at_halves_of_its_range_and_the_cpu_sleeps_between() {
    let machine = ran(&programs::TIMER_HALVES, Time(1_000 * MS));
    assert_eq!(words(&machine, 2), [15, 15]);
    assert_eq!(machine.counters().exceptions[45], 30);
    assert!(machine.counters().instructions < 30 * 20 + 40, "{}", machine.counters().instructions);
    assert_eq!(machine.reports(), []);
}

/// A write to a register in the block in which the period ends does not put the interrupt off.
#[test]
fn no_period_of_a_timer_is_lost_while_the_program_writes_registers() {
    let mut machine = ran(&programs::TIMER_PERIOD, Time(200 * MS + MS / 2));
    assert_eq!(word(&machine, OUT), 200);
    let latency = word(&machine, OUT + 4);
    assert!(latency < 60, "the interrupt comes a block late at most: {latency} cycles");
    assert_eq!(machine.counters().exceptions[44], 200);
    machine.reset_pin();
    machine.run_until(Time(202 * MS));
    assert_eq!(word(&machine, OUT), 1, "a reset starts it anew");
}

/// A condition that the program polls: address, mask, value.
type Condition = (u32, u32, u32);
/// Only an interrupt or a reset ends the wait.
const NO_CONDITION: Condition = (OUT, 0, 1);

/// Runs [`programs::WRITES_AND_WAITS`] for 100 ms: the stores, then the wait.
fn wait_after(stores: &[(u32, u32)], condition: Condition) -> (Machine, Stop) {
    wait_until(ms(100), stores, condition)
}

/// The same until this time.
fn wait_until(deadline: Time, stores: &[(u32, u32)], condition: Condition) -> (Machine, Stop) {
    const SEEN: u32 = 0x2000_1027;
    // RCC_AHB1ENR: port D. DEMCR.TRCENA and DWT_CTRL.CYCCNTENA: the counter of cycles.
    let common = [(0x4002_3830, 1 << 3), (0xE000_EDFC, 1 << 24), (0xE000_1000, 1)];
    let mut machine = machine_in_ram(&programs::WRITES_AND_WAITS, 0, Options::default());
    for exception in [15, 16 + 4] {
        machine.load_bin(0x0800_0000 + 4 * exception, &u32::to_le_bytes(SEEN)).unwrap();
    }
    let script = common.iter().chain(stores).flat_map(|&(address, value)| [address, value]);
    let script = script.chain([0, 0, condition.0, condition.1, condition.2]);
    for (n, value) in (0..).zip(script) {
        put(&mut machine, ARGUMENT + 4 * n, value);
    }
    put(&mut machine, OUT + 4, 0);
    let stop = loop {
        match machine.run_until(deadline) {
            Stop::Attention => {}
            stop => break stop,
        }
    };
    (machine, stop)
}

/// Asserts that the wait ends when the event is due, so many cycles of 16 MHz after the last store.
/// Every block of the waiting program writes a register; an event that comes due within such a
/// block is not put off to the end of the slice.
fn assert_no_delay(stores: &[(u32, u32)], condition: Condition, cycles: u32) {
    let (machine, stop) = wait_after(stores, condition);
    assert_eq!(stop, Stop::Deadline);
    let passed = word(&machine, OUT + 4).wrapping_sub(word(&machine, OUT));
    assert!((cycles - 30..cycles + 60).contains(&passed), "{passed} cycles");
    assert_eq!(machine.reports(), []);
}

#[test]
fn no_event_is_late_because_the_program_writes_registers() {
    const CAN1_MCR: u32 = 0x4000_6400;
    const USART2_SR: u32 = 0x4000_4400;
    const TC: u32 = 1 << 6;
    // PM0214 section 4.5: SysTick has a period of the reload value and one.
    assert_no_delay(&[(0xE000_E014, 999), (0xE000_E018, 0), (0xE000_E010, 7)], NO_CONDITION, 1_000);
    // Datasheet: 16 µs for a word. NVIC line 4, the keys, FLASH_CR: PG, x32, EOPIE.
    let prepare = [(0xE000_E100, 1 << 4), UNLOCK[0], UNLOCK[1], (0x4002_3C10, 1 | 2 << 8 | 1 << 24)];
    let stores = [&prepare[..], &[(0x0800_4000, 0x1234_5678)]].concat();
    assert_no_delay(&stores, NO_CONDITION, 256);
    // RM0090 section 32.4: from sleep mode to normal mode after 11 recessive bits; with the reset
    // value of CAN_BTR a bit has 8 quanta of a cycle.
    let not_asleep = (CAN1_MCR + 4, 1 << 1, 0);
    assert_no_delay(&[(0x4002_3840, 1 << 25), (CAN1_MCR, 0)], not_asleep, 88);
    // RM0090 section 30.3.2: TE sends an idle frame first, as long as the character after it: 10 bits
    // each, at 1 Mbit/s. Port A beside D; PA2 is TX (AF7). USART2_CR1: UE, TE. TC is set after a
    // reset, and cleared by writing 0.
    let pin = [(0x4002_3830, 1 << 3 | 1), (0x4002_0020, 7 << 8), (0x4002_0000, 0xA800_0020)];
    let set_up = [(0x4002_3840, 1 << 17), (USART2_SR + 8, 16), (USART2_SR + 12, 0x2008)];
    let stores = [&pin[..], &set_up, &[(USART2_SR + 4, 0x55), (USART2_SR, 0)]].concat();
    assert_no_delay(&stores, (USART2_SR, TC, TC), 320);
}

/// RM0090 table 107: 4096 counts of 4 periods of the LSI's 32 kHz are 512 ms.
#[test]
fn the_watchdog_is_not_late_because_the_program_writes_registers() {
    let (machine, stop) = wait_until(ms(600), &[(0x4000_3000, 0xCCCC)], NO_CONDITION);
    assert_eq!(stop, Stop::Reset(ResetCause::IndependentWatchdog));
    let at = machine.now().0;
    assert!((512 * MS..512 * MS + MS / 50).contains(&at), "{}", machine.now());
}

/// The core goes from 16 MHz to the crystal's 8 MHz when the crystal is ready, after 2 ms.
#[test]
fn a_change_of_clocks_is_not_late_because_the_program_writes_registers() {
    // RCC_CR: HSION, HSITRIM, HSEON. RCC_CFGR.SW: the crystal.
    let stores = [(0x4002_3800, 0x0001_0081), (0x4002_3808, 1)];
    let (machine, stop) = wait_after(&stores, NO_CONDITION);
    assert_eq!((stop, machine.core_clock()), (Stop::Deadline, 8_000_000));
    let cycles = machine.counters().cycles;
    let expected = 2 * 16_000 + 98 * 8_000;
    assert!((expected..expected + 1_000).contains(&cycles), "{cycles} cycles");
}

/// RM0090 sections 9.2.6 and 12.2: SYSCFG_EXTICR4 gives line 13 to port C.
#[test]
fn a_falling_edge_at_a_pin_wakes_the_program() {
    let mut machine = machine(&programs::BUTTON);
    machine.set_pin('C', 13, Some(true));
    machine.run_until(ms(1));
    assert_eq!(word(&machine, OUT), 0);
    for (at, port, level, edges) in
        [(2, 'C', false, 1), (3, 'C', true, 1), (4, 'B', true, 1), (5, 'B', false, 1), (6, 'C', false, 2)]
    {
        machine.set_pin(port, 13, Some(level));
        machine.run_until(ms(at));
        assert_eq!(word(&machine, OUT), edges, "at {at} ms");
    }
    assert_eq!(word(&machine, OUT + 4), 1 << 13);
    assert_eq!(machine.reports(), []);
}

// --- exceptions

/// DDI 0403E table B1-8: EXC_RETURN FFFF_FFF1 to a handler, FFFF_FFF9 to the thread on the main
/// stack.
#[test]
fn a_higher_priority_pre_empts_and_an_equal_one_waits_and_follows() {
    let nested_sp = STACK - 2 * 0x20;
    for (priority, log) in [
        (0x40, [1, 0xFFFF_FFF9, 2, 0xFFFF_FFF1, nested_sp, 3, 4]),
        (0x80, [1, 0xFFFF_FFF9, 3, 2, 0xFFFF_FFF9, STACK - 0x20, 4]),
    ] {
        let mut machine = with_argument(&programs::NESTING, priority);
        machine.run_until(ms(1));
        assert_eq!(words(&machine, 7), log, "{priority:02X}h");
        assert_eq!(machine.counters().exceptions[16..18], [1, 1], "{priority:02X}h");
    }
}

/// Programs that write what they find, and the words by the manuals.
#[test]
fn a_program_finds_what_the_manuals_say() {
    for (program, until_ms, expected, why) in [
        (&programs::MASKS, 1, &[1, 9, 2, 3, 9, 4][..], "BASEPRI and PRIMASK hold back, PRIMASK lets WFI end"),
        (&programs::UNPRIVILEGED, 10, &[1_000, 1_000, 1], "without privilege masks hold, and do not change"),
        (&programs::FAULTMASK, 1, &[0, 1], "an exception return clears FAULTMASK (DDI 0403E B1.5.8)"),
        (&programs::VECTORS_IN_RAM, 1, &[77], "VTOR moves the table"),
        // The first load from a page calls a hook in the middle of a block.
        (
            &programs::CONDITIONAL_LOADS,
            1,
            &[64 * 4],
            "code after an IT block with a load stays unconditional",
        ),
        (&programs::BIT_BAND, 1, &[3, 1, 0x0010_0008, 1], "bit-band aliases reach their bits"),
        (&programs::WRITES_ITS_OWN_CODE, 1, &[1, 2], "code that a program writes is seen"),
    ] {
        let mut machine = machine(program);
        assert_eq!(machine.run_until(ms(until_ms)), Stop::Deadline, "{why}");
        assert_eq!(words(&machine, expected.len() as u32), expected, "{why}");
        assert_eq!(machine.reports(), [], "{why}");
    }
}

/// DDI 0403E B1.5.6: the frame on the process stack, padded to eight bytes with bit 9 of the
/// stacked xPSR.
#[test]
fn svc_from_the_process_stack_and_back() {
    let machine = ran(&programs::PROCESS_STACK, ms(1));
    let log = words(&machine, 9);
    assert_eq!(log[0], 0xFFFF_FFFD);
    assert_eq!(log[1], STACK, "the handler's own stack is the main one");
    assert_eq!(log[2], 0x2000_8000 - 0x20);
    assert_eq!(log[3], 0x0800_0216, "the instruction behind SVC");
    assert_eq!(log[4] & 0x0100_03FF, 0x0100_0200, "Thumb, padded, thread");
    assert_eq!(log[5], 0, "CONTROL in the handler");
    assert_eq!(log[6], 11);
    assert_eq!(log[7..9], [2, 0x2000_8004], "CONTROL and SP in the thread again");
}

#[test]
fn wfe_ends_by_itself_and_sleep_on_exit_never_comes_back() {
    let waiting = ran(&programs::EVENTS, ms(1));
    assert!((50..=100).contains(&word(&waiting, OUT)), "{}", word(&waiting, OUT));
    let sleeping = ran(&programs::SLEEPS_ON_EXIT, Time(10 * MS + MS / 2));
    assert_eq!(words(&sleeping, 2), [10, 0]);
}

/// The IT state is part of the xPSR that is stacked.
#[test]
fn an_interrupt_within_a_conditional_block_leaves_it_whole() {
    let mut machine = machine(&programs::CONDITIONS);
    put(&mut machine, OUT + 16, 0);
    machine.run_until(ms(500));
    assert_eq!(words(&machine, 4), [350_000, 50_000, 150_000, 250_000]);
    assert!(word(&machine, OUT + 16) > 10_000, "ticks: {}", word(&machine, OUT + 16));
}

/// New code in flash is executed, also if the program had read the old code before executing it.
#[test]
fn code_that_was_read_before_it_was_run_can_be_replaced() {
    let mut machine = machine(&programs::CALLS_WHAT_IT_HAS_READ);
    // movs r0, #n; bx lr
    for (n, at) in [(1_u8, 1), (2, 2), (3, 3)] {
        machine.load_bin(0x0801_0000, &[n, 0x20, 0x70, 0x47]).unwrap();
        machine.run_until(ms(at));
        assert_eq!(word(&machine, OUT), u32::from(n));
    }
}

// --- FPU

#[test]
fn the_fpu_faults_until_it_is_enabled() {
    let mut machine = with_argument(&programs::FPU, 0);
    machine.run_until(ms(1));
    let [cfsr, hfsr] = [0xE000_ED28, 0xE000_ED2C].map(|register| machine.register(register));
    assert_eq!((cfsr, hfsr), (Some(0x0008_0000), Some(FORCED)), "NOCP, FORCED");
    assert_eq!(word(&machine, OUT + 20), 3);
    assert_eq!(word(&machine, OUT + 24), 11, "what came before it was executed");
    assert_eq!(word(&machine, OUT + 16), 0x0800_0220, "the first FPU instruction");
}

/// DDI 0403E B1.5.7: the extended frame has 26 words, EXC_RETURN has bit 4 clear.
#[test]
fn fpu_registers_survive_an_interrupt() {
    let mut machine = with_argument(&programs::FPU, 1);
    machine.run_until(ms(1));
    assert_eq!(word(&machine, OUT), 0xFFFF_FFE9);
    assert_eq!(word(&machine, OUT + 4), 3.0_f32.to_bits());
    assert_eq!(word(&machine, OUT + 8), STACK - 4 * 26);
}

// --- faults

/// Runs [`programs::FAULTS`] with this kind of fault. It logs IPSR, CFSR, HFSR, BFAR and the
/// stacked PC.
fn fault(kind: u32, enabled: u32, again: u32) -> (Machine, Stop) {
    let mut machine = with_argument(&programs::FAULTS, kind);
    put(&mut machine, ARGUMENT + 4, enabled);
    put(&mut machine, ARGUMENT + 8, again);
    let stop = machine.run_until(ms(1));
    (machine, stop)
}

const FORCED: u32 = 0x4000_0000;
const ALL_FAULTS: u32 = 7 << 16;

#[test]
fn faults_escalate_to_hard_fault_while_they_are_disabled() {
    for (kind, cfsr, hfsr) in [
        (0, 0x0000_8200, FORCED),
        (1, 0x0001_0000, FORCED),
        (2, 0x0002_0000, FORCED),
        (4, 0, 0x8000_0000),
        (5, 0x0000_0400, FORCED),
        (6, 0x0000_0100, FORCED),
        (7, 0x0000_0100, FORCED),
    ] {
        let (machine, stop) = fault(kind, 0, 0);
        assert_eq!(stop, Stop::Deadline);
        assert_eq!(words(&machine, 3), [3, cfsr, hfsr], "kind {kind}");
    }
}

#[test]
fn faults_are_taken_at_their_own_priority_when_enabled() {
    for (kind, exception) in [(0, 5), (1, 6), (2, 6), (4, 3), (5, 5), (6, 5)] {
        let (machine, _) = fault(kind, ALL_FAULTS, 0);
        assert_eq!(word(&machine, OUT), exception, "kind {kind}");
        assert_eq!(word(&machine, OUT + 8) & FORCED, 0);
    }
}

#[test]
fn a_bad_load_names_its_address_and_its_instruction() {
    let (machine, _) = fault(0, 0, 0);
    let log = words(&machine, 5);
    assert_eq!(log[3], 0x6000_0010, "BFAR");
    let [report] = machine.reports() else { panic!("{:?}", machine.reports()) };
    assert_eq!((report.address, report.access, report.size), (0x6000_0010, Access::Read, 4));
    assert_eq!(report.pc, log[4], "the stacked PC is the load's");
    assert_eq!(word(&machine, report.pc & !3) >> (8 * (report.pc & 2)) & 0xFFFF, 0x6800, "ldr r0, [r0]");
}

#[test]
fn a_fault_within_hard_fault_locks_up() {
    let (mut machine, stop) = fault(1, 0, 1);
    assert_eq!(stop, Stop::Lockup);
    let before = machine.counters().instructions;
    assert_eq!(machine.run_until(ms(50)), Stop::Deadline);
    assert_eq!(machine.counters().instructions, before);
}

#[test]
fn code_runs_in_ram_but_not_in_core_coupled_memory() {
    let (machine, _) = fault(7, 0, 0);
    assert_eq!(word(&machine, OUT + 16), 0x1000_0000);
    assert_eq!(machine.reports()[0].access, Access::Fetch);
}

// --- reset causes

/// RM0090 section 7.3.21: RCC_CSR reset flags.
#[test]
fn a_software_reset_keeps_ram_and_says_so() {
    let mut machine = machine(&programs::RESET);
    put(&mut machine, OUT, 0);
    assert_eq!(machine.run_until(ms(1)), Stop::Reset(ResetCause::Software));
    assert_eq!(word(&machine, OUT + 16), 0x0E00_0000, "power-on: POR, PIN, BOR");
    assert_eq!(machine.run_until(ms(1)), Stop::Deadline);
    assert_eq!(word(&machine, OUT), 2, "RAM was kept");
    assert_eq!(word(&machine, OUT + 16), 0x1400_0000, "SFT, PIN");
    assert_eq!(machine.counters().resets, 1);
    machine.reset_pin();
    machine.run_until(ms(2));
    assert_eq!(word(&machine, OUT + 16), 0x0400_0000, "PIN alone, as RMVF took the others away");
}

#[test]
fn the_watchdog_resets_unless_it_is_fed() {
    let mut hungry = with_argument(&programs::WATCHDOG, 0);
    assert_eq!(hungry.run_until(ms(10)), Stop::Reset(ResetCause::IndependentWatchdog));
    // Five periods of 32 kHz until the values have got across, then the millisecond.
    let (at, across) = (hungry.now().0, 5 * MS / 32);
    assert!((across + MS..across + MS + MS / 50).contains(&at), "{}", hungry.now());
    let mut fed = with_argument(&programs::WATCHDOG, 10);
    assert_eq!(fed.run_until(ms(30)), Stop::Reset(ResetCause::IndependentWatchdog));
    // Ten rounds of 6 400 × 2 cycles at 16 MHz, 0.8 ms each, then the millisecond that is not fed.
    assert!((across + 9 * MS..across + 9 * MS + MS / 10).contains(&fed.now().0), "{}", fed.now());
}

/// RM0090 sections 5.3.5 and 5.4.2: the chip starts anew, SBF and WUF say why; RAM is lost; which flags
/// RCC_CSR has is a matter of the chip.
#[test]
fn a_chip_wakes_up_from_standby_by_the_pin_or_by_a_reset() {
    for (flags_after_standby, flags) in [(false, 0), (true, 0x0E00_0000)] {
        let silicon = Silicon { flags_after_standby, ..TYPICAL };
        let mut machine = with_options(&programs::STANDBY, Options { silicon, ..Options::default() });
        put(&mut machine, ARGUMENT, 0);
        assert_eq!(machine.run_until(ms(10)), Stop::Deadline);
        assert!(machine.is_in_standby());
        assert_eq!(words(&machine, 2), [0x0E00_0000, 0x4000]);
        put(&mut machine, OUT + 8, 0x600D_CAFE);
        let instructions = machine.counters().instructions;
        assert_eq!(machine.run_until(ms(1_000)), Stop::Deadline);
        assert_eq!(machine.counters().instructions, instructions, "nothing runs");

        machine.set_pin('A', 0, Some(true));
        assert_eq!(machine.run_until(ms(1_001)), Stop::Reset(ResetCause::Standby));
        assert_ne!(word(&machine, OUT + 8), 0x600D_CAFE, "RAM is lost");
        machine.set_pin('A', 0, Some(false));
        assert_eq!(machine.run_until(ms(1_010)), Stop::Deadline);
        assert_eq!(words(&machine, 2), [flags, 0x4103]);
        machine.wake_up();
        assert_eq!(machine.run_until(ms(1_020)), Stop::Reset(ResetCause::Standby));
        machine.run_until(ms(1_030));
        machine.reset_pin();
        machine.run_until(ms(1_040));
        assert_eq!(words(&machine, 2), [0x0400_0000, 0x4002], "NRST wakes it, too");
        assert_eq!(machine.reports(), []);
    }
}

/// PM0214 section 3.11.12: WFI ends when an interrupt is pending, whatever PRIMASK says.
#[test]
fn a_pending_interrupt_keeps_the_chip_out_of_standby() {
    let mut machine = with_argument(&programs::STANDBY, 2);
    assert_eq!(machine.run_until(ms(10)), Stop::Deadline);
    assert!(!machine.is_in_standby());
    assert_eq!(machine.register(0x4000_7004), Some(0x4100), "EWUP, no SBF");
}

/// RM0090 sections 5.3.5 and 21.3: in Standby the core domain stands still, and the watchdog runs on.
#[test]
fn the_watchdog_bites_in_standby() {
    let mut machine = with_argument(&programs::STANDBY, 1);
    assert_eq!(machine.run_until(ms(600)), Stop::Reset(ResetCause::IndependentWatchdog));
    let at = machine.now().0;
    assert!((512 * MS..513 * MS).contains(&at), "{}", machine.now());
    put(&mut machine, ARGUMENT, 0);
    machine.run_until(ms(610));
    assert_eq!(words(&machine, 2), [0x2400_0000, 0x4002]);
}

/// RM0090 sections 5.3.3 and 7.3.18: in sleep mode a peripheral has a clock if its bit of the low-power
/// enable register is 1. SysTick has the core's.
#[test]
fn a_timer_without_a_clock_in_sleep_mode_stands_still() {
    for (apb1lpenr, overflows) in [(0x36FE_C9FF, 99..=100), (0x36FE_C9FE, 0..=0)] {
        let mut machine = with_argument(&programs::SLEEPS_WITH_A_TIMER, apb1lpenr);
        assert_eq!(machine.run_until(ms(100) + Span::from_micros(10)), Stop::Deadline);
        let counted = words(&machine, 2);
        assert!(overflows.contains(&counted[0]), "{apb1lpenr:08X}h: {counted:?}");
        assert_eq!(counted[1], 10, "SysTick");
        assert_eq!(machine.reports(), []);
    }
}

/// ARMv7-M B3.3.5: SYST_CVR is unknown after a reset, and SYST_RVR is loaded when it has reached 0.
#[test]
fn systick_begins_with_what_the_chip_has() {
    for (systick_value, first) in [(0, 16_000), (0x1234, 0x1234), (0x00FF_FFFF, 0x00FF_FFFF)] {
        let silicon = Silicon { systick_value, ..TYPICAL };
        let mut machine =
            with_options(&programs::STORES_AND_SLEEPS, Options { silicon, ..Options::default() });
        machine.run_until(ms(1));
        for (register, value) in [(0xE000_E014, 15_999_u32), (0xE000_E010, 5)] {
            machine.poke(register, &value.to_le_bytes()).unwrap();
        }
        machine.run_until(ms(1) + Span::from_micros(100));
        let value = machine.register(0xE000_E018).unwrap();
        assert!((first - 1_602..=first - 1_598).contains(&value), "{systick_value:X}h: {value}");
    }
}

// --- clocks

/// 2 ms for the crystal and 0.2 ms for the PLL pass before; 168 MHz / 16 800 makes a tick each 100
/// µs.
#[test]
fn the_program_sets_the_clock_and_the_cycles_follow() {
    let mut machine = with_argument(&programs::SCALES_THE_CLOCK, 5);
    machine.run_until(ms(2));
    assert_eq!(machine.core_clock(), 16_000_000);
    machine.run_until(ms(3));
    assert_eq!(machine.core_clock(), 168_000_000);
    // A million rounds of two cycles are 11.9 ms.
    machine.run_until(ms(20));
    let cycles = word(&machine, OUT + 4);
    assert!((2_000_000..2_000_010).contains(&cycles), "{cycles}");
    let ticks = word(&machine, OUT);
    machine.run_until(ms(1_020));
    assert_eq!(word(&machine, OUT), ticks + 10_000);
    assert_eq!(machine.reports(), []);
}

#[test]
fn too_few_wait_states_are_reported() {
    let mut machine = with_argument(&programs::SCALES_THE_CLOCK, 4);
    machine.run_until(ms(20));
    assert!(machine.reports()[0].what.contains("4 flash wait states: it needs 5"), "{:?}", machine.reports());
}

#[test]
fn without_its_crystal_the_board_never_gets_there() {
    let options = Options { hse_hz: 0, ..Options::default() };
    let mut machine = with_options(&programs::SCALES_THE_CLOCK, options);
    machine.run_until(ms(50));
    assert_eq!(machine.core_clock(), 16_000_000);
    assert!(machine.reports()[0].what.contains("no crystal"));
}

// --- memory map

#[test]
fn unmodelled_and_unclocked_accesses_are_reported_once_with_a_count() {
    let mut machine = machine(&programs::PERIPHERALS);
    put(&mut machine, OUT + 4, 5);
    machine.run_until(ms(1));
    let [unclocked, unmodelled] = machine.reports() else { panic!("{:?}", machine.reports()) };
    assert_eq!((unclocked.address, unclocked.access, unclocked.count), (0x4002_0C00, Access::Read, 1));
    assert!(unclocked.what.contains("GPIOD has no clock"), "{unclocked}");
    assert_eq!((unmodelled.address, unmodelled.access, unmodelled.value), (0x4000_0000, Access::Write, 1));
    assert!(unmodelled.what.contains("TIM2"), "{unmodelled}");
    // The listing: ldr r0, [r1, #0] and str r0, [r2, #0].
    assert_eq!((unclocked.pc, unmodelled.pc), (0x0800_0206, 0x0800_0210));
    assert_eq!(machine.reports().iter().map(|r| r.count).sum::<u64>(), 6);
    assert!(machine.pin('D', 12));
    assert_eq!(word(&machine, OUT), 1 << 12, "IDR sees the pin");
}

#[test]
fn the_chip_says_who_it_is() {
    let options = Options { unique_id: [1, 2, 0xDEAD_BEEF], ..Options::default() };
    let machine = with_options(&programs::STORES_AND_SLEEPS, options);
    assert_eq!(word(&machine, 0x1FFF_7A18), 0xDEAD_BEEF);
    assert_eq!(word(&machine, 0x1FFF_7A20) >> 16, 1024, "flash size in KiB at 1FFF_7A22h");
    assert_eq!(word(&machine, 0x0000_0000), STACK, "flash is aliased at 0");
}

/// RM0090 section 3.8 and table 19: blocks of 32 bytes from 1FFF_7800h on, a lock byte for each from 1FFF_7A00h on; no
/// erase. A program here cannot program them.
#[test]
fn one_time_programmable_bytes_are_a_debug_probes_to_program() {
    let mut machine = machine(&programs::STORES_TO_OTP);
    assert_eq!(machine.run_until(ms(1)), Stop::Deadline);
    let reports: Vec<_> = machine.reports().iter().map(|report| (report.access, report.address)).collect();
    assert_eq!(reports, [(Access::Write, 0x1FFF_7820)]);
    assert_eq!(words(&machine, 1), [u32::MAX], "erased");

    machine.load_bin(0x1FFF_7820, &[0x12, 0x34, 0x56, 0x78]).unwrap();
    machine.load_hex(":020000041FFFDC\n:0179E0000F97\n:00000001FF\n").unwrap();
    machine.power_on(ms(2));
    machine.run_until(ms(3));
    assert_eq!(words(&machine, 1), [0x7856_3412]);
    assert_eq!(word(&machine, 0x1FFF_79E0), 0xFFFF_FF0F);
    // A bit only goes from 1 to 0, and none of a locked block.
    machine.load_bin(0x1FFF_7820, &[0xF0, 0xFF]).unwrap();
    assert_eq!(word(&machine, 0x1FFF_7820), 0x7856_3410);
    machine.load_bin(0x1FFF_7A01, &[0]).unwrap();
    assert!(machine.load_bin(0x1FFF_783C, &[0; 8]).is_err());
    assert_eq!([0x1FFF_783C, 0x1FFF_7840].map(|address| word(&machine, address)), [u32::MAX, 0]);
    for (address, len) in [(0x1FFF_77FF, 2), (0x1FFF_7A0F, 2), (0x1FFF_7A10, 4)] {
        assert!(machine.load_bin(address, &vec![0; len]).is_err(), "{address:X}");
    }
}

#[test]
fn where_in_ram_a_piece_of_code_goes_is_told() {
    let program = &programs::STORES_AND_SLEEPS;
    let len = 2 * program.code.len() as u32;
    let mut machine = with_options(program, Options::default());
    machine.watch(Region::new(program.base, len));
    machine.run_until(ms(1));
    assert_eq!(words(&machine, 2), [42, STACK]);
    assert_eq!(machine.take_touched(), [OUT], "two words of one page");
    assert_eq!(machine.take_touched(), [0; 0], "once");
    machine.reset_pin();
    machine.run_until(ms(2));
    assert_eq!(machine.take_touched(), [OUT], "again");
    machine.watch(Region::new(program.base + len, 0x1000));
    machine.reset_pin();
    machine.run_until(ms(3));
    assert_eq!(machine.take_touched(), [0; 0], "other code");
}

#[test]
fn the_host_may_write_into_the_ccm_while_a_program_runs() {
    let mut machine = ran(&programs::STORES_AND_SLEEPS, ms(1));
    machine.write_ram(0x1000_0000, &[0xA5; 64]).unwrap();
    assert_eq!(machine.run_until(ms(2)), Stop::Deadline);
    assert_eq!(machine.reports(), []);
    assert_eq!(word(&machine, 0x1000_003C), 0xA5A5_A5A5);
}

// --- hostile input

#[test]
fn bad_images_are_refused_and_leave_the_flash_alone() {
    let mut machine = Machine::new(&STM32F407VG, Options::default()).unwrap();
    for bad in [&b""[..], b"\x7FELF", &[0; 100], b":10010000214601360121470136007EFE09D2190140"] {
        assert!(machine.load(bad).is_err());
    }
    assert!(
        machine.load_hex(":10010000214601360121470136007EFE09D2190140\n:00000001FF\n").is_err(),
        "not in flash"
    );
    assert!(machine.load_bin(0x080F_FFFF, &[0, 0]).is_err());
    assert!(machine.load_bin(0x2000_0000, &[0]).is_err());
    assert!(machine.load_bin(u32::MAX, &[0; 8]).is_err());
    assert!(machine.write_ram(0x2001_FFFF, &[0, 0]).is_err());
    assert!(machine.read_memory(0x1FFF_7FFF, &mut [0; 2]).is_err());
    assert!(machine.flash().iter().all(|&byte| byte == 0xFF));
    machine.set_pin('Z', 99, Some(true));
    assert!(!machine.pin('Z', 99));
}

/// No program may make the emulator panic or hang. This program is random code; its registers hold
/// addresses of peripherals and memories.
#[test]
fn noise_as_a_program_does_no_harm() {
    const PLACES: [u32; 16] = [
        0x2000_0000,
        0x2001_FFFC,
        0x0800_4000,
        0x4002_3800,
        0x4002_3C00,
        0x4002_0C00,
        0x4000_3000,
        0x4000_6400,
        0x4000_6580,
        0x4000_7000,
        0xE000_E010,
        0xE000_E100,
        0xE000_ED00,
        0xE000_1000,
        0x4247_0600,
        0x1000_0000,
    ];
    let mut state = 0x1234_5678_u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 32) as u32
    };
    for seed in 0..60 {
        // adr r7, table; ldmia r7, {r0-r7}; b past the table; nop
        let mut code = bytes(&[0xA701, 0xCFFF, 0xE010, 0xBF00]);
        for _ in 0..8 {
            code.extend_from_slice(&PLACES[random() as usize % 16].to_le_bytes());
        }
        for _ in 0..512 {
            code.extend_from_slice(&random().to_le_bytes());
        }
        let options = Options { seed, ..Options::default() };
        let mut machine = Machine::new(&STM32F407VG, options).unwrap();
        machine.load_bin(0x0800_0000, &table(&programs::STORES_AND_SLEEPS)).unwrap();
        machine.load_bin(0x0800_0200, &code).unwrap();
        machine.power_on(Time(0));
        let mut stops = 0;
        while machine.run_until(ms(2)) != Stop::Deadline && stops < 50 {
            stops += 1;
        }
    }
}

// --- resets by the chip itself

/// RM0090 sections 7.1.1 and 7.3.21: with nRST_STDBY or nRST_STOP clear, the entry is a reset with
/// LPWRRSTF, and the pin's flag as with every internal reset.
#[test]
fn with_an_option_bit_the_entry_into_standby_is_a_reset() {
    for (optcr, is_reset) in [(0x0FFF_AA6C, true), (0x0FFF_AAAC, false)] {
        let mut machine = machine(&programs::STANDBY);
        machine.set_option_bytes(optcr);
        put(&mut machine, ARGUMENT, 0);
        if is_reset {
            assert_eq!(machine.run_until(ms(10)), Stop::Reset(ResetCause::LowPower));
            assert_eq!(machine.run_until(ms(10)), Stop::Reset(ResetCause::LowPower));
            assert_eq!(words(&machine, 2), [0x8400_0000, 0x4000], "no SBF");
        } else {
            assert_eq!(machine.run_until(ms(10)), Stop::Deadline, "nRST_STOP is for Stop");
            assert!(machine.is_in_standby());
        }
    }
}

/// RM0090 section 22.4: 64 counts of 4096 periods of PCLK1, 16.384 ms at 16 MHz; section 7.3.21:
/// WWDGRSTF, and the flags of the power-on.
#[test]
fn the_window_watchdog_resets_the_chip() {
    let mut machine = ran(&programs::BUSY, ms(1));
    for (register, value) in [(0x4002_3840_u32, 1_u32 << 11), (0x4000_2C00, 0xFF)] {
        machine.poke(register, &value.to_le_bytes()).unwrap();
    }
    assert_eq!(machine.run_until(ms(100)), Stop::Reset(ResetCause::WindowWatchdog));
    let at = machine.now().0 / 1_000_000;
    assert!((17_384..17_390).contains(&at), "{at} us");
    assert_eq!(machine.register(0x4002_3874).unwrap() >> 24, 0x4E);
    assert_eq!(machine.run_until(ms(100)), Stop::Deadline, "the reset stops it");
}
