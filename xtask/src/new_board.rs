//! `cargo xtask new-board`: lays down the files of a port, two and a header for programs in C, and
//! registers them.

use std::fs;
use std::path::Path;

use shared_abi::geometry::{Geometry, CHIPS};
use shared_abi::layout;

use crate::args::Args;
use crate::{workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask new-board NAME --chip CHIP [--from BOARD]

Lays down the two files of a port, and the header with the same numbers for the application in C, with numbered
steps to go through, and registers the board in the crates that have to know of it. docs/porting.md goes on
from there.

  NAME            of the board, as it will be given to --board: small letters, digits and hyphens
  --chip CHIP     its chip, of those in shared-abi/src/geometry.rs, as it is ordered: STM32F407VGT6
  --from BOARD    the board whose pins and clocks stand there at first (default: stm32f407g-disc1)
";

pub fn run(mut args: Args) -> Outcome {
    let chip = args.value("--chip")?.ok_or("--chip is needed: which chip is on the board?")?;
    let from = args.value("--from")?.unwrap_or_else(|| workspace::DEFAULT_BOARD.to_owned());
    let mut words = args.rest().into_iter();
    let (Some(name), None) = (words.next(), words.next()) else {
        return Err("one NAME is needed, and nothing else; --help tells more.".into());
    };
    let chip = chip_by_name(&chip)?;
    if layout::by_name(&name).is_some() {
        return Err(format!("there is a board \"{name}\" already; choose another name."));
    }
    let root = workspace::root();
    // All or nothing: what cannot be done is found before the first file is written.
    let changes = changes(&name, chip, &from, &|path| {
        fs::read_to_string(root.join(path)).map_err(|error| format!("{path} cannot be read: {error}."))
    })?;
    for change in changes.iter().filter(|change| change.is_new) {
        if root.join(&change.path).exists() {
            return Err(format!("{} is there already; remove it, or choose another name.", change.path));
        }
    }
    for Change { path, text, is_new } in &changes {
        write(&root.join(path), text)?;
        println!("  {} {path}", if *is_new { "new     " } else { "changed " });
    }
    println!(
        "\nNow go through the steps in the new files; docs/porting.md tells which test proves each.\n\
         Then: cargo xtask build --board {name} && cargo xtask test --board {name} --test main_job"
    );
    Ok(())
}

fn write(path: &Path, text: &str) -> Outcome {
    fs::write(path, text).map_err(|error| format!("{} cannot be written: {error}.", workspace::shown(path)))
}

fn chip_by_name(name: &str) -> Outcome<&'static Geometry> {
    const WITHOUT_CAN: [&str; 3] = ["stm32f401", "stm32f410", "stm32f411"];
    CHIPS.iter().copied().find(|chip| chip.is_named(name)).ok_or_else(|| {
        let line = name.get(..9).unwrap_or(name).to_ascii_lowercase();
        if WITHOUT_CAN.contains(&&*line) {
            return format!("an {} has no CAN controller.", line.to_ascii_uppercase());
        }
        let known: Vec<_> = CHIPS.iter().map(|chip| chip.chip).collect();
        format!(
            "no chip \"{name}\" is known; there is: {}. Another one starts in shared-abi/src/geometry.rs, with the \
             tables of its reference manual.",
            known.join(", ")
        )
    })
}

/// A file as it is to be.
struct Change {
    path: String,
    text: String,
    is_new: bool,
}

/// All that makes a board; `read` gives a file of the repository.
fn changes(
    name: &str,
    chip: &Geometry,
    from: &str,
    read: &dyn Fn(&str) -> Outcome<String>,
) -> Outcome<Vec<Change>> {
    let good = name.starts_with(|c: char| c.is_ascii_lowercase())
        && !name.ends_with('-')
        && !name.contains("--")
        && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-');
    if !good {
        return Err(format!(
            "\"{name}\" is no name for a board: small letters, digits and single hyphens, a letter first."
        ));
    }
    let module = name.replace('-', "_");
    let from_module = from.replace('-', "_");
    let board_file = read(&format!("bsp/src/{from_module}.rs")).map_err(|error| {
        format!("--from {from}: {error} Name a board that has a file of its own in bsp/src.")
    })?;

    let c_header = read(&format!("app-c/boards/{from}.h"))?;

    let mut changes = Vec::new();
    let mut change = |path: &str, edit: &dyn Fn(&str) -> Option<String>| {
        let text = edit(&read(path)?)
            .ok_or_else(|| format!("{path} does not look as expected: the board must be put in by hand."))?;
        changes.push(Change { path: path.to_owned(), text, is_new: false });
        Ok::<_, String>(())
    };
    change("shared-abi/src/layout.rs", &|text| {
        let text = after_last(text, "pub mod ", &format!("pub mod {module};\n"))?;
        before(&text, "pub const BOARDS", "];", &format!("    &{module}::LAYOUT,\n"))
    })?;
    for package in ["bootloader", "app-template", "tests"] {
        change(&format!("{package}/Cargo.toml"), &|text| {
            after_last(text, "board-", &format!("board-{name} = [\"bsp/board-{name}\"]\n"))
        })?;
    }
    let line = chip.chip.get(..9).unwrap_or(chip.chip);
    change("bsp/Cargo.toml", &|text| {
        after_last(text, "board-", &format!("board-{name} = [\"stm32f4xx-hal/{line}\"]\n"))
    })?;
    change("bsp/src/lib.rs", &|text| {
        let module = format!("#[cfg(feature = \"board-{name}\")]\n#[path = \"{module}.rs\"]\nmod board;\n\n");
        before(text, "mod board;", "pub use board::*;", &module)
    })?;
    change("emulator/src/bin/emulate/main.rs", &|text| {
        let constant = constant(chip);
        let line = format!(
            "    Board {{ name: \"{name}\", chip: &{constant}, hse_hz: 8_000_000, pulled_up: &[], usart: \"USART2\", transceiver: 0 }},\n"
        );
        before(text, "const BOARDS", "];", &line)
    })?;
    for (path, text) in [
        (format!("shared-abi/src/layout/{module}.rs"), layout_file(name, chip)),
        (format!("bsp/src/{module}.rs"), with_steps(&board_file, name, from, &module)?),
        (format!("app-c/boards/{name}.h"), c_with_steps(&c_header, name, from)?),
    ] {
        changes.push(Change { path, text, is_new: true });
    }
    Ok(changes)
}

/// Puts `new` behind the last line that begins with `prefix`.
fn after_last(text: &str, prefix: &str, new: &str) -> Option<String> {
    let mut at = 0;
    let mut found = None;
    for line in text.split_inclusive('\n') {
        at += line.len();
        if line.starts_with(prefix) {
            found = Some(at);
        }
    }
    found.map(|at| format!("{}{new}{}", &text[..at], &text[at..]))
}

/// Puts `new` before the line that begins with `line`, the first one behind `anchor`.
fn before(text: &str, anchor: &str, line: &str, new: &str) -> Option<String> {
    let anchor = text.find(anchor)?;
    let at = anchor + text[anchor..].find(&format!("\n{line}"))? + 1;
    Some(format!("{}{new}{}", &text[..at], &text[at..]))
}

/// What the chip's geometry is called in `shared_abi::geometry`.
fn constant(chip: &Geometry) -> String {
    chip.chip.to_uppercase()
}

/// A map that fits the chip: the smallest sectors for bootloader and parameters, all the rest for
/// one program.
fn layout_file(name: &str, chip: &Geometry) -> String {
    let address = |value: u32| format!("0x{:04X}_{:04X}", value >> 16, value & 0xFFFF);
    let flash = chip.flash.base;
    let (program, ram_end) = (flash + 64 * 1024, chip.sram.end());
    let constant = constant(chip);
    format!(
        "//! {name} ({constant}: {} KiB flash, {} KiB SRAM).

use super::Layout;
use crate::geometry::{{Region, {constant}}};

/// The memory map of the {name}.
pub const LAYOUT: Layout = Layout {{
    board: \"{name}\",
    chip: &{constant},
    // Step 1: the bootloader. 32 KiB are two sectors of 16 KiB on every chip of the family.
    bootloader: Region::new({}, 32 * 1024),
    callgate_offset: 0x40,
    // Step 2: the two homes of the parameters, a sector each.
    parameters: [Region::new({}, 16 * 1024), Region::new({}, 16 * 1024)],
    // Step 3: the programs, whole sectors each. One has all that is left.
    programs: &[Region::new({}, {} * 1024)],
    // Step 4: the RAM; the last 64 bytes of the chip's are for handoff and warm-start cell.
    ram: Region::new({}, {} * 1024 - 64),
    handoff: Region::new({}, 48),
    warm_start: Region::new({}, 16),
}}
.checked();
",
        chip.flash.size / 1024,
        chip.sram.size / 1024,
        address(flash),
        address(flash + 0x8000),
        address(flash + 0xC000),
        address(program),
        (chip.flash.end() - program) / 1024,
        address(chip.sram.base),
        chip.sram.size / 1024,
        address(ram_end - 64),
        address(ram_end - 16),
    )
}

/// What stands in a board file, and the step that it belongs to.
const STEPS: &[(&str, &str)] = &[
    ("pub const IDENTITY", "Step 5: what the device says of itself. The product code tells your product from others."),
    ("pub const NODE_ID", "Step 6: the node-ID of a new device."),
    ("pub const BIT_RATE", "Step 7: the bit rate of a new device. The build fails if the clock below cannot make it."),
    ("pub const CLOCK_TREE", "Step 8: crystal (or a clock, with hse_bypass) and PLL. APB1 at 40 MHz makes each bit rate of CiA 301."),
    ("pub const ENTRY_STRAP", "Step 9: the pin that keeps the device in the bootloader, and the level that does."),
    ("    pub type Led", "Step 10: the LED: its pin here and in `init`."),
    ("    uart! {", "Step 11: the UART for words while you port: which it is here, its pins in `init`, where each port is taken once."),
    ("        let can = can", "Step 12: the CAN pins, transmit and receive. The build fails for pins that the chip cannot use for its controller. CAN2 in the place of CAN1: docs/porting.md."),
];

/// What stands in a board's header for C, and the step that it belongs to.
const C_STEPS: &[(&str, &str)] = &[
    ("#define CAN_PORT", "Step 12: the CAN pins of step 11."),
    ("#define LED_PORT", "Step 13: the LED of step 10."),
    ("#define HSE_HZ", "Step 14: the crystal of step 8."),
    ("#define VENDOR_ID", "Step 15: what the device says of itself, as in step 5."),
];

/// The header of another board for C, with the steps as comments in the place of its own.
fn c_with_steps(source: &str, name: &str, from: &str) -> Outcome<String> {
    let mut text = format!(
        "/* {name}. Begun as a copy of {from}: go through the steps, and take their comments out. */\n"
    );
    let mut steps = 0;
    for line in source.lines().filter(|line| line.starts_with("#define ")) {
        if let Some((_, step)) = C_STEPS.iter().find(|(what, _)| line.starts_with(what)) {
            text += &format!("/* {step} */\n");
            steps += 1;
        }
        text += line;
        text.push('\n');
    }
    if steps == C_STEPS.len() {
        Ok(text)
    } else {
        Err(format!("app-c/boards/{from}.h does not look as expected; take another board with --from."))
    }
}

/// A board file copied from another board's, with the steps as comments in front of what they are
/// about.
fn with_steps(source: &str, name: &str, from: &str, module: &str) -> Outcome<String> {
    let mut text = String::new();
    let mut steps = 0;
    let (mut in_layout, mut in_header) = (false, true);
    for line in source.lines() {
        if in_header && line.starts_with("//!") {
            continue;
        }
        if in_header {
            in_header = false;
            text += &format!(
                "//! {name}. Begun as a copy of {from}: go through the steps, and take their comments out.\n"
            );
        }
        if line.starts_with("pub const LAYOUT") {
            text += &format!("pub const LAYOUT: &Layout = &layout::{module}::LAYOUT;\n");
            in_layout = !line.ends_with(';');
            continue;
        }
        if in_layout {
            in_layout = !line.ends_with("};");
            continue;
        }
        if let Some((_, step)) = STEPS.iter().find(|(what, _)| line.starts_with(what)) {
            let indent = &line[..line.len() - line.trim_start().len()];
            text += &format!("{indent}// {step}\n");
            steps += 1;
        }
        text += line;
        text.push('\n');
    }
    if steps == STEPS.len() {
        Ok(text)
    } else {
        Err(format!(
            "bsp/src/{}.rs does not look as expected; take another board with --from.",
            from.replace('-', "_")
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared_abi::geometry::{STM32F429ZI, STM32F446RE};

    #[test]
    fn chips_are_named_as_people_write_them() {
        for name in ["stm32f429zi", "STM32F429ZI", "STM32F429ZIT6", "stm32f429zit6tr", "STM32F429ZIY7"] {
            assert_eq!(chip_by_name(name), Ok(&STM32F429ZI), "{name}");
        }
        for name in
            ["", "stm32f429z", "stm32f429zit", "stm32f429zi6t", "stm32f429zit6 x", "stm32f429zi\u{e9}6"]
        {
            assert!(chip_by_name(name).unwrap_err().contains("is known"), "{name}");
        }
        for name in ["STM32F401RE", "stm32f411ceu6"] {
            assert!(chip_by_name(name).unwrap_err().contains("has no CAN controller"), "{name}");
        }
    }

    fn read(path: &str) -> Outcome<String> {
        fs::read_to_string(workspace::root().join(path)).map_err(|error| error.to_string())
    }

    #[test]
    fn new_files_and_the_board_where_boards_are_listed() {
        for from in ["stm32f407g-disc1", "nucleo-f446re", "stm32f429i-disc1"] {
            let changes = changes("my-board", &STM32F446RE, from, &read).unwrap();
            let new: Vec<_> =
                changes.iter().filter(|change| change.is_new).map(|change| &*change.path).collect();
            let expected =
                ["shared-abi/src/layout/my_board.rs", "bsp/src/my_board.rs", "app-c/boards/my-board.h"];
            assert_eq!(new, expected);
            assert_eq!(changes.len(), 10);
            for change in &changes {
                assert!(
                    change.text.contains("my-board") || change.text.contains("my_board"),
                    "{}",
                    change.path
                );
            }
            let board = &changes[8].text;
            for step in 5..=12 {
                assert_eq!(
                    board.matches(&format!("// Step {step}: ")).count(),
                    1,
                    "step {step}, from {from}"
                );
            }
            let header = &changes[9].text;
            for step in 12..=15 {
                assert_eq!(
                    header.matches(&format!("/* Step {step}: ")).count(),
                    1,
                    "step {step}, from {from}"
                );
            }
            assert!(
                header.lines().all(|line| line.starts_with("/* ") || line.starts_with("#define ")),
                "{header}"
            );
            assert!(board.contains("pub const LAYOUT: &Layout = &layout::my_board::LAYOUT;\n"), "{board}");
        }
    }

    /// The map that was worked out by hand for a board with this chip.
    #[test]
    fn the_map_fits_the_chip() {
        let file = layout_file("x", &STM32F429ZI);
        for line in [
            "programs: &[Region::new(0x0801_0000, 1984 * 1024)],",
            "ram: Region::new(0x2000_0000, 192 * 1024 - 64),",
            "handoff: Region::new(0x2002_FFC0, 48),",
            "warm_start: Region::new(0x2002_FFF0, 16),",
        ] {
            assert!(file.contains(line), "{line}\n{file}");
        }
    }

    #[test]
    fn what_cannot_be_is_said() {
        for name in ["", "My", "1a", "a_b", "a-", "a--b", "../x", "a b", "ä"] {
            assert!(changes(name, &STM32F446RE, "nucleo-f446re", &read).is_err(), "{name}");
        }
        assert!(changes("good", &STM32F446RE, "nowhere", &read).err().unwrap().contains("--from nowhere"));
        assert!(chip_by_name("stm32f999").unwrap_err().contains("stm32f446re"));
        let odd = |path: &str| Ok(read(path)?.replace("pub use board::*;", ""));
        assert!(changes("good", &STM32F446RE, "nucleo-f446re", &odd)
            .err()
            .unwrap()
            .contains("bsp/src/lib.rs"));
    }
}
