//! The tool as a separate process: files, exit codes, messages, and an update over a real socket.

mod adapters;
mod agent;
mod boards;
mod commands;
mod gateway;
mod legacy;
mod mistakes;
mod package;
mod renew;
mod report;
mod sealed_device;
mod sealing;
mod several;
mod tool;
mod vendor;

use std::fs;
use std::io::ErrorKind;
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

use coflash_core::file::ihex;

use serde_json::Value;

use crate::tool::{coflash, command, data, device, folder, quick, run, served, snapshot, NOWHERE};
use kit::fake::{serve, Fake, Outcome, APPLICATION, BOOTLOADER};

#[test]
fn convert_writes_the_block_file_of_the_manual() {
    let folder = folder("convert");
    let out = folder.path("out.blk");
    let board = ["--board", "nucleo-f446re"];
    let identity = ["--block-size", "0x110", "--vid", "0", "--pid", "1234"];
    let release = ["--ver", "0x00640A01", "--date", "1420070400"];
    for (arguments, expected) in [
        (board.to_vec(), "plain-400.blk"),
        (vec![], "plain-400.blk"),
        ([&board[..], &identity].concat(), "identity-110.blk"),
        ([&board[..], &identity, &release].concat(), "release-110.blk"),
        // The manual's own spelling.
        (
            "-I ihex --block_size 0x110 --start_address 0x08010000 --end_address 0x080FFFFF --vid 0 --pid 1234"
                .split(' ')
                .collect(),
            "identity-110.blk",
        ),
    ] {
        let input = data("program.hex");
        coflash(&[&["convert", &input, &out][..], &arguments].concat()).good();
        assert!(fs::read(&out).unwrap() == fs::read(data(expected)).unwrap(), "{arguments:?}");
    }
    let done = coflash(&["convert", &data("program.elf"), &out]);
    let crc = u32::from_le_bytes(fs::read(data("plain-400.blk")).unwrap()[0x36B..0x36F].try_into().unwrap());
    let words = format!("{out}: 4 blocks, program 4001 bytes from 0x08010000 on, CRC {crc:08X}h\n");
    assert_eq!(done.out, words);
}

/// The manual's calls word by word (chapter 5.1), apart from the addresses, which are those of
/// another chip.
#[test]
fn a_build_script_for_the_manuals_converter_works() {
    let folder = folder("legacy");
    let input = folder.file("blcop_app.hex", &fs::read(data("program.hex")).unwrap());
    let call = |options: &[&str]| {
        let mut convert = command();
        convert.current_dir(&folder).arg("convert").args(options);
        run(convert.env("SOURCE_DATE_EPOCH", "1420070400"))
    };
    let region = ["--start_address", "0x08010000", "--end_address", "0x080FFFFF"];
    let label = ["--vid", "0", "--pid", "1234", "--ver", "0x00640A01"];
    let files = ["blcop_app.hex", "blcop_app.bin"];
    let first = ["-I", "ihex", "-O", "Binary", "--block_size", "0x110"];
    call(&[&first[..], &region, &label, &files, &["--temp"]].concat()).good();
    assert!(fs::read(folder.path("blcop_app.bin")).unwrap() == fs::read(data("release-110.blk")).unwrap());
    assert!(fs::read(folder.path("blcop_app.tmp")).unwrap() == fs::read(data("program.bin")).unwrap());
    // Octal and suffixed numbers, the byte-wide fill of 2008, the CRC-16, and no name for the
    // output.
    call(&["--block_size", "02000", "--gap_fill", "0xFFul", "--crc16", "--adjust_start", "0", &input]).good();
    assert!(fs::read(folder.path("blcop_app.blk")).unwrap() == fs::read(data("crc16-400.blk")).unwrap());
    for format in ["S3", "S5", "S9", "srec"] {
        call(&["-I", format, &data("program.s3"), "s.blk", "--start_address", "0x08010000"]).good();
        assert!(fs::read(folder.path("s.blk")).unwrap() == fs::read(data("plain-400.blk")).unwrap());
    }
}

/// Blocks are copied unchanged: the tool reports which CRC they keep, and that options for another
/// one have no effect.
#[test]
fn convert_of_a_block_file_says_which_crc_it_keeps() {
    let folder = folder("convert-block");
    let out = folder.path("out.blk");
    for (name, options, kept, warns) in [
        ("plain-400.blk", &[][..], "CRC-32", false),
        ("plain-400.blk", &["--crc16"], "CRC-32", true),
        ("crc16-400.blk", &[], "CRC-16", false),
        ("crc16-400.blk", &["--crc16"], "CRC-16", false),
        ("crc16-400.blk", &["--vid", "1", "--pid", "2"], "CRC-16", true),
    ] {
        let input = data(name);
        let done = coflash(&[&["convert", "-I", "block", &input, &out][..], options].concat()).good();
        let words = format!("{input}: this is already a block file; it keeps its {kept}\n");
        assert!(done.out.starts_with(&words), "{}", done.out);
        assert_eq!(done.err.contains("cannot change a block file"), warns, "{options:?}: {}", done.err);
        assert!(fs::read(&out).unwrap() == fs::read(&input).unwrap());
    }
}

/// The bytes of `tests/abi/layout.rs`, whose check word comes from an implementation in another language; addresses of
/// RM0090 section 3.8, table 19.
#[test]
fn a_nameplate_goes_into_its_block() {
    const PLATE: [u8; 32] =
        *b"CBNP\x23\x01\0\0\x07\0\xA1\x5E\x03\0\x02\0\x40\xE2\x01\0\0\0\0\0\0\0\0\0\xFE\x3F\x2A\x54";
    let folder = folder("nameplate");
    let out = folder.path("plate.hex");
    let numbers = ["--vendor", "0x123", "--product", "0x5EA10007", "--revision", "0x00020003"];
    let make = |more: &[&str]| coflash(&[&["seal", "nameplate", &out][..], &numbers, more].concat());
    for (more, address, locks) in [
        (&["--serial", "123456"][..], 0x1FFF_7800, 0),
        (&["--serial", "123456", "--lock"], 0x1FFF_7800, 16),
        (&["--serial", "123456", "--block", "14", "--lock"], 0x1FFF_79C0, 2),
    ] {
        make(more).good();
        let image = ihex::read(&fs::read(&out).unwrap()).unwrap();
        assert_eq!(image.bytes(address), Some(PLATE));
        // The lock bytes are those up to 1FFF_7A0Fh.
        for lock in 0x1FFF_7A10 - locks..0x1FFF_7A10 {
            assert_eq!(image.bytes(lock), Some([0]), "{lock:X}");
        }
        assert_eq!(image.byte_count(), 32 + u64::from(locks));
    }
    make(&["--json"]).says(&[r#""serial_number":0"#, r#""locked":false"#]);
    assert!(
        ihex::read(&fs::read(&out).unwrap()).unwrap().bytes(0x1FFF_781C) == Some([0xEC, 0x22, 0x54, 0x33])
    );
    for (more, words) in [
        (&["--block", "16"][..], "0..=15"),
        (&["--serial", "0x100000000"], "it is not a number of up to 32 bits"),
    ] {
        make(more).fails(2, &[words]);
    }
    // What it makes is nothing for a device's flash.
    coflash(&["convert", &out, &folder.path("none.blk"), "--board", "stm32f407g-disc1"])
        .fails(3, &["one-time programmable"]);
}

/// Each fault of a file comes with something that the user can do.
#[test]
fn each_fault_of_a_file_says_what_to_do() {
    let folder = folder("faults");
    let hex = fs::read_to_string(data("program.hex")).unwrap();
    let srec = fs::read_to_string(data("program.s3")).unwrap();
    let elf = fs::read(data("program.elf")).unwrap();
    let with = |at: usize, value: u8| {
        let mut bytes = elf.clone();
        bytes[at] = value;
        bytes
    };
    let end = ":00000001FF";
    let again = "copy the file again";
    for (what, bytes, advice) in [
        ("no data", b"S0030000FC\nS9030000FC\n".to_vec(), "the linker's output"),
        ("a record type", hex.replace(end, ":0000000600FA").into_bytes(), again),
        ("its length", hex.replace(end, ":0100000401FA\n:00000001FF").into_bytes(), again),
        ("an unknown type", hex.replace(end, ":00000006FA").into_bytes(), again),
        ("half a byte", hex.replacen('\n', "0\n", 2).into_bytes(), again),
        ("a count", srec.replace("S705", "S5030005F7\nS705").into_bytes(), again),
        ("two files", [hex.clone(), hex.clone()].concat().into_bytes(), "one file"),
        ("64 bits", with(4, 2), "Arm"),
        ("big-endian", with(5, 2), "Arm"),
        ("another machine", with(18, 243), "Arm"),
        ("an object file", with(16, 1), "the linker's output"),
        ("an archive", b"PK\x03\x04".to_vec(), "unpack it"),
        (
            "other data twice",
            hex.replace(end, ":02000004080 1F1\n:0100000055AA\n:00000001FF").replace(' ', "").into_bytes(),
            "one address",
        ),
    ] {
        let file = folder.file("bad", &bytes);
        let done = coflash(&["inspect", &file]);
        assert_eq!(done.exit, 3, "{what}: {}{}", done.out, done.err);
        let (_, todo) = done.err.split_once("what to do: ").unwrap_or_else(|| panic!("{what}: {}", done.err));
        assert!(todo.contains(advice), "{what}: {}", done.err);
    }
    // Addresses of 24 bits do not reach the flash.
    coflash(&["convert", &data("program.s2"), &folder.path("out.blk"), "--board", "nucleo-f446re"])
        .fails(3, &["S3 records", "--adjust-start"]);
    let low = fs::read_to_string(data("program.hex")).unwrap().replacen(":020000040801F1", "", 1);
    coflash(&["convert", &folder.file("low.hex", low.as_bytes()), &folder.path("out.blk")])
        .fails(0, &["S3 records", "warning"]);
    // Addresses that a person has moved are as they were asked for, also in a block file.
    for (file, options) in [("program.hex", &["--adjust-start", "0xF8000000"][..]), ("adjusted-400.blk", &[])]
    {
        let words = ["convert", &data(file), &folder.path("out.blk")];
        let done = coflash(&[&words[..], options].concat()).good();
        assert!(!done.err.contains("warning"), "{file}: {}", done.err);
    }
}

#[test]
fn inspect_tells_what_a_file_holds() {
    let shown = |file: &str, options: &[&str]| {
        run(command().current_dir(data("")).args(["inspect", file]).args(options)).good()
    };
    snapshot("inspect-release", &shown("release-110.blk", &[]).out);
    snapshot("inspect-crc16", &shown("crc16-400.blk", &["--board", "nucleo-f446re"]).out);
    snapshot("inspect-hex", &shown("program.hex", &[]).out);
    let json = shown("release-110.blk", &["--json"]).json();
    assert_eq!(json["format"], "block file");
    assert_eq!(json["blocks"]["identity"]["product_code"], 1234);
    assert_eq!(json["blocks"]["release"]["version_text"], "V1.10r100");
    assert_eq!(json["blocks"]["program"]["size"], 4001);
    assert_eq!(json["blocks"]["program"]["start"], 0x0801_0000);
    assert_eq!(json["blocks"]["all"].as_array().unwrap().len(), 6);

    let folder = folder("inspect");
    let mut damaged = fs::read(data("release-110.blk")).unwrap();
    damaged[0x50] ^= 1;
    let done = coflash(&["inspect", "--json", &folder.file("damaged.blk", &damaged)]);
    assert_eq!((done.exit, done.err.as_str()), (3, ""));
    let json = done.json();
    assert_eq!(json["error"]["number"], "0x60000020");
    assert!(json["error"]["what"].as_str().unwrap().contains("CRC of block 1"), "{}", done.out);
    let far =
        fs::read_to_string(data("program.hex")).unwrap().replacen(":020000040801F1", ":020000040800F2", 1);
    let far = folder.file("far.hex", far.as_bytes());
    coflash(&["inspect", &far]).good();
    coflash(&["inspect", &far, "--board", "nucleo-f446re"]).fails(3, &["lies outside"]);
    // Fill bytes up to the end of the flash, where a new bootloader waits (RM0090 table 5: sector
    // 11).
    let mut full = vec![0xFF; 0xE_0000];
    full[..8].copy_from_slice(&[0xC0, 0xFF, 1, 0x20, 1, 2, 2, 8]);
    let (full, out) = (folder.file("full.bin", &full), folder.path("full.blk"));
    for words in [&["inspect", &full][..], &["convert", &full, &out]] {
        for place in [["--board", "stm32f407g-disc1"], ["--start-address", "0x08020000"]] {
            let done = coflash(&[words, &place].concat()).good();
            let said = done.out + &done.err;
            assert!(said.contains("the program reaches into staging, from 080E0000h on"), "{said}");
        }
    }
    // The manual's tool converts any data; without a board it is done with a warning.
    let signed = folder.file("signed.bin", &[&b"\x3D\xB8\xF3\x96"[..], &[0; 60]].concat());
    coflash(&["convert", &signed, &out, "--start-address", "0x08020000"])
        .fails(0, &["warning", "an image for MCUboot"]);
    coflash(&["convert", &signed, &out]).fails(3, &["but an image for MCUboot", "zephyr.elf"]);
}

/// A file without an end, or larger than any firmware, is reported and not read.
#[test]
#[cfg(unix)]
fn what_is_no_file_or_too_large_is_not_read() {
    let folder = folder("endless");
    let fifo = folder.path("fifo");
    assert!(Command::new("mkfifo").arg(&fifo).status().unwrap().success());
    let large = folder.path("large.elf");
    fs::File::create(&large).unwrap().set_len(64 * 1024 * 1024 + 1).unwrap();
    let settings = folder.path("large.toml");
    fs::File::create(&settings).unwrap().set_len(2 * 1024 * 1024).unwrap();
    for (file, words) in [
        ("/dev/zero", "/dev/zero: is a device, pipe or socket and not a file"),
        (&fifo, "fifo: is a device, pipe or socket and not a file"),
        (folder.to_str().unwrap(), &format!("{}: is a folder and not a file", folder.display())),
        (&large, "large.elf: has 67108865 bytes, and a firmware file has at most 67108864"),
    ] {
        for command in [&["inspect"][..], &["convert"], &["--bus", NOWHERE, "flash"]] {
            coflash(&[command, &[file]].concat()).fails(3, &[words]);
        }
    }
    for words in [
        &["--bus", NOWHERE, "flash", "--job", "/dev/zero"][..],
        &["--bus", NOWHERE, "flash", "--job", &settings],
        &["--config", "/dev/zero", "inspect", &data("program.hex")],
    ] {
        coflash(words).fails(3, &["has more than 1048576 bytes"]);
    }
}

/// The image of a bootloader is refused before the bus is opened, and so is an image that is not a
/// program.
#[test]
fn what_can_be_no_program_is_refused_without_a_bus() {
    let folder = folder("no-program");
    let vectors = [0x2001_FFC0_u32, 0x0800_0189].map(u32::to_le_bytes).concat();
    let bootloader = folder.file("bootloader.bin", &[&vectors[..], &[0x5A; 1000]].concat());
    let zeros = folder.file("zeros.bin", &[0; 1000]);
    let flash = |file: &str, options: &[&str]| {
        coflash(&[&["--bus", NOWHERE, "flash", file, "-I", "binary"], options].concat())
    };
    let at_the_start = "bootloader.bin: begins at the start of the flash";
    for (file, options, words) in [
        (&bootloader, &["--start-address", "0x08000000"][..], at_the_start),
        (&bootloader, &["--dialect", "raw"], at_the_start),
        (&bootloader, &["--board", "nucleo-f446re"], "its reset vector is 08000189h, outside 0x08010000"),
        (&zeros, &["--board", "nucleo-f446re"], "zeros.bin: is not a program: all its bytes are 00h"),
        (&zeros, &["--dialect", "lift", "--unlock", "x"], "zeros.bin: is not a program"),
    ] {
        flash(file, options).fails(3, &[words, "0x60000021"]);
        // With --force it passes, and fails because there is no bus; so do data, which may be any
        // bytes.
        let done = flash(file, &[options, &["--force"]].concat());
        assert!(done.exit != 3 && done.err.contains("127.0.0.1:1"), "{}", done.err);
    }
    let done = flash(&zeros, &["--dialect", "lift", "--unlock", "x", "--program", "2"]);
    assert!(done.exit != 3 && done.err.contains("127.0.0.1:1"), "{}", done.err);
}

/// The label of an image (`docs/dialects.md`) is shown by `inspect`, and goes into block 0.
#[test]
fn the_label_is_shown_and_goes_into_block_0() {
    let folder = folder("label");
    let mut image = vec![0x5A; 1024];
    image[..8].copy_from_slice(&[0x2001_FFC0_u32, 0x0801_0201].map(u32::to_le_bytes).concat());
    let mut label = [u32::from_le_bytes(*b"CBL1"), 0x319, 0x4007_D151, 0x0001_0203, 0, 0, 0].to_vec();
    label.push(shared_abi::check_word(&label));
    image[0x1E0..0x200]
        .copy_from_slice(&label.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>());
    let file = folder.file("app.bin", &image);
    let raw = ["-I", "binary", "--board", "nucleo-f446re"];

    coflash(&[&["inspect", &file][..], &raw].concat()).says(&[
        "  label        vendor-ID 00000319h, product code 4007D151h, version V3.2r1\n",
        "  judged       can be a program",
    ]);
    let json = coflash(&[&["--json", "inspect", &file][..], &raw].concat()).json();
    assert_eq!((&json["label"]["product_code"], &json["fault"]), (&0x4007_D151.into(), &Value::Null));

    let out = folder.path("app.blk");
    for (options, data) in [
        // Size of the program, vendor-ID, product code, version, date of 64 bits (manual, table 6).
        (&[][..], vec![1024, 0x319, 0x4007_D151, 0x0001_0203, 0, 0]),
        (&["--date", "1420070400"], vec![1024, 0x319, 0x4007_D151, 0x0001_0203, 1_420_070_400, 0]),
        (&["--vid", "1", "--pid", "2"], vec![1024, 1, 2]),
        (&["--no-label"], vec![0, 0]),
    ] {
        let mut convert = command();
        convert.args(["convert", &file, &out]).args(raw).args(options);
        let done = run(convert.env_remove("SOURCE_DATE_EPOCH")).good();
        let block: Vec<u8> = data.iter().flat_map(|word: &u32| word.to_le_bytes()).collect();
        let bytes = fs::read(&out).unwrap();
        assert_eq!(bytes[8..12], (block.len() as u32).to_le_bytes(), "{options:?}");
        assert_eq!(bytes[12..12 + block.len()], block, "{options:?}");
        assert_eq!(done.out.contains("as its label says"), data.len() == 6, "{}", done.out);
    }
    // A date that would be lost is refused.
    for options in [&["--vid", "1", "--pid", "2"][..], &["--no-label"]] {
        let date = ["--date", "1420070400"];
        coflash(&[&["convert", &file, &out][..], &raw, options, &date].concat()).fails(2, &["without --ver"]);
    }
    // The block file has the label, too, and `inspect` shows it.
    coflash(&["inspect", &out]).says(&["  label        vendor-ID 00000319h"]);
}

#[test]
fn quiet_says_nothing_and_json_says_one_document() {
    let folder = folder("quiet");
    let out = folder.path("out.blk");
    let done = coflash(&["convert", "-q", &data("program.elf"), &out]);
    assert_eq!((done.exit, done.out.as_str(), done.err.as_str()), (0, "", ""));
    let json = coflash(&["--json", "convert", &data("program.elf"), &out]).json();
    let crc = u32::from_le_bytes(fs::read(data("plain-400.blk")).unwrap()[0x36B..0x36F].try_into().unwrap());
    assert_eq!((&json["program"]["size"], &json["program"]["crc"]), (&4001.into(), &crc.into()));
    assert_eq!((&json["blocks"], &json["left_out"]), (&4.into(), &0.into()));
    // A warning about data that are left out appears beside the document.
    let done = coflash(&["--json", "convert", &data("program.elf"), &out, "--end-address", "0x080102C5"]);
    done.fails(0, &["25 bytes outside the address range were left out [0x60002001]"]);
    assert_eq!(done.json()["left_out"], 25);
}

#[test]
fn a_bad_file_is_named_and_no_device_is_touched() {
    let folder = folder("bad");
    let hex = fs::read_to_string(data("program.hex")).unwrap();
    let blocks = fs::read(data("plain-400.blk")).unwrap();
    let elf = fs::read(data("program.elf")).unwrap();
    let damaged = hex.replacen(":08", ":09", 1);
    let mut damaged_blocks = blocks.clone();
    damaged_blocks[100] ^= 1;
    let line = 1 + hex.lines().position(|line| line.starts_with(":08")).unwrap();
    // Another byte at 08010000h, where line 2 has put 00h.
    let twice = hex.replacen(":04000005", ":020000040801F1\n:0100000001FE\n:04000005", 1);
    let twice_line = 1 + twice.lines().position(|line| line == ":0100000001FE").unwrap();
    let twice_words = format!("twice.hex, line {twice_line}: the data at 0x08010000 overlaps that of line 2");
    let far = hex.replacen(":020000040801F1", ":020000040800F2", 1);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    listener.set_nonblocking(true).unwrap();
    let bus = format!("socketcand://{}/can0", listener.local_addr().unwrap());
    for (name, bytes, words) in [
        ("empty.hex", &b""[..], "empty.hex: is empty".to_string()),
        ("text.txt", b"hello", "text.txt: is not a firmware file".to_string()),
        (
            "cut.hex",
            &hex.as_bytes()[..hex.len() - 20],
            format!(
                "cut.hex, line {}: the last byte has only one digit; the line is truncated",
                hex.lines().count() - 1
            ),
        ),
        ("damaged.hex", damaged.as_bytes(), format!("damaged.hex, line {line}: the record is cut off")),
        ("twice.hex", twice.as_bytes(), twice_words),
        (
            "far.hex",
            far.as_bytes(),
            "far.hex, line 2: the data at 0x08000000..=0x08000007 lies outside 0x08010000..=0x0807ffff"
                .to_string(),
        ),
        (
            "sum.hex",
            b":020000040801F1\n:0400000000C0012017\n:00000001FF\n",
            "sum.hex, line 2: checksum is 17 and must be 1B: the line is damaged".to_string(),
        ),
        ("damaged.blk", &damaged_blocks, "damaged.blk, offset 0x18: CRC of block 1 is ".to_string()),
        ("cut.blk", &blocks[..500], "cut.blk, offset 0x18: a block is cut off".to_string()),
        ("cut.elf", &elf[..200], "cut.elf: the file is cut off".to_string()),
    ] {
        let file = folder.file(name, bytes);
        let out = folder.path("out.blk");
        let board = ["--board", "nucleo-f446re"];
        for command in [&["convert", &file, &out][..], &["--bus", &bus, "flash", &file]] {
            let done = coflash(&[command, &board].concat());
            assert!(done.err.starts_with("error: "), "{}", done.err);
            done.fails(3, &[&words, "[0x600000"]);
        }
        assert!(!Path::new(&out).exists());
    }
    coflash(&["--bus", &bus, "flash", &folder.path("missing.hex")])
        .fails(3, &["missing.hex: cannot be read: "]);
    assert_eq!(listener.accept().unwrap_err().kind(), ErrorKind::WouldBlock, "nobody came to the bus");
}

#[test]
fn wrong_usage_is_explained() {
    let hex = data("program.hex");
    for (arguments, words) in [
        (&["flash", &hex][..], "give --bus URL or set COFLASH_BUS"),
        (&["flash", &hex, "--board", "arduino"], "known boards: nucleo-f446re, stm32f407g-disc1"),
        (&["flash", &hex, "--board", "stm32f407g-disc1", "--program", "2"], "its programs are 1 to 1"),
        (&["convert", &hex, "out", "--vid", "1"], "--pid"),
        (&["convert", &hex, "out", "--block-size", "16"], "must be 24 to 16384"),
        (&["convert", &hex, "out", "--start-address", "08"], "not a number in C notation"),
        (&["convert", &hex, &hex], "overwrite its own input"),
        (&["convert", &hex, "out", "-O", "elf"], "binary"),
        (
            &["convert", &hex, "out", "--key", "cf7a7fe196f64c6b8f19e58361d2397e", "--add", "0xA5"],
            "encrypted",
        ),
        (&["convert", &hex, "out", "--adjust-start", "0xF7FEFFF0"], "beyond the end of the address space"),
        (&["-q", "-v", "convert", &hex, "out"], "cannot be used with"),
        (&[], "Usage"),
    ] {
        coflash(arguments).fails(2, &[words]);
    }
}

#[test]
fn flash_and_info_over_a_socket() {
    let words = ["flash", "--node", "5", "--board", "nucleo-f446re", &data("program.elf")];
    let (done, fake) = served(quick(APPLICATION), &words);
    assert_eq!(fake.blocks.concat(), fs::read(data("plain-400.blk")).unwrap());
    assert_eq!(fake.running, Some(APPLICATION));
    done.says(&[
        "calling the application back",
        "the bootloader is running",
        "100 %  883 of 883 bytes",
        "the trial was successful",
        "released for autostart",
        "running: an application",
        "done in ",
    ]);

    let (bus, _server) = serve(fake);
    let done = run(command().args(["info", "--node", "5"]).env("COFLASH_BUS", bus)).good();
    assert!(done.out.starts_with("node 5: an application (device type 00020192h)\n"), "{}", done.out);
}

#[test]
fn the_target_is_checked_before_anything_is_erased() {
    let file = data("program.hex");
    // --force leaves the device to judge, but not what the user asks to be checked.
    let other = ["--force", "--vid", "0x40", "--pid", "1234"];
    for option in [&["--check-target"][..], &["--chk_tgt", "1"]] {
        let words = [&["flash", "--node", "5", &file][..], &other, option].concat();
        let (done, fake) = served(Fake::new(APPLICATION), &words);
        assert_eq!(done.exit, 3, "{}", done.err);
        assert_eq!(
            done.err,
            "error: the program is for vendor-ID 00000040h, and node 5 has 0000003Fh [0x60000180]\n  \
             the device: it was not changed\n  what to do: check that file and device belong together \
             (coflash info shows the device's identity)\n"
        );
        assert_eq!(fake.writes().len(), 0);
    }
    // A file that names no device cannot be checked, unless the command line names one.
    let plain = data("program.elf");
    coflash(&["--bus", NOWHERE, "flash", "--check-target", &plain]).fails(2, &["--vid and --pid"]);
    let target = ["--check-target", "--vid", "0x3F", "--pid", "1234"];
    let words = [&["--json", "flash", "-N", "5", "--no-start", &plain][..], &target].concat();
    let (done, fake) = served(quick(BOOTLOADER), &words);
    let json = done.good().json();
    assert_eq!((&json["command"], &json["node"], &json["program"]), (&"flash".into(), &5.into(), &1.into()));
    assert_eq!((&json["size"], &json["running"]), (&4001.into(), &Value::Null));
    assert_eq!((&json["transfer"], &json["blocks_repeated"]), (&"segments".into(), &0.into()));
    // Block 0: vendor-ID and product code after the size.
    assert_eq!(fake.blocks[0][16..24], [0x3F, 0, 0, 0, 0xD2, 4, 0, 0]);
    assert_eq!(fake.count("command 01"), 0);
}

#[test]
fn a_failure_in_json_has_the_manuals_number_and_the_devices_state() {
    let fake = device(BOOTLOADER, |fake| fake.on_block = Box::new(|_| Outcome::Status(0x0E)));
    let (done, _) = served(fake, &["flash", "--json", "-N", "5", &data("plain-400.blk")]);
    assert_eq!((done.exit, done.err.as_str()), (6, ""));
    let json = done.json();
    assert_eq!(json["error"]["number"], "0x60000007");
    assert_eq!((&json["error"]["exit"], &json["error"]["device"]), (&6.into(), &"erased".into()));
    assert_eq!(json["error"]["seen"]["bootloader"], true);
}
