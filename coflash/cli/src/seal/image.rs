//! `coflash seal image`: makes a sealed image from a program.

use std::path::{Path, PathBuf};

use clap::Args;
use coflash_core::file::convert::{blocks_of_sealed, program_of, DEFAULT_BLOCK_SIZE};
use coflash_core::file::judge::judge;
use coflash_core::file::limit;
use coflash_core::file::ram_image::RamImage;
use coflash_core::file::read;
use coflash_core::file::sealed::sealer::CHUNK;
use coflash_core::file::sealed::{hash, Kek, SealFault, SealedFile, Sealer, SigningKey, Unsigned};
use coflash_core::file::Program;
use seal::wire::{flag, BOOTLOADER, MAX_CHUNK, MIN_CHUNK};
use shared_abi::block_file::ProgramVersion;
use shared_abi::layout::Layout;

use crate::context::Context;
use crate::file::{base, Input, Place};
use crate::objects::bytes_of;
use crate::output::Failure;
use crate::output_file::write;
use crate::seal::keys;
use crate::seal::verify::value;
use crate::values::{number, program_number, unique_id};

/// Seals a program: signs it, encrypts and compresses it.
///
/// It is encrypted and compressed only if asked to.
///
/// The same input gives the same output, byte for byte.
///
/// For a key in a hardware security module this takes two steps: first --tbs with the public key,
/// and, after the module has signed that file, --attach.
#[derive(Debug, Args)]
pub(crate) struct Image {
    #[command(flatten)]
    input: Input,

    /// The sealed image to write; by default the firmware's name with .cbs, or with .blk for
    /// --blocks.
    #[arg(long, short, value_name = "OUT")]
    output: Option<PathBuf>,

    /// The private key that signs; with --tbs and --attach the public key is sufficient.
    #[arg(long, value_name = "FILE")]
    key: PathBuf,

    /// The key's certificate. Without one, the key must be a root of the devices.
    #[arg(long, value_name = "FILE")]
    cert: Option<PathBuf>,

    /// The security counter: a device refuses a program with a counter lower than the highest one
    /// that it has accepted.
    #[arg(long, value_name = "NUMBER", value_parser = number, required_unless_present_any = ["attach", "bootloader"], conflicts_with = "bootloader")]
    counter: Option<u32>,

    /// Seal the bootloader in the file, for a renewal. Counter, version and target are those of its header; the
    /// certificate must be for bootloaders (coflash seal keys certify --role bootloader).
    #[arg(long, conflicts_with_all = ["program", "data", "writes_flash", "base", "vendor", "product", "ver", "hardware", "tbs", "attach"])]
    bootloader: bool,

    /// Vendor-ID of the devices (1018h/1); by default that of the label in the image.
    #[arg(long, alias = "vid", value_name = "NUMBER", value_parser = number)]
    vendor: Option<u32>,

    /// Product code of the devices (1018h/2); by default that of the label in the image.
    #[arg(long, alias = "pid", value_name = "NUMBER", value_parser = number)]
    product: Option<u32>,

    /// The program's version: major in bits 0-7, minor in bits 8-15, release in bits 16-31; by
    /// default that of the label in the image.
    #[arg(long, value_name = "NUMBER", value_parser = number, hide_short_help = true)]
    ver: Option<u32>,

    /// The date in the image, in seconds since 1970; by default SOURCE_DATE_EPOCH, otherwise none.
    #[arg(long, value_name = "SECONDS", env = "SOURCE_DATE_EPOCH", hide_short_help = true)]
    date: Option<u64>,

    /// The program number on the board.
    #[arg(long, short = 'P', alias = "prog_no", value_name = "1..254", value_parser = program_number, default_value = "1")]
    program: u8,

    #[command(flatten)]
    place: Place,

    /// Encrypt for the devices with this key-encryption key; give the option once for each key.
    #[arg(long, value_name = "FILE")]
    encrypt: Vec<PathBuf>,

    /// Compress the program.
    #[arg(long)]
    compress: bool,

    /// Compress against this firmware, the other program of the device.
    #[arg(long, value_name = "FILE")]
    base: Option<PathBuf>,

    /// Make the image only for the device with this unique ID: 24 hexadecimal digits, as the device
    /// reports it.
    #[arg(long, value_name = "UID", value_parser = unique_id)]
    device: Option<[u8; 12]>,

    /// Make the image only for devices of this hardware revision (low 5 bits of 1018h/3); give the
    /// option once for each.
    #[arg(long, value_name = "REVISION", value_parser = number)]
    hardware: Vec<u32>,

    /// Write a block file that carries the sealed image, for masters that support nothing else; its
    /// blocks have at most this many bytes, including framing.
    #[arg(long, value_name = "BYTES", value_parser = number, num_args = 0..=1, default_missing_value = "0x400", conflicts_with = "tbs")]
    blocks: Option<u32>,

    /// Payload of a chunk: a power of two from 512 to 8192. A device must have room for one chunk.
    #[arg(long, value_name = "BYTES", value_parser = chunk, default_value = "4096")]
    chunk: u8,

    /// A text for people, stored in the image.
    #[arg(long, value_name = "TEXT")]
    text: Option<String>,

    /// The software bill of materials; the image contains its hash.
    #[arg(long, value_name = "FILE")]
    sbom: Option<PathBuf>,

    /// Mark the file as data of the application instead of a program.
    #[arg(long)]
    data: bool,

    /// Mark the application as one that writes to flash itself: the device does not lock its flash.
    #[arg(long)]
    writes_flash: bool,

    /// Make the image only for devices that are marked for tests.
    #[arg(long)]
    test: bool,

    /// Write the bytes to be signed (pure Ed25519) to this file, and leave out the signature.
    #[arg(long, value_name = "FILE", conflicts_with = "attach")]
    tbs: Option<PathBuf>,

    /// Complete a sealed image that was made with --tbs: the file with the signature of 64 bytes.
    #[arg(long, value_name = "FILE")]
    attach: Option<PathBuf>,

    /// Seal the file even if it cannot be a program of an STM32F4.
    #[arg(long)]
    force: bool,
}

const _: () = assert!(CHUNK == 12 && DEFAULT_BLOCK_SIZE == 0x400, "the help text says so");

/// A power of two, as its logarithm.
fn chunk(text: &str) -> Result<u8, String> {
    let bytes = number(text)?;
    match (MIN_CHUNK..=MAX_CHUNK).find(|chunk| 1_u32 << chunk == bytes) {
        Some(chunk) => Ok(chunk),
        None => Err(format!("it must be a power of two from {} to {}", 1 << MIN_CHUNK, 1 << MAX_CHUNK)),
    }
}

/// A program to seal, and the options for it.
pub(crate) struct ToSeal<'p> {
    /// Its file.
    pub(crate) path: &'p Path,
    /// What is in it.
    pub(crate) program: &'p Program,
    /// The memory map of its device, if it is known.
    pub(crate) board: Option<&'static Layout>,
    /// Vendor-ID and product code; if absent, those of its label.
    pub(crate) identity: (Option<u32>, Option<u32>),
    /// The names of these options, for messages.
    pub(crate) options: (&'static str, &'static str),
    /// Its version; if absent, that of its label.
    pub(crate) version: Option<u32>,
}

impl ToSeal<'_> {
    /// Refuses a file that cannot be a program, like `flash`.
    pub(crate) fn judge(&self) -> Result<(), Failure> {
        judge(self.program.image(), self.program.start(), self.board)
            .map_err(|fault| Failure::no_program(self.path, fault))
    }

    /// Adds the program's identity and version to the parameters in `sealer`.
    pub(crate) fn sealer<'s>(&self, sealer: Sealer<'s>) -> Result<Sealer<'s>, Failure> {
        let label = self.program.label();
        let unnamed = |what: &str, option: &str| {
            let what = format!("{}: the program has no {what} of its target device", self.path.display());
            Failure::usage(what, format!("give {option}"))
        };
        let vendor_id = self.identity.0.or(label.map(|label| label.vendor_id));
        let product_code = self.identity.1.or(label.map(|label| label.product_code));
        Ok(Sealer {
            vendor_id: vendor_id.ok_or_else(|| unnamed("vendor-ID", self.options.0))?,
            product_code: product_code.ok_or_else(|| unnamed("product code", self.options.1))?,
            version: self.version.or(label.map(|label| label.version)).unwrap_or(0),
            ..sealer
        })
    }

    /// Seals the program as it lies in flash with this key.
    pub(crate) fn seal(&self, sealer: &Sealer<'_>, key: &SigningKey) -> Result<Vec<u8>, Failure> {
        sealer.seal(&self.program.flash_image(), key).map_err(|fault| self.fault(&fault))
    }

    fn fault(&self, fault: &SealFault) -> Failure {
        Failure::file(self.path, fault)
    }
}

/// The form in which a sealed image is written.
#[derive(Clone, Copy)]
pub(crate) enum Form {
    /// Unchanged.
    Plain,
    /// In blocks of at most `size` bytes, for a program that starts at `start`.
    Blocks { start: u32, size: usize },
}

/// Writes a sealed image and returns it; its signature may be missing.
pub(crate) fn put(output: &Path, image: Vec<u8>, form: Form) -> Result<SealedFile, Failure> {
    let file = SealedFile::parse(image).map_err(|refusal| Failure::sealed(output, &refusal))?;
    match form {
        Form::Plain => write(output, file.bytes())?,
        Form::Blocks { start, size } => {
            let blocks = blocks_of_sealed(&file, start, size);
            let blocks = blocks.map_err(|error| Failure::convert(error, output))?;
            write(output, &blocks.emit())?;
        }
    }
    Ok(file)
}

/// Reports what was written.
pub(crate) fn report(context: &Context, output: &Path, file: &SealedFile, signed: bool) {
    let head = file.head();
    let (size, payload) = (head.size(), head.payload());
    let mut words = format!(
        "{}: program {} {}, counter {}, {size} bytes, CRC {:08X}h",
        output.display(),
        head.program(),
        ProgramVersion(head.version()),
        head.counter(),
        head.crc()
    );
    if head.flags() & flag::COMPRESSED != 0 {
        let percent = u64::from(payload) * 100 / u64::from(size.max(1));
        words += &format!(", compressed to {payload} bytes ({percent} %)");
    }
    if !signed {
        words += "; its signature is missing: --attach completes it";
    }
    context.result(words, || {
        let mut value = value(file);
        value["output"] = output.display().to_string().into();
        value["signed"] = signed.into();
        value
    });
}

impl Image {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = self.input.path();
        if let Some(signature) = &self.attach {
            return self.complete(context, path, signature);
        }
        let extension = if self.blocks.is_some() { "blk" } else { "cbs" };
        let output = self.output.clone().unwrap_or_else(|| path.with_extension(extension));
        if output == path || self.tbs.as_ref() == Some(&output) {
            let what = format!("the result would overwrite {}", output.display());
            return Err(Failure::usage(what, "name another file for the result: --output"));
        }
        if self.bootloader {
            return self.seal_bootloader(context, path, &output);
        }
        let (firmware, _) = self.place.load(path, self.program)?;
        let done = program_of(firmware, &self.place.options(self.program)?);
        let done = done.map_err(|error| Failure::convert(error, path))?;
        crate::file::warn(context, path, &done.notes, done.left_out);
        let to_seal = ToSeal {
            path,
            program: &done.program,
            board: self.place.layout()?,
            identity: (self.vendor, self.product),
            options: ("--vendor", "--product"),
            version: self.ver,
        };
        if !self.data && !self.force {
            to_seal.judge()?;
        }
        let encrypt_for = keys::keks(&self.encrypt)?;
        let base = self.base.as_deref().map(base).transpose()?;
        let sealer = to_seal.sealer(Sealer {
            // clap requires the option in every case that reaches this line.
            counter: self.counter.unwrap_or(0),
            program: self.program,
            base: base.as_deref(),
            hardware: self.hardware.iter().fold(0, |mask, revision| mask | 1 << (revision & 31)),
            data: self.data,
            writes_flash: self.writes_flash,
            ..self.sealer(&encrypt_for)?
        })?;
        let image = match &self.tbs {
            None => to_seal.seal(&sealer, &keys::signing_key(&self.key)?)?,
            Some(tbs) => {
                let key = keys::public_key(&self.key)?;
                let unsigned = sealer.for_module(&done.program.flash_image(), key);
                let unsigned = unsigned.map_err(|fault| to_seal.fault(&fault))?;
                write(tbs, &unsigned.tbs())?;
                unsigned.file().to_vec()
            }
        };
        let file = put(&output, image, self.form(|| Ok(done.program.start()))?)?;
        report(context, &output, &file, self.tbs.is_none());
        Ok(())
    }

    /// What a program and a bootloader have in common.
    fn sealer<'a>(&'a self, encrypt_for: &'a [Kek]) -> Result<Sealer<'a>, Failure> {
        let sbom = match &self.sbom {
            Some(path) => {
                let sbom = limit::read(path).map_err(|cause| Failure::file(path, cause))?;
                Some(hash(&sbom))
            }
            None => None,
        };
        Ok(Sealer {
            certificate: self.cert.as_deref().map(keys::certificate).transpose()?,
            chunk: self.chunk,
            encrypt_for,
            compress: self.compress,
            unique_id: self.device.unwrap_or_default(),
            created: self.date.unwrap_or(0),
            test: self.test,
            text: self.text.as_deref(),
            sbom,
            ..Sealer::default()
        })
    }

    /// Seals the RAM image of a bootloader.
    fn seal_bootloader(&self, context: &Context, path: &Path, output: &Path) -> Result<(), Failure> {
        let (firmware, _) = read::load_telling(path, None, Some(0))?;
        let image =
            RamImage::of(&firmware).ok_or_else(|| Failure::file(path, "it contains no bootloader (CBI2)"))?;
        image.check().map_err(|fault| Failure::file(path, format_args!("it {fault}")))?;
        let encrypt_for = keys::keks(&self.encrypt)?;
        let header = image.header();
        let sealer = Sealer {
            vendor_id: header.vendor,
            product_code: header.product,
            version: header.version,
            counter: header.counter,
            program: BOOTLOADER,
            hardware: header.revisions,
            ..self.sealer(&encrypt_for)?
        };
        let sealed = sealer.seal(image.bytes(), &keys::signing_key(&self.key)?);
        let sealed = sealed.map_err(|fault| Failure::file(path, fault))?;
        let home = || {
            let home = self.place.layout()?.and_then(|layout| layout.home);
            home.map(|home| home.base).ok_or_else(|| {
                Failure::usage(
                    "the address of the bootloader is unknown",
                    "give --board, of a board with the split map",
                )
            })
        };
        let file = put(output, sealed, self.form(home)?)?;
        report(context, output, &file, true);
        Ok(())
    }

    /// The form of the result, for a program at the address that `start` returns.
    fn form(&self, start: impl FnOnce() -> Result<u32, Failure>) -> Result<Form, Failure> {
        Ok(match self.blocks {
            None => Form::Plain,
            Some(size) => Form::Blocks { start: start()?, size: size as usize },
        })
    }

    /// The second of the two steps.
    fn complete(&self, context: &Context, path: &Path, signature: &Path) -> Result<(), Failure> {
        let output = self.output.clone().unwrap_or_else(|| match self.blocks {
            None => path.to_path_buf(),
            Some(_) => path.with_extension("blk"),
        });
        let form = self.form(|| {
            let unknown = || {
                let what =
                    "a block file needs the program's start address, which a sealed image does not contain";
                Failure::usage(what, "give --board or --start-address")
            };
            self.place.start(self.program)?.ok_or_else(unknown)
        })?;
        let file = limit::read(path).map_err(|cause| Failure::file(path, cause))?;
        let key = keys::public_key(&self.key)?;
        let why = "is not a signature: it must have 64 bytes, as openssl pkeyutl -sign -rawin writes them";
        let bytes: Option<[u8; 64]> = bytes_of(signature, 1024)?.try_into().ok();
        let bytes = bytes.ok_or_else(|| Failure::file(signature, why))?;
        let image = Unsigned::of_file(file, key).and_then(|unsigned| unsigned.attach(&bytes));
        let image = image.map_err(|fault| Failure::file(path, fault))?;
        let file = put(&output, image, form)?;
        report(context, &output, &file, true);
        Ok(())
    }
}
