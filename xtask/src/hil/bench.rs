//! What the steps work with, and how they end.

use std::path::PathBuf;
use std::time::Duration;

use serde_json::Value;
use shared_abi::layout::Layout;

use super::coflash::Coflash;
use super::command::CommandLine;
use crate::Outcome;

/// The time for a probe: 128 KiB at the slowest speed that is in use.
const PROBE: Duration = Duration::from_secs(120);
/// The time for a relay.
const RELAY: Duration = Duration::from_secs(30);
/// The time without power: the capacitors of the board empty themselves.
const DARK: Duration = Duration::from_secs(1);

/// What the steps work with: a board with everything that reaches it.
pub struct Bench {
    pub board: &'static Layout,
    pub probe: CommandLine,
    pub power: Option<CommandLine>,
    pub coflash: Coflash,
    /// The folder of the board's images.
    pub images: PathBuf,
    /// The folder for files that the steps make.
    pub work: PathBuf,
    /// The CRC of the last program that went into the device to its end, as text.
    pub installed: Option<String>,
    /// The document that `coflash conform` wrote.
    pub conform: Option<Value>,
}

impl Bench {
    /// Lets the probe write a file into the flash, or with no file reset the board.
    pub fn probe(&self, action: &str, elf: &str) -> Outcome {
        // probe-rs takes the beginning of a name: STM32F407VG is STM32F407VGTx.
        let chip = self.board.chip.chip.to_ascii_uppercase();
        let values = [("{action}", action), ("{chip}", &chip), ("{elf}", elf)];
        self.probe.run(&values, PROBE).map_err(|error| {
            format!("{error} Check that the probe is plugged in, and that the board has power.")
        })
    }

    /// Switches the power off and on again, or resets the board if there is no relay; returns which.
    pub fn restart(&self) -> Outcome<&'static str> {
        let Some(power) = &self.power else {
            return self.probe("reset", "").map(|()| "reset by the probe");
        };
        switch(power, "off")?;
        std::thread::sleep(DARK);
        switch(power, "on").map(|()| "power")
    }
}

/// Switches the supply `on` or `off`.
pub fn switch(power: &CommandLine, state: &str) -> Outcome {
    power.run(&[("{state}", state)], RELAY).map_err(|error| {
        format!("the power cannot be switched {state}: {error} Try the command by hand with {state}.")
    })
}

/// How a step ended that has not failed: with a detail, or why it was not done.
pub enum Done {
    Passed(String),
    LeftOut(String),
}
