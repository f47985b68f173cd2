//! Packages for machines: their recipe, and the command line.

use std::fs;

use coflash_core::file::sealed::{Sealer, SigningKey};
use coflash_core::machine::{make, Identity, Package, Recipe};

use crate::tool::{coflash, data, folder};

fn recipe(text: &str, folder: &std::path::Path) -> Result<Recipe, String> {
    Recipe::read(text, folder).map_err(|fault| fault.to_string())
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
    let Recipe { name, release, parts, .. } = recipe(&text, &folder).unwrap();
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

/// One image with two settings is two programs: the second has a name that no other image has.
#[test]
fn the_programs_of_a_job_have_names_of_their_own() {
    let folder = folder("recipe-job");
    for name in ["app.blk", "app (2).blk"] {
        fs::copy(data("plain-400.blk"), folder.join(name)).unwrap();
    }
    let job = "[[device]]\nnode = 5\nimage = 'app.blk'\n[[device]]\nnode = 6\nimage = 'app (2).blk'\n\
               [[device]]\nnode = 7\nimage = 'app.blk'\nverify = true\n";
    let parts = Recipe::of_job(job, &folder).unwrap().parts;
    let names: Vec<_> = parts.iter().map(|part| part.entry.name.as_str()).collect();
    assert_eq!(names, ["app", "app (2)", "app (3)"]);
    Package::parse(&make(None, None, &parts, &[]).unwrap()).unwrap();
    fs::write(folder.join("a.bin"), binary()).unwrap();
    let checked = "board = 'stm32f407g-disc1'\n[[device]]\nnode = 5\nimage = 'a.bin'\ncheck-target = true\n";
    let fault = Recipe::of_job(checked, &folder).unwrap_err().to_string();
    assert!(fault.contains("does not say for which device") && fault.contains("no check-target"), "{fault}");
}

/// A sealed image names its device; a plain program without a label does not.
#[test]
fn a_file_that_names_its_device_needs_no_other_name() {
    let folder = folder("recipe-names");
    let sealer = Sealer { vendor_id: 0x3F, product_code: 7, program: 1, ..Sealer::default() };
    let sealed = sealer.seal(&binary(), &SigningKey::from_seed([1; 32]).unwrap()).unwrap();
    fs::write(folder.join("a.cbs"), sealed).unwrap();
    fs::copy(data("plain-400.blk"), folder.join("b.blk")).unwrap();
    let parts = recipe("[[program]]\nimage = 'a.cbs'\n", &folder).unwrap().parts;
    assert_eq!(parts[0].entry.identity, Some(Identity { vendor: 0x3F, product: 7, revision: None }));
    let parts = recipe("[[program]]\nimage = 'a.cbs'\nrevision = 3\n", &folder).unwrap().parts;
    assert_eq!(parts[0].entry.identity.unwrap().revision, Some(3));
    // Block 0 has vendor 0 and product 1234 (expected.py), as the reference application has.
    fs::copy(data("identity-110.blk"), folder.join("d.blk")).unwrap();
    let parts = recipe("[[program]]\nimage = 'd.blk'\n", &folder).unwrap().parts;
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

/// By the command line: the package beside its recipe, its content, and the options that contradict it.
#[test]
fn the_command_makes_and_shows_a_package() {
    let folder = folder("recipe-command");
    fs::copy(data("plain-400.blk"), folder.join("b.blk")).unwrap();
    let recipe = folder.write("line.toml", b"[[program]]\nimage = 'b.blk'\nvendor = 1\nproduct = 2\n");
    let (recipe, package) = (recipe.to_str().unwrap(), folder.join("line.cpk"));
    let package = package.to_str().unwrap();
    let key = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    for role in ["root", "release"] {
        let file = key(&format!("{role}.pem"));
        assert_eq!(coflash(&["key", "new", "--role", role, "-o", &file]).exit, 0);
    }
    let (root, release, cert) = (key("root.pem"), key("release.pem"), key("release.cert"));
    let public = key("release.pub");
    let certify = ["key", "certify", "--root", &root, "--key", &public, "--epoch", "1", "--vendor", "1"];
    assert_eq!(coflash(&certify).exit, 0);
    let made = coflash(&["package", recipe, "--key", &release, "--cert", &cert]);
    assert_eq!(made.exit, 0, "{}", made.err);
    let shown = coflash(&["inspect", package, "--trust", &key("root.pub")]);
    assert_eq!(shown.exit, 0, "{}", shown.err);
    assert!(
        shown.out.contains("b: program 1 of 4001 bytes, for vendor 00000001h, product 00000002h"),
        "{}",
        shown.out
    );
    assert!(shown.out.contains("signed by key ") && !shown.out.contains("not checked"), "{}", shown.out);
    // With a second signer, whose root is not named.
    let (other, both) = (key("other.pem"), key("both.cpk"));
    assert_eq!(coflash(&["key", "new", "--role", "root", "-o", &other]).exit, 0);
    let keys = ["--key", &release, "--cert", &cert, "--key", &other];
    assert_eq!(coflash(&[&["package", recipe, "-o", &both][..], &keys].concat()).exit, 0);
    let shown = coflash(&["inspect", &both, "--trust", &key("root.pub")]);
    for words in ["signed by key ", "not checked: another root: key "] {
        assert_eq!(shown.out.matches(words).count(), 1, "{}", shown.out);
    }
    let said = coflash(&["flash", &both, "--trust", &key("root.pub"), "--bus", "slcan:no-such-port"]);
    assert!(said.out.contains("not checked: another root: key "), "{}{}", said.out, said.err);
    let open = key("open.cpk");
    assert_eq!(coflash(&["package", recipe, "-o", &open]).exit, 0);
    let said = coflash(&["flash", &open, "--bus", "slcan:no-such-port"]);
    assert!(said.out.contains("not signed"), "{}{}", said.out, said.err);
    let stranger = coflash(&["inspect", package, "--trust", &public]);
    assert_eq!(stranger.exit, 3);
    assert!(
        stranger.err.contains("is signed by a stranger") && stranger.err.contains("[0x60000408]"),
        "{}",
        stranger.err
    );
    // A root of the configuration is for packages, and any other file has nothing to do with it.
    let config = folder.write("coflash.toml", format!("trust = '{public}'\nnode = 5\n").as_bytes());
    let config = config.to_str().unwrap();
    // The same file by another path.
    fs::create_dir(folder.join("aside")).unwrap();
    let (aside, image) = (key("aside/../line.toml"), key("aside/../b.blk"));
    // Another file with the name of a package does not get past this root.
    let named = folder.join("x.CPK");
    fs::copy(data("plain-400.blk"), &named).unwrap();
    let named = named.to_str().unwrap();
    let job = folder.write("job.toml", b"image = 'a.blk'\nstart = false\n[[device]]\nnode = 5\n");
    let job = job.to_str().unwrap();
    for (words, exit, error) in [
        (&["flash", package, "--config", config][..], 3, "[0x60000408]"),
        (&["flash", &data("plain-400.blk"), "--config", config], 2, "no CAN bus is given"),
        (&["package", recipe, "--key", &root, "--cert", &cert], 2, "belongs to none of the keys"),
        (&["package", recipe, "-o", recipe], 2, "replace its recipe"),
        (&["package", recipe, "-o", &aside], 2, "replace its recipe"),
        (&["package", recipe, "-o", &image], 2, "replace an image of its recipe"),
        (
            &["package", recipe, "--key", &release, "--cert", &cert, "-o", &release],
            2,
            "is a key, which would be lost",
        ),
        (&["package", recipe, "-o", &root], 2, "is a key, which would be lost"),
        (&["convert", &data("plain-400.blk"), &root], 2, "is a key, which would be lost"),
        (&["inspect", package, "--log-file", &root], 2, "is a key, which would be lost"),
        (&["scan", "--bus", "slcan:no-such-port", "--trace", &root], 2, "is a key, which would be lost"),
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
        (&["ui", "--service", job], 3, "device 1: each program of a machine is started"),
    ] {
        let done = coflash(words);
        assert_eq!(done.exit, exit, "{words:?}: {}", done.err);
        assert!(done.err.contains(error), "{words:?}: {}", done.err);
    }
    // The bus of the manual's options, which is not there.
    let done = coflash(&["flash", package, "--vxd_type", "16", "--device_no", "99"]);
    let port = if cfg!(windows) { "COM99" } else { "ttyS98" };
    assert!(done.exit != 0 && done.err.contains(port), "{}", done.err);
}
