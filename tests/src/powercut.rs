//! Proof by power cut: the same update, with the power cut at every flash operation, and again
//! during the recovery.
//!
//! | module | what it does |
//! |---|---|
//! | `device` | level 1: `boot-core` on the flash model, as the bootloader runs it |
//! | `scenario` | the actions on the device, and the permitted states after a cut |
//! | `point` | the names of points |
//! | `points` | cuts, checks and counts |
//! | [`board`] | level 2: the built firmware in the emulator |
//!
//! Seeded bugs ([`Bug`]) show that the proof detects them.

pub mod board;
mod device;
mod point;
mod points;
mod scenario;

pub use device::{exit, Bug};
pub use points::{reproduce, run, shows, Cuts, Point, Report, Shown};
pub use scenario::{Scenario, SCENARIOS};
