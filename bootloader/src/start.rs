//! What surrounds the RAM image in flash: the bytes of the resident part, and the image's header.

use core::arch::global_asm;

use bsp::{IDENTITY, LAYOUT};
use shared_abi::boot_report::{BootReport, Words};
use shared_abi::ram_image::{self, Header};

include!(concat!(env!("OUT_DIR"), "/board_identity.rs"));

const BYTES: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/resident.bin"));

#[repr(C, align(4))]
struct Resident([u8; BYTES.len()]);

/// The resident part (`resident/main.rs`) at its place in flash; the linker script places it at the
/// address for which it was linked.
#[used]
#[no_mangle]
#[link_section = ".resident"]
static RESIDENT: Resident = Resident(*include_bytes!(concat!(env!("OUT_DIR"), "/resident.bin")));

// The header of the RAM image. The build writes the second word, the CRC, after the link. It is in
// assembly, because the linker knows the image's size.
global_asm!(
    ".section .ram_image, \"a\"",
    ".word {magic}, 0, {length}, __ram_image_size",
    ".word {ram_base}, {ram_end}, {services}, {features}",
    ".word {board}, {vendor}, {product}, 0",
    ".word {version}, 0, 0, 0",
    magic = const ram_image::MAGIC,
    length = const Header::SIZE,
    ram_base = const LAYOUT.ram.base,
    ram_end = const LAYOUT.ram.end(),
    services = const ram_image::SERVICES_VERSION,
    features = const ram_image::FEATURES,
    board = const BOARD_IDENTITY,
    vendor = const IDENTITY.vendor_id,
    product = const IDENTITY.product_code,
    version = const crate::product::VERSION,
);

/// The report of the resident part. Without one a debugger has started the image; it then stays, as
/// after a fault.
pub fn boot_report() -> Option<BootReport> {
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image;
    // nothing writes it while the image runs.
    let words = unsafe { (LAYOUT.handoff.base as *const Words).read_volatile() };
    BootReport::parse(&words)
}
