//! The CANopen bootloader for STM32F4.
//!
//! | file | what it does | unsafe |
//! |---|---|---|
//! | `main.rs` | tasks: wiring only | no |
//! | `product.rs` | the choices of a product | no |
//! | `resident/` | what runs from flash: boot stage and callgate | jump, ABI |
//! | `start.rs` | from the reset to the boot stage, and to `init` below | start-up |
//! | `flash.rs` | the flash controller and the CRC unit | registers |
//! | `watchdog.rs` | feeds the watchdog when all tasks are alive | no |
//! | `log.rs`, `log/` | a few words for whoever ports it (features `log-…`) | interrupts |
//! | `debugger.rs` | the debugger interface (feature `debugger`) | no |
//! | `memory.rs` | `memcpy` and its kin, small | assembly |
//!
//! What the bootloader *is* stands in `boot-core` and `canopen`.
#![no_std]
#![no_main]

mod debugger;
mod flash;
mod log;
mod memory;
mod product;
mod start;
mod watchdog;

use cortex_m::peripheral::SCB;
use panic_probe as _;
use rtic_monotonics::systick::prelude::*;
use shared_abi::warm_start::BootRequest;

systick_monotonic!(Mono, 1_000);

/// A fault or a panic (which ends in one) must not silence the device: start again, and stay
/// reachable.
#[cortex_m_rt::exception]
unsafe fn HardFault(_frame: &cortex_m_rt::ExceptionFrame) -> ! {
    product::warm_start_cell().put(BootRequest::Fault);
    SCB::sys_reset()
}

#[rtic::app(device = bsp::pac, peripherals = true, dispatchers = [SPI1])]
mod app {
    use boot_core::bootloader::{self, entries_with, entry_count_with, Bootloader};
    use boot_core::canopen::bit_rate::Heard;
    use boot_core::canopen::device::Device;
    use boot_core::canopen::line::{Confinement, Status, CONTROLLER_OVERRUN, QUEUE_OVERRUN};
    use boot_core::canopen::lss;
    use boot_core::canopen::node::{self, NmtPolicy};
    use boot_core::canopen::od::{concat, Entry};
    use boot_core::canopen::program::ProgramControl;
    use boot_core::canopen::sdo::server::Config as SdoConfig;
    use boot_core::canopen::slave::{self, Output, Slave, SlaveDevice};
    use boot_core::canopen::{BitRate, CobId, Frame, Instant};
    use boot_core::download::{Policy, Step};
    use bsp::can::{Errors, Mode};
    use bsp::clock::Source;
    use bsp::hal::rcc::RccExt;
    use bsp::{pac, CanPort, CLOCK_TREE, IDENTITY, LAYOUT};
    use cortex_m::peripheral::SCB;
    use heapless::spsc::{Consumer, Producer, Queue};
    use rtic::Mutex;
    use shared_abi::warm_start::{BootRequest, WarmStart};

    use super::{product, start, Mono};
    use crate::debugger::{self, Debugger};
    use crate::flash::FlashController;
    use crate::log::{self, log};
    use crate::product::{PROFILE, RESCUE_WINDOW_MS};
    use crate::watchdog::{self, Task, Watchdog};
    use rtic_monotonics::fugit::ExtU32;
    use rtic_monotonics::Monotonic;

    /// Frames that may wait for the protocol task. It has a higher priority than all that takes
    /// long, so few do.
    const RX_QUEUE: usize = 32;
    /// Bytes of blocks that may wait for the flash: what RAM is free. While a sector of 128 KiB is
    /// erased, a bus at 1 Mbit/s brings some 55 KiB.
    const BLOCK_QUEUE: usize = 80 * 1024;
    /// Period of the heartbeat in ms.
    const HEARTBEAT_MS: u16 = 1000;
    /// How often the protocol looks at its deadlines, in ms.
    const TICK_MS: u32 = 2;
    /// How long the device stays after the answer to its leaving is on the bus, in ms: clients want
    /// to see the answer before anything else happens.
    const ANSWER_TO_RESET_MS: u32 = 20;

    /// Whether an emergency follows each boot-up, so that a master knows the bootloader from the
    /// application.
    const BOOT_UP_EMERGENCY: bool = true;

    /// Programs of the layout, each a sub-index of 1F50h, 1F51h, 1F56h and 1F57h.
    const PROGRAMS: usize = LAYOUT.programs.len();
    const ENTRY_COUNT: usize = entry_count_with(PROGRAMS as u8, PROFILE.extras);
    const OWN_ENTRIES: [Entry; ENTRY_COUNT] = entries_with(PROGRAMS as u8, PROFILE.extras);
    static ENTRIES: [Entry; ENTRY_COUNT + debugger::ENTRIES.len()] = concat(OWN_ENTRIES, debugger::ENTRIES);

    static CONFIG: bootloader::Config = bootloader::Config {
        entries: &ENTRIES,
        device: Device {
            device_type: PROFILE.device_type,
            name: IDENTITY.device_name,
            hardware_version: IDENTITY.hardware_version,
            software_version: concat!("coboot ", env!("CARGO_PKG_VERSION")),
            heartbeat_ms: HEARTBEAT_MS,
            vendor_id: IDENTITY.vendor_id,
            product_code: IDENTITY.product_code,
            revision: IDENTITY.revision,
            serial_number: 0,
        },
        node_id: PROFILE.node_id,
        layout: LAYOUT,
        supports: product::supports,
        boot_up_emergency: BOOT_UP_EMERGENCY,
        download: Policy { identity: Some((IDENTITY.vendor_id, IDENTITY.product_code)), ..PROFILE.download },
        password: PROFILE.password,
    };

    #[shared]
    struct Shared {
        can: CanPort,
        bootloader: Bootloader<'static, FlashController, product::Parameters, PROGRAMS>,
    }

    #[local]
    struct Local {
        received: Producer<'static, Frame>,
        to_handle: Consumer<'static, Frame>,
        slave: Slave,
        debugger: Debugger,
        leaving: PendingReset,
        /// The program that starts at the end of the rescue window.
        waiting: Option<u8>,
        watchdog: Watchdog,
        led: bsp::Led,
    }

    /// The device is about to reset.
    pub struct PendingReset {
        wanted: bool,
        request: BootRequest,
        /// When; set once the answer is on the bus.
        at: Option<Instant>,
    }

    #[init(local = [queue: Queue<Frame, RX_QUEUE> = Queue::new(), blocks: [u8; BLOCK_QUEUE] = [0; BLOCK_QUEUE]])]
    fn init(cx: init::Context) -> (Shared, Local) {
        CLOCK_TREE.speed_up(&cx.device.RCC, Source::Crystal);
        // SAFETY: the device's own are not used beside it.
        let flash = unsafe { FlashController::steal(Some(&cx.device.RCC)) };
        let board = bsp::init(&mut cx.device.RCC.constrain(), cx.device.CAN1);
        #[cfg(feature = "log-uart")]
        log::uart::open(board.uart);
        Mono::start(cx.core.SYST, bsp::SYSCLK);

        let parameters = product::parameters(&flash);
        let node = product::node_parameters(&parameters, &flash);
        let slave_config = slave::Config {
            node: node::Config {
                heartbeat_ms: HEARTBEAT_MS,
                nmt: NmtPolicy::StayPreOperational,
                sdo: SdoConfig {
                    block_upload: cfg!(feature = "block-upload"),
                    unknown_request: PROFILE.unknown_request,
                    ..SdoConfig::DEFAULT
                },
            },
            lss: if cfg!(feature = "lss") { Some(lss::Config::default()) } else { None },
        };
        let mut bootloader = Bootloader::new(
            &CONFIG,
            bsp::serial_number(),
            node,
            start::stay_reason(),
            parameters,
            flash,
            cx.local.blocks,
        );
        if let Some(program) = start::program_to_clear() {
            // Acknowledged by the application; what becomes of it is in 1F57h.
            let _ = bootloader.command(program, ProgramControl::Clear);
        }
        let slave = Slave::new(bootloader.lss_address(), bootloader.node_id(), node.bit_rate, slave_config);
        let (received, to_handle) = cx.local.queue.split();
        tick::spawn().ok();
        log!("stayed in the bootloader; why", start::stay_reason().into());
        #[cfg(not(feature = "virtual-can"))]
        let can = CanPort::new(board.can);
        #[cfg(feature = "virtual-can")]
        let can = CanPort::new(board.uart);
        (
            Shared { can, bootloader },
            Local {
                received,
                to_handle,
                slave,
                debugger: Debugger::new(),
                waiting: start::program_in_waiting(),
                leaving: PendingReset { wanted: false, request: BootRequest::PowerOn, at: None },
                watchdog: Watchdog::new(cx.device.IWDG),
                led: board.led,
            },
        )
    }

    /// Works on the flash for as long as there is work, and sleeps otherwise; every task comes
    /// first.
    #[idle(shared = [bootloader])]
    fn idle(mut cx: idle::Context) -> ! {
        loop {
            watchdog::check_in(Task::Flash);
            let step = cx.shared.bootloader.lock(|bootloader| {
                let step = bootloader.step();
                log::status(bootloader, PROGRAMS as u8);
                step
            });
            match step {
                Step::Programming | Step::Again => {}
                // The monotonic wakes it every millisecond; a sector takes hundreds of them.
                Step::Idle | Step::Erasing => cortex_m::asm::wfi(),
            }
        }
    }

    /// Empties the controller's FIFO: three frames deep, so nothing may hold this task up.
    #[task(binds = CAN1_RX0, shared = [can], local = [received], priority = 3)]
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
        shared = [can, bootloader],
        local = [to_handle, slave, debugger, leaving, waiting],
        priority = 2
    )]
    fn protocol(cx: protocol::Context) {
        watchdog::check_in(Task::Protocol);
        let now = Instant::from_millis(Mono::now().ticks());
        let protocol::SharedResources { mut can, mut bootloader, .. } = cx.shared;
        let protocol::LocalResources { to_handle, slave, debugger, leaving, waiting, .. } = cx.local;
        if let Some(at) = leaving.at {
            // A frame that began now would be cut off by the reset.
            if now.has_reached(at) {
                leave(leaving.request);
            }
            return;
        }
        let status = can.lock(status);
        bootloader.lock(|bootloader| {
            #[cfg(feature = "password")]
            bootloader.set_time(now);
            let device = debugger.attach(bootloader);
            #[cfg(feature = "debugger")]
            let device = &mut { device };
            slave.observe(status, now, device);
            // A frame that finds no room (a heartbeat on a busy bus) must not keep the requests
            // waiting behind it.
            carry_out(slave, &mut can, now, device);
            while let Some(frame) = to_handle.dequeue() {
                log::received(&frame);
                // The filters let nothing in but network management and what is for this device, or
                // for layer setting services.
                if RESCUE_WINDOW_MS.is_some() && frame.cob_id() != Some(CobId::NMT) {
                    *waiting = None;
                }
                if slave.handle(&frame, now, device) {
                    *leaving = PendingReset { wanted: true, request: BootRequest::PowerOn, at: None };
                }
                carry_out(slave, &mut can, now, device);
            }
            if let Some(request) = bootloader.take_boot_request() {
                *leaving = PendingReset { wanted: true, request, at: None };
            }
        });
        if let (Some(program), Some(ms)) = (*waiting, RESCUE_WINDOW_MS) {
            if now.has_reached(Instant::from_millis(ms.into())) {
                // Whether or not anybody is there to hear the boot-up.
                *leaving =
                    PendingReset { wanted: true, request: BootRequest::Resume(program), at: Some(now) };
                return;
            }
        }
        // What a host was told is done is not lost by a reset that comes too early.
        let finishing = bootloader.lock(|bootloader| bootloader.is_finishing());
        if leaving.wanted && !finishing && slave.is_idle() && can.lock(|can| can.is_idle()) {
            leaving.at = Some(now + ANSWER_TO_RESET_MS);
            log!("leaving; request", WarmStart::new(leaving.request).request);
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
                Output::Send(frame) => {
                    log::sent(&frame);
                    can.lock(|can| can.send(&frame));
                }
                Output::Join(rate) => configure(can, rate, Mode::Normal),
                Output::Listen(rate) => configure(can, rate, Mode::Silent),
                Output::RecoverFromBusOff => can.lock(|can| can.recover_from_bus_off()),
                Output::Accept(ids) => can.lock(|can| can.accept(ids.into_iter().map(CobId::get))),
            }
        }
    }

    fn configure(can: &mut impl Mutex<T = CanPort>, rate: BitRate, mode: Mode) {
        // Another rate is asked for by nobody: `product::supports` says so.
        if let Some(Some(timing)) = product::TIMINGS.get(rate as usize) {
            can.lock(|can| can.configure(*timing, mode));
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
    #[task(local = [led, watchdog], priority = 2)]
    async fn tick(cx: tick::Context) {
        let mut ticks = 0_u32;
        loop {
            rtic::pend(pac::Interrupt::CAN1_TX);
            cx.local.watchdog.feed();
            if ticks.is_multiple_of(100 / TICK_MS) {
                cx.local.led.toggle();
            }
            ticks = ticks.wrapping_add(1);
            Mono::delay(TICK_MS.millis()).await;
        }
    }

    /// Out of the bootloader: the boot stage decides anew, on a clean chip.
    fn leave(request: BootRequest) -> ! {
        product::warm_start_cell().put(request);
        SCB::sys_reset()
    }
}
