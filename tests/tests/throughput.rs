//! The budget of the design: at 1 Mbit/s a download comes to 90 % of what the wire allows, erasing, programming and
//! verifying included.

use canopen::BitRate;
use coboot_tests::throughput::measure;

#[test]
fn a_download_at_1_mbit_uses_nine_tenths_of_the_wire() {
    for kib in [64, 256] {
        let measured = measure(BitRate::K1000, kib);
        assert!(measured.percent() >= 90, "{measured:?}");
        // Nothing is faster than its limits: the yardstick is right, too.
        assert!(measured.took >= measured.limit(), "{measured:?}");
    }
}
