//! `coflash inspect`: shows the contents of a firmware file.

use clap::Args;
use coflash_core::file::inspect::Inspection;
use coflash_core::file::read::Firmware;
use serde_json::{json, Value};

use super::context::Context;
use super::file::{Input, Source};
use super::flash;
use super::output::Failure;
use super::package::{self, Trusted, Typed};
use super::seal::verify::{is_sealed, show};
use super::values::program_number;

/// Shows and checks the contents of a firmware file.
///
/// This checks every record, size and CRC, also those of a block file. Of a sealed image it checks
/// only the form; coflash seal verify checks the rest. A package for a machine is checked as before its update.
///
/// With --board it also checks that the program fits into its region of that board's flash. This
/// command needs no device.
#[derive(Debug, Args)]
pub(super) struct Inspect {
    // The first one: the parser takes each value out as it reads it.
    #[command(flatten)]
    typed: Typed,

    #[command(flatten)]
    input: Input,

    /// The program number on the board.
    #[arg(long, short = 'P', alias = "prog_no", value_name = "1..254", value_parser = program_number, default_value = "1")]
    program: u8,

    #[command(flatten)]
    source: Source,

    #[command(flatten)]
    trusted: Trusted,
}

impl Inspect {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = self.input.path();
        let is_package = package::is_package(path);
        self.typed.check(is_package, &flash::options())?;
        if is_package {
            return package::inspect(context, path, &self.trusted);
        }
        if is_sealed(path) {
            return show(context, path);
        }
        let (firmware, format) = self.source.load(path, self.program)?;
        // Report now what a conversion would refuse. Without a board there is no region for the
        // image to leave.
        let mut start = None;
        if self.source.has_region() || matches!(firmware, Firmware::Blocks(_)) {
            let done = self.source.convert(firmware.clone(), path, self.program, Default::default())?;
            start = Some(done.program.start());
        }
        let inspection = Inspection::of(&firmware, format, start, self.source.layout()?);
        context.result(format_args!("{}: {inspection}", path.display()), || value(&inspection));
        Ok(())
    }
}

fn value(inspection: &Inspection) -> Value {
    let segment =
        |range: &coflash_core::file::AddressRange| json!({ "first": range.first, "last": range.last });
    let gaps: Vec<_> = inspection.gaps().collect();
    let blocks = inspection.blocks.as_ref().map(|blocks| {
        let all: Vec<Value> = blocks
            .all
            .iter()
            .map(|block| {
                json!({
                    "number": block.number,
                    "address": block.flash_address,
                    "size": block.size,
                    "crc": block.crc,
                })
            })
            .collect();
        json!({
            "checksum": blocks.checksum.to_string(),
            "identity": blocks.identity().map(|id| json!({ "vendor_id": id.vendor_id, "product_code": id.product_code })),
            "release": blocks.release().map(|(version, date)| json!({
                "version": version.0, "version_text": version.to_string(), "date": date,
            })),
            "program": {
                "start": blocks.program_start, "size": blocks.program_size, "crc": blocks.program_crc,
            },
            "all": all,
        })
    });
    json!({
        "format": inspection.format.to_string(),
        "bytes": inspection.bytes,
        "segments": inspection.segments.iter().map(segment).collect::<Vec<_>>(),
        "gaps": gaps.iter().map(segment).collect::<Vec<_>>(),
        "software_version": inspection.software_version,
        "label": inspection.label.map(|label| json!({
            "vendor_id": label.vendor_id, "product_code": label.product_code, "version": label.version,
        })),
        "bootloader": inspection.bootloader.as_ref().map(|(header, _)| json!({
            "version": header.version, "size": header.total(), "crc": header.crc, "vendor_id": header.vendor,
            "product_code": header.product, "board": header.board, "services": header.services,
            "facts": header.facts,
        })),
        "fault": match inspection.bootloader {
            Some((_, judgement)) => judgement.err().map(|fault| fault.to_string()),
            None => inspection.judgement.err().map(|fault| fault.to_string()),
        },
        "stack_at_end_of_sram": inspection.stack_at_end.map(|at| at.stack),
        "notes": inspection.notes.iter().map(ToString::to_string).collect::<Vec<_>>(),
        "blocks": blocks,
    })
}
