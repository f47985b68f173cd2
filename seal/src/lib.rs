//! Sealed images: programs that a device takes from nobody but the holder of a key.
//!
//! | module | what it is |
//! |---|---|
//! | [`wire`] | the file `CBS1`, field by field |
//! | [`judge`] | whether a device may take an image, before a signature is looked at |
//! | [`key_block`] | the keys in a device |
//! | [`access`] | what a device does for the holder of a root key alone, and what it records |
//! | [`sha512`] | SHA-512, SHA-512/256, HMAC-SHA-512 |
//! | [`ed25519`] | whether an Ed25519 signature is good |
//! | [`chacha20`] | ChaCha20 |
//! | [`lzma`] | raw LZMA, unpacked |
//!
//! Device and host tool use the same code. Nothing here signs: the host does that with a crate of
//! its own, or a hardware security module does.
#![no_std]
#![forbid(unsafe_code)]

pub mod access;
pub mod chacha20;
pub mod ed25519;
pub mod judge;
pub mod key_block;
pub mod lzma;
pub mod sha512;
pub mod wire;
mod words;

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
