//! The debug probe, as an external program: probe-rs, or what the user names.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use shared_abi::layout::Layout;

use super::command;
use crate::Outcome;

/// The command line for probe-rs.
const PROBE_RS: &str = "probe-rs {action} --chip {chip} {elf}";
/// The time for a probe: 128 KiB at the slowest speed that is in use.
const LIMIT: Duration = Duration::from_secs(120);

/// A command line with placeholders.
pub struct Probe {
    words: Vec<String>,
    /// The chip's name.
    chip: String,
}

impl Probe {
    /// The probe of this command line, or probe-rs.
    pub fn new(line: Option<&str>, board: &Layout) -> Outcome<Self> {
        let words = command::words(line.unwrap_or(PROBE_RS))?;
        // probe-rs takes the beginning of a name: STM32F407VG is STM32F407VGTx.
        Ok(Self { words, chip: board.chip.chip.to_ascii_uppercase() })
    }

    /// Checks that the program exists.
    pub fn is_there(&self) -> Outcome {
        let program = &self.words[0];
        if command::is_there(program) {
            return Ok(());
        }
        let get = match program.as_str() {
            "probe-rs" => "Install it with `cargo install probe-rs-tools --locked`, or name",
            _ => "Correct",
        };
        Err(format!("the probe's program \"{program}\" is not there. {get} another one by --probe."))
    }

    /// Writes a file into the flash.
    pub fn download(&self, elf: &Path) -> Outcome {
        self.run("download", Some(elf))
    }

    /// Resets the board.
    pub fn reset(&self) -> Outcome {
        self.run("reset", None)
    }

    fn run(&self, action: &str, elf: Option<&Path>) -> Outcome {
        let words = self.line(action, elf);
        let mut probe = Command::new(&words[0]);
        command::succeed(probe.args(&words[1..]), LIMIT).map_err(|error| {
            format!("{error} Check that the probe is plugged in, and that the board has power.")
        })
    }

    /// The words of the command for an action.
    fn line(&self, action: &str, elf: Option<&Path>) -> Vec<String> {
        let elf = elf.map(|elf| elf.display().to_string());
        let words = self.words.iter().filter(|word| elf.is_some() || !word.contains("{elf}"));
        words
            .map(|word| {
                let word = word.replace("{action}", action).replace("{chip}", &self.chip);
                word.replace("{elf}", elf.as_deref().unwrap_or_default())
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::DEFAULT;

    use super::*;

    #[test]
    fn probe_rs_is_called_as_its_manual_says() {
        let probe = Probe::new(None, DEFAULT).unwrap();
        let words = probe.line("download", Some(Path::new("a b.elf")));
        assert_eq!(words, ["probe-rs", "download", "--chip", "STM32F407VG", "a b.elf"]);
        assert_eq!(probe.line("reset", None), ["probe-rs", "reset", "--chip", "STM32F407VG"]);
    }

    #[test]
    fn a_missing_probe_is_told_with_its_remedy() {
        let probe = Probe::new(Some("no-such-probe {elf}"), DEFAULT).unwrap();
        let problem = probe.is_there().unwrap_err();
        assert!(problem.contains("no-such-probe") && problem.contains("--probe"), "{problem}");
        assert!(Probe::new(Some("'x"), DEFAULT).is_err());
    }
}
