//! The breakpoint unit and the DebugMonitor exception (DDI 0403E section C1).

use super::*;

/// Runs [`programs::BREAKPOINTS`]; returns the pairs of its log and its three results.
fn debugged(machine: &mut Machine, arguments: [u32; 4], events: u32) -> (Vec<[u32; 2]>, Vec<u32>) {
    for (n, argument) in (0..).zip(arguments) {
        put(machine, ARGUMENT + 4 * n, argument);
    }
    for n in 0..3 {
        put(machine, OUT + 4 * n, 0);
    }
    for n in 0..16 {
        put(machine, 0x2000_0200 + 4 * n, 0);
    }
    machine.run_until(machine.now() + Span::from_millis(1));
    let log = |n| [word(machine, 0x2000_0200 + 8 * n), word(machine, 0x2000_0204 + 8 * n)];
    let log = (0..=events).map(log).collect();
    (log, words(machine, 3))
}

/// DDI 0403E section C1: the breakpoint comes before its instruction, which is carried out
/// afterwards; each step is one instruction, a branch among them; DFSR says 2 for a breakpoint and
/// 1 for a step.
#[test]
fn the_monitor_stops_at_breakpoints_and_steps() {
    for (comparator, first) in
        [(0x4800_022D, 0x0800_022C), (0x8800_022D, 0x0800_022E), (0xC800_022D, 0x0800_022C)]
    {
        let mut machine = machine(&programs::BREAKPOINTS);
        let (log, results) = debugged(&mut machine, [0x0101_0000, comparator, 0, 0], 2);
        assert_eq!(log, [[first, 2], [0x0800_0238, 2], [0, 0]], "{comparator:08X}");
        assert_eq!(results, [1, 17, 17]);
        assert_eq!(machine.reports(), []);
    }
    let mut machine = machine(&programs::BREAKPOINTS);
    let (log, results) = debugged(&mut machine, [0x0101_0000, 0x4800_022D, 0, 3], 5);
    let steps =
        [[0x0800_022C, 2], [0x0800_022E, 1], [0x0800_0232, 1], [0x0800_0234, 1], [0x0800_0238, 2], [0, 0]];
    assert_eq!(log, steps);
    assert_eq!(results, [1, 17, 17]);
    // The breakpoint, three steps, BKPT: exception 12, each of them.
    assert_eq!(machine.counters().exceptions[12], 5);
}

/// HFSR.DEBUGEVT is bit 31.
#[test]
fn a_breakpoint_that_the_monitor_cannot_take_is_a_hard_fault() {
    for (what, demcr, primask) in [("the monitor is off", 0x0100_0000, 0), ("PRIMASK is set", 0x0101_0000, 1)]
    {
        let mut machine = machine(&programs::BREAKPOINTS);
        let (log, results) = debugged(&mut machine, [demcr, 0x4800_022D, primask, 0], 1);
        assert_eq!(log, [[0x0800_022C, 0x8000_0000], [2, 0]], "{what}");
        assert_eq!(results, [0, 0, 0], "{what}");
        // Without a breakpoint in the unit, the program goes on to its BKPT.
        machine.power_off();
        machine.power_on(machine.now());
        let (log, results) = debugged(&mut machine, [demcr, 0, primask, 0], 1);
        assert_eq!(log, [[0x0800_0238, 0x8000_0000], [2, 0]], "{what}");
        assert_eq!(results, [1, 17, 0], "{what}");
    }
}

/// Breakpoints are in the debug power domain, which a reset leaves alone; the monitor's bits are in
/// the core.
#[test]
fn breakpoints_outlive_a_reset_and_not_the_power() {
    let mut machine = machine(&programs::BREAKPOINTS);
    // The monitor's handler turns the unit off at the breakpoint. With PRIMASK set it does not run,
    // and the unit stays on.
    debugged(&mut machine, [0x0101_0000, 0x4800_022D, 1, 0], 1);
    machine.reset_pin();
    let (log, _) = debugged(&mut machine, [0x0101_0000, 0, 0, 0], 2);
    assert_eq!(log, [[0x0800_022C, 2], [0x0800_0238, 2], [0, 0]]);
    debugged(&mut machine, [0, 0x4800_022D, 0, 0], 1);
    machine.power_off();
    machine.power_on(machine.now());
    let (log, _) = debugged(&mut machine, [0x0101_0000, 0, 0, 0], 1);
    assert_eq!(log, [[0x0800_0238, 2], [0, 0]]);
}
