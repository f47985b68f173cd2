//! Program download by block file: every block and command, in and out of order, on a strict flash.

use boot_core::control::{AppInfo, Downloader, Policy, Step, Verdict};
use boot_core::crc::CrcKind;
use boot_core::flash::{Flash, FlashFault, Next};
use boot_core::program::{verify, Invalid};
use boot_core::store::{Journal, Key, Parameters, StoreError, Value};
use canopen::od::Objects;
use canopen::program::{FlashError, ProgramControl};
use canopen::AbortCode;
use kit::bench::*;
use kit::boot::leaked;
use kit::model::{ModelFlash, CHIP};
use shared_abi::block_file::Control;
use shared_abi::geometry::Region;
use shared_abi::warm_start::BootRequest;

#[test]
fn a_program_goes_in_block_by_block_and_survives_a_restart() {
    let image = program(1000, 0x11);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    bench.install(&image);
    assert_eq!(bench.word(IDENTIFICATION), crc32(&image));
    assert_eq!(bench.command(SET_SIGNATURE), 0);

    assert_eq!(&flash.cells(PROGRAM)[..1000], image);
    assert!(flash.cells(PROGRAM)[1000..].iter().all(|byte| *byte == 0xFF));
    assert_eq!(autostart(&flash), Ok(0x11));
    let mut bench = Bench::new(&mut flash);
    assert_eq!((bench.word(IDENTIFICATION), bench.status()), (crc32(&image), 0));
}

#[test]
fn a_program_may_fill_its_region_and_not_a_byte_more() {
    let size = PROGRAM.size as usize;
    let image = program(size, 0x12);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    bench.release(&image);
    assert_eq!(flash.cells(PROGRAM), image);
    assert_eq!(autostart(&flash), Ok(0x12));
    // In one download.
    let mut bench = Bench::cleared(&mut flash);
    assert_eq!(bench.stream(&image, Some(PROGRAM.size), 7), (Ok(()), 0));
    assert_eq!(bench.word(IDENTIFICATION), crc32(&image));

    // The last block is beyond the end by a byte, or by all of it; and so is a program size.
    for behind in [1, 16] {
        assert_eq!(bench.command(CLEAR), 0);
        let file = block_file(&image, 96);
        bench.all_good(&file[..file.len() - 2]);
        let number = file.len() as u32 - 2;
        let wrong = block(number, PROGRAM.end() - 16 + behind, &[0; 16]);
        let (outcome, status) = bench.block(&wrong);
        assert!(outcome.is_err() && status != 0, "{behind}: {outcome:?}, {status:#x}");
    }
    let longer = program(size + 4, 0x13);
    assert_eq!(bench.command(CLEAR), 0);
    let (outcome, status) = bench.stream(&longer, None, 7);
    assert!(outcome.is_err() && status != 0, "{outcome:?}, {status:#x}");
    assert_eq!(autostart(&flash), Err(Invalid::Absent));
}

/// A product whose blocks and programs carry CRC-16 (`BLCOP_USE_CRC16`).
const CRC_16: Policy = Policy { crc: CrcKind::Crc16, ..Policy::DEFAULT };

/// The same block with the other CRC, in the lower half of the word.
fn with_crc16(mut block: Vec<u8>) -> Vec<u8> {
    let body = block.len() - 4;
    let crc = crc16(&block[..body]);
    block[body..].copy_from_slice(&crc.to_le_bytes());
    block
}

fn file_with_crc16(program: &[u8], chunk: usize) -> Vec<Vec<u8>> {
    let mut file = block_file(program, chunk);
    let size = program.len() as u32;
    let last = block(u32::MAX, 0, &[size.to_le_bytes(), crc16(program).to_le_bytes()].concat());
    *file.last_mut().unwrap() = last;
    file.into_iter().map(with_crc16).collect()
}

/// Whether the boot stage of a product with this CRC would start it.
fn starts(flash: &ModelFlash, kind: CrcKind) -> Result<bool, Invalid> {
    let journal = Journal::open(flash, LAYOUT.parameters);
    verify(flash, &journal, &LAYOUT, kind, 1).map(|program| program.signed)
}

/// CRC of the digits 1 to 9, from the CRC catalogue (CRC-32/ISO-HDLC and CRC-16/XMODEM, "check"): computed by
/// the device's code and by the code of these tests.
#[test]
fn the_crcs_are_those_of_the_catalogue() {
    assert_eq!((boot_core::crc32(b"123456789"), crc32(b"123456789")), (0xCBF4_3926, 0xCBF4_3926));
    assert_eq!((CrcKind::Crc16.resume(0, b"123456789"), crc16(b"123456789")), (0x31C3, 0x31C3));
    assert_eq!(CrcKind::Crc16.resume(CrcKind::Crc16.resume(0, b"1234"), b"56789"), 0x31C3);
}

#[test]
fn a_product_with_crc_16_takes_blocks_and_programs_that_carry_it() {
    let image = program(1000, 0x11);
    // Also if the CRC of the program is computed in many steps.
    for crc_step in [64, 1024] {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::with(&mut flash, Policy { crc_step, ..CRC_16 });
        assert_eq!(bench.command(CLEAR), 0);
        let good = file_with_crc16(&image, 96);
        // The other CRC, and one with a non-zero upper half.
        let mut upper = good[0].clone();
        *upper.last_mut().unwrap() = 1;
        for wrong in [&block_file(&image, 96)[0], &upper] {
            assert_eq!(bench.block(wrong), (Err(AbortCode(0x0800_0020)), 0x06));
        }
        bench.all_good(&good);
        assert_eq!(bench.word(IDENTIFICATION), crc16(&image));
        assert_eq!(bench.command(SET_SIGNATURE), 0);
        assert_eq!(starts(&flash, CrcKind::Crc16), Ok(true));
        assert_eq!(starts(&flash, CrcKind::Crc32), Err(Invalid::Crc));
        flash.poke(PROGRAM.base + 500, &[!image[500]]);
        assert_eq!(starts(&flash, CrcKind::Crc16), Err(Invalid::Crc));
    }
}

/// The last block contains another CRC than the program's: the correct value of the other kind.
#[test]
fn a_product_with_crc_16_finds_no_program_where_the_crc_over_it_is_wrong() {
    let image = program(96, 0x22);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::with(&mut flash, CRC_16);
    assert_eq!(bench.command(CLEAR), 0);
    let good = file_with_crc16(&image, 96);
    bench.good(&good[0]);
    bench.good(&good[1]);
    assert_eq!(bench.block(&with_crc16(last(&image))), (Ok(()), 0x02));
    assert_eq!(bench.command(SET_SIGNATURE), 0x02);
    assert_eq!(starts(&flash, CrcKind::Crc16), Err(Invalid::Absent));
}

/// A format without a CRC gets the product's own kind.
#[test]
fn a_product_with_crc_16_takes_raw_images_and_keeps_their_crc_16() {
    let image = program(3001, 0x33);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::with(&mut flash, CRC_16);
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.stream(&image, Some(3001), 7), (Ok(()), 0));
    assert_eq!(bench.word(IDENTIFICATION), crc16(&image));
    assert_eq!(bench.command(START), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Fresh(1)));
    assert_eq!(starts(&flash, CrcKind::Crc16), Ok(true));
    assert_eq!(starts(&flash, CrcKind::Crc32), Err(Invalid::Crc));
}

#[test]
fn blocks_may_begin_and_end_at_any_byte() {
    for chunk in [1, 3, 5, 7, 33] {
        let image = program(120, 0x22);
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::cleared(&mut flash);
        bench.all_good(block_file(&image, chunk));
        assert_eq!(&flash.cells(PROGRAM)[..120], image, "blocks of {chunk}");
    }
}

/// A flash in which all sectors of the program must be erased.
fn full() -> ModelFlash {
    let mut flash = ModelFlash::new(&CHIP);
    flash.poke(PROGRAM.base, &vec![0; PROGRAM.size as usize]);
    flash
}

#[test]
fn status_is_busy_from_the_acknowledgement_to_the_end_of_the_work() {
    let mut flash = full();
    let mut bench = Bench::new(&mut flash);
    // Twice in a row, which erases at once.
    bench.node.write(CONTROL, &[CLEAR]).unwrap();
    assert_eq!(bench.status(), 0);
    bench.node.write(CONTROL, &[CLEAR]).unwrap();
    assert_eq!(bench.status(), 1);
    assert_eq!(bench.node.write(CONTROL, &[CLEAR]), Err(AbortCode(0x0800_0022)));
    // First the record, then the sectors. A command at this time is refused with "wait", and does no harm.
    let mut steps = Vec::new();
    while bench.status() & 1 != 0 {
        steps.push(bench.node.step());
        for command in [START, SET_SIGNATURE, CLR_SIGNATURE] {
            if bench.status() & 1 != 0 {
                assert_eq!(bench.node.write(CONTROL, &[command]), Err(AbortCode(0x0800_0022)));
                assert_eq!(bench.status(), 0x87, "busy, and MAN_BUSY");
            }
        }
    }
    let erasing = steps.iter().filter(|step| **step == Step::Erasing).count();
    assert!(steps[0..8].contains(&Step::Programming) && erasing > 8, "one at least per sector: {steps:?}");
    assert_eq!((bench.status(), bench.node.take_boot_request()), (0, None));
    assert_eq!(bench.command(START), 0x02, "nothing is left to be started");
    bench.install(&program(96, 0x11));
}

/// Each wrong block: the abort, the status of table 3, an unchanged flash, and then the right
/// block.
#[test]
fn every_wrong_block_is_refused_and_the_next_attempt_works() {
    let image = program(192, 0x33);
    let good = block_file(&image, 96);
    let at = PROGRAM.base;
    let mut bad_crc = good[1].clone();
    bad_crc[20] ^= 1;
    let mut short = good[1].clone();
    short.pop();
    let mut long = good[1].clone();
    long.push(0);
    let mut size_lies = good[1].clone();
    size_lies[8] += 1;
    let boot = LAYOUT.bootloader;
    let secured = AbortCode(0x0800_0020);
    let cases: Vec<(&str, Vec<u8>, AbortCode, u32)> = vec![
        ("wrong CRC", bad_crc, AbortCode(0x0800_0020), 0x06),
        ("one byte short", short, AbortCode(0x0607_0010), 0x04),
        ("one byte long", long, AbortCode(0x0607_0010), 0x04),
        ("size does not fit", size_lies, AbortCode(0x0607_0010), 0x04),
        ("shorter than a header", vec![1, 0, 0, 0], AbortCode(0x0607_0013), 0x04),
        ("a byte shorter", good[1][..11].to_vec(), AbortCode(0x0607_0013), 0x04),
        ("a header alone", good[1][..12].to_vec(), AbortCode(0x0607_0013), 0x04),
        ("no data", block(1, at, &[]), AbortCode(0x0800_0020), 0x04),
        ("larger than the buffer", block(1, at, &[0; 257 - 16]), AbortCode(0x0607_0012), 0x04),
        ("next block too early", good[2].clone(), AbortCode(0x0800_0022), 0x88),
        ("last block too early", last(&image), AbortCode(0x0800_0022), 0x88),
        ("huge number", block(0xFFFF_FFFE, at, &[0; 8]), AbortCode(0x0800_0022), 0x88),
        ("after the program", block(1, PROGRAM.end(), &[0; 8]), AbortCode(0x0800_0020), 0x0C),
        ("over the program's end", block(1, PROGRAM.end() - 4, &[0; 8]), AbortCode(0x0800_0020), 0x0C),
        ("outside the flash", block(1, 0x2000_0000, &[0; 8]), AbortCode(0x0800_0020), 0x0C),
        ("wrapping round the address space", block(1, 0xFFFF_FFFC, &[0; 8]), AbortCode(0x0800_0020), 0x0C),
        ("its last byte and one more", block(1, PROGRAM.end() - 1, &[0; 2]), AbortCode(0x0800_0020), 0x0C),
        ("the last address", block(1, u32::MAX, &[0]), AbortCode(0x0800_0020), 0x0C),
        ("not its start", block(1, at + 4, &[0; 8]), AbortCode(0x0800_0020), 0x0C),
        ("up to the bootloader", block(1, boot.base - 4, &[0; 4]), AbortCode(0x0800_0020), 0x0C),
        ("into the bootloader", block(1, boot.base - 4, &[0; 5]), secured, 0x0E),
        ("over the bootloader", block(1, boot.base, &[0; 8]), secured, 0x0E),
        ("over its last byte", block(1, boot.end() - 1, &[0]), secured, 0x0E),
        ("over the parameters", block(1, 0x0800_0400, &[0; 8]), secured, 0x0E),
        ("from the parameters into the program", block(1, at - 4, &[0; 8]), secured, 0x0E),
    ];
    for (what, bad, abort, status) in cases {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::cleared(&mut flash);
        bench.good(&good[0]);
        bench.node.flash().touched.clear();
        assert_eq!(bench.block(&bad), (Err(abort), status), "{what}");
        assert_eq!(bench.node.flash().touched, [], "{what}: the flash was touched");
        bench.all_good(&good[1..]);
        assert_eq!(bench.command(SET_SIGNATURE), 0, "{what}");
        assert_eq!(autostart(&flash), Ok(0x33), "{what}");
    }
}

#[test]
fn control_and_last_blocks_of_other_lengths_or_sizes_are_refused() {
    let image = program(96, 0x44);
    let good = block_file(&image, 96);
    let mut bench = Bench::cleared(new_flash());
    assert_eq!(bench.block(&block(0, 0, &[0; 16])), (Err(AbortCode(0x0800_0020)), 0x04));
    bench.good(&good[0]);
    bench.good(&good[1]);
    for (data, status) in [
        (vec![0; 7], 0x04),
        (vec![0; 12], 0x04),
        ([0_u32.to_le_bytes(), [0; 4]].concat(), 0x04),
        ([7_u32.to_le_bytes(), [0; 4]].concat(), 0x04),
        ([(PROGRAM.size + 1).to_le_bytes(), [0; 4]].concat(), 0x0C),
        ([u32::MAX.to_le_bytes(), [0; 4]].concat(), 0x0C),
    ] {
        assert_eq!(bench.block(&block(u32::MAX, 0, &data)), (Err(AbortCode(0x0800_0020)), status));
    }
    bench.good(&good[2]);
}

#[test]
fn a_program_whose_crc_or_vectors_are_wrong_is_no_program() {
    let image = program(96, 0x55);
    let mut other = image.clone();
    other[50] ^= 1;
    let mut nowhere = image.clone();
    nowhere[4..8].copy_from_slice(&0x0800_0101_u32.to_le_bytes());
    // If the first block contains the vectors, they are checked with it, and it is refused. Here it
    // contains only the first vector.
    for (stored, reported) in [(&image, &other), (&nowhere, &nowhere)] {
        let mut bench = Bench::cleared(new_flash());
        bench.good(&block(0, 0, &[0; 8]));
        bench.good(&block(1, PROGRAM.base, &stored[..4]));
        bench.good(&block(2, PROGRAM.base + 4, &stored[4..]));
        assert_eq!(bench.block(&last(reported)), (Ok(()), 0x02));
        assert_eq!(bench.word(IDENTIFICATION), crc32(stored), "1F56h shows what is in flash");
        assert_eq!(bench.command(SET_SIGNATURE), 0x02);
        assert_eq!(bench.command(START), 0x02);
        assert_eq!(bench.node.take_boot_request(), None);
        bench.install(&image);
    }
}

#[test]
fn an_installed_program_must_be_cleared_first_and_what_is_not_blank_is_not_written() {
    let image = program(96, 0x66);
    let good = block_file(&image, 96);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    bench.install(&image);
    assert_eq!(bench.block(&good[0]), (Err(AbortCode(0x0800_0022)), 0x08));
    // After a power cut in the middle of a download there is no program, but the flash is not
    // blank.
    flash.poke(PROGRAM.base + 90, &[0]);
    flash.poke(LAYOUT.parameters[0].base, &[0; 0x200]);
    let mut bench = Bench::new(&mut flash);
    bench.good(&good[0]);
    // Whether a place is blank is checked when the flash can be read.
    assert_eq!(bench.block(&good[1]), (Ok(()), 0x08));
    assert_eq!(bench.block(&good[1]), (Err(AbortCode(0x0800_0022)), 0x08));
    bench.install(&image);
}

#[test]
fn signature_and_start() {
    let image = program(96, 0x77);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    assert_eq!(bench.command(START), 0x02, "NOVALPROG");
    assert_eq!(bench.command(SET_SIGNATURE), 0x02);
    assert_eq!(bench.command(CLR_SIGNATURE), 0, "nothing to take away");
    assert_eq!(bench.node.take_boot_request(), None);
    assert_eq!(bench.command(0x02), 0, "RESET_STAT");

    bench.install(&image);
    assert_eq!(bench.command(START), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Trial(1)));
    assert_eq!(bench.command(SET_SIGNATURE), 0);
    assert_eq!(bench.command(START), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Start(1)));
    assert_eq!(bench.command(CLR_SIGNATURE), 0);
    assert_eq!(autostart(&flash), Err(Invalid::Absent));

    let mut bench = Bench::new(&mut flash);
    assert_eq!(bench.node.write(CONTROL, &[0x80]), Ok(()));
    assert_eq!(bench.node.write(CONTROL, &[0x00]), Ok(()));
    for unknown in [0x04, 0x05, 0x7F, 0x81, 0x82, 0x85, 0xFF] {
        assert_eq!(bench.node.write(CONTROL, &[unknown]), Err(AbortCode(0x0609_0030)), "{unknown:#x}");
    }
    // One CLEAR loses nothing; a second one does.
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.word(IDENTIFICATION), crc32(&image));
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.word(IDENTIFICATION), 0);
    assert_eq!(bench.command(START), 0x02);
}

#[test]
fn a_transfer_cut_off_in_the_middle_leaves_no_trace() {
    let image = program(192, 0x88);
    let good = block_file(&image, 96);
    for cut in 0..good[1].len() {
        let mut bench = Bench::cleared(new_flash());
        bench.good(&good[0]);
        bench.node.flash().touched.clear();
        bench.node.download_start(DATA, None).unwrap();
        bench.node.download_data(DATA, &good[1][..cut]).unwrap();
        bench.node.download_cancel(DATA);
        assert_eq!(bench.node.flash().touched, []);
        bench.all_good(&good[1..]);
    }
}

/// 1F57h without the number of the protected sector, which a status of 0Eh alone may have: it is one of the
/// program's sectors, 4 to 11.
fn without_sector(status: u32) -> u32 {
    match (status >> 16, status & 0xFFFF) {
        (4..=11, 0x0E) => 0x0E,
        _ => status,
    }
}

#[test]
fn faults_of_the_flash_are_told_and_clear_begins_anew() {
    let image = program(192, 0x99);
    let good = block_file(&image, 96);
    for (fault, status) in
        [(FlashFault::Failed, 0x0A), (FlashFault::Verify, 0x0A), (FlashFault::Protected, 0x0E)]
    {
        // Two CLEARs remove the record and then erase.
        let mut flash = full();
        let mut bench = Bench::new(&mut flash);
        assert_eq!((bench.command(CLEAR), bench.command(CLEAR)), (0, 0));
        let last = bench.node.flash().touched.iter().rposition(|region| region.size > 4).unwrap();
        let fail_to_clear = |bench: &mut Bench<'_>| {
            bench.node.flash().fail = Some((last as u32 + 1, fault));
            assert_eq!(bench.command(CLEAR), 0);
            assert_eq!(without_sector(bench.command(CLEAR)), status);
            assert_eq!(bench.command(CLEAR), 0);
            bench.good(&good[0]);
            bench.node.flash().operations
        };
        // The first block erases its sector; its last operation writes data.
        let mut flash = full();
        let mut bench = Bench::new(&mut flash);
        let before = fail_to_clear(&mut bench);
        bench.good(&good[1]);
        let of_the_block = bench.node.flash().operations - before;
        let mut flash = full();
        let mut bench = Bench::new(&mut flash);
        let operations = fail_to_clear(&mut bench);
        bench.node.flash().fail = Some((operations + of_the_block, fault));
        let (sent, shown) = bench.block(&good[1]);
        assert_eq!((sent, without_sector(shown)), (Ok(()), status));
        let status = shown;
        // Half a block is in flash: only CLEAR helps, and until then the cause stays visible.
        assert_eq!(bench.block(&good[1]), (Err(AbortCode(0x0800_0022)), status));
        bench.install(&image);
        let operations = bench.node.flash().operations;
        bench.node.flash().fail = Some((operations + 2, fault));
        let after = bench.command(SET_SIGNATURE);
        let expected = if fault == FlashFault::Verify { 0 } else { 0x10 };
        assert_eq!(after, expected, "NVDATA, unless another slot of the journal took it");
    }
}

/// Control block with identity: application size, vendor-ID, product code (SYS TEC manual, table
/// 6).
fn control(app_size: u32, vendor_id: u32, product_code: u32) -> Vec<u8> {
    let words = [app_size, vendor_id, product_code];
    block(0, 0, &words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>())
}

/// The data of block 0 belong to the product, whatever their length is (manual, `TgtProcessAppInfoData`).
#[test]
fn a_products_own_check_gets_block_0_of_any_length_byte_for_byte() {
    // The n-th byte of data of this length: 251 is no factor of the size of the ring, so that no two places
    // of the ring look alike.
    fn byte(len: usize, n: usize) -> u8 {
        ((len + n) % 251) as u8
    }
    fn own(_: u8, info: &AppInfo<'_>) -> Verdict {
        let len = info.bytes().len();
        assert!(info.bytes().eq((0..len).map(|n| byte(len, n))), "{len} bytes");
        assert_eq!(info.control.is_some(), matches!(len, 8 | 12 | 24), "{len} bytes");
        match len % 3 {
            0 => Verdict::Accept,
            1 => Verdict::Refuse(FlashError::Unspecified),
            _ => Verdict::Standard,
        }
    }
    let policy = Policy { check: own, ..Policy::DEFAULT };
    let (old, new) = (program(200, 0xA0), program(3000, 0xB0));
    // 16 368 bytes are the most that a block can have. The larger ring has its end within some of the blocks.
    for buffer in [16_384, 20_000] {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::new(&mut flash);
        bench.release(&old);
        let mut bench = Bench::with_buffer(&mut flash, policy, buffer);
        for len in (0..64).chain([100, 255, 256, 1000, 4096, 16_366, 16_367, 16_368]) {
            let data: Vec<u8> = (0..len).map(|n| byte(len, n)).collect();
            assert_eq!(bench.command(CLEAR), 0);
            bench.node.flash().touched.clear();
            let (answer, status) = match len % 3 {
                0 => (Ok(()), 0),
                1 => (Err(AbortCode(0x0800_0020)), 0x7E),
                // Of the manual's lengths these two are judged by the standard.
                _ if matches!(len, 8 | 12 | 24) => (Ok(()), 0),
                _ => (Err(AbortCode(0x0800_0020)), 0x04),
            };
            assert_eq!(bench.block(&block(0, 0, &data)), (answer, status), "{len} bytes");
            assert_eq!(bench.node.flash().touched, [], "nothing is lost with {len} bytes");
            if answer.is_err() {
                assert_eq!(bench.command(START), 0, "{len} bytes");
                assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Start(1)), "{len} bytes");
                continue;
            }
            // The program comes after it, and the same ring holds its blocks.
            block_file(&new, 700)[1..].iter().for_each(|block| bench.good(block));
            assert_eq!(bench.command(SET_SIGNATURE), 0, "{len} bytes");
        }
    }
    // One byte more is refused by its length, with the announcement of the transfer.
    let mut bench = Bench::with_buffer(new_flash(), policy, 20_000);
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.block(&block(0, 0, &[0; 16_369])).0, Err(AbortCode(0x0607_0012)));
}

/// A wrong file has no effect: the installed program stays and starts.
#[test]
fn a_file_for_another_product_is_refused_before_anything_is_lost() {
    fn no_downgrade(program: u8, info: &AppInfo<'_>) -> Verdict {
        assert_eq!(program, 1);
        match info.control {
            Some(Control::Identity(reported)) if reported.app_size == 0xBAD => {
                Verdict::Refuse(FlashError::Unspecified)
            }
            Some(Control::Identity(reported)) if reported.app_size == 0x600D => Verdict::Accept,
            _ => Verdict::Standard,
        }
    }
    const DEVICE: (u32, u32) = (0x0102_0304, 0x0A0B_0C0D);
    let policy = Policy { identity: Some(DEVICE), check: no_downgrade, ..Policy::DEFAULT };
    let (old, new) = (program(200, 0xA0), program(200, 0xB0));
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::with(&mut flash, policy);
    bench.release(&old);
    bench.node.flash().touched.clear();
    for (what, file, status) in [
        ("vendor-ID", control(0, DEVICE.0 ^ 1, DEVICE.1), 0x80),
        ("product code", control(0, DEVICE.0, DEVICE.1 ^ 1), 0x82),
        ("the integrator's no", control(0xBAD, DEVICE.0, DEVICE.1), 0x7E),
    ] {
        assert_eq!(bench.command(CLEAR), 0);
        assert_eq!(bench.block(&file), (Err(AbortCode(0x0800_0020)), status), "{what}");
        assert_eq!(
            bench.block(&block_file(&new, 96)[1]).0,
            Err(AbortCode(0x0800_0022)),
            "{what}: no way past it"
        );
        assert_eq!(bench.node.flash().touched, [], "{what}");
        assert_eq!(bench.command(START), 0, "{what}");
        assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Start(1)), "{what}");
    }
    // 0 stands for any value; and if the integrator accepts a program, it needs no identity.
    for file in [control(0, 0, 0), control(0, DEVICE.0, DEVICE.1), control(0x600D, 7, 7)] {
        assert_eq!(bench.command(CLEAR), 0);
        bench.good(&file);
        bench.all_good(&block_file(&new, 96)[1..]);
        assert_eq!(bench.command(SET_SIGNATURE), 0);
    }
    assert_eq!(autostart(&flash), Ok(0xB0));
}

#[test]
fn while_programming_is_not_allowed_nothing_is_changed() {
    use std::sync::atomic::{AtomicBool, Ordering};
    static ALLOWED: AtomicBool = AtomicBool::new(true);
    let policy = Policy { allowed: || ALLOWED.load(Ordering::Relaxed), ..Policy::DEFAULT };
    let image = program(200, 0xC0);
    let mut bench = Bench::with(new_flash(), policy);
    bench.install(&image);
    bench.node.flash().touched.clear();
    ALLOWED.store(false, Ordering::Relaxed);
    for command in [CLEAR, SET_SIGNATURE, CLR_SIGNATURE] {
        assert_eq!(bench.node.write(CONTROL, &[command]), Err(AbortCode(0x0800_0022)));
        assert_eq!(bench.status(), 0x84, "NO_ACCESS");
    }
    assert_eq!(bench.node.flash().touched, []);
    // To read a program or to start the existing one is not programming.
    assert_eq!(bench.word(IDENTIFICATION), crc32(&image));
    assert_eq!(bench.command(START), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Trial(1)));
    // It may change after CLEAR, and after block 0, as long as nothing is lost.
    ALLOWED.store(true, Ordering::Relaxed);
    assert_eq!(bench.command(CLEAR), 0);
    for (part, block) in block_file(&image, 96)[..2].iter().enumerate() {
        ALLOWED.store(false, Ordering::Relaxed);
        for _ in 0..2 {
            assert_eq!(bench.block(block), (Err(AbortCode(0x0800_0022)), 0x84), "block {part}");
        }
        assert_eq!(bench.stream(&image, None, 7).0, Err(AbortCode(0x0800_0022)));
        ALLOWED.store(true, Ordering::Relaxed);
        if part == 0 {
            bench.good(block);
        }
    }
    assert_eq!(bench.node.flash().touched, []);
    bench.install(&image);
}

#[test]
fn blocks_out_of_order_and_overlapping_ones_are_refused_and_the_program_goes_on() {
    let image = program(192, 0x22);
    let good = block_file(&image, 96);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::cleared(&mut flash);
    bench.good(&good[0]);
    bench.good(&good[1]);
    bench.good(&good[2]);
    assert_eq!(bench.block(&good[1]), (Err(AbortCode(0x0800_0022)), 0x88), "SEQUENCE");
    // Correct by its number, but over existing data: the check of the flash detects it.
    let over = block(3, PROGRAM.base + 100, &[0; 16]);
    assert_eq!(bench.block(&over), (Ok(()), 0x08), "NOTCLEARED");
    assert_eq!(bench.block(&good[3]).0, Err(AbortCode(0x0800_0022)), "half a program is none");
    bench.release(&image);
    assert_eq!(autostart(&flash), Ok(0x22));
}

/// Every operation of an update fails once, in each way: the status reports it, or the engine
/// recovers; a program that would start is complete; and the next attempt succeeds.
#[test]
fn a_fault_at_any_operation_costs_no_more_than_another_attempt() {
    let (old, new) = (program(200, 0xA0), program(300, 0xB0));
    let mut installed = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut installed);
    bench.release(&old);
    let cells = installed.cells(CHIP.flash).to_vec();

    /// The first status that is not 0.
    fn update(flash: &mut ModelFlash, new: &[u8]) -> u32 {
        let mut bench = Bench::new(flash);
        let mut status = bench.command(CLEAR);
        for block in block_file(new, 96) {
            if status != 0 {
                return status;
            }
            status = bench.block(&block).1;
        }
        if status == 0 {
            bench.command(SET_SIGNATURE)
        } else {
            status
        }
    }
    let mut failed = 0;
    for operation in 1.. {
        let mut faultless = false;
        for (fault, allowed) in [
            (FlashFault::Failed, [0x0A, 0x10]),
            (FlashFault::Verify, [0x0A, 0x10]),
            (FlashFault::Protected, [0x0E, 0x10]),
        ] {
            let mut flash = ModelFlash::new(&CHIP);
            flash.poke(CHIP.flash.base, &cells);
            flash.fail = Some((operation, fault));
            let status = update(&mut flash, &new);
            faultless = flash.operations < operation;
            if faultless {
                break;
            }
            let what = format!("{fault:?} at operation {operation}");
            match status {
                0 => assert_eq!(autostart(&flash), Ok(0xB0), "{what}"),
                status => {
                    failed += 1;
                    assert!(allowed.contains(&without_sector(status)), "{what}: {status:#x}");
                    assert!(matches!(autostart(&flash), Ok(0xA0) | Err(_)), "{what}");
                }
            }
            flash.fail = None;
            assert_eq!(update(&mut flash, &new), 0, "{what}: the next attempt");
            assert_eq!(autostart(&flash), Ok(0xB0), "{what}");
        }
        if faultless {
            break;
        }
    }
    assert!(failed > 80, "{failed}");
}

/// A store outside the flash replaces the journal.
#[test]
fn parameters_may_be_kept_in_an_eeprom() {
    /// Stores a value after a delay, like a memory that is written byte by byte; fails on demand.
    #[derive(Default)]
    struct Eeprom {
        values: Vec<(Key, Value)>,
        storing: Option<(Key, Value, u32)>,
        fails: bool,
    }

    impl Parameters for &mut Eeprom {
        fn get<F: Flash>(&self, _: &F, key: Key) -> Option<Value> {
            self.values.iter().rev().find(|(of, _)| *of == key).map(|(_, value)| *value)
        }

        fn store(&mut self, key: Key, value: Value) {
            self.storing = Some((key, value, 20));
        }

        fn next<F: Flash>(&mut self, _: &F, _: Result<(), FlashFault>) -> Next<StoreError> {
            match &mut self.storing {
                Some((.., 0)) if self.fails => Next::Done(Err(StoreError::Device)),
                Some((key, value, 0)) => {
                    let stored = (*key, *value);
                    self.values.push(stored);
                    self.storing = None;
                    Next::Done(Ok(()))
                }
                Some((.., ticks)) => {
                    *ticks -= 1;
                    Next::Again
                }
                None => Next::Done(Ok(())),
            }
        }
    }

    let sealed = || leaked(0).1;
    let image = program(200, 0x5E);
    let mut flash = ModelFlash::new(&CHIP);
    let mut eeprom = Eeprom::default();
    let mut buffer = [0; 256];
    let mut device: Downloader<'_, _, 1> =
        Downloader::new(&LAYOUT, &Policy::DEFAULT, &mut eeprom, &flash, &mut buffer, sealed());
    let settle = |device: &mut Downloader<'_, &mut Eeprom, 1>, flash: &mut ModelFlash| {
        for _ in 0..1_000_000 {
            if device.step(flash) == Step::Idle {
                return device.status(1).to_word();
            }
        }
        panic!("the work does not end");
    };
    device.command(1, ProgramControl::Clear).unwrap();
    for block in block_file(&image, 96) {
        device.download_start(&flash, 1, None).unwrap();
        device.download_data(&block).unwrap();
        device.download_end().unwrap();
        assert_eq!(settle(&mut device, &mut flash), 0);
    }
    device.command(1, ProgramControl::SetSignature).unwrap();
    assert_eq!(settle(&mut device, &mut flash), 0);
    let nv = LAYOUT.parameters.map(|region| Region::new(region.base, region.size));
    assert!(
        !flash.touched.iter().any(|at| nv.iter().any(|nv| nv.contains(at.base, 1))),
        "the journal's sectors"
    );
    assert!(verify(&flash, &&mut eeprom, &LAYOUT, CrcKind::Crc32, 1).unwrap().signed);

    eeprom.fails = true;
    let mut device: Downloader<'_, _, 1> =
        Downloader::new(&LAYOUT, &Policy::DEFAULT, &mut eeprom, &flash, &mut buffer, sealed());
    device.command(1, ProgramControl::ClrSignature).unwrap();
    assert_eq!(settle(&mut device, &mut flash), 0x10, "NVDATA");
    assert!(
        verify(&flash, &&mut eeprom, &LAYOUT, CrcKind::Crc32, 1).unwrap().signed,
        "the old value is still there"
    );
}

/// The last block of the older manual (L-1112e_5, chapter 5.1): data size 8, which does not include
/// the 32 reserved bytes before size and CRC, or the 28 that its offsets 28h, 2Ch and 30h leave. Also with a
/// size that includes them.
#[test]
fn the_last_block_of_2008_is_taken() {
    let image = program(1000, 0x22);
    for (reserved, size) in [(32, 8_u32), (32, 40), (28, 8), (28, 36)] {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::cleared(&mut flash);
        let mut file = block_file(&image, 96);
        file.pop();
        bench.all_good(file);
        let mut last = [u32::MAX, 0, size].map(u32::to_le_bytes).concat();
        last.extend(vec![0xEE; reserved]);
        assert!(reserved == 32 || last.len() == 0x28);
        last.extend(1000_u32.to_le_bytes());
        last.extend(crc32(&image).to_le_bytes());
        last.extend(crc32(&last).to_le_bytes());
        // A truncated one is not a block.
        let (refused, status) = bench.block(&last[..last.len() - 1]);
        assert_eq!((refused, status), (Err(AbortCode::LENGTH), 0x04), "{reserved}, size {size}");
        bench.good(&last);
        assert_eq!(bench.word(IDENTIFICATION), crc32(&image), "size {size}");
        assert_eq!(bench.command(SET_SIGNATURE), 0);
        assert_eq!(autostart(&flash), Ok(0x22));
    }
}
