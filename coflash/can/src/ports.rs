//! Lists serial ports, and explains why a port cannot be opened.

use serialport::{ErrorKind, SerialPortInfo, SerialPortType};

use super::adapter::{AdapterError, Obstacle};
use super::found::{self, shown, Found, Kind, Missing};

/// USB vendor and product IDs of adapters that speak only SLCAN (CANable: current and first IDs).
const SLCAN: [(u16, u16); 2] = [(0x16D0, 0x117E), (0xAD50, 0x60C4)];

/// The serial ports. A port on USB may be an SLCAN adapter.
pub(super) fn list() -> Result<Vec<Found>, Missing> {
    let ports = serialport::available_ports().map_err(|error| Missing {
        what: format!("the serial ports cannot be listed: {error}"),
        advice: "name the port: --bus slcan:PORT@500k",
    })?;
    // macOS lists each port twice; the tty side waits for a modem's carrier and is of no use here.
    Ok(ports.iter().filter(|port| !port.port_name.starts_with("/dev/tty.")).map(found).collect())
}

fn found(port: &SerialPortInfo) -> Found {
    let (about, certain) = match &port.port_type {
        SerialPortType::UsbPort(usb) => {
            let words = usb.product.as_deref().unwrap_or("USB serial port");
            let certain = SLCAN.contains(&(usb.vid, usb.pid));
            (format!("{words} (USB {:04x}:{:04x})", usb.vid, usb.pid), certain)
        }
        _ => ("serial port".to_string(), false),
    };
    let url = format!("slcan:{}", shown(port.port_name.as_bytes()));
    Found { certain, ..Found::new(Kind::Serial, url, shown(about.as_bytes())) }
}

/// A list of the serial ports, for advice.
pub(super) fn those_there() -> String {
    let ports = serialport::available_ports().unwrap_or_default();
    let names = ports.into_iter().map(|port| port.port_name).filter(|name| !name.starts_with("/dev/tty."));
    found::those_there("serial ports", "this computer has no serial port at present", names)
}

/// The error for a port that did not open, with advice.
pub(super) fn refused(adapter: String, port: &str, error: &serialport::Error) -> AdapterError {
    let io = match error.kind() {
        ErrorKind::Io(kind) => Some(kind),
        _ => None,
    };
    let there = std::path::Path::new(port).exists();
    let in_use = match (error.kind(), io) {
        (_, Some(std::io::ErrorKind::PermissionDenied)) => cfg!(windows),
        (ErrorKind::NoDevice, _) => there,
        _ => false,
    };
    let said = shown(error.to_string().as_bytes());
    let (obstacle, what, advice) = match (error.kind(), io) {
        _ if in_use => (Obstacle::InUse, "another program uses the port".to_string(), close_other(port)),
        (_, Some(std::io::ErrorKind::PermissionDenied)) => {
            (Obstacle::Other, "permission denied".to_string(), permit(&group(port)))
        }
        (ErrorKind::NoDevice, _) | (_, Some(std::io::ErrorKind::NotFound)) => (
            Obstacle::Absent,
            "no serial port has this name".to_string(),
            format!("{}; plug the adapter in, or name the right one: slcan:PORT@500k", those_there()),
        ),
        _ if there => (
            Obstacle::Absent,
            format!("it is not a serial port ({said})"),
            format!("{}; name the right one: slcan:PORT@500k", those_there()),
        ),
        _ => (Obstacle::Other, said, format!("{}; unplug the adapter and plug it in again", those_there())),
    };
    AdapterError::unusable(adapter, obstacle, what, advice)
}

/// The advice for a port that another program uses.
fn close_other(port: &str) -> String {
    let who = if cfg!(unix) {
        format!("sudo fuser -v {port} names it; ModemManager opens new ports for some seconds")
    } else {
        "a terminal program, for example".to_string()
    };
    format!("close the other program ({who}), and try again")
}

/// The advice for a port that the user may not open, as only this group may.
fn permit(group: &str) -> String {
    format!(
        "join the group {group}, which the port belongs to: sudo usermod -aG {group} $USER, then log out and in; or, for \
         this kind of adapter and everybody at this computer, add a udev rule: put SUBSYSTEM==\"tty\", \
         ATTRS{{idVendor}}==\"16d0\", TAG+=\"uaccess\" (with the vendor that lsusb shows) into \
         /etc/udev/rules.d/70-slcan.rules, and plug the adapter in again"
    )
}

/// The group that may use a port; `dialout` if this is unknown.
fn group(port: &str) -> String {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let id = std::fs::metadata(port).map(|file| file.gid()).ok();
        let groups = std::fs::read_to_string("/etc/group").unwrap_or_default();
        let name = groups.lines().find_map(|line| {
            let mut words = line.split(':');
            let (name, _, number) = (words.next()?, words.next()?, words.next()?.parse::<u32>().ok()?);
            (Some(number) == id && number != 0).then(|| shown(name.as_bytes()))
        });
        if let Some(name) = name {
            return name;
        }
    }
    let _ = port;
    "dialout".to_string()
}
