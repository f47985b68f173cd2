//! What an image takes of its flash, read from its ELF file.

use std::fmt::Write as _;
use std::path::Path;
use std::{cmp, fs};

use shared_abi::geometry::Region;

use crate::elf::Elf;
use crate::{pack, workspace, Outcome};

/// Reads an ELF file.
///
/// # Errors
/// When it cannot be read or is not an ELF file; the message names the file.
pub fn read(path: &Path) -> Outcome<Elf> {
    let file =
        fs::read(path).map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(path)))?;
    Elf::parse(&file).map_err(|problem| format!("{}: {problem}", workspace::shown(path)))
}

/// The part of its flash region that an image occupies.
#[derive(Debug, PartialEq, Eq)]
pub struct Flash {
    /// Name, load address and length of each loaded section, in the order of addresses.
    pub sections: Vec<(String, u32, u32)>,
    /// Bytes from the region's base to the last loaded one, gaps included: they are written, and
    /// the CRC covers them.
    pub used: u32,
    /// The packed part, if there is one.
    pub packed: Option<Packed>,
}

/// The part of an image that is packed in flash (`pack.rs`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Packed {
    /// Bytes in flash.
    pub stored: u32,
    /// Bytes in RAM.
    pub raw: u32,
}

impl Packed {
    /// The packed part of an image.
    pub fn of(elf: &Elf) -> Option<Self> {
        let size_of = |name| Some(elf.sections.iter().find(|section| section.name == name)?.size);
        Some(Self { stored: size_of(pack::PACKED)?, raw: size_of(pack::IMAGE)? })
    }

    /// The share of `raw` bytes in the packed bytes, with `zeros` of all raw bytes taking no room.
    pub fn share(self, raw: u32, zeros: u32) -> u32 {
        let counted = u64::from(self.raw.saturating_sub(zeros).max(1));
        (u64::from(raw) * u64::from(self.stored)).div_ceil(counted) as u32
    }
}

impl Flash {
    /// Measures an image.
    ///
    /// # Errors
    /// When the image loads nothing, or loads a byte outside its region.
    pub fn of(elf: &Elf, region: Region) -> Outcome<Self> {
        let mut used = 0;
        for segment in elf.segments.iter().filter(|segment| segment.file_size > 0) {
            let behind = segment.load_address.saturating_add(segment.file_size);
            if region.contains(segment.load_address, 1) && behind > region.end() {
                return Err(format!(
                    "it needs {} bytes of flash{}, and has {}: {} too many.",
                    behind - region.base,
                    if Packed::of(elf).is_some() { ", packed" } else { "" },
                    region.size,
                    behind - region.end()
                ));
            }
            if !region.contains(segment.load_address, segment.file_size) {
                return Err(format!(
                    "{} bytes are loaded at {:#010x}, outside the image's flash ({:#010x}, {}); \
                     the linker script and the layout do not agree.",
                    segment.file_size,
                    segment.load_address,
                    region.base,
                    kib(region.size)
                ));
            }
            used = cmp::max(used, segment.load_address - region.base + segment.file_size);
        }
        if used == 0 {
            return Err("the image loads nothing into flash.".into());
        }
        let mut sections: Vec<_> = elf
            .sections
            .iter()
            .filter_map(|section| Some((section.name.clone(), elf.load_address(section)?, section.size)))
            .collect();
        sections.sort_by_key(|&(_, address, _)| address);
        Ok(Self { sections, used, packed: Packed::of(elf) })
    }

    /// Bytes as in [`used`](Self::used), if nothing were packed.
    pub fn raw(&self) -> u32 {
        self.packed.map_or(self.used, |packed| self.used - packed.stored + packed.raw)
    }

    /// The size gate.
    ///
    /// # Errors
    /// When the image uses more than the budget.
    pub fn within(&self, budget: u32) -> Outcome {
        match self.used.checked_sub(budget) {
            None | Some(0) => Ok(()),
            Some(over) => Err(format!(
                "the bootloader is {over} bytes over its budget of {}; the tables above show where they are.",
                kib(budget)
            )),
        }
    }

    /// The loaded sections, as a table.
    pub fn table(&self) -> String {
        let mut text = String::from("section             flash at     bytes      raw\n");
        for (name, address, size) in &self.sections {
            let raw = self.packed.filter(|_| name == pack::PACKED).map_or(*size, |packed| packed.raw);
            let (upper, lower) = (address >> 16, address & 0xFFFF);
            let _ = writeln!(text, "{name:<18}  {upper:04X}_{lower:04X}  {size:>7}  {raw:>7}");
        }
        text
    }
}

/// A number of bytes, in KiB if it is a whole number of them.
pub fn kib(bytes: u32) -> String {
    if bytes.is_multiple_of(1024) {
        format!("{} KiB", bytes / 1024)
    } else {
        format!("{bytes} bytes")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::elf::tests::by_hand;

    const REGION: Region = Region::new(0x0800_0000, 0x1000);

    #[test]
    fn sections_count_where_they_are_loaded_not_where_they_run() {
        let flash = Flash::of(&Elf::parse(&by_hand()).unwrap(), REGION).unwrap();
        assert_eq!(
            flash.sections,
            [(".vectors".into(), 0x0800_0000, 0x20), (".data".into(), 0x0800_0020, 8)]
        );
        assert_eq!(flash.used, 0x28);
    }

    #[test]
    fn a_gap_counts_as_used() {
        let mut elf = Elf::parse(&by_hand()).unwrap();
        elf.segments[1].load_address = 0x0800_0200;
        assert_eq!(Flash::of(&elf, REGION).unwrap().used, 0x208);
    }

    #[test]
    fn an_image_outside_its_region_is_refused() {
        let elf = Elf::parse(&by_hand()).unwrap();
        let elsewhere = Region::new(0x0801_0000, 0x1000);
        assert!(Flash::of(&elf, elsewhere).unwrap_err().contains("outside"));
        let small = Region::new(0x0800_0000, 0x27);
        let problem = Flash::of(&elf, small).unwrap_err();
        assert_eq!(problem, "it needs 40 bytes of flash, and has 39: 1 too many.");
        let mut empty = elf;
        empty.segments.clear();
        assert!(Flash::of(&empty, REGION).unwrap_err().contains("nothing"));
    }
}
