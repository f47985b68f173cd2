//! The software version of a stored program: the text after `$CANopenSoftwareVersion` in its image
//! (CiA 814-1 clause 6.5).
//!
//! The image is searched in steps while the flash is idle, so that 100Ah can be answered at once
//! and without access to the flash.
//! once and without the flash.

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
