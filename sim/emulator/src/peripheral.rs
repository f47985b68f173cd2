//! The interface of every modelled block of the chip to the machine.

use crate::time::Time;

/// The access touches a register, or asks for something of it, that is not modelled.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unmodelled(pub String);

/// Says what is not modelled.
pub(crate) fn unmodelled<T>(what: impl Into<String>) -> Result<T, Unmodelled> {
    Err(Unmodelled(what.into()))
}

/// A memory-mapped block of registers.
///
/// The machine hands in word-aligned accesses; it takes care of bytes, half-words and bit-band
/// aliases. A model never reads a clock: `now` is the virtual time of the access. One in which nothing happens
/// but by an access has neither events nor interrupts.
pub trait Peripheral {
    /// Name as in the reference manual, for reports.
    fn name(&self) -> &'static str;

    /// The CPU (or a debugger) reads the register at `offset`.
    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled>;

    /// The CPU writes the register at `offset`.
    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled>;

    /// Processes all events that are due up to and including `now`.
    fn advance(&mut self, now: Time) {
        let _ = now;
    }

    /// The time of the next event that happens without an access, if there is one: a timer runs
    /// out, an operation ends.
    fn next_event(&self) -> Option<Time> {
        None
    }

    /// The NVIC lines that this block holds active (level), as interrupt numbers.
    fn interrupts(&self, active: &mut Vec<u16>) {
        let _ = active;
    }

    /// These lines alone.
    #[cfg(test)]
    fn active(&self) -> Vec<u16> {
        let mut active = Vec::new();
        self.interrupts(&mut active);
        active
    }

    /// System reset. The model decides what survives it (RAM, the reset flags, the watchdog's
    /// start).
    fn reset(&mut self);
}
