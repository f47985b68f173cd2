//! The boot stage: from the reset to the jump into a program, or to the rest of the bootloader.
//!
//! It runs before any peripheral but the reset flags, the warm-start cell, the flash controller,
//! the CRC unit and the entry strap was touched, and leaves those to a program as after a reset. The
//! rest of the bootloader gets the CRC unit switched on, for the services.

use boot_core::canopen::{BitRate, NodeId};
use boot_core::decision::{decide, BootDecision, Circumstances, StayReason};
use boot_core::program::verify;
use boot_core::store::Key;
use bsp::clock::{Source, HSI};
use bsp::{pac, CLOCK_TREE, LAYOUT};
use cortex_m::peripheral::SCB;
use shared_abi::handoff::{BootInfo, Handoff, ResetCause};
use shared_abi::ram_image::Header;
use shared_abi::warm_start::{BootRequest, Owed};

use crate::boot_report::BootReport;
use crate::caches::Caches;
#[cfg(feature = "sealed")]
use crate::callgate;
use crate::flash::ResidentFlash;
use crate::product::{self, NO_NODE_ID, PRODUCT};
use crate::{ram_image, storing};

/// About how long the warm-start cell can be read in peace between two resets where nothing can run.
const RESET_PERIOD_MS: u32 = 100;

/// Decides. Comes back if the bootloader stays, with the rest of it in RAM, and tells in `report`
/// what there is to do.
///
/// A RAM image that is damaged does not run: it is told in the warm-start cell, and a program starts
/// that would start by itself. Without one the chip is reset again and again.
///
/// # Safety
/// `image` must be the address of the RAM image's header, and `report` writable behind the image's
/// RAM; nothing else may run yet.
pub unsafe extern "C" fn stage(image: *const Header, report: *mut BootReport) {
    // SAFETY: nothing else runs yet; the rest of the bootloader takes them after this has returned.
    let (rcc, iwdg) = unsafe { (pac::RCC::steal(), pac::IWDG::steal()) };

    let reset_cause = ResetCause::from_rcc_csr(rcc.csr().read().bits());
    rcc.csr().modify(|_, w| w.rmvf().set_bit());

    // No reset: an application has jumped here, and the flash may be locked. A reset opens it; the
    // request stays in the cell.
    #[cfg(feature = "sealed")]
    if reset_cause == ResetCause::Unknown {
        SCB::sys_reset();
    }

    let mut cell = product::warm_start_cell();
    let request = cell.take();
    let strap = bsp::entry_strap();

    // CRCs and unpacking want speed. Exact it need not be, and the crystal would take its time.
    CLOCK_TREE.speed_up(&rcc, Source::Internal);
    // SAFETY: as above.
    let mut flash = unsafe { ResidentFlash::steal(true) };
    ResidentFlash::switch_crc_unit_on(&rcc);
    #[cfg(feature = "sealed")]
    callgate::store_after_reset(&mut flash, request);
    let mut parameters = product::parameters(&flash);
    let crash_resets = count_crash_resets(&mut parameters, &mut flash, reset_cause, request);
    // SAFETY: as above; nothing is programmed from here on.
    let caches = unsafe { Caches::on() };

    let node = product::node_parameters(&parameters, &flash);
    let node_id = node.id.map_or(NO_NODE_ID, NodeId::get);
    // A bootloader that cannot run resumes what would start by itself, at once: a rescue window would
    // need the RAM image, and the strap asks for what is not there.
    let mut circumstances = Circumstances { request, strap, crash_resets, node_id };
    for is_damaged in [false, true] {
        if is_damaged {
            circumstances.request = PRODUCT.autostart.map(BootRequest::Resume);
            circumstances.strap = false;
        }
        let verified = |number| verify(&flash, &parameters, LAYOUT, PRODUCT.crc, number);
        let decision = decide(&circumstances, &DECISION, verified);
        if let BootDecision::Start { program, trial } = decision {
            drop(caches);
            flash.release(&rcc);
            CLOCK_TREE.slow_down(&rcc);
            let handoff = Handoff::new(&BootInfo {
                node_id,
                bit_rate: node.bit_rate.or_zero(),
                program: program.number(),
                reset_cause,
                trial,
                fresh: matches!(request, Some(BootRequest::Fresh(_))),
                bootloader_version: product::VERSION,
                serial_number: bsp::serial_number(),
            });
            #[cfg(feature = "sealed")]
            if program.locks_flash() {
                // SAFETY: nothing runs yet but this, and nothing is written any more.
                unsafe { crate::flash_lock::lock_flash() };
            }
            if let Some(ms) = PRODUCT.program_watchdog_ms {
                bsp::watchdog::start(&iwdg, ms);
            }
            // SAFETY: the layout's handoff region, checked to be RAM of that size in no image. No
            // interrupt was enabled and no bus master started since the reset.
            unsafe {
                handoff.write(LAYOUT.handoff.base as *mut Handoff);
                program.vectors().jump()
            }
        }
        // SAFETY: the caller vouches for the address; of the RAM nothing is in use but the stack.
        match unsafe { ram_image::load(image, &flash) } {
            Ok(()) => {
                // SAFETY: the caller vouches for the address.
                unsafe { report.write(boot_report(&decision, request, node_id, node.bit_rate)) };
                return;
            }
            Err(damage) => cell.put(BootRequest::Damaged(damage)),
        }
    }
    CLOCK_TREE.slow_down(&rcc);
    // A round of the loop takes three cycles.
    cortex_m::asm::delay(HSI / 1000 * RESET_PERIOD_MS / 3);
    SCB::sys_reset()
}

/// What the RAM part is told.
fn boot_report(
    decision: &BootDecision,
    request: Option<BootRequest>,
    node_id: u8,
    bit_rate: BitRate,
) -> BootReport {
    let (reason, held_program, window_ms) = match decision {
        BootDecision::Stay(reason) => (*reason, 0, 0),
        BootDecision::Hold { program, window_ms } => (StayReason::Rescue, *program, *window_ms),
        BootDecision::Start { program, .. } => (StayReason::Rescue, program.number(), 0),
    };
    // An application that asks for the bootloader has shown that it can be called back. Which one
    // it was stands in the handoff, which nobody has written since.
    let returned = match request {
        // SAFETY: the layout's handoff region, checked to be RAM of that size in no image.
        Some(BootRequest::Stay | BootRequest::Owed(_)) => unsafe {
            Handoff::read_program(LAYOUT.handoff.base as *const Handoff)
        },
        _ => 0,
    };
    let owed = if let Some(BootRequest::Owed(owed)) = request { owed } else { Owed::NOTHING };
    BootReport {
        reason: reason.code(),
        held_program,
        window_ms,
        owed,
        returned,
        node_id,
        bit_rate: bit_rate as u8,
    }
}

/// The product's policy.
const DECISION: boot_core::decision::Policy = PRODUCT.decision();

/// Keeps the number of resets in a row by which an application ended without being asked to.
fn count_crash_resets(
    parameters: &mut product::Parameters,
    flash: &mut ResidentFlash,
    reset_cause: ResetCause,
    request: Option<BootRequest>,
) -> u32 {
    let before = storing::crash_count(parameters, flash);
    let now = DECISION.crash_resets(before, reset_cause, request);
    if now != before {
        // A store that fails costs the count, not the start.
        let _ = storing::store(parameters, flash, Key::CrashCount, [now, 0, 0, 0]);
    }
    now
}
