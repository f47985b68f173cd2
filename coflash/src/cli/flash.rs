//! `coflash flash`: a program into a device.

use std::time::Duration;

use clap::Args;
use coflash::convert::Converted;
use coflash::flash::{flash, DeviceState, Event, FlashOptions, Report, Target};
use coflash::session::Transfers;
use serde_json::{json, Value};

use super::convert::Labels;
use super::device::Program;
use super::file::{warn_left_out, Input, Source};
use super::legacy::Legacy;
use super::output::Failure;
use super::progress::Progress;
use super::values::number;
use super::Context;

/// Puts a program into a device and starts it.
///
/// Takes a block file, or any other firmware file and converts it on the fly. The file is read and checked completely
/// before the device is touched. An update that was interrupted can be started again at once.
///
/// The options of BinaryBlockDownload and DotNetFlashtool are accepted in their own spelling, too (-F, --node_id,
/// --prog_no, --chk_tgt, --chk_run, --sdo_timeout, --timeout and so on).
#[derive(Debug, Args)]
pub(super) struct Flash {
    #[command(flatten)]
    input: Input,

    #[command(flatten)]
    program: Program,

    #[command(flatten)]
    source: Source,

    #[command(flatten)]
    labels: Labels,

    /// Compare vendor-ID and product code of file and device before anything is erased.
    #[arg(long)]
    check_target: bool,

    /// Start the program once, and call it back, before it is signed.
    #[arg(long, alias = "chk_run")]
    trial_run: bool,

    /// Leave the device in the bootloader.
    #[arg(long)]
    no_start: bool,

    /// Compare the program's CRC once more at the very end, as the running program tells it.
    #[arg(long)]
    verify: bool,

    /// How often one block is sent again after a CRC error or a broken transfer.
    #[arg(long, value_name = "TIMES", value_parser = number, default_value = "3")]
    block_repeats: u32,

    #[command(flatten)]
    legacy: Legacy,
}

impl Flash {
    pub(super) fn run(&self, context: &Context) -> Result<(), Failure> {
        self.legacy.check(context)?;
        let file = self.input.path();
        let done = self.source.blocks(file, self.program.program, self.labels.label()?)?;
        warn_left_out(context, file, &done);
        let options = self.options(&done)?;
        let (size, crc) = (done.file.program_size(), done.file.program_crc());
        context.out.say(format_args!("{}: program of {size} bytes, CRC {crc:08X}h", file.display()));
        let mut adapter = context.open_at(self.legacy.bit_rate())?;
        let mut session = self.program.device.session(&mut *adapter)?;
        let mut progress = Progress::new(context.out);
        let mut left = None;
        let result = flash(&mut session, &done.file, &options, &mut |event| match event {
            Event::Left(state) => left = Some(state),
            event => progress.show(event),
        });
        progress.finish();
        let report = result.map_err(|error| Failure::from(error).leaving(left))?;
        context.out.result(Done(&report), || {
            let mut value = value(&report);
            value["command"] = "flash".into();
            value["node"] = session.node().get().into();
            value["program"] = self.program.program.into();
            value
        });
        Ok(())
    }

    fn options(&self, done: &Converted) -> Result<FlashOptions, Failure> {
        let check_target = if self.check_target || self.legacy.check_target() {
            let advice = "convert it with --vid and --pid, or give them here";
            let unnamed = || Failure::usage("the file does not say for which device it is", advice);
            Some(Target::of(&done.file).ok_or_else(unnamed)?)
        } else {
            None
        };
        Ok(FlashOptions {
            program: self.program.program,
            repeats: self.block_repeats,
            check_target,
            trial_run: self.trial_run,
            start: !self.no_start,
            verify: self.verify,
        })
    }
}

/// The last line for people.
struct Done<'r>(&'r Report);

impl std::fmt::Display for Done<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "done in {:.1} s", self.0.took.as_secs_f64())?;
        match self.0.repeats {
            0 => Ok(()),
            1 => f.write_str(", 1 block sent again"),
            blocks => write!(f, ", {blocks} blocks sent again"),
        }
    }
}

/// For programs.
fn value(report: &Report) -> Value {
    let seconds = |time: Duration| (time.as_secs_f64() * 1000.0).round() / 1000.0;
    json!({
        "size": report.program_size,
        "crc": report.program_crc,
        "blocks_repeated": report.repeats,
        "seconds": seconds(report.took),
        "transfer_seconds": seconds(report.transfer),
        "transfer": match report.transfers {
            Transfers::Blocks => "blocks",
            Transfers::Segments => "segments",
        },
        "running": report.running.map(|running| running.0),
    })
}

/// For programs.
pub(super) fn state_word(state: DeviceState) -> &'static str {
    match state {
        DeviceState::Untouched => "untouched",
        DeviceState::Called => "called",
        DeviceState::Erased => "erased",
        DeviceState::Unsigned => "unsigned",
        DeviceState::Signed => "signed",
    }
}
