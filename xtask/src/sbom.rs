//! `cargo xtask sbom`: makes the software bills of materials for the released programs.
//!
//! cargo-cyclonedx makes them. It writes a file beside the manifest of every crate of the
//! workspace, and the file contains the time, a random number and this machine's folders. This job
//! takes the file of the requested package and removes those three, so that the same sources give
//! the same bytes. It checks that every crate is listed that cargo builds the program from.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{fs, iter};

use serde_json::{json, Value};
use sha2::{Digest, Sha512_256};
use shared_abi::layout::DEFAULT;

use crate::args::Args;
use crate::process::list;
use crate::{build, evidence, files, outcome::Outcome, process, setup, workspace};

pub const HELP: &str = "\
usage: cargo xtask sbom

Writes the software bills of materials of bootloader and host tool (CycloneDX 1.5, JSON) into
target/sbom, and prints each with its SHA-512/256: the hash that the manifest of a sealed image has
room for; the hashes go to target/evidence/sbom.json. The same sources give the same bytes. The host tool's one is that of all systems together.

The bootloader is that of the default board.
cargo-cyclonedx is installed into target/tools where it is missing, which takes some minutes once.
";

/// The version to install if there is none.
const VERSION: &str = "0.5.7";

/// The options of cargo for the target and the features of a bootloader on a line of chips.
fn bootloader(chip_feature: &str) -> [&str; 5] {
    ["--target", workspace::TARGET, "--no-default-features", "--features", chip_feature]
}

/// The crates that a package is built from with these options, according to cargo: itself and all its dependencies,
/// build dependencies too.
fn crates(package: &str, options: &[&str]) -> Outcome<BTreeSet<String>> {
    process::tree(&[&["--package", package, "--edges", "normal,build"], options].concat())
}

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    setup::rust_target(workspace::TARGET)?;
    evidence::begin("sbom")?;
    let cyclonedx = setup::tool("cargo-cyclonedx", VERSION, &[])?;
    let chip_feature = build::chip_feature(DEFAULT);
    let mut rows = Vec::new();
    for (package, name, options) in [
        ("bootloader", DEFAULT.board, &bootloader(&chip_feature)[..]),
        ("coflash", "all-systems", &["--target", "all"]),
    ] {
        let text = tidy(&generate(package, options, &cyclonedx)?, &workspace::root().display().to_string());
        let bill = process::json(&text)?;
        let missing = missing(&bill, &crates(package, options)?);
        if !missing.is_empty() {
            return Err(format!(
                "the bill of materials of {package} does not list {}, which cargo builds it from.",
                missing.join(", ")
            ));
        }
        let file = workspace::target_dir().join("sbom").join(format!("{package}-{name}.cdx.json"));
        files::write(&file, &text)?;
        let hash: String = Sha512_256::digest(&text).iter().map(|byte| format!("{byte:02x}")).collect();
        println!("{}\n  SHA-512/256 {hash}", workspace::shown(&file));
        let program = format!("{package}, {name}");
        let components = list(&bill, "components").count();
        rows.push(json!({"program": program, "components": components, "sha_512_256": hash}));
    }
    evidence::record("sbom", json!({"bills": rows.len(), "failed": 0, "of": rows}))
}

/// The output of cargo-cyclonedx for a package, with these options of cargo.
fn generate(package: &str, options: &[&str], cyclonedx: &Path) -> Outcome<String> {
    // The files are beside the manifests; the number keeps two runs apart.
    let name = format!("sbom-{}", std::process::id());
    let mut command = Command::new(cyclonedx);
    command.args(["cyclonedx", "--quiet", "--format", "json", "--spec-version", "1.5"]);
    command.args(["--override-filename", &name]).args(options);
    let metadata = process::metadata()?;
    let manifest = |package: &Value| Some(Path::new(package["manifest_path"].as_str()?).to_owned());
    let own = list(&metadata, "packages").find(|own| own["name"] == package);
    let own = own.and_then(manifest).ok_or_else(|| format!("there is no package {package}."))?;
    let made = process::run(command.arg("--manifest-path").arg(&own));
    let beside = |manifest: PathBuf| manifest.with_file_name(&name).with_extension("json");
    let text = files::text(&beside(own));
    for file in list(&metadata, "packages").filter_map(manifest).map(beside) {
        // A missing file needs no removal.
        let _ = fs::remove_file(&file);
    }
    made.and(text)
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

/// The crates that a bill of materials does not list.
fn missing(bill: &Value, crates: &BTreeSet<String>) -> Vec<String> {
    let of = |component: &Value| {
        Some(format!("{} {}", component["name"].as_str()?, component["version"].as_str()?))
    };
    let all = iter::once(&bill["metadata"]["component"]).chain(list(bill, "components"));
    let listed: BTreeSet<String> = all.filter_map(of).collect();
    crates.difference(&listed).cloned().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The output of cargo-cyclonedx 0.5.7, shortened.
    const MADE: &str = r#"{
  "bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1,
  "serialNumber": "urn:uuid:855bf0d1-408e-4889-8c6f-9b56e1ec443b",
  "metadata": {
    "timestamp": "2026-11-22T13:26:08.454115787Z",
    "component": {
      "type": "application", "name": "bootloader", "version": "0.1.0",
      "bom-ref": "path+file:///home/me/coboot/bootloader#0.1.0",
      "purl": "pkg:cargo/bootloader@0.1.0?download_url=file://."
    }
  },
  "components": [{
    "bom-ref": "registry+https://github.com/rust-lang/crates.io-index#crc@3.4.0",
    "type": "library", "name": "crc", "version": "3.4.0", "purl": "pkg:cargo/crc@3.4.0"
  }],
  "dependencies": [{
    "ref": "path+file:///home/me/coboot/bootloader#0.1.0",
    "dependsOn": ["registry+https://github.com/rust-lang/crates.io-index#crc@3.4.0"]
  }]
}"#;

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
    fn a_crate_that_is_not_listed_is_named() {
        let missing =
            |crates: [&str; 2]| missing(&process::json(MADE).unwrap(), &crates.map(str::to_owned).into());
        assert_eq!(missing(["bootloader 0.1.0", "crc 3.4.0"]), Vec::<String>::new());
        assert_eq!(missing(["bootloader 0.1.0", "crc 3.4.1"]), ["crc 3.4.1"]);
    }

    /// Cargo's data about our own bootloader: the crates that are linked into it and that build it,
    /// without those of its tests or the emulator.
    #[test]
    fn cargo_tells_what_the_bootloader_is_built_from() {
        let crates = crates("bootloader", &bootloader("bsp/chip-stm32f407")).unwrap();
        let has = |name: &&str| crates.iter().any(|krate| krate.split(' ').next() == Some(name));
        let linked = ["bootloader", "coboot-core", "coboot-canopen", "cortex-m-rt", "rtic", "bxcan", "syn"];
        assert!(linked.iter().all(has), "{crates:?}");
        assert!(!["unicorn-engine", "coflash", "proptest"].iter().any(has), "{crates:?}");
    }
}
