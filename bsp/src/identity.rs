//! Who the device is.

use shared_abi::geometry::OTP;
use shared_abi::nameplate::{Nameplate, Words};

/// The device's identity in 1008h–100Ah and 1018h, for bootloader and application.
#[derive(Clone, Copy, Debug)]
pub struct Identity {
    /// 1018h/1, assigned by CiA; 0 for none.
    pub vendor_id: u32,
    /// 1018h/2.
    pub product_code: u32,
    /// 1018h/3: major in the upper half, minor in the lower.
    pub revision: u32,
    /// 1008h.
    pub device_name: &'static str,
    /// 1009h.
    pub hardware_version: &'static str,
}

/// The chip's 96-bit unique identifier (RM0090 section 39.1).
#[inline(always)]
fn unique_words() -> [u32; 3] {
    const UNIQUE_ID: *const [u32; 3] = 0x1FFF_7A10 as *const _;
    // SAFETY: the unique identifier is a read-only word-aligned part of every STM32F4.
    unsafe { UNIQUE_ID.read_volatile() }
}

/// The chip's 96-bit unique identifier (RM0090 section 39.1), with its bytes in the order of the
/// memory.
#[must_use]
pub fn unique_id() -> [u8; 12] {
    let mut bytes = [0; 12];
    for (bytes, word) in bytes.chunks_exact_mut(4).zip(unique_words()) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    bytes
}

/// Serial number of the device (1018h/4): a fold of the chip's unique identifier.
#[must_use]
pub fn serial_number() -> u32 {
    shared_abi::check_word(&unique_words())
}

/// The identity that the production line has written into the one-time programmable bytes of the chip; `None` if
/// there is none.
#[must_use]
pub fn nameplate() -> Option<Nameplate> {
    // SAFETY: these bytes are a word-aligned part of every STM32F4, and can be read at any time.
    unsafe { Nameplate::read(OTP.base as usize as *const Words) }
}
