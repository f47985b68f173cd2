//! The URL of an adapter, checked before anything is opened.

use super::adapter::{NO_ADAPTER, NO_SCHEME};
use super::digits::decimal;
use super::drivers::driver;
use super::found::Kind;
use super::slcan::BAUD;

/// The target of a URL.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Target {
    /// A bus of a socketcand server.
    Socketcand { server: String, bus: String },
    /// An SLCAN adapter on a serial port with this speed in bit/s.
    SlcanPort { port: String, rate: Option<u32>, baud: u32 },
    /// An SLCAN adapter over TCP.
    SlcanTcp { server: String, rate: Option<u32> },
    /// An interface of the Linux kernel.
    #[cfg(target_os = "linux")]
    SocketCan { interface: String },
    /// An adapter with a driver of its own: which one of this kind.
    Driver { kind: Kind, which: String, rate: Option<u32> },
    /// A network of a gateway, which is not an adapter.
    Gateway { server: String, network: u16 },
}

impl Target {
    /// The bit rate in the URL, in bit/s.
    pub(super) fn rate(&self) -> Option<u32> {
        match self {
            Self::SlcanPort { rate, .. } | Self::SlcanTcp { rate, .. } | Self::Driver { rate, .. } => *rate,
            _ => None,
        }
    }

    /// Parses a URL.
    ///
    /// # Errors
    /// What is wrong with the URL, as a sentence about it.
    pub(super) fn parse(url: &str) -> Result<Self, String> {
        let Some((scheme, rest)) = url.split_once(':') else { return Err(no_scheme(url)) };
        let word = |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_graphic());
        match scheme {
            "socketcand" => {
                let rest = rest.strip_prefix("//").ok_or("it must be socketcand://HOST:PORT/BUS")?;
                let (server, bus) = rest.split_once('/').ok_or("it names no bus: append /can0")?;
                if !word(server) || !word(bus) || bus.contains(['<', '>', '/']) {
                    return Err("it must be socketcand://HOST:PORT/BUS".to_string());
                }
                if bus.contains('@') {
                    return Err("the server sets the bit rate: leave out the @ and the bit rate".to_string());
                }
                Ok(Self::Socketcand { server: server.to_string(), bus: bus.to_string() })
            }
            "slcan" => {
                let (rest, baud) = with_baud(rest)?;
                let (line, rate) = with_rate(rest)?;
                match line.strip_prefix("tcp://") {
                    Some(_) if baud.is_some() => {
                        Err("TCP has no speed of a serial line: leave out ?baud=".to_string())
                    }
                    Some(server) if word(server) && server.contains(':') => {
                        Ok(Self::SlcanTcp { server: server.to_string(), rate })
                    }
                    Some(_) => Err("it must be slcan:tcp://HOST:PORT@BITRATE".to_string()),
                    None if line.is_empty() => {
                        Err("it names no serial port: slcan:/dev/ttyACM0@500k".to_string())
                    }
                    None => Ok(Self::SlcanPort { port: line.to_string(), rate, baud: baud.unwrap_or(BAUD) }),
                }
            }
            "socketcan" => interface(rest),
            "peak" => with_driver(Kind::Peak, rest),
            "kvaser" => with_driver(Kind::Kvaser, rest),
            "gs_usb" => with_driver(Kind::GsUsb, rest),
            "cia309" => {
                const FORM: &str = "it must be cia309://HOST:PORT/NET";
                let rest = rest.strip_prefix("//").ok_or(FORM)?;
                let (server, network) = rest.split_once('/').unwrap_or((rest, "1"));
                if !word(server) {
                    return Err(FORM.to_string());
                }
                let network = decimal(network).ok_or("its network must be a number from 0 to 65535")?;
                Ok(Self::Gateway { server: server.to_string(), network })
            }
            // A Windows drive is not a port, but users often write COM7: for a port.
            scheme if is_port(scheme) => Err(no_scheme(url.trim_end_matches(':'))),
            scheme => {
                let meant = match scheme.to_ascii_lowercase().as_str() {
                    "pcan" | "pcanbasic" => "peak",
                    "canlib" => "kvaser",
                    "candlelight" | "gsusb" | "gs-usb" | "canable" => "gs_usb",
                    "can" | "vcan" => "socketcan",
                    "serial" | "lawicel" | "slcand" => "slcan",
                    lower if lower != scheme && KNOWN.contains(&lower) => {
                        return Err(format!("{NO_ADAPTER}; did you mean {lower}:{rest}?"));
                    }
                    _ => return Err(NO_ADAPTER.to_string()),
                };
                Err(format!("{NO_ADAPTER}; did you mean {meant}:{rest}?"))
            }
        }
    }
}

/// The schemes.
const KNOWN: [&str; 7] = ["socketcand", "slcan", "socketcan", "peak", "kvaser", "gs_usb", "cia309"];

#[cfg(target_os = "linux")]
fn interface(rest: &str) -> Result<Target, String> {
    match with_rate(rest)? {
        ("", _) => Err("it names no interface: socketcan:can0".to_string()),
        (interface, Some(rate)) => Err(format!(
            "set the bit rate of the interface first: sudo ip link set {interface} up type can bitrate {rate}; then \
             socketcan:{interface}"
        )),
        (interface, None) => Ok(Target::SocketCan { interface: interface.to_string() }),
    }
}

#[cfg(not(target_os = "linux"))]
fn interface(_: &str) -> Result<Target, String> {
    Err("only Linux has SocketCAN; peak:, kvaser:, gs_usb: and slcan: work without it".to_string())
}

fn with_driver(kind: Kind, rest: &str) -> Result<Target, String> {
    let driver = driver(kind)?;
    let (which, rate) = with_rate(rest)?;
    (driver.check)(which, rate)?;
    Ok(Target::Driver { kind, which: which.to_string(), rate })
}

/// The text before `?baud=`, and the speed of the serial line in bit/s after it.
fn with_baud(text: &str) -> Result<(&str, Option<u32>), String> {
    let Some((before, query)) = text.split_once('?') else { return Ok((text, None)) };
    // The speeds of serial lines that exist.
    let baud =
        query.strip_prefix("baud=").and_then(parse_speed).filter(|baud| (300..=12_000_000).contains(baud));
    const FORM: &str =
        "the speed of its serial line must be like ?baud=57600, and at the end: slcan:PORT@500k?baud=57600";
    baud.map(|baud| (before, Some(baud))).ok_or(FORM.to_string())
}

/// The text before the last `@`, and the bit rate after it.
fn with_rate(text: &str) -> Result<(&str, Option<u32>), String> {
    let Some((before, rate)) = text.rsplit_once('@') else { return Ok((text, None)) };
    let bare = decimal::<u32>(rate);
    match (bare, parse_bit_rate(rate)) {
        // No CAN bus runs at 500 bit/s.
        (Some(1), _) => Err("1 bit/s is not a bit rate of CAN; did you mean 1M?".to_string()),
        (Some(few @ 5..=1000), _) => {
            Err(format!("{few} bit/s is not a bit rate of CAN; did you mean {few}k?"))
        }
        (_, Some(rate)) => Ok((before, Some(rate))),
        (Some(_), None) => Err("its bit rate must be like 125k, 500k or 1M; CAN goes up to 1M".to_string()),
        (None, None) => {
            // 500kbit, 500kbps, 500 kbit/s, 0.5M, 500kHz
            let digits: String = rate.chars().take_while(char::is_ascii_digit).collect();
            let unit: String = rate
                .chars()
                .skip(digits.len())
                .filter(|c| !c.is_whitespace())
                .collect::<String>()
                .to_lowercase();
            let like = |units: &[&str]| units.contains(&unit.as_str());
            let meant = match digits.as_str() {
                "" => None,
                digits if like(&["kbit", "kbps", "kbit/s", "kbaud", "kb", "khz", "kbd"]) => {
                    Some(format!("{digits}k"))
                }
                digits if like(&["m", "mbit", "mbps", "mbit/s", "mbaud", "mhz"]) => {
                    Some(format!("{digits}M"))
                }
                _ => None,
            };
            let meant = meant.filter(|meant| parse_bit_rate(meant).is_some());
            let meant = meant.map_or(String::new(), |meant| format!("; did you mean {meant}?"));
            Err(format!("its bit rate must be like 125k, 500k or 1M{meant}"))
        }
    }
}

/// A bit rate of CAN: `500k`, `1M`, `125000`, in bit/s.
fn parse_bit_rate(text: &str) -> Option<u32> {
    parse_speed(text).filter(|rate| (1..=1_000_000).contains(rate))
}

/// `500k`, `1M`, `125000`, in bit/s.
fn parse_speed(text: &str) -> Option<u32> {
    let (digits, unit) = match text.strip_suffix(['k', 'K']) {
        Some(digits) => (digits, 1000),
        None => match text.strip_suffix('M') {
            Some(digits) => (digits, 1_000_000),
            None => (text, 1),
        },
    };
    decimal::<u32>(digits)?.checked_mul(unit)
}

fn is_port(text: &str) -> bool {
    let lower = text.to_ascii_lowercase();
    let com = lower.strip_prefix("com").and_then(decimal::<u32>).is_some();
    com || text.starts_with("/dev/")
}

/// Advice for a URL without a scheme: what the user probably meant.
fn no_scheme(text: &str) -> String {
    let none = NO_SCHEME;
    let bare = text.split('@').next().unwrap_or_default();
    let lower = bare.to_ascii_lowercase();
    let names = ["can", "vcan", "slcan"];
    let interface = names.iter().any(|name| lower.strip_prefix(name).and_then(decimal::<u32>).is_some());
    if is_port(bare) {
        let rate = if text.contains('@') { "" } else { "@500k" };
        format!("{none}; did you mean slcan:{text}{rate}?")
    } else if interface {
        format!("{none}; did you mean socketcan:{bare}?")
    } else if lower.starts_with("pcan_") {
        format!("{none}; did you mean peak:{text}?")
    } else {
        none.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_name_adapters() {
        let rate = Some(500_000);
        let port = |port: &str, rate, baud| Target::SlcanPort { port: port.to_string(), rate, baud };
        for (url, target) in [
            ("slcan:COM7@500k", port("COM7", rate, 115_200)),
            ("slcan:/dev/ttyACM0", port("/dev/ttyACM0", None, 115_200)),
            ("slcan:COM7@500k?baud=57600", port("COM7", rate, 57_600)),
            ("slcan:COM7?baud=3M", port("COM7", None, 3_000_000)),
            ("slcan:tcp://[::1]:7@500000", Target::SlcanTcp { server: "[::1]:7".to_string(), rate }),
            ("cia309://host:7", Target::Gateway { server: "host:7".to_string(), network: 1 }),
            ("cia309://host/65535", Target::Gateway { server: "host".to_string(), network: 65535 }),
        ] {
            assert_eq!(Target::parse(url), Ok(target), "{url}");
        }
        #[cfg(target_os = "linux")]
        assert_eq!(Target::parse("socketcan:can0"), Ok(Target::SocketCan { interface: "can0".to_string() }));
        for (url, kind, which) in [
            ("peak:PCAN_USBBUS1@500k", Kind::Peak, "PCAN_USBBUS1"),
            ("kvaser:12@500k", Kind::Kvaser, "12"),
            ("gs_usb:0/1@500k", Kind::GsUsb, "0/1"),
        ] {
            let there = driver(kind).map(|_| Target::Driver { kind, which: which.to_string(), rate });
            assert_eq!(Target::parse(url), there, "{url}");
        }
    }

    /// Each of these is a common mistake.
    #[test]
    fn a_mistake_is_answered_with_what_was_meant() {
        for (url, words) in [
            ("slcan:/dev/ttyACM0@500", "did you mean 500k?"),
            ("slcan:/dev/ttyACM0@1000", "did you mean 1000k?"),
            ("slcan:/dev/ttyACM0@1", "did you mean 1M?"),
            ("slcan:/dev/ttyACM0@500kbit", "did you mean 500k?"),
            ("slcan:/dev/ttyACM0@1Mbit/s", "did you mean 1M?"),
            ("slcan:/dev/ttyACM0@1m", "did you mean 1M?"),
            ("slcan:COM7?baud=57600@500k", "at the end: slcan:PORT@500k?baud=57600"),
            ("slcan:COM7@500k?baud=0", "must be like ?baud=57600"),
            ("slcan:COM7@500k?speed=57600", "must be like ?baud=57600"),
            ("slcan:tcp://host:7@500k?baud=57600", "TCP has no speed"),
            ("slcan:/dev/ttyACM0@2M", "must be like 125k, 500k or 1M"),
            ("slcan:/dev/ttyACM0@2000000", "CAN goes up to 1M"),
            ("slcan:/dev/ttyACM0@", "must be like 125k"),
            ("slcan:/dev/ttyACM0@\u{E9}k", "must be like 125k"),
            ("can0", "did you mean socketcan:can0?"),
            ("/dev/ttyACM0", "did you mean slcan:/dev/ttyACM0@500k?"),
            ("COM7@500k", "did you mean slcan:COM7@500k?"),
            ("COM7:", "did you mean slcan:COM7@500k?"),
            ("PCAN_USBBUS1", "did you mean peak:PCAN_USBBUS1?"),
            ("pcan:PCAN_USBBUS1", "did you mean peak:PCAN_USBBUS1?"),
            ("SLCAN:COM7", "did you mean slcan:COM7?"),
            ("socketcand://host/can0@500k", "the server sets the bit rate"),
            ("", "has no ':'"),
            ("can0", "has no ':'"),
            ("pcan:1", "there is no such adapter"),
            ("socketcand:localhost/can0", "must be socketcand://HOST:PORT/BUS"),
            ("socketcand://localhost", "names no bus"),
            ("socketcand:///can0", "must be socketcand://HOST:PORT/BUS"),
            ("socketcand://localhost/can0 >", "must be socketcand://HOST:PORT/BUS"),
            ("cia309:host/1", "must be cia309://HOST:PORT/NET"),
            ("cia309:///1", "must be cia309://HOST:PORT/NET"),
            ("cia309://host/net", "its network must be a number"),
            ("cia309://host/+1", "its network must be a number"),
            ("cia309://host/65536", "its network must be a number"),
        ] {
            let why = Target::parse(url).unwrap_err();
            assert!(why.contains(words), "{url}: {why}");
        }
    }
}
