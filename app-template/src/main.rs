//! The reference application: a small CANopen node that its bootloader can always get back.
//!
//! | file | what to do with it |
//! |---|---|
//! | `main.rs` | wiring of the tasks: put your own beside them |
//! | `entries.rs` | the table of the object dictionary: add your objects and PDOs; keep 1F51h, 1F56h and 1F57h |
//! | `process.rs` | the values of your objects, what the machine does, `may_leave`, and frames of your own |
//! | `objects.rs` | the values of the other objects, and the callback `start_bootloader` |
//! | `bus.rs` | nothing: it carries out what the slave asks of the CAN controller |
//! | `Cargo.toml` | the version of the application |
//!
//! Priorities: 4 and 3 serve the bus, 1 and `idle` are the application's; 2 is free.
#![no_std]
#![no_main]

use bsp::{IDENTITY, LAYOUT};
use coboot_app::warm_start::BootRequest;
use coboot_app::{Bootloader, ReentryPath};
use panic_probe as _;
use rtic_monotonics::systick::prelude::*;

systick_monotonic!(Mono, 1_000);

/// 100Ah: the version in `Cargo.toml`.
const VERSION: &str = env!("CARGO_PKG_VERSION");
/// The first number of the version.
const MAJOR: u32 = match u32::from_str_radix(env!("CARGO_PKG_VERSION_MAJOR"), 10) {
    Ok(number) => number,
    Err(_) => unreachable!(),
};

// Whom this image is for, at the place where the bootloader looks before it takes a raw image or HEX
// file.
coboot_app::label!(
    vendor_id: IDENTITY.vendor_id,
    product_code: IDENTITY.product_code,
    version: MAJOR,
);

/// 100Ah as update tools find it in the image (CiA 814-1 clause 6.5).
#[used]
static MARKED_VERSION: &str = concat!("$CANopenSoftwareVersion\0", env!("CARGO_PKG_VERSION"), "\0");

/// A fault, or a panic (which ends in a fault), restarts the device. The bootloader decides which
/// program runs then.
#[cortex_m_rt::exception(trampoline = false)]
unsafe fn HardFault() -> ! {
    cortex_m::peripheral::SCB::sys_reset()
}

/// The crystal has failed (RM0090 section 7.2.7), which is no crash of the program. The next start finds whether it
/// runs again.
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() -> ! {
    Bootloader::new(LAYOUT).leave(ReentryPath::SystemReset, BootRequest::PowerOn)
}

#[rtic::app(device = bsp::pac, peripherals = true, dispatchers = [SPI1])]
mod app {
    use app_template::bus::carry_out;
    use app_template::objects::Application;
    use bsp::clock::Source;
    use bsp::{functions, line, pac, CanPort, LAYOUT};
    use canopen::slave::Slave;
    use canopen::{Frame, Instant};
    use coboot_app::{Bootloader, Next, ReentryPath};
    use heapless::spsc::{Consumer, Producer, Queue};
    use rtic::Mutex;
    use rtic_monotonics::fugit::ExtU32;
    use rtic_monotonics::Monotonic;

    use super::{Mono, VERSION};

    /// Received frames that may wait for the protocol task.
    const RX_QUEUE: usize = 16;
    /// How often the protocol looks at its deadlines, in ms.
    const TICK_MS: u32 = 2;

    #[shared]
    struct Shared {
        can: CanPort,
    }

    #[local]
    struct Local {
        received: Producer<'static, Frame>,
        to_handle: Consumer<'static, Frame>,
        slave: Slave,
        application: Application,
        led: bsp::Led,
    }

    #[init(local = [queue: Queue<Frame, RX_QUEUE> = Queue::new()])]
    fn init(cx: init::Context) -> (Shared, Local) {
        // The internal oscillator is not exact enough for CAN. After three such resets the bootloader keeps the
        // device, and it can be reached.
        let Some(mut rcc) = bsp::clocks(cx.device.RCC) else { cortex_m::peripheral::SCB::sys_reset() };
        let board = bsp::init(&mut rcc, cx.device.CAN1);
        let can = CanPort::new(board.can, Source::Crystal);
        Mono::start(bsp::cleared_systick(cx.core.SYST), bsp::SYSCLK);

        let (application, slave) = Application::start(VERSION);
        let (received, to_handle) = cx.local.queue.split();
        tick::spawn().ok();
        (Shared { can }, Local { received, to_handle, slave, application, led: board.led })
    }

    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
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
    #[task(binds = CAN1_TX, shared = [can], local = [to_handle, slave, application], priority = 3)]
    fn protocol(cx: protocol::Context) {
        let now = Instant::from_millis(Mono::now().ticks());
        let protocol::SharedResources { mut can, .. } = cx.shared;
        let protocol::LocalResources { to_handle, slave, application, .. } = cx.local;
        application.set_time(now);
        let status = can.lock(line::status);
        slave.observe(status, now, application);
        while serves(slave, &mut can, application) {
            // A frame that finds no room (a heartbeat on a busy bus) must not keep the requests
            // that wait after it.
            carry_out(slave, &mut can, now, application);
            let Some(frame) = to_handle.dequeue() else { return };
            if slave.handle(&frame, now, application) {
                application.control.nmt_reset(now.as_millis());
            }
        }
    }

    /// Advances the departure, if one is in progress. Returns whether requests are served.
    fn serves(slave: &Slave, can: &mut impl Mutex<T = CanPort>, application: &mut Application) -> bool {
        let bus_idle = slave.is_idle() && can.lock(CanPort::is_idle);
        match application.proceed(bus_idle) {
            Next::Serve => true,
            Next::Wait => false,
            Next::Leave(request) => {
                functions::before_leaving();
                Bootloader::new(LAYOUT).leave(ReentryPath::SystemReset, request)
            }
        }
    }

    /// Lets time pass for the protocol, and shows life.
    #[task(local = [led], priority = 1)]
    async fn tick(cx: tick::Context) {
        let mut ticks = 0_u32;
        loop {
            rtic::pend(pac::Interrupt::CAN1_TX);
            if ticks.is_multiple_of(500 / TICK_MS) {
                cx.local.led.toggle();
            }
            // The board's external watchdog, if it has one. The protocol, which has a higher priority, does not hang
            // if this runs; ask here what proves that your tasks work, too.
            if ticks.is_multiple_of(10 / TICK_MS) {
                functions::each_10_ms();
            }
            ticks = ticks.wrapping_add(1);
            // `delay` would wait for one tick of the clock more.
            Mono::delay_until(Mono::now() + TICK_MS.millis()).await;
        }
    }
}
