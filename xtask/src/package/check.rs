//! Checks each package as a user gets it: installed into an empty root, and run.

use std::fs;
use std::path::Path;
use std::process::Command;

use super::build;
use super::release::{Release, IMAGES, LINUX, SUMS, VERSION};
use crate::{elf, files, outcome::Outcome, process, ram_image, setup, workspace};

/// Checks the sums, with the program that users have for it.
pub fn sums(dist: &Path) -> Outcome {
    process::run(Command::new("sha256sum").args(["--check", "--strict", "--quiet", SUMS]).current_dir(dist))
}

/// The sources build without a connection, and give the same program as the repository.
pub fn source(release: &Release, root: &Path) -> Outcome {
    files::unpack(&release.source(), root)?;
    let sources = root.join(format!("coboot-{VERSION}"));
    let theirs = build::program(&sources, &root.join("target"), LINUX)?;
    let ours = build::program(workspace::root(), &release.build, LINUX)?;
    let (theirs, ours) = (files::bytes(&theirs)?, files::bytes(&ours)?);
    if release.draft && theirs != ours {
        println!(
            "The program of the source archive differs; a draft may have other sources than its commit."
        );
    } else if theirs != ours {
        return Err(format!(
            "the source archive gives another program ({} bytes) than the repository ({} bytes): something of this \
             machine or of the folder is in it.",
            theirs.len(),
            ours.len()
        ));
    }
    Ok(())
}

pub fn linux(release: &Release, root: &Path) -> Outcome {
    files::unpack(&release.linux(), root)?;
    let folder = root.join(format!("coflash-{VERSION}"));
    let files = ["LICENSE-MIT", "LICENSE-APACHE", "README.md", "THIRD-PARTY.txt", "udev/70-coflash.rules"];
    if let Some(file) = files.into_iter().find(|file| !folder.join(file).is_file()) {
        return Err(format!("the archive has no {file}."));
    }
    works(&folder, "coflash")
}

/// Each image loads into the flash; that of the bootloader has its CRC.
pub fn firmware(release: &Release, root: &Path) -> Outcome {
    files::unpack(&release.firmware(), root)?;
    let folder = root.join(shared_abi::layout::DEFAULT.board);
    for image in IMAGES {
        let file = files::bytes(&folder.join(format!("{image}.elf")))?;
        let problem = match elf::segments(&file)?.is_empty() {
            true => "loads nothing",
            false if image.starts_with("bootloader") && ram_image::crc(&file)? == 0 => "has no CRC",
            false => continue,
        };
        return Err(format!("{image}.elf {problem}."));
    }
    Ok(())
}

pub fn debian(release: &Release, root: &Path) -> Outcome {
    let base = root.join("var/lib/dpkg");
    for folder in ["info", "updates", "triggers"] {
        files::make(&base.join(folder))?;
    }
    files::write(&base.join("status"), "")?;
    let dpkg = |words: &[&str]| {
        let mut dpkg = Command::new("dpkg");
        dpkg.arg(format!("--root={}", root.display()))
            .args(["--force-not-root", "--log=/dev/null"])
            .args(words);
        dpkg
    };
    process::run(dpkg(&["--install"]).arg(release.deb()))?;
    let faults = process::output(&mut dpkg(&["--verify", "coflash"]))?;
    if !faults.is_empty() {
        return Err(format!("dpkg finds other files than the package says:\n{faults}"));
    }
    works(root, "usr/bin/coflash")?;
    process::run(
        Command::new("bash").arg("-n").arg(root.join("usr/share/bash-completion/completions/coflash")),
    )?;
    let pages = files::within(&root.join("usr/share/man/man1"))?;
    process::run(Command::new("gzip").arg("--test").args(&pages))?;
    // The page of the program, and one for each of its commands.
    let names: Vec<_> = pages.iter().filter_map(|page| page.file_name()?.to_str()).collect();
    for name in ["coflash.1.gz", "coflash-flash.1.gz", "coflash-convert.1.gz"] {
        if !names.contains(&name) {
            return Err(format!("the package has no {name}; it has {}.", names.join(", ")));
        }
    }
    process::run(&mut dpkg(&["--purge", "coflash"]))?;
    let left: Vec<_> = files::below(root, &[])?.into_iter().filter(|file| !file.starts_with(&base)).collect();
    if let Some(file) = left.first() {
        return Err(format!("{} is left over when the package is removed.", file.display()));
    }
    if process::succeeds("lintian", &["--version"]) {
        process::run(
            Command::new("lintian").args(["--fail-on", "error", "--no-tag-display-limit"]).arg(release.deb()),
        )?;
    }
    Ok(())
}

/// The wheel updates a node, in an environment of its own, and has the program.
pub fn wheel(release: &Release, root: &Path) -> Outcome {
    process::run(Command::new("python3").args(["-m", "venv"]).arg(root.join("venv")))?;
    let python = root.join("venv/bin/python");
    // By its name, as from the registry.
    let pip =
        ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index", "--find-links"];
    process::run(Command::new(&python).args(pip).arg(&release.dist).arg("coflash"))?;
    let output = process::output(Command::new(root.join("venv/bin/coflash")).arg("--version"))?;
    must_contain(&output, VERSION, "coflash --version")?;
    process::run(&mut process::cargo("build --quiet --package coboot-node"))?;
    let node = workspace::target_dir().join("debug/coboot-node");
    files::write(&root.join("program.bin"), sample())?;
    let mut flash = Command::new(&python);
    flash.args(["-I", "-c", UPDATE]).arg(node).current_dir(root);
    must_contain(&process::output(&mut flash)?, &sample().len().to_string(), "coflash.flash")
}

/// Starts a node on a bus of its own, and updates it.
const UPDATE: &str = "
import subprocess, sys, coflash
node = [sys.argv[1], '--listen', '127.0.0.1:0', '--node', '5', '--flash', 'instant', '--stand-in', '--folder', '.']
node = subprocess.Popen(node, stdout=subprocess.PIPE, text=True)
try:
    bus = node.stdout.readline().removeprefix('bus: ').strip()
    report = coflash.flash(bus, 5, 'program.bin', board='stm32f407g-disc1', address=0x08020000, verify=True)
    print(report['size'])
finally:
    node.kill()
";

/// The crates build from the files for the registry, each by itself, and their tests pass from there;
/// `coflash` installs from its folder.
pub fn crates(release: &Release, root: &Path) -> Outcome {
    // One of the crates is the emulator.
    setup::prepare(&[setup::Part::Emulator])?;
    tests_of_crates(release, &root.join("crates"))?;
    let mut install = process::bare_cargo();
    install.args(["install", "--locked", "--debug", "--quiet", "--no-track", "--path"]);
    install.arg(workspace::root().join("coflash/cli")).arg("--root").arg(root);
    install.arg("--target-dir").arg(workspace::target_dir());
    process::run(&mut install)?;
    let installed = root.join("bin/coflash");
    let output = process::output(Command::new(&installed).arg("--version").current_dir(root))?;
    must_contain(&output, VERSION, "coflash --version")
}

/// Compiles what the files for the registry have, and runs its tests, in a folder without the repository. None of
/// the crates is in the registry yet: a workspace has them find each other. (The check of `cargo package` keeps the
/// sources of an earlier file of the same version.)
fn tests_of_crates(release: &Release, folder: &Path) -> Outcome {
    files::make(folder)?;
    let mut names = Vec::new();
    let mut manifest = "[workspace]\nmembers = [\"*\"]\nresolver = \"2\"\n\n[patch.crates-io]\n".to_owned();
    let packed = files::within(&release.build.join("package"))?;
    for file in packed.iter().filter(|file| files::is(file, "crate")) {
        files::unpack(file, folder)?;
        let place = file.file_stem().unwrap_or_default().to_string_lossy();
        let name = place.strip_suffix(VERSION).unwrap_or(&place).trim_end_matches('-');
        manifest += &format!("{name} = {{ path = \"{place}\" }}\n");
        names.push(name.to_owned());
    }
    files::write(&folder.join("Cargo.toml"), manifest)?;
    files::copy(&workspace::root().join("Cargo.lock"), &folder.join("Cargo.lock"))?;
    let cargo = |words: &[&str]| {
        let mut cargo = process::bare_cargo();
        cargo.args(words).current_dir(folder).env("CARGO_TARGET_DIR", &release.build);
        process::run(cargo.env("CARGO_PROFILE_DEV_OPT_LEVEL", "1").env("CARGO_PROFILE_DEV_DEBUG", "0"))
    };
    // Each by itself, without the features that another one asks for.
    names.iter().try_for_each(|name| cargo(&["check", "--quiet", "--package", name]))?;
    cargo(&["test", "--workspace", "--quiet"])
}

/// Runs the program in a folder without any other file of a system: with `root` as its root if the
/// system allows that, and without an environment.
fn works(root: &Path, program: &str) -> Outcome {
    let file = root.join(program);
    if needs_a_linker(&file)? {
        return Err(format!("{} needs a dynamic linker, and so the libraries of a system.", file.display()));
    }
    let inside =
        process::succeeds("chroot", &[&root.display().to_string(), &format!("/{program}"), "--version"]);
    let run = |words: &[&str]| {
        let mut command = if inside { Command::new("chroot") } else { Command::new(&file) };
        if inside {
            command.arg(root).arg(format!("/{program}"));
        }
        process::output(
            command.args(words).current_dir(root).env_clear().env("PATH", "/usr/sbin:/usr/bin:/sbin:/bin"),
        )
    };
    must_contain(&run(&["--version"])?, VERSION, "coflash --version")?;
    files::write(&root.join("app.bin"), sample())?;
    run(&["convert", "app.bin", "app.blk", "-I", "binary", "--board", "stm32f407g-disc1"])?;
    must_contain(&run(&["inspect", "app.blk"])?, "can be a program", "coflash inspect")?;
    // They do not belong to the package.
    ["app.bin", "app.blk"].into_iter().try_for_each(|file| {
        fs::remove_file(root.join(file)).map_err(|error| format!("{file} cannot be removed: {error}."))
    })
}

/// A program for 0802_0000h: the initial stack pointer, the reset vector, and almost no code.
fn sample() -> Vec<u8> {
    let mut image = [0x2001_0000_u32, 0x0802_0201].map(u32::to_le_bytes).concat();
    image.resize(1024, 0xBF);
    image
}

/// Whether an ELF file names a dynamic linker.
fn needs_a_linker(program: &Path) -> Outcome<bool> {
    let mut readelf = Command::new("readelf");
    Ok(process::output(readelf.args(["--wide", "--program-headers"]).arg(program))?.contains(" INTERP "))
}

pub fn windows(release: &Release, _: &Path) -> Outcome {
    // It comes with the linker.
    let mut objdump = Command::new("x86_64-w64-mingw32-objdump");
    runs_on_windows(&process::output(objdump.arg("--private-headers").arg(release.windows()))?)
}

/// Checks a program for Windows, of which objdump says this: it is one of x86-64, and uses the libraries
/// of Windows alone. Those of the compiler begin with `lib`.
fn runs_on_windows(output: &str) -> Outcome {
    if !output.contains("file format pei-x86-64") {
        return Err("the program for Windows is none of x86-64.".into());
    }
    let libraries: Vec<String> =
        output.lines().filter_map(|line| Some(line.split_once("DLL Name: ")?.1.to_lowercase())).collect();
    if !libraries.iter().any(|name| name == "kernel32.dll") {
        return Err(format!("the program for Windows does not import KERNEL32.dll; it has: {libraries:?}."));
    }
    match libraries.iter().find(|name| name.starts_with("lib")) {
        Some(foreign) => Err(format!("the program for Windows needs {foreign}, which no Windows has.")),
        None => Ok(()),
    }
}

fn must_contain(output: &str, expected: &str, who: &str) -> Outcome {
    if output.contains(expected) {
        return Ok(());
    }
    Err(format!("{who} says nothing of \"{expected}\":\n{output}"))
}

#[cfg(test)]
mod tests {
    use kit::folder::Folder;

    use super::*;
    use crate::elf::tests::by_hand;

    #[test]
    fn a_program_with_a_dynamic_linker_is_not_static() {
        let folder = Folder::below(std::env::temp_dir(), "coboot-static");
        let file = |bytes: &[u8]| {
            fs::write(folder.join("program"), bytes).unwrap();
            needs_a_linker(&folder.join("program"))
        };
        // This test program itself is linked against the system's libraries.
        assert_eq!(needs_a_linker(&std::env::current_exe().unwrap()), Ok(true));
        assert_eq!(file(&by_hand()), Ok(false));
        assert!(file(b"#!/bin/sh").is_err());
    }

    /// Lines as objdump prints them.
    #[test]
    fn a_program_for_windows_needs_the_libraries_of_windows_alone() {
        let check = |format: &str, names: &[&str]| {
            let names: String = names.iter().map(|name| format!("\tDLL Name: {name}\n")).collect();
            runs_on_windows(&format!("\ncoflash.exe:     file format {format}\n\n{names}"))
        };
        let windows = ["KERNEL32.dll", "api-ms-win-core-synch-l1-2-0.dll"];
        assert_eq!(check("pei-x86-64", &windows), Ok(()));
        assert!(check("pei-i386", &windows).unwrap_err().contains("none of x86-64"));
        let gcc = check("pei-x86-64", &[windows[0], "libgcc_s_seh-1.dll"]).unwrap_err();
        assert!(gcc.contains("libgcc_s_seh-1.dll"), "{gcc}");
        assert!(check("pei-x86-64", &windows[1..]).unwrap_err().contains("KERNEL32"));
    }
}
