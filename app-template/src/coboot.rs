//! Everything between this application and the bootloader underneath: how it came up, what it may
//! call, and the way back.

use core::sync::atomic::{AtomicU32, Ordering};

use bsp::can::BitTiming;
use bsp::{BIT_RATE, CAN_CLOCK, LAYOUT, NODE_ID};
use canopen::{BitRate, Instant, NodeId};
use shared_abi::callgate::{Callgate, CallgateError, NodeArgs, ProgramArgs};
use shared_abi::handoff::Handoff;
use shared_abi::layout::Layout;
use shared_abi::reentry;
use shared_abi::warm_start::{BootRequest, WarmStart};

use crate::debugger;

/// How long the device stays after the answer to 80h is on the bus, in ms: at least 10 (SYS TEC
/// manual L-1112d_10, 4.5), and one that may be almost over.
const ANSWER_TO_RESET_MS: u32 = 11;

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

/// Reads the handoff; started by a debugger without a bootloader, the application has the board's
/// own values.
pub fn read_handoff(layout: &Layout) -> Start {
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

/// What 1F56h reads in the bootloader as well: the CRC over what was downloaded as this program.
/// Without that (a debugger has put the program there), over the program as it was linked, computed
/// through the callgate; 0 without a bootloader.
pub fn program_crc(number: u8) -> u32 {
    extern "C" {
        static __vector_table: u8;
        static __image_end: u8;
    }
    let (start, end) = (&raw const __vector_table as u32, &raw const __image_end as u32);
    let computed = || Callgate::find(LAYOUT)?.crc32(start, end - start);
    program_info(number).map(|info| info.crc).or_else(|_| computed()).unwrap_or(0)
}

/// Stores node-ID and bit rate for bootloader and application; `None` and [`BitRate::Auto`] as
/// layer setting services mean them.
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

/// Confirms this program: a trial that is content with itself is one no more. Or takes its
/// signature away.
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

/// How the device goes back into the bootloader (`shared_abi::reentry`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ReentryPath {
    /// Through a system reset.
    #[default]
    SystemReset = 0,
    /// Through a reset by the watchdog.
    Watchdog = 1,
    /// By a jump, all resources released.
    Jump = 2,
}

impl ReentryPath {
    /// The path of this number.
    pub const fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            0 => Self::SystemReset,
            1 => Self::Watchdog,
            2 => Self::Jump,
            _ => return None,
        })
    }
}

/// The re-entry in order: the answer, then a time without any transmission, then the reset.
#[derive(Clone, Copy, Debug)]
pub enum ReentrySequence {
    /// The device stays.
    Idle,
    /// What is to be said first is not on the bus yet.
    AnswerPending(ReentryPath, BootRequest),
    /// The device leaves at this time. A frame that began now would be cut off by the reset.
    ResetPending(ReentryPath, BootRequest, Instant),
}

impl ReentrySequence {
    /// Goes on with it: `quiet` says that everything is on the bus. Whether the device is silent
    /// from now on.
    pub fn proceed(&mut self, quiet: bool, now: Instant) -> bool {
        match *self {
            Self::AnswerPending(path, request) if quiet => {
                *self = Self::ResetPending(path, request, now + ANSWER_TO_RESET_MS)
            }
            Self::ResetPending(path, request, at) if now.has_reached(at) => request_reentry(path, request),
            _ => {}
        }
        matches!(self, Self::ResetPending(..))
    }
}

/// Told to `idle`, where no exception is active: 0 to stay, else the path (1 to 3), and from bit 8
/// on the request as the warm-start cell has it, from bit 16 on its argument.
static REENTRY_REQUEST: AtomicU32 = AtomicU32::new(0);

fn request_reentry(path: ReentryPath, request: BootRequest) {
    let WarmStart { request, argument, .. } = WarmStart::new(request);
    REENTRY_REQUEST.store((path as u32 + 1) | request << 8 | argument << 16, Ordering::Relaxed);
    debugger::release_program();
}

/// To be called by `idle` whenever it wakes. Does not return if the device is to leave.
pub fn reenter_if_requested() {
    let told = REENTRY_REQUEST.load(Ordering::Relaxed);
    let Some(path) = (told as u8).checked_sub(1).and_then(ReentryPath::from_number) else { return };
    let request = WarmStart::encode(told >> 8 & 0xFF, told >> 16).request().unwrap_or(BootRequest::Stay);
    match path {
        ReentryPath::SystemReset => reentry::system_reset(LAYOUT, request),
        ReentryPath::Watchdog => reentry::watchdog_reset(LAYOUT, request),
        ReentryPath::Jump => reentry::jump(LAYOUT, request),
    }
}
