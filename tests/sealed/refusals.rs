//! Invalid sealed images: every bit of the head, many bits of the chunks, every length, every
//! field. Each is refused with the code of the reason, and nothing is erased or written before the
//! signatures are found good.

use boot_core::canopen::{AbortCode, Instant};
use coboot_tests::sealed::{
    certificate, image, keys, seal, sealer, Device, Keys, Parts, EPOCH, FORMS, HIGHEST, PRODUCT_CODE,
    REVISION, STANDARD_1, UNIQUE_ID, VENDOR_ID,
};
use coboot_tests::sealed_board::status::{
    FORMAT, KEY, NO_ACCESS, ROLLBACK, SIGNATURE, WRONG_PRODUCT as PRODUCT,
};
use coflash_core::file::sealed::{key_block, Certificate, Kek, Role, Sealer};
use kit::random::Random;

/// ADDRESS, VENDOR in 1F57h.
const ADDRESS: u32 = 0x0C;
const VENDOR: u32 = 0x80;

/// The installed program: counter 5, epoch 4.
fn installed() -> (Device, Vec<u8>) {
    let device = Device::sealed(&STANDARD_1);
    let old = image(STANDARD_1.region(1), 700, 0xA3);
    device.run(|host| host.install(1, &seal(&sealer((false, false)), &old)));
    device.take_touched();
    (device, old)
}

/// The new image: counter 7.
fn next(form: (bool, bool), len: usize) -> (Vec<u8>, Vec<u8>) {
    let image = image(STANDARD_1.region(1), len, 0xB7);
    let sealer = Sealer { counter: 7, version: 2, chunk: 9, text: Some("a text to be read"), ..sealer(form) };
    let file = seal(&sealer, &image);
    (file, image)
}

/// Checks a refusal with one of these codes, without any loss.
fn costs_nothing(device: &Device, old: &[u8], file: &[u8], codes: &[u32], reported: &str) {
    device.run(|host| {
        let (abort, status) = host.update(1, file, 7);
        assert!(codes.contains(&status), "{reported}: {status:02X}h, and not {codes:02X?}");
        assert!(abort.is_ok() || abort == Err(AbortCode::STORE), "{reported}: {abort:?}");
        assert_eq!(device.take_touched(), [], "{reported}");
        assert_eq!(host.start(1), Some(1), "{reported}: the old program can be started");
    });
    assert!(device.holds(1, old), "{reported}");
}

/// Checks a refusal after good signatures: there is no program, only `authentic` bytes of it are in
/// the flash, and a valid image can be installed.
fn costs_the_program(device: &Device, file: &[u8], codes: &[u32], authentic: &[u8], reported: &str) {
    let device = device.copy();
    device.run(|host| {
        let (abort, status) = host.update(1, file, 7);
        assert!(codes.contains(&status), "{reported}: {status:02X}h, and not {codes:02X?}");
        assert!(abort.is_ok() || abort == Err(AbortCode::STORE), "{reported}: {abort:?}");
        assert_eq!(host.state(1), 3, "{reported}: there is none");
        assert_eq!(host.start(1), None, "{reported}");
    });
    assert!(device.record(1).is_none() && device.starts(None).is_none(), "{reported}");
    let written = device.cells(1, authentic.len());
    assert_eq!(written, authentic, "{reported}");
    let size = STANDARD_1.region(1).size as usize;
    let sector = authentic.len().next_multiple_of(0x400).min(size);
    assert!(device.cells(1, sector)[authentic.len()..].iter().all(|byte| *byte == 0xFF), "{reported}");
    let (good, image) = next((true, true), 700);
    device.run(|host| host.install(1, &good));
    assert!(device.holds(1, &image), "{reported}");
}

// --- bits

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

/// The codes for a flipped bit in the head of [`next`], from the tables of the format.
fn code_of_flip(good: &[u8], at: usize, bit: u8) -> Vec<u32> {
    let mut flipped = good.to_vec();
    flipped[at] ^= 1 << bit;
    let parts = Parts::of(good);
    let manifest = parts.manifest.len();
    let flags = good[7];
    let compressed = flags & 2 != 0;
    let encrypted = flags & 1 != 0;
    let in_certificate = at.wrapping_sub(manifest);
    let in_signature = at.wrapping_sub(manifest + 152);
    let code = match at {
        0..4 => return vec![NO_ACCESS, FORMAT],
        // Other bytes are taken for the certificate and the signatures.
        4..6 => return vec![FORMAT, SIGNATURE, KEY],
        6 => return vec![FORMAT, SIGNATURE],
        7 => match bit {
            0 if encrypted => SIGNATURE,
            0 => KEY,
            1 if compressed => FORMAT,
            3 if !compressed => FORMAT,
            // The device has no program that could be the dictionary.
            3 => return vec![FORMAT, SIGNATURE],
            2 | 7 => FORMAT,
            4 => PRODUCT,
            6 => KEY,
            _ => SIGNATURE,
        },
        8..12 => VENDOR,
        12..16 => PRODUCT,
        20..24 if word(&flipped, 20) < 5 => ROLLBACK,
        24 => PRODUCT,
        25 if !(9..=13).contains(&flipped[25]) => FORMAT,
        26..28 if word(&flipped, 24) >> 16 > 1 => FORMAT,
        28..32 if !compressed => FORMAT,
        28..32 if word(&flipped, 28) > STANDARD_1.region(1).size => ADDRESS,
        36..40 if !compressed => FORMAT,
        120..132 => PRODUCT,
        132..136 if word(&flipped, 132) != 1 << (REVISION & 31) => PRODUCT,
        176.. if at < manifest => {
            let recipient = encrypted.then_some(176..224);
            match recipient.filter(|record| record.contains(&at)) {
                Some(_) if at < 178 && (at, bit) != (177, 7) => FORMAT,
                Some(_) if at < 178 => KEY,
                Some(_) if at < 180 => FORMAT,
                Some(_) if at < 184 => KEY,
                Some(_) => SIGNATURE,
                None => {
                    let text = if encrypted { 224 } else { 176 };
                    match at - text {
                        1 if bit == 7 => FORMAT,
                        // The bytes left after it, or before it, may form a record or not.
                        2 | 3 => return vec![FORMAT, SIGNATURE],
                        _ => SIGNATURE,
                    }
                }
            }
        }
        // There is then no certificate, and the first half of it is not a signature.
        _ if in_certificate < 4 => return vec![FORMAT, KEY],
        _ if (8..12).contains(&in_certificate) && word(&flipped, manifest + 8) < EPOCH => ROLLBACK,
        _ if (60..64).contains(&in_certificate) => KEY,
        // It is longer: chunks are taken for a part of it.
        _ if (6..8).contains(&in_signature) => return vec![FORMAT, SIGNATURE],
        _ => SIGNATURE,
    };
    vec![code]
}

#[test]
fn every_bit_of_the_head_counts() {
    for form in [(false, false), (true, true)] {
        let (device, old) = installed();
        let (good, image) = next(form, 600);
        for at in 0..Parts::of(&good).head() {
            for bit in 0..8 {
                let mut file = good.clone();
                file[at] ^= 1 << bit;
                let reported = format!("{form:?} bit {bit} of byte {at}");
                costs_nothing(&device, &old, &file, &code_of_flip(&good, at, bit), &reported);
            }
        }
        device.run(|host| host.install(1, &good));
        assert!(device.holds(1, &image));
    }
}

#[test]
fn every_byte_of_the_chunks_counts() {
    let mut random = Random(7);
    for form in FORMS {
        let (device, old) = installed();
        let (good, image) = next(form, 1700);
        let head = Parts::of(&good).head();
        for at in head..good.len() {
            // All bytes of the hashes, and some others.
            let (chunk, within) = ((at - head) / 544, (at - head) % 544);
            if within >= 32 && !random.chance(4) {
                continue;
            }
            let mut file = good.clone();
            file[at] ^= 1 << random.below(8);
            let reported = format!("{form:?} byte {within} of chunk {chunk}");
            if chunk == 0 {
                costs_nothing(&device, &old, &file, &[SIGNATURE], &reported);
            } else if form.1 {
                // The size of a decompressed chunk, from an independent decoder.
                let device = device.copy();
                device.run(|host| assert_eq!(host.update(1, &file, 7).1, SIGNATURE, "{reported}"));
                assert!(device.record(1).is_none(), "{reported}");
                let size = STANDARD_1.region(1).size as usize;
                let written = device.cells(1, image.len());
                let same = written.iter().zip(&image).take_while(|(a, b)| a == b).count();
                assert!(written[same..].iter().all(|byte| *byte == 0xFF), "{reported}");
                assert!(same < size);
            } else {
                costs_the_program(&device, &file, &[SIGNATURE], &image[..chunk * 512], &reported);
            }
        }
    }
}

// --- lengths

#[test]
fn every_prefix_is_refused() {
    for form in [(false, false), (true, true)] {
        let (device, old) = installed();
        let (good, image) = next(form, 1100);
        let first_chunk = Parts::of(&good).head() + 544;
        // Ended, aborted, and abandoned by a reset.
        for len in 0..good.len() {
            if len < first_chunk {
                if len >= 8 {
                    costs_nothing(&device, &old, &good[..len], &[FORMAT], &format!("{form:?} {len} bytes"));
                }
                device.run(|host| {
                    host.clear(1);
                    host.begin(1, &good[..len], 7).unwrap();
                    host.settle();
                    if len % 2 == 0 {
                        host.cancel(1);
                        host.settle();
                        let begun = len >= 4;
                        assert_eq!(host.status(1), if begun { FORMAT } else { 0 }, "{len}");
                        assert_eq!(host.start(1), Some(1), "{len}");
                    }
                });
                assert_eq!(device.take_touched(), [], "{form:?} {len}");
                assert!(device.holds(1, &old));
            } else if len % 5 == 0 || len > good.len() - 40 {
                let device = device.copy();
                device.run(|host| {
                    host.clear(1);
                    host.begin(1, &good[..len], 7).unwrap();
                    if len % 2 == 0 {
                        host.cancel(1);
                    } else {
                        assert_eq!(host.end(1), Ok(()));
                    }
                    host.settle();
                    assert_eq!(host.status(1), FORMAT, "{len}");
                    assert!(len % 2 == 0 || host.state(1) == 3);
                    if host.state(1) == 3 {
                        assert_eq!(host.start(1), None);
                    }
                });
                // Data that were still in the queue at the abort had no effect.
                assert!(device.record(1).is_none() || device.holds(1, &old), "{len}");
                device.run(|host| host.install(1, &good));
                assert!(device.holds(1, &image));
            }
        }
    }
}

#[test]
fn bytes_behind_the_end_are_refused() {
    for form in FORMS {
        let (device, _) = installed();
        for (len, more) in [(600, 1), (600, 7), (1024, 1), (1024, 544), (1100, 5000)] {
            let (good, image) = next(form, len);
            let file = [good, vec![0x5A; more]].concat();
            costs_the_program(&device, &file, &[FORMAT], &image, &format!("{form:?} {len} + {more}"));
        }
    }
}

// --- fields

/// What is wrong with a file, the code for it, and the file.
type Wrong = (String, u32, Vec<u8>);

/// Correctly signed files whose manifest has one wrong field.
fn wrong_fields(plain: &Parts, packed: &Parts) -> Vec<Wrong> {
    let words = [
        ("vendor 0", 8, 0, VENDOR),
        ("another vendor", 8, VENDOR_ID + 1, VENDOR),
        ("product 0", 12, 0, PRODUCT),
        ("another product", 12, PRODUCT_CODE ^ 0x100, PRODUCT),
        ("a lower counter", 20, 4, ROLLBACK),
        ("the counter 0", 20, 0, ROLLBACK),
        ("a counter that the key may not sign", 20, HIGHEST + 1, SIGNATURE),
        ("the highest counter", 20, u32::MAX, SIGNATURE),
        ("no image", 28, 0, FORMAT),
        ("an image larger than its payload", 28, 601, FORMAT),
        ("an image smaller than its payload", 28, 599, FORMAT),
        ("no payload", 36, 0, FORMAT),
        ("all payload", 36, u32::MAX, FORMAT),
        ("the unique ID of nobody", 128, 1, PRODUCT),
        ("hardware revision 1", 132, 1 << 1, PRODUCT),
        ("all hardware revisions but ours", 132, !(1 << (REVISION & 31)), PRODUCT),
    ];
    let mut almost = UNIQUE_ID;
    almost[11] ^= 1;
    let bytes = [
        ("another unique ID", 120, &almost[..], PRODUCT),
        ("program 0", 24, &[0], PRODUCT),
        ("program 2", 24, &[2], PRODUCT),
        ("program 255", 24, &[255], PRODUCT),
        ("chunks of 2^0", 25, &[0], FORMAT),
        ("chunks of 2^8", 25, &[8], FORMAT),
        ("chunks of 2^14", 25, &[14], FORMAT),
        ("chunks of 2^41", 25, &[41], FORMAT),
        ("chunks of 2^255", 25, &[255], FORMAT),
        ("format 2", 26, &[2, 0], FORMAT),
        ("format FFFFh", 26, &[255, 255], FORMAT),
        ("flag 2", 7, &[1 << 2], FORMAT),
        ("flag 7", 7, &[1 << 7], FORMAT),
        ("all flags", 7, &[0xFF], FORMAT),
        ("data", 7, &[1 << 4], PRODUCT),
        ("a dictionary without compression", 7, &[1 << 3], FORMAT),
        ("signed for tests", 7, &[1 << 6], KEY),
        ("encrypted for nobody", 7, &[1 << 0], KEY),
        ("no signature", 6, &[0], FORMAT),
        ("four signatures", 6, &[4], FORMAT),
        ("255 signatures", 6, &[255], FORMAT),
        ("a manifest of 0 bytes", 4, &[0, 0], FORMAT),
        ("a manifest of 172 bytes", 4, &[172, 0], FORMAT),
        ("a manifest of 177 bytes", 4, &[177, 0], FORMAT),
        ("a manifest of 1028 bytes", 4, &1028_u16.to_le_bytes(), FORMAT),
        ("a manifest of 65535 bytes", 4, &[255, 255], FORMAT),
    ];
    let wrong = |what: &str, parts: &Parts, at, bytes: &[u8], code| {
        (what.to_string(), code, parts.clone().with(at, bytes).signed())
    };
    let words = words.map(|(what, at, word, code)| wrong(what, plain, at, &u32::to_le_bytes(word), code));
    let bytes = bytes.map(|(what, at, bytes, code)| wrong(what, plain, at, bytes, code));
    let size = STANDARD_1.region(1).size;
    let large = [size + 1, 1 << 24, u32::MAX].into_iter().flat_map(|large| {
        let bytes = large.to_le_bytes();
        let unpacked = plain.clone().with(36, &bytes);
        [("", packed), (", unpacked", &unpacked)].map(|(form, parts)| {
            wrong(&format!("an image of {large} bytes{form}"), parts, 28, &bytes, ADDRESS)
        })
    });
    let none = [("size 0, compressed", 28), ("payload 0, compressed", 36)];
    let none = none.map(|(what, at)| wrong(what, packed, at, &[0; 4], FORMAT));
    words.into_iter().chain(bytes).chain(large).chain(none).collect()
}

/// Correctly signed files with a wrong record in the manifest, or for no key of the device.
fn wrong_records(plain: &Parts) -> Vec<Wrong> {
    let secret = Parts::of(&next((true, false), 600).0);
    let records: [(_, _, _, &[u8]); 7] = [
        ("an unknown critical record", 0x8002, 4, &[1; 4]),
        ("an unknown critical record without bytes", 0xFFFE, 0, &[]),
        ("a record over the end of the manifest", 0x0002, 8, &[1; 4]),
        ("a huge record", 0x0002, 65535, &[1; 4]),
        ("a recipient that is too short", 0x8001, 40, &[1; 40]),
        ("a recipient that is too long", 0x8001, 48, &[1; 48]),
        ("a recipient without bytes", 0x8001, 0, &[]),
    ];
    let records = records.map(|(what, tag, size, bytes)| {
        (what.to_string(), FORMAT, plain.clone().with_record(tag, size, bytes).signed())
    });
    let flipped = |at: usize| [secret.manifest[at] ^ 1];
    let recipients: [(_, _, &[u8]); 4] = [
        ("encrypted for a key that is not here", 180, &[1, 2, 3, 4]),
        ("encrypted for the key 0", 180, &[0; 4]),
        ("a wrong check of the key", 184, &flipped(184)),
        ("a wrong check of the key, at its end", 191, &flipped(191)),
    ];
    let recipients =
        recipients.map(|(what, at, bytes)| (what.to_string(), KEY, secret.clone().with(at, bytes).signed()));
    let other = Sealer { encrypt_for: &keys().other_keks, counter: 7, ..sealer((true, false)) };
    let other = seal(&other, &image(STANDARD_1.region(1), 600, 1));
    records.into_iter().chain(recipients).chain([("encrypted for others".to_string(), KEY, other)]).collect()
}

/// Correctly signed files with a wrong certificate.
fn wrong_certificates(plain: &Parts) -> Vec<Wrong> {
    let own = certificate();
    let Keys { root, second_root, release, stranger, .. } = keys();
    let certified = |certificate: Certificate, root| plain.clone().certified(&certificate.signed_by(root));
    let mut files: Vec<Wrong> = [
        ("certified for another vendor", SIGNATURE, Certificate { vendor_id: 1, ..own }),
        ("certified for vendor 0", SIGNATURE, Certificate { vendor_id: 0, ..own }),
        ("certified for another product", SIGNATURE, Certificate { product_code: 1, ..own }),
        ("certified for higher counters", SIGNATURE, Certificate { lowest: 8, ..own }),
        ("certified for lower counters", SIGNATURE, Certificate { highest: 6, ..own }),
        ("certified for none", SIGNATURE, Certificate { lowest: 9, highest: 1, ..own }),
        ("of an old epoch", ROLLBACK, Certificate { epoch: EPOCH - 1, ..own }),
        ("of epoch 0", ROLLBACK, Certificate { epoch: 0, ..own }),
        ("certified for tests", KEY, Certificate { role: Role::Test, ..own }),
    ]
    .map(|(what, code, certificate)| (what.to_string(), code, certified(certificate, root).signed()))
    .into();
    let mut add = |what: String, code, parts: Parts| files.push((what, code, parts.signed()));
    add("certified by nobody".into(), KEY, certified(own, stranger));
    // Signed again, as if the root had signed wrong contents.
    let claims = |at: usize, contents: &[u8]| {
        let mut bytes = own.signed_by(root);
        bytes[at..at + contents.len()].copy_from_slice(contents);
        let signature = root.sign(&bytes[..88]);
        bytes[88..].copy_from_slice(&signature);
        plain.clone().certified(&bytes)
    };
    for role in [0, 3, 255] {
        add(format!("role {role}"), SIGNATURE, claims(6, &[role]));
    }
    for algorithm in [0, 2, 3, 255] {
        add(format!("algorithm {algorithm}"), SIGNATURE, claims(7, &[algorithm]));
    }
    for len in [0_u16, 151, 153, 65535] {
        add(format!("a certificate of {len} bytes"), SIGNATURE, claims(4, &len.to_le_bytes()));
    }
    for at in [64, 75, 87] {
        add(format!("reserved byte {at}"), SIGNATURE, claims(at, &[1]));
    }
    add("of the root 0".into(), KEY, claims(60, &[0; 4]));
    add("of the other root".into(), SIGNATURE, claims(60, &second_root.public().id().to_le_bytes()));
    let mut claimed = own.signed_by(stranger);
    claimed[60..64].copy_from_slice(&root.public().id().to_le_bytes());
    let claimed = plain.clone().certified(&claimed);
    add("a stranger's certificate in the root's name".into(), SIGNATURE, claimed);
    let of_stranger = certified(Certificate { key: stranger.public(), ..own }, root);
    files.push(("another key's certificate".into(), SIGNATURE, of_stranger.signed_by(release).bytes()));
    files
}

/// Files with a wrong signature.
fn wrong_signatures(plain: &Parts) -> Vec<Wrong> {
    let Keys { root, release, stranger, .. } = keys();
    let bare = plain.clone().certified(&[]);
    let strange = Parts::signature(stranger, &bare.manifest);
    let in_the_name = |of: u32| {
        let mut parts = Parts { signatures: strange.clone(), ..bare.clone() };
        parts.signatures[..4].copy_from_slice(&of.to_le_bytes());
        parts
    };
    let changed = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut parts = plain.clone().signed_by(release);
        change(&mut parts.signatures);
        parts
    };
    // Two signatures with the id of the key: the first one counts, and it is bad.
    let mut two = plain.clone().with(6, &[2]).signed_by(release);
    let mut bad = two.signatures.clone();
    bad[20] ^= 1;
    two.signatures = [bad, two.signatures].concat();
    let mut files = vec![
        ("signed by nobody".to_string(), SIGNATURE, plain.clone().signed_by(stranger)),
        ("signed by the root for the release key".into(), SIGNATURE, plain.clone().signed_by(root)),
        ("signed by the release key without certificate".into(), KEY, bare.clone().signed_by(release)),
        ("a stranger in the root's name".into(), SIGNATURE, in_the_name(root.public().id())),
        ("in the name of the key 0".into(), KEY, in_the_name(0)),
        ("a bad signature in front of a good one".into(), SIGNATURE, two),
        ("a signature with S + L".into(), SIGNATURE, changed(&|bytes| add_order(&mut bytes[40..72]))),
    ];
    for algorithm in [0_u8, 2, 3, 255] {
        let parts = changed(&|bytes| bytes[4] = algorithm);
        files.push((format!("signature algorithm {algorithm}"), SIGNATURE, parts));
    }
    for (len, code) in [(0_u16, SIGNATURE), (63, SIGNATURE), (8000, FORMAT), (65535, FORMAT)] {
        let parts = changed(&|bytes| {
            bytes[6..8].copy_from_slice(&len.to_le_bytes());
            bytes.resize(8 + usize::from(len), 0x5A);
        });
        files.push((format!("a signature of {len} bytes"), code, parts));
    }
    files.into_iter().map(|(what, code, parts)| (what, code, parts.bytes())).collect()
}

/// S + L in place of S (RFC 8032 section 5.1.7 accepts no S of L or more).
fn add_order(s: &mut [u8]) {
    let order = [
        0xed, 0xd3, 0xf5, 0x5c, 0x1a, 0x63, 0x12, 0x58, 0xd6, 0x9c, 0xf7, 0xa2, 0xde, 0xf9, 0xde, 0x14, 0, 0,
        0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x10,
    ];
    let mut carry = 0_u16;
    for (byte, order) in s.iter_mut().zip(order) {
        carry += u16::from(*byte) + order;
        *byte = carry as u8;
        carry >>= 8;
    }
}

/// Correctly signed files that are for another device, or impossible.
fn signed_and_wrong() -> Vec<Wrong> {
    let plain = Parts::of(&next((false, false), 600).0);
    let packed = Parts::of(&next((false, true), 600).0);
    let mut shifted = plain.clone();
    shifted.chunks.rotate_left(1);
    let others = Parts { chunks: packed.chunks.clone(), ..plain.clone() };
    let chunks = [("a chunk that is shifted", shifted), ("the chunks of another image", others)]
        .map(|(what, parts)| (what.to_string(), SIGNATURE, parts.bytes()));
    let manifest = [wrong_fields(&plain, &packed), wrong_records(&plain)];
    let signers = [wrong_certificates(&plain), wrong_signatures(&plain), chunks.into()];
    manifest.into_iter().chain(signers).flatten().collect()
}

#[test]
fn a_good_signature_does_not_make_a_wrong_field_right() {
    let (device, old) = installed();
    let files = signed_and_wrong();
    assert!(files.len() > 90, "{}", files.len());
    for (what, code, file) in files {
        costs_nothing(&device, &old, &file, &[code], &what);
    }
    // The good one is found beside signatures that this device does not know.
    let (good, image) = next((true, true), 600);
    let mut parts = Parts::of(&good).with(6, &[3]).signed_by(&keys().release);
    let strange = Parts::signature(&keys().stranger, &parts.manifest);
    let lms = [&[1, 2, 3, 4, 2, 0, 100, 0][..], &[0x5A; 100]].concat();
    parts.signatures = [lms, strange, parts.signatures].concat();
    device.run(|host| host.install(1, &parts.bytes()));
    assert!(device.holds(1, &image));
}

/// Another key-encryption key with the id of ours.
#[test]
fn a_wrong_key_is_told_before_anything_is_lost() {
    let Keys { root, second_root, keks, .. } = keys();
    let mut block = key_block(&[root.public(), second_root.public()], keks, 0, 0, false).unwrap();
    block[88 + 4] ^= 1;
    let check = coboot_tests::sealed::crc32(&block[..252]);
    block[252..].copy_from_slice(&check.to_le_bytes());
    let device = Device::with_keys(&STANDARD_1, &block);
    let old = image(STANDARD_1.region(1), 700, 0xA3);
    device.run(|host| host.install(1, &seal(&sealer((false, false)), &old)));
    device.take_touched();
    costs_nothing(&device, &old, &next((true, false), 600).0, &[KEY], "another key with our id");
    // For three keys, the second of which is ours.
    let (first, third) = (Kek::new([7; 32]).unwrap(), Kek::new([8; 32]).unwrap());
    let for_three = [first, keks[0].clone(), third];
    let (device, _) = installed();
    let image = image(STANDARD_1.region(1), 900, 1);
    let file = seal(&Sealer { encrypt_for: &for_three, counter: 7, ..sealer((true, true)) }, &image);
    device.run(|host| host.install(1, &file));
    assert!(device.holds(1, &image));
}

/// No root, or a damaged key block.
#[test]
fn a_device_without_the_root_takes_nothing() {
    let (good, _) = next((false, false), 600);
    let block = key_block(&[keys().stranger.public()], &keys().keks, 0, 0, false).unwrap();
    let device = Device::with_keys(&STANDARD_1, &block);
    device.run(|host| assert_eq!(host.update(1, &good, 7).1, KEY));
    assert_eq!(device.take_touched(), []);
}

// --- what is compressed

/// Authentic, but its decompressed contents differ from the manifest: there is then no program, and
/// nothing outside its flash is changed.
#[test]
fn a_stream_that_is_wrong_ends_without_a_program() {
    let (device, old) = installed();
    let (good, image) = next((false, true), 3000);
    let parts = Parts::of(&good);
    let payload = parts.payload();
    let with = |bytes: &[u8]| parts.clone().with_payload(bytes);
    let mut files: Vec<_> = [
        ("half a stream", with(&payload[..payload.len() / 2])),
        ("a byte alone", with(&payload[..1])),
        ("five bytes", with(&payload[..5])),
        ("all zeros", with(&[0; 3000])),
        ("all FFh", with(&[0xFF; 3000])),
        ("a first byte that is not 0", with(&[&[1], &payload[1..]].concat())),
        ("much behind its end", with(&[&payload[..], &[0; 600]].concat())),
        ("an image larger than the stream", parts.clone().with(28, &9000_u32.to_le_bytes())),
        ("an image smaller than the stream", parts.clone().with(28, &1000_u32.to_le_bytes())),
        ("another CRC", parts.clone().with(32, &[1, 2, 3, 4])),
        ("another hash", parts.clone().with(40, &[1, 2, 3, 4])),
        // A match before the first byte: a 0 as LZMA requires, and then bits that are 1.
        ("a match with nothing", with(&[&[0][..], &[0xFE; 90]].concat())),
    ]
    .map(|(what, parts)| (what.to_string(), parts))
    .into();
    let mut random = Random(11);
    for number in 0..150 {
        let mut wrong = payload.clone();
        for _ in 0..1 + random.below(4) {
            let at = random.below(wrong.len());
            wrong[at] ^= 1 << random.below(8);
        }
        files.push((format!("stream {number} of seed 11"), with(&wrong)));
    }
    let region = STANDARD_1.region(1);
    let journal = STANDARD_1.layout.parameters;
    let mut refused = 0;
    for (what, parts) in files {
        let device = device.copy();
        device.run(|host| {
            let (_, status) = host.update(1, &parts.signed(), 7);
            // The last bits of a stream may have no meaning.
            let sound = status == 0 && device.holds(1, &image);
            assert!(sound || [FORMAT, SIGNATURE, 0x02].contains(&status), "{what}: {status:02X}h");
            refused += u32::from(!sound);
        });
        // If it gave no byte, nothing was lost.
        let whole = device.holds(1, &old) || device.holds(1, &image);
        assert!(device.record(1).is_none() || whole, "{what}");
        for touched in device.take_touched() {
            let place = |region: &shared_abi::geometry::Region| region.contains(touched.base, touched.size);
            assert!(place(&region) || journal.iter().any(place), "{what}: {touched:?}");
        }
        device.run(|host| host.install(1, &good));
        assert!(device.holds(1, &image), "{what}");
    }
    assert!(refused > 140, "{refused}");
}

/// An image that was compressed with the other program as dictionary, for a device without one: the
/// installed program must not be lost.
#[test]
fn a_dictionary_that_is_not_here_costs_nothing() {
    let (device, old) = installed();
    let other = image(STANDARD_1.region(1), 2000, 0x11);
    let new = image(STANDARD_1.region(1), 2000, 0x12);
    let sealer = Sealer { base: Some(&other), counter: 7, ..sealer((false, false)) };
    costs_nothing(&device, &old, &seal(&sealer, &new), &[FORMAT, SIGNATURE, KEY, PRODUCT], "a dictionary");
}

/// Repeated attempts without a valid signature: the device stays reachable, the wait grows with
/// each attempt up to half a minute, and the flash does not wear out.
#[test]
fn ten_thousand_bad_signatures_in_a_row_slow_down_and_cost_nothing() {
    let (device, old) = installed();
    let (good, new) = next((false, false), 600);
    let mut bad = good.clone();
    let signature = Parts::of(&good).head() - 1;
    bad[signature] ^= 1;
    device.run(|host| {
        for tries in 0..10_000 {
            // Each wait at first; then no longer than the longest wait.
            host.now += 64_000;
            host.node.set_time(Instant::from_millis(host.now));
            host.clear(1);
            assert_eq!(host.send(1, &bad, 889).1, SIGNATURE, "{tries}");
            let longest = 32_000;
            let wait = if tries < 6 { 500 << tries } else { longest };
            for later in [0, wait - 1] {
                host.node.set_time(Instant::from_millis(host.now + later));
                assert!(host.begin(1, &good, 889).is_err(), "{tries}: {later} ms later");
            }
            assert_eq!(host.state(1), 0, "it answers");
        }
        assert_eq!(host.start(1), Some(1));
    });
    let touched = device.chip.model().touched.clone();
    let journal = device.setup.layout.parameters;
    assert!(touched
        .iter()
        .all(|region| journal.iter().any(|place| place.contains(region.base, region.size))));
    // The header again, and one event.
    assert!(touched.len() <= 12, "{} operations for 10000 refusals", touched.len());
    assert!(device.holds(1, &old));
    device.run(|host| host.install(1, &good));
    assert!(device.holds(1, &new));
}
