//! The driver: the order of the transfers over USB.

use std::collections::BTreeSet;
use std::time::Duration;

use canopen::Frame;

use super::wire::{self, request, Constants, Transfer};
use crate::driven::{Driver, Fault, Sent};
use crate::health::Health;

/// The most frames that may be in the device's queue (`GS_MAX_TX_URBS`).
pub(super) const MOST_UNDER_WAY: usize = 10;

/// The USB functions that the protocol needs.
pub(super) trait Usb {
    /// A vendor request to the interface that reads at most `len` bytes.
    fn read_control(&mut self, request: u8, value: u16, len: u16) -> Result<Vec<u8>, String>;
    /// A vendor request to the interface that writes.
    fn write_control(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), String>;
    /// Puts a transfer into the queue of the bulk endpoint. Does not wait; returns `false` if there
    /// is no room.
    fn write(&mut self, data: &[u8]) -> Result<bool, String>;
    /// Returns the next transfer of the bulk endpoint. Waits for at most `wait`.
    fn read(&mut self, wait: Duration) -> Result<Option<Vec<u8>>, String>;
}

/// A channel of a device. `U` is the access to USB.
pub(super) struct GsUsb<U> {
    usb: U,
    channel: u8,
    /// Echoes that the device has not sent yet.
    under_way: BTreeSet<u32>,
    health: Health,
}

impl<U: Usb> GsUsb<U> {
    /// Reads the device's abilities and switches the channel on.
    pub(super) fn start(mut usb: U, channel: u8, rate: u32) -> Result<Self, String> {
        usb.write_control(request::HOST_FORMAT, 1, &wire::LITTLE_ENDIAN)?;
        let config = usb.read_control(request::DEVICE_CONFIG, 1, wire::DEVICE_CONFIG)?;
        let channels = wire::channels(&config).ok_or("it does not report its number of channels")?;
        if channel >= channels {
            return Err(format!("it has {channels} channel(s), counted from 0"));
        }
        let constants = usb.read_control(request::CONSTANTS, channel.into(), wire::CONSTANTS)?;
        let constants = Constants::parse(&constants).ok_or("it does not report its controller's timing")?;
        let timing = constants.timing(rate).ok_or_else(|| {
            format!("its controller's clock of {} Hz cannot produce {rate} bit/s", constants.clock)
        })?;
        // Ends a session that was active before.
        usb.write_control(request::MODE, channel.into(), &wire::RESET)?;
        usb.write_control(request::BIT_TIMING, channel.into(), &timing.emit())?;
        usb.write_control(request::MODE, channel.into(), &wire::START)?;
        let health = Health { bit_rate: Some(rate), ..Health::default() };
        Ok(Self { usb, channel, under_way: BTreeSet::new(), health })
    }
}

impl<U: Usb> Driver for GsUsb<U> {
    fn send(&mut self, frame: &Frame) -> Result<Sent, Fault> {
        let free = (0..MOST_UNDER_WAY as u32).find(|echo| !self.under_way.contains(echo));
        let Some(echo) = free else { return Ok(Sent::Full) };
        if !self.usb.write(&wire::emit(frame, self.channel, echo)).map_err(Fault::Lost)? {
            return Ok(Sent::Full);
        }
        self.under_way.insert(echo);
        Ok(Sent::Taken)
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Frame>, Fault> {
        let Some(bytes) = self.usb.read(wait).map_err(Fault::Lost)? else { return Ok(None) };
        self.health.loses(wire::has_lost(&bytes));
        match wire::parse(&bytes, self.channel).map_err(|what| Fault::Nonsense(format!("it sends {what}")))? {
            Transfer::Frame(frame) => Ok(Some(frame)),
            // Ignore an echo that the device does not owe.
            Transfer::Sent(echo) => {
                self.under_way.remove(&echo);
                Ok(None)
            }
            Transfer::Error(class, data) => {
                self.health.error_frame(class, &data);
                Ok(None)
            }
            Transfer::Other => Ok(None),
        }
    }

    fn health(&mut self) -> Health {
        self.health
    }

    fn close(&mut self) {
        let _ = self.usb.write_control(request::MODE, self.channel.into(), &wire::RESET);
    }
}

#[cfg(test)]
mod tests;
