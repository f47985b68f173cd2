//! Proof by power cut: the same update, the power cut at every flash operation, and once more in
//! the recovery.
//!
//! | module | what it does |
//! |---|---|
//! | `device` | level 1: `boot-core` on the flash model, as the bootloader runs it |
//! | `scenario` | what is done to the device, and what may be found after a cut |
//! | `points` | cuts, looks and counts |
//! | [`board`] | level 2: the built firmware in the emulator |
//!
//! Seeded bugs ([`Bug`]) show that the proof would notice.

pub mod board;
mod device;
#[path = "../../boot-core/tests/model/mod.rs"]
#[allow(missing_docs, reason = "it is the tests' own")]
pub mod model;
mod points;
mod scenario;

pub use device::{Bug, DECISION};
pub use points::{reproduce, run, shows, Point, Report, Shown};
pub use scenario::{Scenario, SCENARIOS};
