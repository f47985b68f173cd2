//! The fields of a sealed image against bytes at literal offsets.

use crate::file::{manifest, put, record, signature};
use seal::access::{event, right};
use seal::wire::{array, flag, half, head_size, word, Certificate, Fault, Head, Recipient};
use seal::{access, key_block};

/// A number, the lowest byte first.
fn number(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

/// A certificate in which each byte has a value of its own.
fn certificate() -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..152).map(|at| at ^ 0xA5).collect();
    bytes[..4].copy_from_slice(b"CBK1");
    bytes[4..6].copy_from_slice(&152_u16.to_le_bytes());
    bytes
}

#[test]
fn a_number_has_its_lowest_byte_first() {
    let bytes = [0x11, 0xF1, 0xF2, 0xF3, 0xF4, 0x55];
    assert_eq!(word(&bytes, 1), 0xF4F3_F2F1);
    assert_eq!(half(&bytes, 3), 0xF4F3);
    assert_eq!(array(&bytes, 2), [0xF2, 0xF3, 0xF4]);
    assert_eq!(array(&bytes, 3), [0xF3, 0xF4, 0x55]);
    // Zeros, if there are too few.
    assert_eq!(array(&bytes, 4), [0; 3]);
}

#[test]
fn each_field_of_a_manifest_stands_at_its_offset() {
    let mut bytes: Vec<u8> = (0..180).map(|at| at ^ 0x5A).collect();
    bytes[4..6].copy_from_slice(&176_u16.to_le_bytes());
    let head = Head(&bytes);
    assert_eq!(head.manifest(), &bytes[..176]);
    assert_eq!([head.signatures(), head.flags(), head.program(), head.chunk()], [0x5C, 0x5D, 0x42, 0x43]);
    assert_eq!(head.vendor_id(), number(&bytes, 8));
    assert_eq!(head.product_code(), number(&bytes, 12));
    assert_eq!(head.version(), number(&bytes, 16));
    assert_eq!(head.counter(), number(&bytes, 20));
    assert_eq!(head.format(), 0x4140);
    assert_eq!(head.size(), number(&bytes, 28));
    assert_eq!(head.crc(), number(&bytes, 32));
    assert_eq!(head.payload(), number(&bytes, 36));
    assert_eq!(head.image_hash(), &bytes[40..72]);
    assert_eq!(head.chain(), bytes[72..104]);
    assert_eq!(head.nonce(), bytes[104..120]);
    assert_eq!(head.unique_id(), bytes[120..132]);
    assert_eq!(head.hardware(), number(&bytes, 132));
    assert_eq!(head.created(), u64::from_le_bytes(bytes[136..144].try_into().unwrap()));
    assert_eq!(head.dictionary(), &bytes[144..176]);
    assert!(head.certificate().is_none());
}

#[test]
fn each_field_of_a_certificate_stands_at_its_offset() {
    let bytes = certificate();
    let file = [manifest(&[], 1), bytes.clone(), vec![0; 72]].concat();
    let certificate = Head(&file).certificate().unwrap();
    assert_eq!(certificate.0, bytes);
    assert_eq!(certificate.signed(), &bytes[..88]);
    assert_eq!(certificate.size(), 152);
    assert_eq!([certificate.role(), certificate.algorithm()], [0xA3, 0xA2]);
    assert_eq!(certificate.epoch(), number(&bytes, 8));
    assert_eq!(certificate.vendor_id(), number(&bytes, 12));
    assert_eq!(certificate.product_code(), number(&bytes, 16));
    assert_eq!(certificate.lowest(), number(&bytes, 20));
    assert_eq!(certificate.highest(), number(&bytes, 24));
    assert_eq!(certificate.key(), bytes[28..60]);
    assert_eq!(certificate.root_id(), number(&bytes, 60));
    assert_eq!(certificate.reserved(), bytes[64..88]);
    assert_eq!(certificate.signature(), bytes[88..]);
    // It is one only if it is whole.
    assert!(Head(&file[..176 + 151]).certificate().is_none());
    assert_eq!(Certificate(&bytes[..10]).signed(), &[0_u8; 0]);
}

#[test]
fn each_field_of_a_recipient_stands_at_its_offset() {
    let bytes: [u8; 44] = core::array::from_fn(|at| at as u8 ^ 0xC3);
    let recipient = Recipient(&bytes);
    assert_eq!(recipient.key_id(), number(&bytes, 0));
    assert_eq!(recipient.check(), bytes[4..12]);
    assert_eq!(recipient.wrapped(), bytes[12..]);
}

#[test]
fn numbers_of_the_format() {
    assert_eq!(
        [flag::ENCRYPTED, flag::COMPRESSED, flag::DICTIONARY, flag::DATA, flag::WRITES_FLASH, flag::TEST],
        [0x01, 0x02, 0x08, 0x10, 0x20, 0x40]
    );
    assert_eq!(flag::KNOWN, 0x7B);
    assert_eq!(
        [
            right::ERASE,
            right::CLEAR_SIGNATURE,
            right::LOWER_COUNTER,
            right::STORE,
            right::READ_BACK,
            right::OPEN
        ],
        [0x01, 0x02, 0x04, 0x08, 0x10, 0x20]
    );
    assert_eq!(access::SEALED, 0x8000_0000);
    assert_eq!((access::SIGNED_CHALLENGE, access::CHALLENGE, access::REQUEST), (44, 48, 76));
    assert_eq!([event::INSTALLED, event::REFUSED, event::UNLOCKED], [0x1_0000, 0x2_0000, 0x3_0000]);
    assert_eq!((key_block::ROOTS, key_block::KEKS, key_block::CHECK), (16, 88, 252));
}

#[test]
fn the_size_of_a_head_becomes_known_with_its_bytes() {
    let records = record(2, &[0x11; 4]);
    let plain = [manifest(&records, 1), signature(7, 1, &[0x22; 64])].concat();
    // Manifest of 184 bytes; one word decides on the certificate; a header, and its signature.
    let of_plain = [(8, 8), (188, 188), (192, 192), (256, 256)];
    let full = [
        manifest(&records, 3),
        certificate(),
        signature(7, 1, &[0x22; 64]),
        signature(8, 2, &[0x33; 10]),
        signature(9, 1, &[]),
    ]
    .concat();
    let of_full = [(8, 8), (188, 188), (344, 344), (416, 416), (434, 434)];
    for (file, sizes) in [(&plain, &of_plain[..]), (&full, &of_full)] {
        let last = sizes.last().unwrap().1;
        assert_eq!(last, file.len());
        for have in 0..=file.len() {
            let expected = sizes.iter().find(|(until, _)| have < *until).map_or(last, |(_, size)| *size);
            assert_eq!(head_size(&file[..have]), Ok(expected), "{have} of {}", file.len());
        }
        // What follows changes nothing.
        assert_eq!(head_size(&[&file[..], &[0xFF; 100]].concat()), Ok(last));
    }
}

#[test]
fn bytes_that_cannot_be_a_head_are_refused_at_the_eighth() {
    for (size, signatures, expected) in [
        (176, 1, Ok(180)),
        (176, 3, Ok(180)),
        (1024, 1, Ok(1028)),
        (176, 0, Err(Fault::Format)),
        (176, 4, Err(Fault::Format)),
        (172, 1, Err(Fault::Format)),
        (1028, 1, Err(Fault::Format)),
        (178, 1, Err(Fault::Format)),
    ] {
        let mut bytes = manifest(&[], signatures);
        bytes[4..6].copy_from_slice(&u16::to_le_bytes(size));
        assert_eq!(head_size(&bytes[..8]), expected, "{size}, {signatures}");
    }
    for at in 0..4 {
        let mut bytes = manifest(&[], 1);
        bytes[at] ^= 1;
        assert_eq!(head_size(&bytes[..8]), Err(Fault::Format), "{at}");
    }
}

#[test]
fn the_largest_head_has_2048_bytes() {
    for (length, expected) in [(1016, Ok(2048)), (1017, Err(Fault::Format)), (u16::MAX, Err(Fault::Format))] {
        let mut bytes = manifest(&[0; 1024 - 176], 1);
        bytes.extend([7, 0, 0, 0, 1, 0]);
        bytes.extend(length.to_le_bytes());
        assert_eq!(bytes.len(), 1032);
        assert_eq!(head_size(&bytes), expected, "{length}");
    }
}

#[test]
fn a_signature_is_found_by_key_algorithm_and_length() {
    let signatures =
        [signature(7, 2, &[0x11; 64]), signature(7, 1, &[0x22; 60]), signature(7, 1, &[0x33; 64])];
    for certificate in [vec![], certificate()] {
        let head = [manifest(&record(2, &[0; 12]), 3), certificate].concat();
        let file = [head.clone(), signatures.concat()].concat();
        assert_eq!(Head(&file).signature(7), Some(&[0x33; 64]));
        assert_eq!(Head(&file).signature(8), None);
        // The first of two.
        let file = [head.clone(), signature(8, 1, &[0x44; 64]), signature(8, 1, &[0x55; 64])].concat();
        assert_eq!(Head(&file).signature(8), Some(&[0x44; 64]));
        // Only as many as the manifest announces.
        let mut file = [head.clone(), signatures.concat()].concat();
        file[6] = 2;
        assert_eq!(Head(&file).signature(7), None);
        // One that is cut off.
        let file = [head, signatures[2][..71].to_vec()].concat();
        assert_eq!(Head(&file).signature(7), None);
    }
}

#[test]
fn a_record_that_exceeds_the_manifest_has_no_bytes_and_no_known_tag() {
    let records = [record(0x8001, &[1, 2, 3, 4]), record(2, &[]), record(3, &[5; 8])].concat();
    let whole = manifest(&records, 1);
    let list =
        |file: &[u8]| Head(file).records().map(|(tag, bytes)| (tag, bytes.to_vec())).collect::<Vec<_>>();
    let expected = vec![(0x8001, vec![1, 2, 3, 4]), (2, vec![]), (3, vec![5; 8])];
    // After the manifest there is none.
    assert_eq!(list(&[&whole[..], &record(4, &[6; 4])].concat()), expected);
    assert_eq!(list(&manifest(&[], 1)), []);
    for (length, known) in [(9, 2), (u16::MAX, 2)] {
        let mut longer = whole.clone();
        let at = longer.len() - 10;
        longer[at..at + 2].copy_from_slice(&u16::to_le_bytes(length));
        let mut expected = expected[..known].to_vec();
        expected.push((0xFFFF, vec![]));
        assert_eq!(list(&longer), expected, "{length}");
    }
    // Too few bytes for tag and length.
    let mut short = manifest(&[9, 0], 1);
    put(&mut short, 8, 0);
    assert_eq!(list(&short), [(0xFFFF, vec![])]);
}
