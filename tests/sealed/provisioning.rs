//! Which of the built bootloaders accepts keys: only the one for sealed images. And which sectors its
//! devices protect.

use coboot_tests::firmware;
use coflash_core::file::sealed::provision::{protected_sectors, provision, ProvisionFault};
use coflash_core::file::sealed::{key_block, SigningKey};
use coflash_core::file::{load, Firmware};

#[test]
fn only_the_bootloader_for_sealed_images_gets_keys() {
    let root = SigningKey::from_seed([1; 32]).unwrap().public();
    let block = key_block(&[root], &[], 0, 0, false).unwrap();
    let provisioned = |name: &str| {
        let loaded = load(&firmware::dir().join(name), None, None);
        let Ok(Firmware::Image(image)) = loaded else { panic!("{name}: {loaded:?}") };
        provision(&image, firmware::board(), &block).map(drop)
    };
    assert_eq!(provisioned(firmware::BOOTLOADER_SEALED), Ok(()));
    for name in [firmware::BOOTLOADER, firmware::BOOTLOADER_LEAST, firmware::BOOTLOADER_LIFT] {
        assert_eq!(provisioned(name), Err(ProvisionFault::Open), "{name}");
    }
}

/// With renewal the home of the RAM image (sector 4) has to stay writable.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn a_bootloader_that_can_be_renewed_leaves_its_home_writable() {
    for (name, mask) in [(firmware::BOOTLOADER_SEALED, 0b0_0001), (firmware::BOOTLOADER_LEAST, 0b1_0001)] {
        let loaded = load(&firmware::dir().join(name), None, None);
        let Ok(Firmware::Image(image)) = loaded else { panic!("{name}: {loaded:?}") };
        assert_eq!(protected_sectors(&image, firmware::board()), mask, "{name}");
    }
}
