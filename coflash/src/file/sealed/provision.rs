//! Makes the bootloader image of a sealed device: the bootloader with the key block.

use seal::key_block::SIZE;
use shared_abi::layout::{Layout, KNOWS_SEALED_IMAGES, MARK_OFFSET};

use crate::file::fault::Place;
use crate::file::image::{Image, Pieces};
use crate::file::range::AddressRange;

/// Why a bootloader cannot get a key block.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ProvisionFault {
    /// The image is not in the bootloader's region.
    #[error(
        "it lies at {found}, but the bootloader of this board lies at {region}: give the bootloader of this board"
    )]
    Elsewhere {
        /// The place of the image.
        found: AddressRange,
        /// The place of the bootloader.
        region: AddressRange,
    },
    /// The image does not begin at the CPU's start address.
    #[error(
        "it begins at {found:#010x} and not at {start:#010x}, where the CPU starts after a reset: it is not a bootloader"
    )]
    Start {
        /// Its first address.
        found: u32,
        /// The required first address.
        start: u32,
    },
    /// The bootloader does not use keys.
    #[error("it is not a coboot bootloader with support for sealed images: it would ignore the keys and accept any program; give one that was built with the feature `sealed` (bootloader-sealed)")]
    Open,
    /// The place of the keys is not empty.
    #[error("it already has data at {0}, the place of the keys: give a bootloader without keys")]
    Occupied(AddressRange),
}

/// Adds a key block to a bootloader image.
///
/// # Errors
/// See [`ProvisionFault`].
pub fn provision(bootloader: &Image, layout: &Layout, block: &[u8; SIZE]) -> Result<Image, ProvisionFault> {
    let region = AddressRange::from(layout.bootloader);
    let found = bootloader.span();
    if !region.contains(&found) {
        return Err(ProvisionFault::Elsewhere { found, region });
    }
    if found.first != region.first {
        return Err(ProvisionFault::Start { found: found.first, start: region.first });
    }
    if bootloader.bytes(region.first + MARK_OFFSET) != Some(KNOWS_SEALED_IMAGES.to_le_bytes()) {
        return Err(ProvisionFault::Open);
    }
    let place = AddressRange::from(layout.key_block());
    // A raw image of the whole region has erased flash there.
    if bootloader.part(place).is_some_and(|there| there.only_byte() != Some(0xFF)) {
        return Err(ProvisionFault::Occupied(place));
    }
    let own = AddressRange { first: region.first, last: place.first - 1 };
    let mut pieces = Pieces::default();
    for (address, data) in bootloader.part(own).iter().flat_map(Image::segments) {
        pieces.add(address, data, Place::File);
    }
    pieces.add(place.first, block.to_vec(), Place::File);
    Ok(pieces.in_order())
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::stm32f407g_disc1::LAYOUT;

    use super::*;
    use crate::file::raw;

    fn image(address: u32, bytes: &[u8]) -> Image {
        raw::read(bytes, Some(address)).unwrap()
    }

    /// The first `size` bytes of a bootloader, with these bytes as its mark.
    fn bootloader(mark: &[u8; 4], size: usize) -> Vec<u8> {
        let mut bytes = vec![0x5A; size];
        bytes[0x1C..0x20].copy_from_slice(mark);
        bytes
    }

    #[test]
    fn a_bootloader_that_knows_no_sealed_images_gets_no_keys() {
        let base = LAYOUT.bootloader.base;
        let provision = |bytes: &[u8]| provision(&image(base, bytes), &LAYOUT, &[7; SIZE]);
        assert!(provision(&bootloader(b"CBS1", 0x400)).is_ok());
        for none in [b"CBS2", b"\0\0\0\0", b"\xFF\xFF\xFF\xFF"] {
            assert_eq!(provision(&bootloader(none, 0x400)), Err(ProvisionFault::Open));
        }
        assert_eq!(provision(&bootloader(b"CBS1", 0x400)[..0x1F]), Err(ProvisionFault::Open), "cut off");
    }

    #[test]
    fn the_keys_lie_at_the_end_of_the_bootloaders_flash() {
        let (base, size) = (LAYOUT.bootloader.base, LAYOUT.bootloader.size);
        let own = bootloader(b"CBS1", 0x400);
        let whole = [&own[..], &vec![0xFF; size as usize - 0x400]].concat();
        for bytes in [&whole[..], &whole[..0x400], &whole[..0x401]] {
            let made = provision(&image(base, bytes), &LAYOUT, &[7; SIZE]).unwrap();
            assert_eq!(made.span(), AddressRange { first: base, last: base + size - 1 });
            assert_eq!(made.bytes(base + size - 256), Some([7; 256]));
            assert_eq!(made.bytes::<0x400>(base).as_ref().map(|bytes| &bytes[..]), Some(&own[..]));
        }
        let place = AddressRange::from(LAYOUT.key_block());
        let mut taken = whole.clone();
        taken[size as usize - 1] = 0;
        let provision = |image| super::provision(&image, &LAYOUT, &[7; SIZE]).unwrap_err();
        assert_eq!(provision(image(base, &taken)), ProvisionFault::Occupied(place));
        let start = ProvisionFault::Start { found: base + 4, start: base };
        assert_eq!(provision(image(base + 4, &[0; 8])), start);
        let program = image(LAYOUT.programs[0].base, &[0; 8]);
        assert!(matches!(provision(program), ProvisionFault::Elsewhere { .. }));
        let long = vec![0; size as usize + 1];
        assert!(matches!(provision(image(base, &long)), ProvisionFault::Elsewhere { .. }));
    }
}
