//! SHA-512, SHA-512/256 and HMAC-SHA-512 against the standards' examples, Wycheproof and the crates
//! `sha2` and `hmac`.

use crate::hex::hex;
use hmac::{Hmac, KeyInit, Mac};
use proptest::prelude::*;
use seal::sha512::{hash_256, hmac, Sha512};
use sha2::{Digest, Sha512 as Sha2, Sha512_256};

const TWO_BLOCKS: &[u8] = b"abcdefghbcdefghicdefghijdefghijkefghijklfghijklmghijklmn\
    hijklmnoijklmnopjklmnopqklmnopqrlmnopqrsmnopqrstnopqrstu";

fn sha512(message: &[u8]) -> [u8; 64] {
    let mut hash = Sha512::new();
    hash.update(message);
    hash.finish()
}

/// NIST, "Examples with Intermediate Values", SHA512.pdf; the last is RFC 6234's TEST3.
#[test]
fn sha_512_of_the_examples_of_nist() {
    for (message, expected) in [
        (
            b"abc".to_vec(),
            "ddaf35a193617aba cc417349ae204131 12e6fa4e89a97ea2 0a9eeee64b55d39a
             2192992a274fc1a8 36ba3c23a3feebbd 454d4423643ce80e 2a9ac94fa54ca49f",
        ),
        (
            TWO_BLOCKS.to_vec(),
            "8e959b75dae313da 8cf4f72814fc143f 8f7779c6eb9f7fa1 7299aeadb6889018
             501d289e4900f7e4 331b99dec4b5433a c7d329eeb6dd2654 5e96e55b874be909",
        ),
        (
            vec![b'a'; 1_000_000],
            "e718483d0ce76964 4e2e42c7bc15b463 8e1f98b13b204428 5632a803afa973eb
             de0ff244877ea60a 4cb0432ce577c31b eb009c5c2c49aa2e 4eadb217ad8cc09b",
        ),
    ] {
        assert_eq!(sha512(&message).to_vec(), hex(expected));
    }
}

/// NIST, "Examples with Intermediate Values", SHA512_256.pdf.
#[test]
fn sha_512_256_of_the_examples_of_nist() {
    assert_eq!(
        hash_256(&[b"abc"]).to_vec(),
        hex("53048e2681941ef9 9b2e29b76b4c7dab e4c2d0c634fc6d46 e0e2f13107e7af23")
    );
    assert_eq!(
        hash_256(&[TWO_BLOCKS]).to_vec(),
        hex("3928e184fb8690f8 40da3988121d31be 65cb9d3ef83ee614 6feac861e19b563a")
    );
}

/// RFC 4231, test cases 1 to 4. A key with fewer than 32 bytes is equal to the same key padded with
/// zeros (RFC 2104, 2).
#[test]
fn hmac_of_the_test_cases_of_rfc_4231() {
    for (key, data, expected) in [
        (
            vec![0x0b; 20],
            b"Hi There".to_vec(),
            "87aa7cdea5ef619d4ff0b4241a1d6cb02379f4e2ce4ec2787ad0b30545e17cde
             daa833b7d6b8a702038b274eaea3f4e4be9d914eeb61f1702e696c203a126854",
        ),
        (
            b"Jefe".to_vec(),
            b"what do ya want for nothing?".to_vec(),
            "164b7a7bfcf819e2e395fbe73b56e0a387bd64222e831fd610270cd7ea250554
             9758bf75c05a994a6d034f65f8f0e6fdcaeab1a34d4a6b4b636e070a38bce737",
        ),
        (
            vec![0xaa; 20],
            vec![0xdd; 50],
            "fa73b0089d56a284efb0f0756c890be9b1b5dbdd8ee81a3655f83e33b2279d39
             bf3e848279a722c806b485a47e67c807b946a337bee8942674278859e13292fb",
        ),
        (
            (1..=25).collect(),
            vec![0xcd; 50],
            "b0ba465637458c6990e5a8c5f61d4af7e576d97ff94b872de76f8050361ee3db
             a91ca5c11aa25eb4d679275cc5788063a5f19741120c4f2de2adebeb10a298dd",
        ),
    ] {
        let mut whole = [0; 32];
        whole[..key.len()].copy_from_slice(&key);
        assert_eq!(hmac(&whole, &[&data]).to_vec(), hex(expected));
    }
}

#[test]
fn hmac_of_the_vectors_of_wycheproof() {
    let set = wycheproof::mac::TestSet::load(wycheproof::mac::TestName::HmacSha512).unwrap();
    let mut seen = 0;
    for test in set.test_groups.iter().flat_map(|group| &group.tests) {
        if test.key.len() <= 32 {
            let mut key = [0; 32];
            key[..test.key.len()].copy_from_slice(&test.key);
            let mac = hmac(&key, &[&test.msg]);
            assert_eq!(
                mac.starts_with(&test.tag),
                test.result == wycheproof::TestResult::Valid,
                "{}",
                test.tc_id
            );
            seen += 1;
        }
    }
    assert!(seen >= 6, "only {seen} vectors have a key of up to 32 bytes");
}

/// Every length around the ends of the first three blocks.
#[test]
fn every_length_agrees_with_sha2() {
    let message: Vec<u8> = (0..400_u32).map(|n| (n * 7 + n / 3) as u8).collect();
    for length in 0..message.len() {
        let message = &message[..length];
        assert_eq!(sha512(message)[..], Sha2::digest(message)[..], "{length}");
        assert_eq!(hash_256(&[message])[..], Sha512_256::digest(message)[..], "{length}");
    }
}

proptest! {
    #[test]
    fn any_parts_agree_with_sha2(parts: Vec<Vec<u8>>) {
        let whole = parts.concat();
        let parts: Vec<&[u8]> = parts.iter().map(|part| part.as_slice()).collect();
        let mut hash = Sha512::new();
        parts.iter().for_each(|part| hash.update(part));
        prop_assert_eq!(&hash.finish()[..], &Sha2::digest(&whole)[..]);
        prop_assert_eq!(&hash_256(&parts)[..], &Sha512_256::digest(&whole)[..]);
    }

    #[test]
    fn any_key_and_parts_agree_with_hmac(key: [u8; 32], parts: Vec<Vec<u8>>) {
        let mut theirs = Hmac::<Sha2>::new_from_slice(&key).unwrap();
        theirs.update(&parts.concat());
        let parts: Vec<&[u8]> = parts.iter().map(|part| part.as_slice()).collect();
        prop_assert_eq!(&hmac(&key, &parts)[..], &theirs.finalize().into_bytes()[..]);
    }
}
