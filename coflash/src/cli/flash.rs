//! `coflash flash`: a program into a device.

use clap::Args;
use coflash::flash::{flash, FlashOptions};
use serde_json::json;

use super::convert::Labels;

use super::file::{warn_left_out, Input, Source};
use super::output::Failure;
use super::progress::Progress;
use super::values::{number, program_number};
use super::{Context, Device};

/// Puts a program into a device and starts it.
///
/// Takes a block file, or any other firmware file and converts it on the fly. The file is read and checked completely
/// before the device is touched.
#[derive(Debug, Args)]
pub(super) struct Flash {
    #[command(flatten)]
    input: Input,

    #[command(flatten)]
    device: Device,

    /// The program number: sub-index of 1F50h.
    #[arg(long, short = 'P', alias = "prog_no", value_name = "1..254", value_parser = program_number, default_value = "1")]
    program: u8,

    #[command(flatten)]
    source: Source,

    #[command(flatten)]
    labels: Labels,

    /// Start the program once, and call it back, before it is signed.
    #[arg(long, alias = "chk_run")]
    trial_run: bool,

    /// Leave the device in the bootloader.
    #[arg(long)]
    no_start: bool,

    /// How often one block is sent again after a CRC error or a broken transfer.
    #[arg(long, value_name = "TIMES", value_parser = number, default_value = "3")]
    repeats: u32,
}

impl Flash {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        let file = self.input.path();
        let done = self.source.blocks(file, self.program, self.labels.label()?)?;
        warn_left_out(context, file, &done);
        let (size, crc) = (done.file.program_size(), done.file.program_crc());
        context.out.say(format_args!("{}: program of {size} bytes, CRC {crc:08X}h", file.display()));
        let options = FlashOptions {
            program: self.program,
            repeats: self.repeats,
            trial_run: self.trial_run,
            start: !self.no_start,
        };
        let mut adapter = context.open()?;
        let mut session = self.device.session(&mut *adapter)?;
        let mut progress = Progress::new(context.out);
        let result = flash(&mut session, &done.file, &options, &mut |event| progress.show(event));
        progress.finish();
        let report = result?;
        let seconds = report.took.as_secs_f64();
        let repeats = match report.repeats {
            0 => String::new(),
            1 => ", 1 block sent again".to_string(),
            blocks => format!(", {blocks} blocks sent again"),
        };
        context.out.result(format_args!("done in {seconds:.1} s{repeats}"), || json!({ "command": "flash" }));
        Ok(())
    }
}
