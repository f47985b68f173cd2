//! The values of the application's object dictionary. The values of 1F51h, 1F56h and 1F57h come
//! from `coboot-app`, which also decides when the device goes back to its bootloader.

use core::sync::atomic::{AtomicU8, Ordering::SeqCst};
use core::task::Poll;

use bsp::{line, IDENTITY, LAYOUT};
use canopen::device::Device;
use canopen::emcy::Emcy;
use canopen::line::LineEvent;
use canopen::lss::{LssAddress, LssDevice, StoreError};
use canopen::od::{put, Address, Entry, Objects};
use canopen::program::{
    region_value, Numbers, DEVICE_STATE, FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_DATE, PROGRAM_ID,
    PROGRAM_REGION, PROGRAM_VERSION,
};
use canopen::slave::Slave;
use canopen::slave::SlaveDevice;
use canopen::{AbortCode, BitRate, Instant, NodeId};
use coboot_app::callgate::PROGRAM_SIGNED;
use coboot_app::nameplate::Nameplate;
use coboot_app::rules::Command;
use coboot_app::warm_start::{BootRequest, Owed};
use coboot_app::{Answer, Bootloader, Next, ProgramControl, ReentryPath, Services, Start};

use crate::entries::{entries, entry_count, numbers, CONFIRMATION, REENTRY_PATH};

/// 1000h: no standardised profile. Anything but the bootloader's 10000000h shows a host that the
/// application runs.
const DEVICE_TYPE: u32 = 0;
/// 1017h, in ms.
pub const HEARTBEAT_MS: u16 = 500;
/// 1018h/1 to 3, from the board file.
const BOARD: Nameplate = Nameplate::new(IDENTITY.vendor_id, IDENTITY.product_code, IDENTITY.revision, 0);
/// 80h to 1F51h: a master calls the bootloader (SYS TEC manual L-1112d_10, table 2).
const START_BOOTLOADER: u8 = Command::StartBootloader as u8;

/// Programs of the device and the bootloader, each a sub-index of 1F51h, 1F56h and 1F57h.
const NUMBERS: Numbers = numbers(LAYOUT);
/// The object dictionary.
static ENTRIES: [Entry; entry_count(NUMBERS)] = entries(NUMBERS).entries();

/// The bootloader underneath.
const BOOTLOADER: Bootloader = Bootloader::new(LAYOUT);

/// What the machine does: it stands, it moves, or it stands because the device leaves. What moves
/// starts by a `compare_exchange` from `STANDS` to `MOVES`, in whatever task, and not at all if
/// that fails: the question below and the start exclude each other.
pub static MACHINE: AtomicU8 = AtomicU8::new(STANDS);
/// See [`MACHINE`].
pub const STANDS: u8 = 0;
/// See [`MACHINE`].
pub const MOVES: u8 = 1;
/// See [`MACHINE`].
pub const LEAVES: u8 = 2;

/// Whether the device may leave now, for its bootloader or for a reset. It is asked once, before a
/// command is answered or left to the bootloader: 1F51h = 80h, 0, 2 and 3, and what a sealed
/// program stores. After a no the command is refused (08000022h), and the program stays. A yes is
/// final: the reset follows within half a second, and until then the machine does not start.
fn may_leave() -> bool {
    MACHINE.compare_exchange(STANDS, LEAVES, SeqCst, SeqCst).is_ok()
}

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
    /// program, once. `software_version` is 100Ah.
    pub fn new(start: &Start, bit_rate: BitRate, software_version: &'static str) -> Self {
        // A bootloader that has another identity from the nameplate of the device shows that one.
        let Nameplate { vendor_id, product_code, revision, .. } = start.nameplate().unwrap_or(BOARD);
        let device = Device {
            device_type: DEVICE_TYPE,
            name: IDENTITY.device_name,
            hardware_version: IDENTITY.hardware_version,
            software_version,
            heartbeat_ms: HEARTBEAT_MS,
            vendor_id,
            product_code,
            revision,
            serial_number: start.serial_number,
        };
        let crc = BOOTLOADER.program_crc(start.program);
        let control = ProgramControl::new(start, NUMBERS.programs, crc).asking(may_leave);
        Self {
            device,
            control,
            bootloader: BOOTLOADER,
            path: ReentryPath::default(),
            owed: None,
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
    }

    /// Advances the departure, if one is in progress.
    pub fn proceed(&mut self, bus_idle: bool) -> Next<BootRequest> {
        if self.control.leaving() {
            // An NMT reset did not ask.
            MACHINE.store(LEAVES, SeqCst);
        } else {
            // A command may be refused for another reason after the yes.
            let _ = MACHINE.compare_exchange(LEAVES, STANDS, SeqCst, SeqCst);
        }
        self.control.proceed(bus_idle, self.now.as_millis())
    }

    /// The path on which the device leaves with this request: an NMT master gets a reset.
    pub fn path(&self, request: BootRequest) -> ReentryPath {
        match request {
            BootRequest::PowerOn | BootRequest::Rescue => ReentryPath::SystemReset,
            _ => self.path,
        }
    }

    /// The callback of 1F51h = 80h, START_BOOTLOADER: a master calls the bootloader in the place of
    /// `program`.
    ///
    /// It runs before the SDO answer is sent, so it only takes a note: [`proceed`](Self::proceed)
    /// lets the device leave when the answer is on the bus. The first 80h to a program that has just
    /// been downloaded and started confirms that program instead (`coboot_app::rules`). Whether the
    /// device may leave at all is asked of [`may_leave`], for this command and every other one.
    fn start_bootloader(&mut self, program: u8) -> Result<(), AbortCode> {
        let now = self.now.as_millis();
        Ok(self.control.write_answered(program, &[START_BOOTLOADER], now, &mut self.bootloader)?)
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
        &ENTRIES
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
            PROGRAM_DATE => {
                let [date, time] = control.software_date();
                put(buf, &if at.sub == 1 { date } else { time }.to_le_bytes())
            }
            PROGRAM_REGION => {
                let region = control.region(at.sub, LAYOUT).ok_or(AbortCode::NO_DATA)?;
                put(buf, &region_value(region.base, region.size))
            }
            PROGRAM_VERSION => {
                let version = control.info(at.sub, bootloader).map_or(0, |info| info.version);
                put(buf, &version.to_le_bytes())
            }
            DEVICE_STATE => put(buf, &[control.bootloader()]),
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
            (PROGRAM_CONTROL, &[START_BOOTLOADER]) => self.start_bootloader(at.sub),
            // The other commands: stop, start, reset and clear a program.
            (PROGRAM_CONTROL, data) => {
                match self.control.write(at.sub, data, now, &mut self.bootloader)? {
                    Answer::Send => {}
                    Answer::Withhold(owed) => self.owed = Some(owed),
                }
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
