//! Layer setting services of a slave (CiA 305): node-ID and bit rate over the bus, for a device
//! without switches.
//!
//! [`Lss::handle`] takes frames, and [`Lss::poll`] returns what the owner must do: answers to send,
//! a node-ID or a bit rate that takes effect. [`LssDevice`] is the interface to the device.
//!
//! Frames other than LSS requests, requests in the wrong state and requests for other slaves are
//! not answered, as the standard requires.

use core::task::Poll;

pub use crate::bit_rate::BitRate;
use crate::frame::{CobId, Frame, NodeId};
use crate::time::Instant;

/// The LSS address of a device: its identity object 1018h, which is unique.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LssAddress {
    /// 1018h/1.
    pub vendor_id: u32,
    /// 1018h/2.
    pub product_code: u32,
    /// 1018h/3.
    pub revision: u32,
    /// 1018h/4.
    pub serial_number: u32,
}

impl LssAddress {
    /// The four numbers in the order of the sub-indices of 1018h.
    const fn parts(&self) -> [u32; 4] {
        [self.vendor_id, self.product_code, self.revision, self.serial_number]
    }
}

/// Why a device could not store; the values are the error codes in the answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum StoreError {
    /// The device does not support storing.
    Unsupported = 1,
    /// Its memory failed.
    Failed = 2,
}

/// The interface between LSS and the device.
pub trait LssDevice {
    /// Whether the device is a slave of these services. Without it, the compiler leaves out the code.
    fn has_lss() -> bool
    where
        Self: Sized,
    {
        true
    }

    /// Whether a master finds the device by ranges of its address (identify remote slave), too.
    fn identifies() -> bool
    where
        Self: Sized,
    {
        true
    }

    /// Whether the device supports this bit rate; for [`BitRate::Auto`], whether it may detect the
    /// bit rate by listening.
    fn supports(&mut self, rate: BitRate) -> bool;

    /// Whether the device takes this node-ID.
    fn takes(&mut self, _id: NodeId) -> bool {
        true
    }

    /// Stores node-ID and bit rate for the next start. `None` as node-ID stores "no node-ID" (FFh);
    /// `None` as bit rate leaves the stored value unchanged. A device that needs time returns
    /// `Pending`, and [`stored`](Self::stored) is called then.
    ///
    /// # Errors
    /// Sent to the master as error code.
    fn store(&mut self, node: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>>;

    /// The result of the last [`store`](Self::store); `Pending` while it continues.
    ///
    /// # Errors
    /// Sent to the master as error code.
    fn stored(&mut self) -> Poll<Result<(), StoreError>> {
        Poll::Ready(Ok(()))
    }
}

/// The configuration of an LSS slave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Config {
    /// Start in LSS configuration state, for a bus with one device to configure. Not part of the
    /// standard. Default: no.
    pub start_in_configuration: bool,
    /// Without a node-ID, send "non-configured slave" once after the start in place of the boot-up
    /// message. Not part of the standard. Default: no.
    pub announce: bool,
}

/// What the owner must do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// Send this frame.
    Send(Frame),
    /// A device without a node-ID gets this one: start the node and send its boot-up message.
    NodeId(NodeId),
    /// Set the CAN controller to this bit rate now.
    BitRate(BitRate),
}

/// An LSS slave.
#[derive(Debug)]
pub struct Lss {
    /// Vendor-ID, product code, revision number, serial number.
    address: [u32; 4],
    /// The initial state.
    initial: State,
    state: State,
    /// The active node-ID.
    active: Option<NodeId>,
    /// The configured node-ID: it takes effect at the next start of the node.
    pending: Option<NodeId>,
    /// The configured bit rate.
    bit_rate: Option<BitRate>,
    /// The number of matching requests of a selective switch in a row.
    selected: u8,
    /// The number of matching requests of an identification in a row.
    identified: u8,
    /// The part of the address that fastscan compares, 0 to 3.
    position: u8,
    activation: Activation,
    /// The device is storing. The master waits for the answer; other requests are ignored.
    storing: bool,
    answer: Option<[u8; 8]>,
    /// A node-ID that has taken effect and was not yet reported to the owner.
    assigned: Option<NodeId>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Waiting,
    Configuration,
}

/// Activation of a bit rate: two delays in which the node is silent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Activation {
    None,
    /// First delay: all nodes finish their present transmissions.
    Before {
        rate: BitRate,
        switch_at: Instant,
        delay_ms: u16,
    },
    /// Second delay: all nodes change to the new bit rate.
    After {
        until: Instant,
    },
}

// Command specifiers.
const SWITCH_GLOBAL: u8 = 0x04;
const CONFIGURE_NODE_ID: u8 = 0x11;
const CONFIGURE_BIT_TIMING: u8 = 0x13;
const ACTIVATE_BIT_TIMING: u8 = 0x15;
const STORE: u8 = 0x17;
const SELECT_VENDOR: u8 = 0x40;
const SELECT_SERIAL: u8 = 0x43;
const SELECTED: u8 = 0x44;
const IDENTIFY_VENDOR: u8 = 0x46;
const IDENTIFY_SERIAL_HIGH: u8 = 0x4B;
const IDENTIFY_NON_CONFIGURED: u8 = 0x4C;
const IDENTIFIED: u8 = 0x4F;
const NON_CONFIGURED: u8 = 0x50;
const FASTSCAN: u8 = 0x51;
const INQUIRE_VENDOR: u8 = 0x5A;
const INQUIRE_SERIAL: u8 = 0x5D;
const INQUIRE_NODE_ID: u8 = 0x5E;

/// The node-ID of a device without one.
const UNCONFIGURED: u8 = 0xFF;

/// Fastscan: all slaves without a node-ID answer, and start with the first part of the address.
const CONFIRM: u8 = 0x80;

impl Lss {
    /// A slave with this node-ID, or without one.
    #[must_use]
    pub fn new(address: LssAddress, node: Option<NodeId>, config: Config) -> Self {
        let initial = if config.start_in_configuration { State::Configuration } else { State::Waiting };
        let announce = config.announce && node.is_none();
        Self {
            address: address.parts(),
            initial,
            state: initial,
            active: node,
            pending: node,
            bit_rate: None,
            selected: 0,
            identified: 0,
            position: 0,
            activation: Activation::None,
            storing: false,
            answer: announce.then(|| answer(NON_CONFIGURED, 0)),
            assigned: None,
        }
    }

    /// The active node-ID.
    #[must_use]
    pub const fn node_id(&self) -> Option<NodeId> {
        self.active
    }

    /// NMT Reset communication: the configured node-ID takes effect and is returned. Without one
    /// the node is not started and waits for LSS again.
    ///
    /// The state becomes LSS waiting, as at the start: the node passes through INITIALISATION, and
    /// the state machine is entered again with PRE-OPERATIONAL, or with a reset of communication
    /// without a node-ID (CiA 305, LSS FSA, transition 1). Other changes of the NMT state do not
    /// affect it.
    pub fn reset_communication(&mut self) -> Option<NodeId> {
        self.state = self.initial;
        self.active = self.pending;
        // The owner starts the node now; a start that was not reported to it yet is over.
        self.assigned = None;
        self.active
    }

    /// Whether the node must not send anything: a new bit rate is being activated.
    #[must_use]
    pub fn is_silent(&self, now: Instant) -> bool {
        match self.activation {
            Activation::None => false,
            Activation::Before { .. } => true,
            Activation::After { until } => !now.has_reached(until),
        }
    }

    /// Processes any received frame; frames other than LSS requests are ignored.
    pub fn handle(&mut self, frame: &Frame, now: Instant, device: &mut impl LssDevice) {
        if !frame.has_cob_id(CobId::LSS_REQUEST) || self.is_silent(now) || self.storing {
            return;
        }
        let Some(bytes) = frame.exactly() else { return };
        if let Some((command, number)) = self.request(bytes, now, device) {
            self.answer = Some(answer(command, number));
        }
    }

    /// Asks a storing device for the result, so that the master gets its answer. Call it before
    /// [`poll`](Self::poll) if the device needs time to store.
    pub fn follow_store(&mut self, device: &mut impl LssDevice) {
        if self.storing {
            if let Poll::Ready(outcome) = device.stored() {
                self.storing = false;
                self.answer = Some(answer(STORE, error_code(outcome)));
            }
        }
    }

    /// Returns the next action of the owner; `None` if there is none.
    pub fn poll(&mut self, now: Instant) -> Option<Output> {
        match self.activation {
            Activation::Before { rate, switch_at, delay_ms } if now.has_reached(switch_at) => {
                self.activation = Activation::After { until: switch_at + u32::from(delay_ms) };
                return Some(Output::BitRate(rate));
            }
            Activation::After { until } if now.has_reached(until) => self.activation = Activation::None,
            _ => {}
        }
        if self.is_silent(now) {
            return None;
        }
        if let Some(answer) = self.answer.take() {
            return Some(Output::Send(Frame::full(CobId::LSS_RESPONSE, answer)));
        }
        self.assigned.take().map(Output::NodeId)
    }

    /// The answer to a request: its command specifier and the following number.
    fn request<D: LssDevice>(&mut self, bytes: &[u8; 8], now: Instant, device: &mut D) -> Option<(u8, u32)> {
        let [command, a, b, c, d, ..] = *bytes;
        let number = u32::from_le_bytes([a, b, c, d]);
        let number = match (command, self.state) {
            (SWITCH_GLOBAL, _) => {
                self.switch_global(a);
                return None;
            }
            (SELECT_VENDOR..=SELECT_SERIAL, State::Waiting) => {
                return self.select(command - SELECT_VENDOR, number).then_some((SELECTED, 0));
            }
            (IDENTIFY_VENDOR..=IDENTIFY_SERIAL_HIGH, _) if D::identifies() => {
                return self.identify(command - IDENTIFY_VENDOR, number).then_some((IDENTIFIED, 0));
            }
            (IDENTIFY_NON_CONFIGURED, _) => return self.is_unconfigured().then_some((NON_CONFIGURED, 0)),
            (FASTSCAN, State::Waiting) => return self.fastscan(bytes).then_some((IDENTIFIED, 0)),
            (CONFIGURE_NODE_ID, State::Configuration) => {
                let id = NodeId::new(a);
                let is_taken = a == UNCONFIGURED || id.is_some_and(|id| device.takes(id));
                if is_taken {
                    self.pending = id;
                }
                u32::from(!is_taken)
            }
            (CONFIGURE_BIT_TIMING, State::Configuration) => {
                let rate = BitRate::from_index(b).filter(|rate| a == 0 && device.supports(*rate));
                self.bit_rate = rate.or(self.bit_rate);
                u32::from(rate.is_none())
            }
            (ACTIVATE_BIT_TIMING, State::Configuration) => {
                let delay_ms = u16::from_le_bytes([a, b]);
                let switch_at = now + u32::from(delay_ms);
                self.activation = Activation::Before { rate: self.bit_rate?, switch_at, delay_ms };
                return None;
            }
            (STORE, State::Configuration) => match device.store(self.pending, self.bit_rate) {
                Poll::Ready(outcome) => error_code(outcome),
                Poll::Pending => {
                    self.storing = true;
                    return None;
                }
            },
            (INQUIRE_VENDOR..=INQUIRE_SERIAL, State::Configuration) => {
                self.address[usize::from(command - INQUIRE_VENDOR)]
            }
            (INQUIRE_NODE_ID, State::Configuration) => self.active.map_or(UNCONFIGURED, NodeId::get).into(),
            _ => return None,
        };
        Some((command, number))
    }

    /// Whether it has no node-ID and none is configured.
    fn is_unconfigured(&self) -> bool {
        self.active.is_none() && self.pending.is_none()
    }

    fn switch_global(&mut self, mode: u8) {
        match mode {
            0 => {
                self.state = State::Waiting;
                // A device without a node-ID takes the new one here and boots.
                if self.active.is_none() && self.pending.is_some() {
                    self.active = self.pending;
                    self.assigned = self.active;
                }
            }
            1 => self.state = State::Configuration,
            _ => {}
        }
    }

    /// Four matching requests in a row select a device; returns whether this was the last one.
    fn select(&mut self, step: u8, number: u32) -> bool {
        let matches = self.address[usize::from(step)] == number;
        let complete = advance(&mut self.selected, step, 3, matches);
        if complete {
            self.state = State::Configuration;
        }
        complete
    }

    /// Six matching requests in a row give vendor, product, and the bounds of revision and serial
    /// number; returns whether this was the last one.
    fn identify(&mut self, step: u8, number: u32) -> bool {
        let [vendor_id, product_code, revision, serial_number] = self.address;
        let matches = match step {
            0 => number == vendor_id,
            1 => number == product_code,
            2 => number <= revision,
            3 => number >= revision,
            4 => number <= serial_number,
            _ => number >= serial_number,
        };
        advance(&mut self.identified, step, 5, matches)
    }

    /// Compares the bits of the address one after another; returns whether all bits up to this one
    /// match the request. Slaves with a node-ID take no part.
    fn fastscan(&mut self, bytes: &[u8; 8]) -> bool {
        let [_, a, b, c, d, bit, part, next] = *bytes;
        if !self.is_unconfigured() {
            return false;
        }
        if bit == CONFIRM {
            self.position = 0;
            return true;
        }
        if bit > 31 || next > 3 || part != self.position {
            return false;
        }
        // The bits from 31 down to this one.
        let asked = u32::MAX << bit;
        let number = u32::from_le_bytes([a, b, c, d]);
        if (self.address[usize::from(part)] ^ number) & asked != 0 {
            return false;
        }
        self.position = next;
        // All bits of the last part match: the master has found this device.
        if bit == 0 && next < part {
            self.state = State::Configuration;
        }
        true
    }
}

/// Counts a sequence of requests that must all match; returns whether this was the last one.
fn advance(done: &mut u8, step: u8, last: u8, matches: bool) -> bool {
    let in_order = step == 0 || step == *done;
    let good = in_order && matches;
    let complete = good && step == last;
    *done = if good && !complete { step + 1 } else { 0 };
    complete
}

/// The error code of the answer to a store, 0 for success.
fn error_code(outcome: Result<(), StoreError>) -> u32 {
    outcome.err().map_or(0, |error| error as u32)
}

/// An answer: a number or an error code after the command specifier.
const fn answer(command: u8, number: u32) -> [u8; 8] {
    let [a, b, c, d] = number.to_le_bytes();
    [command, a, b, c, d, 0, 0, 0]
}
