//! socketcand servers that announce themselves by a broadcast on UDP port 42000 every 3 s
//! (socketcand, `doc/protocol.md`, service discovery).
//!
//! The beacon is XML in name only: servers in the field leave tags open and send the address
//! 0.0.0.0. This reader therefore looks only for the parts that it needs.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use super::found::{shown, Found, Kind, Missing};

/// The port of the beacons.
const PORT: u16 = 42_000;
/// The most servers and buses that are listed. A network with more is under attack.
const MOST: usize = 32;

/// The buses that servers announce during `listen`.
pub(super) fn list(listen: Duration) -> Result<Vec<Found>, Missing> {
    let address = SocketAddr::from((Ipv4Addr::UNSPECIFIED, PORT));
    let socket = socket(address).map_err(|error| Missing {
        what: format!("UDP port {PORT} cannot be listened on: {error}"),
        advice: "close the other program that listens for socketcand's beacons",
    })?;
    Ok(hear(&socket, listen))
}

/// A socket that allows other programs to listen on the same port.
fn socket(address: SocketAddr) -> std::io::Result<UdpSocket> {
    use socket2::{Domain, Protocol, Socket, Type};
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_reuse_address(true)?;
    socket.bind(&address.into())?;
    Ok(socket.into())
}

/// The servers' buses, each once.
fn hear(socket: &UdpSocket, listen: Duration) -> Vec<Found> {
    let until = Instant::now() + listen;
    let mut found = BTreeMap::new();
    let mut bytes = [0; 2048];
    loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() || found.len() >= MOST || socket.set_read_timeout(Some(left)).is_err() {
            break;
        }
        match socket.recv_from(&mut bytes) {
            Ok((len, from)) => {
                let beacon = String::from_utf8_lossy(&bytes[..len]);
                for bus in parse(&beacon, from.ip()) {
                    found.entry(bus.url.clone()).or_insert(bus);
                }
            }
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => break,
            // A beacon longer than the buffer (Windows), or another error of the network.
            Err(_) => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    found.into_values().take(MOST).collect()
}

/// The buses that a beacon names.
fn parse(beacon: &str, from: IpAddr) -> Vec<Found> {
    let Some(start) = beacon.find("<CANBeacon") else { return Vec::new() };
    let beacon = &beacon[start..];
    let Some(server) = beacon.split_once("<URL>").and_then(|(_, rest)| rest.split_once("</URL>")) else {
        return Vec::new();
    };
    let Some(server) =
        server.0.trim().strip_prefix("can://").and_then(|text| text.parse::<SocketAddr>().ok())
    else {
        return Vec::new();
    };
    // Many servers do not know the address at which they can be reached.
    let ip = if server.ip().is_unspecified() { from } else { server.ip() };
    let server = SocketAddr::from((ip, server.port()));
    let head = beacon.split('>').next().unwrap_or_default();
    let about = [attribute(head, "name"), attribute(head, "description")];
    let about = about.into_iter().flatten().map(|text| shown(text.as_bytes())).collect::<Vec<_>>().join(", ");
    let buses = beacon.split("<Bus").skip(1).filter_map(|tag| attribute(tag.split('>').next()?, "name"));
    let word = |name: &&str| {
        !name.is_empty()
            && name.len() < 32
            && name.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c))
    };
    buses
        .filter(word)
        .take(MOST)
        .map(|bus| Found {
            // Anyone on the network can send a beacon.
            certain: false,
            ..Found::new(Kind::Socketcand, format!("socketcand://{server}/{bus}"), about.clone())
        })
        .collect()
}

/// The value of an attribute in a tag.
fn attribute<'t>(tag: &'t str, name: &str) -> Option<&'t str> {
    let (_, rest) = tag.split_once(&format!(" {name}="))?;
    let quote = rest.chars().next().filter(|c| matches!(c, '"' | '\''))?;
    rest[1..].split_once(quote).map(|(value, _)| value)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const FROM: IpAddr = IpAddr::V4(Ipv4Addr::new(192, 0, 2, 7));

    fn urls(beacon: &str) -> Vec<String> {
        parse(beacon, FROM).into_iter().map(|found| found.url).collect()
    }

    /// The example of the protocol description, a beacon as socketcand's own source writes it, and
    /// a beacon with open tags.
    #[test]
    fn beacons_of_the_field_are_read() {
        let example = "<CANBeacon name=\"HeartOfGold\" type=\"SocketCAN\" description=\"A human readable description\">\n    \
                       <URL>can://127.0.0.1:29536</URL>\n    <Bus name=\"vcan0\"/>\n    <Bus name=\"vcan1\"/>\n</CANBeacon>";
        assert_eq!(
            urls(example),
            ["socketcand://127.0.0.1:29536/vcan0", "socketcand://127.0.0.1:29536/vcan1"]
        );
        assert_eq!(parse(example, FROM)[0].about, "HeartOfGold, A human readable description");
        let own = "<CANBeacon name=\"pi\" type=\"SocketCAN\" description=\"socketcand\">\n\
                   <URL>can://0.0.0.0:28600</URL><Bus name=\"can0\"/></CANBeacon>";
        assert_eq!(urls(own), ["socketcand://192.0.2.7:28600/can0"]);
        let open = "<CANBeacon name='ESP32' type='adapter'>\t<URL>can://192.0.2.9:29536</URL>\t<Bus name='can0'></CANBeacon>";
        assert_eq!(urls(open), ["socketcand://192.0.2.9:29536/can0"]);
    }

    #[test]
    fn what_is_no_beacon_names_no_bus() {
        for text in [
            "",
            "hello",
            "<CANBeacon",
            "<CANBeacon><URL>can://127.0.0.1:29536</URL>",
            "<CANBeacon><URL>http://127.0.0.1:80</URL><Bus name=\"can0\"/>",
            "<CANBeacon><URL>can://evil host:1</URL><Bus name=\"can0\"/>",
            "<CANBeacon><URL>can://127.0.0.1:29536</URL><Bus name=\"can0 > < send\"/>",
            "<CANBeacon><URL>can://127.0.0.1:29536</URL><Bus name=\"\u{1B}[2J\"/>",
        ] {
            assert_eq!(urls(text), [""; 0], "{text}");
        }
    }

    #[test]
    fn a_bus_that_is_announced_twice_is_found_once_and_a_flood_ends() {
        let socket = socket(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))).unwrap();
        let to = socket.local_addr().unwrap();
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        for text in
            ["noise", "<CANBeacon><URL>can://0.0.0.0:1</URL><Bus name=\"can0\"/>"].into_iter().cycle().take(8)
        {
            sender.send_to(text.as_bytes(), to).unwrap();
        }
        let found = hear(&socket, Duration::from_millis(100));
        assert_eq!(
            found.into_iter().map(|found| found.url).collect::<Vec<_>>(),
            ["socketcand://127.0.0.1:1/can0"]
        );
        let buses: String = (0..1000).map(|bus| format!("<Bus name=\"c{bus}\"/>")).collect();
        let flood = format!("<CANBeacon><URL>can://0.0.0.0:1</URL>{buses}");
        assert_eq!(urls(&flood).len(), MOST);
    }

    proptest! {
        #[test]
        fn any_text_is_a_beacon_or_not(text in "(<CANBeacon|<URL>|</URL>|can://|127\\.0\\.0\\.1:1|<Bus| name=|\"|'|>|é|x){0,20}") {
            let _ = parse(&text, FROM);
        }
    }
}
