//! Hash, key ids and encryption of sealed images, each by a crate.

use hmac::{Hmac, Mac as _};
use sha2::{Digest as _, Sha512, Sha512_256};

/// SHA-512/256 (FIPS 180-4): the only hash of sealed images.
#[must_use]
pub fn hash(bytes: &[u8]) -> [u8; 32] {
    Sha512_256::digest(bytes).into()
}

/// HMAC-SHA-512 (RFC 2104) over the parts, one behind the other.
pub(super) fn hmac(key: &[u8], parts: &[&[u8]]) -> [u8; 64] {
    // An HMAC takes a key of any length.
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

/// The key of an image, wrapped for the holders of a key-encryption key: bytes 32 to 39 of the key
/// stream, which tell a wrong one, and the image's key exclusive-or bytes 0 to 31. The same undoes it.
pub(super) fn wrap(kek: &[u8; 32], nonce: &[u8; 16], key: &[u8; 32]) -> ([u8; 8], [u8; 32]) {
    let stream = hmac(kek, &[seal::wire::WRAP_DOMAIN, nonce]);
    let mut wrapped = *key;
    for (byte, with) in wrapped.iter_mut().zip(stream) {
        *byte ^= with;
    }
    (seal::wire::array(&stream, 32), wrapped)
}

/// ChaCha20 (RFC 8439) from block 0 on. The same undoes it.
pub(super) fn chacha20(bytes: &mut [u8], key: &[u8; 32], nonce: &[u8; 16]) {
    use chacha20::cipher::{KeyIvInit as _, StreamCipher as _};
    let nonce: [u8; 12] = seal::wire::array(nonce, 0);
    // A block is some 2^38 bytes away from the end of the stream: no payload has so many.
    chacha20::ChaCha20::new(key.into(), (&nonce).into()).apply_keystream(bytes);
}
