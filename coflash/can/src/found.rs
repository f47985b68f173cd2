//! An adapter that was found on this computer or network.

use std::fmt;

use super::health::Controller;

/// The ways to find adapters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Serial ports, which may have an SLCAN adapter.
    Serial,
    /// CAN interfaces of the Linux kernel.
    SocketCan,
    /// PEAK channels, by PCANBasic.
    Peak,
    /// Kvaser channels, by CANlib.
    Kvaser,
    /// gs_usb devices on USB.
    GsUsb,
    /// socketcand servers that send beacons on the network.
    Socketcand,
}

impl Kind {
    /// All kinds. [`Socketcand`](Self::Socketcand), which takes time, is the last one.
    pub const ALL: [Self; 6] =
        [Self::Serial, Self::SocketCan, Self::Peak, Self::Kvaser, Self::GsUsb, Self::Socketcand];

    /// The name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Serial => "serial",
            Self::SocketCan => "socketcan",
            Self::Peak => "peak",
            Self::Kvaser => "kvaser",
            Self::GsUsb => "gs_usb",
            Self::Socketcand => "socketcand",
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The unusual state of an adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// The state of its controller.
    Controller(Controller),
    /// Another program uses it.
    InUse,
    /// PCAN-View uses it, too.
    Shared,
    /// The kernel uses it, as a CAN interface.
    Kernel,
}

impl State {
    /// It in messages.
    #[must_use]
    pub const fn words(self) -> &'static str {
        match self {
            Self::Controller(controller) => controller.words(),
            Self::InUse => "used by another program",
            Self::Shared => "shared with PCAN-View",
            Self::Kernel => "the kernel uses it: see socketcan",
        }
    }
}

/// An adapter that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Found {
    /// How it was found.
    pub kind: Kind,
    /// The URL for `--bus`, without a bit rate.
    pub url: String,
    /// The adapter's own name or description.
    pub about: String,
    /// Its state, if it is unusual.
    pub state: Option<State>,
    /// The bit rate in bit/s that is already set, if it is known.
    pub bit_rate: Option<u32>,
    /// Whether the adapter certainly leads to a CAN bus, so that it can be used without the user
    /// naming it. A serial port may lead to any device.
    pub certain: bool,
}

impl Found {
    pub(super) fn new(kind: Kind, url: String, about: String) -> Self {
        // The vendors' drivers also list virtual channels, which lead to no bus.
        let certain = !about.to_ascii_lowercase().contains("virtual");
        Self { kind, url, about, state: None, bit_rate: None, certain }
    }
}

/// The reason why a search for one kind of adapter was not possible.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Missing {
    /// What is wrong.
    pub what: String,
    /// What to do.
    pub advice: &'static str,
}

/// The names of what is there, for advice: `kind` in the plural, and the words for none.
pub(super) fn those_there(kind: &str, none: &str, names: impl Iterator<Item = String>) -> String {
    match names.map(|name| shown(name.as_bytes())).take(16).collect::<Vec<_>>().join(", ") {
        names if names.is_empty() => none.to_string(),
        names => format!("this computer has these {kind}: {names}"),
    }
}

/// External text made safe to show: no control characters, and a limited length.
pub(super) fn shown(text: &[u8]) -> String {
    let text = String::from_utf8_lossy(text);
    let printable = text.chars().map(|c| if c.is_control() { '\u{FFFD}' } else { c });
    printable.take(80).collect::<String>().trim().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_others_call_themselves_cannot_write_to_the_terminal() {
        assert_eq!(shown(b"PCAN-USB\x1B[2J\xFF"), "PCAN-USB\u{FFFD}[2J\u{FFFD}");
        assert_eq!(shown(&[b'x'; 1000]).len(), 80);
    }
}
