//! The application of the tests: that of the template, with what only tests need.
//!
//! | file | what it adds |
//! |---|---|
//! | `main.rs` | the tasks of the template; CAN over the UART, and a second version |
//! | `device.rs` | the objects of a lift and of the debugger, 2000h and 2001h |
//! | `debugger.rs` | the debugger interface with breakpoints (feature `debugger`) |
//! | `no_debugger.rs` | nothing, in its place |
//!
//! Priorities: 4 and 3 serve the bus, 1 and `idle` are the application's. 2 is the debugger's, which
//! stops what is below it and nothing else.
#![no_std]
#![no_main]

#[cfg_attr(not(feature = "debugger"), path = "no_debugger.rs")]
mod debugger;
mod device;

use bsp::IDENTITY;
use panic_probe as _;
use rtic_monotonics::systick::prelude::*;

systick_monotonic!(Mono, 1_000);

/// Whether this is version 2.
const IS_VERSION_2: bool = cfg!(feature = "version-2");
/// 100Ah.
const VERSION: &str = if IS_VERSION_2 { "2.0.0" } else { "1.0.0" };

/// 100Ah as update tools find it in the image (CiA 814-1 clause 6.5).
#[used]
static MARKED_VERSION: &str =
    if IS_VERSION_2 { "$CANopenSoftwareVersion\x002.0.0\0" } else { "$CANopenSoftwareVersion\x001.0.0\0" };

// Whom this image is for, at the place where the bootloader looks before it takes a raw image or HEX
// file.
coboot_app::label!(
    vendor_id: IDENTITY.vendor_id,
    product_code: IDENTITY.product_code,
    version: if IS_VERSION_2 { 2 } else { 1 },
);

/// A fault, or a panic (which ends in a fault), restarts the device. The bootloader decides which
/// program runs then.
#[cfg(not(feature = "debugger"))]
#[cortex_m_rt::exception]
unsafe fn HardFault(_frame: &cortex_m_rt::ExceptionFrame) -> ! {
    cortex_m::peripheral::SCB::sys_reset()
}

#[rtic::app(device = bsp::pac, peripherals = true, dispatchers = [SPI1])]
mod app {
    use app_template::bus::carry_out;
    use bsp::clock::Source;
    use bsp::{line, pac, CanPort, LAYOUT};
    use canopen::slave::Slave;
    use canopen::{Frame, Instant};
    use coboot_app::{Bootloader, Exit, Next};
    use heapless::spsc::{Consumer, Producer, Queue};
    use rtic::Mutex;
    use rtic_monotonics::fugit::ExtU32;
    use rtic_monotonics::Monotonic;

    use super::{Mono, VERSION};
    use crate::debugger::{self, Debugger};
    use crate::device::Device;

    /// Received frames that may wait for the protocol task.
    const RX_QUEUE: usize = 16;
    /// How often the protocol looks at its deadlines, in ms.
    const TICK_MS: u32 = 2;
    /// How the device is to leave: from the protocol task to `idle`, where no exception is active.
    static EXIT: Exit = Exit::new();

    #[shared]
    struct Shared {
        can: CanPort,
    }

    #[local]
    struct Local {
        received: Producer<'static, Frame>,
        to_handle: Consumer<'static, Frame>,
        slave: Slave,
        device: Device,
        debugger: Debugger,
        led: bsp::Led,
    }

    #[init(local = [queue: Queue<Frame, RX_QUEUE> = Queue::new()])]
    fn init(cx: init::Context) -> (Shared, Local) {
        // The internal oscillator is not exact enough for CAN. After three such resets the bootloader keeps the
        // device, and it can be reached.
        let Some(mut rcc) = bsp::clocks(cx.device.RCC) else { cortex_m::peripheral::SCB::sys_reset() };
        let board = bsp::init(&mut rcc, cx.device.CAN1);
        #[cfg(not(feature = "virtual-can"))]
        let can = CanPort::new(board.can, Source::Crystal);
        #[cfg(feature = "virtual-can")]
        let can = CanPort::new(board.uart, Source::Crystal);
        Mono::start(bsp::cleared_systick(cx.core.SYST), bsp::SYSCLK);

        let (device, slave) = Device::start(VERSION);
        let (received, to_handle) = cx.local.queue.split();
        tick::spawn().ok();
        (
            Shared { can },
            Local { received, to_handle, slave, device, debugger: debugger::start(), led: board.led },
        )
    }

    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            if let Some((path, request)) = EXIT.asked() {
                Bootloader::new(LAYOUT).leave(path, request);
            }
            cortex_m::asm::wfi();
        }
    }

    /// Empties the controller's FIFO. It holds three frames only, so nothing may delay this task.
    #[task(binds = CAN1_RX0, shared = [can], local = [received], priority = 4)]
    fn can_rx(mut cx: can_rx::Context) {
        cx.shared.can.lock(|can| line::receive(can, |frame| cx.local.received.enqueue(frame).is_ok()));
        rtic::pend(pac::Interrupt::CAN1_TX);
    }

    /// Runs the protocol when a frame came in, a mailbox became free or time has passed.
    #[task(binds = CAN1_TX, shared = [can], local = [to_handle, slave, device, debugger], priority = 3)]
    fn protocol(cx: protocol::Context) {
        let now = Instant::from_millis(Mono::now().ticks());
        let protocol::SharedResources { mut can, .. } = cx.shared;
        let protocol::LocalResources { to_handle, slave, device, debugger, .. } = cx.local;
        device.set_time(now);
        let status = can.lock(line::status);
        debugger.with(device, |device| slave.observe(status, now, device));
        while serves(slave, &mut can, device) {
            // A frame that finds no room (a heartbeat on a busy bus) must not keep the requests
            // that wait after it.
            debugger.with(device, |device| carry_out(slave, &mut can, now, device));
            let Some(frame) = to_handle.dequeue() else { return };
            if debugger.with(device, |device| slave.handle(&frame, now, device)) {
                device.application.control.nmt_reset(now.as_millis());
            }
        }
    }

    /// Advances the departure, if one is in progress. Returns whether requests are served.
    fn serves(slave: &Slave, can: &mut impl Mutex<T = CanPort>, device: &mut Device) -> bool {
        let bus_idle = slave.is_idle() && can.lock(CanPort::is_idle);
        match device.application.proceed(bus_idle) {
            Next::Serve => return true,
            Next::Wait => {}
            Next::Leave(request) => {
                EXIT.ask(device.path(request), request);
                debugger::release_program();
            }
        }
        false
    }

    /// Lets time pass for the protocol, and shows life.
    #[task(local = [led], priority = 1)]
    async fn tick(cx: tick::Context) {
        let mut ticks = 0_u32;
        loop {
            rtic::pend(pac::Interrupt::CAN1_TX);
            if ticks.is_multiple_of(500 / TICK_MS) {
                cx.local.led.toggle();
                debugger::example();
            }
            ticks = ticks.wrapping_add(1);
            // `delay` would wait for one tick of the clock more.
            Mono::delay_until(Mono::now() + TICK_MS.millis()).await;
        }
    }
}
