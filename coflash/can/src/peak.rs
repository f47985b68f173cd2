//! PEAK adapters with PCANBasic: `peak:PCAN_USBBUS1@500k`.
//!
//! Names and values are those of `PCANBasic.h` and of the manual of PCAN-Basic ("Error Frames").
//! Tested against a stand-in for the library, not on hardware.

use std::thread;
use std::time::Duration;

use canopen::Frame;
use embedded_can::{Frame as _, Id};
use vendor_can::pcan::{Message, Pcan};

use super::adapter::{AdapterError, Obstacle, ABSENT};
use super::driven::{frame_of, Driven, Driver, Fault, Sent};
use super::found::{shown, Found, Kind, Missing, State};
use super::health::{Controller, Health};

/// Where to get the library.
const FROM: &str =
    "install the driver of the adapter with PCAN-Basic from www.peak-system.com (on macOS PCBUSB from \
                    www.mac-can.com); on Linux the kernel's own driver needs no library: socketcan:can0";

/// The channels of plug-and-play hardware: the name without its number, and the values from number
/// 1 on.
const CHANNELS: [(&str, &[(u16, u16)]); 4] = [
    // The first value, and the number of consecutive values.
    ("USBBUS", &[(0x51, 8), (0x509, 8)]),
    ("PCIBUS", &[(0x41, 8), (0x409, 8)]),
    ("LANBUS", &[(0x801, 16)]),
    ("PCCBUS", &[(0x61, 2)]),
];

/// The bit rates with their register values of an SJA1000 (`PCAN_BAUD_…`).
const BIT_RATES: [(u32, u16); 10] = [
    (1_000_000, 0x0014),
    (800_000, 0x0016),
    (500_000, 0x001C),
    (250_000, 0x011C),
    (125_000, 0x031C),
    (100_000, 0x432F),
    (50_000, 0x472F),
    (20_000, 0x532F),
    (10_000, 0x672F),
    (5_000, 0x7F7F),
];

/// Parameters of `CAN_GetValue` and `CAN_SetValue`.
mod parameter {
    pub const CHANNEL_CONDITION: u8 = 0x0D;
    pub const HARDWARE_NAME: u8 = 0x0E;
    pub const ALLOW_ERROR_FRAMES: u8 = 0x20;
}

/// Bits of a `TPCANStatus` that describe a frame or the bus. All other bits are errors.
mod status {
    pub const CONTROLLER_FULL: u32 = 0x1;
    pub const OVERRUN: u32 = 0x2;
    pub const BUS_LIGHT: u32 = 0x4;
    pub const BUS_HEAVY: u32 = 0x8;
    pub const BUS_OFF: u32 = 0x10;
    pub const EMPTY: u32 = 0x20;
    pub const QUEUE_OVERRUN: u32 = 0x40;
    pub const QUEUE_FULL: u32 = 0x80;
    pub const BUS_PASSIVE: u32 = 0x4_0000;
    pub const BUS: u32 = BUS_LIGHT | BUS_HEAVY | BUS_OFF | BUS_PASSIVE;
    pub const HARMLESS: u32 =
        BUS | CONTROLLER_FULL | OVERRUN | EMPTY | QUEUE_OVERRUN | QUEUE_FULL | 0x200_0000;
}

/// Bits of `MSGTYPE`.
mod kind {
    pub const REMOTE: u8 = 0x01;
    pub const EXTENDED: u8 = 0x02;
    pub const FD: u8 = 0x04;
    pub const ECHO: u8 = 0x20;
    pub const ERROR: u8 = 0x40;
    pub const STATUS: u8 = 0x80;
}

/// The pause before an empty queue is read again. The library has no wait function that works on
/// all systems.
const PAUSE: Duration = Duration::from_micros(500);

/// Checks a channel's name and a bit rate.
pub(super) fn check(name: &str, rate: Option<u32>) -> Result<(), &'static str> {
    if channel(name).is_none() {
        return Err("it names no channel of PCANBasic: peak:PCAN_USBBUS1@500k");
    }
    if rate.is_some_and(|rate| registers(rate).is_none()) {
        return Err("PEAK adapters support 1M, 800k, 500k, 250k, 125k, 100k, 50k, 20k, 10k and 5k");
    }
    Ok(())
}

/// The value for a channel's name, with or without `PCAN_`.
fn channel(name: &str) -> Option<u16> {
    let name = name.to_ascii_uppercase();
    let name = name.strip_prefix("PCAN_").unwrap_or(&name);
    names().find_map(|(known, value)| (known.strip_prefix("PCAN_") == Some(name)).then_some(value))
}

/// All channels.
fn names() -> impl Iterator<Item = (String, u16)> {
    CHANNELS.iter().flat_map(|(bus, ranges)| {
        let values = ranges.iter().flat_map(|(first, count)| *first..first + count);
        values.zip(1..).map(move |(value, number)| (format!("PCAN_{bus}{number}"), value))
    })
}

/// The register values for a bit rate in bit/s.
fn registers(rate: u32) -> Option<u16> {
    BIT_RATES.iter().find_map(|(known, registers)| (*known == rate).then_some(*registers))
}

/// Opens a channel at a bit rate in bit/s.
pub(super) fn open(channel_name: &str, rate: u32) -> Result<Driven, AdapterError> {
    let name = format!("PEAK adapter {channel_name}");
    let adapter = name.clone();
    let unusable = move |what, (obstacle, advice): (Obstacle, &str)| {
        AdapterError::unusable(adapter, obstacle, what, advice)
    };
    let (Some(channel), Some(registers)) = (channel(channel_name), registers(rate)) else {
        let advice = (Obstacle::Other, "choose one from 5k to 1M");
        return Err(unusable(format!("it does not support {rate} bit/s"), advice));
    };
    Driven::open(name, move || {
        let library = Pcan::load().map_err(|error| AdapterError::library("PEAK adapter", &error, FROM))?;
        let status = library.initialize(channel, registers);
        if status & !status::HARMLESS != 0 {
            return Err(unusable(words(status), advice(status)));
        }
        // A library from before 2018 does not know this parameter; it reports the controller's
        // state all the same.
        let _ = library.set_number(channel, parameter::ALLOW_ERROR_FRAMES, 1);
        Ok(Peak { library, channel, health: Health { bit_rate: Some(rate), ..Health::default() } })
    })
}

/// The connected channels, or the reason why the library cannot list them.
pub(super) fn list() -> Result<Vec<Found>, Missing> {
    let library = Pcan::load().map_err(|error| Missing { what: error.to_string(), advice: FROM })?;
    let found = names().filter_map(|(name, channel)| {
        let (status, condition) = library.number(channel, parameter::CHANNEL_CONDITION);
        // Available 1, occupied 2, used by PCAN-View and available 3.
        let state = match (status, condition) {
            (0, 1) => None,
            (0, 2) => Some(State::InUse),
            (0, 3) => Some(State::Shared),
            _ => return None,
        };
        let (status, hardware) = library.text(channel, parameter::HARDWARE_NAME);
        let about = if status == 0 { shown(&hardware) } else { String::new() };
        Some(Found { state, ..Found::new(Kind::Peak, format!("peak:{name}"), about) })
    });
    Ok(found.collect())
}

struct Peak {
    library: Pcan,
    channel: u16,
    health: Health,
}

impl Peak {
    /// Records what a status says about the bus.
    fn note(&mut self, status: u32) {
        self.health.controller = Some(match status {
            status if status & status::BUS_OFF != 0 => Controller::Off,
            status if status & status::BUS_PASSIVE != 0 => Controller::Passive,
            status if status & (status::BUS_HEAVY | status::BUS_LIGHT) != 0 => Controller::Warning,
            _ => Controller::Active,
        });
    }

    /// An error frame ("Error Frames" of the manual): the identifier holds the kind of error; the
    /// data hold direction, position in the frame, and both counters.
    fn error_frame(&mut self, message: &Message) {
        let [_, place, receive, send, ..] = message.data;
        self.health.counters = Some((send, receive));
        match (message.id, place) {
            // The acknowledge slot.
            (1..=8, 25) => self.health.unacknowledged = self.health.unacknowledged.saturating_add(1),
            // Bit, form or stuff error; other errors, such as CRC.
            (1..=8, _) => self.health.disturbed = self.health.disturbed.saturating_add(1),
            // Only the counters.
            _ => {}
        }
    }
}

impl Driver for Peak {
    fn send(&mut self, frame: &Frame) -> Result<Sent, Fault> {
        let (id, mut kind) = match frame.id() {
            Id::Standard(id) => (id.as_raw().into(), 0),
            Id::Extended(id) => (id.as_raw(), kind::EXTENDED),
        };
        let mut message = Message { id, kind: 0, len: frame.dlc() as u8, data: [0; 8] };
        if frame.is_remote_frame() {
            kind |= kind::REMOTE;
        } else {
            message.data[..frame.data().len()].copy_from_slice(frame.data());
        }
        message.kind = kind;
        match self.library.write(self.channel, message) {
            0 => Ok(Sent::Taken),
            status if status & !status::HARMLESS != 0 => Err(Fault::Lost(words(status))),
            status if status & (status::CONTROLLER_FULL | status::QUEUE_FULL | status::BUS_OFF) != 0 => {
                self.note(status);
                Ok(Sent::Full)
            }
            _ => Ok(Sent::Taken),
        }
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Frame>, Fault> {
        let (status, message) = self.library.read(self.channel);
        if status & !status::HARMLESS != 0 {
            return Err(Fault::Lost(words(status)));
        }
        if status & status::BUS != 0 {
            self.note(status);
        }
        self.health.loses(status & (status::OVERRUN | status::QUEUE_OVERRUN) != 0);
        if status & status::EMPTY != 0 {
            thread::sleep(wait.min(PAUSE));
            return Ok(None);
        }
        if message.kind & kind::ERROR != 0 {
            self.error_frame(&message);
            return Ok(None);
        }
        if message.kind & (kind::STATUS | kind::ECHO | kind::FD) != 0 {
            return Ok(None);
        }
        frame_in(&message).map(Some)
    }

    fn health(&mut self) -> Health {
        let status = self.library.status(self.channel);
        if status & !status::HARMLESS == 0 {
            self.note(status);
        }
        self.health
    }

    fn close(&mut self) {
        let _ = self.library.uninitialize(self.channel);
    }
}

/// The frame in a message.
fn frame_in(message: &Message) -> Result<Frame, Fault> {
    let frame = frame_of(
        message.id.into(),
        message.kind & kind::EXTENDED != 0,
        message.kind & kind::REMOTE != 0,
        message.len.into(),
        &message.data,
    );
    frame.map_err(|what| Fault::Nonsense(format!("its library reports {what}")))
}

/// The message for the error in a status.
fn words(status: u32) -> String {
    let why = match status & !status::HARMLESS {
        0x100 => "the test of its controller failed: no hardware is connected (PCAN_ERROR_REGTEST)",
        0x200 => "its driver is not loaded (PCAN_ERROR_NODRIVER)",
        0x400 => "another program uses it (PCAN_ERROR_HWINUSE)",
        0x800 => "another program uses its net (PCAN_ERROR_NETINUSE)",
        0x1400 => "it does not exist (PCAN_ERROR_ILLHW)",
        0x1800 | 0x1C00 => "its handle is no longer valid (PCAN_ERROR_ILLHANDLE)",
        0x2000 => "the driver is out of resources (PCAN_ERROR_RESOURCE)",
        0x400_0000 => "it is no longer initialised (PCAN_ERROR_INITIALIZE)",
        _ => "its library reports an error",
    };
    format!("{why}, status {status:X}h")
}

/// The kind of the error in a status, and the advice.
fn advice(status: u32) -> (Obstacle, &'static str) {
    match status & !status::HARMLESS {
        0x100 | 0x1400 => (Obstacle::Absent, ABSENT),
        0x200 => (Obstacle::Other, FROM),
        0x400 | 0x800 => (Obstacle::InUse, "close the other program (PCAN-View, for example), and try again"),
        _ => (Obstacle::Other, "unplug the adapter, plug it in and try again"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values of PCANBasic.h.
    #[test]
    fn an_adapter_in_use_and_one_that_is_not_there_are_told_apart() {
        for (status, obstacle) in [
            (0x100, Obstacle::Absent),
            (0x1400, Obstacle::Absent),
            (0x400, Obstacle::InUse),
            (0x800 | status::BUS_LIGHT, Obstacle::InUse),
            (0x200, Obstacle::Other),
            (0x1800, Obstacle::Other),
        ] {
            assert_eq!(advice(status).0, obstacle, "{status:X}h");
        }
    }

    /// Values of PCANBasic.h.
    #[test]
    fn channels_and_bit_rates_are_those_of_the_header() {
        for (name, value) in [
            ("PCAN_USBBUS1", Some(0x51)),
            ("PCAN_USBBUS8", Some(0x58)),
            ("PCAN_USBBUS9", Some(0x509)),
            ("pcan_usbbus16", Some(0x510)),
            ("USBBUS2", Some(0x52)),
            ("PCAN_PCIBUS8", Some(0x48)),
            ("PCAN_PCIBUS9", Some(0x409)),
            ("PCAN_LANBUS16", Some(0x810)),
            ("PCAN_PCCBUS2", Some(0x62)),
            ("PCAN_USBBUS0", None),
            ("PCAN_USBBUS17", None),
            ("PCAN_PCCBUS3", None),
            ("USB1", None),
            ("", None),
        ] {
            assert_eq!(channel(name), value, "{name}");
        }
        assert_eq!(
            (registers(500_000), registers(125_000), registers(83_333)),
            (Some(0x001C), Some(0x031C), None)
        );
    }

    #[test]
    fn a_message_that_is_no_frame_is_nonsense_and_named() {
        let message = |id, kind, len| Message { id, kind, len, data: [1, 2, 3, 4, 5, 6, 7, 8] };
        let frame = frame_in(&message(0x585, 0, 2)).unwrap();
        assert_eq!((frame.to_string(), frame.data()), ("585#0102".to_string(), &[1, 2][..]));
        assert!(frame_in(&message(0x1FFF_FFFF, kind::EXTENDED, 8)).is_ok());
        assert_eq!(frame_in(&message(0x585, kind::REMOTE, 9)).unwrap().to_string(), "585#R8");
        for (message, words) in [
            (message(0x585, 0, 16), "of 16 bytes"),
            (message(0x585, kind::REMOTE, 200), "of 200 bytes"),
            (message(0x800, 0, 0), "with identifier 800h"),
            (message(0xFFFF_FFFF, kind::EXTENDED, 0), "with identifier FFFFFFFFh"),
        ] {
            match frame_in(&message) {
                Err(Fault::Nonsense(said)) => assert!(said.contains(words), "{said}"),
                other => panic!("{other:?}"),
            }
        }
    }
}
