//! Packages for machines: their recipe, and the command line.

use std::fs;
use std::net::TcpListener;
use std::path::Path;

use canopen::NodeId;
use coflash_core::device::lss::LssAddress;
use coflash_core::file::sealed::{Sealer, SigningKey};
use coflash_core::machine::{make, Identity, Package, Part, Recipe};

use crate::sealing::Room;
use crate::tool::{coflash, command, data, folder, run, Done};
use kit::fake::{serve, Fake, Maker, APPLICATION};
use kit::folder::Folder;
use serde_json::{json, Value};

fn recipe(text: &str, folder: &Path) -> Result<(Recipe, Vec<Part>), String> {
    let parsed = Recipe::parse(text, folder);
    let parts = parsed.and_then(|recipe| recipe.parts().map(|parts| (recipe, parts)));
    parts.map_err(|fault| fault.to_string())
}

/// The program of `tests/data` in a raw binary for the flash of a board, by its vectors: a stack in RAM, and a
/// reset vector inside.
fn binary() -> Vec<u8> {
    let mut bytes = vec![0; 4096];
    bytes[..8].copy_from_slice(&[0x00, 0x00, 0x01, 0x20, 0x01, 0x02, 0x02, 0x08]);
    bytes
}

/// The example of the page, with files of the names that it has.
#[test]
fn the_documentations_example_is_a_recipe() {
    let page = include_str!("../../../../docs/machine-package.md");
    let text = page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    let folder = folder("recipe-page");
    fs::copy(data("program.elf"), folder.join("panel.elf")).unwrap();
    fs::copy(data("plain-400.blk"), folder.join("valve.blk")).unwrap();
    let sealer = Sealer { vendor_id: 0x3F, product_code: 1, program: 1, ..Sealer::default() };
    let sealed = sealer.seal(&binary(), &SigningKey::from_seed([1; 32]).unwrap()).unwrap();
    fs::write(folder.join("drive.cbs"), sealed).unwrap();
    // The files of the tests are linked for 08010000h, where that board has something else.
    let text = text.replace("board = \"stm32f407g-disc1\"", "");
    let (Recipe { name, release, .. }, parts) = recipe(&text, &folder).unwrap();
    assert_eq!((name.as_deref(), release.as_deref()), (Some("Press 4"), Some("2026-11")));
    let package = Package::parse(&make(name, release, &parts, &[]).unwrap()).unwrap();
    let shown: Vec<(&str, String)> =
        package.programs().map(|(entry, _)| (entry.name.as_str(), entry.whom())).collect();
    let expected = [
        ("panel", "node 1"),
        ("drive", "vendor 0000003Fh, product 00000001h, revision 00010000h"),
        ("valve", "nodes 21, 22, 23 (vendor 0000003Fh, product 00000002h)"),
    ];
    assert_eq!(shown, expected.map(|(name, whom)| (name, whom.to_owned())));
    let counts: Vec<_> = package.programs().map(|(entry, _)| (entry.count, entry.verify)).collect();
    assert_eq!(counts, [(None, false), (Some(4), false), (None, true)]);
}

/// The example of the page is a job, and so are the devices of a recipe for a package that have node-IDs.
#[test]
fn the_pages_example_is_a_job() {
    let page = include_str!("../../../../docs/coflash.md");
    let mut blocks = page.split("```toml\n").skip(1).filter_map(|block| block.split("```").next());
    let example = blocks.find(|block| block.contains("[[program]]")).unwrap();
    let recipe = Recipe::parse(example, Path::new("folder")).unwrap();
    let devices = recipe.devices().unwrap();
    let nodes: Vec<_> = devices.iter().filter_map(|device| device.node).map(NodeId::get).collect();
    assert_eq!(nodes, [5, 7, 6, 9]);
    let (first, third) = (devices[0].row, devices[2].row);
    assert_eq!((first.trial_run, third.start), (Some(true), Some(false)));
    assert_eq!((&*first.image, &*third.image), ("folder/app.elf".as_ref(), "folder/other.blk".as_ref()));
    assert_eq!(first.board.as_deref(), Some("stm32f407g-disc1"));
    let address = LssAddress { vendor_id: 0x3F, product_code: 1, revision: 2, serial_number: 3 };
    assert_eq!((devices[0].address, devices[3].address), (None, Some(address)));
}

/// What is wrong with a recipe that is carried out without a package.
#[test]
fn a_fault_of_a_job_is_named_with_its_place() {
    let fault = |text: &str| {
        let parsed = Recipe::parse(text, Path::new("folder"));
        parsed.and_then(|recipe| recipe.devices().map(drop)).unwrap_err().to_string()
    };
    let one = "[[program]]\nimage = 'a'\n";
    let lss = "lss = { vendor = 1, product = 2, revision = 3, serial = 4 }\n";
    let other = "[[program]]\nimage = 'b'\n";
    for (more, words) in [
        ("", "program 1: it has neither nodes nor lss"),
        ("nodes = [128]\n", "program 1: node-IDs are 1 to 127"),
        ("nodes = [300]\n", "line 3: "),
        ("node = 5\n", "line 3: unknown field `node`"),
        ("nodes = [1]\nprogram = 255\n", "program 1: programs are 1 to 254"),
        ("nodes = [1, 2, 1]\n", "program 1: the recipe has one of its devices twice"),
        (&format!("nodes = [1]\n{other}nodes = [1]\n"), "program 2: the recipe has one of its devices twice"),
        ("lss = { vendor = 1 }\n", "product"),
        (&format!("nodes = [1, 2]\n{lss}"), "program 1: one LSS address"),
        ("nodes = [1]\ncount = 3\n", "program 1: only a package has revision and count"),
        ("nodes = [1]\nvendor = 3\n", "program 1: vendor and product belong together"),
        ("nodes = [1]\ndialect = 'x'\n", "program 1: there is no dialect \"x\""),
    ] {
        let fault = fault(&format!("{one}{more}"));
        assert!(fault.contains(words), "{more:?}: {fault}");
    }
    // The job files of before.
    let before = "[[device]] is of the job files of before: write a [[program]] with image and nodes = [...]";
    for (text, line) in [
        ("image = 'a.elf'\ntrial-run = true\nprogram = 2\n[[device]]\nnode = 5\n", 4),
        ("[[device]]\nnode = 5\nimage = 'a.elf'\n[[device]]\nnode = 6\nimage = 'b.elf'\n", 1),
    ] {
        assert!(fault(text).starts_with(&format!("line {line}: {before}")), "{}", fault(text));
    }
}

/// A package has what a job has, but for the two settings that are for one device.
#[test]
fn a_package_has_no_setting_of_one_device() {
    let folder = folder("recipe-job");
    fs::write(folder.join("a.bin"), binary()).unwrap();
    for (more, words) in [
        ("start = false\n", "program 1: each program of a machine is started"),
        ("lss = { vendor = 1, product = 2, revision = 3, serial = 4 }\n", "program 1: a machine has node-IDs"),
        ("board = 'stm32f407g-disc1'\ncheck-target = true\n", "does not say for which device it is: it cannot be checked; give no revision without vendor and product, and no check-target"),
    ] {
        let fault = recipe(&format!("[[program]]\nimage = 'a.bin'\nnodes = [5]\n{more}"), &folder).unwrap_err();
        assert!(fault.contains(words), "{fault}");
    }
}

/// A sealed image names its device; a plain program without a label does not.
#[test]
fn a_file_that_names_its_device_needs_no_other_name() {
    let folder = folder("recipe-names");
    let sealer = Sealer { vendor_id: 0x3F, product_code: 7, program: 1, ..Sealer::default() };
    let sealed = sealer.seal(&binary(), &SigningKey::from_seed([1; 32]).unwrap()).unwrap();
    fs::write(folder.join("a.cbs"), sealed).unwrap();
    fs::copy(data("plain-400.blk"), folder.join("b.blk")).unwrap();
    let parts = recipe("[[program]]\nimage = 'a.cbs'\n", &folder).unwrap().1;
    assert_eq!(parts[0].entry.identity, Some(Identity { vendor: 0x3F, product: 7, revision: None }));
    let parts = recipe("[[program]]\nimage = 'a.cbs'\nrevision = 3\n", &folder).unwrap().1;
    assert_eq!(parts[0].entry.identity.unwrap().revision, Some(3));
    // Block 0 has vendor 0 and product 1234 (expected.py), as the reference application has.
    fs::copy(data("identity-110.blk"), folder.join("d.blk")).unwrap();
    let parts = recipe("[[program]]\nimage = 'd.blk'\n", &folder).unwrap().1;
    assert_eq!(parts[0].entry.identity, Some(Identity { vendor: 0, product: 1234, revision: None }));
    for (text, words) in [
        ("", "line 1: it names no program"),
        ("name = 5\n", "line 1: "),
        ("[[program]]\nimage = 'b.blk'\nspeed = 1\n", "line 3: "),
        ("[[program]]\nimage = 'b.blk'\n", "program 1: the file does not say for which device it is"),
        ("[[program]]\nimage = 'b.blk'\nvendor = 1\n", "program 1: vendor and product belong together"),
        ("[[program]]\nimage = 'c.blk'\n", "program 1: "),
        ("[[program]]\nimage = 'b.blk'\nnodes = [1]\ndialect = 'x'\n", "there is no dialect \"x\""),
        ("[[program]]\nimage = 'a.cbs'\nprogram = 2\n", "program 1: "),
        ("board = 'no-board'\n[[program]]\nimage = 'b.blk'\nnodes = [1]\n", "no-board"),
        ("[[program]]\nimage = 'b.blk'\nnodes = [1]\nboard = 'stm32f407g-disc1'\n", "b.blk"),
    ] {
        let fault = recipe(text, &folder).unwrap_err();
        assert!(fault.contains(words), "{text:?}: {fault}");
    }
}

/// A recipe, its package `line.cpk`, and the keys that have signed it.
struct Line(Folder);

impl Line {
    fn new(test: &str) -> Self {
        let line = Self(Room::new(test).0);
        fs::copy(data("plain-400.blk"), line.0.join("b.blk")).unwrap();
        line.0.file("line.toml", b"[[program]]\nimage = 'b.blk'\nvendor = 63\nproduct = 2\n");
        coflash(&["seal", "keys", "new", "--role", "root", "-o", &line.at("other.pem")]).good();
        line.package(&["--key", &line.at("release.pem"), "--cert", &line.at("release.cert")]).good();
        line
    }

    fn at(&self, name: &str) -> String {
        self.0.path(name)
    }

    fn package(&self, more: &[&str]) -> Done {
        coflash(&[&["package", &self.at("line.toml")], more].concat())
    }
}

/// By the command line: the package beside its recipe, and its content.
#[test]
fn the_command_makes_and_shows_a_package() {
    let line = Line::new("recipe-command");
    let (package, root) = (line.at("line.cpk"), line.at("root.pub"));
    let words = ["b: program 1 of 4001 bytes, for vendor 0000003Fh, product 00000002h", "signed by key "];
    let shown = coflash(&["inspect", &package, "--trust", &root]).says(&words);
    assert!(!shown.out.contains("not checked"), "{}", shown.out);
    // With a second signer, whose root is not named.
    let both = line.at("both.cpk");
    let (release, cert, other) = (line.at("release.pem"), line.at("release.cert"), line.at("other.pem"));
    line.package(&["-o", &both, "--key", &release, "--cert", &cert, "--key", &other]).good();
    let shown = coflash(&["inspect", &both, "--trust", &root]);
    for words in ["signed by key ", "not checked: another root: key "] {
        assert_eq!(shown.out.matches(words).count(), 1, "{}", shown.out);
    }
    let said = coflash(&["flash", &both, "--trust", &root, "--bus", "slcan:no-such-port"]);
    assert!(said.out.contains("not checked: another root: key "), "{}{}", said.out, said.err);
    let open = line.at("open.cpk");
    line.package(&["-o", &open]).good();
    let said = coflash(&["flash", &open, "--bus", "slcan:no-such-port"]);
    assert!(said.out.contains("not signed"), "{}{}", said.out, said.err);
    coflash(&["inspect", &package, "--trust", &line.at("release.pub")])
        .fails(3, &["is signed by a stranger", "[0x60000408]"]);
    // The bus of the manual's options, which is not there.
    let done = coflash(&["flash", &package, "--vxd_type", "16", "--device_no", "99"]);
    let port = if cfg!(windows) { "COM99" } else { "ttyS98" };
    assert!(done.exit != 0 && done.err.contains(port), "{}", done.err);
}

/// Files and options that contradict a package, or belong to one alone.
#[test]
fn what_contradicts_a_package_is_refused() {
    let line = Line::new("recipe-refused");
    let (recipe, package) = (&*line.at("line.toml"), &*line.at("line.cpk"));
    let (root, release, cert) = (line.at("root.pem"), line.at("release.pem"), line.at("release.cert"));
    let public = line.at("release.pub");
    // A root of the configuration is for packages, and any other file has nothing to do with it.
    let config = line.0.file("coflash.toml", format!("trust = '{public}'\nnode = 5\n").as_bytes());
    let config = &*config;
    // The same file by another path.
    fs::create_dir(line.0.join("aside")).unwrap();
    let (aside, image) = (line.at("aside/../line.toml"), line.at("aside/../b.blk"));
    // Another file with the name of a package does not get past this root.
    let named = &*line.0.file("x.CPK", &fs::read(data("plain-400.blk")).unwrap());
    let job = &*line.0.file("job.toml", b"[[program]]\nimage = 'a.blk'\nnodes = [5]\nstart = false\n");
    let before = &*line.0.file("before.toml", b"image = 'a.blk'\n[[device]]\nnode = 5\n");
    let lost = "is a key, which would be lost";
    for (words, exit, error) in [
        (&["flash", package, "--config", config][..], 3, "[0x60000408]"),
        (&["flash", &data("plain-400.blk"), "--config", config], 2, "no CAN bus is given"),
        (&["package", recipe, "--key", &root, "--cert", &cert], 2, "belongs to none of the keys"),
        (&["package", recipe, "-o", recipe], 2, "replace its recipe"),
        (&["package", recipe, "-o", &aside], 2, "replace its recipe"),
        (&["package", recipe, "-o", &image], 2, "replace an image of its recipe"),
        (&["package", recipe, "--key", &release, "--cert", &cert, "-o", &release], 2, lost),
        (&["package", recipe, "-o", &root], 2, lost),
        (&["convert", &data("plain-400.blk"), &root], 2, lost),
        (&["inspect", package, "--log-file", &root], 2, lost),
        (&["scan", "--bus", "slcan:no-such-port", "--trace", &root], 2, lost),
        (&["package", recipe, "--key", &release, "--cert", &cert, "--cert", &cert], 2, "belong to one key"),
        (&["package", package], 3, "line"),
        (&["flash", package, "--node", "5"], 2, "--node has no meaning beside a package"),
        (&["flash", package, "--no-trial"], 2, "--no-trial has no meaning beside a package"),
        (&["flash", named, "--config", config], 3, "[0x60000400]"),
        (&["inspect", named], 3, "[0x60000400]"),
        (&["inspect", &data("plain-400.blk"), "--trust", &public], 2, "only the signers of a package"),
        (&["inspect", package, "--board", "nucleo-f446re"], 2, "--board has no meaning beside a package"),
        (&["flash", package, "--chk_tgt", "1"], 2, "--chk_tgt has no meaning beside a package"),
        (&["flash", package, "--chk_run"], 2, "--chk_run has no meaning beside a package"),
        (&["flash", package, "--rev", "1"], 2, "--rev has no meaning beside a package"),
        (&["flash", package, "--pcode", "1"], 2, "--pcode has no meaning beside a package"),
        (&["flash", package, "--vendor", "1"], 2, "--vendor has no meaning beside a package"),
        (&["flash", "-F", package, "--trust", &public], 3, "[0x60000408]"),
        (&["flash", &data("plain-400.blk"), "--trust", &public], 2, "only the signers of a package"),
        (&["flash", &data("plain-400.blk"), "--yes"], 2, "only the update with a package is confirmed"),
        (&["flash", package, "--trust", &public], 3, "[0x60000408]"),
        // A service station takes the same packages, before there is any page.
        (&["ui", "--service", package, "--trust", &public], 3, "[0x60000408]"),
        (&["ui", "--service", package, "--config", config], 3, "[0x60000408]"),
        (&["ui", "--service", named], 3, "[0x60000400]"),
        (&["ui", "--trust", &public], 2, "only the signers of a package"),
        (&["ui", "--service", job, "--trust", &public], 2, "a job file has no signature"),
        (&["ui", "--service", job, "--config", config], 2, "a job file has no signature"),
        (&["ui", "--service", job], 3, "program 1: each program of a machine is started"),
        (&["ui", "--service", before], 3, "line 2: [[device]] is of the job files of before"),
        (&["flash", "--job", before], 3, "line 2: [[device]] is of the job files of before"),
    ] {
        coflash(words).fails(exit, &[error]);
    }
    // What a station cannot remember is said before it serves anything: here the place of its folder is a file.
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let words =
        ["ui", "--service", package, "--no-open", "--port", &port, "--report-dir", &line.at("reports")];
    let told = ["the adapter is chosen anew at each start", "make that folder writable", "cannot be served"];
    run(command().env("XDG_STATE_HOME", &root).args(words)).fails(1, &told);
}

/// Vendor-ID, product code, and 2005h.
struct Version(u32);

impl Maker for Version {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        let value = match at {
            (0x1018, 1) => 63,
            (0x1018, 2) => 1234,
            (0x2005, 1) => self.0,
            _ => return None,
        };
        Some(Ok(value.to_le_bytes().to_vec()))
    }
}

/// The device has V1.10r101, and the package V1.10r100 (expected.py): left out, it has not failed; allowed, the plan
/// says that it is written.
#[test]
fn an_older_program_has_not_failed_and_the_plan_says_what_is_done() {
    let folder = folder("package-older");
    fs::copy(data("release-110.blk"), folder.join("b.blk")).unwrap();
    folder.file("line.toml", b"[[program]]\nimage = 'b.blk'\nnodes = [5]\n");
    coflash(&["package", &folder.path("line.toml")]).good();
    let flash = |more: &str| {
        let mut fake = Fake::new(APPLICATION);
        fake.maker = Some(Box::new(Version(0x0065_0A01)));
        let (url, _device) = serve(fake);
        coflash(&["--bus", &url, "flash", &folder.path("line.cpk"), "--yes", more])
    };
    flash("--verbose").fails(8, &["error: 1 of 1 programs are not in their devices\n"]);
    let left = flash("--json").json();
    assert_eq!((&left["devices"][0]["state"], &left["failed"]), (&json!("older"), &json!(0)), "{left:#}");
    flash("--allow-older")
        .says(&["-> V1.10r100, which is older\n", "1 of 1 programs are in their devices\n"]);
}

/// A run that was killed has left what it had begun, in its report or in the folder of the reports:
/// the next run does not say that the device had its program. One of another device does, and one
/// after a later run that has ended.
#[test]
fn a_device_that_an_interrupted_run_has_written_did_not_have_its_program() {
    let folder = folder("package-resumed");
    fs::copy(data("plain-400.blk"), folder.join("b.blk")).unwrap();
    folder.file("line.toml", b"[[program]]\nimage = 'b.blk'\nnodes = [5]\n");
    coflash(&["package", &folder.path("line.toml")]).good();
    let package = Package::parse(&fs::read(folder.join("line.cpk")).unwrap()).unwrap();
    let crc = package.programs().next().unwrap().1.crc();
    let [report, reports] = ["report.json", "reports"].map(|name| folder.path(name));
    let flash = |more: [&str; 2]| {
        let mut fake = Fake::new(APPLICATION);
        fake.crc_of_application = Some(crc);
        let (url, _device) = serve(fake);
        let words = ["--bus", &url, "flash", &folder.path("line.cpk"), "--yes", "--json"];
        coflash(&[&words[..], &more].concat()).good().json()["devices"][0].clone()
    };
    let had = flash(["--report", &report]);
    assert_eq!(had["state"], "had", "{had:#}");
    for (run, serial, ended, state) in [
        ("1", &had["serial_number"], Value::Null, "resumed"),
        ("2", &json!(4711), Value::Null, "resumed"),
        ("3", &had["serial_number"], json!("2026"), "had"),
    ] {
        let mut device = had.clone();
        device["serial_number"] = serial.clone();
        let text = json!({ "began": "2026", "ended": ended, "begun": [device] }).to_string();
        fs::create_dir_all(format!("{reports}/{run}")).unwrap();
        fs::write(format!("{reports}/{run}/report.json"), &text).unwrap();
        assert_eq!(flash(["--report-dir", &reports])["state"], state, "{run}");
        fs::write(&report, text).unwrap();
        let state = if run == "2" { "had" } else { state };
        assert_eq!(flash(["--report", &report])["state"], state, "{run}");
    }
}
