//! Opens the adapter of a URL.

#[cfg(doc)]
use super::adapter::URLS;
use super::adapter::{Adapter, AdapterError};
use super::drivers::driver;
use super::slcan::Slcan;
#[cfg(target_os = "linux")]
use super::socketcan::SocketCan;
use super::socketcand::Socketcand;
use super::target::Target;

/// Opens the adapter of a URL (see [`URLS`]).
///
/// # Errors
/// The URL is invalid, or the adapter does not open.
pub fn open(url: &str) -> Result<Box<dyn Adapter + Send>, AdapterError> {
    open_at(url, None)
}

/// Checks the URL of an adapter or a gateway without opening anything.
///
/// # Errors
/// [`AdapterError::Url`].
pub fn check(url: &str) -> Result<(), AdapterError> {
    target(url).map(|_| ())
}

pub(super) fn target(url: &str) -> Result<Target, AdapterError> {
    Target::parse(url).map_err(|why| AdapterError::Url { url: url.to_string(), why })
}

/// Opens the adapter of a URL. `bit_rate` (in bit/s) applies if the URL contains none and the
/// adapter sets the bit rate. To add another adapter, add it here; one with a driver in `drivers`.
///
/// # Errors
/// The URL is invalid, or the adapter does not open.
pub fn open_at(url: &str, bit_rate: Option<u32>) -> Result<Box<dyn Adapter + Send>, AdapterError> {
    let bad = |why: &str| AdapterError::Url { url: url.to_string(), why: why.to_string() };
    Ok(match target(url)? {
        Target::Socketcand { server, bus } => Box::new(Socketcand::connect(&server, &bus)?),
        Target::SlcanTcp { server, rate } => Box::new(Slcan::connect(&server, rate.or(bit_rate))?),
        Target::SlcanPort { port, rate, baud } => Box::new(Slcan::serial(&port, baud, rate.or(bit_rate))?),
        #[cfg(target_os = "linux")]
        Target::SocketCan { interface } => Box::new(SocketCan::open(&interface)?),
        Target::Driver { kind, which, rate } => {
            let needed = || bad(&format!("it needs the bit rate of the bus: {url}@125k, or 250k, 500k, 1M"));
            let driver = driver(kind).map_err(|why| bad(&why))?;
            (driver.open)(&which, rate.or(bit_rate).ok_or_else(needed)?)?
        }
        Target::Gateway { .. } => {
            return Err(bad("a gateway carries only SDO, and this command needs the CAN bus itself"))
        }
    })
}

/// The bit rate in a URL, in bit/s.
#[must_use]
pub fn bit_rate_of(url: &str) -> Option<u32> {
    Target::parse(url).ok()?.rate()
}
