//! The master of layer setting services (CiA 305): sets node-ID and bit rate over the bus, for
//! devices without switches.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

pub use canopen::lss::{BitRate, LssAddress};
use canopen::nmt::{self, NmtCommand};
use canopen::program::DEVICE_TYPE;
use canopen::{Address, CobId, Frame, NodeId};

use super::doing::Doing;
pub use super::doing::LssDoing;
use super::error::{Error, LssFailure};
use super::listen::listen;
use coboot_can::Adapter;

// Command specifiers (CiA 305).
const SWITCH_GLOBAL: u8 = 0x04;
const CONFIGURE_NODE_ID: u8 = 0x11;
const CONFIGURE_BIT_TIMING: u8 = 0x13;
const ACTIVATE_BIT_TIMING: u8 = 0x15;
const STORE: u8 = 0x17;
const SELECT: [u8; 4] = [0x40, 0x41, 0x42, 0x43];
const SELECTED: u8 = 0x44;
const IDENTIFIED: u8 = 0x4F;
const FASTSCAN: u8 = 0x51;
const INQUIRE: [u8; 4] = [0x5A, 0x5B, 0x5C, 0x5D];
const INQUIRE_NODE_ID: u8 = 0x5E;

/// Fastscan: "which device has no node-ID?".
const ANYBODY: u8 = 0x80;
/// The node-ID of a device without one.
const NO_NODE_ID: u8 = 0xFF;

/// The default time for a slave's answer. Fastscan waits this long for each bit that is set in an
/// address, so a longer time slows it down.
pub const ANSWER: Duration = Duration::from_millis(100);
/// How long a device may take to store its settings: it may have to erase a flash sector.
const STORE_ANSWER: Duration = Duration::from_secs(2);
/// Error code of a store: the device does not support storing (CiA 305).
const STORE_UNSUPPORTED: u8 = 1;

/// The LSS master. A bus must have only one.
pub struct Master<'a> {
    adapter: &'a mut dyn Adapter,
    answer: Duration,
    cancelled: Arc<AtomicBool>,
}

impl std::fmt::Debug for Master<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Master").field("answer", &self.answer).finish_non_exhaustive()
    }
}

impl<'a> Master<'a> {
    /// A master that waits `answer` for each answer ([`ANSWER`]). It sends nothing yet.
    pub fn new(adapter: &'a mut dyn Adapter, answer: Duration) -> Self {
        Self { adapter, answer, cancelled: Arc::default() }
    }

    /// Ends with [`Error::Cancelled`] when `flag` is set.
    pub fn cancel_by(&mut self, flag: Arc<AtomicBool>) {
        self.cancelled = flag;
    }

    /// Switches all devices into configuration state, or back to waiting state. No device answers.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn switch_all(&mut self, to_configuration: bool) -> Result<(), Error> {
        self.send([SWITCH_GLOBAL, u8::from(to_configuration), 0, 0, 0, 0, 0, 0])
    }

    /// Switches the device with this address into configuration state.
    ///
    /// # Errors
    /// [`Error::Lss`] if no device has the address.
    pub fn select(&mut self, address: &LssAddress) -> Result<(), Error> {
        let LssAddress { vendor_id, product_code, revision, serial_number } = *address;
        let numbers = [vendor_id, product_code, revision, serial_number];
        self.drain()?;
        for (command, number) in SELECT.into_iter().zip(numbers) {
            self.send(with_number(command, number))?;
        }
        self.await_answer(SELECTED, self.answer)?.map(|_| ()).ok_or(no_answer(LssDoing::Select))
    }

    /// Reads the address of the device in configuration state.
    ///
    /// # Errors
    /// [`Error::Lss`].
    pub fn inquire_address(&mut self) -> Result<LssAddress, Error> {
        let mut numbers = [0; 4];
        for (command, number) in INQUIRE.into_iter().zip(&mut numbers) {
            let [_, a, b, c, d, ..] =
                self.ask(with_number(command, 0))?.ok_or(no_answer(LssDoing::Inquire))?;
            *number = u32::from_le_bytes([a, b, c, d]);
        }
        let [vendor_id, product_code, revision, serial_number] = numbers;
        Ok(LssAddress { vendor_id, product_code, revision, serial_number })
    }

    /// Reads the active node-ID of the device in configuration state; `None` if it has none.
    ///
    /// # Errors
    /// [`Error::Lss`].
    pub fn inquire_node_id(&mut self) -> Result<Option<NodeId>, Error> {
        let answer = self.ask(with_number(INQUIRE_NODE_ID, 0))?.ok_or(no_answer(LssDoing::Inquire))?;
        Ok(NodeId::new(answer[1]))
    }

    /// Sets or clears the node-ID of the device in configuration state. A device without a node-ID
    /// takes the new one when it is switched to waiting state; a device with another node-ID needs
    /// a reset of its communication.
    ///
    /// # Errors
    /// [`Error::Lss`].
    pub fn set_node_id(&mut self, node: Option<NodeId>) -> Result<(), Error> {
        let number = node.map_or(NO_NODE_ID, NodeId::get);
        self.order([CONFIGURE_NODE_ID, number, 0, 0, 0, 0, 0, 0], LssDoing::NodeId)
    }

    /// Sets the bit rate of the device in configuration state. The rate takes effect with
    /// [`activate`](Self::activate), or at the next start if it was stored.
    ///
    /// # Errors
    /// [`Error::Lss`].
    pub fn set_bit_rate(&mut self, rate: BitRate) -> Result<(), Error> {
        self.order([CONFIGURE_BIT_TIMING, 0, rate as u8, 0, 0, 0, 0, 0], LssDoing::BitRate)
    }

    /// Makes all devices in configuration state switch to their new bit rate: they are silent for
    /// `delay`, switch over, and are silent for `delay` again. No device answers.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn activate(&mut self, delay: Duration) -> Result<(), Error> {
        let [low, high] = u16::try_from(delay.as_millis()).unwrap_or(u16::MAX).to_le_bytes();
        self.send([ACTIVATE_BIT_TIMING, low, high, 0, 0, 0, 0, 0])
    }

    /// Makes the device in configuration state store node-ID and bit rate.
    ///
    /// # Errors
    /// [`Error::Lss`].
    pub fn store(&mut self) -> Result<(), Error> {
        let patience = self.answer;
        self.answer = patience.max(STORE_ANSWER);
        let stored = self.order([STORE, 0, 0, 0, 0, 0, 0, 0], LssDoing::Store);
        self.answer = patience;
        stored
    }

    /// Finds one of the devices without a node-ID, bit by bit of its address, and switches it into
    /// configuration state; `None` if there is no such device. Calls `progress` with the number of
    /// known bits, up to 128.
    ///
    /// # Errors
    /// [`Error::Lss`] if the device disappears during the scan.
    pub fn fastscan(&mut self, progress: &mut dyn FnMut(u32)) -> Result<Option<LssAddress>, Error> {
        self.drain()?;
        if !self.is_there(0, ANYBODY, 0, 0, self.answer)? {
            return Ok(None);
        }
        // The answers of several devices usually come close together. If one was so late that it
        // was taken for the answer to the next question, the scan is repeated with the full time
        // for late answers.
        let address = match self.identify(self.answer / 5, progress)? {
            None => self.identify(self.answer, progress)?,
            found => found,
        };
        address.map(Some).ok_or(no_answer(LssDoing::Fastscan))
    }

    /// The address of one device; `None` if the result is an address that no device has. `late` is
    /// how long further answers may follow the first one.
    fn identify(
        &mut self,
        late: Duration,
        progress: &mut dyn FnMut(u32),
    ) -> Result<Option<LssAddress>, Error> {
        // Sets all devices to the first part of their addresses.
        if !self.is_there(0, ANYBODY, 0, 0, late)? {
            return Ok(None);
        }
        let mut numbers = [0; 4];
        for (part, number) in (0..).zip(&mut numbers) {
            for bit in (0..32).rev() {
                // "Do your bits from 31 down to this one have these values?" No answer means that
                // this bit is 1.
                if !self.is_there(*number, bit, part, part, late)? {
                    *number |= 1 << bit;
                }
                progress(u32::from(part) * 32 + 32 - u32::from(bit));
            }
            // The whole number again: a device with this number continues with the next part, or is
            // found.
            if !self.is_there(*number, 0, part, (part + 1) % 4, late)? {
                return Ok(None);
            }
        }
        let [vendor_id, product_code, revision, serial_number] = numbers;
        Ok(Some(LssAddress { vendor_id, product_code, revision, serial_number }))
    }

    /// Asks one question of fastscan. Several devices may answer, all with the same frame; the
    /// method waits for all answers before the next question.
    fn is_there(&mut self, number: u32, bit: u8, part: u8, next: u8, late: Duration) -> Result<bool, Error> {
        let [a, b, c, d] = number.to_le_bytes();
        self.send([FASTSCAN, a, b, c, d, bit, part, next])?;
        if self.await_answer(IDENTIFIED, self.answer)?.is_none() {
            return Ok(false);
        }
        // There are at most as many answers as node-IDs.
        let mut more = 0;
        while more < 127 && self.await_answer(IDENTIFIED, late)?.is_some() {
            more += 1;
        }
        Ok(true)
    }

    /// Sends a command whose answer has an error code.
    fn order(&mut self, request: [u8; 8], doing: LssDoing) -> Result<(), Error> {
        let [_, code, detail, ..] = self.ask(request)?.ok_or(no_answer(doing))?;
        match code {
            0 => Ok(()),
            code => Err(Error::Lss { doing, failure: LssFailure::Refused { code, detail } }),
        }
    }

    /// Sends a request and waits for the answer with the same command specifier.
    fn ask(&mut self, request: [u8; 8]) -> Result<Option<[u8; 8]>, Error> {
        self.drain()?;
        self.send(request)?;
        self.await_answer(request[0], self.answer)
    }

    fn send(&mut self, request: [u8; 8]) -> Result<(), Error> {
        // No command goes out after a cancellation: the last one may change the bit rate of a bus.
        if self.cancelled.load(Ordering::Relaxed) {
            return Err(Error::Cancelled);
        }
        Ok(self.adapter.send(&Frame::of(CobId::LSS_REQUEST, &request))?)
    }

    /// Discards frames that arrived before the question.
    fn drain(&mut self) -> Result<(), Error> {
        let mut stale = 0;
        while stale < 1000 && self.adapter.receive(Duration::ZERO)?.is_some() {
            stale += 1;
        }
        Ok(())
    }

    fn await_answer(&mut self, command: u8, within: Duration) -> Result<Option<[u8; 8]>, Error> {
        let mut answer = None;
        listen(self.adapter, within, &self.cancelled, &mut |frame| {
            let of_master = frame.cob_id() == Some(CobId::LSS_RESPONSE);
            answer = frame.exactly::<8>().copied().filter(|bytes| of_master && bytes[0] == command);
            answer.is_some()
        })?;
        Ok(answer)
    }
}

/// Makes sure that the device with this address has a node-ID: its own one, or the requested one.
/// The device gets the requested node-ID if it has another one, and stores it if it can, because
/// the node-ID must survive the restart into the program. Afterwards the device is on the bus with
/// this node-ID.
///
/// # Errors
/// [`Error::Lss`] if the device does not answer, if it has no node-ID and none is requested, or if
/// it refuses; [`Error::NoAnswer`] if it does not start with its new node-ID within `boot`.
pub fn ensure_node_id(
    adapter: &mut dyn Adapter,
    address: &LssAddress,
    node: Option<NodeId>,
    boot: Duration,
    cancelled: &Arc<AtomicBool>,
) -> Result<NodeId, Error> {
    let mut master = Master::new(adapter, ANSWER);
    master.cancel_by(cancelled.clone());
    master.switch_all(false)?;
    master.select(address)?;
    let old = master.inquire_node_id()?;
    let (new, reset) = match (old, node) {
        (None, None) => {
            master.switch_all(false)?;
            return Err(Error::Lss { doing: LssDoing::NodeId, failure: LssFailure::None });
        }
        (Some(own), None) => (own, None),
        (Some(own), Some(node)) if own == node => (own, None),
        (old, Some(node)) => {
            master.set_node_id(Some(node))?;
            match master.store() {
                // The device cannot store, or does not know the service.
                Err(Error::Lss {
                    failure: LssFailure::Refused { code: STORE_UNSUPPORTED, .. } | LssFailure::NoAnswer,
                    ..
                }) => {}
                stored => stored?,
            }
            (node, old)
        }
    };
    master.switch_all(false)?;
    if old == Some(new) {
        return Ok(new);
    }
    if let Some(old) = reset {
        adapter.send(&NmtCommand::ResetCommunication.emit(Some(old)))?;
    }
    let mut up = false;
    let boot_up = nmt::boot_up(new);
    listen(adapter, boot, cancelled, &mut |frame| {
        up = *frame == boot_up;
        up
    })?;
    if up {
        return Ok(new);
    }
    Err(Error::NoAnswer { node: new, doing: Doing::Read(Address::new(DEVICE_TYPE, 0)) })
}

fn with_number(command: u8, number: u32) -> [u8; 8] {
    let [a, b, c, d] = number.to_le_bytes();
    [command, a, b, c, d, 0, 0, 0]
}

fn no_answer(doing: LssDoing) -> Error {
    Error::Lss { doing, failure: LssFailure::NoAnswer }
}
