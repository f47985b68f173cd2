//! The conformance checks on an emulated board, and what they leave behind.

use std::sync::atomic::AtomicBool;
use std::sync::Arc;
use std::time::Duration;

use canopen::NodeId;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash::conform::{checks, run, Check, Outcome};
use coflash::device::Error;
use coflash::update::{flash, FlashOptions};

/// The checks that fail, and those that cannot be judged.
fn verdicts(bench: &mut Bench, checks: &[Check]) -> (Vec<String>, Vec<String>) {
    let (mut failed, mut skipped) = (Vec::new(), Vec::new());
    let node = NodeId::new(NODE).unwrap();
    run(bench, node, checks, Duration::from_millis(500), &Arc::default(), &mut |verdict| match &verdict
        .outcome
    {
        Outcome::Passed => {}
        Outcome::Failed(what) => failed.push(format!("{}: {what}", verdict.check.id)),
        Outcome::Skipped(why) => skipped.push(format!("{}: {why}", verdict.check.id)),
    })
    .unwrap();
    (failed, skipped)
}

fn ids(lines: &[String]) -> Vec<&str> {
    lines.iter().filter_map(|line| line.split(':').next()).collect()
}

#[test]
fn the_bootloader_passes() {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    let (failed, skipped) = verdicts(&mut bench, &checks());
    assert!(failed.is_empty(), "{failed:#?}");
    // 1017h is const, and a bootloader has no operational state.
    assert_eq!(ids(&skipped), ["HB-004", "NMT-001", "NMT-002", "NMT-003", "NMT-006"], "{skipped:#?}");
    bench.assert_nothing_unmodelled();
}

#[test]
fn an_application_passes_and_keeps_its_state() {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    flash(&mut bench.session(), &firmware::blocks(firmware::APP_V1), &FlashOptions::default(), &mut |_| {})
        .unwrap();
    bench.post(0x000, &[0x01, NODE]);
    bench.run_ms(1100);
    let checks: Vec<_> = checks().into_iter().filter(|check| !check.resets).collect();
    let (failed, skipped) = verdicts(&mut bench, &checks);
    assert!(failed.is_empty(), "{failed:#?}");
    assert!(
        skipped.iter().all(|line| line.starts_with("PRG-") || line.starts_with("HB-004")),
        "{skipped:#?}"
    );
    let operational = |bench: &mut Bench| {
        let from = bench.time();
        bench.run_ms(1100);
        let frames = bench.frames_since(from);
        let beats = frames.iter().filter(|(_, id, _)| *id == coboot_tests::bench::HEARTBEAT);
        let states: Vec<_> = beats.map(|(_, _, data)| data.clone()).collect();
        assert!(!states.is_empty() && states.iter().all(|state| state == &[5]), "{states:?}");
    };
    operational(&mut bench);

    // The same when the user cancels.
    let cancelled = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&cancelled);
    let node = NodeId::new(NODE).unwrap();
    let result = run(&mut bench, node, &checks, Duration::from_millis(500), &cancelled, &mut |_| {
        flag.store(true, std::sync::atomic::Ordering::Relaxed);
    });
    assert!(matches!(result, Err(Error::Cancelled)), "{result:?}");
    operational(&mut bench);
    bench.assert_nothing_unmodelled();
}
