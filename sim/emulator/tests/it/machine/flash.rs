//! The flash under a program: stalls, caches, power cuts, keys and option bytes (RM0090 section 3).

use super::*;

const SECTOR_1: usize = 0x4000;

/// Datasheet: 250 ms for 16 KiB at x32. Polling from flash sees BSY set never more than once: the
/// CPU is stalled.
#[test]
fn code_in_flash_stands_still_while_the_flash_is_busy() {
    let mut machine = with_options(&programs::FLASH_FROM_FLASH, Options::default());
    machine.load_bin(0x0800_4000, &[0; 64]).unwrap();
    machine.run_until(ms(260));
    assert_eq!(machine.flash()[SECTOR_1..SECTOR_1 + 5], [0x78, 0x56, 0x34, 0x12, 0xFF]);
    let counters = machine.counters();
    assert_eq!((counters.sectors_erased, counters.units_programmed), (1, 1));
    assert!((1..=2).contains(&word(&machine, OUT)), "polls: {}", word(&machine, OUT));
    assert_eq!(word(&machine, OUT + 8), 0, "no error");
    // During the stall one tick becomes pending; the other 249 are lost.
    assert!((1..=11).contains(&word(&machine, OUT + 4)), "ticks: {}", word(&machine, OUT + 4));
    let stalled = counters.flash_stall_time.0;
    assert!((250 * MS..251 * MS).contains(&stalled), "{stalled}");
    assert!(counters.flash_stalls >= 2);
}

#[test]
fn the_longest_times_can_be_chosen() {
    let options = Options { flash_times: FlashTimes::Worst, ..Options::default() };
    let mut machine = with_options(&programs::FLASH_FROM_FLASH, options);
    machine.run_until(ms(499));
    assert_eq!(machine.counters().sectors_erased, 0);
    machine.run_until(ms(501));
    assert_eq!(machine.counters().sectors_erased, 1);
}

/// 250 ms at 16 MHz are 4 million cycles; a round of the poll takes four.
#[test]
fn code_in_ram_goes_on_and_new_code_in_flash_is_seen() {
    let mut machine = machine_in_ram(&programs::FLASH_FROM_RAM, 0, Options::default());
    machine.load_bin(0x0800_4000, &[0x01, 0x20, 0x70, 0x47]).unwrap(); // movs r0, #1; bx lr
    machine.run_until(ms(300));
    let log = words(&machine, 3);
    assert!((990_000..1_010_000).contains(&log[0]), "polls: {}", log[0]);
    assert_eq!(log[1..], [1, 2], "the old function, then the new one");
    assert_eq!(machine.counters().flash_stalls, 0);
}

/// A round takes four cycles: the loop would execute three million instructions. It ends when the erase does, after
/// some 20 instructions and 250 ms.
#[test]
fn a_loop_that_only_waits_for_the_flash_costs_the_host_nothing() {
    let mut machine = machine_in_ram(&programs::POLLS_THE_FLASH, 0, Options::default());
    machine.write_ram(OUT, &[0; 4]).unwrap();
    machine.run_until(ms(250));
    assert_eq!((word(&machine, OUT), machine.counters().sectors_erased), (0, 0));
    machine.run_until(Time(250 * MS + MS / 200));
    assert_eq!((word(&machine, OUT), machine.counters().sectors_erased), (1, 1));
    let instructions = machine.counters().instructions;
    assert!(instructions < 10_000, "{instructions}");
}

/// A round has 7 instructions, which take 20 cycles of 16 MHz at most.
#[test]
fn a_loop_that_counts_in_the_ram_gets_each_of_its_rounds() {
    let mut machine = machine_in_ram(&programs::COUNTS_THE_POLLS, 0, Options::default());
    machine.write_ram(OUT, &[0; 8]).unwrap();
    machine.run_until(ms(251));
    let [done, rounds] = words(&machine, 2)[..] else { panic!("two words") };
    assert!(done == 1 && rounds > 250 * 16_000 / 20, "{rounds}");
}

#[test]
fn a_load_from_busy_flash_stalls_code_in_ram() {
    let mut machine = machine_in_ram(&programs::FLASH_FROM_RAM, 1, Options::default());
    machine.load_bin(0x0800_4000, &[0x01, 0x20, 0x70, 0x47]).unwrap();
    machine.run_until(ms(300));
    let log = words(&machine, 3);
    assert_eq!(log, [1, 1, 2], "BSY was clear at the first poll");
    assert_eq!(machine.counters().flash_stalls, 1);
}

/// Whether the caches keep lines that have become stale.
fn keeping(stale_lines: bool) -> Options {
    Options { silicon: Silicon { stale_lines, ..TYPICAL }, ..Options::default() }
}

/// RM0090 section 3.6.4, programming and caches: a store writes through the data cache, an erase does not reach
/// it, and DCRST empties it. With the cache off, or on a chip that drops such lines, the array is read.
#[test]
fn a_load_by_the_data_cache_is_stale_after_an_erase_until_the_flush() {
    const OLD: u32 = 0x0BAD_F00D;
    const NEW: u32 = 0x1234_5678;
    const BLANK: u32 = u32::MAX;
    let run = |stale_lines, acr| {
        let options = keeping(stale_lines);
        let mut machine = machine_in_ram(&programs::LOADS_BY_THE_CACHE, acr, options);
        machine.load_bin(0x0800_4000, &OLD.to_le_bytes().repeat(8)).unwrap();
        machine.run_until(ms(300));
        assert_eq!(machine.flash()[SECTOR_1 + 4..SECTOR_1 + 8], [0xFF; 4]);
        words(&machine, 7)
    };
    let true_words = [OLD, BLANK, NEW, BLANK, BLANK, BLANK, BLANK];
    // DCEN; ICEN and PRFTEN.
    assert_eq!(run(true, 1 << 10), [OLD, OLD, NEW, OLD, BLANK, OLD, BLANK]);
    assert_eq!(run(true, 1 << 9 | 1 << 8), true_words);
    assert_eq!(run(false, 1 << 10), true_words);
}

/// RM0090 section 3.6.4, programming and caches: code that ran from flash and is erased and programmed anew stays in
/// the instruction cache until ICRST. A fetch of it is reported on a chip that keeps such lines.
#[test]
fn a_fetch_of_code_that_was_erased_after_it_ran_is_reported_until_the_flush() {
    // ICEN; DCEN and PRFTEN.
    const ICEN: u32 = 1 << 9;
    const OTHERS: u32 = 1 << 10 | 1 << 8;
    let run = |stale_lines, acr, flushes| {
        let options = keeping(stale_lines);
        let mut machine = machine_in_ram(&programs::RUNS_BY_THE_CACHE, acr, options);
        put(&mut machine, ARGUMENT + 4, flushes);
        // movs r0, #1; bx lr
        machine.load_bin(0x0800_4000, &[0x01, 0x20, 0x70, 0x47]).unwrap();
        machine.run_until(ms(300));
        assert_eq!(words(&machine, 2), [1, 2], "the emulator runs the new code");
        machine.reports().to_vec()
    };
    let [report] = &run(true, ICEN, 0)[..] else { panic!("one report") };
    assert_eq!((report.access, report.address, report.pc), (Access::Fetch, 0x0800_4000, 0x0800_4000));
    assert!(report.what.contains("ICRST"), "{}", report.what);
    assert_eq!(run(true, ICEN, 1), []);
    assert_eq!(run(true, OTHERS, 0), []);
    assert_eq!(run(false, ICEN, 0), []);
}

#[test]
fn the_power_can_be_cut_at_a_flash_operation() {
    for (when, erased) in [(Cut::Before, false), (Cut::After, true)] {
        let mut machine = machine_in_ram(&programs::FLASH_FROM_RAM, 0, Options::default());
        machine.load_bin(0x0800_4000, &[0x01, 0x20, 0x70, 0x47]).unwrap();
        machine.cut_power_at(Some(FlashCut { operation: 0, when }));
        assert_eq!(machine.run_until(ms(300)), Stop::PowerCut);
        assert!(!machine.is_powered());
        assert_eq!(machine.flash()[SECTOR_1] == 0xFF, erased);
    }
    let torn = |seed| {
        let mut machine = machine_in_ram(&programs::FLASH_FROM_RAM, 0, Options::default());
        machine.load_bin(0x0800_4000, &[0x01, 0x20, 0x70, 0x47].repeat(100)).unwrap();
        machine.cut_power_at(Some(FlashCut { operation: 1, when: Cut::Torn { seed } }));
        assert_eq!(machine.run_until(ms(300)), Stop::PowerCut);
        machine.flash()[SECTOR_1..SECTOR_1 + 8].to_vec()
    };
    let first = torn(1);
    assert_eq!(first, torn(1));
    assert_ne!(first, torn(2));
    assert_eq!(first[4..], [0xFF; 4], "the second operation programs one word");
    let whole = [0x02, 0x20, 0x70, 0x47];
    assert!(first.iter().zip(whole).all(|(found, wanted)| found & wanted == wanted), "bits only go to 0");
}

#[test]
fn losing_the_power_tears_the_operation_that_runs() {
    let mut machine = machine_in_ram(&programs::FLASH_FROM_RAM, 0, Options::default());
    machine.load_bin(0x0800_4000, &[0x01, 0x20, 0x70, 0x47].repeat(1000)).unwrap();
    let before = machine.flash().to_vec();
    machine.run_until(ms(100));
    machine.power_off();
    let sector = &machine.flash()[SECTOR_1..SECTOR_1 + 4000];
    assert!(sector != &before[SECTOR_1..SECTOR_1 + 4000] && sector.iter().any(|&byte| byte != 0xFF));
    assert!(machine.flash()[..SECTOR_1] == before[..SECTOR_1], "its neighbour is whole");
}

/// With table and handlers in RAM the ticks go on during the erase; with the table in flash the
/// first one waits for the vector. 250 ms hold 249 ticks and the end of the erase may come just
/// before or after the next.
#[test]
fn interrupts_during_an_erase_need_their_vectors_in_ram() {
    let run = |table: u32| {
        let mut machine = machine_in_ram(&programs::ERASE_UNDER_INTERRUPTS, table, Options::default());
        // Vectors of the listing: tick at 048h, done at 050h.
        machine.load_bin(0x0800_0000 + 4 * 15, &0x2000_1049_u32.to_le_bytes()).unwrap();
        machine.load_bin(0x0800_0000 + 4 * 20, &0x2000_1051_u32.to_le_bytes()).unwrap();
        machine.run_until(ms(255));
        (words(&machine, 3), machine.counters())
    };
    let (log, counters) = run(0x2000_0400);
    assert!((249..=250).contains(&log[1]), "ticks: {}", log[1]);
    assert_eq!(log[2], 1, "EOP");
    assert_eq!(counters.exceptions[16 + 4], 1);
    assert_eq!(counters.flash_stalls, 0);
    let (log, counters) = run(0x0800_0000);
    assert!(log[1] <= 1, "ticks: {}", log[1]);
    assert_eq!(log[2], 1);
    assert!(counters.flash_stalls >= 1);
}

const KEYR: u32 = 0x4002_3C04;
const OPTKEYR: u32 = 0x4002_3C08;
pub(super) const UNLOCK: [(u32, u32); 2] = [(KEYR, 0x4567_0123), (KEYR, 0xCDEF_89AB)];
const UNLOCK_OPTIONS: [(u32, u32); 2] = [(OPTKEYR, 0x0819_2A3B), (OPTKEYR, 0x4C5D_6E7F)];
/// Wrong keys for both.
const LOCK: [(u32, u32); 2] = [(KEYR, 0), (OPTKEYR, 0)];
const LOCKED: [u32; 2] = [0x8000_0000, 0x0FFF_AAED];
const OPEN: [u32; 2] = [0, 0x0FFF_AAEC];
const CPSID_F: (u32, u32) = (1, 1);
const CPSIE_F: (u32, u32) = (1, 0);
/// ACTLR.DISDEFWBUF.
const NO_WRITE_BUFFER: (u32, u32) = (0xE000_E008, 1 << 1);
/// CCR.BFHFNMIGN, beside STKALIGN.
const IGNORE_BUS_FAULTS: (u32, u32) = (0xE000_ED14, 1 << 8 | 1 << 9);
/// SHCSR.BUSFAULTENA.
const ENABLE_BUS_FAULT: (u32, u32) = (0xE000_ED24, 1 << 17);

/// The result of a script of stores.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Stored {
    faults: u32,
    /// FLASH_CR, FLASH_OPTCR.
    locks: [u32; 2],
    cfsr: u32,
    hfsr: u32,
    bfar: u32,
}

fn write_script(machine: &mut Machine, script: &[(u32, u32)]) {
    for (n, (address, value)) in (0..).zip(script.iter().chain(&[(0, 0)])) {
        put(machine, ARGUMENT + 8 * n, *address);
        put(machine, ARGUMENT + 8 * n + 4, *value);
    }
}

/// Runs a script of stores on a machine that has come out of a reset.
pub(super) fn store(machine: &mut Machine, script: &[&[(u32, u32)]]) -> Stored {
    write_script(machine, &script.concat());
    let until = Time(machine.now().0 + MS);
    assert_eq!(machine.run_until(until), Stop::Deadline);
    let log = words(machine, 6);
    Stored { faults: log[0], locks: [log[1], log[2]], cfsr: log[3], hfsr: log[4], bfar: log[5] }
}

#[test]
fn the_right_keys_open_flash_and_option_bytes() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    let stored = store(&mut machine, &[&UNLOCK, &UNLOCK_OPTIONS]);
    assert_eq!(stored, Stored { faults: 0, locks: OPEN, cfsr: 0, hfsr: 0, bfar: 0 });
    assert_eq!(machine.reports(), []);
}

/// RM0090 sections 3.6.1 and 3.7.2: after a wrong key each key, right or wrong, is a bus error.
#[test]
fn after_a_wrong_key_the_right_ones_are_bus_errors_until_the_next_reset() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    let stored = store(&mut machine, &[&LOCK, &UNLOCK, &UNLOCK_OPTIONS]);
    assert_eq!(stored, Stored { faults: 6, locks: LOCKED, cfsr: 0x400, hfsr: FORCED, bfar: 0 });
    assert_eq!(word(&machine, OUT + 24), 3, "HardFault");
    assert!(machine.reports()[0].what.contains("FLASH_KEYR"));
    machine.reset_pin();
    let stored = store(&mut machine, &[&UNLOCK, &UNLOCK_OPTIONS]);
    assert_eq!((stored.faults, stored.locks), (0, OPEN));
}

/// A wrong key for one register does not affect the other one.
#[test]
fn each_key_register_has_a_lock_of_its_own() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    let stored = store(&mut machine, &[&LOCK[..1], &UNLOCK_OPTIONS]);
    assert_eq!((stored.faults, stored.locks), (1, [LOCKED[0], OPEN[1]]));
    machine.reset_pin();
    let stored = store(&mut machine, &[&LOCK[1..], &UNLOCK]);
    assert_eq!((stored.faults, stored.locks), (1, [OPEN[0], LOCKED[1]]));
}

#[test]
fn a_bus_error_is_a_bus_fault_where_that_is_enabled() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    let stored = store(&mut machine, &[&[ENABLE_BUS_FAULT], &LOCK]);
    assert_eq!(stored, Stored { faults: 2, locks: LOCKED, cfsr: 0x400, hfsr: 0, bfar: 0 });
    assert_eq!(word(&machine, OUT + 24), 5, "BusFault");
}

/// PM0214 section 4.4.10, IMPRECISERR: the fault becomes pending, and active only when the priority
/// lets it.
#[test]
fn an_imprecise_fault_waits_for_faultmask_to_end() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    for ignore in [&[][..], &[IGNORE_BUS_FAULTS]] {
        let stored = store(&mut machine, &[ignore, &[CPSID_F], &LOCK]);
        assert_eq!((stored.faults, stored.locks, stored.cfsr), (0, LOCKED, 0x400));
        machine.reset_pin();
        let stored = store(&mut machine, &[ignore, &[CPSID_F], &LOCK, &[CPSIE_F]]);
        assert_eq!((stored.faults, stored.locks, stored.hfsr), (1, LOCKED, FORCED));
        machine.reset_pin();
    }
}

/// ACTLR.DISDEFWBUF makes bus faults of stores precise (PM0214 section 4.4.1).
#[test]
fn without_the_write_buffer_the_fault_names_its_store() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    let stored = store(&mut machine, &[&[NO_WRITE_BUFFER], &LOCK[..1]]);
    assert_eq!(stored.faults, 1);
    assert_eq!((stored.cfsr, stored.hfsr, stored.bfar), (0x8200, FORCED, KEYR));
    assert_eq!(word(&machine, OUT + 28), 0x0800_0216, "str r0, [r1]");
    assert_eq!(stored.locks, [LOCKED[0], 0x0FFF_AAED]);
}

/// PM0214 section 4.4.7, BFHFNMIGN: code at priority -1 goes on after the store. The status
/// registers show the fault.
#[test]
fn a_precise_fault_is_ignored_under_faultmask_if_the_program_says_so() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    let quiet = [NO_WRITE_BUFFER, IGNORE_BUS_FAULTS, CPSID_F];
    let stored = store(&mut machine, &[&quiet, &LOCK, &[CPSIE_F]]);
    assert_eq!(stored, Stored { faults: 0, locks: LOCKED, cfsr: 0x8200, hfsr: 0, bfar: OPTKEYR });
    assert_eq!(machine.reports(), [], "the program asked to have it ignored");
    machine.reset_pin();
    let stored = store(&mut machine, &[&quiet, &LOCK, &[CPSIE_F], &UNLOCK]);
    assert_eq!((stored.faults, stored.locks), (2, LOCKED), "each key that is written later is a fault");
    machine.reset_pin();
    let without_mask = [NO_WRITE_BUFFER, IGNORE_BUS_FAULTS];
    let stored = store(&mut machine, &[&without_mask, &LOCK]);
    assert_eq!(stored.faults, 2, "the bit is for priorities below 0 alone");
}

#[test]
fn a_precise_fault_under_faultmask_locks_up_otherwise() {
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    write_script(&mut machine, &[NO_WRITE_BUFFER, CPSID_F, LOCK[0]]);
    assert_eq!(machine.run_until(ms(1)), Stop::Lockup);
}

/// RM0090 section 3.7.2: programmed option bytes are loaded at the next reset; these protect
/// sectors 0 and 1.
#[test]
fn a_program_protects_sectors_by_its_option_bytes() {
    const OPTCR: u32 = 0x4002_3C14;
    let mut machine = machine(&programs::STORES_OF_A_SCRIPT);
    store(&mut machine, &[&UNLOCK_OPTIONS, &[(OPTCR, 0x0FFC_AAEC), (OPTCR, 0x0FFC_AAEE)]]);
    machine.run_until(ms(1_000));
    machine.power_off();
    machine.power_on(ms(2_000));
    let stored = store(&mut machine, &[]);
    assert_eq!(stored.locks[1], 0x0FFC_AAED);
    let mut bytes = [0; 4];
    machine.read_memory(0x1FFF_C008, &mut bytes).unwrap();
    assert_eq!(bytes, [0xFC, 0x0F, 0x03, 0xF0], "nWRP and its complement");
}
