//! `coflash seal factory`: one file for production.

use std::path::PathBuf;

use canopen::{BitRate, NodeId};
use clap::Args;
use coflash_core::device::option_bytes::{sector_list, OptionBytes};
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::factory::{Bootloader, First};
use coflash_core::file::label::{self, label_of};
use coflash_core::file::sealed::provision::protected_sectors;
use coflash_core::file::sealed::SealedFile;
use coflash_core::file::{elf, ihex, load, read, Format, Image, Note};
use serde_json::json;
use shared_abi::block_file::ProgramVersion;
use shared_abi::layout::Layout;
use shared_abi::ram_image::Version;

use crate::context::Context;
use crate::file::{same_file, warn, MemoryMap};
use crate::lss::bit_rate;
use crate::output::Failure;
use crate::output_file::{write, write_secret};
use crate::seal::provision::bootloader;
use crate::seal::verify;
use crate::values::{node_id, program_number};

/// Joins bootloader and first program into one file for production.
///
/// A device from the line starts the program at its first power-on, without CAN: the file has the record
/// that the device itself would have stored, released and not yet confirmed.
///
/// Whatever the device would refuse is refused. A programmer has to erase all sectors that it writes.
#[derive(Debug, Args)]
pub(crate) struct Factory {
    /// The bootloader of the build; for sealed devices the file of `coflash seal provision`.
    #[arg(value_name = "BOOTLOADER")]
    bootloader: PathBuf,

    /// The first program: firmware, a block file or, for sealed devices, a sealed image.
    #[arg(value_name = "PROGRAM")]
    first: PathBuf,

    /// The file to write; its name ends with .hex (Intel HEX), .elf or .bin (from the start of the flash).
    #[arg(long, short, value_name = "OUT")]
    output: PathBuf,

    /// The program number on the board.
    #[arg(long, short = 'P', value_name = "1..254", value_parser = program_number, default_value = "1")]
    program: u8,

    #[command(flatten)]
    map: MemoryMap,

    /// The node-ID of the device; by default that of the board, or none, which LSS assigns.
    #[arg(long, value_name = "1..127", value_parser = node_id, requires = "bit_rate")]
    node_id: Option<NodeId>,

    /// Its bit rate in kbit/s: 10, 20, 50, 100, 125, 250, 500, 800 or 1000.
    #[arg(long, value_name = "KBITS", value_parser = bit_rate, requires = "node_id")]
    bit_rate: Option<BitRate>,

    /// The file of `coflash seal nameplate`, with the identity of the device.
    #[arg(long, value_name = "FILE")]
    nameplate: Option<PathBuf>,

    /// Also write this text, with the option bytes as commands for the programmer; needs --brown-out.
    ///
    /// The write protection is that of the bootloader's sectors.
    #[arg(long, value_name = "FILE", requires = "brown_out")]
    option_bytes: Option<PathBuf>,

    /// The level of the brown-out reset: 3 for a supply of 3.0 V and more, 2 from 2.7 V, 1 from 2.4 V.
    #[arg(long, value_name = "LEVEL", value_parser = clap::value_parser!(u32).range(1..=3), requires = "option_bytes")]
    brown_out: Option<u32>,

    /// Replace an existing file.
    #[arg(long = "force")]
    overwrite: bool,
}

impl Factory {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let Self { bootloader: path, output, .. } = self;
        let unnamed = || Failure::usage("the places of the parts are unknown", "give --board");
        let layout = self.map.layout()?.ok_or_else(unnamed)?;
        let format = self.format()?;
        let inputs = [Some(path), Some(&self.first), self.nameplate.as_ref()];
        if inputs.into_iter().flatten().any(|input| same_file(input, output)) {
            let what = format!("the result would overwrite {}", output.display());
            return Err(Failure::usage(what, "name another file for the result: --output"));
        }
        let refused = |fault| Failure::file(path, fault);
        let mut boot = Bootloader::new(bootloader(path, layout)?, layout).map_err(refused)?;
        if let Some(plate) = &self.nameplate {
            let read::Firmware::Image(image) = load(plate, None, None)? else {
                return Err(Failure::file(plate, "is a block file: give the file of coflash seal nameplate"));
            };
            boot = boot.with_nameplate(&image).map_err(|fault| Failure::file(plate, fault))?;
        }
        if let Some((id, bit_rate)) = self.node_id.zip(self.bit_rate) {
            boot = boot.with_node(id.get(), bit_rate as u8).map_err(refused)?;
        }
        let first = self.first(context, &boot, layout)?;
        warn(context, &self.first, Note::of_staging(first.image.span(), Some(layout)).as_slice(), 0);
        let image = boot.join(&first);
        let bytes = match format {
            Format::Elf => {
                let reset = image.bytes(layout.bootloader.base + 4);
                elf::emit(&image, reset.map_or(0, u32::from_le_bytes))
            }
            Format::Raw => image.filled().into_owned(),
            _ => ihex::emit(&image).into_bytes(),
        };
        // With key-encryption keys in it, it is as secret as they are.
        write_secret(output, bytes, self.overwrite)?;
        let protect = protected_sectors(&image, layout);
        let options = self.brown_out.map(|level| OptionBytes::of_product(level, protect));
        if let (Some(options), Some(file)) = (options, &self.option_bytes) {
            write(file, options.commands(layout.chip.chip).as_bytes())?;
        }
        self.report(context, &boot, &first, (&image, layout, protect, options));
        Ok(())
    }

    /// The first program with its record.
    fn first(&self, context: &Context, boot: &Bootloader, layout: &Layout) -> Result<First, Failure> {
        let (path, number) = (&self.first, self.program);
        let refused = |fault| Failure::file(path, fault);
        let count = layout.programs.len();
        let none = || Failure::no_such_program(layout.board, number, count);
        let region = layout.program(number).ok_or_else(none)?;
        if verify::is_sealed(path) {
            let file = SealedFile::parse(verify::read(path)?.image);
            let file = file.map_err(|refusal| Failure::sealed(path, &refusal))?;
            return boot.sealed(number, &file).map_err(refused);
        }
        let options = Options::default().region(Region::Strict(region.into())).checksum(boot.checksum());
        let firmware = load(path, None, options.raw_address())?;
        let done = program_of(firmware, &options).map_err(|error| Failure::convert(error, path))?;
        warn(context, path, &done.notes, 0);
        boot.plain(number, &done.program).map_err(refused)
    }

    /// The format of the file, by its name.
    fn format(&self) -> Result<Format, Failure> {
        let name = self.output.extension().unwrap_or_default().to_ascii_lowercase();
        match name.to_str() {
            Some("hex") => Ok(Format::IntelHex),
            Some("elf") => Ok(Format::Elf),
            Some("bin") if self.nameplate.is_some() => {
                let what = "a raw image has no place for a nameplate, which is outside the flash";
                Err(Failure::usage(what, "name the file with .hex or .elf"))
            }
            Some("bin") => Ok(Format::Raw),
            _ => {
                let what = format!("{}: the format is not known", self.output.display());
                Err(Failure::usage(what, "name the file with .hex, .elf or .bin"))
            }
        }
    }

    fn report(
        &self,
        context: &Context,
        boot: &Bootloader,
        first: &First,
        (image, layout, protect, options): (&Image, &Layout, u32, Option<OptionBytes>),
    ) {
        let (output, record, header) = (self.output.display(), &first.record, &boot.header);
        let by_itself = boot.starts_by_itself(first.number);
        let start = match by_itself {
            Some(true) => "starts by itself",
            Some(false) => "waits for START: the product has no autostart for it",
            None => "a function of the product says whether it starts",
        };
        let (version, bytes) = (ProgramVersion(record.version), image.byte_count());
        let of = |(vendor, product)| format!("vendor-ID {vendor:08X}h, product code {product:08X}h");
        let identity = boot.identity().map_or_else(|| "that of the board".to_string(), of);
        let plate = match &boot.nameplate {
            Some(plate) => format!(" by the nameplate, serial number {:08X}h", plate.serial_number),
            None => String::new(),
        };
        let node = match boot.node {
            Some((id, rate)) => format!("{id}, {} kbit/s", bits_per_second(rate).unwrap_or(0) / 1000),
            None => "that of the board, or by LSS".to_string(),
        };
        let label = label_of(&first.image, first.image.span().first);
        let label = label.map_or_else(|| "none".to_string(), |label| label::Words(&label).to_string());
        let is_sealed = boot.is_sealed();
        let options_said = options
            .map_or_else(|| format!("to be set: nWRP of {}", sector_list(protect)), |it| it.to_string());
        let words = format!(
            "{output}: for {}, {bytes} bytes\n  bootloader    version {}, CRC {:08X}h, {}\n  identity      \
             {identity}{plate}\n  node-ID       {node}\n  program {}     {} bytes, CRC {:08X}h, version {version}; \
             released, not confirmed; {start}\n  label         {label}\n  option bytes  {options_said}",
            layout.board,
            Version(header.version),
            header.crc,
            if is_sealed { "with keys: sealed programs alone" } else { "open: any program" },
            first.number,
            record.size,
            record.crc,
        );
        context.result(words, || {
            json!({
                "output": output.to_string(),
                "board": layout.board,
                "bytes": bytes,
                "bootloader": { "version": header.version, "crc": header.crc, "sealed": is_sealed },
                "identity": boot.identity().map(|(vendor, product)| json!({ "vendor_id": vendor, "product_code": product })),
                "node_id": boot.node.map(|(id, _)| id),
                "bit_rate": boot.node.and_then(|(_, rate)| bits_per_second(rate)),
                "program": {
                    "number": first.number,
                    "size": record.size,
                    "crc": record.crc,
                    "version": record.version,
                    "released": record.signed,
                    "starts_by_itself": by_itself,
                },
                "option_bytes": options,
                "protect": protect,
            })
        });
    }
}

/// A bit rate of the table in CiA 305; `None` for the one that the device finds.
fn bits_per_second(index: u8) -> Option<u32> {
    BitRate::from_index(index).and_then(BitRate::bits_per_second)
}
