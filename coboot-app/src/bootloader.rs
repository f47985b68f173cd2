//! The bootloader underneath: its services, which are called like functions (the callgate), and the
//! way into it.

use core::sync::atomic::{AtomicU32, Ordering};

use shared_abi::callgate::{Callgate, CallgateError, NodeArgs, ProgramArgs, Status};
use shared_abi::layout::Layout;
use shared_abi::warm_start::{BootRequest, WarmStart};

/// What [`ProgramControl`](crate::ProgramControl) asks the bootloader for. [`Bootloader`] does it; a
/// test has its own.
pub trait Services {
    /// What the bootloader knows of a program, 1 to 254.
    ///
    /// # Errors
    /// What the bootloader says.
    fn program_info(&mut self, number: u8) -> Result<ProgramArgs, CallgateError>;

    /// Confirms a program: a trial that is content with itself is one no more.
    ///
    /// # Errors
    /// What the bootloader says.
    fn confirm(&mut self, number: u8) -> Result<Confirmed, CallgateError>;
}

/// What came of a confirmation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Confirmed {
    /// It is stored.
    Now,
    /// The flash is locked in front of a sealed program: the bootloader stores it when the device
    /// leaves with [`BootRequest::Confirm`].
    AtReset,
}

impl Confirmed {
    /// From what the callgate said to a confirmation.
    ///
    /// # Errors
    /// What it said, unless it stored the confirmation or the flash was locked.
    pub const fn from_outcome(outcome: Result<(), CallgateError>) -> Result<Self, CallgateError> {
        const LOCKED: i32 = Status::Locked as i32;
        match outcome {
            Ok(()) => Ok(Self::Now),
            Err(CallgateError::Refused(LOCKED)) => Ok(Self::AtReset),
            Err(error) => Err(error),
        }
    }
}

/// The bootloader of a board.
///
/// Each service uses up to [`callgate::STACK`](shared_abi::callgate::STACK) bytes of the caller's
/// stack and nothing else of its RAM. One service at a time, from one priority, with the flash
/// controller left alone meanwhile. On a bootloader without a callgate every service gives
/// [`CallgateError::Absent`] or [`CallgateError::Version`], and the application goes on.
#[derive(Clone, Copy, Debug)]
pub struct Bootloader {
    layout: &'static Layout,
}

impl Bootloader {
    /// The bootloader of the board with this memory map.
    #[must_use]
    pub const fn new(layout: &'static Layout) -> Self {
        Self { layout }
    }

    /// Stores node-ID and bit rate for bootloader and application, in force from the next reset on:
    /// node-ID 1 to 127, `None` for a device that waits for layer setting services; bit rate in bit/s,
    /// 0 for one that is found out by listening.
    ///
    /// Writes flash: the whole chip waits some 100 µs for it, and once in several hundred stores up to
    /// half a second, when a sector of 16 KiB is erased (datasheet DS8626 table 40).
    ///
    /// # Errors
    /// What the bootloader says. A sealed device stores them for the holder of a root key alone, in the
    /// bootloader.
    pub fn store_node(&self, node_id: Option<u8>, bit_rate: u32) -> Result<(), CallgateError> {
        const NO_NODE_ID: u8 = 255;
        let node_id = node_id.unwrap_or(NO_NODE_ID).into();
        Callgate::find(self.layout)?.store_node(NodeArgs { node_id, bit_rate })
    }

    /// Takes a program's signature away: it does not start by itself any more. Writes flash, as
    /// [`store_node`](Self::store_node).
    ///
    /// # Errors
    /// What the bootloader says. In a sealed device the holder of a root key alone does that, in the
    /// bootloader.
    pub fn invalidate(&self, number: u8) -> Result<(), CallgateError> {
        Callgate::find(self.layout)?.invalidate(number)
    }
}

impl Services for Bootloader {
    fn program_info(&mut self, number: u8) -> Result<ProgramArgs, CallgateError> {
        Callgate::find(self.layout)?.program_info(number)
    }

    /// Writes flash, as [`Bootloader::store_node`].
    fn confirm(&mut self, number: u8) -> Result<Confirmed, CallgateError> {
        Confirmed::from_outcome(Callgate::find(self.layout)?.confirm(number))
    }
}

#[cfg(target_arch = "arm")]
impl Bootloader {
    /// What 1F56h reads in the bootloader as well: the CRC over what was downloaded as this program.
    /// Without that (a debugger has put the program there), over the program as it was linked, computed
    /// through the callgate; 0 without a bootloader. It takes as long as the program is: once, at the
    /// start.
    #[must_use]
    pub fn program_crc(mut self, number: u8) -> u32 {
        // `application.x` defines the second.
        extern "C" {
            static __vector_table: u8;
            static __image_end: u8;
        }
        let (start, end) = (&raw const __vector_table as u32, &raw const __image_end as u32);
        let computed = || Callgate::find(self.layout)?.crc32(start, end - start);
        self.program_info(number).map(|info| info.crc).or_else(|_| computed()).unwrap_or(0)
    }

    /// Leaves for the bootloader. What has to be on the bus is there already
    /// ([`Next::Leave`](crate::Next::Leave)), and outputs are in a safe state.
    pub fn leave(self, path: ReentryPath, request: BootRequest) -> ! {
        use shared_abi::reentry;

        match path {
            ReentryPath::SystemReset => reentry::system_reset(self.layout, request),
            ReentryPath::Watchdog => reentry::watchdog_reset(self.layout, request),
            ReentryPath::Jump => reentry::jump(self.layout, request),
        }
    }
}

/// How the device goes back into the bootloader (`shared_abi::reentry`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ReentryPath {
    /// Through a system reset: the right one, unless there is a reason for another.
    #[default]
    SystemReset = 0,
    /// Through a reset by the independent watchdog, for code that may not write the system control
    /// block. Takes a millisecond; longer if the watchdog runs already.
    Watchdog = 1,
    /// By a jump, all resources released, for a chip whose reset would switch something off. From
    /// thread mode; in a handler it is a system reset.
    Jump = 2,
}

impl ReentryPath {
    /// The path of this number.
    #[must_use]
    pub const fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            0 => Self::SystemReset,
            1 => Self::Watchdog,
            2 => Self::Jump,
            _ => return None,
        })
    }
}

/// Carries the request to leave from the task that serves the bus to the one that leaves: for
/// [`ReentryPath::Jump`], which starts in thread mode. A `static` of the program.
#[derive(Debug)]
pub struct Exit {
    /// 0 to stay, else the path (1 to 3), and from bit 8 on the request as the warm-start cell has it.
    request: AtomicU32,
    /// The argument of the request.
    argument: AtomicU32,
}

impl Default for Exit {
    fn default() -> Self {
        Self::new()
    }
}

impl Exit {
    /// Nobody has asked.
    #[must_use]
    pub const fn new() -> Self {
        Self { request: AtomicU32::new(0), argument: AtomicU32::new(0) }
    }

    /// The device is to leave.
    pub fn ask(&self, path: ReentryPath, request: BootRequest) {
        let WarmStart { request, argument, .. } = WarmStart::new(request);
        self.argument.store(argument, Ordering::Relaxed);
        self.request.store((path as u32 + 1) | request << 8, Ordering::Release);
    }

    /// Whether and how the device is to leave.
    pub fn asked(&self) -> Option<(ReentryPath, BootRequest)> {
        let told = self.request.load(Ordering::Acquire);
        let path = (told as u8).checked_sub(1).and_then(ReentryPath::from_number)?;
        let argument = self.argument.load(Ordering::Relaxed);
        Some((path, WarmStart::encode(told >> 8, argument).request().unwrap_or(BootRequest::Stay)))
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::warm_start::Owed;

    use super::*;

    /// -8 is `Locked` of the callgate ABI, version 1.
    #[test]
    fn a_locked_flash_leaves_the_confirmation_to_the_reset() {
        assert_eq!(Confirmed::from_outcome(Ok(())), Ok(Confirmed::Now));
        assert_eq!(Confirmed::from_outcome(Err(CallgateError::Refused(-8))), Ok(Confirmed::AtReset));
        for error in [CallgateError::Refused(-7), CallgateError::Absent, CallgateError::Version(2)] {
            assert_eq!(Confirmed::from_outcome(Err(error)), Err(error));
        }
    }

    #[test]
    fn an_exit_carries_path_and_request() {
        let exit = Exit::new();
        assert_eq!(exit.asked(), None);
        for path in [ReentryPath::SystemReset, ReentryPath::Watchdog, ReentryPath::Jump] {
            for request in [
                BootRequest::Stay,
                BootRequest::PowerOn,
                BootRequest::Start(254),
                BootRequest::Confirm(1),
                BootRequest::Owed(Owed { program: 3, value: 3, node_id: 127 }),
            ] {
                exit.ask(path, request);
                assert_eq!(exit.asked(), Some((path, request)));
            }
        }
    }
}
