//! The options for the firmware file and how to read it, shared by `convert` and `flash`.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use clap::{Args, ValueEnum};
use coflash_core::file::checksum::Checksum;
use coflash_core::file::convert::{
    program_of, Converted, GapFill, Label, Options, Region, DEFAULT_BLOCK_SIZE,
};
use coflash_core::file::program::LastBlock;
use coflash_core::file::read::{self, Firmware, Format};
use coflash_core::file::{self, limit, AddressRange, Note};
use coflash_core::update::{Reading, JOINED_BLOCKS};
use shared_abi::layout;

use super::context::Context;
use super::output::Failure;
use super::values::number;

/// The board, by its name or by a file.
#[derive(Clone, Debug, Default, Args)]
pub(super) struct MemoryMap {
    /// The board whose memory map applies; data outside its program region are refused. A board that this
    /// tool was not built with is a file, NAME.toml, as `cargo xtask layout --toml` writes it.
    #[arg(long, alias = "layout", value_name = "BOARD|FILE", value_parser = file::board::word)]
    board: Option<String>,

    /// Its memory map, after it was found.
    #[arg(skip)]
    loaded: OnceLock<&'static layout::Layout>,
}

impl MemoryMap {
    /// The memory map, if the user named one.
    pub(super) fn layout(&self) -> Result<Option<&'static layout::Layout>, Failure> {
        let Some(word) = &self.board else { return Ok(None) };
        if let Some(layout) = self.loaded.get() {
            return Ok(Some(layout));
        }
        let layout = file::board::named(word).map_err(Failure::board)?;
        Ok(Some(self.loaded.get_or_init(|| layout)))
    }
}

/// The place of a program, and the format of its file.
#[derive(Clone, Debug, Args)]
pub(super) struct Place {
    #[command(flatten)]
    map: MemoryMap,

    /// The first address of the program's region; data below it are left out.
    #[arg(long, alias = "start_address", value_name = "ADDRESS", value_parser = number, conflicts_with = "board")]
    start_address: Option<u32>,

    /// The last address of the program's region; data above it are left out.
    #[arg(long, alias = "end_address", value_name = "ADDRESS", value_parser = number, conflicts_with = "board", hide_short_help = true)]
    end_address: Option<u32>,

    /// The number that is added to every address of the file (0xF8000000 subtracts 0x08000000).
    #[arg(long, alias = "adjust_start", value_name = "OFFSET", value_parser = number, default_value = "0", hide_short_help = true)]
    adjust_start: u32,

    /// The file's format, if the first bytes do not show it.
    #[arg(short = 'I', long = "input-format", value_name = "FORMAT", ignore_case = true)]
    format: Option<FormatName>,
}

/// How to read a firmware file and cut it into blocks.
#[derive(Clone, Debug, Args)]
pub(super) struct Source {
    #[command(flatten)]
    place: Place,

    /// The size of a block in bytes, including its 16 bytes of framing: at most the bootloader's
    /// buffer. The default is 0x400; an update joins them up to 0x1000 where the device takes that.
    #[arg(long, alias = "block_size", value_name = "BYTES", value_parser = number, hide_short_help = true)]
    block_size: Option<u32>,

    /// The value that fills gaps inside a block: a byte, or a 32-bit pattern.
    #[arg(long, alias = "gap_fill", value_name = "VALUE", value_parser = number, default_value = "0xFFFFFFFF", hide_short_help = true)]
    gap_fill: u32,

    /// The longest gap inside a block, in bytes; a longer gap starts a new block. The default is
    /// the room in the block.
    #[arg(long, alias = "block_max_gap", value_name = "BYTES", value_parser = number, hide_short_help = true)]
    block_max_gap: Option<u32>,

    /// Protect blocks and program with the 16-bit CRC (polynomial 1021h), for a bootloader that was
    /// built for it.
    #[arg(long, hide_short_help = true)]
    crc16: bool,

    /// Put 32 reserved bytes into the last block before size and CRC of the program, for a
    /// bootloader of 2008 (manual L-1112e_5).
    #[arg(long, hide_short_help = true)]
    last_block_2008: bool,
}

const _: () = assert!(DEFAULT_BLOCK_SIZE == 0x400 && JOINED_BLOCKS == 0x1000, "the help text says so");

#[derive(Clone, Copy, Debug, ValueEnum)]
enum FormatName {
    /// Intel HEX.
    #[value(alias = "hex")]
    Ihex,
    /// Motorola S-record.
    #[value(aliases = ["s1", "s2", "s3", "s5", "s9"])]
    Srec,
    /// ELF executable.
    Elf,
    /// Raw binary; needs --start-address or --board.
    #[value(alias = "bin")]
    Binary,
    /// Block file.
    Block,
}

impl From<FormatName> for Format {
    fn from(name: FormatName) -> Self {
        match name {
            FormatName::Ihex => Self::IntelHex,
            FormatName::Srec => Self::SRecord,
            FormatName::Elf => Self::Elf,
            FormatName::Binary => Self::Raw,
            FormatName::Block => Self::BlockFile,
        }
    }
}

impl Source {
    /// Whether the addresses of the program are moved.
    pub(super) const fn adjusts(&self) -> bool {
        self.place.adjust_start != 0
    }

    /// Reads `file`; also returns its format.
    pub(super) fn load(&self, file: &Path, program: u8) -> Result<(Firmware, Format), Failure> {
        self.place.load(file, program)
    }

    /// Makes a program of a file that was read.
    pub(super) fn convert(
        &self,
        firmware: Firmware,
        file: &Path,
        program: u8,
        label: Label,
    ) -> Result<Converted, Failure> {
        let options = self.options(self.place.options(program)?, label);
        let mut done = program_of(firmware, &options).map_err(|error| Failure::convert(error, file))?;
        done.notes.extend(Note::of_staging(done.program.span(), self.layout()?));
        Ok(done)
    }

    /// How to read a file for program `number` of a device. Whether its board has such a program is of no
    /// matter for a file that says where it belongs.
    pub(super) fn reading(&self, program: u8, label: Label) -> Result<Reading, Failure> {
        let board = self.layout()?;
        let place = match board {
            Some(_) => Options::default().adjust_start(self.place.adjust_start),
            None => self.place.options(program)?,
        };
        let convert = self.options(place, label);
        Ok(Reading::new(program).format(self.format()).board(board).convert(convert))
    }

    /// The options of a conversion, for this place.
    fn options(&self, place: Options, label: Label) -> Options {
        place
            .block_size(self.block_size())
            .gap_fill(GapFill::new(self.gap_fill))
            .label(label)
            .checksum(if self.crc16 { Checksum::Crc16 } else { Checksum::Crc32 })
            .max_gap(self.block_max_gap)
            .last_block(if self.last_block_2008 { LastBlock::Of2008 } else { LastBlock::Of2015 })
    }

    /// The same options for another board.
    pub(super) fn for_board(&self, name: &str) -> Self {
        let map = MemoryMap { board: Some(name.to_owned()), ..MemoryMap::default() };
        let place = Place { map, ..self.place.clone() };
        Self { place, ..self.clone() }
    }

    /// The memory map of the device, if the options give one.
    pub(super) fn layout(&self) -> Result<Option<&'static layout::Layout>, Failure> {
        self.place.layout()
    }

    /// The format of the file, if the user has named it.
    pub(super) fn format(&self) -> Option<Format> {
        self.place.format.map(Format::from)
    }

    /// The size of a block in bytes, including framing.
    pub(super) fn block_size(&self) -> usize {
        self.block_size.map_or(DEFAULT_BLOCK_SIZE, |size| size as usize)
    }

    /// The size of a block for devices that are updated together; `None` for the file's blocks.
    pub(super) fn joined_blocks(&self) -> Option<usize> {
        self.block_size.is_none().then_some(JOINED_BLOCKS)
    }

    /// Whether the user asked for another CRC than the file's CRC `kept`.
    pub(super) fn wants(&self, kept: Checksum) -> bool {
        self.crc16 && kept != Checksum::Crc16
    }

    /// Whether the options give the program's region.
    pub(super) fn has_region(&self) -> bool {
        let Place { map, start_address, end_address, .. } = &self.place;
        map.board.is_some() || start_address.is_some() || end_address.is_some()
    }
}

impl Place {
    /// The memory map of the device, if the options give one.
    pub(super) fn layout(&self) -> Result<Option<&'static layout::Layout>, Failure> {
        self.map.layout()
    }

    /// Reads `file` for program `number`; also returns its format.
    pub(super) fn load(&self, file: &Path, program: u8) -> Result<(Firmware, Format), Failure> {
        let raw_address = self.options(program)?.raw_address();
        Ok(read::load_telling(file, self.format.map(Format::from), raw_address)?)
    }

    /// The options of a conversion for this place.
    pub(super) fn options(&self, program: u8) -> Result<Options, Failure> {
        Ok(Options::default().region(self.region(program)?).adjust_start(self.adjust_start))
    }

    /// The program's start address, if the options give it; the firmware is not read.
    pub(super) fn start(&self, program: u8) -> Result<Option<u32>, Failure> {
        Ok(match self.region(program)? {
            Region::Unknown | Region::CutBehind(_) => None,
            Region::Strict(range) => Some(range.first),
            Region::Cut(range) => Some(range.first.wrapping_add(self.adjust_start)),
        })
    }

    fn region(&self, program: u8) -> Result<Region, Failure> {
        match (self.map.layout()?, self.start_address, self.end_address) {
            (Some(layout), ..) => match layout.program(program) {
                Some(region) => Ok(Region::Strict(region.into())),
                None => Err(Failure::no_such_program(layout.board, program, layout.programs.len())),
            },
            (None, None, None) => Ok(Region::Unknown),
            (None, None, Some(last)) => Ok(Region::CutBehind(last)),
            (None, Some(first), last) => {
                let last = last.unwrap_or(AddressRange::ALL.last);
                Ok(Region::Cut(AddressRange { first, last }))
            }
        }
    }
}

/// The device's other program as it lies in flash: from a firmware file, or from the bytes of the
/// flash.
pub(super) fn base(path: &Path) -> Result<Vec<u8>, Failure> {
    let bytes = limit::read(path).map_err(|cause| Failure::file(path, cause))?;
    if bytes.is_empty() {
        return Err(Failure::file(path, "is empty"));
    }
    if Format::detect(&bytes).is_none() {
        return Ok(bytes);
    }
    let firmware = read::read(&bytes, None, None).map_err(|error| error.of(path.display()))?;
    let done = program_of(firmware, &Options::default()).map_err(|error| Failure::convert(error, path))?;
    Ok(done.program.flash_image().into_owned())
}

/// A firmware file as a positional argument.
#[derive(Debug, Args)]
pub(super) struct Input {
    /// The firmware: Intel HEX, Motorola S-record, ELF, raw binary or block file.
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

impl Input {
    pub(super) fn path(&self) -> &Path {
        &self.file
    }
}

/// The first bytes of a regular file; none if it cannot be read. A pipe would wait for its other end.
pub(super) fn front(path: &Path, max: usize) -> Vec<u8> {
    let mut front = Vec::new();
    let is_file = std::fs::metadata(path).is_ok_and(|about| about.is_file());
    let file = is_file.then(|| File::open(path).ok()).flatten();
    if let Some(file) = file {
        // The command that reads the whole file reports an error.
        let _ = file.take(max as u64).read_to_end(&mut front);
    }
    front
}

/// Reads a whole firmware file.
pub(super) fn bytes(path: &Path) -> Result<Vec<u8>, Failure> {
    Ok(limit::read(path).map_err(|cause| file::Place::File.fault(cause).of(path.display()))?)
}

/// Warns of what is odd about the file, and if data were left out.
pub(super) fn warn(context: &Context, file: &Path, notes: &[Note], left_out: u64) {
    for note in notes {
        context.out.warn(format_args!("{}: {note}", file.display()));
    }
    if left_out > 0 {
        context.out.warn(format_args!(
            "{}: {left_out} bytes outside the address range were left out [0x60002001]",
            file.display()
        ));
    }
}

/// Whether two names refer to one file, as far as this can be determined.
pub(super) fn same_file(one: &Path, other: &Path) -> bool {
    let canonical = |path: &Path| path.canonicalize().ok();
    one == other || canonical(one).is_some_and(|one| canonical(other) == Some(one))
}
