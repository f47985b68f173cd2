//! The conformance checks on both kinds of sealed device: with keys, and still without.

use std::sync::Arc;
use std::time::Duration;

use canopen::NodeId;
use coboot_tests::bench::NODE;
use coboot_tests::sealed_board::{board, open_board};
use coflash_conform::{checks, run, Means, Outcome};

#[test]
fn sealed_devices_pass() {
    // A device with keys takes sealed images alone, so these two, which send others, say nothing about it.
    let unsealed = ["REN-010", "REN-011"];
    for (what, mut bench, and) in [("with keys", board(), &unsealed[..]), ("without keys", open_board(), &[])]
    {
        bench.switch_on();
        let harmless: Vec<_> = checks().into_iter().filter(|check| !check.installs).collect();
        let (mut failed, mut skipped) = (Vec::new(), Vec::new());
        let means = Means::of(Duration::from_millis(500));
        let node = NodeId::new(NODE).unwrap();
        run(&mut bench, node, &harmless, means, &Arc::default(), &mut |verdict| match &verdict.outcome {
            Outcome::Passed => {}
            Outcome::Failed(why) => failed.push(format!("{}: {why}", verdict.check.id)),
            Outcome::Skipped(_) => skipped.push(verdict.check.id),
        })
        .unwrap();
        assert!(failed.is_empty(), "{what}: {failed:#?}");
        // 1017h is const, and a bootloader has no operational state: as of an open device.
        let open = ["HB-004", "NMT-001", "NMT-002", "NMT-003", "NMT-006"];
        assert_eq!(skipped, [&open[..], and].concat(), "{what}");
        bench.assert_nothing_unmodelled();
    }
}
