//! Blocks of instructions: how many they have, and what they take.

use std::collections::HashMap;

use super::instruction::Instruction;
use crate::chip::Chip;
use crate::costs;
use crate::report::Access;

/// The properties of a block of instructions that the model needs.
#[derive(Clone, Copy, Debug, Default)]
pub struct Block {
    pub instructions: u64,
    /// What they take, but for what the cache of the flash decides.
    pub cycles: u64,
    /// Address of the first FPU instruction.
    pub fpu: Option<u32>,
    /// Encoding of the last instruction; the upper half of a 16-bit one is zero.
    pub last: u32,
}

/// A cache of the blocks that were inspected. `Cpu::drop_stale` clears it when code changes. If a
/// program changes its own code in RAM, the cycles of the old code are counted.
pub struct Blocks {
    inspected: Vec<(u32, u32, Block)>,
    /// Where the instruction ends that accesses a counter of the core, and how many instructions follow. A program
    /// may poll the counter.
    pub moments: HashMap<Moment, (u32, u64)>,
}

/// An access in a block: the block's address and length, the bytes of it before, access and address.
pub type Moment = (u32, u32, u32, Access, u32);

impl Default for Blocks {
    fn default() -> Self {
        Self { inspected: vec![(0, 0, Block::default()); Self::SIZE], moments: HashMap::new() }
    }
}

impl Blocks {
    const SIZE: usize = 4096;

    pub fn inspect_block(&mut self, chip: &Chip, address: u32, size: u32) -> Block {
        let slot = &mut self.inspected[(address >> 1) as usize % Self::SIZE];
        if (slot.0, slot.1) != (address, size) {
            *slot = (address, size, count_instructions(chip, address, size));
        }
        slot.2
    }

    pub fn clear(&mut self) {
        self.inspected.fill((0, 0, Block::default()));
        self.moments.clear();
    }
}

/// Looks at so many bytes of code.
pub fn count_instructions(chip: &Chip, address: u32, size: u32) -> Block {
    let mut block = Block::default();
    let Some((memory, offset)) = chip.memory(address) else { return block };
    let Some(code) = memory.bytes().get(offset..(offset + size as usize)) else { return block };
    let mut at = address;
    while let Some(instruction) =
        code.get((at - address) as usize..).and_then(|code| Instruction::take(at, code))
    {
        let Instruction { first, second, .. } = instruction;
        let is_wide = instruction.len() == 4;
        // Coprocessor space (A5.3.18) with coprocessor number 10 or 11.
        if is_wide && first & 0xEC00 == 0xEC00 && matches!(second >> 8 & 0xF, 0xA | 0xB) {
            block.fpu = block.fpu.or(Some(at));
        }
        block.instructions += 1;
        block.last = if is_wide { u32::from(first) << 16 | u32::from(second) } else { first.into() };
        block.cycles += if chip.costs { costs::of_instruction(first, second) } else { 1 };
        at += instruction.len();
    }
    if chip.costs && chip.geometry.sram.contains(address, 1) {
        block.cycles += costs::of_fetch_from_sram(size);
    }
    block
}
