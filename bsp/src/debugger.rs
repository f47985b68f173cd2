//! The debugger interface, 1025h, to the chip's memory (feature `debugger`): **every node on the bus
//! can read and write this device's memory**. A request may name any address, and none causes a
//! fault.

use canopen::debugger::{self, Command, Debugged, Kind, Memory};
use canopen::AbortCode;
use shared_abi::memory_map::{may_read, may_write};

use crate::{pac, LAYOUT};

pub use canopen::debugger::ENTRIES;

/// The interface of a device. With the feature `monitor` it also reports where the program stops.
pub struct Debugger(debugger::Debugger<Chip>);

impl Debugger {
    /// The interface to this chip's memory.
    #[must_use]
    #[allow(clippy::new_without_default, reason = "a device has one, where its tasks are set up")]
    pub const fn new() -> Self {
        Self(debugger::Debugger::new(Chip))
    }

    /// The device with the interface in front of it.
    pub fn attach<'a, D>(&'a mut self, device: &'a mut D) -> Debugged<'a, D, Chip> {
        #[cfg(feature = "monitor")]
        if let Some((kind, address)) = crate::monitor::take_stop() {
            if let Some(stop) = debugger::Stop::from_number(kind) {
                self.0.stopped(stop, address);
            }
        }
        self.0.attach(device)
    }
}

/// All memory of the chip.
pub struct Chip;

impl Memory for Chip {
    fn is_locked(&mut self) -> bool {
        is_locked()
    }

    fn allows(&mut self, command: &Command) -> bool {
        let allowed = match command.kind {
            Kind::Read => may_read,
            Kind::Write => may_write,
        };
        allowed(LAYOUT.chip, command.address, command.len.into())
    }

    fn read(&mut self, address: u32, bytes: &mut [u8]) -> Result<(), AbortCode> {
        read(address, bytes)
    }

    fn write(&mut self, address: u32, bytes: &[u8]) -> Result<(), AbortCode> {
        write(address, bytes)
    }
}

/// Whether the chip's read-out protection is on, at level 1 or 2 (RM0090, embedded flash: read
/// protection): `RDP` in `FLASH_OPTCR` is AAh if it is off.
#[must_use]
pub fn is_locked() -> bool {
    const OPEN: u8 = 0xAA;
    // SAFETY: reading this register changes nothing.
    unsafe { pac::FLASH::steal() }.optcr().read().rdp().bits() != OPEN
}

/// Reads memory or registers, by words if the address allows it.
///
/// # Errors
/// [`AbortCode::INVALID_VALUE`] if the address has no memory that may be accessed
/// (`shared_abi::memory_map`); [`AbortCode::LOCAL_CONTROL`] if the flash is busy, because reading it
/// now would stop the CPU until it is idle, or if the CCM has no clock. Then nothing was read.
pub fn read(address: u32, bytes: &mut [u8]) -> Result<(), AbortCode> {
    if !may_read(LAYOUT.chip, address, bytes.len() as u32) {
        return Err(AbortCode::INVALID_VALUE);
    }
    if is_busy(address) {
        return Err(AbortCode::LOCAL_CONTROL);
    }
    let mut at = address;
    let mut rest = bytes;
    while !rest.is_empty() {
        let width = width(at, rest.len());
        let (piece, behind) = rest.split_at_mut(width);
        // SAFETY: the whole range can be read (`may_read`), and the address is aligned to the
        // width. The effect of such a read on a peripheral is intended by the requester.
        unsafe {
            match width {
                4 => piece.copy_from_slice(&(at as *const u32).read_volatile().to_le_bytes()),
                2 => piece.copy_from_slice(&(at as *const u16).read_volatile().to_le_bytes()),
                _ => piece.copy_from_slice(&[(at as *const u8).read_volatile()]),
            }
        }
        at = at.wrapping_add(width as u32);
        rest = behind;
    }
    Ok(())
}

/// Writes RAM or registers, with the same access widths as [`read`].
///
/// # Errors
/// As for [`read`]; then nothing was written.
fn write(address: u32, bytes: &[u8]) -> Result<(), AbortCode> {
    if !may_write(LAYOUT.chip, address, bytes.len() as u32) {
        return Err(AbortCode::INVALID_VALUE);
    }
    if is_busy(address) {
        return Err(AbortCode::LOCAL_CONTROL);
    }
    let mut at = address;
    let mut rest = bytes;
    while !rest.is_empty() {
        let width = width(at, rest.len());
        let (piece, behind) = rest.split_at(width);
        // SAFETY: the whole range can be written (`may_write`), and the address is aligned to the
        // width. **The effect on this program is not limited**: a debugger may change any variable,
        // stacks included. This is why a product never has the feature.
        unsafe {
            match *piece {
                [a, b, c, d] => (at as *mut u32).write_volatile(u32::from_le_bytes([a, b, c, d])),
                [a, b] => (at as *mut u16).write_volatile(u16::from_le_bytes([a, b])),
                [a, ..] => (at as *mut u8).write_volatile(a),
                [] => {}
            }
        }
        at = at.wrapping_add(width as u32);
        rest = behind;
    }
    Ok(())
}

/// Whether the memory at this address cannot be read at present.
fn is_busy(address: u32) -> bool {
    /// `RCC_AHB1ENR.CCMDATARAMEN`, on after a reset (RM0090, RCC); a chip without CCM does not have
    /// it.
    const CCM_CLOCK: u32 = 1 << 20;
    // SAFETY: reading these registers changes nothing.
    let (flash, rcc) = unsafe { (pac::FLASH::steal(), pac::RCC::steal()) };
    if LAYOUT.chip.flash.contains(address, 1) {
        flash.sr().read().bsy().bit_is_set()
    } else {
        LAYOUT.chip.ccm.contains(address, 1) && rcc.ahb1enr().read().bits() & CCM_CLOCK == 0
    }
}

/// The widest aligned access that fits, in bytes.
const fn width(address: u32, len: usize) -> usize {
    if address.is_multiple_of(4) && len >= 4 {
        4
    } else if address.is_multiple_of(2) && len >= 2 {
        2
    } else {
        1
    }
}
