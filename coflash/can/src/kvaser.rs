//! Kvaser adapters with CANlib: `kvaser:0@500k`, with CANlib's channel number.
//!
//! Names and values are those of `canlib.h` and `canstat.h` (CANlib 5). Tested against a stand-in
//! for the library, not on hardware.

use std::time::Duration;

use canopen::Frame;
use embedded_can::{Frame as _, Id};
use vendor_can::canlib::{Canlib, Message};

use super::adapter::{AdapterError, Obstacle, ABSENT};
use super::digits::decimal;
use super::driven::{frame_of, Driven, Driver, Fault, Sent};
use super::found::{shown, Found, Kind, Missing};
use super::health::{Controller, Health};

/// Where to get the library.
const FROM: &str =
    "install the adapter's driver and CANlib from www.kvaser.com (Windows and Linux; there is none for \
                    macOS); on Linux the kernel's own driver needs no library: socketcan:can0";

/// Checks a channel's number and a bit rate.
pub(super) fn check(channel: &str, rate: Option<u32>) -> Result<(), &'static str> {
    number(channel)?;
    if rate.is_some_and(|rate| parameters(rate).is_none()) {
        return Err("Kvaser adapters support 1M, 800k, 500k, 250k, 125k, 100k, 50k and 20k");
    }
    Ok(())
}

/// A channel by its number.
fn number(channel: &str) -> Result<u16, &'static str> {
    decimal(channel).ok_or("it names no channel of CANlib by its number: kvaser:0@500k")
}

/// The arguments of `canSetBusParams` for each bit rate: one of the constants `canBITRATE_…`, or
/// the rate itself with its segments (16 quanta sampled at 87.5 %, 10 at 80 %).
const BIT_RATES: [(u32, i32, (u32, u32)); 8] = [
    (1_000_000, -1, (0, 0)),
    (800_000, 800_000, (7, 2)),
    (500_000, -2, (0, 0)),
    (250_000, -3, (0, 0)),
    (125_000, -4, (0, 0)),
    (100_000, -5, (0, 0)),
    (50_000, -7, (0, 0)),
    (20_000, 20_000, (13, 2)),
];

/// `canStatus` of functions that find no message, and of functions without room.
const NO_MESSAGE: i32 = -2;
const NO_ROOM: i32 = -13;
/// `canStatus` of a channel that another program uses.
const NO_CHANNELS: i32 = -5;
const NO_ACCESS: i32 = -31;
/// `canOPEN_ACCEPT_VIRTUAL`: virtual channels are accepted, too.
const ACCEPT_VIRTUAL: i32 = 0x20;
/// `canCHANNELDATA_DEVDESCR_ASCII`.
const DESCRIPTION: i32 = 26;
/// More channels than any computer has.
const MOST_CHANNELS: i32 = 64;

/// `canMSG_…` and `canMSGERR_…`.
mod flag {
    pub const REMOTE: u32 = 0x1;
    pub const STANDARD: u32 = 0x2;
    pub const EXTENDED: u32 = 0x4;
    pub const ERROR: u32 = 0x20;
    pub const SENT: u32 = 0xC0;
    /// The hardware's or the driver's queue was full.
    pub const OVERRUN: u32 = 0x600;
    pub const FD: u32 = 0x1_0000;
    /// Stuff, form, CRC and bit errors.
    pub const DISTURBED: u32 = 0xF800;
}

/// The arguments of `canSetBusParams` for a bit rate in bit/s.
fn parameters(rate: u32) -> Option<(i32, (u32, u32))> {
    BIT_RATES.iter().find_map(|(known, given, segments)| (*known == rate).then_some((*given, *segments)))
}

/// Opens a channel at a bit rate in bit/s.
pub(super) fn open(channel: &str, rate: u32) -> Result<Driven, AdapterError> {
    let channel = number(channel).map_err(|what| {
        AdapterError::unusable("Kvaser adapter", Obstacle::Other, what, "choose another one")
    })?;
    let name = format!("Kvaser channel {channel}");
    let adapter = name.clone();
    let unusable = move |what, (obstacle, advice): (Obstacle, &str)| {
        AdapterError::unusable(adapter, obstacle, what, advice)
    };
    let Some((given, segments)) = parameters(rate) else {
        let advice = (Obstacle::Other, "choose one from 20k to 1M");
        return Err(unusable(format!("it does not support {rate} bit/s"), advice));
    };
    Driven::open(name, move || {
        let library =
            Canlib::load().map_err(|error| AdapterError::library("Kvaser adapter", &error, FROM))?;
        let handle = library.open(channel.into(), ACCEPT_VIRTUAL);
        if handle < 0 {
            return Err(unusable(words(handle), advice(handle)));
        }
        let opened = Kvaser { library, handle, health: Health { bit_rate: Some(rate), ..Health::default() } };
        let jump_width = u32::from(segments.0 != 0);
        let status = opened.library.bus_parameters(handle, given, segments, jump_width);
        let status = if status < 0 { status } else { opened.library.bus_on(handle) };
        if status < 0 {
            opened.library.close(handle);
            return Err(unusable(words(status), advice(status)));
        }
        Ok(opened)
    })
}

/// The connected channels, or the reason why the library cannot list them.
pub(super) fn list() -> Result<Vec<Found>, Missing> {
    let library = Canlib::load().map_err(|error| Missing { what: error.to_string(), advice: FROM })?;
    let (status, count) = library.channels();
    if status < 0 || !(0..=MOST_CHANNELS).contains(&count) {
        let what = format!("CANlib reports {count} channels, status {status}");
        return Err(Missing { what, advice: FROM });
    }
    let found = (0..count).map(|channel| {
        let (status, text) = library.text(channel, DESCRIPTION);
        let about = if status < 0 { String::new() } else { shown(&text) };
        Found::new(Kind::Kvaser, format!("kvaser:{channel}"), about)
    });
    Ok(found.collect())
}

struct Kvaser {
    library: Canlib,
    handle: i32,
    health: Health,
}

impl Driver for Kvaser {
    fn send(&mut self, frame: &Frame) -> Result<Sent, Fault> {
        let (id, mut flags) = match frame.id() {
            Id::Standard(id) => (id.as_raw().into(), flag::STANDARD),
            Id::Extended(id) => (id.as_raw(), flag::EXTENDED),
        };
        let data = if frame.is_remote_frame() {
            flags |= flag::REMOTE;
            &[]
        } else {
            frame.data()
        };
        match self.library.write(self.handle, id, data, frame.dlc() as u32, flags) {
            NO_ROOM => Ok(Sent::Full),
            status if status < 0 => Err(Fault::Lost(words(status))),
            _ => Ok(Sent::Taken),
        }
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Frame>, Fault> {
        let wait = u32::try_from(wait.as_millis()).unwrap_or(1).clamp(1, 1000);
        let (status, message) = self.library.read_wait(self.handle, wait);
        if status == NO_MESSAGE {
            return Ok(None);
        }
        if status < 0 {
            return Err(Fault::Lost(words(status)));
        }
        self.health.loses(message.flags & flag::OVERRUN != 0);
        if message.flags & flag::ERROR != 0 {
            if message.flags & flag::DISTURBED != 0 {
                self.health.disturbed = self.health.disturbed.saturating_add(1);
            }
            return Ok(None);
        }
        if message.flags & (flag::SENT | flag::FD) != 0 {
            return Ok(None);
        }
        frame_in(&message).map(Some)
    }

    fn health(&mut self) -> Health {
        let (status, flags) = self.library.status(self.handle);
        if status >= 0 {
            // canSTAT_…
            self.health.controller = match flags {
                flags if flags & 0x2 != 0 => Some(Controller::Off),
                flags if flags & 0x1 != 0 => Some(Controller::Passive),
                flags if flags & 0x4 != 0 => Some(Controller::Warning),
                flags if flags & 0x8 != 0 => Some(Controller::Active),
                _ => None,
            };
        }
        let (status, send, receive) = self.library.counters(self.handle);
        if status >= 0 {
            let byte = |count: u32| u8::try_from(count).unwrap_or(u8::MAX);
            self.health.counters = Some((byte(send), byte(receive)));
        }
        self.health
    }

    fn close(&mut self) {
        let _ = self.library.bus_off(self.handle);
        let _ = self.library.close(self.handle);
    }
}

/// The frame in a message.
fn frame_in(message: &Message) -> Result<Frame, Fault> {
    let frame = frame_of(
        message.id,
        message.flags & flag::EXTENDED != 0,
        message.flags & flag::REMOTE != 0,
        message.len,
        &message.data,
    );
    frame.map_err(|what| Fault::Nonsense(format!("CANlib reports {what}")))
}

/// The message for a `canStatus`.
fn words(status: i32) -> String {
    let why = match status {
        -3 => "it does not exist (canERR_NOTFOUND)",
        NO_CHANNELS => "no channel is free (canERR_NOCHANNELS)",
        -10 => "its handle is no longer valid (canERR_INVHANDLE)",
        -15 => "its hardware has failed, or was unplugged (canERR_HARDWARE)",
        -23 | -24 => "its driver does not load (canERR_DRIVERLOAD)",
        -26 => "no adapter is connected (canERR_NOCARD)",
        NO_ACCESS => "another program uses it (canERR_NO_ACCESS)",
        _ => "CANlib reports an error",
    };
    format!("{why}, status {status}")
}

/// The kind of error of a `canStatus`, and the advice.
fn advice(status: i32) -> (Obstacle, &'static str) {
    match status {
        -3 | -26 => (Obstacle::Absent, ABSENT),
        NO_CHANNELS | NO_ACCESS => {
            (Obstacle::InUse, "close the other program (CanKing, for example), and try again")
        }
        -23 | -24 => (Obstacle::Other, FROM),
        _ => (Obstacle::Other, "unplug the adapter, plug it in and try again"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values of canstat.h.
    #[test]
    fn a_channel_in_use_and_one_that_is_not_there_are_told_apart() {
        for (status, obstacle) in [
            (-3, Obstacle::Absent),
            (-26, Obstacle::Absent),
            (-5, Obstacle::InUse),
            (-31, Obstacle::InUse),
            (-23, Obstacle::Other),
            (-15, Obstacle::Other),
        ] {
            assert_eq!(advice(status).0, obstacle, "{status}");
        }
    }

    /// What is a frame, `peak.rs` tests: the function is the same.
    #[test]
    fn a_message_is_the_frame_of_its_flags() {
        let of = |id, flags, len| frame_in(&Message { id, flags, len, data: [1; 8] });
        assert_eq!(of(0x585, flag::STANDARD, 15).unwrap().to_string(), "585#0101010101010101");
        assert_eq!(of(0x585, flag::EXTENDED | flag::REMOTE, 2).unwrap().to_string(), "00000585#R2");
        assert!(matches!(of(-1, flag::STANDARD, 0), Err(Fault::Nonsense(_))));
    }

    /// Values of canstat.h: for example, canBITRATE_1M is -1.
    #[test]
    fn bit_rates_are_those_of_the_header() {
        assert_eq!(parameters(1_000_000), Some((-1, (0, 0))));
        assert_eq!(parameters(125_000), Some((-4, (0, 0))));
        assert_eq!(parameters(50_000), Some((-7, (0, 0))));
        assert_eq!(parameters(20_000), Some((20_000, (13, 2))));
        assert_eq!(parameters(10), None);
    }
}
