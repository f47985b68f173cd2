//! Installs what the jobs need on a machine, if it is missing and may be installed.
//!
//! A new Debian 12 or Ubuntu 24.04 with rustup, git and a C compiler is enough. If nothing is
//! missing, this takes a fraction of a second.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::{env, fs};

use crate::args::Args;
use crate::workspace::TARGET;
use crate::{files, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask setup

Brings the machine to where every other job runs: by rustup the Rust target thumbv7em-none-eabihf, rustfmt and
clippy; by apt-get what builds the emulator's CPU (cmake, make, pkg-config, libclang), compilers for the chip
(clang, gcc-arm-none-eabi), gdb-multiarch, chromium and python3 with venv; and a Python environment in
target/python with tests/python/requirements.txt.

The other jobs do this themselves, each for what it needs. As root it installs what is missing; for
anyone else it stops with the line to run, or, with --yes, runs that line.
";

/// A part of the product with needs on the machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Code for the chip: the Rust target.
    Firmware,
    /// The application in C: a compiler for the chip, and CMake.
    C,
    /// The fuzzer: a compiler for C++.
    Cpp,
    /// The examples in C and C++: two compilers for the chip, and CMake.
    Examples,
    /// The emulator: cmake builds Unicorn from C, libclang makes its bindings, and clang assembles the
    /// programs of its tests.
    Emulator,
    /// The third-party CANopen client: a Python environment.
    Python,
    /// The debugger that loads the images in a test.
    Gdb,
    /// The browser that the tests of `coflash ui` drive.
    Browser,
    /// Another emulated CPU to compare ours with.
    Qemu,
    /// The package for Debian.
    Deb,
    /// The program for Windows: a linker for it.
    Windows,
}

/// Whether packages may be installed with sudo.
static MAY_USE_SUDO: AtomicBool = AtomicBool::new(false);

/// Allows it to install packages with sudo.
pub fn may_use_sudo() {
    MAY_USE_SUDO.store(true, Ordering::Relaxed);
}

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    use Part::{Browser, Emulator, Examples, Firmware, Gdb, Python, C};
    prepare(&[Firmware, C, Examples, Emulator, Python, Gdb, Browser])?;
    println!("Everything is there.");
    Ok(())
}

/// Installs what these parts need and is missing. Where that may not be done, the message has the
/// line to run.
pub fn prepare(parts: &[Part]) -> Outcome {
    install(parts)?;
    if parts.contains(&Part::Emulator) {
        renew_cmake(&workspace::target_dir());
    }
    if parts.contains(&Part::Firmware) {
        rust_target(TARGET)?;
    }
    if parts.contains(&Part::Python) {
        python_environment()?;
    }
    Ok(())
}

/// Installs Debian's packages.
fn install(parts: &[Part]) -> Outcome {
    let missing = missing_packages(parts, is_there);
    if missing.is_empty() {
        return Ok(());
    }
    let by_hand = format!(
        "sudo apt-get update && sudo apt-get install -y --no-install-recommends {}",
        missing.join(" ")
    );
    if !process::succeeds("apt-get", &["--version"]) {
        return Err(format!(
            "these are missing, by the names of Debian's packages: {}. There is no apt-get here to install \
             them with; do it with this system's package manager and try again.",
            missing.join(", ")
        ));
    }
    let root = process::output(Command::new("id").arg("-u")).is_ok_and(|id| id.trim() == "0");
    if !root && !MAY_USE_SUDO.load(Ordering::Relaxed) {
        return Err(format!(
            "some packages are missing. Run this line and try again:\n\n    {by_hand}\n\n\
             (or add --yes, and it is run for you.)"
        ));
    }
    eprintln!("Installing {} ...", missing.join(", "));
    let apt_get = |words: &[&str]| {
        let mut command = Command::new(if root { "env" } else { "sudo" });
        command.args((!root).then_some("env")).args(["DEBIAN_FRONTEND=noninteractive", "apt-get"]);
        process::run(command.args(["-qq", "-o", "DPkg::Lock::Timeout=300"]).args(words))
    };
    // A new machine has no package lists. If one of several sources cannot be reached, the
    // install may still work; if not, it reports that.
    let _ = apt_get(&["update"]);
    let install = ["install", "-y", "--no-install-recommends"];
    apt_get(&[&install[..], &missing[..]].concat())
        .map_err(|problem| format!("{problem} By hand it is:\n\n    {by_hand}"))?;
    let still = missing_packages(parts, is_there);
    if still.is_empty() {
        return Ok(());
    }
    Err(format!(
        "{} installed well, and still nothing is found of it; is another cmake, clang or python3 in front of the \
         system's in PATH?",
        still.join(", ")
    ))
}

/// Whether what a package of Debian and Ubuntu brings is there.
fn is_there(package: &str) -> bool {
    let works = |program: &str| process::succeeds(program, &["--version"]);
    match package {
        "build-essential" => {
            process::succeeds(env::var_os("CC").unwrap_or_else(|| "cc".into()), &["--version"])
        }
        // cmake works with either.
        "make" => works("make") || works("ninja"),
        "libclang-dev" => libclang_is_there(),
        // clang without the target for Arm is of no use here.
        "clang" => {
            let arm = ["--target=thumbv7em-none-eabi", "-E", "-x", "c", "/dev/null"];
            process::succeeds(process::clang().get_program(), &arm)
        }
        // C and C++ without their libraries, which are ten times as large: the examples do not need
        // them.
        "gcc-arm-none-eabi" => works("arm-none-eabi-g++"),
        // Debian's python3 does not contain ensurepip.
        "python3-venv" => process::succeeds("python3", &["-c", "import venv, ensurepip"]),
        // The tests look for it in the same places.
        "chromium" => match env::var_os("COBOOT_CHROMIUM") {
            Some(chromium) => process::succeeds(chromium, &["--version"]),
            None => works("chromium") || works("chromium-browser"),
        },
        "dpkg" => works("dpkg-deb"),
        "gcc-mingw-w64-x86-64" => works("x86_64-w64-mingw32-gcc"),
        program => works(program),
    }
}

impl Part {
    /// What it needs, by the names of Debian's packages.
    fn packages(self) -> &'static [&'static str] {
        match self {
            // Without pkg-config the configure script inside Unicorn stops, and the build then lacks a
            // header.
            Self::Emulator => &["build-essential", "make", "cmake", "pkg-config", "libclang-dev", "clang"],
            Self::C => &["clang", "cmake", "make"],
            Self::Cpp => &["g++"],
            Self::Examples => &["gcc-arm-none-eabi", "clang", "make", "cmake"],
            Self::Gdb => &["gdb-multiarch"],
            Self::Browser => &["chromium"],
            Self::Deb => &["dpkg"],
            Self::Windows => &["gcc-mingw-w64-x86-64"],
            Self::Qemu => &["qemu-system-arm"],
            Self::Python if !python_environment_is_there() => &["python3", "python3-venv"],
            Self::Python | Self::Firmware => &[],
        }
    }
}

/// The missing packages for these parts, each once.
fn missing_packages(parts: &[Part], is_there: impl Fn(&str) -> bool) -> Vec<&'static str> {
    let needed: BTreeSet<_> = parts.iter().flat_map(|part| part.packages()).copied().collect();
    needed.into_iter().filter(|package| !is_there(package)).collect()
}

/// Whether libclang with the compiler's own headers is in a folder in which the bindings' generator
/// (clang-sys) looks.
fn libclang_is_there() -> bool {
    if env::var_os("LIBCLANG_PATH").is_some() {
        // The user has set the path; the build reports it if it is wrong.
        return true;
    }
    // For example `libclang-14.so.14`; libclang-cpp is another library.
    exists("{/usr/lib/llvm-*/lib,/usr/lib/*-linux-gnu,/usr/lib64,/usr/lib,/usr/local/lib}/libclang{.so,.so.*,-1*,-2*}")
        && exists("{/usr/lib/llvm-*/lib,/usr/lib,/usr/lib64,/usr/local/lib}/clang/*/include/stdbool.h")
}

/// Whether a path of this pattern of the shell exists.
fn exists(pattern: &str) -> bool {
    process::succeeds("bash", &["-c", &format!("ls -d {pattern} | grep -q .")])
}

/// Removes what CMake has noted about Unicorn in another folder: after `target/` was copied or moved,
/// as the caches of CI do, CMake would refuse to go on. What is built already stays.
fn renew_cmake(target: &Path) {
    for profile in ["debug", "release"] {
        for package in fs::read_dir(target.join(profile).join("build")).into_iter().flatten().flatten() {
            let notes = package.path().join("out/build");
            let cache = fs::read_to_string(notes.join("CMakeCache.txt")).unwrap_or_default();
            let of = cache.lines().find_map(|line| line.strip_prefix("CMAKE_CACHEFILE_DIR:INTERNAL="));
            let is_here = |of: &str| fs::canonicalize(of).ok() == fs::canonicalize(&notes).ok();
            if of.is_some_and(|of| !is_here(of)) {
                // If it cannot be removed, CMake says why.
                let _ = fs::remove_dir_all(&notes);
            }
        }
    }
}

/// Installs the libraries of a Rust target if they are missing.
pub fn rust_target(target: &str) -> Outcome {
    let added = process::output(Command::new("rustup").args(["target", "add", target]));
    added.map(drop).map_err(|problem| {
        format!(
            "{problem}\nThe Rust target {target} needs rustup (https://rustup.rs), and a connection, once."
        )
    })
}

/// Provides a program that cargo installs, in exactly this version, in `target/tools`; returns its
/// path. `options` are for `cargo install`.
pub fn tool(name: &str, version: &str, options: &[&str]) -> Outcome<PathBuf> {
    let tools = workspace::target_dir().join("tools");
    let program = tools.join("bin").join(name);
    if !program.exists() {
        eprintln!("Installing {name} {version} into {} ...", workspace::shown(&tools));
    }
    // cargo does nothing where this version is there.
    let mut install = process::bare_cargo();
    install.args(["install", "--quiet", "--locked", name, "--version", &format!("={version}")]).args(options);
    install.arg("--root").arg(&tools).env("CARGO_TARGET_DIR", tools.join("build"));
    // It runs for seconds and compiles for minutes: an optimised one takes twice as long in all.
    install.envs([
        ("CARGO_PROFILE_RELEASE_OPT_LEVEL", "0"),
        ("CARGO_PROFILE_RELEASE_LTO", "off"),
        ("CARGO_PROFILE_RELEASE_CODEGEN_UNITS", "64"),
    ]);
    process::run(&mut install)
        .map_err(|problem| format!("{problem} It needs a connection to crates.io, once."))?;
    // The build files are large and not needed again.
    files::remove(&tools.join("build"))?;
    Ok(program)
}

/// The interpreter of the Python environment.
pub fn python() -> PathBuf {
    workspace::target_dir().join("python/bin/python")
}

fn requirements() -> PathBuf {
    workspace::root().join("tests/python/requirements.txt")
}

/// The file that records the environment, written last.
fn stamp() -> PathBuf {
    workspace::target_dir().join("python/requirements.installed")
}

/// What it records: the environment's folder, which its programs name, and the requirements.
fn record() -> Outcome<String> {
    Ok(format!("{}\n{}", python().display(), files::text(&requirements())?))
}

fn python_environment_is_there() -> bool {
    let wanted = record().ok();
    wanted.is_some()
        && fs::read_to_string(stamp()).ok() == wanted
        && process::succeeds(python(), &["--version"])
}

fn python_environment() -> Outcome {
    if python_environment_is_there() {
        return Ok(());
    }
    let _alone = files::lock("python", "Another job makes the Python environment of this clone.")?;
    if python_environment_is_there() {
        return Ok(());
    }
    let home = workspace::target_dir().join("python");
    eprintln!("Making a Python environment in {} ...", workspace::shown(&home));
    process::run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&home))?;
    process::run(
        Command::new(python())
            .args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input", "-r"])
            .arg(requirements()),
    )
    .map_err(|problem| format!("{problem} It needs a connection to the Python package index, once."))?;
    files::write(&stamp(), record()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_a_part_needs_and_is_missing_is_installed_and_once() {
        let nothing = |_: &str| false;
        assert_eq!(missing_packages(&[Part::Firmware], nothing), Vec::<&str>::new());
        assert_eq!(
            missing_packages(&[Part::Emulator, Part::Emulator], nothing),
            ["build-essential", "clang", "cmake", "libclang-dev", "make", "pkg-config"]
        );
        assert_eq!(
            missing_packages(&[Part::Emulator], |package| !["cmake", "libclang-dev"].contains(&package)),
            ["cmake", "libclang-dev"]
        );
        assert_eq!(missing_packages(&[Part::C], nothing), ["clang", "cmake", "make"]);
        assert_eq!(
            missing_packages(&[Part::Examples, Part::C], nothing),
            ["clang", "cmake", "gcc-arm-none-eabi", "make"]
        );
        assert_eq!(missing_packages(&[Part::Browser], nothing), ["chromium"]);
        assert_eq!(missing_packages(&[Part::Windows, Part::Deb], nothing), ["dpkg", "gcc-mingw-w64-x86-64"]);
        assert!(missing_packages(&[Part::C, Part::Emulator, Part::Python], |_: &str| true).is_empty());
    }

    /// The line is CMake's.
    #[test]
    fn what_cmake_noted_in_another_folder_is_removed_and_nothing_else() {
        let target = kit::folder::Folder::below(std::env::temp_dir(), "coboot-cmake");
        let notes = |package: &str| target.join("debug/build").join(package).join("out/build");
        for (package, of) in [("here", notes("here")), ("moved", "/another/clone/out/build".into())] {
            fs::create_dir_all(notes(package)).unwrap();
            let line = format!("# a comment\nCMAKE_CACHEFILE_DIR:INTERNAL={}\n", of.display());
            fs::write(notes(package).join("CMakeCache.txt"), line).unwrap();
            fs::write(notes(package).with_file_name("library"), "").unwrap();
        }
        renew_cmake(&target);
        assert!(notes("here").exists() && !notes("moved").exists());
        assert!(notes("moved").with_file_name("library").exists());
    }

    /// Only exact versions, so that every machine runs the same client.
    #[test]
    fn every_python_requirement_is_pinned() {
        let text = fs::read_to_string(requirements()).unwrap();
        let lines: Vec<_> =
            text.lines().filter(|line| !line.starts_with('#') && !line.trim().is_empty()).collect();
        assert!(lines.iter().any(|line| line.starts_with("canopen==")));
        for line in lines {
            let (name, version) = line.split_once("==").unwrap_or_else(|| panic!("{line} is not pinned"));
            assert!(!name.is_empty() && version.starts_with(|c: char| c.is_ascii_digit()), "{line}");
            assert!(!version.contains('*'), "{line}");
        }
    }
}
