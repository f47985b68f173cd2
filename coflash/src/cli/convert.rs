//! `coflash convert`: a firmware file into a block file.

use std::path::PathBuf;
use std::time::SystemTime;

use clap::Args;
use coflash::convert::Label;

use super::file::{warn_left_out, Input, Source};
use super::{number, program_number, Failure};

/// Converts a firmware file into a block file, ready for 1F50h.
///
/// The same input gives the same output, byte for byte; with --ver, if --date or SOURCE_DATE_EPOCH is given.
#[derive(Debug, Args)]
pub(super) struct Convert {
    #[command(flatten)]
    input: Input,

    /// The block file to write.
    #[arg(value_name = "OUT")]
    output: PathBuf,

    /// The program number on the board.
    #[arg(long, short = 'P', alias = "prog_no", value_name = "1..254", value_parser = program_number, default_value = "1")]
    program: u8,

    #[command(flatten)]
    source: Source,

    /// Vendor-ID of the devices that may take this program (1018h/1).
    #[arg(long, value_name = "NUMBER", value_parser = number, requires = "pid")]
    vid: Option<u32>,

    /// Product code of the devices that may take this program (1018h/2).
    #[arg(long, value_name = "NUMBER", value_parser = number, requires = "vid")]
    pid: Option<u32>,

    /// The program's version: major in bits 0-7, minor in bits 8-15, release in bits 16-31.
    #[arg(long, value_name = "NUMBER", value_parser = number, requires = "vid")]
    ver: Option<u32>,

    /// The date that goes with --ver, in seconds since 1970; otherwise SOURCE_DATE_EPOCH, otherwise now.
    #[arg(long, value_name = "SECONDS", env = "SOURCE_DATE_EPOCH")]
    date: Option<u64>,
}

impl Convert {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let input = &self.input.file;
        let done = self.source.blocks(input, self.program, self.label()?)?;
        warn_left_out(input, &done);
        let bytes = done.file.emit();
        std::fs::write(&self.output, &bytes).map_err(|error| {
            Failure::system(format!("{}: cannot be written: {error}", self.output.display()))
        })?;
        say!(
            "{}: {} blocks, program {} bytes from {:#010x} on, CRC {:08X}h",
            self.output.display(),
            done.file.blocks().len(),
            done.file.program_size(),
            done.file.span().last.wrapping_sub(done.file.program_size().wrapping_sub(1)),
            done.file.program_crc()
        );
        Ok(())
    }

    fn label(&self) -> Result<Label, Failure> {
        let (Some(vendor_id), Some(product_code)) = (self.vid, self.pid) else { return Ok(Label::None) };
        let Some(version) = self.ver else { return Ok(Label::Device { vendor_id, product_code }) };
        let date = match self.date {
            Some(date) => date,
            None => SystemTime::now()
                .duration_since(SystemTime::UNIX_EPOCH)
                .map_err(|_| Failure::system("the clock is set before 1970: give --date".to_string()))?
                .as_secs(),
        };
        Ok(Label::Release { vendor_id, product_code, version, date })
    }
}
