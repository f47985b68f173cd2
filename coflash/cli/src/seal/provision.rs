//! `coflash seal provision`: writes keys into a bootloader, for production.

use std::path::{Path, PathBuf};

use clap::Args;
use coflash_core::device::option_bytes::sector_list;
use coflash_core::file::read::{self, Firmware, Format};
use coflash_core::file::sealed::provision::{protected_sectors, provision};
use coflash_core::file::sealed::{key_block, Kek, PublicKey};
use coflash_core::file::{ihex, Image};
use serde_json::json;
use shared_abi::layout::Layout;

use crate::context::Context;
use crate::file::{Input, MemoryMap};
use crate::output::Failure;
use crate::output_file::write_secret;
use crate::seal::keys::KeyBlock;

/// Writes keys into a bootloader, for production.
///
/// Its devices accept only sealed programs.
///
/// There is room for two roots and three key-encryption keys. A debug probe writes the result into
/// the device in production. With key-encryption keys in it, the file is as secret as the keys;
/// only its owner can read it.
///
/// The output names the sectors that belong under write protection: with renewal the first one
/// alone, because the home of the bootloader's RAM image has to stay writable.
#[derive(Debug, Args)]
pub(crate) struct Provision {
    #[command(flatten)]
    input: Input,

    /// The file to write, Intel HEX; by default the bootloader's name with .hex.
    #[arg(long, short, value_name = "OUT")]
    output: Option<PathBuf>,

    #[command(flatten)]
    map: MemoryMap,

    #[command(flatten)]
    keys: KeyBlock,

    /// Replace an existing file.
    #[arg(long = "force")]
    overwrite: bool,
}

impl Provision {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = self.input.path();
        let unnamed = || Failure::usage("the address of the keys is unknown", "give --board");
        let layout = self.map.layout()?.ok_or_else(unnamed)?;
        let output = self.output.clone().unwrap_or_else(|| path.with_extension("hex"));
        // A raw image would fill the parameters between the two parts of the bootloader.
        if !output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("hex")) {
            let what = format!("{}: the file is Intel HEX", output.display());
            return Err(Failure::usage(what, "name it with .hex"));
        }
        if output == path {
            let what = format!("the result would overwrite {}", output.display());
            return Err(Failure::usage(what, "name another file for the result: --output"));
        }
        let image = bootloader(path, layout)?;
        let (roots, keks) = self.keys.keys()?;
        let KeyBlock { counter, epoch, for_tests, .. } = self.keys;
        let block = key_block(&roots, &keks, counter, epoch, for_tests)
            .map_err(|fault| Failure::usage(fault.to_string(), "see coflash seal provision --help"))?;
        let made = provision(&image, layout, &block).map_err(|fault| Failure::file(path, fault))?;
        write_secret(&output, ihex::emit(&made), self.overwrite)?;
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
        let protect = protected_sectors(&made, layout);
        let words = format!(
            "{}: {} with keys at {:#010x}\n  roots                {}\n  key-encryption keys  {}\n  \
             counter {counter}, epoch {epoch}{}\n  option bytes         write protection (nWRP) of {} and of no \
             others, SPRMOD 0, BFB2 0; RDP last",
            output.display(),
            layout.board,
            layout.key_block().base,
            ids(&root_ids),
            ids(&kek_ids),
            if for_tests { ", for tests" } else { "" },
            sector_list(protect),
        );
        context.result(words, || {
            json!({
                "output": output.display().to_string(),
                "board": layout.board,
                "address": layout.key_block().base,
                "roots": root_ids,
                "keks": kek_ids,
                "counter": counter,
                "epoch": epoch,
                "for_tests": for_tests,
                "protect": protect,
            })
        });
        Ok(())
    }
}

/// The bootloader in a file.
pub(super) fn bootloader(path: &Path, layout: &Layout) -> Result<Image, Failure> {
    let bytes = crate::file::bytes(path)?;
    let format = Format::detect(&bytes).or(Some(Format::Raw));
    match read::read(&bytes, format, Some(layout.bootloader.base))
        .map_err(|error| error.of(path.display()))?
    {
        Firmware::Image(image) => Ok(image),
        Firmware::Blocks(_) => {
            Err(Failure::file(path, "is a block file, not a bootloader: give the linker's output"))
        }
    }
}
