//! Makes the bootloader image of a sealed device: the bootloader with the key block.

use seal::key_block::SIZE;
use shared_abi::abilities::Abilities;
use shared_abi::layout::{Layout, KNOWS_SEALED_IMAGES, MARK_OFFSET};
use shared_abi::ram_image::{Header, MAGIC};
use shared_abi::services::{Facts, OFFSET};

use crate::file::checksum::CRC;
use crate::file::fault::Place;
use crate::file::image::{Image, Pieces};
use crate::file::range::AddressRange;

/// Why a bootloader cannot get a key block.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ProvisionFault {
    /// The board has no place for keys.
    #[error("the board has the compact memory map, which has no place for keys: sealed devices need the split one")]
    Compact,
    /// A part of the image is outside the bootloader's flash.
    #[error(
        "it has data at {found}, but the bootloader of this board is at {resident} and {home}: give the bootloader of \
         this board, as ELF or Intel HEX"
    )]
    Elsewhere {
        /// The part.
        found: AddressRange,
        /// The place of the resident part.
        resident: AddressRange,
        /// The place of the RAM image.
        home: AddressRange,
    },
    /// There is no RAM image, or one without a CRC.
    #[error("it has no RAM image with a CRC at {0:#010x}: give what `cargo xtask build` has made")]
    NoRamImage(u32),
    /// The two parts are of two builds that contradict each other.
    #[error("its RAM image was built for a resident part that decides by other choices: give the two parts of one build")]
    OtherResident,
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
    let home = AddressRange::from(layout.home.ok_or(ProvisionFault::Compact)?);
    check_place(bootloader, layout)?;
    let resident = AddressRange::from(layout.bootloader);
    if bootloader.bytes(resident.first + MARK_OFFSET) != Some(KNOWS_SEALED_IMAGES.to_le_bytes()) {
        return Err(ProvisionFault::Open);
    }
    let place = AddressRange::from(layout.key_block());
    // A raw image of the whole region has erased flash there.
    if bootloader.part(place).is_some_and(|there| there.only_byte() != Some(0xFF)) {
        return Err(ProvisionFault::Occupied(place));
    }
    let no_crc = [Some([0; 4]), None];
    if bootloader.bytes(home.first) != Some(MAGIC.to_le_bytes())
        || no_crc.contains(&bootloader.bytes(home.first + Header::CRC))
    {
        return Err(ProvisionFault::NoRamImage(home.first));
    }
    let facts = bootloader.segments().next().and_then(|(base, bytes)| {
        Facts::record(&bytes, base, layout.callgate() + OFFSET)
            .map(|record| CRC.checksum(record).to_le_bytes())
    });
    if facts.is_some() && bootloader.bytes(home.first + Header::FACTS) != facts {
        return Err(ProvisionFault::OtherResident);
    }
    let own = AddressRange { first: resident.first, last: place.first - 1 };
    let mut pieces = Pieces::default();
    for part in [own, home] {
        for (address, data) in bootloader.part(part).iter().flat_map(Image::segments) {
            pieces.extend(address, &data, Place::File);
        }
    }
    pieces.add(place.first, block.to_vec(), Place::File);
    Ok(pieces.in_order())
}

/// Checks that an image lies where the bootloader of this board does.
pub(in crate::file) fn check_place(bootloader: &Image, layout: &Layout) -> Result<(), ProvisionFault> {
    let resident = AddressRange::from(layout.bootloader);
    let home = AddressRange::from(layout.home.unwrap_or(layout.bootloader));
    for (address, data) in bootloader.segments() {
        let found = AddressRange { first: address, last: address.saturating_add(data.len() as u32 - 1) };
        if !resident.contains(&found) && !home.contains(&found) {
            return Err(ProvisionFault::Elsewhere { found, resident, home });
        }
    }
    match bootloader.span().first {
        found if found != resident.first => Err(ProvisionFault::Start { found, start: resident.first }),
        _ => Ok(()),
    }
}

/// The sectors that belong under write protection in a device with this bootloader, as
/// [`Layout::protected_sectors`] has them.
#[must_use]
pub fn protected_sectors(bootloader: &Image, layout: &Layout) -> u32 {
    let features = layout.home.and_then(|home| bootloader.bytes(home.base + Header::FEATURES));
    let has = |word| Abilities(u32::from_le_bytes(word)).has(Abilities::RENEWAL);
    layout.protected_sectors(features.is_some_and(has))
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::stm32f407g_disc1::LAYOUT;

    use super::*;

    fn image(pieces: &[(u32, &[u8])]) -> Image {
        let mut image = Pieces::default();
        for (address, data) in pieces {
            image.add(*address, data.to_vec(), Place::File);
        }
        image.in_order()
    }

    /// The first `size` bytes of a resident part, with these bytes as its mark.
    fn resident(mark: &[u8; 4], size: usize) -> Vec<u8> {
        let mut bytes = vec![0x5A; size];
        bytes[0x1C..0x20].copy_from_slice(mark);
        bytes
    }

    const BASE: u32 = LAYOUT.bootloader.base;
    const HOME: u32 = LAYOUT.home.unwrap().base;
    const RAM_IMAGE: [u8; 12] = *b"CBI2\x01\0\0\0\x40\0\0\0";

    #[test]
    fn a_bootloader_that_knows_no_sealed_images_gets_no_keys() {
        let provision =
            |bytes: &[u8]| provision(&image(&[(BASE, bytes), (HOME, &RAM_IMAGE)]), &LAYOUT, &[7; SIZE]);
        assert!(provision(&resident(b"CBS1", 0x400)).is_ok());
        for none in [b"CBS2", b"\0\0\0\0", b"\xFF\xFF\xFF\xFF"] {
            assert_eq!(provision(&resident(none, 0x400)), Err(ProvisionFault::Open));
        }
        assert_eq!(provision(&resident(b"CBS1", 0x400)[..0x1F]), Err(ProvisionFault::Open), "cut off");
        // Its services have facts of 20 bytes, and the header of the RAM image is not for them.
        let mut facts = resident(b"CBS1", 0x400);
        let pointer = (LAYOUT.callgate() + OFFSET - BASE) as usize + 36;
        facts[pointer..pointer + 4].copy_from_slice(&(BASE + 0x200).to_le_bytes());
        facts[0x204..0x206].copy_from_slice(&[20, 0]);
        assert_eq!(provision(&facts), Err(ProvisionFault::OtherResident));
    }

    /// The word at offset 28 of the header has a bit for renewal, which writes the home of the RAM image.
    #[test]
    fn the_write_protection_follows_the_header_of_the_ram_image() {
        for (word, mask) in [(0, 0b1_0001), (1, 0b1_0001), (2, 0b0_0001), (3, 0b0_0001)] {
            let mut ram_image = [&RAM_IMAGE[..], &[0; 52]].concat();
            ram_image[28] = word;
            assert_eq!(protected_sectors(&image(&[(HOME, &ram_image)]), &LAYOUT), mask, "{word}");
        }
    }

    #[test]
    fn the_keys_are_at_the_end_of_the_first_sector() {
        let size = LAYOUT.bootloader.size as usize;
        let own = resident(b"CBS1", 0x400);
        let whole = [&own[..], &vec![0xFF; size - 0x400]].concat();
        for bytes in [&whole[..], &whole[..0x400], &whole[..0x401]] {
            let made = provision(&image(&[(BASE, bytes), (HOME, &RAM_IMAGE)]), &LAYOUT, &[7; SIZE]).unwrap();
            assert_eq!(made.bytes(BASE + 0x3F00), Some([7; 256]));
            assert_eq!(made.bytes::<0x400>(BASE).as_ref().map(|bytes| &bytes[..]), Some(&own[..]));
            assert_eq!(made.bytes(HOME), Some(RAM_IMAGE));
            // No load of it touches the sectors between the two.
            let between = AddressRange { first: 0x0800_4000, last: 0x0800_FFFF };
            assert!(made.part(between).is_none());
        }
        let place = AddressRange::from(LAYOUT.key_block());
        let mut taken = whole.clone();
        taken[size - 1] = 0;
        let provision =
            |pieces: &[(u32, &[u8])]| super::provision(&image(pieces), &LAYOUT, &[7; SIZE]).unwrap_err();
        assert_eq!(provision(&[(BASE, &taken), (HOME, &RAM_IMAGE)]), ProvisionFault::Occupied(place));
        let start = ProvisionFault::Start { found: BASE + 4, start: BASE };
        assert_eq!(provision(&[(BASE + 4, &[0; 8])]), start);
        for elsewhere in [LAYOUT.programs[0].base, LAYOUT.parameters[0].base, LAYOUT.data.unwrap().base] {
            let found = provision(&[(BASE, &own), (elsewhere, &[0; 8])]);
            assert!(matches!(found, ProvisionFault::Elsewhere { .. }), "{found}");
        }
        let long = vec![0; size + 1];
        assert!(matches!(provision(&[(BASE, &long)]), ProvisionFault::Elsewhere { .. }));
        let none = ProvisionFault::NoRamImage(HOME);
        assert_eq!(provision(&[(BASE, &own)]), none);
        for damaged in [&b"CBI1\x01\0\0\0"[..], b"CBI2\0\0\0\0", b"CBI2\x01"] {
            assert_eq!(provision(&[(BASE, &own), (HOME, damaged)]), none);
        }
        let compact = &shared_abi::layout::nucleo_f446re::LAYOUT;
        let refused = super::provision(&image(&[(BASE, &own)]), compact, &[7; SIZE]);
        assert_eq!(refused, Err(ProvisionFault::Compact));
    }
}
