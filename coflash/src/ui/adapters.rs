//! The adapters that a page can offer: what this machine has.

use serde::Serialize;

/// One of them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Listed {
    /// What goes into the field; a serial line lacks its bit rate, which the user knows.
    url: String,
    words: String,
}

/// Serial ports, and on Linux the CAN interfaces of the kernel.
pub(super) fn list() -> Vec<Listed> {
    let mut all = interfaces();
    for port in serialport::available_ports().unwrap_or_default() {
        let words = format!("{}, a serial line (SLCAN)", port.port_name);
        all.push(Listed { url: format!("slcan:{}@500k", port.port_name), words });
    }
    all
}

#[cfg(target_os = "linux")]
fn interfaces() -> Vec<Listed> {
    /// ARPHRD_CAN of the kernel.
    const CAN: &str = "280";
    let mut all = Vec::new();
    for entry in std::fs::read_dir("/sys/class/net").into_iter().flatten().flatten() {
        let kind = std::fs::read_to_string(entry.path().join("type")).unwrap_or_default();
        let name = entry.file_name().to_string_lossy().into_owned();
        if kind.trim() == CAN {
            all.push(Listed {
                url: format!("socketcan:{name}"),
                words: format!("{name}, a CAN interface of this machine"),
            });
        }
    }
    all.sort_by(|a, b| a.url.cmp(&b.url));
    all
}

#[cfg(not(target_os = "linux"))]
fn interfaces() -> Vec<Listed> {
    Vec::new()
}
