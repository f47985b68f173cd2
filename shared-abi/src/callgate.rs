//! The callgate: services of the bootloader that an application calls like a function.
//!
//! At a fixed address ([`Layout::callgate`]) lies a table with magic, ABI version, length and one
//! entry point. The code behind it runs from flash and uses the caller's stack alone: the
//! application owns all RAM.
//!
//! What it costs the caller: at most [`STACK`] bytes of stack.

use crate::layout::Layout;

/// Tells a callgate table ("CBCG" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBCG");

/// Version of the ABI. A new selector keeps it; a changed meaning raises it.
pub const ABI_VERSION: u16 = 1;

/// Bytes of the table in flash.
pub const TABLE_SIZE: u32 = 16;

/// Bytes of the caller's stack that a call may use.
pub const STACK: u32 = 1024;

/// The entry point: a [selector](Selector), its argument structure, and a [result code](Status).
pub type Entry = unsafe extern "C" fn(selector: u32, args: *mut core::ffi::c_void) -> i32;

/// The table in flash. `E` is the [`Entry`] in the bootloader that defines it and its 32-bit
/// address for everyone else.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Table<E = u32> {
    /// [`MAGIC`].
    pub magic: u32,
    /// [`ABI_VERSION`].
    pub abi_version: u16,
    /// Bytes of the table: an application finds out here whether a later field exists.
    pub length: u16,
    /// Version of the bootloader: major in the upper half, minor in the lower.
    pub bootloader_version: u32,
    /// The entry point.
    pub entry: E,
}

/// What can be called: one service at a time, from one priority, with the flash controller left
/// alone meanwhile. Every service that stores keeps the core from its flash for as long as that
/// takes: some 100 us, and once in several hundred times a second, when a sector is erased.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Selector {
    /// CRC-32 over a range of flash; takes [`Crc32Args`].
    Crc32 = 1,
    /// Node-ID and bit rate as they are stored; takes [`NodeArgs`].
    ReadNode = 2,
    /// Stores node-ID and bit rate, which are in force from the next reset on; takes [`NodeArgs`].
    StoreNode = 3,
    /// What is known of a program; takes [`ProgramArgs`].
    ProgramInfo = 4,
    /// Gives a program its signature, as 1F51h = 83h does, and forgets its crashes: how a trial
    /// confirms itself. Takes [`ProgramArgs`], of which only the number counts.
    Confirm = 5,
    /// Takes a program's signature away, as 1F51h = 84h does. Takes [`ProgramArgs`], of which only
    /// the number counts.
    Invalidate = 6,
}

impl Selector {
    /// The selector of this number.
    #[must_use]
    pub const fn from_number(number: u32) -> Option<Self> {
        Some(match number {
            1 => Self::Crc32,
            2 => Self::ReadNode,
            3 => Self::StoreNode,
            4 => Self::ProgramInfo,
            5 => Self::Confirm,
            6 => Self::Invalidate,
            _ => return None,
        })
    }
}

/// What a call returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
pub enum Status {
    /// Done; results are in the argument structure.
    Ok = 0,
    /// This bootloader has no such selector.
    UnknownSelector = -1,
    /// The argument pointer is null, misaligned or not in RAM.
    BadPointer = -2,
    /// The range does not lie in flash, or is empty.
    BadRange = -3,
    /// The flash controller is at work, or its control register is open: somebody uses it.
    Busy = -4,
    /// The flash did not take the value.
    Failed = -5,
    /// A node-ID, bit rate or program number that does not exist here.
    BadArgument = -6,
    /// Nothing is installed under this number.
    NoProgram = -7,
    /// Nothing can be stored before the next reset, because the flash is locked in front of a sealed
    /// program: the same is to be asked through the warm-start cell
    /// ([`BootRequest::Confirm`](crate::warm_start::BootRequest::Confirm) and the two behind it).
    Locked = -8,
}

/// Arguments of [`Selector::Crc32`].
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crc32Args {
    /// First byte; any alignment.
    pub address: u32,
    /// Number of bytes, at least 1.
    pub len: u32,
    /// Result: CRC-32/ISO-HDLC, the function of 1F56h.
    pub crc: u32,
}

/// Arguments of [`Selector::ReadNode`] and [`Selector::StoreNode`].
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NodeArgs {
    /// 1 to 127; 255 for a device that waits for layer setting services to give it one.
    pub node_id: u32,
    /// In bit/s; 0 for a device that finds it out by listening.
    pub bit_rate: u32,
}

/// Arguments of the selectors about a program.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProgramArgs {
    /// Which, 1 to 254.
    pub number: u32,
    /// Result: bytes from the start of its flash on.
    pub size: u32,
    /// Result: CRC over them.
    pub crc: u32,
    /// Result: the version that its control block told, 0 for none (SYS TEC manual L-1112d_10,
    /// figure 13).
    pub version: u32,
    /// Result: [`PROGRAM_INSTALLED`], [`PROGRAM_SIGNED`].
    pub flags: u32,
}

/// In [`ProgramArgs::flags`]: it was downloaded completely, and its CRC was right then.
pub const PROGRAM_INSTALLED: u32 = 1 << 0;
/// In [`ProgramArgs::flags`]: it carries the signature, so that it starts by itself.
pub const PROGRAM_SIGNED: u32 = 1 << 1;

/// Why a call through the callgate failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CallgateError {
    /// There is no callgate at the layout's address: another bootloader, or none.
    Absent,
    /// The bootloader speaks another version of the ABI: this one.
    Version(u16),
    /// The bootloader refused; its code. [`Status`] names the ones that this version knows.
    Refused(i32),
}

/// The callgate of the bootloader underneath, found and checked.
#[derive(Clone, Copy, Debug)]
pub struct Callgate {
    table: Table,
}

impl Callgate {
    /// Judges a table.
    ///
    /// # Errors
    /// [`CallgateError::Absent`] or [`CallgateError::Version`].
    pub fn check(table: Table) -> Result<Self, CallgateError> {
        if table.magic != MAGIC || u32::from(table.length) < TABLE_SIZE {
            return Err(CallgateError::Absent);
        }
        if table.abi_version != ABI_VERSION {
            return Err(CallgateError::Version(table.abi_version));
        }
        Ok(Self { table })
    }

    /// Version of the bootloader underneath.
    #[must_use]
    pub const fn bootloader_version(&self) -> u32 {
        self.table.bootloader_version
    }
}

impl Callgate {
    /// CRC-32/ISO-HDLC over `len` bytes of flash from `address` on.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadRange`] where the range does not lie in flash.
    pub fn crc32(&self, address: u32, len: u32) -> Result<u32, CallgateError> {
        let mut args = Crc32Args { address, len, crc: 0 };
        self.call(Selector::Crc32, (&raw mut args).cast())?;
        Ok(args.crc)
    }

    /// Node-ID and bit rate as they are stored.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::Busy`].
    pub fn read_node(&self) -> Result<NodeArgs, CallgateError> {
        let mut args = NodeArgs::default();
        self.call(Selector::ReadNode, (&raw mut args).cast())?;
        Ok(args)
    }

    /// Stores node-ID and bit rate; they are in force from the next reset on.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadArgument`], [`Status::Busy`] or
    /// [`Status::Failed`].
    pub fn store_node(&self, mut node: NodeArgs) -> Result<(), CallgateError> {
        self.call(Selector::StoreNode, (&raw mut node).cast())
    }

    /// What is known of a program.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadArgument`] or [`Status::Busy`].
    pub fn program_info(&self, number: u8) -> Result<ProgramArgs, CallgateError> {
        let mut args = ProgramArgs { number: number.into(), ..ProgramArgs::default() };
        self.call(Selector::ProgramInfo, (&raw mut args).cast())?;
        Ok(args)
    }

    /// Gives a program its signature and forgets its crashes: how a trial confirms itself.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadArgument`], [`Status::NoProgram`],
    /// [`Status::Busy`] or [`Status::Failed`].
    pub fn confirm(&self, number: u8) -> Result<(), CallgateError> {
        let mut args = ProgramArgs { number: number.into(), ..ProgramArgs::default() };
        self.call(Selector::Confirm, (&raw mut args).cast())
    }

    /// Takes a program's signature away: it does not start by itself any more.
    ///
    /// # Errors
    /// As for [`confirm`](Self::confirm).
    pub fn invalidate(&self, number: u8) -> Result<(), CallgateError> {
        let mut args = ProgramArgs { number: number.into(), ..ProgramArgs::default() };
        self.call(Selector::Invalidate, (&raw mut args).cast())
    }
}

#[cfg(target_arch = "arm")]
impl Callgate {
    /// Finds the callgate of the bootloader underneath.
    ///
    /// # Errors
    /// [`CallgateError::Absent`] or [`CallgateError::Version`].
    pub fn find(layout: &Layout) -> Result<Self, CallgateError> {
        // SAFETY: a checked layout puts the table inside the flash, which is always readable; any
        // bits make a `Table`.
        Self::check(unsafe { (layout.callgate() as *const Table).read_volatile() })
    }

    fn call(&self, selector: Selector, args: *mut core::ffi::c_void) -> Result<(), CallgateError> {
        // SAFETY: `check` found the magic and the version of a table that a bootloader of ours put
        // there, so the word is the address of an `Entry`; every caller passes the argument
        // structure of its selector.
        let status = unsafe {
            let entry: Entry = core::mem::transmute::<usize, Entry>(self.table.entry as usize);
            entry(selector as u32, args)
        };
        if status == Status::Ok as i32 {
            Ok(())
        } else {
            Err(CallgateError::Refused(status))
        }
    }
}

#[cfg(not(target_arch = "arm"))]
impl Callgate {
    /// There is no bootloader underneath a host program.
    ///
    /// # Errors
    /// Always [`CallgateError::Absent`].
    pub const fn find(_layout: &Layout) -> Result<Self, CallgateError> {
        Err(CallgateError::Absent)
    }

    /// The entry of a table is an address of the chip.
    #[allow(clippy::unused_self)]
    const fn call(&self, _: Selector, _: *mut core::ffi::c_void) -> Result<(), CallgateError> {
        Err(CallgateError::Absent)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tells_absence_from_another_version() {
        let good = Table {
            magic: MAGIC,
            abi_version: 1,
            length: 16,
            bootloader_version: 0x0001_0000,
            entry: 0x0800_0211,
        };
        assert_eq!(Callgate::check(good).unwrap().bootloader_version(), 0x0001_0000);
        let erased = Table { magic: u32::MAX, abi_version: u16::MAX, length: u16::MAX, ..good };
        assert_eq!(Callgate::check(erased).unwrap_err(), CallgateError::Absent);
        assert_eq!(Callgate::check(Table { length: 12, ..good }).unwrap_err(), CallgateError::Absent);
        assert_eq!(Callgate::check(Table { abi_version: 2, ..good }).unwrap_err(), CallgateError::Version(2));
    }
}
