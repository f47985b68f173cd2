//! The callgate: services of the bootloader that an application calls like a function.
//!
//! At a fixed address ([`Layout::callgate`]) lies a table with magic, ABI version, length and one
//! entry point. The code of the services runs from flash and uses only the caller's stack, because
//! the application owns all RAM: a call needs at most [`STACK`] bytes of stack.

use crate::layout::Layout;

/// Identifies a callgate table ("CBCG" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBCG");

/// Version of the ABI. A new selector does not change it; a changed meaning increases it.
pub const ABI_VERSION: u16 = 1;

/// The size of the table in flash in bytes.
pub const TABLE_SIZE: u32 = 16;

/// The bytes of the caller's stack that a call may use.
pub const STACK: u32 = 1024;

/// The entry point: a [selector](Selector), its argument structure, and a [result code](Status).
pub type Entry = unsafe extern "C" fn(selector: u32, args: *mut core::ffi::c_void) -> i32;

/// The table in flash. `E` is [`Entry`] in the bootloader, which defines the table, and a 32-bit
/// address in all other code.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Table<E = u32> {
    /// [`MAGIC`].
    pub magic: u32,
    /// [`ABI_VERSION`].
    pub abi_version: u16,
    /// The size of the table in bytes: it shows an application whether a later field exists.
    pub length: u16,
    /// Version of the bootloader: major in the upper half, minor in the lower.
    pub bootloader_version: u32,
    /// The entry point.
    pub entry: E,
}

/// The services. Call one service at a time, from one priority, and do not use the flash
/// controller meanwhile. A service that stores something blocks the core's access to its flash: for
/// about 100 us, and in one of several hundred calls for a second, because a sector is erased.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Selector {
    /// CRC-32 over a range of flash; takes [`Crc32Args`].
    Crc32 = 1,
    /// Returns the stored node-ID and bit rate; takes [`NodeArgs`].
    ReadNode = 2,
    /// Stores node-ID and bit rate, which take effect at the next reset; takes [`NodeArgs`].
    StoreNode = 3,
    /// Returns the record of a program; takes [`ProgramArgs`].
    ProgramInfo = 4,
    /// Releases a program for autostart, like 1F51h = 83h, and clears its crash count: a program on
    /// trial confirms itself with this. Takes [`ProgramArgs`] and only uses the number.
    Confirm = 5,
    /// Withdraws a program's release for autostart, like 1F51h = 84h. Takes [`ProgramArgs`] and
    /// only uses the number.
    Invalidate = 6,
}

impl Selector {
    /// The selector with this number.
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

/// The result of a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
pub enum Status {
    /// Successful; the results are in the argument structure.
    Ok = 0,
    /// This bootloader has no such selector.
    UnknownSelector = -1,
    /// The argument pointer is null, misaligned or not in RAM.
    BadPointer = -2,
    /// The range does not lie in flash, or is empty.
    BadRange = -3,
    /// The flash controller is working, or its control register is unlocked: other code uses it.
    Busy = -4,
    /// The flash did not accept the value.
    Failed = -5,
    /// The node-ID, bit rate or program number does not exist here.
    BadArgument = -6,
    /// No program is installed under this number.
    NoProgram = -7,
    /// Storing is not possible before the next reset, because the flash is locked for a sealed
    /// program. Put the same request into the warm-start cell instead
    /// ([`BootRequest::Confirm`](crate::warm_start::BootRequest::Confirm) and the two requests
    /// after it).
    Locked = -8,
}

/// Arguments of [`Selector::Crc32`].
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crc32Args {
    /// The address of the first byte; any alignment.
    pub address: u32,
    /// The number of bytes, at least 1.
    pub len: u32,
    /// Result: CRC-32/ISO-HDLC, the function of 1F56h.
    pub crc: u32,
}

/// Arguments of [`Selector::ReadNode`] and [`Selector::StoreNode`].
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NodeArgs {
    /// 1 to 127; 255 for a device that waits for a node-ID from layer setting services.
    pub node_id: u32,
    /// The bit rate in bit/s; 0 for a device that detects it by listening.
    pub bit_rate: u32,
}

/// Arguments of the selectors that concern a program.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProgramArgs {
    /// The program's number, 1 to 254.
    pub number: u32,
    /// Result: size in bytes, from the start of its flash.
    pub size: u32,
    /// Result: CRC of these bytes.
    pub crc: u32,
    /// Result: the version in its control block, 0 if unknown (SYS TEC manual L-1112d_10, figure
    /// 13).
    pub version: u32,
    /// Result: [`PROGRAM_INSTALLED`], [`PROGRAM_SIGNED`].
    pub flags: u32,
}

/// In [`ProgramArgs::flags`]: the program was downloaded completely with a correct CRC.
pub const PROGRAM_INSTALLED: u32 = 1 << 0;
/// In [`ProgramArgs::flags`]: the program is released for autostart.
pub const PROGRAM_SIGNED: u32 = 1 << 1;

/// Why a call through the callgate failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CallgateError {
    /// There is no callgate at the layout's address: the device has another bootloader, or none.
    Absent,
    /// The bootloader has this other version of the ABI.
    Version(u16),
    /// The bootloader refused with this code. [`Status`] names the codes of this version.
    Refused(i32),
}

/// What a table has in place of its entry point, and how it is entered.
trait Enter: Copy {
    /// Calls the entry; `None` where there is none.
    fn enter(self, selector: Selector, args: *mut core::ffi::c_void) -> Option<i32>;
}

/// The callgate of the device's bootloader, found and checked.
#[derive(Clone, Copy, Debug)]
pub struct Callgate<E = u32> {
    table: Table<E>,
}

impl<E> Callgate<E> {
    /// Checks a table.
    ///
    /// # Errors
    /// [`CallgateError::Absent`] or [`CallgateError::Version`].
    pub fn check(table: Table<E>) -> Result<Self, CallgateError> {
        if table.magic != MAGIC || u32::from(table.length) < TABLE_SIZE {
            return Err(CallgateError::Absent);
        }
        if table.abi_version != ABI_VERSION {
            return Err(CallgateError::Version(table.abi_version));
        }
        Ok(Self { table })
    }

    /// Version of the device's bootloader.
    #[must_use]
    pub const fn bootloader_version(&self) -> u32 {
        self.table.bootloader_version
    }
}

#[allow(private_bounds, reason = "only a table of the chip, and one of a test, can be entered")]
impl<E: Enter> Callgate<E> {
    /// CRC-32/ISO-HDLC of `len` bytes of flash from `address` on.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadRange`] if the range does not lie in flash.
    pub fn crc32(&self, address: u32, len: u32) -> Result<u32, CallgateError> {
        let mut args = Crc32Args { address, len, crc: 0 };
        self.call(Selector::Crc32, (&raw mut args).cast())?;
        Ok(args.crc)
    }

    /// The stored node-ID and bit rate.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::Busy`].
    pub fn read_node(&self) -> Result<NodeArgs, CallgateError> {
        let mut args = NodeArgs::default();
        self.call(Selector::ReadNode, (&raw mut args).cast())?;
        Ok(args)
    }

    /// Stores node-ID and bit rate; they take effect at the next reset.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadArgument`], [`Status::Busy`] or
    /// [`Status::Failed`].
    pub fn store_node(&self, mut node: NodeArgs) -> Result<(), CallgateError> {
        self.call(Selector::StoreNode, (&raw mut node).cast())
    }

    /// The record of a program.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadArgument`] or [`Status::Busy`].
    pub fn program_info(&self, number: u8) -> Result<ProgramArgs, CallgateError> {
        let mut args = ProgramArgs { number: number.into(), ..ProgramArgs::default() };
        self.call(Selector::ProgramInfo, (&raw mut args).cast())?;
        Ok(args)
    }

    /// Releases a program for autostart and clears its crash count: a program on trial confirms
    /// itself with this.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadArgument`], [`Status::NoProgram`],
    /// [`Status::Busy`] or [`Status::Failed`].
    pub fn confirm(&self, number: u8) -> Result<(), CallgateError> {
        let mut args = ProgramArgs { number: number.into(), ..ProgramArgs::default() };
        self.call(Selector::Confirm, (&raw mut args).cast())
    }

    /// Withdraws a program's release: it no longer starts by itself.
    ///
    /// # Errors
    /// As for [`confirm`](Self::confirm).
    pub fn invalidate(&self, number: u8) -> Result<(), CallgateError> {
        let mut args = ProgramArgs { number: number.into(), ..ProgramArgs::default() };
        self.call(Selector::Invalidate, (&raw mut args).cast())
    }

    fn call(&self, selector: Selector, args: *mut core::ffi::c_void) -> Result<(), CallgateError> {
        match self.table.entry.enter(selector, args) {
            None => Err(CallgateError::Absent),
            Some(status) if status == Status::Ok as i32 => Ok(()),
            Some(status) => Err(CallgateError::Refused(status)),
        }
    }
}

#[cfg(target_arch = "arm")]
impl Callgate {
    /// Finds the callgate of the device's bootloader.
    ///
    /// # Errors
    /// [`CallgateError::Absent`] or [`CallgateError::Version`].
    pub fn find(layout: &Layout) -> Result<Self, CallgateError> {
        // SAFETY: a checked layout puts the table inside the flash, which is always readable, and
        // every bit pattern is a valid `Table`.
        Self::check(unsafe { (layout.callgate() as *const Table).read_volatile() })
    }
}

#[cfg(target_arch = "arm")]
impl Enter for u32 {
    fn enter(self, selector: Selector, args: *mut core::ffi::c_void) -> Option<i32> {
        // SAFETY: `check` found the magic and the version of a table written by this bootloader, so
        // the word is the address of an `Entry`; every caller passes the argument structure of its
        // selector.
        Some(unsafe {
            let entry: Entry = core::mem::transmute::<usize, Entry>(self as usize);
            entry(selector as u32, args)
        })
    }
}

#[cfg(not(target_arch = "arm"))]
impl Callgate {
    /// A host program has no bootloader.
    ///
    /// # Errors
    /// Always [`CallgateError::Absent`].
    pub const fn find(_layout: &Layout) -> Result<Self, CallgateError> {
        Err(CallgateError::Absent)
    }
}

#[cfg(not(target_arch = "arm"))]
impl Enter for u32 {
    /// The word is an address of the chip.
    fn enter(self, _: Selector, _: *mut core::ffi::c_void) -> Option<i32> {
        None
    }
}

#[cfg(test)]
mod tests;
