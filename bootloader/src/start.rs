//! The start-up in flash: the resident part decides; if it comes back, vectors, code and constants
//! are in RAM, and `init` follows.

use core::arch::global_asm;
use core::sync::atomic::{AtomicU32, Ordering};

use shared_abi::callgate;
use shared_abi::geometry::CORE_VECTORS;
use shared_abi::ram_image::{self, Method};

use crate::product::RESCUE_WINDOW_MS;

const BYTES: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/resident.bin"));

#[repr(C, align(4))]
struct Resident([u8; BYTES.len()]);

/// The resident part (`resident/main.rs`) at its place in flash; the linker script holds it to the
/// address that it was linked for.
#[used]
#[no_mangle]
#[link_section = ".callgate.resident"]
static RESIDENT: Resident = Resident(*include_bytes!(concat!(env!("OUT_DIR"), "/resident.bin")));

/// Words of the resident part's header behind the callgate's table (`resident/main.rs`): the boot
/// stage, and what is done about a fault.
const STAGE: u32 = callgate::TABLE_SIZE;
/// See [`STAGE`].
const FAULT: u32 = STAGE + 4;

// The vectors of the core in flash. Until the RAM image runs no other exception can come than a
// fault, and then the core has the table in RAM.
global_asm!(
    ".section .core_vectors, \"a\"",
    ".word _stack_start",
    ".word Reset",
    ".rept {others}",
    ".word boot_fault",
    ".endr",
    ".section .boot, \"ax\"",
    ".type boot_fault,%function",
    ".thumb_func",
    "boot_fault:",
    "ldr r0, ={resident}",
    "ldr pc, [r0, {fault}]",
    ".ltorg",
    others = const CORE_VECTORS - 2,
    resident = sym RESIDENT,
    fault = const FAULT,
);

// The header of the RAM image, as it is linked: not packed, without a CRC.
global_asm!(
    ".section .ram_image, \"a\"",
    ".word {magic}, 0, {services}, {raw}, __ram_image_size, __ram_image_size",
    magic = const ram_image::MAGIC,
    services = const ram_image::SERVICES_VERSION,
    raw = const Method::Raw as u32,
);

// Reset calls `__pre_init` first of all, from flash. It switches the FPU on (the compiler may use
// its registers to move data) and calls the boot stage, which comes back when the RAM image is in
// its place; then vectors are taken from there.
global_asm!(
    ".section .boot, \"ax\"",
    ".global __pre_init",
    ".type __pre_init,%function",
    ".thumb_func",
    "__pre_init:",
    "push {{r4, lr}}",
    "ldr r0, =0xE000ED88", // CPACR (ARMv7-M B3.2.20)
    "ldr r1, [r0]",
    "orr r1, r1, #0xF00000",
    "str r1, [r0]",
    "dsb",
    "isb",
    "ldr r1, ={resident}",
    "ldr r1, [r1, {stage}]",
    "ldr r0, =__ram_image",
    "blx r1",
    "ldr r1, ={reason}",
    "str r0, [r1]",
    "ldr r0, =0xE000ED08", // VTOR (ARMv7-M B3.2.5)
    "ldr r1, =__vector_table",
    "str r1, [r0]",
    "dsb",
    "isb",
    "pop {{r4, pc}}",
    ".ltorg",
    resident = sym RESIDENT,
    stage = const STAGE,
    reason = sym STAY_REASON,
);

/// Why the bootloader stayed, for `init`. It lies where the start-up clears nothing.
#[link_section = ".uninit.stay_reason"]
static STAY_REASON: AtomicU32 = AtomicU32::new(0);

/// Why the bootloader stayed ([`StayReason::code`](boot_core::decision::StayReason::code)).
pub fn stay_reason() -> u8 {
    STAY_REASON.load(Ordering::Relaxed) as u8
}

/// The program whose CLEAR was asked of the application.
pub fn program_to_clear() -> Option<u8> {
    let program = (STAY_REASON.load(Ordering::Relaxed) >> 16) as u8;
    (program > 0).then_some(program)
}

/// The program that starts when the rescue window is over.
pub fn program_in_waiting() -> Option<u8> {
    let program = (STAY_REASON.load(Ordering::Relaxed) >> 8) as u8;
    (RESCUE_WINDOW_MS.is_some() && program > 0).then_some(program)
}
