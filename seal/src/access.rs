//! Access to a sealed device (objects 2002h and 2003h): what needs the signature of a root, how it
//! is asked for, and what the device has recorded.

/// Rights, each a bit. They last until the next reset.
pub mod right {
    /// Erase a program at once (a second CLEAR), without another one that takes its place.
    pub const ERASE: u32 = 1 << 0;
    /// Take a program's release for autostart away (84h).
    pub const CLEAR_SIGNATURE: u32 = 1 << 1;
    /// Install one program whose security counter is the argument or higher.
    pub const LOWER_COUNTER: u32 = 1 << 2;
    /// Store node-ID and bit rate (LSS).
    pub const STORE: u32 = 1 << 3;
    /// Read programs back (1F50h).
    pub const READ_BACK: u32 = 1 << 4;
    /// Open the device for good: from the next reset on it takes and starts any program. Its keys
    /// stay, so that sealed images work as before; only a debug probe seals it again.
    pub const OPEN: u32 = 1 << 5;
}

/// Beside the granted rights in 2002h/1: the device has keys, so it takes sealed images alone.
pub const SEALED: u32 = 1 << 31;

/// What stands in front of the challenge in the signed message.
pub const DOMAIN: &[u8; 16] = b"coboot access 1\0";
/// Bytes of 2002h/1: the chip's unique ID (12), the nonce (32), the granted rights (u32).
pub const CHALLENGE: usize = 48;
/// Bytes of the challenge that are signed, behind [`DOMAIN`] and before the request: all but the
/// rights.
pub const SIGNED_CHALLENGE: usize = 44;
/// Bytes of a request that are signed: rights, argument and the id of the root's key (u32 each).
pub const SIGNED_REQUEST: usize = 12;
/// Bytes of 2002h/2: the request with its Ed25519 signature.
pub const REQUEST: usize = SIGNED_REQUEST + 64;

/// How many events a device remembers: 2003h/1 to 2003h/8.
pub const EVENTS: usize = 8;
/// An event is four words: its number (1 is the first of the device's life), what happened (a kind
/// in the upper half, its detail in the lower half), security counter and version of the image.
pub mod event {
    /// A sealed image was installed; the detail is the program's number.
    pub const INSTALLED: u32 = 1 << 16;
    /// A sealed image was refused; the detail is the error code of 1F57h. The same refusal again is
    /// not recorded.
    pub const REFUSED: u32 = 2 << 16;
    /// Rights were granted; the detail is which.
    pub const UNLOCKED: u32 = 3 << 16;
}
