//! `cargo xtask reproduce`: the same sources give the same firmware, wherever they lie.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::json;

use crate::args::Args;
use crate::elf::Elf;
use crate::setup::{Part, Setup};
use crate::{evidence, process, toolchain, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask reproduce [--board BOARD] [--yes]

Clones the last commit into two folders with names of different lengths, builds bootloader and
application in both, and compares the bytes that go into the flash. Whoever has a device and the
sources can so find out whether they belong together. Changes without a commit take no part.

  --board BOARD   the board (default: stm32f407g-disc1)
  --yes           installs what is missing with sudo

The result goes to target/evidence/reproduce.json.
";

/// The images that are compared.
const IMAGES: [&str; 4] = ["bootloader", "bootloader-sealed", "app-v1", "app-v2"];
/// The names of the two folders: paths in the firmware would have other lengths.
const FOLDERS: [&str; 2] = ["a", "another-folder-with-a-longer-name"];

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Firmware])?;
    evidence::begin("reproduce")?;
    let base = workspace::target_dir().join("reproduce");
    let _ = fs::remove_dir_all(&base);
    fs::create_dir_all(&base)
        .map_err(|error| format!("{} cannot be written: {error}.", workspace::shown(&base)))?;
    for folder in FOLDERS {
        let clone = base.join(folder);
        let mut git = Command::new("git");
        process::run(git.args(["clone", "--quiet", "--local"]).arg(workspace::root()).arg(&clone))?;
        let mut build = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
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
        let differs = first_difference(&one, &other);
        match differs {
            None => println!("  {image:<18} {bytes:>6} bytes, the same"),
            Some(address) => println!("  {image:<18} DIFFERS from {address:#010x} on"),
        }
        failed += usize::from(differs.is_some());
        rows.push(json!({"image": image, "bytes": bytes, "same": differs.is_none()}));
    }
    let facts = json!({"board": board.board, "compared": IMAGES.len(), "failed": failed, "images": rows});
    evidence::record("reproduce", facts)?;
    if failed > 0 {
        return Err(format!("{failed} images differ; both builds are in {}.", workspace::shown(&base)));
    }
    let _ = fs::remove_dir_all(&base);
    toolchain::notice();
    Ok(())
}

/// The pieces of an image that go into the flash, by address.
type Pieces = Vec<(u32, Vec<u8>)>;

fn loaded(path: &PathBuf) -> Outcome<Pieces> {
    let file = fs::read(path).map_err(|error| unread(path, &error))?;
    let elf = Elf::parse(&file).map_err(|problem| format!("{}: {problem}", workspace::shown(path)))?;
    let piece = |segment: &crate::elf::Segment| {
        let bytes = &file[segment.offset as usize..][..segment.file_size as usize];
        (segment.load_address, bytes.to_vec())
    };
    Ok(elf.segments.iter().filter(|segment| segment.file_size > 0).map(piece).collect())
}

fn unread(path: &Path, error: &std::io::Error) -> String {
    format!("{} cannot be read: {error}.", workspace::shown(path))
}

/// The first address at which two images differ.
fn first_difference(one: &Pieces, other: &Pieces) -> Option<u32> {
    let flat = |pieces: &Pieces| -> Vec<(u32, u8)> {
        let bytes = |(base, bytes): &(u32, Vec<u8>)| -> Vec<(u32, u8)> {
            (*base..).zip(bytes.iter().copied()).collect()
        };
        pieces.iter().flat_map(bytes).collect()
    };
    let (one, other) = (flat(one), flat(other));
    let shorter = one.len().min(other.len());
    let differs = one.iter().zip(&other).find(|(a, b)| a != b).map(|(a, _)| a.0);
    differs.or_else(|| one.get(shorter).or(other.get(shorter)).map(|(address, _)| *address))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_found_wherever_it_is() {
        let image = vec![(0x100, vec![1, 2, 3]), (0x200, vec![4])];
        assert_eq!(first_difference(&image, &image.clone()), None);
        for (other, address) in [
            (vec![(0x100, vec![1, 9, 3]), (0x200, vec![4])], 0x101),
            (vec![(0x100, vec![1, 2, 3]), (0x200, vec![5])], 0x200),
            (vec![(0x100, vec![1, 2, 3])], 0x200),
            (vec![(0x100, vec![1, 2, 3]), (0x200, vec![4, 5])], 0x201),
            (vec![(0x100, vec![1, 2, 3]), (0x204, vec![4])], 0x200),
        ] {
            assert_eq!(first_difference(&image, &other), Some(address));
        }
    }
}
