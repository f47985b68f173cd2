//! Sealed images: the result matches the page of the format, and every change is refused with the
//! rule that it breaks.

use std::io::Write as _;
use std::process::{Command, Stdio};

use coflash_core::file::block_file::emit;
use coflash_core::file::sealed::blocks::{looks_like, FRONT};
use coflash_core::file::sealed::open::Closed;
use coflash_core::file::sealed::{
    carried, hash, verify, Carried, Certificate, Device, Kek, PublicKey, Refusal, Role, SealFault, Sealed,
    Sealer, SigningKey, Unsigned,
};
use proptest::prelude::*;
use seal::wire::Fault;

const VENDOR: u32 = 0x3F;
const PRODUCT: u32 = 0x4007_D151;

fn key(seed: u8) -> SigningKey {
    SigningKey::from_seed([seed; 32]).unwrap()
}

fn root() -> SigningKey {
    key(1)
}

fn release() -> SigningKey {
    key(2)
}

fn kek(byte: u8) -> Kek {
    Kek::new([byte; 32]).unwrap()
}

fn certified() -> Certificate {
    Certificate {
        role: Role::Release,
        epoch: 3,
        vendor_id: VENDOR,
        product_code: 0,
        lowest: 5,
        highest: 9,
        key: release().public(),
    }
}

fn sealer() -> Sealer<'static> {
    Sealer {
        certificate: Some(certified().signed_by(&root())),
        vendor_id: VENDOR,
        product_code: PRODUCT,
        version: 0x0064_0A01,
        counter: 7,
        chunk: 9,
        ..Sealer::default()
    }
}

/// Something that LZMA can do a little with.
fn image(size: usize) -> Vec<u8> {
    (0..size as u32).map(|at| (at * at / 7 % 251) as u8 & 0x3F).collect()
}

fn device<'a>(roots: &'a [PublicKey], keks: &'a [Kek]) -> Device<'a> {
    Device {
        roots,
        keks,
        vendor_id: Some(VENDOR),
        product_code: Some(PRODUCT),
        revision: Some(0x0001_0000),
        unique_id: Some([7; 12]),
        program: Some(1),
        room: Some(0x10000),
        counter: 6,
        epoch: 2,
        ..Device::default()
    }
}

fn refusal(file: &[u8], device: &Device<'_>) -> Refusal {
    verify(file, device).unwrap_err()
}

/// A block as the manual's figure has it: number, address, size, data, CRC-32.
fn block(number: u32, address: u32, data: &[u8]) -> Vec<u8> {
    let words = [number, address, data.len() as u32];
    let mut bytes: Vec<u8> = words.into_iter().flat_map(u32::to_le_bytes).collect();
    bytes.extend_from_slice(data);
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&bytes);
    bytes.extend_from_slice(&crc.to_le_bytes());
    bytes
}

/// The last block of what these bytes are.
fn last(bytes: &[u8]) -> Vec<u8> {
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(bytes);
    block(u32::MAX, 0, &[(bytes.len() as u32).to_le_bytes(), crc.to_le_bytes()].concat())
}

const START: u32 = 0x0801_0000;

/// A block file that carries these bytes, in pieces of 600.
fn in_blocks(bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut blocks = vec![block(0, 0, &[0; 8])];
    for (number, piece) in (0..).zip(bytes.chunks(600)) {
        blocks.push(block(number + 1, START + 600 * number, piece));
    }
    blocks.push(last(bytes));
    blocks
}

/// The manifest with a field changed, signed again by the release key; the rest as it is.
fn changed(file: &[u8], at: usize, field: &[u8]) -> Vec<u8> {
    let mut file = file.to_vec();
    file[at..at + field.len()].copy_from_slice(field);
    let manifest = usize::from(u16::from_le_bytes([file[4], file[5]]));
    let message = [&b"coboot sealed image 1\0"[..], &file[..manifest]].concat();
    let place = manifest + 152 + 8;
    file[place..place + 64].copy_from_slice(&release().sign(&message));
    file
}

/// Offsets and meanings from the table of the format, and nothing of what made the file.
#[test]
fn every_field_is_where_the_format_says() {
    let image = image(1300);
    let base = [9; 100];
    let sealer = Sealer {
        created: 1_420_070_400,
        unique_id: *b"unique id 12",
        hardware: 0x8000_0001,
        program: 2,
        data: true,
        text: Some("for people"),
        sbom: Some([0xAB; 32]),
        source: Some("c0ffee"),
        ..sealer()
    };
    let file = sealer.seal(&image, &release()).unwrap();
    let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap());
    assert_eq!(file[..4], *b"CBS1");
    let m = usize::from(u16::from_le_bytes([file[4], file[5]]));
    assert_eq!((m, file[6], file[7]), (176 + 4 + 12 + 4 + 32 + 4 + 8, 1, 1 << 4));
    assert_eq!([word(8), word(12), word(16), word(20)], [VENDOR, PRODUCT, 0x0064_0A01, 7]);
    assert_eq!(file[24..28], [2, 9, 1, 0]);
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&image);
    assert_eq!([word(28), word(32), word(36)], [1300, crc, 1300]);
    assert_eq!(file[40..72], hash(&image));
    assert_eq!(file[120..132], *b"unique id 12");
    assert_eq!(word(132), 0x8000_0001);
    assert_eq!(u64::from_le_bytes(file[136..144].try_into().unwrap()), 1_420_070_400);
    assert_eq!(file[144..176], [0; 32]);
    assert_eq!(file[176..192], *b"\x02\0\x0C\0for people\0\0");
    assert_eq!(file[192..196], *b"\x03\0\x20\0");
    assert_eq!(file[228..240], *b"\x04\0\x08\0c0ffee\0\0");
    assert_eq!(file[m..m + 4], *b"CBK1");
    let signature = m + 152;
    assert_eq!(word(signature), release().public().id());
    assert_eq!(file[signature + 4..signature + 8], [1, 0, 64, 0]);
    // Three chunks: 512, 512 and 276 bytes of payload.
    let chunks = &file[signature + 8 + 64..];
    assert_eq!(chunks.len(), 1300 + 3 * 32);
    let (first, rest) = chunks.split_at(544);
    let (second, third) = rest.split_at(544);
    assert_eq!(file[72..104], hash(first));
    assert_eq!((&first[..32], &second[..32]), (&hash(second)[..], &hash(third)[..]));
    assert_eq!(third[..32], [0; 32]);
    assert_eq!([&first[32..], &second[32..], &third[32..]].concat(), image);

    let with_base = Sealer { base: Some(&base), test: true, writes_flash: true, ..self::sealer() };
    let file = with_base.seal(&image, &release()).unwrap();
    assert_eq!(file[7], 1 << 1 | 1 << 3 | 1 << 5 | 1 << 6);
    assert_eq!(file[144..176], hash(&base));
}

/// FIPS 180-4 by NIST's example file "SHA512_256.pdf": "abc".
#[test]
fn the_hash_is_sha_512_256() {
    assert_eq!(digits(&hash(b"abc")), "53048e2681941ef99b2e29b76b4c7dabe4c2d0c634fc6d46e0e2f13107e7af23");
}

#[test]
fn a_device_takes_what_was_sealed_for_it() {
    let base = image(3001);
    let mut next = base.clone();
    next.extend_from_slice(b"and more");
    let keks = [kek(4), kek(5)];
    for size in [1, 511, 512, 513, 5000] {
        let image = image(size);
        for (compress, encrypt_for, base) in [
            (false, &[][..], None),
            (true, &[][..], None),
            (false, &keks[..], None),
            (true, &keks[..1], None),
            (true, &keks[..], Some(&base[..])),
        ] {
            let sealer = Sealer { compress, encrypt_for, base, ..sealer() };
            let file = sealer.seal(&image, &release()).unwrap();
            assert_eq!(sealer.seal(&image, &release()).unwrap(), file, "the same again");
            let roots = [key(8).public(), root().public()];
            for own in encrypt_for.iter().chain((encrypt_for.is_empty()).then_some(&keks[0])) {
                let own = std::slice::from_ref(own);
                let opened = verify(&file, &Device { base, ..device(&roots, own) }).unwrap();
                assert_eq!(opened.image.as_deref(), Some(&image[..]));
                assert_eq!((opened.signed_by, opened.root), (release().public(), root().public()));
                assert_eq!(opened.epoch, 3);
            }
            let without = verify(&file, &Device { keks: &[], ..device(&roots, &[]) }).unwrap();
            let closed = match (encrypt_for.is_empty(), base) {
                (false, _) => Some(Closed::Encrypted),
                (true, Some(_)) => Some(Closed::Dictionary),
                (true, None) => None,
            };
            assert_eq!((without.closed, without.image.is_none()), (closed, closed.is_some()));
        }
    }
}

/// A root may sign a program itself.
#[test]
fn a_root_signs_without_a_certificate() {
    let sealer = Sealer { certificate: None, ..sealer() };
    let file = sealer.seal(&image(100), &root()).unwrap();
    let opened = verify(&file, &device(&[root().public()], &[])).unwrap();
    assert_eq!((opened.signed_by, opened.epoch), (root().public(), 2));
    assert_eq!(refusal(&file, &device(&[key(8).public()], &[])), Refusal::NoCertificate);
}

#[test]
fn the_device_tells_which_rule_is_broken() {
    let roots = [root().public()];
    let good = device(&roots, &[]);
    let sealer = Sealer { unique_id: [7; 12], hardware: 1, ..sealer() };
    let file = sealer.seal(&image(1000), &release()).unwrap();
    assert!(verify(&file, &good).is_ok());
    let id = release().public().id();
    let vendor = Refusal::Vendor { image: VENDOR, device: 1 };
    let product = Refusal::Product { image: PRODUCT, device: 1 };
    let hardware = Refusal::Hardware { mask: 1, device: 33 };
    let cases = [
        (Device { vendor_id: Some(1), ..good }, vendor, Fault::WrongVendor),
        (Device { product_code: Some(1), ..good }, product, Fault::WrongProduct),
        (Device { program: Some(2), ..good }, Refusal::Program { image: 1, device: 2 }, Fault::WrongProduct),
        (Device { unique_id: Some([8; 12]), ..good }, Refusal::UniqueId, Fault::WrongProduct),
        (Device { revision: Some(33), ..good }, hardware, Fault::WrongProduct),
        (Device { room: Some(999), ..good }, Refusal::TooLarge { image: 1000, device: 999 }, Fault::Address),
        (Device { counter: 8, ..good }, Refusal::Counter { image: 7, device: 8 }, Fault::Rollback),
        (Device { epoch: 4, ..good }, Refusal::Epoch { image: 3, device: 4 }, Fault::Rollback),
        (Device { roots: &[], ..good }, Refusal::Root(root().public().id()), Fault::Key),
    ];
    for (device, expected, fault) in cases {
        let found = refusal(&file, &device);
        assert_eq!((found.fault(), &found), (fault, &expected));
        assert!(!found.advice().to_string().is_empty());
    }
    for (device, fits) in [(Some(32), true), (Some(0), true), (Some(1), false)] {
        assert_eq!(verify(&file, &Device { revision: device, ..good }).is_ok(), fits);
    }

    // Each of these is what its signer has signed.
    let found = u32::from_le_bytes(file[32..36].try_into().unwrap());
    let unequal = "payload and image have different sizes, and it is not compressed";
    let cases: [(usize, &[u8], Refusal); 12] = [
        (7, &[1 << 2], Refusal::Field("it has an unknown flag")),
        (7, &[1 << 3], Refusal::Field("it has a dictionary but is not compressed")),
        (25, &[14], Refusal::Field("no device accepts chunks of this size")),
        (26, &[2, 0], Refusal::Field("it needs a newer bootloader")),
        (28, &[0; 4], Refusal::Field("it is empty")),
        (28, &[1, 0, 0, 0], Refusal::Field(unequal)),
        (40, &[0; 32], Refusal::Hash),
        (32, &[0; 4], Refusal::Crc { found, said: 0 }),
        (7, &[1 << 6], Refusal::Test),
        (7, &[1], Refusal::Kek),
        (72, &[0; 32], Refusal::Chain { number: 1, of: 2 }),
        (7, &[1 << 1], Refusal::Compression),
    ];
    for (at, field, expected) in cases {
        assert_eq!(refusal(&changed(&file, at, field), &good), expected);
    }
    assert!(verify(&changed(&file, 7, &[1 << 6]), &Device { for_tests: true, ..good }).is_ok());

    // And these are not.
    let last = file.len() - 1;
    for (at, expected) in [(16, Refusal::Signature(id)), (last, Refusal::Chain { number: 2, of: 2 })] {
        let mut wrong = file.clone();
        wrong[at] ^= 1;
        assert_eq!(refusal(&wrong, &good), expected);
    }
    let cut_off = Refusal::CutOff { needed: last as u64 + 1, found: last as u64 };
    assert_eq!(refusal(&file[..last], &good), cut_off);
    let longer = [&file[..], &[0]].concat();
    assert_eq!(refusal(&longer, &good), Refusal::TooLong { needed: last as u64 + 1, found: last as u64 + 2 });
    assert_eq!(refusal(b"S0", &good), Refusal::NotSealed);
    assert_eq!(refusal(b"CBS1\x01\0\x01\0", &good), Refusal::Head);
}

#[test]
fn a_block_file_carries_a_sealed_image() {
    let image = sealer().seal(&image(900), &release()).unwrap();
    for control in [8, 12, 24] {
        let mut blocks = in_blocks(&image);
        blocks[0] = block(0, 0, &vec![0; control]);
        let file = blocks.concat();
        assert!(looks_like(&file[..FRONT]));
        let carried = carried(file.clone()).unwrap();
        assert!(carried.image == image);
        assert_eq!(emit(&carried.blocks.unwrap()), file);
        assert!(verify(&carried.image, &device(&[root().public()], &[])).is_ok());
    }
    // What carries none stays what it is.
    for other in [b"".to_vec(), image.clone(), image[..3].to_vec(), b"CBS1".to_vec()] {
        assert_eq!(carried(other.clone()).unwrap(), Carried { image: other, blocks: None });
    }
    let plain = in_blocks(&[&[0; 4], &image[..]].concat()).concat();
    assert!(!looks_like(&plain));
    assert_eq!(carried(plain.clone()).unwrap(), Carried { image: plain, blocks: None });
}

/// Numbers, addresses, sizes and CRCs are made wrong one by one; all CRCs but the one in question fit.
#[test]
fn blocks_that_carry_no_whole_image_are_refused() {
    let image = sealer().seal(&image(900), &release()).unwrap();
    let good = in_blocks(&image);
    let count = good.len();
    assert_eq!(count, 5);
    let fault = |blocks: &[Vec<u8>]| carried(blocks.concat()).unwrap_err().to_string();
    let of = |number: usize, address: u32, at: usize| {
        block(number as u32, address, image.chunks(600).nth(at).unwrap())
    };

    // Cut off, at each byte after those that show that it is one.
    let whole = good.concat();
    for end in FRONT..whole.len() {
        assert!(carried(whole[..end].to_vec()).is_err(), "{end}");
    }
    assert!(fault(&good[..count - 1]).contains("ends without its last block"));
    assert!(fault(&[&good[..], &[vec![0]]].concat()).contains("there are more bytes after the last block"));
    // A block is missing: by number, by address, and with a last block of what is left.
    let without = [&good[..2], &good[3..]].concat();
    assert!(fault(&without).contains("block 3 follows where block 2 must"));
    let renumbered = [&good[..2], &[of(2, START + 1200, 2)], &good[4..]].concat();
    assert!(fault(&renumbered).contains("does not match the blocks before it"));
    let filled = [&image[..600], &[0xFF; 600], &image[1200..]].concat();
    let gap = [&renumbered[..3], &[last(&filled)]].concat();
    let words = fault(&gap);
    assert!(words.contains("offset 0x280") && words.contains("a block is missing"), "{words}");
    // Out of order.
    let swapped = [&good[..2], &[good[3].clone(), good[2].clone()], &good[4..]].concat();
    assert!(fault(&swapped).contains("block 3 follows where block 2 must"));
    let swapped = [&good[..2], &[of(2, START + 1200, 2), of(3, START + 600, 1)], &good[4..]].concat();
    assert!(fault(&swapped).contains("does not lie after the one before it"));
    // A wrong CRC, of a block and of all.
    let mut wrong = good.clone();
    wrong[2][30] ^= 1;
    assert!(fault(&wrong).contains("CRC of block 2 is"));
    let wrong = [&good[..count - 1], &[last(&image[1..])]].concat();
    assert!(fault(&wrong).contains("does not match the blocks before it"));
    // CRC-16, which is right everywhere, and which no sealed device takes.
    let crc_16 = crc::Crc::<u16>::new(&crc::CRC_16_XMODEM);
    let with_crc_16 = |mut block: Vec<u8>| {
        if block.starts_with(&[0xFF; 4]) {
            block[16..20].copy_from_slice(&u32::from(crc_16.checksum(&image)).to_le_bytes());
        }
        let end = block.len() - 4;
        let crc = u32::from(crc_16.checksum(&block[..end]));
        block[end..].copy_from_slice(&crc.to_le_bytes());
        block
    };
    let words = fault(&good.iter().cloned().map(with_crc_16).collect::<Vec<_>>());
    assert!(words.contains("accepts only blocks with CRC-32"), "{words}");
    // Erased flash before it or after it is no part of it.
    let behind = [&good[..count - 1], &[last(&[&image[..], &[0xFF; 4]].concat())]].concat();
    assert!(fault(&behind).contains("does not match the blocks before it"));
    let front = [&good[..count - 1], &[last(&[&[0xFF; 4], &image[..]].concat())]].concat();
    assert!(fault(&front).contains("does not match the blocks before it"));
}

#[test]
fn a_record_that_must_be_understood_and_is_not_is_refused() {
    let text = Sealer { text: Some("1234"), ..sealer() };
    let file = text.seal(&image(10), &release()).unwrap();
    let roots = [root().public()];
    assert!(verify(&changed(&file, 176, &[9, 0]), &device(&roots, &[])).is_ok());
    let unknown = Refusal::Field("it has an unknown record that is marked as mandatory");
    assert_eq!(refusal(&changed(&file, 176, &[9, 0x80]), &device(&roots, &[])), unknown);
    // A record that is longer than the manifest.
    assert_eq!(refusal(&changed(&file, 178, &[5, 0]), &device(&roots, &[])), unknown);
}

#[test]
fn a_certificate_holds_for_what_it_says_and_only_if_the_root_has_signed_it() {
    let roots = [root().public()];
    let good = device(&roots, &[]);
    let file = sealer().seal(&image(100), &release()).unwrap();
    let with = |certificate: [u8; 152]| {
        let mut file = file.clone();
        file[176..176 + 152].copy_from_slice(&certificate);
        refusal(&file, &good)
    };
    let of = |certificate: Certificate| with(certificate.signed_by(&root()));
    let rule = Refusal::Certificate;
    assert_eq!(of(Certificate { vendor_id: 1, ..certified() }), rule("it is for another vendor"));
    assert_eq!(of(Certificate { product_code: 1, ..certified() }), rule("it is for another product"));
    let counter = rule("it does not allow this security counter");
    assert_eq!(of(Certificate { highest: 6, ..certified() }), counter);
    assert_eq!(of(Certificate { lowest: 8, ..certified() }), counter);
    assert_eq!(of(Certificate { role: Role::Test, ..certified() }), Refusal::Test);
    assert_eq!(of(Certificate { epoch: 1, ..certified() }), Refusal::Epoch { image: 1, device: 2 });
    let other = key(9).public();
    assert_eq!(of(Certificate { key: other, ..certified() }), Refusal::NoSignature(other.id()));
    let mut bytes = certified().signed_by(&root());
    bytes[100] ^= 1;
    assert_eq!(with(bytes), Refusal::CertificateSignature(root().public().id()));
    for (at, byte, words) in [
        (4, 151, "its size is impossible"),
        (6, 3, "its key does not sign programs"),
        (7, 2, "its key is for another algorithm"),
        (64, 1, "its reserved bytes are not 0: it is of a later format"),
        (87, 1, "its reserved bytes are not 0: it is of a later format"),
    ] {
        let mut bytes = certified().signed_by(&root());
        bytes[at] = byte;
        assert_eq!(with(bytes), rule(words));
    }
    assert_eq!(with(certified().signed_by(&key(8))), Refusal::Root(key(8).public().id()));
    // An attacker's root that takes the id of the true one.
    let mut bytes = certified().signed_by(&key(8));
    bytes[60..64].copy_from_slice(&root().public().id().to_le_bytes());
    assert_eq!(with(bytes), Refusal::CertificateSignature(root().public().id()));
}

#[test]
fn what_no_device_would_take_is_not_sealed() {
    let image = image(100);
    let sealed = |sealer: Sealer<'_>| sealer.seal(&image, &release()).unwrap_err();
    assert_eq!(sealer().seal(&[], &release()).unwrap_err(), SealFault::Empty);
    assert_eq!(sealed(Sealer { chunk: 8, ..sealer() }), SealFault::Chunk(8));
    assert_eq!(sealed(Sealer { chunk: 14, ..sealer() }), SealFault::Chunk(14));
    assert_eq!(sealed(Sealer { program: 0, ..sealer() }), SealFault::Program(0));
    assert!(matches!(sealed(Sealer { program: 255, ..sealer() }), SealFault::Bootloader(_)));
    let twice = [kek(1), kek(1)];
    assert_eq!(sealed(Sealer { encrypt_for: &twice, ..sealer() }), SealFault::Twice(kek(1).id()));
    let text = "x".repeat(845);
    assert_eq!(sealed(Sealer { text: Some(&text), ..sealer() }), SealFault::Manifest(176 + 4 + 848));
    let product = Certificate { product_code: 1, ..certified() }.signed_by(&root());
    for (sealer, what) in [
        (Sealer { vendor_id: 1, ..sealer() }, "the vendor-ID"),
        (Sealer { counter: 4, ..sealer() }, "security counters"),
        (Sealer { counter: 10, ..sealer() }, "security counters"),
        (Sealer { certificate: Some(product), ..sealer() }, "the product code"),
    ] {
        assert!(matches!(sealed(sealer), SealFault::NotAllowed { what: found, .. } if found == what));
    }
    assert_eq!(sealer().seal(&image, &key(9)).unwrap_err(), SealFault::OtherKey(key(9).public().id()));
    assert_eq!(sealed(Sealer { certificate: Some([0; 152]), ..sealer() }), SealFault::NoCertificate);
    let mut later = certified().signed_by(&root());
    later[70] = 1;
    assert_eq!(sealed(Sealer { certificate: Some(later), ..sealer() }), SealFault::NoCertificate);
}

#[test]
fn a_key_in_a_module_signs_in_two_steps() {
    let (image, keks) = (image(700), [kek(1)]);
    let sealer = Sealer { encrypt_for: &keks, ..sealer() };
    let unsigned = sealer.for_module(&image, release().public()).unwrap();
    assert_eq!(unsigned, sealer.for_module(&image, release().public()).unwrap());
    let kept = Unsigned::of_file(unsigned.file().to_vec(), release().public()).unwrap();
    assert_eq!(kept, unsigned);
    let signature = release().sign(&kept.tbs());
    let file = kept.attach(&signature).unwrap();
    let roots = [root().public()];
    assert_eq!(verify(&file, &device(&roots, &keks)).unwrap().image, Some(image));
    let id = release().public().id();
    assert_eq!(kept.attach(&[0; 64]), Err(SealFault::Signature(id)));
    assert_eq!(kept.attach(&key(3).sign(&kept.tbs())), Err(SealFault::Signature(id)));
    assert_eq!(Unsigned::of_file(file, release().public()), Err(SealFault::NotUnsigned));
    assert_eq!(Unsigned::of_file(unsigned.file().to_vec(), key(3).public()), Err(SealFault::OtherKey(id)));
    for end in [0, 4, 8, 100, 300, 400] {
        let cut = unsigned.file()[..end].to_vec();
        assert_eq!(Unsigned::of_file(cut, release().public()), Err(SealFault::NotUnsigned));
    }
}

/// A key stream that is used twice reveals both texts: every difference in the payload or the
/// manifest gives another key.
#[test]
fn no_two_images_have_one_nonce() {
    let keks = [kek(1)];
    let base = Sealer { encrypt_for: &keks, ..sealer() };
    let (image, other) = (image(600), image(601));
    let nonce = |file: Vec<u8>| file[104..120].to_vec();
    let mut nonces = vec![
        nonce(base.seal(&image, &release()).unwrap()),
        nonce(base.seal(&other, &release()).unwrap()),
        nonce(Sealer { compress: true, ..base.clone() }.seal(&image, &release()).unwrap()),
        nonce(Sealer { base: Some(&other), ..base.clone() }.seal(&image, &release()).unwrap()),
        nonce(Sealer { counter: 8, ..base.clone() }.seal(&image, &release()).unwrap()),
        nonce(Sealer { certificate: None, ..base }.seal(&image, &root()).unwrap()),
    ];
    let count = nonces.len();
    nonces.sort();
    nonces.dedup();
    assert_eq!(nonces.len(), count);
}

/// The output of a command for this input; `None` if this computer does not have the command.
fn piped(command: &mut Command, input: &[u8]) -> Option<Vec<u8>> {
    let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
    let mut child = child.ok()?;
    child.stdin.take().unwrap().write_all(input).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{command:?}");
    Some(output.stdout)
}

fn digits(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The key-encryption key's HMAC and the encryption, computed by other tools.
#[test]
fn openssl_unwraps_and_decrypts() {
    let (image, keks) = (image(1500), [kek(0x42)]);
    let file = Sealer { encrypt_for: &keks, ..sealer() }.seal(&image, &release()).unwrap();
    // The recipient is the first record: id, check, wrapped key.
    let record = &file[180..224];
    assert_eq!(record[..4], keks[0].id().to_le_bytes());
    let message = [&b"coboot key 1\0"[..], &file[104..120]].concat();
    let key = digits(&[0x42; 32]);
    let mut mac = Command::new("openssl");
    mac.args(["dgst", "-sha512", "-binary", "-mac", "HMAC", "-macopt", &format!("hexkey:{key}")]);
    let Some(stream) = piped(&mut mac, &message) else { return };
    assert_eq!(record[4..12], stream[32..40]);
    let image_key: Vec<u8> = record[12..44].iter().zip(&stream).map(|(one, other)| one ^ other).collect();
    let chunks = &file[file.len() - 1500 - 3 * 32..];
    let payload: Vec<u8> = chunks.chunks(544).flat_map(|chunk| chunk[32..].to_vec()).collect();
    // Its IV has the block counter in front.
    let iv = digits(&[&[0; 4], &file[104..116]].concat());
    let mut cipher = Command::new("openssl");
    cipher.args(["enc", "-d", "-chacha20", "-K", &digits(&image_key), "-iv", &iv]);
    assert_eq!(piped(&mut cipher, &payload), Some(image));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// Any flipped bit is refused.
    #[test]
    fn no_bit_can_be_changed(place in any::<prop::sample::Index>(), bit in 0..8, kind in 0..3) {
        let keks = [kek(1)];
        let sealer = Sealer {
            compress: kind == 1,
            encrypt_for: if kind == 2 { &keks } else { &[] },
            text: Some("text"),
            ..sealer()
        };
        let mut file = sealer.seal(&image(900), &release()).unwrap();
        let at = place.index(file.len());
        file[at] ^= 1_u8 << bit;
        let roots = [root().public()];
        let refusal = refusal(&file, &device(&roots, &keks));
        let signature = file.len() - 72 - (900 + 64);
        // In the payload of what is not compressed it is known which chunk must be named.
        if kind == 0 && at >= signature + 72 {
            let number = (at - signature - 72) / 544 + 1;
            prop_assert_eq!(refusal, Refusal::Chain { number, of: 2 });
        }
    }

    /// Any bytes in place of a few in a block file: the result is the image, or an error.
    #[test]
    fn hostile_blocks_are_refused(
        noise in prop::collection::vec(any::<u8>(), 1..40),
        place in any::<prop::sample::Index>(),
    ) {
        let image = sealer().seal(&image(900), &release()).unwrap();
        let mut file = in_blocks(&image).concat();
        let at = FRONT + place.index(file.len() - FRONT);
        let end = (at + noise.len()).min(file.len());
        file[at..end].copy_from_slice(&noise[..end - at]);
        let is_as_before = file == in_blocks(&image).concat();
        prop_assert_eq!(carried(file).is_ok(), is_as_before);
        let mut file = in_blocks(&image)[0].clone();
        file.extend(in_blocks(&image)[1][..16].iter().chain(&noise));
        prop_assert!(carried(file).is_err());
    }

    /// A truncated file is refused, and reported as cut off if its head is complete.
    #[test]
    fn no_prefix_is_taken(place in any::<prop::sample::Index>()) {
        let file = sealer().seal(&image(900), &release()).unwrap();
        let end = place.index(file.len());
        let roots = [root().public()];
        let refusal = refusal(&file[..end], &device(&roots, &[]));
        let cut = matches!(refusal, Refusal::CutOff { found, .. } if found == end as u64);
        let expected = if end < 4 { refusal == Refusal::NotSealed } else { cut };
        prop_assert!(expected, "{}: {}", end, refusal);
    }

    /// Any bytes after the magic, and any change of many bytes: no panic, neither in the check nor
    /// in the description.
    #[test]
    fn hostile_files_are_refused(
        noise in prop::collection::vec(any::<u8>(), 0..700),
        at in 4_usize..500,
    ) {
        let roots = [root().public()];
        let mut file = b"CBS1".to_vec();
        file.extend_from_slice(&noise);
        prop_assert!(verify(&file, &device(&roots, &[])).is_err());
        let good = sealer().seal(&image(900), &release()).unwrap();
        let mut file = good.clone();
        let end = (at + noise.len()).min(file.len());
        file[at..end].copy_from_slice(&noise[..end - at]);
        if let Ok(sealed) = Sealed::parse(&file) {
            prop_assert!(!sealed.to_string().is_empty());
        }
        prop_assert!(file == good || verify(&file, &device(&roots, &[kek(1)])).is_err());
    }
}
