//! The set-up of a machine.

use crate::circuit::Circuit;
use crate::periph::flash::FlashTimes;
use crate::silicon::{self, Silicon};
use crate::supply;

/// How a machine is set up.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// Chooses what RAM holds at power-on, and how a power failure tears a flash operation.
    pub seed: u64,
    /// Crystal at OSC_IN, in Hz; 0 for none.
    pub hse_hz: u32,
    /// Which of the datasheet's times flash operations take.
    pub flash_times: FlashTimes,
    /// The 96-bit unique ID.
    pub unique_id: [u32; 3],
    /// The CAN controller whose pins the board's transceiver is at: 0 is CAN1, 1 is CAN2. The other
    /// one hears a recessive line.
    pub transceiver: usize,
    /// Whether code costs what the manuals say (loads, branches, fetches from flash and SRAM) or a cycle
    /// for each instruction.
    pub costs: bool,
    /// What the manuals leave open: the values of this chip.
    pub silicon: Silicon,
    /// VDD at power-on, in mV.
    pub vdd_mv: u32,
    /// What the board has at the pins.
    pub circuit: Circuit,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            seed: 1,
            hse_hz: 8_000_000,
            flash_times: FlashTimes::Typical,
            unique_id: [0x0034_0025, 0x3137_470C, 0x3338_3235],
            transceiver: 0,
            costs: false,
            silicon: silicon::TYPICAL,
            vdd_mv: supply::NOMINAL,
            circuit: Circuit::default(),
        }
    }
}
