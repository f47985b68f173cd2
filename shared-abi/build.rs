//! Lists the boards: each file of `src/layout/boards` is one, `my_board.rs` the board `my-board`.

use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    let folder =
        Path::new(&env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("src/layout/boards");
    println!("cargo:rerun-if-changed={}", folder.display());
    let mut files: Vec<PathBuf> = fs::read_dir(&folder)
        .expect("src/layout/boards can be read")
        .map(|entry| entry.expect("src/layout/boards can be read").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "rs"))
        .collect();
    files.sort();
    let modules: Vec<&str> = files.iter().filter_map(|path| path.file_stem()?.to_str()).collect();
    let mut text = String::new();
    for (file, module) in files.iter().zip(&modules) {
        text += &format!("#[path = {file:?}]\npub mod {module};\n");
    }
    text += "/// Every board that coboot knows, for tools that take a board by name.\n";
    text += "pub const BOARDS: &[&Layout] = &[";
    for module in &modules {
        text += &format!("&{module}::LAYOUT, ");
    }
    text += "];\n";
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::write(out.join("boards.rs"), text).expect("OUT_DIR is writable");
}
