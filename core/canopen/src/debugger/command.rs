//! The command of the debugger interface, and the report of a stop, as bytes.

/// The error code of the emergency that reports a stop: user software (CiA 301 table 26).
pub const USER_SOFTWARE: u16 = 0x6200;

/// Why the program stopped: the first of the five bytes of that emergency; the address follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Stop {
    /// A code breakpoint: the instruction at the address is the next one.
    Breakpoint = 1,
    /// A single step has ended; the instruction at the address is the next one. (The types from 80h
    /// on are coboot's own.)
    Step = 0x80,
    /// The breakpoint at the address lies in code that cannot be stopped: breakpoints are disabled,
    /// and the program continues.
    OutOfReach = 0x81,
}

impl Stop {
    /// The stop with this number.
    #[must_use]
    pub const fn from_number(number: u8) -> Option<Self> {
        match number {
            1 => Some(Self::Breakpoint),
            0x80 => Some(Self::Step),
            0x81 => Some(Self::OutOfReach),
            _ => None,
        }
    }
}

/// Kind of access to memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The client reads.
    Read,
    /// The client writes.
    Write,
}

/// A command: eight bytes, written to 1025h/1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Command {
    /// Read or write.
    pub kind: Kind,
    /// Address of the first byte.
    pub address: u32,
    /// Number of bytes.
    pub len: u16,
}

impl Command {
    /// Parses the eight bytes; `None` for anything but a read or a write.
    #[must_use]
    pub const fn parse(bytes: [u8; 8]) -> Option<Self> {
        let [kind, _reserved, len_low, len_high, a, b, c, d] = bytes;
        let kind = match kind {
            0 => Kind::Read,
            1 => Kind::Write,
            _ => return None,
        };
        Some(Self {
            kind,
            address: u32::from_le_bytes([a, b, c, d]),
            len: u16::from_le_bytes([len_low, len_high]),
        })
    }

    /// The eight bytes.
    #[must_use]
    pub const fn emit(&self) -> [u8; 8] {
        let kind = match self.kind {
            Kind::Read => 0,
            Kind::Write => 1,
        };
        let [len_low, len_high] = self.len.to_le_bytes();
        let [a, b, c, d] = self.address.to_le_bytes();
        [kind, 0, len_low, len_high, a, b, c, d]
    }
}
