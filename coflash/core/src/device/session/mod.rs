//! A conversation with one node: SDO reads and writes, commands and their results, over any
//! [`Adapter`] or [`Gateway`].

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use canopen::program::{self, FlashStatus, ProgramControl};
use canopen::{Address, Frame, NodeId};

use super::device_type::DeviceType;
use super::doing::Doing;
use super::error::Error;
use super::timing::{Timing, Transfers};
use coboot_can::adapter::Adapter;
use coboot_can::gateway::Gateway;
use coboot_can::{Health, Link, Losses};

mod attention;
mod listen;
mod remote;
mod together;
mod transfer;
mod watch;

pub(super) use self::watch::ensure_bus_alone;
use self::watch::Watch;
pub use self::watch::{Silence, SILENCE};

/// The most bytes of any read: more than the flash of any microcontroller.
pub const UPLOAD_MAX: usize = 64 * 1024 * 1024;

/// The access to the node.
enum Access<'a> {
    /// By frames: this session has the SDO client.
    Bus(&'a mut dyn Adapter),
    /// By objects: the gateway has the SDO client.
    Gateway(&'a mut dyn Gateway),
}

/// A conversation with one node.
pub struct Session<'a> {
    access: Access<'a>,
    node: NodeId,
    timing: Timing,
    transfers: Transfers,
    /// Whether the node has taken a sub-block of a block transfer.
    takes_blocks: bool,
    /// Whether the node has refused to be read by block transfer.
    lacks_block_upload: bool,
    sharing: u32,
    cancelled: Option<Arc<AtomicBool>>,
    answer: Option<fn(&Frame) -> Option<Frame>>,
    watch: Arc<Mutex<Watch>>,
    /// How long the computer has slept, in milliseconds.
    slept: Arc<AtomicU64>,
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
        Self::over(Access::Bus(adapter), node, timing)
    }

    /// A conversation with a node behind a gateway.
    pub fn through(gateway: &'a mut dyn Gateway, node: NodeId, timing: Timing) -> Self {
        Self::over(Access::Gateway(gateway), node, timing)
    }

    /// A conversation over the target of a URL.
    pub fn on(link: &'a mut Link, node: NodeId, timing: Timing) -> Self {
        match link {
            Link::Bus(adapter) => Self::new(&mut **adapter, node, timing),
            Link::Gateway(gateway) => Self::through(&mut **gateway, node, timing),
        }
    }

    fn over(access: Access<'a>, node: NodeId, timing: Timing) -> Self {
        Self {
            access,
            node,
            timing,
            transfers: Transfers::default(),
            takes_blocks: false,
            lacks_block_upload: false,
            sharing: 1,
            cancelled: None,
            answer: None,
            watch: Arc::default(),
            slept: Arc::default(),
            on_silence: None,
        }
    }

    /// The same conversation with another node or with other time limits, as long as the result
    /// lives.
    #[must_use]
    pub fn with(&mut self, node: NodeId, timing: Timing) -> Session<'_> {
        let (transfers, cancelled, answer) = (self.transfers, self.cancelled.clone(), self.answer);
        let access = match &mut self.access {
            Access::Bus(adapter) => Access::Bus(&mut **adapter),
            Access::Gateway(gateway) => Access::Gateway(&mut **gateway),
        };
        let (watch, slept) = (self.watch.clone(), self.slept.clone());
        let (on_silence, sharing) = (self.on_silence, self.sharing);
        let takes_blocks = self.takes_blocks;
        let lacks_block_upload = self.lacks_block_upload && node == self.node;
        Session {
            access,
            node,
            timing,
            transfers,
            takes_blocks,
            lacks_block_upload,
            sharing,
            cancelled,
            answer,
            watch,
            slept,
            on_silence,
        }
    }

    /// Says that so many sessions share the bus: a long value may have to wait for those of all
    /// others, so its SDO time-out is multiplied by this.
    pub(crate) fn share_with(&mut self, sessions: u32) {
        self.sharing = sessions.max(1);
    }

    /// Continues with another node.
    pub fn talk_to(&mut self, node: NodeId) {
        self.lacks_block_upload &= node == self.node;
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

    /// Whether the node has taken a part of a value by block transfer in this conversation: the
    /// failure of such a transfer does not mean that it cannot do them.
    pub(crate) fn takes_blocks(&self) -> bool {
        self.takes_blocks
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

    /// The time on the bus, without the time for which the computer slept.
    #[must_use]
    pub fn now(&self) -> Duration {
        let now = match &self.access {
            Access::Bus(adapter) => adapter.now(),
            Access::Gateway(gateway) => gateway.now(),
        };
        now.saturating_sub(Duration::from_millis(self.slept.load(Ordering::Relaxed)))
    }

    /// Whether the session receives the frames of other nodes. Behind a gateway it does not.
    #[must_use]
    pub fn hears_the_bus(&self) -> bool {
        matches!(self.access, Access::Bus(_))
    }

    /// What the adapter knows about its bus apart from the frames.
    pub fn health(&mut self) -> Option<Health> {
        match &mut self.access {
            Access::Bus(adapter) => adapter.health(),
            Access::Gateway(_) => None,
        }
    }

    /// What did not go through the adapter so far.
    #[must_use]
    pub fn losses(&self) -> Losses {
        match &self.access {
            Access::Bus(adapter) => adapter.losses(),
            Access::Gateway(_) => Losses::default(),
        }
    }

    /// Reads a value of up to 4096 bytes. A read without an answer is repeated.
    ///
    /// # Errors
    /// [`Error::NoAnswer`], [`Error::ShortAnswer`], [`Error::Refused`], [`Error::Protocol`],
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn read(&mut self, at: Address) -> Result<Vec<u8>, Error> {
        self.repeated(&mut |session| session.read_once(at))
    }

    /// Reads an unsigned number of up to 32 bits.
    ///
    /// # Errors
    /// As [`read`](Self::read), and [`Error::Protocol`] for a value of another length.
    pub fn read_number(&mut self, at: Address) -> Result<u32, Error> {
        let bytes = self.read(at)?;
        number(&bytes).ok_or(Error::wrong_length(at))
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
                    let word = self::number(&bytes).ok_or(Error::wrong_length(at))?;
                    let status = FlashStatus::from_word(word);
                    if !status.busy {
                        return Ok(status);
                    }
                }
                Err(Error::NoAnswer { .. } | Error::ShortAnswer { .. } | Error::Protocol { .. }) => {}
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

    /// Reads 1000h once; `None` if no valid answer comes.
    ///
    /// # Errors
    /// The errors of [`read`](Self::read) except [`Error::NoAnswer`], [`Error::ShortAnswer`] and
    /// [`Error::Protocol`].
    pub fn device_type(&mut self) -> Result<Option<DeviceType>, Error> {
        match self.device_type_once() {
            Ok(running) => Ok(Some(running)),
            Err(Error::NoAnswer { .. } | Error::ShortAnswer { .. } | Error::Protocol { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn device_type_once(&mut self) -> Result<DeviceType, Error> {
        let at = Address::new(program::DEVICE_TYPE, 0);
        let bytes = self.read_once(at)?;
        number(&bytes).map(DeviceType).ok_or(Error::wrong_length(at))
    }

    /// Returns what runs on the device. A device that was just reset misses a few requests, so the
    /// request is repeated for as long as a restart may take. A device whose answers are invalid
    /// gets as many attempts as any request.
    ///
    /// # Errors
    /// [`Error::NoAnswer`], and the errors of a [read](Self::read).
    pub fn find(&mut self) -> Result<DeviceType, Error> {
        let began = self.now();
        let doing = Doing::Read(Address::new(program::DEVICE_TYPE, 0));
        let mut invalid = 0;
        loop {
            let error = match self.device_type_once() {
                Ok(running) => return Ok(running),
                Err(error @ (Error::ShortAnswer { .. } | Error::Protocol { .. })) => {
                    invalid += 1;
                    error
                }
                Err(error @ Error::NoAnswer { .. }) => error,
                Err(error) => return Err(error),
            };
            if self.now() >= began + self.timing.boot || invalid >= self.timing.attempts.max(1) {
                return Err(error);
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
