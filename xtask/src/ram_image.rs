//! The one step after the link of a bootloader: the CRC in the header of its RAM image
//! (`shared_abi::ram_image`).

use crc::{Crc, CRC_32_ISO_HDLC};
use object::{Object, ObjectSection};
use shared_abi::ram_image::{Header, MAGIC};

use crate::{elf, outcome::Outcome};

/// The linker's section with the header.
const HEADER: &str = ".ram_image";
/// The section of the image, at its addresses in RAM.
const IMAGE: &str = ".data";

/// Writes the CRC into the ELF file of a bootloader. No other byte changes.
///
/// # Errors
/// When it is not an ELF file, or not as the bootloader's linker script makes it.
pub fn seal(mut file: Vec<u8>) -> Outcome<Vec<u8>> {
    let (elf, segments) = (elf::parse(&file)?, elf::segments(&file)?);
    // The offset of a section in the file, its address in flash, and its bytes.
    let find = |name: &str| -> Outcome<(usize, u64, &[u8])> {
        let missing = || format!("it has no section {name}; the bootloader's linker script makes one.");
        let section = elf.section_by_name(name).ok_or_else(missing)?;
        let (offset, size) = section.file_range().ok_or_else(missing)?;
        let load_address = segments.iter().find_map(|segment| {
            let into = offset.checked_sub(segment.offset.into())?;
            (into + size <= segment.bytes.len() as u64).then(|| u64::from(segment.address) + into)
        });
        let address = load_address.ok_or_else(|| format!("{name} is not loaded into the flash."))?;
        Ok((offset as usize, address, &file[offset as usize..][..size as usize]))
    };
    let ((offset, at, header), (_, image_at, image)) = (find(HEADER)?, find(IMAGE)?);
    if image_at != at + header.len() as u64 {
        return Err(format!("{IMAGE} is not loaded right after {HEADER}."));
    }
    let words: Vec<u32> = header
        .chunks_exact(4)
        .map(|word| u32::from_le_bytes(word.try_into().expect("a chunk has four bytes")))
        .collect();
    if header.len() != Header::SIZE as usize || words[..4] != [MAGIC, 0, Header::SIZE, image.len() as u32] {
        return Err(format!("{HEADER} is not what the bootloader's start.rs puts there."));
    }
    let crc = Crc::<u32>::new(&CRC_32_ISO_HDLC);
    let mut digest = crc.digest();
    digest.update(&header[Header::CRC_FROM as usize..]);
    digest.update(image);
    let crc = digest.finalize();
    file[offset + Header::CRC as usize..][..4].copy_from_slice(&crc.to_le_bytes());
    Ok(file)
}

/// The CRC in the header of the RAM image in the ELF file of a bootloader.
///
/// # Errors
/// When it is not an ELF file, or has no such header.
pub fn crc(file: &[u8]) -> Outcome<u32> {
    let elf = elf::parse(file)?;
    let header = elf.section_by_name(HEADER).and_then(|section| section.data().ok());
    let word = header.and_then(|bytes| bytes.get(Header::CRC as usize..)?.first_chunk().copied());
    word.map(u32::from_le_bytes).ok_or_else(|| format!("it has no section {HEADER} with a header."))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::elf::tests::by_hand;

    #[test]
    fn a_file_without_an_image_is_refused_by_name() {
        assert!(seal(by_hand()).unwrap_err().contains("no section .ram_image"));
        assert!(seal(vec![0; 10]).unwrap_err().contains("no 32-bit"));
        assert!(crc(&by_hand()).unwrap_err().contains("no section .ram_image"));
    }
}
