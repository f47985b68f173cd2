//! Makes the package for Debian and Ubuntu, with `dpkg-deb`.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::{build, remove, unreadable, write, Release, VERSION};
use crate::{process, workspace, Outcome};

/// The places of the parts: from a file or folder beside the program to a file or folder of the
/// system.
const PLACES: [(&str, &str); 7] = [
    ("coflash", "usr/bin/coflash"),
    ("man", "usr/share/man/man1"),
    ("completions/coflash.bash", "usr/share/bash-completion/completions/coflash"),
    ("completions/_coflash", "usr/share/zsh/vendor-completions/_coflash"),
    ("completions/coflash.fish", "usr/share/fish/vendor_completions.d/coflash.fish"),
    // Before the rules that give users access to tagged devices (73-seat-late.rules).
    ("udev/70-coflash.rules", "usr/lib/udev/rules.d/70-coflash.rules"),
    ("THIRD-PARTY.txt", "usr/share/doc/coflash/THIRD-PARTY.txt"),
];

pub fn make(release: &Release) -> Outcome {
    let parts = release.empty("deb-parts")?;
    build::with_extras(release, &parts)?;
    let root = release.empty("deb-root")?;
    for (from, to) in PLACES {
        move_to(&parts.join(from), &root.join(to))?;
    }
    let doc = root.join("usr/share/doc/coflash");
    write(&doc.join("copyright"), &copyright()?)?;
    write(&doc.join("changelog"), &changelog(&release.epoch)?)?;
    let overrides = root.join("usr/share/lintian/overrides/coflash");
    write(
        &overrides,
        "# It runs on every Linux, whatever C library that has.\ncoflash: statically-linked-binary\n",
    )?;
    for file in files(&root)? {
        let name = file.strip_prefix(&root).unwrap_or(&file);
        if name.starts_with("usr/share/man") || name.ends_with("doc/coflash/changelog") {
            process::run(Command::new("gzip").args(["-9", "--no-name"]).arg(&file))?;
        }
    }
    let mut sums = String::new();
    let mut bytes = 0;
    for file in files(&root)? {
        let name = file.strip_prefix(&root).unwrap_or(&file);
        bytes += file.metadata().map_err(|error| unreadable(&file, &error))?.len();
        let sum = process::output(Command::new("md5sum").current_dir(&root).arg(name))?;
        sums += &sum;
    }
    write(&root.join("DEBIAN/md5sums"), &sums)?;
    write(&root.join("DEBIAN/control"), &control(bytes.div_ceil(1024)))?;
    let mut dpkg = Command::new("dpkg-deb");
    dpkg.args(["--root-owner-group", "-Zxz", "--build"]).arg(&root).arg(release.deb());
    // Times are clamped to the commit's; with several threads the packed bytes may differ.
    dpkg.env("SOURCE_DATE_EPOCH", &release.epoch).env("DPKG_DEB_THREADS_MAX", "1");
    // Only the program is executable; its build makes it so.
    process::run(Command::new("chmod").args(["--recursive", "u=rwX,go=rX"]).arg(&root))?;
    set_times(&root, &release.epoch)?;
    process::run(&mut dpkg)?;
    remove(&parts)?;
    remove(&root)
}

fn control(kib: u64) -> String {
    let mut text = String::new();
    for (field, value) in [
        ("Package", "coflash"),
        ("Version", VERSION),
        ("Architecture", "amd64"),
        ("Maintainer", "coboot <coboot@example.invalid>"),
        ("Installed-Size", &kib.to_string()),
        ("Section", "electronics"),
        ("Priority", "optional"),
        ("Homepage", "https://example.invalid/coboot"),
        ("Description", "flashes devices over CANopen"),
    ] {
        let _ = writeln!(text, "{field}: {value}");
    }
    text + " coflash updates the program of devices by CANopen program download (CiA 302-3),\n one device or many at once. \
            It reads Intel HEX, S-records, ELF, block files and\n sealed images, and converts them. It works with SocketCAN, \
            SLCAN, gs_usb, PEAK\n and Kvaser adapters.\n"
}

/// The copyright file in Debian's form (DEP 5): the head, and the text of the MIT license, which is
/// not on every system.
fn copyright() -> Outcome<String> {
    let read = |file: &str| {
        let file = workspace::root().join(file);
        fs::read_to_string(&file).map_err(|error| unreadable(&file, &error))
    };
    let mut text = read("coflash/packaging/copyright")? + "\nLicense: MIT\n";
    for line in read("LICENSE-MIT")?.lines().skip_while(|line| !line.starts_with("Copyright")) {
        let _ = writeln!(text, " {}", if line.is_empty() { "." } else { line });
    }
    Ok(text)
}

/// The changelog that Debian requires, with the date in the form of a mail.
fn changelog(epoch: &str) -> Outcome<String> {
    let date =
        process::output(Command::new("date").args(["--utc", "--rfc-email", "--date", &format!("@{epoch}")]))?;
    Ok(format!(
        "coflash ({VERSION}) unstable; urgency=medium\n\n  * CHANGELOG.md in the sources says what changed.\n\n \
         -- coboot <coboot@example.invalid>  {date}"
    ))
}

/// Sets the time of every file and folder to the commit's.
fn set_times(root: &Path, epoch: &str) -> Outcome {
    let date = format!("--date=@{epoch}");
    let mut all = files(root)?;
    all.extend(folders(root)?);
    process::run(Command::new("touch").arg(date).args(all))
}

fn move_to(from: &Path, to: &Path) -> Outcome {
    let parent = to.parent().unwrap_or(to);
    fs::create_dir_all(parent)
        .and_then(|()| fs::rename(from, to))
        .map_err(|error| format!("{} cannot be moved: {error}.", workspace::shown(from)))
}

/// All files below a folder, sorted.
pub fn files(root: &Path) -> Outcome<Vec<PathBuf>> {
    below(root).map(|all| all.into_iter().filter(|path| !path.is_dir()).collect())
}

/// The folder and all folders below it, sorted.
fn folders(root: &Path) -> Outcome<Vec<PathBuf>> {
    let mut found: Vec<_> = below(root)?.into_iter().filter(|path| path.is_dir()).collect();
    found.push(root.to_owned());
    Ok(found)
}

fn below(root: &Path) -> Outcome<Vec<PathBuf>> {
    let mut found = Vec::new();
    let mut open = vec![root.to_owned()];
    while let Some(folder) = open.pop() {
        let entries = fs::read_dir(&folder).map_err(|error| unreadable(&folder, &error))?;
        for path in entries.flatten().map(|entry| entry.path()) {
            if path.is_dir() {
                open.push(path.clone());
            }
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}
