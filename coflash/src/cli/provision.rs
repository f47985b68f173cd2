//! `coflash provision`: a bootloader with its keys, for production.

use std::path::PathBuf;

use clap::Args;
use coflash::file::ihex;
use coflash::file::read::{self, Firmware, Format};
use coflash::file::sealed::provision::provision;
use coflash::file::sealed::{key_block, Kek, PublicKey};
use serde_json::json;
use shared_abi::layout::Layout;

use super::context::Context;
use super::file::{board, board_of_file, Input};
use super::keys::{self, write_secret};
use super::output::Failure;
use super::values::number;

/// Puts keys into a bootloader, which makes devices that take sealed programs alone.
///
/// The result is written in production, by a debug probe. Key-encryption keys in it make it as secret
/// as they are; it is readable for its owner alone.
#[derive(Debug, Args)]
pub(super) struct Provision {
    #[command(flatten)]
    input: Input,

    /// The file to write: .hex or .bin; otherwise the bootloader's name with .hex.
    #[arg(long, short, value_name = "OUT")]
    output: Option<PathBuf>,

    /// The board, whose memory map says where the keys go.
    #[arg(long, value_name = "BOARD", value_parser = board, required_unless_present = "layout")]
    board: Option<&'static Layout>,

    /// The same for a board that this tool was not built with: its memory map, as `cargo xtask
    /// layout --toml` writes it.
    #[arg(long, value_name = "FILE", conflicts_with = "board")]
    layout: Option<PathBuf>,

    /// The public key of a root; one or two of them.
    #[arg(long, value_name = "FILE", required = true)]
    root: Vec<PathBuf>,

    /// A key-encryption key; up to three of them.
    #[arg(long, value_name = "FILE")]
    kek: Vec<PathBuf>,

    /// The lowest security counter that the device takes, of every program.
    #[arg(long, value_name = "NUMBER", value_parser = number, default_value = "0")]
    counter: u32,

    /// The lowest epoch of a certificate that it takes.
    #[arg(long, value_name = "NUMBER", value_parser = number, default_value = "0")]
    epoch: u32,

    /// Mark the device for tests: it takes programs that are signed with test keys, too.
    #[arg(long)]
    for_tests: bool,

    /// Replace a file that is there already.
    #[arg(long = "force")]
    overwrite: bool,
}

impl Provision {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = self.input.path();
        let layout = match (&self.layout, self.board) {
            (Some(file), _) => board_of_file(file)?,
            (None, Some(board)) => board,
            (None, None) => return Err(Failure::usage("no board is named", "give --board or --layout")),
        };
        let output = self.output.clone().unwrap_or_else(|| path.with_extension("hex"));
        let extension = output.extension().map(|extension| extension.to_ascii_lowercase());
        let binary = match extension.as_ref().and_then(|extension| extension.to_str()) {
            Some("hex") => false,
            Some("bin") => true,
            _ => {
                let what = format!("{}: it cannot be told which format that is", output.display());
                return Err(Failure::usage(what, "name the file with .hex or .bin"));
            }
        };
        if output == path {
            let what = format!("{} would be overwritten", output.display());
            return Err(Failure::usage(what, "name another file for the result: --output"));
        }
        let bytes = super::verify::read(path)?;
        let format = Format::detect(&bytes).or(Some(Format::Raw));
        let firmware = read::read(&bytes, format, Some(layout.bootloader.base));
        let Firmware::Image(image) = firmware.map_err(|error| error.of(path.display()))? else {
            return Err(Failure::file(path, "is a block file, and no bootloader: give the linker's output"));
        };
        let (roots, keks) = (keys::public_keys(&self.root)?, keys::keks(&self.kek)?);
        let block = key_block(&roots, &keks, self.counter, self.epoch, self.for_tests)
            .map_err(|fault| Failure::usage(fault.to_string(), "see coflash provision --help"))?;
        let made =
            provision(&image, layout, &block).map_err(|fault| Failure::file(path, &fault.to_string()))?;
        if binary {
            let mut flash = vec![0xFF; layout.bootloader.size as usize];
            for (address, data) in made.segments() {
                // `provision` let nothing out of the region.
                let at = (address - layout.bootloader.base) as usize;
                flash[at..at + data.len()].copy_from_slice(&data);
            }
            write_secret(&output, &flash, self.overwrite)?;
        } else {
            write_secret(&output, ihex::emit(&made), self.overwrite)?;
        }
        let root_ids: Vec<u32> = roots.iter().map(PublicKey::id).collect();
        let kek_ids: Vec<u32> = keks.iter().map(Kek::id).collect();
        let ids = |ids: &[u32]| {
            let all: Vec<String> = ids.iter().map(|id| format!("{id:08X}h")).collect();
            if all.is_empty() {
                "none".to_string()
            } else {
                all.join(", ")
            }
        };
        let words = format!(
            "{}: {} with keys at {:#010x}\n  roots                {}\n  key-encryption keys  {}\n  \
             counter {}, epoch {}{}",
            output.display(),
            layout.board,
            layout.key_block().base,
            ids(&root_ids),
            ids(&kek_ids),
            self.counter,
            self.epoch,
            if self.for_tests { ", for tests" } else { "" },
        );
        context.out.result(words, || {
            json!({
                "command": "provision",
                "output": output.display().to_string(),
                "board": layout.board,
                "address": layout.key_block().base,
                "roots": root_ids,
                "keks": kek_ids,
                "counter": self.counter,
                "epoch": self.epoch,
                "for_tests": self.for_tests,
            })
        });
        Ok(())
    }
}
