//! A package for a machine: one file with the programs of several types of nodes, and their update.
//!
//! `docs/machine-package.md` has its bytes. An update has three steps, so that every user of this room, the
//! command line, a page or an agent, shows and confirms in its own way:
//!
//! 1. [`Package::parse`] checks all of the file, [`Package::trust`] its signatures;
//! 2. [`plan()`] compares the bus with it, and changes nothing;
//! 3. [`run()`] carries out what the user has confirmed.

mod fault;
pub mod manifest;
mod package;
mod plan;
mod recipe;
mod run;
mod signature;
pub mod zip;

pub use self::fault::{DeviceFault, Fault, Limit, SignatureFault};
pub use self::manifest::{Entry, Identity, Manifest};
pub use self::package::{is_package, kind, looks_like, make, version, Package, Part, FRONT};
pub use self::plan::{
    matched, plan, Device, Foreign, Missing, Plan, PlanError, Step, Stranger, Todo,
    EVERY_VERSION_HAS_THIS_CRC,
};
pub use self::recipe::{Recipe, RecipeDevice, RecipeFault, Row};
pub use self::run::{run, Bad, Good, Outcome, RunOptions};
pub use self::signature::Signer;
