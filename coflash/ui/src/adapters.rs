//! The adapters that the page offers.

use std::time::Duration;

use serde::Serialize;

use coboot_can::{Found, Kind};

/// An adapter.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Listed {
    /// The URL for the field of the page; if the adapter sets the bit rate, the user adjusts it.
    url: String,
    words: String,
}

/// The adapters of these kinds, except servers on the network: their beacons take up to 3 s, and
/// the page does not wait for them.
pub(super) fn list(kinds: &[Kind]) -> Vec<Listed> {
    let kinds: Vec<Kind> = kinds.iter().copied().filter(|kind| *kind != Kind::Socketcand).collect();
    coboot_can::list(&kinds, Duration::ZERO).found.into_iter().map(listed).collect()
}

fn listed(found: Found) -> Listed {
    let url = match found.kind {
        Kind::SocketCan | Kind::Socketcand => found.url,
        Kind::Serial | Kind::Peak | Kind::Kvaser | Kind::GsUsb => format!("{}@500k", found.url),
    };
    let words = match found.state {
        Some(state) => format!("{}, {state}", found.about),
        None => found.about,
    };
    Listed { url, words }
}
