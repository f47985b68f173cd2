//! The flash lock: it locks flash and option bytes until the next reset, so that a sealed program
//! cannot change after its verification at installation.
//!
//! A wrong key locks them (RM0090 sections 3.6.1 and 3.7.2): the chip locks FLASH_CR and
//! FLASH_OPTCR, and answers with a bus error. This bus error must have no effect:
//!
//! - without the write buffer (`DISDEFWBUF`) the fault is precise; under FAULTMASK with `BFHFNMIGN`
//!   the core continues after the store (PM0214 sections 4.4.1 and 4.4.7);
//! - a fault that comes late all the same is a BusFault, because BusFault is enabled. It is only
//!   pending, and `lock_flash` clears it at its end. (A HardFault, which it would be otherwise,
//!   cannot be cleared.)

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

/// Locks flash and option bytes. Leaves the registers of the core in their reset state.
///
/// # Safety
/// Nothing writes the flash until the next reset. The core is privileged and in thread mode, and no
/// exception is active or enabled.
pub unsafe fn lock_flash() {
    // SAFETY: the addresses are those of ARMv7-M (B3.2) and RM0090 (section 3.9). The code writes
    // to no other address, and the caller guarantees that these registers have their reset values.
    unsafe {
        core::arch::asm!(
            "cpsid f",
            "str {unbuffered}, [{core}, #0x008]",
            "str {ccr_ignore}, [{core}, #0xD14]",
            "str {enabled}, [{core}, #0xD24]",
            "dsb",
            "isb",
            // 0 is a wrong key in every state of the key sequence.
            "str {zero}, [{flash}, #4]",
            "str {zero}, [{flash}, #8]",
            "dsb",
            // The BusFault is disabled and no longer pending; ones clear the fault status.
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
