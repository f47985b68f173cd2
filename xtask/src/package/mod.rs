//! `cargo xtask package`: makes the release files of the host tool, and the crates for the
//! registry.

mod build;
mod check;
mod deb;
mod notices;
mod release;

use std::path::Path;
use std::process::Command;

use self::release::{Release, IMAGES, SUMS, VERSION, WINDOWS};
use crate::args::Args;
use crate::{files, outcome::Outcome, process, sbom, setup, toolchain, workspace};

pub const HELP: &str = "\
usage: cargo xtask package [--check] [--draft] [PART ...]

Makes what is handed out, in target/dist. Without a PART it makes all of them:

  source    the sources of the commit, as an archive
  linux     coflash for Linux, linked statically, with manual pages, completions and udev rules
  deb       the same as a package for Debian and Ubuntu (amd64)
  windows   coflash.exe (x86-64)
  python    the wheel
  firmware  bootloader and applications of the hardware page for the STM32F407G-DISC1, as ELF files
  sbom      the software bills of materials of coflash and of the bootloader
  crates    the crates for the registry, packaged as `cargo publish` would (in target/dist-build/package)

SHA256SUMS has the sums of all files in target/dist.

  --check   installs each part into an empty root and runs it; builds coflash from the source archive in another
            folder and compares the two programs byte by byte; verifies the crates against each other, and runs
            their tests from their packages. This takes half an hour and more on two cores, so it is a job of its own and no part of .ci/run.
  --draft   a trial: also packs a tree with changes that are not committed (the source archive is without them),
            or a commit without the tag of its version, and by another Rust than a release has
";

/// A part of what is handed out.
struct Part {
    name: &'static str,
    make: fn(&Release) -> Outcome,
    /// Checks it in an empty folder.
    check: fn(&Release, &Path) -> Outcome,
}

/// The parts, in the order in which they are made.
const PARTS: [Part; 8] = [
    Part { name: "source", make: source, check: check::source },
    Part { name: "linux", make: linux, check: check::linux },
    Part { name: "deb", make: deb::make, check: check::debian },
    Part { name: "windows", make: windows, check: check::windows },
    Part { name: "python", make: python, check: check::wheel },
    Part { name: "firmware", make: firmware, check: check::firmware },
    // The job that makes it checks it.
    Part { name: "sbom", make: bills, check: |_, _| Ok(()) },
    Part { name: "crates", make: crates, check: check::crates },
];

pub fn run(mut args: Args) -> Outcome {
    let checked = args.flag("--check");
    let draft = args.flag("--draft");
    let parts = parts(&args.remaining())?;
    if !draft {
        toolchain::check(&toolchain::line())
            .map_err(|other| format!("{other} Or add --draft for a trial."))?;
        releasable(&git(&["status", "--porcelain"])?, &git(&["tag", "--points-at", "HEAD"])?)?;
    }
    let target = workspace::target_dir();
    let release = Release {
        dist: target.join("dist"),
        build: target.join("dist-build"),
        epoch: git(&["log", "-1", "--format=%ct"])?.trim().to_owned(),
        draft,
    };
    if parts.len() == PARTS.len() {
        files::remove(&release.dist)?;
    }
    files::make(&release.dist)?;
    for part in &parts {
        println!("== {}", part.name);
        (part.make)(&release)?;
    }
    sums(&release.dist)?;
    if checked {
        for part in &parts {
            println!("== check: {}", part.name);
            let root = release.empty("check")?;
            (part.check)(&release, &root)?;
            files::remove(&root)?;
        }
        check::sums(&release.dist)?;
    }
    Ok(())
}

/// The named parts, or all parts if none is named; in the order of [`PARTS`].
fn parts(words: &[String]) -> Outcome<Vec<&'static Part>> {
    let names = PARTS.each_ref().map(|part| part.name);
    if let Some(unknown) = words.iter().find(|word| !names.contains(&word.as_str())) {
        return Err(format!("there is no part \"{unknown}\"; there is: {}.", names.join(", ")));
    }
    let is_wanted = |part: &&Part| words.is_empty() || words.iter().any(|word| word == part.name);
    Ok(PARTS.iter().filter(is_wanted).collect())
}

/// Whether a commit may be released: there are no other changes, and it has the tag of its version.
fn releasable(status: &str, tags: &str) -> Outcome {
    let changed: Vec<&str> = status.lines().collect();
    if let Some(first) = changed.first() {
        return Err(format!(
            "the tree has changes that are not committed ({} files, the first: {}). Commit them or put them away \
             (`git stash -u`); or add --draft for a trial.",
            changed.len(),
            first.trim()
        ));
    }
    let tag = format!("v{VERSION}");
    if !tags.lines().any(|known| known == tag) {
        return Err(format!(
            "the commit has no tag {tag}, the version in Cargo.toml. Put it there (`git tag {tag}`), or set the version \
             that is meant in Cargo.toml first; or add --draft for a trial."
        ));
    }
    Ok(())
}

fn windows(release: &Release) -> Outcome {
    setup::prepare(&[setup::Part::Windows])?;
    files::copy(&build::program(workspace::root(), &release.build, WINDOWS)?, &release.windows())?;
    notices_beside(release)
}

fn python(release: &Release) -> Outcome {
    setup::prepare(&[setup::Part::Python])?;
    build::wheel(release)?;
    notices_beside(release)
}

/// The sources of the commit. git sorts them and gives each the commit's time.
fn source(release: &Release) -> Outcome {
    let tar = release.build.join("source.tar");
    files::make(&release.build)?;
    let (prefix, output) = (format!("--prefix=coboot-{VERSION}/"), tar.display().to_string());
    git(&["-c", "tar.umask=0022", "archive", "--format=tar", &prefix, "--output", &output, "HEAD"])?;
    process::run(Command::new("gzip").args(["-9", "--no-name", "--force"]).arg(&tar))?;
    files::copy(&release.build.join("source.tar.gz"), &release.source())
}

/// The program for Linux and its other files, as an archive.
fn linux(release: &Release) -> Outcome {
    let stage = release.empty("stage")?;
    let name = format!("coflash-{VERSION}");
    let folder = stage.join(&name);
    build::with_extras(release, &folder)?;
    for file in ["LICENSE-MIT", "LICENSE-APACHE", "coflash/cli/README.md"] {
        let from = workspace::root().join(file);
        files::copy(&from, &folder.join(from.file_name().unwrap_or_default()))?;
    }
    files::pack(&stage, &name, &release.epoch, &release.linux())?;
    files::remove(&stage)
}

/// The images of the default board, and its file.
fn firmware(release: &Release) -> Outcome {
    let board = shared_abi::layout::DEFAULT;
    setup::prepare(&[setup::Part::Firmware])?;
    let images = crate::build::images(board, &IMAGES)?;
    let stage = release.empty("stage")?;
    let names = IMAGES.iter().map(|image| format!("{image}.elf"));
    for name in names.chain([format!("{}.toml", board.board)]) {
        files::copy(&images.join(&name), &stage.join(board.board).join(&name))?;
    }
    files::pack(&stage, board.board, &release.epoch, &release.firmware())?;
    files::remove(&stage)
}

/// The notices of the crates in the program, for the release files that cannot contain them.
fn notices_beside(release: &Release) -> Outcome {
    files::write(&release.file("-THIRD-PARTY.txt"), notices::text()?)
}

fn bills(release: &Release) -> Outcome {
    sbom::run(Args::new(std::iter::empty()))?;
    let folder = workspace::target_dir().join("sbom");
    let board = shared_abi::layout::DEFAULT.board;
    files::copy(&folder.join("coflash-all-systems.cdx.json"), &release.file(".cdx.json"))?;
    let bootloader = release.dist.join(format!("bootloader-{VERSION}-{board}.cdx.json"));
    files::copy(&folder.join(format!("bootloader-{board}.cdx.json")), &bootloader)
}

/// The crates for the registry. [`check::crates`] checks their contents. One call packs all, since they depend on
/// each other and none is in the registry yet.
fn crates(release: &Release) -> Outcome {
    let mut package = process::cargo("package --locked --no-verify --target-dir");
    package.arg(&release.build).args(release.draft.then_some("--allow-dirty"));
    // The packages without `publish = false`.
    let metadata = process::metadata()?;
    let published = process::list(&metadata, "packages").filter(|package| package["publish"].is_null());
    package.args(published.flat_map(|package| ["--package", package["name"].as_str().unwrap_or_default()]));
    process::run(&mut package)
}

/// Writes SHA256SUMS in the form for `sha256sum --check`.
fn sums(dist: &Path) -> Outcome {
    let mut sha256sum = Command::new("sha256sum");
    for file in files::within(dist)?.iter().filter(|file| !file.ends_with(SUMS)) {
        println!("{:>9} KiB  {}", files::bytes(file)?.len().div_ceil(1024), workspace::shown(file));
        sha256sum.args(file.file_name());
    }
    files::write(&dist.join(SUMS), process::output(sha256sum.current_dir(dist))?)
}

fn git(words: &[&str]) -> Outcome<String> {
    process::git(words).map_err(|problem| {
        format!("{problem}\nA package needs the commit that it is made of: run this in a clone of the repository.")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_made_in_their_order_and_each_once() {
        let parts = |text: &str| {
            let words: Vec<_> = text.split_whitespace().map(str::to_owned).collect();
            parts(&words).map(|parts| parts.iter().map(|part| part.name).collect::<Vec<_>>())
        };
        assert_eq!(parts("").map(|parts| parts.len()), Ok(PARTS.len()));
        assert_eq!(parts("deb source deb"), Ok(vec!["source", "deb"]));
        assert!(parts("deb rpm").unwrap_err().contains("\"rpm\""));
        assert!(parts("--chekc").unwrap_err().contains("--chekc"));
    }

    #[test]
    fn a_dirty_tree_and_a_commit_without_its_tag_are_told() {
        let tag = format!("v{VERSION}\n");
        assert_eq!(releasable("", &tag), Ok(()));
        assert_eq!(releasable("", &format!("nightly\n{tag}")), Ok(()));
        let dirty = releasable(" M README.md\n?? new\n", &tag).unwrap_err();
        assert!(
            dirty.contains("2 files") && dirty.contains("README.md") && dirty.contains("--draft"),
            "{dirty}"
        );
        for tags in ["", "v0.0.9\n", &format!("v{VERSION}0\n")] {
            let untagged = releasable("", tags).unwrap_err();
            assert!(untagged.contains(&format!("git tag v{VERSION}")), "{untagged}");
        }
    }

    /// Each adapter that the tool supports has a rule, and the rules name no other.
    #[test]
    fn the_udev_rules_are_those_of_the_adapters() {
        let read = |file: &str| files::ours(Path::new("coflash").join(file)).unwrap();
        let mut wanted = Vec::new();
        for (file, constant, subsystem) in
            [("can/src/gs_usb/usb.rs", "const DEVICES", "usb"), ("can/src/ports.rs", "const SLCAN", "tty")]
        {
            let source = read(file);
            let (_, list) = source.split_once(constant).unwrap();
            let (list, _) = list.split_once("];\n").unwrap();
            for pair in list.split('(').skip(2) {
                let ids: Vec<_> = pair.split("0x").skip(1).map(|id| id[..4].to_lowercase()).collect();
                let [vendor, product] = ids.as_slice() else { panic!("{pair}") };
                wanted.push(format!(
                    "SUBSYSTEM==\"{subsystem}\", ATTRS{{idVendor}}==\"{vendor}\", ATTRS{{idProduct}}==\"{product}\", \
                     TAG+=\"uaccess\""
                ));
            }
        }
        assert!(wanted.len() >= 7, "{wanted:?}");
        let rules = read("cli/packaging/70-coflash.rules");
        let rules: Vec<_> = rules.lines().filter(|line| !line.is_empty() && !line.starts_with('#')).collect();
        assert_eq!(rules, wanted);
    }
}
