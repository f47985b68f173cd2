//! No input may cause a panic of a reader, and no damaged file may pass as firmware.

use coflash_core::file::block_file::{self, BlockFile};
use coflash_core::file::checksum::{Checksum, CRC};
use coflash_core::file::convert::{program_of, GapFill, Options};
use coflash_core::file::read::{self, Firmware, Format};
use coflash_core::file::Program;
use proptest::prelude::*;

macro_rules! named {
    ($name:literal) => {
        ($name, data!($name))
    };
}

const FILES: [(&str, &[u8]); 9] = [
    named!("program.elf"),
    named!("program.hex"),
    named!("program-srec_cat.hex"),
    named!("program.s2"),
    named!("program.s3"),
    named!("plain-400.blk"),
    named!("identity-110.blk"),
    named!("release-110.blk"),
    named!("crc16-400.blk"),
];

/// The contents of the file, or the reason why it is invalid.
fn meaning(bytes: &[u8], format: Option<Format>) -> Result<Program, String> {
    let firmware = read::read(bytes, format, Some(0x0801_0000)).map_err(|error| error.to_string())?;
    program_of(firmware, &Options::default()).map(|done| done.program).map_err(|error| error.to_string())
}

#[test]
fn a_file_cut_off_anywhere_is_refused() {
    for (name, bytes) in FILES {
        let whole = meaning(bytes, None).unwrap();
        for len in 0..bytes.len() {
            // What may be absent: the end record after a count, the line end of the last line, and
            // whatever of an ELF no segment refers to.
            if let Ok(read) = meaning(&bytes[..len], None) {
                let rest = bytes[len..].trim_ascii();
                // After its count record (S5) an S-record file is complete.
                let counted = rest.starts_with(b"S8") && name.ends_with(".s2");
                let harmless = rest.is_empty() || counted || name.ends_with(".elf") && len >= 0x373;
                assert!(harmless && read == whole, "{name} cut to {len} bytes passed");
            }
        }
    }
}

#[test]
fn a_damaged_text_or_block_file_never_means_something_else() {
    for (name, bytes) in FILES.into_iter().filter(|(name, _)| !name.ends_with(".elf")) {
        let whole = meaning(bytes, None).unwrap();
        for at in 0..bytes.len() {
            for bit in 0..8 {
                let mut damaged = bytes.to_vec();
                damaged[at] ^= 1 << bit;
                // A flipped bit may turn a digit's case or a line end, and nothing else. (No
                // checksum of an S-record covers its type, which says how long the address is:
                // there the format itself is at an end.)
                let srec_type = name.contains(".s") && at > 0 && bytes[at - 1] == b'S';
                if let Ok(read) = meaning(&damaged, None) {
                    assert!(read == whole || srec_type, "{name}: bit {bit} of byte {at}");
                }
            }
        }
    }
}

#[test]
fn an_empty_or_foreign_file_is_named_so() {
    assert_eq!(meaning(b"", None).unwrap_err(), "the file: is empty");
    for bytes in [b"\0".as_slice(), b"PK\x03\x04", b"#!/bin/sh", b"\n\n", &[0; 64], &[0xFF; 64]] {
        assert!(meaning(bytes, None).unwrap_err().contains("not a firmware file"), "{bytes:?}");
    }
}

/// What other tools make around a program: the file says itself what it is.
#[test]
fn a_container_is_named_with_what_to_do() {
    for (bytes, words) in [
        (&b"\x1F\x8B\x08\0"[..], "a gzip archive"),
        (b"PK\x03\x04\x14\0", "a zip archive"),
        (b"7z\xBC\xAF\x27\x1C", "a 7z archive"),
        (b"\xFD7zXZ\0", "an xz archive"),
        (b"!<arch>\n", "a library of object files"),
        (b"DfuSe\x01", "a DfuSe file"),
        (b"UF2\nWQ]\x9E", "a UF2 file"),
        (b"@08010000\n", "a TI-TXT or Verilog file"),
        (b"@F800\n", "a TI-TXT or Verilog file"),
        (b"\x3D\xB8\xF3\x96\0\0\0\0", "an image for MCUboot"),
        (b"00000000: 0001 0220", "a dump in hexadecimal digits"),
        // The suffix of USB DFU 1.1, appendix B.
        (b"\0\0\x01\x20\xFF\xFF\x11\xDF\x83\x04\0\x01UFD\x10\x12\x34\x56\x78", "a file for USB DFU"),
        (b"-----BEGIN PGP", "a text in PEM"),
        (b"<!DOCTYPE html>", "a page of the web"),
        (b"\r\n<HTML>", "a page of the web"),
    ] {
        let error = meaning(bytes, None).unwrap_err();
        assert!(error.contains("is not a firmware file") && error.contains(words), "{error}");
    }
}

/// Texts in 16 and 32 bits, with and without a byte order mark.
#[test]
fn a_text_of_wide_characters_is_named_with_what_to_do() {
    let text = std::str::from_utf8(data!("program.hex")).unwrap();
    let records = std::str::from_utf8(data!("program.s3")).unwrap();
    let wide = |text: &str, little: bool, width: usize| -> Vec<u8> {
        let bytes = |character: char| {
            let mut bytes = [0; 4];
            let number = u32::from(character);
            bytes[..width].copy_from_slice(&number.to_le_bytes()[..width]);
            if !little {
                bytes[..width].reverse();
            }
            bytes.into_iter().take(width).collect::<Vec<u8>>()
        };
        text.chars().flat_map(bytes).collect()
    };
    for text in [text, records] {
        for (marked, little, width, name) in [
            (" \r\n\t", true, 2, "UTF-16"),
            ("\n\n\n\n\n", false, 4, "UTF-32"),
            ("\u{FEFF}", true, 2, "UTF-16"),
            ("\u{FEFF}", false, 2, "UTF-16"),
            ("\u{FEFF}", true, 4, "UTF-32"),
            ("\u{FEFF}", false, 4, "UTF-32"),
            ("", true, 2, "UTF-16"),
            ("", false, 2, "UTF-16"),
            ("", true, 4, "UTF-32"),
            ("", false, 4, "UTF-32"),
        ] {
            let bytes = wide(&format!("{marked}{text}"), little, width);
            let error = meaning(&bytes, None).unwrap_err();
            assert!(error.contains(name) && error.contains("plain ASCII"), "{error}");
            assert_eq!(error.contains("byte order mark"), marked == "\u{FEFF}", "{error}");
        }
    }
}

#[test]
fn program_headers_of_another_size_are_damage_and_not_missing() {
    for size in [0_u8, 31, 33, 40, 56] {
        let mut bytes = elf(1, 400, |_| (100, 0x0801_0000, 4));
        bytes[42] = size;
        let error = meaning(&bytes, None).unwrap_err();
        let words = format!(
            "offset 0x2a: its program headers have {size} bytes, and those of a 32-bit ELF file have 32"
        );
        assert!(error.starts_with(&words), "{error}");
    }
}

#[test]
fn a_damaged_block_file_is_named_with_its_offset() {
    let good = data!("plain-400.blk");
    let with = |at: usize, value: u8| {
        let mut bytes = good.to_vec();
        bytes[at] = value;
        meaning(&bytes, Some(Format::BlockFile)).unwrap_err()
    };
    let crc_of = |block: &[u8]| CRC.checksum(block).to_le_bytes();
    // Data of block 1, which starts after the 24 bytes of block 0.
    assert!(with(0x30, 0).starts_with("offset 0x18: CRC of block 1 is 0xc2fbc65a"), "{}", with(0x30, 0));
    let long = with(0x21, 0xFF);
    assert!(long.starts_with("offset 0x18: block 1 has 65478 data bytes"), "{long}");
    let mut renumbered = good.to_vec();
    renumbered[0x18] = 2;
    let crc = crc_of(&renumbered[0x18..0x2EA]);
    renumbered[0x2EA..0x2EE].copy_from_slice(&crc);
    let error = meaning(&renumbered, None).unwrap_err();
    assert!(error.starts_with("offset 0x18: block 2 follows where block 1 must"), "{error}");
    let error = meaning(&[good, good].concat(), None).unwrap_err();
    assert!(error.starts_with("offset 0x373: there are more bytes after the last block"), "{error}");
    let no_program = [&good[..0x18], &good[0x35B..]].concat();
    assert_eq!(meaning(&no_program, None).unwrap_err(), "the file: holds no data");
    let mut wrong_crc = good.to_vec();
    wrong_crc[0x36B] ^= 1;
    let crc = crc_of(&wrong_crc[0x35B..0x36F]);
    wrong_crc[0x36F..].copy_from_slice(&crc);
    let error = meaning(&wrong_crc, None).unwrap_err();
    assert!(error.starts_with("offset 0x35b: the last block gives 4001 bytes"), "{error}");
}

/// A block 0 of another length than the manual's has a meaning for the check of the product alone: it goes to
/// the device as it is.
#[test]
fn block_0_may_hold_what_a_product_wants() {
    let good = data!("plain-400.blk");
    for size in [0_usize, 1, 7, 9, 13, 20, 25, 1000, 16_368] {
        let data: Vec<u8> = (0..size).map(|n| n as u8 ^ 0x5A).collect();
        let mut block = [0; 12].to_vec();
        block[8..].copy_from_slice(&(size as u32).to_le_bytes());
        block.extend(&data);
        let crc = CRC.checksum(&block);
        block.extend(crc.to_le_bytes());
        // 24 bytes are block 0 of the good file.
        let file = meaning(&[&block, &good[24..]].concat(), None).unwrap();
        let blocks = BlockFile::of(&file);
        assert_eq!((blocks.control(), &blocks.blocks()[0].data[..]), (None, &data[..]), "{size} bytes");
        assert_eq!(file.target(), None, "{size} bytes name no device");
    }
}

/// An ELF file for Arm (System V ABI, chapters 4 and 5) with so many load segments, each of which
/// shows this many bytes from `offset` on.
fn elf(segments: u16, len: usize, segment: impl Fn(u32) -> (u32, u32, u32)) -> Vec<u8> {
    let mut bytes = b"\x7FELF\x01\x01\x01\0\0\0\0\0\0\0\0\0".to_vec();
    for half in [2_u16, 40] {
        bytes.extend(half.to_le_bytes());
    }
    for word in [1_u32, 0x0801_0189, 52, 0, 0x0500_0000] {
        bytes.extend(word.to_le_bytes());
    }
    for half in [52, 32, segments, 40, 0, 0] {
        bytes.extend(half.to_le_bytes());
    }
    for number in 0..segments.into() {
        let (offset, address, size) = segment(number);
        for word in [1, offset, address, address, size, size, 5, 1] {
            bytes.extend(word.to_le_bytes());
        }
    }
    bytes.resize(len.max(bytes.len()), 0x5A);
    bytes
}

/// Headers are small: 20 000 of them that all refer to the same 2.6 MB would be 52 GB.
#[test]
fn the_segments_of_an_elf_file_are_added_up_before_they_are_copied() {
    const LEN: u32 = 2_600_000;
    let bomb = elf(20_000, LEN as usize, |_| (0, 0x0801_0000, LEN));
    let error = meaning(&bomb, None).unwrap_err();
    let words = "the file: its load segments have more than 67108864 bytes together";
    assert!(error.starts_with(words), "{error}");
    // So many headers are not a fault by themselves.
    let bytes = elf(20_000, 0, |number| (52 + 4 * number, 0x0801_0000 + 4 * number, 4));
    assert_eq!(meaning(&bytes, None).unwrap().size(), 80_000);
    // The gap between two segments counts as well.
    let apart = elf(2, 0, |number| (52, 0x0C01_0000 + number * 0x0400_0000, 4));
    let error = meaning(&apart, None).unwrap_err();
    assert!(error.contains("too much for one program"), "{error}");
}

fn format() -> impl Strategy<Value = Option<Format>> {
    prop::sample::select(vec![
        None,
        Some(Format::IntelHex),
        Some(Format::SRecord),
        Some(Format::Elf),
        Some(Format::BlockFile),
        Some(Format::Raw),
    ])
}

proptest! {
    #[test]
    fn random_bytes_never_panic(format in format(), bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        let _ = meaning(&bytes, format);
    }

    #[test]
    fn random_damage_never_panics(
        file in prop::sample::select(FILES.to_vec()),
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
        len in any::<prop::sample::Index>(),
    ) {
        let mut bytes = file.1.to_vec();
        for (at, value) in damage {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        let len = len.index(bytes.len() * 2).min(bytes.len());
        let _ = meaning(&bytes[..len], None);
    }

    /// Random text made of the formats' own alphabet gets further into the readers than random
    /// bytes.
    #[test]
    fn random_records_never_panic(lines in prop::collection::vec("[:S][0-9A-F]{2,24}", 1..20)) {
        let _ = meaning(lines.join("\n").as_bytes(), None);
    }

    /// The blocks contain exactly the memory of the input, for any pieces and any block size.
    #[test]
    fn blocks_hold_exactly_the_image(
        pieces in prop::collection::btree_map(0u32..4000, any::<u8>(), 1..300),
        block_size in 24usize..300,
        checksum in prop::sample::select(vec![Checksum::Crc32, Checksum::Crc16]),
        gap_fill in prop::sample::select(vec![0xFFu32, 0, 0x4433_2211]),
        adjust_start in prop::sample::select(vec![0u32, 0x0801_0000]),
    ) {
        let hex: String = pieces
            .iter()
            .map(|(address, byte)| {
                let [high, low] = (*address as u16).to_be_bytes();
                let sum = 1u8.wrapping_add(high).wrapping_add(low).wrapping_add(*byte).wrapping_neg();
                format!(":01{high:02X}{low:02X}00{byte:02X}{sum:02X}\n")
            })
            .chain([":00000001FF\n".to_string()])
            .collect();
        let Firmware::Image(image) = read::read(hex.as_bytes(), None, None).unwrap() else { panic!() };
        let gap_fill = GapFill::new(gap_fill);
        let options = Options::default().block_size(block_size).checksum(checksum).gap_fill(gap_fill).adjust_start(adjust_start);
        let file = program_of(Firmware::Image(image), &options).unwrap().program;
        let mut memory = [0xFFu8; 4096];
        let mut covered = [false; 4096];
        for block in BlockFile::of(&file).program_blocks() {
            prop_assert!(block.data.len() + 16 <= block_size);
            prop_assert!(block.flash_address % 4 == 0);
            for (address, byte) in ((block.flash_address - adjust_start) as usize..).zip(&*block.data) {
                prop_assert!(!covered[address]);
                (memory[address], covered[address]) = (*byte, true);
            }
        }
        for (address, byte) in (0u32..).zip(memory) {
            // A hole inside a block has the fill's byte, as the flash's words show it; one between
            // blocks is erased.
            let hole = match covered[address as usize] {
                true if gap_fill == GapFill::new(0) => 0,
                true if gap_fill == GapFill::new(0x4433_2211) => [0x11, 0x22, 0x33, 0x44][address as usize % 4],
                _ => 0xFF,
            };
            prop_assert_eq!(byte, pieces.get(&address).copied().unwrap_or(hole));
        }
        let start = (file.start() - adjust_start) as usize;
        prop_assert_eq!(&*file.flash_image(), &memory[start..start + file.size() as usize]);
        let read = block_file::read(&block_file::emit(&file)).unwrap();
        let (read_blocks, blocks) = (BlockFile::of(&read), BlockFile::of(&file));
        prop_assert_eq!(read_blocks.blocks(), blocks.blocks());
        prop_assert_eq!((read.size(), read.crc()), (file.size(), file.crc()));
    }
}
