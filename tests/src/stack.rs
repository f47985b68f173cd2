//! How deep a stack gets: its RAM is filled with a pattern, and searched afterwards.

use emulator::machine::Machine;
use object::read::elf::ElfFile32;
use object::{Endianness, Object, ObjectSection, SectionFlags};
use shared_abi::geometry::Region;

use crate::firmware;

/// A word that no code stores.
const PATTERN: [u8; 4] = [0xA5, 0x5A, 0xC3, 0x3C];
/// ELF for the Arm architecture: a section that takes memory (SHF_ALLOC).
const ALLOC: u64 = 2;

/// The RAM of a bootloader's RAM image after its statics.
///
/// # Panics
/// If the image was not built, or has no statics in RAM.
pub fn of_image(image: &str) -> Region {
    let elf = firmware::elf(image);
    let file = ElfFile32::<Endianness>::parse(&*elf).expect("an ELF file");
    let ram = firmware::board().bootloader_ram();
    let ends = file.sections().filter_map(|section| {
        let takes_memory = matches!(section.flags(), SectionFlags::Elf { sh_flags } if sh_flags & ALLOC != 0);
        takes_memory.then_some((section.address() + section.size()) as u32)
    });
    let end = ends.filter(|end| ram.contains(end - 1, 1)).max().expect("statics in RAM").next_multiple_of(4);
    Region::new(end, ram.end() - end)
}

/// Fills what is not in use now.
///
/// # Panics
/// If the stack pointer is outside the stack.
pub fn fill(machine: &mut Machine, stack: Region) {
    let sp = machine.core_registers()[13];
    assert!((stack.base..=stack.end()).contains(&sp), "the stack pointer is {sp:#x}");
    let unused = (sp - stack.base) as usize / 4;
    machine.write_ram(stack.base, &PATTERN.repeat(unused)).expect("it is in RAM");
}

/// The most bytes that were in use since then.
///
/// # Panics
/// If the stack is not in RAM.
pub fn depth(machine: &Machine, stack: Region) -> u32 {
    let mut found = vec![0; stack.size as usize];
    machine.read_memory(stack.base, &mut found).expect("it is in RAM");
    let unused = found.chunks(4).take_while(|word| *word == PATTERN).count() as u32 * 4;
    stack.size - unused
}
