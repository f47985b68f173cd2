//! Emergency producer (CiA 301 section 7.2.7) and its objects.
//!
//! A device keeps an [`Emcy`] beside its other values. It calls [`Emcy::read`] and [`Emcy::write`]
//! before other functions that handle 1001h, and returns [`Emcy::next_message`] from
//! [`Objects::next_emergency`](crate::Objects::next_emergency).

use crate::abort::AbortCode;
use crate::frame::{CobId, NodeId};
use crate::line::LineEvent;
use crate::od::{put, Access, Address, DataType, Entry};
use crate::program::{COB_ID_EMCY, ERROR_FIELD, ERROR_REGISTER};

/// The number of errors in 1003h.
pub const HISTORY: usize = 4;

/// The most emergencies that wait to be sent.
const QUEUE: usize = 4;

/// 1003h and 1014h. (1001h, which every device has, is in
/// [`device::ENTRIES`](crate::device::ENTRIES).)
pub const ENTRIES: [Entry; HISTORY + 2] = [
    Entry::array(ERROR_FIELD, "Pre-defined error field", HISTORY as u8).access(Access::Rw).default(0),
    Entry::sub(ERROR_FIELD, 1, "Standard error field 1", DataType::Unsigned32, Access::Ro),
    Entry::sub(ERROR_FIELD, 2, "Standard error field 2", DataType::Unsigned32, Access::Ro),
    Entry::sub(ERROR_FIELD, 3, "Standard error field 3", DataType::Unsigned32, Access::Ro),
    Entry::sub(ERROR_FIELD, 4, "Standard error field 4", DataType::Unsigned32, Access::Ro),
    Entry::var(COB_ID_EMCY, "COB-ID EMCY", DataType::Unsigned32, Access::Ro).default_text("$NODEID+0x80"),
];

/// Emergency error codes (CiA 301 table 26).
pub mod code {
    /// The error has ended.
    pub const RESET: u16 = 0x0000;
    /// An error without a more specific code.
    pub const GENERIC: u16 = 0x1000;
    /// A fault of the device's hardware, such as its flash.
    pub const HARDWARE: u16 = 0x5000;
    /// A fault of the device's software.
    pub const SOFTWARE: u16 = 0x6000;
    /// A data set is wrong, such as a program whose CRC does not match.
    pub const DATA_SET: u16 = 0x6300;
    /// Frames were lost.
    pub const CAN_OVERRUN: u16 = 0x8110;
    /// The CAN controller became error passive.
    pub const CAN_PASSIVE: u16 = 0x8120;
    /// The CAN controller was off the bus and is back.
    pub const BUS_OFF_RECOVERED: u16 = 0x8140;
    /// A PDO was not processed: it is too short.
    pub const PDO_LENGTH: u16 = 0x8210;
    /// A PDO is longer than what is mapped.
    pub const PDO_LENGTH_EXCEEDED: u16 = 0x8220;
    /// SYNC has data and should have none.
    pub const SYNC_LENGTH: u16 = 0x8240;
    /// Defined by the manufacturer.
    pub const DEVICE_SPECIFIC: u16 = 0xFF00;
}

/// Bits of the error register, 1001h (CiA 301 table 51).
pub mod register {
    /// Any error; set with each of the others.
    pub const GENERIC: u8 = 1 << 0;
    /// Communication error.
    pub const COMMUNICATION: u8 = 1 << 4;
    /// Manufacturer-specific error.
    pub const MANUFACTURER: u8 = 1 << 7;
}

/// The content of an emergency message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Emergency {
    /// What happened.
    pub code: u16,
    /// The error register, 1001h.
    pub register: u8,
    /// Defined by the manufacturer.
    pub detail: [u8; 5],
}

impl Emergency {
    /// Parses the data of the frame.
    #[must_use]
    pub const fn parse(bytes: &[u8; 8]) -> Self {
        let [low, high, register, a, b, c, d, e] = *bytes;
        Self { code: u16::from_le_bytes([low, high]), register, detail: [a, b, c, d, e] }
    }

    /// The data of the frame.
    #[must_use]
    pub const fn emit(&self) -> [u8; 8] {
        let [low, high] = self.code.to_le_bytes();
        let [a, b, c, d, e] = self.detail;
        [low, high, self.register, a, b, c, d, e]
    }
}

/// The driver's status in the form of CAN overrun: in bytes 5 and 6 of the frame, counted from 0
/// (SYS TEC manual L-1112d_10, section 3.4.9).
#[must_use]
pub const fn driver_status(status: u16) -> [u8; 5] {
    let [low, high] = status.to_le_bytes();
    [0, 0, low, high, 0]
}

/// The errors of a device.
#[derive(Clone, Debug, Default)]
pub struct Emcy {
    register: u8,
    /// Newest first, as in 1003h; the first `remembered` entries are valid.
    history: [u32; HISTORY],
    remembered: u8,
    /// Messages to send, oldest first; the first `waiting` entries are valid.
    queue: [[u8; 8]; QUEUE],
    waiting: u8,
}

impl Emcy {
    /// No errors.
    #[must_use]
    pub const fn new() -> Self {
        Self { register: 0, history: [0; HISTORY], remembered: 0, queue: [[0; 8]; QUEUE], waiting: 0 }
    }

    /// The value of 1001h.
    #[must_use]
    pub const fn register(&self) -> u8 {
        self.register
    }

    /// Reports an error. It is sent and recorded once; its bits stay in the error register until
    /// [`clear`](Self::clear).
    pub fn raise(&mut self, code: u16, bits: u8, detail: [u8; 5]) {
        self.register |= bits | register::GENERIC;
        let [low, high] = code.to_le_bytes();
        let newest = u32::from_le_bytes([low, high, detail[0], detail[1]]);
        let [a, b, c, _] = self.history;
        self.history = [newest, a, b, c];
        self.remembered = (self.remembered + 1).min(HISTORY as u8);
        self.send(code, detail);
    }

    /// Sends a message that is not an error: neither the error register nor 1003h changes.
    pub fn announce(&mut self, code: u16, detail: [u8; 5]) {
        self.send(code, detail);
    }

    /// Reports that the cause of these bits has ended. A message contains the remaining bits; no
    /// message is sent if none of the bits was set.
    pub fn clear(&mut self, bits: u8) {
        let bits = bits & self.register & !register::GENERIC;
        let only_generic = self.register == register::GENERIC;
        if bits == 0 && !only_generic {
            return;
        }
        self.register &= !bits;
        if self.register == register::GENERIC {
            self.register = 0;
        }
        self.send(code::RESET, [0; 5]);
    }

    /// Reports an event of the line.
    pub fn line_event(&mut self, event: LineEvent) {
        let (code, status) = match event {
            LineEvent::Active => return self.clear(register::COMMUNICATION),
            LineEvent::Passive => (code::CAN_PASSIVE, 0),
            LineEvent::Lost(status) => (code::CAN_OVERRUN, status),
            LineEvent::Recovered => (code::BUS_OFF_RECOVERED, 0),
        };
        self.raise(code, register::COMMUNICATION, driver_status(status));
        // Lost frames and bus-off have ended when they are reported; error passive has not.
        if event != LineEvent::Passive {
            self.clear(register::COMMUNICATION);
        }
    }

    /// The data of the next emergency to send, `None` if there is none.
    pub fn next_message(&mut self) -> Option<[u8; 8]> {
        self.waiting = self.waiting.checked_sub(1)?;
        let [oldest, a, b, c] = self.queue;
        self.queue = [a, b, c, oldest];
        Some(oldest)
    }

    /// Queues a message. If the queue is full, the message is dropped: the first errors matter
    /// most, and 1003h contains the latest.
    fn send(&mut self, code: u16, detail: [u8; 5]) {
        if let Some(free) = self.queue.get_mut(usize::from(self.waiting)) {
            *free = Emergency { code, register: self.register, detail }.emit();
            self.waiting += 1;
        }
    }

    /// Reads 1001h, 1003h or 1014h of this node; `None` for every other address.
    ///
    /// # Errors
    /// [`AbortCode::NO_DATA`] for an empty entry of 1003h.
    pub fn read(&self, node: NodeId, at: Address, buf: &mut [u8]) -> Option<Result<usize, AbortCode>> {
        Some(match (at.index, at.sub) {
            (ERROR_REGISTER, 0) => put(buf, &[self.register]),
            (ERROR_FIELD, 0) => put(buf, &[self.remembered]),
            (ERROR_FIELD, sub) if sub <= self.remembered => {
                put(buf, &self.history[usize::from(sub) - 1].to_le_bytes())
            }
            (ERROR_FIELD, _) => Err(AbortCode::NO_DATA),
            (COB_ID_EMCY, 0) => put(buf, &u32::from(CobId::emcy(node).get()).to_le_bytes()),
            _ => return None,
        })
    }

    /// Writes 1003h/0: the value 0 deletes all errors; `None` for every other address.
    ///
    /// # Errors
    /// [`AbortCode::INVALID_VALUE`] for another value.
    pub fn write(&mut self, at: Address, data: &[u8]) -> Option<Result<(), AbortCode>> {
        if at != Address::new(ERROR_FIELD, 0) {
            return None;
        }
        if data != [0] {
            return Some(Err(AbortCode::INVALID_VALUE));
        }
        self.remembered = 0;
        Some(Ok(()))
    }
}
