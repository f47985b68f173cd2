//! A sealed image from any source, before the check of its signatures.
//!
//! Must hold: no bytes cause a panic of the parser or of the judge; a complete head is not longer
//! than the bytes; each record lies inside the manifest; an image that passes the judge is for this
//! device and needs keys that the device has; one for the bootloader is signed by a key for bootloaders.
#![cfg_attr(fuzzing, no_main)]

use seal::judge::{judge, Device};
use seal::key_block::{KEKS, KEK_COUNT, KEY, ROOTS, SIZE};
use seal::wire::{head_size, role, tag, word, Head, Requirements, BOOTLOADER, RECIPIENT};

const DEVICE: Device<'_> = Device {
    vendor_id: 0x319,
    product_code: 1,
    revision: 2,
    unique_id: *b"unique id 96",
    program: 1,
    has: Some(Requirements { board: 7, services: 1, features: 0 }),
    is_data: false,
    room: 0xF_0000,
    counter: 5,
    epoch: 1,
    keys: &[0; SIZE],
};

coboot_fuzz::target!(|bytes: &[u8]| {
    // The first byte is the id of the root, so that the fuzzer can find it.
    let Some((id, bytes)) = bytes.split_first() else { return };
    let mut keys = [0; SIZE];
    keys[ROOTS] = *id;
    keys[KEKS] = *id;
    let Ok(size) = head_size(bytes) else { return };
    assert!(size >= 8);
    if size > bytes.len() {
        return;
    }
    let head = Head(&bytes[..size]);
    assert!(head.manifest().len() <= size);
    let records: usize = head.records().map(|(_, record)| 4 + record.len()).sum();
    assert!(records <= head.manifest().len());
    for program in [DEVICE.program, BOOTLOADER] {
        let device = Device { keys: &keys, program, ..DEVICE };
        let Ok(needs) = judge(head, &device) else { continue };
        assert_eq!((head.vendor_id(), head.product_code()), (device.vendor_id, device.product_code));
        assert_eq!(head.program(), program);
        assert!(head.counter() >= device.counter && needs.epoch >= device.epoch);
        assert!(head.size() <= device.room);
        assert!(word(&keys, needs.root) != 0);
        if let Some((key, at)) = needs.recipient {
            assert!((KEKS..KEKS + KEK_COUNT * KEY).contains(&key));
            assert!(at + RECIPIENT <= head.manifest().len());
        }
        if program == BOOTLOADER {
            // A key for programs must not sign a bootloader, and the image says what it needs.
            assert!(head.certificate().is_none_or(|certificate| certificate.role() == role::BOOTLOADER));
            assert!(head.records().any(|(record, _)| record == tag::BOOTLOADER));
        }
    }
});
