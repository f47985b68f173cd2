//! A program for a device: what the formats of files give, and what every dialect takes.

use std::borrow::Cow;

use serde::Serialize;
use shared_abi::block_file::{Last, ProgramVersion, FRAMING};
use shared_abi::label::Label;

use super::checksum::{own_crc, Checksum};
use super::fault::{Cause, Place, ReadError};
use super::image::Image;
use super::label::label_of;
use super::range::AddressRange;

/// The most bytes from a program's start to its last byte. The flash of any microcontroller is
/// smaller; a larger file holds data for two memories.
pub const MAX_PROGRAM_SIZE: u32 = 64 * 1024 * 1024;

/// The target device of a program: the values that 1018h/1 and 1018h/2 must have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Target {
    /// Vendor-ID.
    pub vendor_id: u32,
    /// Product code.
    pub product_code: u32,
}

/// Version and date of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Release {
    /// The version.
    pub version: ProgramVersion,
    /// Seconds since 1970-01-01 UTC; 0 for none.
    pub date: u64,
}

/// A program: the contents of its flash, the start of its region, and the device and release that its
/// file names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Program {
    /// What lies in flash after the download; the bytes between the pieces are erased.
    pub(super) image: Image,
    /// The first address of its region: size and CRC count from there.
    pub(super) start: u32,
    /// Its size and its CRC.
    pub(super) last: Last,
    /// The CRC that `last` has.
    pub(super) checksum: Checksum,
    pub(super) target: Option<Target>,
    pub(super) release: Option<Release>,
    pub(super) cut: Cut,
}

/// How the dialect `block` cuts a program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Cut {
    /// In blocks of this many data bytes.
    Even { payload: usize, last_block: LastBlock },
    /// As the block file had it that was read: its blocks go out byte for byte.
    AsRead {
        /// Block 0, whose data may be the product's own.
        control: End,
        /// The number of data bytes in each of its blocks with the program.
        sizes: Vec<usize>,
        /// The last block.
        last: End,
    },
}

/// A block without a part of the program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct End {
    pub(super) flash_address: u32,
    pub(super) data: Vec<u8>,
}

/// The form of the last block.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LastBlock {
    /// Size and CRC of the program: the manual of 2015.
    #[default]
    Of2015,
    /// 32 reserved bytes before them: the manual of 2008.
    Of2008,
}

impl Program {
    /// The contents of its flash.
    #[must_use]
    pub fn image(&self) -> &Image {
        &self.image
    }

    /// The first address of its region, as far as its file shows it.
    #[must_use]
    pub fn start(&self) -> u32 {
        self.start
    }

    /// Its size in bytes, from the start of its region.
    #[must_use]
    pub fn size(&self) -> u32 {
        self.last.program_size
    }

    /// Its CRC: the value of 1F56h after the download.
    #[must_use]
    pub fn crc(&self) -> u32 {
        self.last.program_crc
    }

    /// The values of 1F56h of a device with this program: its CRC by the checksum of the file, and by
    /// the other one, which the device may use for a program that it got without blocks.
    #[must_use]
    pub fn crcs(&self) -> [u32; 2] {
        let other = self.checksum.other();
        [self.crc(), other.of_flash(self.start, self.size(), self.image.runs())]
    }

    /// Whether it has a CRC-32 of its own, as build scripts append it. The CRC-32 from there on does not depend on
    /// what is before it: its CRC may be that of each of its versions, and of parts of two.
    #[must_use]
    pub fn has_own_crc(&self) -> bool {
        own_crc(&self.flash_image()).is_some()
    }

    /// The kind of its [CRC](Self::crc).
    #[must_use]
    pub fn checksum(&self) -> Checksum {
        self.checksum
    }

    /// The range from its first byte to its last one.
    #[must_use]
    pub fn span(&self) -> AddressRange {
        self.image.span()
    }

    /// The contents of the flash after the download, from its start to its last byte.
    #[must_use]
    pub fn flash_image(&self) -> Cow<'_, [u8]> {
        self.image.flat(self.start, self.size())
    }

    /// The device that it is for: that of its file or its user, otherwise that of its label.
    #[must_use]
    pub fn target(&self) -> Option<Target> {
        let [named, of_label] = self.targets();
        named.or(of_label)
    }

    /// The device that its file or its user names, as block 0 does in a block file; and the one that the
    /// label in its image names.
    #[must_use]
    pub fn targets(&self) -> [Option<Target>; 2] {
        let of_label =
            self.label().map(|Label { vendor_id, product_code, .. }| Target { vendor_id, product_code });
        [self.target, of_label]
    }

    /// The release that its file or its user names, as block 0 does in a block file.
    #[must_use]
    pub fn release(&self) -> Option<Release> {
        self.release
    }

    /// The label in its image.
    #[must_use]
    pub fn label(&self) -> Option<Label> {
        label_of(&self.image, self.start)
    }

    /// Checks it against the region of its device: all data must lie inside, and size and CRC must be
    /// right when counted from the start of the region, as the device counts them.
    ///
    /// # Errors
    /// [`Cause::Outside`], [`Cause::Elsewhere`] or [`Cause::OtherPlace`].
    pub fn check_region(&self, region: AddressRange) -> Result<(), ReadError> {
        match &self.cut {
            Cut::Even { .. } => self.image.check_inside(region)?,
            Cut::AsRead { control, .. } => {
                let mut offset = control.data.len() + FRAMING;
                for (first, data) in self.parts() {
                    let range = AddressRange { first, last: first + (data.len() - 1) as u32 };
                    if !region.contains(&range) {
                        return Err(Place::Offset(offset).fault(Cause::outside(range, region)));
                    }
                    offset += data.len() + FRAMING;
                }
            }
        }
        if starts_at(&self.image, region.first, self.last, self.checksum) {
            return Ok(());
        }
        Err(Place::File.fault(Cause::OtherPlace { linked: self.start, start: region.first }))
    }

    /// The parts that are the blocks of the dialect `block`: their addresses and bytes.
    pub(super) fn parts(&self) -> Vec<(u32, &[u8])> {
        match &self.cut {
            Cut::Even { payload, .. } => {
                self.image.runs().flat_map(|(address, data)| chunks(address, data, *payload)).collect()
            }
            Cut::AsRead { sizes, .. } => {
                let mut runs = self.image.runs();
                let mut rest = (0, [].as_slice());
                let part = |size: &usize| {
                    if rest.1.is_empty() {
                        rest = runs.next()?;
                    }
                    let (part, after) = rest.1.split_at_checked(*size)?;
                    let address = rest.0;
                    rest = (address.wrapping_add(*size as u32), after);
                    Some((address, part))
                };
                sizes.iter().filter_map(part).collect()
            }
        }
    }
}

/// The bytes from an address on in parts of `size` bytes.
pub(super) fn chunks(address: u32, data: &[u8], size: usize) -> impl Iterator<Item = (u32, &[u8])> {
    data.chunks(size).enumerate().map(move |(at, part)| (address + (at * size) as u32, part))
}

/// Whether size and CRC of a program match the image, counted from `start`.
pub(super) fn starts_at(image: &Image, start: u32, last: Last, checksum: Checksum) -> bool {
    let Last { program_size, program_crc } = last;
    let span = image.span();
    // The CRC would not cover data beyond the size.
    let covered = start <= span.first
        && program_size <= MAX_PROGRAM_SIZE
        && u64::from(start) + u64::from(program_size) > u64::from(span.last);
    covered && checksum.of_flash(start, program_size, image.runs()) == program_crc
}
