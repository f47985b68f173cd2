//! Program images: ELF and raw binary.

use object::elf::{self, FileHeader32, ProgramHeader32, PT_LOAD};
use object::read::elf::{FileHeader, ProgramHeader};
use object::LittleEndian;

use super::Error;

/// A run of bytes that an image puts into flash.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Where it is stored (the load address, not where it runs).
    pub address: u32,
    /// What is stored.
    pub bytes: Vec<u8>,
}

/// What was loaded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoadedImage {
    /// Its segments as (address, length), in file order.
    pub segments: Vec<(u32, u32)>,
    /// The ELF's entry point.
    pub entry: u32,
}

/// The segments of a 32-bit little-endian ARM ELF by their physical addresses.
///
/// # Errors
/// [`Error::Image`] says what is wrong with the file.
pub fn parse_elf(image: &[u8]) -> Result<(Vec<Segment>, u32), Error> {
    let bad = |what: &str| Error::Image(what.to_string());
    let header =
        FileHeader32::<LittleEndian>::parse(image).map_err(|e| bad(&format!("not an ELF file: {e}")))?;
    let endian = header.endian().map_err(|e| bad(&format!("not an ELF file: {e}")))?;
    if header.e_machine(endian) != elf::EM_ARM || !header.is_little_endian() {
        return Err(bad("the ELF file is not for a little-endian ARM"));
    }
    let headers: &[ProgramHeader32<LittleEndian>] =
        header.program_headers(endian, image).map_err(|e| bad(&format!("the program headers: {e}")))?;
    let mut segments = Vec::new();
    for (index, segment) in headers.iter().enumerate() {
        if segment.p_type(endian) != PT_LOAD || segment.p_filesz(endian) == 0 {
            continue;
        }
        let bytes = segment.data(endian, image).map_err(|()| {
            bad(&format!("segment {index} reaches beyond the end of the file: is it truncated?"))
        })?;
        segments.push(Segment { address: segment.p_paddr(endian), bytes: bytes.to_vec() });
    }
    if segments.is_empty() {
        return Err(bad("the ELF file has nothing to load"));
    }
    Ok((segments, header.e_entry(endian)))
}
