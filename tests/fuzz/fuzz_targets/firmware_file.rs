//! The readers of firmware files (Intel HEX, S-record, ELF, block file, raw) and the conversion
//! after them.
//!
//! Must hold: any bytes give an image or an error that can be shown; an image that can be converted
//! gives a block file that reads back equal, with every byte of the image in it; a block file is
//! written as it was read.
#![cfg_attr(fuzzing, no_main)]

use coflash_core::file::block_file::{self, emit, BlockFile};
use coflash_core::file::convert::{program_of, Options};
use coflash_core::file::read::{read, Firmware, Format};
use coflash_core::file::Program;

const FORMATS: [Option<Format>; 6] = [
    None,
    Some(Format::IntelHex),
    Some(Format::SRecord),
    Some(Format::Elf),
    Some(Format::BlockFile),
    Some(Format::Raw),
];

coboot_fuzz::target!(|bytes: &[u8]| {
    let Some((first, bytes)) = bytes.split_first() else { return };
    let format = FORMATS[usize::from(*first) % FORMATS.len()];
    match read(bytes, format, Some(0x0801_0000)) {
        Err(error) => assert!(!error.of("file").to_string().is_empty()),
        Ok(Firmware::Blocks(file)) => assert_eq!(emit(&file), bytes),
        Ok(Firmware::Image(image)) => {
            let segments: Vec<(u32, Vec<u8>)> =
                image.segments().map(|(address, data)| (address, data.into_owned())).collect();
            assert!(!segments.is_empty());
            for pair in segments.windows(2) {
                let end = u64::from(pair[0].0) + pair[0].1.len() as u64;
                assert!(end < u64::from(pair[1].0), "segments touch or overlap");
            }
            let span = image.span();
            // A few bytes at both ends of the address space: not a program, and not worth the
            // memory.
            if span.last - span.first > 1 << 20 {
                return;
            }
            let Ok(converted) = program_of(Firmware::Image(image), &Options::default()) else { return };
            let file = converted.program;
            let read = block_file::read(&emit(&file)).expect("what was written reads back");
            assert_eq!(BlockFile::of(&read).blocks(), BlockFile::of(&file).blocks());
            for (address, data) in segments {
                for (address, byte) in (address..=u32::MAX).zip(data) {
                    assert_eq!(byte_at(&file, address), Some(byte), "at {address:08X}h");
                }
            }
        }
    }
});

fn byte_at(file: &Program, address: u32) -> Option<u8> {
    BlockFile::of(file).program_blocks().iter().find_map(|block| {
        let offset = address.checked_sub(block.flash_address)?;
        block.data.get(offset as usize).copied()
    })
}
