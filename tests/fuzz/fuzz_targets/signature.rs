//! The verifier of sealed images against ed25519-dalek.
//!
//! Must hold: for a key, a signature and a message from the fuzzer, and for valid ones that it has
//! changed, both give the same result; and our verification ends.
#![cfg_attr(fuzzing, no_main)]

use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use seal::ed25519::Verification;
use seal::sha512::Sha512;

coboot_fuzz::target!(|bytes: &[u8]| {
    let Some((seed, rest)) = bytes.split_first_chunk::<32>() else { return };
    let Some((changes, message)) = rest.split_first_chunk::<96>() else { return };
    let signer = SigningKey::from_bytes(seed);
    let mut key = signer.verifying_key().to_bytes();
    let mut signature = signer.sign(message).to_bytes();
    for (byte, change) in key.iter_mut().chain(&mut signature).zip(changes) {
        *byte ^= change;
    }
    let mut hash = Sha512::new();
    for part in [&signature[..32], &key, message] {
        hash.update(part);
    }
    let mut ours = Verification::IDLE;
    ours.start(&key, &signature, &hash.finish());
    let verdict = (0..10_000).find_map(|_| ours.step()).expect("a verdict");
    let theirs = VerifyingKey::from_bytes(&key);
    let theirs =
        theirs.is_ok_and(|key| key.verify_strict(message, &Signature::from_bytes(&signature)).is_ok());
    assert_eq!(verdict, theirs);
});
