//! The Python package (`python/`): its wheel is built and installed as a user has it, and its own
//! tests are run against `coboot-node` over TCP.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// The python of `cargo xtask test`, with the pinned third-party packages.
fn python() -> Command {
    let python = env::var_os("COBOOT_PYTHON")
        .unwrap_or_else(|| panic!("COBOOT_PYTHON is not set: run the tests by `cargo xtask test`"));
    Command::new(python)
}

/// Runs a program to its end.
#[track_caller]
fn done(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let said =
        format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{command:?}:\n{said}");
    said
}

/// An empty folder.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

/// The one file in a folder.
fn only(folder: &Path) -> PathBuf {
    let files: Vec<_> = fs::read_dir(folder).unwrap().map(|file| file.unwrap().path()).collect();
    let [file] = files.as_slice() else { panic!("{files:?}") };
    file.clone()
}

#[test]
fn the_wheel_is_built_installed_and_passes_its_tests() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let package = root.join("python");
    let wheels = folder("python-wheels");
    let maturin = ["-m", "maturin", "build", "--profile", "dev", "--manifest-path"];
    done(python().args(maturin).arg(package.join("Cargo.toml")).arg("--out").arg(&wheels));
    let wheel = only(&wheels);
    // One for every Python from 3.9 on.
    let name = wheel.file_name().unwrap().to_string_lossy().into_owned();
    assert!(name.starts_with("coflash-") && name.contains("-cp39-abi3-"), "{name}");

    let installed = folder("python-package");
    let pip = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"];
    done(python().args(pip).arg(&installed).arg(&wheel));

    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let manifest = root.join("Cargo.toml");
    let build =
        ["build", "--quiet", "--package", "coboot-node", "--message-format", "json", "--manifest-path"];
    let said = done(Command::new(cargo).args(build).arg(manifest));
    let (_, node) = said.rsplit_once("\"executable\":\"").expect("cargo says where it is");
    let node = node.split('"').next().unwrap_or_default();

    let tests = ["-m", "pytest", "-q", "-p", "no:cacheprovider"];
    let said = done(
        python()
            .args(tests)
            .arg(package.join("tests"))
            .current_dir(&installed)
            .env("PYTHONPATH", &installed)
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .env("COBOOT_NODE", node),
    );
    assert!(said.contains(" passed") && !said.contains("skipped"), "{said}");
}
