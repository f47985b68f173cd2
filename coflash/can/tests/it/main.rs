//! The tests of the crate from outside.

mod decode;
