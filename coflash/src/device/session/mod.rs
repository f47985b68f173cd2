//! A conversation with one node: SDO reads and writes, commands and their results, over any
//! [`Adapter`] or [`Gateway`].

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use canopen::program::{self, FlashStatus, ProgramControl};
use canopen::{AbortCode, Address, Frame, NodeId};

use super::device_type::DeviceType;
use super::doing::Doing;
use super::error::Error;
use super::timing::{Timing, Transfers};
use crate::bus::adapter::Adapter;
use crate::bus::gateway::Gateway;
use crate::bus::{Health, Link};

mod attention;
mod listen;
mod remote;
mod together;
mod transfer;
mod watch;

use self::watch::Watch;
pub use self::watch::{Silence, SILENCE};

/// The most bytes of any read: more than the flash of any microcontroller.
pub const UPLOAD_MAX: usize = 64 * 1024 * 1024;

/// The access to the node.
enum Way<'a> {
    /// By frames: this session has the SDO client.
    Bus(&'a mut dyn Adapter),
    /// By objects: the gateway has the SDO client.
    Gateway(&'a mut dyn Gateway),
}

/// A conversation with one node.
pub struct Session<'a> {
    way: Way<'a>,
    node: NodeId,
    timing: Timing,
    transfers: Transfers,
    sharing: u32,
    cancelled: Option<Arc<AtomicBool>>,
    answer: Option<fn(&Frame) -> Option<Frame>>,
    watch: Arc<Mutex<Watch>>,
    on_silence: Option<&'a dyn Fn(Silence)>,
}

impl fmt::Debug for Session<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Session")
            .field("node", &self.node)
            .field("timing", &self.timing)
            .finish_non_exhaustive()
    }
}

impl<'a> Session<'a> {
    /// A conversation with `node`. It sends nothing yet.
    pub fn new(adapter: &'a mut dyn Adapter, node: NodeId, timing: Timing) -> Self {
        Self::over(Way::Bus(adapter), node, timing)
    }

    /// A conversation with a node behind a gateway.
    pub fn through(gateway: &'a mut dyn Gateway, node: NodeId, timing: Timing) -> Self {
        Self::over(Way::Gateway(gateway), node, timing)
    }

    /// A conversation over the target of a URL.
    pub fn on(link: &'a mut Link, node: NodeId, timing: Timing) -> Self {
        match link {
            Link::Bus(adapter) => Self::new(&mut **adapter, node, timing),
            Link::Gateway(gateway) => Self::through(&mut **gateway, node, timing),
        }
    }

    fn over(way: Way<'a>, node: NodeId, timing: Timing) -> Self {
        Self {
            way,
            node,
            timing,
            transfers: Transfers::default(),
            sharing: 1,
            cancelled: None,
            answer: None,
            watch: Arc::default(),
            on_silence: None,
        }
    }

    /// The same conversation with another node or with other time limits, as long as the result
    /// lives.
    #[must_use]
    pub fn with(&mut self, node: NodeId, timing: Timing) -> Session<'_> {
        let (transfers, cancelled, answer) = (self.transfers, self.cancelled.clone(), self.answer);
        let way = match &mut self.way {
            Way::Bus(adapter) => Way::Bus(&mut **adapter),
            Way::Gateway(gateway) => Way::Gateway(&mut **gateway),
        };
        let (watch, on_silence, sharing) = (self.watch.clone(), self.on_silence, self.sharing);
        Session { way, node, timing, transfers, sharing, cancelled, answer, watch, on_silence }
    }

    /// Says that so many sessions share the bus: a long value may have to wait for those of all
    /// others, so its SDO time-out is multiplied by this.
    pub(crate) fn share_with(&mut self, sessions: u32) {
        self.sharing = sessions.max(1);
    }

    /// Continues with another node.
    pub fn talk_to(&mut self, node: NodeId) {
        self.node = node;
    }

    /// Ends with [`Error::Cancelled`] when `flag` is set: a running transfer is aborted.
    pub fn cancel_by(&mut self, flag: Arc<AtomicBool>) {
        self.cancelled = Some(flag);
    }

    /// Ignores the cancellation, for a last request.
    pub(crate) fn cancel_by_nobody(&mut self) {
        self.cancelled = None;
    }

    /// Answers frames that arrive during any other action: the session sends the frame that
    /// `answer` returns.
    pub fn answer_by(&mut self, answer: Option<fn(&Frame) -> Option<Frame>>) {
        self.answer = answer;
    }

    /// Sets the form of downloads from now on.
    pub fn transfer_by(&mut self, transfers: Transfers) {
        self.transfers = transfers;
    }

    /// The present form of downloads.
    #[must_use]
    pub fn transfers(&self) -> Transfers {
        self.transfers
    }

    /// The node.
    #[must_use]
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// The time limits.
    #[must_use]
    pub fn timing(&self) -> &Timing {
        &self.timing
    }

    /// The time on the bus.
    #[must_use]
    pub fn now(&self) -> Duration {
        match &self.way {
            Way::Bus(adapter) => adapter.now(),
            Way::Gateway(gateway) => gateway.now(),
        }
    }

    /// Whether the session receives the frames of other nodes. Behind a gateway it does not.
    #[must_use]
    pub fn hears_the_bus(&self) -> bool {
        matches!(self.way, Way::Bus(_))
    }

    /// What the adapter knows about its bus apart from the frames.
    pub fn health(&mut self) -> Option<Health> {
        match &mut self.way {
            Way::Bus(adapter) => adapter.health(),
            Way::Gateway(_) => None,
        }
    }

    /// Reads a value of up to 4096 bytes. A read without an answer is repeated.
    ///
    /// # Errors
    /// [`Error::NoAnswer`], [`Error::Refused`], [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn read(&mut self, at: Address) -> Result<Vec<u8>, Error> {
        let attempts = self.timing.attempts.max(1);
        let mut attempt = 1;
        loop {
            match self.read_once(at) {
                // A late answer to an earlier request can spoil the next one: repeat the read in
                // this case, too.
                Err(Error::NoAnswer { .. } | Error::Protocol { .. }) if attempt < attempts => attempt += 1,
                result => return result,
            }
        }
    }

    /// Reads an unsigned number of up to 32 bits.
    ///
    /// # Errors
    /// As [`read`](Self::read), and [`Error::Protocol`] for a value of another length.
    pub fn read_number(&mut self, at: Address) -> Result<u32, Error> {
        let bytes = self.read(at)?;
        number(&bytes).ok_or(Error::Protocol { doing: Doing::Read(at), code: AbortCode::LENGTH })
    }

    /// Reads a text. Characters outside ASCII and control characters are replaced.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn read_text(&mut self, at: Address) -> Result<String, Error> {
        let bytes = self.read(at)?;
        let text = bytes.split(|byte| *byte == 0).next().unwrap_or_default();
        let visible = |byte: &u8| if matches!(byte, b' '..=b'~') { char::from(*byte) } else { '?' };
        Ok(text.iter().map(visible).collect())
    }

    /// Writes a command to 1F51h of a program, once; [`status`](Self::status) gives its result.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn command(&mut self, number: u8, command: ProgramControl) -> Result<(), Error> {
        let at = Address::new(program::PROGRAM_CONTROL, number);
        self.write(at, &[command as u8], Doing::Command(command), &mut |_| {})
    }

    /// Reads 1F57h of a program.
    ///
    /// # Errors
    /// As [`read_number`](Self::read_number).
    pub fn status(&mut self, number: u8) -> Result<FlashStatus, Error> {
        self.read_number(Address::new(program::FLASH_STATUS, number)).map(FlashStatus::from_word)
    }

    /// Waits until 1F57h of a program is no longer busy, and returns its value. For a while,
    /// silence counts as busy: a device may be unable to answer while it erases.
    ///
    /// # Errors
    /// [`Error::Busy`] after [`Timing::command`], [`Error::NoAnswer`] after [`Timing::silent`]
    /// without any answer, and the errors of [`read`](Self::read).
    pub fn await_idle(&mut self, number: u8, doing: Doing) -> Result<FlashStatus, Error> {
        let began = self.now();
        let at = Address::new(program::FLASH_STATUS, number);
        let mut pause = self.timing.poll_first;
        loop {
            match self.read_once(at) {
                Ok(bytes) => {
                    let word = self::number(&bytes)
                        .ok_or(Error::Protocol { doing: Doing::Read(at), code: AbortCode::LENGTH })?;
                    let status = FlashStatus::from_word(word);
                    if !status.busy {
                        return Ok(status);
                    }
                }
                Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => {}
                Err(error) => return Err(error),
            }
            if self.silent_since(began) >= self.timing.silent {
                return Err(Error::NoAnswer { node: self.node, doing });
            }
            self.note_silence(began, self.timing.silent, doing);
            let waited = self.now().saturating_sub(began);
            if waited >= self.timing.command {
                return Err(Error::Busy { node: self.node, doing, waited });
            }
            self.wait(pause)?;
            pause = (pause * 2).min(self.timing.poll_most);
        }
    }

    /// Reads 1000h once; `None` if no answer comes.
    ///
    /// # Errors
    /// The errors of [`read`](Self::read) except [`Error::NoAnswer`].
    pub fn device_type(&mut self) -> Result<Option<DeviceType>, Error> {
        let at = Address::new(program::DEVICE_TYPE, 0);
        match self.read_once(at) {
            Ok(bytes) => {
                let value = number(&bytes);
                let value =
                    value.ok_or(Error::Protocol { doing: Doing::Read(at), code: AbortCode::LENGTH })?;
                Ok(Some(DeviceType(value)))
            }
            Err(Error::NoAnswer { .. } | Error::Protocol { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Returns what runs on the device. A device that was just reset misses a few requests, so the
    /// request is repeated for as long as a restart may take.
    ///
    /// # Errors
    /// [`Error::NoAnswer`], and the errors of a [read](Self::read).
    pub fn find(&mut self) -> Result<DeviceType, Error> {
        let began = self.now();
        let doing = Doing::Read(Address::new(program::DEVICE_TYPE, 0));
        loop {
            if let Some(running) = self.device_type()? {
                return Ok(running);
            }
            if self.now() >= began + self.timing.boot {
                return Err(Error::NoAnswer { node: self.node, doing });
            }
            self.note_silence(began, self.timing.boot, doing);
            let pause = self.timing.poll_first;
            self.await_boot_up(pause)?;
        }
    }

    fn check_cancelled(&self) -> Result<(), Error> {
        match &self.cancelled {
            Some(flag) if flag.load(Ordering::Relaxed) => Err(Error::Cancelled),
            _ => Ok(()),
        }
    }
}

/// A little-endian number of one to four bytes.
fn number(bytes: &[u8]) -> Option<u32> {
    if !(1..=4).contains(&bytes.len()) {
        return None;
    }
    Some(bytes.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte)))
}
