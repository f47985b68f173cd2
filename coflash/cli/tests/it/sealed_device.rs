//! Sealed images and devices: downloads, refusals, rights, and the comparison of a device with a file.

use std::sync::{Arc, Mutex};

use crate::sealing::{crc32, program, unwrapped, word, Room, START, VENDOR};
use crate::tool::{coflash, device, quick, served, Done};
use kit::fake::vault::Vault;
use kit::fake::{Fake, Maker, Outcome, APPLICATION, BOOTLOADER};
use serde_json::Value;

/// Flashes this file; returns the output, the data for the device, and the other writes.
fn flashed(file: &str, room: u32, status: u32, more: &[&str]) -> (Done, Vec<u8>, Vec<String>) {
    let kept: Arc<Mutex<Vec<u8>>> = Arc::default();
    let vault = Vault { kept: kept.clone(), start: START, room, status };
    let fake = device(APPLICATION, |fake| fake.maker = Some(Box::new(vault)));
    let (done, fake) = served(fake, &[&["flash", file, "-N", "5"], more].concat());
    let kept = kept.lock().unwrap().clone();
    (done, kept, fake.writes().iter().map(ToString::to_string).collect())
}

#[test]
fn a_sealed_image_goes_into_a_device_as_it_is() {
    let room = Room::small("flash");
    room.seal("app.cbs", &["--counter", "7"]).good();
    let (file, bytes) = (room.path("app.cbs"), room.bytes("app.cbs"));
    let (done, kept, writes) = flashed(&file, 0x10000, 0, &["--check-target"]);
    done.says(&[
        "sealed program of 1024 bytes",
        "counter 7, signed by ",
        "verified: CRC",
        "running: an application",
    ]);
    assert!(kept == bytes);
    let commands: Vec<&String> = writes.iter().filter(|write| write.starts_with("command")).collect();
    assert_eq!(commands, ["command 80", "command 03", "command 01"]);

    // The results that the device reports.
    for (status, number, words, advice) in [
        (0x8A, "[0x6000018a]", "the program's signature is wrong", "coflash seal verify"),
        (
            0x8C,
            "[0x6000018c]",
            "its counter or the epoch of its key is too low for the device",
            "coflash info",
        ),
        (0x8E, "[0x6000018e]", "the device has no key for this program", "coflash seal show"),
    ] {
        let (done, kept, _) = flashed(&file, 0x10000, status, &[]);
        assert!(kept == bytes, "it is sent once, and not again");
        // Nothing was erased.
        done.fails(6, &[number, words, advice, "its program is unchanged (CRC 12345678h)"]);
    }

    // The refusals that do not need the device's keys: the device is not changed.
    room.seal("other.cbs", &["--counter", "7", "--product", "99"]).good();
    for (file, space, words) in
        [(&file, 1000, "the device has room for 1000"), (&room.path("other.cbs"), 0x10000, "product code")]
    {
        let (done, _, writes) = flashed(file, space, 0, &[]);
        done.fails(3, &[words]);
        assert!(writes.is_empty(), "{words}: {writes:?}");
    }
    coflash(&["flash", &file, "-P", "2"]).fails(3, &["it is for program 1, and program 2 is to be written"]);
    let cut = room.0.file("cut.cbs", &bytes[..bytes.len() - 1]);
    coflash(&["flash", &cut]).fails(3, &["it is cut off"]);
    // In the bootloader already, and in the other dialects of the same objects.
    for dialect in ["raw", "hex"] {
        let kept: Arc<Mutex<Vec<u8>>> = Arc::default();
        let mut fake = Fake::new(BOOTLOADER);
        fake.maker = Some(Box::new(Vault { kept: kept.clone(), start: START, room: 0x10000, status: 0 }));
        served(fake, &["flash", &file, "-N", "5", "--dialect", dialect]).0.good();
        assert!(*kept.lock().unwrap() == bytes);
    }
}

/// The lowest epoch and the lowest counter that a device takes (2002h/3), after the ids of two roots.
fn lowest(epoch: u32, counter: u32) -> ((u16, u8), Vec<u8>) {
    ((0x2002, 3), [1, 2, epoch, counter].into_iter().flat_map(u32::to_le_bytes).collect())
}

/// An old program and an old key are two things. Both are refused before anything is erased, by what
/// the device says.
#[test]
fn an_old_counter_and_an_old_key_are_named_with_what_the_device_takes() {
    let room = Room::small("old");
    // The key has epoch 3.
    room.seal("app.cbs", &["--counter", "7"]).good();
    let file = room.path("app.cbs");
    let counter = "its security counter is 7, and the device accepts none below 8";
    let epoch = "its certificate has epoch 3, and the device accepts none below 4";
    for (told, words, advice) in [
        (lowest(3, 8), counter, "a higher --counter"),
        (lowest(4, 7), epoch, "sign with the key that is valid now"),
        (lowest(4, 8), counter, "a higher --counter"),
    ] {
        let (done, fake) = on(BOOTLOADER, Objects::sealed(&program()).but(told), &["flash", &file]);
        done.fails(3, &[words, advice, "it was not changed", "[0x6000018c]"]);
        assert!(!done.err.contains("program is old") && fake.writes().is_empty(), "{}", done.err);
    }
    // A right for a lower counter has been granted; and what the device takes.
    let granted = Objects::sealed(&program()).but(challenge(1 << 31 | 4)).but(lowest(3, 8));
    for told in [granted, Objects::sealed(&program()).but(lowest(3, 7))] {
        let (_, fake) = on(BOOTLOADER, told, &["flash", &file]);
        assert!(fake.count("command 03") == 1, "{:?}", fake.writes());
    }
    // Who forces it leaves it to the device.
    let (_, fake) =
        on(BOOTLOADER, Objects::sealed(&program()).but(lowest(4, 8)), &["flash", &file, "--force"]);
    assert_eq!(fake.count("command 03"), 1);
}

/// An application has no 2002h and no 2003h: its bootloader has.
#[test]
fn what_the_bootloader_alone_has_is_said_with_the_way_there() {
    let room = Room::new("way");
    let root = room.path("root.pem");
    for words in [&["seal", "events"][..], &["seal", "unlock", "erase", "--root", &root]] {
        let (done, fake) = on(APPLICATION, Objects::sealed(&program()), words);
        assert_eq!(fake.writes().len(), 0, "{words:?}");
        done.fails(6, &["coflash enter"]);
        // In the bootloader of a product without sealed images, too, it is the object that is missing.
        let (done, _) = on(BOOTLOADER, Objects { bootloader: Vec::new(), application: Vec::new() }, words);
        done.fails(6, &["without support for sealed images"]);
    }
}

/// A sealed device refuses what needs a right with 84h; the advice names the ways.
#[test]
fn a_refusal_for_want_of_a_right_names_the_right() {
    let room = Room::small("right");
    let app = room.path("app.hex");
    for (command, words) in [
        (0x03, &["erase"][..]),
        (0x84, &["more", "withdraw"]),
        (0x03, &["flash", &app, "--force", "--board", "nucleo-f446re"]),
    ] {
        let mut fake = Fake::new(BOOTLOADER);
        fake.on_command = Box::new(move |came| match came == command {
            true => Outcome::AbortStatus(0x0800_0022, 0x84),
            false => Outcome::Accept,
        });
        fake.maker = Some(Box::new(Objects::sealed(&program())));
        let (done, _) = served(fake, &[words, &["-N", "5"]].concat());
        done.fails(6, &["[0x60000184]", "coflash info", "coflash seal image", "coflash seal unlock"]);
    }
}

/// A device with these objects in its bootloader, and those while an application runs.
struct Objects {
    bootloader: Vec<((u16, u8), Vec<u8>)>,
    application: Vec<((u16, u8), Vec<u8>)>,
}

const UID: [u8; 12] = *b"\x00\x11\x22\x33\x44\x55\x66\x77\x88\x99\xAA\xBB";

/// 2002h/1 with this last word.
fn challenge(word: u32) -> ((u16, u8), Vec<u8>) {
    ((0x2002, 1), [&UID[..], &[0x5A; 32], &word.to_le_bytes()].concat())
}

/// An event in 2003h: number, kind, counter, version.
fn event(place: u8, words: [u32; 4]) -> ((u16, u8), Vec<u8>) {
    ((0x2003, place), words.into_iter().flat_map(u32::to_le_bytes).collect())
}

/// Sealed, with the right for LSS granted.
const SEALED: u32 = 1 << 31 | 8;

impl Objects {
    /// A sealed device that has this program, and has refused something since it was installed.
    fn sealed(program: &[u8]) -> Self {
        let application = vec![
            ((0x2004, 1), [START.to_le_bytes(), 0x10000_u32.to_le_bytes()].concat()),
            ((0x2005, 1), 0x0064_0A01_u32.to_le_bytes().to_vec()),
            ((0x1F56, 1), crc32(program).to_le_bytes().to_vec()),
        ];
        let mut bootloader = application.clone();
        bootloader.push(challenge(SEALED));
        bootloader.push(event(1, [9, 0x2_008C, 5, 0x0001_0000]));
        bootloader.push(event(2, [8, 0x1_0001, 7, 0x0064_0A01]));
        bootloader.push(event(3, [7, 0x1_0001, 6, 0x0000_0001]));
        bootloader.extend((4..=8).map(|place| event(place, [0; 4])));
        Self { bootloader, application }
    }

    /// The same device with another value in the bootloader; an empty value removes the object.
    fn but(mut self, (at, value): ((u16, u8), Vec<u8>)) -> Self {
        self.bootloader.retain(|(own, _)| *own != at);
        if !value.is_empty() {
            self.bootloader.push((at, value));
        }
        self
    }
}

impl Maker for Objects {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        let all = if running == BOOTLOADER { &self.bootloader } else { &self.application };
        all.iter().find(|(own, _)| *own == at).map(|(_, value)| Ok(value.clone()))
    }
}

/// Runs a command on such a device.
fn on(running: u32, told: Objects, words: &[&str]) -> (Done, Fake) {
    let mut fake = quick(running);
    fake.maker = Some(Box::new(told));
    served(fake, &[words, &["-N", "5"]].concat())
}

#[test]
fn a_sealed_image_goes_into_a_device_block_by_block() {
    let room = Room::small("flash-blocks");
    let program = &program()[..1024];
    room.seal("app.cbs", &["--counter", "7"]);
    room.seal("app.blk", &["--counter", "7", "--blocks", "0x200"]);
    let image = room.bytes("app.cbs");
    for name in ["app.cbs", "app.blk"] {
        let words = ["flash", &room.path(name), "--blocks", "--block-size", "0x110"];
        let (done, fake) = on(APPLICATION, Objects::sealed(program), &words);
        done.good();
        let (control, carried) = unwrapped(&fake.blocks);
        assert!(carried == image, "{name}");
        assert_eq!(word(&control, 4), VENDOR);
        assert_eq!(fake.blocks[1].len(), 0x110);
        // No release: it has a signature.
        let commands: Vec<&str> =
            fake.writes().into_iter().filter(|write| write.starts_with("command")).collect();
        assert_eq!(commands, ["command 80", "command 03", "command 01"]);
    }
    // Without the option the image is sent unchanged, whatever the form of its file.
    let (done, kept, _) = flashed(&room.path("app.blk"), 0x10000, 0, &[]);
    done.good();
    assert!(kept == image);

    let file = room.path("app.cbs");
    coflash(&["flash", &file, "--blocks", "--block-size", "20"])
        .fails(2, &["a block size of 20 is impossible"]);
    // A device that does not report its program's start, and one that does not accept blocks.
    let unanswered = Objects::sealed(program).but(((0x2004, 1), Vec::new()));
    let (done, fake) = on(BOOTLOADER, unanswered, &["flash", &file, "--blocks"]);
    done.fails(3, &["the start of its program (2004h)"]);
    assert!(fake.writes().is_empty(), "{:?}", fake.writes());
    let words = ["flash", &file, "--blocks", "--dialect", "raw"];
    let (done, fake) = on(BOOTLOADER, Objects::sealed(program), &words);
    done.fails(2, &["not in blocks"]);
    assert!(fake.writes().is_empty(), "{:?}", fake.writes());
}

#[test]
fn a_device_without_keys_gets_no_sealed_image() {
    let room = Room::new("unsealed");
    room.seal("app.cbs", &["--counter", "7"]);
    let file = room.path("app.cbs");
    let open = || Objects::sealed(&program()).but(challenge(SEALED & 0xFFFF));
    let (done, fake) = on(BOOTLOADER, open(), &["flash", &file]);
    done.fails(3, &["the device is not sealed", "coflash seal provision", "it was not changed"]);
    assert!(fake.writes().is_empty(), "{:?}", fake.writes());
    // An application does not report it; the bootloader does, before anything is erased.
    let (done, fake) = on(APPLICATION, open(), &["flash", &file]);
    done.fails(3, &["the device is not sealed", "its application is running; it was not changed"]);
    assert_eq!(fake.writes(), ["command 80", "command 01"]);
}

/// A sealed image for one device, to compare devices with.
struct Comparison {
    room: Room,
    file: String,
}

impl Comparison {
    fn new(test: &str) -> Self {
        let room = Room::new(test);
        room.seal("app.cbs", &["--counter", "7", "--device", "00112233445566778899aabb", "--hardware", "1"]);
        Self { file: room.path("app.cbs"), room }
    }

    /// The words of the command.
    fn words<'a>(&'a self, root: &'a str) -> [&'a str; 5] {
        ["seal", "verify-device", &self.file, "--root", root]
    }

    fn of(&self, running: u32, told: Objects, more: &[&str]) -> (Done, Fake) {
        on(running, told, &[&self.words(&self.room.path("root.pub"))[..], more].concat())
    }

    /// The exit code and the JSON of a device in its bootloader.
    fn json(&self, told: Objects) -> (i32, Value) {
        let (done, _) = self.of(BOOTLOADER, told, &["--json"]);
        (done.exit, done.json())
    }
}

fn number(index: u16, sub: u8, value: u32) -> ((u16, u8), Vec<u8>) {
    ((index, sub), value.to_le_bytes().to_vec())
}

/// The device that the image is for, in its bootloader.
fn same_device() -> Objects {
    Objects::sealed(&program()).but(number(0x1018, 3, 0x0001_0021))
}

/// The same device, whose bootloader can be renewed and has this state of a renewal (docs/renewal.md).
fn renewable(state: [u8; 4]) -> Objects {
    let factory = number(0x2007, 6, 0x0FFF_AAED);
    same_device().but(((0x2007, 1), vec![2])).but(factory).but(((0x2007, 9), state.to_vec()))
}

#[test]
fn a_device_is_compared_with_a_sealed_image() {
    let comparison = Comparison::new("verify-device");
    let (done, fake) = comparison.of(BOOTLOADER, same_device(), &[]);
    let done = done.says(&["node 5: holds program 1 of", "and does not run it"]);
    assert!(done.out.ends_with("not reported 2007h/6, 2007h/1\n"), "{}", done.out);
    assert!(fake.writes().is_empty());

    // An application does not report all values, and the command says so.
    let (done, _) = comparison.of(APPLICATION, Objects::sealed(&program()), &["--json"]);
    let value = done.good().json();
    assert_eq!((&value["same"], &value["runs"]), (&true.into(), &true.into()));
    let unanswered = serde_json::json!(["1018h/3", "2002h/1", "2003h/1", "2007h/6", "2007h/1"]);
    assert_eq!(value["unanswered"], unanswered);

    // A program of which no installation is among the last eight events, and one of another number.
    let forgotten = same_device().but(event(2, [0; 4])).but(event(3, [7, 0x1_0002, 1, 1]));
    comparison.of(BOOTLOADER, forgotten, &[]).0.says(&["not reported 2003h/1"]);

    // A bad file is refused before a device is asked. For a missing device there is another code.
    let (root, other) = (comparison.room.path("root.pub"), comparison.room.path("release.pub"));
    coflash(&[&comparison.words(&other)[..], &["--bus", "socketcand://127.0.0.1:1/can0"]].concat())
        .fails(3, &["is not one of the given roots"]);
    let mut fake = Fake::new(BOOTLOADER);
    fake.running = None;
    served(fake, &[&comparison.words(&root)[..], &["-N", "5", "--sdo-timeout", "20"]].concat())
        .0
        .fails(5, &[]);
}

/// Each difference is named, and each alone is enough.
#[test]
fn each_difference_from_a_sealed_image_is_named() {
    let comparison = Comparison::new("differences");
    let other_chip = ((0x2002, 1), [&[1; 12][..], &[0; 32], &SEALED.to_le_bytes()].concat());
    for (told, words) in [
        (number(0x1018, 1, 0x40), "vendor-ID (1018h/1): the file has 0000003Fh, the device 00000040h"),
        (number(0x1018, 2, 1235), "product code (1018h/2): the file has 000004D2h, the device 000004D3h"),
        (
            number(0x1018, 3, 2),
            "hardware revision (1018h/3): the file has the mask 00000002h, the device 00000002h",
        ),
        (number(0x1F56, 1, 0), "CRC of the program (1F56h): the file has"),
        (number(0x1F56, 1, 0x1234_5678), ", the device 12345678h"),
        (number(0x2005, 1, 0), "version of the program (2005h): the file has V1.10r100, the device V0.0r0"),
        (other_chip, "unique ID (2002h/1): the file has 00112233445566778899aabb, the device 010101"),
        (challenge(0x7FFF_FFFF), "the device is not sealed"),
        (((0x2002, 1), Vec::new()), "without support for sealed images"),
        (
            event(2, [8, 0x1_0001, 6, 0x0064_0A01]),
            "security counter of the last installation (2003h): the file has 7, the device 6",
        ),
        (
            event(2, [8, 0x1_0001, 7, 1]),
            "version of the last installation (2003h): the file has V1.10r100, the device V1.0r0",
        ),
    ] {
        let (done, _) = comparison.of(BOOTLOADER, same_device().but(told), &[]);
        done.fails(3, &["node 5 differs from the file in one property"]);
        assert!(done.out.contains(words), "{words}: {}", done.out);
        assert_eq!(done.out.matches("  differs ").count(), 1, "{}", done.out);
    }
    let two =
        Objects::sealed(&program()).but(number(0x1018, 3, 1)).but(number(0x1F56, 1, 1)).but(challenge(0));
    let (exit, value) = comparison.json(two);
    let what: Vec<&Value> =
        value["differences"].as_array().unwrap().iter().map(|difference| &difference["what"]).collect();
    assert_eq!((exit, what), (3, vec![&"crc".into(), &"keys".into()]));
    assert_eq!(value["same"], false);
    // A difference comes first: the device may be another one.
    let (done, _) = comparison.of(BOOTLOADER, renewable([1, 1, 0, 0]).but(number(0x1F56, 1, 1)), &[]);
    assert!(done.exit == 3 && done.out.contains("  not ready "), "{}{}", done.out, done.err);
}

/// A device may neither be in the middle of a renewal nor have option bytes that no product has.
#[test]
fn a_device_that_is_not_ready_fails_the_comparison() {
    let comparison = Comparison::new("ready");
    for (bytes, fault, words) in [
        // State, origin, end of the last trial and its detail (docs/renewal.md).
        ([1, 0, 0, 0], "staged", "another bootloader waits for its trial: coflash flash with its file"),
        ([1, 0, 1, 0], "staged", "on trial it was not confirmed in time: coflash flash with a good one"),
        ([1, 0, 4, 3], "staged", "on trial it could not be loaded: its CRC is wrong"),
        ([1, 1, 0, 0], "on_trial", "a bootloader runs on trial: coflash flash with its file confirms it"),
        ([0, 1, 0, 0], "on_trial", "a bootloader runs on trial"),
        ([2, 0, 0, 0], "confirmed", "is confirmed and not installed"),
        ([2, 2, 0, 0], "confirmed", "completes the renewal"),
        ([3, 3, 0, 0], "damaged", "is damaged, and the spare runs, which repairs it: switch the device off"),
    ] {
        let (done, fake) = comparison.of(BOOTLOADER, renewable(bytes), &[]);
        done.fails(6, &["node 5 is not ready"]);
        assert!(done.out.contains("holds program 1 of") && done.out.contains(words), "{words}: {}", done.out);
        assert_eq!(done.out.matches("  not ready ").count(), 1, "{bytes:?}: {}", done.out);
        assert!(fake.writes().is_empty());
        let (_, value) = comparison.json(renewable(bytes));
        let expected = serde_json::json!([true, false, [fault]]);
        assert_eq!(serde_json::json!([value["same"], value["ready"], value["faults"]]), expected);
    }
    // At rest: nothing was ever renewed; installed, and loaded from home or, until the next reset, from
    // staging; a trial that failed, and whose image a program has replaced.
    for bytes in [[0; 4], [3, 0, 0, 0], [3, 1, 0, 0], [3, 2, 0, 0], [0, 0, 1, 0]] {
        comparison.of(BOOTLOADER, renewable(bytes), &[]).0.good();
    }
    // A state of a later version is none that is known to be good.
    comparison.of(BOOTLOADER, renewable([4, 0, 0, 0]), &[]).0.says(&["not reported 2007h/9"]);
    // RM0090 section 3.9.10: SPRMOD is bit 31 of FLASH_OPTCR, BFB2 bit 4, nWRP bits 16 to 27.
    for (option_bytes, fault) in [(0x8001_AAED, "read_protection"), (0x0FFE_AAFD, "second_bank")] {
        let (exit, value) = comparison.json(renewable([0; 4]).but(number(0x2007, 6, option_bytes)));
        assert_eq!((exit, &value["faults"]), (6, &serde_json::json!([fault])));
    }
    // The protection that it has, and the one that belongs to its product.
    for (renewal, wanted) in [(2, "it needs sector 0 and no others"), (0, "(0 and 4 on the boards")] {
        let told = renewable([0; 4]).but(((0x2007, 1), vec![renewal])).but(number(0x2007, 6, 0x0FEE_AAED));
        let words = ["  protection   the device has sectors 0, 4; ", wanted];
        comparison.of(BOOTLOADER, told, &[]).0.says(&words);
    }
}
