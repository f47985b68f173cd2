//! Loads the rest of the bootloader from flash to RAM, if it is undamaged and for this device.

use boot_core::flash::Flash;
use bsp::LAYOUT;
use shared_abi::geometry::Region;
use shared_abi::ram_image::Header;
use shared_abi::vectors::VectorTable;
use shared_abi::warm_start::Damage;

use crate::flash::ResidentFlash;
use crate::product::BOARD_IDENTITY;

extern "C" {
    /// The image's header: the linker script of the resident part has its address.
    #[link_name = "__ram_image"]
    static HEADER: Header;
}

/// Checks the image, copies it to its RAM, and returns its vectors.
///
/// # Errors
/// The damaged part; the RAM may then hold the image.
///
/// # Safety
/// Nothing may use the RAM except its last [`LEAST_STACK`](shared_abi::layout::LEAST_STACK)
/// bytes.
pub unsafe fn load(flash: &ResidentFlash) -> Result<VectorTable, Damage> {
    // SAFETY: the linker script places it in flash, aligned; any bits are a valid `Header`, and the
    // flash after it is part of its region, which `check` compares with the image's size.
    let header = unsafe { &HEADER };
    let at = core::ptr::from_ref(header) as u32;
    let data = at + Header::SIZE;
    let home = LAYOUT.home.unwrap_or(LAYOUT.bootloader);
    header.check(home.end() - data, LAYOUT.ram, BOARD_IDENTITY)?;
    if header.crc != 0 {
        let covered = Region::new(at + Header::CRC_FROM, Header::SIZE - Header::CRC_FROM + header.size);
        if flash.crc32(0, covered) != header.crc {
            return Err(Damage::Crc);
        }
    }
    // SAFETY: `check` has found that the image, which is longer than two words, ends within its flash.
    let vectors = header.entry(unsafe { (data as *const [u32; 2]).read_volatile() })?;
    let words = header.size as usize / 4;
    // SAFETY: `check` has found that the image ends within its flash and within its RAM, leaves the
    // stack its room, and has a multiple of four bytes; both addresses are aligned. The caller
    // guarantees that nothing else uses the RAM.
    unsafe {
        let (from, to) = (data as *const u32, header.ram_base as *mut u32);
        for n in 0..words {
            // Volatile: a call of memcpy would copy by bytes.
            to.add(n).write(from.add(n).read_volatile());
        }
    }
    Ok(vectors)
}
