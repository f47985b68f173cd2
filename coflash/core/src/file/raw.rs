//! Raw binary: the bytes of the flash alone.

use super::fault::{Cause, Place, ReadError};
use super::image::{Image, Pieces};

/// Reads the bytes unchanged.
///
/// # Errors
/// [`Cause::NoAddress`] without an address, [`Cause::AddressOverflow`] if the bytes exceed the
/// address space.
pub fn read(bytes: &[u8], address: Option<u32>) -> Result<Image, ReadError> {
    let address = address.ok_or(Place::File.fault(Cause::NoAddress))?;
    if u64::from(address) + bytes.len() as u64 > 1 << 32 {
        return Err(Place::File.fault(Cause::AddressOverflow { address, what: "the address space" }));
    }
    let mut pieces = Pieces::default();
    pieces.add(address, bytes.to_vec(), Place::Offset(0));
    pieces.into_image()
}
