//! Files: reading, conversion, sealed images.

mod bad_input;
mod convert;
mod sealed;
