//! Everything between this application and the bootloader underneath: how it came up, what it may call, and the
//! way back.

use core::sync::atomic::{AtomicU8, Ordering};

use bsp::can::BitTiming;
use bsp::{BIT_RATE, CAN_CLOCK, LAYOUT, NODE_ID};
use canopen::{BitRate, Instant, NodeId};
use shared_abi::callgate::{Callgate, CallgateError, NodeArgs, ProgramArgs};
use shared_abi::handoff::Handoff;
use shared_abi::layout::Layout;
use shared_abi::reentry;
use shared_abi::warm_start::BootRequest;

/// How long the device stays after the answer to 80h is on the bus, in ms: at least 10 (SYS TEC manual L-1112d_10,
/// 4.5), and one
/// that may be almost over.
const FAREWELL_MS: u32 = 11;

/// The bit rate without a bootloader.
const DEFAULT_BIT_RATE: BitRate = match BitRate::from_bits_per_second(BIT_RATE) {
    Some(rate) => rate,
    None => panic!("board: the bit rate must be one of CANopen's, or 0 to find it out"),
};

/// Whether the board's CAN controller can run at this bit rate.
pub const fn supports(rate: BitRate) -> bool {
    match rate.bits_per_second() {
        Some(rate) => BitTiming::new(CAN_CLOCK, rate).is_some(),
        None => true,
    }
}

/// What the application takes from the bootloader's handoff.
#[derive(Clone, Copy, Debug)]
pub struct Start {
    /// Node-ID to use, unless there is none.
    pub node_id: Option<NodeId>,
    /// Bit rate to use.
    pub bit_rate: BitRate,
    /// 1018h/4.
    pub serial_number: u32,
    /// The program that this is, 1 to 254.
    pub program: u8,
}

/// Reads the handoff; started by a debugger without a bootloader, the application has the board's own values.
pub fn how_we_came_up(layout: &Layout) -> Start {
    // SAFETY: the layout's handoff region, checked to be RAM of that size in no image.
    let handoff = unsafe { Handoff::read(layout.handoff.base as *const Handoff) };
    match handoff {
        Some(info) => Start {
            node_id: NodeId::new(info.node_id),
            bit_rate: BitRate::from_bits_per_second(info.bit_rate).unwrap_or(DEFAULT_BIT_RATE),
            serial_number: info.serial_number,
            program: info.program,
        },
        None => Start {
            node_id: NodeId::new(NODE_ID),
            bit_rate: DEFAULT_BIT_RATE,
            serial_number: bsp::serial_number(),
            program: 1,
        },
    }
}

/// CRC over this program in flash, computed by the bootloader through its callgate: what 1F56h reads there as well.
/// `None` without a bootloader.
pub fn own_crc(layout: &Layout) -> Option<u32> {
    extern "C" {
        static __vector_table: u8;
        static __image_end: u8;
    }
    let (start, end) = (&raw const __vector_table as u32, &raw const __image_end as u32);
    Callgate::find(layout).ok()?.crc32(start, end - start).ok()
}

/// Stores node-ID and bit rate for bootloader and application; `None` and [`BitRate::Auto`] as layer setting
/// services mean them.
///
/// # Errors
/// What the bootloader says.
pub fn store_node(id: Option<NodeId>, rate: BitRate) -> Result<(), CallgateError> {
    const NO_NODE_ID: u8 = 255;
    let node_id = id.map_or(NO_NODE_ID, NodeId::get).into();
    Callgate::find(LAYOUT)?.store_node(NodeArgs { node_id, bit_rate: rate.or_zero() })
}

/// What the bootloader knows of a program.
///
/// # Errors
/// What the bootloader says.
pub fn program_info(number: u8) -> Result<ProgramArgs, CallgateError> {
    Callgate::find(LAYOUT)?.program_info(number)
}

/// Confirms this program: a trial that is content with itself is one no more. Or takes its signature away.
///
/// # Errors
/// What the bootloader says.
pub fn confirm(number: u8, content: bool) -> Result<(), CallgateError> {
    let callgate = Callgate::find(LAYOUT)?;
    if content {
        callgate.confirm(number)
    } else {
        callgate.invalidate(number)
    }
}

/// Where the device goes.
#[derive(Clone, Copy, Debug)]
pub enum Destination {
    /// Into the bootloader, which stays.
    Bootloader(Way),
    /// Through a reset, as after a power-on: nobody has crashed.
    Reset,
}

/// How the device goes back into the bootloader (`shared_abi::reentry`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Way {
    /// Through a system reset.
    #[default]
    SystemReset = 0,
    /// Through a reset by the watchdog.
    Watchdog = 1,
    /// By a jump, all resources released.
    Jump = 2,
}

impl Way {
    /// The way of this number.
    pub const fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            0 => Self::SystemReset,
            1 => Self::Watchdog,
            2 => Self::Jump,
            _ => return None,
        })
    }
}

/// The way out: first the answer, then a while in which nothing is said any more, then the reset.
#[derive(Clone, Copy, Debug)]
pub enum Departure {
    /// The device stays.
    Staying,
    /// What is to be said first is not on the bus yet.
    Answering(Destination),
    /// The device leaves at this time. A frame that began now would be cut off by the reset.
    Leaving(Destination, Instant),
}

impl Departure {
    /// Goes on with it: `quiet` says that everything is on the bus. Whether the device is silent from now on.
    pub fn proceed(&mut self, quiet: bool, now: Instant) -> bool {
        match *self {
            Self::Answering(destination) if quiet => *self = Self::Leaving(destination, now + FAREWELL_MS),
            Self::Leaving(destination, at) if now.has_reached(at) => leave_by_idle(destination),
            _ => {}
        }
        matches!(self, Self::Leaving(..))
    }
}

/// Told to `idle`, where no exception is active: 0 to stay, else one of these.
static LEAVING: AtomicU8 = AtomicU8::new(0);
const RESET: u8 = 1;
const SYSTEM_RESET: u8 = 2;
const WATCHDOG: u8 = 3;
const JUMP: u8 = 4;

fn leave_by_idle(destination: Destination) {
    let how = match destination {
        Destination::Reset => RESET,
        Destination::Bootloader(Way::SystemReset) => SYSTEM_RESET,
        Destination::Bootloader(Way::Watchdog) => WATCHDOG,
        Destination::Bootloader(Way::Jump) => JUMP,
    };
    LEAVING.store(how, Ordering::Relaxed);
}

/// To be called by `idle` whenever it wakes. Does not return if the device is to leave.
pub fn leave_if_told() {
    match LEAVING.load(Ordering::Relaxed) {
        RESET => reentry::system_reset(LAYOUT, BootRequest::PowerOn),
        SYSTEM_RESET => reentry::system_reset(LAYOUT, BootRequest::Stay),
        WATCHDOG => reentry::watchdog_reset(LAYOUT, BootRequest::Stay),
        JUMP => reentry::jump(LAYOUT, BootRequest::Stay),
        _ => {}
    }
}
