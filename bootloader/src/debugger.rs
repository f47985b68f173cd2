//! The debugger interface, 1025h. It exists only with the feature `debugger`: **every node on the
//! bus can then read and write this device's memory**. Without the feature the bootloader contains
//! no code for it.

#[cfg(not(feature = "debugger"))]
use boot_core::canopen::od::Entry;

#[cfg(feature = "debugger")]
pub use on::{Debugger, ENTRIES};

/// The interface without the feature: it does nothing.
#[cfg(not(feature = "debugger"))]
pub struct Debugger;
#[cfg(not(feature = "debugger"))]
impl Debugger {
    /// An interface without function.
    pub const fn new() -> Self {
        Self
    }

    /// The device itself, unchanged.
    pub fn attach<'a, D>(&'a mut self, device: &'a mut D) -> &'a mut D {
        device
    }
}
/// Without the feature the object dictionary has no additional objects.
#[cfg(not(feature = "debugger"))]
pub const ENTRIES: [Entry; 0] = [];

#[cfg(feature = "debugger")]
mod on {
    use boot_core::canopen::debugger::{self, Command, Debugged, Kind, Memory};
    use boot_core::canopen::od::Entry;
    use boot_core::canopen::AbortCode;
    use bsp::debugger::Refused;
    use bsp::LAYOUT;
    use shared_abi::memory_map::{may_read, may_write};

    /// The entries of 1025h.
    pub const ENTRIES: [Entry; debugger::ENTRIES.len()] = debugger::ENTRIES;

    /// The debugger interface.
    pub struct Debugger(debugger::Debugger<Chip>);

    impl Debugger {
        /// The interface to this chip's memory.
        pub const fn new() -> Self {
            Self(debugger::Debugger::new(Chip))
        }

        /// The device with the interface in front of it.
        pub fn attach<'a, D>(&'a mut self, device: &'a mut D) -> Debugged<'a, D, Chip> {
            self.0.attach(device)
        }
    }

    /// All memory of the chip.
    pub struct Chip;

    impl Memory for Chip {
        fn is_locked(&mut self) -> bool {
            bsp::debugger::is_locked()
        }

        fn allows(&mut self, command: &Command) -> bool {
            let allowed = match command.kind {
                Kind::Read => may_read,
                Kind::Write => may_write,
            };
            allowed(LAYOUT.chip, command.address, command.len.into())
        }

        fn read(&mut self, address: u32, bytes: &mut [u8]) -> Result<(), AbortCode> {
            bsp::debugger::read(address, bytes).map_err(abort)
        }

        fn write(&mut self, address: u32, bytes: &[u8]) -> Result<(), AbortCode> {
            bsp::debugger::write(address, bytes).map_err(abort)
        }
    }

    fn abort(refused: Refused) -> AbortCode {
        match refused {
            Refused::Address => AbortCode::INVALID_VALUE,
            Refused::Busy => AbortCode::LOCAL_CONTROL,
        }
    }
}
