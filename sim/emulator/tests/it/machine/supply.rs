//! VDD: the resets by it, and what does not work with too little of it. Thresholds from the datasheet
//! (DocID022152, "Embedded reset and power control block characteristics"), typical.

use super::flash::store;
use super::*;

/// A machine that counts its resets in RAM at [`OUT`] and keeps RCC_CSR at [`OUT`] + 16, after its first
/// software reset; with a level of the brown-out reset, 0 for off.
fn running(level: u8) -> Machine {
    let mut machine = Machine::new(&STM32F407VG, Options::default()).unwrap();
    load(&mut machine, &programs::RESET);
    machine.set_brown_out_level(level);
    machine.power_on(Time(0));
    put(&mut machine, OUT, 0);
    assert_eq!(machine.run_until(ms(1)), Stop::Reset(ResetCause::Software));
    assert_eq!(machine.run_until(ms(2)), Stop::Deadline);
    assert_eq!(word(&machine, OUT), 2);
    machine
}

/// The supply goes to `mv` for some ms, and back to 3.3 V.
fn dip(machine: &mut Machine, mv: u32, for_ms: u64) -> Stop {
    machine.set_supply(mv, Span(0));
    let back = machine.now() + Span::from_millis(for_ms);
    assert_eq!(machine.run_until(back), Stop::Deadline, "{mv} mV");
    machine.set_supply(3_300, Span(0));
    machine.run_until(back + Span::from_millis(1))
}

/// RM0090 section 7.3.21: BORRSTF alone, with the pin that every reset pulls. RAM stays.
#[test]
fn a_supply_below_the_brown_out_level_resets_the_chip() {
    for (level, keeps, resets) in [(3, 2_840, 2_820), (2, 2_510, 2_490), (1, 2_200, 2_180)] {
        let mut machine = running(level);
        assert_eq!(dip(&mut machine, keeps, 5), Stop::Deadline, "level {level}");
        assert_eq!(dip(&mut machine, resets, 5), Stop::Reset(ResetCause::BrownOut), "level {level}");
        machine.run_until(machine.now() + Span::from_millis(1));
        assert_eq!(word(&machine, OUT), 3, "level {level}");
        assert_eq!(word(&machine, OUT + 16), 0x0600_0000, "level {level}: BOR, PIN");
    }
}

#[test]
fn with_the_brown_out_reset_off_a_chip_runs_down_to_the_power_down_reset() {
    let mut machine = running(0);
    for mv in [2_400, 1_900, 1_690] {
        assert_eq!(dip(&mut machine, mv, 1_000), Stop::Deadline, "{mv} mV");
    }
    assert_eq!(word(&machine, OUT), 2);
    assert_eq!(dip(&mut machine, 1_670, 1_000), Stop::Reset(ResetCause::PowerOn));
    machine.run_until(machine.now() + Span::from_millis(1));
    // Its contents are there, with the flags of a power-on: above its retention voltage, RAM forgets nothing.
    assert_eq!((word(&machine, OUT), word(&machine, OUT + 16)), (3, 0x0E00_0000));
}

/// A millisecond, a second, an hour.
#[test]
fn a_supply_that_goes_off_and_comes_back_leaves_the_ram_or_not() {
    for (off_ms, is_kept) in [(1, true), (1_000, false), (3_600_000, false)] {
        let mut machine = running(0);
        put(&mut machine, 0x2000_8000, 0x600D_CAFE);
        assert_eq!(dip(&mut machine, 0, off_ms), Stop::Reset(ResetCause::PowerOn), "{off_ms} ms");
        assert_eq!(word(&machine, 0x2000_8000) == 0x600D_CAFE, is_kept, "{off_ms} ms");
    }
    // Between, some of it is lost.
    let mut machine = running(0);
    machine.write_ram(0x2000_8000, &[0xA5; 0x4000]).unwrap();
    assert_eq!(dip(&mut machine, 0, 500), Stop::Reset(ResetCause::PowerOn));
    let mut ram = [0; 0x4000];
    machine.read_memory(0x2000_8000, &mut ram).unwrap();
    let kept = ram.iter().filter(|byte| **byte == 0xA5).count();
    assert!((0x1800..0x2800).contains(&kept), "{kept} bytes are kept");
}

#[test]
fn while_the_supply_is_too_low_nothing_runs_and_no_pin_helps() {
    let mut machine = running(3);
    machine.set_supply(2_000, Span::from_millis(100));
    assert_eq!(machine.supply(), 3_300);
    // It is below 2.83 V after 36 ms of 1.3 V in 100 ms.
    assert_eq!(machine.run_until(machine.now() + Span::from_millis(35)), Stop::Deadline);
    assert!(!machine.is_held_in_reset() && (2_840..=2_850).contains(&machine.supply()));
    assert_eq!(machine.run_until(machine.now() + Span::from_millis(2)), Stop::Deadline);
    assert!(machine.is_held_in_reset());
    let instructions = machine.counters().instructions;
    machine.reset_pin();
    assert_eq!(machine.run_until(ms(1_000)), Stop::Deadline);
    assert_eq!((machine.counters().instructions, machine.supply()), (instructions, 2_000));
    // It rises slowly, and comes out of reset at 2.92 V.
    machine.set_supply(3_300, Span::from_millis(1_300));
    assert_eq!(machine.run_until(ms(5_000)), Stop::Reset(ResetCause::BrownOut));
    assert!((2_919..=2_922).contains(&machine.supply()), "{}", machine.supply());
}

#[test]
fn a_chip_waits_for_its_supply_at_power_on() {
    let mut machine = Machine::new(&STM32F407VG, Options { vdd_mv: 1_500, ..Options::default() }).unwrap();
    load(&mut machine, &programs::STORES_AND_SLEEPS);
    machine.power_on(Time(0));
    assert_eq!(machine.run_until(ms(10)), Stop::Deadline);
    assert_eq!(machine.counters().instructions, 0);
    machine.set_supply(1_800, Span(0));
    assert_eq!(machine.run_until(ms(11)), Stop::Reset(ResetCause::PowerOn));
    machine.run_until(ms(12));
    assert_eq!(word(&machine, OUT), 42);
}

/// RM0090 table 11: at 2.4 to 2.7 V 24 MHz for each wait state.
#[test]
fn a_lower_supply_needs_more_wait_states() {
    let mut machine = machine(&programs::SCALES_THE_CLOCK);
    put(&mut machine, ARGUMENT, 5);
    machine.run_until(ms(20));
    assert_eq!(machine.reports(), []);
    machine.set_supply(2_700, Span(0));
    machine.run_until(ms(30));
    assert_eq!(machine.reports(), []);
    machine.set_supply(2_600, Span(0));
    machine.run_until(ms(40));
    let [report] = machine.reports() else { panic!("{:?}", machine.reports()) };
    assert!(report.what.contains("5 flash wait states: it needs 6 at VDD 2600 mV"), "{report}");
}

/// FLASH_CR of RM0090 section 3.9.7: PG, PSIZE of 32 bits; and a word.
const PROGRAM_A_WORD: [(u32, u32); 2] = [(0x4002_3C10, 0x201), (0x0804_0000, 0x1234_5678)];

/// RM0090 section 3.6.2: with a supply too low for the width, the value may be there and may not last.
#[test]
fn what_is_programmed_with_too_little_voltage_does_not_last() {
    for (mv, is_weak) in [(2_700, false), (2_690, true)] {
        let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
        machine.set_supply(mv, Span(0));
        store(&mut machine, &[&UNLOCK, &PROGRAM_A_WORD]);
        assert_eq!(word(&machine, 0x0804_0000), 0x1234_5678, "{mv} mV");
        assert_eq!(machine.counters().flash_weak, u64::from(is_weak), "{mv} mV");
        assert_eq!(machine.flash_cells().unstable.is_empty(), !is_weak, "{mv} mV");
        let reported: Vec<_> = machine.reports().iter().map(|report| report.what.as_str()).collect();
        match is_weak {
            false => assert_eq!(reported, [""; 0]),
            true => assert!(
                reported[0].contains("VDD is 2690 mV, and FLASH_CR.PSIZE of 32 bits needs 2700"),
                "{reported:?}"
            ),
        }
        let reads: std::collections::BTreeSet<u32> = (1..50)
            .map(|n| {
                machine.run_until(ms(30 * n));
                word(&machine, 0x0804_0000)
            })
            .collect();
        assert_eq!(reads.len() > 1, is_weak, "{mv} mV: {reads:X?}");
    }
}

/// The supply falls while the operation runs (16 µs).
#[test]
fn a_supply_that_falls_meanwhile_counts() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    machine.set_supply(2_800, Span(0));
    // The store comes in the first 10 µs: above 2.7 V; it ends below.
    machine.set_supply(2_600, Span::from_micros(30));
    store(&mut machine, &[&UNLOCK, &PROGRAM_A_WORD]);
    assert_eq!(machine.counters().flash_weak, 1);
    assert_eq!(machine.reports(), [], "it was enough at the start");
}
