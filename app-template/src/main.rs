//! The reference application: a small CANopen node that its bootloader can always get back.
//!
//! | file | what to do with it |
//! |---|---|
//! | `main.rs` | wiring of the tasks: put your own beside them |
//! | `entries.rs` | the table of the object dictionary: add your objects; keep 1F51h, 1F56h and 1F57h |
//! | `objects.rs` | the values behind it, with the 1F51h callback |
//! | `coboot.rs` | everything between application and bootloader: keep it as it is |
//! | `debugger.rs` | the debugger interface (feature `debugger`): never in a product |
//!
//! Priorities: 4 and 3 serve the bus, 1 and `idle` are the application's. 2 is left free for the
//! debugger, which stops what is below it and nothing else.
#![no_std]
#![no_main]

mod coboot;
mod debugger;
mod entries;
mod objects;

use panic_probe as _;
use rtic_monotonics::systick::prelude::*;

systick_monotonic!(Mono, 1_000);

/// A fault or a panic (which ends in one) starts the device again; what runs then is the
/// bootloader's decision.
#[cfg(not(feature = "debugger"))]
#[cortex_m_rt::exception]
unsafe fn HardFault(_frame: &cortex_m_rt::ExceptionFrame) -> ! {
    cortex_m::peripheral::SCB::sys_reset()
}

#[rtic::app(device = bsp::pac, peripherals = true, dispatchers = [SPI1])]
mod app {
    use bsp::can::{BitTiming, Errors, Mode};
    use bsp::{pac, CanPort, CAN_CLOCK, LAYOUT};
    use canopen::bit_rate::Heard;
    use canopen::line::{Confinement, Status, CONTROLLER_OVERRUN, QUEUE_OVERRUN};
    use canopen::node::{self, NmtPolicy};
    use canopen::slave::{self, Output, Slave, SlaveDevice};
    use canopen::{BitRate, CobId, Frame, Instant};
    use heapless::spsc::{Consumer, Producer, Queue};
    use rtic::Mutex;
    use rtic_monotonics::fugit::ExtU32;
    use rtic_monotonics::Monotonic;

    use super::Mono;
    use crate::coboot::{self, Departure, Leave, ReentryPath};
    use crate::debugger::{self, Debugger};
    use crate::objects::{Application, HEARTBEAT_MS};

    /// Frames that may wait for the protocol task.
    const RX_QUEUE: usize = 16;
    /// How often the protocol looks at its deadlines, in ms.
    const TICK_MS: u32 = 5;

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
        debugger: Debugger,
        departure: Departure,
        led: bsp::Led,
    }

    #[init(local = [queue: Queue<Frame, RX_QUEUE> = Queue::new()])]
    fn init(cx: init::Context) -> (Shared, Local) {
        let mut rcc = bsp::clocks(cx.device.RCC);
        let board = bsp::init(&mut rcc, cx.device.CAN1);
        #[cfg(not(feature = "virtual-can"))]
        let can = CanPort::new(board.can);
        #[cfg(feature = "virtual-can")]
        let can = CanPort::new(board.uart);
        Mono::start(cx.core.SYST, bsp::SYSCLK);

        // Same node-ID and bit rate as the bootloader: whoever talked to it goes on talking to
        // this.
        let start = coboot::read_handoff(LAYOUT);
        let application = Application::new(&start);
        let config = slave::Config {
            node: node::Config {
                heartbeat_ms: HEARTBEAT_MS,
                nmt: NmtPolicy::Follow,
                ..node::Config::default()
            },
            ..slave::Config::default()
        };
        let (received, to_handle) = cx.local.queue.split();
        tick::spawn().ok();
        (
            Shared { can },
            Local {
                received,
                to_handle,
                slave: Slave::new(application.lss_address(), start.node_id, start.bit_rate, config),
                application,
                debugger: Debugger::start(),
                departure: Departure::NONE,
                led: board.led,
            },
        )
    }

    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            coboot::reenter_if_requested();
            cortex_m::asm::wfi();
        }
    }

    /// Empties the controller's FIFO: three frames deep, so nothing may hold this task up.
    #[task(binds = CAN1_RX0, shared = [can], local = [received], priority = 4)]
    fn can_rx(mut cx: can_rx::Context) {
        cx.shared.can.lock(|can| {
            while let Some(frame) = can.receive() {
                // A full queue drops the frame; the client's time-out repeats it, and an emergency
                // tells.
                if cx.local.received.enqueue(frame).is_err() {
                    can.record_overrun();
                }
            }
        });
        rtic::pend(pac::Interrupt::CAN1_TX);
    }

    /// Speaks CANopen: whenever a frame came in, a mailbox became free or time has passed.
    #[task(
        binds = CAN1_TX,
        shared = [can],
        local = [to_handle, slave, application, debugger, departure],
        priority = 3
    )]
    fn protocol(cx: protocol::Context) {
        let now = Instant::from_millis(Mono::now().ticks());
        let protocol::SharedResources { mut can, .. } = cx.shared;
        let protocol::LocalResources { to_handle, slave, application, debugger, departure, .. } = cx.local;
        if coboot::proceed(departure, slave.is_idle() && can.lock(|can| can.is_idle()), now) {
            return;
        }
        #[cfg(feature = "lift")]
        application.set_time(now);
        let status = can.lock(status);
        let device = debugger.attach(application);
        #[cfg(feature = "debugger")]
        let device = &mut { device };
        slave.observe(status, now, device);
        loop {
            let device = debugger.attach(application);
            #[cfg(feature = "debugger")]
            let device = &mut { device };
            // A frame that finds no room (a heartbeat on a busy bus) must not keep the requests
            // waiting behind it.
            carry_out(slave, &mut can, now, device);
            let Some(frame) = to_handle.dequeue() else { return };
            if slave.handle(&frame, now, device) {
                let leave = Leave::Answered(application.reset_request());
                coboot::begin(departure, ReentryPath::SystemReset, leave, slave, now);
            }
            if let Some((path, leave)) = application.take_leave() {
                coboot::begin(departure, path, leave, slave, now);
                if coboot::proceed(departure, slave.is_idle() && can.lock(|can| can.is_idle()), now) {
                    return;
                }
            }
        }
    }

    /// Does what the slave says, until it says nothing.
    fn carry_out(
        slave: &mut Slave,
        can: &mut impl Mutex<T = CanPort>,
        now: Instant,
        device: &mut impl SlaveDevice,
    ) {
        while let Some(output) = slave.poll(now, can.lock(|can| can.has_room()), device) {
            match output {
                Output::Send(frame) => can.lock(|can| can.send(&frame)),
                Output::Join(rate) => configure(can, rate, Mode::Normal),
                Output::Listen(rate) => configure(can, rate, Mode::Silent),
                Output::RecoverFromBusOff => can.lock(|can| can.recover_from_bus_off()),
                Output::Accept(ids) => can.lock(|can| can.accept(ids.map(CobId::get))),
            }
        }
    }

    fn configure(can: &mut impl Mutex<T = CanPort>, rate: BitRate, mode: Mode) {
        // Another rate is asked for by nobody: `coboot::supports` says so.
        if let Some(timing) = BitTiming::new(CAN_CLOCK, rate.or_zero()) {
            can.lock(|can| can.configure(timing, mode));
        }
    }

    /// What the slave wants to know of its line.
    fn status(can: &mut CanPort) -> Status {
        let errors = can.errors();
        let lost = can.take_overruns();
        Status {
            confinement: match errors {
                Errors { off: true, .. } => Confinement::BusOff,
                Errors { passive: true, .. } => Confinement::Passive,
                _ => Confinement::Active,
            },
            heard: match errors {
                Errors { joined: false, .. } => Heard::NeverIdle,
                Errors { last: None, .. } => Heard::Nothing,
                Errors { last: Some(Ok(())), .. } => Heard::Frame,
                Errors { last: Some(Err(())), .. } => Heard::Error,
            },
            lost: u16::from(lost.in_controller) * CONTROLLER_OVERRUN
                + u16::from(lost.in_queue) * QUEUE_OVERRUN,
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
                debugger::example();
            }
            ticks = ticks.wrapping_add(1);
            Mono::delay(TICK_MS.millis()).await;
        }
    }
}
