//! Everything between this application and the bootloader underneath: how it came up, what it may call, and the way back.

use bsp::can::BitTiming;
use bsp::{BIT_RATE, CAN_CLOCK, LAYOUT, NODE_ID};
use canopen::{Instant, NodeId};
use cortex_m::peripheral::SCB;
use shared_abi::callgate::Callgate;
use shared_abi::handoff::Handoff;
use shared_abi::layout::Layout;
use shared_abi::warm_start::{BootRequest, Cell};

/// How long the device stays after the answer to 80h is on the bus, in ms (SYS TEC manual L-1112d_10, 4.5).
const FAREWELL_MS: u32 = 10;

/// The bit timing without a bootloader.
pub const DEFAULT_TIMING: BitTiming = match BitTiming::new(CAN_CLOCK, BIT_RATE) {
    Some(timing) => timing,
    None => panic!("board: the clock of the CAN controller cannot make the bit rate"),
};
/// The node-ID without a bootloader.
const DEFAULT_NODE: NodeId = match NodeId::new(NODE_ID) {
    Some(node) => node,
    None => panic!("board: the node-ID must be 1 to 127"),
};

/// What the application takes from the bootloader's handoff.
#[derive(Clone, Copy, Debug)]
pub struct Start {
    /// Node-ID to use.
    pub node_id: NodeId,
    /// Bit rate to use, in bit/s.
    pub bit_rate: u32,
    /// 1018h/4.
    pub serial_number: u32,
}

/// Reads the handoff; started by a debugger without a bootloader, the application has the board's own values.
pub fn how_we_came_up(layout: &Layout) -> Start {
    // SAFETY: the layout's handoff region, checked to be RAM of that size in no image.
    let handoff = unsafe { Handoff::read(layout.handoff.base as *const Handoff) };
    match handoff.and_then(|info| NodeId::new(info.node_id).map(|node_id| (info, node_id))) {
        Some((info, node_id)) => {
            Start { node_id, bit_rate: info.bit_rate, serial_number: info.serial_number }
        }
        None => Start { node_id: DEFAULT_NODE, bit_rate: BIT_RATE, serial_number: bsp::serial_number() },
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

/// The way back into the bootloader: first the answer, then a while, then the reset.
#[derive(Clone, Copy, Debug)]
pub enum Departure {
    /// The answer is not on the bus yet.
    Staying,
    /// The device leaves at this time.
    Leaving(Instant),
}

impl Departure {
    /// Goes on with it. `answered` says that the answer has reached the bus. Does not return from the last step.
    pub fn proceed(&mut self, answered: bool, now: Instant) {
        match *self {
            Self::Staying if answered => *self = Self::Leaving(now + FAREWELL_MS),
            Self::Leaving(at) if now.has_reached(at) => enter_bootloader(),
            _ => {}
        }
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
