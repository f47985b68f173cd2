//! The budget of the design: at 1 Mbit/s a download reaches 95 % of the wire's limit, including
//! erase, programming and verification.

use canopen::BitRate;
use coboot_tests::throughput::{load, measure, measure_form, Form};

#[test]
fn a_download_at_1_mbit_comes_to_95_percent_of_the_wire() {
    // A program of half a sector waits for the flash: the erase of the whole sector takes a second, and
    // the last data are checked after it.
    for (kib, percent) in [(64, 90), (128, 95), (256, 95)] {
        let measured = measure(BitRate::K1000, kib);
        assert!(measured.percent() >= percent, "{measured:?}");
        // Nothing is faster than its limits: this checks the limits, too.
        assert!(measured.took >= measured.limit(), "{measured:?}");
    }
}

/// The host tool with its default block size keeps a fast bus busy: sectors are erased ahead of the
/// data, and reading the status takes little of its time.
#[test]
fn the_host_tool_saturates_the_bus_at_1_mbit() {
    let load = load(BitRate::K1000, 256, 1024);
    assert!((95..=100).contains(&load.percent()), "{load:?}");
    // 256 KiB with 7 bytes in a frame, plus overhead.
    assert!((37_450..42_000).contains(&load.frames), "{load:?}");
}

/// At 500 kbit/s a sealed and compressed program is verified in the device in less time than the
/// raw one takes on the wire.
#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn a_compressed_program_is_faster_than_the_wire_of_the_raw_one() {
    let measured = measure_form(BitRate::K500, 256, Form::Compressed);
    assert!(measured.took < measured.wire, "{measured:?}");
    // Not faster than wire and flash permit.
    assert!(measured.took >= measured.flash, "{measured:?}");
    assert!(measured.percent() >= measured.file as u64 * 100 / (256 * 1024), "{measured:?}");
}
