//! The EDS files against a foreign checker, importer and client, and against the device.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::{env, fs};

use coboot_tests::bench::Bench;
use coboot_tests::eds::{self, Image};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::firmware;
use coflash::file::read::Firmware;
use coflash::update::{flash, FlashOptions};

fn images() -> [Image; 6] {
    eds::images()
}

/// The board whose files are committed in `docs/eds/`.
const COMMITTED_BOARD: &str = "stm32f407g-disc1";

/// The python of `cargo xtask test`, with the pinned third-party packages.
fn python() -> PathBuf {
    env::var_os("COBOOT_PYTHON")
        .unwrap_or_else(|| panic!("COBOOT_PYTHON is not set: run the tests by `cargo xtask test`"))
        .into()
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// dcfchk of dcf-tools: returns whether it finds no fault, and its output.
fn dcfchk(eds: &Path) -> (bool, String) {
    // It is installed beside the interpreter, whose path may be a link and is not resolved.
    let output = Command::new(python().with_file_name("dcfchk")).arg(eds).output().expect("dcfchk starts");
    (output.status.success(), text(&output))
}

#[test]
fn the_committed_files_are_what_the_tables_give() {
    if bsp::LAYOUT.board != COMMITTED_BOARD {
        println!("not compared: the committed files are those of {COMMITTED_BOARD}");
        return;
    }
    for image in images() {
        let committed = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/eds").join(image.file);
        let file = fs::read_to_string(committed).expect("docs/eds is committed");
        assert_eq!(file, image.eds(), "{} is out of date: run `cargo xtask eds`", image.file);
    }
}

#[test]
fn dcfchk_finds_no_fault_in_the_files_and_one_in_each_damaged_copy() {
    let folder = kit::folder!("eds");
    for image in images() {
        let (good, said) = dcfchk(&folder.write(image.file, image.eds()));
        assert!(good && said.is_empty(), "{}: {said}", image.file);
    }

    let image = eds::bootloader();
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
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    bench
}

/// The board with version 1 of the application running.
fn board_with_application() -> Bench {
    let mut bench = board();
    let file = firmware::blocks(firmware::APP_V1);
    flash(&mut bench.session(), &file, &FlashOptions::default().trial_run(false), &mut |_| {})
        .expect("it takes the program");
    assert_eq!(bench.session().device_type().unwrap().map(|running| running.is_bootloader()), Some(false));
    bench
}

/// python-canopen imports the file, reads every value of the device and compares it.
fn compare(image: &Image, bench: Bench) {
    let folder = kit::folder!("eds");
    let mut endpoint = Endpoint::new(bench);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/eds_client.py");
    let mut client = Command::new(python());
    client.arg(script).arg(endpoint.address()).arg(folder.write(image.file, image.eds()));
    let output = endpoint.run(&mut client);
    let said = text(&output);
    assert!(output.status.success(), "{said}");
    let summary = format!("{} values compared, 0 differ", image.entries.len());
    assert!(said.contains(&summary), "no {summary:?} in:\n{said}");
    endpoint.bench.assert_nothing_unmodelled();
}

#[test]
fn python_canopen_finds_the_bootloader_as_its_file_says() {
    compare(&eds::bootloader(), board());
}

#[test]
fn python_canopen_finds_the_application_as_its_file_says() {
    compare(&eds::application(), board_with_application());
}

/// The other direction: the device has only objects that the file names.
fn survey(image: &Image, mut bench: Bench) {
    let there: Vec<u16> = (0x1000_u16..0x2000)
        .filter(|index| {
            let [low, high] = index.to_le_bytes();
            let answer = bench.ask(0x601, &[0x40, low, high, 0, 0, 0, 0, 0], 0x581);
            let answer = answer.unwrap_or_else(|| panic!("no answer about {index:04X}h"));
            // 06020000h, "object does not exist", little-endian.
            answer[0] != 0x80 || answer[4..] != [0x00, 0x00, 0x02, 0x06]
        })
        .collect();
    let named: Vec<u16> =
        image.indices().into_iter().filter(|index| (0x1000..0x2000).contains(index)).collect();
    assert_eq!(there, named, "{}", image.file);

    // LSS: "switch state global, configuration", then "inquire node-ID".
    bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
    let answer = bench.ask(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0], 0x7E4);
    assert_eq!(answer.is_some(), image.lss, "{}: LSS_Supported", image.file);
}

#[test]
fn the_bootloader_has_no_object_that_its_file_does_not_name() {
    survey(&eds::bootloader(), board());
}

#[test]
fn the_application_has_no_object_that_its_file_does_not_name() {
    survey(&eds::application(), board_with_application());
}

/// A new object is documented on the page for it.
#[test]
fn the_protocol_page_names_every_object() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/protocol.md");
    let page = fs::read_to_string(page).expect("docs/protocol.md is committed");
    for image in images() {
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
        let Ok(Firmware::Image(image)) = coflash::file::read::read(&firmware::elf(elf), None, None) else {
            panic!("{elf} is no ELF of ours")
        };
        let has = |text: &str| {
            image.segments().any(|(_, data)| data.windows(text.len()).any(|bytes| bytes == text.as_bytes()))
        };
        assert!(has(eds::bootloader().device.name), "{elf}: what 1008h reads should be there");
        for entry in eds::bootloader().entries {
            assert!(!has(entry.name), "{elf} carries {:?}: is canopen's feature `names` on?", entry.name);
        }
    }
}
