//! What the steps work with, and how they end.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Duration;

use serde_json::Value;
use shared_abi::layout::Layout;

use super::coflash::Coflash;
use super::command::CommandLine;
use crate::outcome::Outcome;

/// The time for a probe: 128 KiB at the slowest speed that is in use.
const PROBE: Duration = Duration::from_secs(120);
/// The time for a relay.
const RELAY: Duration = Duration::from_secs(30);
/// The time without power: the capacitors of the board empty themselves.
const DARK: Duration = Duration::from_secs(1);

/// What a command of the user switches on and off, or a person where there is no command.
#[derive(Clone, Copy)]
pub enum Hand {
    Power,
    Strap,
    Short,
    Crystal,
}

/// The options of the hands, and what a person is asked for.
pub const HANDS: [(&str, &str, &str); 4] = [
    ("--power-command", "", ""),
    ("--strap-command", "Hold the entry strap", "Release the entry strap"),
    ("--short-command", "Short CAN_H and CAN_L", "Remove the short"),
    ("--crystal-command", "Short OSC_IN to ground", "Remove the short at OSC_IN"),
];

/// What the steps work with: a board with everything that reaches it.
pub struct Bench {
    pub board: &'static Layout,
    pub probe: CommandLine,
    /// The commands, in the order of [`HANDS`].
    pub hands: [Option<CommandLine>; 4],
    /// The line of --power-command, for `coflash more conform`.
    pub power_line: Option<String>,
    pub coflash: Coflash,
    /// The bootloader, and the folder of the board's other images.
    pub bootloader: String,
    pub images: PathBuf,
    /// The folder for files that the steps make.
    pub work: PathBuf,
    /// The CRC of the last program that went into the device to its end, as text.
    pub installed: Option<String>,
    /// The documents that `coflash more conform` wrote.
    pub conform: Vec<Value>,
}

impl Bench {
    /// The path of an image of the board.
    pub fn image(&self, name: &str) -> String {
        self.images.join(name).display().to_string()
    }

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
        if self.hands[Hand::Power as usize].is_none() {
            return self.probe("reset", "").map(|()| "reset by the probe");
        }
        self.hand(Hand::Power, false)?;
        std::thread::sleep(DARK);
        self.hand(Hand::Power, true).map(|_| "power")
    }

    /// Switches something by the user's command, or by a person at the terminal; whether one of them is
    /// there.
    pub fn hand(&self, hand: Hand, on: bool) -> Outcome<bool> {
        let (option, do_it, undo_it) = HANDS[hand as usize];
        let state = if on { "on" } else { "off" };
        if let Some(command) = &self.hands[hand as usize] {
            return command.run(&[("{state}", state)], RELAY).map(|()| true).map_err(|error| {
                format!(
                    "{option}: it cannot be switched {state}: {error} Try the command by hand with {state}."
                )
            });
        }
        if !std::io::stdin().is_terminal() {
            return Ok(false);
        }
        println!(
            "{}, then press Enter; `s` and Enter leaves the step out.",
            if on { do_it } else { undo_it }
        );
        let mut line = String::new();
        std::io::stdin().read_line(&mut line).map_err(|error| error.to_string())?;
        Ok(line.trim() != "s")
    }
}

/// How a step ended that has not failed: with a detail, or why it was not run.
pub enum Done {
    Passed(String),
    NotRun(String),
}
