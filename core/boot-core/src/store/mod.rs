//! The non-volatile data: what is stored, under which key, and how.
//!
//! | module | what it holds |
//! |---|---|
//! | [`parameters`] | the trait to read and store values |
//! | [`journal`] | the power-fail-safe journal over two flash regions |
//! | [`node`] | node-ID and bit rate |
//! | [`renewal`] | the record of a renewal of the bootloader |
//!
//! Keys, values, slots and the record of a program are in [`shared_abi::journal`]: production writes the first ones.
//!
//! The code of the store does not access the flash: it returns the next operation, and its caller
//! carries the operation out. The store can therefore stay in the resident part, while the flash
//! operations are started and polled from RAM.

pub mod journal;
pub mod node;
pub mod parameters;
pub mod renewal;

pub use journal::Journal;
pub use node::NodeParameters;
pub use parameters::{Parameters, StoreError};
pub use renewal::RenewalRecord;
pub use shared_abi::journal::{Key, ProgramRecord, Seal, Value};
