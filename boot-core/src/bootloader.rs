//! The bootloader as a CANopen device: its object dictionary, with the download behind it.

use core::task::Poll;

use canopen::bit_rate::BitRate;
use canopen::device::{self, Device};
#[cfg(feature = "emcy")]
use canopen::emcy::{self, Emcy};
#[cfg(feature = "emcy")]
use canopen::line::LineEvent;
use canopen::lss::{LssAddress, LssDevice, StoreError};
use canopen::od::{concat, put, Access, Address, DataType, Entry, Objects};
#[cfg(feature = "emcy")]
use canopen::program::{FlashError, FlashStatus};
use canopen::program::{
    ProgramControl, ProgramState, FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_DATA, PROGRAM_ID,
};
use canopen::slave::SlaveDevice;
use canopen::{AbortCode, NodeId};
use shared_abi::layout::Layout;
use shared_abi::warm_start::BootRequest;

use crate::download::{Downloader, Step};
use crate::flash::Flash;
use crate::node::NodeParameters;

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
#[cfg(feature = "emcy")]
pub static ENTRIES: [Entry; 25] =
    concat(concat::<11, 6, 17>(device::ENTRIES, emcy::ENTRIES), PROGRAM_ENTRIES);
/// The object dictionary of a bootloader with one program.
#[cfg(not(feature = "emcy"))]
pub static ENTRIES: [Entry; 19] = concat(device::ENTRIES, PROGRAM_ENTRIES);

/// Programs in the object dictionary.
const PROGRAMS: usize = 1;

/// What can be chosen about a bootloader.
#[derive(Clone, Copy, Debug)]
pub struct Config {
    /// What it says of itself.
    pub device: Device,
    /// Who owns which address.
    pub layout: &'static Layout,
    /// Node-ID and bit rate that it came up with.
    pub node: NodeParameters,
    /// The bit rates that its controller can be set to.
    pub supports: fn(BitRate) -> bool,
    /// An emergency behind each boot-up, which tells a master that this is the bootloader and not the application: its
    /// code FF00h (device specific, CiA 301 table 26) and these bytes.
    pub boot_up_emergency: Option<[u8; 5]>,
}

/// The objects of the bootloader and what is behind them.
pub struct Bootloader<'b, F: Flash> {
    config: Config,
    /// Node-ID in force.
    id: Option<NodeId>,
    flash: F,
    download: Downloader<'b, PROGRAMS>,
    #[cfg(feature = "emcy")]
    emcy: Emcy,
}

impl<'b, F: Flash> Bootloader<'b, F> {
    /// Starts from what the flash holds. The size of `buffer` is the largest block that 1F50h takes, framing included.
    pub fn new(config: Config, flash: F, buffer: &'b mut [u8]) -> Self {
        let download = Downloader::new(config.layout, &flash, buffer);
        let mut bootloader = Self {
            config,
            id: None,
            flash,
            download,
            #[cfg(feature = "emcy")]
            emcy: Emcy::new(),
        };
        bootloader.node_id_changed(config.node.id);
        bootloader
    }

    /// Who the device is, for layer setting services.
    #[must_use]
    pub fn lss_address(&self) -> LssAddress {
        self.config.device.lss_address()
    }

    /// Carries the work on the flash on: a bounded piece of it.
    pub fn step(&mut self) -> Step {
        let step = self.download.step(&mut self.flash);
        self.tell_outcome();
        step
    }

    /// Tells by an emergency what became of work on the flash.
    fn tell_outcome(&mut self) {
        #[cfg(feature = "emcy")]
        match self.download.take_outcome() {
            None => {}
            Some((_, Ok(()))) => self.emcy.clear(emcy::register::MANUFACTURER),
            Some((program, Err(error))) => {
                let code = match error {
                    FlashError::NoValidProgram | FlashError::Crc => emcy::code::DATA_SET,
                    _ => emcy::code::HARDWARE,
                };
                let status = FlashStatus { busy: false, error: Some(error), detail: 0 }.to_word();
                self.emcy.raise(code, emcy::register::MANUFACTURER, [status as u8, program, 0, 0, 0]);
            }
        }
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
        #[cfg(feature = "emcy")]
        if let Some(read) = self.id.and_then(|id| self.emcy.read(id, at, buf)) {
            return read;
        }
        if let Some(read) = self.config.device.read(at, buf) {
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
        #[cfg(feature = "emcy")]
        if let Some(written) = self.emcy.write(at, data) {
            return written;
        }
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
        let ended = self.download.block_end(&self.flash);
        self.tell_outcome();
        ended
    }

    fn download_cancel(&mut self, _at: Address) {
        self.download.block_cancel();
    }

    #[cfg(feature = "emcy")]
    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        self.emcy.next_message()
    }
}

impl<F: Flash> LssDevice for Bootloader<'_, F> {
    fn supports(&mut self, rate: BitRate) -> bool {
        (self.config.supports)(rate)
    }

    fn store(&mut self, id: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        let node = NodeParameters { id, bit_rate: rate.unwrap_or(self.config.node.bit_rate) };
        match self.download.store_node(node) {
            Ok(()) => {
                self.config.node = node;
                Poll::Pending
            }
            Err(_) => Poll::Ready(Err(StoreError::Failed)),
        }
    }

    fn stored(&mut self) -> Poll<Result<(), StoreError>> {
        self.download.node_stored().map_err(|_| StoreError::Failed)
    }
}

impl<F: Flash> SlaveDevice for Bootloader<'_, F> {
    #[cfg(feature = "emcy")]
    fn line_event(&mut self, event: LineEvent) {
        self.emcy.line_event(event);
    }

    fn node_id_changed(&mut self, id: Option<NodeId>) {
        self.id = id;
        #[cfg(feature = "emcy")]
        if let (Some(_), Some(detail)) = (id, self.config.boot_up_emergency) {
            self.emcy.announce(emcy::code::DEVICE_SPECIFIC, detail);
        }
    }
}
