//! Sealed images: programs that a device accepts only from the holder of a key.
//!
//! | module | what it is |
//! |---|---|
//! | [`wire`] | the file `CBS1`, field by field |
//! | [`judge`] | whether a device may accept an image, before the check of the signatures |
//! | [`key_block`] | the keys in a device |
//! | [`access`] | the functions of a device that need a root key, and its event log |
//! | [`sha512`] | SHA-512, SHA-512/256, HMAC-SHA-512 |
//! | [`ed25519`] | verification of Ed25519 signatures |
//! | [`chacha20`] | ChaCha20 |
//! | [`lzma`] | raw LZMA, decompression |
//!
//! Device and host tool use the same code. Nothing here signs: the host signs with another crate,
//! or a hardware security module does.
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
