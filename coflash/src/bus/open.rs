//! The adapter that a URL names.

#[cfg(doc)]
use super::adapter::URLS;
use super::adapter::{Adapter, AdapterError};
use super::slcan::Slcan;
#[cfg(target_os = "linux")]
use super::socketcan::SocketCan;
use super::socketcand::Socketcand;

/// Opens the adapter that a URL names (see [`URLS`]).
///
/// # Errors
/// The URL is no good, or the adapter does not open.
pub fn open(url: &str) -> Result<Box<dyn Adapter + Send>, AdapterError> {
    open_at(url, None)
}

/// Opens the adapter that a URL names, at this bit rate (in bit/s) if the URL names none and the
/// adapter sets it. This is the place to add other adapters.
///
/// # Errors
/// The URL is no good, or the adapter does not open.
pub fn open_at(url: &str, bit_rate: Option<u32>) -> Result<Box<dyn Adapter + Send>, AdapterError> {
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
        "socketcan" if !rest.is_empty() => Ok(Box::new(SocketCan::open(rest)?)),
        #[cfg(target_os = "linux")]
        "socketcan" => Err(bad("it names no interface: socketcan:can0")),
        #[cfg(not(target_os = "linux"))]
        "socketcan" => Err(bad("only Linux has SocketCAN")),
        "cia309" => Err(bad("a gateway carries SDO alone, and this needs the CAN bus itself")),
        _ => Err(bad("there is no such adapter")),
    }
}

/// `500k`, `1M`, `125000`, in bit/s.
pub(crate) fn parse_bit_rate(text: &str) -> Option<u32> {
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
