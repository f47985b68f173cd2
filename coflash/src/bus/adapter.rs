//! A CAN bus behind one trait, and what it can be out of.

use std::fmt;
use std::io;
use std::time::Duration;

use canopen::Frame;

use super::health::Health;

/// A CAN bus, and the time on it.
///
/// The time belongs to the adapter, so that an emulated bus can serve its own. The rest of this
/// library knows no other clock and never sleeps: it waits by receiving.
pub trait Adapter {
    /// Hands a frame to the bus.
    ///
    /// # Errors
    /// The adapter is gone, or takes no frames.
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError>;

    /// The next frame from the bus. Waits for it, `timeout` at most; `None` means that this time
    /// has passed on [`now`](Self::now)'s clock. A `timeout` of zero takes what is there already.
    ///
    /// Frames which this adapter sent need not and should not come back.
    ///
    /// # Errors
    /// The adapter is gone.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError>;

    /// The time since an origin of the adapter's choice.
    fn now(&self) -> Duration;

    /// What it knows of its bus beyond the frames; `None` where it tells nothing. It may ask the
    /// system for it, so it is for when something has gone wrong.
    fn health(&mut self) -> Option<Health> {
        None
    }
}

impl<A: Adapter + ?Sized> Adapter for &mut A {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        (**self).send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        (**self).receive(timeout)
    }

    fn now(&self) -> Duration {
        (**self).now()
    }

    fn health(&mut self) -> Option<Health> {
        (**self).health()
    }
}

impl<A: Adapter + ?Sized> Adapter for Box<A> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        (**self).send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        (**self).receive(timeout)
    }

    fn now(&self) -> Duration {
        (**self).now()
    }

    fn health(&mut self) -> Option<Health> {
        (**self).health()
    }
}

/// What [`open`](super::open()) understands, for messages and help texts.
pub const URLS: &str = "socketcan:INTERFACE (Linux), slcan:PORT@BITRATE, slcan:tcp://HOST:PORT@BITRATE, \
                        peak:CHANNEL@BITRATE, kvaser:NUMBER@BITRATE, gs_usb:NUMBER@BITRATE, \
                        socketcand://HOST:PORT/BUS, cia309://HOST:PORT/NET (gateway, SDO alone)";

/// What is wrong with a URL that names no adapter at all.
pub(super) const NO_SCHEME: &str = "it has no ':' behind the adapter's name";
/// The same with one that nobody knows.
pub(super) const NO_ADAPTER: &str = "there is no such adapter";

/// What an adapter can be out of.
#[derive(Debug)]
pub enum AdapterError {
    /// The URL names no adapter.
    Url {
        /// The URL.
        url: String,
        /// What is wrong with it.
        why: String,
    },
    /// The adapter is not there, or does not let us in.
    Open {
        /// Which one.
        adapter: String,
        /// What it said.
        source: io::Error,
    },
    /// The adapter is not there, does not let us in or lacks its driver, for a reason that is known.
    Unusable {
        /// Which one.
        adapter: String,
        /// What is the matter.
        what: String,
        /// What to do.
        advice: String,
        /// Whether the reason is that another program has it.
        in_use: bool,
    },
    /// The adapter takes no frames any more: those that it has do not leave it.
    Stuck {
        /// Which one.
        adapter: String,
        /// What it knows of its bus.
        health: Health,
    },
    /// The adapter did not speak as it must.
    Protocol {
        /// Which one.
        adapter: String,
        /// What it said instead.
        said: String,
    },
    /// The adapter was there and is gone, or takes no frames any more.
    Lost {
        /// Which one.
        adapter: String,
        /// How that showed.
        source: io::Error,
    },
    /// A gateway does not answer, or does not do what it is asked, for a reason of its own.
    Gateway {
        /// Which one.
        adapter: String,
        /// What is the matter, as a sentence about it.
        what: String,
    },
}

impl AdapterError {
    /// The stable number. The manual has none for its CAN drivers; these follow its scheme.
    #[must_use]
    pub const fn number(&self) -> u32 {
        match self {
            Self::Url { .. } => 0x6000_0300,
            Self::Open { .. } | Self::Unusable { .. } => 0x6000_0301,
            Self::Protocol { .. } => 0x6000_0302,
            Self::Lost { .. } => 0x6000_0303,
            Self::Gateway { .. } => 0x6000_0304,
            Self::Stuck { .. } => 0x6000_0305,
        }
    }

    /// What to do next.
    #[must_use]
    pub fn advice(&self) -> String {
        match self {
            Self::Url { why, .. } if why.contains("did you mean") => {
                "give the bus like that, by --bus or in COFLASH_BUS"
            }
            Self::Url { why, .. }
                if !why.starts_with(NO_SCHEME)
                    && !why.starts_with(NO_ADAPTER) =>
            {
                "mend the bus in --bus or COFLASH_BUS; coflash adapters lists those that are there"
            }
            Self::Url { .. } => {
                return format!(
                    "give the bus as --bus URL or in COFLASH_BUS, for example socketcan:can0 or slcan:/dev/ttyACM0@500k \
                     (coflash adapters lists those that are there); known are {URLS}"
                )
            }
            Self::Open { source, .. } => match source.kind() {
                io::ErrorKind::ConnectionRefused => {
                    "nothing listens on this port: start the server (socketcand, coboot-node, an emulated board), and \
                     check the port's number"
                }
                io::ErrorKind::TimedOut | io::ErrorKind::HostUnreachable | io::ErrorKind::NetworkUnreachable => {
                    "check the address, the network cable and firewalls: the host does not answer"
                }
                io::ErrorKind::PermissionDenied => "check who may use it, or write there",
                io::ErrorKind::NotFound => "check the name: there is nothing of this name",
                _ => "check that the adapter is there, that its name is right and that it is switched on",
            },
            Self::Unusable { advice, .. } => return advice.clone(),
            Self::Stuck { health, .. } => {
                return health.advice().unwrap_or_else(|| {
                    "nobody acknowledges on the bus: check that the device has power, that cable and terminators are \
                     right, and that both sides use the same bit rate"
                        .to_string()
                })
            }
            Self::Protocol { .. } => {
                "check that the address is that of the adapter, and that it knows this bus"
            }
            Self::Gateway { .. } => {
                "check the network's number behind the gateway's address, and that the gateway is on the bus; then run \
                 the command again"
            }
            Self::Lost { .. } => {
                "check cable, adapter and the program behind it; the device can be flashed again at once"
            }
        }
        .to_string()
    }

    /// A vendor's library that cannot be used, and where it is to be had.
    #[cfg(any(feature = "peak", feature = "kvaser"))]
    pub(crate) fn library(adapter: &str, error: &vendor_can::LoadError, from: &str) -> Self {
        let advice = match error {
            vendor_can::LoadError::Missing { .. } => from.to_string(),
            vendor_can::LoadError::Old { .. } => format!("it is too old, or another library: {from}"),
        };
        Self::unusable(adapter, error.to_string(), advice)
    }

    /// An adapter that cannot be opened.
    pub(crate) fn unusable(
        adapter: impl Into<String>,
        what: impl Into<String>,
        advice: impl Into<String>,
    ) -> Self {
        Self::Unusable { adapter: adapter.into(), what: what.into(), advice: advice.into(), in_use: false }
    }
}

impl fmt::Display for AdapterError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Url { url, why } => write!(f, "bus '{url}': {why}"),
            Self::Open { adapter, source } => write!(f, "{adapter} cannot be opened: {source}"),
            Self::Unusable { adapter, what, .. } => write!(f, "{adapter} cannot be opened: {what}"),
            Self::Stuck { adapter, .. } => {
                write!(f, "{adapter} takes no frames any more: what it has does not get onto the bus")
            }
            Self::Protocol { adapter, said } => write!(f, "{adapter} answered unexpectedly: {said}"),
            Self::Lost { adapter, source } => write!(f, "{adapter} is gone: {source}"),
            Self::Gateway { adapter, what } => write!(f, "{adapter}: {what}"),
        }
    }
}

impl std::error::Error for AdapterError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Open { source, .. } | Self::Lost { source, .. } => Some(source),
            Self::Url { .. }
            | Self::Unusable { .. }
            | Self::Stuck { .. }
            | Self::Protocol { .. }
            | Self::Gateway { .. } => None,
        }
    }
}
