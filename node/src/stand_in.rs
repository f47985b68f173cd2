//! A program that is none: there is no CPU here that could run the one in the file. It answers what
//! a host asks a running application for, as CiA 302-3 has it: which program runs (1F51h) and which
//! one it is (1F56h); and it lets itself be called back to the bootloader (1F51h = 80h).

use std::task::Poll;

use boot_core::canopen::device::{self, Device};
use boot_core::canopen::lss::{LssAddress, LssDevice, StoreError};
use boot_core::canopen::od::{put, Access, Address, DataType, Entry, Objects};
use boot_core::canopen::program::{
    FlashStatus, ProgramControl, ProgramState, FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_ID,
};
use boot_core::canopen::slave::SlaveDevice;
use boot_core::canopen::{AbortCode, BitRate, NodeId};

/// 1000h: no standardised profile, and not the bootloader's value.
const DEVICE_TYPE: u32 = 0;
/// 100Ah. Nobody shall take it for the program itself.
const SOFTWARE_VERSION: &str = "coboot-node stand-in";

/// The stand-in of a program.
#[derive(Debug)]
pub struct StandIn {
    entries: &'static [Entry],
    device: Device,
    program: u8,
    crcs: Vec<u32>,
    called_back: bool,
}

impl StandIn {
    /// Of this program, of those with these CRCs (0 for one that is not there), on a device that
    /// says this of itself as a bootloader.
    #[must_use]
    pub fn new(entries: &'static [Entry], bootloader: Device, program: u8, crcs: Vec<u32>) -> Self {
        let device = Device { device_type: DEVICE_TYPE, software_version: SOFTWARE_VERSION, ..bootloader };
        Self { entries, device, program, crcs, called_back: false }
    }

    /// Its object dictionary on a device with so many programs.
    #[must_use]
    pub fn entries(programs: u8) -> Vec<Entry> {
        let mut entries = device::ENTRIES.to_vec();
        for (array, name, data_type, access) in [
            (PROGRAM_CONTROL, "Program control", DataType::Unsigned8, Access::Rw),
            (PROGRAM_ID, "Program software identification", DataType::Unsigned32, Access::Ro),
            (FLASH_STATUS, "Flash status identification", DataType::Unsigned32, Access::Ro),
        ] {
            entries.push(Entry::array(array, name, programs));
            entries.extend((1..=programs).map(|number| Entry::sub(array, number, name, data_type, access)));
        }
        entries
    }

    /// Who the device is, for layer setting services.
    #[must_use]
    pub fn lss_address(&self) -> LssAddress {
        self.device.lss_address()
    }

    /// Whether the bootloader was asked for.
    #[must_use]
    pub fn is_called_back(&self) -> bool {
        self.called_back
    }
}

impl Objects for StandIn {
    fn entries(&self) -> &'static [Entry] {
        self.entries
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        if let Some(read) = self.device.read(at, buf) {
            return read;
        }
        match at.index {
            PROGRAM_CONTROL if at.sub == self.program => put(buf, &[ProgramState::Running as u8]),
            PROGRAM_CONTROL => put(buf, &[ProgramState::Stopped as u8]),
            PROGRAM_ID => {
                let crc = self.crcs.get(usize::from(at.sub).wrapping_sub(1)).copied();
                put(buf, &crc.unwrap_or(0).to_le_bytes())
            }
            FLASH_STATUS => put(buf, &FlashStatus::OK.to_word().to_le_bytes()),
            _ => Err(AbortCode::NO_DATA),
        }
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        let (PROGRAM_CONTROL, &[value]) = (at.index, data) else { return Err(AbortCode::UNSUPPORTED_ACCESS) };
        match ProgramControl::try_from(value)? {
            ProgramControl::StartBootloader => {
                self.called_back = true;
                Ok(())
            }
            // It runs already.
            ProgramControl::Start if at.sub == self.program => Ok(()),
            // The bootloader's to do.
            _ => Err(AbortCode::DEVICE_STATE),
        }
    }
}

impl LssDevice for StandIn {
    fn supports(&mut self, rate: BitRate) -> bool {
        crate::supports(rate)
    }

    /// Storing is the bootloader's.
    fn store(&mut self, _: Option<NodeId>, _: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        Poll::Ready(Err(StoreError::Unsupported))
    }
}

impl SlaveDevice for StandIn {}
