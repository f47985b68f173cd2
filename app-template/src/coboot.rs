//! Everything between this application and the bootloader underneath: how it came up, what it may call, and the way back.

use bsp::can::BitTiming;
use bsp::{BIT_RATE, CAN_CLOCK, LAYOUT, NODE_ID};
use canopen::{BitRate, Instant, NodeId};
use cortex_m::peripheral::SCB;
use shared_abi::callgate::Callgate;
use shared_abi::handoff::Handoff;
use shared_abi::layout::Layout;
use shared_abi::warm_start::{BootRequest, Cell};

/// How long the device stays after the answer to 80h is on the bus, in ms: at least 10 (SYS TEC manual L-1112d_10, 4.5), and one
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
        },
        None => Start {
            node_id: NodeId::new(NODE_ID),
            bit_rate: DEFAULT_BIT_RATE,
            serial_number: bsp::serial_number(),
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

/// Where the device goes.
#[derive(Clone, Copy, Debug)]
pub enum Destination {
    /// Into the bootloader, which stays.
    Bootloader,
    /// Through a reset; what runs then is the bootloader's decision.
    Reset,
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
    /// Goes on with it: `quiet` says that everything is on the bus. Whether the device is silent from now on; does not return when
    /// its time is over.
    pub fn proceed(&mut self, quiet: bool, now: Instant) -> bool {
        match *self {
            Self::Answering(destination) if quiet => *self = Self::Leaving(destination, now + FAREWELL_MS),
            Self::Leaving(destination, at) if now.has_reached(at) => match destination {
                Destination::Bootloader => enter_bootloader(),
                Destination::Reset => restart(),
            },
            _ => {}
        }
        matches!(self, Self::Leaving(..))
    }
}

/// Resets into the bootloader, which then stays there.
pub fn enter_bootloader() -> ! {
    // From here on nothing may run but this: no interrupt, no DMA (this application uses none).
    cortex_m::interrupt::disable();
    // SAFETY: the layout's warm-start region, checked to be RAM of that size that the linker keeps out of every image.
    let mut cell = unsafe { Cell::at(LAYOUT.warm_start.base as *mut _) };
    cell.put(BootRequest::Stay);
    restart()
}

/// Resets the device; what runs then is the bootloader's decision.
pub fn restart() -> ! {
    cortex_m::interrupt::disable();
    SCB::sys_reset()
}
