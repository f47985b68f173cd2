//! The callgate: services of the bootloader that an application calls like a function.
//!
//! At a fixed address ([`Layout::callgate`]) lies a table with magic, ABI version, length and one entry
//! point. The code behind it runs from flash and uses the caller's stack alone: the application owns all RAM.
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
pub const STACK: u32 = 256;

/// The entry point: a [selector](Selector), its argument structure, and a [result code](Status).
pub type Entry = unsafe extern "C" fn(selector: u32, args: *mut core::ffi::c_void) -> i32;

/// The table in flash. `E` is the [`Entry`] in the bootloader that defines it and its 32-bit address for everyone else.
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

/// What can be called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Selector {
    /// CRC-32 over a range of flash; takes [`Crc32Args`].
    Crc32 = 1,
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

#[cfg(target_arch = "arm")]
impl Callgate {
    /// Finds the callgate of the bootloader underneath.
    ///
    /// # Errors
    /// [`CallgateError::Absent`] or [`CallgateError::Version`].
    pub fn find(layout: &Layout) -> Result<Self, CallgateError> {
        // SAFETY: a checked layout puts the table inside the flash, which is always readable; any bits make a `Table`.
        Self::check(unsafe { (layout.callgate() as *const Table).read_volatile() })
    }

    /// CRC-32/ISO-HDLC over `len` bytes of flash from `address` on.
    ///
    /// # Errors
    /// [`CallgateError::Refused`] with [`Status::BadRange`] where the range does not lie in flash.
    pub fn crc32(&self, address: u32, len: u32) -> Result<u32, CallgateError> {
        let mut args = Crc32Args { address, len, crc: 0 };
        self.call(Selector::Crc32, (&raw mut args).cast())?;
        Ok(args.crc)
    }

    fn call(&self, selector: Selector, args: *mut core::ffi::c_void) -> Result<(), CallgateError> {
        // SAFETY: `check` found the magic and the version of a table that a bootloader of ours put there, so the
        // word is the address of an `Entry`; every caller passes the argument structure of its selector.
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
    pub fn find(_layout: &Layout) -> Result<Self, CallgateError> {
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
