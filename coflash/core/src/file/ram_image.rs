//! The RAM image of a bootloader in a firmware file: what `coflash flash` renews a bootloader with.

use shared_abi::layout::Layout;
use shared_abi::ram_image::{Header, MAGIC};

use super::checksum::CRC;
use super::image::Image;
use super::judge::program_after;
use super::read::Firmware;

/// The start of the flash.
const FLASH: u32 = super::area::FLASH.first;
/// The size of the smallest sector of the flash.
const SECTOR: usize = 0x4000;

/// A RAM image, with its header.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RamImage {
    header: Header,
    bytes: Vec<u8>,
    /// The address of a program in the same file.
    program: Option<u32>,
}

/// Why a RAM image cannot be sent to a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// It is for the bench: nobody has computed its CRC.
    #[error("is a bootloader without a CRC: build it by cargo xtask build, which writes the CRC")]
    Bench,
    /// The file has a program, too: a factory file.
    #[error(
        "is a factory file with a bootloader and a program, at {0:08X}h, and an update writes one of them"
    )]
    Merged(u32),
    /// Its CRC is wrong.
    #[error("is a damaged bootloader: its header has the CRC {said:08X}h, and its bytes have {found:08X}h")]
    Crc {
        /// The CRC in the header.
        said: u32,
        /// The CRC of the bytes.
        found: u32,
    },
}

impl Fault {
    /// The stable error number: that of a file that is not firmware.
    pub const NUMBER: u32 = super::judge::Fault::NUMBER;
    /// What to do next.
    pub const ADVICE: &'static str =
        "to renew a bootloader give the bootloader.elf of a release, or of cargo xtask \
        build; to update a program give the file of the program alone";
}

impl RamImage {
    /// The RAM image in firmware that was read; as [`find`](Self::find).
    #[must_use]
    pub fn of(firmware: &Firmware) -> Option<Self> {
        match firmware {
            Firmware::Image(image) => Self::find(image),
            Firmware::Blocks(program) => Self::find(program.image()),
        }
    }

    /// Finds the RAM image in a file. A file with a whole bootloader has the resident part, too, which is
    /// left out: it never changes in the field. A program that carries a RAM image in its data stays a
    /// program.
    #[must_use]
    pub fn find(image: &Image) -> Option<Self> {
        let found = image.segments().find_map(|(address, data)| match address {
            // The resident part precedes it; it begins with a sector.
            0 | FLASH => data.chunks(SECTOR).enumerate().find_map(|(at, _)| Self::at(&data[at * SECTOR..])),
            _ => Self::at(&data),
        })?;
        Some(Self { program: program_after(image, image.span().first), ..found })
    }

    /// The RAM image in the bootloader of a board: at its home, or after the resident part in the compact map.
    pub(super) fn in_bootloader(image: &Image, layout: &Layout) -> Option<Self> {
        let (place, places) = match layout.home {
            Some(home) => (home, 1),
            None => (layout.bootloader, layout.bootloader.size as usize / 4),
        };
        let bytes = image.flat(place.base, place.size);
        (0..bytes.len()).step_by(4).take(places).find_map(|at| Self::at(&bytes[at..]))
    }

    /// The RAM image at the start of these bytes.
    fn at(data: &[u8]) -> Option<Self> {
        let header = Header::of_bytes(data.first_chunk()?);
        let is_possible = header.magic == MAGIC
            && header.length == Header::SIZE
            && header.size.is_multiple_of(4)
            && header.size > 0;
        let bytes = data.get(..header.total() as usize).filter(|_| is_possible)?.to_vec();
        Some(Self { header, bytes, program: None })
    }

    /// Its header.
    #[must_use]
    pub const fn header(&self) -> &Header {
        &self.header
    }

    /// Header and image, as they lie in flash.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Checks that the file has nothing else to write, and the CRC, as each device does.
    ///
    /// # Errors
    /// [`Fault`].
    pub fn check(&self) -> Result<(), Fault> {
        let (said, found) = (self.header.crc, CRC.checksum(&self.bytes[Header::CRC_FROM as usize..]));
        match (self.program, said) {
            (Some(program), _) => Err(Fault::Merged(program)),
            (None, 0) => Err(Fault::Bench),
            (None, said) if said != found => Err(Fault::Crc { said, found }),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::ram_image::Version;

    use super::*;
    use crate::file::read::{read, Firmware, Format};

    /// A header in front of `size` bytes, typed from the table of docs/renewal.md.
    fn made(size: usize) -> Vec<u8> {
        let mut bytes = b"CBI2".to_vec();
        for word in [0, 64, size as u32, 0x2000_0000, 0x2001_FFC0, 1, 0, 7, 1, 2, 0, 0x0001_0002, 0, 0, 0] {
            bytes.extend(word.to_le_bytes());
        }
        bytes.extend((0..size).map(|at| at as u8));
        bytes
    }

    fn with_crc(mut bytes: Vec<u8>) -> Vec<u8> {
        let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&bytes[8..]);
        bytes[4..8].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    fn found(bytes: &[u8]) -> Option<RamImage> {
        let Ok(Firmware::Image(image)) = read(bytes, Some(Format::Raw), Some(0x0800_0000)) else {
            panic!("a raw file is an image")
        };
        RamImage::find(&image)
    }

    #[test]
    fn it_is_found_alone_and_after_a_resident_part() {
        let image = with_crc(made(128));
        for before in [0, 0x1_0000] {
            // The resident part has the magic, too: it compares it.
            let mut file = vec![0xA5; before];
            if before > 0 {
                file[64..68].copy_from_slice(b"CBI2");
            }
            file.extend(&image);
            file.extend([0xFF; 40]);
            let found = found(&file).expect("there is one");
            assert_eq!((found.bytes(), found.check()), (&image[..], Ok(())));
            assert_eq!(Version(found.header().version).to_string(), "1.2");
        }
        assert_eq!(found(&image[..image.len() - 1]), None, "its end is missing");
        assert_eq!(found(&[0x5A; 400]), None);
    }

    #[test]
    fn a_program_that_carries_one_is_a_program() {
        let carried = with_crc(made(128));
        for (address, before) in [(0x0802_0000, 0x4000), (0, 0x400)] {
            let file = [vec![0xA5; before], carried.clone()].concat();
            let Ok(Firmware::Image(image)) = read(&file, Some(Format::Raw), Some(address)) else {
                panic!("a raw file is an image")
            };
            assert_eq!(RamImage::find(&image), None);
        }
    }

    /// It would renew the bootloader, and leave the program out.
    #[test]
    fn a_factory_file_is_refused() {
        let mut file = vec![0xA5; 0x1_0000];
        file.extend(with_crc(made(128)));
        file.resize(0x2_0000, 0xFF);
        file.extend([0x2001_FFC0_u32, 0x0802_0009, 0].into_iter().flat_map(u32::to_le_bytes));
        let fault = found(&file).unwrap().check().unwrap_err();
        assert!(fault.to_string().contains("a bootloader and a program, at 08020000h"), "{fault}");
    }

    #[test]
    fn its_crc_is_checked() {
        assert_eq!(found(&made(128)).unwrap().check(), Err(Fault::Bench));
        let mut damaged = with_crc(made(128));
        damaged[100] ^= 1;
        assert!(matches!(found(&damaged).unwrap().check(), Err(Fault::Crc { .. })));
    }
}
