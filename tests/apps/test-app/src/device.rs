//! The template's application with the objects that only tests need: the password of a lift (6005h)
//! and the debugger interface (1025h).

use core::task::Poll;

use app_template::entries::{entries, entry_count, numbers};
use app_template::objects::Application;
use bsp::LAYOUT;
use canopen::line::LineEvent;
use canopen::lss::{LssDevice, StoreError};
use canopen::od::{Address, Entry, Objects};
use canopen::password::Lock;
use canopen::program::{Numbers, UNLOCK, UNLOCK_ENTRIES};
use canopen::slave::SlaveDevice;
use canopen::{AbortCode, BitRate, Instant, NodeId};
use coboot_app::{renewal, Start};

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
const ENTRY_COUNT: usize = entry_count(NUMBERS) + debugger::ENTRIES.len();
/// The object dictionary, with 1025h where there is a debugger interface.
static ENTRIES: [Entry; ENTRY_COUNT] = entries(NUMBERS).with(&debugger::ENTRIES).entries();
/// The one of a lift device.
static WITH_PASSWORD: [Entry; ENTRY_COUNT + UNLOCK_ENTRIES.len()] =
    entries(NUMBERS).with(&debugger::ENTRIES).with(&UNLOCK_ENTRIES).entries();

/// The application and its lock.
pub struct Device {
    /// The template's.
    pub application: Application,
    lock: Lock,
    /// The time of the last call of [`Self::set_time`].
    now: Instant,
}

impl Device {
    /// As [`Application::new`].
    pub fn new(start: &Start, bit_rate: BitRate, software_version: &'static str) -> Self {
        let mut application = Application::new(start, bit_rate, software_version);
        if LIFT {
            // The bootloader of a lift is node 126, whatever the node-ID of this program.
            application.control = application.control.clone().answering_itself();
        }
        let lock = Lock::new(shared_abi::LIFT_PASSWORD);
        Self { application, lock, now: Instant::from_millis(0) }
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
        self.application.read(at, buf)
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        if LIFT && at.index == UNLOCK {
            self.lock.open(data, self.now)?;
            self.application.control.arm();
            return Ok(());
        }
        self.application.write(at, data)
    }

    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        self.application.next_emergency()
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
