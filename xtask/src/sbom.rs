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

/// A released program.
struct Released {
    package: &'static str,
    /// The target, or `all`.
    target: &'static str,
    /// The arguments for cargo that choose its features.
    features: Vec<String>,
}

impl Released {
    fn bootloader(chip_feature: &str) -> Self {
        let features = ["--no-default-features", "--features", chip_feature].map(str::to_owned).into();
        Self { package: "bootloader", target: workspace::TARGET, features }
    }

    /// The crates that it is built from, according to cargo: itself and all its dependencies, build
    /// dependencies too.
    fn crates(&self) -> Outcome<BTreeSet<String>> {
        let words = ["--package", self.package, "--edges", "normal,build", "--target", self.target];
        process::tree(&words.into_iter().chain(self.features.iter().map(String::as_str)).collect::<Vec<_>>())
    }
}

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    setup::rust_target(workspace::TARGET)?;
    evidence::begin("sbom")?;
    let cyclonedx = setup::tool("cargo-cyclonedx", VERSION, &[])?;
    let all = [
        (DEFAULT.board, Released::bootloader(&build::chip_feature(DEFAULT))),
        ("all-systems", Released { package: "coflash", target: "all", features: Vec::new() }),
    ];
    let mut rows = Vec::new();
    for (name, released) in &all {
        let text = tidy(&generate(released, &cyclonedx)?, &workspace::root().display().to_string());
        let bill = process::json(&text)?;
        let missing = missing(&bill, &released.crates()?);
        if !missing.is_empty() {
            return Err(format!(
                "the bill of materials of {} does not list {}, which cargo builds it from.",
                released.package,
                missing.join(", ")
            ));
        }
        let file = workspace::target_dir().join("sbom").join(format!("{}-{name}.cdx.json", released.package));
        files::write(&file, &text)?;
        let hash: String = Sha512_256::digest(&text).iter().map(|byte| format!("{byte:02x}")).collect();
        println!("{}\n  SHA-512/256 {hash}", workspace::shown(&file));
        let program = format!("{}, {name}", released.package);
        let components = list(&bill, "components").count();
        rows.push(json!({"program": program, "components": components, "sha_512_256": hash}));
    }
    evidence::record("sbom", json!({"bills": rows.len(), "failed": 0, "of": rows}))
}

/// The output of cargo-cyclonedx for a package.
fn generate(released: &Released, cyclonedx: &Path) -> Outcome<String> {
    // The files are beside the manifests; the number keeps two runs apart.
    let name = format!("sbom-{}", std::process::id());
    let mut command = Command::new(cyclonedx);
    command.args(["cyclonedx", "--quiet", "--format", "json", "--spec-version", "1.5"]);
    command.args(["--override-filename", &name, "--target", released.target]).args(&released.features);
    let metadata = process::metadata()?;
    let manifest = |package: &Value| Some(Path::new(package["manifest_path"].as_str()?).to_owned());
    let own = list(&metadata, "packages").find(|package| package["name"] == released.package);
    let own = own.and_then(manifest).ok_or_else(|| format!("there is no package {}.", released.package))?;
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
        let crates = Released::bootloader("bsp/chip-stm32f407").crates().unwrap();
        let has = |name: &&str| crates.iter().any(|krate| krate.split(' ').next() == Some(name));
        let linked = ["bootloader", "coboot-core", "coboot-canopen", "cortex-m-rt", "rtic", "bxcan", "syn"];
        assert!(linked.iter().all(has), "{crates:?}");
        assert!(!["unicorn-engine", "coflash", "proptest"].iter().any(has), "{crates:?}");
    }
}
