//! A whole program in one download: raw image and Intel HEX, on a strict flash.

use boot_core::bootloader::{entries, entry_count, Config};
use boot_core::control::Policy;
use boot_core::flash::FlashFault;
use boot_core::profile::Profile;
use canopen::od::{Address, Entry, Objects};
use canopen::{AbortCode, Instant};
use kit::bench::*;
use kit::boot::{leaked, Boot};
use kit::ihex::{record, END_OF_FILE as EOF};
use kit::model::{ModelFlash, CHIP};
use proptest::prelude::*;
use shared_abi::boot_report::BootReport;
use shared_abi::label::Label;
use shared_abi::warm_start::{BootRequest, Owed};

const STORE: AbortCode = AbortCode(0x0800_0020);
const STATE: AbortCode = AbortCode(0x0800_0022);
const TOO_LONG: AbortCode = AbortCode(0x0607_0012);
const RESET_STAT: u8 = 0x02;
/// Vendor-ID and product code.
const IDENTITY: (u32, u32) = (0x0102_0304, 0x0A0B_0C0D);

/// A program as HEX in records of `len` bytes, from its base.
fn hex(program: &[u8], len: usize, end: &str) -> String {
    let base = PROGRAM.base;
    let mut text = record(0, 4, &((base >> 16) as u16).to_be_bytes()) + end;
    for (i, data) in program.chunks(len).enumerate() {
        text += &record((base as usize + i * len) as u16, 0, data);
        text += end;
    }
    text + EOF + end
}

#[test]
fn a_raw_image_is_stored_is_valid_and_starts() {
    let image = program(3001, 0x11);
    for (size, pieces) in [(Some(3001), 7), (None, 7), (Some(3001), 1), (None, 4)] {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::cleared(&mut flash);
        assert_eq!(bench.read_state(), 3, "there is no program");
        assert_eq!(bench.stream(&image, size, pieces), (Ok(()), 0));
        assert_eq!(bench.word(IDENTIFICATION), crc32(&image));
        assert_eq!(bench.read_state(), 0, "stopped");
        assert_eq!(bench.command(START), 0);
        assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Fresh(1)));
        assert_eq!(&flash.cells(PROGRAM)[..3001], image);
        assert!(flash.cells(PROGRAM)[3001..].iter().all(|byte| *byte == 0xFF));
        assert_eq!(autostart(&flash), Ok(0x11));
    }
}

#[test]
fn hex_is_stored_whatever_its_records_and_line_ends_are() {
    let image = program(1000, 0x22);
    for (len, end, pieces) in [(16, "\n", 7), (32, "\r\n", 7), (1, "\r", 3), (255, "", 1), (7, " \r\n\n", 6)]
    {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::with_buffer(&mut flash, Policy::DEFAULT, 1024);
        assert_eq!(bench.command(CLEAR), 0);
        let text = hex(&image, len, end);
        assert_eq!(bench.stream(text.as_bytes(), None, pieces), (Ok(()), 0), "{len} {end:?}");
        assert_eq!(bench.word(IDENTIFICATION), crc32(&image));
        assert_eq!(&flash.cells(PROGRAM)[..1000], image);
        assert_eq!(autostart(&flash), Ok(0x22));
    }
}

/// A record for which the device can never have room: refused without a wait.
#[test]
fn a_record_that_is_larger_than_half_the_queue_is_refused() {
    let mut bench = Bench::cleared(new_flash());
    let text = hex(&program(300, 0), 100, "\n");
    assert_eq!(bench.stream(text.as_bytes(), None, 7), (Err(AbortCode(0x0504_0005)), 0x04));
    assert_eq!(bench.stream(hex(&program(300, 0), 64, "\n").as_bytes(), None, 7), (Ok(()), 0));
}

/// Gaps read FFh and belong to the program; the order of records does not matter.
#[test]
fn hex_may_have_gaps_and_any_order() {
    let mut image = program(2000, 0x33);
    image[300..700].fill(0xFF);
    let base = PROGRAM.base;
    let upper = record(0, 4, &((base >> 16) as u16).to_be_bytes());
    let part = |from: usize, to: usize| {
        let records = image[from..to].chunks(16).enumerate();
        records
            .map(|(i, data)| record((base as usize + from + 16 * i) as u16, 0, data) + "\n")
            .collect::<String>()
    };
    let text = format!("{upper}\n{}{}{}{EOF}\n", part(700, 2000), part(8, 300), part(0, 8));
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::cleared(&mut flash);
    assert_eq!(bench.stream(text.as_bytes(), Some(text.len() as u32), 7), (Ok(()), 0));
    assert_eq!(bench.word(IDENTIFICATION), crc32(&image));
    assert_eq!(autostart(&flash), Ok(0x33));
}

/// CiA 302-3: 2 resets the program, which starts it; for block files it means RESET_STAT. A program
/// is fresh if it is started directly after its download: a release in between shows a master that
/// does not confirm by 80h, and hosts that send blocks release the program themselves.
#[test]
fn a_program_is_fresh_only_right_behind_a_stream() {
    let image = program(500, 0x45);
    let mut bench = Bench::cleared(new_flash());
    assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
    assert_eq!(bench.command(SET_SIGNATURE), 0);
    assert_eq!(bench.command(START), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Start(1)));
    // Reads in between change nothing, and neither does a second START.
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
    assert_eq!((bench.status(), bench.read_state()), (0, 0));
    assert_eq!(bench.command(START), 0);
    assert_eq!(bench.node.write(CONTROL, &[START]), Err(AbortCode(0x0800_0022)), "it leaves");
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Fresh(1)));

    let mut bench = Bench::cleared(new_flash());
    bench.install(&image);
    assert_eq!(bench.command(START), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Trial(1)));
}

#[test]
fn command_2_starts_behind_a_stream_alone() {
    let image = program(500, 0x44);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::cleared(&mut flash);
    assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
    assert_eq!(bench.command(RESET_STAT), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Fresh(1)));

    let mut bench = Bench::new(&mut flash);
    assert_eq!(bench.command(RESET_STAT), 0);
    assert_eq!(bench.node.take_boot_request(), None, "after a restart nobody has just sent one");
    bench.install(&image);
    assert_eq!(bench.command(RESET_STAT), 0);
    assert_eq!(bench.node.take_boot_request(), None, "a block file");
    // A refused stream does not count.
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.stream(b"nonsense that is long enough", None, 7), (Err(STORE), 4));
    assert_eq!(bench.command(RESET_STAT), 0);
    assert_eq!(bench.node.take_boot_request(), None);
}

#[test]
fn a_profile_may_start_always_or_by_itself_or_want_a_signature() {
    let image = program(500, 0x55);
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::with(&mut flash, Policy { reset_starts: true, ..Policy::DEFAULT });
    assert_eq!(bench.command(RESET_STAT), 2, "NOVALPROG");
    assert_eq!(bench.node.take_boot_request(), None);
    bench.install(&image);
    assert_eq!(bench.command(RESET_STAT), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Trial(1)));

    let mut bench = Bench::with(&mut flash, Policy { starts_by_itself: true, ..Policy::DEFAULT });
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.stream(hex(&image, 16, "\n").as_bytes(), None, 7), (Ok(()), 0));
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Fresh(1)));

    let mut bench = Bench::with(&mut flash, Policy { valid_without_signature: false, ..Policy::DEFAULT });
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
    assert_eq!(bench.command(START), 0);
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Fresh(1)));
}

/// Hosts without polling: START directly after the last segment waits for the verification.
#[test]
fn start_right_behind_the_last_segment_waits_for_the_verification() {
    let image = program(2000, 0x66);
    for command in [START, RESET_STAT] {
        let mut bench = Bench::cleared(new_flash());
        assert_eq!(bench.pour(&image, None, 7), Ok(()));
        assert_eq!(bench.status(), 1, "busy");
        assert!(bench.node.is_finishing(), "a reset now would lose the program");
        assert_eq!(bench.node.write(CONTROL, &[command]), Ok(()));
        assert_eq!(bench.node.take_boot_request(), None);
        bench.settle();
        assert!(!bench.node.is_finishing());
        assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Fresh(1)));
    }
    // A program that fails the verification does not start.
    let mut bench = Bench::cleared(new_flash());
    assert_eq!(bench.pour(&image, None, 7), Ok(()));
    assert_eq!(bench.node.write(CONTROL, &[START]), Ok(()));
    let operations = bench.node.flash().operations;
    bench.node.flash().fail = Some((operations + 1, FlashFault::Failed));
    bench.settle();
    assert_eq!((bench.status(), bench.node.take_boot_request()), (0x0A, None));
}

/// A fault in the first piece has no effect on the old program, and the next attempt works. The
/// sent data, the announced size, and the resulting abort and status.
type Case<'a> = (&'a str, Vec<u8>, Option<u32>, AbortCode, u32);

#[test]
fn what_is_seen_in_time_erases_nothing() {
    let old = program(600, 0x77);
    let image = program(600, 0x88);
    let mut elsewhere = image.clone();
    elsewhere[4..8].copy_from_slice(&0x0800_0101_u32.to_le_bytes());
    let text = hex(&image, 16, "\n");
    let at = |address: u32, data: &[u8]| {
        format!(
            "{}\n{}\n",
            record(0, 4, &((address >> 16) as u16).to_be_bytes()),
            record(address as u16, 0, data)
        )
    };
    // As objcopy writes a program, whose label comes after the gap after its vectors.
    let mut other = image.clone();
    other[0x1E0..0x200].copy_from_slice(&Label::new(IDENTITY.0, IDENTITY.1 ^ 1, 7).emit());
    let without = |text: &str, gap: core::ops::Range<usize>| {
        let lines = text.lines().enumerate().filter(|(at, _)| !gap.contains(at));
        lines.map(|(_, line)| format!("{line}\n")).collect::<String>()
    };
    let cases: Vec<Case<'_>> = vec![
        ("another product, HEX", without(&hex(&other, 8, "\n"), 0x32..0x3D).into(), None, STORE, 0x82),
        ("no reset vector, HEX", without(&hex(&image, 4, "\n"), 2..3).into(), None, STORE, 0x04),
        ("one word, HEX", without(&hex(&image, 4, "\n"), 2..0x90).into(), None, STORE, 0x04),
        ("linked for another place, HEX", without(&text, 1..0x11).into(), None, STORE, 0x0C),
        ("no format", b"<xml>firmware</xml>".to_vec(), None, STORE, 0x04),
        (
            "a stack outside RAM",
            [0, 0, 0, 0x30, 1, 8, 0, 8, 0, 0, 0, 0, 0, 0, 0, 0].to_vec(),
            None,
            STORE,
            0x04,
        ),
        ("vectors elsewhere", elsewhere.clone(), None, STORE, 0x04),
        ("vectors elsewhere, HEX", hex(&elsewhere, 16, "\n").into(), None, STORE, 0x04),
        ("announced too large", image.clone(), Some(PROGRAM.size + 1), TOO_LONG, 0x0C),
        ("a raw stub", image[..6].to_vec(), None, STORE, 0x04),
        ("wrong checksum", text.replacen("\n:100800", "\n:100801", 1).into(), None, STORE, 0x06),
        ("no record", text.replacen("\n:", "\n;", 1).into(), None, STORE, 0x04),
        ("unknown type", format!("{}\n", record(0, 6, &[])).into(), None, STORE, 0x04),
        ("over the bootloader", at(0x0800_0000, &[0; 16]).into(), None, STORE, 0x0E),
        ("over the parameters", at(0x0800_0400, &[0; 16]).into(), None, STORE, 0x0E),
        ("after the program", at(PROGRAM.end(), &[0; 16]).into(), None, STORE, 0x0C),
        ("over its end", at(PROGRAM.end() - 8, &[0; 16]).into(), None, STORE, 0x0C),
        ("RAM", at(0x2000_0000, &[0; 16]).into(), None, STORE, 0x0C),
        ("the end of the address space", at(0xFFFF_FFF8, &[0; 16]).into(), None, STORE, 0x0C),
        ("nothing but the end", EOF.into(), None, STORE, 0x04),
        ("nothing but the end, announced", EOF.into(), Some(11), AbortCode(0x0607_0013), 0x04),
        ("no end", text[..200].into(), None, STORE, 0x04),
    ];
    for (what, data, size, abort, status) in cases {
        let mut flash = ModelFlash::new(&CHIP);
        // Large enough for a first piece of 1 KiB.
        let policy = Policy { identity: Some(IDENTITY), ..Policy::DEFAULT };
        let mut bench = Bench::with_buffer(&mut flash, policy, 8192);
        bench.release(&old);
        assert_eq!(bench.command(CLEAR), 0);
        bench.node.flash().touched.clear();
        assert_eq!(bench.stream(&data, size, 7), (Err(abort), status), "{what}");
        assert_eq!(bench.node.flash().touched, [], "{what}: the flash was touched");
        assert_eq!(bench.command(CLEAR), 0, "{what}");
        assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0), "{what}: the next attempt");
        assert_eq!(autostart(&flash), Ok(0x88), "{what}");
    }
}

#[test]
fn what_is_seen_later_leaves_no_program_and_the_next_attempt_works() {
    let image = program(3000, 0x99);
    let text = hex(&image, 16, "\n");
    let late = text.len() - 200;
    let mut damaged = text.clone().into_bytes();
    let digit = damaged[late..].iter().position(|byte| *byte == b'\n').unwrap() + late - 1;
    damaged[digit] = if damaged[digit] == b'0' { b'1' } else { b'0' };
    let too_large = [&image[..], &vec![0x55; PROGRAM.size as usize]].concat();
    let cases: Vec<(&str, Vec<u8>, AbortCode, u32)> = vec![
        ("checksum", damaged, STORE, 0x06),
        ("no EOF", text[..late].into(), STORE, 0x04),
        ("behind EOF", format!("{text}:").into(), STORE, 0x04),
        ("too large", too_large, STORE, 0x0C),
    ];
    for (what, data, abort, status) in cases {
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::cleared(&mut flash);
        assert_eq!(bench.stream(&data, None, 7), (Err(abort), status), "{what}");
        assert_eq!(bench.read_state(), 3, "{what}");
        assert_eq!(bench.command(START), 2, "{what}: NOVALPROG");
        assert_eq!(bench.stream(&image, None, 7).0, Err(STATE), "{what}: CLEAR comes first");
        // Blocks cannot continue a stream either.
        assert_eq!(bench.block(&block(0, 0, &[0; 8])).0, Err(STATE), "{what}: CLEAR comes first");
        assert_eq!(bench.command(CLEAR), 0);
        assert_eq!(bench.stream(text.as_bytes(), None, 7), (Ok(()), 0), "{what}");
        assert_eq!(autostart(&flash), Ok(0x99), "{what}");
    }
}

/// Two records for one address: detected when the second one is programmed.
#[test]
fn a_place_that_is_written_twice_is_not_blank() {
    let image = program(600, 0xA0);
    let text = hex(&image, 16, "\n").replace(EOF, &(record(0x0900, 0, &[0]) + EOF));
    let mut bench = Bench::cleared(new_flash());
    assert_eq!(bench.stream(text.as_bytes(), None, 7), (Ok(()), 0x08), "NOTCLEARED");
    assert_eq!(bench.command(START), 2, "NOVALPROG");
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
}

#[test]
fn a_client_that_breaks_off_leaves_no_program() {
    let image = program(3000, 0xA1);
    let mut bench = Bench::cleared(new_flash());
    // Before a piece is complete nothing is lost, and the download may begin again at once.
    bench.begin(&image[..14]);
    bench.node.download_cancel(DATA);
    bench.settle();
    assert_eq!(bench.status(), 0);
    bench.begin(&image[..2100]);
    bench.node.download_cancel(DATA);
    bench.settle();
    assert_eq!(bench.status(), 4);
    assert_eq!(bench.command(START), 2);
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
}

/// Most public scripts send STOP, data and START. STOP counts as CLEAR for one download in one transfer, until
/// the next reset; the block file keeps the order of the manual.
#[test]
fn stop_counts_as_clear_for_one_download_in_one_transfer() {
    const STOP: u8 = 0x00;
    const NOT_CLEARED: (Result<(), AbortCode>, u32) = (Err(STATE), 0x08);
    let image = program(1500, 0xB3);
    let text = hex(&image, 16, "\n");
    let mut flash = ModelFlash::new(&CHIP);
    Bench::cleared(&mut flash).install(&program(600, 0x11));
    for _ in 0..2 {
        for data in [&image[..], text.as_bytes()] {
            let mut bench = Bench::new(&mut flash);
            assert_eq!(bench.stream(data, None, 7), NOT_CLEARED);
            assert_eq!(bench.command(STOP), 0x08);
            assert_eq!(bench.block(&block(0, 0, &[0; 8])), NOT_CLEARED);
            assert_eq!(bench.stream(b"no program", None, 7), (Err(STORE), 0x04));
            assert_eq!(bench.stream(data, None, 7), (Ok(()), 0));
            assert_eq!(bench.stream(data, None, 7), NOT_CLEARED, "once");
            // A download that broke off; then there is no program, and the flash is not blank.
            for resets in [false, true] {
                assert_eq!(bench.command(STOP), 0x08);
                bench.begin(&data[..1400]);
                bench.node.download_cancel(DATA);
                bench.settle();
                if resets {
                    bench = Bench::new(&mut flash);
                    assert_eq!(bench.command(STOP), 0);
                } else {
                    assert_eq!(bench.stream(data, None, 7).0, Err(STATE), "CLEAR or STOP comes first");
                    bench.command(STOP);
                }
                assert_eq!(bench.stream(data, None, 7), (Ok(()), 0));
                assert_eq!(bench.stream(data, None, 7), NOT_CLEARED);
            }
            // A reset ends it.
            assert_eq!(bench.command(STOP), 0x08);
        }
    }
    let mut bench = Bench::new(&mut flash);
    assert_eq!(bench.stream(&image, None, 7), NOT_CLEARED);
    assert_eq!((bench.read_state(), bench.word(IDENTIFICATION)), (0, crc32(&image)));
    // A program that has answered STOP itself leaves it without a node-ID.
    for (owed, is_taken) in [((1, 0, 0), true), ((1, 3, 0), false), ((2, 0, 0), false), ((0, 0, 0), false)] {
        let (program, value, node_id) = owed;
        let owed = Owed { program, value, node_id };
        let boot = Boot { report: BootReport { owed, ..BootReport::NONE }, ..Boot::new(&CONFIG, node()) };
        let (buffer, sealed) = leaked(256);
        let mut bench = Bench { node: boot.on(&mut flash, buffer, sealed) };
        assert_eq!(bench.stream(&image, None, 7).0.is_ok(), is_taken, "{owed:?}");
    }
}

/// Data of the application, which are any bytes, come in one transfer.
#[test]
fn stop_counts_as_clear_for_data() {
    let mut bench = Bench::with(new_flash(), Policy { data: Some(1), ..Policy::DEFAULT });
    assert_eq!(bench.stream(b"first", None, 7), (Ok(()), 0));
    assert_eq!(bench.stream(b"second", None, 7), (Err(STATE), 0x08));
    assert_eq!(bench.command(0x00), 0x08);
    assert_eq!(bench.stream(b"second", None, 7), (Ok(()), 0));
}

/// The formats do not mix within a session.
#[test]
fn two_formats_in_one_session_are_refused() {
    let image = program(600, 0xB2);
    let blocks = block_file(&image, 96);
    let mut bench = Bench::cleared(new_flash());
    bench.good(&blocks[0]);
    assert_eq!(bench.stream(&image, None, 7), (Err(STATE), 0x88));
    assert_eq!(bench.stream(hex(&image, 16, "\n").as_bytes(), None, 7), (Err(STATE), 0x88));
    bench.all_good(&blocks[1..]);
    assert_eq!(bench.command(CLEAR), 0);
    assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
    assert_eq!(bench.block(&blocks[1]), (Err(STATE), 0x88));
    assert_eq!(bench.block(&blocks[0]), (Err(STATE), 0x08), "there is a program");
    assert_eq!(bench.stream(&image, None, 7), (Err(STATE), 0x08), "there is a program");
}

/// An error of the flash ends the transfer with its abort: 06060000h for programming, 08000000h for
/// erasing (table 3 of Paulus).
#[test]
fn the_flash_fails_under_a_stream() {
    let image = program(3000, 0xC3);
    let fault = |operation: u32| {
        let mut bench = Bench::cleared(new_flash());
        let before = bench.node.flash().operations;
        bench.node.flash().fail = Some((before + operation, FlashFault::Failed));
        let (outcome, status) = bench.stream(&image, None, 7);
        assert_eq!(bench.command(CLEAR), 0);
        assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
        (outcome, status)
    };
    let found: Vec<_> = (1..60).map(fault).collect();
    assert!(found.contains(&(Err(AbortCode(0x0606_0000)), 0x0A)), "{found:?}");
    assert!(found.contains(&(Err(AbortCode(0x0800_0000)), 0x0A)), "{found:?}");
}

/// The ESAcademy profile: locked until the password arrives; after a wrong password the device
/// refuses every attempt for a time.
#[test]
fn a_password_opens_1f50_and_a_wrong_one_is_slowed_down() {
    const ENABLE: Address = Address::new(0x7F50, 1);
    static ENTRIES: [Entry; entry_count(1, Profile::ESACADEMY.extras)] =
        entries(1, Profile::ESACADEMY.extras).entries();
    fn of_esacademy(flash: &mut ModelFlash) -> Bench<'_> {
        let Profile { download, password, .. } = Profile::ESACADEMY;
        Bench::with_config(flash, Config { entries: &ENTRIES, download, password, ..CONFIG }, 1024)
    }
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = of_esacademy(&mut flash);
    let image = program(600, 0x12);
    for command in [CLEAR, SET_SIGNATURE, CLR_SIGNATURE] {
        assert_eq!(bench.node.write(CONTROL, &[command]), Err(STATE));
    }
    assert_eq!(bench.stream(&image, None, 7), (Err(STATE), 0x84));
    // "INIT" in reversed order, half a second of refusal, twice that after the second one.
    let mut at = |ms: u32, password: &[u8; 4]| {
        bench.node.set_time(Instant::from_millis(ms));
        let answer = bench.node.write(ENABLE, password);
        // A reset would permit another attempt at once.
        (answer, bench.node.is_finishing())
    };
    assert_eq!(at(1000, b"INIT"), (Err(AbortCode(0x0609_0030)), true));
    assert_eq!(at(1499, b"TINI"), (Err(STATE), true));
    assert_eq!(at(1500, b"TINO"), (Err(AbortCode(0x0609_0030)), true));
    assert_eq!(at(2499, b"TINI"), (Err(STATE), true));
    assert_eq!(at(2500, b"TINI"), (Ok(()), false));
    assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Fresh(1)), "by itself");
    // The next password makes it invalid at once.
    let mut bench = of_esacademy(&mut flash);
    assert_eq!(bench.read_state(), 0);
    bench.node.write(ENABLE, b"TINI").unwrap();
    bench.settle();
    assert_eq!((bench.read_state(), bench.word(IDENTIFICATION)), (3, 0));
}

proptest! {
    /// Any bytes after a possibly valid beginning: accepted or refused, nothing outside is written,
    /// nothing hangs, and the next attempt works.
    #[test]
    fn any_stream_is_answered_and_the_next_attempt_works(
        start in prop_oneof![Just(Vec::new()), Just(b":".to_vec()), Just(program(8, 1)), Just(hex(&program(64, 1), 16, "\n").into_bytes())],
        rest in proptest::collection::vec(any::<u8>(), 0..400),
        cut in any::<proptest::sample::Index>(),
        pieces in 1_usize..8,
    ) {
        let mut data = start;
        let at = cut.index(data.len() + 1);
        data.splice(at..at, rest);
        let mut flash = ModelFlash::new(&CHIP);
        let mut bench = Bench::cleared(&mut flash);
        let _ = bench.stream(&data, None, pieces);
        let image = program(700, 0xF1);
        prop_assert_eq!(bench.command(CLEAR), 0);
        prop_assert_eq!(bench.stream(&image, None, 7), (Ok(()), 0));
        let parameters = LAYOUT.parameters;
        for region in &bench.node.flash().touched {
            let inside = [PROGRAM, parameters[0], parameters[1]];
            prop_assert!(inside.iter().any(|own| own.contains(region.base, region.size)));
        }
        prop_assert_eq!(autostart(&flash), Ok(0xF1));
    }
}
