//! The verifier against RFC 8032, all vectors of Wycheproof and `ed25519-dalek`.

use crate::hex::hex;
use curve25519_dalek::{constants::EIGHT_TORSION, EdwardsPoint, Scalar};
use ed25519_dalek::{Signature, Signer, SigningKey, Verifier, VerifyingKey};
use proptest::prelude::*;
use seal::ed25519::Verification;
use sha2::{Digest, Sha512};

fn verify(public: &[u8; 32], message: &[u8], signature: &[u8; 64]) -> bool {
    verdict_and_steps(public, message, signature).0
}

fn verdict_and_steps(public: &[u8; 32], message: &[u8], signature: &[u8; 64]) -> (bool, usize) {
    let digest = Sha512::new().chain_update(&signature[..32]).chain_update(public).chain_update(message);
    let mut verification = Verification::IDLE;
    verification.start(public, signature, &digest.finalize().into());
    let steps = |step| verification.step().map(|verdict| (verdict, step));
    let (verdict, steps) = (0..1000).find_map(steps).expect("more than 1000 steps");
    assert_eq!(verification.step(), Some(verdict), "the verdict stays");
    (verdict, steps)
}

/// The result of `ed25519-dalek`.
fn dalek(public: &[u8; 32], message: &[u8], signature: &[u8; 64]) -> bool {
    VerifyingKey::from_bytes(public)
        .is_ok_and(|key| key.verify_strict(message, &Signature::from_bytes(signature)).is_ok())
}

fn array<const N: usize>(digits: &str) -> [u8; N] {
    hex(digits).try_into().unwrap()
}

/// RFC 8032, 7.1: TEST 1, 2, 3, and TEST SHA(abc). TEST 1024 is one of Wycheproof's.
const RFC_8032: [(&str, &str, &str); 4] = [
    (
        "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
        "",
        "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bacc61e39701cf9b46b
         d25bf5f0595bbe24655141438e7a100b",
    ),
    (
        "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
        "72",
        "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da085ac1e43e15996e458f3613d0f11d8c
         387b2eaeb4302aeeb00d291612bb0c00",
    ),
    (
        "fc51cd8e6218a1a38da47ed00230f0580816ed13ba3303ac5deb911548908025",
        "af82",
        "6291d657deec24024827e69c3abe01a30ce548a284743a445e3680d7db5ac3ac18ff9b538d16f290ae67f760984dc659
         4a7c15e9716ed28dc027beceea1ec40a",
    ),
    (
        "ec172b93ad5e563bf4932c70e1245034c35467ef2efd4d64ebf819683467e2bf",
        "ddaf35a193617abacc417349ae20413112e6fa4e89a97ea20a9eeee64b55d39a2192992a274fc1a836ba3c23a3feebbd
         454d4423643ce80e2a9ac94fa54ca49f",
        "dc2a4459e7369633a52b1bf277839a00201009a3efbf3ecb69bea2186c26b58909351fc9ac90b3ecfdfbc7c66431e030
         3dca179c138ac17ad9bef1177331a704",
    ),
];

#[test]
fn the_vectors_of_rfc_8032() {
    for (public, message, signature) in RFC_8032 {
        assert!(verify(&array(public), &hex(message), &array(signature)), "{public}");
    }
}

#[test]
fn each_flipped_bit_of_a_signature_or_key_is_seen() {
    let (public, message, signature) = RFC_8032[1];
    let (public, message, signature) = (array(public), hex(message), array(signature));
    for bit in 0..512 {
        let mut other: [u8; 64] = signature;
        other[bit / 8] ^= 1 << (bit % 8);
        assert!(!verify(&public, &message, &other), "bit {bit} of the signature");
    }
    for bit in 0..256 {
        let mut other: [u8; 32] = public;
        other[bit / 8] ^= 1 << (bit % 8);
        assert!(!verify(&other, &message, &signature), "bit {bit} of the key");
    }
}

#[test]
fn all_vectors_of_wycheproof() {
    let set = wycheproof::eddsa::TestSet::load(wycheproof::eddsa::TestName::Ed25519).unwrap();
    let mut seen = 0;
    for group in &set.test_groups {
        let public: &[u8; 32] = group.key.pk[..].try_into().expect("a public key has 32 bytes");
        for test in &group.tests {
            // A signature with another length than 64 bytes cannot be passed to this verifier.
            let valid = test.sig[..].try_into().is_ok_and(|signature| verify(public, &test.msg, signature));
            assert_eq!(
                valid,
                test.result == wycheproof::TestResult::Valid,
                "{}: {}",
                test.tc_id,
                test.comment
            );
            seen += 1;
        }
    }
    assert_eq!(seen, set.number_of_tests);
    let long = array::<32>("278117fc144c72340f67d0f2316e8386ceffbf2b2428c9c51fef7c597f1d426e");
    assert!(set.test_groups.iter().any(|group| group.key.pk[..] == long), "RFC 8032's TEST 1024");
}

/// y = 0 to 19 and p - 1 to 2^255 - 1 (so 0, 1, -1 in every encoding, and all non-canonical
/// encodings), and y of the points of order 8, each with both signs of x.
fn strange_points() -> Vec<[u8; 32]> {
    let mut points = vec![
        array("c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a"),
        array("26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05"),
    ];
    for small in 0..20 {
        let mut y = [0; 32];
        y[0] = small;
        points.push(y);
        y = [0xff; 32];
        y[0] = 0xec + small % 20;
        y[31] = 0x7f;
        points.push(y);
    }
    let mut signed = points.clone();
    signed.iter_mut().for_each(|y| y[31] |= 0x80);
    [points, signed].concat()
}

#[test]
fn the_strange_points_have_all_of_small_order_and_others() {
    let keys = strange_points().into_iter().filter_map(|y| VerifyingKey::from_bytes(&y).ok());
    let (weak, others): (Vec<_>, Vec<_>) = keys.partition(|key| key.is_weak());
    let mut points: Vec<_> = weak.iter().map(|key| key.to_edwards().compress().to_bytes()).collect();
    points.sort_unstable();
    points.dedup();
    assert_eq!(points.len(), 8, "the points whose order divides 8");
    assert!(weak.len() > 8, "some in encodings that are not canonical");
    assert!(others.iter().any(|key| key.to_edwards().compress().as_bytes() != key.as_bytes()));
}

#[test]
fn strange_points_as_r_or_key_or_both_are_refused() {
    let key = SigningKey::from_bytes(&[7; 32]);
    let good = key.sign(b"message").to_bytes();
    let with = |r: &[u8; 32], s: &[u8]| -> [u8; 64] { [r, s].concat().try_into().unwrap() };
    let verdicts = |public: &[u8; 32], signature: &[u8; 64]| {
        assert!(!verify(public, b"message", signature), "{public:x?} {signature:x?}");
        assert!(!dalek(public, b"message", signature));
    };
    for point in strange_points() {
        verdicts(key.verifying_key().as_bytes(), &with(&point, &good[32..]));
        verdicts(&point, &good);
        // With S = 0 the equation holds for some of them.
        for r in strange_points().iter().step_by(3) {
            verdicts(&point, &with(r, &[0; 32]));
        }
    }
}

/// The order of the group, little-endian (RFC 8032, 5.1).
fn plus_order(s: &[u8]) -> [u8; 32] {
    let order = array::<32>("edd3f55c1a631258d69cf7a2def9de1400000000000000000000000000000010");
    let mut carry = 0;
    let mut sum = [0; 32];
    for at in 0..32 {
        carry += u16::from(s[at]) + u16::from(order[at]);
        sum[at] = carry as u8;
        carry >>= 8;
    }
    sum
}

/// A key with a component of small order (a mixed key) is not refused; the result depends on
/// whether [k]A is computed with k modulo L, as in other libraries, and without the cofactor.
#[test]
fn keys_with_a_part_of_small_order_get_dalek_s_verdict() {
    use ed25519_dalek::hazmat::ExpandedSecretKey;
    let torsion = VerifyingKey::from_bytes(&strange_points()[0]).unwrap().to_edwards();
    let mut verdicts = [0; 2];
    for seed in 0..40_u8 {
        let key = SigningKey::from_bytes(&[seed; 32]);
        let mixed = (key.verifying_key().to_edwards() + torsion).compress().to_bytes();
        // Signed for the mixed key: k depends on its encoding.
        let public = VerifyingKey::from_bytes(&mixed).unwrap();
        let secret = ExpandedSecretKey::from(key.as_bytes());
        let signature = ed25519_dalek::hazmat::raw_sign::<Sha512>(&secret, b"mixed", &public).to_bytes();
        let verdict = verify(&mixed, b"mixed", &signature);
        assert_eq!(verdict, dalek(&mixed, b"mixed", &signature), "{seed}");
        verdicts[usize::from(verdict)] += 1;
    }
    // For one in eight values of k, the component of small order vanishes.
    assert!(verdicts[0] > 0 && verdicts[1] > 0, "{verdicts:?}");
}

/// With the secret key, or without any key, one can make signatures that satisfy the equation with
/// an R or a key of small order. Plain verification accepts them.
#[test]
fn what_holds_the_equation_with_small_order_is_refused() {
    let check = |key: EdwardsPoint, r: EdwardsPoint, s: &dyn Fn(Scalar) -> Scalar| {
        let mut seen = 0;
        for message in 0..100_u8 {
            let [public, r] = [key, r].map(|point| point.compress().to_bytes());
            let hash = Sha512::new().chain_update(r).chain_update(public).chain_update([message]);
            let s = s(Scalar::from_bytes_mod_order_wide(&hash.finalize().into()));
            let signature: [u8; 64] = [r, s.to_bytes()].concat().try_into().unwrap();
            let theirs = VerifyingKey::from_bytes(&public).unwrap();
            // One message in eight, for which the components of small order cancel.
            if theirs.verify(&[message], &Signature::from_bytes(&signature)).is_ok() {
                assert!(!verify(&public, &[message], &signature), "{message}");
                assert!(!dalek(&public, &[message], &signature));
                seen += 1;
            }
        }
        assert!(seen > 0);
    };
    let secret = Scalar::from(123_456_789_u64);
    let key = EdwardsPoint::mul_base(&secret);
    for small in EIGHT_TORSION {
        // First a key of small order with a normal R; then an R of small order with a mixed key.
        check(small, key, &|_| secret);
        check(key + small, small, &|k| k * secret);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn what_dalek_signs_is_good_and_nothing_else(
        seed: [u8; 32],
        message: Vec<u8>,
        flip in 0..8 * (64 + 32 + 1_usize),
    ) {
        let key = SigningKey::from_bytes(&seed);
        let mut public = key.verifying_key().to_bytes();
        let mut signature = key.sign(&message).to_bytes();
        prop_assert!(verify(&public, &message, &signature));
        // S + L is the same number in the equation.
        let mut other = signature;
        other[32..].copy_from_slice(&plus_order(&signature[32..]));
        prop_assert!(!verify(&public, &message, &other));
        let mut message = message;
        message.push(0);
        let last = message.len() - 1;
        match flip / 8 {
            at @ 0..64 => signature[at] ^= 1 << (flip % 8),
            at @ 64..96 => public[at - 64] ^= 1 << (flip % 8),
            _ => message[last] ^= 1 << (flip % 8),
        }
        prop_assert!(!verify(&public, &message, &signature));
    }

    #[test]
    fn any_bytes_get_dalek_s_verdict(public: [u8; 32], r: [u8; 32], s: [u8; 32], message: Vec<u8>) {
        let signature = [r, s].concat().try_into().unwrap();
        prop_assert_eq!(verify(&public, &message, &signature), dalek(&public, &message, &signature));
    }

    /// Half of all keys are not points of the curve. These are refused before any sum is computed.
    #[test]
    fn a_key_that_is_no_point_is_refused_at_once(public: [u8; 32]) {
        let (verdict, steps) = verdict_and_steps(&public, b"", &[1; 64]);
        prop_assert!(!verdict);
        prop_assert_eq!(VerifyingKey::from_bytes(&public).is_ok(), steps > 200);
    }
}
