//! PEAK and Kvaser adapters with a library in place of the vendor's: correct, missing, old, and
//! faulty. Not tested on hardware.
#![cfg(target_os = "linux")]

use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use crate::tool::kernel::{library, serve};
use crate::tool::{bootloader, data, folder, run, Done};
use kit::fake::APPLICATION;
use kit::folder::Folder;

/// A folder with the library of a vendor.
fn vendor(name: &str, which: &str, options: &[&str]) -> Folder {
    let folder = folder(name);
    let (file, define) = match which {
        "peak" => ("libpcanbasic.so", "-DPCAN"),
        _ => ("libcanlib.so.1", "-DCANLIB"),
    };
    library(&folder, "shim/vendor.c", file, &[&[define][..], options].concat());
    folder
}

/// Runs the tool with the vendor's library, without a bus, and with this fault.
fn call(folder: &Folder, lie: &str, arguments: &[&str]) -> Done {
    run(command(folder, lie, arguments).env_remove("FAKE_BUS"))
}

fn command(folder: &Folder, lie: &str, arguments: &[&str]) -> Command {
    let mut command = crate::tool::command();
    command.args(arguments).env("LD_LIBRARY_PATH", folder.as_os_str()).env("FAKE_LIE", lie);
    command.env("COFLASH_SEARCH", "peak,kvaser");
    command
}

/// A whole update over the stand-in.
fn flash(folder: &Folder, lie: &str, bus: &[&str], options: &[&str]) -> Done {
    let (path, server) = serve(bootloader());
    let file = data("identity-110.blk");
    let arguments = [bus, &["flash", "-N", "5", &file], options].concat();
    let done = run(command(folder, lie, &arguments).env("FAKE_BUS", path)).good();
    let fake = server.join().unwrap();
    assert_eq!(fake.blocks.concat(), fs::read(data("identity-110.blk")).unwrap());
    assert_eq!(fake.running, Some(APPLICATION));
    done
}

#[test]
fn an_update_goes_over_each_library() {
    for (which, bus) in [("peak", "peak:PCAN_USBBUS1@500k"), ("kvaser", "kvaser:0@500k")] {
        let folder = vendor(which, which, &[]);
        flash(&folder, "", &["--bus", bus], &[]);
        // One that says that it was read too late.
        let done = flash(&folder, "overrun", &["--bus", bus], &[]);
        assert!(done.out.contains("the adapter has lost frames, or not answered one, once"), "{}", done.out);
    }
}

const READ: [&str; 7] = ["read", "1000", "-N", "5", "--sdo-timeout", "200", "--sdo-attempts"];

/// Bus, fault, exit code, and the required words.
const LIES: [(&str, &str, i32, &[&str]); 26] = [
    ("peak:PCAN_USBBUS2@500k", "", 4, &["it does not exist (PCAN_ERROR_ILLHW)", "coflash adapters lists"]),
    ("peak:PCAN_USBBUS1@500k", "in use", 4, &["another program uses it", "close the other program"]),
    ("peak:PCAN_USBBUS1@500k", "garbage", 4, &["status FFFFFFFFh", "plug it in"]),
    ("peak:PCAN_USBBUS1@500k", "hang", 4, &["has not come back for 5 s"]),
    ("peak:PCAN_USBBUS1@500k", "length", 4, &["reports a frame of 200 bytes"]),
    ("peak:PCAN_USBBUS1@500k", "flood", 5, &["node 5 does not answer", "the bus works"]),
    ("peak:PCAN_USBBUS1@500k", "lost", 4, &["is gone", "PCAN_ERROR_ILLHW"]),
    ("peak:PCAN_USBBUS1@500k", "garbage status", 5, &["node 5 does not answer"]),
    (
        "peak:PCAN_USBBUS1@500k",
        "no acknowledge",
        5,
        &["no other node acknowledges the adapter's frames", "power"],
    ),
    ("peak:PCAN_USBBUS1@500k", "disturbed", 5, &["disturbed (50 bit", "the adapter has 500 kbit/s"]),
    ("peak:PCAN_USBBUS1@500k", "bus-off", 5, &["the adapter is bus-off", "short circuit"]),
    ("peak:PCAN_USBBUS1@500k", "passive", 5, &["error passive", "terminators"]),
    (
        "peak:PCAN_USBBUS1@500k",
        "silent",
        5,
        &["another node acknowledges the adapter's frames", "coflash more catch", "strap"],
    ),
    ("peak:PCAN_USBBUS1", "", 2, &["it needs the bit rate of the bus", "peak:PCAN_USBBUS1@125k"]),
    ("kvaser:1@500k", "", 4, &["it does not exist (canERR_NOTFOUND)", "coflash adapters lists"]),
    ("kvaser:0@250k", "", 4, &["status -1"]),
    ("kvaser:0@500k", "in use", 4, &["another program uses it", "close the other program"]),
    ("kvaser:0@500k", "hang", 4, &["has not come back for 5 s"]),
    ("kvaser:0@500k", "length", 4, &["reports a frame of 4000000000 bytes"]),
    ("kvaser:0@500k", "lost", 4, &["is gone", "was unplugged"]),
    ("kvaser:0@500k", "garbage status", 4, &["status -123456"]),
    ("kvaser:0@500k", "bus-off", 5, &["the adapter is bus-off"]),
    // The transmit error counter stays at 128.
    ("kvaser:0@500k", "passive", 5, &["no other node acknowledges the adapter's frames"]),
    ("kvaser:0@500k", "silent", 5, &["another node acknowledges the adapter's frames"]),
    ("kvaser:0", "", 2, &["it needs the bit rate of the bus"]),
    ("kvaser:9@500k", "", 4, &["canERR_NOTFOUND"]),
];

#[test]
fn a_library_that_lies_is_named_and_stops_nothing() {
    let (peak, kvaser) = (vendor("peak-lies", "peak", &[]), vendor("kvaser-lies", "kvaser", &[]));
    let next = AtomicUsize::new(0);
    // Most of the time is waiting, so several run at the same time.
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| loop {
                let row = LIES.get(next.fetch_add(1, Ordering::Relaxed));
                let Some((bus, lie, exit, words)) = row else { return };
                let folder = if bus.starts_with("peak") { &peak } else { &kvaser };
                let done = call(folder, lie, &[&["--bus", *bus][..], &READ, &["2"]].concat());
                done.fails(*exit, words);
            });
        }
    });
    // An adapter that accepts no more frames.
    for (folder, bus) in [(&peak, "peak:PCAN_USBBUS1@500k"), (&kvaser, "kvaser:0@500k")] {
        let patient = ["read", "1000", "-N", "5", "--sdo-timeout", "20000"];
        call(folder, "full", &[&["--bus", bus][..], &patient].concat())
            .fails(4, &["accepts no more frames", "0x60000305"]);
    }
}

#[test]
fn a_library_that_is_missing_or_old_is_named_with_where_to_get_it() {
    let broken = folder("broken");
    for file in ["libpcanbasic.so", "libpcanbasic.so.4", "libcanlib.so", "libcanlib.so.1"] {
        broken.file(file, b"no library");
    }
    let old = (vendor("peak-old", "peak", &["-DOLD"]), vendor("kvaser-old", "kvaser", &["-DOLD"]));
    for (folder, bus, words) in [
        (
            &broken,
            "peak:PCAN_USBBUS1@500k",
            &["libpcanbasic.so or libpcanbasic.so.4 cannot be loaded", "www.peak-system.com"],
        ),
        (&broken, "kvaser:0@500k", &["libcanlib.so.1 or libcanlib.so cannot be loaded", "www.kvaser.com"]),
        (
            &old.0,
            "peak:PCAN_USBBUS1@500k",
            &["libpcanbasic.so has no function CAN_GetStatus", "it is too old"],
        ),
        (&old.1, "kvaser:0@500k", &["libcanlib.so.1 has no function canReadStatus", "it is too old"]),
    ] {
        call(folder, "", &[&["--bus", bus][..], &READ, &["1"]].concat()).fails(4, words);
    }
    // The list has all others, and the reason why these are missing.
    let done = call(&broken, "", &["adapters", "--json"]);
    let json = done.json();
    assert_eq!((done.exit, json["adapters"].as_array().unwrap().len()), (0, 0));
    assert_eq!(json["not_looked_for"][0]["kind"], "peak");
    assert!(json["not_looked_for"][1]["advice"].as_str().unwrap().contains("www.kvaser.com"));
}

#[test]
fn adapters_are_listed_and_the_only_one_is_taken() {
    let (peak, kvaser) = (vendor("peak-list", "peak", &[]), vendor("kvaser-list", "kvaser", &[]));
    let urls = |folder: &Folder, lie: &str| {
        let json = call(folder, lie, &["adapters", "--json"]).good().json();
        let adapters = json["adapters"].as_array().unwrap();
        adapters.iter().map(|one| one["bus"].as_str().unwrap().to_string()).collect::<Vec<_>>()
    };
    assert_eq!(urls(&peak, ""), ["peak:PCAN_USBBUS1"]);
    assert_eq!(urls(&peak, "two"), ["peak:PCAN_USBBUS1", "peak:PCAN_USBBUS2"]);
    assert_eq!(urls(&peak, "garbage"), [""; 0]);
    assert_eq!(urls(&kvaser, ""), ["kvaser:0", "kvaser:1"]);
    assert_eq!(urls(&kvaser, "channels"), [""; 0]);
    assert_eq!(urls(&kvaser, "negative"), [""; 0]);
    for lie in ["", "no end"] {
        let done = call(&peak, lie, &["adapters"]);
        assert!(done.out.contains("peak:PCAN_USBBUS1") && !done.out.contains('\u{1B}'), "{}", done.out);
    }
    // Virtual channels have no bus, so only one channel is left. Standard error says so.
    for (folder, words) in [
        (&peak, "no --bus is given: using the only adapter, peak:PCAN_USBBUS1 (PCAN-USB\u{FFFD}[2J)"),
        (&kvaser, "no --bus is given: using the only adapter, kvaser:0 (Kvaser Leaf Light v2)"),
    ] {
        // -B 2 of the manual: 500 kbit/s.
        let done = flash(folder, "", &[], &["-B", "2"]);
        assert!(done.err.contains(words), "{}", done.err);
    }
    let words = ["several adapters", "peak:PCAN_USBBUS1", "peak:PCAN_USBBUS2", "give one of them with --bus"];
    call(&peak, "two", &["scan"]).fails(2, &words);
    run(command(&peak, "", &["scan"])
        .env("LD_LIBRARY_PATH", Path::new("/nowhere"))
        .env("COFLASH_SEARCH", "none"))
    .fails(2, &["no adapter was found"]);
}
