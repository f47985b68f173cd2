//! Where the clocks come from. The register level is for code that must be small and must be able to
//! restore the reset state. An application uses the HAL's way, [`crate::clocks`].

pub use shared_abi::clock_tree::{ClockTree, HSI};

/// The input of the PLL.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// The internal oscillator (HSI): it needs no start-up time, and is exact to 4 % from -10 to 85 °C
    /// (DS8626 table 41), which is too little for CAN.
    Internal,
    /// The crystal: it is exact, and needs some milliseconds to start.
    Crystal,
}
