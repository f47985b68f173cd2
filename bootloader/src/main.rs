//! The CANopen bootloader for STM32F4.
//!
//! | file | what it does | unsafe |
//! |---|---|---|
//! | `main.rs` | tasks: wiring only | no |
//! | `boot.rs` | from the reset to the jump, or to `init` below | start-up, jump |
//! | `flash.rs` | the flash controller | registers |
//! | `ram_vectors.rs` | the vector table in RAM | one copy |
//! | `callgate.rs` | services for the application | its ABI |
//!
//! What the bootloader *is* stands in `boot-core` and `canopen`.
#![no_std]
#![no_main]

mod boot;
mod callgate;
mod flash;
mod ram_vectors;

use cortex_m::peripheral::SCB;
use panic_probe as _;
use rtic_monotonics::systick::prelude::*;
use shared_abi::warm_start::BootRequest;

systick_monotonic!(Mono, 1_000);

/// Version of the bootloader: major in the upper half, minor in the lower.
pub const VERSION: u32 = 0x0000_0001;

/// A fault or a panic (which ends in one) must not silence the device: start again, and stay reachable.
#[cortex_m_rt::exception]
unsafe fn HardFault(_frame: &cortex_m_rt::ExceptionFrame) -> ! {
    boot::warm_start_cell().put(BootRequest::Stay);
    SCB::sys_reset()
}

#[rtic::app(device = bsp::pac, peripherals = true, dispatchers = [SPI1, SPI2])]
mod app {
    use boot_core::bootloader::Bootloader;
    use boot_core::canopen::device::Device;
    use boot_core::canopen::nmt::NmtCommand;
    use boot_core::canopen::node::{Config, NmtPolicy, Node};
    use boot_core::canopen::program::BOOTLOADER_DEVICE_TYPE;
    use boot_core::canopen::{CobId, Frame, Instant, NodeId};
    use boot_core::download::Step;
    use bsp::can::{BitTiming, Transmitter};
    use bsp::{pac, CanController, BIT_RATE, IDENTITY, LAYOUT, NODE_ID};
    use bxcan::Rx0;
    use cortex_m::peripheral::SCB;
    use heapless::spsc::{Consumer, Producer, Queue};
    use shared_abi::block_file::MAX_BLOCK_SIZE;
    use shared_abi::warm_start::BootRequest;

    use super::{boot, Mono};
    use crate::flash::FlashController;
    use crate::ram_vectors;
    use rtic_monotonics::fugit::ExtU32;
    use rtic_monotonics::Monotonic;

    /// Frames that may wait for the protocol task. It has a higher priority than all that takes long, so few do.
    const RX_QUEUE: usize = 32;
    /// Period of the heartbeat in ms.
    const HEARTBEAT_MS: u16 = 1000;
    /// How often the protocol looks at its deadlines, in ms.
    const TICK_MS: u32 = 2;
    /// How often a sector being erased is looked at, in ms. It takes hundreds of them.
    const ERASE_POLL_MS: u32 = 1;
    /// How long the device stays after the answer to its leaving is on the bus, in ms: clients want to see the answer before
    /// anything else happens.
    const FAREWELL_MS: u32 = 20;

    const TIMING: BitTiming = match BitTiming::new(bsp::CAN_CLOCK, BIT_RATE) {
        Some(timing) => timing,
        None => panic!("board: the clock of the CAN controller cannot make the bit rate"),
    };
    const NODE: NodeId = match NodeId::new(NODE_ID) {
        Some(node) => node,
        None => panic!("board: the node-ID must be 1 to 127"),
    };

    #[shared]
    struct Shared {
        bootloader: Bootloader<'static, FlashController>,
    }

    #[local]
    struct Local {
        receiver: Rx0<CanController>,
        received: Producer<'static, Frame>,
        to_handle: Consumer<'static, Frame>,
        transmitter: Transmitter<CanController>,
        node: Node,
        leaving: Option<Leaving>,
        led: bsp::Led,
    }

    /// The device is about to reset.
    pub struct Leaving {
        request: Option<BootRequest>,
        /// When; set once the answer is on the bus.
        at: Option<Instant>,
    }

    #[init(local = [queue: Queue<Frame, RX_QUEUE> = Queue::new(), block: [u8; MAX_BLOCK_SIZE] = [0; MAX_BLOCK_SIZE]])]
    fn init(mut cx: init::Context) -> (Shared, Local) {
        ram_vectors::relocate(&mut cx.core.SCB);
        let board = bsp::init(cx.device.RCC, cx.device.CAN1, cx.device.GPIOD);
        Mono::start(cx.core.SYST, bsp::SYSCLK);

        let identifiers = [CobId::NMT, CobId::sdo_request(NODE)].map(|id| bsp::can::standard_id(id.get()));
        let can = bsp::can::start(board.can, TIMING, &identifiers);
        let (transmitter, receiver, _) = can.split();

        let flash = FlashController::new(cx.device.FLASH, LAYOUT.chip.flash);
        let device = Device {
            device_type: BOOTLOADER_DEVICE_TYPE,
            name: IDENTITY.device_name,
            hardware_version: IDENTITY.hardware_version,
            software_version: concat!("coboot ", env!("CARGO_PKG_VERSION")),
            heartbeat_ms: HEARTBEAT_MS,
            vendor_id: IDENTITY.vendor_id,
            product_code: IDENTITY.product_code,
            revision: IDENTITY.revision,
            serial_number: bsp::serial_number(),
        };
        let config =
            Config { heartbeat_ms: HEARTBEAT_MS, nmt: NmtPolicy::StayPreOperational, ..Config::default() };
        let (received, to_handle) = cx.local.queue.split();
        tick::spawn().ok();
        (
            Shared { bootloader: Bootloader::new(device, LAYOUT, flash, cx.local.block) },
            Local {
                receiver,
                received,
                to_handle,
                transmitter: Transmitter::new(transmitter),
                node: Node::new(NODE, config),
                leaving: None,
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

    /// Empties the controller's FIFO: three frames deep, so nothing may hold this task up.
    #[task(binds = CAN1_RX0, local = [receiver, received], priority = 3)]
    fn can_rx(cx: can_rx::Context) {
        while let Some(frame) = bsp::can::receive(cx.local.receiver) {
            // A full queue drops the frame; the client's time-out repeats it.
            cx.local.received.enqueue(frame).ok();
        }
        rtic::pend(pac::Interrupt::CAN1_TX);
    }

    /// Speaks CANopen: whenever a frame came in, a mailbox became free or time has passed.
    #[task(binds = CAN1_TX, shared = [bootloader], local = [to_handle, transmitter, node, leaving], priority = 2)]
    fn protocol(mut cx: protocol::Context) {
        let now = Instant::from_millis(Mono::now().ticks());
        let (node, transmitter, leaving) = (cx.local.node, cx.local.transmitter, cx.local.leaving);
        cx.shared.bootloader.lock(|bootloader| {
            while let Some(frame) = cx.local.to_handle.dequeue() {
                match node.handle(&frame, now, bootloader) {
                    Some(NmtCommand::ResetNode) => *leaving = Some(Leaving { request: None, at: None }),
                    Some(NmtCommand::ResetCommunication) => node.restart(NODE, bootloader),
                    _ => {}
                }
                transmitter.pump(|| node.poll(now, bootloader));
            }
            transmitter.pump(|| node.poll(now, bootloader));
            if let Some(request) = bootloader.take_leave() {
                *leaving = Some(Leaving { request: Some(request), at: None });
            }
            if bootloader.busy() {
                flash_work::spawn().ok();
            }
        });
        if let Some(leaving) = leaving {
            match leaving.at {
                None if node.is_sdo_idle() && transmitter.is_idle() => leaving.at = Some(now + FAREWELL_MS),
                Some(at) if now.has_reached(at) => leave(leaving.request),
                _ => {}
            }
        }
    }

    /// Works on the flash for as long as there is work; every other task comes first.
    #[task(shared = [bootloader], priority = 1)]
    async fn flash_work(mut cx: flash_work::Context) {
        loop {
            match cx.shared.bootloader.lock(|bootloader| bootloader.step()) {
                Step::Idle => break,
                Step::Again | Step::Programming => {}
                Step::Erasing => Mono::delay(ERASE_POLL_MS.millis()).await,
            }
        }
    }

    /// Lets time pass for the protocol, and shows life.
    #[task(local = [led], priority = 2)]
    async fn tick(cx: tick::Context) {
        let mut ticks = 0_u32;
        loop {
            rtic::pend(pac::Interrupt::CAN1_TX);
            if ticks.is_multiple_of(100 / TICK_MS) {
                cx.local.led.toggle();
            }
            ticks = ticks.wrapping_add(1);
            Mono::delay(TICK_MS.millis()).await;
        }
    }

    /// Out of the bootloader: the boot stage decides anew, on a clean chip.
    fn leave(request: Option<BootRequest>) -> ! {
        if let Some(request) = request {
            boot::warm_start_cell().put(request);
        }
        SCB::sys_reset()
    }
}
