//! `coflash convert`: converts a firmware file into a block file.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use clap::Args;
use coflash_core::file::area::Area;
use coflash_core::file::block_file::{self, BlockFile, FRAMING};
use coflash_core::file::convert::{Converted, Label};
use coflash_core::file::judge::{judge, Fault, StackAtEnd};
use coflash_core::file::read::Firmware;
use coflash_core::file::sealed::{Kek, Sealer, SigningKey};
use coflash_core::file::{Program, Target};
use seal::wire::CERTIFICATE;
use serde_json::json;

use super::context::Context;
use super::file::same_file;
use super::file::{warn, Input, Source};
use super::output::Failure;
use super::output_file;
use super::seal::image::{self, Form, ToSeal};
use super::seal::keys::{self, value_of_128_bits};
use super::values::{number, program_number};

/// Converts a firmware file into a block file for 1F50h.
///
/// The same input gives the same output, byte for byte; with --ver this also needs --date or
/// SOURCE_DATE_EPOCH.
///
/// Numbers are in C notation: 4096, 0x1000 or octal 010000. The options of BinaryBlockConv are also
/// accepted in their original spelling (--start_address and so on).
#[derive(Debug, Args)]
pub(super) struct Convert {
    #[command(flatten)]
    input: Input,

    /// The block file to write; by default the firmware's name with .blk.
    #[arg(value_name = "OUT")]
    output: Option<PathBuf>,

    /// The program number on the board.
    #[arg(long, short = 'P', alias = "prog_no", value_name = "1..254", value_parser = program_number, default_value = "1")]
    program: u8,

    #[command(flatten)]
    source: Source,

    #[command(flatten)]
    labels: Labels,

    /// Also write the program as it will lie in flash, with filled gaps, to the current folder,
    /// under the name of OUT with .tmp.
    #[arg(long, hide_short_help = true)]
    temp: bool,

    /// The output's format. There is only one.
    #[arg(short = 'O', value_name = "FORMAT", value_parser = ["binary"], ignore_case = true, hide = true)]
    output_format: Option<String>,

    #[command(flatten)]
    encryption: Encryption,
}

/// The target of the program: the contents of block 0.
#[derive(Debug, Args)]
pub(super) struct Labels {
    /// Vendor-ID of the devices for which this program is (1018h/1). Without --vid and --pid, block
    /// 0 contains the vendor-ID, product code and version from the label in the image.
    #[arg(long, value_name = "NUMBER", value_parser = number, requires = "pid")]
    vid: Option<u32>,

    /// Product code of the devices for which this program is (1018h/2).
    #[arg(long, value_name = "NUMBER", value_parser = number, requires = "vid")]
    pid: Option<u32>,

    /// The program's version: major in bits 0-7, minor in bits 8-15, release in bits 16-31
    /// (0x00640A01 is V1.10r100).
    #[arg(long, value_name = "NUMBER", value_parser = number, requires = "vid", hide_short_help = true)]
    ver: Option<u32>,

    /// The date that belongs to --ver or to the image's label, in seconds since 1970. The default
    /// is SOURCE_DATE_EPOCH; without it, that of the file for --ver and no date for the label.
    #[arg(long, value_name = "SECONDS", env = "SOURCE_DATE_EPOCH", hide_short_help = true)]
    date: Option<u64>,

    /// Write no identity into block 0, even if the image has a label.
    #[arg(long, conflicts_with = "vid", hide_short_help = true)]
    no_label: bool,
}

/// The encryption of the manual's tools. The manual names no algorithm, so these options produce a
/// sealed image for coboot's sealed bootloader instead.
#[derive(Debug, Args)]
#[command(next_help_heading = "Encryption")]
struct Encryption {
    /// Encrypt with this value of 128 bits, in 32 hexadecimal digits; needs --sign and --counter.
    ///
    /// The manual names no algorithm: coflash can neither write nor read encrypted files of its
    /// tool. The result is a block file that carries a sealed image (a file named .cbs is the image
    /// itself), encrypted for the key that `coflash seal keys new --role kek --of-value` makes from the
    /// same value.
    #[arg(long, value_name = "HEX128", value_parser = value_of_128_bits, conflicts_with_all = ["crc16", "last_block_2008", "no_label"])]
    key: Option<[u8; 16]>,

    /// The start value of the manual's encryption; it has no effect here.
    ///
    /// Every sealed image has its own nonce.
    #[arg(long, value_name = "VALUE", value_parser = number, requires = "key")]
    add: Option<u32>,

    /// The private key that signs the encrypted image, as --key of `coflash seal image`.
    #[arg(long, value_name = "FILE", requires = "key")]
    sign: Option<PathBuf>,

    /// The certificate of that key. Without one, the key must be a root of the devices.
    #[arg(long, value_name = "FILE", requires = "key")]
    cert: Option<PathBuf>,

    /// The security counter: a device refuses a program with a counter lower than the highest one
    /// that it has accepted.
    #[arg(long, value_name = "NUMBER", value_parser = number, requires = "key")]
    counter: Option<u32>,
}

impl Encryption {
    /// The parameters for sealing, if the result is to be encrypted.
    fn sealing(&self) -> Result<Option<Sealing>, Failure> {
        let Some(value) = self.key else { return Ok(None) };
        let (Some(sign), Some(counter)) = (&self.sign, self.counter) else {
            let missing: Vec<&str> = [("--sign", self.sign.is_none()), ("--counter", self.counter.is_none())]
                .into_iter()
                .filter_map(|(option, is_missing)| is_missing.then_some(option))
                .collect();
            let what =
                format!("coflash encrypts a program by sealing it, and {} is missing", missing.join(" and "));
            let advice =
                "give --sign with the private key that signs (and --cert with its certificate, unless it \
                          is a root), and --counter; or leave --key out: the file is not encrypted then";
            return Err(Failure::usage(what, advice));
        };
        Ok(Some(Sealing {
            kek: [Kek::of_value(value).map_err(|fault| Failure::system(fault.to_string()))?],
            key: keys::signing_key(sign)?,
            certificate: self.cert.as_deref().map(keys::certificate).transpose()?,
            counter,
        }))
    }
}

/// The parameters for sealing an encrypted program.
struct Sealing {
    kek: [Kek; 1],
    key: SigningKey,
    certificate: Option<[u8; CERTIFICATE]>,
    counter: u32,
}

impl Convert {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let sealing = self.encryption.sealing()?;
        let input = self.input.path();
        let output = self.output.clone().unwrap_or_else(|| input.with_extension("blk"));
        if same_file(input, &output) {
            let what = format!("the result would overwrite its own input {}", input.display());
            return Err(Failure::usage(what, "name another file for the result"));
        }
        let (firmware, _) = self.source.load(input, self.program)?;
        let is_done = matches!(firmware, Firmware::Blocks(_));
        let of_image = self.labels.vid.is_none() && matches!(firmware, Firmware::Image(_));
        if let Firmware::Blocks(program) = &firmware {
            // Blocks are copied unchanged, including their CRC.
            let (file, kept) = (input.display(), program.checksum());
            context.out.say(format_args!("{file}: this is already a block file; it keeps its {kept}"));
            if self.source.wants(kept) || self.labels.vid.is_some() {
                let advice = "convert the original firmware instead";
                context.out.warn(format_args!(
                    "{file}: --crc16, --vid and --pid cannot change a block file: {advice}"
                ));
            }
        }
        let done = self.source.convert(firmware, input, self.program, self.labels.label(input)?)?;
        warn(context, input, &done.notes, done.left_out);
        let program = &done.program;
        let (image, start) = (program.image(), program.start());
        let (board, file) = (self.source.layout()?, input.display());
        let judged = match start {
            // For the judge this is an image without addresses.
            0 => Err(Fault::Elsewhere { range: program.span(), area: Area::Alias }),
            _ => judge(image, start, board),
        };
        match (board, judged, StackAtEnd::of(image, start)) {
            (Some(_), Err(fault), _) => return Err(Failure::no_program(input, fault)),
            // Its addresses are those that a person has asked for.
            (None, Err(Fault::Elsewhere { area: Area::Alias, .. }), _)
                if self.source.adjusts() || is_done => {}
            // The manual's tool converts any data, and so does this one for a board that it does not know.
            (None, Err(fault), _) => context.out.warn(format_args!("{file}: {fault}: {}", fault.advice())),
            (None, Ok(()), Some(stack)) => context.out.warn(format_args!("{file}: {stack}")),
            (_, Ok(()), _) => {}
        }
        if sealing.is_none() {
            output_file::write(&output, &block_file::emit(program))?;
        }
        if self.temp {
            let name = output.with_extension("tmp");
            let flash = PathBuf::from(name.file_name().unwrap_or_default());
            output_file::write(&flash, &program.flash_image())?;
            context.out.say(format_args!("{}: the program as it lies in flash", flash.display()));
        }
        if let Some(sealing) = sealing {
            return self.seal(context, &output, program, &sealing);
        }
        if let (true, [Some(target), _], Some(release)) = (of_image, program.targets(), program.release()) {
            let Target { vendor_id, product_code } = target;
            let output = output.display();
            context.out.say(format_args!(
                "{output}: for vendor-ID {vendor_id:08X}h, product code {product_code:08X}h, version {}, \
                 as its label says",
                release.version
            ));
        }
        self.report(context, &output, &done);
        Ok(())
    }

    /// Writes the program sealed and encrypted.
    fn seal(
        &self,
        context: &Context,
        output: &Path,
        program: &Program,
        sealing: &Sealing,
    ) -> Result<(), Failure> {
        let Labels { vid, pid, ver, date, .. } = self.labels;
        let start = program.start();
        let program = ToSeal {
            path: self.input.path(),
            program,
            board: self.source.layout()?,
            identity: (vid, pid),
            options: ("--vid and --pid", "--vid and --pid"),
            version: ver,
        };
        program.judge()?;
        let sealer = program.sealer(Sealer {
            certificate: sealing.certificate,
            counter: sealing.counter,
            program: self.program,
            encrypt_for: &sealing.kek,
            created: date.unwrap_or(0),
            ..Sealer::default()
        })?;
        let image = program.seal(&sealer, &sealing.key)?;
        let is_plain = output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("cbs"));
        let form = match is_plain {
            true => Form::Plain,
            false => Form::Blocks { start, size: self.source.block_size() },
        };
        if self.encryption.add.is_some_and(|add| add != 0) {
            context.out.warn("--add has no effect: every sealed image has its own nonce");
        }
        let file = image::put(output, image, form)?;
        image::report(context, output, &file, true);
        Ok(())
    }

    fn report(&self, context: &Context, output: &Path, done: &Converted) {
        let Converted { program, left_out, .. } = done;
        let (start, size, crc) = (program.start(), program.size(), program.crc());
        let file = BlockFile::of(program);
        let count = file.blocks().len();
        let largest = file.blocks().iter().map(|block| block.data.len() + FRAMING).max();
        context.out.detail(format_args!(
            "{}, the largest block has {} bytes",
            file.checksum(),
            largest.unwrap_or_default()
        ));
        let words = format!(
            "{}: {count} blocks, program {size} bytes from {start:#010x} on, CRC {crc:08X}h",
            output.display()
        );
        context.result(words, || {
            json!({
                "output": output.display().to_string(),
                "blocks": count,
                "checksum": file.checksum().to_string(),
                "program": { "start": start, "size": size, "crc": crc },
                "left_out": left_out,
            })
        });
    }
}

impl Labels {
    /// The contents of block 0 for the program in this file.
    pub(super) fn label(&self, file: &Path) -> Result<Label, Failure> {
        // A build system may set the variable for all of its commands.
        let epoch = std::env::var("SOURCE_DATE_EPOCH").ok().and_then(|epoch| epoch.parse().ok());
        let is_without_date = self.no_label || self.vid.is_some() && self.ver.is_none();
        if is_without_date && self.date.is_some() && self.date != epoch {
            let advice = "give --ver, too, or leave out --date";
            return Err(Failure::usage("block 0 has no place for --date without --ver", advice));
        }
        if self.no_label {
            return Ok(Label::None);
        }
        let (Some(vendor_id), Some(product_code)) = (self.vid, self.pid) else {
            return Ok(Label::OfImage { date: self.date.unwrap_or(0) });
        };
        let Some(version) = self.ver else { return Ok(Label::Device { vendor_id, product_code }) };
        let date = match self.date {
            Some(date) => date,
            // The same file always gives the same block 0: otherwise a download that was cut off
            // could not go on.
            None => std::fs::metadata(file)
                .and_then(|about| about.modified())
                .ok()
                .and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok())
                .ok_or_else(|| Failure::system(format!("{}: it has no date: give --date", file.display())))?
                .as_secs(),
        };
        Ok(Label::Release { vendor_id, product_code, version, date })
    }
}
