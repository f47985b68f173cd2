//! A program on Embassy that its bootloader can always get back: one task serves the bus with the
//! responder of `coboot-app`, another one is the application's.
#![no_std]
#![no_main]

use core::panic::PanicInfo;

use coboot_app::bxcan::data_length;
use coboot_app::layout::Layout;
use coboot_app::responder::{self, Device, Responder};
use coboot_app::warm_start::BootRequest;
use coboot_app::{label, Bootloader, Defaults, Next, ProgramControl, ReentryPath, Start};
use cortex_m::peripheral::SCB;
use cortex_m_rt::{exception, ExceptionFrame};
use embassy_executor::Spawner;
use embassy_stm32::can::filter::{BankConfig, ListEntry16};
use embassy_stm32::can::util::calc_can_timings;
use embassy_stm32::can::{
    Can, Fifo, Frame, Id, Rx0InterruptHandler, Rx1InterruptHandler, SceInterruptHandler, StandardId,
    TxInterruptHandler,
};
use embassy_stm32::gpio::{Level, Output, Speed};
use embassy_stm32::peripherals::CAN1;
use embassy_stm32::time::Hertz;
use embassy_stm32::{bind_interrupts, rcc, Config};
use embassy_time::{with_timeout, Duration, Instant, Timer};

/// 1008h, and 1018h/1 to 3: those of the bootloader.
const NAME: &str = "coboot STM32F407G-DISC1";
const VENDOR_ID: u32 = 0;
const PRODUCT_CODE: u32 = 0x4007_D151;
const REVISION: u32 = 0x0001_0000;
const VERSION: u32 = if cfg!(feature = "version-2") { 2 } else { 1 };
/// The longest that the way back and the heartbeat wait for a look at the clock.
const TICK: Duration = Duration::from_millis(2);

/// Where everything is on this board: `build.rs` names it.
static LAYOUT: Layout = coboot_app::layout!();
coboot_app::label!(vendor_id: VENDOR_ID, product_code: PRODUCT_CODE, version: VERSION);

/// Whether the device may leave now, for its bootloader or for a reset: asked once, before a
/// command is answered. A machine that moves says no, and the command is refused (08000022h). After
/// a yes no task may start what stands (`Responder::leaving`); app-template shows how they exclude
/// each other.
fn may_leave() -> bool {
    true
}

bind_interrupts!(struct Interrupts {
    CAN1_TX => TxInterruptHandler<CAN1>;
    CAN1_RX0 => Rx0InterruptHandler<CAN1>;
    CAN1_RX1 => Rx1InterruptHandler<CAN1>;
    CAN1_SCE => SceInterruptHandler<CAN1>;
});

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let chip = embassy_stm32::init(clocks());

    // The bootloader gives node-ID and bit rate, so that whoever talked to it goes on talking to
    // this program. The defaults hold where a debugger has started the program.
    let defaults = Defaults { node_id: Some(32), bit_rate: 125_000, serial_number: 0 };
    let start = Start::read(&LAYOUT, defaults);
    let bootloader = Bootloader::new(&LAYOUT);
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
    let timing = calc_can_timings(rcc::frequency::<CAN1>(), start.bit_rate);
    let (Some(responder), Ok(timing)) = (responder, timing) else {
        // A node-ID or a bit rate that has to be found out first: the bootloader can.
        bootloader.leave(ReentryPath::SystemReset, BootRequest::Stay);
    };

    let mut can = Can::new(chip.CAN1, chip.PD0, chip.PD1, Interrupts);
    let [nmt, sdo] = responder.identifiers().map(data_frames);
    can.modify_filters().enable_bank(0, Fifo::Fifo0, BankConfig::List16([nmt, sdo, nmt, sdo]));
    can.modify_config().set_bit_timing(timing);

    // Your own work, in tasks of its own.
    if let Ok(task) = blink(Output::new(chip.PD12, Level::Low, Speed::Low)) {
        spawner.spawn(task);
    }
    serve(can, responder, bootloader).await
}

/// Serves the bus until the bootloader is asked for.
async fn serve(mut can: Can<'static>, mut responder: Responder, mut bootloader: Bootloader) {
    can.enable().await;
    loop {
        match with_timeout(TICK, can.read()).await {
            Ok(Ok(received)) => {
                let answer = read(&received.frame)
                    .and_then(|request| responder.handle(&request, now(), &mut bootloader));
                if let Some(answer) = answer {
                    send(&mut can, &answer);
                }
                // It may have asked for the bootloader: nothing is sent then but the answer.
                responder.proceed(can.is_transmitter_idle(), now());
            }
            // An error on the bus is reported repeatedly while it lasts; others are to run too.
            Ok(Err(_)) => Timer::after(TICK).await,
            Err(_) => {}
        }
        while let Some(frame) = responder.poll(now()) {
            send(&mut can, &frame);
        }
        if let Next::Leave(request) = responder.proceed(can.is_transmitter_idle(), now()) {
            bootloader.leave(ReentryPath::SystemReset, request);
        }
    }
}

/// Shows life.
#[embassy_executor::task]
async fn blink(mut led: Output<'static>) {
    loop {
        led.toggle();
        Timer::after_millis(500).await;
    }
}

/// 168 MHz out of the board's crystal of 8 MHz, 42 MHz for CAN.
fn clocks() -> Config {
    use embassy_stm32::rcc::{
        AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPDiv, PllPreDiv, PllQDiv, PllSource, Sysclk,
    };

    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Oscillator });
    config.rcc.pll_src = PllSource::HSE;
    config.rcc.pll = Some(Pll {
        prediv: PllPreDiv::DIV4,
        mul: PllMul::MUL168,
        divp: Some(PllPDiv::DIV2),
        divq: Some(PllQDiv::DIV7),
        divr: None,
    });
    config.rcc.ahb_pre = AHBPrescaler::DIV1;
    config.rcc.apb1_pre = APBPrescaler::DIV4;
    config.rcc.apb2_pre = APBPrescaler::DIV2;
    config.rcc.sys = Sysclk::PLL1_P;
    config
}

/// Time since the start in ms, of a counter that wraps.
fn now() -> u32 {
    Instant::now().as_millis() as u32
}

/// A filter for data frames with this identifier of 11 bits.
fn data_frames(id: u16) -> ListEntry16 {
    ListEntry16::data_frames_with_id(StandardId::new(id).unwrap_or(StandardId::ZERO))
}

/// The frame as the responder takes it; `None` for one that is none of CANopen's. The filter lets
/// data frames through, and no remote frames. (`data` of a frame panics at a data length code of 9 to 15, which
/// any node may send.)
fn read(frame: &Frame) -> Option<responder::Frame> {
    let Id::Standard(id) = frame.id() else { return None };
    let data = frame.raw_data().get(..data_length(frame.header().len()))?;
    responder::Frame::new(id.as_raw(), data)
}

fn send(can: &mut Can<'static>, frame: &responder::Frame) {
    let Ok(frame) = Frame::new_standard(frame.id(), frame.data()) else { return };
    // Where nobody acknowledges, heartbeats make room for an answer, which comes first by its
    // identifier.
    let _ = can.try_write(&frame);
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
