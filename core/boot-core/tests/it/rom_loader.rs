//! 2008h: the device leaves for the loader in the ROM of the chip, if nothing speaks against it.

use boot_core::control::Policy;
use canopen::od::{Address, Objects};
use canopen::AbortCode;
use kit::bench::Bench;
use kit::model::{ModelFlash, CHIP};
use kit::rig::{block, raw, words, Rig, ESACADEMY_1, LIFT_1, PRODUCT_CODE, STANDARD_1};
use shared_abi::warm_start::BootRequest;

const ROM_LOADER: Address = Address::new(0x2008, 0);
/// In the present device state (CiA 301 table 22).
const STATE: Result<(), AbortCode> = Err(AbortCode(0x0800_0022));
/// FLASH_OPTCR from the factory (RM0090 section 3.9.10).
const FACTORY: u32 = 0x0FFF_AAED;

fn rig(setup: &'static kit::rig::Setup) -> Rig {
    let rig = Rig::new(setup, 8192);
    rig.chip.model().option_bytes = FACTORY;
    rig
}

#[test]
fn the_signature_alone_starts_the_loader_and_nothing_comes_after_it() {
    let mut rig = rig(&STANDARD_1);
    for wrong in [0, 1, u32::MAX, u32::from_be_bytes(*b"roml"), u32::from_le_bytes(*b"save")] {
        // A wrong signature (CiA 301, 1010h and 1011h).
        assert_eq!(
            rig.node.write(ROM_LOADER, &wrong.to_le_bytes()),
            Err(AbortCode(0x0800_0020)),
            "{wrong:X}"
        );
    }
    assert_eq!(rig.node.take_boot_request(), None);
    assert_eq!(rig.node.write(ROM_LOADER, b"roml"), Ok(()));
    assert_eq!(rig.node.write(ROM_LOADER, b"roml"), STATE);
    assert!(rig.command(1, 3).is_err());
    assert_eq!(rig.node.take_boot_request(), Some(BootRequest::RomLoader));
}

/// Who may not write a program may not do this.
#[test]
fn a_password_or_the_product_keeps_a_client_from_the_loader() {
    for setup in [&ESACADEMY_1, &LIFT_1] {
        let mut rig = rig(setup);
        assert_eq!(rig.node.write(ROM_LOADER, b"roml"), STATE, "{}", setup.name);
        rig.open(1);
        assert_eq!(rig.node.write(ROM_LOADER, b"roml"), Ok(()), "{}", setup.name);
    }
    let mut flash = ModelFlash::new(&CHIP);
    flash.option_bytes = FACTORY;
    let mut bench = Bench::with(&mut flash, Policy { allowed: || false, ..Policy::DEFAULT });
    assert_eq!(bench.node.write(ROM_LOADER, b"roml"), STATE);
}

#[test]
fn the_loader_is_not_started_where_it_cannot_run_or_while_the_flash_works() {
    let mut rig = rig(&STANDARD_1);
    for (option_bytes, starts) in [
        // The watchdog runs after each reset.
        (FACTORY & !(1 << 5), false),
        // Read-out protection of level 2, and of level 1.
        (FACTORY & !0xFF00 | 0xCC00, false),
        // A device without a chip.
        (0, false),
        (FACTORY & !0xFF00 | 0x5500, true),
    ] {
        rig.chip.model().option_bytes = option_bytes;
        assert_eq!(rig.node.write(ROM_LOADER, b"roml").is_ok(), starts, "{option_bytes:08X}h");
        assert_eq!(rig.node.take_boot_request().is_some(), starts);
    }
    let image = raw(&STANDARD_1, 1, 600);
    rig.command(1, 3).unwrap();
    rig.send(1, &block(0, 0, &words(&[600, 0, PRODUCT_CODE]))).unwrap();
    rig.settle();
    rig.send(1, &block(1, STANDARD_1.region(1).base, &image)).unwrap();
    assert_eq!(rig.node.write(ROM_LOADER, b"roml"), STATE);
    rig.settle();
    assert_eq!(rig.node.write(ROM_LOADER, b"roml"), Ok(()));
}
