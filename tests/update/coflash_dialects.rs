//! `coflash` detects the dialect of the firmware and updates it accordingly: images and Intel HEX
//! into the standard bootloader, the profiles of ESAcademy and lifts.

use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::renewal::{plain, version as version_of};
use coboot_tests::{firmware, tools};
use coflash_core::device::{recognise, Dialect, Doing};
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::{read, Format};
use coflash_core::file::Program;
use coflash_core::update::dialect::read_locked;
use coflash_core::update::event::{Note, Phase};
use coflash_core::update::{flash, DeviceState, Event, FlashOptions, Password, Report};
use coflash_core::Error;
use shared_abi::layout::stm32f407g_disc1_two;
use shared_abi::ram_image::Version;

const VERSION: Address = Address::new(0x100A, 0);

const ESACADEMY: &str = "bootloader-esacademy.elf";
/// The profile's node-ID.
const ESACADEMY_NODE: u8 = 64;

const LIFT: &str = "bootloader-lift.elf";
const APP_LIFT: &str = "app-lift.elf";
const APP_LIFT_V2: &str = "app-lift-v2.elf";
/// The node-ID of every lift bootloader (CiA 814-1 clause 5).
const LIFT_NODE: u8 = 126;
/// The passwords of this repository's firmware.
const PASSWORD: &str = "coboot";

/// How long the firmware refuses passwords after the first wrong one, plus a margin; in ms.
const PENALTY_MS: u64 = 600;

fn update(
    bench: &mut Bench,
    node: u8,
    blocks: &Program,
    options: &FlashOptions,
) -> (Result<Report, Error>, Vec<Event>) {
    let mut events = Vec::new();
    let result = flash(&mut bench.session_with(node), blocks, options, &mut |event| events.push(event));
    (result, events)
}

fn version(bench: &mut Bench, node: u8) -> String {
    bench.session_with(node).read_text(VERSION).unwrap()
}

fn power_cycle(bench: &mut Bench, node: u8) {
    bench.power_cycle();
    bench.await_program_of(node, 1000);
}

#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn images_and_intel_hex_update_the_standard_firmware() {
    for dialect in [Dialect::Raw, Dialect::Hex] {
        let mut bench = Bench::new().switched_on();
        let options = FlashOptions::default().dialect(Some(dialect)).verify(true);
        // Into an empty device, and into a device with a running application.
        for (image, expected) in [(firmware::APP_V1, "1.0.0"), (firmware::APP_V2, "2.0.0")] {
            let blocks = firmware::blocks(image);
            let (result, events) = update(&mut bench, NODE, &blocks, &options);
            let report = result.unwrap();
            assert_eq!((report.dialect, report.repeats), (dialect, 0));
            assert!(events.contains(&Phase::Verified { crc: blocks.crc() }.into()), "{events:?}");
            assert!(!events.contains(&Phase::Released.into()), "{events:?}");
            assert_eq!(version(&mut bench, NODE), expected);
            let program = &bench.machine().flash()[firmware::program_offset()..];
            let stored = &program[..report.program_size as usize];
            assert_eq!(stored, &*blocks.flash_image());
        }
        power_cycle(&mut bench, NODE);
        assert_eq!(version(&mut bench, NODE), "2.0.0", "it is valid without a signature");
        bench.assert_nothing_unmodelled();
    }
}

#[test]
fn the_profile_of_esacademy_is_recognised_and_updated() {
    let mut bench = Bench::of_image(ESACADEMY);
    bench.power_on();
    bench.await_boot_up_of(ESACADEMY_NODE, 100);
    // "Wrong" instead of "INIT".
    let wrong = FlashOptions::default().unlock(Password::new("0x57726F6E"));
    let (result, events) = update(&mut bench, ESACADEMY_NODE, &firmware::blocks(firmware::APP_V1), &wrong);
    assert!(matches!(result, Err(Error::Refused { doing: Doing::Unlock, .. })), "{result:?}");
    assert_eq!(events.last().and_then(Event::left).map(|left| left.state), Some(DeviceState::Untouched));
    // The next attempt must wait.
    bench.run_ms(PENALTY_MS);

    for (image, expected) in [(firmware::APP_V1, "1.0.0"), (firmware::APP_V2, "2.0.0")] {
        let (result, events) =
            update(&mut bench, ESACADEMY_NODE, &firmware::blocks(image), &FlashOptions::default());
        let report = result.unwrap_or_else(|error| panic!("{error}: {events:?}"));
        assert_eq!(report.dialect, Dialect::EsAcademy);
        assert!(events.contains(&Note::Unlocked.into()), "{events:?}");
        assert_eq!(version(&mut bench, ESACADEMY_NODE), expected);
    }
    power_cycle(&mut bench, ESACADEMY_NODE);
    assert_eq!(version(&mut bench, ESACADEMY_NODE), "2.0.0");
    bench.assert_nothing_unmodelled();
}

/// A lift bootloader needs a board with a region for its set of parameters.
#[test]
fn the_profile_of_lifts_is_recognised_updated_and_read_back() {
    let layout = &stm32f407g_disc1_two::LAYOUT;
    if firmware::board().chip != layout.chip {
        // The tests run for another chip.
        return;
    }
    let blocks = |name: &str| {
        let elf = firmware::elf(&firmware::of_board(layout.board, name));
        let options = Options::default().region(Region::Strict(layout.programs[0].into()));
        program_of(read(&elf, None, None).unwrap(), &options).unwrap().program
    };
    let mut bench = Bench::of_image(&firmware::of_board(layout.board, LIFT));
    bench.power_on();
    bench.await_boot_up_of(LIFT_NODE, 1000);
    let options = FlashOptions::default().unlock(Password::new(PASSWORD));
    // A device without a program is in its bootloader, and its own node-ID is not visible.
    for (from, image, expected) in [(LIFT_NODE, APP_LIFT, "1.0.0"), (NODE, APP_LIFT_V2, "2.0.0")] {
        let (result, events) = update(&mut bench, from, &blocks(image), &options);
        let report = result.unwrap_or_else(|error| panic!("{error}: {events:?}"));
        assert_eq!(report.dialect, Dialect::Lift);
        assert!(report.running.is_some_and(|running| !running.is_bootloader()));
        assert!(version(&mut bench, NODE).contains(expected), "{}", version(&mut bench, NODE));
    }
    let mut session = bench.session_with(NODE);
    let running = session.device_type().unwrap().unwrap();
    assert_eq!(recognise(&mut session, running, 1).unwrap(), Dialect::Lift);

    let program = Address::new(0x1F50, 1);
    let stored = read_locked(&mut session, program, None, Password::new(PASSWORD), &mut |_| {}).unwrap();
    assert_eq!(stored, &*blocks(APP_LIFT_V2).flash_image());
    bench.await_boot_up(2000);
    assert!(version(&mut bench, NODE).contains("2.0.0"), "it runs again");

    // Its set of parameters (CiA 814-1 clause 6.4): any bytes, stored and read back.
    let set: Vec<u8> = (0..3001_u32).map(|i| (i * i / 7) as u8).collect();
    let raw = read(&set, Some(Format::Raw), Some(layout.programs[1].base)).unwrap();
    let blocks_of_set = program_of(raw, &Options::default()).unwrap().program;
    let second = options.program(2);
    update(&mut bench, NODE, &blocks_of_set, &second).0.unwrap();
    assert!(version(&mut bench, NODE).contains("2.0.0"), "the program continues");
    let mut session = bench.session_with(NODE);
    let parameters = Address::new(0x1F50, 2);
    let stored = read_locked(&mut session, parameters, None, Password::new(PASSWORD), &mut |_| {}).unwrap();
    assert_eq!(stored, set);
    bench.await_boot_up(2000);

    // Its bootloader, from the running program and back; each restart wants the password again.
    let new = version_of(&firmware::of_board(layout.board, LIFT), 0x0009_0001);
    let new = plain(&new);
    let none = FlashOptions::default();
    let refused = flash(&mut bench.session_with(NODE), &new, &none, &mut |_| {});
    assert!(matches!(refused, Err(Error::NoPassword { .. })), "{refused:?}");
    let report = flash(&mut bench.session_with(NODE), &new, &options, &mut |_| {}).unwrap();
    let renewal = report.renewal.unwrap();
    assert_eq!((renewal.number, renewal.to), (3, Version(0x0009_0001)), "it follows the set of parameters");
    assert!(version(&mut bench, NODE).contains("2.0.0"), "the program runs again");

    let wrong = FlashOptions::default().unlock(Password::new("Coboot"));
    let (result, events) = update(&mut bench, NODE, &blocks(APP_LIFT), &wrong);
    assert!(matches!(result, Err(Error::Refused { doing: Doing::Unlock, .. })), "{result:?}");
    assert_eq!(events.last().and_then(Event::left).map(|left| left.state), Some(DeviceState::Untouched));
    assert!(version(&mut bench, NODE).contains("2.0.0"), "it goes on");
    bench.run_ms(PENALTY_MS);

    update_by_the_lines_of_the_page(bench, layout.board, &set);
}

/// The lines of the page, but for node-ID and password, with this set of parameters in the device.
fn update_by_the_lines_of_the_page(bench: Bench, board: &str, set: &[u8]) {
    let folder = kit::folder!("lift-of-the-page");
    std::fs::write(folder.join("app.elf"), firmware::elf(&firmware::of_board(board, APP_LIFT))).unwrap();
    let mut endpoint = Endpoint::new(bench);
    let page =
        include_str!("../../docs/coflash.md").lines().filter_map(|line| line.strip_prefix("$ coflash "));
    let lines: Vec<_> =
        page.filter(|line| line.ends_with("--unlock opensesame") || line.contains("opensesame -o")).collect();
    assert_eq!(lines.len(), 4, "{lines:?}");
    for line in lines {
        let line = line.replace("--node 5", &format!("--node {NODE}")).replace("opensesame", PASSWORD);
        let mut command = tools::coflash();
        command.args(line.split(' ')).env("COFLASH_BUS", endpoint.url()).current_dir(&*folder);
        println!("{line}: {}", endpoint.succeed(&mut command));
    }
    assert_eq!(std::fs::read(folder.join("set.bin")).unwrap(), set);
    endpoint.bench.assert_nothing_unmodelled();
}
