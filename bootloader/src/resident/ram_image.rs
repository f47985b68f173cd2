//! Loads the rest of the bootloader from flash to RAM, if it is undamaged.

use core::slice;

use boot_core::flash::Flash;
use bsp::LAYOUT;
use shared_abi::geometry::Region;
use shared_abi::ram_image::{Damage, Header, Method, LEAST_STACK};

use crate::flash::ResidentFlash;
use crate::unpack::{restore_calls, unpack};

/// Checks the image and unpacks it to the start of the RAM.
///
/// # Errors
/// The damaged part; the RAM may then hold a part of the image.
///
/// # Safety
/// `header` must be the address of the image's header in the bootloader's flash, aligned. Nothing
/// may use the RAM except its last [`LEAST_STACK`] bytes.
pub unsafe fn load(header: *const Header, flash: &ResidentFlash) -> Result<(), Damage> {
    let at = header as u32;
    // SAFETY: the caller guarantees the address; any bits are a valid `Header`.
    let header = unsafe { &*header };
    let data = at + Header::SIZE;
    let method = header.check(LAYOUT.bootloader.end() - data, LAYOUT.ram.size - LEAST_STACK)?;
    let front = Region::new(LAYOUT.bootloader.base, at - LAYOUT.bootloader.base);
    if header.has_crc() {
        let behind = Region::new(at + Header::CRC_FROM, Header::SIZE - Header::CRC_FROM + header.stored);
        if flash.crc32(flash.crc32(0, front), behind) != header.crc {
            return Err(Damage::Crc);
        }
    }
    // SAFETY: the caller guarantees that the header lies in the bootloader's flash, and `check` has
    // found that the stored bytes end within it. Nothing writes to it in this time.
    let (front, stored) = unsafe {
        (
            slice::from_raw_parts(front.base as *const u8, front.size as usize),
            slice::from_raw_parts(data as *const u8, header.stored as usize),
        )
    };
    // SAFETY: `check` has found this to be RAM, and the caller guarantees that nothing else uses
    // it.
    let ram = unsafe { slice::from_raw_parts_mut(LAYOUT.ram.base as *mut u8, header.unpacked as usize) };
    match method {
        // SAFETY: the two slices are valid, and `check` has found them to be of one length.
        Method::Raw => unsafe { stored.as_ptr().copy_to_nonoverlapping(ram.as_mut_ptr(), stored.len()) },
        Method::Zx0 if !unpack(front, stored, ram) => return Err(Damage::Stream),
        Method::Zx0 => restore_calls(ram),
    }
    Ok(())
}
