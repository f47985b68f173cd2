//! The adapters that the page offers.

use std::time::Duration;

use serde::Serialize;

use coboot_can::health::Controller;
use coboot_can::{Found, Kind, State};

/// An adapter.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Listed {
    /// The URL for the field of the page; if the adapter sets the bit rate, the user adjusts it.
    url: String,
    /// It in English.
    words: String,
    /// The key of its kind, which says it with its name on this computer: that of a port, an interface or a channel.
    kind: &'static str,
    name: String,
    /// What it calls itself; nothing where that would only be its kind.
    product: Option<String>,
    /// The key of its state, if it is unusual; English for one without a key.
    state: Option<&'static str>,
}

/// The adapters of these kinds, except servers on the network: their beacons take up to 3 s, and
/// the page does not wait for them.
pub(super) fn list(kinds: &[Kind]) -> Vec<Listed> {
    let kinds: Vec<Kind> = kinds.iter().copied().filter(|kind| *kind != Kind::Socketcand).collect();
    coboot_can::list(&kinds, Duration::ZERO).found.into_iter().map(listed).collect()
}

fn listed(Found { kind, url, about, state, .. }: Found) -> Listed {
    let name = url.split_once(':').map_or("", |(_, name)| name).to_owned();
    let of_state = state.map_or(String::new(), |state| format!(", {}", state.words()));
    let (key, sets_rate) = match kind {
        Kind::SocketCan | Kind::Socketcand => ("port-socketcan", false),
        Kind::Serial => ("port-serial", true),
        Kind::Peak => ("port-peak", true),
        Kind::Kvaser => ("port-kvaser", true),
        Kind::GsUsb => ("port-gs-usb", true),
    };
    Listed {
        words: format!("{name}: {about}{of_state}"),
        url: if sets_rate { format!("{url}@500k") } else { url },
        kind: key,
        name,
        product: Some(about).filter(|about| kind != Kind::SocketCan && about != "serial port"),
        state: state.map(|state| match state {
            State::Controller(Controller::Stopped) => "port-off",
            State::InUse => "port-used",
            State::Shared => "port-shared",
            State::Kernel => "port-kernel",
            State::Controller(_) => state.words(),
        }),
    }
}
