//! A second SDO server, with COB-IDs that a client chooses (1201h; CiA 301 clause 7.5.2.33).
//!
//! It exists for group downloads: the client gives several nodes the same COB-ID for requests and
//! each node its own for answers. Then it sends data once, and all of them take it.
//!
//! Both servers share one transfer: a request to one of them ends a transfer of the other, as a
//! second client would.

use crate::abort::AbortCode;
use crate::frame::{Channel, CobId};
use crate::od::{Access, DataType, Entry};
use crate::program::SECOND_SERVER;

/// Sub-index of the COB-ID of requests.
pub const REQUEST: u8 = 1;
/// Sub-index of the COB-ID of answers.
pub const RESPONSE: u8 = 2;
/// The bit of a COB-ID that does not exist. (Bits 0 to 10 are the identifier; the others must be
/// 0.)
pub const INVALID: u32 = 1 << 31;

/// 1201h.
pub const ENTRIES: [Entry; 3] = [
    Entry::record(SECOND_SERVER, "SDO server parameter 2", RESPONSE),
    Entry::sub(SECOND_SERVER, REQUEST, "COB-ID client to server", DataType::Unsigned32, Access::Rw)
        .default(INVALID as u64),
    Entry::sub(SECOND_SERVER, RESPONSE, "COB-ID server to client", DataType::Unsigned32, Access::Rw)
        .default(INVALID as u64),
];

/// The values of 1201h.
#[derive(Clone, Copy, Debug)]
pub struct SecondServer([u32; 2]);

impl SecondServer {
    /// No second server, as after a reset.
    pub const NONE: Self = Self([INVALID; 2]);

    /// Its COB-IDs; none unless both are valid.
    #[must_use]
    pub fn channel(&self) -> Channel {
        let [request, response] = self.0;
        if (request | response) & INVALID != 0 {
            return Channel::NONE;
        }
        // `write` accepts no more than 11 bits.
        Channel { request: CobId::of_word(request), response: CobId::of_word(response) }
    }

    /// Reads sub-index 1 or 2.
    #[must_use]
    pub fn read(&self, sub: u8) -> u32 {
        self.0[usize::from(sub == RESPONSE)]
    }

    /// Writes sub-index 1 or 2.
    ///
    /// # Errors
    /// [`AbortCode::INVALID_VALUE`] for a COB-ID that no configurable object may use (CiA 301
    /// clause 7.3.5, restricted CAN-IDs), for the other one's (an answer would be a request to the
    /// group), and for another COB-ID while this one is valid.
    pub fn write(&mut self, sub: u8, value: u32) -> Result<(), AbortCode> {
        let [request, response] = &mut self.0;
        let (own, other) = if sub == RESPONSE { (response, request) } else { (request, response) };
        // The identifiers of PDOs of other nodes, and those between SDO and boot-up, which the
        // predefined connection set does not use.
        let usable = matches!(value, 0x181..=0x57F | 0x680..=0x6DF) && *own & INVALID != 0;
        if value != *own && value & INVALID == 0 && (!usable || value == *other) {
            return Err(AbortCode::INVALID_VALUE);
        }
        *own = value;
        Ok(())
    }
}
