//! Hands the linker the numbers of the chosen board.

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
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let script = layout.linker_script(Image::Bootloader).to_string();
    fs::write(out.join("memory.x"), script).expect("OUT_DIR is writable");

    let templates = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("../linker");
    println!("cargo:rerun-if-changed={}", templates.display());
    println!("cargo:rustc-link-search={}", out.display());
    println!("cargo:rustc-link-search={}", templates.display());
    println!("cargo:rustc-link-arg-bins=-Tbootloader.x");
    println!("cargo:rustc-link-arg-bins=--nmagic");
}
