//! Loads the rest of the bootloader from flash to RAM, if it is undamaged and for this device, and removes what
//! it leaves there.

use core::mem::transmute;

use boot_core::crc::crc32;
use boot_core::flash::Flash;
use boot_core::renewal::check_contents;
use bsp::LAYOUT;
use shared_abi::geometry::Region;
use shared_abi::handoff::Handoff;
use shared_abi::layout::LEAST_STACK;
use shared_abi::ram_image::{Header, Host, SERVICES_VERSION};
use shared_abi::services::Facts;
use shared_abi::vectors::VectorTable;
use shared_abi::warm_start::Damage;

use crate::flash::ResidentFlash;
use product::{ABILITIES, BOARD_IDENTITY, FACTS, SEALED};

/// What this resident part has for an image.
pub const HOST: Host = Host {
    board: BOARD_IDENTITY,
    services: SERVICES_VERSION,
    features: ABILITIES,
    // SAFETY: it has integers alone, and no gap between them: its size is their sum (shared_abi::services).
    facts: crc32(&unsafe { transmute::<Facts, [u8; Facts::SIZE as usize]>(FACTS) }),
};

extern "C" {
    /// The image's header: the linker script of the resident part has its address.
    #[link_name = "__ram_image"]
    static HEADER: Header;
}

/// The place of the image in flash.
pub fn home() -> Region {
    let at = &raw const HEADER as u32;
    let home = LAYOUT.home.unwrap_or(LAYOUT.bootloader);
    Region::new(at, home.end() - at)
}

/// The header of the image in a place.
///
/// # Safety
/// It must be [`home`], or staging of the layout.
unsafe fn header(place: Region) -> &'static Header {
    // SAFETY: it is in flash, aligned; any bits are a valid `Header`.
    unsafe { &*(place.base as *const Header) }
}

/// Checks the image in a place: its vectors.
///
/// # Errors
/// The damaged part.
///
/// # Safety
/// As for [`header`].
pub unsafe fn check(flash: &ResidentFlash, place: Region) -> Result<VectorTable, Damage> {
    // SAFETY: the caller guarantees it.
    let header = unsafe { header(place) };
    check_contents(flash, place, header, LAYOUT, HOST)?;
    // An image for the bench has no CRC. A device with keys takes none.
    if SEALED && header.crc == 0 && !flash.is_blank(LAYOUT.key_block()) {
        return Err(Damage::Crc);
    }
    let vectors = (place.base + Header::SIZE) as *const [u32; 2];
    // SAFETY: `check_contents` has found that the image, which is longer than two words, ends
    // within its flash.
    header.entry(unsafe { vectors.read_volatile() })
}

/// Copies the image in a place to its RAM.
///
/// # Safety
/// [`check`] has found it good. Nothing may use the RAM of the bootloader except its last
/// [`LEAST_STACK`] bytes.
pub unsafe fn copy(place: Region) {
    // SAFETY: `check` has found that the image ends within its flash and within its RAM, leaves the
    // stack its room, and has a multiple of four bytes; both addresses are aligned. The caller
    // guarantees that nothing else uses the RAM.
    unsafe {
        let header = header(place);
        let (from, to) = ((place.base + Header::SIZE) as *const u32, header.ram_base as *mut u32);
        for n in 0..header.size as usize / 4 {
            // Volatile: a call of memcpy would copy by bytes.
            to.add(n).write(from.add(n).read_volatile());
        }
    }
}

/// Removes the secrets that the RAM image may have left, wherever a reset has ended it: clears all
/// of its RAM but the last [`LEAST_STACK`] bytes, which Reset has cleared. The RAM of a program
/// that has run since stays as it is: the handoff, which the report of a RAM image replaces, says
/// which of them it was. 0.3 ms.
///
/// # Safety
/// Nothing may use the RAM of the bootloader except its last [`LEAST_STACK`] bytes.
pub unsafe fn wipe() {
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image.
    if unsafe { Handoff::read_program(LAYOUT.handoff.base as *const Handoff) } != 0 {
        return;
    }
    const RAM: Region = LAYOUT.bootloader_ram();
    const { assert!(RAM.size > LEAST_STACK && RAM.size.is_multiple_of(64)) };
    // SAFETY: it is in the RAM; the caller guarantees that nothing uses it.
    unsafe { clear(RAM.base, RAM.end() - LEAST_STACK) };
}

/// Clears memory, 64 bytes at a time, without a stack: Reset calls it, too.
///
/// # Safety
/// Both are addresses of words in RAM, `end` is a multiple of 64 bytes after `at`, and nothing uses the memory.
#[unsafe(naked)]
pub unsafe extern "C" fn clear(at: u32, end: u32) {
    core::arch::naked_asm!(
        "movs r2, #0",
        "movs r3, #64",
        "0: subs r3, #4",
        "str r2, [r0, r3]",
        "bne 0b",
        "vldmia r0, {{s0-s15}}",
        "1: vstmia r0!, {{s0-s15}}",
        "cmp r0, r1",
        "bne 1b",
        "bx lr",
    )
}
