//! A lift device, as a host sees it.

use std::sync::{Arc, Mutex};

use super::{Deed, Fake, Maker, APPLICATION, NODE};

pub use super::renewal::{NOT_NOW, NOT_STORED, NO_OBJECT};

/// More abort codes (CiA 301 table 22).
const WRITE_ONLY: u32 = 0x0601_0001;
const NO_SUB_INDEX: u32 = 0x0609_0011;
pub const RANGE: u32 = 0x0609_0030;

/// CiA 814-1 clause 6.3.
pub const LIFT: u32 = 0xFE00_01A1;
/// The password.
pub const PHRASE: &str = "open sesame";

/// What a device has stored.
pub type Kept = Arc<Mutex<Vec<u8>>>;

/// A lift device (CiA 814-1 clause 6.3). The document only defines the abort code of a wrong file.
pub struct Lift {
    kept: Kept,
    armed: bool,
    unlocked: bool,
    /// What 1000h reads in its bootloader.
    pub bootloader: u32,
    /// Sub-index of "Firmware update".
    pub sub: u8,
    /// Whether it has 1F51h.
    pub has_control: bool,
    /// Whether it stores what it gets.
    pub takes: bool,
    /// The application stays: the lift moves.
    pub refuses: bool,
}

impl Lift {
    /// A device, and what its program becomes.
    pub fn fake(running: u32, change: impl FnOnce(&mut Self)) -> (Fake, Kept) {
        let kept = Kept::default();
        let mut lift = Self {
            kept: kept.clone(),
            armed: false,
            unlocked: false,
            bootloader: LIFT,
            sub: 1,
            has_control: true,
            takes: true,
            refuses: false,
        };
        change(&mut lift);
        let mut fake = Fake::new(running);
        if running == lift.bootloader {
            fake.node = 126;
        }
        fake.maker = Some(Box::new(lift));
        (fake, kept)
    }

    fn restart(&mut self) -> (u8, u32) {
        self.unlocked = false;
        if std::mem::take(&mut self.armed) {
            (126, self.bootloader)
        } else {
            (NODE, APPLICATION)
        }
    }
}

impl Maker for Lift {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        match at {
            (0x6005, sub) if sub == self.sub => Some(Err(WRITE_ONLY)),
            (0x6005, _) => Some(Err(NO_SUB_INDEX)),
            (0x1F50, 1) if running != APPLICATION => Some(match self.unlocked {
                true => Ok(b"what was stored".to_vec()),
                false => Err(NOT_NOW),
            }),
            (0x1F50 | 0x1F56 | 0x1F57, _) => Some(Err(NO_OBJECT)),
            (0x1F51, _) if !self.has_control => Some(Err(NO_OBJECT)),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], running: u32) -> Option<Result<Deed, u32>> {
        let in_bootloader = running != APPLICATION;
        Some(match at {
            (0x6005, sub) if sub != self.sub => Err(NO_SUB_INDEX),
            (0x6005, _) if data != PHRASE.as_bytes() => Err(RANGE),
            (0x6005, _) => {
                *(if in_bootloader { &mut self.unlocked } else { &mut self.armed }) = true;
                Ok(Deed::Nothing)
            }
            (0x1F51, _) if !self.has_control => Err(NO_OBJECT),
            (0x1F51, 1) if self.refuses => Err(NOT_NOW),
            (0x1F51, 1) if data == [2] => {
                let (node, next) = self.restart();
                Ok(Deed::Restart(node, next))
            }
            (0x1F50, 1) if in_bootloader && !self.takes => Err(NOT_STORED),
            (0x1F50, 1) if in_bootloader && self.unlocked => {
                *self.kept.lock().unwrap() = data.to_vec();
                Ok(Deed::Nothing)
            }
            (0x1F50, 1) if in_bootloader => Err(NOT_NOW),
            _ => Err(NO_OBJECT),
        })
    }

    fn reset(&mut self, _: u32) -> Option<(u8, u32)> {
        Some(self.restart())
    }
}
