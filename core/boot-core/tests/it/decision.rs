//! The boot decision: the promised order of its checks.

use std::cell::RefCell;

use boot_core::crc::CrcKind;
use boot_core::decision::{decide, fallback, Autostart, BootDecision, Circumstances, PinReset, Policy};
use boot_core::flash::{run, Flash as _};
use boot_core::program::{verify, Invalid, VerifiedProgram};
use boot_core::store::{Journal, Key, Parameters, ProgramRecord};
use kit::model::ModelFlash;
use shared_abi::boot_report::Reason;
use shared_abi::geometry::Region;
use shared_abi::handoff::ResetCause;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;
use shared_abi::vectors::VectorFault;
use shared_abi::warm_start::{BootRequest, Owed};

const QUIET: Circumstances =
    Circumstances { request: None, strap: false, crash_resets: 0, node_id: 5, nearly_full: false };

fn policy() -> Policy {
    Policy {
        autostart: Autostart::InOrder,
        programs: &[1],
        max_crash_resets: 3,
        node_ids: 1..=100,
        rescue_window_ms: 0,
        rescue_window_confirmed_ms: 0,
        start_allowed: |_| true,
    }
}

/// A program of 64 bytes as a download leaves it, and its check.
fn check(signed: bool, damage: impl FnOnce(&mut ModelFlash)) -> Result<VerifiedProgram, Invalid> {
    check_record(signed, false, damage)
}

fn check_record(
    signed: bool,
    confirmed: bool,
    damage: impl FnOnce(&mut ModelFlash),
) -> Result<VerifiedProgram, Invalid> {
    let mut flash = ModelFlash::new(LAYOUT.chip);
    let mut bytes = vec![0xA5; 64];
    bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&0x0802_0189_u32.to_le_bytes());
    flash.poke(0x0802_0000, &bytes);
    let mut journal = Journal::open(&flash, LAYOUT.parameters);
    let record = ProgramRecord {
        seal: None,
        withdrawn: false,
        size: 64,
        crc: boot_core::crc32(&bytes),
        signed,
        confirmed,
        version: 0,
        half_erased: false,
    };
    journal.store(Key::program(1), record.value());
    run(&mut flash, |flash, outcome| journal.next(flash, outcome)).unwrap();
    damage(&mut flash);
    verify(&flash, &Journal::open(&flash, LAYOUT.parameters), &LAYOUT, CrcKind::Crc32, 1)
}

fn signed() -> Result<VerifiedProgram, Invalid> {
    check(true, |_| {})
}

fn unsigned() -> Result<VerifiedProgram, Invalid> {
    check(false, |_| {})
}

#[test]
fn a_signed_program_starts_by_itself() {
    let decision = decide(&QUIET, &policy(), |number| {
        assert_eq!(number, 1);
        signed()
    });
    assert_eq!(decision, BootDecision::Start { program: signed().unwrap(), trial: false });
}

/// Requests for the bootloader come before requests for a program, and then the program is not even
/// checked.
#[test]
fn what_asks_for_the_bootloader_wins() {
    let stay = |circumstances: Circumstances, policy: Policy| match decide(&circumstances, &policy, |_| {
        panic!("the program was looked at")
    }) {
        BootDecision::Stay { reason, refused: 0 } => reason,
        start => panic!("{start:?}"),
    };
    let request = |request| Circumstances { request: Some(request), ..QUIET };
    let owed = BootRequest::Owed(Owed { program: 1, value: 3, node_id: 5 });
    assert_eq!(stay(request(BootRequest::Stay), policy()), Reason::Requested);
    assert_eq!(stay(request(owed), policy()), Reason::Requested);
    assert_eq!(stay(Circumstances { strap: true, ..QUIET }, policy()), Reason::Strap);
    assert_eq!(
        stay(Circumstances { strap: true, ..request(BootRequest::Start(1)) }, policy()),
        Reason::Strap
    );
    assert_eq!(stay(Circumstances { crash_resets: 3, ..QUIET }, policy()), Reason::CrashLoop);
    assert_eq!(stay(QUIET, Policy { autostart: Autostart::List(&[]), ..policy() }), Reason::NoAutostart);
    for node_id in [0, 101, 127, 255] {
        assert_eq!(stay(Circumstances { node_id, ..QUIET }, policy()), Reason::NodeId);
    }
}

#[test]
fn without_signature_a_program_starts_as_a_trial_alone() {
    let stays = BootDecision::Stay { reason: Reason::Unsigned, refused: 0 };
    assert_eq!(decide(&QUIET, &policy(), |_| unsigned()), stays);
    let start = Circumstances { request: Some(BootRequest::Start(1)), ..QUIET };
    let refused = BootDecision::Stay { reason: Reason::Unsigned, refused: 1 };
    assert_eq!(decide(&start, &policy(), |_| unsigned()), refused);
    let policy = Policy { autostart: Autostart::List(&[]), ..policy() };
    for request in [BootRequest::Trial(1), BootRequest::Fresh(1)] {
        let trial = Circumstances { request: Some(request), crash_resets: 9, ..QUIET };
        let expected = BootDecision::Start { program: unsigned().unwrap(), trial: true };
        assert_eq!(decide(&trial, &policy, |_| unsigned()), expected);
        let expected = BootDecision::Start { program: signed().unwrap(), trial: false };
        assert_eq!(decide(&trial, &policy, |_| signed()), expected, "a signed program is on no trial");
    }
}

/// A record that is longer than its program's flash is no program, even if the CRC of what follows
/// there is right: one bit of a size must not let the check read into another region.
#[test]
fn a_program_ends_inside_its_region() {
    let region = LAYOUT.programs[0];
    let verified = |size: u32| {
        let mut flash = ModelFlash::new(LAYOUT.chip);
        let vectors = [0x2001_FFC0_u32, region.base + 0x189].map(u32::to_le_bytes).concat();
        flash.poke(region.base, &vectors);
        let mut bytes = vec![0; size as usize];
        flash.read(region.base, &mut bytes);
        let record = ProgramRecord {
            seal: None,
            withdrawn: false,
            size,
            crc: boot_core::crc32(&bytes),
            signed: true,
            confirmed: true,
            version: 0,
            half_erased: false,
        };
        let mut journal = Journal::open(&flash, LAYOUT.parameters);
        journal.store(Key::program(1), record.value());
        run(&mut flash, |flash, outcome| journal.next(flash, outcome)).unwrap();
        verify(&flash, &Journal::open(&flash, LAYOUT.parameters), &LAYOUT, CrcKind::Crc32, 1).map(|_| ())
    };
    assert_eq!(verified(region.size), Ok(()));
    for more in [1, 4, 1024, 1025, 0x1_0000] {
        assert_eq!(verified(region.size + more), Err(Invalid::Size), "{more} bytes too long");
    }
}

#[test]
fn a_request_for_a_program_that_is_not_there_stays() {
    let start = Circumstances { request: Some(BootRequest::Start(7)), ..QUIET };
    let flash = ModelFlash::new(LAYOUT.chip);
    let journal = Journal::open(&flash, LAYOUT.parameters);
    let decision =
        decide(&start, &policy(), |number| verify(&flash, &journal, &LAYOUT, CrcKind::Crc32, number));
    assert_eq!(decision, BootDecision::Stay { reason: Reason::NoProgram, refused: 7 });
    let decision =
        decide(&QUIET, &policy(), |number| verify(&flash, &journal, &LAYOUT, CrcKind::Crc32, number));
    assert_eq!(decision, BootDecision::Stay { reason: Reason::NoProgram, refused: 0 });
}

#[test]
fn any_damage_to_a_program_keeps_it_from_starting() {
    for offset in 8..64 {
        for bit in 0..8 {
            let damaged = check(true, |flash| flash.poke(0x0802_0000 + offset, &[0xA5 ^ 1 << bit]));
            assert_eq!(damaged, Err(Invalid::Crc));
        }
    }
    let erased = check(true, |flash| flash.poke(0x0802_0000, &[0xFF; 64]));
    assert_eq!(erased, Err(Invalid::Vectors(VectorFault::StackPointer)));
    assert!(
        check(true, |flash| flash.poke(0x0802_0040, &[0])).is_ok(),
        "what lies behind its size is not its own"
    );
}

/// docs/architecture.md: resets without a request count, a power-on and the reset pin begin anew
/// below the limit, and a request begins anew.
#[test]
fn resets_in_a_row_are_counted_until_somebody_asks() {
    use ResetCause::{
        BrownOut, IndependentWatchdog, LowPower, Pin, PowerOn, Software, Standby, Unknown, WindowWatchdog,
    };
    let policy = policy();
    for cause in [Software, IndependentWatchdog, WindowWatchdog, LowPower] {
        for (before, after) in [(0, 1), (2, 3), (3, 4), (254, 255), (255, 255), (u32::MAX, 255)] {
            assert_eq!(policy.crash_resets(before, cause, None), after, "{cause:?}");
        }
    }
    for cause in [PowerOn, Pin, BrownOut, Standby, Unknown] {
        for (before, after) in [(0, 0), (2, 0), (3, 3), (4, 4)] {
            assert_eq!(policy.crash_resets(before, cause, None), after, "{cause:?}");
        }
    }
    for (request, after) in [
        (BootRequest::Stay, 0),
        (BootRequest::Start(1), 0),
        (BootRequest::Trial(1), 0),
        (BootRequest::PowerOn, 0),
        (BootRequest::Rescue, 0),
        (BootRequest::Fault, 2),
        (BootRequest::Resume(1), 2),
    ] {
        assert_eq!(policy.crash_resets(2, Software, Some(request)), after, "{request:?}");
    }
}

/// Only resets by the pin alone count: a request, or any other reset, begins anew. One of them decides
/// nothing.
#[test]
fn two_resets_by_the_pin_in_a_row_keep_the_device_in_the_bootloader() {
    use ResetCause::{
        BrownOut, IndependentWatchdog, LowPower, Pin, PowerOn, Software, Standby, Unknown, WindowWatchdog,
    };
    assert_eq!(PinReset::of(Pin, None, false), PinReset::First);
    assert_eq!(PinReset::of(Pin, None, true), PinReset::Second);
    for is_marked in [false, true] {
        assert_eq!(PinReset::of(Pin, Some(BootRequest::Start(1)), is_marked), PinReset::None);
        for cause in
            [PowerOn, BrownOut, Standby, Software, IndependentWatchdog, WindowWatchdog, LowPower, Unknown]
        {
            assert_eq!(PinReset::of(cause, None, is_marked), PinReset::None, "{cause:?}");
        }
    }
    // After the second one no program starts, at once or after the rescue window.
    let starts = decide(&QUIET, &policy(), |_| signed());
    let held = decide(&QUIET, &Policy { rescue_window_ms: 300, ..policy() }, |_| signed());
    let stays = BootDecision::Stay { reason: Reason::NoProgram, refused: 1 };
    for decision in [starts, held] {
        assert_eq!(PinReset::None.change(decision), decision);
        assert_eq!(PinReset::First.change(decision), decision);
        let twice = BootDecision::Stay { reason: Reason::TwoResets, refused: 0 };
        assert_eq!(PinReset::Second.change(decision), twice);
    }
    assert_eq!(PinReset::Second.change(stays), stays, "it stays for a reason of its own");
    // A power-on sets the flag of the pin, too.
    assert_eq!(ResetCause::from_flags(0x0C00_0000, false), PowerOn);
    assert_eq!(ResetCause::from_flags(0x0400_0000, false), Pin);
}

/// A program that starts by itself is held back, as long as its confirmation says; one that was
/// asked for is not.
#[test]
fn the_rescue_window_is_for_a_start_that_nobody_asked_for() {
    let policy = Policy { rescue_window_ms: 300, rescue_window_confirmed_ms: 20, ..policy() };
    assert_eq!(decide(&QUIET, &policy, |_| signed()), BootDecision::Hold { program: 1, window_ms: 300 });
    for request in
        [BootRequest::Start(1), BootRequest::Resume(1), BootRequest::Confirm(1), BootRequest::PowerOn]
    {
        let asked = Circumstances { request: Some(request), ..QUIET };
        let start = BootDecision::Start { program: signed().unwrap(), trial: false };
        assert_eq!(decide(&asked, &policy, |_| signed()), start, "{request:?}");
    }
    let confirmed = || check_record(true, true, |_| {});
    assert_eq!(decide(&QUIET, &policy, |_| confirmed()), BootDecision::Hold { program: 1, window_ms: 20 });
    // It has refused to leave.
    let refused = Circumstances { request: Some(BootRequest::Rescue), ..QUIET };
    let held = BootDecision::Hold { program: 1, window_ms: 300 };
    assert_eq!(decide(&refused, &policy, |_| confirmed()), held);
    let policy = Policy { rescue_window_confirmed_ms: 0, ..policy };
    let start = BootDecision::Start { program: confirmed().unwrap(), trial: false };
    assert_eq!(decide(&QUIET, &policy, |_| confirmed()), start);
}

/// The store is compacted before a start that no bootloader has just left for; the fallback of a damaged RAM image
/// is such a start, too: no loop.
#[test]
fn a_store_that_is_nearly_full_is_compacted_before_a_program_starts_by_itself() {
    let compact = BootDecision::Hold { program: 1, window_ms: 0 };
    let starts = BootDecision::Start { program: signed().unwrap(), trial: false };
    let by_itself = [None, Some(BootRequest::Confirm(1)), Some(BootRequest::PowerOn)];
    let left = [BootRequest::Resume(1), BootRequest::Start(1), BootRequest::Fresh(1)].map(Some);
    for (requests, decision) in [(by_itself, compact), (left, starts)] {
        for request in requests {
            let full = Circumstances { nearly_full: true, request, ..QUIET };
            assert_eq!(decide(&full, &policy(), |_| signed()), decision, "{request:?}");
        }
    }
}

#[test]
fn a_fault_of_the_bootloader_and_the_product_s_own_check_keep_it_there() {
    let fault = Circumstances { request: Some(BootRequest::Fault), ..QUIET };
    assert_eq!(
        decide(&fault, &policy(), |_| signed()),
        BootDecision::Stay { reason: Reason::Fault, refused: 0 }
    );
    let forbids = Policy { start_allowed: |number| number != 1, ..policy() };
    for request in [None, Some(BootRequest::Start(1)), Some(BootRequest::Trial(1))] {
        let asked = Circumstances { request, ..QUIET };
        let refused = u8::from(request.is_some());
        let stays = BootDecision::Stay { reason: Reason::Forbidden, refused };
        assert_eq!(decide(&asked, &forbids, |_| signed()), stays);
    }
    // Just below the limit.
    let crashes = Circumstances { crash_resets: 2, ..QUIET };
    assert!(matches!(decide(&crashes, &policy(), |_| signed()), BootDecision::Start { .. }));
}

/// What is wrong with a program is a reason of its own.
#[test]
fn the_reason_names_what_is_wrong_with_the_program() {
    for (invalid, reason) in [
        (Invalid::NoSuchProgram, Reason::NoProgram),
        (Invalid::Absent, Reason::NoProgram),
        (Invalid::Size, Reason::Damaged),
        (Invalid::Crc, Reason::Damaged),
        (Invalid::Vectors(VectorFault::StackPointer), Reason::Vectors),
        (Invalid::Vectors(VectorFault::NotThumb), Reason::Vectors),
    ] {
        let decision = decide(&QUIET, &policy(), |_| Err(invalid));
        assert!(
            matches!(decision, BootDecision::Stay { reason: stays, .. } if stays == reason),
            "{invalid:?}"
        );
    }
}

/// A chip that had the map with the bootloader in sectors 0 and 1, its journal in 2 and 3 and its program from
/// sector 4 on, gets today's: sector 1 has code, and sector 2 a whole journal with the record of a program
/// that is not where it says. Nothing starts, for a reason that has a name, and each value can be stored.
#[test]
fn a_journal_of_the_map_before_this_one_starts_nothing_and_can_be_written() {
    let before = [Region::new(0x0800_8000, 0x4000), Region::new(0x0800_C000, 0x4000)];
    assert_eq!(LAYOUT.parameters.map(|region| region.base), [0x0800_4000, before[0].base]);
    // A slot has 28 bytes: after more than 585 stores the other region has the values.
    let blank = (vec![], Invalid::Vectors(VectorFault::StackPointer), Reason::Vectors);
    let vectors = [0x2001_FFC0_u32, 0x0802_0189].map(u32::to_le_bytes).concat();
    for (stores, (there, invalid, reason)) in
        [(1, blank.clone()), (600, blank), (600, (vectors, Invalid::Crc, Reason::Damaged))]
    {
        let mut flash = ModelFlash::new(LAYOUT.chip);
        let program = [0xA5; 64];
        flash.poke(0x0801_0000, &program);
        let mut journal = Journal::open(&flash, before);
        let record = ProgramRecord {
            seal: None,
            withdrawn: false,
            size: 64,
            crc: boot_core::crc32(&program),
            signed: true,
            confirmed: true,
            version: 0,
            half_erased: false,
        };
        let store = |flash: &mut ModelFlash, journal: &mut Journal, key, value| {
            journal.store(key, value);
            run(flash, |flash, outcome| journal.next(flash, outcome)).unwrap();
        };
        store(&mut flash, &mut journal, Key::program(1), record.value());
        for count in 0..stores {
            store(&mut flash, &mut journal, Key::CRASH_COUNT, [count, 0, 0, 0]);
        }
        flash.poke(0x0800_4000, &[0x4B; 0x3000]);
        flash.poke(0x0802_0000, &there);

        let mut journal = Journal::open(&flash, LAYOUT.parameters);
        let found = verify(&flash, &journal, &LAYOUT, CrcKind::Crc32, 1);
        assert_eq!(found, Err(invalid), "{stores} stores");
        let decision = decide(&QUIET, &policy(), |_| Err(found.unwrap_err()));
        // 1F57h/1 says that it is no valid program.
        assert_eq!(decision, BootDecision::Stay { reason, refused: 1 });
        for count in 0..600 {
            store(&mut flash, &mut journal, Key::NODE, [count, 1, 0, 0]);
            let again = Journal::open(&flash, LAYOUT.parameters);
            assert_eq!(again.get(&flash, Key::NODE), Some([count, 1, 0, 0]), "{stores} stores");
        }
        assert_eq!(flash.cells(Region::new(0x0801_0000, 64)), program, "outside of the journal");
    }
}

/// 1F57h reports a start that a client requested and that is not possible. Of a start that nobody
/// requested it reports a damaged program alone: a device without a program has no error.
#[test]
fn a_start_that_is_refused_names_its_program() {
    let refused = |request, policy: Policy, verified: fn() -> Result<VerifiedProgram, Invalid>| {
        let circumstances = Circumstances { request, ..QUIET };
        match decide(&circumstances, &policy, |_| verified()) {
            BootDecision::Stay { refused, .. } => refused,
            _ => 0,
        }
    };
    let with = |more: fn(&mut Policy)| {
        let mut policy = policy();
        more(&mut policy);
        policy
    };
    for request in [BootRequest::Start(1), BootRequest::Trial(1), BootRequest::Fresh(1)] {
        assert_eq!(refused(Some(request), policy(), || Err(Invalid::Absent)), 1, "{request:?}");
        assert_eq!(refused(Some(request), policy(), || Err(Invalid::Crc)), 1, "{request:?}");
        let nodes = with(|policy| policy.node_ids = 6..=100);
        assert_eq!(refused(Some(request), nodes, signed), 1, "{request:?}");
        let forbidden = with(|policy| policy.start_allowed = |_| false);
        assert_eq!(refused(Some(request), forbidden, signed), 1, "{request:?}");
        assert_eq!(refused(Some(request), policy(), signed), 0, "{request:?}");
    }
    assert_eq!(refused(Some(BootRequest::Start(2)), policy(), || Err(Invalid::Absent)), 2);
    assert_eq!(refused(Some(BootRequest::Start(1)), policy(), unsigned), 1);
    for damage in [Invalid::Crc, Invalid::Size, Invalid::Vectors(VectorFault::ResetVector)] {
        let verified: fn() -> Result<VerifiedProgram, Invalid> = match damage {
            Invalid::Crc => || Err(Invalid::Crc),
            Invalid::Size => || Err(Invalid::Size),
            _ => || Err(Invalid::Vectors(VectorFault::ResetVector)),
        };
        assert_eq!(refused(None, policy(), verified), 1, "{damage:?}");
        assert_eq!(refused(Some(BootRequest::Resume(1)), policy(), verified), 1, "{damage:?}");
        assert_eq!(refused(Some(BootRequest::Stay), policy(), verified), 0, "{damage:?}");
    }
    assert_eq!(refused(None, policy(), || Err(Invalid::Absent)), 0);
    assert_eq!(refused(None, policy(), unsigned), 0);
    assert_eq!(refused(None, with(|policy| policy.node_ids = 6..=100), signed), 0);
}

/// Without a bootloader to stay in, each program has its turn, until one starts.
#[test]
fn the_programs_with_autostart_are_tried_first_and_then_the_others() {
    let order = |autostart, programs, starts: u8| {
        let mut tried = Vec::new();
        fallback(&Policy { autostart, programs, ..policy() }, |number| {
            if !tried.contains(&number) {
                tried.push(number);
            }
            number == starts
        });
        tried
    };
    assert_eq!(order(Autostart::InOrder, &[1], 0), [1]);
    assert_eq!(order(Autostart::List(&[]), &[1], 0), [1]);
    assert_eq!(order(Autostart::List(&[]), &[1, 2], 0), [1, 2]);
    assert_eq!(order(Autostart::List(&[2]), &[1, 2], 0), [2, 1]);
    assert_eq!(order(Autostart::List(&[2]), &[1, 2, 3], 0), [2, 1, 3]);
    assert_eq!(order(Autostart::List(&[2]), &[1, 2, 3], 1), [2, 1]);
    assert_eq!(order(Autostart::Function(|| &[3, 2]), &[1, 2, 3], 2), [3, 2]);
}

/// The first program of the list that may start does, whatever is wrong with those before it; a request
/// names one program, and no other one takes its place.
#[test]
fn of_several_programs_the_preferred_one_that_may_start_does() {
    /// Two programs: what is wrong with each.
    type Faults = [Option<Invalid>; 2];
    const GOOD: Option<Invalid> = None;
    const ABSENT: Option<Invalid> = Some(Invalid::Absent);
    const DAMAGED: Option<Invalid> = Some(Invalid::Crc);
    let decide_with = |autostart, circumstances: Circumstances, faults: Faults, start_allowed| {
        let tried = RefCell::new(Vec::new());
        let policy = Policy { autostart, programs: &[1, 2], start_allowed, ..policy() };
        let decision = decide(&circumstances, &policy, |number| {
            tried.borrow_mut().push(number);
            match number {
                1 | 2 => faults[usize::from(number) - 1].map_or_else(signed, Err),
                _ => Err(Invalid::NoSuchProgram),
            }
        });
        (decision, tried.into_inner())
    };
    let starts = |autostart, faults| {
        let (decision, tried) = decide_with(autostart, QUIET, faults, |_| true);
        matches!(decision, BootDecision::Start { trial: false, .. }).then(|| *tried.last().unwrap())
    };
    let listed = Autostart::List;
    for (autostart, faults, expected) in [
        (Autostart::InOrder, [GOOD, GOOD], Some(1)),
        (Autostart::InOrder, [ABSENT, GOOD], Some(2)),
        (Autostart::InOrder, [DAMAGED, GOOD], Some(2)),
        (Autostart::InOrder, [ABSENT, ABSENT], None),
        (listed(&[2, 1]), [GOOD, GOOD], Some(2)),
        (listed(&[2, 1]), [GOOD, ABSENT], Some(1)),
        (listed(&[1]), [ABSENT, GOOD], None),
        (listed(&[]), [GOOD, GOOD], None),
        (Autostart::Function(|| &[2]), [GOOD, GOOD], Some(2)),
        // A function that names what there is not.
        (Autostart::Function(|| &[7, 0, 1]), [GOOD, GOOD], Some(1)),
        (Autostart::Function(|| &[]), [GOOD, GOOD], None),
    ] {
        assert_eq!(starts(autostart, faults), expected, "{autostart:?} {faults:?}");
    }
    // One that is not allowed now is passed over, too.
    let (decision, tried) = decide_with(Autostart::InOrder, QUIET, [GOOD, GOOD], |number| number == 2);
    assert!(matches!(decision, BootDecision::Start { .. }));
    assert_eq!(tried, [1, 2]);
    // The reason to stay is that of the first one that is there.
    for (faults, expected) in [
        ([ABSENT, ABSENT], Reason::NoProgram),
        ([ABSENT, DAMAGED], Reason::Damaged),
        ([DAMAGED, ABSENT], Reason::Damaged),
        ([DAMAGED, Some(Invalid::Vectors(VectorFault::NotThumb))], Reason::Damaged),
    ] {
        let (decision, _) = decide_with(Autostart::InOrder, QUIET, faults, |_| true);
        assert!(matches!(decision, BootDecision::Stay { reason, .. } if reason == expected), "{faults:?}");
    }
    for request in
        [BootRequest::Start(1), BootRequest::Trial(1), BootRequest::Resume(1), BootRequest::Confirm(1)]
    {
        let requested = Circumstances { request: Some(request), ..QUIET };
        let (decision, tried) = decide_with(Autostart::InOrder, requested, [ABSENT, GOOD], |_| true);
        assert!(matches!(decision, BootDecision::Stay { .. }), "{request:?}");
        assert_eq!(tried, [1], "{request:?}");
    }
}
