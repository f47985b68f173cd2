//! The return from an application to its bootloader, by one of three ways.
//!
//! | way | cost | use |
//! |---|---|---|
//! | [`system_reset`] | none: the chip is as after any reset | the usual way |
//! | [`watchdog_reset`] | a millisecond | code that may not write the system control block |
//! | [`jump`] | the list below | a device on which a reset would switch off something that must
//! stay on |
//!
//! Each way writes a request into the warm-start cell. The answer to the command that caused it
//! must be on the bus before: wait until the transmit mailboxes are empty, then 10 ms (SYS TEC
//! manual L-1112d_10, 4.5), and send nothing else meanwhile.

use crate::layout::Layout;
use crate::reset;
use crate::warm_start::{BootRequest, Cell};

/// Writes the request to the place where the bootloader reads it.
fn put_request(layout: &Layout, request: BootRequest) {
    // SAFETY: this is the layout's warm-start region, checked to be RAM of the right size, which
    // the linker scripts keep out of every image.
    unsafe { Cell::at(layout.warm_start.base as *mut _) }.put(request);
}

fn read(register: u32) -> u32 {
    // SAFETY: every caller in this file passes a register of the core or of an STM32F4 that can be
    // read without side effects.
    unsafe { (register as *const u32).read_volatile() }
}

fn write(register: u32, value: u32) {
    // SAFETY: every caller in this file passes a register of the core or of an STM32F4. Interrupts
    // are disabled, and the code that set up the registers does not run again.
    unsafe { (register as *mut u32).write_volatile(value) }
}

fn interrupts_off() {
    // SAFETY: disabled interrupts do no harm here; the functions of this file do not return.
    unsafe { core::arch::asm!("cpsid i", options(nostack)) };
}

/// Application interrupt and reset control register (ARMv7-M B3.2.6), and the key for writes to it.
const AIRCR: u32 = 0xE000_ED0C;
const VECTKEY: u32 = 0x05FA_0000;

/// Resets the chip.
pub fn system_reset(layout: &Layout, request: BootRequest) -> ! {
    const SYSRESETREQ: u32 = 1 << 2;
    interrupts_off();
    put_request(layout, request);
    write(AIRCR, read(AIRCR) & 0x700 | VECTKEY | SYSRESETREQ);
    loop {
        core::hint::spin_loop();
    }
}

/// Makes the independent watchdog reset the chip: within a millisecond if it is not running yet,
/// otherwise when it runs out.
pub fn watchdog_reset(layout: &Layout, request: BootRequest) -> ! {
    // RM0090 section 21.4.
    const KR: u32 = 0x4000_3000;
    const PR: u32 = 0x4000_3004;
    const RLR: u32 = 0x4000_3008;
    interrupts_off();
    put_request(layout, request);
    for (register, value) in [(KR, 0xCCCC), (KR, 0x5555), (PR, 0), (RLR, 1)] {
        write(register, value);
    }
    loop {
        core::hint::spin_loop();
    }
}

/// Jumps into the bootloader with the chip in the state after a reset:
///
/// - interrupts are disabled, and none is pending; priorities, fault handlers and vector table are
///   those after a reset;
/// - every peripheral of the buses, including DMA, was reset and has no clock;
/// - the core runs from HSI, without wait states, caches or prefetch;
/// - FPU and MPU are disabled; the stack is the bootloader's.
///
/// Only a real reset can do the rest: a running independent watchdog continues, and the backup
/// domain is unchanged.
///
/// Call it in thread mode. In a handler, whose exception would stay active, it does a
/// [`system_reset`] instead.
pub fn jump(layout: &Layout, request: BootRequest) -> ! {
    let ipsr: u32;
    // SAFETY: reads a register.
    unsafe { core::arch::asm!("mrs {}, IPSR", out(reg) ipsr, options(nomem, nostack)) };
    if ipsr & 0x1FF != 0 {
        system_reset(layout, request);
    }
    interrupts_off();
    release_peripherals();
    release_core();
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
            sp = in(reg) read(table),
            reset = in(reg) read(table + 4),
            zero = in(reg) 0,
            options(noreturn),
        )
    }
}

/// Clocks, peripherals and flash interface as after a reset (RM0090 sections 3.8.1 and 7.3).
fn release_peripherals() {
    const RCC: u32 = 0x4002_3800;
    const CR: u32 = RCC;
    const PLLCFGR: u32 = RCC + 0x04;
    const CFGR: u32 = RCC + 0x08;
    const CIR: u32 = RCC + 0x0C;
    /// AHB1, AHB2, AHB3, APB1, APB2: offset of the reset register, offset of the clock register
    /// from it, and the clock register's value after a reset.
    const BUSES: [(u32, u32, u32); 5] = [
        (0x10, 0x30, reset::RCC_AHB1ENR),
        (0x14, 0x34, 0),
        (0x18, 0x38, 0),
        (0x20, 0x40, 0),
        (0x24, 0x44, 0),
    ];
    const FLASH_ACR: u32 = 0x4002_3C00;
    const HSION: u32 = 1 << 0;
    const HSIRDY: u32 = 1 << 1;
    const PLLRDY: u32 = 1 << 25;
    const SWS: u32 = 0b11 << 2;

    // The core must run from HSI before its previous clock source is switched off.
    write(CR, read(CR) | HSION);
    while read(CR) & HSIRDY == 0 {}
    write(CFGR, 0);
    while read(CFGR) & SWS != 0 {}
    write(CR, reset::RCC_CR);
    while read(CR) & PLLRDY != 0 {}
    write(PLLCFGR, reset::RCC_PLLCFGR);
    write(CIR, 0);
    for (resets, clocks, after) in BUSES {
        write(RCC + resets, u32::MAX);
        write(RCC + resets, 0);
        write(RCC + clocks, after);
    }
    // The caches can only be cleared while they are disabled.
    write(FLASH_ACR, 0);
    write(FLASH_ACR, 0b11 << 11);
    write(FLASH_ACR, 0);
}

/// The core's own peripherals as after a reset (ARMv7-M B3).
fn release_core() {
    const SYST_CSR: u32 = 0xE000_E010;
    const NVIC_ICER: u32 = 0xE000_E180;
    const NVIC_ICPR: u32 = 0xE000_E280;
    const NVIC_IPR: u32 = 0xE000_E400;
    const ICSR: u32 = 0xE000_ED04;
    const SCR: u32 = 0xE000_ED10;
    const CCR: u32 = 0xE000_ED14;
    const SHPR: u32 = 0xE000_ED18;
    const SHCSR: u32 = 0xE000_ED24;
    const VTOR: u32 = 0xE000_ED08;
    const CPACR: u32 = 0xE000_ED88;
    const MPU_CTRL: u32 = 0xE000_ED94;
    /// The number of register words with one bit for each interrupt: an F4 has up to 112
    /// interrupts.
    const WORDS: u32 = 4;

    write(SYST_CSR, 0);
    for word in 0..WORDS {
        write(NVIC_ICER + 4 * word, u32::MAX);
        write(NVIC_ICPR + 4 * word, u32::MAX);
    }
    for word in 0..8 * WORDS {
        write(NVIC_IPR + 4 * word, 0);
    }
    // SysTick and PendSV are no longer pending.
    write(ICSR, 1 << 25 | 1 << 27);
    for register in [SHPR, SHPR + 4, SHPR + 8, SHCSR, SCR, MPU_CTRL, CPACR, VTOR] {
        write(register, 0);
    }
    write(CCR, 1 << 9);
    write(AIRCR, VECTKEY);
}
