//! The bootloader as a CANopen device: its object dictionary, with the download behind it.

use canopen::device::{self, Device};
use canopen::od::{concat, put, Access, Address, DataType, Entry, Objects};
use canopen::program::{
    ProgramControl, ProgramState, FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_DATA, PROGRAM_ID,
};
use canopen::AbortCode;
use shared_abi::layout::Layout;
use shared_abi::warm_start::BootRequest;

use crate::download::{Downloader, Step};
use crate::flash::Flash;

/// The program objects of a device with one program (SYS TEC manual L-1112d_10, table 1).
const PROGRAM_ENTRIES: [Entry; 8] = [
    Entry::array(PROGRAM_DATA, "Program data", 1),
    Entry::sub(PROGRAM_DATA, 1, "Program data 1", DataType::Domain, Access::Wo),
    Entry::array(PROGRAM_CONTROL, "Program control", 1),
    Entry::sub(PROGRAM_CONTROL, 1, "Program control 1", DataType::Unsigned8, Access::Rw).default(0),
    Entry::array(PROGRAM_ID, "Program software identification", 1),
    Entry::sub(PROGRAM_ID, 1, "Program software identification 1", DataType::Unsigned32, Access::Ro),
    Entry::array(FLASH_STATUS, "Flash status identification", 1),
    Entry::sub(FLASH_STATUS, 1, "Flash status identification 1", DataType::Unsigned32, Access::Ro).default(0),
];

/// The object dictionary of a bootloader with one program.
pub static ENTRIES: [Entry; 19] = concat(device::ENTRIES, PROGRAM_ENTRIES);

/// Programs in the object dictionary.
const PROGRAMS: usize = 1;

/// The objects of the bootloader and what is behind them.
pub struct Bootloader<'b, F: Flash> {
    device: Device,
    flash: F,
    download: Downloader<'b, PROGRAMS>,
}

impl<'b, F: Flash> Bootloader<'b, F> {
    /// Starts from what the flash holds. The size of `buffer` is the largest block that 1F50h takes, framing included.
    pub fn new(device: Device, layout: &'static Layout, flash: F, buffer: &'b mut [u8]) -> Self {
        let download = Downloader::new(layout, &flash, buffer);
        Self { device, flash, download }
    }

    /// Carries the work on the flash on: a bounded piece of it.
    pub fn step(&mut self) -> Step {
        self.download.step(&mut self.flash)
    }

    /// Whether there is work for [`Bootloader::step`].
    #[must_use]
    pub fn busy(&self) -> bool {
        self.download.busy()
    }

    /// The request to leave the bootloader, once; the answer to the command may still be on its way.
    pub fn take_leave(&mut self) -> Option<BootRequest> {
        self.download.take_leave()
    }

    /// The flash behind it.
    pub fn flash(&mut self) -> &mut F {
        &mut self.flash
    }
}

impl<F: Flash> Objects for Bootloader<'_, F> {
    fn entries(&self) -> &'static [Entry] {
        &ENTRIES
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        if let Some(read) = self.device.read(at, buf) {
            return read;
        }
        match at.index {
            PROGRAM_CONTROL => put(buf, &[ProgramState::Stopped as u8]),
            PROGRAM_ID => put(buf, &self.download.identification(at.sub).to_le_bytes()),
            FLASH_STATUS => put(buf, &self.download.status(at.sub).to_word().to_le_bytes()),
            _ => Err(AbortCode::NO_DATA),
        }
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        match (at.index, data) {
            (PROGRAM_CONTROL, &[value]) => self.download.command(at.sub, ProgramControl::try_from(value)?),
            _ => Err(AbortCode::UNSUPPORTED_ACCESS),
        }
    }

    fn download_start(&mut self, at: Address, size: Option<u32>) -> Result<(), AbortCode> {
        self.download.block_start(at.sub, size)
    }

    fn download_data(&mut self, _at: Address, data: &[u8]) -> Result<(), AbortCode> {
        self.download.block_data(data)
    }

    fn download_end(&mut self, _at: Address) -> Result<(), AbortCode> {
        self.download.block_end(&self.flash)
    }

    fn download_cancel(&mut self, _at: Address) {
        self.download.block_cancel();
    }
}
