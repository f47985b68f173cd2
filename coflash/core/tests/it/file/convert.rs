//! Conversion against block files made by other tools (`data/make.sh`) and against literals from
//! the manual's tables.

use coflash_core::file::block_file::{self, emit, BlockFile};
use coflash_core::file::checksum::Checksum;
use coflash_core::file::convert::{
    convert, program_of, ConvertError, Converted, GapFill, Label, Options, Region,
};
use coflash_core::file::program::LastBlock;
use coflash_core::file::read::{self, Firmware, Format};
use coflash_core::file::{AddressRange, Image};
use shared_abi::layout::nucleo_f446re::LAYOUT;

fn image(bytes: &[u8]) -> Image {
    match read::read(bytes, None, None).unwrap() {
        Firmware::Image(image) => image,
        Firmware::Blocks(_) => panic!("a block file"),
    }
}

fn board() -> Region {
    Region::Strict(LAYOUT.programs[0].into())
}

const IDENTITY: Label = Label::Device { vendor_id: 0, product_code: 1234 };
const RELEASE: Label =
    Label::Release { vendor_id: 0, product_code: 1234, version: 0x0064_0A01, date: 1_420_070_400 };

#[test]
fn every_format_of_one_program_gives_the_same_block_file() {
    let plain = Options::default().region(board());
    for (name, bytes) in [
        ("program.elf", data!("program.elf")),
        ("program.hex", data!("program.hex")),
        ("program-srec_cat.hex", data!("program-srec_cat.hex")),
        ("program.s3", data!("program.s3")),
    ] {
        let image = image(bytes);
        for (expected, options) in [
            (data!("plain-400.blk"), plain),
            (data!("plain-400.blk"), Options::default()),
            (data!("identity-110.blk"), plain.block_size(0x110).label(IDENTITY)),
            (data!("release-110.blk"), plain.block_size(0x110).label(RELEASE)),
        ] {
            let Converted { program: file, left_out, .. } = convert(image.clone(), &options).unwrap();
            assert!(emit(&file) == expected, "{name}, {options:?}");
            assert_eq!(left_out, 0);
        }
    }
}

/// The last block of the manual of 2008 (L-1112e_5, 5.1): data size 8, 32 reserved bytes that it does
/// not count, size and CRC. Everything before it is as it is today.
#[test]
fn the_last_block_of_2008_is_written_and_read() {
    let elf = image(data!("program.elf"));
    let options = Options::default().region(board()).last_block(LastBlock::Of2008);
    let file = convert(elf.clone(), &options).unwrap().program;
    let (old, new) = (emit(&file), data!("plain-400.blk"));
    let (before, last) = old.split_at(old.len() - 56);
    assert!(before == &new[..new.len() - 24]);
    let today = &new[new.len() - 24..];
    assert_eq!(last[..12], today[..12], "number, address, data size 8");
    assert_eq!((last[8..12].to_vec(), &last[12..44]), (vec![8, 0, 0, 0], &[0; 32][..]));
    assert_eq!(last[44..52], today[12..20], "size and CRC of the program");
    assert_eq!(BlockFile::of(&block_file::read(&old).unwrap()), BlockFile::of(&file));
    // One byte less is no last block of either manual.
    assert!(block_file::read(&old[..old.len() - 1]).is_err());
    let mut damaged = old.clone();
    damaged[before.len() + 20] ^= 1;
    assert!(block_file::read(&damaged).is_err(), "its CRC runs over the reserved bytes");
}

/// The table of the manual of 2008 contradicts itself: a field of 32 reserved bytes, and offsets (28h, 2Ch,
/// 30h) that leave 28. `tests/data/expected.py` writes a file for each from the table. Both are read for
/// what they are, and sent as they are.
#[test]
fn the_last_block_of_2008_is_read_at_the_printed_offsets_and_after_32_bytes() {
    let plain = block_file::read(data!("plain-400.blk")).unwrap();
    for (file, last) in [(data!("last-2008-offsets-400.blk"), 52), (data!("last-2008-reserved-400.blk"), 56)]
    {
        let read = block_file::read(file).unwrap();
        assert_eq!((read.size(), read.crc()), (plain.size(), plain.crc()));
        assert!(read.image() == plain.image() && emit(&read) == file);
        assert_eq!(BlockFile::of(&read).blocks().last().unwrap().emit(), file[file.len() - last..]);
        // A byte of the field more or less, and a damaged one.
        let at = file.len() - 20;
        for other in [[&file[..at], &file[at + 1..]].concat(), [&file[..at], &[0], &file[at..]].concat()] {
            assert!(block_file::read(&other).is_err(), "{}", other.len());
        }
        let mut damaged = file.to_vec();
        damaged[at] ^= 1;
        assert!(block_file::read(&damaged).unwrap_err().to_string().contains("CRC of block"));
        // The same with a data size that counts the field, as the device takes it, too.
        let mut counts = file[..file.len() - 4].to_vec();
        let size_at = file.len() - last + 8;
        counts[size_at] = last as u8 - 16;
        let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&counts[size_at - 8..]);
        counts.extend(crc.to_le_bytes());
        assert_eq!(block_file::read(&counts).unwrap().crc(), plain.crc());
    }
}

/// Polynomial 1021h in blocks and program, stored in 32 bits (manual, table 8); made with Python's
/// `binascii.crc_hqx`.
#[test]
fn the_16_bit_crc_is_that_of_the_manual() {
    let elf = image(data!("program.elf"));
    let options = Options::default().region(board()).checksum(Checksum::Crc16);
    let file = convert(elf.clone(), &options).unwrap().program;
    assert!(emit(&file) == data!("crc16-400.blk"));
    // Read back, it is known for what it is.
    let read = block_file::read(data!("crc16-400.blk")).unwrap();
    assert_eq!(BlockFile::of(&read), BlockFile::of(&file));
    assert_eq!((read.checksum(), read.crc() >> 16), (Checksum::Crc16, 0));
    let mut damaged = data!("crc16-400.blk").to_vec();
    damaged[0x30] ^= 1;
    assert!(block_file::read(&damaged).unwrap_err().to_string().contains("CRC of block 1"));
}

#[test]
fn addresses_are_adjusted_behind_the_cut_and_before_the_board() {
    let elf = image(data!("program.elf"));
    let with = |region, adjust_start| {
        convert(elf.clone(), &Options::default().region(region).adjust_start(adjust_start))
    };
    let range = |first, last| Region::Cut(AddressRange { first, last });
    for region in [Region::Unknown, range(0x0801_0000, 0x080F_FFFF)] {
        assert!(emit(&with(region, 0xF800_0000).unwrap().program) == data!("adjusted-400.blk"), "{region:?}");
    }
    // Away from the board and back to it.
    let moved = Firmware::Image(elf.moved(0x1000_0000).unwrap());
    let back = Options::default().region(board()).adjust_start(0xF000_0000);
    assert!(emit(&program_of(moved.clone(), &back).unwrap().program) == data!("plain-400.blk"));
    assert!(program_of(moved, &Options::default().region(board())).is_err());
    // Over the end of the address space: the border within a piece, between two, and before the
    // first.
    for (region, offset) in [
        (Region::Unknown, 0xF7FE_FFF0),
        (Region::Unknown, 0xF7FE_F200),
        (range(0x0800_0000, 0x0801_FFFF), 0xF7FF_FFF0),
    ] {
        let error = with(region, offset).unwrap_err();
        assert!(matches!(error, ConvertError::Adjust(_)), "{offset:#x}: {error}");
    }
    assert!(with(Region::Unknown, 2).is_ok(), "a start inside a word is rounded down");
    let blocks = read::read(data!("plain-400.blk"), None, None).unwrap();
    let error = program_of(blocks, &Options::default().adjust_start(4)).unwrap_err();
    assert!(matches!(error, ConvertError::Blocks(_)), "{error}");
}

/// objcopy's binary is the flash image, gaps filled with FFh.
#[test]
fn the_flash_image_is_that_of_objcopy() {
    for bytes in [data!("plain-400.blk"), data!("identity-110.blk"), data!("crc16-400.blk")] {
        let file = block_file::read(bytes).unwrap();
        assert!(file.flash_image() == data!("program.bin"));
        assert_eq!(file.start(), 0x0801_0000);
    }
}

/// The example of CiA 814-1, section 6.5: the text begins 24 bytes after the mark.
#[test]
fn the_software_version_is_found_in_every_format() {
    let text = b"junk$CANopenSoftwareVersion\x001.2.0 (\xE9)\x1B\0more";
    let raw = |bytes: &[u8]| match read::read(bytes, Some(Format::Raw), Some(0x0801_0000)).unwrap() {
        Firmware::Image(image) => image,
        Firmware::Blocks(_) => panic!("a block file"),
    };
    let found = Some("1.2.0 (\u{e9})?".to_string());
    assert_eq!(raw(text).software_version(), found);
    // It may lie across two blocks.
    let options = Options::default().block_size(24);
    let file = convert(raw(text), &options).unwrap().program;
    assert_eq!(file.image().software_version(), found);
    assert_eq!(raw(&text[..4]).software_version(), None);
    assert_eq!(raw(&text[..27]).software_version(), None, "the mark's final zero is missing");
    assert_eq!(raw(&text[..29]).software_version(), Some("1".to_string()), "no end");
}

#[test]
fn short_addresses_read_the_same_memory() {
    let short = image(data!("program.s2"));
    let moved = short.segments().map(|(address, data)| (address + 0x0800_0000, data));
    let elf = image(data!("program.elf"));
    assert!(moved.eq(elf.segments()));
}

#[test]
fn a_block_file_is_read_back_and_taken_as_it_is() {
    for bytes in [data!("plain-400.blk"), data!("identity-110.blk"), data!("release-110.blk")] {
        let firmware = read::read(bytes, None, None).unwrap();
        let done = program_of(firmware, &Options::default().region(board())).unwrap();
        assert!(emit(&done.program) == bytes);
        assert_eq!(done.program.size(), 0xFA1);
    }
}

/// A program of five bytes, block by block as the tables of chapter 5.1 draw it; CRCs from Python's
/// `zlib.crc32`.
#[test]
fn a_small_program_byte_by_byte() {
    let image = image(b":020000040801F1\n:050000000102030405EC\n:00000001FF\n");
    let Converted { program: file, .. } = convert(image.clone(), &Options::default()).unwrap();
    #[rustfmt::skip]
    let expected = [
        0, 0, 0, 0,  0, 0, 0, 0,  8, 0, 0, 0,  0, 0, 0, 0, 0, 0, 0, 0,  0x73, 0xED, 0xD9, 0x09,
        1, 0, 0, 0,  0, 0, 1, 8,  5, 0, 0, 0,  1, 2, 3, 4, 5,  0x6C, 0x8E, 0xAE, 0x57,
        0xFF, 0xFF, 0xFF, 0xFF,  0, 0, 0, 0,  8, 0, 0, 0,
            5, 0, 0, 0,  0xF4, 0x99, 0x0B, 0x47,  0x12, 0x88, 0x99, 0x41,
    ];
    assert_eq!(emit(&file), expected);
}

#[test]
fn gaps_inside_a_block_take_the_fill_and_count_in_the_crc() {
    // 01 at 08010000h, a gap of six bytes, 02 at 08010007h.
    let image = image(b":020000040801F1\n:0100000001FE\n:0100070002F6\n:00000001FF\n");
    let data = |gap_fill| {
        let file =
            convert(image.clone(), &Options::default().gap_fill(GapFill::new(gap_fill))).unwrap().program;
        (BlockFile::of(&file).program_blocks()[0].data.to_vec(), file.crc())
    };
    // CRCs: zlib.crc32 over the eight bytes.
    assert_eq!(data(0xFFFF_FFFF), (vec![1, 255, 255, 255, 255, 255, 255, 2], 0x08A9_57C5));
    assert_eq!(data(0x0000_00A5), (vec![1, 0xA5, 0xA5, 0xA5, 0xA5, 0xA5, 0xA5, 2], 0xD575_ECB9));
    assert_eq!(data(0x4433_2211), (vec![1, 0x22, 0x33, 0x44, 0x11, 0x22, 0x33, 2], 0x173E_DAA0));
}

/// The 2008 manual's `FT_BLOCK_MAX_GAP`: so many bytes in a row may a block have that are not the
/// program's; with one more the program continues in a new block.
#[test]
fn a_gap_that_is_too_long_starts_a_new_block() {
    // 01 at 08010000h, 02 at 08010010h (a gap of 15), 03 at 08010013h (of 2, within a word).
    let text = b":020000040801F1\n:0100000001FE\n:0100100002ED\n:0100130003E9\n:00000001FF\n";
    let image = image(text);
    let blocks = |max_gap| {
        let file = convert(image.clone(), &Options::default().max_gap(max_gap)).unwrap().program;
        let blocks: Vec<(u32, usize)> = BlockFile::of(&file)
            .program_blocks()
            .iter()
            .map(|block| (block.flash_address, block.data.len()))
            .collect();
        (blocks, file.size())
    };
    let (start, next) = (0x0801_0000, 0x0801_0010);
    for whole in [None, Some(15), Some(u32::MAX)] {
        assert_eq!(blocks(whole), (vec![(start, 20)], 20), "{whole:?}");
    }
    // Flash is programmed by words: a gap within one never ends a block.
    for split in [14, 2, 1, 0] {
        assert_eq!(blocks(Some(split)), (vec![(start, 1), (next, 4)], 20), "{split}");
    }
}

#[test]
fn the_region_decides_about_data_outside() {
    let elf = image(data!("program.elf"));
    let with = |region| convert(elf.clone(), &Options::default().region(region));
    let range = |first, last| AddressRange { first, last };

    let error = with(Region::Strict(range(0x0801_0000, 0x0801_0F9F))).unwrap_err().to_string();
    let words = "offset 0x362: the data at 0x08010f90..=0x08010fa0 lies outside 0x08010000..=0x08010f9f";
    assert!(error.starts_with(words), "{error}");
    // The manual's --start_address/--end_address leave it out.
    let cut = with(Region::Cut(range(0x0801_0000, 0x0801_02C5))).unwrap();
    assert_eq!((cut.program.size(), cut.left_out), (0x2C6, 8 + 17));
    assert_eq!(with(Region::CutBehind(0x0801_02C5)).unwrap(), cut);
    let error = with(Region::Cut(range(0, 0xFFFF))).unwrap_err().to_string();
    assert_eq!(error, "the file: holds no data inside 0x00000000..=0x0000ffff");
    // The size counts from the region's start.
    let early = with(Region::Strict(range(0x0800_FF00, 0x080F_FFFF))).unwrap();
    assert_eq!(early.program.size(), 0xFA1 + 0x100);
    assert!(matches!(with(Region::Cut(range(2, 0xFFFF_FFFF))), Err(ConvertError::Start(2))));
    assert!(matches!(with(Region::Cut(range(8, 4))), Err(ConvertError::Range(_))));
}

#[test]
fn a_block_file_for_another_place_is_refused() {
    let file = block_file::read(data!("plain-400.blk")).unwrap();
    let range = |first, last| AddressRange { first, last };
    assert!(file.check_region(range(0x0801_0000, 0x080F_FFFF)).is_ok());
    let error = file.check_region(range(0x0801_0000, 0x0801_0FFF - 0x60)).unwrap_err().to_string();
    assert!(error.starts_with("offset 0x2ee: the data at 0x08010f44..=0x08010fa0 lies outside"), "{error}");
    // The device would count size and CRC from its region's start.
    let error = file.check_region(range(0x0800_0000, 0x080F_FFFF)).unwrap_err().to_string();
    assert!(error.contains("the program begins at 0x08010000, and the region at 0x08000000"), "{error}");
}

#[test]
fn a_block_size_holds_every_block() {
    let elf = image(data!("program.elf"));
    let with =
        |block_size, label| convert(elf.clone(), &Options::default().block_size(block_size).label(label));
    for (least, label) in [(24, Label::None), (28, IDENTITY), (40, RELEASE)] {
        let file = with(least, label).unwrap().program;
        assert!(BlockFile::of(&file).blocks().iter().all(|block| block.emit().len() <= least));
        let error = with(least - 1, label).unwrap_err().to_string();
        assert!(error.contains(&format!("must be {least} to 16384")), "{error}");
    }
    assert!(with(16384, Label::None).is_ok());
    assert!(with(16385, Label::None).is_err());
}

#[test]
fn two_memories_in_one_file_are_not_one_program() {
    let image = image(b":0100000001FE\n:02000004FFFFFC\n:01FFFF0002FF\n:00000001FF\n");
    let error = convert(image.clone(), &Options::default()).unwrap_err().to_string();
    assert!(error.starts_with("the file: the data spans 0x00000000..=0xffffffff"), "{error}");
    // The end of the address space itself is no problem.
    let top = AddressRange { first: 0xFFFF_FF00, last: 0xFFFF_FFFF };
    let file = convert(image.clone(), &Options::default().region(Region::Cut(top))).unwrap().program;
    assert_eq!((file.size(), file.span().last), (0x100, 0xFFFF_FFFF));
    assert!(block_file::read(&emit(&file)).is_ok());
}

#[test]
fn a_raw_file_goes_where_it_is_told() {
    let bytes = data!("program.bin");
    let read = |address| read::read(bytes, Some(Format::Raw), address);
    let Firmware::Image(raw) = read(Some(0x0801_0000)).unwrap() else { panic!() };
    let file = convert(raw.clone(), &Options::default().region(board())).unwrap().program;
    let gapless = block_file::read(data!("plain-400.blk")).unwrap();
    assert_eq!((file.size(), file.crc()), (gapless.size(), gapless.crc()));
    assert!(read(None).unwrap_err().to_string().contains("give --start-address"));
    assert!(read(Some(0xFFFF_FF00)).is_err());
    assert!(read::read(bytes, None, None).unwrap_err().to_string().contains("not a firmware file"));
}
