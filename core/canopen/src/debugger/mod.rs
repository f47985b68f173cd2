//! The debugger interface, object 1025h (ESAcademy "CANopen compliant bootloader and debugger
//! cores"; feature `debugger`).
//!
//! **With it, every node on the bus can read and write the memory of the device.** It is for the
//! bench, never for a product.
//!
//! | sub-index | |
//! |---|---|
//! | 1 | command, 8 bytes: 0 read or 1 write, reserved, number of bytes (16 bits), address (32 bits) |
//! | 2 | status: 0 done, 1 done and there are data, 2 refused or failed, FFh waits for data (CiA 301, 1025h) |
//! | 4 | data: a domain of exactly that number of bytes |
//!
//! Sub-index 3, the reply of CiA 301, does not exist, as in that document. A command permits any
//! number of reads or writes of its data, until the next command.
//!
//! | the client | abort |
//! |---|---|
//! | sends a command that does not have 8 bytes | 06070012h, 06070013h |
//! | sends an unknown command, a command for no bytes, or a command for bytes without permission |
//! 06090030h |
//! | sends more or fewer data than its command said | 06070012h, 06070013h |
//! | reads data without a command to read | 08000024h |
//! | writes data without a command to write | 08000022h |
//! | sends any request to a device with locked memory | 08000022h |
//!
//! A device adds [`ENTRIES`] to its table, keeps a [`Debugger`] beside its own state and passes
//! [`Debugger::attach`] to its slave instead of itself. When the program stops, the device calls
//! [`Debugger::stopped`].

mod command;

use core::task::Poll;

use crate::abort::AbortCode;
use crate::bit_rate::BitRate;
use crate::frame::{Channel, NodeId};
use crate::line::LineEvent;
use crate::lss::{LssDevice, StoreError};
use crate::od::{put, Access, Address, DataType, Entry, Exchange, Objects, Reply};
use crate::program::ERROR_REGISTER;
use crate::slave::SlaveDevice;

pub use command::{Command, Kind, Stop, USER_SOFTWARE};

/// Index of the object.
pub const DEBUGGER: u16 = 0x1025;
/// The command, written.
pub const COMMAND: Address = Address::new(DEBUGGER, 1);
/// The state of the command, one of [`status`].
pub const STATUS: Address = Address::new(DEBUGGER, 2);
/// The bytes of the memory.
pub const DATA: Address = Address::new(DEBUGGER, 4);

/// 1025h.
pub const ENTRIES: [Entry; 4] = [
    Entry::record(DEBUGGER, "OS debugger interface", 4),
    Entry::sub(DEBUGGER, COMMAND.sub, "Command", DataType::OctetString, Access::Wo),
    Entry::sub(DEBUGGER, STATUS.sub, "Status", DataType::Unsigned8, Access::Ro).default(0),
    Entry::sub(DEBUGGER, DATA.sub, "Data", DataType::Domain, Access::Rw),
];

/// Values of the status (CiA 301, objects 1023h and 1025h).
pub mod status {
    /// The last command ended without an error.
    pub const DONE: u8 = 0;
    /// The last command ended without an error, and there are data.
    pub const REPLY: u8 = 1;
    /// The last command or its data were refused.
    pub const ERROR: u8 = 2;
    /// The command waits for its data.
    pub const EXECUTING: u8 = 0xFF;
}

/// The memory that the interface accesses.
///
/// It is read and written in pieces of at most [`PIECE`] bytes, within a command that it has
/// permitted. Each piece starts at a multiple of `PIECE` from the command's address.
pub trait Memory {
    /// Whether the device refuses all access to its memory.
    fn is_locked(&mut self) -> bool;

    /// Whether all bytes of this command may be accessed. Address and length may have any value.
    fn allows(&mut self, command: &Command) -> bool;

    /// Reads a piece.
    ///
    /// # Errors
    /// Sent to the client as abort, if the bytes cannot be read at present.
    fn read(&mut self, address: u32, bytes: &mut [u8]) -> Result<(), AbortCode>;

    /// Writes a piece.
    ///
    /// # Errors
    /// Sent to the client as abort, if the bytes cannot be written at present.
    fn write(&mut self, address: u32, bytes: &[u8]) -> Result<(), AbortCode>;
}

/// The most bytes of one read or write. A longer read or write is carried out piece by piece during
/// the transfer; a shorter write is carried out when all its data have arrived.
pub const PIECE: usize = 128;

/// The state of the interface.
#[derive(Debug)]
pub struct Debugger<M> {
    memory: M,
    state: State,
    status: u8,
    piece: [u8; PIECE],
    stop: Option<(Stop, u32)>,
}

/// The last command, and the number of its bytes that were transferred.
#[derive(Clone, Copy, Debug)]
enum State {
    Idle,
    /// `held` is the offset of the piece that is in the buffer.
    Reading {
        address: u32,
        len: u32,
        held: u32,
    },
    Writing {
        address: u32,
        len: u32,
        received: u32,
    },
}

impl<M: Memory> Debugger<M> {
    /// The interface to this memory.
    pub const fn new(memory: M) -> Self {
        Self { memory, state: State::Idle, status: status::DONE, piece: [0; PIECE], stop: None }
    }

    /// The memory.
    pub fn memory(&mut self) -> &mut M {
        &mut self.memory
    }

    /// Reports that the program has stopped at this address. An emergency reports only the latest
    /// stop.
    pub fn stopped(&mut self, stop: Stop, address: u32) {
        self.stop = Some((stop, address));
    }

    /// The device combined with this interface, for its slave.
    pub fn attach<'a, D>(&'a mut self, device: &'a mut D) -> Debugged<'a, D, M> {
        Debugged { device, debugger: self }
    }

    fn locked(&mut self) -> Result<(), AbortCode> {
        if self.memory.is_locked() {
            Err(AbortCode::DEVICE_STATE)
        } else {
            Ok(())
        }
    }

    /// Records an error in the status.
    fn noted<T>(&mut self, outcome: Result<T, AbortCode>) -> Result<T, AbortCode> {
        if outcome.is_err() {
            self.status = status::ERROR;
        }
        outcome
    }

    fn command(&mut self, bytes: &[u8]) -> Result<(), AbortCode> {
        self.state = State::Idle;
        self.locked()?;
        let bytes: [u8; 8] = bytes.try_into().map_err(|_| {
            if bytes.len() > 8 {
                AbortCode::LENGTH_TOO_HIGH
            } else {
                AbortCode::LENGTH_TOO_LOW
            }
        })?;
        let command = Command::parse(bytes).ok_or(AbortCode::INVALID_VALUE)?;
        if command.len == 0 || !self.memory.allows(&command) {
            return Err(AbortCode::INVALID_VALUE);
        }
        let Command { address, .. } = command;
        let len = u32::from(command.len);
        (self.state, self.status) = match command.kind {
            Kind::Read => (State::Reading { address, len, held: 0 }, status::REPLY),
            Kind::Write => (State::Writing { address, len, received: 0 }, status::EXECUTING),
        };
        Ok(())
    }

    fn upload_start(&mut self) -> Result<u32, AbortCode> {
        let len = self.fetch(0)?;
        self.status = status::REPLY;
        Ok(len)
    }

    /// Reads the piece at this offset and returns the length of the whole. The device may have been
    /// locked since the transfer began.
    fn fetch(&mut self, offset: u32) -> Result<u32, AbortCode> {
        self.locked()?;
        let State::Reading { address, len, held } = &mut self.state else { return Err(AbortCode::NO_DATA) };
        let left = (*len - offset) as usize;
        self.memory.read(address.wrapping_add(offset), &mut self.piece[..left.min(PIECE)])?;
        *held = offset;
        Ok(*len)
    }

    fn upload_data(&mut self, offset: u32, buf: &mut [u8]) -> Result<usize, AbortCode> {
        let mut done = 0;
        while done < buf.len() {
            let State::Reading { len, held, .. } = self.state else { return Err(AbortCode::NO_DATA) };
            let at = offset.saturating_add(done as u32);
            if at >= len {
                break;
            }
            let within = at % PIECE as u32;
            if at - within != held {
                self.fetch(at - within)?;
            }
            let count = (buf.len() - done).min((len - at) as usize).min(PIECE - within as usize);
            buf[done..done + count].copy_from_slice(&self.piece[within as usize..][..count]);
            done += count;
        }
        Ok(done)
    }

    fn download_start(&mut self, size: Option<u32>) -> Result<(), AbortCode> {
        self.locked()?;
        let State::Writing { len, received, .. } = &mut self.state else {
            return Err(AbortCode::DEVICE_STATE);
        };
        *received = 0;
        let len = *len;
        size.map_or(Ok(()), |size| matches(size, len))?;
        self.status = status::EXECUTING;
        Ok(())
    }

    fn download_data(&mut self, data: &[u8]) -> Result<(), AbortCode> {
        for &byte in data {
            let State::Writing { len, received, .. } = self.state else {
                return Err(AbortCode::DEVICE_STATE);
            };
            if received == len {
                return Err(AbortCode::LENGTH_TOO_HIGH);
            }
            // `download_end` writes the last piece, so this piece is written only if more data
            // follow.
            if received > 0 && received.is_multiple_of(PIECE as u32) {
                self.flush()?;
            }
            self.piece[received as usize % PIECE] = byte;
            if let State::Writing { received, .. } = &mut self.state {
                *received += 1;
            }
        }
        Ok(())
    }

    /// Writes the piece that is in the buffer, unless the device was locked since the transfer began.
    fn flush(&mut self) -> Result<(), AbortCode> {
        self.locked()?;
        let State::Writing { address, received, .. } = self.state else {
            return Err(AbortCode::DEVICE_STATE);
        };
        let Some(last) = received.checked_sub(1) else { return Ok(()) };
        let offset = last - last % PIECE as u32;
        self.memory.write(address.wrapping_add(offset), &self.piece[..(received - offset) as usize])
    }

    fn download_end(&mut self) -> Result<(), AbortCode> {
        let State::Writing { len, received, .. } = self.state else { return Err(AbortCode::DEVICE_STATE) };
        matches(received, len)?;
        self.flush()?;
        self.status = status::DONE;
        Ok(())
    }
}

fn matches(size: u32, len: u32) -> Result<(), AbortCode> {
    match size {
        _ if size > len => Err(AbortCode::LENGTH_TOO_HIGH),
        _ if size < len => Err(AbortCode::LENGTH_TOO_LOW),
        _ => Ok(()),
    }
}

/// A device combined with the debugger interface.
#[derive(Debug)]
pub struct Debugged<'a, D, M> {
    device: &'a mut D,
    debugger: &'a mut Debugger<M>,
}

impl<D: Objects, M: Memory> Objects for Debugged<'_, D, M> {
    fn has_second_server() -> bool {
        D::has_second_server()
    }

    fn has_block_download() -> bool {
        D::has_block_download()
    }

    fn has_block_upload() -> bool {
        D::has_block_upload()
    }

    /// The device's entries, which include [`ENTRIES`].
    fn entries(&self) -> &'static [Entry] {
        self.device.entries()
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        if at == STATUS {
            put(buf, &[self.debugger.status])
        } else {
            self.device.read(at, buf)
        }
    }

    fn write_with_reply(&mut self, at: Address, data: &[u8], expedited: bool) -> Result<Reply, AbortCode> {
        if at != COMMAND {
            return self.device.write_with_reply(at, data, expedited);
        }
        let outcome = self.debugger.command(data);
        self.debugger.noted(outcome).map(|()| Reply::Send)
    }

    fn download_start(&mut self, at: Address, size: Option<u32>) -> Result<(), AbortCode> {
        if at != DATA {
            return self.device.download_start(at, size);
        }
        let outcome = self.debugger.download_start(size);
        self.debugger.noted(outcome)
    }

    fn download_space(&mut self, at: Address, held: bool) -> usize {
        if at == DATA {
            usize::MAX
        } else {
            self.device.download_space(at, held)
        }
    }

    fn download_data(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        if at != DATA {
            return self.device.download_data(at, data);
        }
        let outcome = self.debugger.download_data(data);
        self.debugger.noted(outcome)
    }

    fn download_end(&mut self, at: Address) -> Result<(), AbortCode> {
        if at != DATA {
            return self.device.download_end(at);
        }
        let outcome = self.debugger.download_end();
        self.debugger.noted(outcome)
    }

    fn download_cancel(&mut self, at: Address) {
        if at == DATA {
            self.debugger.status = status::ERROR;
        } else {
            self.device.download_cancel(at);
        }
    }

    fn second_server(&self) -> Channel {
        self.device.second_server()
    }

    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        let Some((stop, address)) = self.debugger.stop.take() else { return self.device.next_emergency() };
        // A stop is not an error of the device: the message contains the unchanged error register.
        let mut register = [0];
        let _ = self.device.read(Address::new(ERROR_REGISTER, 0), &mut register);
        let [low, high] = USER_SOFTWARE.to_le_bytes();
        let [a, b, c, d] = address.to_le_bytes();
        Some([low, high, register[0], stop as u8, a, b, c, d])
    }

    fn exchange(&mut self) -> Option<&mut dyn Exchange> {
        self.device.exchange()
    }

    fn upload_start(&mut self, at: Address) -> Result<Option<u32>, AbortCode> {
        if at != DATA {
            return self.device.upload_start(at);
        }
        let outcome = self.debugger.upload_start();
        self.debugger.noted(outcome).map(Some)
    }

    fn upload_data(&mut self, at: Address, offset: u32, buf: &mut [u8]) -> Result<usize, AbortCode> {
        if at != DATA {
            return self.device.upload_data(at, offset, buf);
        }
        let outcome = self.debugger.upload_data(offset, buf);
        self.debugger.noted(outcome)
    }
}

impl<D: LssDevice, M> LssDevice for Debugged<'_, D, M> {
    fn has_lss() -> bool {
        D::has_lss()
    }

    fn identifies() -> bool {
        D::identifies()
    }

    fn supports(&mut self, rate: BitRate) -> bool {
        self.device.supports(rate)
    }

    fn takes(&mut self, id: NodeId) -> bool {
        self.device.takes(id)
    }

    fn store(&mut self, node: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        self.device.store(node, rate)
    }

    fn stored(&mut self) -> Poll<Result<(), StoreError>> {
        self.device.stored()
    }
}

impl<D: SlaveDevice, M: Memory> SlaveDevice for Debugged<'_, D, M> {
    fn line_event(&mut self, event: LineEvent) {
        self.device.line_event(event);
    }

    fn node_id_changed(&mut self, id: Option<NodeId>) {
        self.device.node_id_changed(id);
    }
}
