//! Judges whether an image can be a program, without a device. The rules for the first two words are
//! those of the device, [`Memory::judge`].
//!
//! The checks are not stricter than the device's, with these exceptions: an image at the start of the
//! flash is a bootloader and not a program, and a reset vector must point into the image.

use std::fmt;

use shared_abi::geometry::{Region, CHIPS};
use shared_abi::layout::Layout;
use shared_abi::vectors::{Memory, VectorFault};

use super::area::{Area, FLASH};
use super::foreign::{self, Foreign};
use super::image::Image;
use super::range::AddressRange;
use crate::advice::Advice;

/// Its first sector, which has 16 KiB on every chip. No program can have it, because the CPU starts
/// there after a reset.
const FIRST_SECTOR: AddressRange = AddressRange { first: 0x0800_0000, last: 0x0800_3FFF };
/// The bytes of handoff and warm-start cell, which every board has at the end of its SRAM.
const SHARED: u32 = 64;

/// Why an image cannot be a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// It begins at the address of the bootloader.
    #[error("begins at the start of the flash, as a bootloader does and a program does not")]
    Bootloader,
    /// All its bytes have this value, 00h or FFh.
    #[error("is not a program: all its bytes are {0:02X}h")]
    Blank(u8),
    /// It has data that no bootloader writes.
    #[error("has data at {range}, in {area}, and not in the flash of a program")]
    Elsewhere {
        /// First and last address of the data.
        range: AddressRange,
        /// Their area.
        area: Area,
    },
    /// It is an image of another kind, which its first bytes name.
    #[error("is not a program but {}", .0.what)]
    Foreign(Foreign),
    /// It has a program, and other data before it: a factory file.
    #[error("has more than a program: other data from {other:08X}h on, and a program at {program:08X}h")]
    Merged {
        /// The first address of the other data.
        other: u32,
        /// The address of the program's vectors.
        program: u32,
    },
    /// It does not contain the first two vectors.
    #[error("is not a program: it does not begin with an initial stack pointer and a reset vector")]
    NoVectors,
    /// It begins with vectors, but not where the program begins.
    #[error("is linked for {linked:08X}h, and the program begins at {start:08X}h")]
    OtherPlace {
        /// The address of its vectors.
        linked: u32,
        /// The address where the device looks for them.
        start: u32,
    },
    /// The first word cannot be an initial stack pointer.
    #[error(
        "is not a program: its first word, {0:08X}h, is not an initial stack pointer (a multiple \
         of 8 in the RAM)"
    )]
    StackPointer(u32),
    /// The stack would run over what bootloader and program tell each other.
    #[error(
        "cannot be started: its stack begins at {stack:08X}h, over the handoff ({handoff:08X}h), which the \
         bootloader writes for the program at the end of the RAM"
    )]
    StackOverHandoff {
        /// The initial stack pointer.
        stack: u32,
        /// The address of the handoff.
        handoff: u32,
    },
    /// The second word does not point into the program.
    #[error("is not a program: its reset vector is {vector:08X}h, outside {range}")]
    ResetVector {
        /// The reset vector.
        vector: u32,
        /// The range for a valid vector.
        range: AddressRange,
    },
    /// The second word points into the vector table, where no code can be.
    #[error("is not a program: its reset vector is {vector:08X}h, inside the vector table, {table}")]
    VectorInTable {
        /// The reset vector.
        vector: u32,
        /// The vector table: that of the board's chip, or the shortest of the family.
        table: AddressRange,
    },
    /// The reset vector points into the program, but its bit 0 is clear: this CPU only executes
    /// Thumb code.
    #[error("is not a program: its reset vector is {0:08X}h, without the Thumb bit")]
    NotThumb(u32),
}

impl Fault {
    /// The stable error number: that of a file that is not firmware.
    pub const NUMBER: u32 = 0x6000_0021;

    /// What to do next.
    #[must_use]
    pub fn advice(&self) -> Advice {
        match self {
            Self::Bootloader => Advice::BootloaderFile,
            Self::Foreign(foreign) => foreign.advice.clone(),
            Self::Merged { .. } => Advice::ProgramAlone,
            Self::Elsewhere { area, .. } => area.advice(),
            Self::OtherPlace { .. } => Advice::OtherPlace,
            Self::StackOverHandoff { .. } => Advice::StackOverHandoff,
            Self::ResetVector { .. } => Advice::ResetVector,
            Self::VectorInTable { .. } => Advice::VectorTable,
            _ => Advice::NoVectorTable,
        }
    }
}

/// Judges an image with a program that starts at `start`; 0 for an image without addresses. `board` is
/// the memory map of the device, if it is known.
///
/// # Errors
/// The first fault.
pub fn judge(image: &Image, start: u32, board: Option<&Layout>) -> Result<(), Fault> {
    judge_image(image, start, board).map_err(|fault| match fault {
        Fault::Bootloader | Fault::NoVectors | Fault::StackPointer(_) => {
            named_image(image, start).unwrap_or(fault)
        }
        fault => fault,
    })
}

/// The fault of an image that does not begin with vectors, if its contents name one.
pub(super) fn named_image(image: &Image, start: u32) -> Option<Fault> {
    /// The room that Zephyr and imgtool leave for the header of MCUboot.
    const HEADERS: [u32; 4] = [0x100, 0x200, 0x400, 0x800];
    let first = image.part(AddressRange { first: start, last: start.saturating_add(511) });
    let first = first.iter().flat_map(Image::segments).find(|(at, _)| *at == start);
    if let Some(foreign) = first.and_then(|(_, bytes)| foreign::of_image(&bytes)) {
        return Some(Fault::Foreign(foreign));
    }
    let is_program = |at: &u32| is_begin(image, *at, &Memory::ANY);
    if let Some(linked) = HEADERS.map(|room| start.saturating_add(room)).into_iter().find(is_program) {
        return Some(Fault::OtherPlace { linked, start });
    }
    program_after(image, start).map(|program| Fault::Merged { other: start, program })
}

/// Where a program begins in an image with other data before it: the first sector after `first`
/// that begins with a vector table, or with the header of MCUboot.
pub(super) fn program_after(image: &Image, first: u32) -> Option<u32> {
    let step = FIRST_SECTOR.len() as u32;
    let sectors = (first / step + 1..=image.span().last / step).map(|number| number * step);
    let is_program =
        |at: &u32| is_begin(image, *at, &Memory::ANY) || image.bytes(*at) == Some(foreign::MCUBOOT);
    sectors.filter(|at| FLASH.has(*at)).find(is_program)
}

fn judge_image(image: &Image, start: u32, board: Option<&Layout>) -> Result<(), Fault> {
    let AddressRange { first, last } = image.span();
    if start == FLASH.first
        || image.part(AddressRange { first: FLASH.first, last: FLASH.first + 3 }).is_some()
    {
        return Err(Fault::Bootloader);
    }
    if let Some((range, area)) = elsewhere(image, start) {
        return Err(Fault::Elsewhere { range, area });
    }
    if let Some(byte) = image.only_byte().filter(|byte| matches!(byte, 0 | 0xFF)) {
        return Err(Fault::Blank(byte));
    }
    let memory = memory_of(board);
    let [stack, vector] = match vectors(image, start) {
        Some(words) => words,
        None if is_begin(image, first, &memory) => return Err(Fault::OtherPlace { linked: first, start }),
        None => return Err(Fault::NoVectors),
    };
    if start == 0 && FIRST_SECTOR.has(vector & !1) {
        memory.judge_stack(stack).map_err(|fault| named(fault, [stack, 0], FLASH, board))?;
        return Err(Fault::Bootloader);
    }
    if start != 0 {
        return judge_words([stack, vector], AddressRange { first: start, last }, board);
    }
    judge_words([stack, vector], FLASH, board)?;
    match table_anywhere(image, vector, board) {
        Some(table) => Err(Fault::VectorInTable { vector, table }),
        None => Ok(()),
    }
}

/// Judges the reset vector of an image without addresses, when its place is known: it begins at the
/// first address of `region`.
///
/// # Errors
/// [`Fault::ResetVector`], [`Fault::VectorInTable`], [`Fault::NotThumb`] or [`Fault::NoVectors`].
pub fn judge_place(image: &Image, region: AddressRange) -> Result<(), Fault> {
    let words = vectors(image, 0).ok_or(Fault::NoVectors)?;
    let last = region.first.saturating_add(image.span().last).min(region.last);
    judge_words(words, AddressRange { first: region.first, last }, None)
}

/// A stack that begins at the end of a chip's SRAM, the default of CubeMX and of cortex-m-rt. On a board
/// with such a chip the handoff is there; on one with more RAM the program starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StackAtEnd {
    /// The initial stack pointer.
    pub stack: u32,
    /// The end of that SRAM.
    pub end: u32,
}

impl StackAtEnd {
    /// The stack of a program that starts at `start`, if it begins there.
    #[must_use]
    pub fn of(image: &Image, start: u32) -> Option<Self> {
        let [stack, _] = vectors(image, start)?;
        let mut ends = CHIPS.iter().map(|chip| chip.sram.end());
        let end = ends.find(|end| (end - SHARED + 1..=*end).contains(&stack))?;
        Some(Self { stack, end })
    }
}

impl fmt::Display for StackAtEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { stack, end } = self;
        write!(
            f,
            "its stack begins at {stack:08X}h, over the handoff ({:08X}h) of a board whose SRAM ends at {end:08X}h: \
             such a board does not start it; {}",
            end - SHARED,
            Advice::KnowBoard
        )
    }
}

/// The memory of the board, or that of the family.
fn memory_of(board: Option<&Layout>) -> Memory {
    board.map_or(Memory::ANY, Memory::of)
}

/// The vector table of a program at `range`.
fn table_of(range: AddressRange, board: Option<&Layout>) -> AddressRange {
    let last = range.first.saturating_add(memory_of(board).table - 1);
    AddressRange { first: range.first, last: last.min(range.last) }
}

/// The vector table of an image without addresses, if the reset vector points into it wherever the image
/// is linked for. A program begins with a sector, and each sector begins at a multiple of the first one's
/// size. In an image that is longer than that size, the vector may be meant for an earlier sector.
fn table_anywhere(image: &Image, vector: u32, board: Option<&Layout>) -> Option<AddressRange> {
    let step = FIRST_SECTOR.len() as u32;
    let (first, end) = (vector - vector % step, image.span().last);
    let table = table_of(AddressRange { first, last: first.saturating_add(end) }, board);
    (table.has(vector & !1) && end < step + vector % step).then_some(table)
}

/// Data outside the main flash, of an image with addresses.
fn elsewhere(image: &Image, start: u32) -> Option<(AddressRange, Area)> {
    if let Some((piece, area)) = image.strays() {
        return Some((piece.range(), area));
    }
    let area = Area::of(start).filter(|_| start != 0)?;
    Some((image.span(), area))
}

/// Whether a vector table begins at this address of the image.
fn is_begin(image: &Image, address: u32, memory: &Memory) -> bool {
    let range = AddressRange { first: address, last: image.span().last };
    vectors(image, address).is_some_and(|[stack, vector]| {
        !matches!(memory.judge_stack(stack), Err(VectorFault::StackPointer)) && range.has(vector & !1)
    })
}

fn judge_words(words: [u32; 2], range: AddressRange, board: Option<&Layout>) -> Result<(), Fault> {
    let memory = memory_of(board);
    // The range lies in the flash, so its size has 32 bits.
    let program = Region::new(range.first, range.last - range.first + 1);
    memory.judge(words, program).map_err(|fault| named(fault, words, range, board))
}

/// The fault with its addresses.
fn named(fault: VectorFault, words: [u32; 2], range: AddressRange, board: Option<&Layout>) -> Fault {
    let [stack, vector] = words;
    match (fault, board) {
        (VectorFault::StackOverHandoff, Some(layout)) => {
            Fault::StackOverHandoff { stack, handoff: layout.handoff.base }
        }
        (VectorFault::StackPointer | VectorFault::StackOverHandoff, _) => Fault::StackPointer(stack),
        (VectorFault::ResetVector, _) => match table_of(range, board) {
            table if table.has(vector & !1) => Fault::VectorInTable { vector, table },
            _ => Fault::ResetVector { vector, range },
        },
        (VectorFault::NotThumb, _) => Fault::NotThumb(vector),
        (VectorFault::Misaligned, _) => Fault::NoVectors,
    }
}

/// Initial stack pointer and reset vector.
fn vectors(image: &Image, start: u32) -> Option<[u32; 2]> {
    Some([image.bytes(start)?, image.bytes(start.checked_add(4)?)?].map(u32::from_le_bytes))
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::nucleo_f446re::LAYOUT as NUCLEO;
    use shared_abi::layout::stm32f429i_disc1::LAYOUT as F429;

    use super::super::convert::{convert, Options, Region};
    use super::super::raw;
    use super::*;

    const START: u32 = 0x0801_0000;

    fn with(stack_pointer: u32, vector: u32, at: u32) -> Result<(), Fault> {
        judge(&program(stack_pointer, vector, at), at, None)
    }

    #[test]
    fn what_a_device_takes_is_taken() {
        for stack_pointer in [0x2000_0008, 0x2001_FFC0, 0x2002_0000, 0x2005_0000, 0x1001_0000, 0x1000_0008] {
            assert_eq!(with(stack_pointer, START + 0x189, START), Ok(()), "{stack_pointer:08X}h");
        }
        for vector in [START + 0x189, START + 0x3FF] {
            assert_eq!(with(0x2001_FFC0, vector, START), Ok(()), "{vector:08X}h");
        }
        // Without addresses, the image may be linked for any place of the flash that a program may
        // have.
        for vector in [0x0800_4189, 0x0801_0189, 0x081F_FFFF] {
            assert_eq!(with(0x2001_FFC0, vector, 0), Ok(()), "{vector:08X}h");
        }
    }

    #[test]
    fn what_no_device_starts_is_refused() {
        for stack_pointer in [0, 0x2000_0000, 0x2001_FFC4, 0x2005_0008, 0x1000_0000, 0x1001_0008, 0x0801_0000]
        {
            let fault = Err(Fault::StackPointer(stack_pointer));
            assert_eq!(with(stack_pointer, START + 0x189, START), fault);
        }
        let range = AddressRange { first: START, last: START + 0x3FF };
        for vector in [0, START - 1, START + 0x401, 0x0800_0189, 0xFFFF_FFFF] {
            assert_eq!(with(0x2001_FFC0, vector, START), Err(Fault::ResetVector { vector, range }));
        }
        assert_eq!(with(0x2001_FFC0, START + 0x188, START), Err(Fault::NotThumb(START + 0x188)));
        assert_eq!(
            with(0x2001_FFC0, 0x2000_0189, 0).unwrap_err(),
            Fault::ResetVector { vector: 0x2000_0189, range: FLASH }
        );
    }

    /// The STM32F405 has the shortest table of the family, 16 + 82 vectors (RM0090 table 61), the
    /// STM32F446 has 16 + 97 (RM0390 table 38).
    #[test]
    fn a_reset_vector_into_the_table_is_refused_with_the_board_and_without() {
        let judged = |vector, board| judge(&program(0x2001_0000, vector, START), START, board);
        for (board, size) in [(None, 98 * 4), (Some(&NUCLEO), 113 * 4)] {
            let table = AddressRange { first: START, last: START + size - 1 };
            for vector in [START + 1, START + 9, START + size - 1] {
                let fault = judged(vector, board).unwrap_err();
                assert_eq!(fault, Fault::VectorInTable { vector, table });
                let words = fault.to_string();
                assert!(
                    words.contains(&format!("{vector:08X}h")) && words.contains(&table.to_string()),
                    "{words}"
                );
            }
            assert_eq!(judged(START + size + 1, board), Ok(()));
        }
        // An image that ends within its table has no code at all.
        let image =
            raw::read(&program(0x2001_0000, START + 9, START).bytes::<64>(START).unwrap(), Some(START));
        let table = AddressRange { first: START, last: START + 63 };
        let fault = Fault::VectorInTable { vector: START + 9, table };
        assert_eq!(judge(&image.unwrap(), START, None), Err(fault));
    }

    /// An image without addresses may be linked for any sector, and each has a multiple of 16 KiB.
    #[test]
    fn a_reset_vector_that_is_in_the_table_for_each_place_is_refused() {
        let table = AddressRange { first: 0x0800_C000, last: 0x0800_C187 };
        let fault = Err(Fault::VectorInTable { vector: 0x0800_C009, table });
        assert_eq!(with(0x2001_FFC0, 0x0800_C009, 0), fault);
        // It may be the code of a program that begins a sector before.
        let mut bytes = vec![0x5A; 0x4010];
        bytes[..4].copy_from_slice(&0x2001_0000_u32.to_le_bytes());
        bytes[4..8].copy_from_slice(&0x0800_C009_u32.to_le_bytes());
        assert_eq!(judge(&raw::read(&bytes, Some(0)).unwrap(), 0, None), Ok(()));
        // The device says where the program begins.
        let image = program(0x2001_0000, START + 9, 0);
        let place = judge_place(&image, AddressRange { first: START, last: START + 0xFFFF });
        assert!(matches!(place, Err(Fault::VectorInTable { .. })), "{place:?}");
    }

    #[test]
    fn a_bootloader_is_no_program_with_addresses_and_without() {
        assert_eq!(with(0x2001_FFC0, 0x0800_0189, 0x0800_0000), Err(Fault::Bootloader));
        assert_eq!(with(0x2001_FFC0, 0x0800_0189, 0), Err(Fault::Bootloader));
        // This fault is reported before all others.
        assert_eq!(with(0, 0, 0x0800_0000), Err(Fault::Bootloader));
    }

    #[test]
    fn blank_and_short_images_are_no_programs() {
        for (byte, len) in [(0, 8), (0xFF, 0x2000), (0, 1)] {
            let image = raw::read(&vec![byte; len], Some(START)).unwrap();
            assert_eq!(judge(&image, START, None), Err(Fault::Blank(byte)));
        }
        let image = raw::read(&[0, 0, 1, 0x20, 0x89, 1, 1], Some(START)).unwrap();
        assert_eq!(judge(&image, START, None), Err(Fault::NoVectors));
        // Vectors after the start do not count.
        let image = raw::read(&[0x5A; 64], Some(START + 4)).unwrap();
        assert_eq!(judge(&image, START, None), Err(Fault::NoVectors));
    }

    #[test]
    fn an_image_without_addresses_is_judged_by_the_place_that_it_goes_to() {
        let image = program(0x2001_0000, 0x0801_0189, 0);
        let region = |first| AddressRange { first, last: first + 0xFFFF };
        assert_eq!(judge_place(&image, region(START)), Ok(()));
        // In the region, but not in the image when that lies at the region's start.
        for first in [0x0808_0000, 0x0800_C000] {
            let range = AddressRange { first, last: first + 0x3FF };
            let other = Fault::ResetVector { vector: 0x0801_0189, range };
            assert_eq!(judge_place(&image, region(first)), Err(other));
            let words = other.to_string();
            assert!(words.contains("08010189h") && words.contains(&format!("{first:#010x}..=")), "{words}");
        }
    }

    /// A program with these first words, at a place of its own.
    fn program(stack: u32, vector: u32, at: u32) -> Image {
        let mut bytes = vec![0x5A; 0x400];
        bytes[..4].copy_from_slice(&stack.to_le_bytes());
        bytes[4..8].copy_from_slice(&vector.to_le_bytes());
        raw::read(&bytes, Some(at)).unwrap()
    }

    /// The end of the SRAM is the default stack of CubeMX and cortex-m-rt: 2002_0000h on an F446 and
    /// 2003_0000h on an F429 (RM0090 section 2.3.1). With the board it is refused with both addresses;
    /// without it is a suspicion.
    #[test]
    fn a_stack_over_the_handoff_is_refused_with_the_board() {
        for (board, end) in [(&NUCLEO, 0x2002_0000), (&F429, 0x2003_0000)] {
            let at = board.programs[0].base;
            let (vector, handoff) = (at + 0x1D1, end - 64);
            for stack in [end, end - 8, end - 56] {
                let image = program(stack, vector, at);
                let fault = judge(&image, at, Some(board)).unwrap_err();
                assert_eq!(fault, Fault::StackOverHandoff { stack, handoff });
                let words = fault.to_string();
                let both = format!("stack begins at {stack:08X}h, over the handoff ({handoff:08X}h)");
                assert!(words.contains(&both), "{words}");
                assert_eq!(judge(&image, at, None), Ok(()));
                assert_eq!(StackAtEnd::of(&image, at), Some(StackAtEnd { stack, end }));
            }
            let image = program(handoff, vector, at);
            assert_eq!((judge(&image, at, Some(board)), StackAtEnd::of(&image, at)), (Ok(()), None));
            let beyond = program(end + 8, vector, at);
            assert_eq!(judge(&beyond, at, Some(board)), Err(Fault::StackPointer(end + 8)));
            // An image without addresses has a stack as well.
            assert!(matches!(
                judge(&program(end, vector, 0), 0, Some(board)),
                Err(Fault::StackOverHandoff { .. })
            ));
        }
    }

    #[test]
    fn a_program_for_another_place_in_the_region_is_told_with_both_addresses() {
        for linked in [0x0801_2000, 0x0800_C000] {
            let image = program(0x2001_0000, linked + 0x1C1, linked);
            for board in [None, Some(&NUCLEO)] {
                let fault = judge(&image, START, board).unwrap_err();
                assert_eq!(fault, Fault::OtherPlace { linked, start: START });
                let words = fault.to_string();
                assert!(words.contains(&format!("{linked:08X}h")) && words.contains("08010000h"), "{words}");
            }
        }
        // Data without vectors are linked for nothing.
        let image = program(0x5A5A_5A5A, 0x0801_2189, 0x0801_2000);
        assert_eq!(judge(&image, START, None), Err(Fault::NoVectors));
    }

    /// The header of MCUboot: "MCUboot image format", `ih_magic`; Zephyr leaves 200h bytes for it.
    #[test]
    fn an_image_for_another_bootloader_is_named() {
        let code = |at| program(0x2001_0000, at + 0x189, at).bytes::<0x400>(at).unwrap();
        for (begin, words) in [
            (&[0x3D, 0xB8, 0xF3, 0x96][..], "is not a program but an image for MCUboot"),
            (b"PK\x03\x04", "is not a program but a zip archive"),
            // RFC 1952 section 2.3.1; HTML; the pointer of Git LFS's specification; esptool's image of three segments.
            (b"\x1F\x8B\x08", "is not a program but a gzip archive"),
            (b"<!DOCTYPE html>", "is not a program but a page of the web"),
            // The stack pointer 2001003Ch begins as XML does.
            (b"\x3C\x00\x01\x20", "is linked for 08010200h, and the program begins at 08010000h"),
            (b"version https://git-lfs.github.com/spec/v1", "is not a program but a pointer of Git LFS"),
            (b"\xE9\x03\x02\x20", "is not a program but an image for an ESP32"),
            // POSIX.1, "ustar Interchange Format": the magic follows 257 bytes.
            (&[&[b'f'; 257][..], b"ustar"].concat(), "is not a program but a tar archive"),
            (&[], "is linked for 08010200h, and the program begins at 08010000h"),
        ] {
            let mut bytes = begin.to_vec();
            bytes.resize(0x200, 0);
            bytes.extend(code(START + 0x200));
            let image = raw::read(&bytes, Some(START)).unwrap();
            for board in [None, Some(&NUCLEO)] {
                let fault = judge(&image, START, board).unwrap_err();
                assert!(fault.to_string().starts_with(words), "{fault}");
            }
        }
    }

    /// A file of the production: other data, a gap or fill bytes, and the program.
    #[test]
    fn a_factory_file_is_named_with_the_place_of_its_program() {
        // The program may have been signed for MCUboot.
        for (other, stack) in [(0x0800_0000, 0x2001_0000), (0x0800_C000, 0x96F3_B83D)] {
            for fill in [0, 0xFF] {
                let mut bytes = vec![fill; (START - other) as usize];
                bytes[..8].copy_from_slice(b"CAL1\0\0\0\0");
                bytes.extend(program(stack, START + 0x189, START).bytes::<0x400>(START).unwrap());
                let image = raw::read(&bytes, Some(other)).unwrap();
                let fault = Fault::Merged { other, program: START };
                assert_eq!(judge(&image, other, None), Err(fault));
                // With the board, which says where the region of the program is.
                let options = Options::default().region(Region::Strict(NUCLEO.programs[0].into()));
                let error = convert(image, &options).unwrap_err();
                assert!(error.to_string().ends_with(&format!("{fault}: {}", fault.advice())), "{error}");
            }
        }
    }

    #[test]
    fn data_outside_the_flash_are_named_by_their_area() {
        let at = |address| program(0x2001_0000, address + 0x189, address);
        for (address, area) in
            [(0x2000_0000, Area::Ram), (0x1000_0000, Area::Ccm), (0x9000_0000, Area::External)]
        {
            let range = AddressRange { first: address, last: address + 0x3FF };
            assert_eq!(judge(&at(address), address, None), Err(Fault::Elsewhere { range, area }));
        }
    }
}
