//! Board support: everything that differs between two boards of one firmware.
//!
//! One file per board, chosen by the cargo feature `board-…`, beside its memory map in
//! `shared-abi/src/layout/`. To port coboot, copy a board file and go through it from top to
//! bottom. The rest of the crate is what all boards share.
//!
//! On the host there are the values of a board, without the drivers.
#![no_std]

pub mod can;
#[cfg(target_arch = "arm")]
pub mod can_controllers;
pub mod clock;
#[cfg(all(target_arch = "arm", feature = "debugger"))]
pub mod debugger;
#[cfg(target_arch = "arm")]
mod drivers;
pub mod line;
#[cfg(all(target_arch = "arm", feature = "monitor"))]
pub mod monitor;
#[cfg(any(feature = "uart", not(target_arch = "arm")))]
pub mod ring;
#[cfg(any(feature = "virtual-can", not(target_arch = "arm")))]
pub mod slcan;
pub mod uart;
#[cfg(all(target_arch = "arm", feature = "virtual-can"))]
pub mod virtual_can;
#[cfg(target_arch = "arm")]
pub mod watchdog;

/// A GPIO port or a UART, for the `init` of a board. The board file alone knows which that is
/// about, so no caller hands them over; that it is asked for once is shown by the CAN controller,
/// which exists once.
#[cfg(target_arch = "arm")]
macro_rules! take_port {
    ($port:ident, $can:ident) => {{
        let _: &pac::CAN1 = &$can;
        // SAFETY: the pins of a board and its UART are set up by its `init` alone, and that takes
        // the only CAN controller.
        unsafe { pac::$port::steal() }
    }};
}

/// The CAN controller that a board talks through, CAN1 or CAN2.
///
/// The tasks of a program are bound to CAN1's interrupts, whichever it is: those of CAN2 have
/// handlers that are the tasks' entries, too. `init` of such a board makes them the same priority
/// ([`can_controllers::take_can2`]), so that neither interrupts the other.
macro_rules! can_controller {
    (CAN1) => {
        can_controller!(1, CAN1);
    };
    (CAN2) => {
        can_controller!(2, CAN2);
        can_controller!(CAN2_TX is CAN1_TX);
        can_controller!(CAN2_RX0 is CAN1_RX0);
    };
    ($number:literal, $can:ident) => {
        /// The number of the CAN controller that coboot talks through.
        pub const CAN_CONTROLLER: u8 = $number;

        /// The CAN controller that coboot talks through.
        #[cfg(target_arch = "arm")]
        pub type CanController = stm32f4xx_hal::can::Can<stm32f4xx_hal::pac::$can>;
    };
    ($interrupt:ident is $task:ident) => {
        #[cfg(target_arch = "arm")]
        #[no_mangle]
        #[allow(non_snake_case)]
        extern "C" fn $interrupt() {
            extern "C" {
                fn $task();
            }
            // SAFETY: the handler of the program, called as the core would call it: at the
            // priority of its own interrupt.
            unsafe { $task() }
        }
    };
}

/// The USART that a board talks through; its interrupt has the same name.
#[cfg(target_arch = "arm")]
macro_rules! uart {
    ($(#[$doc:meta])* $usart:ident) => {
        $(#[$doc])*
        pub type UartController = pac::$usart;

        #[cfg(feature = "uart")]
        #[no_mangle]
        #[allow(non_snake_case)]
        extern "C" fn $usart() {
            crate::uart::interrupted();
        }
    };
}

#[cfg(target_arch = "arm")]
use shared_abi::{geometry::Geometry, layout::Layout};

#[cfg(any(feature = "board-stm32f407g-disc1", feature = "board-stm32f407g-disc1-two"))]
#[path = "stm32f407g_disc1.rs"]
mod board;

#[cfg(feature = "board-stm32f407g-disc1-can2")]
#[path = "stm32f407g_disc1_can2.rs"]
mod board;

#[cfg(feature = "board-nucleo-f446re")]
#[path = "nucleo_f446re.rs"]
mod board;

#[cfg(feature = "board-stm32f429i-disc1")]
#[path = "stm32f429i_disc1.rs"]
mod board;

/// The core's clock, in Hz.
pub const SYSCLK: u32 = CLOCK_TREE.sysclk();
/// Clock of the CAN controller, in Hz: that of APB1.
pub const CAN_CLOCK: u32 = CLOCK_TREE.apb1_clock();

/// Who owns which address on this board; on the chip without the names, which nothing there asks
/// for.
#[cfg(target_arch = "arm")]
pub const LAYOUT: &Layout = {
    const CHIP: Geometry = Geometry { chip: "", ..*board::LAYOUT.chip };
    const NAMELESS: Layout = Layout { board: "", chip: &CHIP, ..*board::LAYOUT };
    &NAMELESS
};

pub use board::*; // Not found, or found twice? Choose one board by its feature `board-…`.

const _: () = assert!(
    BIT_RATE == 0 || can::BitTiming::new(CAN_CLOCK, BIT_RATE).is_some(),
    "board: the clock of the CAN controller (APB1) cannot make BIT_RATE"
);
const _: () = assert!(
    ENTRY_STRAP.0 >= 'A'
        && (ENTRY_STRAP.0 as u32) < 'A' as u32 + LAYOUT.chip.ports as u32
        && ENTRY_STRAP.1 < 16,
    "board: the chip has no such pin as ENTRY_STRAP names"
);

#[cfg(target_arch = "arm")]
pub use drivers::{clocks, entry_strap, inputs, Board};
/// What frames go through: the CAN controller, or the UART in its place.
#[cfg(all(target_arch = "arm", not(feature = "virtual-can")))]
pub type CanPort = can::Port<CanController>;
/// What frames go through: the CAN controller, or the UART in its place.
#[cfg(all(target_arch = "arm", feature = "virtual-can"))]
pub type CanPort = virtual_can::Port;
#[cfg(target_arch = "arm")]
pub use stm32f4xx_hal as hal;
#[cfg(target_arch = "arm")]
pub use stm32f4xx_hal::pac;

/// What the device says of itself in 1008h–100Ah and 1018h, for bootloader and application alike.
#[derive(Clone, Copy, Debug)]
pub struct Identity {
    /// 1018h/1, assigned by CiA; 0 where there is none.
    pub vendor_id: u32,
    /// 1018h/2.
    pub product_code: u32,
    /// 1018h/3: major in the upper half, minor in the lower.
    pub revision: u32,
    /// 1008h.
    pub device_name: &'static str,
    /// 1009h.
    pub hardware_version: &'static str,
}

/// The chip's 96-bit unique identifier (RM0090 section 39.1).
#[inline(always)]
fn unique_words() -> [u32; 3] {
    const UNIQUE_ID: *const [u32; 3] = 0x1FFF_7A10 as *const _;
    // SAFETY: the unique identifier is a read-only word-aligned part of every STM32F4.
    unsafe { UNIQUE_ID.read_volatile() }
}

/// The chip's 96-bit unique identifier (RM0090 section 39.1), as its bytes lie in memory.
#[must_use]
pub fn unique_id() -> [u8; 12] {
    let mut bytes = [0; 12];
    for (bytes, word) in bytes.chunks_exact_mut(4).zip(unique_words()) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    bytes
}

/// The count of the system timer, which runs with the clock of the core.
#[cfg(target_arch = "arm")]
#[must_use]
pub fn cycles() -> u32 {
    cortex_m::peripheral::SYST::get_current()
}

/// Serial number of the device (1018h/4): a fold of the chip's unique identifier.
#[must_use]
pub fn serial_number() -> u32 {
    shared_abi::check_word(&unique_words())
}
