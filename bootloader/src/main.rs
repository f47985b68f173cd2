//! The CANopen bootloader for STM32F4.
//!
//! | file | what it does | unsafe |
//! |---|---|---|
//! | `main.rs` | the tasks: it only connects the other parts | no |
//! | `product.rs` | the choices that a product has; it makes them in `products/`. A library of its own, which the resident part and the tests have, too | no |
//! | `resident/` | the part that runs from flash: boot stage and callgate | jump, ABI |
//! | `start.rs` | the resident part's bytes, the header of the RAM image, the boot report | handoff |
//! | `flash_controller.rs` | starts flash operations and polls them | registers |
//! | `storage.rs` | flash and stored values, by the services of the resident part | its ABI |
//! | `watchdog.rs` | feeds the watchdog when all tasks are alive | no |
//! | `log.rs`, `log/` | log lines for a port to a new board (features `log-…`) | interrupts |
//! | `memory.rs` | small versions of `memcpy` and similar functions | assembly |
//!
//! The behaviour of the bootloader is in `boot-core` and `canopen`.
#![no_std]
#![no_main]

mod flash_controller;
mod log;
mod memory;
mod start;
mod storage;
mod watchdog;

use cortex_m::peripheral::SCB;
use panic_probe as _;
use rtic_monotonics::systick::prelude::*;
use shared_abi::warm_start::BootRequest;

systick_monotonic!(Mono, 1_000);

/// A fault must not leave the device silent; a panic ends in a fault, too. The chip resets, and the
/// bootloader stays reachable.
#[cortex_m_rt::exception(trampoline = false)]
unsafe fn HardFault() -> ! {
    restart()
}

/// The crystal has failed (RM0090 section 7.2.7). After the reset the bootloader finds whether it starts again.
#[cortex_m_rt::exception]
unsafe fn NonMaskableInt() -> ! {
    restart()
}

fn restart() -> ! {
    product::warm_start_cell().put(BootRequest::Fault);
    SCB::sys_reset()
}

#[rtic::app(device = bsp::pac, peripherals = true, dispatchers = [SPI1])]
mod app {
    use boot_core::bootloader::{self, entries, entry_count, Bootloader, Choices, Extras};
    use boot_core::canopen::device::Device;
    use boot_core::canopen::lss;
    use boot_core::canopen::node::{self, NmtPolicy};
    use boot_core::canopen::od::Entry;
    use boot_core::canopen::program::{ClockSource, ProgramStart};
    use boot_core::canopen::sdo::server::Config as SdoConfig;
    use boot_core::canopen::slave::{self, Output, Slave, SlaveDevice};
    use boot_core::canopen::{BitRate, CobId, Frame, Instant, NodeId};
    use boot_core::control::{Renewal, Sealed, SealedMemory, Step};
    use boot_core::decision;
    use boot_core::store::NodeParameters;
    use bsp::clock::Source;
    use bsp::debugger::{self, Debugger};
    use bsp::hal::rcc::RccExt;
    use bsp::{line, pac, CanPort, IDENTITY, LAYOUT};
    use core::mem::MaybeUninit;
    use cortex_m::peripheral::SCB;
    use heapless::spsc::{Consumer, Producer, Queue};
    use product::{CrystalFailure, PRODUCT};
    use rtic::Mutex;
    use shared_abi::boot_report::BootReport;
    use shared_abi::nameplate::Nameplate;
    use shared_abi::services::{StoreState, STORE_STATE_WORDS};
    use shared_abi::warm_start::{BootRequest, Owed, TrialStep, WarmStart};

    use super::{start, Mono};
    use crate::log::{self, log};
    use crate::storage::{BootFlash, Store};
    use crate::watchdog::{self, Task, Watchdog};
    use rtic_monotonics::fugit::ExtU32;
    use rtic_monotonics::Monotonic;

    /// Frames that can wait for the protocol task. The task has a higher priority than all work
    /// that takes long, so only few frames wait.
    const RX_QUEUE: usize = PRODUCT.sdo.receive_queue as usize;
    /// Period in which the protocol checks its deadlines, in ms.
    const TICK_MS: u32 = 2;
    /// Programs of the layout; each is a sub-index of 1F50h, 1F51h, 1F56h and 1F57h.
    const PROGRAMS: usize = LAYOUT.programs.len();
    /// The same with the bootloader itself, if it can be renewed.
    const IMAGES: usize = PROGRAMS + product::RENEWS as usize;
    const EXTRAS: Extras = PRODUCT.extras();
    const LSS: product::Lss = PRODUCT.lss_or_default();
    const BLOCK_DOWNLOAD: product::BlockDownload = PRODUCT.block_download_or_default();
    const ENTRY_COUNT: usize = entry_count(PROGRAMS as u8, EXTRAS) + debugger::ENTRIES.len();
    static ENTRIES: [Entry; ENTRY_COUNT] = entries(PROGRAMS as u8, EXTRAS).with(&debugger::ENTRIES).entries();

    const RENEWAL: Renewal = product::renewal(&product::BOARD);

    static CONFIG: bootloader::Config = bootloader::Config {
        entries: &ENTRIES,
        device: Device {
            device_type: PRODUCT.profile.device_type,
            name: IDENTITY.device_name,
            hardware_version: IDENTITY.hardware_version,
            // The version, and the product if it is not the default one (build.rs).
            software_version: env!("COBOOT_VERSION"),
            heartbeat_ms: PRODUCT.nmt.heartbeat_ms,
            vendor_id: IDENTITY.vendor_id,
            product_code: IDENTITY.product_code,
            revision: IDENTITY.revision,
            serial_number: 0,
        },
        node_id: PRODUCT.profile.node_id,
        layout: LAYOUT,
        supports: product::supports,
        boot_up_emergency: PRODUCT.nmt.boot_up_emergency,
        download: PRODUCT.download_policy(&product::BOARD, &RENEWAL),
        password: PRODUCT.profile.password,
    };

    // The record has no types of CANopen.
    const _: () = {
        assert!(BootReport::NONE.node_id == product::NO_NODE_ID);
        assert!(BootReport::NONE.bit_rate == BitRate::Auto as u8);
    };

    /// What the product has.
    pub struct Chosen;

    impl Choices for Chosen {
        const EXTRAS: Extras = EXTRAS;
        const INTEL_HEX: bool = PRODUCT.download.intel_hex;
        const BLOCK_DOWNLOAD: bool = PRODUCT.block_download.is_some();
        const BLOCK_UPLOAD: bool = PRODUCT.sdo.block_upload;
        const LSS: bool = PRODUCT.lss.is_some();
        const LSS_IDENTIFY: bool = LSS.identify;
        const LSS_STORE: bool = LSS.store;
        const DETECTS_BIT_RATE: bool = PRODUCT.node.auto_bit_rate;
        const DECISION: &'static decision::Policy = &PRODUCT.decision();
        const PROGRAM_START: ProgramStart = product::PROGRAM_START;

        fn entry_strap(_: bool) -> bool {
            bsp::entry_strap(bsp::SYSCLK)
        }
    }

    #[shared]
    struct Shared {
        can: CanPort,
        bootloader: Bootloader<'static, BootFlash, Store, IMAGES, Chosen>,
    }

    #[local]
    struct Local {
        received: Producer<'static, Frame>,
        to_handle: Consumer<'static, Frame>,
        slave: Slave,
        debugger: Debugger,
        pending_reset: PendingReset,
        /// The write of 1F51h that the application received and the bootloader answers.
        owed: Owed,
        /// The program that starts at the end of the rescue window, and the window's length in ms.
        held: Option<(u8, u16)>,
        watchdog: Watchdog,
        led: bsp::Led,
    }

    /// The reset that the device is about to make.
    pub struct PendingReset {
        wanted: bool,
        request: BootRequest,
        /// The time of the reset; it is set when the answer is on the bus.
        at: Option<Instant>,
    }

    /// The configuration of a device whose identity is not the board's.
    struct Own {
        config: MaybeUninit<bootloader::Config>,
        renewal: MaybeUninit<Renewal>,
    }

    impl Own {
        const NONE: Self = Self { config: MaybeUninit::uninit(), renewal: MaybeUninit::uninit() };

        fn of(&'static mut self, device: &Nameplate) -> &'static bootloader::Config {
            let renewal = self.renewal.write(product::renewal(device));
            let Nameplate { vendor_id, product_code, revision, .. } = *device;
            self.config.write(bootloader::Config {
                device: Device { vendor_id, product_code, revision, ..CONFIG.device },
                download: PRODUCT.download_policy(device, renewal),
                ..CONFIG
            })
        }
    }

    #[init(local = [queue: Queue<Frame, RX_QUEUE> = Queue::new(), blocks: [u8; PRODUCT.download.block_buffer] = [0; PRODUCT.download.block_buffer], room: [SealedMemory; product::SEALED as usize] = [const { SealedMemory::new() }; product::SEALED as usize], store: StoreState = StoreState([0; STORE_STATE_WORDS]), own: [Own; product::HAS_NAMEPLATE as usize] = [const { Own::NONE }; product::HAS_NAMEPLATE as usize]])]
    fn init(mut cx: init::Context) -> (Shared, Local) {
        // First: with a watchdog, whatever the chip does not do from here on ends in a reset.
        let watchdog = Watchdog::new(cx.device.IWDG);
        let clock =
            log::feeds::during_clock_start(&mut cx.core.SYST, || Source::Crystal.speed_up(&cx.device.RCC));
        // SAFETY: the flash controller and the CRC unit of `cx.device` are not used.
        let flash = unsafe { BootFlash::steal() };
        let board = bsp::init(&mut cx.device.RCC.constrain(), cx.device.CAN1);
        #[cfg(feature = "log-uart")]
        log::uart::open(board.uart);
        Mono::start(bsp::cleared_systick(cx.core.SYST), clock.tree().sysclk());

        let parameters = Store::open(cx.local.store);
        let report = start::boot_report().unwrap_or(BootReport::NONE);
        let node = NodeParameters {
            id: NodeId::new(report.node_id),
            // The boot stage reports only bit rates that the product supports.
            bit_rate: BitRate::from_index(report.bit_rate)
                .filter(|rate| product::supports(*rate))
                .unwrap_or(product::BOARD_NODE.bit_rate),
        };
        let slave_config = slave::Config {
            node: node::Config {
                boot_up: PRODUCT.nmt.boot_up_message,
                heartbeat_ms: PRODUCT.nmt.heartbeat_ms,
                nmt: NmtPolicy::StayPreOperational,
                sdo: SdoConfig {
                    unknown_request: PRODUCT.profile.unknown_request,
                    request_base: PRODUCT.sdo.request_base,
                    response_base: PRODUCT.sdo.response_base,
                    blksize: BLOCK_DOWNLOAD.segments_per_sub_block,
                    ..SdoConfig::DEFAULT
                },
            },
            lss: lss::Config { start_in_configuration: LSS.start_in_configuration, announce: LSS.announce },
            is_silent: clock == Source::Internal && LSS.crystal_failure == CrystalFailure::Silent,
        };
        let nameplate = product::nameplate();
        let config = match (cx.local.own.first_mut(), &nameplate) {
            (Some(own), Some(device)) => own.of(device),
            _ => &CONFIG,
        };
        let mut bootloader = Bootloader::new(
            config,
            product::serial_number(nameplate.as_ref()),
            node,
            &report,
            parameters,
            flash,
            cx.local.blocks,
            cx.local.room.first_mut().map_or(Sealed::NONE, SealedMemory::sealed),
        );
        bootloader.confirm(report.returned);
        bootloader.set_clock_source(match clock {
            Source::Crystal => ClockSource::Crystal,
            Source::Internal => ClockSource::Internal,
        });
        let slave = Slave::new(bootloader.lss_address(), bootloader.node_id(), node.bit_rate, slave_config);
        let (received, to_handle) = cx.local.queue.split();
        tick::spawn().ok();
        log!("stayed in the bootloader; why", report.reason.into());
        #[cfg(not(feature = "virtual-can"))]
        let can = CanPort::new(board.can, clock);
        #[cfg(feature = "virtual-can")]
        let can = CanPort::new(board.uart, clock);
        (
            Shared { can, bootloader },
            Local {
                received,
                to_handle,
                slave,
                debugger: Debugger::new(),
                owed: report.owed,
                held: (report.held_program > 0).then_some((report.held_program, report.window_ms)),
                pending_reset: PendingReset { wanted: false, request: BootRequest::PowerOn, at: None },
                watchdog,
                led: board.led,
            },
        )
    }

    /// Works on the flash while there is work, and sleeps otherwise. Every task interrupts it.
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
                // The monotonic wakes the core every millisecond; the erase of a sector takes
                // hundreds of them.
                Step::Idle | Step::Erasing => cortex_m::asm::wfi(),
            }
        }
    }

    /// Empties the controller's FIFO. The FIFO holds three frames, so nothing may delay this task.
    #[task(binds = CAN1_RX0, shared = [can], local = [received], priority = 3)]
    fn can_rx(mut cx: can_rx::Context) {
        cx.shared.can.lock(|can| line::receive(can, |frame| cx.local.received.enqueue(frame).is_ok()));
        rtic::pend(pac::Interrupt::CAN1_TX);
    }

    /// Runs the CANopen slave: after each received frame, each sent frame and each tick.
    #[task(
        binds = CAN1_TX,
        shared = [can, bootloader],
        local = [to_handle, slave, debugger, pending_reset, owed, held],
        priority = 2
    )]
    fn protocol(cx: protocol::Context) {
        watchdog::check_in(Task::Protocol);
        let now = Instant::from_millis(Mono::now().ticks());
        let protocol::SharedResources { mut can, mut bootloader, .. } = cx.shared;
        let protocol::LocalResources { to_handle, slave, debugger, pending_reset, owed, held, .. } = cx.local;
        if let Some(at) = pending_reset.at {
            // The reset would cut off a frame that began now, so nothing is sent any more.
            if now.has_reached(at) {
                reset_with(pending_reset.request);
            }
            return;
        }
        let status = can.lock(line::status);
        let (finishing, compacting) = bootloader.lock(|bootloader| {
            bootloader.set_time(now);
            debugger.with(bootloader, |device| {
                slave.observe(status, now, device);
                // The slave sends what it has before it handles requests: a frame without room (a
                // heartbeat on a busy bus) must not delay the requests.
                carry_out(slave, &mut can, now, device);
                // The request that the application left comes first, now that the boot-up is on its
                // way.
                let Owed { program, value, node_id } = core::mem::replace(owed, Owed::NOTHING);
                let asked = NodeId::new(node_id).map(|node| {
                    Frame::full(CobId::sdo_request(node), [0x2F, 0x51, 0x1F, program, value, 0, 0, 0])
                });
                let mut next = asked.or_else(|| to_handle.dequeue());
                while let Some(frame) = next {
                    log::received(&frame);
                    // The filters pass only NMT and frames for this device or for layer setting
                    // services (LSS). All but NMT, and what is not answered, end the rescue window.
                    let is_window = held.is_some_and(|(_, ms)| ms > 0);
                    if is_window && frame.cob_id() != Some(CobId::NMT) && !slave.ignores(&frame) {
                        *held = None;
                    }
                    if slave.handle(&frame, now, device) {
                        *pending_reset =
                            PendingReset { wanted: true, request: BootRequest::PowerOn, at: None };
                    }
                    carry_out(slave, &mut can, now, device);
                    next = to_handle.dequeue();
                }
            });
            // A master that greets each device after its boot-up must not keep the program from starting
            // while the store is compacted. One that wants to download does.
            if bootloader.is_asked() {
                *held = None;
            }
            if let Some(request) = bootloader.take_boot_request() {
                // A trial ends also if nobody acknowledges a frame: the bit rate of the image may be wrong.
                let ends = product::RENEWS && request == BootRequest::Renewal(TrialStep::Late);
                *pending_reset = PendingReset { wanted: true, request, at: ends.then_some(now) };
            }
            (bootloader.is_finishing(), bootloader.is_compacting())
        });
        if let Some((program, window_ms)) = *held {
            // An installation that a cut has left is completed first, and the store gets room.
            let is_over = now.has_reached(Instant::from_millis(window_ms.into()));
            if is_over && !finishing && !compacting {
                // The program starts even if no other node acknowledges the boot-up.
                *pending_reset =
                    PendingReset { wanted: true, request: BootRequest::Resume(program), at: Some(now) };
                return;
            }
        }
        // The stored values that were reported to a host must not be lost by an early reset.
        if pending_reset.wanted && !finishing && slave.is_idle() && can.lock(CanPort::is_idle) {
            pending_reset.at = Some(now + PRODUCT.nmt.answer_to_reset_ms);
            log!("leaving; request", WarmStart::new(pending_reset.request).request);
            log!("longest between two feeds; us", log::feeds::longest());
            if bsp::functions::HAS_EACH_10_MS {
                log!("longest each_10_ms; us", log::feeds::slowest());
            }
        }
    }

    /// Carries out the slave's outputs until there are no more.
    fn carry_out(
        slave: &mut Slave,
        can: &mut impl Mutex<T = CanPort>,
        now: Instant,
        device: &mut impl SlaveDevice,
    ) {
        loop {
            let room = can.lock(CanPort::has_room);
            let Some(output) = slave.poll(now, room, device) else { return };
            if let Output::Send(frame) = &output {
                log::sent(frame);
            }
            can.lock(|can| line::carry_out(can, output));
        }
    }

    /// Drives the protocol, the watchdog and the LED.
    #[task(local = [led, watchdog], priority = 2)]
    async fn tick(cx: tick::Context) {
        let mut ticks = 0_u32;
        loop {
            rtic::pend(pac::Interrupt::CAN1_TX);
            cx.local.watchdog.feed(|| Mono::now().ticks());
            if ticks.is_multiple_of(100 / TICK_MS) {
                cx.local.led.toggle();
            }
            ticks = ticks.wrapping_add(1);
            Mono::delay(TICK_MS.millis()).await;
        }
    }

    /// Leaves the bootloader by a reset: the boot stage decides again, on a chip in its reset
    /// state.
    fn reset_with(request: BootRequest) -> ! {
        bsp::functions::before_leaving();
        product::warm_start_cell().put(request);
        SCB::sys_reset()
    }
}
