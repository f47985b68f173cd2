//! The boot decision: the promised order of its checks.

mod model;

use boot_core::crc::CrcKind;
use boot_core::decision::{decide, BootDecision, Circumstances, Policy, StayReason};
use boot_core::flash::run;
use boot_core::program::{verify, Invalid, VerifiedProgram};
use boot_core::store::{Journal, Key, Parameters, ProgramRecord};
use model::ModelFlash;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;
use shared_abi::vectors::VectorFault;
use shared_abi::warm_start::{BootRequest, Owed};

const QUIET: Circumstances = Circumstances { request: None, strap: false, crash_resets: 0, node_id: 5 };

fn policy() -> Policy {
    Policy {
        autostart: Some(1),
        max_crash_resets: 3,
        node_ids: 1..=100,
        rescue_window_ms: 0,
        rescue_window_confirmed_ms: 0,
        start_allowed: |_| true,
    }
}

/// A program of 64 bytes as a download leaves it, and its check.
fn check(signed: bool, damage: impl FnOnce(&mut ModelFlash)) -> Result<VerifiedProgram, Invalid> {
    let mut flash = ModelFlash::new(LAYOUT.chip);
    let mut bytes = vec![0xA5; 64];
    bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&0x0801_0189_u32.to_le_bytes());
    flash.poke(0x0801_0000, &bytes);
    let mut journal = Journal::open(&flash, LAYOUT.parameters);
    let record = ProgramRecord {
        #[cfg(feature = "sealed")]
        seal: None,
        size: 64,
        crc: boot_core::crc32(&bytes),
        signed,
        confirmed: false,
        version: 0,
        half_erased: false,
    };
    journal.store(Key::Program(1), record.value());
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
        BootDecision::Stay(reason) => reason,
        start => panic!("{start:?}"),
    };
    let request = |request| Circumstances { request: Some(request), ..QUIET };
    let owed = BootRequest::Owed(Owed { program: 1, value: 3, node_id: 5 });
    assert_eq!(stay(request(BootRequest::Stay), policy()), StayReason::Requested);
    assert_eq!(stay(request(owed), policy()), StayReason::Requested);
    assert_eq!(stay(Circumstances { strap: true, ..QUIET }, policy()), StayReason::Strap);
    assert_eq!(
        stay(Circumstances { strap: true, ..request(BootRequest::Start(1)) }, policy()),
        StayReason::Strap
    );
    assert_eq!(stay(Circumstances { crash_resets: 3, ..QUIET }, policy()), StayReason::CrashLoop);
    assert_eq!(stay(QUIET, Policy { autostart: None, ..policy() }), StayReason::NoAutostart);
    for node_id in [0, 101, 127, 255] {
        assert_eq!(stay(Circumstances { node_id, ..QUIET }, policy()), StayReason::NodeId);
    }
}

#[test]
fn without_signature_a_program_starts_as_a_trial_alone() {
    assert_eq!(decide(&QUIET, &policy(), |_| unsigned()), BootDecision::Stay(StayReason::Unsigned));
    let start = Circumstances { request: Some(BootRequest::Start(1)), ..QUIET };
    assert_eq!(decide(&start, &policy(), |_| unsigned()), BootDecision::Stay(StayReason::Unsigned));
    let policy = Policy { autostart: None, ..policy() };
    for request in [BootRequest::Trial(1), BootRequest::Fresh(1)] {
        let trial = Circumstances { request: Some(request), crash_resets: 9, ..QUIET };
        let expected = BootDecision::Start { program: unsigned().unwrap(), trial: true };
        assert_eq!(decide(&trial, &policy, |_| unsigned()), expected);
        let expected = BootDecision::Start { program: signed().unwrap(), trial: false };
        assert_eq!(decide(&trial, &policy, |_| signed()), expected, "a signed program is on no trial");
    }
}

#[test]
fn a_request_for_a_program_that_is_not_there_stays() {
    let start = Circumstances { request: Some(BootRequest::Start(7)), ..QUIET };
    let flash = ModelFlash::new(LAYOUT.chip);
    let journal = Journal::open(&flash, LAYOUT.parameters);
    let decision =
        decide(&start, &policy(), |number| verify(&flash, &journal, &LAYOUT, CrcKind::Crc32, number));
    assert_eq!(decision, BootDecision::Stay(StayReason::Program(Invalid::NoSuchProgram)));
    let decision =
        decide(&QUIET, &policy(), |number| verify(&flash, &journal, &LAYOUT, CrcKind::Crc32, number));
    assert_eq!(decision, BootDecision::Stay(StayReason::Program(Invalid::Absent)));
}

#[test]
fn any_damage_to_a_program_keeps_it_from_starting() {
    for offset in 8..64 {
        for bit in 0..8 {
            let damaged = check(true, |flash| flash.poke(0x0801_0000 + offset, &[0xA5 ^ 1 << bit]));
            assert_eq!(damaged, Err(Invalid::Crc));
        }
    }
    let erased = check(true, |flash| flash.poke(0x0801_0000, &[0xFF; 64]));
    assert_eq!(erased, Err(Invalid::Vectors(VectorFault::StackPointer)));
    assert!(
        check(true, |flash| flash.poke(0x0801_0040, &[0])).is_ok(),
        "what lies behind its size is not its own"
    );
}
