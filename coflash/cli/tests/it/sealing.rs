//! The commands for sealed images, one after another; OpenSSL checks the results if it is
//! installed.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::tool::{coflash, folder, Done};
use coflash_core::file::sealed::{verify, Device, Kek, PublicKey};
use coflash_core::file::{ihex, raw};
use kit::folder::Folder;
use kit::ihex::{intel_hex, END_OF_FILE};
use serde_json::Value;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;

pub const START: u32 = 0x0801_0000;
/// The identity of the fake device (1018h).
pub const VENDOR: u32 = 0x3F;
const PRODUCT: u32 = 1234;

/// A program with a label at 1E0h (docs/protocol.md), and some bytes that can be compressed.
pub fn program() -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..9001_u32).map(|at| (at / 5 % 40) as u8).collect();
    bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&(START + 0x201).to_le_bytes());
    let mut words = vec![u32::from_le_bytes(*b"CBL1"), VENDOR, PRODUCT, 0x0064_0A01, 0, 0, 0];
    words.push(shared_abi::check_word(&words));
    for (place, word) in bytes[0x1E0..0x200].chunks_mut(4).zip(words) {
        place.copy_from_slice(&word.to_le_bytes());
    }
    bytes
}

/// A folder with keys, a certificate and a program.
pub struct Room(pub Folder);

impl Room {
    pub fn new(test: &str) -> Self {
        let room = Self(folder(&format!("sealing-{test}")));
        let image = raw::read(&program(), Some(START)).unwrap();
        room.0.file("app.hex", ihex::emit(&image).as_bytes());
        for role in ["root", "release", "kek"] {
            coflash(&["seal", "keys", "new", "--role", role, "-o", &room.path(&format!("{role}.pem"))])
                .good();
        }
        room.certify("release.cert", &[]);
        room
    }

    /// With a small program, because each frame takes time.
    pub fn small(test: &str) -> Self {
        let room = Self::new(test);
        let image = raw::read(&program()[..1024], Some(START)).unwrap();
        room.0.file("app.hex", ihex::emit(&image).as_bytes());
        room
    }

    pub fn path(&self, name: &str) -> String {
        self.0.path(name)
    }

    pub fn bytes(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    fn certify(&self, name: &str, more: &[&str]) {
        let (root, key, out) = (self.path("root.pem"), self.path("release.pub"), self.path(name));
        let words =
            ["seal", "keys", "certify", "--root", &root, "--key", &key, "--epoch", "3", "--vendor", "0x3F"];
        coflash(&[&words[..], &["-o", &out], more].concat()).good();
    }

    /// Seals the program as this file.
    pub fn seal(&self, name: &str, more: &[&str]) -> Done {
        let (app, out) = (self.path("app.hex"), self.path(name));
        let (key, cert) = (self.path("release.pem"), self.path("release.cert"));
        let words =
            ["seal", "image", &app, "-o", &out, "--board", "nucleo-f446re", "--key", &key, "--cert", &cert];
        coflash(&[&words[..], more].concat())
    }

    fn verify(&self, name: &str, more: &[&str]) -> Done {
        coflash(&[&["seal", "verify", &self.path(name), "--root", &self.path("root.pub")], more].concat())
    }
}

fn json(words: &[&str]) -> Value {
    coflash(&[words, &["--json"]].concat()).json()
}

/// The output of OpenSSL; `None` if it is not installed.
fn openssl(words: &[&str]) -> Option<Vec<u8>> {
    let output = Command::new("openssl").args(words).stdin(Stdio::null()).output().ok()?;
    assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    Some(output.stdout)
}

/// Who may read and write a file.
#[cfg(unix)]
fn mode(path: &str) -> u32 {
    use std::os::unix::fs::PermissionsExt as _;
    fs::metadata(path).unwrap().permissions().mode() & 0o777
}

#[test]
fn keys_are_made_once_and_are_those_of_openssl() {
    let room = Room::new("keys");
    let root = room.path("root.pem");
    let before = room.bytes("root.pem");
    #[cfg(unix)]
    for name in ["root.pem", "release.pem", "kek.pem"] {
        assert_eq!(mode(&room.path(name)), 0o600, "{name}");
    }
    coflash(&["seal", "keys", "new", "--role", "root", "-o", &root]).fails(2, &["exists already"]);
    assert_eq!(room.bytes("root.pem"), before);
    // Only the public key exists.
    fs::remove_file(&root).unwrap();
    assert_eq!(coflash(&["seal", "keys", "new", "--role", "root", "-o", &root]).exit, 2);
    assert!(!Path::new(&root).exists());
    coflash(&["seal", "keys", "new", "--role", "root", "-o", &root, "--force"]).good();
    assert_ne!(room.bytes("root.pem"), before);
    // With this name both files would have the same path.
    assert_eq!(coflash(&["seal", "keys", "new", "--role", "root", "-o", &room.path("a.pub")]).exit, 2);

    if let Some(public) = openssl(&["pkey", "-in", &root, "-pubout"]) {
        assert_eq!(public, room.bytes("root.pub"));
        let made = room.path("openssl.pem");
        openssl(&["genpkey", "-algorithm", "ed25519", "-out", &made]).unwrap();
        let der = openssl(&["pkey", "-in", &made, "-pubout", "-outform", "DER"]).unwrap();
        let digits: String = der[12..].iter().map(|byte| format!("{byte:02x}")).collect();
        let shown = json(&["seal", "keys", "show", &made]);
        assert_eq!((&shown["kind"], &shown["public_key"]), (&"private key".into(), &digits.into()));
        // A key of another curve is no key for coflash.
        openssl(&["genpkey", "-algorithm", "x25519", "-out", &made]).unwrap();
        assert_eq!(coflash(&["seal", "keys", "show", &made]).exit, 3);
    }
}

#[test]
fn keys_and_certificates_are_shown_without_secrets() {
    let room = Room::new("show-keys");
    let id = PublicKey::from_pem(&String::from_utf8(room.bytes("release.pub")).unwrap()).unwrap().id();
    for (name, kind) in [("release.pem", "private key"), ("release.pub", "public key")] {
        let shown = json(&["seal", "keys", "show", &room.path(name)]);
        assert_eq!((&shown["kind"], &shown["id"]), (&kind.into(), &id.into()));
    }
    let kek = Kek::from_pem(&String::from_utf8(room.bytes("kek.pem")).unwrap()).unwrap();
    let shown = coflash(&["seal", "keys", "show", &room.path("kek.pem")]).good();
    assert_eq!(shown.out, format!("{}: key-encryption key {:08X}h\n", room.path("kek.pem"), kek.id()));
    room.certify("test.cert", &["--role", "test", "--product", "1234", "--lowest", "2", "--highest", "5"]);
    let shown = json(&["seal", "keys", "show", &room.path("test.cert")]);
    assert_eq!((&shown["kind"], &shown["role"]), (&"certificate".into(), &"test".into()));
    assert_eq!((&shown["key_id"], &shown["epoch"]), (&id.into(), &3.into()));
    assert_eq!((&shown["lowest"], &shown["highest"]), (&2.into(), &5.into()));
    for (name, bytes) in
        [("empty", &b""[..]), ("text", b"hello"), ("cut.cert", b"CBK1\x98"), ("binary", &[0xFF; 99])]
    {
        let file = room.0.file(name, bytes);
        assert_eq!(coflash(&["seal", "keys", "show", &file]).exit, 3, "{name}");
    }
    let bad =
        ["seal", "keys", "certify", "--root", &room.path("root.pem"), "--key", &room.path("release.pub")];
    let bad = [&bad[..], &["--epoch", "1", "--vendor", "1", "--lowest", "6", "--highest", "5"]].concat();
    assert_eq!(coflash(&bad).exit, 2);
}

/// The value of the manual's tools: the first 32 bytes of an HMAC, by OpenSSL.
#[test]
fn a_value_of_128_bits_makes_a_key() {
    let room = Room::new("value");
    let (value, out) = ("000102030405060708090a0b0c0d0e0f", room.path("product.pem"));
    coflash(&["seal", "keys", "new", "--role", "kek", "--of-value", value, "-o", &out]).good();
    let text = room.0.file("text", b"coboot key of a value 1\0");
    let option = format!("hexkey:{value}");
    if let Some(mac) = openssl(&["dgst", "-sha512", "-binary", "-mac", "HMAC", "-macopt", &option, &text]) {
        let kek = Kek::new(mac[..32].try_into().unwrap()).unwrap();
        assert_eq!(json(&["seal", "keys", "show", &out])["id"], kek.id());
    }
    for (role, value) in [("kek", "0001"), ("kek", "zz"), ("root", value)] {
        let out = room.path("none.pem");
        let done = coflash(&["seal", "keys", "new", "--role", role, "--of-value", value, "-o", &out]);
        assert!(done.exit == 2 && !Path::new(&out).exists(), "{role}, {value}: {}", done.err);
    }
}

/// `--key` of the manual's converter: only the key of the same value decrypts the program.
#[test]
fn the_converter_encrypts_with_a_value() {
    let room = Room::new("convert");
    let (value, app) = ("000102030405060708090a0b0c0d0e0f", room.path("app.hex"));
    let (sign, cert) = (room.path("release.pem"), room.path("release.cert"));
    let words = ["convert", &app, "--board", "nucleo-f446re", "--key", value];
    for (more, missing) in [
        (&[][..], "--sign and --counter is missing"),
        (&["--counter", "7"], ", and --sign is missing"),
        (&["--sign", &sign], ", and --counter is missing"),
    ] {
        let done = coflash(&[&words[..], more].concat());
        done.fails(2, &[missing, "what to do: give --sign"]);
        assert!(!done.err.contains(value), "the value is a secret");
        assert!(!Path::new(&room.path("app.blk")).exists());
    }
    let signed = [&words[..], &["--sign", &sign, "--cert", &cert, "--counter", "7"]].concat();
    coflash(&[&signed[..], &["--add", "0xA5"]].concat())
        .says(&["app.blk: program 1 V1.10r100, counter 7, 9001 bytes"])
        .fails(0, &["--add has no effect"]);
    let kek = room.path("product.pem");
    coflash(&["seal", "keys", "new", "--role", "kek", "--of-value", value, "-o", &kek]).good();
    assert!(room.verify("app.blk", &["--kek", &kek]).out.contains("the program is whole, 9001 bytes"));
    assert!(room.verify("app.blk", &["--kek", &room.path("kek.pem")]).err.contains("for other keys"));
    let shown = json(&["seal", "show", &room.path("app.blk")]);
    assert_eq!(shown["flags"], serde_json::json!(["encrypted"]));
    assert_eq!(shown["blocks"]["start"], START);
    // No part of the program is visible.
    let first = room.bytes("app.blk");
    let has = |part: &[u8]| first.windows(part.len()).any(|bytes| bytes == part);
    assert!(program()[0x300..].chunks_exact(32).all(|plain| !has(plain)));
    coflash(&signed).good();
    assert_eq!(room.bytes("app.blk"), first, "the same input, the same file");
    // The image is the same as that of `seal`.
    coflash(&[&["convert", &app, &room.path("own.cbs")], &signed[2..]].concat()).good();
    room.seal("sealed.cbs", &["--counter", "7", "--encrypt", &kek]);
    assert_eq!(room.bytes("own.cbs"), room.bytes("sealed.cbs"));
    // The command line sets another identity, and the certificate is checked against it.
    let done = coflash(&[&signed[..], &["--vid", "1", "--pid", "2"]].concat());
    assert!(done.err.contains("the certificate allows the vendor-ID 0000003Fh"), "{}", done.err);
    for (more, words) in [
        (&["--key", "12"][..], "32 hexadecimal digits"),
        (&["--add", "1"], "--key"),
        (&["--key", value, "--crc16"], "--crc16"),
    ] {
        coflash(&[&["convert", &app], more].concat()).fails(2, &[words]);
    }
    let junk = room.0.file("junk.bin", &[0x5A; 1000]);
    coflash(&[&["convert", &junk, "-I", "binary"], &signed[2..]].concat()).fails(3, &["is not a program"]);
    assert!(!Path::new(&room.path("junk.blk")).exists());
}

pub fn crc32(bytes: &[u8]) -> u32 {
    crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(bytes)
}

pub fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

/// Parses blocks by the manual's figure: each has its number, its CRC, and the address after the
/// previous block. Returns the data of block 0 and the data of the others.
pub fn unwrapped(blocks: &[Vec<u8>]) -> (Vec<u8>, Vec<u8>) {
    let data = |block: &[u8]| {
        let end = block.len() - 4;
        assert_eq!(word(block, end), crc32(&block[..end]));
        assert_eq!(word(block, 8) as usize, end - 12);
        block[12..end].to_vec()
    };
    let (last, rest) = blocks.split_last().unwrap();
    let mut carried = Vec::new();
    for (number, block) in rest.iter().enumerate() {
        assert_eq!(word(block, 0), number as u32);
        if number > 0 {
            assert_eq!(word(block, 4), START + carried.len() as u32);
            carried.extend(data(block));
        }
    }
    assert_eq!(word(last, 0), u32::MAX);
    assert_eq!(data(last), [(carried.len() as u32).to_le_bytes(), crc32(&carried).to_le_bytes()].concat());
    (data(&blocks[0]), carried)
}

/// The blocks of a file.
fn split(mut file: &[u8]) -> Vec<Vec<u8>> {
    let mut blocks = Vec::new();
    while !file.is_empty() {
        let (block, rest) = file.split_at(16 + word(file, 8) as usize);
        blocks.push(block.to_vec());
        file = rest;
    }
    blocks
}

#[test]
fn a_sealed_image_is_written_in_blocks_and_read_out_of_them() {
    let room = Room::new("blocks");
    let more = ["--counter", "7", "--date", "1420070400"];
    room.seal("app.cbs", &more);
    let image = room.bytes("app.cbs");
    for (name, blocks, largest) in
        [("usual.blk", &["--blocks"][..], 0x400), ("small.blk", &["--blocks", "0x110"], 0x110)]
    {
        room.seal(name, &[&more[..], blocks].concat()).good();
        let blocks = split(&room.bytes(name));
        let (control, carried) = unwrapped(&blocks);
        assert!(carried == image);
        assert!(blocks.iter().all(|block| block.len() <= largest) && blocks[1].len() == largest);
        let size = image.len() as u32;
        let words = [size, VENDOR, PRODUCT, 0x0064_0A01, 1_420_070_400, 0];
        assert_eq!(control, words.into_iter().flat_map(u32::to_le_bytes).collect::<Vec<u8>>());
        // The file counts as the image that is in its blocks.
        room.verify(name, &["--product", "1234"]).says(&["the program is whole, 9001 bytes"]);
        let shown = json(&["seal", "show", &room.path(name)]);
        assert_eq!((&shown["format"], &shown["counter"]), (&"sealed image".into(), &7.into()));
        assert_eq!(shown["blocks"]["count"], blocks.len());
        assert_eq!(shown["blocks"]["crc"], crc32(&image));
        for command in [&["seal", "show"][..], &["inspect"]] {
            let front = format!("file, {} blocks, from 0x08010000 on; in it: sealed image", blocks.len());
            let words = [&format!("block {front}")[..], "counter      7"];
            coflash(&[command, &[&room.path(name)]].concat()).says(&words);
        }
        coflash(&["convert", &room.path(name), &room.path("x.blk")]).fails(3, &["is a sealed image"]);
    }
    assert_eq!(json(&["seal", "show", &room.path("app.cbs")])["blocks"], Value::Null);
    // The name of the result, and options that do not fit together.
    let (app, key) = (room.path("app.hex"), room.path("release.pem"));
    let words =
        ["seal", "image", &app, "--key", &key, "--cert", &room.path("release.cert"), "--counter", "7"];
    coflash(&[&words[..], &["--blocks"]].concat()).good();
    assert!(room.bytes("app.blk").len() > image.len());
    coflash(&[&words[..], &["--blocks", "20"]].concat()).fails(2, &["a block size of 20 is impossible"]);
    // Every command reports an error in the blocks.
    let good = room.bytes("small.blk");
    let mut wrong = good.clone();
    wrong[0x300] ^= 1;
    let mut blocks = split(&good);
    blocks.remove(3);
    for (name, bytes, words, number) in [
        ("cut.blk", &good[..good.len() - 30], "a block is cut off", "[0x60000022]"),
        ("wrong.blk", &wrong, "CRC of block 3 is", "[0x60000020]"),
        ("missing.blk", &blocks.concat(), "block 4 follows where block 3 must", "[0x60000022]"),
    ] {
        let file = room.0.file(name, bytes);
        let root = room.path("root.pub");
        for command in [
            &["seal", "show", &file][..],
            &["inspect", &file],
            &["seal", "verify", &file, "--root", &root],
            &["seal", "verify-device", &file, "--root", &root],
            &["flash", &file],
        ] {
            coflash(command).fails(3, &[words, number]);
        }
    }
}

#[test]
fn a_program_is_sealed_shown_and_verified() {
    let room = Room::new("seal");
    let done = room.seal("app.cbs", &["--counter", "7"]).good();
    let crc = crc32(&program());
    let expected = format!(": program 1 V1.10r100, counter 7, 9001 bytes, CRC {crc:08X}h\n");
    assert!(done.out.ends_with(&expected), "{}", done.out);
    let first = room.bytes("app.cbs");
    room.seal("app.cbs", &["--counter", "7"]);
    assert_eq!(room.bytes("app.cbs"), first, "the same input, the same file");

    let shown = json(&["seal", "show", &room.path("app.cbs")]);
    assert_eq!((&shown["vendor_id"], &shown["product_code"]), (&VENDOR.into(), &PRODUCT.into()));
    assert_eq!((&shown["version_text"], &shown["counter"]), (&"V1.10r100".into(), &7.into()));
    assert_eq!(
        (&shown["size"], &shown["payload"], &shown["chunk"]),
        (&9001.into(), &9001.into(), &4096.into())
    );
    let identity = "vendor-ID 0000003Fh, product code 000004D2h";
    let words = coflash(&["seal", "show", &room.path("app.cbs")]).says(&[identity]).out;
    // `inspect` recognises it, too, and no other command takes it for another format.
    assert_eq!(coflash(&["inspect", &room.path("app.cbs")]).good().out, words);
    coflash(&["convert", &room.path("app.cbs"), &room.path("x.blk")]).fails(3, &["is a sealed image"]);

    room.verify("app.cbs", &["--product", "1234", "--counter", "7", "--epoch", "3"])
        .says(&["the program is whole, 9001 bytes"]);
    for (more, words, number) in [
        (&["--product", "1"][..], "it is for product code 000004D2h", "0x60000182"),
        (&["--vendor", "1"], "it is for vendor-ID 0000003Fh", "0x60000180"),
        (&["-P", "2"], "it is for program 1, and program 2 is to be written", "0x60000182"),
        (&["--counter", "8"], "its security counter is 7", "0x6000018c"),
        (&["--epoch", "4"], "its certificate has epoch 3", "0x6000018c"),
        (&["--room", "9000"], "the program has 9001 bytes", "0x60000006"),
    ] {
        room.verify("app.cbs", more).fails(3, &[words, number, "what to do: "]);
    }
    let mut damaged = first.clone();
    *damaged.last_mut().unwrap() ^= 1;
    let file = room.0.file("damaged.cbs", &damaged);
    coflash(&["seal", "verify", &file, "--root", &room.path("root.pub")])
        .fails(3, &["chunk 3 of 3", "[0x6000018a]"]);
    coflash(&["seal", "verify", &room.path("app.cbs"), "--root", &room.path("release.pub")])
        .fails(3, &["is not one of the given roots [0x6000018e]"]);
    for (name, bytes) in [("empty.cbs", &b""[..]), ("cut.cbs", &first[..600]), ("magic.cbs", b"CBS1")] {
        let file = room.0.file(name, bytes);
        for words in [
            &["seal", "show", &file][..],
            &["seal", "verify", &file, "--root", &room.path("root.pub")],
            &["inspect", &file],
        ] {
            assert_eq!(coflash(words).exit, 3, "{words:?}");
        }
    }
}

#[test]
fn encrypted_and_compressed_programs_come_out_again() {
    let room = Room::new("options");
    let kek = room.path("kek.pem");
    let sealed =
        room.seal("app.cbs", &["--counter", "0", "--compress", "--encrypt", &kek, "--text", "for all"]);
    assert!(sealed.out.contains(", compressed to "), "{}{}", sealed.out, sealed.err);
    let shown = json(&["seal", "show", &room.path("app.cbs")]);
    assert_eq!(shown["flags"], serde_json::json!(["encrypted", "compressed"]));
    assert_eq!(shown["text"], "for all");
    assert!(shown["payload"].as_u64() < shown["size"].as_u64());
    room.verify("app.cbs", &[]).says(&["give --kek"]);
    room.verify("app.cbs", &["--kek", &kek]).says(&["the program is whole, 9001 bytes"]);
    let other = room.0.file("other.kek", "5a".repeat(32).as_bytes());
    room.verify("app.cbs", &["--kek", &other]).fails(3, &["encrypted for other keys"]);

    // Against the other program, for one device, with everything else.
    let old = room.0.file("old.bin", &program()[..8000]);
    let (uid, sbom) = ("00112233445566778899aabb", room.0.file("sbom.json", b"{}"));
    let more = ["--counter", "0x10", "--base", &old, "--device", uid, "--hardware", "1", "--hardware", "33"];
    let more = [&more[..], &["--chunk", "512", "--sbom", &sbom, "--date", "1420070400", "-P", "1"]].concat();
    room.seal("app.cbs", &more).good();
    let shown = json(&["seal", "show", &room.path("app.cbs")]);
    assert_eq!((&shown["unique_id"], &shown["hardware"]), (&uid.into(), &2.into()));
    assert_eq!((&shown["chunk"], &shown["created"]), (&512.into(), &1_420_070_400.into()));
    // A hash of two bytes: `printf '{}' | openssl dgst -sha512-256`.
    if let Some(said) = openssl(&["dgst", "-sha512-256", "-r", &sbom]) {
        assert_eq!(shown["sbom"], String::from_utf8(said).unwrap().split(' ').next().unwrap());
    }
    assert!(room.verify("app.cbs", &[]).out.contains("give --base"));
    assert!(room.verify("app.cbs", &["--base", &old]).out.contains("is whole"));
    room.verify("app.cbs", &["--base", &room.path("app.hex")]).fails(3, &["is not the given program"]);
    room.verify("app.cbs", &["--device", "000102030405060708090a0b"]).fails(3, &["another unique ID"]);
    room.verify("app.cbs", &["--hardware", "2"]).fails(3, &[]);

    // For tests.
    room.certify("release.cert", &["--role", "test"]);
    room.seal("test.cbs", &["--counter", "1"]);
    assert!(room.verify("test.cbs", &[]).err.contains("not marked for tests"));
    assert_eq!(room.verify("test.cbs", &["--for-tests"]).exit, 0);
}

#[test]
fn what_cannot_be_sealed_is_refused_with_what_to_do() {
    let room = Room::new("refused");
    let kek = room.path("kek.pem");
    for (more, exit, words) in [
        (&["--counter", "1", "--vendor", "1"][..], 3, "the certificate allows the vendor-ID 0000003Fh"),
        (&["--counter", "1", "--encrypt", &kek, "--encrypt", &kek], 3, "encrypted twice"),
        (&["--counter", "1", "--encrypt", &room.path("root.pub")], 3, "it is not a key-encryption key"),
        (&["--counter", "1", "--chunk", "1000"], 2, "a power of two from 512 to 8192"),
        (&["--counter", "1", "--device", "00"], 2, "24 hexadecimal digits"),
        (&["--counter", "1", "-P", "2"], 2, "has no program 2"),
        (&[], 2, "--counter"),
    ] {
        room.seal("none.cbs", more).fails(exit, &[words]);
        assert!(!Path::new(&room.path("none.cbs")).exists());
    }
    // No program, and no label.
    let junk = room.0.file("junk.bin", &[0x5A; 1000]);
    let key = room.path("release.pem");
    let words =
        ["seal", "image", &junk, "-I", "binary", "--board", "nucleo-f446re", "--key", &key, "--counter", "1"];
    assert!(coflash(&words).err.contains("is not a program"));
    coflash(&[&words[..], &["--data"]].concat())
        .fails(2, &["the program has no vendor-ID of its target device", "give --vendor"]);
    coflash(&[&words[..], &["--data", "--vendor", "1", "--product", "2"]].concat()).good();
    assert_eq!(json(&["seal", "show", &room.path("junk.cbs")])["flags"], serde_json::json!(["data"]));
    // A sealed image is not sealed again, and not overwritten.
    let before = room.bytes("junk.cbs");
    let done = coflash(&["seal", "image", &room.path("junk.cbs"), "--key", &key, "--counter", "1"]);
    assert_eq!((done.exit, room.bytes("junk.cbs")), (2, before));
}

#[test]
fn a_module_signs_in_two_steps() {
    let room = Room::new("module");
    let (app, out) = (room.path("app.hex"), room.path("app.cbs"));
    let (key, cert, tbs) = (room.path("release.pub"), room.path("release.cert"), room.path("app.tbs"));
    let words =
        ["seal", "image", &app, "--board", "nucleo-f446re", "--key", &key, "--cert", &cert, "--counter", "1"];
    coflash(&[&words[..], &["--tbs", &tbs]].concat()).says(&["its signature is missing"]);
    room.verify("app.cbs", &[]).fails(3, &["its signature is wrong"]);
    let wrong = room.0.file("wrong.sig", &[0; 64]);
    coflash(&["seal", "image", &out, "--key", &key, "--attach", &wrong])
        .fails(3, &["this is not a signature of the key"]);
    let short = room.0.file("short.sig", &[0; 63]);
    assert!(coflash(&["seal", "image", &out, "--key", &key, "--attach", &short]).err.contains("64 bytes"));

    let signature = room.path("app.sig");
    let private = room.path("release.pem");
    let words = ["pkeyutl", "-sign", "-rawin", "-inkey", &private, "-in", &tbs, "-out", &signature];
    if openssl(&words).is_none() {
        let key = String::from_utf8(room.bytes("release.pem")).unwrap();
        let key = coflash_core::file::sealed::SigningKey::from_pem(&key).unwrap();
        fs::write(&signature, key.sign(&room.bytes("app.tbs"))).unwrap();
    }
    // In blocks, if their addresses are known.
    let attach = ["seal", "image", &out, "--key", &key, "--attach", &signature];
    coflash(&[&attach[..], &["--blocks"]].concat()).fails(2, &["give --board"]);
    coflash(&[&attach[..], &["--blocks", "--board", "nucleo-f446re"]].concat()).good();
    coflash(&attach).good();
    assert!(room.verify("app.cbs", &[]).out.contains("is whole"));
    assert!(unwrapped(&split(&room.bytes("app.blk"))).1 == room.bytes("app.cbs"));
    // OpenSSL accepts the tool's own signature.
    room.seal("own.cbs", &["--counter", "1"]);
    let own = room.bytes("own.cbs");
    let manifest = usize::from(u16::from_le_bytes([own[4], own[5]]));
    let message = room.0.file("message", &[&b"coboot sealed image 1\0"[..], &own[..manifest]].concat());
    let signature = room.0.file("own.sig", &own[manifest + 160..manifest + 224]);
    let words = ["pkeyutl", "-verify", "-rawin", "-pubin", "-inkey", &key, "-in", &message];
    openssl(&[&words[..], &["-sigfile", &signature]].concat());
    let certificate = room.bytes("release.cert");
    let message = room.0.file("certified", &certificate[..88]);
    let signature = room.0.file("certificate.sig", &certificate[88..]);
    let root = room.path("root.pub");
    let words = ["pkeyutl", "-verify", "-rawin", "-pubin", "-inkey", &root, "-in", &message];
    openssl(&[&words[..], &["-sigfile", &signature]].concat());
}

/// A bootloader as Intel HEX: 992 bytes of a resident part with this word among its vectors, and the
/// beginning of a RAM image.
fn bootloader(mark: &[u8; 4]) -> String {
    let mut resident = vec![0x5A; 992];
    resident[0x1C..0x20].copy_from_slice(mark);
    let image = b"CBI2\x01\0\0\0\x40\0\0\0\0\0\0\0";
    let resident = intel_hex(LAYOUT.bootloader.base, &resident);
    [resident.trim_end().trim_end_matches(END_OF_FILE), &intel_hex(LAYOUT.home.unwrap().base, image)].concat()
}

fn words_of(root: &str) -> [&str; 4] {
    ["--board", "stm32f407g-disc1", "--root", root]
}

#[test]
fn a_bootloader_gets_its_keys() {
    let room = Room::new("provision");
    let bootloader = bootloader(b"CBS1");
    let boot = room.0.file("boot.hex", bootloader.as_bytes());
    let (root, kek) = (room.path("root.pub"), room.path("kek.pem"));
    let words = ["seal", "provision", &boot, "--board", "stm32f407g-disc1", "--root", &root, "--kek", &kek];
    let provision = |more: &[&str]| coflash(&[&words[..], more].concat());
    let more = ["--counter", "7", "--epoch", "2", "--for-tests"];
    let out = room.path("production.hex");
    let done = provision(&[&more[..], &["-o", &out]].concat()).good();
    let secret = Kek::from_pem(&String::from_utf8(room.bytes("kek.pem")).unwrap()).unwrap();
    assert!(done.out.contains(&format!("key-encryption keys  {:08X}h", secret.id())), "{}", done.out);
    let image = ihex::read(&room.bytes("production.hex")).unwrap();
    let block: [u8; 256] = image.bytes(LAYOUT.key_block().base).unwrap();
    assert_eq!(image.byte_count(), 992 + 16 + 256);
    // The sectors of RM0090 table 5 at 08000000h and 08010000h.
    done.says(&[
        "option bytes         write protection (nWRP) of sectors 0, 4 and of no others, SPRMOD 0, BFB2 0",
    ]);
    assert_eq!(block[..16], *b"CBKB\x01\0\0\0\x07\0\0\0\x02\0\0\0");
    let public = PublicKey::from_pem(&String::from_utf8(room.bytes("root.pub")).unwrap()).unwrap();
    assert_eq!(block[20..52], public.bytes());
    #[cfg(unix)]
    assert_eq!(mode(&out), 0o600);
    for (more, exit, words) in [
        (&["-o", &out][..], 2, "exists already"),
        (&["-o", &room.path("x.bin")], 2, "name it with .hex"),
        (&["-o", &room.path("x.hex"), "--root", &root], 2, "a key was given twice"),
        (&["-o", &room.path("x.hex"), "--kek", &kek], 2, "a key was given twice"),
    ] {
        provision(more).fails(exit, &[words]);
    }
    coflash(&[&["seal", "provision", &out, "-o", &room.path("y.hex")][..], &words_of(&root)].concat())
        .fails(3, &["the place of the keys"]);
    // For any other file keys have no meaning.
    let other = room.0.file("other.hex", self::bootloader(b"CBS2").as_bytes());
    let out = room.path("none.hex");
    coflash(&[&["seal", "provision", &other][..], &words_of(&root), &["-o", &out]].concat())
        .fails(3, &["support for sealed images"]);
    assert!(!Path::new(&out).exists());
    coflash(&["seal", "provision", &boot, "--root", &root]).fails(2, &["give --board"]);
}

/// What only the command line knows; `tests/device/factory.rs` and `tests/sealed/factory.rs` have built bootloaders.
#[test]
fn a_file_for_production_has_a_format_and_takes_nobodys_place() {
    let room = Room::new("factory");
    let boot = room.0.file("boot.hex", bootloader(b"CBS1").as_bytes());
    let (app, out) = (room.path("app.hex"), room.path("factory.hex"));
    let factory = |more: &[&str]| coflash(&[&["seal", "factory", &boot, &app][..], more].concat());
    let board = ["--board", "stm32f407g-disc1"];
    factory(&["-o", &out]).fails(2, &["give --board"]);
    for (more, exit, words) in [
        (&["-o", &room.path("factory.txt")][..], 2, "name the file with .hex, .elf or .bin"),
        (&["-o", &room.path("factory.bin"), "--nameplate", &app], 2, "no place for a nameplate"),
        (&["-o", &boot], 2, "the result would overwrite"),
        (&["-o", &out, "--option-bytes", &room.path("options.txt")], 2, "--brown-out"),
        (&["-o", &out, "--node-id", "5"], 2, "--bit-rate"),
        (&["-o", &out], 3, "not a coboot bootloader"),
    ] {
        factory(&[&board[..], more].concat()).fails(exit, &[words]);
    }
    assert!(!Path::new(&out).exists());
}

/// The library's own check of the results of the commands.
#[test]
fn the_commands_make_what_the_library_verifies() {
    let room = Room::new("library");
    room.seal("app.cbs", &["--counter", "7", "--encrypt", &room.path("kek.pem")]);
    let root = PublicKey::from_pem(&String::from_utf8(room.bytes("root.pub")).unwrap()).unwrap();
    let kek = Kek::from_pem(&String::from_utf8(room.bytes("kek.pem")).unwrap()).unwrap();
    let device = Device { roots: &[root], keks: &[kek], ..Device::default() };
    assert_eq!(verify(&room.bytes("app.cbs"), &device).unwrap().image, Some(program()));
}

/// A RAM image of a bootloader, with the fields of its header typed from docs/adr/0020, and 4096 bytes.
fn ram_image(counter: u32) -> Vec<u8> {
    let mut image = b"CBI2".to_vec();
    let words = [0, 64, 4096, 0x2000_0000, 0x2001_FFC0, 1, 1, 7, 0x3F, 0x40, 0, 0x0001_0002, counter, 0, 0];
    image.extend(words.into_iter().flat_map(u32::to_le_bytes));
    image.extend((0..4096_u32).map(|at| at as u8));
    let crc = crc32(&image[8..]);
    image[4..8].copy_from_slice(&crc.to_le_bytes());
    image
}

/// Everything about a sealed bootloader is in its header.
#[test]
fn a_bootloader_is_sealed_by_a_key_for_bootloaders() {
    let room = Room::new("bootloader");
    let (root, key) = (room.path("root.pem"), room.path("release.pem"));
    let file = room.0.file("boot.bin", &ram_image(3));
    let (out, cert) = (room.path("boot.cbs"), room.path("boot.cert"));
    let certify =
        ["seal", "keys", "certify", "--root", &root, "--key", &room.path("release.pub"), "--epoch", "1"];
    let certify = [&certify[..], &["--vendor", "0x3F", "-o", &cert]].concat();
    let seal = ["seal", "image", &file, "-o", &out, "--bootloader", "--key", &key, "--cert", &cert];
    coflash(&[&certify[..], &["--role", "release"]].concat()).good();
    let done = coflash(&seal);
    assert_eq!(done.exit, 3, "a key for programs: {}", done.err);
    fs::remove_file(&cert).unwrap();
    coflash(&[&certify[..], &["--role", "bootloader"]].concat()).good();
    assert_eq!(json(&["seal", "keys", "show", &cert])["role"], "bootloader");
    coflash(&seal).says(&["counter 3, 4160 bytes"]);
    let shown = json(&["seal", "show", &out]);
    assert_eq!((&shown["program"], &shown["counter"]), (&255.into(), &3.into()));
    assert!(room.verify("boot.cbs", &[]).out.contains("4160 bytes"));
    // A key for bootloaders signs no program.
    let program = ["seal", "image", &room.path("app.hex"), "--board", "nucleo-f446re", "--counter", "7"];
    let done =
        coflash(&[&program[..], &["--key", &key, "--cert", &cert, "-o", &room.path("app.cbs")]].concat());
    assert_eq!(done.exit, 3, "{}", done.err);
    // What the header has.
    for more in [["--counter", "4"], ["--hardware", "1"]] {
        assert_eq!(coflash(&[&seal[..], &more].concat()).exit, 2, "{more:?}");
    }
    let none = room.path("app.hex");
    assert_eq!(coflash(&["seal", "image", &none, "--bootloader", "--key", &key, "-o", &out]).exit, 3);
}
