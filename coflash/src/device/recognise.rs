//! Which dialect a device speaks.

use canopen::{program, AbortCode, Address};

use super::device_type::DeviceType;
use super::dialect::Dialect;
use super::error::Error;
use super::session::Session;

/// "Lock/unlock parameters: Firmware update" (CiA 814-1 clause 6.3). Where it has no sub-index 1,
/// it is a plain variable.
pub(crate) const UNLOCK: [Address; 2] =
    [Address::new(program::UNLOCK, program::UNLOCK_FIRMWARE), Address::new(program::UNLOCK, 0)];

/// Finds out which dialect a device speaks of which this is running. A bootloader tells it by its
/// device type. Of an application it is known for lifts; of the others, whether they belong to a
/// bootloader with the status of 1F57h, which tells more when it runs.
///
/// # Errors
/// What a [read](Session::read) has.
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

/// Whether there is such an object, readable or not.
fn has(session: &mut Session<'_>, at: Address) -> Result<bool, Error> {
    match session.read(at) {
        Ok(_) => Ok(true),
        Err(Error::Refused { code: AbortCode::NO_OBJECT | AbortCode::NO_SUB_INDEX, .. }) => Ok(false),
        Err(Error::Refused { .. }) => Ok(true),
        Err(error) => Err(error),
    }
}
