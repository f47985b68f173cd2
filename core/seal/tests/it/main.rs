//! The algorithms against their standards, other crates and Wycheproof, and the format against
//! literal bytes.

mod chacha20;
mod ed25519;
mod file;
mod hex;
mod judge;
mod lzma;
mod sha512;
mod wire;
