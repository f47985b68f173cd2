//! The template's application with the objects that only tests need: the password of a lift (6005h),
//! the debugger interface (1025h), and the other services of coboot (2000h, 2001h).

use core::task::Poll;

use app_template::entries::{entries, entry_count, numbers};
use app_template::objects::Application;
use bsp::LAYOUT;
use canopen::line::LineEvent;
use canopen::lss::{LssDevice, StoreError};
use canopen::od::{put, Access, Address, DataType, Entry, Exchange, Objects, Reply};
use canopen::password::Lock;
use canopen::program::{Numbers, UNLOCK, UNLOCK_ENTRIES};
use canopen::slave::{Slave, SlaveDevice};
use canopen::{AbortCode, BitRate, Instant, NodeId};
use coboot_app::callgate::PROGRAM_SIGNED;
use coboot_app::warm_start::BootRequest;
use coboot_app::{renewal, Bootloader, ReentryPath, Services};

use crate::debugger;

/// Whether this is a lift device.
const LIFT: bool = cfg!(feature = "lift");

/// Those of the template; on a lift number 2 is for its parameters, and the bootloader's follows that.
const NUMBERS: Numbers = match numbers(LAYOUT) {
    Numbers { programs, bootloader: Some(_) } if LIFT => {
        Numbers { programs, bootloader: Some(renewal::number(programs, Some(2))) }
    }
    numbers => numbers,
};
/// How 1F51h = 80h leads back into the bootloader: 0 system reset, 1 watchdog reset, 2 jump.
const REENTRY_PATH: u16 = 0x2000;
/// The bootloader's state of this program: bit 0 installed, bit 1 signed. A write with bit 1 set
/// confirms the program; a write without it removes the signature.
const CONFIRMATION: u16 = 0x2001;
const SERVICES: [Entry; 2] = [
    Entry::var(REENTRY_PATH, "Re-entry path into the bootloader", DataType::Unsigned8, Access::Rw),
    Entry::var(CONFIRMATION, "Confirmation", DataType::Unsigned8, Access::Rw),
];
const ENTRY_COUNT: usize = entry_count(NUMBERS) + debugger::ENTRIES.len() + SERVICES.len();
/// The object dictionary, with 1025h where there is a debugger interface.
static ENTRIES: [Entry; ENTRY_COUNT] = entries(NUMBERS).with(&debugger::ENTRIES).with(&SERVICES).entries();
/// The one of a lift device.
static WITH_PASSWORD: [Entry; ENTRY_COUNT + UNLOCK_ENTRIES.len()] =
    entries(NUMBERS).with(&debugger::ENTRIES).with(&SERVICES).with(&UNLOCK_ENTRIES).entries();

/// The application, its lock and its way back.
pub struct Device {
    /// The template's.
    pub application: Application,
    lock: Lock,
    /// The value of 2000h.
    path: ReentryPath,
    /// The time of the last call of [`Self::set_time`].
    now: Instant,
}

impl Device {
    /// As [`Application::start`].
    pub fn start(software_version: &'static str) -> (Self, Slave) {
        let (mut application, slave) = Application::start(software_version);
        if LIFT {
            // The bootloader of a lift is node 126, whatever the node-ID of this program.
            application.control = application.control.clone().answering_itself();
        }
        let lock = Lock::new(shared_abi::LIFT_PASSWORD);
        (Self { application, lock, path: ReentryPath::default(), now: Instant::from_millis(0) }, slave)
    }

    /// The path on which the device leaves with this request: an NMT master gets a reset.
    pub fn path(&self, request: BootRequest) -> ReentryPath {
        match request {
            BootRequest::PowerOn | BootRequest::Rescue => ReentryPath::SystemReset,
            _ => self.path,
        }
    }

    /// A write to 2001h.
    fn confirm(&mut self, value: u8) -> Result<(), AbortCode> {
        let (control, now) = (&mut self.application.control, self.now.as_millis());
        let mut bootloader = Bootloader::new(LAYOUT);
        if u32::from(value) & PROGRAM_SIGNED != 0 {
            return control.confirm(now, &mut bootloader).map_err(|_| AbortCode::DEVICE_STATE);
        }
        bootloader.invalidate(control.program()).map_err(|_| AbortCode::DEVICE_STATE)
    }

    /// As [`Application::set_time`].
    pub fn set_time(&mut self, now: Instant) {
        self.now = now;
        if LIFT {
            // The lock must be asked at least now and then.
            let _ = self.lock.is_waiting(now);
        }
        self.application.set_time(now);
    }
}

impl Objects for Device {
    fn entries(&self) -> &'static [Entry] {
        if LIFT {
            &WITH_PASSWORD
        } else {
            &ENTRIES
        }
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        match at.index {
            REENTRY_PATH => put(buf, &[self.path as u8]),
            CONFIRMATION => {
                let info = Bootloader::new(LAYOUT).program_info(self.application.control.program());
                put(buf, &[info.map_err(|_| AbortCode::DEVICE_STATE)?.flags as u8])
            }
            _ => self.application.read(at, buf),
        }
    }

    fn write_with_reply(&mut self, at: Address, data: &[u8], expedited: bool) -> Result<Reply, AbortCode> {
        match (at.index, data) {
            (UNLOCK, password) if LIFT => {
                self.lock.open(password, self.now)?;
                self.application.control.arm();
            }
            (REENTRY_PATH, &[value]) => {
                self.path = ReentryPath::from_number(value).ok_or(AbortCode::INVALID_VALUE)?;
            }
            (CONFIRMATION, &[value @ 0..=3]) => self.confirm(value)?,
            (CONFIRMATION, _) => return Err(AbortCode::INVALID_VALUE),
            _ => return self.application.write_with_reply(at, data, expedited),
        }
        Ok(Reply::Send)
    }

    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        self.application.next_emergency()
    }

    fn exchange(&mut self) -> Option<&mut dyn Exchange> {
        self.application.exchange()
    }
}

impl LssDevice for Device {
    fn supports(&mut self, rate: BitRate) -> bool {
        self.application.supports(rate)
    }

    fn store(&mut self, id: Option<NodeId>, rate: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        self.application.store(id, rate)
    }
}

impl SlaveDevice for Device {
    fn line_event(&mut self, event: LineEvent) {
        self.application.line_event(event);
    }

    fn node_id_changed(&mut self, id: Option<NodeId>) {
        self.application.node_id_changed(id);
    }
}
