//! The build script of every image: hands the linker the numbers of the chosen board and the image's template.

use std::path::PathBuf;
use std::{env, fs};

use shared_abi::layout::{Image, BOARDS};

fn main() {
    let layout = BOARDS
        .iter()
        .find(|layout| {
            let feature = layout.board.to_uppercase().replace('-', "_");
            env::var_os(format!("CARGO_FEATURE_BOARD_{feature}")).is_some()
        })
        .expect("choose a board by one of the features `board-…`");
    let (image, template) = match env::var("CARGO_PKG_NAME").as_deref() {
        Ok("bootloader") => (Image::Bootloader, "bootloader.x"),
        _ if env::var_os("CARGO_FEATURE_PROGRAM_2").is_some() => (Image::Program(2), "application.x"),
        _ => (Image::Program(1), "application.x"),
    };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    fs::write(out.join("memory.x"), layout.linker_script(image).to_string()).expect("OUT_DIR is writable");

    let templates =
        PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("../linker");
    println!("cargo:rerun-if-changed={}", templates.display());
    println!("cargo:rustc-link-search={}", out.display());
    println!("cargo:rustc-link-search={}", templates.display());
    println!("cargo:rustc-link-arg-bins=-T{template}");
    println!("cargo:rustc-link-arg-bins=--nmagic");
    // Functions that compile to the same code are one.
    println!("cargo:rustc-link-arg-bins=--icf=all");
}
