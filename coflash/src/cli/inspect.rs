//! `coflash inspect`: what a firmware file holds, in words.

use clap::Args;
use coflash::file::inspect::Inspection;
use coflash::file::read::Firmware;
use serde_json::{json, Value};

use super::context::Context;
use super::file::{Input, Source};
use super::output::Failure;
use super::values::program_number;
use super::verify::{is_sealed, show};

/// Shows what a firmware file holds, and checks all of it.
///
/// That is every record, size and CRC, of a block file, too. Of a sealed image it is the form alone;
/// verify checks it.
///
/// With --board it also checks that the program lies where the board has room for it. No device is
/// needed.
#[derive(Debug, Args)]
pub(super) struct Inspect {
    #[command(flatten)]
    input: Input,

    /// The program number on the board.
    #[arg(long, short = 'P', alias = "prog_no", value_name = "1..254", value_parser = program_number, default_value = "1")]
    program: u8,

    #[command(flatten)]
    source: Source,
}

impl Inspect {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let path = self.input.path();
        if is_sealed(path) {
            return show(context, "inspect", path);
        }
        let (firmware, format) = self.source.load(path, self.program)?;
        // What conversion would refuse is worth knowing now; an image without a board has no region
        // to leave.
        let mut start = None;
        if self.source.has_region() || matches!(firmware, Firmware::Blocks(_)) {
            let done = self.source.convert(firmware.clone(), path, self.program, Default::default())?;
            start = Some(done.file.program_start());
        }
        let inspection = Inspection::of(&firmware, format, start);
        context.out.result(format_args!("{}: {inspection}", path.display()), || value(&inspection));
        Ok(())
    }
}

fn value(inspection: &Inspection) -> Value {
    let segment = |range: &coflash::file::AddressRange| json!({ "first": range.first, "last": range.last });
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
        "command": "inspect",
        "format": inspection.format.to_string(),
        "bytes": inspection.bytes,
        "segments": inspection.segments.iter().map(segment).collect::<Vec<_>>(),
        "gaps": gaps.iter().map(segment).collect::<Vec<_>>(),
        "software_version": inspection.software_version,
        "label": inspection.label.map(|label| json!({
            "vendor_id": label.vendor_id, "product_code": label.product_code, "version": label.version,
        })),
        "fault": inspection.judgement.err().map(|fault| fault.to_string()),
        "blocks": blocks,
    })
}
