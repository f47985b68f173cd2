//! The object dictionary: the application's own objects, and those of the bootloader's world. 1F51h,
//! 1F56h and 1F57h are asked of `coboot-app`.

use core::sync::atomic::{AtomicU16, Ordering};

use coboot_app::program_control::{PROGRAM_CONTROL, PROGRAM_REGION};
use coboot_app::warm_start::BootRequest;
use coboot_app::{Abort, Bootloader, Next, ProgramControl, Reply, Start};

use crate::device::{LAYOUT, PRODUCT_CODE, REVISION, VENDOR_ID};
use crate::stack::{AbortCode, Confirmation, Dictionary, Value};

/// 2000h, an object of the application: half the period of the LED, in ms.
pub static BLINK_MS: AtomicU16 = AtomicU16::new(500);

/// Whether the device may leave now, for its bootloader or for a reset: asked once, before a
/// command is answered. A machine that moves says no, and the command is refused (08000022h). After
/// a yes `ProgramControl::leaving` is true until the reset, and what stands must not start to move.
fn may_leave() -> bool {
    true
}

/// The values of the dictionary.
pub struct Objects {
    control: ProgramControl,
    bootloader: Bootloader,
    serial_number: u32,
    /// The time, which 1F51h needs: in ms, of a counter that wraps.
    pub now: u32,
}

impl Objects {
    /// For a program that came up so. Asks the bootloader for the CRC over this program, once.
    pub fn new(start: &Start, bootloader: Bootloader) -> Self {
        let crc = bootloader.program_crc(start.program);
        Self {
            control: ProgramControl::new(start, &LAYOUT, crc).asking(may_leave),
            bootloader,
            serial_number: start.serial_number,
            now: 0,
        }
    }

    /// NMT reset node came.
    pub fn reset(&mut self) {
        self.control.nmt_reset(self.now);
    }

    /// Goes on with the way back. `bus_idle`: all that was sent is on the bus and acknowledged.
    pub fn proceed(&mut self, bus_idle: bool) -> Next<BootRequest> {
        self.control.proceed(bus_idle, self.now)
    }
}

impl Dictionary for Objects {
    fn read(&mut self, index: u16, sub: u8) -> Result<Value, AbortCode> {
        let Self { control, bootloader, .. } = self;
        Ok(match (index, sub) {
            // The device type: anything but the bootloader's.
            (0x1000, 0) => value(&[0; 4]),
            (0x1001, 0) => value(&[0]),
            (0x1018, 0) => value(&[4]),
            (0x1018, 1) => value(&VENDOR_ID.to_le_bytes()),
            (0x1018, 2) => value(&PRODUCT_CODE.to_le_bytes()),
            (0x1018, 3) => value(&REVISION.to_le_bytes()),
            (0x1018, 4) => value(&self.serial_number.to_le_bytes()),
            (0x2000, 0) => value(&BLINK_MS.load(Ordering::Relaxed).to_le_bytes()),
            // The stack has no transfer for the eight bytes of this one.
            (PROGRAM_REGION, _) => return Err(AbortCode::NO_OBJECT),
            _ => match control.read(index, sub, bootloader) {
                Some(read) => value(&read?),
                None => return Err(AbortCode::NO_OBJECT),
            },
        })
    }

    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<Confirmation, AbortCode> {
        match (index, sub) {
            (PROGRAM_CONTROL, sub) => {
                // The stack takes expedited downloads alone.
                Ok(match self.control.write(sub, data, true, self.now, &mut self.bootloader)? {
                    Reply::Send => Confirmation::Send,
                    // The bootloader carries the command out, and answers.
                    Reply::Withhold => Confirmation::Withhold,
                })
            }
            (0x2000, 0) => {
                let bytes = data.try_into().map_err(|_| AbortCode::LENGTH)?;
                // An LED that never waits would leave no time for anything else.
                BLINK_MS.store(u16::from_le_bytes(bytes).max(1), Ordering::Relaxed);
                Ok(Confirmation::Send)
            }
            _ => self.read(index, sub).and(Err(AbortCode::READ_ONLY)),
        }
    }
}

/// The codes of `coboot-app` are those of the standard.
impl From<Abort> for AbortCode {
    fn from(Abort(code): Abort) -> Self {
        Self(code)
    }
}

fn value(bytes: &[u8]) -> Value {
    Value::from_slice(bytes).unwrap_or_default()
}
