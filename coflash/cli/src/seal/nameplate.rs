//! `coflash seal nameplate`: makes the identity of an OEM's device, for production.

use std::path::PathBuf;

use clap::Args;
use coflash_core::file::ihex;
use coflash_core::file::nameplate::{nameplate, LAST_BLOCK};
use serde_json::json;
use shared_abi::nameplate::Nameplate;

use crate::context::Context;
use crate::output::Failure;
use crate::output_file::write;
use crate::values::number;

/// Makes a nameplate, the identity of an OEM's device.
///
/// It is the identity (1018h) for the one-time programmable bytes of the device's chip.
///
/// The programmer of the production line writes the file; no bootloader and no tool over CAN does. It
/// counts for a bootloader whose product has the choice identity = Otp. The last good nameplate counts,
/// so one in a later block corrects a mistake.
#[derive(Debug, Args)]
pub(crate) struct MakeNameplate {
    /// The file to write, Intel HEX.
    #[arg(value_name = "OUT")]
    output: PathBuf,

    /// The vendor-ID of the OEM (1018h/1).
    #[arg(long, value_parser = number, value_name = "NUMBER")]
    vendor: u32,

    /// The product code (1018h/2).
    #[arg(long, value_parser = number, value_name = "NUMBER")]
    product: u32,

    /// The revision number (1018h/3).
    #[arg(long, value_parser = number, value_name = "NUMBER")]
    revision: u32,

    /// The serial number (1018h/4); 0 for a fold of the unique ID of the chip.
    #[arg(long, value_parser = number, value_name = "NUMBER", default_value = "0")]
    serial: u32,

    /// The block of the one-time programmable bytes, 0 to 15: the first one that is blank.
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=i64::from(LAST_BLOCK)), default_value = "0")]
    block: u8,

    /// Lock this block and those after it for good: otherwise a program can still damage the nameplate, or
    /// write another one.
    #[arg(long)]
    lock: bool,
}

impl MakeNameplate {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let Self { output, vendor, product, revision, serial, block, lock } = self;
        let plate = Nameplate::new(*vendor, *product, *revision, *serial);
        let image = nameplate(&plate, *block, *lock);
        write(output, ihex::emit(&image).as_bytes())?;
        let address = image.span().first;
        let words = format!(
            "{}: nameplate for block {block}, {address:08X}h{}\n  vendor-ID {vendor:08X}h, product code \
             {product:08X}h, revision {revision:08X}h, serial number {serial:08X}h{}",
            output.display(),
            if *lock { ", which it locks with those after it" } else { "" },
            if *serial == 0 { ": the chip's own" } else { "" },
        );
        context.result(words, || {
            json!({
                "output": output.display().to_string(),
                "block": block,
                "address": address,
                "vendor_id": vendor,
                "product_code": product,
                "revision": revision,
                "serial_number": serial,
                "locked": lock,
            })
        });
        Ok(())
    }
}
