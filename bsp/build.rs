//! Selects the board: the variable `COBOOT_BOARD` names it, and its file is in `src/boards`.

use std::path::{Path, PathBuf};
use std::{env, fs};

use shared_abi::layout;

fn main() {
    println!("cargo:rerun-if-env-changed=COBOOT_BOARD");
    println!("cargo:rerun-if-changed=src/boards");
    let board = layout::chosen(env::var("COBOOT_BOARD").ok().as_deref());
    let module = board.board.replace('-', "_");
    let file = Path::new(&env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it"))
        .join("src/boards")
        .join(&module)
        .with_extension("rs");
    assert!(file.exists(), "the board {} needs the file {}", board.board, file.display());
    let text = format!(
        "#[path = {file:?}]\nmod board;\n\n/// The memory map of the board.\nconst BOARD: &Layout = \
         &shared_abi::layout::{module}::LAYOUT;\n"
    );
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::write(out.join("board.rs"), text).expect("OUT_DIR is writable");
}
