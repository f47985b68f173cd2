//! The non-volatile data: what is stored, under which key, and how.
//!
//! | module | what it holds |
//! |---|---|
//! | [`parameters`] | keys, values, and the trait to read and store them |
//! | [`journal`] | the power-fail-safe journal over two flash regions |
//! | [`record`] | the record of a program |
//! | [`node`] | node-ID and bit rate |
//! | [`renewal`] | the record of a renewal of the bootloader |
//!
//! The code of the store does not access the flash: it returns the next operation, and its caller
//! carries the operation out. The store can therefore stay in the resident part, while the flash
//! operations are started and polled from RAM.

pub mod journal;
pub mod node;
pub mod parameters;
pub mod record;
pub mod renewal;

pub use journal::Journal;
pub use node::NodeParameters;
pub use parameters::{Key, Parameters, StoreError, Value};
pub use record::ProgramRecord;
pub use renewal::RenewalRecord;
