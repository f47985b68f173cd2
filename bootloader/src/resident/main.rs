//! The resident part of the bootloader: what runs from flash, beside an application that owns all
//! RAM.
//!
//! | file | what it does | unsafe |
//! |---|---|---|
//! | `main.rs` | the header at the layout's fixed address | no |
//! | `stage.rs` | from the reset to the jump, or to the rest of the bootloader | jump, handoff |
//! | `callgate.rs` | services for the application | its ABI |
//! | `service_table.rs` | services for the RAM part: the one owner of what is non-volatile | their ABI |
//! | `flash.rs` | the flash with sectors and CRC unit | registers |
//! | `flash_lock.rs` | shuts the flash in front of a sealed program (feature `sealed`) | assembly |
//! | `storing.rs` | a value stored while nothing else runs | no |
//! | `ram_image.rs` | the rest of the bootloader, checked and unpacked to RAM | memory |
//! | `unpack.rs` | the unpacker of ZX0 | assembly |
//! | `caches.rs` | the caches of the flash, off or on for a while | registers |
//!
//! It is a program of its own, so that the linker can see that it has no variables: nothing but the
//! stack and its own code is there when it runs. `build.rs` builds it, and the bootloader
//! carries it as bytes.
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

/// What lies at the callgate's address: its table, and behind it the ways in for the bootloader's
/// own start-up (`start.rs`).
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

/// A fault before the RAM image runs. There is nobody to tell but the bootloader after the reset.
extern "C" fn fault() -> ! {
    product::warm_start_cell().put(BootRequest::Fault);
    cortex_m::peripheral::SCB::sys_reset()
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    fault()
}
