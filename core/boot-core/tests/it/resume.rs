//! A download of block files that was cut off goes on where it stopped, and a block may come twice.

use boot_core::bootloader::{Bootloader, Choices, Config, Everything, Extras};
use boot_core::control::Step;
use boot_core::crc::CrcKind;
use boot_core::program::verify;
use boot_core::store::Journal;
use canopen::od::{Address, Objects};
use canopen::AbortCode;
use kit::bench::{self, block, block_file, last, program, Bench, CLEAR, CONFIG, DATA, LAYOUT, PROGRAM};
use kit::boot::{leaked, Boot};
use kit::model::{until_power_cut, Cut, ModelFlash, CHIP};
use kit::rig::{self, Rig, LIFT_1, LIFT_2, PAULUS_2, STANDARD_1, STANDARD_2};
use shared_abi::geometry::{Geometry, Region, SectorRun};
use shared_abi::layout::Layout;

/// 2006h/1.
const PARTIAL: Address = Address::new(0x2006, 1);
/// Data of a block: sixteen of them are the step in which progress is stored.
const CHUNK: usize = 64;

/// A block file with an identity.
fn named(image: &[u8]) -> Vec<Vec<u8>> {
    let mut file = block_file(image, CHUNK);
    // Reserved word with the size, vendor-ID, product code (manual L-1112d_10, figure 11).
    let words: Vec<u8> = [image.len() as u32, 0, 0].into_iter().flat_map(u32::to_le_bytes).collect();
    file[0] = block(0, 0, &words);
    file
}

/// What the device reports of a begun download: the CRC of block 0, and the address.
fn partial(bench: &mut Bench<'_>) -> (u32, u32) {
    let mut bytes = [0; 8];
    assert_eq!(bench.node.read(PARTIAL, &mut bytes), Ok(8));
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    (word(0), word(4))
}

/// The CRC that ends a block.
fn crc_of(block: &[u8]) -> u32 {
    u32::from_le_bytes(block[block.len() - 4..].try_into().unwrap())
}

/// What a host does that goes on if the device can; returns the number of data blocks that it sent.
fn send(flash: &mut ModelFlash, file: &[Vec<u8>]) -> usize {
    let (sent, status) = try_send(flash, file);
    assert_eq!(status, 0);
    sent
}

/// The same, with the status at the end.
fn try_send(flash: &mut ModelFlash, file: &[Vec<u8>]) -> (usize, u32) {
    let mut bench = Bench::new(flash);
    let (id, end) = partial(&mut bench);
    let goes_on = id == crc_of(&file[0]);
    let done = if goes_on { (end - PROGRAM.base) as usize / CHUNK } else { 0 };
    if !goes_on {
        assert_eq!(bench.command(CLEAR), 0);
    }
    bench.good(&file[0]);
    let data = &file[1 + done..file.len() - 1];
    bench.all_good(data);
    let (outcome, status) = bench.block(&file[file.len() - 1]);
    assert_eq!(outcome, Ok(()));
    (data.len(), status)
}

fn is_installed(flash: &ModelFlash, image: &[u8]) -> bool {
    let journal = Journal::open(flash, LAYOUT.parameters);
    verify(flash, &journal, &LAYOUT, CrcKind::Crc32, 1).is_ok()
        && flash.cells(PROGRAM)[..image.len()] == *image
}

#[test]
fn a_cut_download_goes_on_after_a_cut_at_any_operation() {
    // From the middle of a sector to the middle of another one.
    let (old, new) = (program(0x1200, 0x11), program(0x1A40, 0x22));
    let file = named(&new);
    let blocks = file.len() - 2;
    let mut installed = ModelFlash::new(&CHIP);
    send(&mut installed, &named(&old));
    installed.power_on();
    let operations = {
        let mut flash = installed.clone();
        assert_eq!(send(&mut flash, &file), blocks);
        flash.operations
    };
    let mut went_on = 0;
    for operation in 1..=operations {
        for cut in [Cut::Before, Cut::After, Cut::Torn(3), Cut::Torn(4), Cut::Unstable(5), Cut::Unstable(6)] {
            let mut flash = installed.clone();
            flash.cut = Some((operation, cut));
            let mut sent = 0;
            assert!(until_power_cut(|| {
                sent = send(&mut flash, &file);
            }));
            flash.power_on();
            if is_installed(&flash, &old) || is_installed(&flash, &new) {
                continue;
            }
            let again = send(&mut flash, &file);
            went_on += u32::from(again < blocks);
            let what = format!("{cut:?} at operation {operation} of {operations}");
            assert!(is_installed(&flash, &new), "{what}");
            assert!(
                flash.is_stable(Region::new(PROGRAM.base, new.len() as u32)),
                "{what}: bits between 0 and 1 are left"
            );
        }
    }
    assert!(went_on > 6 * operations / 2, "only {went_on} of {} went on", 6 * operations);
}

/// The bus is lost, or the host: the device keeps all that it has.
#[test]
fn a_host_that_comes_back_goes_on_with_the_next_block() {
    let image = program(0xC00, 0x33);
    let file = named(&image);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    assert_eq!(partial(&mut bench), (0, 0));
    bench.all_good(&file[..6]);
    let end = PROGRAM.base + 5 * CHUNK as u32;
    assert_eq!(partial(&mut bench), (crc_of(&file[0]), end));
    bench.good(&file[0]);
    assert_eq!(partial(&mut bench), (crc_of(&file[0]), end), "the same file goes on");
    // A block that does not join the data.
    assert_eq!(bench.transfer(&file[7]), Err(AbortCode::DEVICE_STATE));
    bench.all_good(&file[6..]);
    assert!(is_installed(&flash, &image));
    assert_eq!(partial(&mut Bench::new(&mut flash)), (0, 0), "nothing is left to go on with");
}

/// Whoever comes after it, as a bootloader with resumption, finds no download to go on with.
#[test]
fn a_product_without_resumption_leaves_no_begun_download() {
    struct Without;
    impl Choices for Without {
        const EXTRAS: Extras = Extras { resume: false, ..Everything::EXTRAS };
    }
    let file = named(&program(0xC00, 0x33));
    let mut flash = ModelFlash::new(&CHIP);
    let journal = Journal::open(&flash, LAYOUT.parameters);
    let (buffer, sealed) = leaked(256);
    let mut node: Bootloader<'_, _, _, 1, Without> =
        Boot::new(&CONFIG, bench::node()).with(journal, &mut flash, buffer, sealed);
    for block in &file[..20] {
        node.download_start(DATA, Some(block.len() as u32)).unwrap();
        node.download_data(DATA, block).unwrap();
        node.download_end(DATA).unwrap();
        while node.step() != Step::Idle {}
    }
    assert_eq!(partial(&mut Bench::new(&mut flash)).0, 0);
    // The same with resumption, so that the zero means something.
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    bench.all_good(&file[..20]);
    assert_eq!(partial(&mut Bench::new(&mut flash)).0, crc_of(&file[0]));
}

/// A host that knows nothing of this sends everything again, with CLEAR or without.
#[test]
fn a_host_that_begins_again_gets_through() {
    let image = program(0xC00, 0x33);
    let file = named(&image);
    for clear in [false, true] {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::new(&mut flash);
        bench.all_good(&file[..20]);
        let mut bench = Bench::new(&mut flash);
        assert_ne!(partial(&mut bench).0, 0);
        if clear {
            assert_eq!(bench.command(CLEAR), 0);
        }
        bench.all_good(&file);
        assert!(is_installed(&flash, &image), "clear: {clear}");
    }
}

/// Another program never continues the data of the first one, and a program that only says it is
/// the same is found by the flash or by its CRC.
#[test]
fn other_data_do_not_become_a_program() {
    let image = program(0xC00, 0x33);
    let file = named(&image);
    let mut cut_off = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut cut_off);
    bench.all_good(&file[..30]);

    // The same control block; a byte differs in data that are already there.
    let mut other = image.clone();
    other[600] ^= 0x10;
    let file_of_other = named(&other);
    assert_eq!(file_of_other[0], file[0]);
    let mut flash = cut_off.clone();
    let mut bench = Bench::new(&mut flash);
    let done = (partial(&mut bench).1 - PROGRAM.base) as usize / CHUNK;
    assert!(done >= 10, "the byte is there");
    bench.good(&file_of_other[0]);
    bench.all_good(&file_of_other[1 + done..file.len() - 1]);
    assert_eq!(bench.block(&last(&other)).1, 0x02, "NOVALPROG: the CRC over all decides");
    assert!(!is_installed(&flash, &other) && !is_installed(&flash, &image));

    // The device's half program was changed by a fault.
    let mut flash = cut_off.clone();
    flash.poke(PROGRAM.base + 300, &[0]);
    assert_eq!(try_send(&mut flash, &file).1, 0x02, "NOVALPROG");
    assert!(!is_installed(&flash, &image));
    // CLEAR, and everything anew.
    flash.power_on();
    let mut bench = Bench::cleared(&mut flash);
    bench.all_good(&file);
    assert!(is_installed(&flash, &image));
}

/// Two files that are sent into each other, without CLEAR between them, are a download that cannot
/// go on: neither file is named for data of the other one, before a cut or after it.
#[test]
fn a_download_of_two_files_does_not_go_on() {
    let (image, other) = (program(0xC00, 0x33), program(0x1240, 0x44));
    let (file, control_of_other) = (named(&image), named(&other).swap_remove(0));
    // How many data blocks of the first file have come when the second one begins: none, fewer and
    // more than the device stores its progress after.
    for sent in [0, 4, 24] {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::new(&mut flash);
        bench.all_good(&file[..=sent]);
        assert_eq!(partial(&mut bench).0, crc_of(&file[0]));
        bench.good(&control_of_other);
        assert_eq!(partial(&mut bench).0, 0, "{sent} blocks");
        // The flash takes nothing where there are data, and everything after them.
        for (number, data) in (1..).zip(other.chunks(CHUNK).skip(sent)) {
            let address = PROGRAM.base + (sent * CHUNK) as u32 + (number - 1) * CHUNK as u32;
            bench.good(&block(number, address, data));
            assert_eq!(partial(&mut bench).0, 0, "{sent} blocks");
        }
        assert_eq!(partial(&mut Bench::new(&mut flash)).0, 0, "{sent} blocks");
        send(&mut flash, &file);
        assert!(is_installed(&flash, &image));
    }
}

/// Before the first data, the installed program stays: two files cost it no more than one.
#[test]
fn two_files_without_data_cost_nothing() {
    let (old, image, other) = (program(0xC00, 0x11), program(0xC00, 0x33), program(0x1240, 0x44));
    let mut flash = ModelFlash::new(&CHIP);
    send(&mut flash, &named(&old));
    let mut bench = Bench::new(&mut flash);
    assert_eq!(partial(&mut bench), (0, 0));
    assert_eq!(bench.command(CLEAR), 0);
    for file in [&image, &other, &image] {
        bench.good(&named(file)[0]);
    }
    assert!(is_installed(&flash, &old));
    send(&mut flash, &named(&image));
    assert!(is_installed(&flash, &image));
}

/// Progress is stored with each KiB of a short program, and a program that is one is no progress.
#[test]
fn progress_is_stored_each_kib_and_ends_with_the_program() {
    let image = program(0xC00, 0x33);
    let file = named(&image);
    let end = file.len() - 1;
    for sent in 0..=end {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::new(&mut flash);
        bench.all_good(&file[..=sent]);
        let reported = partial(&mut bench);
        let stored = partial(&mut Bench::new(&mut flash));
        if sent == 0 || sent == end {
            assert_eq!(stored, (0, 0), "{sent} blocks");
        } else {
            let kibs = sent * CHUNK / 1024 * 1024;
            assert_eq!(stored, (crc_of(&file[0]), PROGRAM.base + kibs as u32), "{sent} blocks");
        }
        assert_eq!(reported == (0, 0), sent == end, "{sent} blocks");
    }
}

/// Flash and program of the model, with larger sectors after the first five.
static LARGE_CHIP: Geometry = Geometry {
    chip: "large-model",
    flash: Region::new(0x0800_0000, 0x1_0C00),
    sectors: &[
        SectorRun { count: 4, size: 0x200 },
        SectorRun { count: 1, size: 0x400 },
        SectorRun { count: 16, size: 0x1000 },
    ],
    ..CHIP
};
static LARGE: Layout =
    Layout { chip: &LARGE_CHIP, programs: &[Region::new(PROGRAM.base, 0x1_0400)], ..LAYOUT }.checked();

/// Each record wears the journal: a large program has sixteen of them, not one for each KiB.
#[test]
fn the_progress_of_a_large_program_is_stored_sixteen_times() {
    let mut flash = ModelFlash::new(&LARGE_CHIP);
    let mut bench = Bench::with_config(&mut flash, Config { layout: &LARGE, ..CONFIG }, 256);
    let file = named(&program(64 * 1024, 0x33));
    bench.all_good(&file[..file.len() - 1]);
    let in_journal = |at: &&Region| LAYOUT.parameters.iter().any(|own| own.contains(at.base, at.size));
    let words = flash.touched.iter().filter(in_journal).filter(|at| at.size == 4).count();
    // Seven words each: the journal's header, and a record with the first data and behind each sixteenth
    // part but the last, which the program fills only in part.
    assert_eq!(words, (1 + 16) * 7);
}

/// Files that a device refuses before any good data, and 1F57h for them.
fn refused(region: Region, bootloader: Region) -> Vec<(Vec<Vec<u8>>, u32)> {
    let (base, vendor, product) = (region.base, rig::VENDOR_ID, rig::PRODUCT_CODE);
    let image = |product| rig::program(region, product, 1300, 0x66);
    let good = image(product);
    let with = |at: usize, word: u32| {
        let mut image = good.clone();
        image[at..at + 4].copy_from_slice(&word.to_le_bytes());
        image
    };
    let file = |vendor, product, first| {
        let control = block(0, 0, &rig::words(&[1300, vendor, product]));
        vec![control, first, block(2, base + 600, &good[600..]), last(&good)]
    };
    let ours = |first| file(vendor, product, first);
    let first = |image: &[u8]| block(1, base, &image[..600]);
    let (mut damaged, mut short) = (first(&good), first(&good));
    damaged[100] ^= 1;
    short.pop();
    vec![
        // No stack pointer, no reset vector, one without the Thumb bit; the label.
        (ours(first(&with(0, 0x3000_0000))), 0x04),
        (ours(first(&with(4, 0x0800_0101))), 0x04),
        (ours(first(&with(4, base + 0x100))), 0x04),
        (ours(first(&image(product ^ 1))), 0x82),
        (file(vendor, product ^ 1, first(&good)), 0x82),
        (file(vendor ^ 1, product, first(&good)), 0x80),
        (ours(block(1, base + 0x400, &good[..600])), 0x0C),
        (ours(block(1, bootloader.base, &good[..600])), 0x0E),
        (ours(block(3, base, &good[..600])), 0x88),
        (ours(damaged), 0x06),
        (ours(short), 0x04),
        (vec![with(4, 0x0800_0101)], 0x04),
        (vec![rig::hex(base, &with(4, 0x0800_0101))], 0x04),
        (vec![vec![0x3C; 600]], 0x04),
    ]
}

/// What is refused may come again: after CLEAR or without it, after a power-off, and with the rest of the file, as
/// a device of a group gets it; all files in a row. The old program starts, and the next good one is taken.
#[test]
fn a_refused_program_costs_nothing_however_often_it_comes() {
    for setup in [&STANDARD_1, &STANDARD_2, &PAULUS_2, &LIFT_1, &LIFT_2] {
        let number = if setup.is_data(2) { 1 } else { setup.programs() };
        let region = setup.region(number);
        let old = rig::program(region, rig::PRODUCT_CODE, 900, 1);
        let mut rig = Rig::new(setup, 4096);
        rig.install(number, &old);
        rig.reset();
        for (kind, (file, status)) in refused(region, setup.layout.bootloader).iter().enumerate() {
            for attempt in 0..4 {
                let what = format!("{}, file {kind}, attempt {attempt}", setup.name);
                rig.unlock(number).unwrap();
                let mut reported = [0; 8];
                rig.node.read(Address::new(0x2006, number), &mut reported).unwrap();
                assert_eq!(reported[..4], [0; 4], "{what}: 2006h");
                if attempt % 2 == 0 {
                    rig.command(number, CLEAR).unwrap();
                }
                let sent: Vec<_> =
                    file.iter().map(|part| (rig.send(number, part), rig.status(number))).collect();
                assert!(sent.iter().any(|(_, found)| found == status), "{what}: {sent:02X?}");
                rig.settle();
                assert_eq!(rig.cells(number)[..old.len()], old, "{what}");
                if attempt == 1 {
                    rig.assert_installed(number, &old, &what);
                }
            }
        }
        let new = rig::program(region, rig::PRODUCT_CODE, 1000, 2);
        rig.unlock(number).unwrap();
        rig.install(number, &new);
        rig.assert_installed(number, &new, setup.name);
    }
}

/// A refusal ends what can go on until a block is taken again, and after a power-off in any case. 2006h counts
/// the blocks that were taken.
#[test]
fn a_refusal_ends_what_could_go_on() {
    let image = program(0xC00, 0x33);
    let file = named(&image);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    bench.all_good(&file[..=20]);
    let wrong = block(21, 0x2000_0000, &[0; CHUNK]);
    let mut damaged = file[21].clone();
    damaged[20] ^= 1;
    for wrong in [&wrong, &damaged, &file[23]] {
        assert!(bench.transfer(wrong).is_err());
        assert_eq!(partial(&mut bench).0, 0);
    }
    bench.good(&file[21]);
    assert_eq!(partial(&mut bench), (crc_of(&file[0]), PROGRAM.base + 21 * CHUNK as u32));
    assert_eq!(partial(&mut Bench::new(&mut flash)).0, 0, "after a power-off");
    send(&mut flash, &file);
    assert!(is_installed(&flash, &image));
    // A program that is refused as a whole; CLEAR does the same.
    let mut bench = Bench::cleared(&mut flash);
    bench.good(&file[0]);
    assert_eq!((partial(&mut bench).0 == 0, bench.command(CLEAR)), (false, 0));
    assert_eq!(partial(&mut bench), (0, 0));
    bench.all_good(&file[..file.len() - 1]);
    assert_eq!(bench.block(&last(&program(0xC00, 0x34))).1, 0x02, "NOVALPROG");
    assert_eq!(partial(&mut bench).0, 0);
    assert_eq!(partial(&mut Bench::new(&mut flash)).0, 0);
}

/// For a group of devices, a block comes again until all of them have it.
#[test]
fn the_last_block_may_come_again_and_is_written_once() {
    let image = program(0x400, 0x44);
    let file = named(&image);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    for (number, block) in file.iter().enumerate() {
        bench.good(block);
        if (1..file.len() - 1).contains(&number) {
            bench.good(block);
        }
        // Its number with other data.
        if (2..file.len() - 1).contains(&number) {
            let mut other = block.clone();
            other[20] ^= 1;
            let len = other.len();
            let crc = kit::bench::crc32(&other[..len - 4]);
            other[len - 4..].copy_from_slice(&crc.to_le_bytes());
            assert_eq!(bench.transfer(&other), Err(AbortCode::DEVICE_STATE), "block {number}");
        }
    }
    assert!(is_installed(&flash, &image));
    let mut words: Vec<u32> = flash.touched.iter().map(|region| region.base).collect();
    words.retain(|base| PROGRAM.contains(*base, 4));
    words.sort_unstable();
    let all = words.len();
    words.dedup();
    assert_eq!(all, words.len(), "each word once");
}
