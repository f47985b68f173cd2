//! Which RAM image is loaded: the one at home, or the one in staging (docs/renewal.md). Nothing is erased or
//! copied here.

use boot_core::renewal::Places;
use boot_core::store::RenewalRecord;
use bsp::LAYOUT;
use shared_abi::boot_report::{BootReport, Words};
use shared_abi::handoff::ResetCause;
use shared_abi::renewal::{of_word, Origin, State, TrialEnd};
use shared_abi::vectors::VectorTable;
use shared_abi::warm_start::{BootRequest, Damage, TrialStep};

use crate::flash::ResidentFlash;
use crate::ram_image;
use product::{Parameters, PRODUCT};

/// Loads the first image that is good. A trial whose image is not is over: `trial_end` says so.
///
/// # Errors
/// The damage of the image at home.
///
/// # Safety
/// As for [`ram_image::load`].
pub unsafe fn load(
    flash: &ResidentFlash,
    parameters: &Parameters,
    request: Option<BootRequest>,
    trial_end: &mut TrialEnd,
) -> Result<(VectorTable, Origin), Damage> {
    let home = || {
        // SAFETY: the caller guarantees it.
        unsafe { ram_image::load(flash, ram_image::home()) }.map(|vectors| (vectors, Origin::Home))
    };
    let Some(places) = Places::of(LAYOUT).filter(|_| PRODUCT.renewal) else { return home() };
    let record = RenewalRecord::load(parameters, flash);
    let tries = request == Some(BootRequest::Renewal(TrialStep::Try));
    let mut damage = Damage::Header;
    for (place, origin) in places.order(flash, record, tries).into_iter().flatten() {
        // SAFETY: it is a place of the layout; the caller guarantees the rest.
        match unsafe { ram_image::load(flash, place) } {
            Ok(vectors) => return Ok((vectors, origin)),
            Err(found) if origin == Origin::Trial => *trial_end = TrialEnd::Damaged(found),
            Err(found) if origin == Origin::Home => damage = found,
            Err(_) => {}
        }
    }
    Err(damage)
}

/// The report of the RAM image that ran before this reset; `None` if a program ran, or the power failed: a short
/// dip may leave the RAM as it was.
pub fn last_report(cause: ResetCause) -> Option<BootReport> {
    if matches!(cause, ResetCause::PowerOn | ResetCause::BrownOut) {
        return None;
    }
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image; nothing else
    // runs.
    BootReport::parse(unsafe { &(LAYOUT.handoff.base as *const Words).read_volatile() })
}

/// How a trial has ended by this reset, if the image that ran was on trial. A confirmed one is not.
pub fn trial_end(
    flash: &ResidentFlash,
    parameters: &Parameters,
    request: Option<BootRequest>,
    cause: ResetCause,
) -> TrialEnd {
    let ran_on_trial = || {
        let record = RenewalRecord::load(parameters, flash);
        let last = last_report(cause).map(|report| of_word(report.renewal).0);
        last == Some(Origin::Trial) && record.is_some_and(|record| record.state == State::Staged)
    };
    match request {
        Some(BootRequest::Renewal(TrialStep::Late)) => TrialEnd::Late,
        Some(BootRequest::Renewal(TrialStep::GivenUp)) => TrialEnd::GivenUp,
        _ if ran_on_trial() => TrialEnd::Reset(cause),
        _ => TrialEnd::None,
    }
}
