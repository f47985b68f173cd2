//! The functions of the manual's tools (L-1112e_5, L-1112d_10), with their own options.

use std::net::TcpListener;
use std::time::Duration;

use crate::fake::{Fake, Outcome, BOOTLOADER};
use crate::tool::{coflash, data, folder, run, serve};

/// The exit code that the system reports: Unix keeps eight bits, Windows all of them.
fn shown(number: u32) -> i32 {
    if cfg!(windows) {
        number as i32
    } else {
        (number & 0xFF) as i32
    }
}

fn quick(running: u32) -> Fake {
    let mut fake = Fake::new(running);
    fake.erase_time = Duration::from_millis(5);
    fake.restart_time = Duration::from_millis(10);
    fake
}

/// Table 5 of the older manual and table 10 of the newer one: the values of ERRORLEVEL.
#[test]
fn with_legacy_exit_codes_the_program_ends_with_the_manuals_numbers() {
    let file = data("plain-400.blk");
    let status = |word| {
        let mut fake = quick(BOOTLOADER);
        fake.on_block = Box::new(move |_| Outcome::Status(word));
        fake
    };
    let absent = || {
        let mut fake = quick(BOOTLOADER);
        fake.running = None;
        fake
    };
    let dead = || {
        let mut fake = quick(BOOTLOADER);
        fake.starts = Some(BOOTLOADER);
        fake
    };
    let wrong = || {
        let mut fake = quick(BOOTLOADER);
        fake.crc = Some(0x1234_5678);
        fake
    };
    for (fake, number) in [
        (wrong(), 0x6000_0001),
        (status(0x04), 0x6000_0002),
        (status(0x06), 0x6000_0003),
        (status(0x08), 0x6000_0004),
        (status(0x0A), 0x6000_0005),
        (status(0x0C), 0x6000_0006),
        (status(0x0E), 0x6000_0007),
        (status(0x84), 0x6000_0008),
        (status(0x86), 0x6000_0012),
        (absent(), 0x6000_0013),
        (dead(), 0x6000_0014),
        (quick(BOOTLOADER), 0),
    ] {
        let (bus, server) = serve(fake);
        let done = coflash(&[
            "flash",
            "--legacy-exit-codes",
            "--bus",
            &bus,
            "-N",
            "5",
            &file,
            "--boot-timeout",
            "200",
            "--sdo-timeout",
            "100",
        ]);
        assert_eq!(done.exit, shown(number), "{number:08X}h: {}", done.err);
        server.join().unwrap();
    }
}

#[test]
fn without_a_device_they_are_the_manuals_too() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let closed = format!("socketcand://{}/can0", listener.local_addr().unwrap());
    drop(listener);
    let folder = folder("legacy-exit");
    let file = data("plain-400.blk");
    let hex = std::fs::read_to_string(data("program.hex")).unwrap();
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
            let mut command = crate::tool::command();
            command.args(arguments);
            let done = run(if way {
                command.arg("--legacy-exit-codes")
            } else {
                command.env("COFLASH_LEGACY_EXIT_CODES", "1")
            });
            assert_eq!(done.exit, shown(number), "{arguments:?}, {number:08X}h: {}", done.err);
        }
    }
    let mut command = crate::tool::command();
    let done = run(command.args(["flash", &file, "-N", "128"]).env("COFLASH_LEGACY_EXIT_CODES", "0"));
    assert_eq!(done.exit, 2, "{}", done.err);
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
    for spelling in ["-B", "--br_idx"] {
        let done = coflash(&["flash", spelling, "?"]);
        assert_eq!((done.exit, done.err.as_str()), (0, ""));
        let rates: Vec<Vec<&str>> = done.out.lines().map(|line| line.split_whitespace().collect()).collect();
        let table = [1000, 800, 500, 250, 125, 100, 50, 20, 10].map(|rate: u32| rate.to_string());
        let found: Vec<&str> = rates[1..].iter().map(|row| row[1]).collect();
        assert_eq!(found, table);
        assert_eq!(rates[9][..], ["8", "10", "kbit/s"]);
    }
    let done = coflash(&["flash", "--vxd_type", "17"]);
    assert!(done.exit == 2 && done.err.contains("interfaces are 1 to 16"), "{}", done.err);
    let done = coflash(&["flash", "--vxd_type", "4"]);
    assert!(done.exit == 2 && done.err.contains("no firmware file is named"), "{}", done.err);
}

/// The manual's example with CAN over a serial line: its bit rate is 115200 bit/s.
#[test]
fn a_serial_line_has_115200_bits_a_second() {
    let file = data("plain-400.blk");
    let line = ["--node_id", "0x05", "--vxd_type", "16", "--device_no", "7"];
    let (bus, server) = serve(quick(BOOTLOADER));
    let done = coflash(&[&["--bus", &bus, "flash", "-F", &file, "--baudrate", "115200"][..], &line].concat());
    assert_eq!(done.exit, 0, "{}", done.err);
    assert!(done.err.contains("--vxd_type is ignored"), "{}", done.err);
    server.join().unwrap();
    // Without --bus, the number names the port.
    let done = coflash(&[&["flash", "-F", &file, "--baudrate", "115200"][..], &line].concat());
    let port = if cfg!(windows) { "COM7" } else { "/dev/ttyS6" };
    assert!(done.exit == 4 && done.err.contains(port), "{}", done.err);
    for (options, words) in [
        (&["--baudrate", "9600", "--vxd_type", "16"][..], "its bit rate is 115200"),
        (&["--baudrate", "115200"], "1 to 1000 kbit/s"),
    ] {
        let done = coflash(&[&["--bus", "slcan:nowhere", "flash", "-F", &file][..], options].concat());
        assert!(done.exit == 2 && done.err.contains(words), "{}", done.err);
    }
}

/// `FT_DEF_RETRY_TIMEOUT`: how many times a request without an answer is sent.
#[test]
fn attempts_of_a_request_are_as_many_as_said() {
    for (options, times) in [(&[][..], 3), (&["--sdo-attempts", "1"], 1), (&["--sdo-attempts", "5"], 5)] {
        let mut fake = quick(BOOTLOADER);
        fake.on_command = Box::new(|_| Outcome::LoseRequest);
        let (bus, server) = serve(fake);
        let words = ["--bus", &bus, "release", "-N", "5", "--sdo-timeout", "40"];
        let done = coflash(&[&words[..], options].concat());
        assert_eq!(done.exit, 5, "{}", done.err);
        assert_eq!(server.join().unwrap().count("command 83"), times);
    }
}
