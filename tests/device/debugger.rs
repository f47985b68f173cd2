//! The debugger interface, 1025h, of the built images: memory access over the bus in bootloader and
//! application, and breakpoints while the bus continues.

use std::time::Duration;

use canopen::debugger::Stop as DebugStop;
use canopen::Address;
use coboot_tests::bench::{abort_code, Bench, HEARTBEAT, NODE};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::{firmware, script, tools};
use coflash_core::device::debugger::{Debugger, NoBreakpoint, Stopped};
use coflash_core::device::Doing;
use emulator::machine::{ResetCause, Stop};
use emulator::time::Time;

const COMMAND: Address = Address::new(0x1025, 1);
const STATUS: Address = Address::new(0x1025, 2);
const DATA: Address = Address::new(0x1025, 4);

// The core's registers (DDI 0403E section C1).
const FP_CTRL: u32 = 0xE000_2000;
const FP_COMP0: u32 = 0xE000_2008;
const DCRDR: u32 = 0xE000_EDF8;
const DEMCR: u32 = 0xE000_EDFC;
/// `TRCENA`, `MON_EN`; with `MON_STEP`; with `MON_PEND`.
const GO_ON: u32 = 0x0101_0000;
const STEP: u32 = 0x0105_0000;
const STOP: u32 = 0x0103_0000;
/// `MON_REQ`: the program is stopped.
const STOPPED: u32 = 0x0008_0000;

const INVALID_VALUE: Option<u32> = Some(0x0609_0030);
const DEVICE_STATE: Option<u32> = Some(0x0800_0022);

/// A board with a bootloader that has the interface.
fn bootloader() -> Bench {
    let mut bench = Bench::of_image(firmware::BOOTLOADER_DEBUGGER).switched_on();
    // The emergency after the boot-up message.
    bench.run_ms(10);
    bench
}

/// A board with an application that has the interface, and a standard bootloader.
fn application() -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.install(firmware::APP_DEBUGGER);
    bench.confirm_program();
    bench.events();
    bench
}

fn symbol(name: &str) -> u32 {
    firmware::symbol(firmware::APP_DEBUGGER, |of| of == name)
}

/// Sends a command; returns the abort code.
fn command(bench: &mut Bench, kind: u8, address: u32, len: u16) -> Option<u32> {
    let [low, high] = len.to_le_bytes();
    let [a, b, c, d] = address.to_le_bytes();
    let bytes = [kind, 0, low, high, a, b, c, d];
    abort_code(bench.session().write(COMMAND, &bytes, Doing::Write(COMMAND), &mut |_| {}))
}

fn read(bench: &mut Bench, address: u32, len: u16) -> Vec<u8> {
    assert_eq!(command(bench, 0, address, len), None, "{address:08X}");
    bench.session().upload(DATA, &mut |_| {}).unwrap()
}

fn write(bench: &mut Bench, address: u32, data: &[u8]) {
    assert_eq!(command(bench, 1, address, data.len() as u16), None, "{address:08X}");
    bench.session().write(DATA, data, Doing::Write(DATA), &mut |_| {}).unwrap();
}

fn read_word(bench: &mut Bench, address: u32) -> u32 {
    u32::from_le_bytes(read(bench, address, 4).try_into().unwrap())
}

fn write_word(bench: &mut Bench, address: u32, value: u32) {
    write(bench, address, &value.to_le_bytes());
}

/// 6200h, no error in the error register, the type, the address (the table of the five bytes in the
/// document).
fn stop_of_type(kind: u8, address: u32) -> Vec<u8> {
    [&[0x00, 0x62, 0x00, kind], &address.to_le_bytes()[..]].concat()
}

/// Sets a breakpoint at this address with comparator 0; returns the time before.
fn break_at(bench: &mut Bench, address: u32) -> Time {
    let from = bench.time();
    let half = if address & 2 == 0 { 1 << 30 } else { 1 << 31 };
    write_word(bench, FP_COMP0, half | address & !3 | 1);
    write_word(bench, FP_CTRL, 3);
    from
}

/// Runs until an emergency is sent, for at most two seconds.
fn await_stop(bench: &mut Bench, from: Time) -> Vec<u8> {
    for _ in 0..1000 {
        if let Some(stop) = bench.emergencies(from).pop() {
            return stop;
        }
        bench.run_ms(2);
    }
    panic!("the program does not stop; heard: {:?}", bench.frames_since(from));
}

/// The program stops at this address. A code breakpoint is of type 1.
#[track_caller]
fn stop_at(bench: &mut Bench, address: u32) {
    let from = break_at(bench, address);
    assert_eq!(await_stop(bench, from), stop_of_type(1, address));
}

#[test]
fn the_bootloader_reads_and_writes_what_there_is() {
    let mut bench = bootloader();
    let board = firmware::board();
    // Flash, over several pieces, and from an odd address; the unique identifier; RAM at the end of
    // the images' region.
    for (address, len) in [
        (board.bootloader.base, 700),
        (board.bootloader.base + 0x201, 5),
        (0x1FFF_7A10, 12),
        (board.ram.end() - 64, 64),
    ] {
        let expected = bench.memory(address, len);
        assert_eq!(read(&mut bench, address, len as u16), expected, "{address:08X}");
    }
    // The handoff is unused while the bootloader runs. An odd address and an odd length, with both
    // neighbours unchanged.
    let at = board.handoff.base + 1;
    let mut expected = bench.memory(at - 1, 16);
    expected[1..14].copy_from_slice(b"thirteen long");
    write(&mut bench, at, b"thirteen long");
    assert_eq!(bench.memory(at - 1, 16), expected);
    assert_eq!(bench.session().read_number(STATUS).unwrap(), 0);
    // Registers: CPUID of the Cortex-M4 r0p1; GPIOE has no clock, but can be read.
    assert_eq!(read_word(&mut bench, 0xE000_ED00), 0x410F_C241);
    bench.assert_nothing_unmodelled();
    assert_eq!(read(&mut bench, 0x4002_1000, 4).len(), 4);
    assert_eq!(bench.events(), [], "no reset");
}

/// Missing memory, and memory without write access: the bootloader, the parameters, a program, and
/// the registers with which they could be erased.
#[test]
fn what_must_not_be_touched_is_refused_and_faults_nothing() {
    let board = firmware::board();
    let chip = board.chip;
    for mut bench in [bootloader(), application()] {
        let before = bench.machine().flash().to_vec();
        for (kind, address, len) in [
            (0, 0, 4),
            (0, chip.flash.base - 4, 4),
            (0, chip.flash.end(), 4),
            (0, chip.flash.end() - 4, 8),
            (0, chip.sram.end(), 1),
            (0, chip.sram.end() - 1, 2),
            (0, 0x2200_0000, 4),
            (0, 0x4000_2400, 4),
            (0, 0x4002_7000, 4),
            (0, 0x4242_0000, 4),
            (0, 0x6000_0000, 4),
            (0, 0xE000_ED01, 4),
            (0, 0xE000_ED00, 2),
            (0, 0xFFFF_FFFC, 4),
            (0, 0xFFFF_FFFF, 0xFFFF),
            (0, chip.sram.base, 0),
            (1, board.bootloader.base, 4),
            (1, board.parameters[0].base, 4),
            (1, board.parameters[1].base, 4),
            (1, board.programs[0].base, 4),
            (1, 0x1FFF_C000, 4),
            (1, 0x4002_3C04, 4),
            (1, 0x4002_3C10, 4),
            (2, chip.sram.base, 4),
        ] {
            assert_eq!(command(&mut bench, kind, address, len), INVALID_VALUE, "{kind} {address:08X} {len}");
            assert_eq!(bench.session().read_number(STATUS).unwrap(), 2);
        }
        assert!(bench.machine().flash() == before);
        assert_eq!(bench.events(), [], "no reset");
        bench.assert_nothing_unmodelled();
        // The next command works.
        assert_eq!(read_word(&mut bench, 0xE000_ED00), 0x410F_C241);
    }
}

/// 08000021h, local control: the CPU would stall until the sector is erased, or the memory has no
/// clock.
#[test]
fn memory_that_does_not_answer_now_is_refused_now() {
    let mut bench = bootloader();
    let board = firmware::board();
    // The second CLEAR is carried out at once: it erases what is not blank.
    bench.soil_programs();
    for _ in 0..2 {
        bench.session().command(1, canopen::program::ProgramControl::Clear).unwrap();
    }
    assert_eq!(command(&mut bench, 0, board.bootloader.base, 4), None);
    let outcome = bench.session().upload(DATA, &mut |_| {});
    assert_eq!(abort_code(outcome), Some(0x0800_0021));
    assert_eq!(read(&mut bench, board.handoff.base, 4).len(), 4, "RAM has nothing to do with it");
    let status = bench.session().await_idle(1, Doing::Read(STATUS)).unwrap();
    assert_eq!(status.to_word(), 0);
    let expected = bench.memory(board.bootloader.base, 4);
    assert_eq!(read(&mut bench, board.bootloader.base, 4), expected);
    // RCC_AHB1ENR bit 20 is the clock of the CCM, if the chip has one.
    let ccm = board.chip.ccm;
    if ccm.size == 0 {
        return;
    }
    write(&mut bench, ccm.end() - 4, &[1, 2, 3, 4]);
    let clocks = read_word(&mut bench, 0x4002_3830);
    write_word(&mut bench, 0x4002_3830, clocks & !(1 << 20));
    assert_eq!(command(&mut bench, 0, ccm.end() - 4, 4), None);
    let outcome = bench.session().upload(DATA, &mut |_| {});
    assert_eq!(abort_code(outcome), Some(0x0800_0021));
    assert_eq!(command(&mut bench, 1, ccm.end() - 4, 4), None);
    let outcome = bench.session().write(DATA, &[9; 4], Doing::Write(DATA), &mut |_| {});
    assert_eq!(abort_code(outcome), Some(0x0800_0021));
    write_word(&mut bench, 0x4002_3830, clocks);
    assert_eq!(read(&mut bench, ccm.end() - 4, 4), [1, 2, 3, 4]);
}

#[test]
fn data_of_another_length_are_refused() {
    let at = firmware::board().handoff.base;
    for mut bench in [bootloader(), application()] {
        let before = bench.memory(at, 16);
        assert_eq!(command(&mut bench, 1, at, 8), None);
        for (len, abort) in [(7, 0x0607_0013), (9, 0x0607_0012), (500, 0x0607_0012)] {
            let data = vec![0xA5; len];
            let outcome = abort_code(bench.session().write(DATA, &data, Doing::Write(DATA), &mut |_| {}));
            assert_eq!(outcome, Some(abort), "{len} bytes");
            assert_eq!(bench.memory(at, 16), before, "{len} bytes");
        }
        // 08000024h: no data.
        let nothing = bench.session().upload(DATA, &mut |_| {});
        assert_eq!(abort_code(nothing), Some(0x0800_0024));
        write(&mut bench, at, &[1; 8]);
        assert_eq!(bench.memory(at, 9), [&[1; 8][..], &before[8..9]].concat());
    }
}

/// Read-out protection: level 1 and level 2.
#[test]
fn a_secured_device_tells_nothing() {
    for rdp in [0x55, 0xCC] {
        for mut bench in [bootloader(), application()] {
            let at = firmware::board().handoff.base;
            let before = bench.memory(at, 4);
            assert_eq!(command(&mut bench, 0, at, 4), None);
            bench.machine().set_read_protection(rdp);
            assert_eq!(abort_code(bench.session().upload(DATA, &mut |_| {})), DEVICE_STATE);
            for kind in [0, 1] {
                assert_eq!(command(&mut bench, kind, at, 4), DEVICE_STATE);
                let outcome = bench.session().write(DATA, &[9; 4], Doing::Write(DATA), &mut |_| {});
                assert_eq!(abort_code(outcome), DEVICE_STATE);
            }
            assert_eq!(bench.memory(at, 4), before);
            bench.machine().set_read_protection(0xAA);
            assert_eq!(read(&mut bench, at, 4), before);
        }
    }
}

/// What the document says, frame by frame.
#[test]
fn the_scripts_of_the_document_are_played() {
    for mut bench in [bootloader(), application()] {
        script::play(&mut bench, "debugger-memory.candump");
        bench.assert_nothing_unmodelled();
    }
    let mut bench = application();
    script::play(&mut bench, "debugger-stop.candump");
    bench.assert_nothing_unmodelled();
}

/// The standard images do not have this object.
#[test]
fn without_the_feature_there_is_no_interface() {
    let mut bench = Bench::new().switched_on();
    assert_eq!(command(&mut bench, 0, 0x2000_0000, 4), Some(0x0602_0000));
    bench.install(firmware::APP_V1);
    assert_eq!(command(&mut bench, 0, 0x2000_0000, 4), Some(0x0602_0000));
}

/// A variable at run time, without stopping the program.
#[test]
fn the_application_is_looked_at_while_it_runs() {
    let mut bench = application();
    let calls = symbol("DEBUGGER_EXAMPLE_CALLS");
    let first = read_word(&mut bench, calls);
    bench.run_ms(6000);
    // It counts a little less than twice a second.
    let counted = read_word(&mut bench, calls) - first;
    assert!((10..=12).contains(&counted), "{counted}");
    write_word(&mut bench, calls, 1000);
    bench.run_ms(2000);
    let counted = read_word(&mut bench, calls);
    assert!((1003..=1004).contains(&counted), "{counted}");
    bench.assert_nothing_unmodelled();
}

#[test]
fn a_breakpoint_stops_the_program_and_not_the_bus() {
    let mut bench = application();
    let (at, calls) = (symbol("debugger_example"), symbol("DEBUGGER_EXAMPLE_CALLS"));
    let mut from = break_at(&mut bench, at);
    for _ in 0..3 {
        // A code breakpoint is of type 1.
        assert_eq!(await_stop(&mut bench, from), stop_of_type(1, at));
        assert_eq!(read_word(&mut bench, DEMCR) & STOPPED, STOPPED);
        let stopped_with = read_word(&mut bench, calls);
        from = bench.time();
        bench.run_ms(3000);
        // The program is stopped; heartbeats (every 500 ms), SDO and memory access continue.
        assert_eq!(read_word(&mut bench, calls), stopped_with);
        let beats = bench.frames_of(HEARTBEAT, from);
        assert_eq!(beats.len(), 6, "{beats:?}");
        for pair in beats.windows(2) {
            let period = (pair[1].0 - pair[0].0).0 / 1_000_000_000;
            assert!((499..=503).contains(&period), "{period} ms");
        }
        assert_eq!(bench.text(0x100A), "1.0.0");
        assert_eq!(bench.emergencies(from), Vec::<Vec<u8>>::new());
        // It continues after the current instruction, and returns half a second later.
        from = bench.time();
        write_word(&mut bench, DEMCR, GO_ON);
        bench.run_ms(300);
        assert_eq!(read_word(&mut bench, DEMCR), GO_ON);
        assert_eq!(read_word(&mut bench, calls), stopped_with + 1);
        assert_eq!(bench.emergencies(from), Vec::<Vec<u8>>::new());
    }
    // Without the breakpoint the program runs.
    write_word(&mut bench, FP_COMP0, 0);
    write_word(&mut bench, DEMCR, GO_ON);
    let before = read_word(&mut bench, calls);
    bench.run_ms(2000);
    assert!(read_word(&mut bench, calls) >= before + 3);
    assert_eq!(bench.events(), [], "no reset");
    bench.assert_nothing_unmodelled();
}

/// The registers of a stopped program are at the address in `DCRDR`, and the program continues with
/// them.
#[test]
fn registers_are_read_and_changed_and_steps_are_steps() {
    let mut bench = application();
    let (at, calls) = (symbol("debugger_example"), symbol("DEBUGGER_EXAMPLE_CALLS"));
    stop_at(&mut bench, at);
    let saved = read_word(&mut bench, DCRDR);
    let frame = read_word(&mut bench, saved);
    assert_eq!(frame, saved + 40, "the core's part lies behind the handler's ten words");
    assert_eq!(read_word(&mut bench, frame + 24), at, "the stacked PC");
    let lr = read_word(&mut bench, frame + 20);
    assert!(firmware::board().programs[0].contains(lr & !1, 2) && lr & 1 == 1, "{lr:08X}");
    // Single steps up to the return: each step one instruction further, and at the end at the
    // address in LR.
    let mut last = at;
    let mut steps = 0;
    loop {
        let from = bench.time();
        write_word(&mut bench, DEMCR, STEP);
        let stop = await_stop(&mut bench, from);
        let pc = u32::from_le_bytes(stop[4..].try_into().unwrap());
        assert_eq!(stop, stop_of_type(0x80, pc));
        steps += 1;
        if pc == lr & !1 {
            break;
        }
        assert!(pc > at && pc < at + 64 && steps < 100, "{pc:08X} behind {last:08X}");
        last = pc;
        if steps == 1 {
            assert!([at + 2, at + 4].contains(&pc), "{pc:08X}");
        }
    }
    assert!(steps >= 4, "{steps}");
    // Back to the beginning of the function: the program continues from there, and counts once
    // more.
    let before = read_word(&mut bench, calls);
    let frame = {
        let saved = read_word(&mut bench, DCRDR);
        read_word(&mut bench, saved)
    };
    write_word(&mut bench, FP_CTRL, 2);
    write_word(&mut bench, frame + 24, at);
    write_word(&mut bench, frame + 20, lr);
    write_word(&mut bench, DEMCR, GO_ON);
    bench.run_ms(10);
    assert_eq!(read_word(&mut bench, calls), before + 1);
    assert_eq!(bench.events(), [], "no reset");
}

/// Breaks in whatever runs at the time, usually `idle`.
#[test]
fn a_program_is_stopped_on_request_and_goes_on() {
    let mut bench = application();
    let calls = symbol("DEBUGGER_EXAMPLE_CALLS");
    for _ in 0..4 {
        let from = bench.time();
        write_word(&mut bench, DEMCR, STOP);
        let stop = await_stop(&mut bench, from);
        assert_eq!(stop[..4], [0x00, 0x62, 0x00, 0x80]);
        let pc = u32::from_le_bytes(stop[4..].try_into().unwrap());
        assert!(firmware::board().programs[0].contains(pc, 2), "{pc:08X}");
        let stopped_with = read_word(&mut bench, calls);
        bench.run_ms(717);
        assert_eq!(read_word(&mut bench, calls), stopped_with);
        write_word(&mut bench, DEMCR, GO_ON);
        bench.run_ms(700);
        assert!(read_word(&mut bench, calls) > stopped_with);
    }
    assert_eq!(bench.events(), [], "no reset");
}

/// `idle` sleeps, and its interrupts are long overdue when it continues: the instruction with the
/// breakpoint is still executed first, and the next instruction is the next stop.
#[test]
fn a_step_over_a_breakpoint_is_not_lost_to_an_interrupt() {
    let mut bench = application();
    let idle = firmware::symbol(firmware::APP_DEBUGGER, |name| name.contains("3app4idle17h"));
    // WFI is BF30h.
    let code = bench.memory(idle, 64);
    let wfi = (0..64).step_by(2).find(|&n| code[n..n + 2] == [0x30, 0xBF]).expect("it sleeps");
    let wfi = idle + wfi as u32;
    stop_at(&mut bench, wfi);
    let next = wfi + 2;
    let half = if next & 2 == 0 { 1 << 30 } else { 1 << 31 };
    write_word(&mut bench, FP_COMP0 + 4, half | next & !3 | 1);
    for round in 0..4 {
        // Enough time for the task of `tick` to become due.
        bench.run_ms(20);
        for at in [next, wfi] {
            let from = bench.time();
            write_word(&mut bench, DEMCR, GO_ON);
            assert_eq!(await_stop(&mut bench, from), stop_of_type(1, at), "round {round}");
            bench.run_ms(20);
        }
    }
    assert_eq!(bench.events(), [], "no reset");
    bench.assert_nothing_unmodelled();
}

/// The interrupt that serves the bus cannot be stopped: breakpoints are then disabled, the device
/// reports it, and everything continues.
#[test]
fn a_breakpoint_out_of_reach_harms_nothing() {
    let mut bench = application();
    let at = symbol("CAN1_TX");
    let from = bench.time();
    break_at(&mut bench, at);
    bench.run_ms(100);
    assert_eq!(bench.emergencies(from), [stop_of_type(0x81, at)]);
    assert_eq!(read_word(&mut bench, FP_CTRL), 0x260, "off");
    assert_eq!(read_word(&mut bench, DEMCR) & STOPPED, 0);
    let calls = symbol("DEBUGGER_EXAMPLE_CALLS");
    let before = read_word(&mut bench, calls);
    bench.run_ms(2000);
    assert!(read_word(&mut bench, calls) >= before + 3);
    // The next breakpoint, which is possible, works.
    let at = symbol("debugger_example");
    stop_at(&mut bench, at);
    assert_eq!(bench.events(), [], "no reset");
}

/// A fault that does not concern the debugger restarts the device, as without the interface: here
/// the program jumps to an address without code.
#[test]
fn a_fault_restarts_the_device_as_ever() {
    let mut bench = application();
    let at = symbol("debugger_example");
    stop_at(&mut bench, at);
    let saved = read_word(&mut bench, DCRDR);
    let frame = read_word(&mut bench, saved);
    write_word(&mut bench, frame + 24, 0x6000_0000);
    // Its answer no longer reaches the bus.
    assert_eq!(command(&mut bench, 1, DEMCR, 4), None);
    let [a, b, c, d] = GO_ON.to_le_bytes();
    bench.post(0x600 + u16::from(NODE), &[0x23, 0x25, 0x10, 0x04, a, b, c, d]);
    bench.await_boot_up(1000);
    let stops = bench.stops();
    assert_eq!(stops, [Stop::Reset(ResetCause::Software)]);
    assert!(!bench.is_bootloader(NODE));
    let calls = symbol("DEBUGGER_EXAMPLE_CALLS");
    bench.run_ms(2000);
    assert!(read_word(&mut bench, calls) >= 2);
}

/// A stopped program is reset, or returns to the bootloader, and neither start is affected by the
/// breakpoint, which the core keeps over a reset.
#[test]
fn a_stopped_program_can_be_reset_and_called_back() {
    let mut bench = application();
    let at = symbol("debugger_example");
    stop_at(&mut bench, at);
    // NMT reset node.
    bench.post(0x000, &[0x81, NODE]);
    bench.await_boot_up(1000);
    bench.run_ms(2000);
    assert_eq!(read_word(&mut bench, FP_CTRL), 0x260);
    assert_eq!(bench.events().len(), 1, "the one reset");
    stop_at(&mut bench, at);
    bench.call_back();
    assert!(bench.is_bootloader(NODE));
    bench.start_program();
    bench.run_ms(2000);
    assert!(!bench.is_bootloader(NODE));
    assert_eq!(bench.events().len(), 2, "to the bootloader, and back");
}

// --- coflash

/// The library: the functions of `coflash more debug`, in virtual time.
#[test]
fn the_host_library_sets_breakpoints_and_shows_registers() {
    let mut bench = application();
    let (at, calls) = (symbol("debugger_example"), symbol("DEBUGGER_EXAMPLE_CALLS"));
    let out_of_reach = symbol("CAN1_TX");
    let second = Duration::from_secs(1);
    let board = firmware::board();
    let flash = board.chip.flash.base;
    let start = bench.memory(flash, 5000);
    let mut session = bench.session();
    let mut debugger = Debugger::new(&mut session);
    assert_eq!(debugger.read(flash, 5000, &mut |_| {}).unwrap(), start);
    let word = |debugger: &mut Debugger<'_, '_>, address| {
        let bytes = debugger.read(address, 4, &mut |_| {}).unwrap();
        u32::from_le_bytes(bytes.try_into().unwrap())
    };
    assert!(debugger.breakpoints().unwrap().is_empty());
    assert_eq!(debugger.registers().unwrap(), None);
    assert_eq!(debugger.break_at(at + 1).unwrap(), Err(NoBreakpoint::Address));
    assert_eq!(debugger.break_at(board.ram.base).unwrap(), Err(NoBreakpoint::Address));
    debugger.break_at(at).unwrap().unwrap();
    // A breakpoint that is set twice counts once.
    debugger.break_at(at).unwrap().unwrap();
    assert_eq!(debugger.breakpoints().unwrap(), [at]);
    let at_breakpoint = Some(Stopped { stop: DebugStop::Breakpoint, address: at });
    for round in 0..3 {
        assert_eq!(debugger.await_stop(second).unwrap(), at_breakpoint, "round {round}");
        let registers = debugger.registers().unwrap().unwrap();
        assert_eq!(registers.pc(), at);
        // Thumb, in the exception of the task's dispatcher: SPI1, interrupt 35 (RM0090 table 61).
        assert_eq!(registers.0[16] & 0x0100_01FF, 0x0100_0000 | (16 + 35));
        assert!(board.ram.contains(registers.0[13], 4), "SP {:08X}", registers.0[13]);
        let counted = word(&mut debugger, calls);
        debugger.step().unwrap();
        let Some(Stopped { stop: DebugStop::Step, address }) = debugger.await_stop(second).unwrap() else {
            panic!("no step");
        };
        assert!((at + 2..=at + 4).contains(&address), "{address:08X}");
        debugger.resume().unwrap();
        assert_eq!(debugger.await_stop(Duration::from_millis(300)).unwrap(), None);
        assert_eq!(word(&mut debugger, calls), counted + 1);
    }
    // There are six comparators.
    for n in 1..6 {
        debugger.break_at(board.programs[0].end() - 2 * n).unwrap().unwrap();
    }
    assert_eq!(debugger.break_at(board.programs[0].base).unwrap(), Err(NoBreakpoint::Full));
    assert!(debugger.clear(at).unwrap() && !debugger.clear(at).unwrap());
    debugger.clear_all().unwrap();
    assert!(debugger.breakpoints().unwrap().is_empty());
    // The program may have reached it once more.
    debugger.resume().unwrap();
    assert_eq!(debugger.await_stop(second).unwrap(), None);
    debugger.stop().unwrap();
    assert!(matches!(debugger.await_stop(second).unwrap(), Some(Stopped { stop: DebugStop::Step, .. })));
    debugger.resume().unwrap();
    debugger.break_at(out_of_reach).unwrap().unwrap();
    let missed = Some(Stopped { stop: DebugStop::OutOfReach, address: out_of_reach });
    assert_eq!(debugger.await_stop(second).unwrap(), missed);
    // Old comparator values do not return with the next breakpoint.
    debugger.break_at(at).unwrap().unwrap();
    assert_eq!(debugger.breakpoints().unwrap(), [at]);
    assert_eq!(debugger.await_stop(second).unwrap(), at_breakpoint);
    drop(session);
    assert_eq!(bench.events(), [], "no reset");
    bench.assert_nothing_unmodelled();
}

/// Runs `coflash more debug`; returns exit code, standard output and standard error.
fn debug(endpoint: &mut Endpoint, words: &[&str]) -> (Option<i32>, String, String) {
    let mut command = tools::coflash();
    command.args(["more", "debug"]).args(words).env("COFLASH_BUS", endpoint.url());
    let done = endpoint.run(&mut command);
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (done.status.code(), text(&done.stdout), text(&done.stderr))
}

/// The command line of a user.
#[test]
fn coflash_debug_reads_writes_breaks_and_continues() {
    let mut endpoint = Endpoint::new(application());
    let hex = |address: u32| format!("{address:#010x}");
    let (at, calls) = (symbol("debugger_example"), hex(symbol("DEBUGGER_EXAMPLE_CALLS")));
    let done = |said: (Option<i32>, String, String)| {
        assert_eq!(said.0, Some(0), "{said:?}");
        said.1
    };
    assert_eq!(
        done(debug(&mut endpoint, &["read", "0xE000ED00"])),
        "node 1: E000ED00h: 41 C2 0F 41 (410FC241h)\n"
    );
    done(debug(&mut endpoint, &["write", &calls, "0x12345600"]));
    let said = done(debug(&mut endpoint, &["read", &calls, "4"]));
    assert!(said.contains(" 56 34 12 (123456"), "{said}");
    let said = done(debug(&mut endpoint, &["break", &hex(at), "--wait", "3000"]));
    assert_eq!(said, format!("node 1: stopped at a breakpoint at {at:08X}h\n"));
    done(debug(&mut endpoint, &["write", &calls, "--bytes", "05 00 00 00"]));
    let said = done(debug(&mut endpoint, &["registers"]));
    assert!(said.contains(&format!("pc {at:08X}h")), "{said}");
    let said = done(debug(&mut endpoint, &["step"]));
    assert!(said.starts_with("node 1: stopped at 08"), "{said}");
    assert_eq!(done(debug(&mut endpoint, &["break"])), format!("node 1: breakpoints at {at:08X}h\n"));
    // After one round it stops there again, and has counted one.
    let said = done(debug(&mut endpoint, &["continue", "--wait", "3000"]));
    assert_eq!(said, format!("node 1: stopped at a breakpoint at {at:08X}h\n"));
    let said = done(debug(&mut endpoint, &["read", &calls]));
    assert!(said.ends_with("06 00 00 00 (00000006h)\n"), "{said}");
    assert_eq!(done(debug(&mut endpoint, &["break", "--clear"])), "node 1: no breakpoints\n");
    assert_eq!(done(debug(&mut endpoint, &["continue"])), "node 1: the program continues\n");
    for (words, exit, says) in [
        (&["continue"][..], 2, "the program is not stopped"),
        (&["registers"], 2, "the program is not stopped"),
        (&["read", "0x60000000"], 6, "cannot be accessed"),
        (&["write", "0x08000000", "0"], 6, "cannot be accessed"),
        (&["break", "0x20000000"], 2, "cannot have a breakpoint"),
        (&["break", &hex(at), "--clear"], 2, "there is no breakpoint"),
        (&["read", "20000000h"], 2, "number"),
    ] {
        let (code, out, err) = debug(&mut endpoint, words);
        assert_eq!(code, Some(exit), "{words:?}: {err}");
        assert!(err.contains(says) && out.is_empty(), "{words:?}: {out}{err}");
    }
    assert_eq!(endpoint.bench.events(), [], "no reset");
}

/// The session of the page, line by line; the address of the function is that of this build.
#[test]
fn the_pages_session_goes_as_printed() {
    let page = include_str!("../../docs/debugger.md");
    let mut endpoint = Endpoint::new(application());
    for line in page.lines().filter_map(|line| line.strip_prefix("$ coflash more debug ")) {
        let line = line.replace("0x08020CF4", &format!("{:#010x}", symbol("debugger_example")));
        let (code, _, err) = debug(&mut endpoint, &line.split(' ').collect::<Vec<_>>());
        assert_eq!(code, Some(0), "{line}: {err}");
    }
    assert_eq!(endpoint.bench.events(), [], "no reset");
}

/// The firmware of a product, and a bootloader.
#[test]
fn coflash_debug_tells_what_a_device_lacks() {
    let mut endpoint = Endpoint::new(bootloader());
    let (code, _, err) = debug(&mut endpoint, &["break", "0x08010000"]);
    assert!(code == Some(2) && err.contains("does not stop at breakpoints"), "{err}");
    endpoint.bench.machine().set_read_protection(0);
    let (code, _, err) = debug(&mut endpoint, &["read", "0x20000000"]);
    assert!(code == Some(6) && err.contains("the device is secured"), "{err}");
    let bench = Bench::new().switched_on();
    let (code, _, err) = debug(&mut Endpoint::new(bench), &["read", "0x20000000"]);
    assert!(code == Some(6) && err.contains("no debugger interface"), "{err}");
}
