//! The return from an application to its bootloader, by one of three ways.
//!
//! | way | cost | use |
//! |---|---|---|
//! | [`system_reset`] | none: the chip is as after any reset | the usual way |
//! | [`watchdog_reset`] | 13 periods of the LSI: 0.3 to 0.8 ms | code that may not write the system control block |
//! | [`jump`] | the list below | a device on which a reset would switch off something that must
//! stay on |
//!
//! Each way writes a request into the warm-start cell. The answer to the command that caused it
//! must be on the bus before: wait until the transmit mailboxes are empty, then 10 ms (SYS TEC
//! manual L-1112d_10, 4.5), and send nothing else meanwhile.

use crate::layout::Layout;
use crate::registers::{self, Registers};
use crate::warm_start::{BootRequest, Cell};

/// Writes the request to the place where the bootloader reads it.
fn put_request(layout: &Layout, request: BootRequest) {
    // SAFETY: this is the layout's warm-start region, checked to be RAM of the right size, which
    // the linker scripts keep out of every image.
    unsafe { Cell::at(layout.warm_start.base as *mut _) }.put(request);
}

/// The registers of the chip.
struct Hardware;

impl Registers for Hardware {
    fn read(&mut self, register: u32) -> u32 {
        // SAFETY: `registers` and this file pass only registers of the core or of an STM32F4 that
        // can be read without side effects, and words of flash.
        unsafe { (register as *const u32).read_volatile() }
    }

    fn write(&mut self, register: u32, value: u32) {
        // SAFETY: `registers` passes only registers of the core or of an STM32F4. Interrupts are
        // disabled, and the code that set up the registers does not run again.
        unsafe { (register as *mut u32).write_volatile(value) }
    }
}

fn interrupts_off() {
    // SAFETY: disabled interrupts do no harm here; the functions of this file do not return.
    unsafe { core::arch::asm!("cpsid i", options(nostack)) };
}

/// Resets the chip.
pub fn system_reset(layout: &Layout, request: BootRequest) -> ! {
    interrupts_off();
    put_request(layout, request);
    registers::request_reset(&mut Hardware);
    loop {
        core::hint::spin_loop();
    }
}

/// Makes the independent watchdog reset the chip within a millisecond, whether it runs already or not: 13
/// periods of the LSI, which has 17 to 47 kHz, and its start (RM0090 section 21.4).
pub fn watchdog_reset(layout: &Layout, request: BootRequest) -> ! {
    interrupts_off();
    put_request(layout, request);
    registers::start_watchdog(&mut Hardware);
    loop {
        core::hint::spin_loop();
    }
}

/// Jumps into the bootloader with the chip in the state after a reset:
///
/// - interrupts are disabled, and none is pending; priorities, fault handlers and vector table are
///   those after a reset;
/// - every peripheral of the buses, including DMA, was reset and has no clock; in sleep mode all have one;
/// - the core runs from HSI, without wait states, caches or prefetch;
/// - FPU and MPU are disabled; the stack is the bootloader's.
///
/// Only a real reset can do the rest: a running independent watchdog continues, and the backup
/// domain is unchanged.
///
/// Call it in thread mode. In a handler, whose exception would stay active, and on a chip whose clocks do
/// not follow, it does a [`system_reset`] instead.
pub fn jump(layout: &Layout, request: BootRequest) -> ! {
    let ipsr: u32;
    // SAFETY: reads a register.
    unsafe { core::arch::asm!("mrs {}, IPSR", out(reg) ipsr, options(nomem, nostack)) };
    if registers::in_handler(ipsr) {
        system_reset(layout, request);
    }
    interrupts_off();
    if !registers::release_peripherals(&mut Hardware) {
        system_reset(layout, request);
    }
    registers::release_core(&mut Hardware);
    put_request(layout, request);
    let table = layout.bootloader.base;
    // SAFETY: the layout's bootloader begins with its vector table: initial stack pointer and
    // Reset. Interrupts are disabled, and this code does not continue. All operands are in
    // registers when the stack changes.
    unsafe {
        core::arch::asm!(
            "msr BASEPRI, {zero}",
            "msr FAULTMASK, {zero}",
            "msr CONTROL, {zero}",
            "isb",
            "msr MSP, {sp}",
            "dsb",
            "isb",
            "cpsie i",
            "bx {reset}",
            sp = in(reg) Hardware.read(table),
            reset = in(reg) Hardware.read(table + 4),
            zero = in(reg) 0,
            options(noreturn),
        )
    }
}
