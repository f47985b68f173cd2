//! From the bytes of a file to what a device gets.

use std::path::Path;

use seal::wire::BOOTLOADER;
use shared_abi::layout::Layout;

use super::dialect::is_data;
use super::payload::Payload;
use crate::device::{Dialect, Form};
use crate::file::convert::{program_of, ConvertError, Options, Region};
use crate::file::inspect::Inspection;
use crate::file::sealed::{blocks, carried, Refusal, SealedFile};
use crate::file::{judge, ram_image, read, Cause, Format, Note, ReadError};

/// How a file is judged before any request to a device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Judging {
    /// By all rules that need no device.
    #[default]
    Whole,
    /// Only by what the update itself cannot see: whether the stack leaves the handoff of the board alone.
    Handoff,
    /// Not at all: the device alone judges it.
    Nothing,
}

options! {
    /// What is known of the device, and chosen about a file for it.
    #[derive(Clone, Copy, Debug)]
    pub struct Reading {
        /// The program number: sub-index of 1F50h.
        pub program: u8 = 1,
        /// The format, in place of that of the first bytes and the name. A sealed image is one in
        /// any format.
        pub format: Option<Format> = None,
        /// The address of a raw binary, in place of the start of the board's region.
        pub address: Option<u32> = None,
        /// The memory map of the device: the program must lie in its region there.
        pub board: Option<&'static Layout> = None,
        /// The dialect of the device. `None` if it is found later: then a program above 1 may be
        /// data.
        pub dialect: Option<Dialect> = None,
        /// How a program is made of the memory contents. The board's region takes the place of the
        /// one in here.
        pub convert: Options = Options::default(),
        /// How the file is judged.
        pub judging: Judging = Judging::default(),
        /// Whether the contents are described, for people.
        pub inspect: bool = false,
    }
}

/// A file that was read for a device.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Loaded {
    /// What the device gets.
    pub payload: Payload,
    /// Bytes of the file outside the region, which are left out.
    pub left_out: u64,
    /// What is odd about the file.
    pub notes: Vec<Note>,
    /// The description of a program, if it was asked for.
    pub inspection: Option<Inspection>,
}

/// Why a file is nothing for the device. `Display` is the rest of a sentence that begins with the file.
#[derive(Debug, thiserror::Error)]
pub enum ContentFault {
    /// A bootloader with an unusable header.
    #[error("{0}")]
    Bootloader(ram_image::Fault),
    /// A sealed image that no such device takes.
    #[error("{0}")]
    Sealed(Refusal),
    /// The device has no program of this number.
    #[error("{board} has no program {program}")]
    NoProgram {
        /// The board.
        board: &'static str,
        /// The number.
        program: u8,
        /// How many programs the board has, from 1 on.
        programs: usize,
    },
    /// It cannot be read, or its data lie outside the region.
    #[error("{0}")]
    File(ReadError),
    /// No program can be made of it. Never [`ConvertError::File`].
    #[error("{0}")]
    Convert(ConvertError),
    /// It cannot be a program.
    #[error("{0}")]
    Judged(judge::Fault),
}

impl Reading {
    /// Reading for this program number, with nothing else known.
    #[must_use]
    pub fn new(program: u8) -> Self {
        Self { program, ..Self::default() }
    }

    /// Reads a file with this name: a bootloader, a sealed image, also one in blocks, or a program.
    ///
    /// # Errors
    /// See [`ContentFault`].
    pub fn read(&self, name: &Path, bytes: &[u8]) -> Result<Loaded, ContentFault> {
        let only = |payload| Loaded { payload, left_out: 0, notes: Vec::new(), inspection: None };
        if blocks::looks_like(bytes) {
            return self.sealed(bytes).map(only);
        }
        let format = self.format.or_else(|| Format::of(name, bytes));
        if let Some(new) = Payload::bootloader_in(bytes, format).map_err(ContentFault::Bootloader)? {
            return Ok(only(new));
        }
        let convert = self.convert.region(self.region()?);
        let raw_address = self.address.or_else(|| convert.raw_address()).or_else(|| {
            // These take an image without addresses.
            self.dialect.filter(|dialect| dialect.form() == Form::Image).map(|_| 0)
        });
        let firmware = read::read(bytes, format, raw_address).map_err(ContentFault::File)?;
        let described = format.filter(|_| self.inspect);
        let start = self.board.and(raw_address);
        let inspection = described.map(|format| Inspection::of(&firmware, format, start, self.board));
        let converted = program_of(firmware, &convert).map_err(|error| match error {
            ConvertError::File(error) => ContentFault::File(error),
            ConvertError::Judged(fault) => ContentFault::Judged(fault),
            error => ContentFault::Convert(error),
        })?;
        let (program, left_out, notes) = (converted.program, converted.left_out, converted.notes);
        let judged = judge::judge(program.image(), program.start(), self.board);
        let may_be_data = is_data(self.dialect.unwrap_or(Dialect::Lift), self.program);
        match (self.judging, judged) {
            (Judging::Whole, Err(fault)) if !may_be_data => return Err(ContentFault::Judged(fault)),
            (Judging::Handoff, Err(fault @ judge::Fault::StackOverHandoff { .. })) => {
                return Err(ContentFault::Judged(fault));
            }
            _ => {}
        }
        Ok(Loaded { payload: program.into(), left_out, notes, inspection })
    }

    /// Reads a sealed image, which stays unchanged: only the keys of a device open it.
    fn sealed(&self, bytes: &[u8]) -> Result<Payload, ContentFault> {
        let image = carried(bytes.to_vec()).map_err(ContentFault::File)?.image;
        let file = SealedFile::parse(image).map_err(ContentFault::Sealed)?;
        let image = file.head().program();
        if self.judging != Judging::Nothing && ![self.program, BOOTLOADER].contains(&image) {
            return Err(ContentFault::Sealed(Refusal::Program { image, device: self.program }));
        }
        Ok(file.into())
    }

    /// The region of the program.
    fn region(&self) -> Result<Region, ContentFault> {
        let Some(board) = self.board else { return Ok(self.convert.region) };
        let (name, programs) = (board.board, board.programs.len());
        let region = board.program(self.program);
        let region =
            region.ok_or(ContentFault::NoProgram { board: name, program: self.program, programs })?;
        Ok(Region::Strict(region.into()))
    }
}

impl ContentFault {
    /// Whether the file is a raw binary, and nothing says where it belongs.
    #[must_use]
    pub fn is_without_address(&self) -> bool {
        matches!(self, Self::File(ReadError { cause: Cause::NoAddress, .. }))
    }
}
