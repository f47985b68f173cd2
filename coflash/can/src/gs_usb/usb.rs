//! Access to USB with `nusb`.

use std::io;
use std::time::Duration;

use nusb::transfer::{Bulk, ControlIn, ControlOut, ControlType, In, Out, Recipient, TransferError};
use nusb::{DeviceInfo, Endpoint, ErrorKind, Interface, MaybeFuture};

use super::driver::{Usb, MOST_UNDER_WAY};
use super::which::Choice;
use crate::adapter::{AdapterError, Obstacle};

/// USB vendor and product IDs of gs_usb adapters (the list of the Linux driver, and CANnectivity).
const DEVICES: [(u16, u16); 5] =
    [(0x1D50, 0x606F), (0x1209, 0x2323), (0x1CD2, 0x606F), (0x16D0, 0x10B8), (0x1209, 0xCA01)];

/// How long a request may take (the limit of the kernel's driver).
const REQUEST: Duration = Duration::from_secs(1);
/// The number of transfers that wait for data from the device.
const READS: usize = 8;

/// What is known about a device before it is opened.
pub(super) struct Listed {
    pub(super) serial: Option<String>,
    pub(super) product: Option<String>,
    /// Whether the kernel's own driver uses it. The device is a CAN interface then.
    pub(super) kernel: bool,
}

fn devices() -> Result<Vec<DeviceInfo>, String> {
    let all = nusb::list_devices().wait().map_err(|error| error.to_string())?;
    Ok(all.filter(|device| DEVICES.contains(&(device.vendor_id(), device.product_id()))).collect())
}

/// The connected devices, in the system's order.
pub(super) fn list() -> Result<Vec<Listed>, String> {
    let text = |text: Option<&str>| text.map(str::to_string);
    let listed = |device: &DeviceInfo| Listed {
        serial: text(device.serial_number()),
        product: text(device.product_string()),
        kernel: kernel_has(device),
    };
    Ok(devices()?.iter().map(listed).collect())
}

/// Whether a driver of the kernel is bound to the device's first interface.
#[cfg(target_os = "linux")]
fn kernel_has(device: &DeviceInfo) -> bool {
    let path = device.sysfs_path();
    let interface = path.file_name().map(|name| format!("{}:1.0", name.to_string_lossy()));
    let driver = interface.and_then(|interface| path.join(interface).join("driver").read_link().ok());
    driver.is_some_and(|driver| driver.ends_with("gs_usb"))
}

#[cfg(not(target_os = "linux"))]
fn kernel_has(_: &DeviceInfo) -> bool {
    false
}

/// Opens a device. `name` is for messages.
pub(super) fn open(name: &str, which: &Choice) -> Result<Device, AdapterError> {
    let unusable =
        |obstacle, what: String, advice: &str| AdapterError::unusable(name, obstacle, what, advice);
    let devices = devices().map_err(|error| {
        let advice = "check that USB works on this computer";
        unusable(Obstacle::Other, format!("the USB devices cannot be listed: {error}"), advice)
    })?;
    let device = match which {
        Choice::Place(place) => devices.get(*place),
        Choice::Serial(serial) => devices.iter().find(|device| device.serial_number() == Some(serial)),
    };
    let device = device.ok_or_else(|| {
        let what = match devices.len() {
            0 => "no such adapter is connected to USB".to_string(),
            count => format!("it is not connected ({count} other(s) are)"),
        };
        unusable(Obstacle::Absent, what, "plug it in")
    })?;
    let rule = udev_rule(device.vendor_id(), device.product_id());
    let refused = |error: nusb::Error| {
        let (obstacle, advice) = match error.kind() {
            ErrorKind::PermissionDenied => (Obstacle::Other, rule.as_str()),
            ErrorKind::Busy => (
                Obstacle::InUse,
                "the kernel's driver or another program uses it: on Linux use the interface that the kernel made of it \
                 (socketcan:can0)",
            ),
            ErrorKind::Unsupported => (
                Obstacle::Other,
                "on Windows the device needs the driver WinUSB, which candleLight asks for by itself; Zadig installs it \
                 for others",
            ),
            _ => (Obstacle::Other, "unplug the adapter, plug it in and try again"),
        };
        unusable(obstacle, error.to_string(), advice)
    };
    let opened = device.open().wait().map_err(refused)?;
    let interface = opened.claim_interface(0).wait().map_err(refused)?;
    let advice = "it must speak gs_usb (candleLight)";
    Device::new(interface).map_err(|what| unusable(Obstacle::Other, what, advice))
}

/// The advice for a device that the user may not use, by its USB vendor and product ID.
fn udev_rule(vendor: u16, product: u16) -> String {
    format!(
        "allow it by a udev rule: put SUBSYSTEM==\"usb\", ATTRS{{idVendor}}==\"{vendor:04x}\", \
         ATTRS{{idProduct}}==\"{product:04x}\", TAG+=\"uaccess\" into /etc/udev/rules.d/70-gs_usb.rules, and plug the \
         adapter in again"
    )
}

/// An open device.
pub(super) struct Device {
    interface: Interface,
    incoming: Endpoint<Bulk, In>,
    outgoing: Endpoint<Bulk, Out>,
}

impl Device {
    fn new(interface: Interface) -> Result<Self, String> {
        let none = "it has no bulk endpoints".to_string();
        let descriptor = interface.descriptor().ok_or(none.clone())?;
        let bulk = |direction| {
            let mut all = descriptor.endpoints();
            let endpoint = all.find(|endpoint| {
                endpoint.direction() == direction
                    && endpoint.transfer_type() == nusb::descriptors::TransferType::Bulk
            });
            endpoint.map(|endpoint| endpoint.address()).ok_or_else(|| none.clone())
        };
        let (incoming, outgoing) =
            (bulk(nusb::transfer::Direction::In)?, bulk(nusb::transfer::Direction::Out)?);
        let words = |error: nusb::Error| error.to_string();
        let mut incoming = interface.endpoint::<Bulk, In>(incoming).map_err(words)?;
        let outgoing = interface.endpoint::<Bulk, Out>(outgoing).map_err(words)?;
        let packet = incoming.max_packet_size().max(1);
        // Whole packets, with room for a frame and its time stamp.
        let len = packet * 24_usize.div_ceil(packet);
        for _ in 0..READS {
            let buffer = incoming.allocate(len);
            incoming.submit(buffer);
        }
        Ok(Self { interface, incoming, outgoing })
    }

    fn index(&self) -> u16 {
        self.interface.interface_number().into()
    }
}

/// The message for a transfer that failed.
fn words(error: TransferError) -> String {
    match error {
        TransferError::Disconnected => "it was unplugged".to_string(),
        TransferError::Stall => "it refuses the request (USB stall)".to_string(),
        TransferError::Cancelled => "it does not answer on USB".to_string(),
        error => format!("USB: {}", io::Error::from(error)),
    }
}

impl Usb for Device {
    fn read_control(&mut self, request: u8, value: u16, len: u16) -> Result<Vec<u8>, String> {
        let control = ControlIn {
            control_type: ControlType::Vendor,
            recipient: Recipient::Interface,
            request,
            value,
            index: self.index(),
            length: len,
        };
        self.interface.control_in(control, REQUEST).wait().map_err(words)
    }

    fn write_control(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), String> {
        let control = ControlOut {
            control_type: ControlType::Vendor,
            recipient: Recipient::Interface,
            request,
            value,
            index: self.index(),
            data,
        };
        self.interface.control_out(control, REQUEST).wait().map_err(words)
    }

    fn write(&mut self, data: &[u8]) -> Result<bool, String> {
        while self.outgoing.pending() > 0 {
            match self.outgoing.wait_next_complete(Duration::ZERO) {
                Some(done) => {
                    done.status.map_err(words)?;
                }
                None => break,
            }
        }
        if self.outgoing.pending() >= MOST_UNDER_WAY {
            return Ok(false);
        }
        self.outgoing.submit(data.to_vec().into());
        Ok(true)
    }

    fn read(&mut self, wait: Duration) -> Result<Option<Vec<u8>>, String> {
        let Some(done) = self.incoming.wait_next_complete(wait) else { return Ok(None) };
        done.status.map_err(words)?;
        let mut buffer = done.buffer;
        let bytes = buffer.to_vec();
        buffer.clear();
        self.incoming.submit(buffer);
        Ok(Some(bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// udev compares with the files of sysfs, which have four small digits.
    #[test]
    fn the_rule_names_the_device_as_udev_does() {
        let advice = udev_rule(0x16D0, 0x0AB8);
        assert!(advice.contains(r#"ATTRS{idVendor}=="16d0", ATTRS{idProduct}=="0ab8","#), "{advice}");
    }
}
