//! Packages for machines: the file, and the plan and run on a bus of fake devices.

mod format;
mod signed;
mod update;

use coflash_core::machine::zip::{self, Member};
use coflash_core::machine::{Fault, Package};

/// 883 bytes, for any device.
pub const BLOCKS: &[u8] = data!("plain-400.blk");
/// Its SHA-256 by coreutils' sha256sum.
pub const HASH: &str = "36d4bab73677e2f9f9111b51b6f85be7d763cc2c95751b48a245f611f74fcce5";

/// A program in a manifest, with further fields.
pub fn entry(name: &str, more: &str) -> String {
    let number = if more.contains("\"program\"") { "" } else { "\"program\": 1, " };
    format!(r#"{{"name": "{name}", "file": "{name}.blk", "size": 883, "sha256": "{HASH}", {number}{more}}}"#)
}

/// A manifest with these programs.
pub fn manifest(programs: &[String]) -> String {
    let programs = programs.join(", ");
    format!(r#"{{"format": "coboot machine package", "version": 1, "programs": [{programs}]}}"#)
}

/// A package with this manifest and these members.
pub fn package(manifest: &str, names: &[&str]) -> Vec<u8> {
    let mut members = vec![Member { name: "manifest.json", bytes: manifest.as_bytes() }];
    members.extend(names.iter().map(|name| Member { name, bytes: BLOCKS }));
    zip::write(&members)
}

/// The package of these programs.
pub fn packed(programs: &[(&str, &str)]) -> Vec<u8> {
    let entries: Vec<String> = programs.iter().map(|(name, more)| entry(name, more)).collect();
    let names: Vec<String> = programs.iter().map(|(name, _)| format!("{name}.blk")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    package(&manifest(&entries), &names)
}

#[track_caller]
pub fn refused(bytes: &[u8], number: u32, words: &str) {
    let fault: Fault = Package::parse(bytes).unwrap_err();
    assert!(fault.to_string().contains(words), "{fault}");
    assert_eq!(fault.number(), number, "{fault}");
    assert!(!fault.advice().is_empty());
}
