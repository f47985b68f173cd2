//! The debugger interface, 1025h, and breakpoints, with the feature `debugger` alone: **everybody
//! on the bus reads and writes this device's memory, and stops its program**. Without the feature
//! the program contains none of it.

#[cfg(not(feature = "debugger"))]
pub use off::*;
#[cfg(feature = "debugger")]
pub use on::*;

#[cfg(not(feature = "debugger"))]
mod off {
    use canopen::od::Entry;

    /// No objects.
    pub const ENTRIES: [Entry; 0] = [];

    /// Nothing.
    pub struct Debugger;

    impl Debugger {
        /// Nothing.
        pub fn start() -> Self {
            Self
        }

        /// The device, unchanged.
        pub fn attach<'a, D>(&'a mut self, device: &'a mut D) -> &'a mut D {
            device
        }
    }

    /// Nothing.
    pub fn release_program() {}

    /// Nothing.
    pub fn example() {}
}

#[cfg(feature = "debugger")]
mod on {
    use core::sync::atomic::{AtomicU32, Ordering};

    use bsp::debugger::Refused;
    use bsp::{monitor, pac, LAYOUT};
    use canopen::debugger::{self, Command, Debugged, Kind, Memory, Stop};
    use canopen::AbortCode;
    use shared_abi::memory_map::{may_read, may_write};

    pub use canopen::debugger::ENTRIES;

    /// Tasks of this priority and above cannot be stopped. Tasks of priority 1 and `idle` can. The
    /// tasks that serve the bus have higher priorities.
    const PRIORITY: u8 = 2;

    /// The interface.
    pub struct Debugger(debugger::Debugger<Chip>);

    impl Debugger {
        /// Makes the interface to this chip's memory. From now on breakpoints stop the program.
        pub fn start() -> Self {
            // The priority as the core counts it: 0 is the most urgent, and only the upper four
            // bits exist.
            monitor::arm((16 - PRIORITY) << 4, pac::Interrupt::CAN1_TX as u16);
            Self(debugger::Debugger::new(Chip))
        }

        /// The device with the interface in front of it.
        pub fn attach<'a, D>(&'a mut self, device: &'a mut D) -> Debugged<'a, D, Chip> {
            if let Some((kind, address)) = monitor::take_stop() {
                if let Some(stop) = Stop::from_number(kind) {
                    self.0.stopped(stop, address);
                }
            }
            self.0.attach(device)
        }
    }

    /// The device is about to leave, which `idle` does. A stopped program goes on and cannot be
    /// stopped any more.
    pub fn release_program() {
        monitor::release_program();
    }

    /// The number of calls of [`example`].
    #[unsafe(no_mangle)]
    static DEBUGGER_EXAMPLE_CALLS: AtomicU32 = AtomicU32::new(0);

    /// A function for a breakpoint, called every half second, and a variable to watch.
    #[unsafe(export_name = "debugger_example")]
    #[inline(never)]
    pub extern "C" fn example() {
        // Load and store apart: an exclusive access never succeeds when it is stepped through.
        let calls = DEBUGGER_EXAMPLE_CALLS.load(Ordering::Relaxed);
        DEBUGGER_EXAMPLE_CALLS.store(calls.wrapping_add(1), Ordering::Relaxed);
    }

    /// All of its memory.
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
