//! Linux SocketCAN: the CAN interfaces of the kernel.

use std::fs;
use std::io;
use std::io::ErrorKind;
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use canopen::Frame;
use embedded_can::Frame as _;
use socketcan::{CanFrame, CanSocket, Socket, SocketOptions};

use super::adapter::{Adapter, AdapterError, Obstacle};
use super::found;
use super::health::{Controller, Health, Losses};
use super::links;
use super::tcp::waits;

/// How long the interface may take to accept a frame. Its queue stays full while no node
/// acknowledges on the bus.
const PATIENCE: Duration = Duration::from_secs(1);
/// `ENOBUFS`: the interface's queue is full. The kernel does not wait for room.
const QUEUE_FULL: i32 = 105;
/// `ENODEV` and `ENXIO`: no interface has this name, or it is not a CAN interface.
const NONE: [i32; 2] = [19, 6];
/// The message for an interface that is switched off.
const SWITCHED_OFF: &str = "it is switched off";
/// `ENETDOWN`: the interface is switched off.
const DOWN: i32 = 100;
/// `EAFNOSUPPORT`, `EPROTONOSUPPORT` and `ESOCKTNOSUPPORT`: the kernel has no CAN support, or has
/// not loaded it.
const NO_CAN: [i32; 3] = [97, 93, 94];

/// A CAN interface of the kernel.
#[derive(Debug)]
pub struct SocketCan {
    socket: CanSocket,
    interface: String,
    name: String,
    opened: Instant,
    /// What the error frames have reported.
    health: Health,
}

impl SocketCan {
    /// Opens an interface, for example `can0`. The user sets its bit rate and switches it on with
    /// `ip link`.
    ///
    /// # Errors
    /// [`AdapterError::Unusable`].
    pub fn open(interface: &str) -> Result<Self, AdapterError> {
        let name = format!("CAN interface {interface}");
        let socket = CanSocket::open(interface).map_err(|source| refused(&name, interface, &source))?;
        if is_up(interface) == Some(false) {
            return Err(AdapterError::unusable(name, Obstacle::Other, SWITCHED_OFF, switch_on(interface)));
        }
        // The bus also works without error frames, but the tool knows less about it.
        let _ = socket.set_error_filter_accept_all();
        let interface = interface.to_string();
        Ok(Self { socket, interface, name, opened: Instant::now(), health: Health::default() })
    }

    fn lost(&self, source: io::Error) -> AdapterError {
        AdapterError::Lost { adapter: self.name.clone(), source: source.into() }
    }

    fn stuck(&mut self) -> AdapterError {
        let health = self.health().unwrap_or_default();
        AdapterError::Stuck { adapter: self.name.clone(), health }
    }
}

/// Whether an interface is switched on (`IFF_UP`), if this is known.
fn is_up(interface: &str) -> Option<bool> {
    let flags = fs::read_to_string(class(interface)?.join("flags")).ok()?;
    let flags = u32::from_str_radix(flags.trim().strip_prefix("0x")?, 16).ok()?;
    Some(flags & 1 != 0)
}

/// The kernel's folder for an interface.
fn class(interface: &str) -> Option<std::path::PathBuf> {
    let path = Path::new("/sys/class/net").join(interface);
    (!interface.contains('/') && path.exists()).then_some(path)
}

/// The error for an interface that did not open, with advice.
fn refused(name: &str, interface: &str, error: &io::Error) -> AdapterError {
    let code = error.raw_os_error().unwrap_or_default();
    let there = class(interface).is_some();
    let kind = class(interface).and_then(|class| fs::read_to_string(class.join("type")).ok());
    // ARPHRD_CAN
    let can = kind.is_none_or(|kind| kind.trim() == "280");
    let (what, advice) = if there && !can {
        ("it is not a CAN interface".to_string(), those_there())
    } else if NO_CAN.contains(&code) {
        (
            format!("this kernel has no CAN support at present ({error})"),
            "load it: sudo modprobe can_raw; if that fails, the kernel was built without CAN: use slcan:, peak:, \
             kvaser: or gs_usb: instead"
                .to_string(),
        )
    } else if NONE.contains(&code) {
        ("no interface has this name".to_string(), those_there())
    } else if code == DOWN {
        (SWITCHED_OFF.to_string(), switch_on(interface))
    } else if error.kind() == ErrorKind::PermissionDenied {
        (
            "permission denied".to_string(),
            "Linux needs no permissions for CAN interfaces, but a container or a sandbox may forbid them"
                .to_string(),
        )
    } else {
        (error.to_string(), those_there())
    };
    AdapterError::unusable(name, Obstacle::Other, what, advice)
}

/// The advice for an interface that is switched off.
fn switch_on(interface: &str) -> String {
    format!(
        "switch it on, with the bit rate of the bus: sudo ip link set {interface} up type can bitrate 500000"
    )
}

/// A list of the CAN interfaces, for advice.
fn those_there() -> String {
    const NONE: &str =
        "this computer has no CAN interface at present: plug the adapter in; its driver creates one (ip link shows it); \
         then switch that on: sudo ip link set can0 up type can bitrate 500000; an SLCAN adapter works without an interface: \
         slcan:/dev/ttyACM0@500k";
    let links = links::all().unwrap_or_default();
    found::those_there("CAN interfaces", NONE, links.into_iter().map(|link| link.name))
}

impl Adapter for SocketCan {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        let made = if frame.is_remote_frame() {
            CanFrame::new_remote(frame.id(), frame.dlc())
        } else {
            CanFrame::new(frame.id(), frame.data())
        };
        // `made` is `None` only for an impossible frame: both kinds have an identifier of 11 or 29
        // bits and at most 8 bytes.
        let Some(made) = made else { return Ok(()) };
        let deadline = Instant::now() + PATIENCE;
        loop {
            match self.socket.write_frame(&made) {
                Ok(()) => return Ok(()),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.raw_os_error() == Some(QUEUE_FULL) && Instant::now() < deadline => {
                    thread::sleep(Duration::from_millis(1));
                }
                Err(error) if error.raw_os_error() == Some(QUEUE_FULL) => return Err(self.stuck()),
                Err(error) if error.raw_os_error() == Some(DOWN) => {
                    self.health.controller = Some(Controller::Stopped);
                    return Err(self.stuck());
                }
                Err(error) => return Err(self.lost(error)),
            }
        }
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let deadline = Instant::now() + timeout;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.socket.read_frame_timeout(left) {
                Ok(CanFrame::Data(frame)) => {
                    if let Some(frame) = Frame::new(frame.id(), frame.data()) {
                        return Ok(Some(frame));
                    }
                }
                Ok(CanFrame::Error(frame)) => self.health.error_frame(frame.error_bits(), frame.data()),
                // Remote frames are ignored.
                Ok(CanFrame::Remote(_)) => {}
                Err(error) if waits(&error) => {}
                Err(error) => return Err(self.lost(error)),
            }
            if Instant::now() >= deadline {
                return Ok(None);
            }
        }
    }

    fn now(&self) -> Duration {
        self.opened.elapsed()
    }

    fn losses(&self) -> Losses {
        self.health.losses
    }

    /// The reports of the error frames, and the controller's present state from the kernel.
    fn health(&mut self) -> Option<Health> {
        let link = links::of(&self.interface);
        let now = link.map(|link| Health {
            controller: if link.up { link.health.controller } else { Some(Controller::Stopped) },
            ..link.health
        });
        let Some(now) = now else { return Some(self.health) };
        Some(Health {
            controller: now.controller.or(self.health.controller),
            counters: now.counters.or(self.health.counters),
            bit_rate: now.bit_rate,
            ..self.health
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interface_that_is_not_there_is_named() {
        let error = SocketCan::open("nocan99").unwrap_err();
        assert_eq!(error.to_string(), "CAN interface nocan99 cannot be opened: no interface has this name");
        assert!(error.advice().contains("CAN interface"), "{}", error.advice());
    }
}
