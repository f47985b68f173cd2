//! Masters that support CiA 302-3 and do not know coboot update a device with a running program:
//! the sequences of requests of Zephyr's runner and of Lely's NMT master, with their timing. And they renew its
//! bootloader, as does the order of SYS TEC's tools (docs/masters.md).

use std::time::Duration;

use boot_core::profile::Profile;
use canopen::{Address, BitRate};
use coboot_node::device::Event;
use coboot_tests::attacker::node::Node;
use coboot_tests::attacker::target::Target as _;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::masters::{confirm, lely, simple, systec, zephyr, Master};
use coboot_tests::renewal::{crc_of, identification, number, progress, running, version};
use coflash_core::device::Transfers;
use coflash_core::file::convert::{program_of, Options};
use coflash_core::file::read::{read, Format};
use coflash_core::update::steps::{call_back, erase_at_once};
use kit::rig::crc32;
use shared_abi::renewal::{Origin, Progress, State, TrialEnd};

/// The applications that run on the device.
const APPLICATIONS: [&str; 2] = [firmware::APP_V1, firmware::APP_C];

/// The whole procedure, from one application to the next, confirmed at the end: the device runs the
/// new program, and starts it by itself.
#[test]
fn zephyrs_runner_updates_and_confirms_a_running_device() {
    for image in APPLICATIONS {
        let mut bench = Bench::running(BitRate::K125, image);
        let done = zephyr(&mut bench, NODE, 1, &firmware::raw(firmware::APP_V2));
        let [stop, clear] = done.unwrap_or_else(|error| panic!("{image}: {error}")).answers;
        println!("{image}: STOP answered in {stop:?}, CLEAR in {clear:?}");
        assert!(stop <= Duration::from_millis(25), "{image}: {stop:?}");
        bench.run_ms(100);
        assert!(!bench.is_bootloader(NODE), "{image}: it was confirmed, not called back");
        bench.power_cycle();
        bench.await_boot_up(1000);
        assert!(!bench.is_bootloader(NODE), "{image}: it starts by itself, without a rescue window");
        bench.assert_nothing_unmodelled();
    }
}

/// An update by a master; no request was repeated.
type Update = fn(&mut Bench, &[u8]) -> Result<(), String>;

/// Lely's step "check and update software version" with its defaults; CANopenTerm with its 100 ms; and scripts that
/// send no CLEAR, with the 300 ms of python-canopen. At 500 kbit/s, each of them twice in a row, and once more
/// after `coflash erase`.
#[test]
fn each_master_updates_a_running_device_again_and_again() {
    const TERM: (Duration, bool) = (Duration::from_millis(100), true);
    const SCRIPT: (Duration, bool) = (Duration::from_millis(300), false);
    let masters: [(&str, Update); 4] = [
        ("Lely", |bench, image| {
            let done = lely(bench, NODE, image, crc32(image))?;
            assert_eq!((done.repeated, done.stop_answered), (0, true));
            Ok(())
        }),
        ("CANopenTerm", |bench, image| simple(bench, NODE, TERM, image, Transfers::Segments)),
        ("CANopenTerm, block", |bench, image| simple(bench, NODE, TERM, image, Transfers::Blocks)),
        ("a script", |bench, image| simple(bench, NODE, SCRIPT, image, Transfers::Segments)),
    ];
    for (number, (master, update)) in masters.into_iter().enumerate() {
        let mut bench = Bench::running(BitRate::K500, APPLICATIONS[number % 2]);
        for (time, image) in [firmware::APP_V2, firmware::APP_V1, firmware::APP_V2].iter().enumerate() {
            if time == 2 {
                call_back(&mut bench.session()).unwrap();
                // Twice: there is nothing to erase the second time.
                for _ in 0..2 {
                    erase_at_once(&mut bench.session(), 1).unwrap();
                }
            }
            let raw = firmware::raw(image);
            update(&mut bench, &raw).unwrap_or_else(|error| panic!("{master}, {time}: {error}"));
            assert!(!bench.is_bootloader(NODE), "{master}, {time}");
            let crc = bench.session().read_number(Address::new(0x1F56, 1)).unwrap();
            assert_eq!(crc, crc32(&raw), "{master}, {time}");
        }
        bench.assert_nothing_unmodelled();
    }
}

/// The part of a program that a bootloader checks: initial stack pointer in RAM, reset vector
/// inside, Thumb bit set.
fn program(first: u8) -> Vec<u8> {
    let mut bytes = vec![first; 20 * 1024];
    bytes[..8].copy_from_slice(&[0x00, 0x00, 0x01, 0x20, 0x01, 0x02, 0x02, 0x08]);
    bytes
}

/// Both against `coboot-node` with its stand-in for the program.
#[test]
fn both_masters_update_a_node_without_a_chip() {
    let mut node = Node::new(&Profile::STANDARD);
    // It has booted.
    node.pass_us(1000);
    // Twice: the second time from the running program.
    for first in [1, 2] {
        let done = zephyr(&mut node, NODE, 1, &program(first)).unwrap();
        assert!(done.answers[0] <= Duration::from_millis(25), "{:?}", done.answers);
        node.pass_us(100_000);
        node.events();
        let last = node.result.unwrap();
        assert!(matches!(last, Event::Program { trial: false, .. }), "confirmed, not called back: {last:?}");
    }
    let image = program(3);
    let done = lely(&mut node, NODE, &image, crc32(&image)).unwrap();
    assert_eq!((done.repeated, done.stop_answered), (0, true));
}

/// From the request to its answer, as a client sees it; the bootloader sends its boot-up message
/// before.
#[test]
fn stop_and_clear_are_answered_by_the_bootloader_within_25_ms() {
    for image in APPLICATIONS {
        for command in [0, 3] {
            let mut bench = Bench::running(BitRate::K125, image);
            let from = bench.time();
            let took = Master::new(&mut bench, NODE, Duration::from_millis(100)).control(1, command);
            let took = took.unwrap_or_else(|error| panic!("{image}: {error}"));
            println!("{}, {image}: 1F51h = {command}: {took:?}", firmware::board().board);
            assert!(took <= Duration::from_millis(25), "{image}, {command}: {took:?}");
            bench.run_ms(2);
            let frames = bench.frames_since(from);
            // The emergency of the bootloader may come in between: its identifier is lower.
            let frames = frames.iter().filter(|(_, id, _)| *id != 0x80 + u32::from(NODE));
            let of_node: Vec<_> = frames.map(|(_, id, data)| (*id, &data[..])).collect();
            let expected: [(u32, &[u8]); 3] = [
                (0x601, &[0x2F, 0x51, 0x1F, 1, command, 0, 0, 0]),
                (0x701, &[0]),
                (0x581, &[0x60, 0x51, 0x1F, 1, 0, 0, 0, 0]),
            ];
            assert_eq!(of_node[..3], expected, "{image}, {command}");
            assert!(bench.is_bootloader(NODE));
        }
    }
}

/// At every bit rate, the device needs the same few milliseconds, and the rest is the time of the
/// frames on the wire: request, boot-up message, emergency and answer. From 50 kbit/s on the sum is
/// at most 25 ms.
#[test]
fn stop_is_answered_as_soon_as_the_wire_allows_at_every_bit_rate() {
    /// The longest frames with 8, 1, 8 and 8 bytes, including stuff bits and the following
    /// intermission (CiA 301 uses 11-bit identifiers: 47 bits and the data, and a stuff bit after
    /// each 4 of 34 bits and the data).
    const BITS: u32 = 3 * (47 + 64 + (34 + 64 - 1) / 4) + 47 + 8 + (34 + 8 - 1) / 4;
    const DEVICE: Duration = Duration::from_millis(15);
    // Not 800 kbit/s, which these boards' clocks do not support.
    let rates = [BitRate::K10, BitRate::K20, BitRate::K50, BitRate::K250, BitRate::K500, BitRate::K1000];
    for rate in rates {
        let bits = rate.bits_per_second().unwrap();
        let mut bench = Bench::running(rate, firmware::APP_V1);
        let took = Master::new(&mut bench, NODE, Duration::from_millis(100)).control(1, 0).unwrap();
        println!("{}: {bits} bit/s: {took:?}", firmware::board().board);
        let limit = DEVICE + Duration::from_secs(1) * BITS / bits;
        assert!(took <= limit, "{bits} bit/s: {took:?}, not {limit:?}");
        assert!(bits < 50_000 || limit <= Duration::from_millis(25));
        bench.run_ms(50);
        assert!(bench.is_bootloader(NODE));
    }
}

/// The version of the new bootloader.
const NEW: u32 = 0x0009_0001;

/// A device that runs a program, and whose master has called its bootloader (1F51h/1 = 80h).
fn called_back() -> Bench {
    let mut bench = Bench::running(BitRate::K125, firmware::APP_V1);
    call_back(&mut bench.session()).unwrap();
    bench
}

/// The new image is on trial, staged and not confirmed.
fn assert_on_trial(bench: &mut Bench) {
    let Progress { state, origin, .. } = progress(bench);
    assert_eq!((state, origin, running(bench)), (State::Staged, Origin::Trial, NEW));
}

/// It is installed, 1F56h reads the CRC in its header, and the program is there as before.
fn assert_renewed(bench: &mut Bench, image: &[u8]) {
    assert_eq!((progress(bench).state, running(bench)), (State::Installed, NEW));
    assert_eq!(identification(bench), crc_of(image));
    let mut master = Master::new(bench, NODE, Duration::from_millis(500));
    master.control(1, 1).unwrap();
    bench.await_program(1000);
    assert!(!bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();
}

/// Zephyr's runner with `--program-number` of the bootloader. Its own confirmation, 80h, changes nothing
/// here: without 83h the old bootloader is back after 60 s.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn zephyrs_runner_renews_a_bootloader_with_one_request_more() {
    let image = version(firmware::BOOTLOADER, NEW);
    for is_confirmed in [true, false] {
        let mut bench = called_back();
        let old = running(&mut bench);
        zephyr(&mut bench, NODE, number(), &image).unwrap();
        assert_on_trial(&mut bench);
        if is_confirmed {
            confirm(&mut bench, NODE, number()).unwrap();
            assert_renewed(&mut bench, &image);
            continue;
        }
        bench.await_boot_up(61_000);
        let expected = Progress { state: State::Staged, origin: Origin::Home, trial_end: TrialEnd::Late };
        assert_eq!((progress(&mut bench), running(&mut bench)), (expected, old));
    }
}

/// SYS TEC's tools write 83h directly after the data. It is acknowledged and changes nothing; the second one,
/// after the boot-up, confirms.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn systecs_order_renews_a_bootloader_with_a_second_83h() {
    let image = version(firmware::BOOTLOADER, NEW);
    let home = firmware::board().home.unwrap().base;
    let file = program_of(read(&image, Some(Format::Raw), Some(home)).unwrap(), &Options::default());
    let mut bench = called_back();
    systec(&mut bench, NODE, number(), &file.unwrap().program).unwrap();
    assert_on_trial(&mut bench);
    confirm(&mut bench, NODE, number()).unwrap();
    assert_renewed(&mut bench, &image);
}
