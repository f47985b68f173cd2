//! Layer setting services, the master's side (CiA 305): node-ID and bit rate over the bus, for
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
use crate::bus::Adapter;

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

/// Fastscan: "who has no node-ID?".
const ANYBODY: u8 = 0x80;
/// The node-ID of a device without one.
const NO_NODE_ID: u8 = 0xFF;

/// How long a slave may take for its answer, unless told otherwise. Fastscan waits so long for each
/// bit that is set in an address, so that patience costs time there.
pub const ANSWER: Duration = Duration::from_millis(100);
/// How long a device may take to store what it was given: it may have to erase a sector of its
/// flash for that.
const STORE_ANSWER: Duration = Duration::from_secs(2);
/// Error code of a store: the device has no place for it (CiA 305).
const STORE_UNSUPPORTED: u8 = 1;

/// The master of the bus. There must not be two.
pub struct Master<'a> {
    adapter: &'a mut dyn Adapter,
    answer: Duration,
    cancelled: Option<Arc<AtomicBool>>,
}

impl std::fmt::Debug for Master<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Master").field("answer", &self.answer).finish_non_exhaustive()
    }
}

impl<'a> Master<'a> {
    /// A master that waits so long for an answer ([`ANSWER`]). Nothing is sent yet.
    pub fn new(adapter: &'a mut dyn Adapter, answer: Duration) -> Self {
        Self { adapter, answer, cancelled: None }
    }

    /// Ends with [`Error::Cancelled`] as soon as `flag` is set.
    pub fn cancel_by(&mut self, flag: Arc<AtomicBool>) {
        self.cancelled = Some(flag);
    }

    /// Switches every device that listens into configuration state, or back to waiting. Nobody
    /// answers.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn switch_all(&mut self, to_configuration: bool) -> Result<(), Error> {
        self.send([SWITCH_GLOBAL, u8::from(to_configuration), 0, 0, 0, 0, 0, 0])
    }

    /// Switches the one device with this address into configuration state.
    ///
    /// # Errors
    /// [`Error::Lss`] where no device answers to the address.
    pub fn select(&mut self, address: &LssAddress) -> Result<(), Error> {
        let LssAddress { vendor_id, product_code, revision, serial_number } = *address;
        let numbers = [vendor_id, product_code, revision, serial_number];
        self.drain()?;
        for (command, number) in SELECT.into_iter().zip(numbers) {
            self.send(with_number(command, number))?;
        }
        self.await_answer(SELECTED, self.answer)?.map(|_| ()).ok_or(no_answer(LssDoing::Select))
    }

    /// Asks the device in configuration state for its address.
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

    /// Asks the device in configuration state for the node-ID that it has in force; `None` where it
    /// has none.
    ///
    /// # Errors
    /// [`Error::Lss`].
    pub fn inquire_node_id(&mut self) -> Result<Option<NodeId>, Error> {
        let answer = self.ask(with_number(INQUIRE_NODE_ID, 0))?.ok_or(no_answer(LssDoing::Inquire))?;
        Ok(NodeId::new(answer[1]))
    }

    /// Gives the device in configuration state a node-ID, or takes it away. A device without one
    /// takes it when it is switched back to waiting; one that has another needs a reset of its
    /// communication.
    ///
    /// # Errors
    /// [`Error::Lss`].
    pub fn set_node_id(&mut self, node: Option<NodeId>) -> Result<(), Error> {
        let number = node.map_or(NO_NODE_ID, NodeId::get);
        self.order([CONFIGURE_NODE_ID, number, 0, 0, 0, 0, 0, 0], LssDoing::NodeId)
    }

    /// Gives the device in configuration state a bit rate; it comes into force by
    /// [`activate`](Self::activate), or with the next start when it was stored.
    ///
    /// # Errors
    /// [`Error::Lss`].
    pub fn set_bit_rate(&mut self, rate: BitRate) -> Result<(), Error> {
        self.order([CONFIGURE_BIT_TIMING, 0, rate as u8, 0, 0, 0, 0, 0], LssDoing::BitRate)
    }

    /// Has all devices in configuration state change over to the bit rate that they were given:
    /// they fall silent for `delay`, change over, and stay silent for as long again. Nobody
    /// answers.
    ///
    /// # Errors
    /// [`Error::Adapter`] or [`Error::Cancelled`].
    pub fn activate(&mut self, delay: Duration) -> Result<(), Error> {
        let [low, high] = u16::try_from(delay.as_millis()).unwrap_or(u16::MAX).to_le_bytes();
        self.send([ACTIVATE_BIT_TIMING, low, high, 0, 0, 0, 0, 0])
    }

    /// Has the device in configuration state store node-ID and bit rate.
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
    /// configuration state; `None` where there is no such device. `progress` is told how many of
    /// the 128 bits are known.
    ///
    /// # Errors
    /// [`Error::Lss`] where the device has gone in the middle.
    pub fn fastscan(&mut self, progress: &mut dyn FnMut(u32)) -> Result<Option<LssAddress>, Error> {
        self.drain()?;
        if !self.is_there(0, ANYBODY, 0, 0, self.answer)? {
            return Ok(None);
        }
        // Answers of several devices come close behind one another, as a rule. Where one was so
        // late that it was taken for the answer to the next question, the whole time is left for
        // it.
        let address = match self.identify(self.answer / 5, progress)? {
            None => self.identify(self.answer, progress)?,
            found => found,
        };
        address.map(Some).ok_or(no_answer(LssDoing::Fastscan))
    }

    /// The address of one device; `None` where it comes out as one that no device has. `late` is
    /// how long further answers may lag behind the first.
    fn identify(
        &mut self,
        late: Duration,
        progress: &mut dyn FnMut(u32),
    ) -> Result<Option<LssAddress>, Error> {
        // Takes all devices to the first part of their addresses.
        if !self.is_there(0, ANYBODY, 0, 0, late)? {
            return Ok(None);
        }
        let mut numbers = [0; 4];
        for (part, number) in (0..).zip(&mut numbers) {
            for bit in (0..32).rev() {
                // "Do your bits from 31 down to this one read as these?": silence means that this
                // one is set.
                if !self.is_there(*number, bit, part, part, late)? {
                    *number |= 1 << bit;
                }
                progress(u32::from(part) * 32 + 32 - u32::from(bit));
            }
            // The whole number once more: who has it goes on to the next part, or is found.
            if !self.is_there(*number, 0, part, (part + 1) % 4, late)? {
                return Ok(None);
            }
        }
        let [vendor_id, product_code, revision, serial_number] = numbers;
        Ok(Some(LssAddress { vendor_id, product_code, revision, serial_number }))
    }

    /// One question of fastscan. Several devices may answer, all with the same frame; these are all
    /// heard before the next question.
    fn is_there(&mut self, number: u32, bit: u8, part: u8, next: u8, late: Duration) -> Result<bool, Error> {
        let [a, b, c, d] = number.to_le_bytes();
        self.send([FASTSCAN, a, b, c, d, bit, part, next])?;
        if self.await_answer(IDENTIFIED, self.answer)?.is_none() {
            return Ok(false);
        }
        // At most as many as there are node-IDs.
        let mut more = 0;
        while more < 127 && self.await_answer(IDENTIFIED, late)?.is_some() {
            more += 1;
        }
        Ok(true)
    }

    /// Gives an order that is answered with an error code.
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
        self.check_cancelled()?;
        Ok(self.adapter.send(&Frame::of(CobId::LSS_REQUEST, &request))?)
    }

    /// Forgets what came before the question.
    fn drain(&mut self) -> Result<(), Error> {
        let mut stale = 0;
        while stale < 1000 && self.adapter.receive(Duration::ZERO)?.is_some() {
            stale += 1;
        }
        Ok(())
    }

    fn await_answer(&mut self, command: u8, within: Duration) -> Result<Option<[u8; 8]>, Error> {
        let deadline = self.adapter.now() + within;
        loop {
            self.check_cancelled()?;
            let left = deadline.saturating_sub(self.adapter.now());
            if let Some(frame) = self.adapter.receive(left)? {
                let bytes: Option<&[u8; 8]> = frame.exactly();
                match bytes {
                    Some(bytes) if frame.cob_id() == Some(CobId::LSS_RESPONSE) && bytes[0] == command => {
                        return Ok(Some(*bytes))
                    }
                    _ => {}
                }
            }
            if self.adapter.now() >= deadline {
                return Ok(None);
            }
        }
    }

    fn check_cancelled(&self) -> Result<(), Error> {
        match &self.cancelled {
            Some(flag) if flag.load(Ordering::Relaxed) => Err(Error::Cancelled),
            _ => Ok(()),
        }
    }
}

/// Sees to it that the device with this address has a node-ID: its own, or the one that is asked
/// for, which it is given if need be, and stores if it can: it has to outlive the restart into the
/// program. Afterwards it is on the bus with it.
///
/// # Errors
/// [`Error::Lss`] where the device does not answer, has no node-ID and none is asked for, or
/// refuses; [`Error::NoAnswer`] where it does not come up with its new node-ID within `boot`.
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
                // It cannot, or has never heard of the service.
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
