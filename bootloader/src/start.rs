//! The start-up in flash: it calls the boot stage in the resident part. If the boot stage returns,
//! vectors, code and constants are in RAM, and `init` follows.

use core::arch::global_asm;
use core::cell::UnsafeCell;
use core::mem::MaybeUninit;

use shared_abi::callgate;
use shared_abi::geometry::CORE_VECTORS;
use shared_abi::layout::{KNOWS_SEALED_IMAGES, MARK_OFFSET};
use shared_abi::ram_image::{self, Method};

use crate::boot_report::BootReport;

const BYTES: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/resident.bin"));

#[repr(C, align(4))]
struct Resident([u8; BYTES.len()]);

/// The resident part (`resident/main.rs`) at its place in flash; the linker script places it at the
/// address for which it was linked.
#[used]
#[no_mangle]
#[link_section = ".callgate.resident"]
static RESIDENT: Resident = Resident(*include_bytes!(concat!(env!("OUT_DIR"), "/resident.bin")));

/// Offset of the boot stage in the resident part's header, behind the callgate's table
/// (`resident/main.rs`).
const STAGE: u32 = callgate::TABLE_SIZE;
/// Offset of the fault handler, see [`STAGE`].
const FAULT: u32 = STAGE + 4;

// The vectors of the core in flash. Before the RAM image runs, the only possible exceptions are
// faults. After that the core uses the table in RAM.
global_asm!(
    ".section .core_vectors, \"a\"",
    ".word _stack_start",
    ".word Reset",
    ".rept {faults}",
    ".word boot_fault",
    ".endr",
    ".if {is_sealed}",
    ".word {mark}",
    ".else",
    ".word boot_fault",
    ".endif",
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
    faults = const MARK_OFFSET / 4 - 2,
    is_sealed = const cfg!(feature = "sealed") as u32,
    mark = const KNOWS_SEALED_IMAGES,
    others = const CORE_VECTORS - MARK_OFFSET / 4 - 1,
    resident = sym RESIDENT,
    fault = const FAULT,
);

// The header of the RAM image as the linker writes it: not packed, without a CRC.
global_asm!(
    ".section .ram_image, \"a\"",
    ".word {magic}, 0, {services}, {raw}, __ram_image_size, __ram_image_size",
    magic = const ram_image::MAGIC,
    services = const ram_image::SERVICES_VERSION,
    raw = const Method::Raw as u32,
);

// Reset calls `__pre_init` first, from flash. It enables the FPU (the compiler may use its
// registers to move data) and calls the boot stage. The boot stage returns when the RAM image is in
// its place; then the core takes its vectors from there.
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
    "ldr r2, ={resident}",
    "ldr r2, [r2, {stage}]",
    "ldr r1, ={report}",
    "ldr r0, =__ram_image",
    "blx r2",
    "ldr r0, =0xE000ED08", // VTOR (ARMv7-M B3.2.5)
    "ldr r1, =__vector_table",
    "str r1, [r0]",
    "dsb",
    "isb",
    "pop {{r4, pc}}",
    ".ltorg",
    resident = sym RESIDENT,
    stage = const STAGE,
    report = sym BOOT_REPORT,
);

/// The report for `init`. It lies in memory that the start-up does not clear; the boot stage writes
/// it before `init`.
#[link_section = ".uninit.boot_report"]
static BOOT_REPORT: Report = Report(UnsafeCell::new(MaybeUninit::uninit()));

#[repr(transparent)]
struct Report(UnsafeCell<MaybeUninit<BootReport>>);

// SAFETY: nothing writes it while Rust code of the RAM part runs.
unsafe impl Sync for Report {}

/// The boot stage's report.
pub fn boot_report() -> BootReport {
    // SAFETY: `__pre_init` has passed its address to the boot stage, which has written it.
    unsafe { (*BOOT_REPORT.0.get()).assume_init() }
}
