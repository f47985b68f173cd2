//! What code costs in cycles if [`Options::costs`](crate::options::Options::costs) asks for it. Without,
//! each instruction takes one.
//!
//! - Instructions: Cortex-M4 TRM (ARM DDI 0439, table 3-1): a load takes two cycles, several registers
//!   one more than there are, a division up to 12, a branch that is taken 1 to 3 for the refill of the
//!   pipeline (here 2); a store one, since the write buffer takes it.
//! - Code in SRAM comes over the System bus, whose fetches of a word take one more cycle (DDI 0439,
//!   section 2.3.1).
//! - Code in flash comes in lines of 128 bits. One that is not in the instruction cache of 64 lines takes
//!   the wait states; with the cache off each line does, less what the prefetch reads ahead (RM0090
//!   section 3.5).
//! - The CRC unit takes four cycles for a word (RM0090 section 4.3), one more than the load and the store.

use crate::memory::PAGE;

/// Bytes of a line of flash.
const LINE: u32 = 16;
/// Lines of the instruction cache. Here, each address has one place; in the chip any line has any.
const LINES: usize = 64;
/// A taken branch, beyond the cycle of the instruction.
pub const REFILL: u64 = 2;
/// A word for the CRC unit, beyond load and store.
pub const CRC_WORD: u64 = 1;
const DIVISION: u64 = 12;

/// FLASH_ACR.
const ACR_PRFTEN: u32 = 1 << 8;
const ACR_ICEN: u32 = 1 << 9;
const ACR_ICRST: u32 = 1 << 11;

/// Cycles of an instruction without wait states; `second` is 0 for one of 16 bits.
#[must_use]
pub fn of_instruction(first: u16, second: u16) -> u64 {
    let ones = |word: u16| u64::from(word.count_ones());
    if first >> 11 < 0b11101 {
        return match first >> 11 {
            // LDR by PC, by immediate, by SP.
            0b01001 | 0b01101 | 0b01111 | 0b10001 | 0b10011 => 2,
            // With a register as the offset: STR, STRH, STRB, or a load.
            0b01010 | 0b01011 => 1 + u64::from(first >> 9 & 7 >= 3),
            // STM, LDM.
            0b11000 | 0b11001 => 1 + ones(first & 0xFF),
            // PUSH, POP.
            0b10110 | 0b10111 if first & 0x0600 == 0x0400 => 1 + ones(first & 0x1FF),
            _ => 1,
        };
    }
    let is_load = first & 0x10 != 0;
    match first {
        _ if first & 0xFFD0 == 0xFB90 && second & 0xF0F0 == 0xF0F0 => DIVISION,
        _ if first & 0xFE00 == 0xF800 => 1 + u64::from(is_load),
        // LDRD, STRD and their like; LDM, STM.
        _ if first & 0xFE40 == 0xE840 => 3,
        _ if first & 0xFE40 == 0xE800 => 1 + ones(second),
        // VLDR, VSTR.
        _ if first & 0xFE00 == 0xEC00 => 2,
        _ => 1,
    }
}

/// Cycles that a fetch from SRAM adds.
#[must_use]
pub fn of_fetch_from_sram(bytes: u32) -> u64 {
    u64::from(bytes.div_ceil(4))
}

/// The instruction cache of the flash.
pub struct InstructionCache {
    lines: [u32; LINES],
}

impl Default for InstructionCache {
    fn default() -> Self {
        Self { lines: [u32::MAX; LINES] }
    }
}

impl InstructionCache {
    /// Cycles that the fetch of a block adds, with this FLASH_ACR and this many instructions.
    pub fn fetch(&mut self, address: u32, bytes: u32, instructions: u64, acr: u32) -> u64 {
        let wait_states = u64::from(acr & 7);
        if acr & ACR_ICRST != 0 || acr & ACR_ICEN == 0 {
            *self = Self::default();
        }
        let (first, last) = (address / LINE, (address + bytes.max(1) - 1) / LINE);
        let misses = (first..=last).filter(|&line| {
            let place = &mut self.lines[line as usize % LINES];
            std::mem::replace(place, line) != line
        });
        let misses = misses.count() as u64;
        if acr & ACR_PRFTEN == 0 || misses == 0 {
            return misses * wait_states;
        }
        // The line after the first is read while the first is executed.
        let each = instructions / u64::from(last - first + 1);
        wait_states + (misses - 1) * wait_states.saturating_sub(each)
    }
}

/// A page of flash or RAM has whole lines.
const _: () = assert!(PAGE.is_multiple_of(LINE));

#[cfg(test)]
mod tests {
    use super::*;

    /// Machine code from GNU as; cycles from DDI 0439, table 3-1.
    #[test]
    fn instructions_take_what_the_manual_of_the_core_says() {
        for (first, second, cycles) in [
            (0x2001, 0, 1),       // movs r0, #1
            (0x6848, 0, 2),       // ldr r0, [r1, #4]
            (0x6048, 0, 1),       // str r0, [r1, #4]
            (0x4801, 0, 2),       // ldr r0, [pc, #4]
            (0x5888, 0, 2),       // ldr r0, [r1, r2]
            (0x5088, 0, 1),       // str r0, [r1, r2]
            (0xC919, 0, 4),       // ldmia r1, {r0, r3, r4}
            (0xB5F0, 0, 6),       // push {r4-r7, lr}
            (0xBDF0, 0, 6),       // pop {r4-r7, pc}
            (0xF8D1, 0x0234, 2),  // ldr.w r0, [r1, #564]
            (0xE9D1, 0x0302, 3),  // ldrd r0, r3, [r1, #8]
            (0xFBB0, 0xF2F1, 12), // udiv r2, r0, r1
            (0xFB00, 0xF201, 1),  // mul r2, r0, r1
        ] {
            assert_eq!(of_instruction(first, second), cycles, "{first:04X} {second:04X}");
        }
    }

    /// RM0090 section 3.5.2: five wait states for a line that is not cached, none for one that is.
    #[test]
    fn a_line_of_flash_waits_once_with_the_cache_and_each_time_without() {
        const WAIT_STATES: u32 = 5;
        let mut cache = InstructionCache::default();
        let cached = WAIT_STATES | ACR_ICEN;
        assert_eq!(cache.fetch(0x0800_0000, 32, 16, cached), 10);
        assert_eq!(cache.fetch(0x0800_0000, 32, 16, cached), 0);
        assert_eq!(cache.fetch(0x0800_001C, 8, 4, cached), 5, "one of two");
        assert_eq!(cache.fetch(0x0800_0400, 4, 2, cached), 5, "64 lines further");
        assert_eq!(cache.fetch(0x0800_0000, 4, 2, cached), 5, "it has lost its place");
        for _ in 0..2 {
            assert_eq!(cache.fetch(0x0800_0000, 32, 16, WAIT_STATES), 10, "no cache");
            assert_eq!(cache.fetch(0x0800_0000, 32, 16, WAIT_STATES | ACR_PRFTEN), 5, "read ahead");
        }
        assert_eq!(cache.fetch(0x0800_0000, 64, 32, 0), 0, "no wait state");
    }
}
