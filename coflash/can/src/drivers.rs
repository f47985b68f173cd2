//! The adapters with drivers of their own, which are features of this crate: a row for each.

use super::adapter::{Adapter, AdapterError};
use super::found::{Found, Kind, Missing};

type Opened = Result<Box<dyn Adapter + Send>, AdapterError>;

/// What an adapter takes of a URL, what opens it, and what finds it.
pub(super) struct Row {
    kind: Kind,
    /// Checks what the URL has after the scheme, and the bit rate, if it has one.
    pub(super) check: fn(&str, Option<u32>) -> Result<(), &'static str>,
    /// Opens what was checked, at a bit rate in bit/s.
    pub(super) open: fn(&str, u32) -> Opened,
    /// Lists those of this computer.
    pub(super) list: fn() -> Result<Vec<Found>, Missing>,
}

/// The drivers of this build. To add one, add its file, a feature and a row.
const ROWS: &[Row] = &[
    #[cfg(feature = "peak")]
    Row {
        kind: Kind::Peak,
        check: super::peak::check,
        open: |channel, rate| Ok(Box::new(super::peak::open(channel, rate)?)),
        list: super::peak::list,
    },
    #[cfg(feature = "kvaser")]
    Row {
        kind: Kind::Kvaser,
        check: super::kvaser::check,
        open: |channel, rate| Ok(Box::new(super::kvaser::open(channel, rate)?)),
        list: super::kvaser::list,
    },
    #[cfg(feature = "gs_usb")]
    Row {
        kind: Kind::GsUsb,
        check: super::gs_usb::check,
        open: |which, rate| Ok(Box::new(super::gs_usb::open(which, rate)?)),
        list: super::gs_usb::list,
    },
];

/// The driver of a kind.
///
/// # Errors
/// This build has none, as a sentence.
pub(super) fn driver(kind: Kind) -> Result<&'static Row, String> {
    let row = ROWS.iter().find(|row| row.kind == kind);
    row.ok_or_else(|| format!("this coflash was built without {kind}"))
}
