//! What the steps work with.

use std::path::PathBuf;

use shared_abi::layout::Layout;

use super::coflash::Coflash;
use super::power::Power;
use super::probe::Probe;

/// The bench: a board with everything that reaches it.
pub struct Bench {
    pub board: &'static Layout,
    pub probe: Probe,
    pub power: Option<Power>,
    pub coflash: Coflash,
    /// The folder of the board's images.
    pub images: PathBuf,
    /// The folder for files that the steps make.
    pub work: PathBuf,
    /// The CRC of the last program that went into the device to its end, as text.
    pub installed: Option<String>,
    /// The document that `coflash conform` wrote.
    pub conform: Option<serde_json::Value>,
}
