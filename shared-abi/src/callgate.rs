//! The callgate: services of the bootloader that an application calls like a function.
//!
//! At a fixed address ([`Layout::callgate`](crate::layout::Layout::callgate)) lies a table with
//! magic, ABI version, length and one entry point. The code of the services runs from flash and uses
//! only the caller's stack, because the application owns all RAM: a call needs at most [`STACK`]
//! bytes of stack. This module is what both sides agree on; the calling half is in `coboot-app`.

/// Identifies a callgate table ("CBCG" read as little-endian bytes).
pub const MAGIC: u32 = u32::from_le_bytes(*b"CBCG");

/// Version of the ABI. It has not changed since the first bootloader: a new selector does not change it,
/// because an older bootloader answers [`Status::UnknownSelector`], and no meaning changes.
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
    /// The size of the table in bytes: 16, because the [services](crate::services) follow it.
    pub length: u16,
    /// Version of the bootloader: major in the upper half, minor in the lower.
    pub bootloader_version: u32,
    /// The entry point.
    pub entry: E,
}

/// The services. Call one service at a time, from one priority, and do not use the flash
/// controller meanwhile. A service that stores something blocks the core's access to its flash for
/// about 16 us at a time, eight times for a value. None erases a sector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Selector {
    /// CRC-32 over a range of flash; takes [`Crc32Args`].
    Crc32 = 1,
    /// Returns the stored node-ID and bit rate; takes [`NodeArgs`].
    ReadNode = 2,
    /// Stores node-ID and bit rate, which take effect at the next reset; takes [`NodeArgs`].
    StoreNode = 3,
    /// Returns what is known of a program, or of the bootloader itself
    /// ([`BOOTLOADER`](crate::renewal::BOOTLOADER)) where it can be renewed; takes [`ProgramArgs`].
    ProgramInfo = 4,
    /// Releases a program for autostart, like 1F51h = 83h, and clears its crash count: a program on
    /// trial confirms itself with this. Takes [`ProgramArgs`] and only uses the number.
    Confirm = 5,
    /// Withdraws a program's release for autostart, like 1F51h = 84h. Takes [`ProgramArgs`] and
    /// only uses the number.
    Invalidate = 6,
    /// Takes back that a program is confirmed, but not its release: it starts with its rescue
    /// window until it has shown again that it can return. Takes [`ProgramArgs`] and only uses the
    /// number. That of a sealed program is not stored ([`Status::Locked`]): its confirmation keeps
    /// older images out, and no stranger may wear the flash out.
    Unconfirm = 7,
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
            7 => Self::Unconfirm,
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
    /// after it; [`BootRequest::Rescue`](crate::warm_start::BootRequest::Rescue) for
    /// [`Selector::Unconfirm`]).
    Locked = -8,
    /// The journal is nearly full, and its last places are for confirmations; or these are used, too. The next
    /// start without a request makes room, and so does the bootloader when it is called.
    Full = -9,
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
    /// The program's number, 1 to 254; 255 for the bootloader.
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
