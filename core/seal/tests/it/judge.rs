//! Each rule by which a device accepts an image, alone, and the order of the rules.

use crate::file::{manifest, put, record, signature};
use seal::judge::{judge, Device, Needs};
use seal::key_block::find;
use seal::wire::{Fault, Head, Requirements};

const VENDOR: u32 = 0x319;
const PRODUCT: u32 = 0x4_0001;
const UNIQUE_ID: [u8; 12] = *b"unique id 96";
const ROOTS: [u32; 2] = [0x0101_0101, 0x0202_0202];
const KEKS: [u32; 3] = [0x0303_0303, 0x0404_0404, 0x0505_0505];
const OTHER: u32 = 0x0606_0606;
const ROOM: u32 = 0x1_0000;
const COUNTER: u32 = 40;
const EPOCH: u32 = 5;

/// Flags: encrypted, compressed, with a dictionary, data, for tests.
const ENCRYPTED: u8 = 0x01;
const COMPRESSED: u8 = 0x02;
const DICTIONARY: u8 = 0x08;
const DATA: u8 = 0x10;
const TEST: u8 = 0x40;

/// An image, and what of the device the tests change.
struct Case {
    flags: u8,
    chunk: u8,
    format: u8,
    size: u32,
    payload: u32,
    records: Vec<u8>,
    vendor: u32,
    product: u32,
    program: u8,
    unique_id: [u8; 12],
    hardware: u32,
    counter: u32,
    certificate: Option<Certificate>,
    signers: Vec<u32>,
    roots: [u32; 2],
    revision: u32,
    is_data: bool,
    for_tests: u32,
    /// The program of the device, and what it has for a bootloader.
    device_program: u8,
    has: Option<Requirements>,
}

struct Certificate {
    size: u16,
    role: u8,
    algorithm: u8,
    epoch: u32,
    vendor: u32,
    product: u32,
    lowest: u32,
    highest: u32,
    root: u32,
    reserved: [u8; 24],
}

/// What makes an accepted image one that is refused.
type Change = fn(&mut Case);

/// Signed by the first root.
fn direct() -> Case {
    Case {
        flags: 0,
        chunk: 12,
        format: 1,
        size: 5000,
        payload: 5000,
        records: Vec::new(),
        vendor: VENDOR,
        product: PRODUCT,
        program: 1,
        unique_id: [0; 12],
        hardware: 0,
        counter: COUNTER,
        certificate: None,
        signers: vec![ROOTS[0]],
        roots: ROOTS,
        // Bit 5 of `hardware`: the five lowest bits count.
        revision: 0x1_0025,
        is_data: false,
        for_tests: 0,
        device_program: 1,
        has: None,
    }
}

/// Signed by a key that the second root has certified.
fn certified() -> Case {
    let certificate = Certificate {
        size: 152,
        role: 1,
        algorithm: 1,
        epoch: EPOCH,
        vendor: VENDOR,
        product: PRODUCT,
        lowest: COUNTER,
        highest: COUNTER,
        root: ROOTS[1],
        reserved: [0; 24],
    };
    Case { certificate: Some(certificate), signers: vec![OTHER], ..direct() }
}

impl Case {
    fn judged(&self) -> Result<Needs, Fault> {
        let mut bytes = manifest(&self.records, self.signers.len() as u8);
        bytes[7] = self.flags;
        put(&mut bytes, 8, self.vendor);
        put(&mut bytes, 12, self.product);
        put(&mut bytes, 20, self.counter);
        [bytes[24], bytes[25], bytes[26]] = [self.program, self.chunk, self.format];
        put(&mut bytes, 28, self.size);
        put(&mut bytes, 36, self.payload);
        bytes[120..132].copy_from_slice(&self.unique_id);
        put(&mut bytes, 132, self.hardware);
        if let Some(own) = &self.certificate {
            let mut certificate = [0; 152];
            certificate[..4].copy_from_slice(b"CBK1");
            certificate[4..6].copy_from_slice(&own.size.to_le_bytes());
            [certificate[6], certificate[7]] = [own.role, own.algorithm];
            let numbers = [own.epoch, own.vendor, own.product, own.lowest, own.highest];
            numbers.iter().enumerate().for_each(|(n, number)| put(&mut certificate, 8 + 4 * n, *number));
            put(&mut certificate, 60, own.root);
            certificate[64..88].copy_from_slice(&own.reserved);
            bytes.extend(certificate);
        }
        self.signers.iter().for_each(|signer| bytes.extend(signature(*signer, 1, &[0; 64])));

        let device = Device {
            vendor_id: VENDOR,
            product_code: PRODUCT,
            revision: self.revision,
            unique_id: UNIQUE_ID,
            program: self.device_program,
            has: self.has,
            is_data: self.is_data,
            room: ROOM,
            counter: COUNTER,
            epoch: EPOCH,
            keys: &key_block(self.for_tests, self.roots),
        };
        judge(Head(&bytes), &device)
    }
}

fn key_block(flags: u32, roots: [u32; 2]) -> [u8; 256] {
    let mut block = [0; 256];
    block[..4].copy_from_slice(b"CBKB");
    put(&mut block, 4, flags);
    roots.iter().enumerate().for_each(|(n, id)| put(&mut block, 16 + 36 * n, *id));
    KEKS.iter().enumerate().for_each(|(n, id)| put(&mut block, 88 + 36 * n, *id));
    block
}

fn accepted(root: usize) -> Result<Needs, Fault> {
    Ok(Needs { root, epoch: EPOCH, recipient: None })
}

/// Changes what the device accepts, both ways of signing.
#[track_caller]
fn both(change: impl Fn(&mut Case), fault: Option<Fault>) {
    for (mut case, root) in [(direct(), 16), (certified(), 52)] {
        change(&mut case);
        assert_eq!(case.judged(), fault.map_or(accepted(root), Err));
    }
}

/// Changes the certificate.
#[track_caller]
fn with_certificate(change: impl Fn(&mut Certificate), expected: Result<Needs, Fault>) {
    let mut case = certified();
    case.certificate.iter_mut().for_each(change);
    assert_eq!(case.judged(), expected);
}

#[test]
fn a_key_is_found_in_its_part_of_the_block() {
    let block = key_block(0, ROOTS);
    for (n, id) in ROOTS.into_iter().enumerate() {
        assert_eq!(find(&block, 16, 2, id), Some(16 + 36 * n));
        assert_eq!(find(&block, 88, 3, id), None);
    }
    for (n, id) in KEKS.into_iter().enumerate() {
        assert_eq!(find(&block, 88, 3, id), Some(88 + 36 * n));
        assert_eq!(find(&block, 16, 2, id), None);
    }
    assert_eq!(find(&block, 16, 2, OTHER), None);
    // The id of a place without a key.
    assert_eq!(find(&[0; 256], 16, 2, 0), None);
}

#[test]
fn what_is_possible() {
    both(|_| {}, None);
    both(|case| case.flags = 0x04, Some(Fault::Format));
    both(|case| case.flags = 0x80, Some(Fault::Format));
    // The application writes to flash.
    both(|case| case.flags = 0x20, None);
    for (chunk, fault) in [(8, Some(Fault::Format)), (9, None), (13, None), (14, Some(Fault::Format))] {
        both(|case| case.chunk = chunk, fault);
    }
    both(|case| case.format = 0, None);
    both(|case| case.format = 2, Some(Fault::Format));
    for flags in [0, COMPRESSED] {
        both(|case| (case.flags, case.size, case.payload) = (flags, 0, 0), Some(Fault::Format));
        both(|case| (case.flags, case.size) = (flags, 0), Some(Fault::Format));
        both(|case| (case.flags, case.payload) = (flags, 0), Some(Fault::Format));
        both(|case| (case.flags, case.size, case.payload) = (flags, 1, 1), None);
    }
    both(|case| case.payload = 4999, Some(Fault::Format));
    both(|case| case.payload = 5001, Some(Fault::Format));
    both(|case| (case.flags, case.payload) = (COMPRESSED, 4999), None);
    both(|case| (case.flags, case.payload) = (COMPRESSED, 5001), None);
    both(|case| case.flags = DICTIONARY, Some(Fault::Format));
    both(|case| case.flags = DICTIONARY | COMPRESSED, None);
}

#[test]
fn records() {
    let recipient = |id: u32, size: usize| {
        let mut bytes = vec![0; size];
        put(&mut bytes, 0, id);
        bytes
    };
    // Text.
    both(|case| case.records = record(2, b"text"), None);
    both(|case| case.records = record(0x7FFF, b"unknown"), None);
    both(|case| case.records = record(0x8002, b"unknown"), Some(Fault::Format));
    both(|case| case.records = record(0x8002, &recipient(KEKS[0], 44)), Some(Fault::Format));
    both(|case| case.records = record(0x8001, &recipient(KEKS[0], 43)), Some(Fault::Format));
    both(|case| case.records = record(0x8001, &recipient(KEKS[0], 45)), Some(Fault::Format));
    // A record that exceeds the manifest.
    both(|case| case.records = [2, 0, 1, 0].into(), Some(Fault::Format));
    // What is not encrypted needs no key.
    both(|case| case.records = record(0x8001, &recipient(KEKS[0], 44)), None);
    both(|case| case.records = record(0x8001, &recipient(OTHER, 44)), None);

    let encrypted = |records: &[Vec<u8>]| Case { flags: ENCRYPTED, records: records.concat(), ..direct() };
    let needs = |kek, at| Ok(Needs { root: 16, epoch: EPOCH, recipient: Some((kek, at)) });
    let [text, other] = [record(2, b"four or twelve"), record(0x8001, &recipient(OTHER, 44))];
    for (n, id) in KEKS.into_iter().enumerate() {
        let own = record(0x8001, &recipient(id, 44));
        let kek = 88 + 36 * n;
        assert_eq!(encrypted(std::slice::from_ref(&own)).judged(), needs(kek, 180));
        assert_eq!(encrypted(&[text.clone(), own.clone()]).judged(), needs(kek, 176 + 18 + 4));
        assert_eq!(encrypted(&[other.clone(), own.clone()]).judged(), needs(kek, 176 + 48 + 4));
        // The first of two.
        let more = record(0x8001, &recipient(KEKS[(n + 1) % 3], 44));
        assert_eq!(encrypted(&[own, more, other.clone()]).judged(), needs(kek, 180));
    }
    assert_eq!(encrypted(&[]).judged(), Err(Fault::Key));
    assert_eq!(encrypted(&[other]).judged(), Err(Fault::Key));
    // The id of a root, of no key, and a text of that size.
    assert_eq!(encrypted(&[record(0x8001, &recipient(ROOTS[0], 44))]).judged(), Err(Fault::Key));
    assert_eq!(encrypted(&[record(0x8001, &recipient(0, 44))]).judged(), Err(Fault::Key));
    assert_eq!(encrypted(&[record(2, &recipient(KEKS[0], 44))]).judged(), Err(Fault::Key));
}

#[test]
fn the_device_for_which_the_image_is() {
    both(|case| case.vendor = VENDOR + 1, Some(Fault::WrongVendor));
    both(|case| case.vendor = 0, Some(Fault::WrongVendor));
    both(|case| case.product = PRODUCT + 1, Some(Fault::WrongProduct));
    both(|case| case.product = 0, Some(Fault::WrongProduct));
    both(|case| case.program = 2, Some(Fault::WrongProduct));
    both(|case| case.flags = DATA, Some(Fault::WrongProduct));
    both(|case| case.is_data = true, Some(Fault::WrongProduct));
    both(|case| (case.flags, case.is_data) = (DATA, true), None);
    both(|case| case.unique_id = UNIQUE_ID, None);
    both(|case| case.unique_id = *b"unique id 97", Some(Fault::WrongProduct));
    for (hardware, fault) in [
        (1 << 5, None),
        (1 << 5 | 1 << 9, None),
        (u32::MAX, None),
        (1, Some(Fault::WrongProduct)),
        (1 << 4, Some(Fault::WrongProduct)),
        (1 << 6, Some(Fault::WrongProduct)),
        (!(1 << 5), Some(Fault::WrongProduct)),
    ] {
        both(|case| case.hardware = hardware, fault);
    }
    both(|case| (case.size, case.payload) = (ROOM, ROOM), None);
    both(|case| (case.size, case.payload) = (ROOM + 1, ROOM + 1), Some(Fault::Address));
}

#[test]
fn nothing_older() {
    both(|case| case.counter = COUNTER - 1, Some(Fault::Rollback));
    let later = Case { counter: COUNTER + 1, ..direct() };
    assert_eq!(later.judged(), accepted(16));
    with_certificate(|own| own.epoch = EPOCH - 1, Err(Fault::Rollback));
    with_certificate(|own| own.epoch = EPOCH + 1, Ok(Needs { root: 52, epoch: EPOCH + 1, recipient: None }));
}

#[test]
fn what_a_certificate_allows() {
    let wrong = Err(Fault::Signature);
    for size in [151, 153] {
        with_certificate(|own| own.size = size, wrong);
    }
    with_certificate(|own| own.algorithm = 2, wrong);
    for role in [0, 3] {
        with_certificate(|own| own.role = role, wrong);
    }
    with_certificate(|own| own.vendor = VENDOR + 1, wrong);
    with_certificate(|own| own.vendor = 0, wrong);
    with_certificate(|own| own.product = PRODUCT + 1, wrong);
    // All products of the vendor.
    with_certificate(|own| own.product = 0, accepted(52));
    with_certificate(|own| (own.lowest, own.highest) = (0, u32::MAX), accepted(52));
    with_certificate(|own| (own.lowest, own.highest) = (COUNTER + 1, u32::MAX), wrong);
    with_certificate(|own| (own.lowest, own.highest) = (0, COUNTER - 1), wrong);
    // A restriction of a later format.
    for at in 0..24 {
        with_certificate(|own| own.reserved[at] = 0x80, wrong);
    }
}

#[test]
fn the_root_that_has_signed() {
    with_certificate(|own| own.root = ROOTS[0], accepted(16));
    for id in [0, OTHER, KEKS[0]] {
        with_certificate(|own| own.root = id, Err(Fault::Key));
        assert_eq!(Case { signers: vec![id], ..direct() }.judged(), Err(Fault::Key), "{id:#x}");
    }
    // An unused place for a root has the id 0.
    let case = Case { signers: vec![0], roots: [ROOTS[0], 0], ..direct() };
    assert_eq!(case.judged(), Err(Fault::Key));
    // With a certificate, a root's own signature does not count.
    let mut case = Case { signers: vec![OTHER, ROOTS[0]], ..certified() };
    case.certificate.iter_mut().for_each(|own| own.root = OTHER);
    assert_eq!(case.judged(), Err(Fault::Key));
    for (signers, root) in [
        (vec![ROOTS[1]], 52),
        (vec![OTHER, ROOTS[1]], 52),
        (vec![ROOTS[1], ROOTS[0]], 16),
        (vec![OTHER, KEKS[0], ROOTS[0]], 16),
    ] {
        assert_eq!(Case { signers, ..direct() }.judged(), accepted(root));
    }
}

#[test]
fn a_test_key_needs_a_device_for_tests() {
    // The flag of the image, the role of the key, and both; bit 0 of the key block's flags allows it.
    for (flags, role) in [(TEST, None), (TEST, Some(1)), (0, Some(2)), (TEST, Some(2))] {
        let image = |for_tests| {
            let mut case = if role.is_some() { certified() } else { direct() };
            (case.flags, case.for_tests) = (flags, for_tests);
            case.certificate.iter_mut().for_each(|own| own.role = role.unwrap_or(1));
            case.judged()
        };
        let root = if role.is_some() { 52 } else { 16 };
        for for_tests in [0, 2, !1] {
            assert_eq!(image(for_tests), Err(Fault::Key), "{flags:#x}, {role:?}, {for_tests:#x}");
        }
        for for_tests in [1, 3] {
            assert_eq!(image(for_tests), accepted(root), "{flags:#x}, {role:?}, {for_tests:#x}");
        }
    }
    both(|case| case.for_tests = 1, None);
}

/// Is it possible, is it for this device, is it recent enough, are the keys there: with all faults from
/// one on, that one is reported.
#[test]
fn the_first_fault_is_told() {
    let faults: [(Fault, Change); 8] = [
        (Fault::Format, |case| case.chunk = 0),
        (Fault::WrongVendor, |case| case.vendor = 1),
        (Fault::WrongProduct, |case| case.product = 1),
        (Fault::Address, |case| (case.size, case.payload) = (ROOM + 1, ROOM + 1)),
        (Fault::Rollback, |case| case.counter = 0),
        (Fault::Signature, |case| case.certificate.iter_mut().for_each(|own| own.role = 9)),
        (Fault::Rollback, |case| case.certificate.iter_mut().for_each(|own| own.epoch = 0)),
        (Fault::Key, |case| case.certificate.iter_mut().for_each(|own| own.root = OTHER)),
    ];
    for (n, (fault, _)) in faults.iter().enumerate() {
        let mut case = certified();
        faults[n..].iter().for_each(|(_, change)| change(&mut case));
        assert_eq!(case.judged(), Err(*fault), "from {n} on");
    }
}

/// What the device of a bootloader has: board, services, features.
const HAS: Requirements = Requirements { board: 0x1234_5678, services: 2, features: 1 };

/// A record 8004h with these words.
fn requirements(words: [u32; 3]) -> Vec<u8> {
    record(0x8004, &words.map(u32::to_le_bytes).concat())
}

/// A RAM image for such a device.
fn of_bootloader(case: &mut Case) {
    (case.program, case.device_program, case.has) = (255, 255, Some(HAS));
    case.records = requirements([0x1234_5678, 2, 1]);
    case.certificate.iter_mut().for_each(|certificate| certificate.role = 3);
}

#[test]
fn a_bootloader_is_for_its_board_and_resident_part() {
    let with = |change: fn(&mut Case), fault| {
        both(
            |case| {
                of_bootloader(case);
                change(case);
            },
            fault,
        );
    };
    with(|_| {}, None);
    with(|case| case.records = requirements([0x1234_5678, 1, 1]), None);
    let refused = Some(Fault::WrongProduct);
    with(|case| case.records = requirements([0x1234_5679, 2, 1]), refused);
    with(|case| case.records = requirements([0x1234_5678, 3, 1]), refused);
    with(|case| case.records = requirements([0x1234_5678, 2, 3]), refused);
    with(|case| case.records = requirements([0x1234_5678, 2, 0]), refused);
    with(|case| case.records.clear(), refused);
    with(|case| case.records = record(0x8004, &[0; 8]), refused);
    // Two of them: the second one is a critical record that is not known.
    with(|case| case.records = requirements([0x1234_5678, 2, 1]).repeat(2), Some(Fault::Format));
    with(|case| case.has = None, refused);
    with(|case| case.program = 1, refused);
    with(|case| case.flags = 0x20, refused);
    with(|case| case.flags = DATA, refused);
    with(|case| (case.flags, case.payload) = (COMPRESSED | DICTIONARY, 100), refused);
    with(|case| (case.flags, case.payload) = (COMPRESSED, 100), None);
    with(|case| case.counter = COUNTER - 1, Some(Fault::Rollback));
}

#[test]
fn a_key_signs_bootloaders_or_programs() {
    for (role, holds) in [(1, false), (2, false), (3, true), (4, false)] {
        let mut case = certified();
        of_bootloader(&mut case);
        case.certificate.iter_mut().for_each(|certificate| certificate.role = role);
        assert_eq!(case.judged(), if holds { accepted(52) } else { Err(Fault::Signature) }, "role {role}");
    }
    with_certificate(|certificate| certificate.role = 3, Err(Fault::Signature));
}

/// Such a program could write a bootloader that nobody has verified.
#[test]
fn a_program_that_writes_flash_is_refused_where_the_bootloader_can_be_renewed() {
    both(
        |case| {
            case.has = Some(HAS);
            case.flags = 0x20;
        },
        Some(Fault::WrongProduct),
    );
    both(|case| case.has = Some(HAS), None);
    // A record of a bootloader in a program.
    both(
        |case| {
            case.has = Some(HAS);
            case.records = requirements([0x1234_5678, 2, 1]);
        },
        Some(Fault::Format),
    );
}
