//! Detects the dialect of a device.

use canopen::{program, AbortCode, Address};

use super::device_type::DeviceType;
use super::dialect::Dialect;
use super::error::Error;
use super::session::Session;

/// "Lock/unlock parameters: Firmware update" (CiA 814-1 clause 6.3). A device without sub-index 1
/// has it as a plain variable.
pub(crate) const UNLOCK: [Address; 2] =
    [Address::new(program::UNLOCK, program::UNLOCK_FIRMWARE), Address::new(program::UNLOCK, 0)];

/// Detects the dialect of a device from the device type and the objects of what runs on it. The
/// device type of a bootloader gives the dialect. Applications of lifts have the object for
/// unlocking. Another application with 1F57h belongs to a bootloader with block files. This is a
/// first guess: the bootloader gives more information when it runs.
///
/// # Errors
/// The errors of a [read](Session::read).
pub fn recognise(session: &mut Session<'_>, running: DeviceType, number: u8) -> Result<Dialect, Error> {
    if let Some(dialect) = Dialect::of_bootloader(running, session.node()) {
        return Ok(dialect);
    }
    if has(session, UNLOCK[0])? || has(session, UNLOCK[1])? {
        return Ok(Dialect::Lift);
    }
    if has(session, Address::new(program::FLASH_STATUS, number))? {
        return Ok(Dialect::Block);
    }
    Ok(Dialect::Raw)
}

/// Whether the object exists, readable or not.
fn has(session: &mut Session<'_>, at: Address) -> Result<bool, Error> {
    match session.read(at) {
        Ok(_) => Ok(true),
        Err(Error::Refused { code: AbortCode::NO_OBJECT | AbortCode::NO_SUB_INDEX, .. }) => Ok(false),
        Err(Error::Refused { .. }) => Ok(true),
        Err(error) => Err(error),
    }
}
