//! The board that a user names: one that is built into the tool, or a file with its memory map.
//!
//! `cargo xtask build` and `cargo xtask layout --toml` write such a file. It must meet the same rules as the
//! compiled layouts of this repository.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use serde::Deserialize;
use shared_abi::geometry::{self, Geometry, Line, SectorRun};
use shared_abi::layout::toml::Circuit;
use shared_abi::layout::{self, Layout, BOARDS};

/// The largest size of such a file, in bytes.
pub const MAX: usize = 64 * 1024;

/// Why there is no board.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NamedError {
    /// No board that is built in has this name.
    #[error(
        "there is no board '{0}'; known boards: {boards}. For another one give the file with its memory map, \
         NAME.toml, as `cargo xtask layout --toml` writes it",
        boards = BOARDS.iter().map(|board| board.board).collect::<Vec<_>>().join(", ")
    )]
    Unknown(String),
    /// The file cannot be read, or has a mistake.
    #[error("{0}: {1}")]
    File(String, String),
}

/// Checks a word after `--board` without a look at the file that it may name.
///
/// # Errors
/// [`NamedError::Unknown`].
pub fn word(word: &str) -> Result<String, NamedError> {
    if is_file(word) {
        return Ok(word.to_owned());
    }
    named(word).map(|_| word.to_owned())
}

/// Whether a word names a file and no board: it has a dot or is a path, which no board's name has.
#[must_use]
pub fn is_file(word: &str) -> bool {
    word.contains(['.', '/', '\\'])
}

/// The word of a settings file, whose paths are relative to its folder.
#[must_use]
pub fn in_folder(word: &str, folder: &Path) -> String {
    if is_file(word) {
        folder.join(word).to_string_lossy().into_owned()
    } else {
        word.to_owned()
    }
}

/// The board of a word after `--board`: its name, or the path of a file with its memory map.
///
/// # Errors
/// [`NamedError`]: no such board, or what is wrong with the file.
pub fn named(word: &str) -> Result<&'static Layout, NamedError> {
    described(word).map(|(layout, _)| layout)
}

/// The same with the circuit around the chip, which only a file has, and not each.
///
/// # Errors
/// As [`named`].
pub fn described(word: &str) -> Result<(&'static Layout, Option<Circuit>), NamedError> {
    if !is_file(word) {
        let layout = layout::by_name(word).ok_or_else(|| NamedError::Unknown(word.to_owned()));
        return layout.map(|layout| (layout, None));
    }
    let unreadable = |error: &dyn std::fmt::Display| NamedError::File(word.to_owned(), error.to_string());
    let mut bytes = Vec::new();
    // It may be a pipe, which may never end.
    File::open(Path::new(word))
        .and_then(|file| file.take(MAX as u64 + 1).read_to_end(&mut bytes))
        .map_err(|error| unreadable(&error))?;
    parse_all(&String::from_utf8_lossy(&bytes)).map_err(|error| unreadable(&error))
}

/// An error in a memory map.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BoardError {
    /// The file is not TOML, or an entry is missing or invalid. The number is that of the line.
    #[error("line {0}: {1}")]
    Syntax(usize, String),
    /// The memory map breaks this rule.
    #[error("{0}")]
    Rule(&'static str),
}

#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct Region {
    base: u32,
    size: u32,
}

impl From<Region> for geometry::Region {
    fn from(Region { base, size }: Region) -> Self {
        Self::new(base, size)
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Map {
    board: String,
    bootloader: Region,
    callgate_offset: u32,
    home: Option<Region>,
    parameters: [Region; 2],
    data: Option<Region>,
    programs: Vec<Region>,
    staging: Option<Region>,
    ram: Region,
    handoff: Region,
    warm_start: Region,
    chip: Chip,
    circuit: Option<Around>,
}

/// [`Circuit`] in a file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Around {
    crystal: u32,
    can: u8,
    usart: String,
    pulled_up: Option<String>,
}

impl Around {
    fn checked(self) -> Result<Circuit, BoardError> {
        let pin = |word: &str| {
            let word = word.strip_prefix('P')?;
            let port = word.chars().next().filter(|port| ('A'..='K').contains(port))?;
            Some((port, word[1..].parse().ok().filter(|pin| *pin < 16)?))
        };
        let pulled_up = self.pulled_up.map(|word| pin(&word).ok_or(BoardError::Rule("a pin is PA0 to PK15")));
        if !(1..=2).contains(&self.can) || !(1_000_000..=50_000_000).contains(&self.crystal) {
            return Err(BoardError::Rule(
                "a circuit has a crystal of 1 to 50 MHz, and CAN controller 1 or 2",
            ));
        }
        let (crystal, can, usart) = (self.crystal, self.can, name(self.usart)?);
        Ok(Circuit { crystal, can, usart, pulled_up: pulled_up.transpose()? })
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Chip {
    name: String,
    flash: Region,
    sectors: Vec<Sectors>,
    second_bank: Option<u8>,
    sram: Region,
    ccm: Region,
    interrupts: u16,
    ports: u8,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Sectors {
    count: u8,
    size: u32,
}

/// Parses and checks a memory map. The result lives as long as the program.
///
/// # Errors
/// [`BoardError`]: the line that cannot be read, or the rule that is broken.
pub fn parse(text: &str) -> Result<&'static Layout, BoardError> {
    parse_all(text).map(|(layout, _)| layout)
}

fn parse_all(text: &str) -> Result<(&'static Layout, Option<Circuit>), BoardError> {
    if text.len() > MAX {
        return Err(BoardError::Rule("a memory map has 64 KiB at most; this is another file"));
    }
    let file: Map = toml::from_str(text).map_err(|error| {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        // The message may quote the file.
        let message = error.message().replace(char::is_control, " ");
        BoardError::Syntax(1 + before.matches('\n').count(), message)
    })?;
    let runs: Vec<SectorRun> =
        file.chip.sectors.iter().map(|run| SectorRun { count: run.count, size: run.size }).collect();
    let programs: Vec<geometry::Region> = file.programs.into_iter().map(Into::into).collect();
    // A layout refers to static data. A command loads one board of some hundred bytes, so the leak
    // is harmless.
    let chip = name(file.chip.name)?;
    let line = Line::of(chip).ok_or(BoardError::Rule(
        "the chip's name begins with that of no STM32F4 with a CAN controller of the kind bxCAN",
    ))?;
    let chip: &'static Geometry = Box::leak(Box::new(Geometry {
        chip,
        line,
        flash: file.chip.flash.into(),
        sectors: runs.leak(),
        second_bank: file.chip.second_bank,
        sram: file.chip.sram.into(),
        ccm: file.chip.ccm.into(),
        interrupts: file.chip.interrupts,
        ports: file.chip.ports,
    }));
    let layout = Layout {
        board: name(file.board)?,
        chip,
        bootloader: file.bootloader.into(),
        callgate_offset: file.callgate_offset,
        home: file.home.map(Into::into),
        parameters: file.parameters.map(Into::into),
        data: file.data.map(Into::into),
        programs: programs.leak(),
        staging: file.staging.map(Into::into),
        ram: file.ram.into(),
        handoff: file.handoff.into(),
        warm_start: file.warm_start.into(),
    };
    chip.check().and_then(|()| layout.check()).map_err(BoardError::Rule)?;
    Ok((Box::leak(Box::new(layout)), file.circuit.map(Around::checked).transpose()?))
}

/// Checks that a name is printable.
fn name(text: String) -> Result<&'static str, BoardError> {
    let good = (1..=64).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic());
    if good {
        Ok(text.leak())
    } else {
        Err(BoardError::Rule("a name has 1 to 64 printable ASCII characters and no blanks"))
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::toml::Toml;
    use shared_abi::layout::{stm32f429i_disc1, BOARDS};

    use super::*;

    #[test]
    fn every_board_comes_back_as_it_was_written() {
        for board in BOARDS {
            assert_eq!(parse(&Toml(board).to_string()), Ok(*board), "{}", board.board);
        }
        let circuit = Circuit { crystal: 25_000_000, can: 2, usart: "USART1", pulled_up: Some(('C', 13)) };
        let own = |circuit: Circuit| format!("{}{circuit}", Toml(&stm32f429i_disc1::LAYOUT));
        for circuit in [circuit, Circuit { pulled_up: None, ..circuit }] {
            assert_eq!(parse_all(&own(circuit)), Ok((&stm32f429i_disc1::LAYOUT, Some(circuit))));
        }
        for (crystal, can, pin) in [(0, 1, ('A', 0)), (8_000_000, 3, ('A', 0)), (8_000_000, 1, ('A', 16))] {
            let wrong = Circuit { crystal, can, pulled_up: Some(pin), ..circuit };
            assert!(matches!(parse_all(&own(wrong)), Err(BoardError::Rule(_))), "{wrong:?}");
        }
    }

    #[test]
    fn a_map_that_breaks_a_rule_is_refused_with_its_words() {
        let good = Toml(&stm32f429i_disc1::LAYOUT).to_string();
        for (from, to, words) in [
            (
                "programs = [\n  { base = 0x08020000",
                "programs = [\n  { base = 0x0801c000",
                "a program must start and end at sector borders",
            ),
            (
                "programs = [\n  { base = 0x08020000, size = 0x1e0000 },",
                "programs = [",
                "there must be 1 to 254 programs",
            ),
            (
                "bootloader = { base = 0x08000000",
                "bootloader = { base = 0xffffff00",
                "over the end of the address space",
            ),
            (
                "bootloader = { base = 0x08000000",
                "bootloader = { base = 0x08004000",
                "must start at the base of the flash",
            ),
            (
                "callgate-offset = 0x40",
                "callgate-offset = 0xfffffff0",
                "the callgate lies outside the bootloader",
            ),
            ("callgate-offset = 0x40", "callgate-offset = 0x3c", "overlaps the bootloader's vector table"),
            (
                "handoff = { base = 0x2002ffc0",
                "handoff = { base = 0x2002ff00",
                "inside the RAM of the images",
            ),
            ("count = 7", "count = 8", "no STM32F4 has more than 24 sectors"),
            ("size = 0x20000 }", "size = 0x20001 }", "16, 64 or 128 KiB"),
            ("second-bank = 12", "second-bank = 11", "8 or 12 sectors each"),
            ("name = \"stm32f429zi\"", "name = \"stm32f411re\"", "no STM32F4 with a CAN controller"),
            ("interrupts = 91", "interrupts = 65535", "112 interrupt lines"),
            ("sram = { base = 0x20000000", "sram = { base = 0x20000004", "whole pages of 4 KiB"),
            ("board = \"stm32f429i-disc1\"", "board = \"a\\u001bb\"", "printable ASCII"),
            ("callgate-offset = 0x40", "callgate-offset = -1", "line 4: "),
            (
                "home = { base = 0x08010000",
                "home = { base = 0x0800c000",
                "the home of the RAM image must start",
            ),
            (
                "data = { base = 0x0800c000",
                "data = { base = 0x08008000",
                "the data region overlaps a parameter",
            ),
            (
                "data = {",
                "staging = { base = 0x08020000, size = 0x1e0000 }\ndata = {",
                "the staging region must be the last sector",
            ),
            ("ports = 11", "ports = 11\nspeed = 5", "speed"),
            ("[chip]", "[chap]", "chap"),
        ] {
            let text = good.replacen(from, to, 1);
            assert_ne!(text, good, "{from}");
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.contains(words), "{to}: {error}");
        }
        assert!(parse("").is_err() && parse("board = [").is_err());
        let quoted = parse("\"\\u001b[2J\" = 1").unwrap_err().to_string();
        assert!(quoted.starts_with("line 1: ") && !quoted.contains(char::is_control), "{quoted:?}");
        assert!(parse(&" ".repeat(MAX + 1)).unwrap_err().to_string().contains("64 KiB at most"));
    }

    #[test]
    fn a_board_is_named_or_a_file() {
        let own = Toml(&stm32f429i_disc1::LAYOUT).to_string().replace("stm32f429i-disc1", "my-board");
        let path = std::env::temp_dir().join(format!("coboot-board-{}.toml", std::process::id()));
        let word = path.to_str().unwrap();
        std::fs::write(&path, &own).unwrap();
        assert_eq!(named(word).unwrap().board, "my-board");
        assert_eq!(named("stm32f429i-disc1"), Ok(&stm32f429i_disc1::LAYOUT));
        std::fs::write(&path, own.replace("[chip]", "[chap]")).unwrap();
        let wrong = named(word).unwrap_err().to_string();
        assert!(wrong.starts_with(word) && wrong.contains(": line "), "{wrong}");
        std::fs::remove_file(&path).unwrap();
        for (word, says) in [
            ("arduino", "there is no board 'arduino'; known boards: nucleo-f446re, stm32f407g-disc1"),
            ("none.toml", "none.toml: "),
            ("/", "/: "),
            ("", "there is no board ''"),
        ] {
            let said = named(word).unwrap_err().to_string();
            assert!(said.starts_with(says), "{word}: {said}");
        }
        #[cfg(unix)]
        assert!(named("/dev/zero").unwrap_err().to_string().contains("64 KiB at most"));
    }
}
