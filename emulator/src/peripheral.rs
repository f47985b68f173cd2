//! What every modelled block of the chip offers to the machine around it.

use crate::time::Time;

/// The access touches a register, or asks for something of it, that is not modelled.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unmodelled(pub String);

/// A memory-mapped block of registers.
///
/// The machine hands in word-aligned accesses; it takes care of bytes, half-words and bit-band
/// aliases. A model never reads a clock: `now` is the virtual time of the access.
pub trait Peripheral {
    /// Name as in the reference manual, for reports.
    fn name(&self) -> &'static str;

    /// The CPU (or a debugger) reads the register at `offset`.
    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled>;

    /// The CPU writes the register at `offset`.
    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled>;

    /// Lets everything happen that is due up to and including `now`.
    fn advance(&mut self, now: Time);

    /// When something will happen next without anybody's doing, if it will: a timer runs out, an
    /// operation ends.
    fn next_event(&self) -> Option<Time>;

    /// The NVIC lines that this block holds active (level), as interrupt numbers.
    fn interrupts(&self, active: &mut Vec<u16>);

    /// System reset. What survives it (RAM, the reset flags, the watchdog's start) is the model's
    /// to know.
    fn reset(&mut self);
}
