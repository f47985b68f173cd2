//! The boot stage: from the reset to the jump into a program, or to the rest of the bootloader.
//!
//! It reads what is read once ([`take`]), makes the choice ([`boot_core::decision::choose`]),
//! carries it out, and ends in [`enter_program`] or [`enter_bootloader`].
//!
//! Before it, nothing has used a peripheral. It uses only the reset flags, that of Standby among them, the
//! warm-start cell, the watchdog, the power and the flash controller, the CRC unit and the entry strap, and leaves the
//! peripherals to a program in their reset state. The rest of the bootloader gets the CRC unit with its
//! clock on, for the services.

use boot_core::canopen::program::Supply;
use boot_core::canopen::BitRate;
use boot_core::decision::{choose, Exit, Images, PinReset, Start, Store, Woken};
use boot_core::renewal::Places;
use boot_core::store::{Key, Parameters as _};
use bsp::clock::Source;
use bsp::{functions, pac, LAYOUT};
use cortex_m::peripheral::scb::VectActive;
use cortex_m::peripheral::SCB;
use shared_abi::boot_report::{BootReport, Words};
use shared_abi::geometry::Region;
use shared_abi::handoff::{BootInfo, Handoff, ResetCause, SdoBases};
use shared_abi::renewal::{of_word, Origin};
use shared_abi::vectors::VectorTable;
use shared_abi::warm_start::{BootRequest, Cell, Damage};

use crate::caches::Caches;
use crate::flash::{CrcUnit, ResidentFlash};
use crate::{ram_image, storing};
use product::{self, Chosen, Parameters, NO_NODE_ID, PRODUCT, SEALED};

/// Minimum time between two resets if nothing can run, in ms, approximately: a debugger can read
/// the warm-start cell in this time.
const RESET_PERIOD_MS: u32 = 100;

/// The peripherals of the boot stage.
struct Chip {
    rcc: pac::RCC,
    iwdg: pac::IWDG,
    flash: ResidentFlash,
}

/// Makes the choice after a reset, and carries it out.
///
/// A damaged RAM image does not run. The warm-start cell records the damage, and a program starts:
/// the first with autostart that may, or another one. If there is none, the chip resets again and again.
///
/// # Safety
/// Nothing else may run yet.
pub unsafe extern "C" fn stage() -> ! {
    functions::after_reset();
    // SAFETY: nothing else runs yet.
    let mut chip = unsafe { chip() };
    let mut cell = product::warm_start_cell();
    let mut woken = take(&chip.rcc, &mut cell);
    // CRCs need speed, but no exact clock. The crystal would take time to start.
    Source::Internal.speed_up(&chip.rcc);
    // SAFETY: nothing else runs, and what waits with the timer leaves it off.
    unsafe { functions::begin(Source::Internal.tree().sysclk()) };
    ResidentFlash::switch_crc_unit_on(&chip.rcc);
    // SAFETY: what else changes the register until it is dropped restores it at once.
    let caches = unsafe { Caches::on() };

    let (choice, parameters) = loop {
        let mut parameters = product::parameters(&chip.flash);
        let node = product::node_parameters(&parameters, &chip.flash);
        (woken.node_id, woken.bit_rate) = (node.id_or_none(), node.bit_rate);
        let choice = choose(&woken, &images(&chip.flash), &chip.flash, &parameters, Chosen);
        if let Some(value) = choice.store {
            store(value, &woken, &mut parameters, &mut chip.flash);
        }
        woken.stored = true;
        if !matches!(choice.exit, Exit::Choose) {
            break (choice, parameters);
        }
    };
    if SEALED {
        // SAFETY: nothing but the stack uses the RAM.
        unsafe { ram_image::wipe() };
    }
    if choice.waits {
        await_second_reset(&mut cell);
    }
    if let Some(damage) = choice.damage {
        cell.put(BootRequest::Damaged(damage));
    }
    match choice.exit {
        // SAFETY: since the reset no interrupt was enabled and no bus master started.
        Exit::Program(start) => unsafe { enter_program(chip, caches, &woken, &parameters, &start) },
        Exit::Bootloader { place, origin, image, stay, crash_resets, renewal } => {
            let report = woken.report(stay, crash_resets, renewal);
            // SAFETY: as above, and only the stack uses the RAM; `choose` has checked the image.
            unsafe { enter_bootloader(chip, caches, place, origin, image, &report) }
        }
        Exit::Again | Exit::Choose => reset_later(),
    }
}

/// Takes the peripherals, and sets what must not wait.
///
/// # Safety
/// Nothing else may run.
unsafe fn chip() -> Chip {
    // SAFETY: nothing else runs.
    let chip = unsafe {
        Chip {
            rcc: pac::RCC::steal(),
            iwdg: pac::IWDG::steal(),
            flash: ResidentFlash::steal(CrcUnit::Own).in_stage(),
        }
    };
    // A watchdog that the option bytes start could end the erase of a sector: it bites after 512 ms,
    // 349 at the fastest LSI.
    if chip.flash.starts_watchdog() {
        bsp::watchdog::rescale(&chip.iwdg, bsp::watchdog::SLOWEST);
    }
    bsp::low_power::keep_clocks_in_sleep(&chip.rcc);
    chip
}

/// Reads what is read once, and removes it, so that no later reset reads it again. Does not return
/// after a jump that left more than a reset does, and if the request is for the loader in the ROM.
fn take(rcc: &pac::RCC, cell: &mut Cell) -> Woken {
    let status = rcc.csr().read();
    // SAFETY: it removes the flags, and leaves the LSI as it is.
    rcc.csr().write(|w| unsafe { w.bits(status.bits()).rmvf().set_bit() });
    let cause = ResetCause::from_flags(status.bits(), bsp::low_power::take(rcc));
    // Without a reset cause an application has jumped here. The flash may be locked, the watchdog, whose
    // clock is the LSI, may run, and an exception may be active. A reset ends all; the request stays in the
    // cell.
    let in_handler = || SCB::vect_active() != VectActive::ThreadMode;
    if cause == ResetCause::Unknown && (SEALED || status.lsirdy().bit_is_set() || in_handler()) {
        SCB::sys_reset();
    }
    let is_marked = PRODUCT.ways_in.two_resets && cell.is_marked();
    let request = cell.take();
    if PRODUCT.ways_in.rom_loader && request == Some(BootRequest::RomLoader) && cause == ResetCause::Software
    {
        // SAFETY: since the reset no interrupt was enabled and no bus master started.
        unsafe { enter_rom(rcc) };
    }
    Woken {
        cause,
        request,
        is_marked,
        strap: bsp::entry_strap(bsp::clock::HSI),
        ended: if product::RENEWS { ended(cause) } else { None },
        // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image.
        // Nothing has written it since the program started.
        program: unsafe { Handoff::read_program(LAYOUT.handoff.base as *const Handoff) },
        node_id: NO_NODE_ID,
        bit_rate: BitRate::Auto,
        stored: false,
    }
}

/// The origin of the RAM image that ran before this reset, by its report; `None` if a program ran,
/// or the power failed: a short dip may leave the RAM as it was.
fn ended(cause: ResetCause) -> Option<Origin> {
    if matches!(cause, ResetCause::PowerOn | ResetCause::BrownOut) {
        return None;
    }
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image;
    // nothing else runs.
    let words = unsafe { (LAYOUT.handoff.base as *const Words).read_volatile() };
    BootReport::parse(&words).map(|report| of_word(report.renewal).0)
}

/// The places of the RAM image.
fn images(flash: &ResidentFlash) -> Images<impl Fn(Region) -> Result<VectorTable, Damage> + '_> {
    let Places { home, staging } = match Places::of(LAYOUT) {
        Some(places) if product::RENEWS => places,
        _ => Places { home: ram_image::home(), staging: Region::new(0, 0) },
    };
    // SAFETY: they are places of the layout.
    Images { home, staging, check: |place| unsafe { ram_image::check(flash, place) } }
}

/// Stores a value, if the supply is good enough for the journal. What is not stored is lost, and
/// the start continues.
fn store(value: Store, woken: &Woken, parameters: &mut Parameters, flash: &mut ResidentFlash) {
    if bsp::supply::state() == Supply::Low {
        return;
    }
    match value {
        Store::Asked => crate::callgate::store_after_reset(flash, woken.request),
        Store::CrashCount(count) => {
            let _ = storing::store(parameters, flash, Key::CRASH_COUNT, [count, 0, 0, 0]);
        }
    }
}

/// Marks the first reset by the pin, and gives the second one its time. A watchdog of the option
/// bytes does not bite meanwhile: it has its longest time.
fn await_second_reset(cell: &mut Cell) {
    let core = Source::Internal.tree().sysclk();
    bsp::pause(core, PinReset::BOUNCE_MS);
    cell.mark();
    bsp::pause(core, PinReset::WITHIN_MS - PinReset::BOUNCE_MS);
    cell.clear();
}

/// Resets the chip after [`RESET_PERIOD_MS`].
fn reset_later() -> ! {
    if functions::HAS_EACH_10_MS {
        bsp::pause(Source::Internal.tree().sysclk(), RESET_PERIOD_MS);
        SCB::sys_reset()
    }
    // One pass of the loop takes three cycles.
    cortex_m::asm::delay(Source::Internal.tree().sysclk() / 1000 * RESET_PERIOD_MS / 3);
    SCB::sys_reset()
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

/// Enters the RAM image in a place, with a report of what is left for it.
///
/// # Safety The image must be good ([`ram_image::check`]). No interrupt may be enabled, no bus
/// master started, and only the stack may use the RAM.
// One call: without a function of its own it is shorter.
#[inline(always)]
unsafe fn enter_bootloader(
    chip: Chip,
    caches: Caches,
    place: Region,
    origin: Origin,
    vectors: VectorTable,
    report: &BootReport,
) -> ! {
    // SAFETY: the caller guarantees it. The copy takes less than a millisecond.
    unsafe {
        ram_image::copy(place);
        functions::poll();
        functions::end();
    }
    drop(caches);
    if let (Origin::Trial, Some(ms)) = (origin, PRODUCT.watchdog.bootloader_ms) {
        // An image that hangs before it starts the watchdog ends, too.
        bsp::watchdog::start(&chip.iwdg, ms);
    }
    // The image changes the clock. The CRC unit keeps its clock, for the services.
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image. The
    // caller guarantees the rest.
    unsafe {
        (LAYOUT.handoff.base as *mut Words).write_volatile(report.words());
        vectors.jump()
    }
}

/// Starts a program on a clean chip.
///
/// # Safety
/// No interrupt may be enabled, and no bus master started.
// One call: without a function of its own it is shorter.
#[inline(always)]
unsafe fn enter_program(
    chip: Chip,
    caches: Caches,
    woken: &Woken,
    parameters: &Parameters,
    start: &Start,
) -> ! {
    let handoff = handoff(woken, start, date(start, parameters, &chip.flash));
    let has_watchdog = chip.flash.starts_watchdog();
    // SAFETY: from here on nothing polls.
    unsafe { functions::end() };
    functions::each_10_ms();
    functions::before_leaving();
    drop(caches);
    chip.flash.release(&chip.rcc);
    bsp::low_power::release(&chip.rcc);
    bsp::slow_down(&chip.rcc);
    if SEALED && start.locks_flash {
        // SAFETY: only this code runs, and it writes the flash no more.
        unsafe { crate::flash_lock::lock_flash() };
    }
    if let Some(ms) = PRODUCT.watchdog.program_ms {
        bsp::watchdog::start(&chip.iwdg, ms);
    } else if has_watchdog {
        bsp::watchdog::rescale(&chip.iwdg, bsp::watchdog::AFTER_RESET);
    }
    // SAFETY: the layout's handoff region, checked to be RAM of that size outside every image. The
    // caller guarantees the rest.
    unsafe {
        handoff.write(LAYOUT.handoff.base as *mut Handoff);
        start.vectors.jump()
    }
}

/// The date of a program, for the handoff; 0 if it is not known, or the product has no dates.
fn date(start: &Start, parameters: &Parameters, flash: &ResidentFlash) -> u32 {
    let number = start.number;
    let record = || Some((parameters.program(flash, number)?, LAYOUT.program(number)?));
    match PRODUCT.download.program_date.then(record).flatten() {
        Some((record, region)) => parameters.date(flash, number, region, &record),
        None => 0,
    }
}

/// What a program is told.
fn handoff(woken: &Woken, start: &Start, program_date: u32) -> Handoff {
    let nameplate = product::nameplate();
    Handoff::new(&BootInfo {
        node_id: woken.node_id,
        bit_rate: woken.bit_rate.or_zero(),
        program: start.number,
        reset_cause: woken.cause,
        trial: start.trial,
        fresh: matches!(woken.request, Some(BootRequest::Fresh(_))),
        bootloader_version: product::VERSION,
        serial_number: product::serial_number(nameplate.as_ref()),
        bootloader_number: PRODUCT.bootloader_number(),
        sdo: SdoBases { request: PRODUCT.sdo.request_base, response: PRODUCT.sdo.response_base },
        program_date,
        nameplate: nameplate.is_some(),
    })
}
