//! Processes sealed images between the queue and the flash: checks, authenticates, decrypts and
//! decompresses them (`seal::wire` has the format, docs/security.md the purpose).
//!
//! The order is essential: nothing is decrypted, decompressed or written before it is authentic.
//! The head is held until its signatures are found good; each chunk is held until its hash matches
//! the one in the previous authentic chunk.
//!
//! | file | what it has |
//! |---|---|
//! | [`unsealer`] | the interface, and the signature of a request for rights |
//! | [`image`] | an image from its first byte on: the stages of its head |
//! | [`content`] | an image with an authentic head: the phases of dictionary, chunks and last check |
//! | [`buffers`] | the memory that the stages share |
//!
//! A device that takes sealed images has an [`Unsealer`] with a [`Workshop`]; in any other device,
//! every question to the [`Unsealer`] is answered with no. Other modules ask it, and never how the
//! bootloader was built.

mod buffers;
mod content;
mod image;
mod unsealer;

pub(crate) use image::{proved, Place, Progress};
pub(crate) use unsealer::{Edition, News, Outcome, Request, Unsealer, Workshop};
