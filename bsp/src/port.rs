//! The port for frames.

/// The port for frames: the CAN controller, or the UART instead of it.
#[cfg(not(feature = "virtual-can"))]
pub type CanPort = crate::can::Port<crate::facts::CanController>;
/// The port for frames: the CAN controller, or the UART instead of it.
#[cfg(feature = "virtual-can")]
pub type CanPort = crate::virtual_can::Port;
