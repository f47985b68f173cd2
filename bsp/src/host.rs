//! What the functions of a product and of a board use of the chip. On the host they are compiled, and never called: the
//! tables of a product are made there (`cargo xtask eds`).

/// See the driver: the levels of the 16 pins of a port.
#[must_use]
pub fn inputs(_port: char) -> u16 {
    0
}

/// See the driver: an output of a board's functions.
pub fn drive(_pin: shared_abi::geometry::Pin, _high: bool) {}

/// See the driver: the other level of an output.
pub fn toggle(_pin: shared_abi::geometry::Pin) {}

/// The count of the system timer.
#[must_use]
pub fn cycles() -> u32 {
    0
}
