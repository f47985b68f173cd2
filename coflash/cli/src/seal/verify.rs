//! `coflash seal verify` and `coflash seal show`: checks and describes a sealed image.

use std::path::{Path, PathBuf};

use clap::Args;
use coflash_core::file::block_file::BlockFile;
use coflash_core::file::sealed::open::Closed;
use coflash_core::file::sealed::show::{digits, flags, text};
use coflash_core::file::sealed::{blocks, carried, verify, Carried, Device, Opened, SealedFile};
use seal::wire::tag;
use serde_json::{json, Value};
use shared_abi::block_file::ProgramVersion;

use crate::context::Context;
use crate::file::{base, bytes, front};
use crate::output::Failure;
use crate::seal::keys::{self, KeyBlock};
use crate::values::{number, program_number, unique_id};

/// Checks a sealed image as a device does.
///
/// A bad image is shown with the rule that it breaks. This covers the form, the target device, counter and epoch, the certificate, the signature,
/// every chunk, and the program itself. A property of the device that no option gives is assumed to
/// match the image. Without --kek the program in an encrypted image is not checked.
#[derive(Debug, Args)]
pub(crate) struct Verify {
    #[command(flatten)]
    checked: Checked,

    /// The device's vendor-ID (1018h/1).
    #[arg(long, alias = "vid", value_name = "NUMBER", value_parser = number)]
    vendor: Option<u32>,

    /// Its product code (1018h/2).
    #[arg(long, alias = "pid", value_name = "NUMBER", value_parser = number)]
    product: Option<u32>,

    /// Its hardware revision (1018h/3).
    #[arg(long, value_name = "REVISION", value_parser = number)]
    hardware: Option<u32>,

    /// Its unique ID, in 24 hexadecimal digits.
    #[arg(long, value_name = "UID", value_parser = unique_id)]
    device: Option<[u8; 12]>,

    /// The program number to be written.
    #[arg(long, short = 'P', value_name = "1..254", value_parser = program_number)]
    program: Option<u8>,

    /// The size of the program's flash in bytes.
    #[arg(long, value_name = "BYTES", value_parser = number)]
    room: Option<u32>,
}

/// A sealed image, and the keys to check it with.
#[derive(Debug, Args)]
pub(crate) struct Checked {
    /// The sealed image, or the block file that carries one.
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,

    #[command(flatten)]
    keys: KeyBlock,

    /// The other program of the device, for an image that was compressed against it.
    #[arg(long, value_name = "FILE")]
    base: Option<PathBuf>,
}

/// Shows the manifest of a sealed image.
///
/// Only its form is checked.
#[derive(Debug, Args)]
pub(crate) struct Show {
    /// The sealed image, or the block file that carries one.
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

impl Checked {
    /// Checks the image for a device with these keys; `device` holds the other properties. Returns
    /// the file and the opened image.
    pub(crate) fn check(&self, device: &Device<'_>) -> Result<(SealedFile, Opened), Failure> {
        let path = &self.file;
        let refused = |refusal| Failure::sealed(path, &refusal);
        let bytes = read(path)?.image;
        let (roots, keks) = self.keys.keys()?;
        let KeyBlock { counter, epoch, for_tests, .. } = self.keys;
        let base = self.base.as_deref().map(base).transpose()?;
        let keys = Device { roots: &roots, keks: &keks, base: base.as_deref(), ..*device };
        let opened = verify(&bytes, &Device { counter, epoch, for_tests, ..keys }).map_err(refused)?;
        Ok((SealedFile::parse(bytes).map_err(refused)?, opened))
    }
}

impl Verify {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = &self.checked.file;
        let (file, opened) = self.checked.check(&Device {
            vendor_id: self.vendor,
            product_code: self.product,
            revision: self.hardware,
            unique_id: self.device,
            program: self.program,
            room: self.room,
            ..Device::default()
        })?;
        let head = file.head();
        let (key, root) = (opened.signed_by.id(), opened.root.id());
        let image = match opened.closed {
            None => format!("the program is whole, {} bytes, CRC {:08X}h", head.size(), head.crc()),
            Some(Closed::Encrypted) => "the program was not checked: it is encrypted; give --kek".to_string(),
            Some(Closed::Dictionary) => {
                "the program was not checked: it was compressed against another one; give --base".to_string()
            }
        };
        let whose = match key == root {
            true => "which is a root".to_string(),
            false => format!("certified by root {root:08X}h"),
        };
        let words = format!(
            "{}: good\n  signed by    key {key:08X}h, {whose}\n  \
             program      {} {}, counter {}, epoch {}\n  image        {image}",
            path.display(),
            head.program(),
            ProgramVersion(head.version()),
            head.counter(),
            opened.epoch,
        );
        context.result(words, || {
            let mut value = value(&file);
            value["signed_by"] = key.into();
            value["root"] = root.into();
            value["epoch"] = opened.epoch.into();
            value["image_checked"] = opened.closed.is_none().into();
            value
        });
        Ok(())
    }
}

impl Show {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        show(context, &self.file)
    }
}

/// Shows a sealed image.
pub(crate) fn show(context: &Context, path: &Path) -> Result<(), Failure> {
    let Carried { image, blocks } = read(path)?;
    let file = SealedFile::parse(image).map_err(|refusal| Failure::sealed(path, &refusal))?;
    let carrier = blocks.as_ref().map_or_else(String::new, |program| {
        let (count, start) = (BlockFile::of(program).blocks().len(), program.start());
        format!("block file, {count} blocks, from {start:#010x} on; in it: ")
    });
    context.result(format_args!("{}: {carrier}{}", path.display(), file.parts()), || {
        let mut value = value(&file);
        value["blocks"] = json!(blocks.as_ref().map(|program| json!({
            "count": BlockFile::of(program).blocks().len(),
            "start": program.start(),
            "size": program.size(),
            "crc": program.crc(),
        })));
        value
    });
    Ok(())
}

/// Whether the file begins as a sealed image, or as a block file that carries one; `false` if it
/// cannot be read.
pub(crate) fn is_sealed(path: &Path) -> bool {
    blocks::looks_like(&front(path, blocks::FRONT))
}

/// Reads a sealed image, from the blocks of a block file if the file is one.
pub(crate) fn read(path: &Path) -> Result<Carried, Failure> {
    Ok(carried(bytes(path)?).map_err(|fault| fault.of(path.display()))?)
}

/// The JSON value of a sealed image.
pub(crate) fn value(file: &SealedFile) -> Value {
    let sealed = file.parts();
    let head = sealed.head;
    let record = |wanted: u16| head.records().find(|(tag, _)| *tag == wanted).map(|(_, bytes)| bytes);
    json!({
        "format": "sealed image",
        "vendor_id": head.vendor_id(),
        "product_code": head.product_code(),
        "program": head.program(),
        "version": head.version(),
        "version_text": ProgramVersion(head.version()).to_string(),
        "counter": head.counter(),
        "created": head.created(),
        "size": head.size(),
        "crc": head.crc(),
        "payload": head.payload(),
        "chunk": 1_u32 << (head.chunk() & 31),
        "flags": flags(head.flags()).collect::<Vec<_>>(),
        "unique_id": Some(head.unique_id()).filter(|id| *id != [0; 12]).map(|id| digits(&id)),
        "hardware": head.hardware(),
        "hash": digits(head.image_hash()),
        "chain": digits(&head.chain()),
        "nonce": digits(&head.nonce()),
        "dictionary": Some(head.dictionary()).filter(|hash| *hash != [0; 32]).map(digits),
        "recipients": sealed.recipients().map(|recipient| recipient.key_id()).collect::<Vec<_>>(),
        "text": record(tag::TEXT).map(text),
        "source": record(tag::SOURCE).map(text),
        "sbom": record(tag::SBOM).map(digits),
        "certificate": head.certificate().map(keys::certificate_value),
        "signatures": sealed.signers(),
    })
}
