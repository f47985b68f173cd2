//! The dialects of 1F50h and 1F51h (docs/dialects.md): scripted sessions with the frames of their documents.

use coboot_tests::bench::Bench;
use coboot_tests::{firmware, script};

fn bench(bootloader: &str) -> Bench {
    let mut bench = Bench::of_image(bootloader);
    bench.power_on();
    bench.run_ms(50);
    bench
}

#[test]
fn a_master_that_knows_paulus() {
    let mut bench = bench(firmware::BOOTLOADER_PAULUS);
    script::play(&mut bench, "paulus.candump");
    bench.assert_nothing_unmodelled();
}
