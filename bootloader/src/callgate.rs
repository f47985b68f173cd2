//! The callgate: what an application may call (`shared_abi::callgate`).
//!
//! Everything here runs from flash while the application owns all RAM: no static, no constant in memory, no call to
//! anything outside this file, nothing but registers and the caller's stack. The sections keep the code in
//! flash; a test with garbage in the bootloader's RAM proves the rest.

use core::ffi::c_void;

use bsp::LAYOUT;
use shared_abi::callgate::{Crc32Args, Entry, Selector, Status, Table, ABI_VERSION, MAGIC, TABLE_SIZE};

use crate::VERSION;

/// The table at its fixed address.
#[no_mangle]
#[link_section = ".callgate.table"]
static CALLGATE: Table<Entry> = Table {
    magic: MAGIC,
    abi_version: ABI_VERSION,
    length: TABLE_SIZE as u16,
    bootloader_version: VERSION,
    entry,
};
const _: () = assert!(size_of::<Table<Entry>>() == TABLE_SIZE as usize);

/// # Safety
/// `args` must point to the argument structure of `selector`; what can be told of a wrong pointer is refused.
#[link_section = ".callgate.text"]
unsafe extern "C" fn entry(selector: u32, args: *mut c_void) -> i32 {
    if selector != Selector::Crc32 as u32 {
        return Status::UnknownSelector as i32;
    }
    let args = args.cast::<Crc32Args>();
    let (address, size) = (args as u32, size_of::<Crc32Args>() as u32);
    let reachable = within(address, size, LAYOUT.chip.sram.base, LAYOUT.chip.sram.size)
        || within(address, size, LAYOUT.chip.ccm.base, LAYOUT.chip.ccm.size);
    if !reachable || address % 4 != 0 {
        return Status::BadPointer as i32;
    }
    // SAFETY: aligned and inside RAM, as just checked; the caller vouches that it is its structure.
    unsafe {
        let (start, len) = ((*args).address, (*args).len);
        if len == 0 || !within(start, len, LAYOUT.chip.flash.base, LAYOUT.chip.flash.size) {
            return Status::BadRange as i32;
        }
        (*args).crc = crc32(start, len);
    }
    Status::Ok as i32
}

/// `Region::contains` again: that one may be compiled into RAM.
#[inline(always)]
fn within(address: u32, len: u32, base: u32, size: u32) -> bool {
    address >= base && len <= size && address - base <= size - len
}

/// CRC-32/ISO-HDLC bit by bit: a table would have to lie somewhere.
///
/// # Safety
/// The range must be inside the flash.
#[inline(always)]
unsafe fn crc32(start: u32, len: u32) -> u32 {
    let mut crc = u32::MAX;
    let mut next = start as *const u8;
    for _ in 0..len {
        // SAFETY: the caller vouches for the range.
        crc ^= u32::from(unsafe { next.read_volatile() });
        next = next.wrapping_add(1);
        for _ in 0..8 {
            crc = crc >> 1 ^ (0xEDB8_8320 & (crc & 1).wrapping_neg());
        }
    }
    !crc
}
