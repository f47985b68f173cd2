//! The one step after the link of a bootloader: the CRC in the header of its RAM image
//! (`shared_abi::ram_image`).

use crc::{Crc, CRC_32_ISO_HDLC};
use shared_abi::ram_image::{Header, MAGIC};

use crate::elf::{Elf, Section};
use crate::outcome::Outcome;

/// The linker's section with the header.
pub const HEADER: &str = ".ram_image";
/// The section of the image, at its addresses in RAM.
pub const IMAGE: &str = ".data";

/// Writes the CRC into the ELF file of a bootloader. No other byte changes.
///
/// # Errors
/// When it is not an ELF file, or not as the bootloader's linker script makes it.
pub fn seal(mut file: Vec<u8>) -> Outcome<Vec<u8>> {
    let elf = Elf::parse(&file)?;
    let find = |name: &str| -> Outcome<&Section> {
        let found = elf.sections.iter().find(|section| section.name == name);
        found.ok_or_else(|| format!("it has no section {name}; the bootloader's linker script makes one."))
    };
    let (header, image) = (find(HEADER)?, find(IMAGE)?);
    let follows = elf.load_address(header).and_then(|at| at.checked_add(header.size));
    if follows.is_none() || elf.load_address(image) != follows {
        return Err(format!("{IMAGE} is not loaded right after {HEADER}."));
    }
    let contents = |section: &Section| &file[section.offset as usize..][..section.size as usize];
    let words: Vec<u32> = contents(header)
        .chunks_exact(4)
        .map(|word| u32::from_le_bytes(word.try_into().expect("a chunk has four bytes")))
        .collect();
    if header.size != Header::SIZE || words[..4] != [MAGIC, 0, Header::SIZE, image.size] {
        return Err(format!("{HEADER} is not what the bootloader's start.rs puts there."));
    }
    let crc = Crc::<u32>::new(&CRC_32_ISO_HDLC);
    let mut digest = crc.digest();
    digest.update(&contents(header)[Header::CRC_FROM as usize..]);
    digest.update(contents(image));
    let crc = digest.finalize();
    let at = (header.offset + Header::CRC) as usize;
    file[at..][..4].copy_from_slice(&crc.to_le_bytes());
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::elf::tests::by_hand;

    #[test]
    fn a_file_without_an_image_is_refused_by_name() {
        assert!(seal(by_hand()).unwrap_err().contains("no section .ram_image"));
        assert!(seal(vec![0; 10]).unwrap_err().contains("no 32-bit"));
    }
}
