//! The software version of a stored program: the text after `$CANopenSoftwareVersion` in its image
//! (CiA 814-1 clause 6.5).
//!
//! The image is searched in steps while the flash is idle, so that 100Ah can be answered at once
//! and without access to the flash.

use shared_abi::geometry::Region;

use crate::flash::Flash;
use crate::programmer::Step;

/// The text before the version, including its NUL.
const MARK: &[u8] = b"$CANopenSoftwareVersion\0";
/// The longest version that is shown.
const LONGEST: usize = 48;
/// The number of bytes that a step searches.
const STEP: u32 = 512;

/// The search, or its result.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StoredVersion {
    /// The image that was searched or is being searched; an empty region for none.
    image: Region,
    /// The CRC of the image: it detects that another image was stored.
    crc: u32,
    /// Offset of the next byte to look at.
    at: u32,
    text: [u8; LONGEST],
    len: usize,
}

impl StoredVersion {
    pub(crate) const fn new() -> Self {
        Self { image: Region::new(0, 0), crc: 0, at: 0, text: [0; LONGEST], len: 0 }
    }

    /// The version; `None` if none was found.
    pub(crate) fn text(&self) -> Option<&[u8]> {
        self.text.get(..self.len).filter(|text| !text.is_empty())
    }

    /// Continues the search. The flash must be idle.
    pub(crate) fn step<F: Flash>(&mut self, flash: &F, (image, crc): (Region, u32)) -> Step {
        if self.image != image || self.crc != crc {
            (self.image, self.crc, self.at, self.len) = (image, crc, 0, 0);
        }
        if self.at >= image.size {
            return Step::Idle;
        }
        let end = (self.at + STEP).min(image.size);
        while self.at < end {
            let mut mark = [0; MARK.len()];
            // Most bytes are not `$`.
            flash.read(image.base + self.at, &mut mark[..1]);
            if mark[0] == MARK[0] {
                flash.read(image.base + self.at, &mut mark);
                if mark == MARK {
                    self.take(flash, image, self.at + MARK.len() as u32);
                    self.at = image.size;
                    return Step::Idle;
                }
            }
            self.at += 1;
        }
        Step::Again
    }

    fn take<F: Flash>(&mut self, flash: &F, image: Region, at: u32) {
        let rest = image.size.saturating_sub(at) as usize;
        let text = &mut self.text[..rest.min(LONGEST)];
        flash.read(image.base + at, text);
        self.len = text.iter().position(|byte| *byte == 0).unwrap_or(text.len());
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use super::*;
    use crate::flash::{FlashFault, Operation};
    use core::task::Poll;
    use shared_abi::geometry::Sector;
    use std::vec::Vec;

    const BASE: u32 = 0x0801_0000;

    /// Flash that is only read.
    struct Rom(Vec<u8>);

    impl Flash for Rom {
        fn read(&self, address: u32, buffer: &mut [u8]) {
            for (at, byte) in (address - BASE..).zip(buffer) {
                *byte = self.0.get(at as usize).copied().unwrap_or(0xFF);
            }
        }

        fn start(&mut self, _: Operation) -> Result<(), FlashFault> {
            unreachable!("a search writes nothing")
        }

        fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
            Poll::Ready(Ok(()))
        }

        fn sector_at(&self, _: u32) -> Option<Sector> {
            None
        }
    }

    /// Zeros with this at an offset.
    fn rom(size: usize, at: usize, text: &[u8]) -> Rom {
        let mut bytes = std::vec![0; size];
        bytes[at..at + text.len()].copy_from_slice(text);
        Rom(bytes)
    }

    /// The version in an image, and the steps until it was found.
    fn search(found: &mut StoredVersion, rom: &Rom, size: u32, crc: u32) -> u32 {
        let mut steps = 1;
        while found.step(rom, (Region::new(BASE, size), crc)) == Step::Again {
            steps += 1;
            assert!(steps < 100, "the search does not end");
        }
        steps
    }

    fn version(rom: &Rom, size: u32) -> Option<Vec<u8>> {
        let mut found = StoredVersion::new();
        search(&mut found, rom, size, 1);
        found.text().map(<[u8]>::to_vec)
    }

    const MARKED: &[u8] = b"$CANopenSoftwareVersion\x001.2.3\0rest";

    #[test]
    fn the_text_behind_the_mark_is_the_version() {
        for at in [0, 1, 511, 512, 513, 1024, 4096 - MARKED.len()] {
            assert_eq!(version(&rom(4096, at, MARKED), 4096).as_deref(), Some(&b"1.2.3"[..]), "{at}");
        }
        assert_eq!(version(&rom(4096, 0, b"no mark"), 4096), None);
        // A text that begins like the mark, in front of it.
        let text = [&b"$CANopenSoftware$"[..], MARKED].concat();
        assert_eq!(version(&rom(4096, 7, &text), 4096).as_deref(), Some(&b"1.2.3"[..]));
        assert_eq!(version(&rom(4096, 9, b"$CANopenSoftwareVersion\0\0"), 4096), None, "an empty text");
    }

    #[test]
    fn a_text_ends_with_the_image_or_with_what_can_be_shown() {
        let long = [MARK, &[b'x'; 100]].concat();
        assert_eq!(version(&rom(4096, 0, &long), 4096).unwrap().len(), LONGEST);
        let at = 4096 - MARK.len() - 3;
        assert_eq!(version(&rom(4096, at, &[MARK, b"abc"].concat()), 4096).as_deref(), Some(&b"abc"[..]));
        // What lies after the image is none of its own.
        assert_eq!(
            version(&rom(4096, 1000, MARKED), 1000 + MARK.len() as u32 + 2).as_deref(),
            Some(&b"1."[..])
        );
    }

    #[test]
    fn a_search_takes_a_step_for_each_512_bytes_and_begins_anew_for_another_image() {
        let mut found = StoredVersion::new();
        assert_eq!(search(&mut found, &rom(2048, 0, b""), 2048, 1), 5);
        assert_eq!(search(&mut found, &rom(2048, 0, b""), 2048, 1), 1, "it was searched");
        // Another CRC, another size: another image.
        assert_eq!(search(&mut found, &rom(2048, 600, MARKED), 2048, 2), 2);
        assert_eq!(found.text(), Some(&b"1.2.3"[..]));
        search(&mut found, &rom(2048, 600, MARKED), 2048, 2);
        assert_eq!(found.text(), Some(&b"1.2.3"[..]));
        search(&mut found, &rom(2048, 0, b""), 1024, 2);
        assert_eq!(found.text(), None);
    }
}
