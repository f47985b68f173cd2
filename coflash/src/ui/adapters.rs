//! The adapters that a page can offer: what this machine has.

use std::time::Duration;

use serde::Serialize;

use crate::bus::{self, Found, Kind};

/// One of them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Listed {
    /// What goes into the field; where the adapter sets the bit rate, the user corrects it.
    url: String,
    words: String,
}

/// Those of these kinds, but for servers on the network: they are heard after 3 s only, and the page
/// does not wait for them.
pub(super) fn list(kinds: &[Kind]) -> Vec<Listed> {
    let kinds: Vec<Kind> = kinds.iter().copied().filter(|kind| *kind != Kind::Socketcand).collect();
    bus::list(&kinds, Duration::ZERO).found.into_iter().map(listed).collect()
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
