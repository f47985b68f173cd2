//! Vector tables: the judge of their first two words, the proof that a table was checked, and the
//! jump to it. Device and host tool judge by the same rules.

use crate::geometry::{Region, CORE_VECTORS_SIZE, SYSTEM_MEMORY};
use crate::layout::Layout;

/// Why a vector table is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VectorFault {
    /// The table's address is not aligned as VTOR requires.
    Misaligned,
    /// The initial stack pointer is not in RAM, or not a multiple of 8.
    StackPointer,
    /// The initial stack pointer is after the program's RAM: the stack would run over the handoff
    /// and the warm-start cell, which are there.
    StackOverHandoff,
    /// The reset vector does not point into the program.
    ResetVector,
    /// The reset vector lacks the Thumb bit.
    NotThumb,
}

/// The memory that the first two words of a program's vector table may name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Memory {
    /// The RAM of a program. The rest of `sram` has the handoff and the warm-start cell.
    pub ram: Region,
    /// The whole SRAM of the chip.
    pub sram: Region,
    /// The core-coupled RAM, which may have a stack, too.
    pub ccm: Region,
    /// The size of the vector table in bytes, which is before all code.
    pub table: u32,
}

impl Memory {
    /// The memory of any STM32F4, for a judge that does not know the board: at most 320 KiB of SRAM
    /// (STM32F413, STM32F469), 64 KiB of core-coupled RAM, and no table shorter than that of the STM32F405.
    /// It has no handoff, whose place is that of the board.
    pub const ANY: Self = Self {
        ram: Region::new(0x2000_0000, 320 * 1024),
        sram: Region::new(0x2000_0000, 320 * 1024),
        ccm: Region::new(0x1000_0000, 64 * 1024),
        table: crate::geometry::STM32F405RG.vector_table_size(),
    };

    /// The memory of a board.
    #[must_use]
    pub const fn of(layout: &Layout) -> Self {
        let chip = layout.chip;
        Self { ram: layout.ram, sram: chip.sram, ccm: chip.ccm, table: chip.vector_table_size() }
    }

    /// Judges initial stack pointer and reset vector of a program whose bytes lie at `program`.
    ///
    /// # Errors
    /// The first broken rule.
    pub const fn judge(&self, words: [u32; 2], program: Region) -> Result<(), VectorFault> {
        let [initial_sp, reset] = words;
        if let Err(fault) = self.judge_stack(initial_sp) {
            return Err(fault);
        }
        let table = if self.table < program.size { self.table } else { program.size };
        let code = Region::new(program.base + table, program.size - table);
        if !code.contains(reset & !1, 2) {
            return Err(VectorFault::ResetVector);
        }
        if reset & 1 == 0 {
            return Err(VectorFault::NotThumb);
        }
        Ok(())
    }

    /// Judges an initial stack pointer.
    ///
    /// # Errors
    /// [`VectorFault::StackPointer`] or [`VectorFault::StackOverHandoff`].
    pub const fn judge_stack(&self, initial_sp: u32) -> Result<(), VectorFault> {
        if !initial_sp.is_multiple_of(8) {
            return Err(VectorFault::StackPointer);
        }
        if is_stack_in(&self.ram, initial_sp) || is_stack_in(&self.ccm, initial_sp) {
            return Ok(());
        }
        if is_stack_in(&self.sram, initial_sp) {
            return Err(VectorFault::StackOverHandoff);
        }
        Err(VectorFault::StackPointer)
    }
}

/// Whether a stack that begins at this address lies in a memory. It is a full descending stack: the
/// pointer may point directly after the last byte, and needs room below.
const fn is_stack_in(ram: &Region, initial_sp: u32) -> bool {
    initial_sp > ram.base && initial_sp <= ram.end()
}

/// A vector table that has passed its checks. Only [`VectorTable::check`] makes this value, and
/// only such a table can be jumped to (`VectorTable::jump`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VectorTable {
    address: u32,
    initial_sp: u32,
    reset: u32,
}

impl VectorTable {
    /// Checks the first two words of the table at the start of `program`.
    ///
    /// # Errors
    /// The first broken rule.
    pub fn check(words: [u32; 2], program: Region, layout: &Layout) -> Result<Self, VectorFault> {
        if !program.base.is_multiple_of(layout.chip.vector_table_alignment()) {
            return Err(VectorFault::Misaligned);
        }
        Memory::of(layout).judge(words, program)?;
        let [initial_sp, reset] = words;
        Ok(Self { address: program.base, initial_sp, reset })
    }

    /// Checks the first two words of the bootloader's RAM image: `image` is its place in RAM, and
    /// `ram` the RAM that it uses. A table in RAM has no more vectors than the image needs.
    #[must_use]
    pub(crate) const fn of_ram_image(words: [u32; 2], image: Region, ram: Region) -> Option<Self> {
        let [initial_sp, reset] = words;
        let is_stack = initial_sp.is_multiple_of(8) && is_stack_in(&ram, initial_sp);
        let code = Region::new(image.base + CORE_VECTORS_SIZE, image.size - CORE_VECTORS_SIZE);
        if is_stack && code.contains(reset & !1, 2) && reset & 1 == 1 {
            Some(Self { address: image.base, initial_sp, reset })
        } else {
            None
        }
    }

    /// Checks the first two words of the loader in the ROM of the chip, [`SYSTEM_MEMORY`]: the stack is in the SRAM, and
    /// the first instruction in the ROM. How long its table is, no manual says.
    #[must_use]
    pub const fn of_rom(words: [u32; 2], sram: Region) -> Option<Self> {
        let [initial_sp, reset] = words;
        let is_stack = initial_sp.is_multiple_of(4) && is_stack_in(&sram, initial_sp);
        if is_stack && SYSTEM_MEMORY.contains(reset & !1, 2) && reset & 1 == 1 {
            Some(Self { address: SYSTEM_MEMORY.base, initial_sp, reset })
        } else {
            None
        }
    }

    /// Whether a word may be the first one of a table: a pointer to the end of a stack in RAM.
    #[must_use]
    pub fn is_stack_pointer(word: u32, layout: &Layout) -> bool {
        Memory::of(layout).judge_stack(word).is_ok()
    }

    /// Address of the table, the value for `VTOR`.
    #[must_use]
    pub const fn address(&self) -> u32 {
        self.address
    }

    /// The initial stack pointer.
    #[must_use]
    pub const fn initial_sp(&self) -> u32 {
        self.initial_sp
    }

    /// The address of the first instruction, with the Thumb bit.
    #[must_use]
    pub const fn reset(&self) -> u32 {
        self.reset
    }

    /// Starts the image: disables the FPU and returns to privileged thread mode on the main stack,
    /// as after a reset; then sets `VTOR` and `MSP` and branches.
    ///
    /// # Safety
    /// No interrupt may be enabled or pending, and no bus master may be active: they would act for
    /// an image that no longer runs.
    #[cfg(target_arch = "arm")]
    pub unsafe fn jump(self) -> ! {
        const VTOR: u32 = 0xE000_ED08;
        const CPACR: u32 = 0xE000_ED88;
        // SAFETY: the addresses are those of ARMv7-M (B3.2.2); the table was checked; the caller
        // guarantees the rest. Nothing after the write to MSP uses the stack: all operands are in
        // registers.
        unsafe {
            core::arch::asm!(
                "str {table}, [{vtor}]",
                "str {zero}, [{cpacr}]",
                "msr CONTROL, {zero}",
                "msr MSP, {sp}",
                "dsb",
                "isb",
                "bx {reset}",
                table = in(reg) self.address,
                vtor = in(reg) VTOR,
                cpacr = in(reg) CPACR,
                zero = in(reg) 0,
                sp = in(reg) self.initial_sp,
                reset = in(reg) self.reset,
                options(noreturn),
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::stm32f407g_disc1::LAYOUT;

    const PROGRAM: Region = LAYOUT.programs[0];

    fn check(sp: u32, reset: u32) -> Result<VectorTable, VectorFault> {
        VectorTable::check([sp, reset], PROGRAM, &LAYOUT)
    }

    #[test]
    fn takes_a_plausible_table() {
        let table = check(0x2001_FFC0, 0x0802_0189).unwrap();
        assert_eq!(
            (table.address(), table.initial_sp(), table.reset()),
            (0x0802_0000, 0x2001_FFC0, 0x0802_0189)
        );
        assert!(check(0x1001_0000, 0x080F_FFFF).is_ok(), "a stack in CCM RAM is fine");
    }

    /// Without a board every chip of the family counts, and nothing is known of a handoff.
    #[test]
    fn any_chip_has_no_more_than_the_family() {
        for chip in crate::geometry::CHIPS {
            assert!(Memory::ANY.sram.contains(chip.sram.base, chip.sram.size), "{}", chip.chip);
            assert!(
                chip.ccm.size == 0 || Memory::ANY.ccm.contains(chip.ccm.base, chip.ccm.size),
                "{}",
                chip.chip
            );
            assert_eq!(Memory::ANY.judge_stack(chip.sram.end()), Ok(()), "{}", chip.chip);
            assert!(Memory::ANY.table <= chip.vector_table_size(), "{}", chip.chip);
        }
        assert_eq!(Memory::ANY.judge_stack(0x2005_0008), Err(VectorFault::StackPointer));
        // The code of each chip is after its table: 16 + 82 vectors at least (RM0090 table 61).
        let program = Region::new(0x0802_0000, 0x1000);
        let judged = |reset| Memory::ANY.judge([0x2001_0000, reset], program);
        assert_eq!(judged(0x0802_0187), Err(VectorFault::ResetVector));
        assert_eq!(judged(0x0802_0189), Ok(()));
        // An image that ends in its own table has no code.
        let short = Region::new(0x0802_0000, 4);
        assert_eq!(Memory::ANY.judge([0x2001_0000, 0x0802_0001], short), Err(VectorFault::ResetVector));
    }

    #[test]
    fn the_rom_is_entered_only_at_an_instruction_of_the_rom() {
        let sram = LAYOUT.chip.sram;
        let table = VectorTable::of_rom([0x2000_2D44, 0x1FFF_0189], sram).unwrap();
        assert_eq!(
            (table.address(), table.initial_sp(), table.reset()),
            (0x1FFF_0000, 0x2000_2D44, 0x1FFF_0189)
        );
        // The end of the SRAM, and of the ROM.
        assert!(VectorTable::of_rom([0x2002_0000, 0x1FFF_77FF], sram).is_some());
        for words in [
            [u32::MAX, u32::MAX],
            [0, 0],
            [0x2000_2D42, 0x1FFF_0189],
            [0x2000_0000, 0x1FFF_0189],
            [0x2002_0004, 0x1FFF_0189],
            [0x2000_2D40, 0x1FFF_0188],
            [0x2000_2D40, 0x1FFF_7801],
            [0x2000_2D40, 0x0800_0189],
        ] {
            assert_eq!(VectorTable::of_rom(words, sram), None, "{words:08X?}");
        }
    }

    #[test]
    fn refuses_everything_else() {
        use VectorFault::{Misaligned, NotThumb, ResetVector, StackOverHandoff, StackPointer};
        for (sp, reset, fault) in [
            (0xFFFF_FFFF, 0xFFFF_FFFF, StackPointer),
            (0, 0x0802_0189, StackPointer),
            (0x2000_0000, 0x0802_0189, StackPointer),
            // CubeMX and cortex-m-rt put the stack at the end of the SRAM if nobody says otherwise.
            (0x2002_0000, 0x0802_0189, StackOverHandoff),
            (0x2001_FFC8, 0x0802_0189, StackOverHandoff),
            (0x2002_0008, 0x0802_0189, StackPointer),
            (0x2001_FFBC, 0x0802_0189, StackPointer),
            (0x2001_FFC0, 0x0800_0189, ResetVector),
            (0x2001_FFC0, 0x0810_0001, ResetVector),
            (0x2001_FFC0, 0x0802_0001, ResetVector),
            (0x2001_FFC0, 0x0802_0188, NotThumb),
        ] {
            assert_eq!(check(sp, reset), Err(fault), "{sp:#x} {reset:#x}");
        }
        let program = Region::new(0x0802_0100, 0x1000);
        assert_eq!(VectorTable::check([0x2001_FFC0, 0x0802_0301], program, &LAYOUT), Err(Misaligned));
    }
}
