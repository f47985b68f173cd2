//! An application on coboot without a CANopen stack and without an executor, for the
//! stm32f407g-disc1: boot-up, heartbeat, and updates over the bus.
#![no_std]
#![no_main]

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicU32, Ordering};

use coboot_app::layout::Layout;
use coboot_app::responder::{Device, Frame, Responder};
use coboot_app::{Bootloader, Defaults, Next, ProgramControl, ReentryPath, Start};
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::peripheral::SCB;
use stm32f4xx_hal::can::{Can, CanExt};
use stm32f4xx_hal::pac::{CorePeripherals, Peripherals, CAN1};
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::rcc::Config;

static LAYOUT: Layout = coboot_app::layout!();

const VENDOR_ID: u32 = 0;
const PRODUCT_CODE: u32 = 0x4007_D151;

#[cfg(not(feature = "without-label"))]
coboot_app::label!(vendor_id: VENDOR_ID, product_code: PRODUCT_CODE, version: 1);

type Port = bxcan::Can<Can<CAN1>>;

const SYSCLK: u32 = 168_000_000;
/// The clock of bxCAN.
const PCLK1: u32 = 42_000_000;

/// Milliseconds since the start.
static MILLIS: AtomicU32 = AtomicU32::new(0);

#[cortex_m_rt::entry]
fn main() -> ! {
    let (Some(device), Some(mut core)) = (Peripherals::take(), CorePeripherals::take()) else {
        SCB::sys_reset()
    };
    #[cfg(feature = "wrong-vtor")]
    // SAFETY: it is wrong, on purpose: the table is the bootloader's.
    unsafe {
        core.SCB.vtor.write(0x0800_0000);
    }
    let clocks = Config::hse(8.MHz()).sysclk(SYSCLK.Hz()).pclk1(PCLK1.Hz());
    let mut rcc = device.RCC.freeze(clocks);
    core.SYST.set_clock_source(SystClkSource::Core);
    core.SYST.set_reload(SYSCLK / 1000 - 1);
    core.SYST.enable_interrupt();
    core.SYST.enable_counter();

    let start = Start::read(&LAYOUT, Defaults { node_id: Some(1), bit_rate: 125_000, serial_number: 0 });

    let gpiod = device.GPIOD.split(&mut rcc);
    let can = device.CAN1.can((gpiod.pd1, gpiod.pd0), &mut rcc);
    let mut can = bxcan::Can::builder(can).set_bit_timing(timing(start.bit_rate)).leave_disabled();

    let mut bootloader = Bootloader::new(&LAYOUT);
    let programs = LAYOUT.programs.len() as u8;
    let crc = bootloader.program_crc(start.program);
    let control = ProgramControl::new(&start, programs, crc);
    let device = Device {
        device_type: 0,
        vendor_id: VENDOR_ID,
        product_code: PRODUCT_CODE,
        revision: 0x0001_0000,
        serial_number: start.serial_number,
        heartbeat_ms: 500,
    };
    let Some(mut responder) = start.node_id.and_then(|id| Responder::new(device, id, control)) else {
        // A device without a node-ID waits for layer setting services: the bootloader's.
        bootloader.leave(ReentryPath::SystemReset, coboot_app::warm_start::BootRequest::Stay)
    };
    accept(&mut can, responder.identifiers());
    // Joining takes 11 recessive bits; the controller waits for them by itself.
    let _ = can.enable_non_blocking();

    let mut confirmed = false;
    loop {
        let now = MILLIS.load(Ordering::Relaxed);
        while let Some(request) = receive(&mut can) {
            if let Some(answer) = responder.handle(&request, now, &mut bootloader) {
                send(&mut can, &answer);
            }
        }
        while let Some(frame) = responder.poll(now) {
            send(&mut can, &frame);
        }
        // This program is content with itself when its master has started it.
        if responder.is_operational() && !confirmed {
            confirmed = responder.control().confirm(now, &mut bootloader).is_ok();
        }
        if let Next::Leave(request) = responder.proceed(can.is_transmitter_idle(), now) {
            bootloader.leave(ReentryPath::SystemReset, request);
        }
        // The timer wakes it every millisecond.
        cortex_m::asm::wfi();
    }
}

/// The bit timing of a rate, with the sample point at 86 %: 14 quanta, 11 of them before it (RM0090
/// section 32.7.7). The bootloader comes up with a rate that the clock can make.
fn timing(bit_rate: u32) -> u32 {
    let prescaler = PCLK1 / 14 / bit_rate.max(3_000);
    (2 - 1) << 20 | (11 - 1) << 16 | (prescaler.max(1) - 1)
}

fn accept(can: &mut Port, [a, b]: [u16; 2]) {
    use bxcan::filter::{BankConfig, ListEntry16};
    use bxcan::{Fifo, StandardId};
    let entry = |id| ListEntry16::data_frames_with_id(StandardId::new(id).unwrap_or(StandardId::MAX));
    let bank = BankConfig::List16([entry(a), entry(b), entry(b), entry(b)]);
    can.modify_filters().clear().enable_bank(0, Fifo::Fifo0, bank);
}

fn receive(can: &mut Port) -> Option<Frame> {
    // An overrun has lost a frame; those that are there are still good.
    let frame = loop {
        match can.receive() {
            Ok(frame) => break frame,
            Err(stm32f4xx_hal::nb::Error::WouldBlock) => return None,
            Err(stm32f4xx_hal::nb::Error::Other(_)) => {}
        }
    };
    let bxcan::Id::Standard(id) = frame.id() else { return None };
    Frame::new(id.as_raw(), frame.data()?)
}

fn send(can: &mut Port, frame: &Frame) {
    let (Some(id), Some(data)) = (bxcan::StandardId::new(frame.id()), bxcan::Data::new(frame.data())) else {
        return;
    };
    // Without a free mailbox the frame is lost: an answer is asked for again, a heartbeat follows.
    let _ = can.transmit(&bxcan::Frame::new_data(id, data));
}

#[cortex_m_rt::exception]
fn SysTick() {
    MILLIS.fetch_add(1, Ordering::Relaxed);
}

/// Faults and panics reset without a request: the bootloader counts them.
#[cortex_m_rt::exception]
unsafe fn HardFault(_: &cortex_m_rt::ExceptionFrame) -> ! {
    SCB::sys_reset()
}

#[panic_handler]
fn panic(_: &PanicInfo) -> ! {
    SCB::sys_reset()
}
