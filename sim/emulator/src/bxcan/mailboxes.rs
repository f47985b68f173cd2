//! Transmit mailboxes and receive FIFOs (RM0090 section 32.7).

use std::collections::VecDeque;

use super::registers::{ier, ir, rfr, tsr};
use crate::frame::{ExtendedId, Frame, Id, StandardId};
use crate::time::Time;

/// A transmit mailbox (RM0090, 32.7.1).
#[derive(Clone, Copy, Debug, Default)]
pub struct Mailbox {
    pub tir: u32,
    pub tdtr: u32,
    pub tdlr: u32,
    pub tdhr: u32,
    /// RQCP, TXOK, ALST, TERR.
    pub flags: u32,
    pub state: MailboxState,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MailboxState {
    #[default]
    Empty,
    /// TXRQ is set. `order` counts the requests of the controller.
    Pending { since: Time, order: u64 },
    /// Its frame is on the wire; `abort`: ABRQ waits for the outcome.
    Transmit { since: Time, order: u64, abort: bool },
}

impl Mailbox {
    pub fn frame(&self) -> Frame {
        let dlc = (self.tdtr & 0xF) as u8;
        let id = if self.tir & ir::IDE == 0 {
            StandardId::new((self.tir >> 21) as u16).map(Id::Standard)
        } else {
            ExtendedId::new(self.tir >> 3).map(Id::Extended)
        };
        // 32 bits less the 21 or 3 shifted out fit 11 or 29.
        let id = id.unwrap_or(Id::Standard(StandardId::MAX));
        let frame = if self.tir & ir::RTR == 0 {
            let mut data = [0; 8];
            data[..4].copy_from_slice(&self.tdlr.to_le_bytes());
            data[4..].copy_from_slice(&self.tdhr.to_le_bytes());
            let data = &data[..usize::from(dlc).min(data.len())];
            Frame::data_frame(id, data).and_then(|frame| frame.with_dlc(dlc))
        } else {
            Frame::remote_frame(id, dlc)
        };
        frame.expect("the DLC has four bits")
    }

    pub fn order(&self) -> Option<u64> {
        match self.state {
            MailboxState::Empty => None,
            MailboxState::Pending { order, .. } | MailboxState::Transmit { order, .. } => Some(order),
        }
    }

    /// The request is over.
    pub fn complete(&mut self) {
        self.state = MailboxState::Empty;
        self.flags |= tsr::RQCP;
    }
}

/// A received frame as its four registers show it.
#[derive(Clone, Copy, Debug)]
pub struct RxMailbox {
    pub rir: u32,
    pub rdtr: u32,
    pub rdlr: u32,
    pub rdhr: u32,
}

impl Default for RxMailbox {
    /// After a reset: undefined (RM0090, 32.9.3).
    fn default() -> Self {
        const ANY: u32 = 0xA5A5_A5A5;
        Self { rir: ANY, rdtr: ANY, rdlr: ANY, rdhr: ANY }
    }
}

impl RxMailbox {
    /// A frame after another one, of which the data registers keep the bytes that this one does not have.
    pub fn new(frame: &Frame, filter_index: u8, stamp: u32, before: &Self) -> Self {
        let id = match frame.id() {
            Id::Standard(id) => u32::from(id.as_raw()) << 21,
            Id::Extended(id) => id.as_raw() << 3 | ir::IDE,
        };
        let word = |at: usize, before: u32| {
            let mut bytes = before.to_le_bytes();
            for (to, from) in bytes.iter_mut().zip(frame.data().iter().skip(at)) {
                *to = *from;
            }
            u32::from_le_bytes(bytes)
        };
        Self {
            rir: id | if frame.is_remote() { ir::RTR } else { 0 },
            rdtr: stamp | u32::from(filter_index) << 8 | u32::from(frame.dlc()),
            rdlr: word(0, before.rdlr),
            rdhr: word(4, before.rdhr),
        }
    }
}

/// A receive FIFO of three frames (RM0090, 32.7.3).
#[derive(Clone, Debug, Default)]
pub struct Fifo {
    pub frames: VecDeque<RxMailbox>,
    /// What the output mailbox shows when nothing is in the FIFO: the last frame released.
    pub stale: RxMailbox,
    pub full: bool,
    pub overrun: bool,
}

const FIFO_DEPTH: usize = 3;

impl Fifo {
    pub fn store(&mut self, frame: RxMailbox, locked: bool) {
        if self.frames.len() == FIFO_DEPTH {
            self.overrun = true;
            if locked {
                return;
            }
            self.frames.pop_back();
        }
        self.frames.push_back(frame);
        self.full |= self.frames.len() == FIFO_DEPTH;
    }

    pub fn release(&mut self) {
        if let Some(frame) = self.frames.pop_front() {
            self.stale = frame;
        }
    }

    pub fn output(&self) -> &RxMailbox {
        self.frames.front().unwrap_or(&self.stale)
    }

    pub fn read_status(&self) -> u32 {
        // At most FIFO_DEPTH.
        let pending = self.frames.len() as u32;
        pending | if self.full { rfr::FULL } else { 0 } | if self.overrun { rfr::FOVR } else { 0 }
    }

    pub fn write_status(&mut self, value: u32) {
        self.full &= value & rfr::FULL == 0;
        self.overrun &= value & rfr::FOVR == 0;
        if value & rfr::RFOM != 0 {
            self.release();
        }
    }

    /// Whether an interrupt is active; `enabled`: FMPIE, FFIE and FOVIE of this FIFO at their FIFO
    /// 0 places.
    pub fn interrupt(&self, enabled: u32) -> bool {
        enabled & ier::FMPIE != 0 && !self.frames.is_empty()
            || enabled & ier::FFIE != 0 && self.full
            || enabled & ier::FOVIE != 0 && self.overrun
    }
}
