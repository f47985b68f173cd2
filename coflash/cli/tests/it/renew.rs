//! The renewal of a bootloader by the command line, over a socket.

use std::fs;

use kit::fake::renewal::{device, image, word_of, NEW, OLD};
use kit::fake::{APPLICATION, BOOTLOADER};
use serde_json::Value;

use crate::tool::{coflash, folder, served};

#[test]
fn flash_knows_a_bootloader_by_its_header() {
    let folder = folder("renew");
    let file = folder.file("new.bin", &image(NEW));
    let report = folder.path("report.json");
    let words = ["flash", &file, "--node", "5", "--report", &report];
    let (done, fake) = served(device(APPLICATION, |_| {}).0, &words);
    let crc = word_of(&image(NEW), 4);
    done.says(&[
        &format!("{file}: bootloader 1.3 of 320 bytes, CRC {crc:08X}h\n")[..],
        "  renewing the bootloader (program 2): version 1.2 -> 1.3; the program stays\n",
        "  installed: bootloader 1.3\n",
        "  running: an application",
        "s: bootloader 1.2 -> 1.3, installed\n",
    ]);
    assert_eq!(fake.running, Some(APPLICATION));
    let written: Value = serde_json::from_str(&fs::read_to_string(&report).unwrap()).unwrap();
    let renewal = &written["devices"][0]["report"]["renewal"];
    assert_eq!((&renewal["number"], &renewal["from"], &renewal["to"]), (&2.into(), &OLD.into(), &NEW.into()));

    let words = ["  bootloader   version 1.3, 320 bytes, CRC ", "a bootloader: coflash flash renews that of"];
    coflash(&["inspect", &file, "--start-address", "0x08010000"]).says(&words);
    let json = coflash(&["inspect", &file, "--start-address", "0x08010000", "--json"]).json();
    assert_eq!((&json["bootloader"]["version"], &json["fault"]), (&NEW.into(), &Value::Null));

    // By a job file, too.
    let job = folder.file("job.toml", b"[[program]]\nimage = 'new.bin'\nnodes = [5]\n");
    let (done, _) = served(device(BOOTLOADER, |_| {}).0, &["flash", "--job", &job]);
    assert!(done.good().out.ends_with("1 of 1 devices are done\n"));
}

/// What is refused before a device is asked.
#[test]
fn flash_refuses_what_is_no_bootloader_for_a_device() {
    let folder = folder("renew-refused");
    let file = folder.file("new.bin", &image(NEW));
    for option in ["--no-trial", "--no-start"] {
        coflash(&["--bus", "socketcand://127.0.0.1:1/can0", "flash", &file, option])
            .fails(2, &["a new bootloader is tried before it replaces the old one"]);
    }
    let mut bench = image(NEW);
    bench[4..8].fill(0);
    let bench = folder.file("bench.bin", &bench);
    let mut damaged = image(NEW);
    damaged[100] ^= 1;
    let damaged = folder.file("damaged.bin", &damaged);
    for (file, words) in [
        (bench, "it is a bootloader without a CRC: build it by cargo xtask build, which writes the CRC"),
        (damaged, "it is a damaged bootloader: its header has the CRC"),
    ] {
        coflash(&["--bus", "socketcand://127.0.0.1:1/can0", "flash", &file]).fails(3, &[words]);
    }
}
