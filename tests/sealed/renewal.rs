//! The bootloader of a sealed device is renewed: by a genuine image that is newer, and by no other.

use std::sync::Arc;

use canopen::program::{FlashError, ProgramControl, DEVICE_STATE, STATE_RENEWAL};
use canopen::{Address, BitRate, NodeId};
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::renewal::{
    cells, confirm, crc_of, identification, image_of, number, progress, running, start, status as refusal,
    version, with_crc,
};
use coboot_tests::sealed_board::{
    board, key, provision, release, root, seal, sealer, status, write_to, COUNTER,
};
use coflash_core::device::info::info;
use coflash_core::device::scan::ScanOptions;
use coflash_core::device::Transfers;
use coflash_core::file::block_file;
use coflash_core::file::sealed::{Certificate, Role, Sealer, SigningKey};
use coflash_core::machine::{self, make, plan, Entry, Good, Package, Part, RunOptions};
use coflash_core::update::steps::call_back;
use emulator::machine::Operation;
use shared_abi::geometry::Region;
use shared_abi::ram_image::Version;
use shared_abi::renewal::{Origin, Progress, State};

/// The program number of a bootloader in a manifest.
const BOOTLOADER: u8 = 255;

/// The built image with this security counter and version.
fn image(counter: u32, version: u32) -> Vec<u8> {
    let mut image = image_of(firmware::BOOTLOADER_SEALED);
    image[48..52].copy_from_slice(&version.to_le_bytes());
    image[52..56].copy_from_slice(&counter.to_le_bytes());
    with_crc(image)
}

/// The key that signs bootloaders.
fn signer() -> SigningKey {
    key(3)
}

fn bootloader_sealer(counter: u32) -> Sealer<'static> {
    let of_programs = sealer(counter);
    let certificate = Certificate {
        role: Role::Bootloader,
        epoch: 1,
        vendor_id: of_programs.vendor_id,
        product_code: 0,
        lowest: 0,
        highest: u32::MAX,
        key: signer().public(),
    };
    Sealer { certificate: Some(certificate.signed_by(&root())), program: BOOTLOADER, ..of_programs }
}

fn sealed(counter: u32, version: u32) -> Vec<u8> {
    bootloader_sealer(counter).seal(&image(counter, version), &signer()).unwrap()
}

/// A sealed device without a program, in its bootloader.
fn device() -> Bench {
    board().switched_on()
}

/// Downloads a file; the word of 1F57h.
fn send(bench: &mut Bench, file: &[u8]) -> u32 {
    write_to(bench, number(), file, Transfers::Blocks).1
}

fn power_cycle(bench: &mut Bench) {
    bench.power_cycle();
    bench.await_boot_up(100);
    assert!(bench.is_bootloader(NODE));
}

#[test]
fn a_newer_genuine_bootloader_is_installed_and_an_older_one_never() {
    let mut bench = device();
    let staging = Region::new(firmware::board().staging.unwrap().base, 1024);
    let second = sealed(2, 0x0002_0000);
    assert_eq!(send(&mut bench, &second), status::OK);
    assert_eq!(progress(&mut bench).state, State::Staged);
    // Before its confirmation an older one may take its place: the counter is not raised yet.
    let first = sealed(1, 0x0001_0000);
    assert_eq!(send(&mut bench, &first), status::OK);
    start(&mut bench);
    assert_eq!((progress(&mut bench).origin, running(&mut bench)), (Origin::Trial, 0x0001_0000));
    bench.session().command(number(), ProgramControl::ClrSignature).unwrap();
    bench.await_boot_up(1_000);
    assert_eq!(send(&mut bench, &second), status::OK);
    start(&mut bench);
    confirm(&mut bench);
    power_cycle(&mut bench);
    assert_eq!((running(&mut bench), progress(&mut bench).state), (0x0002_0000, State::Installed));
    // Not older, not another one with the same counter; and the same again changes nothing.
    let spare = cells(&bench, staging);
    for (file, expected) in [
        (sealed(1, 0x0003_0000), status::ROLLBACK),
        (sealed(2, 0x0003_0000), status::ROLLBACK),
        (second.clone(), status::OK),
    ] {
        assert_eq!(send(&mut bench, &file), expected);
        assert_eq!(progress(&mut bench).state, State::Installed);
        assert_eq!(cells(&bench, staging), spare);
    }
    bench.machine().keep_flash_log();
    assert_eq!(send(&mut bench, &second), status::OK);
    assert_eq!(bench.machine().take_flash_log(), [], "the same image writes nothing");
    assert_eq!(send(&mut bench, &sealed(3, 0x0003_0000)), status::OK);
}

/// A device with this image at home, and a newer one in staging, which nobody has tried.
fn device_with_staged(home: &[u8], newer: &[u8]) -> Bench {
    let mut bench = device();
    assert_eq!(send(&mut bench, home), status::OK);
    start(&mut bench);
    confirm(&mut bench);
    power_cycle(&mut bench);
    assert_eq!(send(&mut bench, newer), status::OK);
    assert_eq!(progress(&mut bench).state, State::Staged);
    bench
}

/// SEALED: the counter is raised with the confirmation, never before the trial. A probe writes an older
/// bootloader, whose own counter says nothing; what is stored is that of the last confirmed one.
#[test]
fn an_image_that_was_only_staged_raises_no_counter() {
    let (second, third) = (sealed(2, 0x0002_0000), sealed(3, 0x0003_0000));
    let mut bench = device_with_staged(&second, &sealed(4, 0x0004_0000));
    bench.power_off();
    let home = firmware::board().home.unwrap().base;
    bench.machine().load_bin(home, &image(0, 0x0000_9000)).unwrap();
    bench.switch_on();
    assert_eq!((running(&mut bench), progress(&mut bench).state), (0x0000_9000, State::None));
    assert_eq!(send(&mut bench, &sealed(1, 0x0001_0000)), status::ROLLBACK);
    assert_eq!(send(&mut bench, &second), status::OK);
    assert_eq!(send(&mut bench, &third), status::OK);
}

/// A master that sends the image at home wants no other one: a start would try the one in staging.
#[test]
fn the_image_at_home_sent_again_gives_up_the_one_in_staging() {
    let (second, third) = (sealed(2, 0x0002_0000), sealed(3, 0x0003_0000));
    let mut bench = device_with_staged(&second, &third);
    let staging = Region::new(firmware::board().staging.unwrap().base, 1024);
    let before = cells(&bench, staging);
    assert_ne!(identification(&mut bench), crc_of(&image(2, 0x0002_0000)));
    // The staged one again keeps it.
    assert_eq!(send(&mut bench, &third), status::OK);
    assert_eq!(progress(&mut bench).state, State::Staged);
    assert_eq!(send(&mut bench, &second), status::OK);
    assert_eq!((progress(&mut bench).state, cells(&bench, staging)), (State::None, before));
    assert_eq!(identification(&mut bench), crc_of(&image(2, 0x0002_0000)));
    bench.session().command(number(), ProgramControl::Start).unwrap();
    bench.run_ms(500);
    assert_eq!(progress(&mut bench).origin, Origin::Home);
    assert_eq!(refusal(&mut bench).error, Some(FlashError::NoValidProgram));
}

/// Each is refused before staging is touched.
#[test]
fn an_image_that_is_not_genuine_is_refused() {
    let mut bench = device();
    let staging = Region::new(firmware::board().staging.unwrap().base, 1024);
    bench.machine().load_bin(staging.base, &[0x5A; 1024]).unwrap();
    let old = identification(&mut bench);
    let plain = image(1, 0x0001_0000);
    let of_release = Sealer { program: BOOTLOADER, ..sealer(1) };
    let signed_as_program = {
        // The manifest of a bootloader under the signature of a program's message.
        let mut file = sealed(1, 0x0001_0000);
        let program = Sealer { ..sealer(COUNTER) }.seal(&plain, &release()).unwrap();
        let size = usize::from(u16::from_le_bytes([file[4], file[5]]));
        let other = usize::from(u16::from_le_bytes([program[4], program[5]]));
        let signature = size + 152 + 8;
        file[signature..signature + 64].copy_from_slice(&program[other + 152 + 8..][..64]);
        file
    };
    let mut altered = sealed(1, 0x0001_0000);
    altered[40] ^= 1;
    let stranger = bootloader_sealer(1).for_module(&plain, key(9).public());
    assert!(stranger.is_err(), "the certificate is for another key");
    assert!(of_release.seal(&plain, &release()).is_err(), "the tool refuses the role");
    for (case, file, expected) in [
        ("not sealed", plain.clone(), status::NO_ACCESS),
        ("signed as a program", signed_as_program, status::SIGNATURE),
        ("altered", altered, status::SIGNATURE),
    ] {
        let before = cells(&bench, staging);
        assert_eq!(send(&mut bench, &file), expected, "{case}");
        assert_eq!(cells(&bench, staging), before, "{case}");
        assert_eq!(progress(&mut bench).state, State::None, "{case}");
        assert_eq!(identification(&mut bench), old, "{case}");
        // After a bad signature the device waits.
        bench.run_ms(20_000);
    }
    // Signed by a root itself.
    let direct = Sealer { certificate: None, ..bootloader_sealer(1) };
    assert_eq!(send(&mut bench, &direct.seal(&plain, &root()).unwrap()), status::OK);
}

/// The resident part of a sealed device loads no image that takes programs from anybody.
#[test]
fn an_image_that_knows_no_sealed_programs_is_refused() {
    let mut bench = device();
    let open = with_crc({
        let mut image = image_of(firmware::BOOTLOADER);
        image[52..56].copy_from_slice(&1_u32.to_le_bytes());
        image
    });
    let file = bootloader_sealer(1).seal(&open, &signer()).unwrap();
    assert_eq!(send(&mut bench, &file), status::WRONG_PRODUCT);
    // Nor one for another resident part; its header says so: FORMAT with 6.
    let mut other = image(1, 2);
    other[56] ^= 1;
    let file = bootloader_sealer(1).seal(&with_crc(other), &signer()).unwrap();
    assert_eq!(send(&mut bench, &file), 6 << 16 | 0x04);
    assert_eq!(progress(&mut bench).state, State::None);
}

/// One package for a machine of a sealed device and an open one: each gets a new bootloader of its kind, and then
/// its program. Once more, nothing is written.
#[test]
fn a_package_renews_a_sealed_device_and_an_open_one_and_updates_both() {
    let mut bench = Bench::of_boards(2);
    let boards = bench.boards();
    bench.commission(boards[1], 2, BitRate::K125);
    let sealed_device = bench.world.machine_mut(boards[0]);
    sealed_device.load(&firmware::elf(firmware::BOOTLOADER_SEALED)).unwrap();
    provision(&mut bench);
    bench.power_on();
    bench.run_ms(200);

    let part = |name: &str, node, program, bytes| Part {
        entry: Entry {
            name: name.to_owned(),
            file: String::new(),
            size: 0,
            sha256: String::new(),
            nodes: vec![node],
            identity: None,
            count: None,
            program,
            dialect: None,
            trial_run: true,
            verify: false,
        },
        bytes,
    };
    let (of_sealed, of_open) = (0x0002_0000, 0x0009_0001);
    let parts = [
        part("sealed bootloader", 1, BOOTLOADER, sealed(2, of_sealed)),
        part("bootloader", 2, BOOTLOADER, version(firmware::BOOTLOADER, of_open)),
        part("sealed program", 1, 1, seal(&sealer(COUNTER), firmware::APP_V1)),
        part("program", 2, 1, block_file::emit(&firmware::blocks(firmware::APP_V1))),
    ];
    let package = Package::parse(&make(None, None, &parts, &[(&root(), None)]).unwrap()).unwrap();
    package.trust(&[root().public()]).unwrap();
    let scan = ScanOptions::default().nodes((1..=3).filter_map(NodeId::new).collect());
    let ended = |bench: &mut Bench| {
        let plan = plan(bench, &package, &scan, &Arc::default()).unwrap();
        let outcomes = machine::run(bench, &package, &plan, &RunOptions::default(), &|_, _, _| {});
        let good = outcomes.into_iter().map(|outcome| match outcome.result {
            Ok(Good::Had) => "had",
            Ok(Good::Updated(report)) if report.renewal.is_some_and(|renewal| renewal.unchanged) => {
                "unchanged"
            }
            Ok(Good::Updated(_)) => "updated",
            Err(bad) => panic!("{:?} {:?}: {bad:?}", outcome.node, outcome.entry),
        });
        good.collect::<Vec<_>>()
    };
    assert_eq!(ended(&mut bench), ["updated"; 4]);
    for (node, version) in [(1, of_sealed), (2, of_open)] {
        assert!(!bench.is_bootloader(node), "node {node} runs its program");
        call_back(&mut bench.session_with(node)).unwrap();
        let info = info(&mut bench.session_with(node)).unwrap();
        assert_eq!(info.bootloader.unwrap().version, Version(version), "node {node}");
        let state = bench.session_with(node).read_number(Address::new(DEVICE_STATE, STATE_RENEWAL)).unwrap();
        assert_eq!(Progress::from_bytes(state.to_le_bytes()).unwrap().state, State::Installed, "node {node}");
        bench.session_with(node).command(1, ProgramControl::Start).unwrap();
        bench.run_ms(500);
    }
    boards.iter().for_each(|board| bench.world.machine_mut(*board).keep_flash_log());
    assert!(ended(&mut bench).iter().all(|how| *how != "updated"));
    for board in boards {
        let log = bench.world.machine_mut(board).take_flash_log();
        let erased = log.iter().filter(|operation| matches!(operation, Operation::Erase { .. })).count();
        assert_eq!(erased, 0, "nothing is written twice");
    }
}
