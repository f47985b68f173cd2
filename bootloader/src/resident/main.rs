//! The resident part of the bootloader: the code that runs from flash. An application that calls it
//! owns all RAM.
//!
//! | file | what it does | unsafe |
//! |---|---|---|
//! | `main.rs` | the header at the layout's fixed address | no |
//! | `stage.rs` | from the reset to the jump, or to the rest of the bootloader | jump, handoff |
//! | `callgate.rs` | services for the application | its ABI |
//! | `service_table.rs` | services for the RAM part: all access to non-volatile data | their ABI |
//! | `flash.rs` | the flash with sectors and CRC unit | registers |
//! | `flash_lock.rs` | locks the flash for a sealed program (feature `sealed`) | assembly |
//! | `storing.rs` | stores a value while nothing else runs | no |
//! | `ram_image.rs` | checks the rest of the bootloader and unpacks it to RAM | memory |
//! | `unpack.rs` | the unpacker of ZX0 | assembly |
//! | `caches.rs` | the caches of the flash, off or on for a while | registers |
//!
//! It is a separate program, so that the linker can check that it has no variables: it uses only
//! the stack and its own code. `build.rs` builds it, and the bootloader contains its bytes.
#![no_std]
#![no_main]

#[path = "../boot_report.rs"]
mod boot_report;
mod caches;
mod callgate;
mod flash;
#[path = "../flash_controller.rs"]
mod flash_controller;
#[cfg(feature = "sealed")]
mod flash_lock;
#[path = "../memory.rs"]
mod memory;
#[path = "../product.rs"]
mod product;
mod ram_image;
mod service_table;
#[path = "../services.rs"]
mod services;
mod stage;
mod storing;
mod unpack;

use shared_abi::callgate::{Entry, Table, ABI_VERSION, MAGIC, TABLE_SIZE};
use shared_abi::warm_start::BootRequest;

/// The contents at the callgate's address: the callgate's table, then the entries for the
/// bootloader's own start-up (`start.rs`).
#[repr(C)]
struct Header {
    callgate: Table<Entry>,
    stage: unsafe extern "C" fn(*const shared_abi::ram_image::Header, *mut boot_report::BootReport),
    fault: extern "C" fn() -> !,
    services: services::Services,
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
    stage: stage::stage,
    fault,
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
