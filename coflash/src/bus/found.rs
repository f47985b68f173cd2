//! An adapter that is there.

use std::fmt;

/// The ways in which adapters are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Serial ports, behind which an SLCAN adapter may be.
    Serial,
    /// CAN interfaces of the Linux kernel.
    SocketCan,
    /// PEAK channels, by PCANBasic.
    Peak,
    /// Kvaser channels, by CANlib.
    Kvaser,
    /// gs_usb devices on USB.
    GsUsb,
    /// socketcand servers that announce themselves on the network.
    Socketcand,
}

impl Kind {
    /// All of them. [`Socketcand`](Self::Socketcand), the one that takes time, is the last.
    pub const ALL: [Self; 6] =
        [Self::Serial, Self::SocketCan, Self::Peak, Self::Kvaser, Self::GsUsb, Self::Socketcand];

    /// Its name on the command line.
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

/// An adapter that is there.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Found {
    /// How it was found.
    pub kind: Kind,
    /// What `--bus` takes, without a bit rate.
    pub url: String,
    /// What it calls itself.
    pub about: String,
    /// Its state, where that is worth a word.
    pub state: Option<String>,
    /// The bit rate that it has in bit/s, where that is known.
    pub bit_rate: Option<u32>,
    /// Whether it surely leads to a CAN bus, so that it may be taken unasked. A serial port may have
    /// anything behind it.
    pub certain: bool,
}

impl Found {
    pub(super) fn new(kind: Kind, url: String, about: String) -> Self {
        // The vendor's drivers come with channels that lead nowhere.
        let certain = !about.to_ascii_lowercase().contains("virtual");
        Self { kind, url, about, state: None, bit_rate: None, certain }
    }
}

/// Why adapters of a kind could not be looked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Missing {
    /// What is the matter.
    pub what: String,
    /// What to do.
    pub advice: &'static str,
}

/// Text of somebody else's, for people: no control characters, and not too long.
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
