//! `cargo xtask sbom`: makes the software bills of materials for the released programs.
//!
//! cargo-cyclonedx makes them. It writes a file beside the manifest of every crate of the
//! workspace, and the file contains the time, a random number and this machine's folders. This job
//! takes the file of the requested package and removes those three, so that the same sources give
//! the same bytes. It checks the rest against the requirements of CycloneDX and against cargo.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::Command;
use std::{env, fs, process as std_process};

use sha2::{Digest, Sha512_256};

use crate::args::Args;
use crate::{build, evidence, process, setup, workspace, Outcome};
use serde_json::{json, Value};

pub const HELP: &str = "\
usage: cargo xtask sbom [--board BOARD]

Writes the software bills of materials of bootloader and host tool (CycloneDX 1.5, JSON) into
target/sbom, and prints each with its SHA-512/256: the hash that the manifest of a sealed image has
room for; the hashes go to target/evidence/sbom.json. The same sources give the same bytes. The host tool's one is that of all systems together.

  --board BOARD   the board of the bootloader (default: stm32f407g-disc1)

cargo-cyclonedx is installed into target/tools where it is missing, which takes some minutes once.
";

/// The version to install if there is none.
const VERSION: &str = "0.5.7";

/// A released program, and its arguments for cargo.
struct Released {
    package: &'static str,
    /// The target, or `all`.
    target: &'static str,
    features: Vec<String>,
}

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    args.none_left()?;
    setup::rust_target(workspace::TARGET)?;
    evidence::begin("sbom")?;
    let path = setup::tool("cargo-cyclonedx", VERSION)?;
    let folder = workspace::target_dir().join("sbom");
    fs::create_dir_all(&folder).map_err(|error| unwritable(&folder, &error))?;
    let chip_feature = build::chip_feature(board);
    let all = [
        Released {
            package: "bootloader",
            target: workspace::TARGET,
            features: ["--no-default-features", "--features", &chip_feature].map(str::to_owned).into(),
        },
        Released { package: "coflash", target: "all", features: Vec::new() },
    ];
    let mut rows = Vec::new();
    for released in &all {
        let text = tidy(&generate(released, &path)?, &workspace::root().display().to_string());
        let faults = faults(&process::json(&text)?, &closure(released)?);
        if !faults.is_empty() {
            return Err(format!(
                "the bill of materials of {} is not as it has to be:\n    {}",
                released.package,
                faults.join("\n    ")
            ));
        }
        let name = if released.target == "all" { "all-systems" } else { board.board };
        let file = folder.join(format!("{}-{name}.cdx.json", released.package));
        fs::write(&file, &text).map_err(|error| unwritable(&file, &error))?;
        let hash: String = Sha512_256::digest(&text).iter().map(|byte| format!("{byte:02x}")).collect();
        println!("{}\n  SHA-512/256 {hash}", workspace::shown(&file));
        let components = process::json(&text)?["components"].as_array().map_or(0, Vec::len);
        let program = format!("{}, {name}", released.package);
        rows.push(json!({"program": program, "components": components, "sha_512_256": hash}));
    }
    evidence::record("sbom", json!({"bills": rows.len(), "failed": 0, "of": rows}))
}

fn unwritable(path: &std::path::Path, error: &std::io::Error) -> String {
    format!("{} cannot be written: {error}.", workspace::shown(path))
}

/// The output of cargo-cyclonedx for a package.
fn generate(released: &Released, path: &std::ffi::OsStr) -> Outcome<String> {
    // The files are beside the manifests; the number keeps two runs apart.
    let name = format!("sbom-{}", std_process::id());
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.args(["cyclonedx", "--quiet", "--format", "json", "--spec-version", "1.5"]);
    command.args(["--override-filename", &name, "--target", released.target]).args(&released.features);
    command.arg("--manifest-path").arg(manifest(released)).env("PATH", path);
    let made = process::run(&mut command);
    let mut text = Err(format!("cargo-cyclonedx wrote nothing for {}.", released.package));
    for (package, folder) in members()? {
        let file = folder.join(&name).with_extension("json");
        if package == released.package {
            text = fs::read_to_string(&file)
                .map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(&file)));
        }
        // A missing file needs no removal.
        let _ = fs::remove_file(&file);
    }
    made.and(text)
}

fn manifest(released: &Released) -> PathBuf {
    workspace::root().join(released.package).join("Cargo.toml")
}

/// The crates of the workspace with their folders.
fn members() -> Outcome<Vec<(String, PathBuf)>> {
    let said = process::output(process::cargo("metadata").args(["--no-deps", "--format-version", "1"]))?;
    let member = |package: &Value| {
        let manifest = PathBuf::from(package["manifest_path"].as_str()?);
        Some((package["name"].as_str()?.to_owned(), manifest.parent()?.to_owned()))
    };
    Ok(process::json(&said)?["packages"].as_array().into_iter().flatten().filter_map(member).collect())
}

/// Removes all that differs between runs and machines from a bill of materials: the time, the
/// serial number (both are optional in CycloneDX 1.5) and the folder of the repository.
fn tidy(text: &str, root: &str) -> String {
    let varies = |line: &&str| {
        let line = line.trim_start();
        line.starts_with("\"serialNumber\": ") || line.starts_with("\"timestamp\": ")
    };
    let lines: Vec<&str> = text.lines().filter(|line| !varies(line)).collect();
    lines.join("\n").replace(&format!("file://{root}/"), "file:///coboot/") + "\n"
}

/// Name and version.
type Crate = (String, String);

/// The crates that a package is built from, according to cargo: itself and all its dependencies,
/// build dependencies too.
fn closure(released: &Released) -> Outcome<BTreeSet<Crate>> {
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.args(["tree", "--locked", "--prefix", "none", "--edges", "normal,build", "--no-dedupe"]);
    command.args(["--format", "{p}", "--target", released.target]).args(&released.features);
    command.arg("--manifest-path").arg(manifest(released));
    Ok(crates(&process::output(&mut command)?))
}

/// The crates in the output of `cargo tree` with the format `{p}`: `name v1.2.3`, and more.
fn crates(tree: &str) -> BTreeSet<Crate> {
    let line = |line: &str| {
        let mut words = line.split(' ');
        Some((words.next()?.to_owned(), words.next()?.strip_prefix('v')?.to_owned()))
    };
    tree.lines().filter_map(line).collect()
}

/// The faults of a bill of materials: broken requirements of CycloneDX 1.5, and missing crates.
fn faults(sbom: &Value, crates: &BTreeSet<Crate>) -> Vec<String> {
    let mut faults = Vec::new();
    for (name, wanted) in [("bomFormat", "CycloneDX"), ("specVersion", "1.5")] {
        if sbom[name].as_str() != Some(wanted) {
            faults.push(format!("{name} is not \"{wanted}\""));
        }
    }
    let main = &sbom["metadata"]["component"];
    let mut listed = BTreeSet::new();
    let mut refs = BTreeMap::new();
    for component in [main].into_iter().chain(sbom["components"].as_array().into_iter().flatten()) {
        let text = |name: &str| component[name].as_str().unwrap_or_default().to_owned();
        let (name, version) = (text("name"), text("version"));
        // `version` is optional there, but a bill without it is of no use.
        for needed in ["type", "name", "version", "bom-ref", "purl"] {
            if text(needed).is_empty() {
                faults.push(format!("the component \"{name}\" has no {needed}"));
            }
        }
        *refs.entry(text("bom-ref")).or_insert(0) += 1;
        listed.insert((name, version));
    }
    faults.extend(
        refs.iter().filter(|(_, count)| **count > 1).map(|(name, _)| format!("{name} is there twice")),
    );
    for dependency in sbom["dependencies"].as_array().into_iter().flatten() {
        let all =
            [&dependency["ref"]].into_iter().chain(dependency["dependsOn"].as_array().into_iter().flatten());
        let unknown = all.filter_map(Value::as_str).filter(|name| !refs.contains_key(*name));
        faults.extend(unknown.map(|name| format!("a dependency on {name}, which is not listed")));
    }
    let missing = crates.difference(&listed);
    faults.extend(missing.map(|(name, version)| format!("{name} {version} is not listed")));
    faults
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The output of cargo-cyclonedx 0.5.7, shortened.
    const MADE: &str = r#"{
  "bomFormat": "CycloneDX",
  "specVersion": "1.5",
  "version": 1,
  "serialNumber": "urn:uuid:855bf0d1-408e-4889-8c6f-9b56e1ec443b",
  "metadata": {
    "timestamp": "2026-11-22T13:26:08.454115787Z",
    "component": {
      "type": "application",
      "bom-ref": "path+file:///home/me/coboot/bootloader#0.1.0",
      "name": "bootloader",
      "version": "0.1.0",
      "purl": "pkg:cargo/bootloader@0.1.0?download_url=file://."
    }
  },
  "components": [
    {
      "type": "library",
      "bom-ref": "registry+https://github.com/rust-lang/crates.io-index#crc@3.4.0",
      "name": "crc",
      "version": "3.4.0",
      "purl": "pkg:cargo/crc@3.4.0"
    }
  ],
  "dependencies": [
    {
      "ref": "path+file:///home/me/coboot/bootloader#0.1.0",
      "dependsOn": ["registry+https://github.com/rust-lang/crates.io-index#crc@3.4.0"]
    }
  ]
}"#;

    /// The output of `cargo tree`.
    const TREE: &str = "bootloader v0.1.0 (/home/me/coboot/bootloader)\ncrc v3.4.0\ncrc v3.4.0\n\n";

    fn faults_of(text: &str, tree: &str) -> Vec<String> {
        faults(&process::json(&tidy(text, "/home/me/coboot")).unwrap(), &crates(tree))
    }

    #[test]
    fn time_serial_number_and_folder_are_taken_out_and_nothing_else() {
        let tidied = tidy(MADE, "/home/me/coboot");
        assert!(!tidied.contains("uuid") && !tidied.contains("2026") && !tidied.contains("/home/me"));
        assert!(tidied.contains("\"path+file:///coboot/bootloader#0.1.0\""));
        assert_eq!(tidied.lines().count(), MADE.lines().count() - 2);
        let other = MADE.replace("/home/me/coboot", "/src").replace("855bf0d1", "00000000");
        assert_eq!(tidy(&other, "/src"), tidied);
    }

    #[test]
    fn a_whole_one_has_no_faults() {
        assert_eq!(faults_of(MADE, TREE), Vec::<String>::new());
    }

    #[test]
    fn what_is_missing_is_named() {
        for (text, tree, fault) in [
            (MADE.replace("\"1.5\"", "\"1.4\""), TREE, "specVersion is not \"1.5\""),
            (MADE.replace("\"CycloneDX\"", "1"), TREE, "bomFormat is not \"CycloneDX\""),
            (MADE.replace("\"type\": \"library\"", "\"kind\": \"library\""), TREE, "has no type"),
            (MADE.replace("\"purl\": \"pkg:cargo/crc@3.4.0\"", "\"x\": 0"), TREE, "\"crc\" has no purl"),
            (MADE.replacen("crc@3.4.0\"", "crc@3.4.1\"", 1), TREE, "which is not listed"),
            (MADE.to_owned(), "crc v3.4.1", "crc 3.4.1 is not listed"),
            (MADE.to_owned(), "heapless v0.9.3 (proc-macro)", "heapless 0.9.3 is not listed"),
        ] {
            let faults = faults_of(&text, tree);
            assert!(faults.iter().any(|told| told.contains(fault)), "{fault}: {faults:?}");
        }
        let twice = MADE.replace("registry+https://github.com/rust-lang/crates.io-index#crc@3.4.0", "x");
        let twice = twice.replace("path+file:///home/me/coboot/bootloader#0.1.0", "x");
        assert_eq!(faults_of(&twice, TREE), ["x is there twice"]);
    }

    /// Cargo's data about our own bootloader: the crates that are linked into it and that build it,
    /// without those of its tests or the emulator.
    #[test]
    fn cargo_tells_what_the_bootloader_is_built_from() {
        let features = ["--no-default-features", "--features", "bsp/chip-stm32f407"];
        let released = Released {
            package: "bootloader",
            target: workspace::TARGET,
            features: features.map(str::to_owned).into(),
        };
        let names: BTreeSet<String> = closure(&released).unwrap().into_iter().map(|(name, _)| name).collect();
        for name in ["bootloader", "coboot-core", "coboot-canopen", "cortex-m-rt", "rtic", "bxcan", "syn"] {
            assert!(names.contains(name), "{name}: {names:?}");
        }
        for name in ["unicorn-engine", "coflash", "proptest"] {
            assert!(!names.contains(name), "{name}");
        }
    }
}
