//! Hash, key ids and encryption of sealed images, each implemented by an external crate.

use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::{Digest as _, Sha512, Sha512_256};

/// SHA-512/256 (FIPS 180-4): the only hash of sealed images.
#[must_use]
pub fn hash(bytes: &[u8]) -> [u8; 32] {
    Sha512_256::digest(bytes).into()
}

/// HMAC-SHA-512 (RFC 2104) over all parts in sequence.
pub(super) fn hmac(key: &[u8], parts: &[&[u8]]) -> [u8; 64] {
    // An HMAC accepts a key of any length.
    let Ok(mut hmac) = Hmac::<Sha512>::new_from_slice(key) else { return [0; 64] };
    for part in parts {
        hmac.update(part);
    }
    hmac.finalize().into_bytes().into()
}

/// The id of a key: the first four bytes of its SHA-512, little-endian.
pub(super) fn id_of(key: &[u8; 32]) -> u32 {
    let [a, b, c, d, ..] = <[u8; 64]>::from(Sha512::digest(key));
    u32::from_le_bytes([a, b, c, d])
}

/// Wraps the key of an image for the holders of a key-encryption key. Returns bytes 32 to 39 of the
/// key stream, which reveal a wrong key-encryption key, and the image's key exclusive-or bytes 0 to
/// 31. The same operation unwraps the key.
pub(super) fn wrap(kek: &[u8; 32], nonce: &[u8; 16], key: &[u8; 32]) -> ([u8; 8], [u8; 32]) {
    let stream = hmac(kek, &[seal::wire::WRAP_DOMAIN, nonce]);
    let mut wrapped = *key;
    for (byte, with) in wrapped.iter_mut().zip(stream) {
        *byte ^= with;
    }
    (seal::wire::array(&stream, 32), wrapped)
}

/// ChaCha20 (RFC 8439) from block 0 on, for encryption and decryption.
pub(super) fn chacha20(bytes: &mut [u8], key: &[u8; 32], nonce: &[u8; 16]) {
    use chacha20::cipher::{KeyIvInit as _, StreamCipher as _};
    let nonce: [u8; 12] = seal::wire::array(nonce, 0);
    // The end of the stream is 2^38 bytes away: every payload is shorter.
    chacha20::ChaCha20::new(key.into(), (&nonce).into()).apply_keystream(bytes);
}
