//! The renewal of the bootloader in the flash half: a new RAM image is judged before staging is
//! erased for it; a confirmed one is copied from staging over home, while the bootloader runs from
//! RAM (docs/renewal.md).

use canopen::program::FlashError;
use shared_abi::abilities::Abilities;
use shared_abi::block_file::{fits, Difference};
use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::ram_image::{Header, Host};
use shared_abi::renewal::State;
use shared_abi::warm_start::Damage;

use crate::crc::CrcKind;
use crate::flash::{Flash, FlashFault, Next};
use crate::policy::Renewal;
use crate::program::FlashCrc;
use crate::queue::Piece;
use crate::renewal::Places;
use crate::sequence::{EraseSectors, ProgramWords};
use crate::store::{RenewalRecord, Value};

/// What the flash half knows about renewals.
#[derive(Clone, Copy)]
pub(crate) struct Renewing {
    pub layout: &'static Layout,
    pub policy: &'static Renewal,
    /// What the device has for a RAM image.
    pub host: Host,
    /// The stored record of the image in staging; a copy, because the flash cannot be read while it is busy.
    /// It must be removed before a program changes that flash.
    pub record: Option<RenewalRecord>,
    /// Whether the last program has a record and reaches into staging; a copy, too.
    pub is_occupied: bool,
}

impl Renewing {
    /// The two places of a RAM image.
    pub(crate) fn places(&self) -> Places {
        Places::of(self.layout).unwrap_or(Places::NONE)
    }

    /// The number of the last program, whose flash ends with staging.
    pub(crate) fn last_program(&self) -> u8 {
        self.layout.programs.len() as u8
    }

    /// Whether the image in staging is confirmed and not installed: home may be half erased, and this image
    /// the only bootloader.
    pub(super) fn is_confirmed(&self) -> bool {
        self.record.is_some_and(|record| record.state == State::Confirmed)
    }

    /// Whether an image with this header may become the bootloader. `counter`: that of its manifest, if it
    /// is sealed. `detail` says more about the error.
    pub(super) fn judge(
        &self,
        bytes: &[u8; Header::SIZE as usize],
        counter: Option<u32>,
        detail: &mut u8,
    ) -> Result<(), FlashError> {
        let header = Header::of_bytes(bytes);
        let Renewal { identity, revision, .. } = *self.policy;
        let room = self.places().staging.size.saturating_sub(Header::SIZE);
        let checked = header.check(room, self.layout.bootloader_ram(), self.host);
        if checked == Err(Damage::Facts) {
            *detail = Damage::Facts as u8;
        }
        if checked.is_err()
            || header.crc == 0
            || !header.features.has(Abilities::RENEWAL)
            || counter.is_some_and(|counter| counter != header.counter)
        {
            return Err(FlashError::Format);
        }
        if header.revisions != 0 && header.revisions >> (revision & 31) & 1 == 0 {
            return Err(FlashError::WrongProductId);
        }
        match identity.map(|device| fits((header.vendor, header.product), device)) {
            Some(Err(Difference::VendorId)) => Err(FlashError::WrongVendorId),
            Some(Err(Difference::ProductCode)) => Err(FlashError::WrongProductId),
            Some(Ok(())) | None => Ok(()),
        }
    }

    /// A piece of a new RAM image at its place in staging. Those of a sealed one are there already.
    pub(super) fn placed(&self, piece: Piece, is_sealed: bool) -> Piece {
        let Places { home, staging } = self.places();
        let offset = if is_sealed { 0 } else { staging.base.wrapping_sub(home.base) };
        Piece { address: piece.address.wrapping_add(offset), ..piece }
    }

    /// Whether the last program's flash up to `end` is a part of staging, and has a record.
    pub(super) fn is_reached(&self, program: u8, end: u32) -> bool {
        self.record.is_some() && program == self.last_program() && end > self.places().staging.base
    }
}

/// The installation of a confirmed image.
pub(super) enum Phase {
    /// The security counter of a sealed image must be raised: from now on no older one is accepted.
    Counter,
    /// The record that permits the erase must be stored once more: a power cut may have left it
    /// between 0 and 1.
    Permit,
    /// Home is being erased.
    Erase(EraseSectors),
    /// The image is being copied.
    Copy(ProgramWords),
    /// The copy is being checked.
    Check(FlashCrc),
    /// The record of the installed image must be stored.
    Done,
}

impl Phase {
    /// The record is certain: home may be erased.
    pub(super) const fn erase(places: Places) -> Self {
        Self::Erase(EraseSectors::new(places.home))
    }

    /// An address in the sector of the operation that began last, 0 for none.
    pub(super) const fn at(&self) -> u32 {
        match self {
            Self::Erase(sectors) => sectors.at(),
            Self::Copy(words) => words.at(),
            Self::Counter | Self::Permit | Self::Check(_) | Self::Done => 0,
        }
    }

    /// The next operation of the installation of the image with this record, until [`Phase::Done`].
    pub(super) fn next<F: Flash>(
        &mut self,
        flash: &F,
        Places { home, staging }: Places,
        record: &RenewalRecord,
        crc_step: u32,
    ) -> Next<FlashFault> {
        let words = record.size as usize / 4;
        let next = match self {
            Self::Erase(sectors) => sectors.next(flash),
            Self::Copy(copy) => {
                copy.next(flash, words, |word| flash.read_word(staging.base + 4 * word as u32))
            }
            Self::Check(crc) => {
                return match crc.step(flash, CrcKind::Crc32, crc_step) {
                    false => Next::Again,
                    true if crc.value() != record.crc => Next::Done(Err(FlashFault::Verify)),
                    true => {
                        *self = Self::Done;
                        Next::Done(Ok(()))
                    }
                };
            }
            Self::Counter | Self::Permit | Self::Done => return Next::Done(Ok(())),
        };
        match next {
            Ok(Some(operation)) => Next::Start(operation),
            Err(fault) => Next::Done(Err(fault)),
            Ok(None) => {
                *self = match self {
                    Self::Erase(_) => Self::Copy(ProgramWords::new(home.base)),
                    _ => {
                        let from = home.base + Header::CRC_FROM;
                        Self::Check(FlashCrc::new(Region::new(from, record.size - Header::CRC_FROM)))
                    }
                };
                Next::Again
            }
        }
    }
}

/// The stored form of a record that permits the installation, or says that it is done.
pub(super) const fn value(record: &RenewalRecord, state: State) -> Value {
    let home = match state {
        State::Installed => record.crc,
        _ => record.home,
    };
    RenewalRecord { state, home, ..*record }.value()
}
