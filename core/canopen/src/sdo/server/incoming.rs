//! Data from the client to the device.

use crate::abort::AbortCode;
use crate::od::{Address, DataType, Objects, Reply};

use super::value::VALUE_MAX;
use crate::sdo::block::SEGMENT;

/// A download by any kind of transfer: the number of bytes received, and the permitted number.
#[derive(Clone, Copy, Debug)]
pub(super) struct Incoming {
    data_type: DataType,
    /// The number of bytes that the client announced.
    announced: Option<u32>,
    received: u32,
}

impl Incoming {
    /// Starts a download. A size that does not match the type is refused at once.
    pub fn start(
        at: Address,
        data_type: DataType,
        announced: Option<u32>,
        objects: &mut impl Objects,
    ) -> Result<Self, AbortCode> {
        let incoming = Self { data_type, announced, received: 0 };
        if incoming.is_domain() {
            objects.download_start(at, announced)?;
        } else if let Some(size) = announced {
            incoming.check_length(size)?;
        }
        Ok(incoming)
    }

    /// Whether the data are passed on as they arrive, instead of being kept until they are
    /// complete.
    pub fn is_domain(&self) -> bool {
        self.data_type == DataType::Domain
    }

    /// Whether one segment of a block download has the rest of the announced bytes.
    pub fn misses_one(&self) -> bool {
        self.announced.is_some_and(|size| size.wrapping_sub(self.received) <= SEGMENT as u32)
    }

    /// Processes the next bytes: data of a domain go to the object, data of a value into `value`.
    pub fn take(
        &mut self,
        at: Address,
        data: &[u8],
        value: &mut [u8; VALUE_MAX],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let before = self.received;
        let after = before.checked_add(data.len() as u32).ok_or(AbortCode::LENGTH_TOO_HIGH)?;
        if self.announced.is_some_and(|size| after > size) {
            return Err(AbortCode::LENGTH);
        }
        if !self.is_domain() {
            let place = value.get_mut(before as usize..after as usize);
            place.ok_or(AbortCode::LENGTH_TOO_HIGH)?.copy_from_slice(data);
        } else if !data.is_empty() {
            // The server slows a client down by delaying its answers. A client that does not wait
            // for them, or that sends expedited, is refused.
            if objects.download_space(at, true) < data.len() {
                return Err(AbortCode::OUT_OF_MEMORY);
            }
            objects.download_data(at, data)?;
        }
        self.received = after;
        Ok(())
    }

    /// Whether a value of the type can have this length.
    fn check_length(&self, len: u32) -> Result<(), AbortCode> {
        let (least, most) = match self.data_type.size() {
            Some(size) => (size, size),
            None => (0, VALUE_MAX as u32),
        };
        if len > most {
            Err(AbortCode::LENGTH_TOO_HIGH)
        } else if len < least {
            Err(AbortCode::LENGTH_TOO_LOW)
        } else {
            Ok(())
        }
    }

    /// Whether the number of bytes matches the announced size and the type.
    pub fn check(&self) -> Result<(), AbortCode> {
        if self.announced.is_some_and(|size| self.received != size) {
            Err(AbortCode::LENGTH)
        } else if self.is_domain() {
            Ok(())
        } else {
            self.check_length(self.received)
        }
    }

    /// All bytes have arrived: informs the object, which may refuse them.
    pub fn finish(
        &self,
        at: Address,
        value: &[u8; VALUE_MAX],
        expedited: bool,
        objects: &mut impl Objects,
    ) -> Result<Reply, AbortCode> {
        if self.is_domain() {
            objects.download_end(at).map(|()| Reply::Send)
        } else {
            objects.write_with_reply(at, &value[..self.received as usize], expedited)
        }
    }
}
