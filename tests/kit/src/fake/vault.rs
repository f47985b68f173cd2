//! A device with keys, as a host sees it.

use std::sync::{Arc, Mutex};

use super::{Deed, Maker};

/// A device that accepts sealed images: it stores the received data.
pub struct Vault {
    /// The received data.
    pub kept: Arc<Mutex<Vec<u8>>>,
    /// Where the program starts.
    pub start: u32,
    /// Bytes of its flash.
    pub room: u32,
    /// The value of 1F57h afterwards.
    pub status: u32,
}

impl Maker for Vault {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        let kept = self.kept.lock().unwrap();
        match at {
            (0x2004, 1) => Some(Ok([self.start.to_le_bytes(), self.room.to_le_bytes()].concat())),
            // Nothing was erased for an image that is refused.
            (0x1F56, 1) if self.status != 0 => Some(Ok(vec![0x78, 0x56, 0x34, 0x12])),
            (0x1F56, 1) => Some(Ok(kept.get(32..36).unwrap_or(&[0; 4]).to_vec())),
            (0x1F57, 1) if !kept.is_empty() && self.status != 0 => {
                Some(Ok(self.status.to_le_bytes().to_vec()))
            }
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], _: u32) -> Option<Result<Deed, u32>> {
        if at != (0x1F50, 1) {
            return None;
        }
        *self.kept.lock().unwrap() = data.to_vec();
        Some(if self.status == 0 { Ok(Deed::Nothing) } else { Err(0x0800_0020) })
    }
}
