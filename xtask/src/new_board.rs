//! `cargo xtask new-board`: creates the three files of a port. It changes no other file.

use shared_abi::geometry::{self, Geometry, Line, Region, CHIPS};
use shared_abi::layout::{self, Layout};

use crate::args::Args;
use crate::{files, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask new-board NAME --chip CHIP

Creates the files of a port, with numbered steps to go through: the memory map, the board file, and the
header with the same numbers for the application in C. Nothing else has to be changed. The files compile as
they are, with clocks that the chip allows and pins that each of its packages has. docs/porting.md has the next steps.

  NAME            of the board, as it will be given to --board: small letters, digits and hyphens
  --chip CHIP     its chip as it is ordered, STM32F407VGT6: any STM32F4 with CAN controllers
";

pub fn run(mut args: Args) -> Outcome {
    let chip = args.value("--chip")?.ok_or("--chip is needed: which chip is on the board?")?;
    let mut words = args.rest().into_iter();
    let (Some(name), None) = (words.next(), words.next()) else {
        return Err("one NAME is needed, and nothing else; --help tells more.".into());
    };
    let chip = chip_by_name(&chip)?;
    let root = workspace::root();
    let files = files(&name, chip)?;
    for (path, _) in &files {
        if root.join(path).exists() {
            return Err(format!("{path} exists already; remove it, or choose another name."));
        }
    }
    for (path, text) in &files {
        files::write(&root.join(path), text)?;
        println!("  new      {path}");
    }
    if chip.line.can_controllers() > 2 {
        println!("\nCAN3 of this chip is not supported: the transceiver has to be at CAN1 or CAN2.");
    }
    println!(
        "\nNow go through the steps in the new files; docs/porting.md tells which test proves each.\n\
         Then: cargo xtask build --board {name} && cargo xtask test --board {name} --test update main_job::"
    );
    Ok(())
}

fn chip_by_name(name: &str) -> Outcome<&'static Geometry> {
    const WITHOUT_CAN: [&str; 3] = ["stm32f401", "stm32f410", "stm32f411"];
    geometry::by_name(name).ok_or_else(|| {
        let line = name.get(..9).unwrap_or(name).to_ascii_lowercase();
        if WITHOUT_CAN.contains(&&*line) {
            return format!("an {} has no CAN controller.", line.to_ascii_uppercase());
        }
        let of_line: Vec<_> =
            CHIPS.iter().map(|chip| chip.chip).filter(|chip| chip.starts_with(&line)).collect();
        if Line::of(name).is_none() {
            let lines: Vec<_> = Line::ALL.iter().map(|line| line.name()).collect();
            format!("no chip \"{name}\" is known; there are those of the lines {}.", lines.join(", "))
        } else {
            format!("no chip \"{name}\" is known; of this line there is: {}.", of_line.join(", "))
        }
    })
}

/// The files of a board: their paths and contents.
fn files(name: &str, chip: &'static Geometry) -> Outcome<[(String, String); 3]> {
    let good = name.starts_with(|c: char| c.is_ascii_lowercase())
        && !name.ends_with('-')
        && !name.contains("--")
        && name.len() <= 40
        && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-');
    if !good {
        return Err(format!(
            "\"{name}\" is no name for a board: small letters, digits and single hyphens, a letter first, \
             40 at most."
        ));
    }
    // Its file would be an existing module.
    if layout::by_name(name).is_some() || name == "toml" {
        return Err(format!("there is a board \"{name}\" already; choose another name."));
    }
    let module = name.replace('-', "_");
    Ok([
        (format!("shared-abi/src/layout/boards/{module}.rs"), layout_file(name, chip)),
        (format!("bsp/src/boards/{module}.rs"), board_file(name, chip)),
        (format!("examples/c/boards/{name}.h"), c_header(name, chip)),
    ])
}

/// The name of the chip's geometry in `shared_abi::geometry`.
fn constant(chip: &Geometry) -> String {
    chip.chip.to_uppercase()
}

/// A memory map for the chip, with its programs separate: split from 512 KiB on, compact below, and
/// the rest of the flash for one program.
fn map(chip: &'static Geometry) -> (Layout, Region) {
    let (flash, ram_end) = (chip.flash.base, chip.sram.end());
    let is_split = chip.flash.size >= 512 * 1024;
    // The first four sectors have 16 KiB and the fifth 64 KiB on every chip of the family.
    let small = |number: u32| Region::new(flash + number * 0x4000, 0x4000);
    let home = Region::new(flash + 0x1_0000, 0x1_0000);
    let program = if is_split { home.end() } else { home.base };
    let layout = Layout {
        chip,
        bootloader: Region::new(flash, if is_split { 0x4000 } else { 0x8000 }),
        home: is_split.then_some(home),
        parameters: if is_split { [small(1), small(2)] } else { [small(2), small(3)] },
        data: is_split.then(|| small(3)),
        ram: Region::new(chip.sram.base, chip.sram.size - 64),
        handoff: Region::new(ram_end - 64, 48),
        warm_start: Region::new(ram_end - 16, 16),
        ..*layout::DEFAULT
    };
    (layout, Region::new(program, chip.flash.end() - program))
}

fn layout_file(name: &str, chip: &'static Geometry) -> String {
    let region = |region: Region| {
        let kib = match region.size {
            size if size.is_multiple_of(1024) => format!("{} * 1024", size / 1024),
            size if size > 1024 => format!("{} * 1024 - {}", size.div_ceil(1024), 1024 - size % 1024),
            size => size.to_string(),
        };
        format!("Region::new(0x{:04X}_{:04X}, {kib})", region.base >> 16, region.base & 0xFFFF)
    };
    let optional = |place: Option<Region>| {
        place.map_or_else(|| "None".to_owned(), |place| format!("Some({})", region(place)))
    };
    let constant = constant(chip);
    let (layout, program) = map(chip);
    format!(
        "//! {name} ({constant}: {} KiB flash, {} KiB SRAM).

use crate::geometry::{{Region, {constant}}};
use crate::layout::Layout;

/// The memory map of the {name}.
pub const LAYOUT: Layout = Layout {{
    board: \"{name}\",
    chip: &{constant},
    // Step 1: the bootloader's resident part, and the home of its RAM image (none in the compact map).
    bootloader: {},
    callgate_offset: 0x40,
    home: {},
    // Step 2: the two sectors of the parameters, and one for the application's own data.
    parameters: [{}, {}],
    data: {},
    // Step 3: the programs, whole sectors each. Here one program has the rest of the flash.
    programs: &[{}],
    staging: None,
    // Step 4: the RAM; the chip's last 64 bytes of it are for handoff and warm-start cell.
    ram: {},
    handoff: {},
    warm_start: {},
}}
.checked();
",
        chip.flash.size / 1024,
        chip.sram.size / 1024,
        region(layout.bootloader),
        optional(layout.home),
        region(layout.parameters[0]),
        region(layout.parameters[1]),
        optional(layout.data),
        region(program),
        region(layout.ram),
        region(layout.handoff),
        region(layout.warm_start),
    )
}

/// The differences between the chips in the created files.
struct Fit {
    /// The core's clock in MHz, and the dividers of the buses.
    mhz: u32,
    apb1: u32,
    apb2: u32,
    wait_states: u32,
    /// Port of the CAN pins, receive and transmit. The application in C uses only alternate
    /// function 9, which PB8 and PB9 do not have on all chips.
    can: (char, u8, u8),
}

impl Fit {
    /// The fastest clocks that make each bit rate of CiA 301 from 8 MHz.
    fn of(chip: &Geometry) -> Self {
        match chip.line {
            Line::F412 | Line::F413 | Line::F423 => {
                Self { mhz: 96, apb1: 2, apb2: 1, wait_states: 3, can: ('A', 11, 12) }
            }
            _ => Self { mhz: 160, apb1: 4, apb2: 2, wait_states: 5, can: ('B', 8, 9) },
        }
    }
}

fn board_file(name: &str, chip: &Geometry) -> String {
    let Fit { mhz, apb1, apb2, wait_states, can: (port, receive, transmit) } = Fit::of(chip);
    format!(
        "//! {name} ({}), with a CAN transceiver on P{port}{receive} and P{port}{transmit}.

use crate::clock::ClockTree;
use crate::{{Facts, Identity, Pins}};

/// The facts of this board.
pub const FACTS: Facts = Facts {{
    // Step 5: vendor-ID, product code and names. The product code tells your product from others.
    identity: Identity {{
        vendor_id: 0,
        product_code: 0,
        revision: 0x0001_0000,
        device_name: \"{name}\",
        hardware_version: \"1\",
    }},
    // Step 6: the node-ID of a new device; 255 for one that waits for layer setting services (LSS).
    node_id: 1,
    // Step 7: the bit rate of a new device; 0 for one that detects it by listening.
    bit_rate: 125_000,
    // Step 8: the crystal, or the clock at OSC_IN with `hse_bypass`, and the numbers of the PLL. Here
    // {mhz} MHz from a crystal of 8 MHz; {} MHz on APB1 make each bit rate of CiA 301.
    clock_tree: ClockTree {{
        hse: 8_000_000,
        hse_bypass: false,
        pll_input: 2_000_000,
        pll_n: {mhz},
        pll_p: 2,
        apb1: {apb1},
        apb2: {apb2},
        wait_states: {wait_states},
    }},
    // Step 9: a pin that keeps the device in the bootloader, if the board has one:
    // `Some(crate::Strap {{ port: 'A', pin: 0, pressed: false, pull: crate::Pull::Up }})`.
    entry_strap: None,
    // Step 10: the LED.
    led: ('C', 13),
    // Step 11: the CAN pins.
    can_pins: Pins {{ transmit: ('{port}', {transmit}), receive: ('{port}', {receive}) }},
    // Step 12: the transceiver's standby pin, if it has one, and the level of normal operation:
    // `Some((('C', 14), false))` for a low level.
    can_standby: None,
    // Step 13: the UART for messages while you port: its pins, and below its name.
    uart_pins: Pins {{ transmit: ('A', 2), receive: ('A', 3) }},
    uart_bit_rate: 115_200,
}};

// Step 14: the CAN controller, CAN1 or CAN2 (docs/porting.md).
can_controller!(CAN1);
uart!(USART2);
",
        constant(chip),
        mhz / apb1,
    )
}

fn c_header(name: &str, chip: &Geometry) -> String {
    let Fit { can: (port, receive, transmit), .. } = Fit::of(chip);
    format!(
        "/* {name}: the numbers of bsp/src/boards/{}.rs for the application in C. */
/* Step 15: the CAN pins of step 11, by alternate function 9; CAN1 alone. */
#define CAN_PORT '{port}'
#define CAN_RX_PIN {receive}
#define CAN_TX_PIN {transmit}
/* Step 16: the LED of step 10. */
#define LED_PORT 'C'
#define LED_PIN 13
/* Step 17: the crystal of step 8. */
#define HSE_HZ UINT32_C(8000000)
#define HSE_BYPASS 0
/* Step 18: the identity, as in step 5. */
#define VENDOR_ID UINT32_C(0)
#define PRODUCT_CODE UINT32_C(0)
#define REVISION UINT32_C(0x00010000)
",
        name.replace('-', "_")
    )
}

#[cfg(test)]
mod tests {
    use shared_abi::geometry::{STM32F405RG, STM32F429ZI, STM32F446RE};

    use super::*;

    #[test]
    fn a_chip_that_cannot_be_is_told_why() {
        assert_eq!(chip_by_name("STM32F405RGT6"), Ok(&STM32F405RG));
        for name in ["STM32F401RE", "stm32f411ceu6", "STM32F410RB"] {
            assert!(chip_by_name(name).unwrap_err().contains("has no CAN controller"), "{name}");
        }
        for name in ["", "stm32f999", "stm32f103c8", "stm32f4\u{e9}6"] {
            assert!(chip_by_name(name).unwrap_err().contains("those of the lines stm32f405, "), "{name}");
        }
        let other = chip_by_name("stm32f446rg").unwrap_err();
        assert!(other.contains("of this line there is: ") && other.contains("stm32f446re"), "{other}");
    }

    /// All three files together have every step once, in order.
    #[test]
    fn the_steps_are_numbered_once() {
        for chip in CHIPS {
            let all: String = files("my-board", chip).unwrap().into_iter().map(|(_, text)| text).collect();
            let steps: Vec<u32> = all
                .match_indices("Step ")
                .filter_map(|(at, _)| all[at + 5..].split(':').next()?.parse().ok())
                .collect();
            assert_eq!(steps, (1..=18).collect::<Vec<u32>>(), "{}", chip.chip);
        }
    }

    #[test]
    fn the_map_fits_every_chip() {
        for chip in CHIPS {
            let (layout, program) = map(chip);
            let layout = Layout { programs: Box::leak(Box::new([program])), ..layout };
            assert_eq!(layout.check(), Ok(()), "{}", chip.chip);
        }
    }

    #[test]
    fn the_clocks_are_within_the_limits_of_every_chip() {
        for chip in CHIPS {
            let (fit, limits) = (Fit::of(chip), chip.line.limits());
            let hz = fit.mhz * 1_000_000;
            assert!(hz <= limits.sysclk && hz / fit.apb1 <= limits.apb1 && hz / fit.apb2 <= limits.apb2);
            assert!(fit.wait_states >= (hz - 1) / limits.per_wait_state, "{}", chip.chip);
        }
    }

    /// The map that was made by hand for a board with this chip.
    #[test]
    fn the_map_is_the_one_that_people_make() {
        let file = layout_file("x", &STM32F429ZI);
        for line in [
            "bootloader: Region::new(0x0800_0000, 16 * 1024),",
            "home: Some(Region::new(0x0801_0000, 64 * 1024)),",
            "data: Some(Region::new(0x0800_C000, 16 * 1024)),",
            "programs: &[Region::new(0x0802_0000, 1920 * 1024)],",
            "ram: Region::new(0x2000_0000, 192 * 1024 - 64),",
            "handoff: Region::new(0x2002_FFC0, 48),",
            "warm_start: Region::new(0x2002_FFF0, 16),",
        ] {
            assert!(file.contains(line), "{line}\n{file}");
        }
    }

    #[test]
    fn what_cannot_be_is_said() {
        let long = "a".repeat(41);
        for name in ["", "My", "1a", "a_b", "a-", "a--b", "../x", "a b", "ä", &long] {
            assert!(files(name, &STM32F446RE).unwrap_err().contains("is no name"), "{name}");
        }
        assert!(files("nucleo-f446re", &STM32F446RE).unwrap_err().contains("already"));
    }
}
