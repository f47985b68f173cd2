//! The start-up in flash: the resident part decides; if it comes back, code and constants are
//! copied to RAM and `init` follows.

use core::arch::global_asm;
use core::sync::atomic::{AtomicU32, Ordering};

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

// Reset calls `__pre_init` first of all, from flash. It switches the FPU on (the compiler may use
// its registers to move data) and calls the boot stage, whose address is the word behind the
// callgate's table.
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
    "ldr r0, ={resident}",
    "ldr r0, [r0, {stage}]",
    "blx r0",
    "ldr r1, ={reason}",
    "str r0, [r1]",
    "pop {{r4, pc}}",
    ".ltorg",
    resident = sym RESIDENT,
    stage = const shared_abi::callgate::TABLE_SIZE,
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
