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
//! | `renewal.rs` | chooses the image: home, or staging | handoff |
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
mod renewal;
mod service_table;
mod stage;
mod storing;

use core::arch::global_asm;

use shared_abi::callgate::{Entry, Table, ABI_VERSION, MAGIC, TABLE_SIZE};
use shared_abi::geometry::CORE_VECTORS;
use shared_abi::layout::{KNOWS_SEALED_IMAGES, MARK_OFFSET};
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

// Reset takes the vectors (an application that jumps here may have left its own) and enables the
// FPU, whose registers the compiler may use to move data.
global_asm!(
    ".section .text.resident_reset, \"ax\"",
    ".global resident_reset",
    ".type resident_reset,%function",
    ".thumb_func",
    "resident_reset:",
    "ldr r0, =0xE000ED08", // VTOR (ARMv7-M B3.2.5)
    "ldr r1, ={vectors}",
    "str r1, [r0]",
    "ldr r1, [r0, #0x80]", // CPACR (ARMv7-M B3.2.20)
    "orr r1, r1, #0xF00000",
    "str r1, [r0, #0x80]",
    "dsb",
    "isb",
    "b {stage}",
    ".ltorg",
    vectors = const bsp::LAYOUT.bootloader.base,
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
