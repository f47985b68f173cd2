//! Writes to the devices of a group: one download for all of them, by their second SDO servers
//! (1201h; CiA 301 clause 7.5.2.33).

use canopen::program::SECOND_SERVER;
use canopen::sdo::second::{INVALID, REQUEST, RESPONSE};
use canopen::{Address, CobId};

use super::{Access, Session};
use crate::device::doing::Doing;
use crate::device::error::Error;
use coboot_can::adapter::{Delivery, Group};

impl Session<'_> {
    fn group(&mut self) -> Option<&mut dyn Group> {
        match &mut self.access {
            Access::Bus(adapter) => adapter.group(),
            Access::Gateway(_) => None,
        }
    }

    /// Gives the device's second SDO server the COB-IDs of the group; returns whether the device
    /// is now in the group. A device without such a server leaves the group.
    ///
    /// # Errors
    /// As [`write`](Session::write), except a refusal.
    pub(crate) fn join_group(&mut self) -> Result<bool, Error> {
        let Some(channel) = self.group().and_then(|group| group.channel()) else { return Ok(false) };
        // COB-IDs can be changed only while they are not valid.
        let off = [(REQUEST, INVALID), (RESPONSE, INVALID)];
        let word = |id: CobId| u32::from(id.get());
        let on = [(RESPONSE, word(channel.response)), (REQUEST, word(channel.request))];
        for (sub, value) in off.into_iter().chain(on) {
            match self.write_second_server(sub, value) {
                Ok(()) => {}
                Err(Error::Refused { .. }) => {
                    self.leave_group();
                    return Ok(false);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(true)
    }

    /// Switches the device's second SDO server off, and leaves the group.
    ///
    /// # Errors
    /// As [`write`](Session::write).
    pub(crate) fn part_from_group(&mut self) -> Result<(), Error> {
        self.leave_group();
        self.write_second_server(REQUEST, INVALID)
    }

    /// Leaves the group, if there is one: it does not wait for this device any more.
    pub(crate) fn leave_group(&mut self) {
        if let Some(group) = self.group() {
            group.leave();
        }
    }

    /// Writes data to all devices of the group that need them, this one among them; see
    /// [`Group::deliver`]. [`Delivery::Alone`] if there is no group.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub(crate) fn write_together(&mut self, turn: u32, at: Address, data: &[u8]) -> Result<Delivery, Error> {
        self.check_cancelled()?;
        match self.group() {
            Some(group) => Ok(group.deliver(turn, at, data)?),
            None => Ok(Delivery::Alone),
        }
    }

    fn write_second_server(&mut self, sub: u8, value: u32) -> Result<(), Error> {
        let at = Address::new(SECOND_SERVER, sub);
        let attempts = self.timing.attempts.max(1);
        let mut attempt = 1;
        loop {
            match self.write(at, &value.to_le_bytes(), Doing::Write(at), &mut |_| {}) {
                Err(Error::NoAnswer { .. } | Error::Protocol { .. }) if attempt < attempts => attempt += 1,
                result => return result,
            }
        }
    }
}
