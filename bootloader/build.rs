//! Passes the numbers of the chosen board and the template of the image to the linker, and the file
//! of the product to the compiler. For the bootloader it first builds the resident part, which is a
//! separate program.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

use shared_abi::layout::toml::Toml;
use shared_abi::layout::{Image, Layout};

fn main() {
    let layout = coboot_linker::chosen_board().unwrap_or_else(|error| panic!("{error}"));
    let has = |feature: &str| env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    let template = if has("RESIDENT") { "resident.x" } else { "bootloader.x" };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    coboot_linker::write_memory(layout.linker_script(Image::Bootloader), &out)
        .unwrap_or_else(|error| panic!("{error}"));
    assert!(
        layout.home.is_some() || !has("SEALED"),
        "{} has the compact map, which has no key block: sealed images need a split one (docs/porting.md)",
        layout.board
    );
    // Both parts have it: the header of the RAM image, and the resident part that reads the header.
    let identity = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(Toml(layout).to_string().as_bytes());
    let text = format!("/// The identity of the board: see `shared_abi::ram_image::Header::board`.\npub const BOARD_IDENTITY: u32 = {identity:#010x};\n");
    fs::write(out.join("board_identity.rs"), text).expect("OUT_DIR is writable");

    let package = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it"));
    let templates = package.join("../linker");
    println!("cargo:rerun-if-changed={}", templates.display());
    println!("cargo:rustc-link-search={}", templates.display());
    let product = product(&package, &out);
    coboot_linker::link(&out, &[template]);
    // Functions with identical code are merged.
    println!("cargo:rustc-link-arg-bins=--icf=all");
    if template == "bootloader.x" && has("LOG_DEFMT") {
        // The linker script for the log strings of `defmt`: they are in the ELF file, not on the
        // chip.
        println!("cargo:rustc-link-arg-bins=-Tdefmt.x");
    }
    if env::var("CARGO_CFG_TARGET_OS").is_ok_and(|system| system != "none") {
        // The library alone, for the tests.
        return;
    }
    match template {
        "resident.x" => println!("cargo:rustc-link-arg-bins=--oformat=binary"),
        _ => resident(&package, &out, layout, &product),
    }
}

/// The product of a build that names none.
const DEFAULT_PRODUCT: &str = "default";

/// Makes the file of the product a module (`src/product.rs`), and the version text that names the
/// product. Returns the choice: the name of a file in `products/`, or the path of another file.
///
/// `cargo xtask build --product` makes the choice, as an argument of cargo. A variable of the shell
/// has no effect: `.cargo/config.toml` overrides it with the default.
fn product(package: &Path, out: &Path) -> String {
    println!("cargo:rerun-if-env-changed=COBOOT_PRODUCT");
    let chosen = env::var("COBOOT_PRODUCT").unwrap_or_else(|_| DEFAULT_PRODUCT.to_owned());
    let file = if chosen.ends_with(".rs") {
        PathBuf::from(&chosen)
    } else {
        package.join("products").join(format!("{chosen}.rs"))
    };
    assert!(
        file.is_absolute() && file.exists(),
        "there is no product \"{chosen}\": no file {}",
        file.display()
    );
    println!("cargo:rerun-if-changed={}", file.display());
    let name = file.file_stem().and_then(|name| name.to_str()).unwrap_or_default();
    // A product with an EEPROM has a store of its own (docs/eeprom.md).
    let has_store = fs::read_to_string(&file).is_ok_and(|text| text.contains("pub type Parameters ="));
    let store = if has_store { "chosen" } else { "in_flash" };
    let text = format!(
        "#[path = {file:?}]\nmod chosen;\npub use {store}::{{parameters, Parameters}};\n/// The name of this \
         product.\npub const NAME: &str = {name:?};\n"
    );
    fs::write(out.join("product.rs"), text).expect("OUT_DIR is writable");

    let version = format!("coboot {}", env::var("CARGO_PKG_VERSION").expect("cargo sets it"));
    if chosen == DEFAULT_PRODUCT {
        println!("cargo:rustc-env=COBOOT_VERSION={version}");
    } else {
        println!("cargo:rustc-env=COBOOT_VERSION={version} {name}");
        println!("cargo:warning=this is the product \"{name}\" ({})", file.display());
    }
    chosen
}

/// Builds the resident part with the features and the product of the bootloader, and writes its
/// bytes to `OUT_DIR/resident.bin`.
fn resident(package: &Path, out: &Path, layout: &Layout, product: &str) {
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
    cargo.current_dir(&workspace).args(["build", "--quiet", "--package=bootloader", "--bin=resident"]);
    cargo.args(["--profile=firmware", "--no-default-features", "--target", &triple, "--features"]);
    cargo.arg(features.join(",")).arg("--target-dir").arg(&target);
    cargo.arg("--config").arg(format!("env.COBOOT_PRODUCT.value={product:?}"));
    cargo.args(["--config", "env.COBOOT_PRODUCT.force=true"]);
    // The inner build keeps these settings; all others concern only the outer build.
    let own = ["CARGO_HOME", "CARGO_MAKEFLAGS", "CARGO_NET_OFFLINE"];
    let reported = env::vars_os().map(|(name, _)| name).filter(|name| {
        let name = name.to_string_lossy();
        name == "RUSTC_WORKSPACE_WRAPPER" || name.starts_with("CARGO") && !own.contains(&&*name)
    });
    for variable in reported {
        cargo.env_remove(variable);
    }
    let status = cargo.status().expect("cargo can be started");
    assert!(status.success(), "the resident part of the bootloader does not build");
    let built = target.join(&triple).join("firmware").join("resident");
    let bytes = fs::read(&built).expect("the resident part was built");
    fs::write(out.join("resident.bin"), bytes).expect("OUT_DIR is writable");
}
