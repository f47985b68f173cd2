//! A program without a CANopen stack that its bootloader can always get back: a main loop, and the
//! responder of `coboot-app`, which is all that an update needs on the bus.
#![no_std]
#![no_main]

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicU32, Ordering};

use bxcan::filter::{BankConfig, ListEntry16};
use bxcan::{Can, Fifo, Frame, StandardId};
use coboot_app::layout::Layout;
use coboot_app::responder::{self, Device, Responder};
use coboot_app::warm_start::BootRequest;
use coboot_app::{label, BitTiming, Bootloader, Defaults, Next, ProgramControl, ReentryPath, Start};
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::peripheral::{SCB, SYST};
use cortex_m_rt::{entry, exception, ExceptionFrame};
use stm32f4xx_hal::can::CanExt;
use stm32f4xx_hal::pac::{CorePeripherals, Peripherals, RCC};
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::rcc::Config;

mod identity;

use identity::{NAME, PRODUCT_CODE, REVISION, VENDOR_ID};

/// Which version of the program this is: the last number of its label.
const VERSION: u32 = if cfg!(feature = "version-2") { 2 } else { 1 };

/// Number of checks whether the crystal runs: some 100 ms at 16 MHz.
const PATIENCE: u32 = 200_000;

/// Where everything is on this board: `build.rs` names it.
static LAYOUT: Layout = coboot_app::layout!();
coboot_app::label!(vendor_id: VENDOR_ID, product_code: PRODUCT_CODE, version: VERSION);

/// Time since the start, in ms. It wraps.
static NOW: AtomicU32 = AtomicU32::new(0);

#[entry]
fn main() -> ! {
    let (Some(core), Some(chip)) = (CorePeripherals::take(), Peripherals::take()) else {
        SCB::sys_reset();
    };
    if !start_crystal(&chip.RCC) {
        // The internal oscillator is not exact enough for CAN. After three such resets the bootloader keeps the
        // device, and it can be reached.
        SCB::sys_reset();
    }
    let mut rcc = chip.RCC.freeze(Config::hse(8.MHz()).sysclk(168.MHz()));
    let can_clock = rcc.clocks.pclk1().raw();
    count_milliseconds(core.SYST, rcc.clocks.sysclk().raw());

    // The bootloader gives node-ID and bit rate, so that whoever talked to it goes on talking to
    // this program. The defaults hold where a debugger has started the program.
    let defaults = Defaults { node_id: Some(32), bit_rate: 125_000, serial_number: 0 };
    let start = Start::read(&LAYOUT, defaults);
    let mut bootloader = Bootloader::new(&LAYOUT);
    let crc = bootloader.program_crc(start.program);
    let control = ProgramControl::new(&start, &LAYOUT, crc).asking(may_leave);
    let device = Device {
        device_type: 0,
        name: NAME,
        label: label::own(),
        vendor_id: VENDOR_ID,
        product_code: PRODUCT_CODE,
        revision: REVISION,
        serial_number: start.serial_number,
        heartbeat_ms: 500,
    };
    let responder = start.node_id.and_then(|node_id| Responder::new(device, node_id, control));
    let timing = BitTiming::new(can_clock, start.bit_rate);
    let (Some(mut responder), Some(timing)) = (responder, timing) else {
        // A node-ID or a bit rate that has to be found out first: the bootloader can.
        bootloader.leave(ReentryPath::SystemReset, BootRequest::Stay);
    };

    let port = chip.GPIOD.split(&mut rcc);
    let can = chip.CAN1.can((port.pd1, port.pd0), &mut rcc);
    let mut can = Can::builder(can).set_bit_timing(timing.register()).leave_disabled();
    let [nmt, sdo] = responder.identifiers().map(data_frames);
    can.modify_filters().enable_bank(0, Fifo::Fifo0, BankConfig::List16([nmt, sdo, nmt, sdo]));
    // It joins as soon as the bus is idle: nothing waits for that here.
    let _ = can.enable_non_blocking();

    let mut led = port.pd12.into_push_pull_output();
    let mut confirmed = false;
    loop {
        let now = NOW.load(Ordering::Relaxed);
        // An overrun has lost a frame: the client asks again.
        while let Some(request) = receive(&mut can) {
            if let Some(answer) = responder.handle(&request, now, &mut bootloader) {
                send(&mut can, &answer);
            }
            // It may have asked for the bootloader.
            responder.proceed(can.is_transmitter_idle(), now);
        }
        while let Some(frame) = responder.poll(now) {
            send(&mut can, &frame);
        }
        // The trial is over when the NMT master has started the node: it is content with it.
        if responder.is_operational() && !confirmed {
            confirmed = responder.control().confirm(now, &mut bootloader).is_ok();
        }
        if let Next::Leave(request) = responder.proceed(can.is_transmitter_idle(), now) {
            bootloader.leave(ReentryPath::SystemReset, request);
        }

        // Your own work: whatever does not take longer than some milliseconds. What stands must not
        // start to move while `responder.leaving()`: the reset comes within half a second.
        led.set_state((now / 500).is_multiple_of(2).into());

        // Until the next millisecond.
        cortex_m::asm::wfi();
    }
}

/// Whether the device may leave now, for its bootloader or for a reset: asked once, before a
/// command is answered. A machine that moves says no, and the command is refused (08000022h).
fn may_leave() -> bool {
    true
}

/// Switches the crystal on. Returns whether it runs in time; the HAL would wait for it without a bound. With a
/// clock on OSC_IN, set HSEBYP first.
fn start_crystal(rcc: &RCC) -> bool {
    rcc.cr().modify(|_, w| w.hseon().set_bit());
    (0..PATIENCE).any(|_| rcc.cr().read().hserdy().bit_is_set())
}

/// Starts the system timer at this clock of the core, in Hz: its interrupt counts [`NOW`].
fn count_milliseconds(mut systick: SYST, core_hz: u32) {
    systick.set_clock_source(SystClkSource::Core);
    systick.set_reload(core_hz / 1000 - 1);
    systick.clear_current();
    systick.enable_counter();
    systick.enable_interrupt();
}

/// A filter for data frames with this identifier of 11 bits.
fn data_frames(id: u16) -> ListEntry16 {
    ListEntry16::data_frames_with_id(StandardId::new(id).unwrap_or(StandardId::ZERO))
}

/// The next frame from the FIFO. (`receive` of `bxcan` gives frames that panic when they are read, if they have
/// a data length code of 9 to 15, which any node may send.)
fn receive<I: bxcan::Instance>(_: &mut Can<I>) -> Option<responder::Frame> {
    // SAFETY: `Instance` promises the registers, and nobody else has the controller.
    unsafe { coboot_app::bxcan::receive(I::REGISTERS.cast()) }
}

fn send(can: &mut Can<impl bxcan::Instance>, frame: &responder::Frame) {
    let (Some(id), Some(data)) = (StandardId::new(frame.id()), bxcan::Data::new(frame.data())) else {
        return;
    };
    // Where nobody acknowledges, heartbeats make room for an answer, which comes first by its
    // identifier.
    let _ = can.transmit(&Frame::new_data(id, data));
}

#[exception]
fn SysTick() {
    NOW.fetch_add(1, Ordering::Relaxed);
}

/// What a fault or a panic comes to is the bootloader's decision.
#[exception]
unsafe fn HardFault(_frame: &ExceptionFrame) -> ! {
    SCB::sys_reset()
}

#[panic_handler]
fn panic(_: &PanicInfo) -> ! {
    SCB::sys_reset()
}
