//! Which of the built bootloaders accepts keys: only the one for sealed images.

use coboot_tests::firmware;
use coflash::file::sealed::provision::{provision, ProvisionFault};
use coflash::file::sealed::{key_block, SigningKey};
use coflash::file::{load, Firmware};

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
