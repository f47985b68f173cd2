//! Which RAM image of the bootloader is loaded, and whether one is good (docs/renewal.md). The
//! resident part and the RAM image both use this.

use core::array;

use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::ram_image::{Header, Host};
use shared_abi::renewal::{Origin, State, TrialEnd};
use shared_abi::warm_start::Damage;

use crate::flash::Flash;
use crate::store::RenewalRecord;

/// What the running image knows about itself.
#[derive(Clone, Copy)]
pub(crate) struct Known {
    /// The place of the running image.
    pub origin: Origin,
    pub trial_end: TrialEnd,
    /// The version of the running image.
    pub version: u32,
    /// 1F56h of the running image.
    pub identification: u32,
    /// It was confirmed since its start; its record may have gone since then.
    pub confirmed: bool,
}

impl Known {
    /// Of a device without renewal.
    pub(crate) const NOTHING: Self = Self {
        origin: Origin::Home,
        trial_end: TrialEnd::None,
        version: 0,
        identification: 0,
        confirmed: false,
    };
}

/// The two places of a RAM image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Places {
    /// Where it is loaded from after every ordinary reset.
    pub home: Region,
    /// Where a new one waits. Its region is as large as home.
    pub staging: Region,
}

impl Places {
    /// Of a layout without staging.
    pub(crate) const NONE: Self = Self { home: Region::new(0, 0), staging: Region::new(0, 0) };

    /// The places of a layout; `None` if its RAM image cannot be renewed.
    #[must_use]
    pub const fn of(layout: &Layout) -> Option<Self> {
        let (Some(home), Some(staging)) = (layout.home, layout.staging) else { return None };
        let size = if home.size < staging.size { home.size } else { staging.size };
        Some(Self { home: Region::new(home.base, size), staging: Region::new(staging.base, size) })
    }

    /// The images to try, in this order. `tries`: the warm-start cell asked for a trial.
    ///
    /// A trial is made once, by a request. A confirmed image is preferred, because home may be partly
    /// erased; unless home is a good image that the record does not know: then a debug probe has
    /// written it, and the record is void.
    pub fn order<F: Flash>(
        &self,
        flash: &F,
        record: Option<RenewalRecord>,
        tries: bool,
    ) -> [Option<(Region, Origin)>; 2] {
        let home = Some((self.home, Origin::Home));
        let Some(record) = record.filter(|record| self.is_in_staging(flash, record)) else {
            return [home, None];
        };
        let staging = |origin| Some((self.staging, origin));
        match record.state {
            State::Staged if tries => [staging(Origin::Trial), home],
            State::Confirmed if self.is_home_foreign(flash, &record) => [home, staging(Origin::Confirmed)],
            State::Confirmed => [staging(Origin::Confirmed), home],
            State::Installed => [home, staging(Origin::Spare)],
            State::None | State::Staged => [home, None],
        }
    }

    /// Whether the header in staging is that of the record.
    pub fn is_in_staging<F: Flash>(&self, flash: &F, record: &RenewalRecord) -> bool {
        let header = header(flash, self.staging);
        header.crc != 0 && (header.total(), header.crc) == (record.size, record.crc)
    }

    /// Whether the image at home is neither that of the record nor the one before it, as its header
    /// says. It may be damaged.
    pub fn is_home_foreign<F: Flash>(&self, flash: &F, record: &RenewalRecord) -> bool {
        let crc = header(flash, self.home).crc;
        crc != record.crc && crc != record.home
    }
}

/// The header of the image in a place.
pub fn header<F: Flash>(flash: &F, place: Region) -> Header {
    Header::of_words(array::from_fn(|n| flash.read_word(place.base + 4 * n as u32)))
}

/// 1F56h of an image: the CRC in its header; over an image for the bench, which has none, the CRC of its
/// bytes.
pub fn identification<F: Flash>(flash: &F, place: Region, header: &Header) -> u32 {
    match header.crc {
        0 => flash.crc32(0, Region::new(place.base, header.total().min(place.size))),
        crc => crc,
    }
}

/// Checks header and CRC of the image in a place. An image for the bench has no CRC, and passes.
///
/// # Errors
/// The damage.
pub fn check_contents<F: Flash>(
    flash: &F,
    place: Region,
    header: &Header,
    layout: &Layout,
    host: Host,
) -> Result<(), Damage> {
    header.check(place.size - Header::SIZE, layout.bootloader_ram(), host)?;
    let covered = Region::new(place.base + Header::CRC_FROM, header.total() - Header::CRC_FROM);
    if header.crc != 0 && flash.crc32(0, covered) != header.crc {
        return Err(Damage::Crc);
    }
    Ok(())
}

/// Checks an image that is to replace the bootloader, completely: its header, its CRC, its entry. An
/// image without a CRC, which is for the bench, is refused.
///
/// # Errors
/// The damage.
pub fn check<F: Flash>(flash: &F, place: Region, layout: &Layout, host: Host) -> Result<Header, Damage> {
    let header = header(flash, place);
    check_contents(flash, place, &header, layout, host)?;
    if header.crc == 0 {
        return Err(Damage::Crc);
    }
    let vectors = place.base + Header::SIZE;
    header.entry([flash.read_word(vectors), flash.read_word(vectors + 4)])?;
    Ok(header)
}
