//! Ways to a CAN bus, behind one trait and chosen by URL.

use std::fmt;
use std::io;
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use canopen::Frame;

mod sdo_ids;
pub mod slcan;
#[cfg(target_os = "linux")]
mod socketcan;
pub mod socketcand;
mod trace;

pub use self::sdo_ids::SdoIds;
pub use self::slcan::{Line, Slcan};
pub use self::socketcand::Socketcand;
pub use self::trace::{OnFailure, Trace};

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

/// What [`open`] understands, for messages and help texts.
pub const URLS: &str = "socketcand://HOST:PORT/BUS, slcan:PORT@BITRATE, slcan:tcp://HOST:PORT@BITRATE, \
                        socketcan:INTERFACE (Linux), cia309://HOST:PORT/NET (gateway, SDO alone)";

/// How long a server may take to let us in, and to take what we send.
const PATIENCE: Duration = Duration::from_secs(3);

/// Opens the adapter that a URL names (see [`URLS`]).
///
/// # Errors
/// The URL is no good, or the adapter does not open.
pub fn open(url: &str) -> Result<Box<dyn Adapter>, AdapterError> {
    open_at(url, None)
}

/// Opens the adapter that a URL names, at this bit rate (in bit/s) if the URL names none and the
/// adapter sets it. This is the place to add other adapters.
///
/// # Errors
/// The URL is no good, or the adapter does not open.
pub fn open_at(url: &str, bit_rate: Option<u32>) -> Result<Box<dyn Adapter>, AdapterError> {
    let bad = |why| AdapterError::Url { url: url.to_string(), why };
    let (scheme, rest) = url.split_once(':').ok_or_else(|| bad("it has no ':' behind the adapter's name"))?;
    let word = |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_graphic());
    match scheme {
        "socketcand" => {
            let rest = rest.strip_prefix("//").ok_or_else(|| bad("it must be socketcand://HOST:PORT/BUS"))?;
            let (server, bus) = rest.split_once('/').ok_or_else(|| bad("it names no bus: append /can0"))?;
            if !word(server) || !word(bus) || bus.contains(['<', '>', '/']) {
                return Err(bad("it must be socketcand://HOST:PORT/BUS"));
            }
            Ok(Box::new(Socketcand::connect(server, bus)?))
        }
        "slcan" => {
            let (line, rate) = match rest.rsplit_once('@') {
                None => (rest, bit_rate),
                Some((line, rate)) => {
                    let why = "its bit rate must be like 125k, 500k or 1M";
                    (line, Some(parse_bit_rate(rate).ok_or_else(|| bad(why))?))
                }
            };
            match line.strip_prefix("tcp://") {
                Some(server) if word(server) && server.contains(':') => {
                    Ok(Box::new(Slcan::connect(server, rate)?))
                }
                Some(_) => Err(bad("it must be slcan:tcp://HOST:PORT@BITRATE")),
                None if line.is_empty() => Err(bad("it names no serial port: slcan:/dev/ttyACM0@500k")),
                None => Ok(Box::new(Slcan::serial(line, rate)?)),
            }
        }
        #[cfg(target_os = "linux")]
        "socketcan" if !rest.is_empty() => Ok(Box::new(socketcan::SocketCan::open(rest)?)),
        #[cfg(target_os = "linux")]
        "socketcan" => Err(bad("it names no interface: socketcan:can0")),
        #[cfg(not(target_os = "linux"))]
        "socketcan" => Err(bad("only Linux has SocketCAN")),
        "cia309" => Err(bad("a gateway carries SDO alone, and this needs the CAN bus itself")),
        _ => Err(bad("there is no such adapter")),
    }
}

/// A number in hexadecimal digits and nothing else: no sign, no blank.
pub(crate) fn hex_number(text: &str) -> Option<u32> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    digits.then(|| u32::from_str_radix(text, 16).ok()).flatten()
}

/// Bytes in pairs of hexadecimal digits and nothing else.
pub(crate) fn hex_bytes(text: &str) -> Option<Vec<u8>> {
    if !text.is_ascii() || !text.len().is_multiple_of(2) {
        return None;
    }
    (0..text.len()).step_by(2).map(|at| hex_number(&text[at..at + 2]).map(|byte| byte as u8)).collect()
}

/// `500k`, `1M`, `125000`, in bit/s.
fn parse_bit_rate(text: &str) -> Option<u32> {
    let (digits, unit) = match text.strip_suffix(['k', 'K']) {
        Some(digits) => (digits, 1000),
        None => match text.strip_suffix('M') {
            Some(digits) => (digits, 1_000_000),
            None => (text, 1),
        },
    };
    let digits = Some(digits).filter(|digits| digits.bytes().all(|byte| byte.is_ascii_digit()))?;
    digits.parse::<u32>().ok()?.checked_mul(unit).filter(|rate| (1..=1_000_000).contains(rate))
}

/// Connects to the first of the server's addresses that answers.
pub(crate) fn connect(server: &str, default_port: Option<u16>) -> io::Result<TcpStream> {
    let has_port = server.rsplit_once(':').is_some_and(|(host, port)| {
        !port.is_empty()
            && port.bytes().all(|b| b.is_ascii_digit())
            && (!host.contains(':') || host.ends_with(']'))
    });
    let server = match default_port {
        Some(port) if !has_port => format!("{server}:{port}"),
        _ => server.to_string(),
    };
    let mut result = Err(io::Error::new(io::ErrorKind::NotFound, "the host has no address"));
    for address in server.to_socket_addrs()? {
        result = TcpStream::connect_timeout(&address, PATIENCE);
        if result.is_ok() {
            break;
        }
    }
    result
}

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
