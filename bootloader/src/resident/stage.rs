//! The boot stage: from the reset to the jump into a program, or to the rest of the bootloader.
//!
//! Before it, nothing has used a peripheral. It uses only the reset flags, that of Standby among them, the
//! warm-start cell, the watchdog, the power and the flash controller, the CRC unit and the entry strap, and leaves the
//! peripherals to a program in their reset state. The rest of the bootloader gets the CRC unit with its
//! clock on, for the services.

use boot_core::canopen::program::Supply;
use boot_core::canopen::NodeId;
use boot_core::decision::{decide, fallback, BootDecision, Circumstances, PinReset};
use boot_core::program::{verify, Invalid};
use boot_core::store::{Key, Parameters as _, ProgramRecord};
use bsp::clock::{Source, HSI};
use bsp::{pac, LAYOUT};
use cortex_m::peripheral::scb::VectActive;
use cortex_m::peripheral::SCB;
use shared_abi::boot_report::{BootReport, Reason, Words};
use shared_abi::handoff::{BootInfo, Handoff, ResetCause, SdoBases};
use shared_abi::renewal::{word, Origin, TrialEnd};
use shared_abi::vectors::VectorTable;
use shared_abi::warm_start::{BootRequest, Cell, Owed, TrialStep};

use crate::caches::Caches;
use crate::flash::{CrcUnit, ResidentFlash};
use crate::{ram_image, renewal, storing};
use product::{self, NO_NODE_ID, PRODUCT, SEALED};

/// Minimum time between two resets if nothing can run, in ms, approximately: a debugger can read
/// the warm-start cell in this time.
const RESET_PERIOD_MS: u32 = 100;

/// Decides between a program and the bootloader, and starts it: a program in flash, or the RAM image
/// with a report ([`BootReport`]) of what is left for it.
///
/// A damaged RAM image does not run. The warm-start cell records the damage, and a program starts:
/// the first with autostart that may, or another one. If there is none, the chip resets again and again.
///
/// # Safety
/// Nothing else may run yet.
pub unsafe extern "C" fn stage() -> ! {
    // SAFETY: nothing else runs yet.
    let (rcc, iwdg) = unsafe { (pac::RCC::steal(), pac::IWDG::steal()) };

    // SAFETY: as above.
    let mut flash = unsafe { ResidentFlash::steal(CrcUnit::Own) };
    // A watchdog that the option bytes start could end the erase of a sector: it bites after 512 ms,
    // 349 at the fastest LSI.
    if flash.starts_watchdog() {
        bsp::watchdog::rescale(&iwdg, bsp::watchdog::SLOWEST);
    }
    bsp::low_power::keep_clocks_in_sleep(&rcc);

    let status = rcc.csr().read();
    // SAFETY: it removes the flags, and leaves the LSI as it is.
    rcc.csr().write(|w| unsafe { w.bits(status.bits()).rmvf().set_bit() });
    let reset_cause = ResetCause::from_flags(status.bits(), bsp::low_power::take(&rcc));

    // Without a reset cause an application has jumped here. The flash may be locked, the watchdog, whose
    // clock is the LSI, may run, and an exception may be active. A reset ends all; the request stays in the
    // cell.
    let in_handler = || SCB::vect_active() != VectActive::ThreadMode;
    if reset_cause == ResetCause::Unknown && (SEALED || status.lsirdy().bit_is_set() || in_handler()) {
        SCB::sys_reset();
    }

    let mut cell = product::warm_start_cell();
    let is_marked = PRODUCT.two_resets && cell.is_marked();
    let request = cell.take();
    if PRODUCT.rom_loader && request == Some(BootRequest::RomLoader) && reset_cause == ResetCause::Software {
        // SAFETY: since the reset no interrupt was enabled and no bus master started.
        unsafe { enter_rom(&rcc) };
    }
    let strap = bsp::entry_strap();

    // CRCs need speed, but no exact clock. The crystal would take time to start.
    Source::Internal.speed_up(&rcc);
    ResidentFlash::switch_crc_unit_on(&rcc);
    if SEALED && may_store() {
        crate::callgate::store_after_reset(&mut flash, request);
    }
    let mut parameters = product::parameters(&flash);
    // A reset that ends the RAM image is no crash of a program.
    let crash_resets = if PRODUCT.renewal && request.is_none() && renewal::last_report(reset_cause).is_some()
    {
        storing::crash_count(&parameters, &flash)
    } else {
        count_crash_resets(&mut parameters, &mut flash, reset_cause, request)
    };
    // SAFETY: as above; nothing else changes the register until it is dropped.
    let caches = unsafe { Caches::on() };
    if SEALED {
        // SAFETY: nothing but the stack uses the RAM.
        unsafe { ram_image::wipe() };
    }

    let node = product::node_parameters(&parameters, &flash);
    let node_id = node.id.map_or(NO_NODE_ID, NodeId::get);
    let decide = |circumstances: &Circumstances| {
        decide(circumstances, &DECISION, |number| match PRODUCT.profile.download.data {
            Some(data) if data == number => Err(Invalid::NoSuchProgram),
            _ => verify(&flash, &parameters, LAYOUT, PRODUCT.crc, number),
        })
    };
    let mut circumstances =
        Circumstances { request, strap, crash_resets, node_id, nearly_full: parameters.is_nearly_full() };
    let mut trial_end = TrialEnd::None;
    if PRODUCT.renewal {
        trial_end = renewal::trial_end(&flash, &parameters, request, reset_cause);
        if matches!(trial_end, TrialEnd::Reset(_)) && matches!(request, None | Some(BootRequest::Fault)) {
            // The image at home says why it ended.
            circumstances.request = Some(BootRequest::Renewal(TrialStep::GivenUp));
        }
    }
    let mut decision = decide(&circumstances);
    if PRODUCT.two_resets {
        let pin_reset = PinReset::of(reset_cause, request, is_marked);
        decision = pin_reset.change(decision);
        if pin_reset == PinReset::First && !matches!(decision, BootDecision::Stay { .. }) {
            await_second_reset(&mut cell);
        }
    }
    if !matches!(decision, BootDecision::Start { .. }) {
        // SAFETY: only the stack uses the RAM.
        match unsafe { renewal::load(&flash, &parameters, request, &mut trial_end) } {
            Ok((vectors, origin)) => {
                let report = BootReport {
                    renewal: word(origin, trial_end),
                    crash_resets: crash_resets.min(u32::from(u8::MAX)) as u8,
                    node_id,
                    bit_rate: node.bit_rate as u8,
                    ..boot_report(&decision, request, reset_cause)
                };
                drop(caches);
                if let (Origin::Trial, Some(ms)) = (origin, PRODUCT.watchdog_ms) {
                    // An image that hangs before it starts the watchdog ends, too.
                    bsp::watchdog::start(&iwdg, ms);
                }
                // The image changes the clock. The CRC unit keeps its clock, for the services.
                // SAFETY: the layout's handoff region, checked to be RAM of that size outside every
                // image. Since the reset no interrupt was enabled and no bus master started.
                unsafe {
                    (LAYOUT.handoff.base as *mut Words).write_volatile(report.words());
                    vectors.jump()
                }
            }
            Err(damage) => cell.put(BootRequest::Damaged(damage)),
        }
        // There is no bootloader to stay in, neither for the entry strap nor for the reset pin or a rescue
        // window: the first program with autostart that may start is resumed at once, or another one.
        circumstances.strap = false;
        fallback(&DECISION, |number| {
            circumstances.request = Some(BootRequest::Resume(number));
            decision = decide(&circumstances);
            matches!(decision, BootDecision::Start { .. })
        });
    }

    let mut program_date = 0;
    if let (true, BootDecision::Start { program, .. }) = (PRODUCT.program_date, &decision) {
        let number = program.number();
        if let (Some(record), Some(region)) =
            (ProgramRecord::load(&parameters, &flash, number), LAYOUT.program(number))
        {
            program_date = record.date(&parameters, &flash, number, region);
        }
    }
    let has_watchdog = flash.starts_watchdog();
    drop(caches);
    flash.release(&rcc);
    bsp::low_power::release(&rcc);
    bsp::slow_down(&rcc);
    let BootDecision::Start { program, trial } = decision else {
        // One pass of the loop takes three cycles.
        cortex_m::asm::delay(HSI / 1000 * RESET_PERIOD_MS / 3);
        SCB::sys_reset()
    };
    let nameplate = product::nameplate();
    let handoff = Handoff::new(&BootInfo {
        node_id,
        bit_rate: node.bit_rate.or_zero(),
        program: program.number(),
        reset_cause,
        trial,
        fresh: matches!(request, Some(BootRequest::Fresh(_))),
        bootloader_version: product::VERSION,
        serial_number: product::serial_number(nameplate.as_ref()),
        bootloader_number: PRODUCT.bootloader_number(),
        sdo: SdoBases { request: PRODUCT.sdo_request_base, response: PRODUCT.sdo_response_base },
        program_date,
        nameplate: nameplate.is_some(),
    });
    if SEALED && program.locks_flash() {
        // SAFETY: only this code runs, and it writes the flash no more.
        unsafe { crate::flash_lock::lock_flash() };
    }
    if let Some(ms) = PRODUCT.program_watchdog_ms {
        bsp::watchdog::start(&iwdg, ms);
    } else if has_watchdog {
        bsp::watchdog::rescale(&iwdg, bsp::watchdog::AFTER_RESET);
    }
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image. Since the
    // reset no interrupt was enabled and no bus master started.
    unsafe {
        handoff.write(LAYOUT.handoff.base as *mut Handoff);
        program.vectors().jump()
    }
}

/// Enters the loader in the ROM of the chip. Returns if there is none.
///
/// # Safety
/// No interrupt may be enabled, and no bus master started.
unsafe fn enter_rom(rcc: &pac::RCC) {
    let Some(vectors) = VectorTable::of_rom(bsp::rom::words(), LAYOUT.chip.sram) else { return };
    bsp::low_power::release(rcc);
    bsp::rom::map(rcc);
    // SAFETY: the caller guarantees it.
    unsafe { vectors.jump() }
}

/// Marks the first reset by the pin, and gives the second one its time. A watchdog of the option bytes does not bite
/// meanwhile: it has its longest time.
fn await_second_reset(cell: &mut Cell) {
    let core = Source::Internal.tree().sysclk();
    bsp::pause(core, PinReset::BOUNCE_MS);
    cell.mark();
    bsp::pause(core, PinReset::WITHIN_MS - PinReset::BOUNCE_MS);
    cell.clear();
}

/// Why the RAM image runs, and what is left for it.
fn boot_report(decision: &BootDecision, request: Option<BootRequest>, cause: ResetCause) -> BootReport {
    let (reason, refused, held_program, window_ms) = match *decision {
        BootDecision::Stay { reason, refused } => (reason, refused, 0, 0),
        BootDecision::Hold { program, window_ms: 0 } => (Reason::Compaction, 0, program, 0),
        BootDecision::Hold { program, window_ms } => (Reason::Rescue, 0, program, window_ms),
        BootDecision::Start { program, .. } => (Reason::Rescue, 0, program.number(), 0),
    };
    let (returned, program_reset) = match request {
        // An application that requests the bootloader has shown that it can be called back. The handoff
        // has its number; nothing has written it since.
        Some(BootRequest::Stay | BootRequest::Owed(_)) => {
            // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image.
            let program = unsafe { Handoff::read_program(LAYOUT.handoff.base as *const Handoff) };
            (program, cause as u8)
        }
        None => (0, cause as u8),
        // The bootloader itself left these requests.
        Some(_) => (0, 0),
    };
    let owed = if let Some(BootRequest::Owed(owed)) = request { owed } else { Owed::NOTHING };
    BootReport {
        reason: reason as u8,
        refused,
        program_reset,
        held_program,
        window_ms,
        owed,
        returned,
        ..BootReport::NONE
    }
}

/// The product's policy for the decision.
const DECISION: boot_core::decision::Policy = PRODUCT.decision();

/// Whether the supply is good enough for the journal. What is not stored is lost, and the start continues.
fn may_store() -> bool {
    bsp::supply::state() != Supply::Low
}

/// Updates the number of resets in a row by which an application ended without a request.
fn count_crash_resets(
    parameters: &mut product::Parameters,
    flash: &mut ResidentFlash,
    reset_cause: ResetCause,
    request: Option<BootRequest>,
) -> u32 {
    let before = storing::crash_count(parameters, flash);
    let now = DECISION.crash_resets(before, reset_cause, request);
    if now != before && may_store() {
        // If the store fails, the count is lost, but the start continues.
        let _ = storing::store(parameters, flash, Key::CRASH_COUNT, [now, 0, 0, 0]);
    }
    now
}
