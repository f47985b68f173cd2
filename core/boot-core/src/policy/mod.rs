//! The product's choices about downloads, and the rules that follow from them.

mod choices;
mod judge;

pub use choices::{AppInfo, Erase, Policy, Renewal, SealPolicy, Verdict};
pub(crate) use judge::Judge;
