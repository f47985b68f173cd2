//! The flash lock: shuts flash and option bytes until the next reset, so that a sealed program stays
//! the one that was verified when it was installed.
//!
//! A wrong key does it (RM0090 sections 3.5.1 and 3.6.2): the chip shuts FLASH_CR and FLASH_OPTCR,
//! and answers with a bus error. That has to end nowhere:
//!
//! - without the write buffer (`DISDEFWBUF`) the fault is precise, and under FAULTMASK, with
//!   `BFHFNMIGN`, the core goes on behind the store (PM0214 sections 4.4.1 and 4.4.7);
//! - should a fault come late all the same, it is a BusFault, which is enabled and pending then, and
//!   no longer when this is over. (HardFault, which it would be otherwise, cannot be taken back.)

/// The system control space.
const CORE: u32 = 0xE000_E000;
/// The flash interface: key registers at 4 and 8.
const FLASH: u32 = 0x4002_3C00;

/// ACTLR, `DISDEFWBUF`: no write buffer.
const UNBUFFERED: u32 = 1 << 1;
/// SHCSR, `BUSFAULTENA`.
const BUS_FAULT_ENABLED: u32 = 1 << 17;
/// CCR after a reset: `STKALIGN`.
const CCR: u32 = 1 << 9;
/// CCR, `BFHFNMIGN`.
const IGNORE: u32 = 1 << 8;

/// Shuts flash and option bytes. Leaves the registers of the core as after a reset.
///
/// # Safety
/// Nobody writes the flash until the next reset. The core is privileged, in thread mode, with no
/// exception active or enabled.
pub unsafe fn lock_flash() {
    // SAFETY: the addresses are those of ARMv7-M (B3.2) and RM0090 (section 3.9). Nothing is stored
    // elsewhere, and the caller vouches that nobody has other values in these registers.
    unsafe {
        core::arch::asm!(
            "cpsid f",
            "str {unbuffered}, [{core}, #0x008]",
            "str {ccr_ignore}, [{core}, #0xD14]",
            "str {enabled}, [{core}, #0xD24]",
            "dsb",
            "isb",
            // 0 is a wrong key, whatever came before it.
            "str {zero}, [{flash}, #4]",
            "str {zero}, [{flash}, #8]",
            "dsb",
            // Not enabled and not pending any more; what the status tells is cleared by ones.
            "str {zero}, [{core}, #0xD24]",
            "str {ones}, [{core}, #0xD28]",
            "str {ccr}, [{core}, #0xD14]",
            "str {zero}, [{core}, #0x008]",
            "dsb",
            "isb",
            "cpsie f",
            core = in(reg) CORE,
            flash = in(reg) FLASH,
            unbuffered = in(reg) UNBUFFERED,
            ccr_ignore = in(reg) CCR | IGNORE,
            enabled = in(reg) BUS_FAULT_ENABLED,
            ccr = in(reg) CCR,
            zero = in(reg) 0,
            ones = in(reg) u32::MAX,
            options(nostack, preserves_flags),
        );
    }
}
