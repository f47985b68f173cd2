//! The slice of the CPU loop: how far the CPU may go on, and what it must do first.
//!
//! The chip says here that the CPU must leave translated code, and why; the CPU says which code it
//! is in. Nothing of it is silicon.

use std::collections::BTreeSet;

use shared_abi::geometry::Region;

use crate::periph::rcc::ResetCause;
use crate::report::Report;
use crate::supply::Change;
use crate::time::Time;

/// The record of the RAM that a piece of code accesses.
pub struct Watch {
    /// The code.
    pub code: Region,
    /// The code runs at present.
    pub inside: bool,
    /// The pages of RAM that it accessed, by their addresses.
    pub touched: BTreeSet<u32>,
}

/// What the chip and the CPU loop have to say to each other.
#[derive(Default)]
pub struct Slice {
    /// The CPU goes on until its cycle count reaches this.
    pub end: u64,
    /// The deadline of the machine's owner, which the slice never passes.
    pub deadline: Time,
    /// The CPU leaves translated code at the end of the present block.
    pub leave: bool,
    /// An exception is pending that might be taken when the masks allow.
    pub check_exceptions: bool,
    /// The CAN bus must process a change.
    pub attention: bool,
    /// A system reset was asked for.
    pub reset_request: Option<ResetCause>,
    /// The supply takes the chip into reset, or out of it.
    pub supply: Option<Change>,
    /// The CPU is stalled until this time, because the bus to the flash is held.
    pub hold_until: Option<Time>,
    /// A bus error came back for the last store, to this address.
    pub bus_error: Option<u32>,
    /// Code that has changed since it was translated: (address, length).
    pub stale: Vec<(u32, u32)>,
    /// The translator must forget which memory may be read: a flash operation started, and loads
    /// from flash must be noticed.
    pub flush_tlb: bool,
    /// This was done for the running operation.
    pub guarded: bool,
    /// Breakpoints were set or removed, so translations of code may stop at the wrong places.
    pub breakpoints_changed: bool,
    /// The addresses at which a debugger wants code to stop.
    pub stops: BTreeSet<u32>,
    /// How often translated code was entered.
    pub entries: u64,
    /// The block that runs: address and length in bytes.
    pub block: (u32, u32),
    /// How many cycles of the block come after the access that the program makes to a counter of the
    /// core: all its cycles are counted when it starts.
    pub ahead: u64,
    /// Code that is watched.
    pub watch: Option<Watch>,
    /// Reports of accesses to peripherals whose instruction is still to be found; their address is
    /// the one that the program used.
    pub unlocated: Vec<Report>,
}
