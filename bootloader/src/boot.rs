//! The boot stage: from the reset to the jump into a program, or to the bootloader's own `init`.
//!
//! It runs before `.bss` is cleared and before any peripheral but the reset flags, the warm-start cell, the flash
//! controller and the entry strap was touched. It therefore uses the stack and constants alone.

use core::arch::global_asm;
use core::ops::RangeInclusive;
use core::sync::atomic::{AtomicU8, Ordering};

use boot_core::canopen::{BitRate, NodeId};
use boot_core::decision::{decide, BootDecision, Circumstances, Policy};
use boot_core::node::NodeParameters;
use boot_core::parameters::{Journal, Key, Parameters as _};
use boot_core::program::verify;
use bsp::can::BitTiming;
use bsp::clock::Source;
use bsp::{pac, BIT_RATE, CAN_CLOCK, CLOCK_TREE, LAYOUT, NODE_ID};
use shared_abi::handoff::{BootInfo, Handoff, ResetCause};
use shared_abi::warm_start::{BootRequest, Cell};

use crate::flash::FlashController;
use crate::watchdog::Watchdog;
use crate::VERSION;

/// What this product does after a reset.
const POLICY: Policy = Policy { autostart: Some(1), max_crash_resets: 3, node_ids: NODE_IDS };
/// A program that is started has to feed the independent watchdog within this time, in ms, from its first instruction on;
/// `None` for a program that is started without one.
const PROGRAM_WATCHDOG_MS: Option<u16> = None;
/// Node-IDs with which programs may be started.
const NODE_IDS: RangeInclusive<u8> = 1..=127;

// Reset calls `__pre_init` first of all, from flash. It switches the FPU on (the compiler may use its registers to move
// data) and copies code and constants to RAM, as Reset will do once more; then the Rust below can run.
global_asm!(
    ".section .boot, \"ax\"",
    ".global __pre_init",
    ".type __pre_init,%function",
    ".thumb_func",
    "__pre_init:",
    "push {{r4, lr}}",
    "ldr r0, =0xE000ED88", // CPACR (ARMv7-M B3.2.20)
    "ldr r1, [r0]",
    "orr r1, r1, #0xF00000",
    "str r1, [r0]",
    "dsb",
    "ldr r0, =__sdata",
    "ldr r1, =__edata",
    "ldr r2, =__sidata",
    "0:",
    "cmp r0, r1",
    "beq 1f",
    "ldm r2!, {{r3}}",
    "stm r0!, {{r3}}",
    "b 0b",
    "1:",
    "dsb",
    "isb",
    "ldr r0, ={stage}",
    "blx r0",
    "pop {{r4, pc}}",
    ".ltorg",
    stage = sym stage,
);

/// Decides, and does not come back if a program is to run.
extern "C" fn stage() {
    // SAFETY: nothing else runs yet; `init` takes the peripherals after this has returned and dropped its own.
    let peripherals = unsafe { pac::Peripherals::steal() };
    let rcc = peripherals.RCC;

    let reset_cause = ResetCause::from_rcc_csr(rcc.csr().read().bits());
    rcc.csr().modify(|_, w| w.rmvf().set_bit());

    let request = warm_start_cell().take();
    let strap = bsp::entry_strap(&rcc, &peripherals.GPIOA);

    // A CRC over a whole program wants speed. Exact it need not be, and the crystal would take its time.
    CLOCK_TREE.speed_up(&rcc, Source::Internal);
    let mut flash = FlashController::new(peripherals.FLASH, peripherals.CRC, &rcc, LAYOUT.chip.flash);
    let mut parameters = parameters(&flash);
    let crash_resets = count_crash_resets(&mut parameters, &mut flash, reset_cause, request);

    let node = node_parameters(&parameters, &flash);
    let node_id = node.id.map_or(NO_NODE_ID, NodeId::get);
    let circumstances = Circumstances { request, strap, crash_resets, node_id };
    let decision = decide(&circumstances, &POLICY, |number| verify(&flash, &parameters, LAYOUT, number));
    // Whoever runs next finds the chip as after a reset.
    CLOCK_TREE.slow_down(&rcc);
    flash.release(&rcc);
    match decision {
        BootDecision::Stay(reason) => STAY_REASON.store(reason.code(), Ordering::Relaxed),
        BootDecision::Start { program, trial } => {
            let handoff = Handoff::new(&BootInfo {
                node_id,
                bit_rate: node.bit_rate.or_zero(),
                program: program.number(),
                reset_cause,
                trial,
                bootloader_version: VERSION,
                serial_number: bsp::serial_number(),
            });
            if let Some(ms) = PROGRAM_WATCHDOG_MS {
                Watchdog::start(&peripherals.IWDG, ms);
            }
            // SAFETY: the layout's handoff region, checked to be RAM of that size in no image. No interrupt was enabled
            // and no bus master started since the reset.
            unsafe {
                handoff.write(LAYOUT.handoff.base as *mut Handoff);
                program.vectors().jump()
            }
        }
    }
}

/// Node-ID and bit rate of a device that was never told others.
const BOARD_NODE: NodeParameters = NodeParameters {
    id: match NODE_ID {
        NO_NODE_ID => None,
        id => match NodeId::new(id) {
            Some(id) => Some(id),
            None => panic!("board: the node-ID must be 1 to 127, or 255 for none"),
        },
    },
    bit_rate: match BitRate::from_bits_per_second(BIT_RATE) {
        Some(rate) => {
            assert!(
                supports(rate),
                "board: the clock of the CAN controller cannot make the bit rate, or nothing can find it out"
            );
            rate
        }
        None => panic!("board: the bit rate must be one of CANopen's, or 0 to find it out"),
    },
};
/// Stands for no node-ID (CiA 305).
const NO_NODE_ID: u8 = 255;

/// Where this product keeps its parameters. One with an EEPROM puts its own [`boot_core::parameters::Parameters`] here.
pub type Parameters = Journal;

/// The parameters of this device.
pub fn parameters(flash: &FlashController) -> Parameters {
    Journal::open(flash, LAYOUT.chip, LAYOUT.parameters)
}

/// Node-ID and bit rate in force from this reset on.
pub fn node_parameters(parameters: &Parameters, flash: &FlashController) -> NodeParameters {
    NodeParameters::load(parameters, flash, BOARD_NODE, supports)
}

/// Whether the board's CAN controller can run at this bit rate.
pub const fn supports(rate: BitRate) -> bool {
    match rate {
        BitRate::Auto => cfg!(feature = "auto-bit-rate"),
        rate => TIMINGS[rate as usize].is_some(),
    }
}

/// How the board's CAN controller makes each bit rate.
pub const TIMINGS: [Option<BitTiming>; 9] = BitTiming::table(CAN_CLOCK, BitRate::TABLE);

/// Why the bootloader stayed, for `init`. It lies where the start-up clears nothing.
#[link_section = ".uninit.stay_reason"]
static STAY_REASON: AtomicU8 = AtomicU8::new(0);

/// Why the bootloader stayed ([`StayReason::code`](boot_core::decision::StayReason::code)).
pub fn stay_reason() -> u8 {
    STAY_REASON.load(Ordering::Relaxed)
}

/// The warm-start cell of this board.
pub fn warm_start_cell() -> Cell {
    // SAFETY: the layout's warm-start region, checked to be RAM of that size that the linker keeps out of every image.
    unsafe { Cell::at(LAYOUT.warm_start.base as *mut _) }
}

/// Keeps the number of watchdog resets in a row. A request of somebody ends the row: it is a new beginning.
fn count_crash_resets(
    parameters: &mut Parameters,
    flash: &mut FlashController,
    reset_cause: ResetCause,
    request: Option<BootRequest>,
) -> u32 {
    let crashed = matches!(reset_cause, ResetCause::IndependentWatchdog | ResetCause::WindowWatchdog);
    let before = parameters.get(flash, Key::CrashCount).map_or(0, |[count, ..]| count);
    let now = if crashed && request.is_none() { before.saturating_add(1) } else { 0 };
    if now != before {
        parameters.store(Key::CrashCount, [now, 0, 0, 0]);
        // Nothing else runs that could be kept waiting. A store that fails costs the count, not the start.
        while parameters.poll(flash).is_pending() {}
    }
    now
}
