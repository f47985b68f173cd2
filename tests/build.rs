//! Makes the files of the bootloader's products modules of `src/products.rs`, with a list of them.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    let folder = Path::new(&env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it"))
        .join("../bootloader/products")
        .canonicalize()
        .expect("the bootloader has products");
    println!("cargo:rerun-if-changed={}", folder.display());
    let mut files: Vec<PathBuf> = fs::read_dir(folder)
        .expect("the bootloader has products")
        .map(|entry| entry.expect("it can be read").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "rs"))
        .collect();
    files.sort();
    let (mut modules, mut list) = (String::new(), String::new());
    for (number, path) in files.iter().enumerate() {
        let name = path.file_stem().and_then(|name| name.to_str()).expect("text");
        writeln!(modules, "#[path = {path:?}]\nmod product_{number};").expect("a string takes everything");
        write!(list, "({name:?}, product_{number}::PRODUCT), ").expect("a string takes everything");
    }
    let text = format!(
        "{modules}/// The products with their names.\npub const ALL: &[(&str, Product)] = &[{list}];\n"
    );
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::write(out.join("products.rs"), text).expect("OUT_DIR is writable");
}
