//! What surrounds the RAM image in flash: the bytes of the resident part, and the image's header.

use core::arch::global_asm;

use boot_core::crc::crc32;
use bsp::{IDENTITY, LAYOUT};
use shared_abi::abilities::Abilities;
use shared_abi::boot_report::{BootReport, Words};
use shared_abi::layout::{KNOWS_SEALED_IMAGES, MARK_OFFSET};
use shared_abi::ram_image::{self, Header};
use shared_abi::services::{self, Facts};

use product::{ABILITIES, BOARD_IDENTITY, FACTS, HAS_NAMEPLATE, PRODUCT, SEALED};

/// The bytes of the resident part: of the released one that the product names, or a fresh one.
const BYTES: &[u8] = match PRODUCT.resident {
    Some(released) => released,
    None => include_bytes!(concat!(env!("OUT_DIR"), "/resident.bin")),
};

// A released resident part decides by choices of its own: the image must not contradict them.
const _: () = {
    assert!(
        PRODUCT.resident.is_none() || LAYOUT.home.is_some(),
        "product: `resident` needs the split map: in the compact one the two parts are written together"
    );
    let Some((version, facts)) = Facts::of_resident(BYTES, LAYOUT.bootloader.base, TABLE) else {
        panic!("product: `resident` is no resident part")
    };
    assert!(facts.board == FACTS.board, "product: `resident` is for another board");
    assert!(version >= ram_image::SERVICES_VERSION, "product: `resident` is older than the image needs");
    let is_sealed = matches!(services::word(BYTES, MARK_OFFSET), Some(KNOWS_SEALED_IMAGES));
    assert!(is_sealed == SEALED, "product: `resident` differs in the feature `sealed`");
    assert!(facts.autostart == FACTS.autostart, "product: `resident` has another autostart");
    assert!(facts.crc_bits == FACTS.crc_bits, "product: `resident` has another download.crc");
    assert!(facts.node_ids == FACTS.node_ids, "product: `resident` has other node.ids");
    assert!(facts.bit_rates == FACTS.bit_rates, "product: `resident` has other node.bit_rates");
    assert!(
        facts.sdo_request_base == FACTS.sdo_request_base
            && facts.sdo_response_base == FACTS.sdo_response_base,
        "product: `resident` has another sdo.request_base or sdo.response_base"
    );
    let differs = Abilities(facts.abilities as u32 ^ ABILITIES.0);
    assert!(!differs.has(Abilities::ROM_LOADER), "product: `resident` has another ways_in.rom_loader");
    assert!(!differs.has(Abilities::NAMEPLATE), "product: `resident` has another identity.source");
    assert!(!differs.has(Abilities::RENEWAL), "product: `resident` has another renewal");
};

/// The address of the services of the resident part.
const TABLE: u32 = LAYOUT.callgate() + services::OFFSET;

#[repr(C, align(4))]
struct Resident([u8; BYTES.len()]);

/// The resident part (`resident/main.rs`) at its place in flash; the linker script places it at the
/// address for which it was linked.
#[used]
#[no_mangle]
#[link_section = ".resident"]
static RESIDENT: Resident = {
    let mut bytes = [0; BYTES.len()];
    bytes.copy_from_slice(BYTES);
    Resident(bytes)
};

// Its Reset is the second vector (PM0214 section 2.3.4), and the entry of the ELF file.
global_asm!(
    ".global __resident_reset",
    ".set __resident_reset, {reset}",
    reset = const services::word(BYTES, 4).unwrap(),
);

/// Vendor-ID and product code of the devices that the RAM image is for. With nameplates one image serves the
/// devices of all of them: 0 is any.
const FOR: (u32, u32) = if HAS_NAMEPLATE { (0, 0) } else { (IDENTITY.vendor_id, IDENTITY.product_code) };

// The header of the RAM image. The build writes the second word, the CRC, after the link. It is in
// assembly, because the linker knows the image's size.
global_asm!(
    ".section .ram_image, \"a\"",
    ".word {magic}, 0, {length}, __ram_image_size",
    ".word {ram_base}, {ram_end}, {services}, {features}",
    ".word {board}, {vendor}, {product}, {revisions}",
    ".word {version}, {counter}, {facts}, 0",
    magic = const ram_image::MAGIC,
    length = const Header::SIZE,
    ram_base = const LAYOUT.ram.base,
    ram_end = const LAYOUT.bootloader_ram().end(),
    services = const ram_image::SERVICES_VERSION,
    features = const ABILITIES.0,
    board = const BOARD_IDENTITY,
    vendor = const FOR.0,
    product = const FOR.1,
    revisions = const PRODUCT.renewal_or_default().revisions,
    version = const product::VERSION,
    counter = const PRODUCT.renewal_or_default().counter,
    facts = const crc32(Facts::record(BYTES, LAYOUT.bootloader.base, TABLE).unwrap()),
);

/// The report of the resident part. Without one a debugger has started the image; it then stays, as
/// after a fault.
pub fn boot_report() -> Option<BootReport> {
    let base = LAYOUT.handoff.base as *const u32;
    let mut words: Words = [0; _];
    for (n, word) in words.iter_mut().enumerate() {
        // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image;
        // nothing writes it while the image runs.
        *word = unsafe { base.add(n).read_volatile() };
    }
    BootReport::parse(&words)
}
