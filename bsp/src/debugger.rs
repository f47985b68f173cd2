//! The debugger interface, 1025h, to the chip's memory (feature `debugger`): **every node on the bus
//! can read and write this device's memory**. A request may name any address, and none causes a
//! fault.

use canopen::debugger::{self, Command, Debugged, Kind, Memory};
use canopen::AbortCode;
use shared_abi::memory_map::{may_read, may_write};

use crate::facts::LAYOUT;
use crate::memory;

pub use canopen::debugger::ENTRIES;

/// The interface of a device. With the feature `monitor` it also reports where the program stops.
pub struct Debugger(debugger::Debugger<Chip>);

impl Debugger {
    /// The interface to this chip's memory.
    #[must_use]
    #[allow(clippy::new_without_default, reason = "a device has one, where its tasks are set up")]
    pub const fn new() -> Self {
        Self(debugger::Debugger::new(Chip))
    }

    /// Does something with the device, with the interface in front of it.
    pub fn with<D, R>(&mut self, device: &mut D, action: impl FnOnce(&mut Debugged<'_, D, Chip>) -> R) -> R {
        #[cfg(feature = "monitor")]
        if let Some((kind, address)) = crate::monitor::take_stop() {
            if let Some(stop) = debugger::Stop::from_number(kind) {
                self.0.stopped(stop, address);
            }
        }
        action(&mut self.0.attach(device))
    }
}

/// All memory of the chip.
pub struct Chip;

impl Memory for Chip {
    fn is_locked(&mut self) -> bool {
        memory::is_locked()
    }

    fn allows(&mut self, command: &Command) -> bool {
        let allowed = match command.kind {
            Kind::Read => may_read,
            Kind::Write => may_write,
        };
        allowed(LAYOUT.chip, command.address, command.len.into())
    }

    fn read(&mut self, address: u32, bytes: &mut [u8]) -> Result<(), AbortCode> {
        memory::read(address, bytes)
    }

    fn write(&mut self, address: u32, bytes: &[u8]) -> Result<(), AbortCode> {
        memory::write(address, bytes)
    }
}
