//! The action of the host that failed, for error messages.

use std::fmt;

use canopen::program::ProgramControl;
use canopen::Address;

/// The host's action at the time of an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Doing {
    /// Reading an object.
    Read(Address),
    /// Writing an object.
    Write(Address),
    /// Carrying out a command of 1F51h.
    Command(ProgramControl),
    /// Writing a block of the program.
    Block(u32),
    /// Writing the whole program at once.
    Program,
    /// Writing a new bootloader.
    Bootloader,
    /// Waiting until the device has installed a new bootloader.
    Installation,
    /// Writing the password of a locked device.
    Unlock,
    /// Commanding the bootloader to restart into the program.
    Restart,
}

impl fmt::Display for Doing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Read(at) => write!(f, "reading {at}"),
            Self::Write(at) => write!(f, "writing {at}"),
            Self::Block(u32::MAX) => f.write_str("writing the last block"),
            Self::Block(number) => write!(f, "writing block {number}"),
            Self::Program => f.write_str("writing the program"),
            Self::Bootloader => f.write_str("writing the bootloader"),
            Self::Installation => f.write_str("installing the bootloader"),
            Self::Unlock => f.write_str("unlocking the device"),
            Self::Restart => f.write_str("restarting the program"),
            Self::Command(command) => f.write_str(match command {
                ProgramControl::Stop => "stopping the program",
                ProgramControl::Start => "starting the program",
                ProgramControl::ResetStat => "clearing the status",
                ProgramControl::Clear => "erasing the program",
                ProgramControl::StartBootloader => "calling the bootloader",
                ProgramControl::SetSignature => "releasing the program for autostart",
                ProgramControl::ClrSignature => "withdrawing the release for autostart",
            }),
        }
    }
}

/// The LSS master's action at the time of an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssDoing {
    /// Selecting a device by its LSS address.
    Select,
    /// Asking for the LSS address or the node-ID.
    Inquire,
    /// Setting the node-ID.
    NodeId,
    /// Setting the bit rate.
    BitRate,
    /// Storing node-ID and bit rate.
    Store,
    /// Searching by fastscan.
    Fastscan,
}

impl LssDoing {
    /// The words for messages.
    #[must_use]
    pub const fn words(self) -> &'static str {
        match self {
            Self::Select => "selecting the device by its LSS address",
            Self::Inquire => "asking for LSS address or node-ID",
            Self::NodeId => "setting the node-ID",
            Self::BitRate => "setting the bit rate",
            Self::Store => "storing node-ID and bit rate",
            Self::Fastscan => "fastscan",
        }
    }
}
