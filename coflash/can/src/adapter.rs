//! The trait for a CAN bus, and the errors that an adapter can report.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use canopen::frame::Channel;
use canopen::{AbortCode, Address, Frame};

use super::health::{Health, Losses};

/// A CAN bus and its clock.
///
/// The clock belongs to the adapter, so that an emulated bus can supply its own time. The rest of
/// this library uses no other clock and never sleeps: it waits by receiving.
pub trait Adapter {
    /// Hands a frame to the bus.
    ///
    /// # Errors
    /// The adapter is gone, or it accepts no frames.
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError>;

    /// Returns the next frame from the bus. Waits for it for at most `timeout`. `None` means that
    /// this time has passed on the clock of [`now`](Self::now). With a `timeout` of zero, it
    /// returns only a frame that has already arrived.
    ///
    /// An adapter need not and should not return the frames that it sent itself.
    ///
    /// # Errors
    /// The adapter is gone.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError>;

    /// The time since an origin of the adapter's choice.
    fn now(&self) -> Duration;

    /// What the adapter knows about its bus apart from the frames; `None` if it reports nothing.
    /// The call may query the system, so use it only after something has gone wrong.
    fn health(&mut self) -> Option<Health> {
        None
    }

    /// What did not go through the adapter so far, as far as it knows. Unlike [`health`](Self::health),
    /// this asks nobody.
    fn losses(&self) -> Losses {
        Losses::default()
    }

    /// The group downloads in which this conversation can take part.
    fn group(&mut self) -> Option<&mut dyn Group> {
        None
    }
}

/// A conversation's place in a group: the devices that take the same data in one download, each by
/// its second SDO server (1201h).
pub trait Group {
    /// The COB-IDs for the device's second SDO server; `None` after [`leave`](Self::leave).
    fn channel(&self) -> Option<Channel>;

    /// Waits until all conversations of the group have come here. Those with the lowest turn and
    /// the same data go first, in one download; the others wait for their turn.
    ///
    /// # Errors
    /// The adapter is gone.
    fn deliver(&mut self, turn: u32, at: Address, data: &[u8]) -> Result<Delivery, AdapterError>;

    /// Leaves the group: it does not wait for this conversation any more.
    fn leave(&mut self);
}

/// What became of the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The device has taken the data, as one of so many devices.
    Taken(usize),
    /// The device has refused the data.
    Refused(AbortCode),
    /// The device did not confirm the data.
    NoAnswer,
    /// Nobody else has the same data, or this device has disturbed the group: write them alone.
    Alone,
    /// Somebody else uses a COB-ID of the group: there is no group any more.
    Disturbed,
}

/// What an adapter has of the one that it is in front of.
macro_rules! passes_on {
    ($this:ident => $inner:expr) => {
        fn now(&self) -> Duration {
            let $this = self;
            $inner.now()
        }

        fn health(&mut self) -> Option<Health> {
            let $this = self;
            $inner.health()
        }

        fn losses(&self) -> Losses {
            let $this = self;
            $inner.losses()
        }
    };
}

pub(super) use passes_on;

/// An adapter by a pointer to it.
macro_rules! by_pointer {
    ($($pointer:ty),*) => {$(
        impl<A: Adapter + ?Sized> Adapter for $pointer {
            fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
                (**self).send(frame)
            }

            fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
                (**self).receive(timeout)
            }

            passes_on!(this => (**this));

            fn group(&mut self) -> Option<&mut dyn Group> {
                (**self).group()
            }
        }
    )*};
}

by_pointer!(&mut A, Box<A>);

/// The URLs that [`open`](super::open()) accepts, for messages and help texts.
pub const URLS: &str =
    "socketcan:INTERFACE (Linux), slcan:PORT@BITRATE?baud=SPEED, slcan:tcp://HOST:PORT@BITRATE, \
                        peak:CHANNEL@BITRATE, kvaser:NUMBER@BITRATE, gs_usb:NUMBER@BITRATE, \
                        socketcand://HOST:PORT/BUS, cia309://HOST:PORT/NET (gateway, SDO alone)";

/// The message for a URL without a scheme.
pub(super) const NO_SCHEME: &str = "it has no ':' after the adapter's name";
/// The message for a URL with an unknown scheme.
pub(super) const NO_ADAPTER: &str = "there is no such adapter";

/// The advice for a vendor's adapter that is not there.
#[cfg(any(feature = "peak", feature = "kvaser"))]
pub(super) const ABSENT: &str = "plug it in, and check its number";

/// The errors of an adapter.
#[derive(Clone, Debug, thiserror::Error)]
pub enum AdapterError {
    /// The URL names no adapter.
    #[error("bus '{url}': {why}")]
    Url {
        /// The URL.
        url: String,
        /// What is wrong with it.
        why: String,
    },
    /// The adapter is missing, or it denies access.
    #[error("{adapter} cannot be opened: {source}")]
    Open {
        /// The adapter's name.
        adapter: String,
        /// The system's error.
        source: Arc<io::Error>,
    },
    /// The adapter is missing, denies access or lacks its driver, and the reason is known.
    #[error("{adapter} cannot be opened: {what}")]
    Unusable {
        /// The adapter's name.
        adapter: String,
        /// What is wrong.
        what: String,
        /// What to do.
        advice: String,
        /// The kind of reason.
        obstacle: Obstacle,
    },
    /// The adapter accepts no more frames, because its queued frames do not reach the bus.
    #[error("{adapter} accepts no more frames: its queued frames do not reach the bus")]
    Stuck {
        /// The adapter's name.
        adapter: String,
        /// What the adapter knows about its bus.
        health: Health,
    },
    /// The adapter broke its protocol.
    #[error("{adapter} answered unexpectedly: {said}")]
    Protocol {
        /// The adapter's name.
        adapter: String,
        /// What it sent instead of the expected answer.
        said: String,
    },
    /// The adapter was connected and is gone, or it accepts no more frames.
    #[error("{adapter} is gone: {source}")]
    Lost {
        /// The adapter's name.
        adapter: String,
        /// The error that showed it.
        source: Arc<io::Error>,
    },
    /// A gateway does not answer, or it refuses a request for a reason of its own.
    #[error("{adapter}: {what}")]
    Gateway {
        /// The gateway's name.
        adapter: String,
        /// What is wrong, as a clause with the gateway as its subject.
        what: String,
    },
}

impl AdapterError {
    /// The stable error number. The manual defines none for CAN drivers; these numbers follow its
    /// scheme.
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

    /// Whether the URL names no adapter of this computer: a list of those that are there helps.
    #[must_use]
    pub const fn is_absent(&self) -> bool {
        matches!(self, Self::Url { .. } | Self::Unusable { obstacle: Obstacle::Absent, .. })
    }

    /// What to do next, wherever the user has entered the URL.
    #[must_use]
    pub fn advice(&self) -> String {
        match self {
            Self::Url { why, .. } if why.contains("did you mean") => "give this bus",
            Self::Url { why, .. } if !why.starts_with(NO_SCHEME) && !why.starts_with(NO_ADAPTER) => {
                "correct the URL of the bus"
            }
            Self::Url { .. } => {
                return format!(
                    "give the bus by its URL, for example socketcan:can0 or slcan:/dev/ttyACM0@500k; known are {URLS}"
                )
            }
            Self::Open { source, .. } => match source.kind() {
                io::ErrorKind::ConnectionRefused => {
                    "nothing listens on this port: start the server (socketcand, coboot-node, an emulated board), and \
                     check the port's number"
                }
                io::ErrorKind::TimedOut | io::ErrorKind::HostUnreachable | io::ErrorKind::NetworkUnreachable => {
                    "the host does not answer: check the address, the network cable and firewalls"
                }
                io::ErrorKind::PermissionDenied => "check that you have permission to use it or to write there",
                io::ErrorKind::NotFound => "check the name: nothing with this name exists",
                _ => "check that the adapter is connected and switched on, and that its name is right",
            },
            Self::Unusable { advice, .. } => return advice.clone(),
            Self::Stuck { health, .. } => {
                return health.advice().unwrap_or_else(|| {
                    "no other node acknowledges on the bus: check that the device has power, that cable and terminators are \
                     right, and that both sides use the same bit rate"
                        .to_string()
                })
            }
            Self::Protocol { .. } => {
                "check that the address is the adapter's, and that the adapter has this bus"
            }
            Self::Gateway { .. } => {
                "check the network's number behind the gateway's address, and that the gateway is on the bus; then try \
                 again"
            }
            Self::Lost { .. } => {
                "check the cable, the adapter and the program that serves it; then flash the device again"
            }
        }
        .to_string()
    }

    /// A vendor's library that cannot be used. `from` says where to get the library.
    #[cfg(any(feature = "peak", feature = "kvaser"))]
    pub(crate) fn library(adapter: &str, error: &vendor_can::LoadError, from: &str) -> Self {
        let advice = match error {
            vendor_can::LoadError::Missing { .. } => from.to_string(),
            vendor_can::LoadError::Old { .. } => format!("it is too old, or another library: {from}"),
        };
        Self::unusable(adapter, Obstacle::Other, error.to_string(), advice)
    }

    /// An adapter that cannot be opened.
    pub(crate) fn unusable(
        adapter: impl Into<String>,
        obstacle: Obstacle,
        what: impl Into<String>,
        advice: impl Into<String>,
    ) -> Self {
        let (adapter, what, advice) = (adapter.into(), what.into(), advice.into());
        Self::Unusable { adapter, what, advice, obstacle }
    }
}

/// Why an adapter cannot be used, as far as what comes next depends on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Obstacle {
    /// The URL names what is not there: a list of the adapters helps.
    Absent,
    /// Another program uses the adapter.
    InUse,
    /// Anything else.
    Other,
}
