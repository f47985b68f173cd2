//! The product whose parameters are in an EEPROM (docs/eeprom.md), on a board that has none at these pins.

use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash_core::update::{flash, FlashOptions};

/// NVDATA (SYS TEC manual L-1112d_10, table 3).
const NVDATA: u32 = 0x10;

#[test]
fn without_its_eeprom_the_device_answers_and_says_so() {
    for level in [false, true] {
        let mut bench = Bench::of_image(firmware::BOOTLOADER_EEPROM);
        bench.machine().set_pin('B', 14, Some(level));
        bench.switch_on();
        let program = firmware::blocks(firmware::APP_V1);
        let refused = flash(&mut bench.session(), program, &FlashOptions::default(), &mut |_| {});
        let status = bench.session().read_number(Address::new(0x1F57, 1)).unwrap();
        assert!(refused.is_err() && status & 0xFFFF == NVDATA, "{level}: {status:X}h, {refused:?}");
        assert!(bench.is_bootloader(NODE));
        bench.assert_nothing_unmodelled();
    }
}
