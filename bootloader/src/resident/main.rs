//! The resident part of the bootloader: the code that runs from flash. An application that calls it
//! owns all RAM.
//!
//! | file | what it does | unsafe |
//! |---|---|---|
//! | `main.rs` | vectors and Reset, and the tables at the layout's fixed address | start-up |
//! | `stage.rs` | from the reset to the jump, or to the rest of the bootloader | jump, handoff |
//! | `callgate.rs` | services for the application | its ABI |
//! | `service_table.rs` | services for the RAM image: all access to non-volatile data | their ABI |
//! | `flash.rs` | the flash with sectors and CRC unit | registers |
//! | `flash_lock.rs` | locks the flash for a sealed program (feature `sealed`) | assembly |
//! | `storing.rs` | stores a value while nothing else runs | no |
//! | `ram_image.rs` | checks the rest of the bootloader and copies it to RAM | memory |
//! | `caches.rs` | the caches of the flash, off or on for a while | registers |
//!
//! It is a complete program, without variables: it uses only the stack and its own code. It is
//! written once, in production, and stays for ever; of the RAM image it knows the address of its
//! header alone. `build.rs` builds it, and the bootloader's image contains its bytes.
#![no_std]
#![no_main]

mod caches;
mod callgate;
mod flash;
#[path = "../flash_controller.rs"]
mod flash_controller;
mod flash_lock;
#[path = "../memory.rs"]
mod memory;
mod ram_image;
mod service_table;
mod stage;
mod storing;

use core::arch::global_asm;

use shared_abi::callgate::{Entry, Table, ABI_VERSION, MAGIC, TABLE_SIZE};
use shared_abi::geometry::CORE_VECTORS;
use shared_abi::layout::{KNOWS_SEALED_IMAGES, LEAST_STACK, MARK_OFFSET};
use shared_abi::services::{self, Services};
use shared_abi::warm_start::BootRequest;

// The vectors of the core. Before the RAM image or a program runs, the only possible exceptions are
// faults; both bring vectors of their own.
global_asm!(
    ".section .core_vectors, \"a\"",
    ".word _stack_start",
    ".word resident_reset",
    ".rept {faults}",
    ".word {fault}",
    ".endr",
    ".if {is_sealed}",
    ".word {mark}",
    ".else",
    ".word {fault}",
    ".endif",
    ".rept {others}",
    ".word {fault}",
    ".endr",
    faults = const MARK_OFFSET / 4 - 2,
    is_sealed = const product::SEALED as u32,
    mark = const KNOWS_SEALED_IMAGES,
    others = const CORE_VECTORS - MARK_OFFSET / 4 - 1,
    fault = sym fault,
);

// Reset makes the core as after a power-on (docs/architecture.md, "What a reset leaves"): a reset leaves the
// debug units, and an application that jumps here everything else. The vectors, the FPU, whose registers
// the compiler may use to move data, and the stack are those of the resident part.
//
// The patch unit (FPB) comes first, with immediate values alone: it may replace every instruction and every
// constant in flash. In an open device the breakpoints of a debug probe stay; only a probe can set C_DEBUGEN.
global_asm!(
    ".section .text.resident_reset, \"ax\"",
    ".global resident_reset",
    ".type resident_reset,%function",
    ".thumb_func",
    "resident_reset:",
    "cpsid i",
    "mov r0, #0xE000E000", // the system control space, SCS (ARMv7-M B3.2)
    "movs r1, #0",
    ".if !{is_sealed}",
    "ldr r2, [r0, #0xDF0]", // DHCSR (C1.6.2), C_DEBUGEN
    "lsls r2, r2, #31",
    "bne 1f",
    ".endif",
    "sub r2, r0, #0xC000", // FPB (C1.11)
    "movs r3, #2",
    "str r3, [r2], #8", // FP_CTRL: KEY without ENABLE
    "dsb",
    "isb", // from here on each instruction is the one in flash
    "movs r3, #32",
    "0: subs r3, #4",
    "str r1, [r2, r3]", // FP_COMP7 to 0
    "bne 0b",
    "mov r3, #0x01000000",
    "str r3, [r0, #0xDFC]", // DEMCR (C1.6.5), TRCENA: without it the DWT may ignore what is written
    "sub r2, r0, #0xD000", // DWT (C1.8)
    "str r1, [r2]",
    "str r1, [r2, #0x28]", // DWT_FUNCTION0 to 3
    "str r1, [r2, #0x38]",
    "str r1, [r2, #0x48]",
    "str r1, [r2, #0x58]",
    "str r1, [r0, #0xDFC]", // DWT and ITM off, no vector catch
    "1:",
    "str r1, [r0, #0xD94]", // MPU_CTRL
    "str r1, [r0, #0xD10]", // SCR
    "str r1, [r0, #0xD24]", // SHCSR
    "str r1, [r0, #0x10]", // SYST_CSR
    "mov r2, #0x200",
    "str r2, [r0, #0xD14]", // CCR: STKALIGN
    "mov r2, #0x0A000000",
    "str r2, [r0, #0xD04]", // ICSR: PendSV and SysTick no longer pending
    "mvns r2, r1",
    "add r4, r0, #0x180", // NVIC_ICER0 to 3, NVIC_ICPR0 to 3
    "add r5, r0, #0x280",
    "movs r3, #16",
    "0: subs r3, #4",
    "str r2, [r4, r3]",
    "str r2, [r5, r3]",
    "bne 0b",
    "ldr r2, ={vectors}",
    "str r2, [r0, #0xD08]", // VTOR
    "mov r2, #0xF00000",
    "str r2, [r0, #0xD88]", // CPACR
    "msr BASEPRI, r1",
    "msr CONTROL, r1",
    "ldr r1, =_stack_start",
    "msr MSP, r1",
    "dsb",
    "isb",
    ".if {is_sealed}",
    // The memory of the boot stage's stack, and the registers of the FPU, which no reset clears, may have a
    // secret of the RAM image.
    "sub r0, r1, #{least_stack}",
    "bl {clear}",
    "sub r0, #128",
    "vldmia r0, {{s0-s31}}",
    ".endif",
    "cpsie f",
    "cpsie i",
    "b {stage}",
    ".ltorg",
    is_sealed = const product::SEALED as u32,
    vectors = const bsp::LAYOUT.bootloader.base,
    least_stack = const LEAST_STACK,
    clear = sym ram_image::clear,
    stage = sym stage::stage,
);

/// The contents at the callgate's address: the callgate's table, then the services for the RAM
/// image.
#[repr(C)]
struct Header {
    callgate: Table<Entry>,
    services: Services,
}
const _: () = assert!(core::mem::offset_of!(Header, services) == services::OFFSET as usize);

#[no_mangle]
#[link_section = ".header"]
static HEADER: Header = Header {
    callgate: Table {
        magic: MAGIC,
        abi_version: ABI_VERSION,
        length: TABLE_SIZE as u16,
        bootloader_version: product::VERSION,
        entry: callgate::entry,
    },
    services: service_table::SERVICES,
};
const _: () = assert!(size_of::<Table<Entry>>() == TABLE_SIZE as usize);

/// A fault before the RAM image runs. The bootloader reports it after the reset.
extern "C" fn fault() -> ! {
    product::warm_start_cell().put(BootRequest::Fault);
    cortex_m::peripheral::SCB::sys_reset()
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    fault()
}
