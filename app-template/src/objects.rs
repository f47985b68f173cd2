//! The values of the application's object dictionary. The values of 1F51h, 1F56h and 1F57h come
//! from `coboot-app`, which also decides when the device goes back to its bootloader.

use core::task::Poll;

use bsp::{line, IDENTITY, LAYOUT};
use canopen::device::Device;
use canopen::emcy::Emcy;
use canopen::line::LineEvent;
use canopen::lss::{LssAddress, LssDevice, StoreError};
use canopen::od::{put, Address, Entry, Objects};
#[cfg(feature = "lift")]
use canopen::password::Lock;
#[cfg(feature = "lift")]
use canopen::program::UNLOCK;
use canopen::program::{
    region_value, FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_ID, PROGRAM_REGION, PROGRAM_VERSION, UNLOCK_ENTRIES,
};
use canopen::slave::Slave;
use canopen::slave::SlaveDevice;
use canopen::{AbortCode, BitRate, Instant, NodeId};
use coboot_app::callgate::PROGRAM_SIGNED;
use coboot_app::warm_start::{BootRequest, Owed};
use coboot_app::{Answer, Bootloader, Next, ProgramControl, ReentryPath, Services, Start};

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

// Whom this image is for, at the place where the bootloader looks before it takes a raw image or HEX
// file.
coboot_app::label!(
    vendor_id: IDENTITY.vendor_id,
    product_code: IDENTITY.product_code,
    version: if cfg!(feature = "version-2") { 2 } else { 1 },
);

/// 100Ah as update tools find it in the image (CiA 814-1 clause 6.5).
#[used]
static MARKED_VERSION: &str = concat!("$CANopenSoftwareVersion\0", version!(), "\0");

/// The bootloader underneath.
const BOOTLOADER: Bootloader = Bootloader::new(LAYOUT);

/// The application's state that is visible on the bus.
pub struct Application {
    device: Device,
    /// 1F51h, 1F56h, 1F57h, and the way back.
    pub control: ProgramControl,
    bootloader: Bootloader,
    /// The re-entry path (2000h).
    path: ReentryPath,
    /// An answer that the SDO server still has to withhold.
    owed: Option<Owed>,
    #[cfg(feature = "lift")]
    lock: Lock,
    /// The time of the last call of [`Self::set_time`].
    now: Instant,
    emcy: Emcy,
    /// Node-ID in force.
    id: Option<NodeId>,
    /// Bit rate that the device came up with.
    bit_rate: BitRate,
}

impl Application {
    /// Builds the state from the bootloader's values. Asks the bootloader for the CRC over this
    /// program, once.
    pub fn new(start: &Start, bit_rate: BitRate) -> Self {
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
        let control = ProgramControl::new(start, PROGRAMS, BOOTLOADER.program_crc(start.program));
        // The bootloader of a lift is node 126, whatever the node-ID of this program.
        let control = if cfg!(feature = "lift") { control.answering_itself() } else { control };
        Self {
            device,
            control,
            bootloader: BOOTLOADER,
            path: ReentryPath::default(),
            owed: None,
            #[cfg(feature = "lift")]
            lock: Lock::new(shared_abi::LIFT_PASSWORD),
            now: Instant::from_millis(0),
            bit_rate,
            emcy: Emcy::new(),
            id: start.node_id.and_then(NodeId::new),
        }
    }

    /// The identity of the device for layer setting services.
    pub fn lss_address(&self) -> LssAddress {
        self.device.lss_address()
    }

    /// Passes the time in: call it at least every few milliseconds.
    pub fn set_time(&mut self, now: Instant) {
        self.now = now;
        // Asked at least now and then, as it wants.
        #[cfg(feature = "lift")]
        let _ = self.lock.is_waiting(now);
    }

    /// Advances the departure, if one is in progress.
    pub fn proceed(&mut self, bus_idle: bool) -> Next<BootRequest> {
        self.control.proceed(bus_idle, self.now.as_millis())
    }

    /// The path on which the device leaves with this request: an NMT master gets a reset.
    pub fn path(&self, request: BootRequest) -> ReentryPath {
        match request {
            BootRequest::PowerOn => ReentryPath::SystemReset,
            _ => self.path,
        }
    }

    /// Call it after every frame. Withdraws an answer that the bootloader is to send. If the client
    /// has written in segments, the answer cannot be withdrawn, so the command is judged once more.
    pub fn leave_owed(&mut self, slave: &mut Slave) {
        let Some(owed) = self.owed.take() else { return };
        let now = self.now.as_millis();
        let Owed { program, value, .. } = owed;
        if slave.withdraw_answer(&[0x60, 0x51, 0x1F, program, 0, 0, 0, 0]) {
            self.control.leave_owed(owed, now);
        } else if let Err(abort) = self.control.write_answered(program, &[value], now, &mut self.bootloader) {
            slave.refuse(abort.into());
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
        let Self { control, bootloader, .. } = self;
        match at.index {
            PROGRAM_CONTROL => put(buf, &[control.state(at.sub, bootloader)?]),
            PROGRAM_ID => put(buf, &control.identification(at.sub, bootloader)?.to_le_bytes()),
            FLASH_STATUS => put(buf, &control.flash_status(at.sub)?.to_le_bytes()),
            PROGRAM_REGION => {
                let region = LAYOUT.program(at.sub).ok_or(AbortCode::NO_DATA)?;
                put(buf, &region_value(region.base, region.size))
            }
            PROGRAM_VERSION => {
                let version = bootloader.program_info(at.sub).map_or(0, |info| info.version);
                put(buf, &version.to_le_bytes())
            }
            REENTRY_PATH => put(buf, &[self.path as u8]),
            CONFIRMATION => {
                let info = bootloader.program_info(control.program()).map_err(|_| AbortCode::DEVICE_STATE)?;
                put(buf, &[info.flags as u8])
            }
            _ => Err(AbortCode::NO_DATA),
        }
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        if let Some(written) = self.emcy.write(at, data) {
            return written;
        }
        let now = self.now.as_millis();
        match (at.index, data) {
            // The callback runs before the SDO answer is sent, so it only takes a note.
            (PROGRAM_CONTROL, data) => {
                match self.control.write(at.sub, data, now, &mut self.bootloader)? {
                    Answer::Send => {}
                    Answer::Withhold(owed) => self.owed = Some(owed),
                }
                Ok(())
            }
            #[cfg(feature = "lift")]
            (UNLOCK, password) => {
                self.lock.open(password, self.now)?;
                self.control.arm();
                Ok(())
            }
            (REENTRY_PATH, &[value]) => {
                self.path = ReentryPath::from_number(value).ok_or(AbortCode::INVALID_VALUE)?;
                Ok(())
            }
            (CONFIRMATION, &[value @ 0..=3]) => {
                if u32::from(value) & PROGRAM_SIGNED != 0 {
                    let confirmed = self.control.confirm(now, &mut self.bootloader);
                    return confirmed.map_err(|_| AbortCode::DEVICE_STATE);
                }
                self.bootloader.invalidate(self.control.program()).map_err(|_| AbortCode::DEVICE_STATE)
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
        line::supports(rate)
    }

    /// The bootloader stores the values: its journal lies in flash that this program does not own.
    fn store(&mut self, id: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        let rate = rate.unwrap_or(self.bit_rate);
        let id = id.map(NodeId::get);
        let stored = self.bootloader.store_node(id, rate.or_zero()).map_err(|_| StoreError::Failed);
        if stored.is_ok() {
            self.control.node_stored(id, rate == self.bit_rate);
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
        self.control.node_id_changed(id.map(NodeId::get));
    }
}
