//! The object dictionary of the application, with the 1F51h callback that calls the bootloader
//! back.

use core::task::Poll;

use bsp::{IDENTITY, LAYOUT};
use canopen::application::{react, Reaction, Standing};
use canopen::device::Device;
use canopen::emcy::Emcy;
use canopen::line::LineEvent;
use canopen::lss::{LssAddress, LssDevice, StoreError};
use canopen::od::{put, Address, Entry, Objects};
#[cfg(feature = "lift")]
use canopen::program::UNLOCK;
use canopen::program::{
    region_value, FlashStatus, ProgramControl, ProgramState, FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_ID,
    PROGRAM_REGION, PROGRAM_VERSION, UNLOCK_ENTRIES,
};
use canopen::slave::SlaveDevice;
#[cfg(feature = "lift")]
use canopen::{password::Lock, Instant};
use canopen::{AbortCode, BitRate, NodeId};
use shared_abi::callgate::{PROGRAM_INSTALLED, PROGRAM_SIGNED};
use shared_abi::label::Label;
use shared_abi::warm_start::{BootRequest, Owed};

use crate::coboot::{self, Confirmed, Leave, ReentryPath, Start};
use crate::debugger;
use crate::entries::{entries, entry_count, CONFIRMATION, REENTRY_PATH};

/// 1000h: no standardised profile. Anything but the bootloader's 10000000h tells a host that the
/// application runs.
const DEVICE_TYPE: u32 = 0;
/// 1017h, in ms.
pub const HEARTBEAT_MS: u16 = 500;
/// 100Ah.
#[cfg(not(feature = "version-2"))]
macro_rules! version {
    () => {
        "1.0.0"
    };
}
#[cfg(feature = "version-2")]
macro_rules! version {
    () => {
        "2.0.0"
    };
}
const SOFTWARE_VERSION: &str = version!();

/// Programs of the device, each a sub-index of 1F51h, 1F56h and 1F57h.
const PROGRAMS: u8 = LAYOUT.programs.len() as u8;
const ENTRY_COUNT: usize = entry_count(PROGRAMS) + debugger::ENTRIES.len();
/// The object dictionary, with 1025h where there is a debugger interface.
static ENTRIES: [Entry; ENTRY_COUNT] = entries(PROGRAMS).with(&debugger::ENTRIES).entries();
/// The one of a lift device.
static WITH_PASSWORD: [Entry; ENTRY_COUNT + UNLOCK_ENTRIES.len()] =
    entries(PROGRAMS).with(&debugger::ENTRIES).with(&UNLOCK_ENTRIES).entries();

/// Whom this image is for, at the place where the bootloader looks before it takes a raw image or
/// HEX file.
#[used]
#[link_section = ".label"]
static LABEL: Label =
    Label::new(IDENTITY.vendor_id, IDENTITY.product_code, if cfg!(feature = "version-2") { 2 } else { 1 });

/// 100Ah as update tools find it in the image (CiA 814-1 clause 6.5).
#[used]
static MARKED_VERSION: &str = concat!("$CANopenSoftwareVersion\0", version!(), "\0");

/// The application's state, as far as the bus sees it.
pub struct Application {
    device: Device,
    program_crc: u32,
    /// Which program this is.
    program: u8,
    /// The re-entry path (2000h).
    path: ReentryPath,
    leave: Option<Leave>,
    /// What a master was promised of the reset that is due: the bootloader, or that this program is
    /// confirmed by it. Nobody else takes that away.
    promised: Option<BootRequest>,
    /// The next 80h to this program confirms it.
    fresh: bool,
    /// The node-ID as which the bootloader can answer in this program's place.
    bootloader_answers: Option<NodeId>,
    #[cfg(feature = "lift")]
    lock: Lock,
    /// The time that was told last.
    #[cfg(feature = "lift")]
    now: Instant,
    /// The password came: 1F51h = 2 and NMT reset node lead into the bootloader.
    armed: bool,
    emcy: Emcy,
    /// Node-ID in force.
    id: Option<NodeId>,
    /// Bit rate that the device came up with.
    bit_rate: BitRate,
}

impl Application {
    /// From how the device came up. Asks the bootloader for the CRC over this program, once.
    pub fn new(start: &Start) -> Self {
        let device = Device {
            device_type: DEVICE_TYPE,
            name: IDENTITY.device_name,
            hardware_version: IDENTITY.hardware_version,
            software_version: SOFTWARE_VERSION,
            heartbeat_ms: HEARTBEAT_MS,
            vendor_id: IDENTITY.vendor_id,
            product_code: IDENTITY.product_code,
            revision: IDENTITY.revision,
            serial_number: start.serial_number,
        };
        Self {
            device,
            program_crc: coboot::program_crc(start.program),
            program: start.program,
            path: ReentryPath::default(),
            leave: None,
            promised: None,
            fresh: start.fresh,
            bootloader_answers: start.bootloader_answers(),
            #[cfg(feature = "lift")]
            lock: Lock::new(shared_abi::LIFT_PASSWORD),
            #[cfg(feature = "lift")]
            now: Instant::from_millis(0),
            armed: false,
            bit_rate: start.bit_rate,
            emcy: Emcy::new(),
            id: start.node_id,
        }
    }

    /// Who the device is, for layer setting services.
    pub fn lss_address(&self) -> LssAddress {
        self.device.lss_address()
    }

    /// Whether and how the device shall go back to the bootloader, once.
    pub fn take_leave(&mut self) -> Option<(ReentryPath, Leave)> {
        self.leave.take().map(|leave| (self.path, leave))
    }

    /// With which request the device restarts when the NMT master says so.
    pub fn reset_request(&self) -> BootRequest {
        if self.armed {
            BootRequest::Stay
        } else {
            BootRequest::PowerOn
        }
    }

    /// Tells the time: at least every few milliseconds.
    #[cfg(feature = "lift")]
    pub fn set_time(&mut self, now: Instant) {
        self.now = now;
        // Asked at least now and then, as it wants.
        let _ = self.lock.is_waiting(now);
    }

    /// The 1F51h callback. It runs before the SDO answer is sent, so it only notes what is to be done:
    /// `main` sends the answer and leaves, or leaves the answer to the bootloader.
    fn program_control(&mut self, program: u8, command: ProgramControl) -> Result<(), AbortCode> {
        let node_id = self.bootloader_answers.filter(|id| self.id == Some(*id));
        let Self { fresh, armed, .. } = *self;
        let standing = Standing { fresh, armed, can_hand_over: node_id.is_some() };
        self.leave = Some(match react(command, program == self.program, standing)? {
            Reaction::Nothing => return Ok(()),
            Reaction::Confirm => return self.confirm(),
            Reaction::CallBack => return self.promise(BootRequest::Stay),
            _ if matches!(self.promised, Some(BootRequest::Confirm(_))) => {
                return Err(AbortCode::DEVICE_STATE);
            }
            Reaction::Restart => Leave::Answered(BootRequest::Start(program)),
            Reaction::HandOver => {
                let node_id = node_id.map_or(0, NodeId::get);
                Leave::Owed(Owed { program, value: command as u8, node_id })
            }
        });
        Ok(())
    }

    /// The device leaves with this request, unless it was promised to leave with another one.
    fn promise(&mut self, request: BootRequest) -> Result<(), AbortCode> {
        if self.promised.is_some_and(|promised| promised != request) {
            return Err(AbortCode::DEVICE_STATE);
        }
        self.promised = Some(request);
        self.leave = Some(Leave::Answered(request));
        Ok(())
    }

    /// This program is good.
    fn confirm(&mut self) -> Result<(), AbortCode> {
        let confirmed = coboot::confirm(self.program);
        // Until it is stored, an 80h that comes again means the same.
        self.fresh &= confirmed == Ok(Confirmed::AtReset);
        match confirmed {
            Ok(Confirmed::Now) => Ok(()),
            Ok(Confirmed::AtReset) => self.promise(BootRequest::Confirm(self.program)),
            Err(_) => Err(AbortCode::HARDWARE),
        }
    }

    /// What 1F51h reads.
    fn program_state(&self, program: u8) -> ProgramState {
        if program == self.program {
            return ProgramState::Running;
        }
        match coboot::program_info(program) {
            Ok(info) if info.flags & PROGRAM_INSTALLED != 0 => ProgramState::Stopped,
            _ => ProgramState::Absent,
        }
    }
}

impl Objects for Application {
    fn entries(&self) -> &'static [Entry] {
        if cfg!(feature = "lift") {
            &WITH_PASSWORD
        } else {
            &ENTRIES
        }
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        if let Some(read) = self.id.and_then(|id| self.emcy.read(id, at, buf)) {
            return read;
        }
        if let Some(read) = self.device.read(at, buf) {
            return read;
        }
        match at.index {
            PROGRAM_CONTROL => put(buf, &[self.program_state(at.sub) as u8]),
            PROGRAM_ID if at.sub == self.program => put(buf, &self.program_crc.to_le_bytes()),
            PROGRAM_ID => put(buf, &coboot::program_info(at.sub).map_or(0, |info| info.crc).to_le_bytes()),
            FLASH_STATUS => put(buf, &FlashStatus::OK.to_word().to_le_bytes()),
            PROGRAM_REGION => {
                let region = LAYOUT.program(at.sub).ok_or(AbortCode::NO_DATA)?;
                put(buf, &region_value(region.base, region.size))
            }
            PROGRAM_VERSION => {
                let version = coboot::program_info(at.sub).map_or(0, |info| info.version);
                put(buf, &version.to_le_bytes())
            }
            REENTRY_PATH => put(buf, &[self.path as u8]),
            CONFIRMATION => {
                let info = coboot::program_info(self.program).map_err(|_| AbortCode::DEVICE_STATE)?;
                put(buf, &[info.flags as u8])
            }
            _ => Err(AbortCode::NO_DATA),
        }
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        if let Some(written) = self.emcy.write(at, data) {
            return written;
        }
        match (at.index, data) {
            (PROGRAM_CONTROL, &[value]) => self.program_control(at.sub, ProgramControl::try_from(value)?),
            #[cfg(feature = "lift")]
            (UNLOCK, password) => {
                self.lock.open(password, self.now)?;
                self.armed = true;
                Ok(())
            }
            (REENTRY_PATH, &[value]) => {
                self.path = ReentryPath::from_number(value).ok_or(AbortCode::INVALID_VALUE)?;
                Ok(())
            }
            (CONFIRMATION, &[value @ 0..=3]) => {
                if u32::from(value) & PROGRAM_SIGNED != 0 {
                    return self.confirm().map_err(|_| AbortCode::DEVICE_STATE);
                }
                coboot::invalidate(self.program).map_err(|_| AbortCode::DEVICE_STATE)
            }
            (CONFIRMATION, _) => Err(AbortCode::INVALID_VALUE),
            _ => Err(AbortCode::UNSUPPORTED_ACCESS),
        }
    }

    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        self.emcy.next_message()
    }
}

impl LssDevice for Application {
    fn supports(&mut self, rate: BitRate) -> bool {
        coboot::supports(rate)
    }

    /// Storing is the bootloader's: its journal lies in flash that this program does not own.
    fn store(&mut self, id: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        let rate = rate.unwrap_or(self.bit_rate);
        let stored = coboot::store_node(id, rate).map_err(|_| StoreError::Failed);
        if stored.is_ok() && self.bootloader_answers.is_some() {
            // It comes up with these from now on.
            self.bootloader_answers = id.filter(|_| rate == self.bit_rate);
        }
        Poll::Ready(stored)
    }
}

impl SlaveDevice for Application {
    fn line_event(&mut self, event: LineEvent) {
        self.emcy.line_event(event);
    }

    fn node_id_changed(&mut self, id: Option<NodeId>) {
        self.id = id;
    }
}
