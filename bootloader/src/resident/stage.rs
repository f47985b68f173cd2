//! The boot stage: from the reset to the jump into a program, or to the rest of the bootloader.
//!
//! It runs before any peripheral but the reset flags, the warm-start cell, the flash controller,
//! the CRC unit and the entry strap was touched, and leaves those as after a reset.

use boot_core::canopen::NodeId;
use boot_core::decision::{decide, BootDecision, Circumstances, StayReason};
use boot_core::parameters::{Key, Parameters as _};
use boot_core::program::verify;
use bsp::clock::Source;
use bsp::{pac, CLOCK_TREE, LAYOUT};
use shared_abi::handoff::{BootInfo, Handoff, ResetCause};
use shared_abi::warm_start::BootRequest;

use crate::flash::FlashController;
use crate::product::{self, NO_NODE_ID, POLICY, PROGRAM_WATCHDOG_MS, RESCUE_WINDOW_MS};

/// Decides. Does not come back if a program is to run; else tells why the bootloader stays
/// ([`StayReason::code`]), in the next byte which program waits for the end of the rescue window,
/// and in the one behind that which is to be cleared.
pub extern "C" fn stage() -> u32 {
    // SAFETY: nothing else runs yet; the rest of the bootloader takes them after this has returned.
    let (rcc, iwdg) = unsafe { (pac::RCC::steal(), pac::IWDG::steal()) };

    let reset_cause = ResetCause::from_rcc_csr(rcc.csr().read().bits());
    rcc.csr().modify(|_, w| w.rmvf().set_bit());

    let request = product::warm_start_cell().take();
    let strap = bsp::entry_strap(&rcc);

    // A CRC over a whole program wants speed. Exact it need not be, and the crystal would take its
    // time.
    CLOCK_TREE.speed_up(&rcc, Source::Internal);
    // SAFETY: as above.
    let mut flash = unsafe { FlashController::steal(Some(&rcc)) };
    let mut parameters = product::parameters(&flash);
    let crash_resets = count_crash_resets(&mut parameters, &mut flash, reset_cause, request);

    let node = product::node_parameters(&parameters, &flash);
    let node_id = node.id.map_or(NO_NODE_ID, NodeId::get);
    let circumstances = Circumstances { request, strap, crash_resets, node_id };
    let decision = decide(&circumstances, &POLICY, |number| verify(&flash, &parameters, LAYOUT, number));
    // Whoever runs next finds the chip as after a reset.
    CLOCK_TREE.slow_down(&rcc);
    flash.release(&rcc);
    match decision {
        BootDecision::Stay(reason) => {
            let clear = if let Some(BootRequest::Clear(program)) = request { program } else { 0 };
            u32::from(reason.code()) | u32::from(clear) << 16
        }
        BootDecision::Start { program, .. } if RESCUE_WINDOW_MS.is_some() && request.is_none() => {
            u32::from(StayReason::Rescue.code()) | u32::from(program.number()) << 8
        }
        BootDecision::Start { program, trial } => {
            let handoff = Handoff::new(&BootInfo {
                node_id,
                bit_rate: node.bit_rate.or_zero(),
                program: program.number(),
                reset_cause,
                trial,
                bootloader_version: product::VERSION,
                serial_number: bsp::serial_number(),
            });
            if let Some(ms) = PROGRAM_WATCHDOG_MS {
                bsp::watchdog::start(&iwdg, ms);
            }
            // SAFETY: the layout's handoff region, checked to be RAM of that size in no image. No
            // interrupt was enabled and no bus master started since the reset.
            unsafe {
                handoff.write(LAYOUT.handoff.base as *mut Handoff);
                program.vectors().jump()
            }
        }
    }
}

/// Keeps the number of resets in a row by which an application ended without being asked to.
fn count_crash_resets(
    parameters: &mut product::Parameters,
    flash: &mut FlashController,
    reset_cause: ResetCause,
    request: Option<BootRequest>,
) -> u32 {
    let before = parameters.get(flash, Key::CrashCount).map_or(0, |[count, ..]| count);
    let now = POLICY.crash_resets(before, reset_cause, request);
    if now != before {
        parameters.store(Key::CrashCount, [now, 0, 0, 0]);
        // Nothing else runs that could be kept waiting. A store that fails costs the count, not the
        // start.
        while parameters.poll(flash).is_pending() {}
    }
    now
}
