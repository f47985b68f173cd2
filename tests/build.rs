//! Makes the files of the bootloader's products modules of `bootloader/src/product.rs`, which `src/lib.rs`
//! includes: the chosen one as `chosen`, as `bootloader/build.rs` does, and those of the repository.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    println!("cargo:rerun-if-env-changed=COBOOT_PRODUCT");
    // A feature of the bootloader.
    println!("cargo:rustc-check-cfg=cfg(feature, values(\"sealed\"))");
    let folder = Path::new(&env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it"))
        .join("../bootloader/products")
        .canonicalize()
        .expect("the bootloader has products");
    println!("cargo:rerun-if-changed={}", folder.display());
    let chosen = env::var("COBOOT_PRODUCT").unwrap_or_else(|_| "default".to_owned());
    let file = match chosen.ends_with(".rs") {
        true => PathBuf::from(&chosen),
        false => folder.join(format!("{chosen}.rs")),
    };
    println!("cargo:rerun-if-changed={}", file.display());
    let name = |file: &Path| file.file_stem().and_then(|name| name.to_str()).expect("text").to_owned();

    let mut files: Vec<PathBuf> = fs::read_dir(folder)
        .expect("the bootloader has products")
        .map(|entry| entry.expect("it can be read").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "rs"))
        .collect();
    files.sort();
    // The chosen one is in the folder, or is a file elsewhere.
    let mut modules = match files.iter().position(|path| *path == file) {
        Some(number) => format!("use product_{number} as chosen;\n"),
        None => format!("#[path = {file:?}]\nmod chosen;\n"),
    };
    let mut list = String::new();
    for (number, path) in files.iter().enumerate() {
        writeln!(modules, "#[path = {path:?}]\nmod product_{number};").expect("a string takes everything");
        write!(list, "({:?}, product_{number}::PRODUCT), ", name(path)).expect("a string takes everything");
    }
    let text = format!(
        "{modules}/// The name of the chosen product.\npub const CHOSEN: &str = {:?};\n\
         /// The products of the repository, with their names.\npub const ALL: &[(&str, Product)] = &[{list}];\n",
        name(&file)
    );
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::write(out.join("product.rs"), text).expect("OUT_DIR is writable");
    // What is made here from a product does not have it.
    let identity = "/// The identity of no board.\npub const BOARD_IDENTITY: u32 = 0;\n";
    fs::write(out.join("board_identity.rs"), identity).expect("OUT_DIR is writable");
}
