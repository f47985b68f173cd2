//! The commands for sealed images, one behind the other as a user runs them; OpenSSL is asked wherever
//! it is there.

mod fake;
mod tool;

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use coflash::file::sealed::{verify, Device, Kek, PublicKey};
use coflash::file::{ihex, raw};
use fake::vault::Vault;
use fake::{Fake, APPLICATION, BOOTLOADER};
use serde_json::Value;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;
use tool::{coflash, serve, Done, Folder};

const START: u32 = 0x0801_0000;
/// What the fake has in 1018h.
const VENDOR: u32 = 0x3F;
const PRODUCT: u32 = 1234;

/// A program with a label at 1E0h, as the page about it has it, and some bytes that can be compressed.
fn program() -> Vec<u8> {
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
struct Room(Folder);

impl Room {
    fn new(test: &str) -> Self {
        let room = Self(Folder::new(&format!("sealing-{test}")));
        let image = raw::read(&program(), Some(START)).unwrap();
        room.0.file("app.hex", ihex::emit(&image).as_bytes());
        for role in ["root", "release", "kek"] {
            room.good(&["key", "new", "--role", role, "-o", &room.path(&format!("{role}.pem"))]);
        }
        room.certify("release.cert", &[]);
        room
    }

    fn path(&self, name: &str) -> String {
        self.0.path(name)
    }

    fn bytes(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    #[track_caller]
    fn good(&self, words: &[&str]) -> Done {
        let done = coflash(words);
        assert_eq!(done.exit, 0, "{words:?}: {}", done.err);
        done
    }

    fn certify(&self, name: &str, more: &[&str]) {
        let (root, key, out) = (self.path("root.pem"), self.path("release.pub"), self.path(name));
        let words = ["key", "certify", "--root", &root, "--key", &key, "--epoch", "3", "--vendor", "0x3F"];
        self.good(&[&words[..], &["-o", &out], more].concat());
    }

    /// Seals the program as this file.
    fn seal(&self, name: &str, more: &[&str]) -> Done {
        let (app, out) = (self.path("app.hex"), self.path(name));
        let (key, cert) = (self.path("release.pem"), self.path("release.cert"));
        let words = ["seal", &app, "-o", &out, "--board", "stm32f407g-disc1", "--key", &key, "--cert", &cert];
        coflash(&[&words[..], more].concat())
    }

    fn verify(&self, name: &str, more: &[&str]) -> Done {
        coflash(&[&["verify", &self.path(name), "--root", &self.path("root.pub")], more].concat())
    }
}

fn json(words: &[&str]) -> Value {
    let done = coflash(&[words, &["--json"]].concat());
    serde_json::from_str(&done.out).unwrap_or_else(|error| panic!("{error}: {}{}", done.out, done.err))
}

/// What OpenSSL says; `None` where it is not there.
fn openssl(words: &[&str]) -> Option<Vec<u8>> {
    let output = Command::new("openssl").args(words).stdin(Stdio::null()).output().ok()?;
    assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    Some(output.stdout)
}

#[test]
fn keys_are_made_once_and_are_those_of_openssl() {
    let room = Room::new("keys");
    let root = room.path("root.pem");
    let before = room.bytes("root.pem");
    #[cfg(unix)]
    for name in ["root.pem", "release.pem", "kek.pem"] {
        use std::os::unix::fs::PermissionsExt as _;
        assert_eq!(fs::metadata(room.path(name)).unwrap().permissions().mode() & 0o777, 0o600, "{name}");
    }
    let again = coflash(&["key", "new", "--role", "root", "-o", &root]);
    assert_eq!(again.exit, 2);
    assert!(again.err.contains("is there already"), "{}", again.err);
    assert_eq!(room.bytes("root.pem"), before);
    // The public key alone is there.
    fs::remove_file(&root).unwrap();
    assert_eq!(coflash(&["key", "new", "--role", "root", "-o", &root]).exit, 2);
    assert!(!Path::new(&root).exists());
    room.good(&["key", "new", "--role", "root", "-o", &root, "--force"]);
    assert_ne!(room.bytes("root.pem"), before);
    // A name that both files would have.
    assert_eq!(coflash(&["key", "new", "--role", "root", "-o", &room.path("a.pub")]).exit, 2);

    if let Some(public) = openssl(&["pkey", "-in", &root, "-pubout"]) {
        assert_eq!(public, room.bytes("root.pub"));
        let made = room.path("openssl.pem");
        openssl(&["genpkey", "-algorithm", "ed25519", "-out", &made]).unwrap();
        let der = openssl(&["pkey", "-in", &made, "-pubout", "-outform", "DER"]).unwrap();
        let digits: String = der[12..].iter().map(|byte| format!("{byte:02x}")).collect();
        let shown = json(&["key", "show", &made]);
        assert_eq!((&shown["kind"], &shown["public_key"]), (&"private key".into(), &digits.into()));
        // A curve of another kind is none.
        openssl(&["genpkey", "-algorithm", "x25519", "-out", &made]).unwrap();
        assert_eq!(coflash(&["key", "show", &made]).exit, 3);
    }
}

#[test]
fn keys_and_certificates_are_shown_without_secrets() {
    let room = Room::new("show-keys");
    let id = PublicKey::from_pem(&String::from_utf8(room.bytes("release.pub")).unwrap()).unwrap().id();
    for (name, kind) in [("release.pem", "private key"), ("release.pub", "public key")] {
        let shown = json(&["key", "show", &room.path(name)]);
        assert_eq!((&shown["kind"], &shown["id"]), (&kind.into(), &id.into()));
    }
    let kek = Kek::from_pem(&String::from_utf8(room.bytes("kek.pem")).unwrap()).unwrap();
    let shown = room.good(&["key", "show", &room.path("kek.pem")]);
    assert_eq!(shown.out, format!("{}: key-encryption key {:08X}h\n", room.path("kek.pem"), kek.id()));
    room.certify("test.cert", &["--test", "--product", "1234", "--lowest", "2", "--highest", "5"]);
    let shown = json(&["key", "show", &room.path("test.cert")]);
    assert_eq!((&shown["kind"], &shown["role"]), (&"certificate".into(), &"test".into()));
    assert_eq!((&shown["key_id"], &shown["epoch"]), (&id.into(), &3.into()));
    assert_eq!((&shown["lowest"], &shown["highest"]), (&2.into(), &5.into()));
    for (name, bytes) in
        [("empty", &b""[..]), ("text", b"hello"), ("cut.cert", b"CBK1\x98"), ("binary", &[0xFF; 99])]
    {
        let file = room.0.file(name, bytes);
        assert_eq!(coflash(&["key", "show", &file]).exit, 3, "{name}");
    }
    let bad = ["key", "certify", "--root", &room.path("root.pem"), "--key", &room.path("release.pub")];
    let bad = [&bad[..], &["--epoch", "1", "--vendor", "1", "--lowest", "6", "--highest", "5"]].concat();
    assert_eq!(coflash(&bad).exit, 2);
}

/// The value of the manual's tools: the first 32 bytes of an HMAC, by OpenSSL.
#[test]
fn a_value_of_128_bits_makes_a_key() {
    let room = Room::new("value");
    let (value, out) = ("000102030405060708090a0b0c0d0e0f", room.path("product.pem"));
    room.good(&["key", "new", "--role", "kek", "--of-value", value, "-o", &out]);
    let text = room.0.file("text", b"coboot key of a value 1\0");
    let option = format!("hexkey:{value}");
    if let Some(mac) = openssl(&["dgst", "-sha512", "-binary", "-mac", "HMAC", "-macopt", &option, &text]) {
        let kek = Kek::new(mac[..32].try_into().unwrap()).unwrap();
        assert_eq!(json(&["key", "show", &out])["id"], kek.id());
    }
    for (role, value) in [("kek", "0001"), ("kek", "zz"), ("root", value)] {
        let out = room.path("none.pem");
        assert_eq!(coflash(&["key", "new", "--role", role, "--of-value", value, "-o", &out]).exit, 2);
        assert!(!Path::new(&out).exists());
    }
    // What the manual's converter takes for encryption leads here.
    let done = coflash(&["convert", &room.path("app.hex"), "--board", "stm32f407g-disc1", "--key", value]);
    assert_eq!(done.exit, 2);
    assert!(done.err.contains("--of-value") && !done.err.contains(value), "{}", done.err);
}

#[test]
fn a_program_is_sealed_shown_and_verified() {
    let room = Room::new("seal");
    let done = room.seal("app.cbs", &["--counter", "7"]);
    assert_eq!(done.exit, 0, "{}", done.err);
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&program());
    let expected = format!(": program 1 V1.10r100, counter 7, 9001 bytes, CRC {crc:08X}h\n");
    assert!(done.out.ends_with(&expected), "{}", done.out);
    let first = room.bytes("app.cbs");
    room.seal("app.cbs", &["--counter", "7"]);
    assert_eq!(room.bytes("app.cbs"), first, "the same input, the same file");

    let shown = json(&["show", &room.path("app.cbs")]);
    assert_eq!((&shown["vendor_id"], &shown["product_code"]), (&VENDOR.into(), &PRODUCT.into()));
    assert_eq!((&shown["version_text"], &shown["counter"]), (&"V1.10r100".into(), &7.into()));
    assert_eq!(
        (&shown["size"], &shown["payload"], &shown["chunk"]),
        (&9001.into(), &9001.into(), &4096.into())
    );
    let words = room.good(&["show", &room.path("app.cbs")]).out;
    assert!(words.contains("vendor-ID 0000003Fh, product code 000004D2h"), "{words}");
    // inspect knows it, too, and other commands do not take it for anything else.
    assert_eq!(room.good(&["inspect", &room.path("app.cbs")]).out, words);
    let converted = coflash(&["convert", &room.path("app.cbs"), &room.path("x.blk")]);
    assert_eq!(converted.exit, 3);
    assert!(converted.err.contains("is a sealed image"), "{}", converted.err);

    let verified = room.verify("app.cbs", &["--product", "1234", "--counter", "7", "--epoch", "3"]);
    assert_eq!(verified.exit, 0, "{}", verified.err);
    assert!(verified.out.contains("the program is whole, 9001 bytes"), "{}", verified.out);
    for (more, words, number) in [
        (&["--product", "1"][..], "it is for product code 000004D2h", "0x60000182"),
        (&["--vendor", "1"], "it is for vendor-ID 0000003Fh", "0x60000180"),
        (&["-P", "2"], "it is program 1, and program 2 is written", "0x60000182"),
        (&["--counter", "8"], "its security counter is 7", "0x6000018c"),
        (&["--epoch", "4"], "its certificate is of epoch 3", "0x6000018c"),
        (&["--room", "9000"], "the program has 9001 bytes", "0x60000006"),
    ] {
        let done = room.verify("app.cbs", more);
        assert_eq!(done.exit, 3, "{more:?}");
        assert!(done.err.contains(words) && done.err.contains(number), "{}", done.err);
        assert!(done.err.contains("what to do: "), "{}", done.err);
    }
    let mut damaged = first.clone();
    *damaged.last_mut().unwrap() ^= 1;
    let file = room.0.file("damaged.cbs", &damaged);
    let done = coflash(&["verify", &file, "--root", &room.path("root.pub")]);
    assert!(done.err.contains("chunk 3 of 3") && done.err.contains("[0x6000018a]"), "{}", done.err);
    let done = coflash(&["verify", &room.path("app.cbs"), "--root", &room.path("release.pub")]);
    assert!(done.err.contains("is none of the roots given [0x6000018e]"), "{}", done.err);
    for (name, bytes) in [("empty.cbs", &b""[..]), ("cut.cbs", &first[..600]), ("magic.cbs", b"CBS1")] {
        let file = room.0.file(name, bytes);
        for words in
            [&["show", &file][..], &["verify", &file, "--root", &room.path("root.pub")], &["inspect", &file]]
        {
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
    let shown = json(&["show", &room.path("app.cbs")]);
    assert_eq!(shown["flags"], serde_json::json!(["encrypted", "compressed"]));
    assert_eq!(shown["text"], "for all");
    assert!(shown["payload"].as_u64() < shown["size"].as_u64());
    let closed = room.verify("app.cbs", &[]);
    assert!(closed.out.contains("give --kek"), "{}{}", closed.out, closed.err);
    let whole = room.verify("app.cbs", &["--kek", &kek]);
    assert!(whole.out.contains("the program is whole, 9001 bytes"), "{}{}", whole.out, whole.err);
    let other = room.0.file("other.kek", "5a".repeat(32).as_bytes());
    let done = room.verify("app.cbs", &["--kek", &other]);
    assert!(done.err.contains("encrypted for other keys"), "{}", done.err);

    // Against the other program, for one device, with everything else.
    let old = room.0.file("old.bin", &program()[..8000]);
    let (uid, sbom) = ("00112233445566778899aabb", room.0.file("sbom.json", b"{}"));
    let more = ["--counter", "0x10", "--base", &old, "--device", uid, "--hardware", "1", "--hardware", "33"];
    let more = [&more[..], &["--chunk", "512", "--sbom", &sbom, "--date", "1420070400", "-P", "1"]].concat();
    let sealed = room.seal("app.cbs", &more);
    assert_eq!(sealed.exit, 0, "{}", sealed.err);
    let shown = json(&["show", &room.path("app.cbs")]);
    assert_eq!((&shown["unique_id"], &shown["hardware"]), (&uid.into(), &2.into()));
    assert_eq!((&shown["chunk"], &shown["created"]), (&512.into(), &1_420_070_400.into()));
    // A hash of two bytes: `printf '{}' | openssl dgst -sha512-256`.
    if let Some(said) = openssl(&["dgst", "-sha512-256", "-r", &sbom]) {
        assert_eq!(shown["sbom"], String::from_utf8(said).unwrap().split(' ').next().unwrap());
    }
    assert!(room.verify("app.cbs", &[]).out.contains("give --base"));
    assert!(room.verify("app.cbs", &["--base", &old]).out.contains("is whole"));
    let done = room.verify("app.cbs", &["--base", &room.path("app.hex")]);
    assert!(done.err.contains("another program than the one given"), "{}", done.err);
    let done = room.verify("app.cbs", &["--device", "000102030405060708090a0b"]);
    assert!(done.err.contains("another unique ID alone"), "{}", done.err);
    assert_eq!(room.verify("app.cbs", &["--hardware", "2"]).exit, 3);

    // For tests.
    room.certify("release.cert", &["--test"]);
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
        (&["--counter", "1", "--encrypt", &room.path("root.pub")], 3, "it is no key-encryption key"),
        (&["--counter", "1", "--chunk", "1000"], 2, "a power of two from 512 to 8192"),
        (&["--counter", "1", "--device", "00"], 2, "24 hexadecimal digits"),
        (&["--counter", "1", "-P", "2"], 2, "has no program 2"),
        (&[], 2, "--counter"),
    ] {
        let done = room.seal("none.cbs", more);
        assert_eq!(done.exit, exit, "{more:?}: {}", done.err);
        assert!(done.err.contains(words), "{}", done.err);
        assert!(!Path::new(&room.path("none.cbs")).exists());
    }
    // No program, and no label.
    let junk = room.0.file("junk.bin", &[0x5A; 1000]);
    let key = room.path("release.pem");
    let words =
        ["seal", &junk, "-I", "binary", "--board", "stm32f407g-disc1", "--key", &key, "--counter", "1"];
    assert!(coflash(&words).err.contains("is no program"));
    let done = coflash(&[&words[..], &["--data"]].concat());
    assert!(
        done.err.contains("for which vendor-ID it is") && done.err.contains("give --vendor"),
        "{}",
        done.err
    );
    let done = coflash(&[&words[..], &["--data", "--vendor", "1", "--product", "2"]].concat());
    assert_eq!(done.exit, 0, "{}", done.err);
    assert_eq!(json(&["show", &room.path("junk.cbs")])["flags"], serde_json::json!(["data"]));
    // A file that is one already is not sealed again, and not overwritten.
    let before = room.bytes("junk.cbs");
    let done = coflash(&["seal", &room.path("junk.cbs"), "--key", &key, "--counter", "1"]);
    assert_eq!((done.exit, room.bytes("junk.cbs")), (2, before));
}

#[test]
fn a_module_signs_in_two_steps() {
    let room = Room::new("module");
    let (app, out) = (room.path("app.hex"), room.path("app.cbs"));
    let (key, cert, tbs) = (room.path("release.pub"), room.path("release.cert"), room.path("app.tbs"));
    let words =
        ["seal", &app, "--board", "stm32f407g-disc1", "--key", &key, "--cert", &cert, "--counter", "1"];
    let done = room.good(&[&words[..], &["--tbs", &tbs]].concat());
    assert!(done.out.contains("its signature is missing"), "{}", done.out);
    let done = room.verify("app.cbs", &[]);
    assert!(done.err.contains("its signature is wrong"), "{}", done.err);
    let wrong = room.0.file("wrong.sig", &[0; 64]);
    let done = coflash(&["seal", &out, "--key", &key, "--attach", &wrong]);
    assert_eq!(done.exit, 3);
    assert!(done.err.contains("this is no signature of the key"), "{}", done.err);
    let short = room.0.file("short.sig", &[0; 63]);
    assert!(coflash(&["seal", &out, "--key", &key, "--attach", &short]).err.contains("64 bytes"));

    let signature = room.path("app.sig");
    let private = room.path("release.pem");
    let words = ["pkeyutl", "-sign", "-rawin", "-inkey", &private, "-in", &tbs, "-out", &signature];
    if openssl(&words).is_none() {
        let key = String::from_utf8(room.bytes("release.pem")).unwrap();
        let key = coflash::file::sealed::SigningKey::from_pem(&key).unwrap();
        fs::write(&signature, key.sign(&room.bytes("app.tbs"))).unwrap();
    }
    room.good(&["seal", &out, "--key", &key, "--attach", &signature]);
    assert!(room.verify("app.cbs", &[]).out.contains("is whole"));
    // What the tool itself has signed, OpenSSL finds right.
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

#[test]
fn a_bootloader_gets_its_keys() {
    let room = Room::new("provision");
    let bootloader = [&0x2001_FFC0_u32.to_le_bytes()[..], &[0x5A; 996]].concat();
    let boot = room.0.file("boot.bin", &bootloader);
    let (root, kek) = (room.path("root.pub"), room.path("kek.pem"));
    let words = ["provision", &boot, "--board", "stm32f407g-disc1", "--root", &root, "--kek", &kek];
    let more = ["--counter", "7", "--epoch", "2", "--for-tests"];
    let out = room.path("production.bin");
    let done = room.good(&[&words[..], &more, &["-o", &out]].concat());
    let secret = Kek::from_pem(&String::from_utf8(room.bytes("kek.pem")).unwrap()).unwrap();
    assert!(done.out.contains(&format!("key-encryption keys  {:08X}h", secret.id())), "{}", done.out);
    let flash = room.bytes("production.bin");
    assert_eq!(flash.len(), LAYOUT.bootloader.size as usize);
    assert_eq!(flash[..1000], bootloader);
    let block = &flash[flash.len() - 256..];
    assert_eq!(block[..16], *b"CBKB\x01\0\0\0\x07\0\0\0\x02\0\0\0");
    let public = PublicKey::from_pem(&String::from_utf8(room.bytes("root.pub")).unwrap()).unwrap();
    assert_eq!(block[20..52], public.bytes());
    // The same as Intel HEX.
    room.good(&[&words[..], &more, &["-o", &room.path("production.hex")]].concat());
    let image = ihex::read(&room.bytes("production.hex")).unwrap();
    assert_eq!(
        image.bytes(LAYOUT.key_block().base).map(|bytes: [u8; 256]| bytes.to_vec()),
        Some(block.to_vec())
    );
    assert_eq!(image.byte_count(), 1256);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        assert_eq!(fs::metadata(&out).unwrap().permissions().mode() & 0o777, 0o600);
    }
    for (more, exit, words) in [
        (&["-o", &out][..], 2, "is there already"),
        (&["-o", &room.path("x.elf")], 2, "name the file with .hex or .bin"),
        (&["-o", &room.path("x.hex"), "--root", &root], 2, "the same key twice"),
        (&["-o", &room.path("x.hex"), "--kek", &kek], 2, "the same key twice"),
    ] {
        let done = coflash(
            &[&["provision", &boot, "--board", "stm32f407g-disc1", "--root", &root, "--kek", &kek], more]
                .concat(),
        );
        assert_eq!(done.exit, exit, "{more:?}: {}", done.err);
        assert!(done.err.contains(words), "{}", done.err);
    }
    let again = coflash(&[
        "provision",
        &out,
        "--board",
        "stm32f407g-disc1",
        "--root",
        &root,
        "-o",
        &room.path("y.hex"),
    ]);
    assert_eq!(again.exit, 3);
    assert!(again.err.contains("where the keys go"), "{}", again.err);
}

/// Flashes this file; gives what was said, what the device was sent, and what else was written.
fn flashed(file: &str, room: u32, status: u32, more: &[&str]) -> (Done, Vec<u8>, Vec<String>) {
    let kept: Arc<Mutex<Vec<u8>>> = Arc::default();
    let mut fake = Fake::new(APPLICATION);
    fake.erase_time = Duration::from_millis(30);
    fake.restart_time = Duration::from_millis(20);
    fake.maker = Some(Box::new(Vault { kept: kept.clone(), start: START, room, status }));
    let (bus, server) = serve(fake);
    let done = coflash(&[&["flash", file, "--bus", &bus, "-N", "5"], more].concat());
    let fake = server.join().unwrap();
    let kept = kept.lock().unwrap().clone();
    (done, kept, fake.writes().iter().map(ToString::to_string).collect())
}

#[test]
fn a_sealed_image_goes_into_a_device_as_it_is() {
    let room = Room::new("flash");
    // A small one: each frame takes its time.
    let image = raw::read(&program()[..1024], Some(START)).unwrap();
    room.0.file("app.hex", ihex::emit(&image).as_bytes());
    assert_eq!(room.seal("app.cbs", &["--counter", "7"]).exit, 0);
    let (file, bytes) = (room.path("app.cbs"), room.bytes("app.cbs"));
    let (done, kept, writes) = flashed(&file, 0x10000, 0, &["--check-target"]);
    assert_eq!(done.exit, 0, "{}{}", done.out, done.err);
    assert!(kept == bytes);
    let commands: Vec<&String> = writes.iter().filter(|write| write.starts_with("command")).collect();
    assert_eq!(commands, ["command 80", "command 03", "command 01"]);
    for words in
        ["sealed program of 1024 bytes", "counter 7, signed by ", "verified: CRC", "running: an application"]
    {
        assert!(done.out.contains(words), "{words}: {}", done.out);
    }

    // What the device says of it.
    for (status, number, words, advice) in [
        (0x8A, "[0x6000018a]", "the program's signature is wrong", "coflash verify"),
        (0x8C, "[0x6000018c]", "the program is older than the device allows", "--counter"),
        (0x8E, "[0x6000018e]", "the device has no key for this program", "coflash show"),
    ] {
        let (done, kept, _) = flashed(&file, 0x10000, status, &[]);
        assert_eq!(done.exit, 6, "{}", done.out);
        assert!(kept == bytes, "it is sent once, and not again");
        for words in [number, words, advice] {
            assert!(done.err.contains(words), "{words}: {}", done.err);
        }
    }

    // What is told without asking the device's keys: nothing is done to it.
    let small = flashed(&file, 1000, 0, &[]);
    assert!(small.0.err.contains("the device has room for 1000"), "{}", small.0.err);
    assert_eq!((small.0.exit, small.2.len()), (6, 0));
    assert_eq!(room.seal("other.cbs", &["--counter", "7", "--product", "99"]).exit, 0);
    let other = flashed(&room.path("other.cbs"), 0x10000, 0, &[]);
    assert!(other.0.err.contains("product code"), "{}", other.0.err);
    assert_eq!((other.0.exit, other.2.len()), (6, 0));
    let second = coflash(&["flash", &file, "-P", "2"]);
    assert!(second.err.contains("it is program 1, and program 2 is written"), "{}", second.err);
    assert_eq!(second.exit, 3);
    let cut = room.0.file("cut.cbs", &bytes[..bytes.len() - 1]);
    let cut = coflash(&["flash", &cut]);
    assert!(cut.exit == 3 && cut.err.contains("it is cut off"), "{}", cut.err);
    // In the bootloader already, and in the other dialects of the same objects.
    for dialect in ["raw", "hex"] {
        let kept: Arc<Mutex<Vec<u8>>> = Arc::default();
        let mut fake = Fake::new(BOOTLOADER);
        fake.maker = Some(Box::new(Vault { kept: kept.clone(), start: START, room: 0x10000, status: 0 }));
        let (bus, server) = serve(fake);
        let done = coflash(&["flash", &file, "--bus", &bus, "-N", "5", "--dialect", dialect]);
        assert_eq!(done.exit, 0, "{}", done.err);
        server.join().unwrap();
        assert!(*kept.lock().unwrap() == bytes);
    }
}

/// The library's own check of what the commands have made.
#[test]
fn the_commands_make_what_the_library_verifies() {
    let room = Room::new("library");
    room.seal("app.cbs", &["--counter", "7", "--encrypt", &room.path("kek.pem")]);
    let root = PublicKey::from_pem(&String::from_utf8(room.bytes("root.pub")).unwrap()).unwrap();
    let kek = Kek::from_pem(&String::from_utf8(room.bytes("kek.pem")).unwrap()).unwrap();
    let device = Device { roots: &[root], keks: &[kek], ..Device::default() };
    assert_eq!(verify(&room.bytes("app.cbs"), &device).unwrap().image, Some(program()));
}
