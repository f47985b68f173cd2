//! The renewal of the bootloader in the flash half: a new RAM image is judged before staging is
//! erased for it; a confirmed one is copied from staging over home, while the bootloader runs from
//! RAM (docs/renewal.md).

use canopen::program::FlashError;
use shared_abi::block_file::{fits, Difference};
use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::ram_image::{Header, Host};
use shared_abi::renewal::State;

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
    /// The version of the services of the resident part.
    pub services: u32,
    /// A record of staging is stored: it must be removed before a program changes that flash.
    pub has_record: bool,
}

impl Renewing {
    /// The two places of a RAM image.
    pub(super) fn places(&self) -> Places {
        Places::of(self.layout).unwrap_or(Places::NONE)
    }

    /// What the device has for a RAM image.
    pub(crate) const fn host(&self) -> Host {
        self.policy.host(self.services)
    }

    /// Whether an image with this header may become the bootloader. `counter`: that of its manifest, if it
    /// is sealed.
    pub(super) fn judge(
        &self,
        bytes: &[u8; Header::SIZE as usize],
        counter: Option<u32>,
    ) -> Result<(), FlashError> {
        let header = Header::of_bytes(bytes);
        let Renewal { identity, revision, .. } = *self.policy;
        let room = self.places().staging.size.saturating_sub(Header::SIZE);
        if header.check(room, self.layout.ram, self.host()).is_err()
            || header.crc == 0
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
        self.has_record
            && usize::from(program) == self.layout.programs.len()
            && end > self.places().staging.base
    }
}

/// The installation of a confirmed image.
pub(super) struct Install {
    record: RenewalRecord,
    pub phase: Phase,
}

/// The progress of an installation.
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

impl Install {
    pub(super) const fn new(record: RenewalRecord) -> Self {
        Self { record, phase: Phase::Counter }
    }

    /// The stored form of its record in this state.
    pub(super) const fn value(&self, state: State) -> Value {
        let home = match state {
            State::Installed => self.record.crc,
            _ => self.record.home,
        };
        RenewalRecord { state, home, ..self.record }.value()
    }

    /// The record is certain: home may be erased.
    pub(super) const fn permitted(&mut self, places: Places) {
        self.phase = Phase::Erase(EraseSectors::new(places.home));
    }

    /// The next operation, until [`Phase::Done`].
    pub(super) fn next<F: Flash>(&mut self, flash: &F, places: Places, crc_step: u32) -> Next<FlashFault> {
        let Places { home, staging } = places;
        let words = self.record.size as usize / 4;
        let next = match &mut self.phase {
            Phase::Erase(sectors) => sectors.next(flash),
            Phase::Copy(copy) => {
                copy.next(flash, words, |word| flash.read_word(staging.base + 4 * word as u32))
            }
            Phase::Check(crc) => {
                return match crc.step(flash, CrcKind::Crc32, crc_step) {
                    false => Next::Again,
                    true if crc.value() != self.record.crc => Next::Done(Err(FlashFault::Verify)),
                    true => {
                        self.phase = Phase::Done;
                        Next::Done(Ok(()))
                    }
                };
            }
            Phase::Counter | Phase::Permit | Phase::Done => Ok(None),
        };
        match next {
            Ok(Some(operation)) => Next::Start(operation),
            Err(fault) => Next::Done(Err(fault)),
            Ok(None) => {
                self.phase = match self.phase {
                    Phase::Erase(_) => Phase::Copy(ProgramWords::new(home.base)),
                    _ => {
                        let from = home.base + Header::CRC_FROM;
                        Phase::Check(FlashCrc::new(Region::new(from, self.record.size - Header::CRC_FROM)))
                    }
                };
                Next::Again
            }
        }
    }
}
