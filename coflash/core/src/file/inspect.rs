//! Describes the contents of a firmware file without a device. The readers have already checked the
//! file.

use std::fmt;

use shared_abi::block_file::{Control, Identity, ProgramVersion, NUMBER_CONTROL, NUMBER_LAST};
use shared_abi::label::Label;
use shared_abi::layout::Layout;
use shared_abi::ram_image::{Header, Version};

use super::area::Area;
use super::block_file::{Block, BlockFile};
use super::checksum::Checksum;
use super::image::Image;
use super::judge::{judge, Fault, StackAtEnd};
use super::label::{label_of, Words};
use super::note::Note;
use super::program::Program;
use super::ram_image::{self, RamImage};
use super::range::AddressRange;
use super::read::{Firmware, Format};
use crate::advice::Advice;

/// The contents of a firmware file. `Display` describes them for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Inspection {
    /// The file's format.
    pub format: Format,
    /// The contiguous ranges of bytes, in address order.
    pub segments: Vec<AddressRange>,
    /// The number of bytes for the flash.
    pub bytes: u64,
    /// The text after `$CANopenSoftwareVersion` in the program.
    pub software_version: Option<String>,
    /// The target of the program, from its own label.
    pub label: Option<Label>,
    /// The bootloader in it, if it is one, and whether it can be sent to a device.
    pub bootloader: Option<(Header, Result<(), ram_image::Fault>)>,
    /// Whether the image can be a program.
    pub judgement: Result<(), Fault>,
    /// A stack at the end of a chip's SRAM, if the board is not known.
    pub stack_at_end: Option<StackAtEnd>,
    /// What is odd about the file.
    pub notes: Vec<Note>,
    /// The parts that only a block file has.
    pub blocks: Option<Blocks>,
}

/// The parts that only a block file has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Blocks {
    /// All blocks in the file's order.
    pub all: Vec<BlockLine>,
    /// The CRC of blocks and program.
    pub checksum: Checksum,
    /// The contents of block 0.
    pub control: Option<Control>,
    /// The start of the program's region.
    pub program_start: u32,
    /// The size of the program in bytes from there on.
    pub program_size: u32,
    /// The value of 1F56h after the download.
    pub program_crc: u32,
}

/// A summary of one block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockLine {
    /// 0, 1…N or FFFFFFFFh.
    pub number: u32,
    /// The address for its data.
    pub flash_address: u32,
    /// The size of its data in bytes.
    pub size: usize,
    /// Its CRC.
    pub crc: u32,
}

impl Inspection {
    /// Describes the contents of a file of this format. `start` is the program's start, if it is
    /// known from elsewhere; otherwise an image starts with its first byte. `board` is the memory map
    /// of the device, if it is known.
    #[must_use]
    pub fn of(firmware: &Firmware, format: Format, start: Option<u32>, board: Option<&Layout>) -> Self {
        match firmware {
            Firmware::Image(image) => {
                Self::of_image(image, format, start.unwrap_or(image.span().first), board)
            }
            Firmware::Blocks(program) => {
                let start = start.unwrap_or_else(|| program.start());
                let inspection = Self::of_image(program.image(), format, start, board);
                Self { blocks: Some(Blocks::of(program)), ..inspection }
            }
        }
    }

    fn of_image(image: &Image, format: Format, start: u32, board: Option<&Layout>) -> Self {
        let segments = image.segments().map(|(first, data)| {
            // A segment is not empty and ends inside the address space.
            AddressRange { first, last: first + (data.len() as u32 - 1) }
        });
        Self {
            format,
            segments: segments.collect(),
            bytes: image.byte_count(),
            software_version: image.software_version(),
            label: label_of(image, start),
            bootloader: RamImage::find(image).map(|found| (*found.header(), found.check())),
            judgement: judge(image, start, board),
            stack_at_end: StackAtEnd::of(image, start).filter(|_| board.is_none()),
            notes: image.notes().iter().copied().chain(Note::of_staging(image.span(), board)).collect(),
            blocks: None,
        }
    }

    /// The gaps between the segments.
    pub fn gaps(&self) -> impl Iterator<Item = AddressRange> + '_ {
        self.segments.windows(2).map(|pair| AddressRange { first: pair[0].last + 1, last: pair[1].first - 1 })
    }
}

impl Blocks {
    fn of(program: &Program) -> Self {
        let file = BlockFile::of(program);
        let line = |block: &Block<'_>| {
            let bytes = block.emit_with(file.checksum());
            let crc = bytes.last_chunk().map_or(0, |crc| u32::from_le_bytes(*crc));
            BlockLine {
                number: block.number,
                flash_address: block.flash_address,
                size: block.data.len(),
                crc,
            }
        };
        Self {
            all: file.blocks().iter().map(line).collect(),
            checksum: file.checksum(),
            control: file.control(),
            program_start: program.start(),
            program_size: program.size(),
            program_crc: program.crc(),
        }
    }

    /// The target of the program, if block 0 names it.
    #[must_use]
    pub fn identity(&self) -> Option<&Identity> {
        match &self.control {
            None | Some(Control::Plain) => None,
            Some(Control::Identity(identity) | Control::Dated { identity, .. }) => Some(identity),
        }
    }

    /// Version and date (seconds since 1970 UTC), if block 0 gives them.
    #[must_use]
    pub fn release(&self) -> Option<(ProgramVersion, u64)> {
        match self.control {
            Some(Control::Dated { version, date, .. }) => Some((ProgramVersion(version), date)),
            _ => None,
        }
    }
}

/// Seconds since 1970 UTC, shown as `2015-01-01 00:00:00 UTC`. Very large values are shown as
/// seconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Date(pub u64);

impl fmt::Display for Date {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const DAY: u64 = 86_400;
        let (mut days, seconds) = (self.0 / DAY, self.0 % DAY);
        if days > 3_000_000 {
            return write!(f, "{} s after 1970", self.0);
        }
        let leap =
            |year: u64| year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
        let mut year = 1970;
        while days >= 365 + u64::from(leap(year)) {
            days -= 365 + u64::from(leap(year));
            year += 1;
        }
        let lengths = [31, 28 + u64::from(leap(year)), 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
        let mut month = 0;
        while days >= lengths[month] {
            days -= lengths[month];
            month += 1;
        }
        let (hour, minute, second) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
        let (month, day) = (month + 1, days + 1);
        write!(f, "{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02} UTC")
    }
}

impl Inspection {
    /// The advice in its text.
    #[must_use]
    pub fn advice(&self) -> Vec<Advice> {
        let update = match (&self.bootloader, &self.judgement) {
            (Some((_, Ok(()))), _) => Some(Advice::RenewsDevice),
            (Some((_, Err(_))), _) | (None, Err(_)) => Some(Advice::IsRefused),
            (None, Ok(())) => None,
        };
        update.into_iter().chain(self.stack_at_end.map(|_| Advice::KnowBoard)).collect()
    }
}

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.blocks {
            None => writeln!(f, "{}, well-formed", self.format)?,
            Some(blocks) => {
                let count = blocks.all.len();
                writeln!(f, "{}, {count} blocks, every {} is right", self.format, blocks.checksum)?;
                blocks.program(f)?;
            }
        }
        if let Some(version) = &self.software_version {
            writeln!(f, "  software     {version}")?;
        }
        if let Some(label) = &self.label {
            writeln!(f, "  label        {}", Words(label))?;
        }
        if let Some((header, _)) = &self.bootloader {
            let Header { version, vendor, product, board, services, facts, crc, .. } = *header;
            let (version, size) = (Version(version), header.total());
            writeln!(f, "  bootloader   version {version}, {size} bytes, CRC {crc:08X}h")?;
            writeln!(f, "  for          vendor-ID {vendor:08X}h, product code {product:08X}h, board {board:08X}h, services {services}, facts {facts:08X}h")?;
        }
        write!(f, "  judged       ")?;
        match (&self.bootloader, &self.judgement) {
            (Some((_, Ok(()))), _) => writeln!(f, "a bootloader: {}", Advice::RenewsDevice)?,
            (Some((_, Err(fault))), _) => writeln!(f, "{fault}: {}", Advice::IsRefused)?,
            (None, Err(fault)) => writeln!(f, "{fault}: {}", Advice::IsRefused)?,
            (None, Ok(())) => writeln!(f, "can be a program: stack pointer and reset vector are plausible")?,
        }
        if let (Ok(()), Some(stack)) = (&self.judgement, self.stack_at_end) {
            writeln!(f, "  caution      {stack}")?;
        }
        for note in &self.notes {
            writeln!(f, "  caution      {note}")?;
        }
        let (bytes, count) = (self.bytes, self.segments.len());
        let pieces = if count == 1 { "piece" } else { "pieces" };
        writeln!(f, "  data         {bytes} bytes in {count} {pieces}")?;
        for segment in &self.segments {
            let area = Area::of(segment.first).map(|area| format!(", in {area}")).unwrap_or_default();
            writeln!(f, "    {segment}  {:>7} bytes{area}", segment.len())?;
        }
        for gap in self.gaps() {
            writeln!(f, "  gap          {gap}, {} bytes", gap.len())?;
        }
        self.blocks.as_ref().map_or(Ok(()), |blocks| blocks.table(f))
    }
}

impl Blocks {
    /// Prints what the blocks say of the program.
    fn program(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { program_start, program_size, program_crc, .. } = self;
        let digits = match self.checksum {
            Checksum::Crc32 => 8,
            Checksum::Crc16 => 4,
        };
        writeln!(
            f,
            "  program      {program_size} bytes from {program_start:#010x} on, CRC {program_crc:0digits$X}h"
        )?;
        if let Some(Identity { vendor_id, product_code, .. }) = self.identity() {
            writeln!(f, "  for          vendor-ID {vendor_id:08X}h, product code {product_code:08X}h")?;
        }
        if self.control.is_none() {
            let size = self.all.first().map_or(0, |block| block.size);
            writeln!(f, "  block 0      {size} bytes of the product's own, for its own check")?;
        }
        match self.release() {
            None => Ok(()),
            Some((version, 0)) => writeln!(f, "  version      {version}"),
            Some((version, date)) => writeln!(f, "  version      {version} of {}", Date(date)),
        }
    }

    /// Prints one line for each block.
    fn table(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "  block  address      bytes  CRC")?;
        for BlockLine { number, flash_address, size, crc } in &self.all {
            match *number {
                NUMBER_CONTROL => write!(f, "      0  control   ")?,
                NUMBER_LAST => write!(f, "     -1  last      ")?,
                number => write!(f, "  {number:>5}  {flash_address:#010x}")?,
            }
            writeln!(f, "  {size:>6}  {crc:08X}h")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Second column: the output of GNU `date -u -d @…`.
    #[test]
    fn a_date_is_that_of_the_calendar() {
        for (seconds, words) in [
            (0, "1970-01-01 00:00:00 UTC"),
            (951_782_400, "2000-02-29 00:00:00 UTC"),
            (1_420_070_400, "2015-01-01 00:00:00 UTC"),
            (4_107_542_399, "2100-02-28 23:59:59 UTC"),
            (4_107_542_400, "2100-03-01 00:00:00 UTC"),
            (253_402_300_799, "9999-12-31 23:59:59 UTC"),
        ] {
            assert_eq!(Date(seconds).to_string(), words);
        }
        assert_eq!(Date(u64::MAX).to_string(), "18446744073709551615 s after 1970");
    }
}
