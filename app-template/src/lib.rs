//! What the reference application is on the bus: its object dictionary. `main.rs` has the tasks.
//!
//! On the host the crate has the table alone.
#![no_std]

#[cfg(target_arch = "arm")]
pub mod bus;
pub mod entries;
#[cfg(target_arch = "arm")]
pub mod objects;
#[cfg(target_arch = "arm")]
pub mod process;
