//! Checks each package as a user gets it: installed into an empty root, and run.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use super::{build, package_crates, remove, unreadable, unwritable, write, Release, LINUX, SUMS, VERSION};
use crate::setup::{self, Setup};
use crate::{process, workspace, Outcome};

pub fn part(release: &Release, setup: &Setup, part: &str) -> Outcome {
    let root = release.empty("check")?;
    match part {
        "source" => source(release, &root)?,
        "linux" => linux(release, &root)?,
        "deb" => debian(release, &root)?,
        "windows" => {
            let file = release.windows();
            windows(&fs::read(&file).map_err(|error| unreadable(&file, &error))?)?;
        }
        "python" => {
            setup.prepare(&[setup::Part::Python])?;
            wheel(release, &root)?;
        }
        // The job that makes it checks it.
        "sbom" => {}
        _ => {
            // One of the crates is the emulator.
            setup.prepare(&[setup::Part::Emulator])?;
            crates(release, &root)?;
        }
    }
    remove(&root)
}

/// Checks the sums, with the program that users have for it.
pub fn sums(dist: &Path) -> Outcome {
    process::run(Command::new("sha256sum").args(["--check", "--strict", "--quiet", SUMS]).current_dir(dist))
}

/// The sources build without a connection, and give the same program as the repository.
fn source(release: &Release, root: &Path) -> Outcome {
    unpack(&release.source(), root)?;
    let sources = root.join(format!("coboot-{VERSION}"));
    let theirs = build::program(&sources, &root.join("target"), LINUX)?;
    let ours = build::program(workspace::root(), &release.build, LINUX)?;
    let read = |file: &Path| fs::read(file).map_err(|error| unreadable(file, &error));
    let (theirs, ours) = (read(&theirs)?, read(&ours)?);
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

fn linux(release: &Release, root: &Path) -> Outcome {
    unpack(&release.linux(), root)?;
    let folder = root.join(format!("coflash-{VERSION}"));
    for file in ["LICENSE-MIT", "LICENSE-APACHE", "README.md", "THIRD-PARTY.txt", "udev/70-coflash.rules"] {
        there(&folder.join(file))?;
    }
    works(&folder, "coflash")
}

fn debian(release: &Release, root: &Path) -> Outcome {
    let base = root.join("var/lib/dpkg");
    for folder in ["info", "updates", "triggers"] {
        let folder = base.join(folder);
        fs::create_dir_all(&folder).map_err(|error| unwritable(&folder, &error))?;
    }
    write(&base.join("status"), "")?;
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
    let pages = files(&root.join("usr/share/man/man1"))?;
    process::run(Command::new("gzip").arg("--test").args(&pages))?;
    // The page of the program, and one for each of its commands.
    let names: Vec<_> = pages.iter().filter_map(|page| page.file_name()?.to_str()).collect();
    for name in ["coflash.1.gz", "coflash-flash.1.gz", "coflash-convert.1.gz"] {
        if !names.contains(&name) {
            return Err(format!("the package has no {name}; it has {}.", names.join(", ")));
        }
    }
    process::run(&mut dpkg(&["--purge", "coflash"]))?;
    let left: Vec<_> = files(root)?.into_iter().filter(|file| !file.starts_with(&base)).collect();
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

/// The wheel updates a node, in an environment of its own.
fn wheel(release: &Release, root: &Path) -> Outcome {
    let entries = fs::read_dir(&release.dist).map_err(|error| unreadable(&release.dist, &error))?;
    let wheel = entries.flatten().map(|entry| entry.path()).find(|path| build::is_wheel(path));
    let wheel = wheel.ok_or("target/dist has no wheel; `cargo xtask package python` makes it.")?;
    process::run(Command::new("python3").args(["-m", "venv"]).arg(root.join("venv")))?;
    let python = root.join("venv/bin/python");
    let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index"];
    process::run(Command::new(&python).args(pip).arg(wheel))?;
    process::run(process::cargo("build").args(["--quiet", "--package", "coboot-node"]))?;
    let node = workspace::target_dir().join("debug/coboot-node");
    let node = Node::start(&node, root)?;
    let program = root.join("program.bin");
    fs::write(&program, sample()).map_err(|error| unwritable(&program, &error))?;
    let script = "import sys, coflash\n\
                  report = coflash.flash(sys.argv[1], 5, sys.argv[2], board='stm32f407g-disc1', address=0x08010000, verify=True)\n\
                  print(report['size'])";
    let mut flash = Command::new(&python);
    flash.args(["-I", "-c", script, &node.bus]).arg(&program).current_dir(root);
    let said = process::output(&mut flash)?;
    said_in(&said, &sample().len().to_string(), "coflash.flash")
}

/// A node on a bus of its own; it ends when it is dropped.
struct Node {
    child: Child,
    bus: String,
}

impl Node {
    fn start(program: &Path, folder: &Path) -> Outcome<Self> {
        let mut command = Command::new(program);
        command.args([
            "--listen",
            "127.0.0.1:0",
            "--node",
            "5",
            "--flash",
            "instant",
            "--stand-in",
            "--folder",
        ]);
        command.arg(folder).stdout(Stdio::piped());
        let mut child = command.spawn().map_err(|error| process::not_started(&command, &error))?;
        let mut said = BufReader::new(child.stdout.take().ok_or("the node has no output.")?);
        let mut line = String::new();
        let read = said.read_line(&mut line);
        let node = Self { child, bus: line.trim().strip_prefix("bus: ").unwrap_or_default().to_owned() };
        if read.is_err() || node.bus.is_empty() {
            return Err(format!("the node says \"{}\" and not where its bus is.", line.trim()));
        }
        // The rest of its output must be read, so that the pipe does not fill up.
        std::thread::spawn(move || std::io::copy(&mut said, &mut std::io::sink()));
        Ok(node)
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The crates build from the files for the registry, and `coflash` installs from its folder.
fn crates(release: &Release, root: &Path) -> Outcome {
    process::run(package_crates(release)?.env("CARGO_PROFILE_DEV_DEBUG", "0"))?;
    let mut install = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    install.args(["install", "--locked", "--debug", "--quiet", "--no-track", "--path"]);
    install.arg(workspace::root().join("coflash")).arg("--root").arg(root);
    install.arg("--target-dir").arg(workspace::target_dir());
    process::run(&mut install)?;
    let installed = root.join("bin/coflash");
    let said = process::output(Command::new(&installed).arg("--version").current_dir(root))?;
    said_in(&said, VERSION, "coflash --version")
}

/// Runs the program in a folder without any other file of a system: with `root` as its root if the
/// system allows that, and without an environment.
fn works(root: &Path, program: &str) -> Outcome {
    let file = root.join(program);
    let bytes = fs::read(&file).map_err(|error| unreadable(&file, &error))?;
    if !is_static(&bytes) {
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
    said_in(&run(&["--version"])?, VERSION, "coflash --version")?;
    let app = root.join("app.bin");
    fs::write(&app, sample()).map_err(|error| unwritable(&app, &error))?;
    run(&["convert", "app.bin", "app.blk", "-I", "binary", "--board", "stm32f407g-disc1"])?;
    said_in(&run(&["inspect", "app.blk"])?, "can be a program", "coflash inspect")?;
    for file in ["app.bin", "app.blk"] {
        fs::remove_file(root.join(file)).map_err(|error| unwritable(&root.join(file), &error))?;
    }
    Ok(())
}

/// A program for 0801_0000h: the initial stack pointer, the reset vector, and almost no code.
fn sample() -> Vec<u8> {
    let mut image = [0x2001_0000_u32, 0x0801_0201].map(u32::to_le_bytes).concat();
    image.resize(1024, 0xBF);
    image
}

/// Whether a 64-bit ELF file names no dynamic linker (no segment of the type PT_INTERP).
fn is_static(file: &[u8]) -> bool {
    let number = |at: usize, size: usize| -> Option<usize> {
        let bytes = file.get(at..at.checked_add(size)?)?;
        bytes
            .iter()
            .rev()
            .try_fold(0_usize, |sum, byte| sum.checked_mul(256)?.checked_add(usize::from(*byte)))
    };
    let segment = |index: usize| number(32, 8)?.checked_add(index.checked_mul(number(54, 2)?)?);
    let kinds =
        || -> Option<Vec<usize>> { (0..number(56, 2)?).map(|index| number(segment(index)?, 4)).collect() };
    let elf64 = file.starts_with(b"\x7fELF\x02\x01");
    elf64 && kinds().is_some_and(|kinds| !kinds.is_empty() && !kinds.contains(&3))
}

/// An executable for 64-bit Windows that needs only the libraries of the system.
fn windows(file: &[u8]) -> Outcome {
    let at = |at: usize, size: usize| file.get(at..at + size);
    let header =
        at(0x3C, 4).map(|bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as usize);
    // "PE", and the machine number of x86-64.
    if !file.starts_with(b"MZ")
        || header.and_then(|header| file.get(header..)?.get(..6)) != Some(b"PE\0\0\x64\x86")
    {
        return Err("the program for Windows is none (no PE of x86-64).".into());
    }
    let name = std::env::temp_dir().join(format!("coflash-{}.exe", std::process::id()));
    fs::write(&name, file).map_err(|error| unwritable(&name, &error))?;
    let said = process::output(Command::new("x86_64-w64-mingw32-objdump").arg("-p").arg(&name));
    let _ = fs::remove_file(&name);
    foreign_libraries(&said?)
}

/// Checks the libraries in the output of `objdump -p`: those of the compiler begin with `lib`.
fn foreign_libraries(listing: &str) -> Outcome {
    let libraries: Vec<&str> =
        listing.lines().filter_map(|line| line.trim().strip_prefix("DLL Name: ")).map(str::trim).collect();
    if !libraries.iter().any(|name| name.eq_ignore_ascii_case("kernel32.dll")) {
        return Err(format!("the program for Windows does not import KERNEL32.dll; it has: {libraries:?}."));
    }
    match libraries.iter().find(|name| name.to_lowercase().starts_with("lib")) {
        Some(foreign) => Err(format!("the program for Windows needs {foreign}, which no Windows has.")),
        None => Ok(()),
    }
}

/// All files below a folder.
fn files(folder: &Path) -> Outcome<Vec<PathBuf>> {
    let mut found = Vec::new();
    for path in fs::read_dir(folder).map_err(|error| unreadable(folder, &error))?.flatten() {
        let path = path.path();
        if path.is_dir() {
            found.extend(files(&path)?);
        } else {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

fn unpack(archive: &Path, into: &Path) -> Outcome {
    process::run(Command::new("tar").arg("--extract").arg("--file").arg(archive).arg("--directory").arg(into))
}

fn there(file: &Path) -> Outcome {
    file.is_file().then_some(()).ok_or_else(|| format!("the archive has no {}.", file.display()))
}

fn said_in(said: &str, expected: &str, who: &str) -> Outcome {
    if said.contains(expected) {
        return Ok(());
    }
    Err(format!("{who} says nothing of \"{expected}\":\n{said}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The head of an ELF file with segments of these types.
    fn elf(kinds: &[u32]) -> Vec<u8> {
        let mut file = b"\x7fELF\x02\x01\x01".to_vec();
        file.resize(64, 0);
        file[32] = 64;
        file[54] = 56;
        file[56] = kinds.len() as u8;
        for kind in kinds {
            file.extend(kind.to_le_bytes());
            file.extend([0; 52]);
        }
        file
    }

    #[test]
    fn a_program_with_a_dynamic_linker_is_not_static() {
        assert!(is_static(&elf(&[1, 1, 2])));
        assert!(!is_static(&elf(&[1, 3, 1])));
        // This test program itself is linked against the system's libraries.
        assert!(!is_static(&fs::read(std::env::current_exe().unwrap()).unwrap()));
        assert!(!is_static(b"#!/bin/sh") && !is_static(&elf(&[])) && !is_static(&elf(&[1, 1])[..80]));
        let mut hostile = elf(&[1]);
        hostile[32..40].fill(0xFF);
        assert!(!is_static(&hostile));
    }

    #[test]
    fn what_is_no_program_for_windows_is_told() {
        for file in [&b""[..], b"MZ", &[b'M', b'Z', 0, 0, 0xFF], &[0xFF; 64], &elf(&[1])] {
            assert!(windows(file).is_err());
        }
        let mut beyond = vec![0xFF; 64];
        beyond[..2].copy_from_slice(b"MZ");
        assert!(windows(&beyond).is_err());
    }

    #[test]
    fn a_library_of_the_compiler_is_foreign() {
        let listing =
            "\tDLL Name: KERNEL32.dll\n\tvma:  Hint/Ord\n\tDLL Name: api-ms-win-core-synch-l1-2-0.dll\n";
        assert_eq!(foreign_libraries(listing), Ok(()));
        let gcc = foreign_libraries(&format!("{listing}\tDLL Name: libgcc_s_seh-1.dll\n")).unwrap_err();
        assert!(gcc.contains("libgcc_s_seh-1.dll"), "{gcc}");
        assert!(foreign_libraries("nothing").is_err());
    }
}
