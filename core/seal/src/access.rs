//! Access to a sealed device (objects 2002h and 2003h): the actions that need a root's signature,
//! the request for them, and the device's event log.

use crate::key_block::ROOT_COUNT;

/// Rights, each a bit. They last until the next reset.
pub mod right {
    /// Erase a program at once (a second CLEAR) without installing another one.
    pub const ERASE: u32 = 1 << 0;
    /// Withdraw a program's release for autostart (84h), and release such a program again (83h).
    pub const CLEAR_SIGNATURE: u32 = 1 << 1;
    /// Install one program with a security counter of at least the argument.
    pub const LOWER_COUNTER: u32 = 1 << 2;
    /// Store node-ID and bit rate (LSS).
    pub const STORE: u32 = 1 << 3;
    /// Read programs back (1F50h).
    pub const READ_BACK: u32 = 1 << 4;
    /// Open the device permanently: from the next reset on it accepts and starts any program. Its
    /// keys stay, so that sealed images still work; only a debug probe can seal it again.
    pub const OPEN: u32 = 1 << 5;
}

/// A flag beside the granted rights in 2002h/1: the device has keys, so it accepts only sealed
/// images.
pub const SEALED: u32 = 1 << 31;

/// The prefix of the challenge in the signed message.
pub const DOMAIN: &[u8; 16] = b"coboot access 1\0";
/// Bytes of 2002h/1: the chip's unique ID (12), the nonce (32), the granted rights (u32).
pub const CHALLENGE: usize = 48;
/// The signed bytes of the challenge, after [`DOMAIN`] and before the request: all but the rights.
pub const SIGNED_CHALLENGE: usize = 44;
/// The signed bytes of a request: rights, argument and the id of the root's key (u32 each).
pub const SIGNED_REQUEST: usize = 12;
/// Bytes of 2002h/2: the request with its Ed25519 signature.
pub const REQUEST: usize = SIGNED_REQUEST + 64;

/// Words of 2002h/3 before the counters: the ids of the root keys (0 for none), and the lowest epoch
/// that the device accepts. The lowest security counter of each program follows. All are as they were
/// at the last reset.
pub const FLOOR: usize = ROOT_COUNT + 1;

/// The number of events in the log: 2003h/1 to 2003h/8.
pub const EVENTS: usize = 8;
/// The number of these that may be refusals, which anybody can cause; a wrong signature
/// ([`Fault::Signature`](crate::wire::Fault::Signature)) is recorded beyond it.
pub const MOST_REFUSALS: usize = 3;
/// An event is four words: its number (1 is the first in the device's life), the kind in the upper
/// half and its detail in the lower half of a word, security counter and version of the image.
pub mod event {
    /// A sealed image was installed; the detail is the program's number. The installed image once
    /// more is not recorded.
    pub const INSTALLED: u32 = 1 << 16;
    /// A sealed image was refused; the detail is the error code of 1F57h. An error code that the log
    /// contains is not recorded again, and other refusals are limited
    /// ([`MOST_REFUSALS`](super::MOST_REFUSALS)).
    pub const REFUSED: u32 = 2 << 16;
    /// Rights were granted; the detail is the rights.
    pub const UNLOCKED: u32 = 3 << 16;
}
