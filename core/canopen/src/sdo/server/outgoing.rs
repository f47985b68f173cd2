//! Data from the device to the client.

use crate::abort::AbortCode;
use crate::od::{Address, Objects};
use crate::sdo::block::SEGMENT;

use super::value::VALUE_MAX;

/// An upload by any kind of transfer: the number of bytes, and the number of sent bytes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Outgoing {
    domain: bool,
    size: Option<u32>,
    /// The number of sent bytes. A block upload sets it back to send a sub-block again.
    pub offset: u32,
}

impl Outgoing {
    /// A domain, with its size if it is known.
    pub const fn domain(size: Option<u32>) -> Self {
        Self { domain: true, size, offset: 0 }
    }

    /// A variable or string that was read.
    pub const fn value(size: u32) -> Self {
        Self { domain: false, size: Some(size), offset: 0 }
    }

    /// Whether the data are read from the object as they are sent.
    pub const fn is_domain(&self) -> bool {
        self.domain
    }

    /// Its size in bytes, if it is known.
    pub const fn size(&self) -> Option<u32> {
        self.size
    }

    /// Writes the data of the next segment into bytes 1 to 7 of a frame. Returns their number, and
    /// whether they are the last data.
    pub fn next(
        &mut self,
        at: Address,
        value: &[u8; VALUE_MAX],
        frame: &mut [u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(usize, bool), AbortCode> {
        let left = self.size.map_or(u32::MAX, |size| size - self.offset);
        let wanted = left.min(SEGMENT as u32) as usize;
        let data = &mut frame[1..=wanted];
        let len = if wanted == 0 {
            0
        } else if self.domain {
            objects.upload_data(at, self.offset, data)?.min(wanted)
        } else {
            let offset = self.offset as usize;
            data.copy_from_slice(&value[offset..offset + wanted]);
            wanted
        };
        // A domain that ends before its own size is an error of the device.
        if len < wanted && self.size.is_some() {
            return Err(AbortCode::INTERNAL);
        }
        self.offset = self.offset.checked_add(len as u32).ok_or(AbortCode::INTERNAL)?;
        Ok((len, len < SEGMENT || self.size == Some(self.offset)))
    }
}
