//! The limits of a block and of a stream, and what is seen of them beside other work.

use boot_core::flash::FlashFault;
use canopen::od::Address;
use canopen::AbortCode;
use kit::bench::{CLEAR, CLR_SIGNATURE, SET_SIGNATURE};
use kit::rig::{block, blocks, crc32, raw, words, Rig, Setup, STANDARD_1, STANDARD_2};

use super::objects::{BUSY, MAN_BUSY};

/// SYS TEC manual, table 3, shifted by the bit for busy: FORMAT, ADDRESS and SEQUENCE.
const FORMAT: u32 = 0x04;
const ADDRESS: u32 = 0x0C;
const SEQUENCE: u32 = 0x88;
const LENGTH: AbortCode = AbortCode(0x0607_0010);
const LENGTH_TOO_HIGH: AbortCode = AbortCode(0x0607_0012);

/// A device after CLEAR and a control block, with this buffer.
fn open(setup: &'static Setup, buffer: usize) -> Rig {
    let mut rig = Rig::new(setup, buffer);
    rig.clear(1);
    rig.send(1, &block(0, 0, &[0; 8])).unwrap();
    rig.settle();
    rig
}

/// The buffer is the limit: for the size that is announced, for the size in the header, and for what
/// comes without either.
#[test]
fn a_block_is_as_large_as_the_buffer_and_no_larger() {
    let base = STANDARD_1.region(1).base;
    let block = |size: usize| block(1, base, &raw(&STANDARD_1, 1, size));
    for (buffer, largest) in [(1024, 1024), (16 * 1024, 16_384), (64 * 1024, 16_384)] {
        let largest = largest - 16;
        // The program has less flash than the largest block.
        let fits = largest <= STANDARD_1.region(1).size as usize;
        for announced in [true, false] {
            let mut rig = open(&STANDARD_1, buffer);
            let size = |bytes: &[u8]| announced.then_some(bytes.len() as u32);
            let (good, large) = (block(largest), block(largest + 1));
            // So few bytes that the header is not complete, and so many that it is.
            rig.begin(1, size(&good), &good[..8]).unwrap();
            rig.cancel(1);
            let first = rig.begin(1, size(&large), &large[..8]);
            assert_eq!(first, if announced { Err(LENGTH_TOO_HIGH) } else { Ok(()) }, "{buffer}");
            rig.cancel(1);
            assert_eq!(rig.begin(1, size(&large), &large[..12]), Err(LENGTH_TOO_HIGH), "{buffer}");
            // What the header does not announce.
            let mut hidden = block(largest + 2);
            hidden[8..12].copy_from_slice(&4_u32.to_le_bytes());
            rig.begin(1, None, &hidden[..largest + 16]).unwrap();
            rig.cancel(1);
            assert_eq!(rig.begin(1, None, &hidden[..largest + 17]), Err(LENGTH_TOO_HIGH), "{buffer}");
            if fits {
                assert_eq!(rig.begin(1, size(&good), &good), Ok(()), "{buffer}");
            }
        }
    }
}

/// No flash has 65536 blocks: a larger number begins something else.
#[test]
fn the_first_number_tells_a_block() {
    let base = STANDARD_1.region(1).base;
    for (number, status) in [(0xFFFF, SEQUENCE), (0x1_0000, FORMAT)] {
        let mut rig = Rig::new(&STANDARD_1, 1024);
        rig.clear(1);
        assert!(rig.send(1, &block(number, base, &[0; 64])).is_err());
        assert_eq!(rig.status(1), status, "{number:X}");
    }
}

/// The last block of the manual of 2008 has 32 bytes more than its header says, and no other has.
#[test]
fn only_the_last_block_may_be_longer_than_it_says() {
    let region = STANDARD_1.region(1);
    let image = raw(&STANDARD_1, 1, 64);
    let old = |number: u32, address: u32, data: &[u8; 40], reported: u32| {
        let mut bytes = words(&[number, address, reported]);
        bytes.extend(data);
        bytes.extend(crc32(&bytes).to_le_bytes());
        bytes
    };
    let mut last = [0; 40];
    last[32..36].copy_from_slice(&64_u32.to_le_bytes());
    last[36..].copy_from_slice(&crc32(&image).to_le_bytes());
    for (number, reported, good) in [(u32::MAX, 8, true), (u32::MAX, 9, false), (2, 8, false)] {
        let mut rig = open(&STANDARD_1, 1024);
        rig.send_all(1, [&block(1, region.base, &image)]);
        let sent = rig.send(1, &old(number, region.base + 64, &last, reported));
        assert_eq!(sent, if good { Ok(()) } else { Err(LENGTH) }, "{number:X}, {reported}");
        rig.settle();
        assert_eq!(rig.state(1), if good { 0 } else { 3 });
    }
}

/// The two first vectors are the least that can be started, and less is no program.
#[test]
fn a_program_is_its_first_two_vectors_at_least() {
    let region = STANDARD_1.region(1);
    for (size, status) in [(7, FORMAT), (8, 0)] {
        let image = raw(&STANDARD_1, 1, 8);
        let mut rig = open(&STANDARD_1, 1024);
        rig.send_all(1, [&block(1, region.base, &image)]);
        let last = block(u32::MAX, 0, &words(&[size, crc32(&image[..size as usize])]));
        assert_eq!(rig.send(1, &last).is_ok(), status == 0, "{size}");
        rig.settle();
        assert_eq!(rig.status(1), status, "{size}");
    }
}

/// Intel HEX with segments reaches 64 KiB from the base of the segment. What lies below is at a place
/// that is no program's; what goes beyond is not Intel HEX.
#[test]
fn a_record_stays_in_its_segment() {
    let segment = kit::ihex::record(0, 2, &[0x10, 0x00]);
    for (offset, status) in [(0x2000, ADDRESS), (0xFFF0, ADDRESS), (0xFFF1, FORMAT)] {
        let mut rig = Rig::new(&STANDARD_1, 4096);
        rig.clear(1);
        let text = format!("{segment}\n{}\n", kit::ihex::record(offset, 0, &[0; 16]));
        assert!(rig.send(1, text.as_bytes()).is_err());
        rig.settle();
        assert_eq!(rig.status(1), status, "{offset:X}");
    }
}

/// A raw image with a size: all its flash is erased while it comes, not only what it has reached.
#[test]
fn a_size_that_is_told_is_erased_ahead() {
    let image = raw(&STANDARD_1, 1, 0x3000);
    for reported in [true, false] {
        let mut rig = Rig::new(&STANDARD_1, 8 * 1024);
        rig.install(1, &image);
        rig.clear(1);
        let next = raw(&STANDARD_1, 1, 0x2800);
        rig.begin(1, reported.then_some(next.len() as u32), &next[..1600]).unwrap();
        rig.settle();
        assert_eq!(
            rig.cells(1)[0x2000..0x2800].iter().all(|byte| *byte == 0xFF),
            reported,
            "told: {reported}"
        );
    }
}

/// CLEAR of the program that is being downloaded begins it anew, at any time; the other one waits.
#[test]
fn clear_ends_the_download_of_its_own_program() {
    let image = raw(&STANDARD_2, 1, 600);
    let mut rig = open(&STANDARD_2, 1024);
    rig.send(1, &block(1, STANDARD_2.region(1).base, &image)).unwrap();
    assert_eq!(rig.status(1) & BUSY, BUSY);
    assert_eq!(rig.command(2, CLEAR), Err(MAN_BUSY));
    assert_eq!(rig.command(1, CLEAR), Ok(()));
    rig.settle();
    rig.install(1, &image);
}

/// A command for one program fails beside an open block of the other one, which goes on.
#[test]
fn a_block_goes_on_beside_a_command_that_fails() {
    let mut rig = Rig::new(&STANDARD_2, 4096);
    let (one, two) = (raw(&STANDARD_2, 1, 600), raw(&STANDARD_2, 2, 600));
    rig.install(2, &two);
    rig.work(2, CLR_SIGNATURE);
    rig.clear(1);
    for block in blocks(STANDARD_2.region(1).base, &one) {
        rig.begin(1, None, &block[..10]).unwrap();
        let next = rig.chip.model().operations + 1;
        rig.chip.model().fail = Some((next, FlashFault::Protected));
        rig.work(2, SET_SIGNATURE);
        assert_eq!(rig.status(2), 0x10, "NVDATA");
        let at = Address::new(0x1F50, 1);
        assert_eq!(rig.node.download_data(at, &block[10..]), Ok(()));
        assert_eq!(rig.node.download_end(at), Ok(()));
        rig.settle();
    }
    assert_eq!((rig.state(1), rig.identification(1)), (0, crc32(&one)));
}

/// An emergency reports work that has ended: a block that is refused has its answer.
#[test]
fn a_refused_block_is_no_emergency() {
    let mut rig = open(&STANDARD_1, 1024);
    let base = STANDARD_1.region(1).base;
    assert!(rig.send(1, &block(7, base + 0x400, &[0; 64])).is_err());
    rig.settle();
    assert_eq!((rig.status(1), rig.node.next_emergency()), (SEQUENCE, None));
}

/// A release that is stored does not end the download that has begun, and has changed nothing yet.
#[test]
fn a_release_beside_an_open_download_leaves_it_open() {
    let (old, new) = (raw(&STANDARD_1, 1, 600), raw(&STANDARD_1, 1, 900));
    let mut rig = Rig::new(&STANDARD_1, 4096);
    rig.install(1, &old);
    rig.work(1, CLR_SIGNATURE);
    rig.clear(1);
    rig.send(1, &block(0, 0, &[0; 8])).unwrap();
    rig.work(1, SET_SIGNATURE);
    assert_eq!(rig.stored().records[0].map(|record| record.2), Some(true), "it is released");
    rig.send_all(1, &blocks(STANDARD_1.region(1).base, &new)[1..]);
    assert_eq!((rig.status(1), rig.identification(1)), (0, crc32(&new)));
}

/// One piece of a stream may begin the program and be refused: then nothing waits for the flash.
#[test]
fn a_stream_that_is_refused_as_it_begins_leaves_nothing() {
    let image = raw(&STANDARD_1, 1, 600);
    let text = kit::ihex::intel_hex(STANDARD_1.region(1).base, &image);
    let mut rig = Rig::new(&STANDARD_1, 1024);
    rig.clear(1);
    let at = Address::new(0x1F50, 1);
    rig.node.download_start(at, None).unwrap();
    // More than a piece of 128 bytes, and after it no record.
    let bad = format!("{}\n:X", text.lines().take(12).collect::<Vec<_>>().join("\n"));
    assert!(rig.node.download_data(at, bad.as_bytes()).is_err());
    rig.cancel(1);
    rig.settle();
    assert_eq!(rig.status(1), FORMAT);
    rig.install(1, &image);
}

/// A record waits beside the piece that it belongs to in half of the buffer.
#[test]
fn a_record_fits_into_half_of_the_buffer() {
    let image = raw(&STANDARD_1, 1, 640);
    let base = STANDARD_1.region(1).base;
    // Half of it is a record of 16 bytes and 4 headers of 8, exactly, or a byte less.
    for (buffer, fits) in [(96, true), (95, false)] {
        let mut rig = Rig::new(&STANDARD_1, buffer);
        rig.clear(1);
        let sent = rig.send(1, kit::ihex::intel_hex(base, &image).as_bytes());
        assert_eq!(sent.is_ok(), fits, "{buffer}: {sent:?}");
        rig.settle();
        assert_eq!(rig.state(1) == 0, fits, "{buffer}");
    }
}

/// While the flash erases, a quarter of the buffer is kept for answers that are held back.
#[test]
fn a_quarter_of_the_buffer_is_for_held_answers() {
    let mut rig = Rig::new(&STANDARD_1, 1024);
    rig.clear(1);
    rig.begin(1, None, &raw(&STANDARD_1, 1, 600)[..7]).unwrap();
    let at = Address::new(0x1F50, 1);
    let (free, held) = (rig.node.download_space(at, false), rig.node.download_space(at, true));
    // The open piece has a header of 8 bytes; another one, and its end, may follow.
    assert_eq!((free, held), (1024 - 8 - 7 - 2 * 8 - 256, 1024 - 8 - 7 - 2 * 8));
}
