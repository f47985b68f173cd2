//! The functions of the manual's tools (L-1112e_5, L-1112d_10), with their own options.

use std::fs;
use std::net::TcpListener;

use super::adapters::serve_slcan;
use crate::tool::{coflash, command, data, device, folder, quick, run, served, Done, NOWHERE};
use kit::fake::renewal::image;
use kit::fake::{serve, Fake, Outcome, APPLICATION, BOOTLOADER};

/// The exit code that the system reports: Unix keeps eight bits, Windows all of them.
fn shown(number: u32) -> i32 {
    if cfg!(windows) {
        number as i32
    } else {
        (number & 0xFF) as i32
    }
}

/// Table 5 of the older manual and table 10 of the newer one: the values of ERRORLEVEL.
#[test]
fn with_legacy_exit_codes_the_program_ends_with_the_manuals_numbers() {
    let file = data("plain-400.blk");
    let status = |word| device(BOOTLOADER, |fake| fake.on_block = Box::new(move |_| Outcome::Status(word)));
    for (fake, number) in [
        (device(BOOTLOADER, |fake| fake.crc = Some(0x1234_5678)), 0x6000_0001),
        (status(0x04), 0x6000_0002),
        (status(0x06), 0x6000_0003),
        (status(0x08), 0x6000_0004),
        (status(0x0A), 0x6000_0005),
        (status(0x0C), 0x6000_0006),
        (status(0x0E), 0x6000_0007),
        (status(0x84), 0x6000_0008),
        (status(0x86), 0x6000_0012),
        (device(BOOTLOADER, |fake| fake.running = None), 0x6000_0013),
        (device(BOOTLOADER, |fake| fake.starts = Some(BOOTLOADER)), 0x6000_0014),
        (quick(BOOTLOADER), 0),
    ] {
        let times = ["--boot-timeout", "200", "--sdo-timeout", "100"];
        let (done, _) =
            served(fake, &[&["flash", "--legacy-exit-codes", "-N", "5", &file][..], &times].concat());
        assert_eq!(done.exit, shown(number), "{number:08X}h: {}", done.err);
    }
}

#[test]
fn without_a_device_they_are_the_manuals_too() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let closed = format!("socketcand://{}/can0", listener.local_addr().unwrap());
    drop(listener);
    let folder = folder("legacy-exit");
    let file = data("plain-400.blk");
    let hex = fs::read_to_string(data("program.hex")).unwrap();
    // A record with the checksum FDh in place of FEh, and one that is cut off.
    let damaged = folder.file("damaged.hex", b":0100000001FD\n:00000001FF\n");
    let cut = folder.file("cut.hex", hex.replacen(":08", ":09", 1).as_bytes());
    let far = folder.file("far.hex", hex.replacen(":020000040801F1", ":020000040800F2", 1).as_bytes());
    let board = "stm32f407g-disc1";
    for (arguments, number) in [
        // No CAN interface (CANopen stack), and an unknown kind of interface.
        (&["--bus", &closed, "flash", &file][..], 0x6000_101B),
        (&["--bus", "nothing:0", "flash", &file], 0x6000_1019),
        (&["--bus", &closed, "flash", &file, "-N", "128"], 0x6000_0017),
        (&["--bus", &closed, "flash", &file, "-P", "255"], 0x6000_0018),
        (&["--bus", &closed, "flash"], 0x6000_0018),
        (&["flash", &file], 0x6000_0018),
        (&["flash", &damaged], 0x6000_0020),
        (&["flash", &cut], 0x6000_0022),
        (&["flash", &far, "--board", board], 0x6000_0015),
        // ENOENT: "an error code from the operating system".
        (&["flash", "no such file.blk"], 2),
        (&["--version"], 0),
    ] {
        for way in [true, false] {
            let mut command = command();
            command.args(arguments);
            let done = run(match way {
                true => command.arg("--legacy-exit-codes"),
                false => command.env("COFLASH_LEGACY_EXIT_CODES", "1"),
            });
            assert_eq!(done.exit, shown(number), "{arguments:?}, {number:08X}h: {}", done.err);
        }
    }
    run(command().args(["flash", &file, "-N", "128"]).env("COFLASH_LEGACY_EXIT_CODES", "0")).fails(2, &[]);
}

/// Tables 12 and 13, printed with the options of chapter 5.3; no file and no bus is needed.
#[test]
fn a_question_mark_lists_interfaces_and_bit_rates() {
    let done = coflash(&["flash", "--vxd_type", "?"]);
    assert_eq!((done.exit, done.err.as_str()), (0, ""));
    let lines: Vec<&str> = done.out.lines().collect();
    assert_eq!(lines.len(), 1 + 16 + 1, "{}", done.out);
    assert!(lines[4].starts_with("4 ") && lines[4].contains("SYS TEC USB-CANmodul"), "{}", lines[4]);
    assert!(lines[16].starts_with("16 ") && lines[16].ends_with("slcan:PORT"), "{}", lines[16]);
    // What --bus is given on Windows: PCAN-Basic has names for plug-and-play adapters (PCANBasic.h),
    // and this tool loads no library of SYS TEC.
    assert!(lines[0].ends_with("--bus on Linux  --bus on Windows"), "{}", lines[0]);
    for (number, linux, windows) in [
        (4, "socketcan:can0", "none"),
        (5, "socketcan:can0", "peak:PCAN_PCIBUS1@BITRATE"),
        (10, "socketcan:can0", "none"),
        (11, "socketcan:can0", "peak:PCAN_USBBUS1@BITRATE"),
        (14, "none", "none"),
    ] {
        let words: Vec<&str> = lines[number].split_whitespace().rev().take(2).collect();
        assert_eq!(words, [windows, linux], "{}", lines[number]);
    }
    for spelling in ["-B", "--br_idx"] {
        let done = coflash(&["flash", spelling, "?"]);
        assert_eq!((done.exit, done.err.as_str()), (0, ""));
        let rates: Vec<Vec<&str>> = done.out.lines().map(|line| line.split_whitespace().collect()).collect();
        let table = [1000, 800, 500, 250, 125, 100, 50, 20, 10].map(|rate: u32| rate.to_string());
        let found: Vec<&str> = rates[1..].iter().map(|row| row[1]).collect();
        assert_eq!(found, table);
        assert_eq!(rates[9][..], ["8", "10", "kbit/s"]);
    }
    coflash(&["flash", "--vxd_type", "17"]).fails(2, &["interfaces are 1 to 16"]);
    coflash(&["flash", "--vxd_type", "4"]).fails(2, &["no firmware file is named"]);
}

/// The words of a call of DotNetFlashtool, for `flash`, with the block file that it names.
fn dot_net(file: &str, call: &str, bus: &str) -> Done {
    let folder = folder("dot-net");
    folder.file(file, &fs::read(data("plain-400.blk")).unwrap());
    let words = ["--bus", bus, "flash"];
    run(command().current_dir(&folder).args(words).args(call.split_whitespace()))
}

/// Such a call on the bus of this device, which succeeds.
fn dot_net_on(fake: Fake, file: &str, call: &str) -> (Done, Fake) {
    let (bus, server) = serve(fake);
    let done = dot_net(file, call, &bus);
    assert_eq!(done.exit, 0, "{call}: {}", done.err);
    (done, server.join().unwrap())
}

const NO_TRIAL: &str =
    "no trial, as DotNetFlashtool makes none: the program is released before its first start (--chk_run tries it first)\n";

/// The examples of chapter 5.3, word by word and with the printed dashes, after the name of the
/// program; the last one is in a test of its own. The note on the last steps of a download (chapter 3) says that this tool starts no program
/// for a moment; so the program is released (83h) and then started, once.
#[test]
fn the_examples_of_dotnetflashtool_word_by_word() {
    for (file, call, node, program, ignored) in [
        ("blcop_app.bin", "–F blcop_app.bin", 1, 1, 0),
        ("blcop_app.bin", "–F blcop_app.bin --node_id 0x62 --baudrate 500 --device_no 5", 0x62, 1, 1),
        ("blcop_app2.bin", "–F blcop_app2.bin --node_id 15 --br_idx 4 --device_no 255 --prog_no 2", 15, 2, 1),
        (
            "blcop_app.bin",
            "–F blcop_app.bin --node_id 0xF --vxd_type 16 --baudrate 115200 --device_no 7",
            15,
            1,
            2,
        ),
    ] {
        let (done, fake) = dot_net_on(quick(BOOTLOADER).at(node, program), file, call);
        assert_eq!(done.out.matches(NO_TRIAL).count(), 1, "{call}: {}", done.out);
        assert_eq!(done.err.matches("is ignored").count(), ignored, "{call}: {}", done.err);
        assert_eq!(fake.running, Some(APPLICATION), "{call}");
        let commands: Vec<&str> = fake.writes().into_iter().filter(|entry| entry.starts_with("c")).collect();
        assert_eq!(commands, ["command 03", "command 83", "command 01"], "{call}");
    }
}

/// Chapter 5.2: BinaryBlockDownload makes the trial. Only what DotNetFlashtool alone has leaves it out.
#[test]
fn only_the_words_of_dotnetflashtool_leave_the_trial_out() {
    for (call, trials) in [
        ("blcop_app.bin -N 5", 1),
        ("-P 1 -B 4 -N 5 --delay 20 --repeats 0x000400 --timeout 500 blcop_app.bin", 1),
        ("blcop_app.bin -N 5 --sdo_timeout 500 --chk_tgt 0 --device_no 255", 1),
        (
            "-F blcop_app.bin --node_id 0x05 --br_idx 4 --device_no 255 --prog_no 1 --chk_run --sdo_timeout 500 \
             --chk_tgt 0 --vxd_type 4 --baudrate 500",
            1,
        ),
        ("blcop_app.bin --node_id 5", 0),
        ("blcop_app.bin -N 5 --prog_no 1", 0),
        ("-F blcop_app.bin -N 5", 0),
        ("blcop_app.bin -N 5 --no-trial", 0),
    ] {
        let (done, fake) = dot_net_on(quick(BOOTLOADER), "blcop_app.bin", call);
        assert!(fake.blocks.concat() == fs::read(data("plain-400.blk")).unwrap(), "{call}");
        assert_eq!(fake.count("command 80"), trials, "{call}");
        assert_eq!(fake.count("command 83"), 1, "{call}");
        let said = trials == 0 && !call.contains("--no-trial");
        assert_eq!(done.out.contains(NO_TRIAL), said, "{call}: {}", done.out);
    }
    // A job file is none of its words: it says itself whether there is a trial.
    let folder = folder("dot-net-job");
    folder.file("blcop_app.bin", &fs::read(data("plain-400.blk")).unwrap());
    let job = folder.file("job.toml", b"[[program]]\nimage = 'blcop_app.bin'\nnodes = [5]\n");
    let (done, fake) = served(quick(BOOTLOADER), &["flash", "--job", &job, "--prog_no", "1"]);
    assert_eq!((done.exit, done.out.contains(NO_TRIAL)), (0, false), "{}", done.err);
    assert_eq!(fake.count("command 80"), 1);
    // A program that is not started is not released either.
    let call = "-F blcop_app.bin --node_id 5 --no-start";
    let (done, fake) = dot_net_on(quick(BOOTLOADER), "blcop_app.bin", call);
    assert_eq!((done.out.contains("no trial"), fake.count("command 83")), (false, 0), "{}", done.out);
}

/// DotNetFlashtool knows no new bootloaders, and without its trial none is installed: here its words
/// change nothing, and the tool goes as far as the bus.
#[test]
fn its_words_leave_the_trial_of_a_bootloader_in() {
    let folder = folder("dot-net-bootloader");
    let file = folder.file("new.bin", &image(0x0000_0102));
    let call = |words: &[&str]| coflash(&[&["--bus", NOWHERE, "flash"], words].concat());
    let done = call(&["-F", &file, "--node_id", "5"]);
    assert_eq!(done.exit, 4, "{}", done.err);
    assert!(done.out.contains("bootloader") && !done.out.contains("no trial"), "{}", done.out);
    call(&["--node", "5", "--no-trial", &file]).fails(2, &["--no-trial"]);
}

#[test]
fn words_that_contradict_each_other_are_refused() {
    let file = data("plain-400.blk");
    for (words, expected) in [
        (&["-F", &file, &file][..], "cannot be used with"),
        (&["-F", &file, "--node_id", "5", "--node", "5"], "cannot be used with"),
        (&["-F", &file, "--prog_no", "1", "--program", "1"], "cannot be used with"),
        (&["-F", &file, "--chk_run", "--no-trial"], "cannot be used with"),
        (&["-F", "–I"], "a value is required"),
        (&["-F", &file, "--prog_no", "0"], "programs are 1 to 254"),
        (&[&file, "--gateway_id", "3"], "SDO gateway"),
        (&[&file, "-B", "9"], "0 (1 Mbit/s) to 8"),
    ] {
        coflash(&[&["--bus", NOWHERE, "flash"], words].concat()).fails(2, &[expected]);
    }
}

/// Chapter 5.3: node-IDs are 1 to 126, and the tool itself has 127. `ERR_INVALID_NODEID` is
/// 60000017h (L-1112e_5, table 5).
#[test]
fn a_wrong_node_id_has_the_manuals_number() {
    let file = data("plain-400.blk");
    for (words, expected) in [
        (&["flash", "-F", &file, "--node_id", "0"][..], "node-IDs are 1 to 127"),
        (&["flash", "-F", &file, "--node_id", "127"], "127 is DotNetFlashtool's own"),
        (&["flash", "-F", &file, "--node_id", "120-127"], "127 is DotNetFlashtool's own"),
        (&["flash", &file, "--node", "0"], "node-IDs are 1 to 127"),
        (&["info", "--node", "0"], "node-IDs are 1 to 127"),
        (&["info", "-N", "128"], "node-IDs are 1 to 127"),
    ] {
        let done = coflash(&[&["--json"][..], words].concat());
        let json = done.json();
        assert_eq!((done.exit, &json["error"]["number"]), (2, &"0x60000017".into()), "{words:?}: {json}");
        assert!(json["error"]["what"].as_str().unwrap().contains(expected), "{words:?}: {json}");
    }
    // Any other wrong command line has the number with which the manual's tools would end.
    assert_eq!(coflash(&["--json", "flash", "--no-such"]).json()["error"]["number"], "0x60000018");
    // This tool has no node-ID of its own.
    let call = "-F blcop_app.bin --node 127";
    let (_, fake) = dot_net_on(quick(BOOTLOADER).at(127, 1), "blcop_app.bin", call);
    assert_eq!(fake.running, Some(APPLICATION));
}

/// Table 11: the default of --br_idx is 0, 1 Mbit/s (table 13), S8 of the CAN232 manual. An adapter
/// that has a bit rate of its own keeps it for every other call.
#[test]
fn the_default_bit_rate_is_that_of_dotnetflashtool() {
    for (call, url, rate) in [
        ("-F blcop_app.bin --node_id 5", "", Some("S8")),
        ("-F blcop_app.bin --node_id 5 --br_idx 4", "", Some("S4")),
        ("-F blcop_app.bin --node_id 5", "@250k", Some("S5")),
        ("-P 1 -N 5 blcop_app.bin", "", None),
        ("-F blcop_app.bin --node_id 5 --vxd_type 16 --baudrate 115200", "", None),
    ] {
        let (address, server) = serve_slcan(quick(BOOTLOADER));
        let done = dot_net("blcop_app.bin", call, &format!("slcan:tcp://{address}{url}"));
        assert_eq!(done.exit, 0, "{call}: {}", done.err);
        let (_, said) = server.join().unwrap();
        assert_eq!(said.iter().find(|word| word.starts_with('S')).map(String::as_str), rate, "{call}");
    }
}

/// `ERR_SREC_NO_VALID_S3` (L-1112e_5, table 5): the indicated file does not have the S3 format.
#[test]
fn a_file_that_is_not_of_the_named_format_is_error_21h() {
    let folder = folder("named-format");
    let zip = folder.file("app.s3", b"PK\x03\x04\x14\0\0\0\0\0\0\0");
    let text = folder.file("text.s3", b"hello\n");
    let damaged = folder.file("damaged.s3", b"S1040000AA52\nS9030000FC\n");
    let hex = data("program.hex");
    for (format, file, number, words) in [
        ("S3", &hex, "0x60000021", "is no Motorola S-record file, but Intel HEX"),
        ("ihex", &data("program.s3"), "0x60000021", "is no Intel HEX file, but Motorola S-record"),
        ("S3", &data("program.bin"), "0x60000021", "is no Motorola S-record file"),
        ("S9", &text, "0x60000021", "is no Motorola S-record file"),
        ("S5", &zip, "0x60000021", "is not a firmware file but"),
        // A file of the format with a damaged line has the number of its fault: ERR_SREC_CRC_ERROR.
        ("S3", &damaged, "0x60000020", "the line is damaged"),
    ] {
        for command in ["convert", "flash"] {
            let done = coflash(&["--json", command, file, "-I", format]);
            let json = done.json();
            assert_eq!((done.exit, &json["error"]["number"]), (3, &number.into()), "{file}: {json}");
            assert!(json["error"]["what"].as_str().unwrap().contains(words), "{file}: {json}");
        }
    }
    let done = coflash(&["--legacy-exit-codes", "convert", &hex, "-I", "S3"]);
    assert_eq!(done.exit, shown(0x6000_0021), "{}", done.err);
}

/// The manual's example with CAN over a serial line: its bit rate is 115200 bit/s.
#[test]
fn a_serial_line_has_115200_bits_a_second() {
    let file = data("plain-400.blk");
    let line = ["--node_id", "0x05", "--vxd_type", "16", "--device_no", "7"];
    let words = [&["flash", "-F", &file, "--baudrate", "115200"][..], &line].concat();
    served(quick(BOOTLOADER), &words).0.fails(0, &["--vxd_type is ignored"]);
    // Without --bus, the number names the port.
    coflash(&words).fails(4, &[if cfg!(windows) { "COM7" } else { "/dev/ttyS6" }]);
    for (options, words) in [
        (&["--baudrate", "9600", "--vxd_type", "16"][..], "its bit rate is 115200"),
        (&["--baudrate", "115200"], "1 to 1000 kbit/s"),
    ] {
        coflash(&[&["--bus", "slcan:nowhere", "flash", "-F", &file][..], options].concat())
            .fails(2, &[words]);
    }
}

/// Table 12, interface 14, with the last example of chapter 5.3: the device is on the bus of that gateway. A
/// bus that is known from somewhere else is another one, and nothing may be sent there.
#[test]
fn the_can_ethernet_gateway_stops_and_names_what_to_use() {
    let example = "–F blcop_app.bin --node_id 20 --vxd_type 14 --ip_addr 192.168.1.10 --ip_port 1234";
    let (bus, server) = serve(quick(BOOTLOADER));
    let refused = |done: &Done| {
        done.fails(2, &["--vxd_type 14", "--bus", "socketcand://", "slcan:tcp://", "cia309://"]);
    };
    refused(&dot_net("blcop_app.bin", example, &bus));
    let file = data("plain-400.blk");
    let words = ["flash", "-F", &file, "--node_id", "20", "--vxd_type", "14"];
    refused(&coflash(&words));
    refused(&run(command().args(words).env("COFLASH_BUS", &bus)));
    // The bus was never opened: the first connection is this one.
    coflash(&["--bus", &bus, "more", "release", "-N", "5"]).good();
    assert_eq!(server.join().unwrap().count("command 83"), 1);
}

/// `FT_DEF_RETRY_TIMEOUT`: how many times a request without an answer is sent.
#[test]
fn attempts_of_a_request_are_as_many_as_said() {
    for (options, times) in [(&[][..], 3), (&["--sdo-attempts", "1"], 1), (&["--sdo-attempts", "5"], 5)] {
        let fake = device(BOOTLOADER, |fake| fake.on_command = Box::new(|_| Outcome::LoseRequest));
        let words = ["more", "release", "-N", "5", "--sdo-timeout", "40"];
        let (done, fake) = served(fake, &[&words[..], options].concat());
        assert_eq!((done.exit, fake.count("command 83")), (5, times), "{}", done.err);
    }
}
