//! The reference application: a small CANopen node that its bootloader can always get back.
//!
//! | file | what to do with it |
//! |---|---|
//! | `main.rs` | wiring of the tasks: put your own beside them |
//! | `entries.rs` | the table of the object dictionary: add your objects; keep 1F51h, 1F56h and 1F57h |
//! | `objects.rs` | the values behind it, with the 1F51h callback |
//! | `coboot.rs` | everything between application and bootloader: keep it as it is |
#![no_std]
#![no_main]

mod coboot;
mod entries;
mod objects;

use panic_probe as _;
use rtic_monotonics::systick::prelude::*;

systick_monotonic!(Mono, 1_000);

/// A fault or a panic (which ends in one) starts the device again; what runs then is the bootloader's decision.
#[cortex_m_rt::exception]
unsafe fn HardFault(_frame: &cortex_m_rt::ExceptionFrame) -> ! {
    cortex_m::peripheral::SCB::sys_reset()
}

#[rtic::app(device = bsp::pac, peripherals = true, dispatchers = [SPI1])]
mod app {
    use bsp::can::{BitTiming, Transmitter};
    use bsp::{pac, CanController, LAYOUT};
    use bxcan::Rx0;
    use canopen::nmt::NmtCommand;
    use canopen::node::{Config, NmtPolicy, Node};
    use canopen::{CobId, Frame, Instant};
    use heapless::spsc::{Consumer, Producer, Queue};
    use rtic_monotonics::fugit::ExtU32;
    use rtic_monotonics::Monotonic;

    use super::Mono;
    use crate::coboot::{self, Departure};
    use crate::objects::{Application, HEARTBEAT_MS};

    /// Frames that may wait for the protocol task.
    const RX_QUEUE: usize = 16;
    /// How often the protocol looks at its deadlines, in ms.
    const TICK_MS: u32 = 5;

    #[shared]
    struct Shared {}

    #[local]
    struct Local {
        receiver: Rx0<CanController>,
        received: Producer<'static, Frame>,
        to_handle: Consumer<'static, Frame>,
        transmitter: Transmitter<CanController>,
        node: Node,
        application: Application,
        departure: Departure,
        led: bsp::Led,
    }

    #[init(local = [queue: Queue<Frame, RX_QUEUE> = Queue::new()])]
    fn init(cx: init::Context) -> (Shared, Local) {
        let board = bsp::init(cx.device.RCC, cx.device.CAN1, cx.device.GPIOD);
        Mono::start(cx.core.SYST, bsp::SYSCLK);

        // Same node-ID and bit rate as the bootloader: whoever talked to it goes on talking to this.
        let start = coboot::how_we_came_up(LAYOUT);
        let timing = BitTiming::new(bsp::CAN_CLOCK, start.bit_rate).unwrap_or(coboot::DEFAULT_TIMING);
        let identifiers = [CobId::NMT, CobId::sdo_request(start.node_id)];
        let can = bsp::can::start(board.can, timing, &identifiers.map(|id| bsp::can::standard_id(id.get())));
        let (transmitter, receiver, _) = can.split();

        let config = Config { heartbeat_ms: HEARTBEAT_MS, nmt: NmtPolicy::Follow, ..Config::default() };
        let (received, to_handle) = cx.local.queue.split();
        tick::spawn().ok();
        (
            Shared {},
            Local {
                receiver,
                received,
                to_handle,
                transmitter: Transmitter::new(transmitter),
                node: Node::new(start.node_id, config),
                application: Application::new(&start),
                departure: Departure::Staying,
                led: board.led,
            },
        )
    }

    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            cortex_m::asm::wfi();
        }
    }

    #[task(binds = CAN1_RX0, local = [receiver, received], priority = 3)]
    fn can_rx(cx: can_rx::Context) {
        while let Some(frame) = bsp::can::receive(cx.local.receiver) {
            cx.local.received.enqueue(frame).ok();
        }
        rtic::pend(pac::Interrupt::CAN1_TX);
    }

    /// Speaks CANopen: whenever a frame came in, a mailbox became free or time has passed.
    #[task(binds = CAN1_TX, local = [to_handle, transmitter, node, application, departure], priority = 2)]
    fn protocol(cx: protocol::Context) {
        let now = Instant::from_millis(Mono::now().ticks());
        let protocol::LocalResources { to_handle, transmitter, node, application, departure, .. } = cx.local;
        while let Some(frame) = to_handle.dequeue() {
            match node.handle(&frame, now, application) {
                Some(NmtCommand::ResetNode) => coboot::restart(),
                Some(NmtCommand::ResetCommunication) => node.restart(node.id(), application),
                _ => {}
            }
            transmitter.pump(|| node.poll(now, application));
        }
        transmitter.pump(|| node.poll(now, application));

        if application.is_called_back() {
            let answered = node.is_sdo_idle() && transmitter.is_idle();
            departure.proceed(answered, now);
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
            ticks = ticks.wrapping_add(1);
            Mono::delay(TICK_MS.millis()).await;
        }
    }
}
