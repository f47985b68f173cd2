//! Common code of the tests and the demonstration: the built firmware, and its bench.

pub mod attacker;
pub mod bench;
pub mod call_back;
pub mod dead_crystal;
pub mod eds;
pub mod endpoint;
pub mod factory;
pub mod firmware;
pub mod fleet;
pub mod listener;
pub mod masters;
pub mod powercut;
mod products;
pub mod renewal;
pub mod script;
pub mod sealed;
pub mod sealed_board;
pub mod serial;
pub mod silicon;
pub mod stack;
pub mod throughput;
pub mod tools;
