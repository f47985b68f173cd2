//! A CAN bus behind one trait, and what it can be out of.

use std::fmt;
use std::io;
use std::time::Duration;

use canopen::Frame;

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
}

/// What [`open`](super::open()) understands, for messages and help texts.
pub const URLS: &str = "socketcand://HOST:PORT/BUS, slcan:PORT@BITRATE, slcan:tcp://HOST:PORT@BITRATE, \
                        socketcan:INTERFACE (Linux), cia309://HOST:PORT/NET (gateway, SDO alone)";

/// What an adapter can be out of.
#[derive(Debug)]
pub enum AdapterError {
    /// The URL names no adapter.
    Url {
        /// The URL.
        url: String,
        /// What is wrong with it.
        why: &'static str,
    },
    /// The adapter is not there, or does not let us in.
    Open {
        /// Which one.
        adapter: String,
        /// What it said.
        source: io::Error,
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
            Self::Open { .. } => 0x6000_0301,
            Self::Protocol { .. } => 0x6000_0302,
            Self::Lost { .. } => 0x6000_0303,
            Self::Gateway { .. } => 0x6000_0304,
        }
    }

    /// What to do next.
    #[must_use]
    pub const fn advice(&self) -> &'static str {
        match self {
            Self::Url { .. } => {
                "give the bus as --bus URL or in COFLASH_BUS, for example socketcand://127.0.0.1:29536/can0"
            }
            Self::Open { .. } => {
                "check that the adapter is there, that its name is right and that it is switched on"
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
    }
}

impl fmt::Display for AdapterError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Url { url, why } => write!(f, "bus '{url}': {why} (known are {URLS})"),
            Self::Open { adapter, source } => write!(f, "{adapter} cannot be opened: {source}"),
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
            Self::Url { .. } | Self::Protocol { .. } | Self::Gateway { .. } => None,
        }
    }
}
