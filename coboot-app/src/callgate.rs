//! The callgate: services of the bootloader that an application calls like a function. The ABI is
//! that of [`shared_abi::callgate`]; here is the half that finds the table and calls it.

pub use shared_abi::callgate::*;
use shared_abi::layout::Layout;

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
        // Newer versions only add services.
        if table.abi_version < ABI_VERSION {
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
    /// [`CallgateError::Refused`] with [`Status::BadArgument`], [`Status::Busy`], [`Status::Full`] or
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

    /// Takes back that a program is confirmed, but not its release.
    ///
    /// # Errors
    /// As for [`confirm`](Self::confirm). [`Status::Locked`] for a sealed program;
    /// [`Status::UnknownSelector`] of a bootloader that is older than this service.
    pub fn unconfirm(&self, number: u8) -> Result<(), CallgateError> {
        let mut args = ProgramArgs { number: number.into(), ..ProgramArgs::default() };
        self.call(Selector::Unconfirm, (&raw mut args).cast())
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
