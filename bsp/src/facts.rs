//! The facts of the board, and what follows from them.

use canopen::BitRate;
pub use shared_abi::geometry::Pin;
use shared_abi::geometry::{Geometry, Limits};
use shared_abi::layout::Layout;
pub use shared_abi::wiring::Pins;
use shared_abi::wiring::Wiring;

use crate::can::BitTiming;
use crate::clock::ClockTree;
use crate::identity::Identity;
use crate::voltage;

/// Selects the board's CAN controller for coboot, CAN1 or CAN2.
///
/// The tasks of a program are bound to CAN1's interrupts for either controller: with CAN2, the
/// handlers of CAN2's interrupts call the tasks' entries. [`init`](crate::init) gives both the same
/// priority ([`can_controllers`](crate::can_controllers)), so that neither interrupts the other.
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
            // SAFETY: it calls the handler of the program as the core would: at the priority of the
            // handler's own interrupt.
            unsafe { $task() }
        }
    };
}

// The board's file in `boards/`, and the name of its memory map (build.rs).
include!(concat!(env!("OUT_DIR"), "/board.rs"));

/// The chip on the board.
pub(crate) const CHIP: &Geometry = BOARD.chip;

/// The facts of a board: the constant `FACTS` of its file in `boards/`.
#[derive(Clone, Copy, Debug)]
pub struct Facts {
    /// The identity that the device reports.
    pub identity: Identity,
    /// Node-ID of a device that has no other one stored, 1 to 127; 255 for a device that waits for
    /// layer setting services (LSS).
    pub node_id: u8,
    /// Bit rate of a device that has no other one stored, in bit/s; 0 for a device that detects it
    /// by listening.
    pub bit_rate: u32,
    /// The lowest supply of the chip (VDD) that the board guarantees, in mV, 1800 to 3600. How wide the flash
    /// is programmed and the threshold of the voltage detector follow from it ([`voltage`]), and the wait
    /// states that the clocks need.
    pub supply_mv: u32,
    /// How the clocks are made.
    pub clock_tree: ClockTree,
    /// The pin that asks for the bootloader after a reset, if the board has one.
    pub entry_strap: Option<Strap>,
    /// The pin of the LED that blinks while the device works.
    pub led: Pin,
    /// The pins of the CAN controller.
    pub can_pins: Pins,
    /// The pin that takes the CAN transceiver out of standby, and the level that does it: high, or
    /// low.
    pub can_standby: Option<(Pin, bool)>,
    /// The pins of the UART.
    pub uart_pins: Pins,
    /// Bit rate of the UART, in bit/s.
    pub uart_bit_rate: u32,
    /// What the board does, beside what these facts are for; [`Functions::NONE`] for nothing.
    pub functions: Functions,
}

/// The entry strap: a pin that asks for the bootloader after a reset.
///
/// It is read [`Strap::SAMPLES`] times, some microseconds apart, and asks for the bootloader only
/// if it is pressed each time: a spike must not keep a device from its program, and a user who
/// wants the bootloader holds the strap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Strap {
    /// Its port, `'A'` and on.
    pub port: char,
    /// The pin's number in the port, 0 to 15.
    pub pin: u8,
    /// The level that asks for the bootloader: high, or low.
    pub pressed: bool,
    /// The chip's resistor (about 40 kΩ) that holds the pin at the other level. It is on while the
    /// strap is read.
    pub pull: Pull,
}

/// A resistor in the chip at a pin (`GPIOx_PUPDR`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pull {
    /// None: the board has one.
    None,
    /// To the supply.
    Up,
    /// To ground.
    Down,
}

impl Strap {
    /// How often the strap is read.
    pub const SAMPLES: u32 = 4;

    /// Whether the resistor does not hold the pin at the pressed level.
    const fn is_possible(&self) -> bool {
        let holds = match self.pull {
            Pull::None => !self.pressed,
            Pull::Up => true,
            Pull::Down => false,
        };
        holds != self.pressed
    }
}

/// The functions of a board (docs/porting.md, "A board's own functions"). One that is `None` costs nothing.
///
/// Each runs in the resident part of the bootloader, from flash, and in its RAM image, where code and constants
/// are in RAM and the flash may be busy; [`each_10_ms`](Self::each_10_ms) and
/// [`before_leaving`](Self::before_leaving) in the application template, too. So they use neither the flash
/// controller, nor interrupts, nor a `static` (with one, the resident part does not link: an application owns the
/// RAM), nor an address in flash, and return within a millisecond.
#[derive(Clone, Copy, Debug)]
pub struct Functions {
    /// The first thing after each reset, when the core runs from HSI: a pin that holds the power, outputs that are
    /// safe. An application that jumps to the bootloader leads here, too. The boot stage leaves what it has set up to
    /// the bootloader and to the programs, which find all else as after a reset.
    pub init: Option<fn()>,
    /// At most 10 ms after the call before, as long as the software proves that it works; some ms later in a RAM
    /// image that computes. To be toggled: an external watchdog.
    pub each_10_ms: Option<fn()>,
    /// Before a program starts, and before a reset that bootloader or application make themselves.
    pub before_leaving: Option<fn()>,
}

impl Functions {
    /// A board that has facts alone.
    pub const NONE: Self = Self { init: None, each_10_ms: None, before_leaving: None };
}

/// The identity that the device reports.
pub const IDENTITY: Identity = FACTS.identity;
/// Node-ID of a device that has no other one stored ([`Facts::node_id`]).
pub const NODE_ID: u8 = FACTS.node_id;
/// Bit rate of a device that has no other one stored ([`Facts::bit_rate`]).
pub const BIT_RATE: u32 = FACTS.bit_rate;
/// The lowest supply of the chip in mV ([`Facts::supply_mv`]).
pub const SUPPLY_MV: u32 = {
    assert!(
        FACTS.supply_mv >= *voltage::RANGE.start() && FACTS.supply_mv <= *voltage::RANGE.end(),
        "board: supply_mv, the lowest supply of the chip, is 1800 to 3600 (mV)"
    );
    FACTS.supply_mv
};
/// How many bytes of the flash are programmed at a time: 1, 2 or 4.
pub const FLASH_WIDTH: u32 = voltage::flash_width(SUPPLY_MV);
/// The highest clocks at the lowest supply with which the device works on.
const LIMITS: Limits = CHIP.line.limits_at(voltage::lowest(SUPPLY_MV));
/// How the clocks are made; the chip can run with them.
pub const CLOCK_TREE: ClockTree = FACTS.clock_tree.checked(&LIMITS);
/// The same with HSI in place of the crystal.
pub const INTERNAL: ClockTree = CLOCK_TREE.internal(&LIMITS, &BitRate::TABLE).checked(&LIMITS);
/// The pin that asks for the bootloader after a reset.
pub const ENTRY_STRAP: Option<Strap> = FACTS.entry_strap;

/// The core's clock, in Hz.
pub const SYSCLK: u32 = CLOCK_TREE.sysclk();
/// Clock of the CAN controller in Hz: the clock of APB1.
pub const CAN_CLOCK: u32 = CLOCK_TREE.apb1_clock();

/// The memory layout of this board: the owner of each address. On the chip it has no names, because
/// nothing reads them there.
#[cfg(target_arch = "arm")]
pub const LAYOUT: &Layout = {
    const CHIP: Geometry = Geometry { chip: "", ..*BOARD.chip };
    const NAMELESS: Layout = Layout { board: "", chip: &CHIP, ..*BOARD };
    &NAMELESS
};
/// The memory layout of this board: the owner of each address.
#[cfg(not(target_arch = "arm"))]
pub const LAYOUT: &Layout = BOARD;

pub use board::*;

const _: () = assert!(
    BIT_RATE == 0 || BitTiming::new(CAN_CLOCK, BIT_RATE).is_some(),
    "board: the clock of the CAN controller (APB1) cannot make bit_rate"
);
const _: () = assert!(
    matches!(NODE_ID, 1..=127 | 255),
    "board: node_id must be 1 to 127, or 255 for a device that waits for layer setting services"
);
const _: Wiring = Wiring {
    can_controller: CAN_CONTROLLER,
    can: FACTS.can_pins,
    led: FACTS.led,
    strap: match ENTRY_STRAP {
        Some(Strap { port, pin, .. }) => Some((port, pin)),
        None => None,
    },
    standby: match FACTS.can_standby {
        Some((pin, _)) => Some(pin),
        None => None,
    },
    uart: FACTS.uart_pins,
    hse_bypass: CLOCK_TREE.hse_bypass,
}
.checked(CHIP);
const _: () = assert!(
    match ENTRY_STRAP {
        Some(strap) => strap.is_possible(),
        None => true,
    },
    "board: the chip's resistor pulls entry_strap to `pressed`"
);

/// Compares the chip of the HAL and its PAC with the chip of the board.
#[cfg(target_arch = "arm")]
mod chip_check {
    use stm32f4xx_hal::pac;

    use crate::facts::CHIP;

    const fn len<T, const N: usize>(_: *const [T; N]) -> u16 {
        N as u16
    }

    const PAC: u16 = len(&raw const pac::__INTERRUPTS);
    const EXPECTED: u16 = CHIP.line.pac_interrupts();

    const _: () = assert!(PAC == EXPECTED, "{}", MESSAGE);

    const TEXT: [u8; 91] = with_numbers(
        *b"board: the PAC has ### interrupt lines, the chip ###: the feature of bsp names another line",
        [PAC, EXPECTED],
    );
    const MESSAGE: &str = match core::str::from_utf8(&TEXT) {
        Ok(text) => text,
        Err(_) => unreachable!(),
    };

    /// Replaces each `###` by a number of three digits.
    const fn with_numbers<const N: usize>(mut text: [u8; N], numbers: [u16; 2]) -> [u8; N] {
        let (mut at, mut next) = (0, 0);
        while at < N {
            if text[at] == b'#' {
                text[at] = b'0' + (numbers[next] / 100 % 10) as u8;
                text[at + 1] = b'0' + (numbers[next] / 10 % 10) as u8;
                text[at + 2] = b'0' + (numbers[next] % 10) as u8;
                next += 1;
                at += 2;
            }
            at += 1;
        }
        text
    }
}
