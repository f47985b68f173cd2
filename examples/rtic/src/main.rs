//! A program on RTIC with a CANopen stack of its own (`stack.rs`), which asks `coboot-app` for the
//! objects of the bootloader's world (`objects.rs`). `device.rs` says which device it is.
//!
//! Priority 2 serves the bus, 1 is the application's.
#![no_std]
#![no_main]

mod device;
mod objects;
mod stack;

use core::panic::PanicInfo;

use bxcan::filter::{BankConfig, ListEntry16};
use bxcan::{Can, Data, Fifo, Frame, Instance, StandardId};
use coboot_app::{bxcan as fifo, Bootloader, Next, ReentryPath};
use cortex_m::peripheral::SCB;
use cortex_m_rt::{exception, ExceptionFrame};
use rtic_monotonics::systick::prelude::*;
use stm32f4xx_hal::pac::{CAN1, RCC};

use crate::device::{LAYOUT, PRODUCT_CODE, VENDOR_ID};
use crate::objects::Objects;
use crate::stack::{Event, Node};

const VERSION: u32 = if cfg!(feature = "version-2") { 2 } else { 1 };
const HEARTBEAT_MS: u32 = 500;
/// How often the protocol looks at the clock, in ms.
const TICK_MS: u32 = 2;
/// Number of checks whether the crystal runs: some 100 ms at 16 MHz.
const PATIENCE: u32 = 200_000;

coboot_app::label!(vendor_id: VENDOR_ID, product_code: PRODUCT_CODE, version: VERSION);

systick_monotonic!(Mono, 1_000);

#[rtic::app(device = stm32f4xx_hal::pac, peripherals = true, dispatchers = [SPI1])]
mod app {
    use core::sync::atomic::Ordering;

    use bxcan::Interrupt;
    use coboot_app::warm_start::BootRequest;
    use coboot_app::{BitTiming, Defaults, Start};
    use stm32f4xx_hal::can::CanExt;
    use stm32f4xx_hal::gpio::{Output, PD12};
    use stm32f4xx_hal::pac;
    use stm32f4xx_hal::prelude::*;
    use stm32f4xx_hal::rcc::Config;

    use super::*;

    #[shared]
    struct Shared {}

    #[local]
    struct Local {
        bus: Bus,
        led: PD12<Output>,
    }

    #[init]
    fn init(cx: init::Context) -> (Shared, Local) {
        if !start_crystal(&cx.device.RCC) {
            // The internal oscillator is not exact enough for CAN. After three such resets the bootloader keeps
            // the device, and it can be reached.
            SCB::sys_reset();
        }
        let mut rcc = cx.device.RCC.freeze(Config::hse(8.MHz()).sysclk(168.MHz()));
        // Its counter holds anything after a reset: the first tick could be a tenth of a second late.
        let mut systick = cx.core.SYST;
        systick.clear_current();
        Mono::start(systick, rcc.clocks.sysclk().raw());

        // The bootloader gives node-ID and bit rate, so that whoever talked to it goes on talking to
        // this program. The defaults hold where a debugger has started the program.
        let defaults = Defaults { node_id: Some(32), bit_rate: 125_000, serial_number: 0 };
        let start = Start::read(&LAYOUT, defaults);
        let bootloader = Bootloader::new(&LAYOUT);
        let node = start.node_id.and_then(|node_id| Node::new(node_id, [start.sdo().request, start.sdo().response], HEARTBEAT_MS));
        let timing = BitTiming::new(rcc.clocks.pclk1().raw(), start.bit_rate);
        let (Some(node), Some(timing)) = (node, timing) else {
            // A node-ID or a bit rate that has to be found out first: the bootloader can.
            bootloader.leave(ReentryPath::SystemReset, BootRequest::Stay);
        };

        let port = cx.device.GPIOD.split(&mut rcc);
        let pins = (port.pd1, port.pd0);
        let can = cx.device.CAN1.can(pins, &mut rcc);
        let mut can = Can::builder(can).set_bit_timing(timing.register()).leave_disabled();
        let [nmt, sdo] = node.identifiers().map(data_frames);
        can.modify_filters().enable_bank(0, Fifo::Fifo0, BankConfig::List16([nmt, sdo, nmt, sdo]));
        can.enable_interrupt(Interrupt::Fifo0MessagePending);
        // It joins as soon as the bus is idle: nothing waits for that here.
        let _ = can.enable_non_blocking();

        tick::spawn().ok();
        blink::spawn().ok();
        let objects = Objects::new(&start, bootloader);
        (
            Shared {},
            Local { bus: Bus { can, node, objects, bootloader }, led: port.pd12.into_push_pull_output() },
        )
    }

    /// Speaks CANopen: when a frame came in, and when time has passed.
    #[task(binds = CAN1_RX0, local = [bus], priority = 2)]
    fn protocol(cx: protocol::Context) {
        cx.local.bus.serve(Mono::now().ticks());
    }

    /// Lets time pass for the protocol.
    #[task(priority = 1)]
    async fn tick(_: tick::Context) {
        loop {
            rtic::pend(pac::Interrupt::CAN1_RX0);
            Mono::delay(TICK_MS.millis()).await;
        }
    }

    /// Your own work.
    #[task(local = [led], priority = 1)]
    async fn blink(cx: blink::Context) {
        loop {
            cx.local.led.toggle();
            Mono::delay(u32::from(objects::BLINK_MS.load(Ordering::Relaxed)).millis()).await;
        }
    }
}

/// The node on its bus.
struct Bus {
    can: Can<stm32f4xx_hal::can::Can<CAN1>>,
    node: Node,
    objects: Objects,
    bootloader: Bootloader,
}

impl Bus {
    /// Takes what was received, and sends what is due, at this time in ms.
    fn serve(&mut self, now: u32) {
        self.objects.now = now;
        loop {
            // Asked after every frame: it may have asked for the bootloader.
            let serves = match self.objects.proceed(self.can.is_transmitter_idle()) {
                Next::Serve => true,
                Next::Wait => false,
                Next::Leave(request) => self.bootloader.leave(ReentryPath::SystemReset, request),
            };
            if serves {
                while let Some((id, data)) = self.node.poll(now) {
                    self.send(id, &data);
                }
            }
            // An overrun has lost a frame: the client asks again.
            let Some(frame) = receive(&mut self.can) else { return };
            // A device that is about to leave takes no request.
            if serves {
                self.handle(&frame);
            }
        }
    }

    fn handle(&mut self, frame: &fifo::Frame) {
        match self.node.handle(frame.id(), frame.data(), &mut self.objects) {
            Some(Event::Answer(id, answer)) => self.send(id, &answer),
            Some(Event::Reset) => self.objects.reset(),
            None => {}
        }
    }

    fn send(&mut self, id: u16, data: &[u8]) {
        let (Some(id), Some(data)) = (StandardId::new(id), Data::new(data)) else { return };
        // Where nobody acknowledges, heartbeats make room for an answer, which comes first by its
        // identifier.
        let _ = self.can.transmit(&Frame::new_data(id, data));
    }
}

/// Switches the crystal on. Returns whether it runs in time; the HAL would wait for it without a bound. With a
/// clock on OSC_IN, set HSEBYP first.
fn start_crystal(rcc: &RCC) -> bool {
    rcc.cr().modify(|_, w| w.hseon().set_bit());
    (0..PATIENCE).any(|_| rcc.cr().read().hserdy().bit_is_set())
}

/// The next frame from the FIFO. (`receive` of `bxcan` gives frames that panic when they are read, if they have
/// a data length code of 9 to 15, which any node may send.)
fn receive<I: Instance>(_: &mut Can<I>) -> Option<fifo::Frame> {
    // SAFETY: `Instance` promises the registers, and nobody else has the controller.
    unsafe { fifo::receive(I::REGISTERS.cast()) }
}

/// A filter for data frames with this identifier of 11 bits.
fn data_frames(id: u16) -> ListEntry16 {
    ListEntry16::data_frames_with_id(StandardId::new(id).unwrap_or(StandardId::ZERO))
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
