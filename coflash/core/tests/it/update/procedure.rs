//! The update procedure against a device that plays every failure of the manual.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use super::{file, left, node, script, update};
use canopen::{CobId, Frame};
use coboot_can::Adapter;
use coflash_core::device::info::info;
use coflash_core::device::{Session, Timing, Transfers};
use coflash_core::file::block_file::{self, BlockFile};
use coflash_core::file::convert::{program_of, Options};
use coflash_core::file::{raw, Firmware};
use coflash_core::file::{Program, Target};
use coflash_core::update::event::{Phase, RepeatReason, Retry, Warning};
use coflash_core::update::{flash, steps, DeviceState, Event, FlashOptions, Report};
use coflash_core::Error;
use embedded_can::{Frame as _, StandardId};
use kit::fake::{crc16, Blocks, Fake, Outcome, APPLICATION, BOOTLOADER};
use proptest::prelude::*;

/// Five blocks: 0, 1 to 4 (three of code, one of text and data), -1.
const BLOCKS: usize = 6;

fn run(fake: &mut Fake, options: FlashOptions) -> (Result<Report, Error>, Vec<Event>) {
    update(fake, file(), &options)
}

fn fails(fake: &mut Fake) -> Error {
    run(fake, FlashOptions::default()).0.unwrap_err()
}

/// A device that runs this, and differs by `change` from one without faults.
fn device(running: u32, change: impl FnOnce(&mut Fake)) -> Fake {
    let mut fake = Fake::new(running);
    change(&mut fake);
    fake
}

fn bootloader(change: impl FnOnce(&mut Fake)) -> Fake {
    device(BOOTLOADER, change)
}

/// One that knows block transfer, with the most segments of a sub-block.
fn takes_blocks(change: impl FnOnce(&mut Fake)) -> Fake {
    let mut fake = bootloader(change);
    fake.knows_blocks = Blocks::Known(127);
    fake
}

#[test]
fn the_whole_procedure_from_a_running_application() {
    let mut fake = Fake::new(APPLICATION);
    let (report, events) = run(&mut fake, FlashOptions::default());
    let report = report.unwrap();
    // Commands and their order: the manual's steps 3, 4, 6 to 9, 10, 12, 14 and 15.
    let steps = "command 80, command 03, block 0, block 1, block 2, block 3, block 4, block -1";
    let trial = "command 01, command 80, command 83, command 01";
    assert_eq!(fake.writes().join(", "), format!("{steps}, {trial}"));
    assert_eq!(fake.blocks.concat(), data!("identity-110.blk"));
    assert_eq!(fake.running, Some(APPLICATION));
    assert_eq!(
        (report.program_size, report.repeats, report.running.map(|running| running.0)),
        (4001, 0, Some(APPLICATION))
    );
    assert_eq!((report.program_crc, report.device_crc), (file().crc(), Some(file().crc())));
    let words: Vec<String> = events
        .iter()
        .filter(|event| !matches!(event, Event::Progress { .. }))
        .map(Event::to_string)
        .collect();
    assert_eq!(words[0], "found an application (device type 00020192h)");
    assert_eq!(
        words[1..5],
        [
            "calling the application back to the bootloader",
            "the bootloader is running",
            "dialect: block (block files, SYS TEC)",
            "commanding the device to erase the old program"
        ]
    );
    assert_eq!(words[5][..9], *"erased in");
    assert_eq!(
        words[7..],
        [
            "starting the program for a trial",
            "the trial was successful: an application (device type 00020192h) started and returned to the bootloader",
            "released for autostart (83h)",
            "starting the program",
            "running: an application (device type 00020192h)",
            report.to_string().as_str()
        ]
    );
}

/// Done and total, in bytes, of each progress.
fn progress(events: &[Event]) -> Vec<(usize, usize)> {
    let of = |event: &Event| match event {
        Event::Progress { done, total } => Some((*done, *total)),
        _ => None,
    };
    events.iter().filter_map(of).collect()
}

#[test]
fn progress_never_goes_back_and_ends_complete() {
    let progress = progress(&run(&mut Fake::new(BOOTLOADER), FlashOptions::default()).1);
    let bytes = data!("identity-110.blk").len();
    assert!(progress.is_sorted() && progress.iter().all(|(_, total)| *total == bytes), "{progress:?}");
    assert_eq!(progress.last(), Some(&(bytes, bytes)));
    assert!(progress.len() > 100, "about one for each segment of seven bytes: {}", progress.len());
}

/// With the form of the downloads at the end, the repetitions and the block downloads. Block 0 and the last
/// one have 28 and 24 bytes: four segments cost no more than the frames around a block. One that refuses block
/// transfer is asked once for it, and one that does not answer twice.
#[test]
fn blocks_are_used_where_the_device_knows_them() {
    let known = [1, 2, 5, 127].map(Blocks::Known).map(|knows| (knows, (Transfers::Blocks, 0, BLOCKS - 2)));
    let refused = [0x0504_0001, 0x0601_0000, 0x0800_0000].map(Blocks::Refused);
    let refused = refused.map(|knows| (knows, (Transfers::Segments, 0, 1)));
    let ignored = (Blocks::Ignored, (Transfers::Segments, 2, 2));
    for (knows_blocks, expected) in known.into_iter().chain(refused).chain([ignored]) {
        for running in [APPLICATION, BOOTLOADER] {
            let mut fake = device(running, |fake| fake.knows_blocks = knows_blocks);
            let report = run(&mut fake, FlashOptions::default()).0.unwrap();
            assert_eq!(fake.blocks.concat(), data!("identity-110.blk"));
            assert_eq!((report.transfers, report.repeats, fake.block_downloads), expected);
        }
    }
    // Any other abort concerns the value, and is not a reason for another form of download.
    let mut fake = bootloader(|fake| fake.knows_blocks = Blocks::Refused(0x0607_0012));
    let error = fails(&mut fake);
    assert_eq!((error.number(), fake.block_downloads), (0x6000_0025, 1));
}

#[test]
fn no_block_is_tried_where_segments_are_asked_for() {
    let mut fake = takes_blocks(|_| {});
    let mut session = Session::new(&mut fake, node(), Timing::default());
    session.transfer_by(Transfers::Segments);
    flash(&mut session, file(), &FlashOptions::default(), &mut |_| {}).unwrap();
    assert_eq!(fake.block_downloads, 0);
}

#[test]
fn lost_segments_of_a_block_are_sent_again_within_the_transfer() {
    for lost in [vec![1], vec![3], vec![10, 11], (1..60).step_by(7).collect()] {
        let mut fake = bootloader(|fake| {
            (fake.knows_blocks, fake.lost_segments) = (Blocks::Known(10), lost.clone());
        });
        let report = run(&mut fake, FlashOptions::default()).0.unwrap();
        assert_eq!(fake.blocks.concat(), data!("identity-110.blk"), "{lost:?}");
        assert_eq!((report.repeats, report.transfers), (0, Transfers::Blocks));
    }
}

/// Each segment in transit then causes an abort: none of these is taken for an answer to the next
/// request.
#[test]
fn a_block_transfer_that_is_refused_in_the_middle_is_told_by_its_status() {
    for segment in [1, 2, 9, 30] {
        let mut fake = takes_blocks(|fake| fake.refuses_segment = Some((segment, 0x0C)));
        let error = fails(&mut fake);
        assert_eq!(error.number(), 0x6000_0006, "{segment}: {error}");
        // The tool notices the abort long before the 39 segments are sent.
        let sent = fake.sent.iter().filter(|frame| matches!(frame.data()[0], 1..=0x1F | 0x81..=0x9F)).count();
        assert!(sent <= segment + 16, "{segment}: {sent}");
    }
}

/// A damaged frame costs its block, and not the form of those that follow.
#[test]
fn after_a_damaged_block_comes_block_transfer_again() {
    // In the first block, whose transfer has 39 segments, and in the second one.
    for altered in [vec![5, 45], vec![45, 85]] {
        let mut fake = takes_blocks(|fake| fake.altered_segments = altered.clone());
        let report = run(&mut fake, FlashOptions::default()).0.unwrap();
        assert_eq!(fake.blocks.concat(), data!("identity-110.blk"));
        // Two attempts for the damaged block, which then came in segments; one for each other.
        assert_eq!(fake.block_downloads, 1 + BLOCKS - 2, "{altered:?}");
        assert_eq!((report.repeats, report.transfers), (2, Transfers::Blocks), "{altered:?}");
    }
    // If no block gets through, segments remain.
    let mut fake = takes_blocks(|fake| fake.altered_segments = (1..10_000).step_by(10).collect());
    let report = run(&mut fake, FlashOptions::default()).0.unwrap();
    assert_eq!(fake.blocks.concat(), data!("identity-110.blk"));
    assert_eq!((fake.block_downloads, report.transfers), (2 * 3, Transfers::Segments));
}

/// A bootloader of coboot, which reports the region of its program.
struct Coboot;

impl kit::fake::Maker for Coboot {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        let region = [LARGE_AT.to_le_bytes(), 0x6_0000_u32.to_le_bytes()].concat();
        (at == (0x2004, 1)).then_some(Ok(region))
    }
}

const LARGE_AT: u32 = 0x0802_0000;

/// A program of so many KiB, in blocks of 1 KiB.
fn large(kib: usize) -> Program {
    let mut bytes: Vec<u8> = (0..kib * 1024).map(|at| (at * 7 + at / 256) as u8).collect();
    bytes[..8].copy_from_slice(&[0, 0, 1, 0x20, 1, 2, 2, 8]);
    let image = raw::read(&bytes, Some(LARGE_AT)).unwrap();
    program_of(Firmware::Image(image), &Options::default()).unwrap().program
}

/// Flashes a file into a bootloader of coboot, which must then have its program.
fn into_coboot(
    file: &Program,
    options: FlashOptions,
    change: impl FnOnce(&mut Fake),
) -> (Result<Report, Error>, Vec<Event>, Fake) {
    let mut fake = takes_blocks(change);
    fake.maker = Some(Box::new(Coboot));
    let (result, events) = update(&mut fake, file, &options);
    if result.is_ok() {
        let taken = block_file::read(&fake.blocks.concat()).unwrap();
        assert_eq!(taken.flash_image(), file.flash_image());
        assert_eq!(BlockFile::of(&taken).control(), BlockFile::of(file).control());
    }
    (result, events, fake)
}

#[test]
fn blocks_are_joined_where_the_device_takes_them() {
    let file = large(256);
    let own = BlockFile::of(&file).blocks().len();
    // 256 KiB in pieces of 4 times 1008 bytes, and two blocks more.
    let (report, _, fake) = into_coboot(&file, FlashOptions::default(), |_| {});
    assert_eq!((report.unwrap().repeats, fake.blocks.len()), (0, (256 * 1024_usize).div_ceil(4 * 1008) + 2));
    assert!(fake.blocks.iter().all(|block| block.len() <= 4096));
    // The user has chosen the size; a small program, of which a cut would cost much.
    let (_, _, fake) = into_coboot(&file, FlashOptions::default().joined_blocks(None), |_| {});
    assert_eq!(fake.blocks.len(), own);
    let small = large(64);
    let (_, _, fake) = into_coboot(&small, FlashOptions::default(), |_| {});
    assert_eq!(fake.blocks.len(), BlockFile::of(&small).blocks().len());
    // A device with a smaller buffer gets the blocks of the file.
    let (report, events, fake) = into_coboot(&file, FlashOptions::default(), |fake| fake.room = 1100);
    assert_eq!((fake.blocks.len(), fake.count("command 03")), (own, 1));
    assert_eq!(report.unwrap().repeats, 0);
    let progress = progress(&events);
    assert!(progress.is_sorted_by_key(|(done, _)| *done), "{progress:?}");
    assert!(progress.last().is_some_and(|(done, total)| done == total), "{progress:?}");
    // One that is too long for the buffer fails as before if it is the file's own.
    let (result, _, _) = into_coboot(&file, FlashOptions::default(), |fake| fake.room = 900);
    assert_eq!(result.unwrap_err().number(), 0x6000_0002);
    // A damaged frame costs a large block twice, and then smaller ones.
    let damage = |fake: &mut Fake| fake.altered_segments = vec![5, 600];
    let (report, _, fake) = into_coboot(&file, FlashOptions::default(), damage);
    let report = report.unwrap();
    assert_eq!((report.repeats, report.transfers, fake.blocks.len()), (2, Transfers::Blocks, own));
}

/// A frame that is no segment of a sub-block waits for an answer, which is what a slow adapter costs.
#[test]
fn joined_blocks_halve_what_waits_for_an_answer() {
    let file = large(256);
    let waits = |options: FlashOptions| {
        let fake = into_coboot(&file, options, |_| {}).2;
        let data: usize = fake.blocks.iter().map(|block| block.len().div_ceil(7)).sum();
        // Of the segments, the last of each sub-block waits.
        let sub_blocks: usize = fake.blocks.iter().map(|block| block.len().div_ceil(7 * 127)).sum();
        fake.sent.len() - data + sub_blocks
    };
    let (joined, own) = (waits(FlashOptions::default()), waits(FlashOptions::default().joined_blocks(None)));
    assert!(2 * joined < own, "{joined} and {own}");
}

/// Polynomial EDB88320h, start value and end FFFFFFFFh (manual L-1112d_10, chapter 3.1), bit by bit.
fn crc_of_32_bits(data: &[u8]) -> u32 {
    !data.iter().fold(!0, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| crc >> 1 ^ (0xEDB8_8320 & (crc & 1).wrapping_neg()))
    })
}

/// A file's CRC is its own, and a device checks with that of its product: it says so when it refuses
/// block 0.
#[test]
fn a_device_with_the_other_crc_gets_the_blocks_with_it() {
    let (plain, other) = (data!("plain-400.blk"), data!("crc16-400.blk"));
    let of_16_bits: fn(&[u8]) -> u32 = |data| crc16(data).into();
    for (file, wanted, of) in
        [(plain, other, of_16_bits), (other, plain, crc_of_32_bits), (plain, plain, crc_of_32_bits)]
    {
        let sent = |fake: &mut Fake, options: FlashOptions| {
            fake.crc_of_blocks = Some(of);
            update(fake, block_file::read(file).unwrap(), &options).0
        };
        let mut fake = Fake::new(BOOTLOADER);
        let report = sent(&mut fake, FlashOptions::default()).unwrap();
        assert!(fake.blocks.concat() == wanted);
        let repeats = u32::from(file != wanted);
        assert_eq!((report.repeats, fake.count("command 03")), (repeats, 1));
        // 1F56h has the device's own CRC, and not that of the file.
        assert_eq!(report.device_crc.map(|crc| crc <= 0xFFFF), Some(wanted == other));
        assert_eq!(report.device_crc == Some(report.program_crc), repeats == 0);
        // A damaged block 0 looks the same: the other CRC is then in vain.
        let mut fake = bootloader(|fake| fake.on_block = script(0, 1, Outcome::Status(0x06)));
        assert_eq!(sent(&mut fake, FlashOptions::default()).unwrap().repeats, 2 - repeats);
        assert!(fake.blocks.concat() == wanted);
        if repeats > 0 {
            let error = sent(&mut Fake::new(BOOTLOADER), FlashOptions::default().repeats(0)).unwrap_err();
            assert!(error.advice().to_string().contains("--crc16"), "{}", error.advice());
        }
    }
}

#[test]
fn a_file_for_another_device_erases_nothing() {
    let target = file().target().unwrap();
    assert_eq!((target.vendor_id, target.product_code), (0, 1234));
    let check = |check_target| FlashOptions::default().check_target(Some(check_target));
    for running in [APPLICATION, BOOTLOADER] {
        let checked = |target| {
            let mut fake = Fake::new(running);
            let (result, events) = run(&mut fake, check(target));
            (result, events, fake)
        };
        // The fake has vendor-ID 3Fh and product code 1234.
        let (result, events, fake) = checked(Target { vendor_id: 0x40, ..target });
        let error = result.unwrap_err();
        assert_eq!(error.number(), 0x6000_0180);
        assert_eq!(error.to_string(), "the program is for vendor-ID 00000040h, and node 5 has 0000003Fh");
        assert_eq!((fake.writes().len(), left(&events)), (0, DeviceState::Untouched));
        let (result, _, fake) = checked(Target { vendor_id: 0x3F, product_code: 1235 });
        assert_eq!((result.unwrap_err().number(), fake.writes().len()), (0x6000_0182, 0));
        let (result, _, fake) = checked(Target { vendor_id: 0x3F, product_code: 1234 });
        assert!(result.is_ok(), "{result:?}");
        // Before the update; bootloader and program on trial, which are compared; and the program
        // with the file. The identity in block 0 is always compared, except for a vendor-ID of
        // "any".
        assert_eq!((fake.count("read 1018/1"), fake.count("read 1018/2")), (4, 5));
    }
}

#[test]
fn verify_looks_once_more_at_the_running_program() {
    let options = FlashOptions::default().verify(true);
    let mut fake = Fake::new(BOOTLOADER);
    let (report, events) = run(&mut fake, options);
    report.unwrap();
    // Before and after the erasure, after the download, and at the end.
    assert_eq!(fake.count("read 1F56/1"), 4);
    assert_eq!(fake.log.last().unwrap(), "read 1F56/1");
    let [.., last, Event::Done(_)] = events.as_slice() else { panic!("{events:?}") };
    assert_eq!(*last, Phase::VerifiedAgain { crc: file().crc() }.into());
    // A program that reports another CRC while it runs.
    let mut fake = bootloader(|fake| fake.crc_of_application = Some(0x1234_5678));
    let (result, events) = run(&mut fake, options);
    assert_eq!(result.unwrap_err().number(), 0x6000_0001);
    assert_eq!(left(&events), DeviceState::Released);
}

#[test]
fn in_the_bootloader_no_call_and_without_start_none() {
    let mut fake = Fake::new(BOOTLOADER);
    let (report, events) = run(&mut fake, FlashOptions::default().start(false));
    let report = report.unwrap();
    // Neither tried nor released for autostart.
    assert_eq!((fake.writes()[0], *fake.writes().last().unwrap()), ("command 03", "block -1"));
    assert_eq!((report.running, report.released, fake.running), (None, Some(false), Some(BOOTLOADER)));
    assert!(events.contains(&Phase::NotReleased { program: 1 }.into()), "{events:?}");
}

#[test]
fn a_trial_run_comes_before_the_release() {
    let mut fake = Fake::new(BOOTLOADER);
    let report = run(&mut fake, FlashOptions::default()).0.unwrap();
    assert_eq!(fake.writes()[1 + BLOCKS..], ["command 01", "command 80", "command 83", "command 01"]);
    assert_eq!(report.released, Some(true));
    let mut fake = Fake::new(BOOTLOADER);
    run(&mut fake, FlashOptions::default().trial_run(false)).0.unwrap();
    assert_eq!(fake.writes()[1 + BLOCKS..], ["command 83", "command 01"]);
}

/// A program that fails its trial in any way is never released for autostart; the message names the
/// failure and the way to recover.
#[test]
fn a_program_that_fails_its_trial_is_not_released() {
    let trial = |change: &dyn Fn(&mut Fake)| {
        let mut fake = Fake::new(BOOTLOADER);
        change(&mut fake);
        let error = run(&mut fake, FlashOptions::default()).0.unwrap_err();
        assert_eq!(fake.count("command 83"), 0, "{error}");
        let start = "the trial failed, and the program is not released for autostart: ";
        let text = error.to_string();
        let rest = text.strip_prefix(start).unwrap_or_else(|| panic!("{text}")).to_string();
        (error.number(), rest, error.advice().to_string())
    };
    let (number, words, advice) = trial(&|fake| fake.starts = None);
    assert_eq!((number, &*words), (0x6000_0014, "node 5 has not answered since the program was started"));
    assert!(
        advice.contains("switch the device off and on") && advice.contains("coflash more catch --node 5"),
        "{advice}"
    );
    let (number, words, _) = trial(&|fake| fake.starts = Some(BOOTLOADER));
    assert_eq!(number, 0x6000_0014);
    assert!(
        words.starts_with("it does not start, node 5 stays in the bootloader; there is no valid"),
        "{words}"
    );
    let (number, words, _) = trial(&|fake| fake.on_command = script(0x80, usize::MAX, Outcome::Ignore));
    assert_eq!(number, 0x6000_0010);
    assert_eq!(words, "it runs in node 5 and does not return to the bootloader when called");
    let refused = Outcome::Abort(0x0602_0000);
    let (number, words, advice) = trial(&|fake| fake.on_command = script(0x80, usize::MAX, refused));
    assert_eq!(number, 0x6000_0010);
    assert!(
        words.starts_with("it runs in node 5, and refuses the call to the bootloader with abort 06020000h"),
        "{words}"
    );
    // Not --no-trial: that would install what can never be updated.
    assert!(!advice.contains("--no-trial"), "{advice}");
    for words in ["docs/application.md", "coflash reset --node 5", "coflash more catch --node 5"] {
        assert!(advice.contains(words), "{advice}");
    }
    let refuses = Outcome::Abort(0x0800_0022);
    let (number, _, advice) = trial(&|fake| fake.on_command = script(0x80, usize::MAX, refuses));
    assert!(number == 0x6000_0010 && advice.starts_with("the application refuses now"), "{advice}");
}

#[test]
fn nobody_there() {
    let mut fake = bootloader(|fake| fake.running = None);
    let began = fake.now;
    let error = fails(&mut fake);
    assert_eq!(error.number(), 0x6000_0013);
    assert_eq!(error.to_string(), "node 5 does not answer (reading 1000h/0)");
    assert!(error.advice().to_string().contains("bit rate"));
    let waited = fake.now - began;
    assert!(
        waited >= Timing::default().boot && waited < Timing::default().boot + Duration::from_secs(1),
        "{waited:?}"
    );
}

/// One that is silent for a while, and one that answers on before it restarts.
#[test]
fn a_device_that_is_just_restarting_is_waited_for() {
    for (restart, leave) in [(Some(3500), None), (None, Some(1200))] {
        let mut fake = device(APPLICATION, |fake| {
            fake.restart_time = restart.map_or(fake.restart_time, Duration::from_millis);
            fake.leave_time = leave.map_or(fake.leave_time, Duration::from_millis);
        });
        let report = run(&mut fake, FlashOptions::default()).0.unwrap();
        assert_eq!((fake.count("command 80"), fake.count("command 01")), (2, 2));
        assert_eq!(report.running.map(|running| running.0), Some(APPLICATION));
    }
}

#[test]
fn an_answer_left_over_from_before_is_not_taken_for_one_to_this_request() {
    let mut fake = Fake::new(BOOTLOADER);
    // The late acknowledge of a segment does not name its transfer.
    let late = Frame::of(CobId::new(0x585).unwrap(), &[0x20, 0, 0, 0, 0, 0, 0, 0]);
    fake.inject(late);
    let mut session = Session::new(&mut fake, node(), Timing::default());
    session.command(1, canopen::program::ProgramControl::Clear).unwrap();
}

/// Table 3, and table 10 of the manual for the numbers that it has. The last one is in no
/// table, and has a detail.
const STATUS: [(u32, u32, &str); 15] = [
    (0x02, 0x6000_0001, "no valid program"),
    (0x04, 0x6000_0002, "expected form"),
    (0x06, 0x6000_0003, "CRC"),
    (0x08, 0x6000_0004, "cleared"),
    (0x0A, 0x6000_0005, "written"),
    (0x0C, 0x6000_0006, "outside"),
    (0x0E, 0x6000_0007, "protected"),
    (0x10, 0x6000_0110, "non-volatile"),
    (0x7E, 0x6000_0008, "unspecified"),
    (0x80, 0x6000_0180, "vendor"),
    (0x82, 0x6000_0182, "product"),
    (0x84, 0x6000_0184, "not allowed"),
    (0x86, 0x6000_0186, "carried out"),
    (0x88, 0x6000_0188, "order"),
    (0xBEEF_0020, 0x6000_0008, "detail BEEFh"),
];

/// A sector that the option bytes protect (nWRP): bits 16 to 31 of 1F57h have its number.
#[test]
fn a_write_protected_sector_is_named_with_the_way_out() {
    for outcome in [Outcome::Status(0x0004_000E), Outcome::AbortStatus(0x0800_0020, 0x0004_000E)] {
        let mut fake = bootloader(|fake| fake.on_block = script(1, usize::MAX, outcome));
        let error = fails(&mut fake);
        let text = error.to_string();
        let words = "writing block 1 failed: sector 4 of the flash is write-protected (1F57h reads 0Eh";
        assert!(text.starts_with(words) && !text.contains("detail"), "{text}");
        let advice = error.advice().to_string();
        assert!(advice.contains("option bytes") && advice.contains("debug probe"), "{advice}");
        assert!(!advice.contains("linked"), "{advice}");
    }
}

#[test]
fn every_status_of_the_manual_has_its_number_and_words() {
    for (status, number, words) in STATUS {
        for outcome in [Outcome::Status(status), Outcome::AbortStatus(0x0800_0020, status)] {
            let mut fake = bootloader(|fake| fake.on_block = script(2, usize::MAX, outcome));
            let error = fails(&mut fake);
            let text = error.to_string();
            assert_eq!(error.number(), number, "{text}");
            assert!(text.starts_with("writing block 2 failed: ") && text.contains(words), "{text}");
            assert!(text.contains(&format!("1F57h reads {:02X}h", status & 0xFF)), "{text}");
            assert!(!error.advice().to_string().is_empty());
            assert_eq!(fake.count("command 83") + fake.count("block 3"), 0, "the procedure ends here");
            let repeatable = matches!(status, 0x06 | 0x86);
            assert_eq!(fake.count("block 2"), if repeatable { 4 } else { 1 }, "{text}");
            // The start before the release is that of the trial.
            for (command, words, starts) in
                [(0x03, "erasing the program", 0), (0x83, "releasing the program for autostart", 1)]
            {
                let mut fake = bootloader(|fake| fake.on_command = script(command, usize::MAX, outcome));
                let error = fails(&mut fake);
                assert_eq!((error.number(), fake.count("command 01")), (number, starts));
                assert!(error.to_string().starts_with(&format!("{words} failed: ")), "{error}");
                assert!(starts > 0 || fake.writes() == ["command 03"]);
            }
        }
    }
}

/// An erase after which 1F56h has the program's CRC was postponed until the first block; a second command erases at
/// once. It does so too with the rest of a download, of which 1F56h says nothing.
#[test]
fn an_erase_that_the_device_puts_off_is_asked_for_twice() {
    for (had, commands) in [(Some((1, 2)), 2), (Some((1, 1)), 1), (None, 2)] {
        let mut fake = bootloader(|fake| fake.had = had);
        steps::erase_at_once(&mut Session::new(&mut fake, node(), Timing::default()), 1).unwrap();
        assert_eq!(fake.writes(), vec!["command 03"; commands], "{had:?}");
    }
}

/// After the boot-up that ends a trial, the bootloader stores that the program came back. CLEAR is not
/// repeated: what keeps the device busy may be the download of somebody else.
#[test]
fn a_command_is_repeated_while_the_device_is_still_storing() {
    let busy = Outcome::AbortStatus(0x0800_0022, 0x86);
    let mut fake = bootloader(|fake| fake.on_command = script(0x83, 3, busy));
    assert!(run(&mut fake, FlashOptions::default()).0.is_ok());
    assert_eq!(fake.count("command 83"), 4);

    let mut fake = bootloader(|fake| fake.on_command = script(0x03, 1, busy));
    assert_eq!(fails(&mut fake).number(), 0x6000_0186);
    assert_eq!(fake.writes(), ["command 03"]);
}

#[test]
fn a_block_is_repeated_as_often_as_allowed() {
    let mut fake = bootloader(|fake| fake.on_block = script(2, 2, Outcome::Status(0x06)));
    let (report, events) = run(&mut fake, FlashOptions::default().repeats(2));
    assert_eq!(report.unwrap().repeats, 2);
    assert_eq!(fake.count("block 2"), 3);
    assert_eq!(fake.blocks.concat(), data!("identity-110.blk"));
    let again = Event::Retry(Retry::block(2, 2, 2, RepeatReason::Crc));
    assert!(events.contains(&again));

    let mut fake = bootloader(|fake| fake.on_block = script(2, 3, Outcome::Status(0x06)));
    let error = run(&mut fake, FlashOptions::default().repeats(2)).0.unwrap_err();
    assert_eq!((error.number(), fake.count("block 2"), fake.count("block 3")), (0x6000_0003, 3, 0));
}

#[test]
fn a_refusal_without_status_gives_the_abort_code() {
    let mut fake = bootloader(|fake| fake.on_block = script(1, 1, Outcome::Abort(0x0607_0012)));
    let error = fails(&mut fake);
    assert_eq!((error.number(), fake.count("block 1")), (0x6000_0025, 1));
    let text = error.to_string();
    assert!(text.starts_with("node 5 refuses writing block 1: abort 06070012h"), "{text}");
    assert!(error.advice().to_string().contains("--block-size"));
    // Codes that mean lost frames: the tool tries once more.
    let mut fake = bootloader(|fake| fake.on_block = script(1, 1, Outcome::Abort(0x0504_0000)));
    assert_eq!(run(&mut fake, FlashOptions::default()).0.unwrap().repeats, 1);
}

#[test]
fn a_lost_answer_or_request_costs_a_repeat_and_nothing_else() {
    for (block, knows_blocks) in [0, 1, 3, u32::MAX]
        .into_iter()
        .flat_map(|block| [Blocks::Refused(0x0504_0001), Blocks::Known(127)].map(|knows| (block, knows)))
    {
        for outcome in [Outcome::LoseAnswer, Outcome::LoseRequest] {
            let mut fake = bootloader(|fake| fake.on_block = script(block, 1, outcome));
            fake.knows_blocks = knows_blocks;
            let report = run(&mut fake, FlashOptions::default()).0.unwrap();
            // The last block may be sent twice; its second copy is the same.
            fake.blocks.dedup();
            assert_eq!(fake.blocks.concat(), data!("identity-110.blk"), "{block} {outcome:?}");
            assert_eq!(report.repeats, 1);
        }
    }
    for command in [0x80, 0x03, 0x83, 0x01] {
        for outcome in [Outcome::LoseAnswer, Outcome::LoseRequest] {
            let mut fake = device(APPLICATION, |fake| fake.on_command = script(command, 1, outcome));
            let result = run(&mut fake, FlashOptions::default().trial_run(false)).0;
            // START is sent once: a program that already runs may not support it.
            let fatal = command == 0x01 && outcome == Outcome::LoseRequest;
            assert_eq!(result.is_err(), fatal, "{command:02X} {outcome:?} {result:?}");
        }
    }
}

#[test]
fn a_long_erase_is_waited_for_without_flooding_the_bus() {
    for (deaf, seconds) in [(false, 16), (true, 9)] {
        let mut fake = bootloader(|fake| fake.erase_time = Duration::from_secs(seconds));
        fake.deaf_while_busy = deaf;
        run(&mut fake, FlashOptions::default()).0.unwrap();
        let reads = fake.count("read 1F57/1");
        assert!(reads < 16 * 5 + 30, "{reads} reads");
    }
}

#[test]
fn busy_for_ever_is_given_up() {
    for (deaf, number, words) in [
        (false, 0x6000_0016, "node 5 is still busy erasing the program after 60"),
        (true, 0x6000_0013, "node 5 does not answer (erasing the program)"),
    ] {
        let mut fake = bootloader(|fake| fake.erase_time = Duration::from_secs(100_000));
        fake.deaf_while_busy = deaf;
        let error = fails(&mut fake);
        assert_eq!(error.number(), number);
        assert!(error.to_string().starts_with(words), "{error}");
    }
}

/// The power is cut during the erase: this is reported after 2 s, and the update ends after 10 s.
/// For a device that is busy and answers, the tool waits for as long as a command may take.
#[test]
fn silence_is_told_and_comes_to_an_end_soon() {
    for (silent, end) in [(None, 10), (Some(Duration::from_secs(4)), 4)] {
        let mut fake = bootloader(|fake| fake.erase_time = Duration::from_secs(100_000));
        fake.deaf_while_busy = true;
        let began = fake.now;
        let timing = silent.map_or(Timing::default(), |silent| Timing::default().silent(silent));
        let mut session = Session::new(&mut fake, node(), timing);
        let mut events = Vec::new();
        let error = flash(&mut session, file(), &FlashOptions::default(), &mut |event| events.push(event))
            .unwrap_err();
        assert_eq!(error.to_string(), "node 5 does not answer (erasing the program)");
        // The last check takes a second, and the steps before the erase some milliseconds.
        let took = fake.now - began;
        assert!(took >= Duration::from_secs(end) && took < Duration::from_secs(end + 3), "{took:?}");
        let reported: Vec<String> = events
            .iter()
            .filter(|event| matches!(event, Event::Warning(Warning::Silent { .. })))
            .map(Event::to_string)
            .collect();
        let line = format!("no answer for 2 s (erasing the program), waiting up to {end} s");
        assert_eq!(reported, [line], "once");
    }
    // For a device that answers all the time nothing of this is reported.
    let mut fake = bootloader(|fake| fake.erase_time = Duration::from_secs(30));
    let (result, events) = run(&mut fake, FlashOptions::default());
    assert!(
        result.is_ok() && !events.iter().any(|event| matches!(event, Event::Warning(Warning::Silent { .. }))),
        "{result:?}"
    );
}

/// A program that was started directly after its download takes the first 80h for "confirm": it
/// answers and continues. It is called again soon.
#[test]
fn an_application_that_takes_the_first_call_for_a_confirmation_is_called_again() {
    let mut fake = device(APPLICATION, |fake| fake.erase_time = Duration::from_millis(500));
    fake.on_command = script(0x80, 1, Outcome::Ignore);
    let began = fake.now;
    let report = run(&mut fake, FlashOptions::default().trial_run(false)).0.unwrap();
    assert_eq!((fake.count("command 80"), fake.count("command 03")), (2, 1));
    assert_eq!(report.running.map(|running| running.0), Some(APPLICATION));
    let took = fake.now - began;
    assert!(took < Timing::default().boot, "not after the time that a restart may take: {took:?}");
}

/// The call uses 1F51h/1 for every program that runs or is to be written (manual, steps 3 and 12):
/// as a rule an application has no other sub-index. The fake's bootloader has one program, so the
/// procedure ends there, with the erase of the other sub-index.
#[test]
fn a_second_program_is_written_to_a_device_whose_first_one_runs() {
    for (running, calls) in [(APPLICATION, 1), (BOOTLOADER, 0)] {
        let mut fake = Fake::new(running);
        let error = run(&mut fake, FlashOptions::default().program(2)).0.unwrap_err();
        assert_eq!(fake.writes(), vec!["command 80"; calls], "{error}");
        assert_eq!((error.number(), fake.running), (0x6000_0025, Some(BOOTLOADER)));
        let clear = fake.sent.iter().any(|frame| frame.data()[..5] == [0x2F, 0x51, 0x1F, 2, 3]);
        assert!(clear, "{:?}", fake.sent);
    }
}

#[test]
fn an_application_that_does_not_go_back() {
    let mut fake = device(APPLICATION, |fake| fake.on_command = script(0x80, usize::MAX, Outcome::Ignore));
    let error = fails(&mut fake);
    assert_eq!((error.number(), fake.count("command 80")), (0x6000_0010, 3));
    assert_eq!(error.to_string(), "node 5 stays in an application (device type 00020192h)");
    assert_eq!(fake.writes(), ["command 80"; 3], "nothing was erased");

    // The codes as CiA 301 table 22 has them. 06060000h is a confirmation that could not be stored.
    let refuses = "the application refuses now: stop the machine and run the command again";
    for (code, words, others) in [
        (0x0602_0000, "cannot be called back", "entry strap"),
        (0x0609_0030, "does not know the call", "--dialect raw"),
        (0x0800_0022, refuses, "run coflash more catch --node 5"),
        (0x0800_0021, refuses, "run coflash more catch --node 5"),
        (0x0606_0000, "run the command again", "the abort code gives the device's reason"),
        (0x0504_0001, "frames were lost", "second tool"),
    ] {
        let mut fake = Fake::new(APPLICATION);
        fake.on_command = script(0x80, usize::MAX, Outcome::Abort(code));
        let error = fails(&mut fake);
        assert_eq!((error.number(), fake.count("command 80")), (0x6000_0010, 1));
        assert!(error.to_string().contains(&format!("refuses the call with abort {code:08X}h")), "{error}");
        let advice = error.advice().to_string();
        assert!(advice.contains(words) && advice.contains(others), "{advice}");
    }
}

#[test]
fn a_wrong_program_crc_is_never_released() {
    let mut fake = bootloader(|fake| fake.crc = Some(0x1234_5678));
    let error = fails(&mut fake);
    assert_eq!(error.number(), 0x6000_0001);
    assert!(error.to_string().contains("CRC 12345678h, that of the file "), "{error}");
    assert_eq!(fake.count("command 83"), 0);
}

#[test]
fn a_program_that_does_not_come_up() {
    let fails = |change: &dyn Fn(&mut Fake)| {
        let error = run(&mut bootloader(change), FlashOptions::default().trial_run(false)).0.unwrap_err();
        (error.number(), error.to_string())
    };
    let (number, words) = fails(&|fake| fake.starts = Some(BOOTLOADER));
    assert_eq!(number, 0x6000_0014);
    assert_eq!(
        words,
        "the program does not start: node 5 stays in the bootloader (device type 10000000h); there is no valid \
         program to start (1F57h reads 02h)"
    );
    let (_, words) = fails(&|fake| fake.starts = None);
    assert_eq!(words, "the program does not start: node 5 does not answer");
    let refused = Outcome::AbortStatus(0x0800_0022, 0x02);
    assert_eq!(fails(&|fake| fake.on_command = script(0x01, 1, refused)).0, 0x6000_0014);
}

#[test]
fn what_others_say_on_the_bus_is_passed_over() {
    let other = |id: u16, data: &[u8]| Frame::of(CobId::new(id).unwrap(), data);
    let mut fake = Fake::new(APPLICATION);
    fake.noise = vec![
        // Another node's answer to a similar question, and its abort.
        other(0x586, &[0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10]),
        other(0x586, &[0x80, 0x57, 0x1F, 1, 0, 0, 2, 6]),
        // Heartbeats, emergencies, an answer that is too short, a remote frame.
        other(0x705, &[0x7F]),
        other(0x706, &[0]),
        other(0x085, &[0; 8]),
        other(0x585, &[0x80, 0, 0]),
        Frame::new_remote(StandardId::new(0x585).unwrap(), 8).unwrap(),
    ];
    run(&mut fake, FlashOptions::default()).0.unwrap();
    assert_eq!(fake.blocks.concat(), data!("identity-110.blk"));
}

#[test]
fn answers_that_come_late_do_not_stand_for_others() {
    // Each answer takes longer than the time-out: no step may count as done.
    let slow = || bootloader(|fake| fake.latency = Duration::from_millis(700));
    let mut fake = slow();
    assert!(run(&mut fake, FlashOptions::default()).0.is_err());
    assert_eq!(fake.count("command 83"), 0);
    // With a longer time-out the update succeeds.
    let (mut fake, timing) = (slow(), Timing::default().sdo(Duration::from_secs(2)));
    let mut session = Session::new(&mut fake, node(), timing);
    flash(&mut session, file(), &FlashOptions::default(), &mut |_| {}).unwrap();
}

#[test]
fn cancelling_aborts_the_transfer() {
    for knows_blocks in [Blocks::Refused(0x0504_0001), Blocks::Known(5)] {
        let mut fake = bootloader(|fake| fake.knows_blocks = knows_blocks);
        let flag = Arc::new(AtomicBool::new(false));
        let mut session = Session::new(&mut fake, node(), Timing::default());
        session.cancel_by(flag.clone());
        let result = flash(&mut session, file(), &FlashOptions::default(), &mut |event| {
            if matches!(event, Event::Progress { done, .. } if done > 300) {
                flag.store(true, Ordering::Relaxed);
            }
        });
        assert_eq!(result.unwrap_err().number(), 0x6000_0011);
        // The requests after it find out the state of the device.
        let aborts = fake.log.iter().rposition(|entry| entry == "abort 08000000").unwrap();
        assert!(fake.log[aborts + 1..].iter().all(|entry| entry.starts_with("read ")), "{:?}", fake.log);
        // The next run works without any other step.
        run(&mut fake, FlashOptions::default()).0.unwrap();
    }
}

/// A device that has all data when the update is cancelled still completes its program.
#[test]
fn what_is_complete_soon_after_a_cancel_is_complete() {
    let mut fake = Fake::new(BOOTLOADER);
    let flag = Arc::new(AtomicBool::new(false));
    let mut session = Session::new(&mut fake, node(), Timing::default());
    session.cancel_by(flag.clone());
    let mut events = Vec::new();
    let result = flash(&mut session, file(), &FlashOptions::default(), &mut |event| {
        if matches!(event, Event::Progress { done, total } if done == total) {
            flag.store(true, Ordering::Relaxed);
        }
        events.push(event);
    });
    assert_eq!(result.unwrap_err().number(), 0x6000_0011);
    assert_eq!(left(&events), DeviceState::Unreleased);
}

#[test]
fn an_adapter_that_goes_away_ends_it_at_any_frame() {
    let mut fake = Fake::new(APPLICATION);
    run(&mut fake, FlashOptions::default()).0.unwrap();
    for frames in 0..fake.sent.len() {
        let mut fake = device(APPLICATION, |fake| fake.frames_left = frames);
        let error = fails(&mut fake);
        assert_eq!(error.number(), 0x6000_0303, "{error}");
    }
}

#[test]
fn info_in_words() {
    let mut fake = Fake::new(APPLICATION);
    let mut session = Session::new(&mut fake, node(), Timing::default());
    assert_eq!(
        info(&mut session).unwrap().to_string(),
        "\
node 5: an application (device type 00020192h)
  device name       a device with a long name
  hardware version  not reported
  software version  v1?
  vendor-ID         0000003Fh
  product code      000004D2h
  revision          not reported
  serial number     not reported
  error register    00h (no error)
  dialect           block (block files, SYS TEC)
  program 1
    state           running
    CRC             00000000h
    status          ok
"
    );
}

/// A bus on which any frame may arrive at any time.
struct Chaos {
    now: Duration,
    frames: Vec<(u16, Vec<u8>)>,
    next: usize,
}

impl Adapter for Chaos {
    fn send(&mut self, _: &Frame) -> Result<(), coboot_can::AdapterError> {
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, coboot_can::AdapterError> {
        if timeout.is_zero() {
            return Ok(None);
        }
        self.now += Duration::from_millis(10).min(timeout);
        let (id, data) = &self.frames[self.next % self.frames.len()];
        self.next += 1;
        assert!(self.next < 1_000_000, "a hang");
        Ok(Some(Frame::of(CobId::new(*id).unwrap(), data)))
    }

    fn now(&self) -> Duration {
        self.now
    }
}

/// An upload whose segments are all empty: each is a valid answer, and none is the last.
#[test]
fn an_upload_without_end_is_given_up() {
    let segments = [0x0E, 0x1E].map(|command| (0x585, vec![command, 0, 0, 0, 0, 0, 0, 0]));
    let frames = [(0x585, vec![0x41, 0x00, 0x10, 0, 0, 1, 0, 0])]
        .into_iter()
        .chain(segments.into_iter().cycle().take(20_000))
        .collect();
    let mut chaos = Chaos { now: Duration::ZERO, frames, next: 0 };
    let mut session = Session::new(&mut chaos, node(), Timing::default());
    let error = session.read_once(canopen::Address::new(0x1000, 0)).unwrap_err();
    assert!(matches!(error, Error::Protocol { .. }), "{error:?}");
    assert!(chaos.now >= Duration::from_secs(60) && chaos.now < Duration::from_secs(61), "{:?}", chaos.now);
}

/// Endless answers to other requests.
#[test]
fn answers_that_never_fit_are_given_up() {
    let answer = (0x585, vec![0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10]);
    let mut chaos = Chaos { now: Duration::ZERO, frames: vec![answer], next: 0 };
    let mut session = Session::new(&mut chaos, node(), Timing::default());
    assert!(session.command(1, canopen::program::ProgramControl::Clear).is_err());
}

proptest! {
    /// No answer of a device causes a panic or a hang of the host, or makes it report a program
    /// that is not in the device.
    #[test]
    fn no_device_can_break_the_host(
        frames in prop::collection::vec(
            (
                prop::sample::select(vec![0x585u16, 0x585, 0x585, 0x705, 0x085]),
                prop_oneof![
                    prop::collection::vec(any::<u8>(), 0..9),
                    (prop::sample::select(vec![0x60u8, 0x20, 0x30, 0x43, 0x41, 0x80, 0x00, 0xA4, 0xA2, 0xA1]), any::<[u8; 7]>())
                        .prop_map(|(command, rest)| [&[command][..], &rest].concat()),
                    Just(vec![0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10]),
                    Just(vec![0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
                    Just(vec![0xA4, 0x50, 0x1F, 1, 127, 0, 0, 0]),
                    (any::<u8>(), any::<u8>()).prop_map(|(ackseq, blksize)| vec![0xA2, ackseq, blksize, 0, 0, 0, 0, 0]),
                    Just(vec![0x43, 0x57, 0x1F, 1, 0, 0, 0, 0]),
                ],
            ),
            1..12,
        ),
    ) {
        let mut chaos = Chaos { now: Duration::ZERO, frames, next: 0 };
        let timing = Timing::default().command(Duration::from_secs(2));
        let mut session = Session::new(&mut chaos, node(), timing);
        let result = flash(&mut session, file(), &FlashOptions::default(), &mut |_| {});
        prop_assert!(result.is_err());
        prop_assert!(chaos.now < Duration::from_secs(600), "{:?}", chaos.now);
        let mut session = Session::new(&mut chaos, node(), timing);
        let _ = info(&mut session);
    }
}
