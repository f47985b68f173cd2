//! A CANopen device as small as an update needs it, for applications without a CANopen stack: boot-up,
//! heartbeat, NMT slave, and an SDO server with expedited transfers, and segmented ones for texts
//! (CiA 301).
//!
//! | object | access | what it is |
//! |---|---|---|
//! | 1000h | ro | device type: anything but the bootloader's |
//! | 1001h | ro | error register: 0 |
//! | 1008h | const | device name, if it has one |
//! | 100Ah | const | software version: that of the program's label, if it has one |
//! | 1017h | rw | heartbeat time in ms, until the next reset |
//! | 1018h/1–4 | ro | vendor-ID, product code, revision, serial number |
//! | 1F51h/n | rw | program control |
//! | 1F56h/n | ro | CRC of the program |
//! | 1F57h/n | ro | flash status: 0 |
//! | 2005h/n | ro | version of the program: that of its record, or of its label where a debugger wrote it |
//! | 2007h/1 | const | sub-index of the bootloader itself in the objects above; 0 if it cannot be renewed |
//!
//! Every other request gets the SDO abort that CiA 301 has for it, or nothing where it is no request.
//!
//! What the owner does:
//!
//! - each data frame with one of [`identifiers`](Responder::identifiers) into
//!   [`handle`](Responder::handle), and its answer onto the bus;
//! - after that, and every few milliseconds, [`poll`](Responder::poll) until it gives no frame;
//! - then [`proceed`](Responder::proceed), which says when to leave.

use core::fmt::{self, Write as _};

use shared_abi::block_file::ProgramVersion;
pub use shared_abi::bxcan::Frame;
use shared_abi::label::Label;
use shared_abi::warm_start::BootRequest;

use crate::abort::Abort;
use crate::bootloader::Services;
use crate::departure::has_reached;
use crate::departure::Next;
use crate::program_control::{
    ProgramControl, Reply, Value, PROGRAM_CONTROL, PROGRAM_REGION, PROGRAM_VERSION,
};

const DEVICE_NAME: u16 = 0x1008;
const SOFTWARE_VERSION: u16 = 0x100A;

/// The values by which the device identifies itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Device {
    /// 1000h: 0 for a device without a standardised profile. Not 10000000h, by which a host recognises
    /// the bootloader.
    pub device_type: u32,
    /// 1008h: that of the bootloader, by which a host finds the board. Without a text the object does
    /// not exist.
    pub name: &'static str,
    /// The label of this program (`label::own`), which gives 100Ah and 2005h.
    pub label: Option<Label>,
    /// 1018h/1, assigned by CiA; that of the bootloader.
    pub vendor_id: u32,
    /// 1018h/2; that of the bootloader.
    pub product_code: u32,
    /// 1018h/3.
    pub revision: u32,
    /// 1018h/4: [`Start::serial_number`](crate::Start::serial_number).
    pub serial_number: u32,
    /// 1017h, in ms; 0 for no heartbeat.
    pub heartbeat_ms: u16,
}

/// The state of a node (CiA 301 section 7.3.2.2); the values are the byte of a heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Nmt {
    /// The boot-up has yet to be sent.
    BootUp = 0,
    /// Neither SDO nor PDO are served.
    Stopped = 4,
    /// All is served.
    Operational = 5,
    /// SDO is served.
    PreOperational = 127,
}

/// The device on the bus.
#[derive(Clone, Debug)]
pub struct Responder {
    device: Device,
    node_id: u8,
    control: ProgramControl,
    nmt: Nmt,
    /// 100Ah; empty without a label.
    version: VersionText,
    sending: Option<Sending>,
    /// The time of the last heartbeat.
    beaten: u32,
    /// No frame is taken or sent any more.
    silent: bool,
}

/// The content of an object.
enum Content<'v> {
    /// 1 to 4 bytes.
    Number(Value),
    Text(&'v [u8]),
}

/// A text that is being sent in segments.
#[derive(Clone, Copy, Debug)]
struct Sending {
    index: u16,
    /// How many of its bytes were sent.
    sent: usize,
    /// [`TOGGLE`] or 0, as in the next request.
    toggle: u8,
}

const TOGGLE: u8 = 1 << 4;

/// The text of 100Ah, at most `V255.255r65535`.
#[derive(Clone, Copy, Debug, Default)]
struct VersionText {
    bytes: [u8; 14],
    len: usize,
}

impl VersionText {
    fn new(version: u32) -> Self {
        let mut text = Self::default();
        // It has room for the longest.
        let _ = write!(text, "{}", ProgramVersion(version));
        text
    }
}

impl fmt::Write for VersionText {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let room = self.bytes[self.len..].get_mut(..text.len()).ok_or(fmt::Error)?;
        room.copy_from_slice(text.as_bytes());
        self.len += text.len();
        Ok(())
    }
}

impl Responder {
    /// A device with this node-ID ([`Start::node_id`](crate::Start::node_id)) that has yet to send its
    /// boot-up. `None` for a node-ID that is not 1 to 127.
    #[must_use]
    pub fn new(device: Device, node_id: u8, control: ProgramControl) -> Option<Self> {
        (1..=127).contains(&node_id).then_some(Self {
            device,
            node_id,
            control,
            nmt: Nmt::BootUp,
            version: device.label.map_or_else(VersionText::default, |label| VersionText::new(label.version)),
            sending: None,
            beaten: 0,
            silent: false,
        })
    }

    /// The identifiers to let through: NMT and the SDO requests of this node.
    #[must_use]
    pub const fn identifiers(&self) -> [u16; 2] {
        [0, self.control.sdo().request + self.node_id as u16]
    }

    /// Program control, to confirm this program with
    /// ([`confirm`](ProgramControl::confirm)).
    pub fn control(&mut self) -> &mut ProgramControl {
        &mut self.control
    }

    /// Whether the device is about to leave ([`ProgramControl::leaving`]): what stands must not
    /// start to move.
    #[must_use]
    pub fn leaving(&self) -> bool {
        self.control.leaving()
    }

    /// Whether an NMT master has started the node: it is OPERATIONAL.
    #[must_use]
    pub fn is_operational(&self) -> bool {
        self.nmt == Nmt::Operational
    }

    /// Takes any data frame received; gives the answer to it, if there is one.
    pub fn handle(&mut self, frame: &Frame, now: u32, services: &mut impl Services) -> Option<Frame> {
        // Before its boot-up a node serves nothing.
        if self.silent || self.nmt == Nmt::BootUp {
            return None;
        }
        match (frame.id(), frame.data()) {
            (0, &[command, node]) if node == 0 || node == self.node_id => {
                self.command(command, now);
                None
            }
            (id, &[a, b, c, d, e, f, g, h])
                if id == self.control.sdo().request + u16::from(self.node_id) && self.nmt != Nmt::Stopped =>
            {
                let bytes = self.request([a, b, c, d, e, f, g, h], now, services)?;
                Frame::new(self.control.sdo().response + u16::from(self.node_id), &bytes)
            }
            _ => None,
        }
    }

    /// The next boot-up or heartbeat to send; `None` if none is due.
    pub fn poll(&mut self, now: u32) -> Option<Frame> {
        if self.silent {
            return None;
        }
        let state = match self.nmt {
            Nmt::BootUp => {
                self.nmt = Nmt::PreOperational;
                Nmt::BootUp
            }
            state => {
                let period = u32::from(self.device.heartbeat_ms);
                if period == 0 || !has_reached(now, self.beaten.wrapping_add(period)) {
                    return None;
                }
                state
            }
        };
        self.beaten = now;
        Frame::new(0x700 + u16::from(self.node_id), &[state as u8])
    }

    /// Goes on with the way out ([`ProgramControl::proceed`]). `bus_idle`: all frames that the
    /// responder gave are on the bus and were acknowledged.
    pub fn proceed(&mut self, bus_idle: bool, now: u32) -> Next<BootRequest> {
        let next = self.control.proceed(bus_idle, now);
        self.silent = next != Next::Serve;
        next
    }

    /// A command of the NMT master (CiA 301 section 7.2.8.3.1).
    fn command(&mut self, command: u8, now: u32) {
        self.sending = None;
        self.nmt = match command {
            0x01 => Nmt::Operational,
            0x02 => Nmt::Stopped,
            0x80 => Nmt::PreOperational,
            0x81 => return self.control.nmt_reset(now),
            0x82 => Nmt::BootUp,
            _ => return,
        };
    }

    /// The answer to an SDO request (CiA 301 section 7.2.4.3).
    fn request(&mut self, bytes: [u8; 8], now: u32, services: &mut impl Services) -> Option<[u8; 8]> {
        let [command, low, high, sub, data @ ..] = bytes;
        let index = u16::from_le_bytes([low, high]);
        // Whatever is no request for the next segment ends the transfer.
        let sending = self.sending.take();
        let answered = match command >> 5 {
            1 => self.download(command, index, sub, &data, now, services),
            2 => self.initiate_upload(index, sub, services).map(Some),
            3 => match sending {
                Some(sending) => return Some(self.segment(command, sending)),
                None => Err(Abort::COMMAND),
            },
            // The client ends a transfer; there is no answer to that.
            4 => return None,
            // No segmented download and no block transfer.
            _ => Err(Abort::COMMAND),
        };
        let (command, data) = match answered {
            Ok(answer) => answer?,
            Err(Abort(code)) => (0x80, code.to_le_bytes()),
        };
        // Only an initiate names an object: of the block transfers, that has a subcommand of 0. An abort of
        // another request has that of the transfer it ends (CiA 301 section 7.2.4.3.17).
        let names_object = match bytes[0] >> 5 {
            1 | 2 => true,
            5 => bytes[0] & 3 == 0,
            6 => bytes[0] & 1 == 0,
            _ => false,
        };
        let of_transfer = (sending.map_or(0, |sending| sending.index), 0);
        let (index, sub) = if names_object { (index, sub) } else { of_transfer };
        Some(answer(command, index, sub, data))
    }

    /// An initiate upload; the command and data of its answer: the value, or the size of a text that
    /// comes in segments.
    fn initiate_upload(
        &mut self,
        index: u16,
        sub: u8,
        services: &mut impl Services,
    ) -> Result<(u8, [u8; 4]), Abort> {
        match self.value(index, sub, services)? {
            Content::Number(value) => {
                let mut bytes = [0; 4];
                bytes[..value.len()].copy_from_slice(&value);
                Ok((0x43 | (4 - value.len() as u8) << 2, bytes))
            }
            Content::Text(text) => {
                let size = text.len() as u32;
                self.sending = Some(Sending { index, sent: 0, toggle: 0 });
                Ok((0x41, size.to_le_bytes()))
            }
        }
    }

    /// The next segment of a text (CiA 301 section 7.2.4.3.7).
    fn segment(&mut self, command: u8, sending: Sending) -> [u8; 8] {
        let Sending { index, sent, toggle } = sending;
        if command & TOGGLE != toggle {
            let Abort(code) = Abort::TOGGLE;
            return answer(0x80, index, 0, code.to_le_bytes());
        }
        let rest = self.text(index).and_then(|text| text.get(sent..)).unwrap_or_default();
        let part = &rest[..rest.len().min(7)];
        let is_last = part.len() == rest.len();
        let mut answer = [0; 8];
        answer[0] = toggle | (7 - part.len() as u8) << 1 | u8::from(is_last);
        answer[1..=part.len()].copy_from_slice(part);
        let sent = sent + part.len();
        self.sending = (!is_last).then_some(Sending { index, sent, toggle: toggle ^ TOGGLE });
        answer
    }

    /// An initiate download; the command and data of its answer, `None` where it is withheld.
    fn download(
        &mut self,
        command: u8,
        index: u16,
        sub: u8,
        data: &[u8; 4],
        now: u32,
        services: &mut impl Services,
    ) -> Result<Option<(u8, [u8; 4])>, Abort> {
        // An object that cannot be read does not exist.
        let own_len = match self.value(index, sub, services)? {
            Content::Number(value) => value.len(),
            Content::Text(_) => return Err(Abort::READ_ONLY),
        };
        if !matches!((index, sub), (0x1017, 0) | (PROGRAM_CONTROL, 1..)) {
            return Err(Abort::READ_ONLY);
        }
        const EXPEDITED: u8 = 1 << 1;
        const SIZE_INDICATED: u8 = 1 << 0;
        if command & EXPEDITED == 0 {
            // Its data would come in segments.
            return Err(Abort::COMMAND);
        }
        // If the client does not give the size, the size of the object counts.
        let len = if command & SIZE_INDICATED == 0 { own_len } else { 4 - usize::from(command >> 2 & 3) };
        let data = &data[..len];
        if index == PROGRAM_CONTROL {
            if self.control.write(sub, data, true, now, services)? == Reply::Withhold {
                self.silent = true;
                return Ok(None);
            }
        } else {
            match data {
                &[low, high] => self.device.heartbeat_ms = u16::from_le_bytes([low, high]),
                [_] => return Err(Abort::LENGTH_TOO_LOW),
                _ => return Err(Abort::LENGTH_TOO_HIGH),
            }
            self.beaten = now;
        }
        Ok(Some((0x60, [0; 4])))
    }

    /// The content of an object.
    fn value(&self, index: u16, sub: u8, services: &mut impl Services) -> Result<Content<'_>, Abort> {
        let Device { device_type, vendor_id, product_code, revision, serial_number, heartbeat_ms, .. } =
            self.device;
        Ok(Content::Number(match (index, sub) {
            (0x1000, 0) => Value::word(device_type),
            (0x1001, 0) => Value::byte(0),
            (DEVICE_NAME | SOFTWARE_VERSION, sub) => match (self.text(index), sub) {
                (Some(text), 0) => return Ok(Content::Text(text)),
                (Some(_), _) => return Err(Abort::NO_SUB_INDEX),
                (None, _) => return Err(Abort::NO_OBJECT),
            },
            (0x1017, 0) => Value::half(heartbeat_ms),
            (0x1018, 0) => Value::byte(4),
            (0x1018, 1) => Value::word(vendor_id),
            (0x1018, 2) => Value::word(product_code),
            (0x1018, 3) => Value::word(revision),
            (0x1018, 4) => Value::word(serial_number),
            (0x1000 | 0x1001 | 0x1017 | 0x1018, _) => return Err(Abort::NO_SUB_INDEX),
            // A program that a debugger wrote has no record in the bootloader, but a label.
            (PROGRAM_VERSION, sub) if sub == self.control.program() => {
                let of_label = self.device.label.map_or(0, |label| label.version);
                Value::word(services.program_info(sub).map_or(of_label, |info| info.version))
            }
            // It does not fit into four bytes.
            (PROGRAM_REGION, _) => return Err(Abort::NO_OBJECT),
            _ => self.control.read(index, sub, services).unwrap_or(Err(Abort::NO_OBJECT))?,
        }))
    }

    /// The text of 1008h or 100Ah, if it has one.
    fn text(&self, index: u16) -> Option<&[u8]> {
        let text = match index {
            DEVICE_NAME => self.device.name.as_bytes(),
            SOFTWARE_VERSION => &self.version.bytes[..self.version.len],
            _ => return None,
        };
        (!text.is_empty()).then_some(text)
    }
}

/// An answer that names an object.
fn answer(command: u8, index: u16, sub: u8, [a, b, c, d]: [u8; 4]) -> [u8; 8] {
    let [low, high] = index.to_le_bytes();
    [command, low, high, sub, a, b, c, d]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use shared_abi::callgate::{CallgateError, ProgramArgs};
    use shared_abi::layout::stm32f407g_disc1_two::LAYOUT;
    use shared_abi::warm_start::Owed;

    use super::*;
    use crate::bootloader::Confirmed;
    use crate::start::{Defaults, Start};

    /// A bootloader that knows no other program and stores what it is asked to.
    struct Fake;

    impl Services for Fake {
        fn program_info(&mut self, _: u8) -> Result<ProgramArgs, CallgateError> {
            Err(CallgateError::Refused(-7))
        }

        fn confirm(&mut self, _: u8) -> Result<Confirmed, CallgateError> {
            Ok(Confirmed::Now)
        }
    }

    const DEVICE: Device = Device {
        device_type: 0x0002_0192,
        name: "coboot STM32F407G-DISC1",
        label: Some(Label::new(0x11, 0x22, 0x0064_0A01)),
        vendor_id: 0x11,
        product_code: 0x22,
        revision: 0x0001_0003,
        serial_number: 0xDEAD_BEEF,
        heartbeat_ms: 100,
    };

    /// Node 5, program 1 of two.
    fn before_boot_up(fresh: bool) -> Responder {
        let defaults = Defaults { node_id: Some(5), bit_rate: 125_000, serial_number: 0 };
        let start = Start { fresh, ..Start::new(None, defaults) };
        Responder::new(DEVICE, 5, ProgramControl::new(&start, &LAYOUT, 0x1234_5678)).unwrap()
    }

    fn responder() -> Responder {
        let mut responder = before_boot_up(false);
        assert_eq!(responder.poll(0), Frame::new(0x705, &[0]));
        responder
    }

    fn ask(responder: &mut Responder, request: [u8; 8]) -> Option<[u8; 8]> {
        let answer = responder.handle(&Frame::new(0x605, &request).unwrap(), 0, &mut Fake)?;
        assert_eq!(answer.id(), 0x585);
        Some(answer.data().try_into().unwrap())
    }

    /// The requests and answers as CiA 301 section 7.2.4.3.3 and 7.2.4.3.6 lays the bytes out.
    #[test]
    fn each_object_is_read_by_an_expedited_upload() {
        let mut responder = responder();
        for (object, answer) in [
            ([0x00, 0x10, 0], [0x43, 0x00, 0x10, 0, 0x92, 0x01, 0x02, 0x00]),
            ([0x01, 0x10, 0], [0x4F, 0x01, 0x10, 0, 0, 0, 0, 0]),
            ([0x17, 0x10, 0], [0x4B, 0x17, 0x10, 0, 100, 0, 0, 0]),
            ([0x18, 0x10, 0], [0x4F, 0x18, 0x10, 0, 4, 0, 0, 0]),
            ([0x18, 0x10, 1], [0x43, 0x18, 0x10, 1, 0x11, 0, 0, 0]),
            ([0x18, 0x10, 2], [0x43, 0x18, 0x10, 2, 0x22, 0, 0, 0]),
            ([0x18, 0x10, 3], [0x43, 0x18, 0x10, 3, 3, 0, 1, 0]),
            ([0x18, 0x10, 4], [0x43, 0x18, 0x10, 4, 0xEF, 0xBE, 0xAD, 0xDE]),
            ([0x51, 0x1F, 0], [0x4F, 0x51, 0x1F, 0, 2, 0, 0, 0]),
            ([0x51, 0x1F, 1], [0x4F, 0x51, 0x1F, 1, 1, 0, 0, 0]),
            ([0x51, 0x1F, 2], [0x4F, 0x51, 0x1F, 2, 3, 0, 0, 0]),
            ([0x56, 0x1F, 1], [0x43, 0x56, 0x1F, 1, 0x78, 0x56, 0x34, 0x12]),
            ([0x57, 0x1F, 1], [0x43, 0x57, 0x1F, 1, 0, 0, 0, 0]),
            ([0x05, 0x20, 0], [0x4F, 0x05, 0x20, 0, 2, 0, 0, 0]),
            // The bootloader has no record of this program: its label counts.
            ([0x05, 0x20, 1], [0x43, 0x05, 0x20, 1, 0x01, 0x0A, 0x64, 0x00]),
            ([0x05, 0x20, 2], [0x43, 0x05, 0x20, 2, 0, 0, 0, 0]),
            ([0x07, 0x20, 0], [0x4F, 0x07, 0x20, 0, 1, 0, 0, 0]),
            // The bootloader has told none.
            ([0x07, 0x20, 1], [0x4F, 0x07, 0x20, 1, 0, 0, 0, 0]),
        ] {
            let [low, high, sub] = object;
            assert_eq!(ask(&mut responder, [0x40, low, high, sub, 0, 0, 0, 0]), Some(answer), "{object:X?}");
        }
    }

    /// CiA 301 sections 7.2.4.3.6 and 7.2.4.3.7: the size, then seven bytes in each segment, with the
    /// toggle bit, the number of bytes without data, and the mark of the last one. V1.10r100 is how the
    /// SYS TEC manual writes 00640A01h.
    #[test]
    fn texts_are_read_in_segments() {
        let mut responder = responder();
        for (request, answer) in [
            ([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], *b"\x41\x08\x10\0\x17\0\0\0"),
            ([0x60, 0, 0, 0, 0, 0, 0, 0], *b"\x00coboot "),
            ([0x70, 0, 0, 0, 0, 0, 0, 0], *b"\x10STM32F4"),
            ([0x60, 0, 0, 0, 0, 0, 0, 0], *b"\x0007G-DIS"),
            ([0x70, 0, 0, 0, 0, 0, 0, 0], *b"\x1BC1\0\0\0\0\0"),
            // It is over.
            ([0x60, 0, 0, 0, 0, 0, 0, 0], *b"\x80\0\0\0\x01\0\x04\x05"),
            ([0x40, 0x0A, 0x10, 0, 0, 0, 0, 0], *b"\x41\x0A\x10\0\x09\0\0\0"),
            ([0x60, 0, 0, 0, 0, 0, 0, 0], *b"\x00V1.10r1"),
            ([0x70, 0, 0, 0, 0, 0, 0, 0], *b"\x1B00\0\0\0\0\0"),
            // The same toggle bit twice: 05030000h, and the transfer has ended.
            ([0x40, 0x0A, 0x10, 0, 0, 0, 0, 0], *b"\x41\x0A\x10\0\x09\0\0\0"),
            ([0x60, 0, 0, 0, 0, 0, 0, 0], *b"\x00V1.10r1"),
            ([0x60, 0, 0, 0, 0, 0, 0, 0], *b"\x80\x0A\x10\0\0\0\x03\x05"),
            ([0x70, 0, 0, 0, 0, 0, 0, 0], *b"\x80\0\0\0\x01\0\x04\x05"),
            // Another request ends it, too.
            ([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], *b"\x41\x08\x10\0\x17\0\0\0"),
            ([0x40, 0x01, 0x10, 0, 0, 0, 0, 0], *b"\x4F\x01\x10\0\0\0\0\0"),
            ([0x60, 0, 0, 0, 0, 0, 0, 0], *b"\x80\0\0\0\x01\0\x04\x05"),
            // Read-only, and without further sub-indices.
            ([0x23, 0x0A, 0x10, 0, 1, 0, 0, 0], *b"\x80\x0A\x10\0\x02\0\x01\x06"),
            ([0x40, 0x08, 0x10, 1, 0, 0, 0, 0], *b"\x80\x08\x10\x01\x11\0\x09\x06"),
        ] {
            assert_eq!(ask(&mut responder, request), Some(answer), "{request:X?}");
        }
        // The client ends it, or the NMT master restarts the communication.
        for (id, data) in [(0x605, &[0x80, 0, 0, 0, 0, 0, 4, 5][..]), (0, &[0x82, 5])] {
            ask(&mut responder, [0x40, 0x08, 0x10, 0, 0, 0, 0, 0]);
            assert_eq!(responder.handle(&Frame::new(id, data).unwrap(), 0, &mut Fake), None);
            responder.poll(0);
            let answer = ask(&mut responder, [0x60, 0, 0, 0, 0, 0, 0, 0]);
            assert_eq!(answer, Some([0x80, 0, 0, 0, 1, 0, 4, 5]));
        }
    }

    #[test]
    fn the_longest_version_has_room() {
        let text = VersionText::new(u32::MAX);
        assert_eq!(&text.bytes[..text.len], b"V255.255r65535");
    }

    /// 06020000h: there is no text without a name, and no version without a label.
    #[test]
    fn without_name_and_label_the_texts_do_not_exist() {
        let device = Device { name: "", label: None, ..DEVICE };
        let mut responder = Responder { device, version: VersionText::default(), ..responder() };
        for low in [0x08, 0x0A] {
            let answer = ask(&mut responder, [0x40, low, 0x10, 0, 0, 0, 0, 0]);
            assert_eq!(answer, Some([0x80, low, 0x10, 0, 0, 0, 2, 6]));
        }
        let answer = ask(&mut responder, [0x40, 0x05, 0x20, 1, 0, 0, 0, 0]);
        assert_eq!(answer, Some([0x43, 0x05, 0x20, 1, 0, 0, 0, 0]));
    }

    /// The version in the record, as the bootloader reports it, comes before the label's.
    #[test]
    fn the_record_of_a_program_has_its_version() {
        struct Recorded;
        impl Services for Recorded {
            fn program_info(&mut self, number: u8) -> Result<ProgramArgs, CallgateError> {
                Ok(ProgramArgs {
                    number: number.into(),
                    size: 9,
                    crc: 9,
                    version: 7 + u32::from(number),
                    flags: 1,
                })
            }

            fn confirm(&mut self, _: u8) -> Result<Confirmed, CallgateError> {
                Ok(Confirmed::Now)
            }
        }
        let mut responder = responder();
        for (number, version) in [(1, 8), (2, 9)] {
            let request = Frame::new(0x605, &[0x40, 0x05, 0x20, number, 0, 0, 0, 0]).unwrap();
            let answer = responder.handle(&request, 0, &mut Recorded).unwrap();
            assert_eq!(answer.data(), [0x43, 0x05, 0x20, number, version, 0, 0, 0]);
        }
    }

    /// The codes are those of CiA 301 table 22, least significant byte first.
    #[test]
    fn every_other_request_gets_the_abort_that_the_standard_has_for_it() {
        for (request, code) in [
            // 06020000h: the object does not exist.
            ([0x40, 0x09, 0x10, 0, 0, 0, 0, 0], [0, 0, 2, 6]),
            ([0x2F, 0x50, 0x1F, 1, 0, 0, 0, 0], [0, 0, 2, 6]),
            // 06090011h: the sub-index does not exist.
            ([0x40, 0x18, 0x10, 5, 0, 0, 0, 0], [0x11, 0, 9, 6]),
            ([0x40, 0x51, 0x1F, 3, 0, 0, 0, 0], [0x11, 0, 9, 6]),
            ([0x2F, 0x51, 0x1F, 3, 0x80, 0, 0, 0], [0x11, 0, 9, 6]),
            ([0x40, 0x05, 0x20, 3, 0, 0, 0, 0], [0x11, 0, 9, 6]),
            ([0x40, 0x07, 0x20, 2, 0, 0, 0, 0], [0x11, 0, 9, 6]),
            // 06010002h: read-only.
            ([0x23, 0x00, 0x10, 0, 1, 0, 0, 0], [2, 0, 1, 6]),
            ([0x2F, 0x51, 0x1F, 0, 1, 0, 0, 0], [2, 0, 1, 6]),
            ([0x23, 0x57, 0x1F, 1, 0, 0, 0, 0], [2, 0, 1, 6]),
            // 06070012h and 06070013h: too long, too short.
            ([0x2B, 0x51, 0x1F, 1, 0x80, 0, 0, 0], [0x12, 0, 7, 6]),
            ([0x23, 0x17, 0x10, 0, 0, 0, 0, 0], [0x12, 0, 7, 6]),
            ([0x2F, 0x17, 0x10, 0, 0, 0, 0, 0], [0x13, 0, 7, 6]),
            // 06090030h: the value is none of the object's.
            ([0x2F, 0x51, 0x1F, 1, 0x04, 0, 0, 0], [0x30, 0, 9, 6]),
            // 08000022h: not in the present state.
            ([0x2F, 0x51, 0x1F, 1, 0x83, 0, 0, 0], [0x22, 0, 0, 8]),
            // 05040001h: a segmented download, and a block download and upload.
            ([0x21, 0x51, 0x1F, 1, 1, 0, 0, 0], [1, 0, 4, 5]),
            ([0xC6, 0x50, 0x1F, 1, 0, 1, 0, 0], [1, 0, 4, 5]),
            ([0xA4, 0x00, 0x10, 0, 127, 0, 0, 0], [1, 0, 4, 5]),
        ] {
            let mut expected = request;
            expected[0] = 0x80;
            expected[4..].copy_from_slice(&code);
            assert_eq!(ask(&mut responder(), request), Some(expected), "{request:X?}");
        }
        // Parts of a transfer name no object, and there is no transfer.
        for command in [0x00, 0x10, 0x60, 0x70, 0xA1, 0xA2, 0xA3, 0xC1, 0xE0, 0xFF] {
            let answer = ask(&mut responder(), [command, 1, 2, 3, 4, 5, 6, 7]);
            assert_eq!(answer, Some([0x80, 0, 0, 0, 1, 0, 4, 5]), "{command:02X}h");
        }
        // In a transfer, they end it.
        for command in [0x00, 0xA1, 0xA2, 0xA3, 0xC1, 0xE0] {
            let mut responder = responder();
            ask(&mut responder, [0x40, 0x08, 0x10, 0, 0, 0, 0, 0]);
            let answer = ask(&mut responder, [command, 1, 2, 3, 4, 5, 6, 7]);
            assert_eq!(answer, Some([0x80, 0x08, 0x10, 0, 1, 0, 4, 5]), "{command:02X}h");
        }
    }

    #[test]
    fn what_is_no_request_to_this_node_is_not_answered() {
        let mut responder = responder();
        let silent = |responder: &mut Responder, id, data: &[u8]| {
            assert_eq!(
                responder.handle(&Frame::new(id, data).unwrap(), 0, &mut Fake),
                None,
                "{id:X} {data:X?}"
            );
        };
        for (id, data) in [
            (0x606, &[0x40, 0, 0x10, 0, 0, 0, 0, 0][..]),
            (0x585, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]),
            (0x605, &[0x40, 0, 0x10, 0, 0, 0, 0]),
            (0x605, &[]),
            // The client ends a transfer.
            (0x605, &[0x80, 0, 0x10, 0, 0, 0, 4, 5]),
            (0x000, &[0x02, 6]),
            (0x000, &[0x02]),
            (0x000, &[0x03, 5]),
        ] {
            silent(&mut responder, id, data);
        }
        assert!(ask(&mut responder, [0x40, 0, 0x10, 0, 0, 0, 0, 0]).is_some(), "nothing has stopped it");
        // Stopped, a node serves no SDO; before its boot-up nothing.
        silent(&mut responder, 0, &[0x02, 0]);
        silent(&mut responder, 0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
        silent(&mut before_boot_up(false), 0x605, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
        assert_eq!(Frame::new(0x800, &[]), None);
        assert_eq!(Frame::new(0, &[0; 9]), None);
    }

    #[test]
    fn boot_up_and_heartbeat_tell_the_state() {
        let mut responder = responder();
        assert_eq!(responder.poll(0), None);
        assert_eq!(responder.poll(99), None);
        assert_eq!(responder.poll(100), Frame::new(0x705, &[0x7F]));
        for (command, state) in [(0x01, 0x05), (0x02, 0x04), (0x80, 0x7F)] {
            responder.handle(&Frame::new(0, &[command, 5]).unwrap(), 100, &mut Fake);
            assert_eq!(responder.is_operational(), command == 1);
            assert_eq!(responder.poll(150), None);
            assert_eq!(responder.poll(200), Frame::new(0x705, &[state]));
            responder.beaten = 100;
        }
        // Reset communication, then a heartbeat of 500 ms, then none.
        responder.handle(&Frame::new(0, &[0x82, 0]).unwrap(), 200, &mut Fake);
        assert_eq!(responder.poll(200), Frame::new(0x705, &[0]));
        let written = Some([0x60, 0x17, 0x10, 0, 0, 0, 0, 0]);
        assert_eq!(ask(&mut responder, [0x2B, 0x17, 0x10, 0, 0xF4, 0x01, 0, 0]), written);
        assert_eq!((responder.poll(499), responder.poll(500)), (None, Frame::new(0x705, &[0x7F])));
        assert_eq!(ask(&mut responder, [0x2B, 0x17, 0x10, 0, 0, 0, 0, 0]), written);
        assert_eq!(responder.poll(60_000), None);
    }

    /// The size may be announced or not (CiA 301: the s bit).
    #[test]
    fn a_call_back_is_acknowledged_and_the_device_leaves_behind_the_pause() {
        for command in [0x2F, 0x22] {
            let mut responder = responder();
            let answer = ask(&mut responder, [command, 0x51, 0x1F, 1, 0x80, 0, 0, 0]);
            assert_eq!(answer, Some([0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]));
            assert_eq!(responder.proceed(false, 1), Next::Serve);
            assert_eq!(responder.proceed(true, 2), Next::Serve);
            assert!(ask(&mut responder, [0x40, 0, 0x10, 0, 0, 0, 0, 0]).is_some(), "served in the pause");
            assert_eq!(responder.proceed(true, 13), Next::Leave(BootRequest::Stay));
            assert_eq!(responder.poll(60_000), None);
        }
    }

    #[test]
    fn stop_is_left_to_the_bootloader_and_the_device_is_silent() {
        let mut responder = responder();
        let mut stays =
            Responder { control: responder.control.clone().asking(|| false), ..responder.clone() };
        let refused = Some([0x80, 0x51, 0x1F, 1, 0x22, 0, 0, 8]);
        assert_eq!(ask(&mut stays, [0x2F, 0x51, 0x1F, 1, 0, 0, 0, 0]), refused);
        assert_eq!((stays.proceed(true, 1), stays.leaving()), (Next::Serve, false));
        assert_eq!(ask(&mut responder, [0x2F, 0x51, 0x1F, 1, 0, 0, 0, 0]), None);
        assert_eq!(ask(&mut responder, [0x40, 0, 0x10, 0, 0, 0, 0, 0]), None);
        assert!(responder.leaving() && responder.poll(1000).is_none());
        let owed = Owed { program: 1, value: 0, node_id: 5 };
        assert_eq!(responder.proceed(true, 1), Next::Leave(BootRequest::Owed(owed)));
    }

    #[test]
    fn nmt_reset_node_restarts_as_after_a_power_on() {
        let mut responder = responder();
        responder.handle(&Frame::new(0, &[0x81, 0]).unwrap(), 0, &mut Fake);
        assert_eq!(responder.proceed(true, 0), Next::Serve);
        assert_eq!(responder.proceed(true, 11), Next::Leave(BootRequest::PowerOn));
    }

    #[test]
    fn a_fresh_program_is_confirmed_by_the_first_80h() {
        let mut responder = before_boot_up(true);
        responder.poll(0);
        assert!(ask(&mut responder, [0x2F, 0x51, 0x1F, 1, 0x80, 0, 0, 0]).is_some());
        assert_eq!((responder.proceed(true, 20), responder.proceed(true, 900)), (Next::Serve, Next::Serve));
    }

    #[test]
    fn only_a_node_id_of_the_standard_makes_a_node() {
        let control = responder().control().clone();
        for (node_id, good) in [(0, false), (1, true), (127, true), (128, false), (255, false)] {
            assert_eq!(Responder::new(DEVICE, node_id, control.clone()).is_some(), good, "{node_id}");
        }
    }

    proptest! {
        /// Whatever comes: a request that is no abort gets one answer on the server's identifier, with
        /// the layout of the standard; everything else silence.
        #[test]
        fn any_frame_gets_an_answer_or_silence(
            frames in prop::collection::vec(
                (prop_oneof![Just(0x605_u16), Just(0), 0..0x800_u16], prop::collection::vec(any::<u8>(), 0..=8)),
                1..40,
            ),
            on_objects in prop_oneof![Just(0), Just(0x1F51_u16), Just(0x1008)],
        ) {
            let mut responder = responder();
            for (at, (id, mut data)) in frames.into_iter().enumerate() {
                if let (1.., [_, low, high, sub, ..]) = (on_objects, &mut data[..]) {
                    [*low, *high] = on_objects.to_le_bytes();
                    *sub %= 2;
                }
                let frame = Frame::new(id, &data).unwrap();
                let stopped = responder.nmt == Nmt::Stopped;
                let booting = responder.nmt == Nmt::BootUp;
                let silent = responder.silent;
                let answer = responder.handle(&frame, at as u32, &mut Fake);
                let is_request = id == 0x605 && data.len() == 8 && data[0] >> 5 != 4;
                if !is_request || stopped || booting || silent {
                    prop_assert_eq!(answer, None);
                } else if let Some(answer) = answer {
                    prop_assert_eq!((answer.id(), answer.data().len()), (0x585, 8));
                    match (data[0] >> 5, answer.data()[0]) {
                        (1, 0x60) | (2, 0x41 | 0x43 | 0x4B | 0x4F) | (3, 0..0x20) | (_, 0x80) => {}
                        other => prop_assert!(false, "{other:X?}"),
                    }
                } else {
                    // An answer that is left to the bootloader: STOP or CLEAR.
                    prop_assert!(data[0] >> 5 == 1 && data[1..3] == [0x51, 0x1F] && matches!(data[4], 0 | 3));
                }
                responder.poll(at as u32);
            }
        }
    }

    /// CiA 301 table 37: NMT has identifier 0, requests to node 5 have 605h.
    #[test]
    fn the_device_lets_its_own_identifiers_through() {
        assert_eq!(responder().identifiers(), [0, 0x605]);
    }
}
