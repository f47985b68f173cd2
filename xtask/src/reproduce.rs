//! `cargo xtask reproduce`: the same sources give the same firmware, wherever they lie.

use std::path::Path;
use std::process::Command;

use serde_json::json;

use crate::args::Args;
use crate::setup::{self, Part};
use crate::{elf, evidence, files, outcome::Outcome, process, toolchain, workspace};

pub const HELP: &str = "\
usage: cargo xtask reproduce [--board BOARD]

Clones the last commit into two folders with names of different lengths, builds bootloader and
application in both, and compares the bytes that go into the flash. Whoever has a device and the
sources can so find out whether they belong together. Changes without a commit take no part.

  --board BOARD   the board (default: stm32f407g-disc1)

The result goes to target/evidence/reproduce.json.
";

/// The images that are compared.
const IMAGES: [&str; 4] = ["bootloader", "bootloader-sealed", "app-v1", "app-v2"];
/// The names of the two folders: paths in the firmware would have other lengths.
const FOLDERS: [&str; 2] = ["a", "another-folder-with-a-longer-name"];

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    args.none_left()?;
    setup::prepare(&[Part::Firmware])?;
    evidence::begin("reproduce")?;
    let base = workspace::target_dir().join("reproduce");
    files::remove(&base)?;
    files::make(&base)?;
    for folder in FOLDERS {
        let clone = base.join(folder);
        let mut git = Command::new("git");
        process::run(git.args(["clone", "--quiet", "--local"]).arg(workspace::root()).arg(&clone))?;
        let mut build = process::bare_cargo();
        build.args(["xtask", "build", "--board", board.board]).args(IMAGES).current_dir(&clone);
        process::run(build.env_remove("CARGO_TARGET_DIR").env_remove("CARGO_MANIFEST_DIR"))?;
    }
    let (mut rows, mut failed) = (Vec::new(), 0);
    println!();
    for image in IMAGES {
        let [one, other] = FOLDERS.map(|folder| {
            let built = base.join(folder).join("target/firmware").join(board.board);
            loaded(&built.join(image).with_extension("elf"))
        });
        let (one, other) = (one?, other?);
        let bytes: usize = one.iter().map(|(_, bytes)| bytes.len()).sum();
        let same = one == other;
        println!("  {image:<18} {bytes:>6} bytes, {}", if same { "the same" } else { "DIFFERENT" });
        failed += usize::from(!same);
        rows.push(json!({"image": image, "bytes": bytes, "same": same}));
    }
    let facts = json!({"board": board.board, "compared": IMAGES.len(), "failed": failed, "images": rows});
    evidence::record("reproduce", facts)?;
    if failed > 0 {
        return Err(format!("{failed} images differ; both builds are in {}.", workspace::shown(&base)));
    }
    toolchain::notice();
    files::remove(&base)
}

/// The pieces of an image that go into the flash, by address.
fn loaded(path: &Path) -> Outcome<Vec<(u32, Vec<u8>)>> {
    let file = files::bytes(path)?;
    let segments =
        elf::segments(&file).map_err(|problem| format!("{}: {problem}", workspace::shown(path)))?;
    Ok(segments.iter().map(|segment| (segment.address, segment.bytes.to_vec())).collect())
}
