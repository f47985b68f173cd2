//! The file for production of a sealed device.

use boot_core::store::Key;
use canopen::Address;
use coboot_tests::bench::NODE;
use coboot_tests::factory::{board, image, journal, latest};
use coboot_tests::firmware;
use coboot_tests::sealed_board::{board_of, keys, seal, sealer, status, write, COUNTER, KEKS};
use coflash_core::device::Transfers;
use coflash_core::file::factory::{Bootloader, Fault};
use coflash_core::file::sealed::provision::{provision, ProvisionFault};
use coflash_core::file::sealed::{Refusal, SealedFile, Sealer};
use kit::rig::crc32;

/// A bootloader with the keys of the tests.
fn provisioned(name: &str) -> Bootloader {
    let with_keys = provision(&image(name), firmware::board(), &keys()).unwrap();
    Bootloader::new(with_keys, firmware::board()).unwrap()
}

fn file(sealer: &Sealer<'_>, application: &str) -> SealedFile {
    SealedFile::parse(seal(sealer, application)).unwrap()
}

/// Encrypted and compressed: the tool has the keys of the device.
fn version_1() -> SealedFile {
    file(&Sealer { version: 1, encrypt_for: &*KEKS, compress: true, ..sealer(COUNTER + 1) }, firmware::APP_V1)
}

#[test]
fn a_sealed_device_starts_its_first_program_and_keeps_its_counter() {
    let boot = provisioned(firmware::BOOTLOADER_SEALED);
    let mut bench = board(&boot.join(&boot.sealed(1, &version_1()).unwrap()));
    let made = journal(&bench);
    bench.power_on();
    bench.await_program(200);
    assert!(!bench.is_bootloader(NODE));
    let crc = crc32(&firmware::raw(firmware::APP_V1));
    let seen = [0x1F56, 0x1F57, 0x2005].map(|at| bench.session().read_number(Address::new(at, 1)).unwrap());
    assert_eq!(seen, [crc, 0, 1]);
    bench.call_back();
    let update = |counter| seal(&sealer(counter), firmware::APP_V2);
    assert_eq!(write(&mut bench, &update(COUNTER), Transfers::Blocks).1, status::ROLLBACK);
    assert_eq!(write(&mut bench, &update(COUNTER + 1), Transfers::Blocks), (None, status::OK));
    bench.start_program();
    assert!(!bench.is_bootloader(NODE));

    // A device that got the same file over CAN has written the same.
    let mut updated = board_of(firmware::BOOTLOADER_SEALED).switched_on();
    assert_eq!(write(&mut updated, version_1().bytes(), Transfers::Blocks), (None, status::OK));
    let tags = [0x564E_4243, Key::counter(1).0, Key::program(1).0];
    assert_eq!(made, latest(&journal(&updated), &tags));
}

#[test]
fn what_a_sealed_device_refuses_is_refused() {
    let boot = provisioned(firmware::BOOTLOADER_SEALED);
    let refused = |file: &SealedFile| boot.sealed(1, file).map(drop);
    assert_eq!(boot.plain(1, &firmware::blocks(firmware::APP_V1)).map(drop), Err(Fault::Unsealed));
    let old = file(&sealer(COUNTER - 1), firmware::APP_V1);
    let counter = Refusal::Counter { image: COUNTER - 1, device: COUNTER };
    assert_eq!(refused(&old), Err(Fault::Refused(counter)));
    let other = file(&Sealer { product_code: 1, ..sealer(COUNTER) }, firmware::APP_V1);
    assert!(matches!(refused(&other), Err(Fault::Refused(Refusal::Product { .. }))));
    let mut bytes = version_1().bytes().to_vec();
    *bytes.last_mut().unwrap() ^= 1;
    let damaged = SealedFile::parse(bytes).unwrap();
    assert!(matches!(refused(&damaged), Err(Fault::Refused(Refusal::Chain { .. }))));
    let data = file(&Sealer { data: true, ..sealer(COUNTER) }, firmware::APP_V1);
    assert!(matches!(refused(&data), Err(Fault::Marked(_))));
    let writes = file(&Sealer { writes_flash: true, ..sealer(COUNTER) }, firmware::APP_V1);
    let renews = cfg!(staging);
    assert_eq!(refused(&writes).is_err(), renews);
    assert!(provisioned(firmware::BOOTLOADER_SEALED_WRITES_FLASH).sealed(1, &writes).is_ok());

    let of = |image| Bootloader::new(image, firmware::board());
    assert_eq!(of(image(firmware::BOOTLOADER_SEALED)).map(drop), Err(Fault::NoKeys));
    let plain = of(image(firmware::BOOTLOADER)).unwrap();
    assert_eq!(plain.sealed(1, &version_1()).map(drop), Err(Fault::Sealed));
    let mut block = keys();
    block[20] ^= 1;
    let damaged = provision(&image(firmware::BOOTLOADER_SEALED), firmware::board(), &block).unwrap();
    assert_eq!(of(damaged).map(drop), Err(Fault::Keys));
    let open = provision(&image(firmware::BOOTLOADER), firmware::board(), &keys()).map(drop);
    assert_eq!(open, Err(ProvisionFault::Open));
}
