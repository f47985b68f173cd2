//! Access to all memory of the chip, for the debugger interface.

use canopen::AbortCode;
use shared_abi::memory_map::{may_read, may_write};
use stm32f4xx_hal::pac;

use crate::facts::LAYOUT;

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
pub fn write(address: u32, bytes: &[u8]) -> Result<(), AbortCode> {
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
