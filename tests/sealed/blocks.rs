//! A sealed image in a block file, block by block, for masters that only support block files: the
//! blocks that the sealed device accepts and refuses, and that the old program stays.

use std::sync::Arc;

use canopen::program::ProgramControl;
use canopen::{Address, BitRate};
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::fleet::Fleet;
use coboot_tests::sealed_board::{board_with_a_program, keys, seal, sealer, status, COUNTER, KEKS};
use coflash_core::device::Doing;
use coflash_core::file::block_file::BlockFile;
use coflash_core::file::convert::blocks_of_sealed;
use coflash_core::file::sealed::{SealedFile, Sealer};
use coflash_core::update::event::{Note, Phase};
use coflash_core::update::{flash, Event, FlashOptions};
use coflash_core::Error;
use shared_abi::block_file::Header;

const DATA: Address = Address::new(0x1F50, 1);
const STATUS: Address = Address::new(0x1F57, 1);
const CRC_OF_PROGRAM: Address = Address::new(0x1F56, 1);
const VERSION: Address = Address::new(0x100A, 0);

/// Its blocks, each as one download.
fn blocks(file: &[u8], size: usize) -> Vec<Vec<u8>> {
    let file = SealedFile::parse(file.to_vec()).expect("it is one");
    let start = firmware::board().programs[0].base;
    let blocks = blocks_of_sealed(&file, start, size).expect("it can be cut");
    blocks.blocks().iter().map(|block| block.emit_with(blocks.checksum())).collect()
}

/// Sends a block, and waits until the device is not busy; returns 1F57h.
fn send(bench: &mut Bench, block: &[u8]) -> u32 {
    let mut session = bench.session();
    match session.write(DATA, block, Doing::Program, &mut |_| {}) {
        Ok(()) | Err(Error::Refused { .. }) => {}
        Err(error) => panic!("{error}"),
    }
    session.await_idle(1, Doing::Read(STATUS)).expect("1F57h is answered").to_word()
}

fn clear(bench: &mut Bench) {
    let mut session = bench.session();
    session.command(1, ProgramControl::Clear).expect("CLEAR is answered");
    session.await_idle(1, Doing::Command(ProgramControl::Clear)).expect("1F57h is answered");
}

/// Sends all blocks; returns the first status that is not OK.
fn send_all(bench: &mut Bench, blocks: &[Vec<u8>]) -> u32 {
    clear(bench);
    blocks.iter().map(|block| send(bench, block)).find(|word| *word != status::OK).unwrap_or(status::OK)
}

fn cut_power(bench: &mut Bench) {
    bench.power_cycle();
    bench.await_boot_up(1000);
}

fn assert_runs(bench: &mut Bench, version: &str, what: &str) {
    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.await_boot_up(1000);
    bench.run_ms(50);
    assert!(!bench.is_bootloader(NODE), "{what}: it does not start");
    assert_eq!(bench.text(0x100A), version, "{what}");
    bench.session().command(1, ProgramControl::Stop).unwrap();
    bench.run_ms(100);
    assert!(bench.is_bootloader(NODE), "{what}");
}

#[test]
fn sealed_images_in_blocks_are_installed() {
    let mut bench = board_with_a_program();
    let everything = Sealer { encrypt_for: &*KEKS, compress: true, ..sealer(COUNTER) };
    let versions = [(firmware::APP_V2, "2.0.0"), (firmware::APP_V1, "1.0.0")];
    for (sealer, size) in [(sealer(COUNTER), 4096), (everything.clone(), 1024), (everything, 100)] {
        for (image, version) in versions {
            let blocks = blocks(&seal(&sealer, image), size);
            assert_eq!(send_all(&mut bench, &blocks), status::OK, "{version} in blocks of {size}");
            let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&firmware::raw(image));
            assert_eq!(bench.session().read_number(CRC_OF_PROGRAM).unwrap(), crc);
            assert_runs(&mut bench, version, version);
        }
    }
    bench.assert_nothing_unmodelled();
}

/// By the host tool.
#[test]
fn coflash_sends_a_sealed_image_in_blocks() {
    let mut bench = board_with_a_program();
    let file = SealedFile::parse(seal(&sealer(COUNTER), firmware::APP_V2)).unwrap();
    let options = FlashOptions::default().blocks(Some(512));
    flash(&mut bench.session(), &file, &options, &mut |_| {}).unwrap();
    assert_eq!(bench.text(0x100A), "2.0.0");
    bench.assert_nothing_unmodelled();
}

/// Before the first authentic chunk nothing is lost, whatever is wrong with the blocks.
#[test]
fn what_is_not_authentic_costs_nothing() {
    type Spoil = fn(&mut Vec<Vec<u8>>);
    /// A block with other data and a matching CRC.
    fn with_data(block: &[u8], change: impl Fn(&mut [u8])) -> Vec<u8> {
        let mut block = block.to_vec();
        let end = block.len() - 4;
        change(&mut block[12..end]);
        let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&block[..end]);
        block[end..].copy_from_slice(&crc.to_le_bytes());
        block
    }
    let mut bench = board_with_a_program();
    let program = firmware::program_offset();
    let genuine = blocks(&seal(&sealer(COUNTER), firmware::APP_V2), 128);
    let cases: [(&str, Spoil, u32); 6] = [
        (
            "a flipped bit in the manifest",
            |all| all[1] = with_data(&all[1], |data| data[50] ^= 1),
            status::SIGNATURE,
        ),
        ("a flipped bit, and the block's CRC tells", |all| all[1][50] ^= 1, status::CRC),
        ("no sealed image", |all| all[1] = with_data(&all[1], |data| data[0] ^= 1), status::NO_ACCESS),
        ("a block is left out", |all| drop(all.remove(2)), status::SEQUENCE),
        (
            "block 0 of another version in the middle",
            |all| all.insert(2, with_data(&all[0], |data| data[12] ^= 1)),
            status::SEQUENCE,
        ),
        ("the end comes too early", |all| drop(all.drain(2..all.len() - 1)), status::FORMAT),
    ];
    for (what, spoil, expected) in cases {
        let mut blocks = genuine.clone();
        spoil(&mut blocks);
        let before = bench.machine().flash()[program..].to_vec();
        assert_eq!(send_all(&mut bench, &blocks), expected, "{what}");
        assert!(bench.machine().flash()[program..] == before[..], "{what}: the flash is another");
        // After a bad signature the device stays in its bootloader for half a minute.
        bench.run_ms(33_000);
        assert_runs(&mut bench, "1.0.0", what);
    }
    let unsealed = firmware::blocks(firmware::APP_V2);
    let unsealed = BlockFile::of(&unsealed);
    let unsealed: Vec<_> =
        unsealed.blocks().iter().map(|block| block.emit_with(unsealed.checksum())).collect();
    assert_eq!(send_all(&mut bench, &unsealed), status::NO_ACCESS);
    assert_runs(&mut bench, "1.0.0", "an unsealed block file");
    assert_eq!(send_all(&mut bench, &genuine), status::OK);
    assert_runs(&mut bench, "2.0.0", "and the genuine one");
    bench.assert_nothing_unmodelled();
}

/// Between two blocks there are others: a repeated block, a damaged one, a sealed image in one
/// download, a reset. The download continues, or begins again after CLEAR, and no other program is
/// started.
#[test]
fn blocks_among_other_work() {
    let mut bench = board_with_a_program();
    let file = seal(&sealer(COUNTER), firmware::APP_V2);
    let blocks = blocks(&file, 512);
    clear(&mut bench);
    for (at, block) in blocks.iter().enumerate() {
        if at == 6 {
            let mut damaged = block.clone();
            damaged[100] ^= 8;
            assert_eq!(send(&mut bench, &damaged), status::CRC);
            assert_eq!(send(&mut bench, &blocks[4]), status::SEQUENCE, "that one is there");
            // A second client with the same image in one transfer.
            assert_ne!(send(&mut bench, &file), status::OK);
        }
        assert_eq!(send(&mut bench, block), status::OK, "block {at}");
    }
    assert_runs(&mut bench, "2.0.0", "the download went on");
    // Aborted by CLEAR, and by a power cut.
    for (power, image, version) in [(false, firmware::APP_V1, "1.0.0"), (true, firmware::APP_V2, "2.0.0")] {
        let blocks = self::blocks(&seal(&sealer(COUNTER), image), 512);
        clear(&mut bench);
        // After the first chunk.
        for block in &blocks[..14] {
            assert_eq!(send(&mut bench, block), status::OK);
        }
        if power {
            cut_power(&mut bench);
            bench.run_ms(500);
            assert!(bench.is_bootloader(NODE), "half a program does not start");
        }
        assert_eq!(send_all(&mut bench, &blocks), status::OK, "power cut: {power}");
        assert_runs(&mut bench, version, "begun anew");
    }
    bench.assert_nothing_unmodelled();
}

/// What the device reports of a begun download (2006h): the CRC of block 0, and the address.
fn begun(bench: &mut Bench) -> (u32, u32) {
    let value = bench.session().read(Address::new(0x2006, 1)).expect("2006h is answered");
    let word = |at: usize| u32::from_le_bytes(value[at..at + 4].try_into().unwrap());
    (word(0), word(4))
}

/// The bus is lost, or the host: the device keeps what it has processed, and takes each byte once.
#[test]
fn a_client_that_comes_back_goes_on_with_the_next_block() {
    const SIZE: usize = 512;
    let mut bench = board_with_a_program();
    let all = Sealer { encrypt_for: &*KEKS, compress: true, ..sealer(COUNTER) };
    let blocks = self::blocks(&seal(&all, firmware::APP_V2), SIZE);
    // Of another length: block 0 contains the length, and nothing else of the file.
    let plain = Sealer { compress: false, ..all };
    let others = self::blocks(&seal(&plain, firmware::APP_V1), SIZE);
    assert_ne!(blocks[0], others[0]);
    let control_crc = u32::from_le_bytes(*blocks[0].last_chunk().unwrap());
    assert_eq!(begun(&mut bench), (0, 0));
    clear(&mut bench);
    for (at, block) in blocks.iter().enumerate() {
        if at % 7 == 6 {
            let before = Header::parse(blocks[at - 1].first_chunk().unwrap());
            let end = before.flash_address + before.size;
            assert_eq!(begun(&mut bench), (control_crc, end), "before block {at}");
            assert_eq!(send(&mut bench, &others[0]), status::SEQUENCE, "the blocks of another file");
            assert_eq!(begun(&mut bench).0, 0, "nothing goes on after a refusal");
            assert_eq!(send(&mut bench, &blocks[0]), status::SEQUENCE, "so it does not begin again");
            assert_eq!(send(&mut bench, &blocks[at - 1]), status::OK, "the last block once more");
            assert_eq!(send(&mut bench, &blocks[0]), status::OK, "the same file again");
            assert_eq!(begun(&mut bench), (control_crc, end));
            // The client is not sure where it was.
            assert_eq!(send(&mut bench, &blocks[at - 3]), status::OK, "it is there");
            assert_eq!(send(&mut bench, &blocks[at - 1]), status::OK, "it is there, too");
            if at + 2 < blocks.len() {
                assert_eq!(send(&mut bench, &blocks[at + 1]), status::SEQUENCE, "one is missing before it");
            }
        }
        assert_eq!(send(&mut bench, block), status::OK, "block {at} of {}", blocks.len());
    }
    assert_eq!(begun(&mut bench), (0, 0));
    assert_runs(&mut bench, "2.0.0", "with each byte once");
    // What was found authentic is known no more after a power cut.
    clear(&mut bench);
    for block in &others[..14] {
        assert_eq!(send(&mut bench, block), status::OK);
    }
    assert_ne!(begun(&mut bench), (0, 0));
    cut_power(&mut bench);
    assert_eq!(begun(&mut bench).0, 0);
    assert_eq!(send_all(&mut bench, &others), status::OK);
    assert_runs(&mut bench, "1.0.0", "begun anew");
    bench.assert_nothing_unmodelled();
}

/// By the host tool: a second call sends what the first one has left.
#[test]
fn coflash_goes_on_with_a_sealed_image_in_blocks() {
    let mut bench = board_with_a_program();
    let file = seal(&sealer(COUNTER), firmware::APP_V2);
    let blocks = self::blocks(&file, 512);
    clear(&mut bench);
    for block in &blocks[..20] {
        assert_eq!(send(&mut bench, block), status::OK);
    }
    let file = SealedFile::parse(file).unwrap();
    let options = FlashOptions::default().blocks(Some(512));
    let mut went_on_with = None;
    flash(&mut bench.session(), &file, &options, &mut |event| {
        if let Event::Phase(Phase::GoingOn { done, .. }) = event {
            went_on_with = Some(done);
        }
    })
    .unwrap();
    assert_eq!(went_on_with, Some(19 * (512 - 16)));
    assert_eq!(bench.text(0x100A), "2.0.0");
}

/// Eight devices on one bus get an image in one download for all.
#[test]
fn eight_sealed_devices_get_an_image_together() {
    let mut fleet = Fleet::of_image(firmware::BOOTLOADER_SEALED, 8, BitRate::K1000);
    let boards = fleet.bench.boards();
    for board in boards {
        let machine = fleet.bench.world.machine_mut(board);
        machine.load_bin(firmware::board().key_block().base, &keys()).unwrap();
        machine.reset_pin();
    }
    fleet.bench.run_ms(50);
    for (image, version) in [(firmware::APP_V1, "1.0.0"), (firmware::APP_V2, "2.0.0")] {
        let file = Arc::new(SealedFile::parse(seal(&sealer(COUNTER), image)).unwrap());
        let update = fleet.update_sealed(8, &file);
        assert_eq!(update.done(), 8, "{:?}", update.results);
        for number in 0..8 {
            let together = |(of, event): &(usize, Event)| {
                *of == number && matches!(event, Event::Note(Note::Together { devices: 8 }))
            };
            assert!(update.events.iter().any(together), "device {number}");
            let node = number as u8 + 1;
            assert_eq!(fleet.bench.session_with(node).read_text(VERSION).unwrap(), version, "node {node}");
        }
    }
    fleet.bench.assert_nothing_unmodelled();
}
