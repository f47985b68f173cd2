//! The one way to make a bootloader in a test: what it starts from, and then the flash.

use boot_core::bootloader::{Bootloader, Choices, Config};
use boot_core::control::{Sealed, SealedMemory};
use boot_core::flash::Flash;
use boot_core::store::{Journal, NodeParameters, Parameters};
use shared_abi::boot_report::{BootReport, Reason};

/// What a bootloader starts from, apart from its memory.
pub struct Boot {
    /// The product.
    pub config: &'static Config,
    /// Node-ID and bit rate as stored.
    pub node: NodeParameters,
    /// The device's own number.
    pub serial_number: u32,
    /// Why the device stayed in the bootloader.
    pub report: BootReport,
}

impl Boot {
    /// A device with the serial number 0 that was asked to stay.
    pub fn new(config: &'static Config, node: NodeParameters) -> Self {
        Self {
            config,
            node,
            serial_number: 0,
            report: BootReport { reason: Reason::Requested as u8, ..BootReport::NONE },
        }
    }

    /// Starts on this flash, with the journal in it.
    pub fn on<'b, F: Flash, const PROGRAMS: usize>(
        self,
        flash: F,
        buffer: &'b mut [u8],
        sealed: Sealed<'b>,
    ) -> Bootloader<'b, F, Journal, PROGRAMS> {
        let journal = Journal::open(&flash, self.config.layout.parameters);
        self.with(journal, flash, buffer, sealed)
    }

    /// Starts on this flash, with the parameters in this store.
    pub fn with<'b, F: Flash, P: Parameters, const PROGRAMS: usize, C: Choices>(
        self,
        parameters: P,
        flash: F,
        buffer: &'b mut [u8],
        sealed: Sealed<'b>,
    ) -> Bootloader<'b, F, P, PROGRAMS, C> {
        let Self { config, node, serial_number, report } = self;
        Bootloader::new(config, serial_number, node, &report, parameters, flash, buffer, sealed)
    }
}

/// The variable with which the tests of a device without keys are those of one that takes sealed
/// images, too, and has no keys yet: both behave the same.
const TAKES_SEALED: &str = "COBOOT_TAKES_SEALED";

/// Whether that is set.
pub(crate) fn takes_sealed() -> bool {
    std::env::var_os(TAKES_SEALED).is_some()
}

/// A buffer for blocks, and the memory for sealed images, for a bootloader that lives as long as the test.
pub fn leaked(buffer: usize) -> (&'static mut [u8], Sealed<'static>) {
    let sealed =
        if takes_sealed() { Box::leak(Box::<SealedMemory>::default()).sealed() } else { Sealed::NONE };
    (vec![0; buffer].leak(), sealed)
}
