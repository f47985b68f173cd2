//! A CANopen stack as small as can be, in the place of yours: NMT, heartbeat and an SDO server with
//! expedited transfers (CiA 301). It knows nothing of a bootloader.

use heapless::Vec;

/// An object's value, of up to 4 bytes, little-endian.
pub type Value = Vec<u8, 4>;

/// The code of an SDO abort (CiA 301 table 22).
#[derive(Clone, Copy)]
pub struct AbortCode(pub u32);

impl AbortCode {
    const COMMAND: Self = Self(0x0504_0001);
    pub const READ_ONLY: Self = Self(0x0601_0002);
    pub const NO_OBJECT: Self = Self(0x0602_0000);
    pub const LENGTH: Self = Self(0x0607_0010);
}

/// What is done about a download that was taken.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Confirmation {
    /// The server sends its positive answer.
    Send,
    /// The server sends nothing.
    Withhold,
}

/// The object dictionary.
pub trait Dictionary {
    /// Reads an object.
    fn read(&mut self, index: u16, sub: u8) -> Result<Value, AbortCode>;

    /// Writes an object, before the answer is sent.
    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<Confirmation, AbortCode>;
}

/// What an NMT master or a client wants.
pub enum Event {
    /// This answer is to be sent.
    Answer(u16, [u8; 8]),
    /// NMT reset node.
    Reset,
}

/// The states of a node; the values are the byte of a heartbeat.
#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    BootUp = 0,
    Stopped = 4,
    Operational = 5,
    PreOperational = 127,
}

/// A node.
pub struct Node {
    id: u8,
    /// The bases of the COB-IDs of SDO requests and answers.
    sdo: [u16; 2],
    state: State,
    heartbeat_ms: u32,
    beaten: u32,
}

impl Node {
    /// A node with this node-ID, 1 to 127, and these bases of SDO requests and answers, that has yet to send its boot-up.
    pub fn new(id: u8, sdo: [u16; 2], heartbeat_ms: u32) -> Option<Self> {
        (1..=127).contains(&id).then_some(Self { id, sdo, state: State::BootUp, heartbeat_ms, beaten: 0 })
    }

    /// The identifiers of what the node receives: NMT and its SDO requests.
    pub fn identifiers(&self) -> [u16; 2] {
        [0, self.sdo[0] + u16::from(self.id)]
    }

    /// The boot-up or heartbeat that is to be sent.
    pub fn poll(&mut self, now: u32) -> Option<(u16, [u8; 1])> {
        let state = self.state;
        if state == State::BootUp {
            self.state = State::PreOperational;
        } else if now.wrapping_sub(self.beaten) < self.heartbeat_ms {
            return None;
        }
        self.beaten = now;
        Some((0x700 + u16::from(self.id), [state as u8]))
    }

    /// Takes a frame.
    pub fn handle(&mut self, id: u16, data: &[u8], objects: &mut impl Dictionary) -> Option<Event> {
        match (id, data) {
            (0, &[command, node]) if node == 0 || node == self.id => {
                self.state = match command {
                    0x01 => State::Operational,
                    0x02 => State::Stopped,
                    0x80 => State::PreOperational,
                    0x81 => return Some(Event::Reset),
                    0x82 => State::BootUp,
                    _ => return None,
                };
                None
            }
            (id, data) if id == self.sdo[0] + u16::from(self.id) && self.state != State::Stopped => {
                let answer = answer(*<&[u8; 8]>::try_from(data).ok()?, objects)?;
                Some(Event::Answer(self.sdo[1] + u16::from(self.id), answer))
            }
            _ => None,
        }
    }
}

/// The answer to an SDO request.
fn answer(request: [u8; 8], objects: &mut impl Dictionary) -> Option<[u8; 8]> {
    let [command, low, high, sub, data @ ..] = request;
    let index = u16::from_le_bytes([low, high]);
    let (command, value) = match command >> 5 {
        1 => match download(command, index, sub, &data, objects) {
            Ok(Confirmation::Send) => (0x60, [0; 4]),
            Ok(Confirmation::Withhold) => return None,
            Err(AbortCode(code)) => (0x80, code.to_le_bytes()),
        },
        2 => match objects.read(index, sub) {
            Ok(value) => {
                let mut bytes = [0; 4];
                bytes[..value.len()].copy_from_slice(&value);
                (0x43 | (4 - value.len() as u8) << 2, bytes)
            }
            Err(AbortCode(code)) => (0x80, code.to_le_bytes()),
        },
        // The client ends a transfer.
        4 => return None,
        _ => (0x80, AbortCode::COMMAND.0.to_le_bytes()),
    };
    let [a, b, c, d] = value;
    Some([command, low, high, sub, a, b, c, d])
}

/// An expedited download.
fn download(
    command: u8,
    index: u16,
    sub: u8,
    data: &[u8; 4],
    objects: &mut impl Dictionary,
) -> Result<Confirmation, AbortCode> {
    const EXPEDITED: u8 = 1 << 1;
    const SIZE_TOLD: u8 = 1 << 0;
    if command & EXPEDITED == 0 {
        return Err(AbortCode::COMMAND);
    }
    // A client that does not announce the size means that of the object.
    let size = match command & SIZE_TOLD {
        0 => objects.read(index, sub)?.len(),
        _ => 4 - usize::from(command >> 2 & 3),
    };
    objects.write(index, sub, &data[..size])
}
