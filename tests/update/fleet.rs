//! Boards that get the same program at the same time, with the real firmware.

use std::process::Command;
use std::sync::atomic::Ordering;
use std::sync::Arc;
use std::time::Duration;

use canopen::program::{FlashError, DEVICE_STATE, PROGRAM_ID, STATE_RENEWAL};
use canopen::{Address, BitRate};
use coboot_can::Adapter as _;
use coboot_tests::bench::Bench;
use coboot_tests::endpoint::Endpoint;
use coboot_tests::firmware;
use coboot_tests::fleet::{file, Fleet, Update};
use coboot_tests::renewal::{crc_of, image_of, number};
use coflash_core::device::Doing;
use coflash_core::file::Program;
use coflash_core::update::event::{Note, Warning};
use coflash_core::update::many::ManyOptions;
use coflash_core::update::{DeviceState, Event};
use coflash_core::Error;
use emulator::bus::fault::FaultAction;
use emulator::frame::Frame;
use emulator::machine::{Machine, Operation};
use emulator::time::Span;
use shared_abi::layout::stm32f407g_disc1_two;
use shared_abi::renewal::{Progress, State};

const KIB: u32 = 40;

fn one_by_one() -> ManyOptions {
    ManyOptions::default().together(false)
}

/// Each device runs the program that it was sent, by its own account.
fn assert_all_have(fleet: &mut Fleet, devices: u8, crc: u32) {
    for node in 1..=devices {
        assert!(!fleet.bench.is_bootloader(node), "node {node}");
        assert_eq!(program(fleet, node), crc, "node {node}");
    }
}

/// 1F56h/1 of a device.
fn program(fleet: &mut Fleet, node: u8) -> u32 {
    fleet.bench.session_with(node).read_number(Address::new(PROGRAM_ID, 1)).unwrap()
}

fn together(update: &Update, device: usize) -> Option<usize> {
    update.events.iter().find_map(|(number, event)| match event {
        Event::Note(Note::Together { devices }) if *number == device => Some(*devices),
        _ => None,
    })
}

fn warnings(update: &Update) -> Vec<&Event> {
    let bad = |event: &&Event| matches!(event, Event::Warning(_) | Event::Retry(_));
    update.events.iter().map(|(_, event)| event).filter(bad).collect()
}

#[test]
fn together_takes_little_longer_than_one_and_one_by_one_much() {
    let file = file(KIB);
    let mut fleet = Fleet::new(4, BitRate::K1000);
    // It runs a program, as in the next update: the tool waits for quiet after the call back.
    fleet.update(1, &file, &ManyOptions::default());
    let one = fleet.update(1, &file, &ManyOptions::default()).took;
    let all = fleet.update(4, &file, &ManyOptions::default());
    assert_eq!((all.done(), warnings(&all)), (4, vec![]));
    assert!((0..4).all(|device| together(&all, device) == Some(4)));
    assert!(all.took * 100 <= one * 115, "{:?} for four, {one:?} for one", all.took);
    assert_all_have(&mut fleet, 4, file.crc());
    let apart = fleet.update(4, &file, &one_by_one());
    assert_eq!((apart.done(), warnings(&apart)), (4, vec![]));
    assert!((0..4).all(|device| together(&apart, device).is_none()));
    assert!(apart.took > all.took * 3 / 2, "{:?} one by one, {:?} together", apart.took, all.took);
    fleet.bench.assert_nothing_unmodelled();
}

/// The bus is full with requests for seconds: a heartbeat does not get through, and must not hold
/// up the answers after it.
#[test]
fn eight_transfers_at_once_leave_every_device_its_answers() {
    let file = file(KIB);
    let mut fleet = Fleet::new(8, BitRate::K1000);
    let update = fleet.update(8, &file, &one_by_one());
    assert_eq!((update.done(), warnings(&update)), (8, vec![]));
}

#[test]
fn lost_repeated_and_late_frames_cost_time_and_nothing_else() {
    let file = file(96);
    let mut fleet = Fleet::new(4, BitRate::K1000);
    let one = fleet.update(1, &file, &ManyOptions::default()).took;
    fleet.to_one_in(1000, 3, FaultAction::Drop);
    let all = fleet.update(4, &file, &ManyOptions::default());
    assert_eq!(all.done(), 4);
    assert!(all.took * 2 <= one * 3, "{:?} for four with lost frames, {one:?} for one without", all.took);
    assert_all_have(&mut fleet, 4, file.crc());
    for (frames, seed, action) in [
        (300, 4, FaultAction::Duplicate),
        (300, 5, FaultAction::Delay(Span::from_millis(3))),
        (3000, 6, FaultAction::Alter { byte: 4, mask: 0x10 }),
    ] {
        let mut fleet = Fleet::new(3, BitRate::K1000);
        fleet.to_one_in(frames, seed, action);
        let all = fleet.update(3, &file, &ManyOptions::default());
        assert_eq!(all.done(), 3, "{action:?}: {:?}", warnings(&all));
        fleet.bench.world.clear_faults();
        assert_all_have(&mut fleet, 3, file.crc());
    }
}

/// The bus at 125 kbit/s: answers take eight times as long.
#[test]
fn a_slow_bus_is_no_obstacle() {
    let file = file(24);
    let mut fleet = Fleet::new(3, BitRate::K125);
    let all = fleet.update(3, &file, &ManyOptions::default());
    assert_eq!((all.done(), warnings(&all)), (3, vec![]));
    assert_all_have(&mut fleet, 3, file.crc());
}

/// One device loses its power for a moment in the middle: the others go on, and it is finished
/// afterwards, from where it was.
#[test]
fn a_device_that_falls_out_is_finished_afterwards() {
    let file = file(KIB);
    let mut fleet = Fleet::new(3, BitRate::K1000);
    let usual = fleet.update(3, &file, &ManyOptions::default()).took;
    let from = fleet.bench.now();
    let board = fleet.bench.boards()[1];
    let mut state = 0;
    let update = fleet.update_while(3, &file, &ManyOptions::default(), &mut |bench| {
        if state == 0 && bench.now() > from + usual / 2 {
            bench.world.power_off(board);
            state = 1;
        } else if state == 1 && bench.now() > from + usual / 2 + Duration::from_millis(100) {
            bench.world.power_on(board);
            state = 2;
        }
    });
    assert_eq!((state, update.done()), (2, 3), "{:?}", warnings(&update));
    let apart = |(device, event): &&(usize, Event)| {
        *device == 1 && matches!(event, Event::Warning(Warning::Apart { .. }))
    };
    assert_eq!(update.events.iter().filter(apart).count(), 1, "{:?}", update.events);
    assert_all_have(&mut fleet, 3, file.crc());
}

/// A device without power from the middle on: its outcome is reported, and the others have theirs.
#[test]
fn a_device_that_stays_away_costs_the_others_nothing() {
    let file = file(KIB);
    let mut fleet = Fleet::new(3, BitRate::K1000);
    let usual = fleet.update(3, &file, &ManyOptions::default()).took;
    let from = fleet.bench.now();
    let board = fleet.bench.boards()[0];
    let update = fleet.update_while(3, &file, &ManyOptions::default(), &mut |bench| {
        if bench.now() > from + usual / 2 {
            bench.world.power_off(board);
        }
    });
    assert_eq!(update.done(), 2);
    let failed = update.results[0].as_ref().unwrap_err();
    assert!(matches!(failed.error, Error::NoAnswer { .. }), "{:?}", failed.error);
    // That of the group, and not that of the attempt after it.
    assert_eq!(failed.left.state, DeviceState::Erased, "{}", failed.left);
    fleet.bench.world.power_on(board);
    fleet.bench.run_ms(100);
    // Its half program is not started, and the next update goes on with it.
    assert!(fleet.bench.is_bootloader(1));
    assert_eq!(fleet.update(1, &file, &ManyOptions::default()).done(), 1);
    assert_all_have(&mut fleet, 3, file.crc());
}

/// Another node uses the COB-ID of the group's requests, or of an answer: before the group's first
/// download, or in the middle of one.
#[test]
fn a_cob_id_that_somebody_else_uses_ends_the_group() {
    let file = file(KIB);
    for (id, after) in [(0x6DF, 0), (0x682, 0), (0x6DF, 100)] {
        let mut fleet = Fleet::new(3, BitRate::K1000);
        let other = fleet.bench.world.add_host_port(1_000_000);
        let from = fleet.bench.now();
        let mut sent = false;
        let update = fleet.update_while(3, &file, &ManyOptions::default(), &mut |bench| {
            // On an idle bus: two frames with the same COB-ID at the same time destroy each other.
            let is_idle =
                bench.records().last().is_some_and(|last| last.end + Span::from_micros(500) < bench.time());
            if !sent && is_idle && bench.now() >= from + Duration::from_millis(after) {
                sent = true;
                bench.world.send(other, Frame::standard(id, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]).unwrap());
            }
        });
        assert!(sent);
        assert_eq!(update.done(), 3, "{id:X}h after {after} ms: {:?}", warnings(&update));
        let told = |(_, event): &&(usize, Event)| matches!(event, Event::Warning(Warning::GroupDisturbed));
        assert_eq!(update.events.iter().filter(told).count(), 3, "{id:X}h after {after} ms");
        assert_all_have(&mut fleet, 3, file.crc());
    }
}

/// Ctrl-C in the middle: all updates end, no device keeps the COB-IDs of the group, and the next
/// update goes on.
#[test]
fn a_cancelled_group_goes_on_later() {
    let file = file(KIB);
    let mut fleet = Fleet::new(3, BitRate::K1000);
    let usual = fleet.update(3, &file, &ManyOptions::default()).took;
    let from = fleet.bench.now();
    let options = ManyOptions::default();
    let cancelled = options.cancelled.clone();
    let update = fleet.update_while(3, &file, &options, &mut |bench| {
        if bench.now() > from + usual / 2 {
            cancelled.store(true, Ordering::Relaxed);
        }
    });
    for result in &update.results {
        assert!(matches!(result.as_ref().unwrap_err().error, Error::Cancelled), "{result:?}");
    }
    for node in 1..=3 {
        let request = fleet.bench.session_with(node).read_number(Address::new(0x1201, 1)).unwrap();
        assert_eq!(request, 0x8000_0000, "node {node}");
    }
    let rest = fleet.update(3, &file, &ManyOptions::default());
    assert_eq!(rest.done(), 3, "{:?}", warnings(&rest));
    assert!(rest.took * 10 < usual * 9, "{:?} for the rest, {usual:?} for all", rest.took);
    assert_all_have(&mut fleet, 3, file.crc());
}

/// Three boards of which the second is prepared, and their update; the others stay together.
fn with_another(prepare: impl FnOnce(&mut Machine), file: &Arc<Program>) -> (Fleet, Update) {
    let mut fleet = Fleet::new(3, BitRate::K1000);
    let board = fleet.bench.boards()[1];
    fleet.bench.world.power_off(board);
    prepare(fleet.bench.world.machine_mut(board));
    fleet.bench.world.power_on(board);
    fleet.bench.run_ms(50);
    let update = fleet.update(3, file, &ManyOptions::default());
    assert!([0, 2].map(|device| together(&update, device)).into_iter().all(|devices| devices >= Some(2)));
    (fleet, update)
}

/// One of three boards cannot take the program: the error is its own, and the others have theirs.
fn assert_refuses_alone(prepare: impl FnOnce(&mut Machine), file: &Arc<Program>) -> Error {
    let (mut fleet, mut update) = with_another(prepare, file);
    assert_eq!(update.done(), 2, "{:?}", update.results);
    for node in [1, 3] {
        assert_eq!(program(&mut fleet, node), file.crc(), "node {node}");
    }
    // It runs nothing that was not verified, and is there for the next try.
    assert!(fleet.bench.is_bootloader(2));
    assert_eq!(program(&mut fleet, 2), 0);
    update.results.swap_remove(1).unwrap_err().error
}

/// A product with CRC-16 leaves the group with block 0, and gets its blocks by itself.
#[test]
fn a_device_with_another_checksum_is_updated_alone() {
    let file = file(KIB);
    let of_crc_16 = |machine: &mut Machine| {
        machine.load(&firmware::elf(firmware::BOOTLOADER_CRC_16)).unwrap();
    };
    let (mut fleet, update) = with_another(of_crc_16, &file);
    assert_eq!(update.done(), 3, "{:?}", update.results);
    let bytes: Vec<u8> = file.image().segments().flat_map(|(_, bytes)| bytes.into_owned()).collect();
    for (node, crc) in [(1, file.crc()), (2, kit::bench::crc16(&bytes)), (3, file.crc())] {
        assert!(!fleet.bench.is_bootloader(node), "node {node}");
        assert_eq!(program(&mut fleet, node), crc, "node {node}");
    }
}

#[test]
fn a_device_with_flash_that_cannot_be_erased_fails_alone() {
    let error = assert_refuses_alone(
        |machine| {
            let board = firmware::board();
            let first = board.chip.sector_at(board.programs[0].base).unwrap();
            machine.protect_sector(first.number, true);
        },
        &file(KIB),
    );
    assert!(
        matches!(error, Error::Failed { doing: Doing::Block(1), error: FlashError::Secured, .. }),
        "{error}"
    );
}

/// The bootloader of the board with two programs has less room for the first one.
#[test]
#[cfg_attr(not(reference_board), ignore = "needs the stm32f407g-disc1")]
fn a_device_without_room_refuses_alone() {
    let size = stm32f407g_disc1_two::LAYOUT.programs[0].size / 1024 + 1;
    let error = assert_refuses_alone(
        |machine| {
            let name = firmware::of_board(stm32f407g_disc1_two::LAYOUT.board, firmware::BOOTLOADER);
            machine.load(&firmware::elf(&name)).unwrap();
        },
        &file(size),
    );
    assert!(matches!(error, Error::OtherRegion { program: 1, .. }), "{error}");
}

/// `coflash flash bootloader.elf --node 1-8`, where the home of the bootloader of one board is
/// write-protected: the boards, the exit code, and what the command has said.
fn renewed(refusing: usize) -> (Bench, Option<i32>, String) {
    let mut bench = Fleet::new(8, BitRate::K1000).bench;
    let layout = firmware::board();
    let home = layout.chip.sector_at(layout.home.unwrap().base).unwrap();
    for (board, place) in bench.boards().into_iter().zip(1..) {
        let machine = bench.world.machine_mut(board);
        machine.keep_flash_log();
        if place == refusing {
            machine.protect_sector(home.number, true);
        }
    }
    let mut endpoint = Endpoint::new(bench);
    let coflash = std::env::var("COBOOT_COFLASH").expect("cargo xtask test sets it");
    let file = firmware::dir().join(firmware::BOOTLOADER_WATCHDOG);
    let url = endpoint.url();
    let output =
        endpoint.run(Command::new(coflash).args(["--bus", &url, "flash", "--node", "1-8"]).arg(file));
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    println!("{said}");
    (endpoint.bench, output.status.code(), said.into_owned())
}

/// What each device says: the state of its renewal, and 1F56h of its bootloader.
fn bootloaders(bench: &mut Bench) -> Vec<(State, u32)> {
    let each = |node| {
        let mut session = bench.session_with(node);
        let state = session.read_number(Address::new(DEVICE_STATE, STATE_RENEWAL)).unwrap();
        let crc = session.read_number(Address::new(PROGRAM_ID, number())).unwrap();
        (Progress::from_bytes(state.to_le_bytes()).unwrap().state, crc)
    };
    (1..=8).map(each).collect()
}

fn erases(bench: &mut Bench, place: usize) -> usize {
    let board = bench.boards()[place - 1];
    let log = bench.world.machine_mut(board).take_flash_log();
    log.iter().filter(|operation| matches!(operation, Operation::Erase { .. })).count()
}

/// The first device shows whether the new bootloader is good: without it the others stay as they are.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn if_the_first_device_refuses_a_bootloader_the_others_are_left_alone() {
    let (mut bench, exit, said) = renewed(1);
    assert_eq!(exit, Some(8), "{said}");
    assert!(said.contains("sector 4 of the flash is write-protected"), "{said}");
    let others = "error: not renewed: the bootloader of node 1 was the first, and could not be renewed";
    for node in 2..=8 {
        assert!(said.contains(&format!("node {node}: {others}")), "{node}: {said}");
    }
    assert!(said.contains("0 of 8 devices are done"), "{said}");
    let old = crc_of(&image_of(firmware::BOOTLOADER));
    assert_eq!(bootloaders(&mut bench), [(State::None, old); 8]);
    assert!((1..=8).all(|place| erases(&mut bench, place) == 0), "nothing was erased");
}

/// A later device is named, and the others are renewed.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn a_later_device_that_refuses_a_bootloader_is_named_and_the_others_are_renewed() {
    let (mut bench, exit, said) = renewed(5);
    assert_eq!(exit, Some(8), "{said}");
    let line = said.lines().find(|line| line.starts_with("node 5: error: ")).expect("it is named");
    assert!(line.contains("sector 4 of the flash is write-protected"), "{line}");
    assert_eq!(said.matches(": error: ").count(), 1, "{said}");
    assert!(said.contains("7 of 8 devices are done"), "{said}");
    let old = crc_of(&image_of(firmware::BOOTLOADER));
    let new = crc_of(&image_of(firmware::BOOTLOADER_WATCHDOG));
    let mut expected = [(State::Installed, new); 8];
    expected[4] = (State::None, old);
    assert_eq!(bootloaders(&mut bench), expected);
    assert_eq!(erases(&mut bench, 5), 0);
}
