//! The budget of the design: at 1 Mbit/s a download comes to 95 % of what the wire allows, erasing,
//! programming and verifying included.

use canopen::BitRate;
use coboot_tests::throughput::{load, measure};

#[test]
fn a_download_at_1_mbit_comes_to_95_percent_of_the_wire() {
    for kib in [64, 256] {
        let measured = measure(BitRate::K1000, kib);
        assert!(measured.percent() >= 95, "{measured:?}");
        // Nothing is faster than its limits: the yardstick is right, too.
        assert!(measured.took >= measured.limit(), "{measured:?}");
    }
}

/// The host tool as it is, with its default block size, keeps a fast bus busy: sectors are erased
/// ahead of the data, and a look at the status takes little of its time.
#[test]
fn the_host_tool_saturates_the_bus_at_1_mbit() {
    let load = load(BitRate::K1000, 256, 1024);
    assert!((95..=100).contains(&load.percent()), "{load:?}");
    // 256 KiB by 7 in a frame, and what goes with it.
    assert!((37_450..42_000).contains(&load.frames), "{load:?}");
}
