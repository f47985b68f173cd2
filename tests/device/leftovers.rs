//! What an application leaves switched wrong before it jumps into the bootloader, and what outlives a reset:
//! the bootloader works.

use std::iter;

use canopen::program::ProgramControl;
use coboot_tests::bench::{Bench, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coflash_core::device::Doing;
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use emulator::bus::{Outcome, Record};
use emulator::machine::{self, ResetCause, Stop};
use emulator::silicon::{Silicon, TYPICAL};
use emulator::time::Span;
use shared_abi::geometry::Region;

/// A program that stores the values of a table, ends in a state by the bits of the last one, and jumps.
const SCRIPT: [u16; 40] = [
    0xB672, 0xA013, // cpsid i; adr r0, table
    0xC806, 0xB109, 0x600A, 0xE7FB, // ldmia r0!, {r1, r2}; cbz r1, end; str r2, [r1]; next
    0xF04F, 0x6400, 0x6825, 0x6866, // end: mov r4, #0x08000000; ldr r5, [r4]; ldr r6, [r4, #4]
    0x07D3, 0xD400, 0xB662, // without bit 0: cpsie i
    0x0793, 0xD500, 0xB671, // bit 1: cpsid f
    0x0753, 0xD501, 0xEE00, 0x4A10, // bit 2: vmov s0, r4
    0x0713, 0xD500, 0xDF00, // bit 3: svc #0, whose vector is the next instruction
    0x06D3, 0xD502, 0x2310, 0xF383, 0x8811, // bit 4: msr BASEPRI, #10h
    0x0693, 0xD506, 0xF385, 0x8809, 0x2302, 0xF383, 0x8814, // bit 5: msr PSP, r5; msr CONTROL, #2
    0xF3BF, 0x8F6F, // isb
    0xF385, 0x8808, 0x4730, // msr MSP, r5; bx r6; the table follows
];
/// Where the vectors of HardFault and SVC lead (ARMv7-M B1.5.2: exceptions 3 and 11), from the first
/// instruction on.
const END: u32 = 0x0C;
const AFTER_SVC: u32 = 0x2E;
const INTERRUPTS_OFF: u32 = 1 << 0;
const FAULTS_MASKED: u32 = 1 << 1;
const FPU_USED: u32 = 1 << 2;
const FROM_A_HANDLER: u32 = 1 << 3;
const PRIORITIES_MASKED: u32 = 1 << 4;
const PROCESS_STACK: u32 = 1 << 5;

/// What a program leaves wrong.
struct Wrong {
    what: &'static str,
    /// Stores, in order.
    stores: &'static [(u32, u32)],
    /// The state of the core.
    core: u32,
}

const RCC: u32 = 0x4002_3800;
const APB1ENR: u32 = RCC + 0x40;
const CAN1: u32 = 0x4000_6400;
/// PWR, CAN1, WWDG, TIM2.
const APB1_CLOCKS: u32 = 1 << 28 | 1 << 25 | 1 << 11 | 1 << 0;

const fn wrong(what: &'static str, stores: &'static [(u32, u32)], core: u32) -> Wrong {
    Wrong { what, stores, core }
}

/// Registers by RM0090, and by ARMv7-M those of the core.
#[rustfmt::skip]
const WRONG: [Wrong; 21] = [
    wrong("PRIMASK and FAULTMASK set", &[], INTERRUPTS_OFF | FAULTS_MASKED),
    wrong("BASEPRI set", &[], PRIORITIES_MASKED),
    wrong("on the process stack", &[], PROCESS_STACK),
    wrong("FPU in use", &[(0xE000_ED88, 0x00F0_0000)], FPU_USED),
    wrong("in a handler", &[], FROM_A_HANDLER),
    wrong("every interrupt enabled, some pending, TIM2 and SysTick run", &[
        (APB1ENR, APB1_CLOCKS),
        (0x4000_002C, 60_000), // TIM2: ARR, DIER, CR1
        (0x4000_000C, 1),
        (0x4000_0000, 1),
        (0xE000_E014, 60_000), // SYST_RVR, SYST_CSR
        (0xE000_E010, 7),
        (0xE000_E100, u32::MAX), // ISER0 to 2, ISPR0
        (0xE000_E104, u32::MAX),
        (0xE000_E108, u32::MAX),
        (0xE000_E200, u32::MAX),
    ], INTERRUPTS_OFF),
    wrong("VTOR in RAM, unaligned accesses and divisions by 0 fault", &[
        (0xE000_ED08, 0x2000_0000), (0xE000_ED14, 0x218),
    ], 0),
    wrong("SLEEPDEEP and SLEEPONEXIT, and Standby chosen", &[
        (APB1ENR, APB1_CLOCKS), (0x4000_7000, 0xC006), (0xE000_ED10, 6),
    ], 0),
    wrong("in sleep no peripheral has a clock, the PLL's is spread by 3 %, SysTick has a large count", &[
        (RCC + 0x50, 0), // The LPENRs
        (RCC + 0x54, 0),
        (RCC + 0x58, 0),
        (RCC + 0x60, 0),
        (RCC + 0x64, 0),
        (RCC + 0x80, 0xC010_60FA), // SSCGR (RM0090 section 7.3.23)
        (0xE000_E014, 0x00FF_FFFF),
        (0xE000_E018, 0),
        (0xE000_E010, 5),
    ], 0),
    // After an interrupt the core would sleep again, and no work on the flash would be done (B1.5.17).
    wrong("SLEEPONEXIT alone", &[(SCR, 2)], 0),
    // Each sleep would be Stop, which no interrupt of a peripheral ends (RM0090 section 5.3.5).
    wrong("SLEEPDEEP alone", &[(SCR, 4)], 0),
    wrong("PendSV pending, its priority and that of SysTick the lowest, no groups of priorities", &[
        (0xE000_ED20, 0xF0F0_0000), (0xE000_ED04, 1 << 28), (0xE000_ED0C, 0x05FA_0700),
    ], INTERRUPTS_OFF),
    wrong("patches, breakpoints, watchpoints and vector catches", &DEBUG_UNITS, 0),
    wrong("flash open for programming by bytes, its caches off", &[
        (0x4002_3C04, 0x4567_0123), // KEYR, CR, ACR
        (0x4002_3C04, 0xCDEF_89AB),
        (0x4002_3C10, 1),
        (0x4002_3C00, 7),
    ], 0),
    // A bus error: the program jumps from the handler of the fault.
    wrong("option bytes shut by a wrong key", &[(0x4002_3C08, 0)], 0),
    wrong("voltage detector at 2.9 V with its interrupt", &[
        (APB1ENR, APB1_CLOCKS),
        (0x4000_7000, 0xC0F0),  // PWR_CR: PVDE, PLS 7
        (0x4001_3C00, 1 << 16), // EXTI: IMR, RTSR, FTSR, SWIER
        (0x4001_3C08, 1 << 16),
        (0x4001_3C0C, 1 << 16),
        (0x4001_3C10, 1 << 16),
    ], 0),
    wrong("independent watchdog", &[(0x4000_3000, 0xCCCC)], 0),
    wrong("window watchdog", &[(APB1ENR, APB1_CLOCKS), (0x4000_2C00, 0xFF)], 0),
    wrong("CAN in loop-back and silent mode with a frame to send and its interrupts", &[
        (APB1ENR, APB1_CLOCKS),
        (CAN1, 1), // MCR, BTR, MCR, IER, TI0R
        (CAN1 + 0x1C, 0xC123_0001),
        (CAN1, 0),
        (CAN1 + 0x14, 0x0003_8F7F),
        (CAN1 + 0x180, 1),
    ], 0),
    wrong("slow buses, the oscillator in place of the PLL, and no crystal", &[
        (0x4002_3808, 0xFCA0), (0x4002_3800, 0x83),
    ], 0),
    wrong("peripherals held in reset, and without clocks", &[
        (0x4002_3810, 0x0000_11FF), // RSTRs
        (0x4002_3820, 0x36FE_C9FF),
        (0x4002_3824, 0x0007_5933),
        (0x4002_3830, 0), // ENRs
        (APB1ENR, 0),
        (0x4002_3844, 0),
    ], 0),
];

const SCR: u32 = 0xE000_ED10;
const FP_CTRL: u32 = 0xE000_2000;
const FP_COMP0: u32 = 0xE000_2008;
const DWT_CTRL: u32 = 0xE000_1000;
const DEMCR: u32 = 0xE000_EDFC;

/// The debug units switched on, by DDI 0403E sections C1.6, C1.8 and C1.11. No instruction of Reset follows
/// its vector at 100h or 200h: the addresses do no harm by themselves.
const DEBUG_UNITS: [(u32, u32); 18] = [
    (DEMCR, 0x0100_07F1), // TRCENA, each vector catch
    (DWT_CTRL, 1),
    (0xE000_1020, 0x0800_0000), // COMP0: a read of the first word
    (0xE000_1028, 5),
    (0xE000_1038, 6),
    (0xE000_1048, 7),
    (0xE000_1058, 4),
    (0x2001_0000, 0xE7FE_E7FE), // the new words: a jump to itself
    (0x2001_0018, 0xE7FE_E7FE),
    (0xE000_2004, 0x2001_0000),       // FP_REMAP
    (FP_COMP0, 0x0800_0100 | 1),      // a patch
    (FP_COMP0 + 4, 0xC800_0201),      // breakpoints
    (FP_COMP0 + 8, 0x4800_0205),      //
    (FP_COMP0 + 12, 0x8800_0209),     //
    (FP_COMP0 + 20, 0xC800_020D),     //
    (FP_COMP0 + 24, 0x0800_0104 | 1), // a patch of a literal
    (FP_COMP0 + 28, 0x0800_0108 | 1),
    (FP_CTRL, 3),
];

fn poke(bench: &mut Bench, stores: &[(u32, u32)]) {
    for (register, value) in stores {
        bench.machine().poke(*register, &value.to_le_bytes()).unwrap();
    }
}

/// The registers of the core that have no value of the running bootloader, as after a power-on.
fn residues(bench: &mut Bench) -> Vec<String> {
    let comparators = (0..8).map(|n| FP_COMP0 + 4 * n).chain((0..4).map(|n| DWT_CTRL + 0x28 + 0x10 * n));
    let zero = comparators.chain([DEMCR, SCR, 0xE000_ED94]).map(|register| (register, 0));
    // FP_CTRL has the numbers of the comparators, DWT_CTRL that of its own, CCR has STKALIGN.
    let others = [(FP_CTRL, 0x260), (DWT_CTRL, 0x4000_0000), (0xE000_ED14, 0x200)];
    let all = zero
        .chain(others)
        .map(|(register, expected)| (register, expected, bench.machine().register(register)));
    let wrong = all.filter(|(_, expected, found)| *found != Some(*expected));
    wrong.map(|(register, _, found)| format!("{register:08X}h = {:08X}h", found.unwrap())).collect()
}

/// The sealed bootloader, which only the split map has room for.
fn sealed() -> Option<&'static str> {
    firmware::board().home.map(|_| firmware::BOOTLOADER_SEALED)
}

/// The patch unit, the watchpoints and the vector catches outlive each reset but a power reset (Cortex-M4
/// technical reference manual, resets): a program that was taken over could patch the bootloader, and a
/// forgotten breakpoint would end the trial of a good one.
#[test]
fn no_reset_leaves_a_patch_or_a_breakpoint() {
    for image in iter::once(firmware::BOOTLOADER).chain(sealed()) {
        let mut bench = Bench::of_image(image).switched_on();
        // After the first instructions, which no program can guard, Reset goes straight on for some time.
        let code = (bench.word(firmware::board().bootloader.base + 4) & !1) + 0x40;
        let program = firmware::raw(firmware::APP_V1);
        let program = u32::from_le_bytes(program[4..8].try_into().unwrap()) & !1;
        let in_reset = [(FP_COMP0, code | 1), (FP_COMP0 + 4, program | 0xC000_0001)];
        for way in [ResetCause::Pin, ResetCause::Software, ResetCause::WindowWatchdog] {
            poke(&mut bench, &DEBUG_UNITS);
            poke(&mut bench, &in_reset);
            assert_eq!(residues(&mut bench).len(), 14, "{way:?}: all is on");
            bench.events();
            match way {
                ResetCause::Pin => bench.machine().reset_pin(),
                ResetCause::Software => bench.post(0, &[0x81, NODE]),
                // A counter below 40h (RM0090 section 22.3).
                _ => poke(&mut bench, &[(APB1ENR, APB1_CLOCKS), (0x4000_2C00, 0x80)]),
            }
            bench.await_boot_up(1_000);
            let was_so = bench.events().iter().any(|(_, stop)| *stop == Stop::Reset(way));
            assert!(was_so || way == ResetCause::Pin, "{way:?}");
            assert_eq!(residues(&mut bench), [""; 0], "{image}, {way:?}");
        }
        // A program whose first instruction had a breakpoint passes its trial.
        let program = firmware::blocks(firmware::APP_V1);
        flash(&mut bench.session(), &program, &FlashOptions::default(), &mut |_| {}).unwrap();
        assert!(!bench.is_bootloader(NODE));
    }
}

/// A developer's breakpoints stay over a reset, as long as the probe is there: it alone can set C_DEBUGEN (DDI
/// 0403E C1.6.2). A sealed device makes no exception.
#[test]
fn an_open_device_leaves_a_probe_its_breakpoints() {
    let sealed = sealed().map(|image| (image, false));
    for (image, stays) in iter::once((firmware::BOOTLOADER, true)).chain(sealed) {
        let mut bench = Bench::of_image(image).switched_on();
        assert!(bench.machine().attach_debugger());
        poke(&mut bench, &[(FP_COMP0, 0xC802_0001), (FP_CTRL, 3)]);
        bench.machine().resume(false);
        bench.machine().reset_pin();
        bench.await_boot_up(100);
        let found = [FP_CTRL, FP_COMP0].map(|register| bench.machine().register(register).unwrap());
        assert_eq!(found, if stays { [0x261, 0xC802_0001] } else { [0x260, 0] }, "{image}");
    }
}

/// Writes the kept RAM (`Layout::kept`) as an application does before a reset.
fn fill_kept(bench: &mut Bench) -> Vec<u8> {
    let kept = firmware::board().kept();
    let written: Vec<u8> = (0..kept.size).map(|n| (n * 7 + 5) as u8).collect();
    bench.machine().write_ram(kept.base, &written).unwrap();
    written
}

/// Runs up to the first instruction in this region, for two seconds at most.
fn run_into(bench: &mut Bench, region: Region, what: &str) {
    let end = bench.time() + Span::from_millis(2_000);
    while !region.contains(bench.machine().pc(), 2) {
        let next = bench.time() + Span::from_nanos(100);
        assert!(next < end, "{what}: the core is at {:08X}h", bench.machine().pc());
        bench.world.run_until(next);
    }
}

/// A crash log or a dump of a panic is there after each reset but that of the power, and after the
/// bootloader has run and written a program (docs/application.md). The program uses it as its stack
/// here, so it is compared before its first instruction.
#[test]
fn the_end_of_the_ram_outlives_the_bootloader() {
    let board = firmware::board();
    let (kept, program) = (board.kept(), board.programs[0]);
    assert_eq!(kept.size, 1024);
    for image in iter::once(firmware::BOOTLOADER).chain(sealed()) {
        let mut bench = Bench::of_image(image).switched_on();
        // Reset of the boot stage takes some microseconds there.
        let stage = Region::new(bench.word(board.bootloader.base + 4) & !1, 0x60);
        let written = fill_kept(&mut bench);
        let lost = |bench: &Bench| {
            let found = bench.memory(kept.base, written.len());
            (0..found.len()).find(|at| found[*at] != written[*at])
        };
        let blocks = firmware::blocks(firmware::APP_V1);
        let options = FlashOptions::default().trial_run(false).start(false);
        flash(&mut bench.session(), &blocks, &options, &mut |_| {}).unwrap();
        bench.session().command(1, ProgramControl::SetSignature).unwrap();
        assert_eq!(lost(&bench), None, "{image}: after an update");
        // No session: the bootloader may answer after the reset.
        let command = |bench: &mut Bench, command: u8| {
            bench.post(REQUEST, &[0x2F, 0x51, 0x1F, 1, command, 0, 0, 0]);
        };
        for way in ["START", "NRST", "NMT reset node", "window watchdog"] {
            match way {
                "START" => command(&mut bench, 1),
                "NRST" => bench.machine().reset_pin(),
                "NMT reset node" => bench.post(0, &[0x81, NODE]),
                // A counter below 40h (RM0090 section 22.3).
                _ => poke(&mut bench, &[(APB1ENR, APB1_CLOCKS), (0x4000_2C00, 0x80)]),
            }
            run_into(&mut bench, stage, way);
            fill_kept(&mut bench);
            run_into(&mut bench, program, way);
            assert_eq!(lost(&bench), None, "{image}: after {way}");
            bench.await_program(1_000);
            if way == "START" {
                bench.confirm_program();
            }
        }
        for (way, value) in [("call back", 0x80), ("STOP", 0)] {
            command(&mut bench, value);
            run_into(&mut bench, stage, way);
            fill_kept(&mut bench);
            bench.run_ms(100);
            assert_eq!((bench.is_bootloader(NODE), lost(&bench)), (true, None), "{image}: after {way}");
            bench.start_program();
        }
        fill_kept(&mut bench);
        bench.power_off();
        bench.power_on();
        run_into(&mut bench, program, "the power");
        assert!(lost(&bench).is_some(), "{image}: the power");
    }
}

/// A program with this reset handler; its other bytes are 0.
fn scripted_program(wrong: &Wrong) -> Program {
    let table = wrong.stores.iter().copied().chain([(0, wrong.core)]);
    let table = table.flat_map(|(address, value)| [address, value]);
    let table = table.flat_map(|word| [word as u16, (word >> 16) as u16]);
    let base = firmware::board().programs[0].base;
    let mut image = vec![0; 0x200];
    for (vector, value) in [
        (0, firmware::board().ram.end()),
        (1, base + 0x201),
        (3, base + 0x201 + END),
        (11, base + 0x201 + AFTER_SVC),
    ] {
        image[4 * vector..][..4].copy_from_slice(&value.to_le_bytes());
    }
    image.extend(SCRIPT.into_iter().chain(table).flat_map(u16::to_le_bytes));
    image.resize(0x400.max(image.len()), 0);
    firmware::blocks_of_raw(&image)
}

/// A bootloader that has this program, with the silicon of caches that become stale.
fn board_with(wrong: &Wrong) -> Bench {
    let silicon = Silicon { stale_lines: true, ..TYPICAL };
    let mut bench = Bench::with(machine::Options { silicon, ..machine::Options::default() }).switched_on();
    let options = FlashOptions::default().start(false);
    flash(&mut bench.session(), scripted_program(wrong), &options, &mut |_| {}).unwrap();
    bench.run_ms(100);
    bench.events();
    bench
}

/// Every request is answered in time: a controller that stands still while the core sleeps would not
/// hear most of them, and would be wrong by more than a bus tolerates.
fn assert_alive(bench: &mut Bench, what: &str) {
    bench.take_records();
    for _ in 0..100 {
        let from = bench.time();
        // 1000h, device type.
        let answer = bench.ask(REQUEST, &[0x40, 0, 0x10, 0, 0, 0, 0, 0], RESPONSE);
        assert!(answer.is_some_and(|answer| answer[0] == 0x43), "{what}");
        assert!(bench.time() - from < Span::from_millis(5), "{what}");
        bench.run_ms(3);
    }
    assert!(bench.is_bootloader(NODE), "{what}");
    let is_good = |record: &Record| record.outcome == Outcome::Good;
    assert!(bench.records().iter().all(is_good), "{what}: error frames");
}

/// Each alone: the device is reachable within the time of its watchdogs, and its flash works.
#[test]
fn whatever_a_program_leaves_wrong_the_device_is_reachable() {
    let mut lost = Vec::new();
    for wrong in &WRONG {
        let mut bench = board_with(wrong);
        bench.session().command(1, ProgramControl::Start).unwrap();
        // A second of the watchdog at 32 kHz, and a rescue window.
        bench.run_ms(2_000);
        let stops = bench.stops();
        let stops = &stops[..stops.len().min(4)];
        println!("{}: {stops:?}", wrong.what);
        let answer = bench.ask(REQUEST, &[0x40, 0, 0x10, 0, 0, 0, 0, 0], RESPONSE);
        if answer.is_none_or(|answer| answer[0] != 0x43) {
            let machine = bench.machine();
            lost.push(format!("{}: {stops:?}, pc {:08X}h", wrong.what, machine.pc()));
            continue;
        }
        assert_alive(&mut bench, wrong.what);
        let residues = residues(&mut bench);
        let is_slow = stops.contains(&Stop::Reset(ResetCause::IndependentWatchdog));
        if !residues.is_empty() || is_slow && !wrong.what.contains("watchdog") {
            lost.push(format!("{}: {stops:?}, {residues:?}", wrong.what));
        }
        // It can erase.
        bench.session().command(1, ProgramControl::Clear).unwrap();
        bench.session().await_idle(1, Doing::Block(0)).unwrap();
    }
    assert!(lost.is_empty(), "not reachable, or not clean, after: {lost:#?}");
}

/// A program that jumps with the caches of the flash on or held in reset, into a bootloader that erases and
/// programs: an erase leaves what they have (RM0090 section 3.6.4).
#[test]
fn a_program_that_leaves_the_caches_of_the_flash_on_does_no_harm() {
    const ACR: u32 = 0x4002_3C00;
    // DCRST, ICRST, DCEN, ICEN, PRFTEN.
    const CACHES: u32 = 0x1F00;
    const LEFT: [Wrong; 2] = [
        Wrong { what: "caches on", stores: &[(ACR, 0x700)], core: 0 },
        Wrong { what: "caches in reset", stores: &[(ACR, 0x1800)], core: 0 },
    ];
    for wrong in &LEFT {
        plays_the_main_job_after(wrong, ACR, CACHES);
    }
}

/// The main job after a jump of this program; none of these bits of a register may be left set by it.
fn plays_the_main_job_after(wrong: &Wrong, register: u32, bits: u32) {
    let mut bench = board_with(wrong);
    bench.fill_journal(0);
    bench.start_program();
    bench.run_ms(500);
    let left_on = bench.machine().register(register).unwrap() & bits;
    bench.install(firmware::APP_V1);
    assert!(!bench.is_bootloader(NODE));
    bench.power_cycle();
    bench.await_program(1_000);
    assert!(!bench.is_bootloader(NODE));
    assert_eq!(left_on, 0, "{}: the bootloader needs none", wrong.what);
}
