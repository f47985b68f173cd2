//! Everything between this application and the bootloader underneath: how it came up, what it may
//! call, and the way back.

use core::sync::atomic::{AtomicU32, Ordering};

use bsp::can::BitTiming;
use bsp::{BIT_RATE, CAN_CLOCK, LAYOUT, NODE_ID};
use canopen::application::{self, Next};
use canopen::slave::Slave;
use canopen::{AbortCode, BitRate, Instant, NodeId};
use shared_abi::callgate::{Callgate, CallgateError, NodeArgs, ProgramArgs, Status};
use shared_abi::handoff::Handoff;
use shared_abi::layout::Layout;
use shared_abi::reentry;
use shared_abi::warm_start::{BootRequest, Owed, WarmStart};

use crate::debugger;

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
    /// It was started right behind its download in one go: the first 1F51h = 80h confirms it.
    pub fresh: bool,
}

impl Start {
    /// The node-ID with which the bootloader comes up at the same bit rate, so that it can answer in
    /// this program's place. `None` where it has to find the bit rate out first, or is another node
    /// (lifts).
    pub fn bootloader_answers(&self) -> Option<NodeId> {
        self.node_id.filter(|_| self.bit_rate != BitRate::Auto && !cfg!(feature = "lift"))
    }
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
            fresh: info.fresh,
        },
        None => Start {
            node_id: NodeId::new(NODE_ID),
            bit_rate: DEFAULT_BIT_RATE,
            serial_number: bsp::serial_number(),
            program: 1,
            fresh: false,
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
/// What the bootloader says. A sealed device stores them for the holder of a root key alone, in the
/// bootloader.
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

/// What came of a confirmation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Confirmed {
    /// It is stored.
    Now,
    /// The flash is locked in front of a sealed program: the bootloader stores it when the device
    /// leaves with [`BootRequest::Confirm`].
    AtReset,
}

/// Confirms a program: a trial that is content with itself is one no more.
///
/// # Errors
/// What the bootloader says.
pub fn confirm(number: u8) -> Result<Confirmed, CallgateError> {
    const LOCKED: i32 = Status::Locked as i32;
    match Callgate::find(LAYOUT)?.confirm(number) {
        Ok(()) => Ok(Confirmed::Now),
        Err(CallgateError::Refused(LOCKED)) => Ok(Confirmed::AtReset),
        Err(error) => Err(error),
    }
}

/// Takes a program's signature away.
///
/// # Errors
/// What the bootloader says. In a sealed device the holder of a root key alone does that, in the
/// bootloader.
pub fn invalidate(number: u8) -> Result<(), CallgateError> {
    Callgate::find(LAYOUT)?.invalidate(number)
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

/// How the device leaves for a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leave {
    /// This program answers, and the bootloader finds this request.
    Answered(BootRequest),
    /// The bootloader answers, behind its boot-up.
    Owed(Owed),
}

/// The way out: when, where, and with which request.
pub type Departure = application::Departure<(ReentryPath, BootRequest)>;

/// Begins with it, right behind the frame that asked for it.
pub fn begin(departure: &mut Departure, path: ReentryPath, leave: Leave, slave: &mut Slave, now: Instant) {
    match leave {
        Leave::Answered(request) => {
            let promised = !matches!(request, BootRequest::PowerOn | BootRequest::Start(_));
            departure.begin((path, request), promised, now);
        }
        Leave::Owed(owed) if slave.withdraw_answer(&[0x60, 0x51, 0x1F, owed.program, 0, 0, 0, 0]) => {
            departure.begin_silent((path, BootRequest::Owed(owed)), now)
        }
        // The client has written STOP in segments, whose end only this program can acknowledge.
        Leave::Owed(Owed { value: 0, .. }) => departure.begin((path, BootRequest::Stay), true, now),
        // CLEAR in segments: nobody could acknowledge it and carry it out.
        Leave::Owed(_) => slave.refuse(AbortCode::DEVICE_STATE),
    }
}

/// Goes on with it: `quiet` says that everything is on the bus. Whether the device is silent from now
/// on.
pub fn proceed(departure: &mut Departure, quiet: bool, now: Instant) -> bool {
    match departure.proceed(quiet, now) {
        Next::Serve => return false,
        Next::Wait => {}
        Next::Leave((path, request)) => request_reentry(path, request),
    }
    true
}

/// Told to `idle`, where no exception is active: 0 to stay, else the path (1 to 3), and from bit 8
/// on the request as the warm-start cell has it.
static REENTRY_REQUEST: AtomicU32 = AtomicU32::new(0);
/// The argument of the request.
static REENTRY_ARGUMENT: AtomicU32 = AtomicU32::new(0);

fn request_reentry(path: ReentryPath, request: BootRequest) {
    let WarmStart { request, argument, .. } = WarmStart::new(request);
    REENTRY_ARGUMENT.store(argument, Ordering::Relaxed);
    REENTRY_REQUEST.store((path as u32 + 1) | request << 8, Ordering::Release);
    debugger::release_program();
}

/// To be called by `idle` whenever it wakes. Does not return if the device is to leave.
pub fn reenter_if_requested() {
    let told = REENTRY_REQUEST.load(Ordering::Acquire);
    let Some(path) = (told as u8).checked_sub(1).and_then(ReentryPath::from_number) else { return };
    let argument = REENTRY_ARGUMENT.load(Ordering::Relaxed);
    let request = WarmStart::encode(told >> 8, argument).request().unwrap_or(BootRequest::Stay);
    match path {
        ReentryPath::SystemReset => reentry::system_reset(LAYOUT, request),
        ReentryPath::Watchdog => reentry::watchdog_reset(LAYOUT, request),
        ReentryPath::Jump => reentry::jump(LAYOUT, request),
    }
}
