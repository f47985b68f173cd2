//! A conversation with one node: SDO reads and writes, commands and their outcome, over any
//! [`Adapter`] or [`Gateway`].

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use canopen::nmt::NmtCommand;
use canopen::program::{
    self, FlashStatus, ProgramControl, BOOTLOADER_DEVICE_TYPE, ESACADEMY_DEVICE_TYPE, LIFT_DEVICE_TYPE,
};
use canopen::sdo::client::{Block, Buffer, Config, Sink};
use canopen::sdo::{Download, SdoError, Step, Transfer, Upload};
use canopen::{AbortCode, Address, CobId, Frame, Instant, NodeId};

use crate::adapter::Adapter;
use crate::error::Error;
use crate::gateway::Gateway;

mod remote;

use self::remote::of_gateway;

/// How long to wait for what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// The answer to one SDO request. The manual's default.
    pub sdo: Duration,
    /// How often a read, or a write that may be repeated, is tried when no answer comes.
    pub attempts: u32,
    /// A command's execution (erase, program, check): how long 1F57h may read busy, or the device
    /// be silent.
    pub command: Duration,
    /// A restart: how long a device may take until it answers again.
    pub boot: Duration,
    /// The first pause between two looks at a device that is at work. It doubles from look to look
    /// …
    pub poll_first: Duration,
    /// … up to this one, so that the bus is not flooded.
    pub poll_most: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            sdo: Duration::from_millis(500),
            attempts: 3,
            command: Duration::from_secs(60),
            boot: Duration::from_secs(5),
            poll_first: Duration::from_millis(10),
            poll_most: Duration::from_millis(250),
        }
    }
}

/// What the host was about when something went wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Doing {
    /// Reading an object.
    Read(Address),
    /// Writing an object.
    Write(Address),
    /// Carrying out a command of 1F51h.
    Command(ProgramControl),
    /// Writing a block of the program.
    Block(u32),
    /// Writing the whole program at once.
    Program,
    /// Writing the password of a device that is locked.
    Unlock,
    /// Telling the bootloader to restart into the program.
    Restart,
}

impl fmt::Display for Doing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Read(at) => write!(f, "reading {at}"),
            Self::Write(at) => write!(f, "writing {at}"),
            Self::Block(u32::MAX) => f.write_str("writing the last block"),
            Self::Block(number) => write!(f, "writing block {number}"),
            Self::Program => f.write_str("writing the program"),
            Self::Unlock => f.write_str("unlocking the device"),
            Self::Restart => f.write_str("restarting the program"),
            Self::Command(command) => f.write_str(match command {
                ProgramControl::Stop => "stopping the program",
                ProgramControl::Start => "starting the program",
                ProgramControl::ResetStat => "clearing the status",
                ProgramControl::Clear => "erasing the program",
                ProgramControl::StartBootloader => "calling the bootloader",
                ProgramControl::SetSignature => "setting the signature",
                ProgramControl::ClrSignature => "clearing the signature",
            }),
        }
    }
}

/// The largest value that is read as a whole. No object of a bootloader comes near it.
const VALUE_MAX: usize = 4096;
/// The most bytes that are read at all: more than any microcontroller's flash has.
pub const UPLOAD_MAX: usize = 64 * 1024 * 1024;

/// Grows with what really arrives; what a device merely announces takes no memory.
struct Grown(Vec<u8>);

impl Sink for Grown {
    fn write(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        if self.0.len() + data.len() > UPLOAD_MAX {
            return Err(AbortCode::OUT_OF_MEMORY);
        }
        self.0.extend_from_slice(data);
        Ok(())
    }
}

/// After so long without an abort, no more come for the segments of a transfer that was refused. A
/// frame on the slowest bus takes 13 ms.
const QUIET: Duration = Duration::from_millis(30);
/// After so many frames in a row, a look whether the node has something against them.
const BURST: u32 = 8;
/// The longest wait in one piece: how soon a cancelled session notices.
const SLICE: Duration = Duration::from_millis(100);

/// How values of more than four bytes are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Transfers {
    /// As blocks, the fast way, until the device says that it does not know them; from then on in
    /// segments.
    #[default]
    Blocks,
    /// In segments, which every device knows: one answer for seven bytes.
    Segments,
}

/// Less is not worth the frames around a block transfer.
const WORTH_BLOCKS: usize = 4 * 7;

/// What [`Timing::command`] limits in a transfer. The SDO time-out alone does not end one: it
/// counts from answer to answer, and a device that babbles always has one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Patience {
    /// The transfer.
    InAll,
    /// The time without progress.
    ForEachStep,
}

/// The way to the node.
enum Way<'a> {
    /// Frames: the SDO client is ours.
    Bus(&'a mut dyn Adapter),
    /// Objects: the SDO client is the gateway's.
    Gateway(&'a mut dyn Gateway),
}

/// A conversation with one node.
pub struct Session<'a> {
    way: Way<'a>,
    node: NodeId,
    timing: Timing,
    transfers: Transfers,
    cancelled: Option<Arc<AtomicBool>>,
    answer: Option<fn(&Frame) -> Option<Frame>>,
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
    /// A conversation with `node`. Nothing is sent yet.
    pub fn new(adapter: &'a mut dyn Adapter, node: NodeId, timing: Timing) -> Self {
        Self::over(Way::Bus(adapter), node, timing)
    }

    /// The same with a node behind a gateway.
    pub fn through(gateway: &'a mut dyn Gateway, node: NodeId, timing: Timing) -> Self {
        Self::over(Way::Gateway(gateway), node, timing)
    }

    fn over(way: Way<'a>, node: NodeId, timing: Timing) -> Self {
        Self { way, node, timing, transfers: Transfers::default(), cancelled: None, answer: None }
    }

    /// The same conversation with another node, or with other patience, for a while.
    #[must_use]
    pub fn with(&mut self, node: NodeId, timing: Timing) -> Session<'_> {
        let (transfers, cancelled, answer) = (self.transfers, self.cancelled.clone(), self.answer);
        let way = match &mut self.way {
            Way::Bus(adapter) => Way::Bus(&mut **adapter),
            Way::Gateway(gateway) => Way::Gateway(&mut **gateway),
        };
        Session { way, node, timing, transfers, cancelled, answer }
    }

    /// Goes on with another node.
    pub fn talk_to(&mut self, node: NodeId) {
        self.node = node;
    }

    /// Ends with [`Error::Cancelled`] as soon as `flag` is set: a transfer under way is aborted.
    pub fn cancel_by(&mut self, flag: Arc<AtomicBool>) {
        self.cancelled = Some(flag);
    }

    /// Answers by this to frames that come meanwhile, whatever else is under way: what it gives is
    /// sent.
    pub fn answer_by(&mut self, answer: Option<fn(&Frame) -> Option<Frame>>) {
        self.answer = answer;
    }

    /// Writes this way from now on.
    pub fn transfer_by(&mut self, transfers: Transfers) {
        self.transfers = transfers;
    }

    /// How long values are written at present.
    #[must_use]
    pub fn transfers(&self) -> Transfers {
        self.transfers
    }

    /// The node.
    #[must_use]
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// How long it waits for what.
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

    /// Whether it hears what others say on the bus. Behind a gateway it does not.
    #[must_use]
    pub fn hears_the_bus(&self) -> bool {
        matches!(self.way, Way::Bus(_))
    }

    /// Reads a value of up to 4096 bytes. A read that gets no answer is repeated.
    ///
    /// # Errors
    /// [`Error::NoAnswer`], [`Error::Refused`], [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn read(&mut self, at: Address) -> Result<Vec<u8>, Error> {
        let attempts = self.timing.attempts.max(1);
        let mut attempt = 1;
        loop {
            match self.read_once(at) {
                // An answer that came late, to a request given up, spoils the next one: then, too,
                // ask again.
                Err(Error::NoAnswer { .. } | Error::Protocol { .. }) if attempt < attempts => attempt += 1,
                result => return result,
            }
        }
    }

    /// Reads a value without repetition; otherwise as [`read`](Self::read).
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn read_once(&mut self, at: Address) -> Result<Vec<u8>, Error> {
        if !self.hears_the_bus() {
            return self.read_there(at);
        }
        let mut bytes = [0; VALUE_MAX];
        let mut upload = Upload::new(self.node, at, Buffer::new(&mut bytes), self.config());
        // A value is short: all of it has to be here in time.
        self.run(&mut upload, Doing::Read(at), Patience::InAll, &mut |_| {})?;
        Ok(upload.sink().filled().to_vec())
    }

    /// Reads a value of any length, as blocks where the device knows them. `progress` is told how
    /// many bytes are here.
    ///
    /// # Errors
    /// As [`read`](Self::read); [`Error::Protocol`] for more than [`UPLOAD_MAX`] bytes.
    pub fn upload(&mut self, at: Address, progress: &mut dyn FnMut(u32)) -> Result<Vec<u8>, Error> {
        if !self.hears_the_bus() {
            return self.upload_there(at, self.timing.command, progress);
        }
        let (sink, config) = (Grown(Vec::new()), self.config());
        let mut upload = match self.transfers {
            Transfers::Blocks => Upload::as_blocks(self.node, at, sink, config, Block::default()),
            Transfers::Segments => Upload::new(self.node, at, sink, config),
        };
        self.run(&mut upload, Doing::Read(at), Patience::ForEachStep, progress)?;
        Ok(upload.into_sink().0)
    }

    /// Reads an unsigned number of up to 32 bits.
    ///
    /// # Errors
    /// As [`read`](Self::read), and [`Error::Protocol`] for a value of another length.
    pub fn read_number(&mut self, at: Address) -> Result<u32, Error> {
        let bytes = self.read(at)?;
        number(&bytes).ok_or(Error::Protocol { doing: Doing::Read(at), code: AbortCode::LENGTH })
    }

    /// Reads a text. What is not ASCII, or would move the cursor, is replaced.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn read_text(&mut self, at: Address) -> Result<String, Error> {
        let bytes = self.read(at)?;
        let text = bytes.split(|byte| *byte == 0).next().unwrap_or_default();
        let visible = |byte: &u8| if matches!(byte, b' '..=b'~') { char::from(*byte) } else { '?' };
        Ok(text.iter().map(visible).collect())
    }

    /// Writes a value, once. `progress` is told how many bytes have arrived.
    ///
    /// # Errors
    /// [`Error::NoAnswer`], [`Error::Refused`], [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn write(
        &mut self,
        at: Address,
        data: &[u8],
        doing: Doing,
        progress: &mut dyn FnMut(u32),
    ) -> Result<(), Error> {
        if !self.hears_the_bus() {
            return self.write_there(at, data, doing, progress);
        }
        if self.transfers == Transfers::Blocks && data.len() > WORTH_BLOCKS {
            let block = Block { fallback: false, ..Block::default() };
            let mut download = Download::as_blocks(self.node, at, data, self.config(), block);
            match self.run(&mut download, doing, Patience::ForEachStep, progress) {
                // It is no use asking again for each value.
                Err(Error::Refused { code, .. }) if download.progress() == 0 && means_no_blocks(code) => {
                    self.transfers = Transfers::Segments;
                }
                Err(error @ Error::Refused { .. }) => {
                    self.settle_after_burst()?;
                    return Err(error);
                }
                result => return result,
            }
        }
        let mut download = Download::new(self.node, at, data, self.config());
        self.run(&mut download, doing, Patience::ForEachStep, progress)
    }

    /// Writes a command to 1F51h of a program, once; how it went is in [`status`](Self::status).
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

    /// Waits until 1F57h of a program is no longer busy, and gives what it says then. Silence
    /// counts as busy: a device may be unable to answer while it erases.
    ///
    /// # Errors
    /// [`Error::Busy`] or [`Error::NoAnswer`] when [`Timing::command`] has passed, and what
    /// [`read`](Self::read) has.
    pub fn await_idle(&mut self, number: u8, doing: Doing) -> Result<FlashStatus, Error> {
        let began = self.now();
        let at = Address::new(program::FLASH_STATUS, number);
        let mut pause = self.timing.poll_first;
        loop {
            let silence = match self.read_once(at) {
                Ok(bytes) => {
                    let word = self::number(&bytes)
                        .ok_or(Error::Protocol { doing: Doing::Read(at), code: AbortCode::LENGTH })?;
                    let status = FlashStatus::from_word(word);
                    if !status.busy {
                        return Ok(status);
                    }
                    None
                }
                Err(error @ (Error::NoAnswer { .. } | Error::Protocol { .. })) => Some(error),
                Err(error) => return Err(error),
            };
            let waited = self.now().saturating_sub(began);
            if waited >= self.timing.command {
                return Err(silence.unwrap_or(Error::Busy { node: self.node, doing, waited }));
            }
            self.wait(pause)?;
            pause = (pause * 2).min(self.timing.poll_most);
        }
    }

    /// Reads 1000h once: `None` where no answer comes.
    ///
    /// # Errors
    /// What [`read`](Self::read) has apart from [`Error::NoAnswer`].
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

    /// Waits until the node has said nothing for a while: segments that were on their way when it
    /// refused a block transfer draw an abort each, and none of these is the answer to what is
    /// asked next.
    fn settle_after_burst(&mut self) -> Result<(), Error> {
        let deadline = self.now() + self.timing.sdo;
        let response = CobId::sdo_response(self.node);
        while self.now() < deadline && self.listen(QUIET, |frame| frame.cob_id() == Some(response))? {}
        Ok(())
    }

    /// Lets time pass on the bus. Frames that come are not for anyone.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn wait(&mut self, time: Duration) -> Result<(), Error> {
        self.listen(time, |_| false).map(|_| ())
    }

    /// Listens to everything on the bus for a time.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn observe(&mut self, time: Duration, heard: &mut dyn FnMut(&Frame)) -> Result<(), Error> {
        self.listen(time, |frame| {
            heard(frame);
            false
        })
        .map(|_| ())
    }

    /// Listens to everything on the bus until `enough` says so, `time` at most; tells whether it
    /// did.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn observe_until(
        &mut self,
        time: Duration,
        enough: &mut dyn FnMut(&Frame) -> bool,
    ) -> Result<bool, Error> {
        self.listen(time, enough)
    }

    /// Waits for the node's boot-up message, `time` at most; tells whether it came.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn await_boot_up(&mut self, time: Duration) -> Result<bool, Error> {
        let boot_up = Frame::of(CobId::heartbeat(self.node), &[0]);
        self.listen(time, |frame| *frame == boot_up)
    }

    /// Waits for the boot-up message of any other node, `time` at most; gives which one it was.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn await_boot_up_of_another(&mut self, time: Duration) -> Result<Option<NodeId>, Error> {
        let (this, mut other) = (self.node, None);
        self.listen(time, |frame| {
            let of = |node: &NodeId| *frame == Frame::of(CobId::heartbeat(*node), &[0]);
            other = (1..=127).filter_map(NodeId::new).filter(|node| *node != this).find(of);
            other.is_some()
        })?;
        Ok(other)
    }

    /// Tells the node by network management to restart (NMT reset node); it gives no answer.
    ///
    /// # Errors
    /// [`Error::Adapter`].
    pub fn reset_node(&mut self) -> Result<(), Error> {
        let node = self.node;
        match &mut self.way {
            Way::Bus(adapter) => {
                Ok(adapter.send(&Frame::of(CobId::NMT, &[NmtCommand::ResetNode as u8, node.get()]))?)
            }
            Way::Gateway(gateway) => {
                gateway.reset_node(node).map_err(|error| of_gateway(error, node, Doing::Restart))
            }
        }
    }

    /// Sends a frame that is no SDO. A gateway carries none, and none is sent there.
    ///
    /// # Errors
    /// [`Error::Adapter`].
    pub fn send(&mut self, frame: &Frame) -> Result<(), Error> {
        match &mut self.way {
            Way::Bus(adapter) => Ok(adapter.send(frame)?),
            Way::Gateway(_) => Ok(()),
        }
    }

    /// The next frame from the bus. Those that somebody else waits for are answered on the way. Of a
    /// gateway, boot-up messages are all there is to hear.
    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, Error> {
        let adapter = match &mut self.way {
            Way::Bus(adapter) => adapter,
            Way::Gateway(gateway) => {
                let booted = gateway.wait(timeout);
                let booted = booted.map_err(|error| of_gateway(error, self.node, Doing::Restart))?;
                return Ok(booted.map(|node| Frame::of(CobId::heartbeat(node), &[0])));
            }
        };
        let frame = adapter.receive(timeout)?;
        if let (Some(answer), Some(frame)) = (self.answer, &frame) {
            if let Some(answer) = answer(frame) {
                adapter.send(&answer)?;
            }
        }
        Ok(frame)
    }

    /// Receives until `enough` says so, `time` at most; tells whether it did.
    fn listen(&mut self, time: Duration, mut enough: impl FnMut(&Frame) -> bool) -> Result<bool, Error> {
        let deadline = self.now() + time;
        loop {
            self.check_cancelled()?;
            let left = deadline.saturating_sub(self.now());
            if let Some(frame) = self.receive(left.min(SLICE))? {
                if enough(&frame) {
                    return Ok(true);
                }
            }
            if self.now() >= deadline {
                return Ok(false);
            }
        }
    }

    fn config(&self) -> Config {
        Config { timeout_ms: u32::try_from(self.timing.sdo.as_millis()).unwrap_or(u32::MAX / 4) }
    }

    fn check_cancelled(&self) -> Result<(), Error> {
        match &self.cancelled {
            Some(flag) if flag.load(Ordering::Relaxed) => Err(Error::Cancelled),
            _ => Ok(()),
        }
    }

    /// Runs one transfer to its end.
    fn run(
        &mut self,
        transfer: &mut impl Transfer,
        doing: Doing,
        patience: Patience,
        progress: &mut dyn FnMut(u32),
    ) -> Result<(), Error> {
        self.check_cancelled()?;
        // Answers to requests that were given up are no answers to this one.
        let mut stale = 0;
        while stale < 1000 && self.receive(Duration::ZERO)?.is_some() {
            stale += 1;
        }
        let mut deadline = self.now() + self.timing.command;
        let mut cancelled = false;
        let mut told = 0;
        let mut burst = 0;
        loop {
            if !cancelled && self.check_cancelled().is_err() {
                cancelled = true;
                transfer.abort(AbortCode::GENERAL);
            }
            if self.now() >= deadline {
                transfer.abort(AbortCode::TIMEOUT);
            }
            match transfer.poll(self.instant()) {
                Step::Send(frame) => {
                    self.send(&frame)?;
                    burst += 1;
                    if burst % BURST == 0 {
                        if let Some(frame) = self.receive(Duration::ZERO)? {
                            let now = self.instant();
                            transfer.handle(&frame, now);
                        }
                    }
                }
                Step::Wait(until) => {
                    burst = 0;
                    let now = self.instant();
                    let left = if now.has_reached(until) { 0 } else { until.since(now) };
                    let left = Duration::from_millis(left.into());
                    if let Some(frame) = self.receive(left.min(SLICE))? {
                        let now = self.instant();
                        transfer.handle(&frame, now);
                        if transfer.progress() != told {
                            told = transfer.progress();
                            progress(told);
                            if patience == Patience::ForEachStep {
                                deadline = self.now() + self.timing.command;
                            }
                        }
                    }
                }
                Step::Done(_) if cancelled => return Err(Error::Cancelled),
                Step::Done(Ok(())) => return Ok(()),
                Step::Done(Err(SdoError::NoAnswer)) => {
                    return Err(Error::NoAnswer { node: self.node, doing })
                }
                Step::Done(Err(SdoError::Server(code))) => {
                    return Err(Error::Refused { node: self.node, doing, code })
                }
                Step::Done(Err(SdoError::Client(code))) => return Err(Error::Protocol { doing, code }),
            }
        }
    }

    /// The bus time as the state machines count it: they compare by difference, so wrapping is
    /// right.
    fn instant(&self) -> Instant {
        Instant::from_millis(self.now().as_millis() as u32)
    }
}

/// What 1000h reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceType(pub u32);

impl DeviceType {
    /// Whether it is that of a bootloader, of one dialect or the other; everything else is an
    /// application's.
    #[must_use]
    pub const fn is_bootloader(self) -> bool {
        matches!(self.0, BOOTLOADER_DEVICE_TYPE | LIFT_DEVICE_TYPE | ESACADEMY_DEVICE_TYPE)
    }
}

impl fmt::Display for DeviceType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let who = if self.is_bootloader() { "the bootloader" } else { "an application" };
        write!(f, "{who} (device type {:08X}h)", self.0)
    }
}

/// Whether this is how a server says that it does not know block transfer. Some use the general
/// error for it.
fn means_no_blocks(code: AbortCode) -> bool {
    matches!(code, AbortCode::COMMAND | AbortCode::UNSUPPORTED_ACCESS | AbortCode::GENERAL)
}

/// A little-endian number of one to four bytes.
fn number(bytes: &[u8]) -> Option<u32> {
    if !(1..=4).contains(&bytes.len()) {
        return None;
    }
    Some(bytes.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte)))
}
