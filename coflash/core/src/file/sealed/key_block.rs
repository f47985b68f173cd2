//! The key block, which makes a device a sealed device. [`seal::key_block`] defines its format.

use seal::key_block::{
    CHECK, COUNTER, EPOCH, FLAGS, FOR_TESTS, KEKS, KEK_COUNT, KEY, MAGIC, ROOTS, ROOT_COUNT, SIZE,
};

use super::key::{Kek, PublicKey};
use crate::file::checksum::CRC;

/// Why the key block is impossible.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BlockFault {
    /// A device without a root would accept no program.
    #[error("a sealed device needs a root: give a public key with --root")]
    NoRoot,
    /// There is room for two roots.
    #[error("{0} roots are too many: a device has room for {ROOT_COUNT}")]
    TooManyRoots(usize),
    /// There is room for three key-encryption keys.
    #[error("{0} key-encryption keys are too many: a device has room for {KEK_COUNT}")]
    TooManyKeks(usize),
    /// Two keys have the same id: a device would find only the first.
    #[error("two of the keys have the id {0:08X}h: a key was given twice; give each key once")]
    Twice(u32),
}

/// The key block of a device with these roots and key-encryption keys. The device accepts no
/// program with a lower security counter and no certificate with a lower epoch. With `for_tests` it
/// also accepts programs signed with test keys.
///
/// # Errors
/// See [`BlockFault`].
pub fn key_block(
    roots: &[PublicKey],
    keks: &[Kek],
    counter: u32,
    epoch: u32,
    for_tests: bool,
) -> Result<[u8; SIZE], BlockFault> {
    if roots.is_empty() {
        return Err(BlockFault::NoRoot);
    }
    if roots.len() > ROOT_COUNT {
        return Err(BlockFault::TooManyRoots(roots.len()));
    }
    if keks.len() > KEK_COUNT {
        return Err(BlockFault::TooManyKeks(keks.len()));
    }
    let roots: Vec<_> = roots.iter().map(|root| (root.id(), root.bytes())).collect();
    let keks: Vec<_> = keks.iter().map(|kek| (kek.id(), *kek.secret())).collect();
    for keys in [&roots, &keks] {
        let twice = |(at, (id, _)): &(usize, &(u32, _))| keys[..*at].iter().any(|(other, _)| other == id);
        if let Some((_, (id, _))) = keys.iter().enumerate().find(twice) {
            return Err(BlockFault::Twice(*id));
        }
    }
    Ok(of_ids(&roots, &keks, counter, epoch, for_tests))
}

/// The key block for keys with their ids, as many as there is room for.
pub(super) fn of_ids(
    roots: &[(u32, [u8; 32])],
    keks: &[(u32, [u8; 32])],
    counter: u32,
    epoch: u32,
    for_tests: bool,
) -> [u8; SIZE] {
    let mut block = [0; SIZE];
    let mut put = |at: usize, bytes: &[u8]| block[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &MAGIC);
    put(FLAGS, &(if for_tests { FOR_TESTS } else { 0 }).to_le_bytes());
    put(COUNTER, &counter.to_le_bytes());
    put(EPOCH, &epoch.to_le_bytes());
    for (from, count, keys) in [(ROOTS, ROOT_COUNT, roots), (KEKS, KEK_COUNT, keks)] {
        for (at, (id, key)) in (from..).step_by(KEY).take(count).zip(keys) {
            put(at, &id.to_le_bytes());
            put(at + 4, key);
        }
    }
    let check = CRC.checksum(&block[..CHECK]);
    block[CHECK..].copy_from_slice(&check.to_le_bytes());
    block
}

#[cfg(test)]
mod tests {
    use super::super::key::SigningKey;
    use super::*;

    fn root(seed: u8) -> PublicKey {
        SigningKey::from_seed([seed; 32]).unwrap().public()
    }

    fn kek(byte: u8) -> Kek {
        Kek::new([byte; 32]).unwrap()
    }

    #[test]
    fn keys_lie_where_the_device_finds_them() {
        let (roots, keks) = ([root(1), root(2)], [kek(3), kek(4), kek(5)]);
        let block = key_block(&roots, &keks, 0x0102_0304, 9, true).unwrap();
        assert_eq!(block[..16], *b"CBKB\x01\0\0\0\x04\x03\x02\x01\x09\0\0\0");
        for (number, root) in roots.iter().enumerate() {
            let at = 16 + 36 * number;
            assert_eq!(seal::key_block::find(&block, ROOTS, ROOT_COUNT, root.id()), Some(at));
            assert_eq!(block[at + 4..at + 36], root.bytes());
        }
        for (number, kek) in keks.iter().enumerate() {
            let at = 88 + 36 * number;
            assert_eq!(seal::key_block::find(&block, KEKS, KEK_COUNT, kek.id()), Some(at));
            assert_eq!(block[at + 4..at + 36], *kek.secret());
        }
        assert_eq!(block[196..252], [0; 56]);
        // The residue of CRC-32 over data followed by their CRC.
        assert_eq!(CRC.checksum(&block), 0x2144_DF1C);
    }

    #[test]
    fn too_few_too_many_and_double_keys_are_refused() {
        assert_eq!(key_block(&[], &[], 0, 0, false), Err(BlockFault::NoRoot));
        let three = [root(1), root(2), root(3)];
        assert_eq!(key_block(&three, &[], 0, 0, false), Err(BlockFault::TooManyRoots(3)));
        let keks = [1, 2, 3, 4].map(kek);
        assert_eq!(key_block(&three[..1], &keks, 0, 0, false), Err(BlockFault::TooManyKeks(4)));
        let twice = Err(BlockFault::Twice(root(1).id()));
        assert_eq!(key_block(&[root(1), root(1)], &[], 0, 0, false), twice);
        let twice = Err(BlockFault::Twice(kek(7).id()));
        assert_eq!(key_block(&three[..1], &[kek(7), kek(1), kek(7)], 0, 0, false), twice);
    }
}
