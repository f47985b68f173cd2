//! The services of the bootloader, which an application calls like functions (the callgate), and
//! the re-entry into the bootloader.

use core::sync::atomic::{AtomicU32, Ordering};

use shared_abi::layout::Layout;
use shared_abi::warm_start::{BootRequest, WarmStart};

use crate::callgate::{Callgate, CallgateError, NodeArgs, ProgramArgs, Status};

/// The services that [`ProgramControl`](crate::ProgramControl) needs from the bootloader.
/// [`Bootloader`] implements them for the chip; a test implements its own.
pub trait Services {
    /// The bootloader's data about a program, 1 to 254.
    ///
    /// # Errors
    /// The error of the bootloader.
    fn program_info(&mut self, number: u8) -> Result<ProgramArgs, CallgateError>;

    /// Confirms a program: a program on trial becomes a permanent one.
    ///
    /// # Errors
    /// The error of the bootloader.
    fn confirm(&mut self, number: u8) -> Result<Confirmed, CallgateError>;

    /// Takes back that a program is confirmed: it starts with its rescue window.
    ///
    /// # Errors
    /// The error of the bootloader.
    fn unconfirm(&mut self, _number: u8) -> Result<(), CallgateError> {
        Err(CallgateError::Absent)
    }
}

/// The result of a confirmation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Confirmed {
    /// The confirmation is stored.
    Now,
    /// The flash is locked because the program is sealed. The bootloader stores the confirmation
    /// when the device leaves with [`BootRequest::Confirm`].
    AtReset,
}

impl Confirmed {
    /// The result that belongs to the callgate's answer to a confirmation.
    ///
    /// # Errors
    /// The callgate's error, unless the confirmation was stored or the flash was locked.
    pub const fn from_outcome(outcome: Result<(), CallgateError>) -> Result<Self, CallgateError> {
        match outcome {
            Ok(()) => Ok(Self::Now),
            Err(CallgateError::Refused(LOCKED)) => Ok(Self::AtReset),
            Err(error) => Err(error),
        }
    }
}

/// The callgate cannot store before a reset.
pub(crate) const LOCKED: i32 = Status::Locked as i32;
/// What is stored in the place of a node-ID for a device that waits for one.
pub(crate) const NO_NODE_ID: u8 = 255;

/// The bootloader of a board.
///
/// Each service uses up to [`callgate::STACK`](crate::callgate::STACK) bytes of the caller's
/// stack and no other RAM of the caller. Call one service at a time, from one priority, and do not
/// use the flash controller meanwhile. If the bootloader has no callgate, every service returns
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

    /// Stores node-ID and bit rate for bootloader and application. They are in force from the next
    /// reset on. The node-ID is 1 to 127, or `None` for a device that waits for layer setting
    /// services. The bit rate is in bit/s; 0 means that the device detects it by listening.
    ///
    /// Writes flash: each fetch from it waits for 16 µs at a time. While few places of the journal are free, it
    /// is refused with [`Status::Full`]; the next start makes room.
    ///
    /// # Errors
    /// The error of the bootloader. A sealed device stores these values in the bootloader only, and
    /// only for the holder of a root key.
    pub fn store_node(&self, node_id: Option<u8>, bit_rate: u32) -> Result<(), CallgateError> {
        let node_id = node_id.unwrap_or(NO_NODE_ID).into();
        Callgate::find(self.layout)?.store_node(NodeArgs { node_id, bit_rate })
    }

    /// Removes a program's signature: the program does not start by itself any more. Writes flash,
    /// as [`store_node`](Self::store_node) does.
    ///
    /// # Errors
    /// The error of the bootloader. In a sealed device only the holder of a root key removes a
    /// signature, and only in the bootloader.
    pub fn invalidate(&self, number: u8) -> Result<(), CallgateError> {
        Callgate::find(self.layout)?.invalidate(number)
    }
}

impl Services for Bootloader {
    fn program_info(&mut self, number: u8) -> Result<ProgramArgs, CallgateError> {
        Callgate::find(self.layout)?.program_info(number)
    }

    /// Writes flash, as [`Bootloader::store_node`] does.
    fn confirm(&mut self, number: u8) -> Result<Confirmed, CallgateError> {
        Confirmed::from_outcome(Callgate::find(self.layout)?.confirm(number))
    }

    /// Writes flash, as [`Bootloader::store_node`] does.
    fn unconfirm(&mut self, number: u8) -> Result<(), CallgateError> {
        Callgate::find(self.layout)?.unconfirm(number)
    }
}

#[cfg(target_arch = "arm")]
impl Bootloader {
    /// The value of 1F56h, the same as in the bootloader: the CRC over the data that was downloaded
    /// as this program. If a debugger wrote the program, there is no such CRC; then it is the CRC
    /// over the program as it was linked, computed through the callgate. The value is 0 without a
    /// bootloader. The time grows with the size of the program: call it once, at the start.
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

    /// Leaves for the bootloader. Before the call, all frames must be on the bus
    /// ([`Next::Leave`](crate::Next::Leave)), and the outputs must be in a safe state.
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
    /// By a system reset. Use it unless there is a reason for another path.
    #[default]
    SystemReset = 0,
    /// By a reset of the independent watchdog, for code that may not write the system control
    /// block. It takes a millisecond at most, also if the watchdog already runs.
    Watchdog = 1,
    /// By a jump, with all resources released, for a chip on which a reset would switch something
    /// off. Call it in thread mode; in a handler it becomes a system reset.
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

/// Carries the request to leave from the task that serves the bus to the task that leaves.
/// [`ReentryPath::Jump`] needs it, because it starts in thread mode. Make it a `static` of the
/// program.
#[derive(Debug)]
pub struct Exit {
    /// 0: stay. Otherwise the path (1 to 3), and from bit 8 on the request as in the warm-start
    /// cell.
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
    /// No request to leave.
    #[must_use]
    pub const fn new() -> Self {
        Self { request: AtomicU32::new(0), argument: AtomicU32::new(0) }
    }

    /// Asks the device to leave.
    pub fn ask(&self, path: ReentryPath, request: BootRequest) {
        let WarmStart { request, argument, .. } = WarmStart::new(request);
        self.argument.store(argument, Ordering::Relaxed);
        self.request.store((path as u32 + 1) | request << 8, Ordering::Release);
    }

    /// The path and the request, if the device is to leave.
    pub fn asked(&self) -> Option<(ReentryPath, BootRequest)> {
        let reported = self.request.load(Ordering::Acquire);
        let path = (reported as u8).checked_sub(1).and_then(ReentryPath::from_number)?;
        let argument = self.argument.load(Ordering::Relaxed);
        Some((path, WarmStart::encode(reported >> 8, argument).request().unwrap_or(BootRequest::Stay)))
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

    /// On the host there is no bootloader: each service says so, and none pretends to have worked.
    #[test]
    fn without_a_bootloader_each_service_says_so() {
        let mut bootloader = Bootloader::new(&shared_abi::layout::stm32f407g_disc1::LAYOUT);
        let absent = CallgateError::Absent;
        assert_eq!(bootloader.store_node(Some(5), 125_000), Err(absent));
        assert_eq!(bootloader.invalidate(1), Err(absent));
        assert!(matches!(bootloader.program_info(1), Err(CallgateError::Absent)));
        assert_eq!(bootloader.confirm(1), Err(absent));
    }
}
