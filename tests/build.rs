//! Makes the files of the bootloader's products modules of `src/products.rs`, with a list of them, and says what the
//! board under test has: a test that needs more names it as a `cfg`.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::{env, fs};

use shared_abi::layout::{self, stm32f407g_disc1};

fn main() {
    println!("cargo:rerun-if-env-changed=COBOOT_BOARD");
    let board = layout::chosen(env::var("COBOOT_BOARD").ok().as_deref());
    for (name, has) in [
        // Room for images that are sealed, or with a log, the debugger or CAN over UART.
        ("split_map", board.home.is_some()),
        // A renewal of the bootloader.
        ("staging", board.staging.is_some()),
        // The chip of the boards with CAN2 and with two programs.
        ("reference_chip", board.chip == stm32f407g_disc1::LAYOUT.chip),
        // Pages, guides and the projects that they describe are for one board.
        ("reference_board", board.board == stm32f407g_disc1::LAYOUT.board),
    ] {
        println!("cargo:rustc-check-cfg=cfg({name})");
        if has {
            println!("cargo:rustc-cfg={name}");
        }
    }
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
