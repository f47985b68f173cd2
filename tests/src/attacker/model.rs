//! What the masters asked for, read from the bus alone: CiA 301 for NMT and SDO, CiA 305 for LSS.
//! The model does not know how the device works; it knows which changes somebody has asked for.

use std::collections::BTreeSet;

use attack::play::Broken;
use canopen::lss::LssAddress;
use canopen::Frame;
use embedded_can::Frame as _;

pub(super) const ANSWERS: &str = "the device answers in time, and what was asked alone";
pub(super) const PARAMETERS: &str = "node parameters are those that a master stored";

/// The start of a change of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Ask {
    /// 1F51h := this value.
    Control(u8),
    /// 1F51h := some value, by another transfer than the expedited one.
    AnyControl,
    /// A download to 1F50h.
    Download,
    /// A write to an object for passwords.
    Password,
}

/// Bit rate indices of CiA 305 table 1 with their bit/s.
pub const RATES: [(u8, u32); 4] = [(0, 1_000_000), (2, 500_000), (3, 250_000), (4, 125_000)];
/// "No node-ID" in LSS.
pub const NO_NODE: u8 = 255;

/// Node-ID (255 for none) and bit rate index, as LSS stores them.
pub type Node = (u8, u8);

/// The state of LSS.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lss {
    Waiting,
    Configuration,
}

/// What the bus knows of the device.
pub struct Model {
    programs: u8,
    /// The node-ID that the product fixes, and the one that it has without stored values.
    fixed: Option<u8>,
    default: Node,
    address: [u32; 4],
    /// The active node-ID.
    id: Option<u8>,
    /// The configured node-ID and bit rate.
    pending: Option<u8>,
    rate: Option<u8>,
    /// The bit rate on the bus.
    active_rate: u8,
    lss: Lss,
    selected: u8,
    position: u8,
    /// The last request of LSS that may be answered: the command of the answer, and its bytes.
    may_answer: Option<(u8, [u8; 8])>,
    /// Until then the device is silent and deaf: a bit rate is being activated.
    silent_until: u64,
    /// The stored node parameters; `None` until something was stored.
    stored: Option<Node>,
    /// A store that was asked for and not answered.
    storing: Option<Node>,
    /// COB-IDs that may be those of requests to the second SDO server.
    second: BTreeSet<u16>,
    /// What was asked for since the last check.
    asked: BTreeSet<(u8, Ask)>,
    node_reset: bool,
}

impl Model {
    /// A device with this identity that has nothing stored.
    #[must_use]
    pub fn new(programs: u8, fixed: Option<u8>, default: Node, address: LssAddress) -> Self {
        let LssAddress { vendor_id, product_code, revision, serial_number } = address;
        let mut model = Self {
            programs,
            fixed,
            default,
            address: [vendor_id, product_code, revision, serial_number],
            id: None,
            pending: None,
            rate: None,
            active_rate: default.1,
            lss: Lss::Waiting,
            selected: 0,
            position: 0,
            may_answer: None,
            silent_until: 0,
            stored: None,
            storing: None,
            second: BTreeSet::new(),
            asked: BTreeSet::new(),
            node_reset: false,
        };
        model.restarted();
        model
    }

    /// The active node-ID.
    #[must_use]
    pub fn id(&self) -> Option<u8> {
        self.id
    }

    /// The bit rate on the bus, in bit/s.
    #[must_use]
    pub fn bit_rate(&self) -> u32 {
        RATES.iter().find(|(index, _)| *index == self.active_rate).map_or(125_000, |(_, rate)| *rate)
    }

    /// Whether LSS is in configuration state.
    #[must_use]
    pub fn configures(&self) -> bool {
        self.lss == Lss::Configuration
    }

    /// The time until which the device is silent, in us.
    #[must_use]
    pub fn silent_until(&self) -> u64 {
        self.silent_until
    }

    /// The COB-IDs of requests to the device.
    pub fn requests(&self) -> impl Iterator<Item = u16> + '_ {
        self.id.map(|id| 0x600 + u16::from(id)).into_iter().chain(self.second.iter().copied())
    }

    /// The LSS address of the device.
    #[must_use]
    pub fn address(&self) -> [u32; 4] {
        self.address
    }

    /// What was asked of a program since the last check.
    pub fn asked(&self, program: u8) -> impl Iterator<Item = Ask> + '_ {
        self.asked.iter().filter(move |(at, _)| *at == program).map(|(_, ask)| *ask)
    }

    /// Whether NMT asked for a reset of the node since the last check.
    #[must_use]
    pub fn node_reset(&self) -> bool {
        self.node_reset
    }

    /// The stored node parameters, if any.
    #[must_use]
    pub fn stored(&self) -> Option<Node> {
        self.stored
    }

    /// Whether a node that starts may have this node-ID.
    #[must_use]
    pub fn may_be(&self, id: u8) -> bool {
        [self.id, self.pending, Some(self.stored.unwrap_or(self.default).0)].contains(&Some(id))
    }

    /// The node has started with this node-ID.
    pub fn booted(&mut self, id: u8) {
        if self.id != Some(id) {
            (self.id, self.pending) = (Some(id), Some(id));
        }
    }

    /// Compares what is stored now, and takes an unanswered store for carried out if it was.
    ///
    /// # Errors
    /// Other values than those that a master stored.
    pub fn stored_is(&mut self, found: Option<Node>) -> Result<(), Broken> {
        let storing = self.storing.take();
        if found == self.stored {
            return Ok(());
        }
        if storing.is_some() && found == storing {
            self.stored = storing;
            return Ok(());
        }
        Err(Broken(PARAMETERS, format!("stored are {found:?}, and masters stored {:?}", self.stored)))
    }

    /// The check was made: what was asked for has had its effect.
    pub fn forget(&mut self) {
        self.asked.clear();
        self.node_reset = false;
    }

    /// The device has started again. Only what is stored is left.
    pub fn restarted(&mut self) {
        let (id, rate) = self.stored.unwrap_or(self.default);
        self.id = self.fixed.or((id != NO_NODE).then_some(id));
        self.pending = self.id;
        self.rate = None;
        self.active_rate = rate;
        self.lss = Lss::Waiting;
        (self.selected, self.position) = (0, 0);
        (self.may_answer, self.silent_until) = (None, 0);
        self.second.clear();
    }

    /// Whether an unanswered store may have been carried out: what a restart makes of it must be read
    /// from the flash.
    #[must_use]
    pub fn is_storing(&self) -> bool {
        self.storing.is_some()
    }

    /// A frame that somebody else than the device has sent.
    pub fn sent(&mut self, frame: &Frame, at: u64) {
        if frame.is_extended() || frame.is_remote_frame() || at < self.silent_until {
            return;
        }
        let Some(id) = frame.cob_id().map(canopen::CobId::get) else { return };
        match (id, frame.data()) {
            (0x000, &[command, node]) => self.nmt(command, node),
            (0x7E5, data) => {
                if let Ok(bytes) = data.try_into() {
                    self.lss_request(bytes, at);
                }
            }
            (_, data) if self.requests().any(|request| request == id) => {
                if let Ok(bytes) = data.try_into() {
                    self.sdo_request(bytes);
                }
            }
            _ => {}
        }
    }

    /// A frame of the device.
    ///
    /// # Errors
    /// An answer that nobody asked for.
    pub fn answered(&mut self, frame: &Frame) -> Result<(), Broken> {
        if frame.cob_id().map(canopen::CobId::get) != Some(0x7E4) {
            return Ok(());
        }
        let Some(bytes) = frame.exactly::<8>() else {
            return Err(Broken(ANSWERS, format!("{frame}: no frame of LSS")));
        };
        let Some((_, asked)) = self.may_answer.take().filter(|(command, _)| *command == bytes[0]) else {
            return Err(Broken(ANSWERS, format!("{frame}: LSS answers what nobody asked")));
        };
        match (asked[0], bytes[1]) {
            (0x11, 0) => self.pending = (asked[1] != NO_NODE).then_some(asked[1]),
            (0x13, 0) => self.rate = Some(asked[2]),
            (0x17, 0) => self.stored = self.storing.take(),
            (0x17, _) => self.storing = None,
            _ => {}
        }
        Ok(())
    }

    fn nmt(&mut self, command: u8, node: u8) {
        if self.id.is_none() || (node != 0 && Some(node) != self.id) {
            return;
        }
        match command {
            0x81 => self.node_reset = true,
            0x82 => {
                self.lss = Lss::Waiting;
                self.id = self.pending;
                self.second.clear();
            }
            _ => {}
        }
    }

    fn lss_request(&mut self, bytes: [u8; 8], at: u64) {
        let [command, a, b, c, d, bit, part, next] = bytes;
        let number = u32::from_le_bytes([a, b, c, d]);
        let configures = self.configures();
        let answer = match command {
            0x04 => {
                match a {
                    0 => {
                        self.lss = Lss::Waiting;
                        self.id = self.id.or(self.pending);
                    }
                    1 => self.lss = Lss::Configuration,
                    _ => {}
                }
                None
            }
            0x40..=0x43 if !configures => {
                let step = command - 0x40;
                let matches =
                    (step == 0 || step == self.selected) && self.address[usize::from(step)] == number;
                self.selected = if matches { step + 1 } else { 0 };
                (self.selected == 4).then(|| {
                    (self.selected, self.lss) = (0, Lss::Configuration);
                    0x44
                })
            }
            0x46..=0x4B => Some(0x4F),
            0x4C if self.id.is_none() && self.pending.is_none() => Some(0x50),
            0x51 if !configures && self.id.is_none() && self.pending.is_none() => {
                self.fastscan(number, bit, part, next).then_some(0x4F)
            }
            0x11 | 0x13 | 0x17 | 0x5A..=0x5E if configures => Some(command),
            0x15 if configures && self.rate.is_some() => {
                let delay = u64::from(u16::from_le_bytes([a, b])) * 1000;
                self.silent_until = at + 2 * delay;
                self.active_rate = self.rate.unwrap_or(self.active_rate);
                None
            }
            _ => None,
        };
        if command == 0x17 && configures {
            let (_, rate) = self.stored.unwrap_or(self.default);
            self.storing = Some((self.pending.unwrap_or(NO_NODE), self.rate.unwrap_or(rate)));
        }
        self.may_answer = answer.map(|command| (command, bytes));
    }

    fn fastscan(&mut self, number: u32, bit: u8, part: u8, next: u8) -> bool {
        if bit == 0x80 {
            self.position = 0;
            return true;
        }
        let differs = |own: u32| (own ^ number).checked_shr(u32::from(bit)).unwrap_or(0) != 0;
        if bit > 31 || next > 3 || part != self.position || differs(self.address[usize::from(part)]) {
            return false;
        }
        self.position = next;
        if bit == 0 && next < part {
            self.lss = Lss::Configuration;
        }
        true
    }

    fn sdo_request(&mut self, bytes: [u8; 8]) {
        let [command, low, high, sub, value, ..] = bytes;
        // The start of a download (CiA 301, 7.2.4.3.3 and 7.2.4.3.9).
        let is_expedited = command & 0xE2 == 0x22;
        if command & 0xE0 != 0x20 && command & 0xE1 != 0xC0 {
            return;
        }
        let index = u16::from_le_bytes([low, high]);
        let ask = match index {
            0x1F50 => Ask::Download,
            0x1F51 if is_expedited => Ask::Control(value),
            0x1F51 => Ask::AnyControl,
            0x7F50 | 0x6005 => Ask::Password,
            0x1201 if sub == 1 => {
                let id = u16::from_le_bytes([bytes[4], bytes[5]]);
                if matches!(id, 0x181..=0x57F | 0x680..=0x6DF) {
                    self.second.insert(id);
                }
                return;
            }
            _ => return,
        };
        // The unlocking of a lift is for all programs.
        let programs = if index == 0x6005 { 1..=self.programs } else { sub..=sub };
        self.asked.extend(programs.filter(|at| (1..=self.programs).contains(at)).map(|at| (at, ask)));
    }
}
