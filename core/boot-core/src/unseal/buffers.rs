//! The memory that the stages of an image share.

use seal::ed25519::Verification;
use seal::lzma::Decoder;
use seal::sha512::Sha512;
use seal::wire::{HASH, MAX_CHUNK, MAX_HEAD};
use zeroize::Zeroize;

/// The most bytes that the decoder leaves for the next chunk.
pub(super) const CARRY: usize = 24;
/// The offset of a chunk's payload in the buffer: after the rest of the previous chunk, and after
/// the hash of the next one.
pub(super) const PAYLOAD: usize = CARRY + HASH;
/// The offset of the decompressed bytes for the flash: after the largest chunk.
pub(super) const UNPACKED: usize = PAYLOAD + (1 << MAX_CHUNK);
/// The number of bytes that are decompressed at a time.
pub(super) const UNPACK: usize = 512;

/// The large parts of the state. They are outside the stages, so that none of them is ever moved.
pub(super) struct Buffers {
    pub verification: Verification,
    pub lzma: Decoder,
    /// The hash of the chunk that is being received, or of the flash that is being hashed.
    pub hash: Sha512,
    pub head: [u8; MAX_HEAD],
    /// The key of the chunks, if they are encrypted.
    pub key: [u8; 32],
    /// A chunk, and the decompressed bytes after it.
    pub bytes: [u8; UNPACKED + UNPACK],
}

impl Buffers {
    /// All of it is zero.
    pub(super) const fn new() -> Self {
        Self {
            verification: Verification::IDLE,
            lzma: Decoder::new(),
            hash: Sha512::IDLE,
            head: [0; MAX_HEAD],
            key: [0; 32],
            bytes: [0; UNPACKED + UNPACK],
        }
    }

    /// Removes the secrets: the key, and what was decrypted.
    pub(super) fn wipe(&mut self) {
        self.key.zeroize();
        self.bytes.zeroize();
    }
}

/// Starts to check a signature.
pub(super) fn start(
    verification: &mut Verification,
    key: &[u8; 32],
    signature: &[u8; 64],
    message: &[&[u8]],
) {
    let mut hash = Sha512::new();
    hash.update(&signature[..32]);
    hash.update(key);
    for part in message {
        hash.update(part);
    }
    verification.start(key, signature, &hash.finish());
}
