//! The CAN interfaces of Linux, as `ip -json -details link show` reports them.
//!
//! Users configure these interfaces with `ip`, so a computer with such an interface has this
//! program. Its output is the answer of netlink in a stable format.

use std::io::Read;
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::Value;

use super::found::{shown, Found, Kind, Missing, State};
use super::health::{Controller, Health};
use super::in_time::in_time;

/// How long `ip` may take.
const PATIENCE: Duration = Duration::from_secs(2);
const MOST: u64 = 4 << 20;

/// A CAN interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Link {
    pub(super) name: String,
    /// `can`, `vcan`, `slcan` and others.
    pub(super) kind: String,
    /// Whether it is switched on.
    pub(super) up: bool,
    /// What is known about its controller. A virtual interface has none.
    pub(super) health: Health,
}

/// All CAN interfaces.
pub(super) fn all() -> Result<Vec<Link>, Missing> {
    let mut last = String::new();
    // The PATH of a user often lacks the folder of `ip`.
    for program in ["ip", "/usr/sbin/ip", "/sbin/ip"] {
        match text_of(program) {
            Ok(text) => return Ok(parse(&text)),
            Err(error) => last = error,
        }
    }
    let what = format!("the program ip cannot list the CAN interfaces: {last}");
    Err(Missing { what, advice: "install iproute2, whose program ip sets up CAN interfaces" })
}

/// The interface with this name.
pub(super) fn of(name: &str) -> Option<Link> {
    all().ok()?.into_iter().find(|link| link.name == name)
}

/// The output of the program.
fn text_of(program: &str) -> Result<String, String> {
    let mut command = Command::new(program);
    command.args(["-json", "-details", "link", "show"]);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = command.spawn().map_err(|error| error.to_string())?;
    let output = child.stdout.take().ok_or("it has no output")?;
    let text = in_time(PATIENCE, move || {
        let mut text = Vec::new();
        output.take(MOST).read_to_end(&mut text).map(|_| text)
    });
    // A program that still runs has used up its time; for a program that has ended this does
    // nothing.
    let _ = child.kill();
    let _ = child.wait();
    match text {
        Some(Ok(text)) => Ok(String::from_utf8_lossy(&text).into_owned()),
        Some(Err(error)) => Err(error.to_string()),
        None => Err("it does not answer".to_string()),
    }
}

/// The CAN interfaces in the output of `ip`. Entries in an unexpected form are left out.
fn parse(text: &str) -> Vec<Link> {
    let all: Vec<Value> = serde_json::from_str(text).unwrap_or_default();
    all.iter().filter(|link| link["link_type"] == "can").filter_map(link).collect()
}

fn link(link: &Value) -> Option<Link> {
    let info = &link["linkinfo"]["info_data"];
    let flags = link["flags"].as_array();
    let controller = match info["state"].as_str() {
        Some("ERROR-ACTIVE") => Some(Controller::Active),
        Some("ERROR-WARNING") => Some(Controller::Warning),
        Some("ERROR-PASSIVE") => Some(Controller::Passive),
        Some("BUS-OFF") => Some(Controller::Off),
        Some("STOPPED" | "SLEEPING") => Some(Controller::Stopped),
        _ => None,
    };
    let count =
        |side: &str| info["berr_counter"][side].as_u64().map(|count| u8::try_from(count).unwrap_or(u8::MAX));
    let bit_rate = info["bittiming"]["bitrate"].as_u64().and_then(|rate| u32::try_from(rate).ok());
    let health = Health {
        controller,
        counters: count("tx").zip(count("rx")),
        bit_rate: bit_rate.filter(|rate| *rate > 0),
        ..Health::default()
    };
    Some(Link {
        name: link["ifname"].as_str()?.to_string(),
        kind: link["linkinfo"]["info_kind"].as_str().unwrap_or("can").to_string(),
        up: flags.is_some_and(|flags| flags.iter().any(|flag| flag == "UP")),
        health,
    })
}

/// The CAN interfaces as adapters.
pub(super) fn list() -> Result<Vec<Found>, Missing> {
    let found = all()?.into_iter().map(|link| {
        let controller = if link.up { link.health.controller } else { Some(Controller::Stopped) };
        let state = controller.map(State::Controller);
        let about = shown(format!("CAN interface of the kernel ({})", link.kind).as_bytes());
        let found = Found::new(Kind::SocketCan, format!("socketcan:{}", shown(link.name.as_bytes())), about);
        // A user has created this interface for a purpose, even if it is virtual.
        Found { state, bit_rate: link.health.bit_rate, certain: true, ..found }
    });
    Ok(found.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::Trouble;

    /// The output of iproute2 for a real interface (a sun4i_can at 250 kbit/s on a bus with another
    /// bit rate), and for a USB adapter that is switched off; shortened.
    const SEEN: &str = r#"[
        {"ifindex":1,"ifname":"lo","flags":["LOOPBACK","UP","LOWER_UP"],"operstate":"UNKNOWN","link_type":"loopback"},
        {"ifindex":3,"ifname":"can0","flags":["NOARP","UP","LOWER_UP","ECHO"],"mtu":16,"operstate":"UP","link_type":"can",
         "linkinfo":{"info_kind":"can","info_data":{"state":"ERROR-PASSIVE","berr_counter":{"tx":0,"rx":135},"restart_ms":100,
         "bittiming":{"bitrate":250000,"sample_point":0.875,"tq":250,"prop_seg":6,"phase_seg1":7,"phase_seg2":2,"sjw":1},
         "clock":24000000},"info_xstats":{"restarts":0,"bus_error":2}}},
        {"ifindex":4,"ifname":"can1","flags":["NOARP","ECHO"],"mtu":72,"operstate":"DOWN","link_type":"can",
         "linkinfo":{"info_kind":"can","info_data":{"ctrlmode":["FD","TDC_AUTO"],"state":"STOPPED","berr_counter":{"tx":0,"rx":0},
         "bittiming":{"bitrate":1000000,"sample_point":"0.750"}}}},
        {"ifindex":5,"ifname":"vcan0","flags":["NOARP","UP","LOWER_UP"],"link_type":"can","linkinfo":{"info_kind":"vcan"}}]"#;

    #[test]
    fn interfaces_have_their_state_and_bit_rate() {
        let links = parse(SEEN);
        let names: Vec<(&str, &str, bool)> =
            links.iter().map(|link| (&*link.name, &*link.kind, link.up)).collect();
        assert_eq!(names, [("can0", "can", true), ("can1", "can", false), ("vcan0", "vcan", true)]);
        assert_eq!((links[0].health.bit_rate, links[0].health.counters), (Some(250_000), Some((0, 135))));
        assert_eq!(links[0].health.trouble(), Some(Trouble::Passive));
        assert_eq!(links[1].health.trouble(), Some(Trouble::Stopped));
        assert_eq!(links[2].health, Health::default());
    }

    #[test]
    fn what_is_no_list_of_interfaces_has_none() {
        for text in [
            "",
            "[",
            "{}",
            "null",
            "[1,null,{}]",
            r#"[{"link_type":"can"}]"#,
            r#"[{"link_type":"can","ifname":7}]"#,
        ] {
            assert_eq!(parse(text), [], "{text}");
        }
        let odd = r#"[{"link_type":"can","ifname":"x","linkinfo":{"info_data":{"berr_counter":{"tx":-1,"rx":9999},
                      "bittiming":{"bitrate":1e99}}}}]"#;
        assert_eq!(parse(odd)[0].health, Health::default());
    }
}
