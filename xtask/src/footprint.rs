//! What an image takes of its flash, read from its ELF file.

use std::fmt::Write as _;
use std::path::Path;
use std::{cmp, fs};

use shared_abi::geometry::Region;

use crate::elf::Elf;
use crate::{outcome::Outcome, workspace};

/// Reads an ELF file.
///
/// # Errors
/// When it cannot be read or is not an ELF file; the message names the file.
pub fn read(path: &Path) -> Outcome<Elf> {
    let file =
        fs::read(path).map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(path)))?;
    Elf::parse(&file).map_err(|problem| format!("{}: {problem}", workspace::shown(path)))
}

/// The parts of its flash regions that an image occupies.
#[derive(Debug, PartialEq, Eq)]
pub struct Flash {
    /// Name, load address and length of each loaded section, in the order of addresses.
    pub sections: Vec<(String, u32, u32)>,
    /// Each region of the image, and its bytes from the region's base to the last loaded one, gaps
    /// included.
    pub used: Vec<(Region, u32)>,
}

impl Flash {
    /// Measures an image.
    ///
    /// # Errors
    /// When the image loads nothing, or loads a byte outside its regions.
    pub fn of(elf: &Elf, regions: &[Region]) -> Outcome<Self> {
        let mut used: Vec<_> = regions.iter().map(|region| (*region, 0)).collect();
        for segment in elf.segments.iter().filter(|segment| segment.file_size > 0) {
            let (at, size) = (segment.load_address, segment.file_size);
            let place = used.iter_mut().find(|(region, _)| region.contains(at, 1));
            let Some((region, bytes)) = place else {
                return Err(format!(
                    "{size} bytes are loaded at {at:#010x}, outside the image's flash ({}); the linker \
                     script and the layout do not agree.",
                    regions
                        .iter()
                        .map(|region| format!("{:#010x}, {}", region.base, kib(region.size)))
                        .collect::<Vec<_>>()
                        .join("; ")
                ));
            };
            let end = at.saturating_add(size);
            if end > region.end() {
                return Err(format!(
                    "it needs {} bytes of flash at {:#010x}, and has {}: {} too many.",
                    end - region.base,
                    region.base,
                    region.size,
                    end - region.end()
                ));
            }
            *bytes = cmp::max(*bytes, end - region.base);
        }
        if used.iter().all(|(_, bytes)| *bytes == 0) {
            return Err("the image loads nothing into flash.".into());
        }
        let mut sections: Vec<_> = elf
            .sections
            .iter()
            .filter_map(|section| Some((section.name.clone(), elf.load_address(section)?, section.size)))
            .collect();
        sections.sort_by_key(|&(_, address, _)| address);
        Ok(Self { sections, used })
    }

    /// The loaded sections, as a table.
    pub fn table(&self) -> String {
        let mut text = String::from("section             flash at     bytes\n");
        for (name, address, size) in &self.sections {
            let (upper, lower) = (address >> 16, address & 0xFFFF);
            let _ = writeln!(text, "{name:<18}  {upper:04X}_{lower:04X}  {size:>7}");
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
        let flash = Flash::of(&Elf::parse(&by_hand()).unwrap(), &[REGION]).unwrap();
        assert_eq!(
            flash.sections,
            [(".vectors".into(), 0x0800_0000, 0x20), (".data".into(), 0x0800_0020, 8)]
        );
        assert_eq!(flash.used, [(REGION, 0x28)]);
    }

    #[test]
    fn a_gap_counts_as_used() {
        let mut elf = Elf::parse(&by_hand()).unwrap();
        elf.segments[1].load_address = 0x0800_0200;
        assert_eq!(Flash::of(&elf, &[REGION]).unwrap().used, [(REGION, 0x208)]);
        let regions = [Region::new(0x0800_0000, 0x100), Region::new(0x0800_0200, 0x100)];
        let used = [(regions[0], 0x20), (regions[1], 8)];
        assert_eq!(Flash::of(&elf, &regions).unwrap().used, used);
    }

    #[test]
    fn an_image_outside_its_region_is_refused() {
        let elf = Elf::parse(&by_hand()).unwrap();
        let elsewhere = Region::new(0x0801_0000, 0x1000);
        assert!(Flash::of(&elf, &[elsewhere]).unwrap_err().contains("outside"));
        let small = Region::new(0x0800_0000, 0x27);
        let problem = Flash::of(&elf, &[small]).unwrap_err();
        assert_eq!(problem, "it needs 40 bytes of flash at 0x08000000, and has 39: 1 too many.");
        let mut empty = elf;
        empty.segments.clear();
        assert!(Flash::of(&empty, &[REGION]).unwrap_err().contains("nothing"));
    }
}
