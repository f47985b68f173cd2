//! The EDS files against a foreign checker, importer and client, and against the device.

use std::fs;
use std::path::Path;
use std::process::Command;

use canopen::program::{ESACADEMY_NODE_ID, LIFT_NODE_ID};
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::eds::{self, Image};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::firmware;
use coboot_tests::tools::{given, script, text};
use coflash_core::file::read::Firmware;

/// The board whose files are committed in `docs/eds/`.
const COMMITTED_BOARD: &str = "stm32f407g-disc1";

/// dcfchk of dcf-tools: returns whether it finds no fault, and its output.
fn dcfchk(eds: &Path) -> (bool, String) {
    // It is installed beside the interpreter, whose path may be a link and is not resolved.
    let dcfchk = given("COBOOT_PYTHON").with_file_name("dcfchk");
    // It computes the COB-IDs of PDOs, which need a node-ID.
    let output = Command::new(dcfchk).args(["-n", "1"]).arg(eds).output().expect("dcfchk starts");
    (output.status.success(), text(&output))
}

#[test]
fn the_committed_files_are_what_the_tables_give() {
    if bsp::LAYOUT.board != COMMITTED_BOARD {
        println!("not compared: the committed files are those of {COMMITTED_BOARD}");
        return;
    }
    let images = eds::images();
    for kept in
        fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/eds")).expect("it is committed")
    {
        let kept = kept.expect("it can be read").path();
        let image = images.iter().find(|image| kept.ends_with(&image.file)).expect("a table makes it");
        let file = fs::read_to_string(&kept).expect("it can be read");
        assert_eq!(file, image.eds(), "{} is out of date: run `cargo xtask eds`", image.file);
    }
}

#[test]
fn dcfchk_finds_no_fault_in_the_files_and_one_in_each_damaged_copy() {
    let folder = kit::folder!("eds");
    for image in eds::images() {
        let (good, said) = dcfchk(&folder.write(&image.file, image.eds()));
        assert!(good && said.is_empty(), "{}: {said}", image.file);
    }

    let image = eds::default_bootloader();
    let whole = image.eds();
    let faults = [
        (
            "type",
            "[1001]\nParameterName=Error register\nObjectType=0x7\nDataType=0x0005\n",
            "DataType=0x0005\n",
            "",
        ),
        ("range", "[1018sub0]", "DefaultValue=4", "DefaultValue=256"),
        ("access", "[1000]", "AccessType=const", "AccessType=none"),
        ("number", "[1F50]", "SubNumber=2", "SubNumber=3"),
        ("list", "[MandatoryObjects]", "1=0x1000", "1=0x1002"),
        ("name", "[1008]", "ParameterName=", "ParameterNumber="),
    ];
    for (fault, section, good, bad) in faults {
        let at = whole.find(section).unwrap_or_else(|| panic!("{fault}: no {section}"));
        let (before, behind) = whole.split_at(at);
        assert!(behind.contains(good), "{fault}: no {good}");
        let bytes = format!("{before}{}", behind.replacen(good, bad, 1));
        let path = folder.write(format!("fault-{fault}.eds"), bytes);
        let (good, said) = dcfchk(&path);
        assert!(!good, "the fault \"{fault}\" was not found: {said}");
    }
}

fn board() -> Bench {
    Bench::new().switched_on()
}

/// The board with version 1 of the application running.
fn board_with_application() -> Bench {
    let mut bench = board();
    bench.install(firmware::APP_V1);
    assert!(!bench.is_bootloader(NODE));
    bench
}

/// python-canopen imports the file, reads every value of the device and compares it.
fn compare(image: &Image, bench: Bench, node: u8) {
    let folder = kit::folder!("eds");
    let mut endpoint = Endpoint::new(bench);
    let mut client = script("eds_client.py");
    client.arg(endpoint.address()).arg(folder.write(&image.file, image.eds()));
    let said = endpoint.succeed(client.args(["--node", &node.to_string()]));
    let summary = format!("{} values compared, 0 differ", image.entries.len());
    assert!(said.contains(&summary), "{}: no {summary:?} in:\n{said}", image.file);
    endpoint.bench.assert_nothing_unmodelled();
}

#[test]
fn python_canopen_finds_the_bootloader_as_its_file_says() {
    compare(&eds::default_bootloader(), board(), NODE);
}

/// A lift refuses 1F51h until it is unlocked, so its values are not compared.
#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn python_canopen_finds_other_products_as_their_files_say() {
    for (name, product, sealed) in [
        (firmware::BOOTLOADER_SEALED, "default", true),
        (firmware::BOOTLOADER_LEAST, "least", false),
        (firmware::BOOTLOADER_WAYS_IN, "ways-in", false),
    ] {
        let image = eds::bootloader_of(product, sealed).expect("a product of the repository");
        let (bench, node) = board_with(name);
        compare(&image, bench, node);
    }
}

#[test]
fn python_canopen_finds_the_application_as_its_file_says() {
    compare(&eds::application(), board_with_application(), NODE);
}

/// python-canopen knows the PDOs by the file: it exchanges values and changes mapping and transmission type by its
/// own procedure. The call back at its end leads into the bootloader.
#[test]
fn python_canopen_exchanges_pdos_with_the_application() {
    let folder = kit::folder!("eds");
    let image = eds::application();
    let mut endpoint = Endpoint::new(board_with_application());
    let mut client = script("pdo_client.py");
    client.arg(endpoint.address()).arg(folder.write(&image.file, image.eds()));
    println!("{}", endpoint.succeed(&mut client));
    endpoint.bench.run_ms(100);
    assert!(endpoint.bench.is_bootloader(NODE));
    endpoint.bench.assert_nothing_unmodelled();
}

/// The other direction: the device has only objects that the file names. All objects and sub-indices that a client
/// can find on this node: standard ones and the manufacturer's, and those of the profiles that a bootloader has (6005h
/// of CiA 814-1, 7F50h of ESAcademy).
fn survey(image: &Image, mut bench: Bench, node: u8) {
    let mut abort_of = |index: u16, sub: u8| {
        let [low, high] = index.to_le_bytes();
        let (request, response) = (0x600 + u16::from(node), 0x580 + u32::from(node));
        let answer = bench.ask(request, &[0x40, low, high, sub, 0, 0, 0, 0], response);
        let answer = answer.unwrap_or_else(|| panic!("no answer about {index:04X}h/{sub}"));
        if answer[0] == 0x41 {
            // An upload in segments has begun; general error (CiA 301 table 22).
            bench.post(request, &[0x80, low, high, sub, 0, 0, 0, 8]);
        }
        (answer[0] == 0x80).then(|| u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]))
    };
    // CiA 301 table 22: the object does not exist; the sub-index does not exist.
    let (no_object, no_sub_index) = (Some(0x0602_0000), Some(0x0609_0011));
    let mut there = Vec::new();
    for index in (0x1000..0x3000).chain(0x6000..0x6100).chain(0x7F00..0x8000) {
        if abort_of(index, 0) == no_object {
            continue;
        }
        for sub in 0..=u8::MAX {
            let abort = abort_of(index, sub);
            assert_ne!(abort, no_object, "{index:04X}h/{sub}");
            if abort != no_sub_index {
                there.push((index, sub));
            }
        }
    }
    let mut named: Vec<_> = image.entries.iter().map(|entry| (entry.at.index, entry.at.sub)).collect();
    named.sort_unstable();
    assert_eq!(there, named, "{}", image.file);

    // LSS: "switch state global, configuration", then "inquire node-ID".
    bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    let answer = bench.ask(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0], 0x7E4);
    assert_eq!(answer.is_some(), image.lss, "{}: LSS_Supported", image.file);
    bench.assert_nothing_unmodelled();
}

/// A bootloader of this image, and its node-ID.
fn board_with(name: &str) -> (Bench, u8) {
    let mut bench = Bench::of_image(name);
    bench.power_on();
    let node = match name {
        firmware::BOOTLOADER_LIFT => LIFT_NODE_ID,
        firmware::BOOTLOADER_ESACADEMY => ESACADEMY_NODE_ID,
        _ => NODE,
    };
    bench.await_boot_up_of(node, 100);
    bench.run_ms(20);
    (bench, node)
}

/// The products with other objects than the default one: passwords, sealed images, the loader in the ROM, and
/// one without all that it may leave out.
#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn each_product_has_the_objects_of_its_file_and_no_others() {
    for (name, product, sealed) in [
        (firmware::BOOTLOADER_SEALED, "default", true),
        (firmware::BOOTLOADER_LEAST, "least", false),
        (firmware::BOOTLOADER_WAYS_IN, "ways-in", false),
        (firmware::BOOTLOADER_LIFT, "lift", false),
        (firmware::BOOTLOADER_ESACADEMY, "esacademy", false),
        (firmware::BOOTLOADER_PAULUS, "paulus", false),
        (firmware::BOOTLOADER_SEALED_WRITES_FLASH, "writes-flash", true),
    ] {
        let image = eds::bootloader_of(product, sealed).expect("a product of the repository");
        let (bench, node) = board_with(name);
        survey(&image, bench, node);
        println!("{}: {} objects and sub-indices", image.file, image.entries.len());
    }
}

/// What the files of these products leave out, by the meaning of the choices (docs/product.md).
#[test]
#[cfg_attr(not(split_map), ignore = "needs the split map")]
fn a_file_has_no_object_that_the_product_leaves_out() {
    let has = |product, index| {
        let image = eds::bootloader_of(product, false).expect("a product of the repository");
        image.eds().contains(&format!("=0x{index:04X}\n"))
    };
    // The second SDO server; where a download goes on; the loader in the ROM; the passwords.
    for (index, products) in [
        (0x1201, &["default", "esacademy", "lift", "ways-in"][..]),
        (0x2006, &["default", "esacademy", "lift", "ways-in"]),
        (0x2008, &["ways-in"]),
        (0x6005, &["lift"]),
        (0x7F50, &["esacademy"]),
    ] {
        for product in ["default", "esacademy", "least", "lift", "ways-in"] {
            assert_eq!(has(product, index), products.contains(&product), "{product}: {index:04X}h");
        }
    }
    let least = eds::bootloader_of("least", false).expect("a product of the repository").eds();
    assert!(least.contains("LSS_Supported=0\n") && least.contains("BaudRate_125=1\n"));
    assert!(least.contains("BaudRate_500=0\n"), "it stays at the board's bit rate");
    let switches = eds::bootloader_of("switches", false).expect("a product of the repository").eds();
    // bit_rates: 2..=6 are 500 to 50 kbit/s (CiA 305 table 1).
    for (kbit, can) in [(10, 0), (20, 0), (50, 1), (125, 1), (250, 1), (500, 1), (800, 0), (1000, 0)] {
        assert!(switches.contains(&format!("BaudRate_{kbit}={can}\n")), "{kbit}");
    }
}

#[test]
fn the_bootloader_has_no_object_that_its_file_does_not_name() {
    survey(&eds::default_bootloader(), board(), NODE);
}

#[test]
fn the_application_has_no_object_that_its_file_does_not_name() {
    survey(&eds::application(), board_with_application(), NODE);
}

/// A new object is documented on the page for it.
#[test]
fn the_protocol_page_names_every_object() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/protocol.md");
    let page = fs::read_to_string(page).expect("docs/protocol.md is committed");
    for image in eds::images() {
        for index in image.indices() {
            assert!(
                page.contains(&format!("\n| {index:04X}h")),
                "docs/protocol.md has no row for {index:04X}h"
            );
        }
    }
}

/// Names and defaults are only for the files; on the chip they would take flash.
#[test]
fn the_firmware_does_not_carry_the_names() {
    for elf in [firmware::BOOTLOADER, firmware::APP_V1] {
        let Ok(Firmware::Image(image)) = coflash_core::file::read::read(&firmware::elf(elf), None, None)
        else {
            panic!("{elf} is no ELF of ours")
        };
        let has = |text: &str| {
            image.segments().any(|(_, data)| data.windows(text.len()).any(|bytes| bytes == text.as_bytes()))
        };
        assert!(has(eds::default_bootloader().device.name), "{elf}: what 1008h reads should be there");
        for entry in eds::default_bootloader().entries {
            assert!(!has(entry.name), "{elf} carries {:?}: is canopen's feature `names` on?", entry.name);
        }
    }
}
