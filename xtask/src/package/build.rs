//! Builds the programs with cargo, so that the same sources give the same bytes in every folder.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

use super::notices;
use super::release::{Release, LINUX, VERSION};
use crate::{files, outcome::Outcome, process, setup, workspace};

/// Cargo's profile of the released programs.
pub const PROFILE: &str = "dist";

/// Builds `coflash` from the workspace at `root`.
pub fn program(root: &Path, target_dir: &Path, target: &str) -> Outcome<PathBuf> {
    setup::rust_target(target)?;
    let mut cargo = process::bare_cargo();
    cargo.args(["build", "--package", "coflash", "--profile", PROFILE, "--locked", "--target", target]);
    cargo.arg("--target-dir").arg(target_dir).arg("--manifest-path").arg(root.join("Cargo.toml"));
    if target == LINUX {
        // The C code in TLS uses no C library but for functions that musl has, too; so the compiler
        // of this system will do. What it would add for glibc alone is switched off.
        let name = LINUX.replace('-', "_");
        cargo.env(format!("CC_{name}"), "cc").env(format!("CFLAGS_{name}"), "-U_FORTIFY_SOURCE");
    }
    process::run(reproducible(&mut cargo, root))?;
    let extension = if target.contains("windows") { "exe" } else { "" };
    Ok(target_dir.join(target).join(PROFILE).join("coflash").with_extension(extension))
}

/// Builds the wheel for the Python of this system: the package, and the program for the command line.
pub fn wheel(release: &Release) -> Outcome {
    for old in files::within(&release.dist)?.iter().filter(|file| files::is(file, "whl")) {
        let _ = fs::remove_file(old);
    }
    let mut maturin = Command::new(setup::python());
    maturin.args(["-m", "maturin", "build", "--profile", PROFILE, "--locked", "--quiet", "--manifest-path"]);
    maturin.arg(workspace::root().join("coflash/python/Cargo.toml")).arg("--out").arg(&release.dist);
    maturin.arg("--target-dir").arg(&release.build).env("SOURCE_DATE_EPOCH", &release.epoch);
    process::run(reproducible(&mut maturin, workspace::root()))?;
    with_program(release, &release.wheel()?)
}

/// Puts the program for Linux into a wheel. It is built apart, since maturin takes either a library or
/// programs from a crate.
fn with_program(release: &Release, wheel: &Path) -> Outcome {
    let stage = release.empty("wheel")?;
    let tool = |words: &[&OsStr]| {
        let mut tool = Command::new(setup::python());
        tool.args(["-m", "wheel"]).args(words).env("SOURCE_DATE_EPOCH", &release.epoch);
        process::output(&mut tool)
    };
    tool(&["unpack".as_ref(), "--dest".as_ref(), stage.as_ref(), wheel.as_ref()])?;
    // PEP 427: what is in `NAME.data/scripts` goes to the programs of the environment.
    let name = format!("coflash-{}", VERSION);
    let folder = stage.join(&name);
    let program = program(workspace::root(), &release.build, LINUX)?;
    files::copy(&program, &folder.join(format!("{name}.data/scripts/coflash")))?;
    tool(&["pack".as_ref(), "--dest-dir".as_ref(), release.dist.as_ref(), folder.as_ref()])?;
    files::remove(&stage)
}

/// The program for Linux, and beside it the files for other folders of a system: `man`,
/// `completions`, `udev`, `THIRD-PARTY.txt`.
pub fn with_extras(release: &Release, folder: &Path) -> Outcome {
    let built = program(workspace::root(), &release.build, LINUX)?;
    let program = folder.join("coflash");
    files::copy(&built, &program)?;
    let man = folder.join("man");
    files::remove(&man)?;
    process::output(Command::new(&program).args(["more", "man", "--out"]).arg(&man))?;
    for (shell, file) in [("bash", "coflash.bash"), ("zsh", "_coflash"), ("fish", "coflash.fish")] {
        let script = process::output(Command::new(&program).args(["more", "completions", shell]))?;
        files::write(&folder.join("completions").join(file), script)?;
    }
    let rules = "70-coflash.rules";
    files::copy(
        &workspace::root().join("coflash/cli/packaging").join(rules),
        &folder.join("udev").join(rules),
    )?;
    files::write(&folder.join("THIRD-PARTY.txt"), notices::text()?)
}

/// Removes this machine's folders from the paths that the compiler writes into a program (the
/// locations of panics).
fn reproducible<'c>(command: &'c mut Command, root: &Path) -> &'c mut Command {
    let cargo_home = match env::var_os("CARGO_HOME") {
        Some(home) => PathBuf::from(home),
        None => Path::new(&env::var_os("HOME").unwrap_or_default()).join(".cargo"),
    };
    let flag = |folder: &Path, name| format!("--remap-path-prefix={}={name}", folder.display());
    let flags = [flag(root, "/coboot"), flag(&cargo_home, "/cargo")].join("\u{1f}");
    command.current_dir(root).env("CARGO_ENCODED_RUSTFLAGS", flags).env_remove("RUSTFLAGS")
}
