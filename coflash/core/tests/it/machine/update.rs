//! Plan and run on a bus of fake devices, in virtual time.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use canopen::{CobId, Frame, NodeId};
use coboot_can::Adapter;
use coflash_core::device::scan::ScanOptions;
use coflash_core::device::{Session, Timing};
use coflash_core::file::checksum::CRC as CRC32;
use coflash_core::file::convert::{program_of, Label, Options};
use coflash_core::file::{block_file, raw, Firmware};
use coflash_core::machine::{
    make, plan, run, Bad, DeviceFault, Good, Outcome, Package, Part, Plan, PlanError, RunOptions,
};
use coflash_core::update::many::ManyOptions;
use coflash_core::update::{DeviceState, Event, FlashOptions};
use coflash_core::Error;

use super::{entry, packed};
use crate::tap::Tap;
use kit::fake::{Bus, Fake, Maker, APPLICATION, BOOTLOADER};

/// The CRC in the last block of `plain-400.blk`, as expected.py computed it (bytes 875 to 878).
const CRC: u32 = 0x4CF3_C5A5;

/// The identity of a device: vendor-ID, product code, revision and serial number.
struct Plate([u32; 4]);

impl Maker for Plate {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        match at {
            (0x1018, sub @ 1..=4) => Some(Ok(self.0[usize::from(sub) - 1].to_le_bytes().to_vec())),
            _ => None,
        }
    }
}

fn device(node: u8, product: u32) -> Fake {
    let mut fake = Fake::new(APPLICATION).at(node, 1);
    fake.maker = Some(Box::new(Plate([63, product, 2, 1000 + u32::from(node)])));
    fake.crc_of_application = Some(0x1234_5678);
    fake
}

const DRIVES: &str = r#""nodes": [5, 6], "identity": {"vendor": 63, "product": 1234}"#;

/// Whether nothing was written to a device; a scan ends what another tool may have left unfinished.
fn is_untouched(fake: &Fake) -> bool {
    fake.writes().iter().all(|entry| entry.starts_with("abort"))
}

fn package(programs: &[(&str, &str)]) -> Package {
    Package::parse(&packed(programs)).unwrap()
}

fn planned(bus: &mut dyn Adapter, package: &Package) -> Plan {
    plan(bus, package, &ScanOptions::default(), &Arc::default()).unwrap()
}

/// Node, name of the program and what is to be done.
fn steps(plan: &Plan) -> Vec<(u8, &str, &str)> {
    let of = |device: &'_ coflash_core::machine::Device| device.node.get();
    let each = plan.devices.iter().flat_map(|device| device.steps.iter().map(move |step| (of(device), step)));
    each.map(|(node, step)| (node, step.program.as_str(), step.todo.name())).collect()
}

fn carried_out(bus: &mut dyn Adapter, package: &Package, plan: &Plan) -> Vec<Outcome> {
    run(bus, package, plan, &RunOptions::default(), &|_, _, _| {})
}

fn words(outcomes: &[Outcome]) -> Vec<(Option<u8>, usize, String)> {
    let word = |outcome: &Outcome| match &outcome.result {
        Ok(Good::Had) => "had".to_owned(),
        Ok(Good::Updated(_)) => "updated".to_owned(),
        Err(Bad::Left(fault)) => format!("{:08X}h", fault.number()),
        Err(Bad::Failed(failed)) => format!("{:08X}h {}", failed.error.number(), failed.left.state.name()),
    };
    outcomes.iter().map(|outcome| (outcome.node.map(NodeId::get), outcome.entry, word(outcome))).collect()
}

#[test]
fn each_node_is_matched_and_a_foreign_one_is_left_alone() {
    let package = package(&[
        ("drive", DRIVES),
        ("valve", r#""identity": {"vendor": 63, "product": 77}, "count": 2"#),
        ("panel", r#""nodes": [9, 10]"#),
    ]);
    let mut has = device(6, 1234);
    has.crc_of_application = Some(CRC);
    let mut bus = Bus(vec![device(5, 1234), has, device(7, 77), device(9, 99), device(20, 5)]);
    let plan = planned(&mut bus, &package);
    let due = [(5, "drive", "update"), (6, "drive", "has"), (7, "valve", "update"), (9, "panel", "update")];
    assert_eq!(steps(&plan), due);
    assert_eq!(plan.foreign.iter().map(|foreign| foreign.node.get()).collect::<Vec<_>>(), [20]);
    let missing: Vec<_> = plan.missing.iter().map(|missing| missing.fault.clone()).collect();
    assert_eq!(
        missing,
        [
            DeviceFault::TooFew { program: "valve".to_owned(), expected: 2, found: 1 },
            DeviceFault::Absent { node: NodeId::new(10).unwrap() },
        ]
    );
    assert_eq!((plan.updates(), plan.nodes().count()), (3, 3));
    // To make a plan changes nothing.
    assert!(bus.0.iter().all(is_untouched));
    let outcomes = carried_out(&mut bus, &package, &plan);
    let expected = [
        (Some(5), 0, "updated"),
        (Some(6), 0, "had"),
        (None, 1, "6000040Ah"),
        (Some(7), 1, "updated"),
        (Some(10), 2, "60000013h"),
        (Some(9), 2, "updated"),
    ];
    assert_eq!(words(&outcomes), expected.map(|(node, entry, word)| (node, entry, word.to_owned())));
    for (node, is_written) in [(0, true), (1, false), (2, true), (3, true), (4, false)] {
        assert_eq!(!bus.0[node].blocks.is_empty(), is_written, "{node}");
        assert_eq!(bus.0[node].running, Some(APPLICATION));
    }
}

/// What a device reports of its program beside its CRC: identity, 2005h and 1F52h.
struct Reports(Plate, u32, [u32; 2]);

impl Maker for Reports {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        match at {
            (0x2005, 1) => Some(Ok(self.1.to_le_bytes().to_vec())),
            (0x1F52, sub @ 1..=2) => Some(Ok(self.2[usize::from(sub) - 1].to_le_bytes().to_vec())),
            _ => self.0.value(at, running),
        }
    }
}

/// A program of this version (major number) and date for node 5, with its CRC-32 in its last four bytes or without,
/// for this product, 0 for any.
fn dated(version: u32, date: u64, own_crc: bool, product: u32) -> Package {
    let mut image = vec![7; 1000];
    image[..8].copy_from_slice(&[0x00, 0x00, 0x01, 0x20, 0x01, 0x02, 0x02, 0x08]);
    if own_crc {
        let crc = CRC32.checksum(&image);
        image.extend(crc.to_le_bytes());
    }
    let label = Label::Release { vendor_id: 0, product_code: product, version, date };
    let image = Firmware::Image(raw::read(&image, Some(0x0802_0000)).unwrap());
    let blocks = program_of(image, &Options::default().label(label)).unwrap().program;
    let bytes = block_file::emit(&blocks);
    let entry = serde_json::from_str(&entry("drive", r#""nodes": [5]"#)).unwrap();
    Package::parse(&make(None, None, &[Part { entry, bytes }], &[]).unwrap()).unwrap()
}

/// No value of a device is enough for "it has this program" where another one says something else. The dates are
/// 2026-11-27 18:30:15 (15671 days after 1984-01-01, 66615 s) and none. 2144DF1Ch is the CRC of all data with their
/// CRC-32 at the end.
#[test]
fn a_crc_alone_decides_nothing() {
    const DATE: u64 = 1_795_804_215;
    let crc = |package: &Package| package.programs().next().unwrap().1.crc();
    let plain = crc(&dated(2, 0, false, 0));
    let days = [15_671, 66_615_000];
    for (own_crc, product, date, reported, (crc, version, days), todo) in [
        (false, 0, 0, 1234, (plain, 2, [0; 2]), "has"),
        (false, 0, 0, 1234, (plain, 0, [0; 2]), "has"),
        (false, 1234, DATE, 1234, (plain, 2, days), "has"),
        (false, 0, DATE, 1234, (plain, 2, [0; 2]), "has"),
        (false, 0, DATE, 1234, (plain, 2, [15_671, 1]), "update"),
        (false, 0, 0, 1234, (plain, 1, [0; 2]), "update"),
        (false, 0, 0, 1234, (plain, 3, [0; 2]), "older"),
        (false, 0, 0, 1234, (plain ^ 1, 3, [0; 2]), "older"),
        (false, 0, 0, 1234, (plain ^ 1, 0x103, [0; 2]), "older"),
        (false, 0, 0, 1234, (plain ^ 1, 2, [0; 2]), "update"),
        (true, 0, 0, 1234, (0x2144_DF1C, 1, [0; 2]), "update"),
        (true, 0, 0, 1234, (0x2144_DF1C, 0, [0; 2]), "update?"),
        (true, 0, 0, 1234, (0x2144_DF1C, 2, [0; 2]), "update?"),
        (true, 0, 0, 1234, (0x2144_DF1C, 3, [0; 2]), "older"),
        // Block 0 names another machine, and a device without an identity takes any.
        (false, 1235, 0, 1234, (plain, 2, [0; 2]), "leave"),
        (false, 1235, 0, 0, (plain, 2, [0; 2]), "has"),
    ] {
        let package = dated(2, date, own_crc, product);
        let vendor = if reported == 0 { 0 } else { 63 };
        let mut fake = device(5, reported);
        fake.maker = Some(Box::new(Reports(Plate([vendor, reported, 2, 1005]), version, days)));
        fake.crc_of_application = Some(crc);
        let mut bus = Bus(vec![fake]);
        let mut plan = planned(&mut bus, &package);
        // An agent that starts again asks this way.
        let mut session = Session::new(&mut bus, NodeId::new(5).unwrap(), Timing::default());
        let runs = package.programs().next().unwrap().1.marks().is_running(&mut session, 1).unwrap();
        assert_eq!(runs, matches!(todo, "has" | "leave"), "{crc:08X} {version} {days:?}");
        let step = &plan.devices[0].steps[0];
        let doubt = if step.every_version_has_this_crc { "?" } else { "" };
        let row = format!("{own_crc} {product} {date} {crc:08X} {version} {days:?}");
        assert_eq!(format!("{}{doubt}", step.todo.name()), todo, "{row}");
        assert_eq!(plan.to_string().contains("each version of this program"), !doubt.is_empty(), "{row}");
        assert_eq!(plan.is_of_other_machine(), todo == "leave", "{row}");
        let is_written = |bus: &Bus| !bus.0[0].blocks.is_empty();
        let outcomes = words(&carried_out(&mut bus, &package, &plan));
        assert_eq!(is_written(&bus), todo.starts_with("update"), "{row}: {outcomes:?}");
        if todo == "older" {
            assert_eq!(outcomes, [(Some(5), 0, "6000040Fh".to_owned())], "{row}");
            plan.allow_older(|node| node.get() == 5);
            let said = plan.to_string();
            assert!(said.contains(", which is older") && !said.contains("not written"), "{said}");
            let outcomes = words(&carried_out(&mut bus, &package, &plan));
            assert!(is_written(&bus) && outcomes[0].2 == "updated", "{row}: {outcomes:?}");
        }
    }
}

/// A program is due in the order of the package, also if the bus has the devices in another order.
#[test]
fn the_order_is_that_of_the_package() {
    let package = package(&[("panel", r#""nodes": [9]"#), ("drive", DRIVES)]);
    let mut bus = Bus(vec![device(5, 1234), device(6, 1234), device(9, 1)]);
    let plan = planned(&mut bus, &package);
    let seen: Mutex<Vec<(u8, usize)>> = Mutex::default();
    let outcomes = run(&mut bus, &package, &plan, &RunOptions::default(), &|node, entry, event| {
        if matches!(event, Event::Done(_)) {
            seen.lock().unwrap().push((node.get(), entry));
        }
    });
    assert!(outcomes.iter().all(|outcome| outcome.result.is_ok()), "{:?}", words(&outcomes));
    let mut seen = seen.into_inner().unwrap();
    assert_eq!(seen[0], (9, 0));
    seen.sort_unstable();
    assert_eq!(seen, [(5, 1), (6, 1), (9, 0)]);
    // The next run has nothing to do.
    let plan = planned(&mut bus, &package);
    // The fake's application reports what it is told to.
    assert_eq!(plan.updates(), 3);
    bus.0.iter_mut().for_each(|fake| fake.crc_of_application = None);
    assert_eq!(planned(&mut bus, &package).updates(), 0);
}

/// A device in its bootloader has not got its program released: its CRC alone does not count.
#[test]
fn a_device_that_was_interrupted_is_not_done() {
    let package = package(&[("drive", DRIVES)]);
    let mut waits = device(5, 1234);
    (waits.running, waits.crc) = (Some(BOOTLOADER), Some(CRC));
    let mut bus = Bus(vec![waits, device(6, 1234)]);
    assert_eq!(steps(&planned(&mut bus, &package)), [(5, "drive", "update"), (6, "drive", "update")]);
}

#[test]
fn another_device_at_a_named_node_is_said_and_not_written() {
    let package = package(&[("drive", DRIVES)]);
    let mut bus = Bus(vec![device(5, 1235), device(6, 1234)]);
    let plan = planned(&mut bus, &package);
    assert_eq!(steps(&plan), [(5, "drive", "leave"), (6, "drive", "update")]);
    let words_of = plan.to_string();
    assert!(words_of.contains("its product code is 000004D3h, and \"drive\" is for 000004D2h"), "{words_of}");
    let outcomes = carried_out(&mut bus, &package, &plan);
    assert_eq!(words(&outcomes), [(Some(5), 0, "6000040Bh".to_owned()), (Some(6), 0, "updated".to_owned())]);
    assert!(is_untouched(&bus.0[0]), "{:?}", bus.0[0].writes());
}

/// A program for each device that can be at a node: the one that is there gets its own, and the other one is
/// no mistake.
#[test]
fn a_node_may_be_one_device_or_another() {
    let at = |product: u32| format!(r#""nodes": [5], "identity": {{"vendor": 63, "product": {product}}}"#);
    let package = package(&[("old", &at(1234)), ("new", &at(1235))]);
    for (product, name) in [(1234, "old"), (1235, "new")] {
        let plan = planned(&mut Bus(vec![device(5, product)]), &package);
        assert_eq!(steps(&plan), [(5, name, "update")]);
    }
    let plan = planned(&mut Bus(vec![device(5, 1236)]), &package);
    assert_eq!(steps(&plan), [(5, "old", "leave"), (5, "new", "leave")]);
}

/// One with nodes and one with an identity: whether they meet is known when the bus is.
#[test]
fn two_programs_for_a_node_of_the_bus_are_refused() {
    let package =
        package(&[("a", r#""nodes": [5]"#), ("b", r#""identity": {"vendor": 63, "product": 1234}"#)]);
    let mut bus = Bus(vec![device(5, 1), device(6, 1234)]);
    assert_eq!(steps(&planned(&mut bus, &package)).len(), 2);
    let mut bus = Bus(vec![device(5, 1234), device(6, 1234)]);
    let error = plan(&mut bus, &package, &ScanOptions::default(), &Arc::default()).unwrap_err();
    let PlanError::Package(fault) = error else { panic!("{error}") };
    assert_eq!(fault.number(), 0x6000_0407);
    assert!(fault.to_string().contains("node 5"), "{fault}");
    assert!(bus.0.iter().all(is_untouched));
}

/// Somebody has put another device to the node between plan and update.
#[test]
fn a_device_that_was_exchanged_is_not_written() {
    let package = package(&[("drive", DRIVES)]);
    let mut bus = Bus(vec![device(5, 1234), device(6, 1234)]);
    let plan = planned(&mut bus, &package);
    for (plate, what) in [
        ([63, 1234, 2, 4711], "its serial number was 000003EDh, and is 00001267h"),
        ([63, 99, 2, 1005], "its product code was 000004D2h, and is 00000063h"),
    ] {
        bus.0[0].maker = Some(Box::new(Plate(plate)));
        bus.0[1].crc_of_application = Some(CRC);
        let outcomes = carried_out(&mut bus, &package, &plan);
        let Err(Bad::Left(fault)) = &outcomes[0].result else { panic!("{:?}", words(&outcomes)) };
        assert_eq!(fault.number(), 0x6000_040C);
        assert!(fault.to_string().contains(what), "{fault}");
        assert!(is_untouched(&bus.0[0]), "{:?}", bus.0[0].writes());
    }
    // Nor is it said of another device that it had the program.
    let mut finished = Bus(vec![device(5, 1234), device(6, 1234)]);
    finished.0.iter_mut().for_each(|fake| fake.crc_of_application = Some(CRC));
    let had = planned(&mut finished, &package);
    assert!(words(&carried_out(&mut finished, &package, &had)).iter().all(|row| row.2 == "had"));
    finished.0[1].maker = Some(Box::new(Plate([63, 1234, 2, 4711])));
    let outcomes = carried_out(&mut finished, &package, &had);
    assert!(matches!(&outcomes[1].result, Err(Bad::Left(fault)) if fault.number() == 0x6000_040C));
    // Bootloader and application may report a part or not, and their revisions may differ.
    bus.0[0].maker = Some(Box::new(Plate([63, 1234, 3, 0])));
    assert_eq!(words(&carried_out(&mut bus, &package, &plan))[0].2, "updated");
}

/// A device that is exchanged after its comparison with the plan, while others are still compared.
struct Exchanged {
    first: Plate,
    then: Plate,
    is_first: bool,
}

impl Maker for Exchanged {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        let plate = if self.is_first { &mut self.first } else { &mut self.then };
        let value = plate.value(at, running);
        self.is_first &= at != (0x1018, 4);
        value
    }
}

/// All devices of a program are compared before the first is written. Another type of device that comes after
/// that is not written, also if the package names nodes alone.
#[test]
fn a_device_that_is_exchanged_during_the_run_is_not_written() {
    let package = package(&[("drive", r#""nodes": [5, 6]"#)]);
    for count in [1, 2] {
        let mut bus = Bus((0..count).map(|number| device(5 + number, 1234)).collect());
        let plan = planned(&mut bus, &package);
        let (first, then) = (Plate([63, 1234, 2, 1005]), Plate([63, 99, 2, 1005]));
        bus.0[0].maker = Some(Box::new(Exchanged { first, then, is_first: true }));
        let outcomes = carried_out(&mut bus, &package, &plan);
        let outcome = outcomes.iter().find(|outcome| outcome.node == NodeId::new(5)).unwrap();
        let Err(Bad::Failed(failed)) = &outcome.result else { panic!("{:?}", words(&outcomes)) };
        assert!(matches!(failed.error, Error::WrongTarget { .. }), "{:?}", failed.error);
        assert!(is_untouched(&bus.0[0]), "{:?}", bus.0[0].writes());
    }
}

/// A device whose bootloader reports less than its application: 0 is no report.
struct Sparse {
    bootloader: Plate,
    application: Plate,
}

impl Maker for Sparse {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        let is_application = running == APPLICATION;
        if is_application { &mut self.application } else { &mut self.bootloader }.value(at, running)
    }
}

#[test]
fn a_bootloader_without_an_identity_of_its_own_is_no_other_device() {
    let nodes = r#""nodes": [5]"#;
    // On trial the vendor-ID of a program is compared with that of the bootloader, which CiA 301 demands.
    for (bootloader, entry) in
        [([0; 4], format!("{nodes}, \"trial_run\": false")), ([63, 0, 0, 0], nodes.to_owned())]
    {
        let package = package(&[("drive", &entry)]);
        let (a, b) = (APPLICATION, BOOTLOADER);
        for (in_plan, in_run) in [(a, a), (a, b), (b, b), (b, a)] {
            let mut bus = Bus(vec![device(5, 1234)]);
            let application = Plate([63, 1234, 2, 1005]);
            bus.0[0].maker = Some(Box::new(Sparse { bootloader: Plate(bootloader), application }));
            bus.0[0].running = Some(in_plan);
            let plan = planned(&mut bus, &package);
            bus.0[0].running = Some(in_run);
            let outcomes = carried_out(&mut bus, &package, &plan);
            assert_eq!(words(&outcomes)[0].2, "updated", "{bootloader:?}, {in_plan:X}h, {in_run:X}h");
        }
    }
}

/// A request to a node from another tool on the bus.
fn request_to(node: u8) -> Frame {
    Frame::of(CobId::new(0x600 + u16::from(node)).unwrap(), &[0x40, 0x57, 0x1F, 1, 0, 0, 0, 0])
}

/// The requests of a comparison would break a transfer of another tool, too.
#[test]
fn a_device_of_another_tool_is_not_asked() {
    let package = package(&[("drive", DRIVES)]);
    let mut bus = Bus(vec![device(5, 1234), device(6, 1234)]);
    let plan = planned(&mut bus, &package);
    let asked = bus.0[0].log.len();
    bus.0[0].inject(request_to(5));
    let outcomes = words(&carried_out(&mut bus, &package, &plan));
    assert_eq!(outcomes[0], (Some(5), 0, "60000012h untouched".to_owned()));
    assert_eq!(outcomes[1], (Some(6), 0, "updated".to_owned()));
    assert_eq!(bus.0[0].log.len(), asked, "{:?}", bus.0[0].log);
    // The user says that it does not matter.
    bus.0[0].inject(request_to(5));
    let options = RunOptions::default().flash(FlashOptions::default().alone(false));
    let outcomes = words(&run(&mut bus, &package, &plan, &options, &|_, _, _| {}));
    assert_eq!(outcomes[0], (Some(5), 0, "updated".to_owned()));
}

/// A scan asks all nodes, and ends their transfers: it does not begin while another tool is heard.
#[test]
fn no_plan_is_made_while_another_tool_talks_to_a_node() {
    let package = package(&[("drive", DRIVES)]);
    let mut bus = Bus(vec![device(5, 1234), device(6, 1234)]);
    let alone = ScanOptions::default().alone(true);
    // Nothing but a heartbeat: a plan.
    bus.0[0].inject(Frame::of(CobId::new(0x705).unwrap(), &[5]));
    assert_eq!(plan(&mut bus, &package, &alone, &Arc::default()).unwrap().updates(), 2);
    bus.0.iter_mut().for_each(|fake| fake.log.clear());
    bus.0[1].inject(request_to(77));
    let error = plan(&mut bus, &package, &alone, &Arc::default()).unwrap_err();
    let PlanError::Bus(error @ Error::NotAlone { .. }) = error else { panic!("{error}") };
    let words = "another tool is using node 77: it sends SDO requests, the last one for 1F57h/1";
    assert_eq!(error.to_string(), words);
    assert!(bus.0.iter().all(|fake| fake.log.is_empty()));
    bus.0[1].inject(request_to(77));
    assert_eq!(planned(&mut bus, &package).updates(), 2);
}

/// It is on the bus, and nobody looks for its plug.
#[test]
fn a_device_that_answers_wrongly_is_not_absent() {
    let package = package(&[("drive", r#""nodes": [5, 6, 7]"#)]);
    let mut bus = Tap::shortened(Bus(vec![device(5, 1234), device(6, 1234)]), 4);
    let plan = planned(&mut bus, &package);
    assert_eq!(steps(&plan), [(6, "drive", "update")]);
    let outcomes = words(&carried_out(&mut bus, &package, &plan));
    let expected = [(Some(5), "6000040Eh"), (Some(7), "60000013h"), (Some(6), "updated")];
    assert_eq!(outcomes, expected.map(|(node, word)| (node, 0, word.to_owned())));
    let said = plan.to_string();
    assert!(said.contains("drive: node 5 answers, but with frames of 4 bytes where SDO has 8\n"), "{said}");
    assert!(said.contains("drive: node 7 is not on the bus\n"), "{said}");
}

/// The user wants the last comparison, which the package does not.
#[test]
fn the_option_verify_is_for_packages_too() {
    let package = package(&[("drive", r#""nodes": [5]"#)]);
    let mut bus = Bus(vec![device(5, 1234)]);
    let plan = planned(&mut bus, &package);
    let options = RunOptions::default().flash(FlashOptions::default().verify(true));
    let outcomes = run(&mut bus, &package, &plan, &options, &|_, _, _| {});
    // This application reports another CRC than its program has.
    let Err(Bad::Failed(failed)) = &outcomes[0].result else { panic!("{:?}", words(&outcomes)) };
    assert!(matches!(failed.error, Error::WrongCrc { .. }), "{:?}", failed.error);
}

/// A device without power costs the others nothing, and gets nothing more after a program that failed.
#[test]
fn a_device_that_is_gone_costs_the_others_nothing() {
    let package = package(&[("drive", DRIVES), ("data", r#""nodes": [5, 6], "program": 2"#)]);
    let mut bus = Bus(vec![device(5, 1234), device(6, 1234)]);
    let plan = planned(&mut bus, &package);
    bus.0[0].running = None;
    let outcomes = words(&carried_out(&mut bus, &package, &plan));
    assert_eq!(outcomes[0], (Some(5), 0, "60000013h untouched".to_owned()));
    assert_eq!(outcomes[1], (Some(6), 0, "updated".to_owned()));
    assert_eq!(outcomes[2], (Some(5), 1, "6000040Dh".to_owned()));
}

/// Cancelled in the first of three devices: the outcome of each is kept, and the next run does the rest. What the
/// third one has by the plan, it still has.
#[test]
fn an_interrupted_run_is_continued_by_the_next() {
    let package = package(&[("panel", r#""nodes": [9]"#), ("drive", DRIVES)]);
    let mut bus = Bus(vec![device(5, 1234), device(6, 1234), device(9, 1)]);
    bus.0.iter_mut().for_each(|fake| fake.crc_of_application = None);
    bus.0[1].crc_of_application = Some(CRC);
    let plan = planned(&mut bus, &package);
    let flag: Arc<AtomicBool> = Arc::default();
    let options = RunOptions::default().many(ManyOptions::default().cancelled(flag.clone()));
    let mut interrupted = Tap::sending(bus, |bus, _| {
        let blocks: usize = bus.0.iter().map(|fake| fake.blocks.len()).sum();
        flag.fetch_or(blocks >= 2, Ordering::Relaxed);
    });
    let outcomes = run(&mut interrupted, &package, &plan, &options, &|_, _, _| {});
    let mut bus = interrupted.of;
    let cancelled = |state: &str| format!("{:08X}h {state}", Error::Cancelled.number());
    let expected = [
        (Some(9), 0, cancelled("erased")),
        (Some(5), 1, cancelled("untouched")),
        (Some(6), 1, "had".to_owned()),
    ];
    assert_eq!(words(&outcomes), expected);
    let plan = planned(&mut bus, &package);
    assert_eq!(steps(&plan), [(5, "drive", "update"), (6, "drive", "has"), (9, "panel", "update")]);
    let outcomes = carried_out(&mut bus, &package, &plan);
    assert!(outcomes.iter().all(|outcome| outcome.result.is_ok()), "{:?}", words(&outcomes));
    assert_eq!(planned(&mut bus, &package).updates(), 0);
}

/// Neither is the state of one program that of the other, nor is the device said to be unchanged: the second program
/// is cancelled before it begins, or refused before its first frame (a lift without its password).
#[test]
fn a_device_of_which_one_program_was_changed_is_not_called_unchanged() {
    for (more, stops) in [("", true), (r#", "dialect": "lift""#, false)] {
        let data = format!(r#""nodes": [5], "program": 2{more}"#);
        let package = package(&[("drive", r#""nodes": [5]"#), ("data", &data)]);
        let mut bus = Bus(vec![device(5, 1234)]);
        let plan = planned(&mut bus, &package);
        let flag: Arc<AtomicBool> = Arc::default();
        let options = RunOptions::default().many(ManyOptions::default().cancelled(flag.clone()));
        let outcomes = run(&mut bus, &package, &plan, &options, &|_, _, event| {
            flag.fetch_or(stops && matches!(event, Event::Done(_)), Ordering::Relaxed);
        });
        assert_eq!(words(&outcomes)[0].2, "updated");
        let Err(Bad::Failed(failed)) = &outcomes[1].result else { panic!("{:?}", words(&outcomes)) };
        assert_eq!(failed.left.state, DeviceState::OtherChanged, "{more}");
        assert_eq!(failed.left.to_string(), "this program of it was not changed, and another one was");
    }
}
