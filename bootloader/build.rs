//! Passes the numbers of the chosen board and the template of the image to the linker. For the
//! bootloader it first builds the resident part, which is a separate program.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

include!("../linker/packs_well.rs");

use shared_abi::layout::{Image, Layout};

fn main() {
    let layout = coboot_linker::chosen_board().unwrap_or_else(|error| panic!("{error}"));
    let has = |feature: &str| env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    let template = if has("RESIDENT") { "resident.x" } else { "bootloader.x" };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    coboot_linker::write_memory(layout, Image::Bootloader, &out).unwrap_or_else(|error| panic!("{error}"));

    let package = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it"));
    let templates = package.join("../linker");
    println!("cargo:rerun-if-changed={}", templates.display());
    println!("cargo:rustc-link-search={}", templates.display());
    // The resident part belongs to the same product as the rest (bootloader/src/product.rs).
    println!("cargo:rerun-if-env-changed=COBOOT_PRODUCT");
    coboot_linker::link(&out, template);
    // Functions with identical code are merged.
    println!("cargo:rustc-link-arg-bins=--icf=all");
    // Similar functions are placed near each other, so that copies in the compressed image have
    // short distances. (The image is compressed; it also copies from the resident part.)
    println!("cargo:rustc-link-arg-bins=--bp-compression-sort=function");
    if template == "bootloader.x" && has("LOG_DEFMT") {
        // The linker script for the log strings of `defmt`: they are in the ELF file, not on the
        // chip.
        println!("cargo:rustc-link-arg-bins=-Tdefmt.x");
    }
    match template {
        "resident.x" => println!("cargo:rustc-link-arg-bins=--oformat=binary"),
        _ => resident(&package, &out, layout),
    }
}

/// Builds the resident part with the features of the bootloader, and writes its bytes to
/// `OUT_DIR/resident.bin`.
fn resident(package: &Path, out: &Path, layout: &Layout) {
    let workspace = package.join("..");
    for used in [
        "bootloader/src",
        "core/boot-core/src",
        "bsp/src",
        "core/canopen/src",
        "core/seal/src",
        "shared-abi/src",
        ".cargo",
    ] {
        println!("cargo:rerun-if-changed={}", workspace.join(used).display());
    }
    let features = env::vars().filter_map(|(name, _)| {
        let feature = name.strip_prefix("CARGO_FEATURE_")?.to_lowercase().replace('_', "-");
        (feature != "default").then_some(feature)
    });
    let features: Vec<String> =
        features.chain(["resident".to_owned(), format!("bsp/chip-{}", layout.chip.line.name())]).collect();
    // In the profile's folder of the outer build. The inner build has its own lock there.
    let target = out.ancestors().nth(3).expect("OUT_DIR lies deep in the target folder").join("resident");
    let triple = env::var("TARGET").expect("cargo sets it");

    let mut cargo = Command::new(env::var_os("CARGO").expect("cargo sets it"));
    cargo.current_dir(&workspace).args(["rustc", "--quiet", "--package=bootloader", "--bin=resident"]);
    cargo.args(["--profile=firmware", "--no-default-features", "--target", &triple, "--features"]);
    cargo.arg(features.join(",")).arg("--target-dir").arg(&target).args(["--", PACKS_WELL]);
    // The inner build keeps these settings; all others concern only the outer build.
    let own = ["CARGO_HOME", "CARGO_MAKEFLAGS", "CARGO_NET_OFFLINE"];
    let told = env::vars_os().map(|(name, _)| name).filter(|name| {
        let name = name.to_string_lossy();
        name == "RUSTC_WORKSPACE_WRAPPER" || name.starts_with("CARGO") && !own.contains(&&*name)
    });
    for variable in told {
        cargo.env_remove(variable);
    }
    let status = cargo.status().expect("cargo can be started");
    assert!(status.success(), "the resident part of the bootloader does not build");
    let built = target.join(&triple).join("firmware").join("resident");
    fs::copy(&built, out.join("resident.bin")).expect("the resident part was built");
}
