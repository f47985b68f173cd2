//! The three files of a new board (`cargo xtask new-board`), as text: a memory map, the facts, and the header
//! for the application in C. Their templates are beside this file.
#![forbid(unsafe_code)]

use shared_abi::clock_tree::ClockTree;
use shared_abi::geometry::{self, CanLine, Geometry, Line, Pin, Region, CHIPS};
use shared_abi::layout::{self, Layout};
use shared_abi::wiring::{Pins, Wiring};

/// A result, or what is wrong and what to do.
pub type Outcome<T> = Result<T, String>;

/// The words of the options.
#[derive(Clone, Debug, Default)]
pub struct Choices {
    /// The crystal, in Hz; 8 MHz if it is left out.
    pub crystal: Option<String>,
    /// The CAN controller, 1 or 2; that of the pins, or 1.
    pub can: Option<String>,
    /// Transmit and receive pin, `PB9,PB8`.
    pub pins: Option<String>,
    /// The pin of the LED.
    pub led: Option<String>,
    /// The product code (1018h/2), `1234` or `0x4D2`; left out, it is made from the name.
    pub product_code: Option<String>,
    /// The pin of the entry strap, which asks for the bootloader while it is low.
    pub strap: Option<String>,
}

/// The files of a board with this name and chip (as it is ordered): their paths in the repository, and their
/// contents.
///
/// # Errors
/// The mistake, by name.
pub fn board(name: &str, chip: &str, choices: &Choices) -> Outcome<Vec<(String, String)>> {
    files(name, &Fit::new(chip_by_name(chip)?, choices)?, product_code(name, choices)?)
}

/// The product code of a board. 0 would be any: the programs of two boards would go into each other.
///
/// # Errors
/// The option is no number, or 0.
pub fn product_code(name: &str, choices: &Choices) -> Outcome<u32> {
    let Some(word) = &choices.product_code else {
        return Ok(shared_abi::check_word(&name.bytes().map(u32::from).collect::<Vec<_>>()).max(1));
    };
    let number =
        word.strip_prefix("0x").map_or_else(|| word.parse(), |digits| u32::from_str_radix(digits, 16));
    number.ok().filter(|code| *code != 0).ok_or_else(|| {
        format!("--product-code {word}: it takes a number as 1234 or 0x4D2, and not 0, which is any product.")
    })
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
fn files(name: &str, fit: &Fit, product_code: u32) -> Outcome<Vec<(String, String)>> {
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
    let mut files = vec![
        (format!("shared-abi/src/layout/boards/{module}.rs"), layout_file(name, fit.chip)),
        (format!("bsp/src/boards/{module}.rs"), board_file(name, fit, product_code)),
    ];
    files.extend(c_header(name, fit, product_code).map(|text| (format!("examples/c/boards/{name}.h"), text)));
    Ok(files)
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
        staging: chip.sector_at(chip.flash.end() - 1).filter(|_| is_split).map(|sector| sector.region),
        ..*layout::DEFAULT
    };
    (layout, Region::new(program, chip.flash.end() - program))
}

/// A file of `xtask/new-board`, with values in the places of their names.
fn fill(template: &str, values: &[(&str, &str)]) -> String {
    values.iter().fold(template.to_owned(), |text, (name, value)| text.replace(&format!("{{{name}}}"), value))
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
    fill(
        include_str!("layout.txt"),
        &[
            ("name", name),
            ("constant", &constant),
            ("flash", &(chip.flash.size / 1024).to_string()),
            ("sram", &(chip.sram.size / 1024).to_string()),
            ("bootloader", &region(layout.bootloader)),
            ("home", &optional(layout.home)),
            ("parameters_a", &region(layout.parameters[0])),
            ("parameters_b", &region(layout.parameters[1])),
            ("data", &optional(layout.data)),
            ("program", &region(program)),
            ("staging", &optional(layout.staging)),
            ("ram", &region(layout.ram)),
            ("handoff", &region(layout.handoff)),
            ("warm_start", &region(layout.warm_start)),
        ],
    )
}

/// A board whose chip can run with these clocks and has these pins.
struct Fit {
    chip: &'static Geometry,
    clocks: ClockTree,
    wiring: Wiring,
}

impl Fit {
    fn new(chip: &'static Geometry, choices: &Choices) -> Outcome<Self> {
        let clocks = clocks(chip, choices.crystal.as_deref())?;
        let optional =
            |option, word: &Option<String>| word.as_ref().map(|word| pin(option, word)).transpose();
        let strap = optional("--strap", &choices.strap)?;
        let (can_controller, can) = can(chip, choices)?;
        let is_used = |pin| [Some(can.transmit), Some(can.receive), strap].contains(&Some(pin));
        let led = optional("--led", &choices.led)?;
        let led = led.unwrap_or(if is_used(('C', 13)) { ('A', 5) } else { ('C', 13) });
        let uart = match led {
            ('A', 2 | 3) => Pins { transmit: ('A', 9), receive: ('A', 10) },
            _ => Pins { transmit: ('A', 2), receive: ('A', 3) },
        };
        let wiring =
            Wiring { can_controller, can, led, strap, standby: None, uart, hse_bypass: clocks.hse_bypass };
        wiring.check(chip).map_err(|rule| {
            let pins = |line| {
                let pins = all_pins().filter(|pin| chip.can_line(*pin) == Some((can_controller, line)));
                pins.map(shown).collect::<Vec<_>>().join(", ")
            };
            let rule = format!("{}. No file was written.", rule.trim_start_matches("board: "));
            if !rule.contains("can_pins") {
                return rule;
            }
            format!(
                "{rule} ({} has CAN{can_controller} on these pins: transmit {}; receive {}.)",
                constant(chip),
                pins(CanLine::Transmit),
                pins(CanLine::Receive),
            )
        })?;
        Ok(Self { chip, clocks, wiring })
    }
}

/// The fastest clocks that make each bit rate of CiA 301 from a crystal: 160 MHz, or 96 on the slower chips.
fn clocks(chip: &Geometry, crystal: Option<&str>) -> Outcome<ClockTree> {
    let word = crystal.unwrap_or("8000000");
    let hse = word.parse().map_err(|_| {
        format!(
            "--crystal {word}: it takes the frequency in Hz, as 8000000. A board without a crystal needs a clock \
             at OSC_IN (`hse_bypass` in the board file): the internal oscillator is off by up to 4 %, and CAN \
             allows 1.58 % at most."
        )
    })?;
    // The inputs of the PLL that divide the 16 MHz of HSI; the fastest one has the least jitter.
    let trees = [2_000_000, 1_600_000, 1_000_000].map(|pll_input| {
        let (mhz, apb1, apb2, wait_states) = match chip.line {
            Line::F412 | Line::F413 | Line::F423 => (96, 2, 1, 3),
            _ => (160, 4, 2, 5),
        };
        let pll_n = mhz * 2_000_000 / pll_input;
        ClockTree { hse, hse_bypass: false, pll_input, pll_n, pll_p: 2, apb1, apb2, wait_states }
    });
    let rule = match trees.map(|tree| tree.check(&chip.line.limits())) {
        [Ok(()), ..] => return Ok(trees[0]),
        [_, Ok(()), _] => return Ok(trees[1]),
        [.., Ok(())] => return Ok(trees[2]),
        [Err(rule), ..] => rule,
    };
    Err(format!("--crystal {word}: {}. No file was written.", rule.trim_start_matches("board: ")))
}

/// The CAN controller and its pins.
fn can(chip: &Geometry, choices: &Choices) -> Outcome<(u8, Pins)> {
    let number = match choices.can.as_deref() {
        None => None,
        Some("1") => Some(1),
        Some("2") => Some(2),
        Some(word) => return Err(format!("--can {word}: coboot can use CAN1 or CAN2. Give 1 or 2.")),
    };
    if let Some(words) = &choices.pins {
        let Some((transmit, receive)) = words.split_once(',') else {
            return Err(format!("--pins {words}: it takes two pins, transmit and receive, as PB9,PB8."));
        };
        let pins = Pins { transmit: pin("--pins", transmit)?, receive: pin("--pins", receive)? };
        let of_pins = [pins.transmit, pins.receive].into_iter().find_map(|pin| chip.can_line(pin));
        return Ok((number.or(of_pins.map(|(number, _)| number)).unwrap_or(1), pins));
    }
    Ok(match (number, chip.line) {
        (Some(2), _) => (2, Pins { transmit: ('B', 13), receive: ('B', 12) }),
        // The application in C uses alternate function 9 alone, which their PB8 and PB9 do not have.
        (_, Line::F412 | Line::F413 | Line::F423) => (1, Pins { transmit: ('A', 12), receive: ('A', 11) }),
        _ => (1, Pins { transmit: ('B', 9), receive: ('B', 8) }),
    })
}

/// The pin of a word like `PB9`.
fn pin(option: &str, word: &str) -> Outcome<Pin> {
    let upper = word.to_ascii_uppercase();
    all_pins()
        .find(|pin| shown(*pin) == upper)
        .ok_or_else(|| format!("{option} {word}: a pin is PA0 to PK15. No file was written."))
}

/// Every pin that a chip may have.
fn all_pins() -> impl Iterator<Item = Pin> {
    ('A'..='K').flat_map(|port| (0..16).map(move |number| (port, number)))
}

/// A pin as its name in the datasheets.
fn shown((port, number): Pin) -> String {
    format!("P{port}{number}")
}

fn board_file(name: &str, fit: &Fit, product_code: u32) -> String {
    let Fit { chip, clocks, wiring: Wiring { can_controller, can, led, strap, uart, .. } } = fit;
    let mhz = clocks.sysclk() / 1_000_000;
    let ClockTree { hse, pll_input, pll_n, pll_p, apb1, apb2, wait_states, .. } = clocks;
    let strap = strap.map_or("None".to_owned(), |(port, pin)| {
        format!("Some(crate::Strap {{ port: '{port}', pin: {pin}, pressed: false, pull: crate::Pull::Up }})")
    });
    let pins =
        |Pins { transmit, receive }| format!("Pins {{ transmit: {transmit:?}, receive: {receive:?} }}");
    fill(
        include_str!("board.txt"),
        &[
            ("name", name),
            ("product_code", &format!("0x{:04X}_{:04X}", product_code >> 16, product_code & 0xFFFF)),
            ("chip", &constant(chip)),
            ("receive", &shown(can.receive)),
            ("transmit", &shown(can.transmit)),
            ("mhz", &mhz.to_string()),
            ("apb1_mhz", &(mhz / apb1).to_string()),
            ("hse", &grouped(*hse)),
            ("pll_input", &grouped(*pll_input)),
            ("pll_n", &pll_n.to_string()),
            ("pll_p", &pll_p.to_string()),
            ("apb1", &apb1.to_string()),
            ("apb2", &apb2.to_string()),
            ("wait_states", &wait_states.to_string()),
            ("strap", &strap),
            ("led", &format!("{led:?}")),
            ("can", &pins(*can)),
            ("uart", &pins(*uart)),
            ("can_controller", &can_controller.to_string()),
            ("usart", if uart.transmit == ('A', 2) { "2" } else { "1" }),
        ],
    )
}

/// A number of Hz with its digits in groups; crystals are whole kHz.
fn grouped(hz: u32) -> String {
    format!("{}_{:03}_000", hz / 1_000_000, hz / 1_000 % 1_000)
}

/// The header for the application in C, which knows one port with alternate function 9 of CAN1.
fn c_header(name: &str, fit: &Fit, product_code: u32) -> Option<String> {
    let Fit { chip, clocks: ClockTree { hse, .. }, wiring: Wiring { can, led, can_controller, .. } } = fit;
    let (port, receive, transmit) = (can.receive.0, can.receive.1, can.transmit.1);
    let is_other = matches!(chip.line, Line::F412 | Line::F413 | Line::F423) && port == 'B';
    if *can_controller != 1 || can.transmit.0 != port || is_other {
        return None;
    }
    Some(fill(
        include_str!("header.txt"),
        &[
            ("name", name),
            ("product_code", &format!("0x{product_code:08X}")),
            ("module", &name.replace('-', "_")),
            ("port", &port.to_string()),
            ("receive", &receive.to_string()),
            ("transmit", &transmit.to_string()),
            ("led_port", &led.0.to_string()),
            ("led_pin", &led.1.to_string()),
            ("hse", &hse.to_string()),
        ],
    ))
}

#[cfg(test)]
mod tests {
    use shared_abi::bit_timing::BitTiming;
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

    /// The choices of these words, in the order of the options.
    fn fit(chip: &'static Geometry, words: [&str; 5]) -> Outcome<Fit> {
        let [crystal, can, pins, led, strap] =
            words.map(|word| Some(word.to_owned()).filter(|word| !word.is_empty()));
        Fit::new(chip, &Choices { crystal, can, pins, led, strap, product_code: None })
    }

    /// All three files together have every step once, in order. Their clocks make each bit rate of CiA 301.
    #[test]
    fn every_chip_has_clocks_and_pins_and_its_steps_are_numbered_once() {
        for chip in CHIPS {
            let fit = fit(chip, [""; 5]).unwrap_or_else(|error| panic!("{}: {error}", chip.chip));
            let all: String = files("my-board", &fit, 1).unwrap().into_iter().map(|(_, text)| text).collect();
            let steps: Vec<u32> = all
                .match_indices("Step ")
                .filter_map(|(at, _)| all[at + 5..].split(':').next()?.parse().ok())
                .collect();
            assert_eq!(steps, (1..=18).collect::<Vec<u32>>(), "{}", chip.chip);
            for bit_rate in [10_000, 20_000, 50_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] {
                let timing = BitTiming::new(fit.clocks.apb1_clock(), bit_rate);
                assert!(timing.is_some(), "{}: {bit_rate}", chip.chip);
            }
        }
    }

    #[test]
    fn the_choices_are_in_the_files() {
        let own = fit(&STM32F446RE, ["25000000", "", "pb13,PB12", "PA2", "PC13"]).unwrap();
        let files = files("my-board", &own, 0x4D2).unwrap();
        assert_eq!(files.len(), 2, "the application in C has no CAN2");
        for line in [
            "product_code: 0x0000_04D2,",
            "hse: 25_000_000,",
            "pll_input: 1_000_000,",
            "pll_n: 320,",
            "entry_strap: Some(crate::Strap { port: 'C', pin: 13, pressed: false, pull: crate::Pull::Up }),",
            "led: ('A', 2),",
            "can_pins: Pins { transmit: ('B', 13), receive: ('B', 12) },",
            "uart_pins: Pins { transmit: ('A', 9), receive: ('A', 10) },",
            "can_controller!(CAN2);",
            "uart!(USART1);",
        ] {
            assert!(files[1].1.contains(line), "{line}\n{}", files[1].1);
        }
        let other = fit(&STM32F446RE, ["4800000", "1", "", "", "PC13"]).unwrap();
        assert_eq!((other.clocks.pll_input, other.wiring.led), (1_600_000, ('A', 5)));
        let header = c_header("x", &other, 0x4D2).unwrap();
        assert!(
            header.contains("HSE_HZ UINT32_C(4800000)") && header.contains("UINT32_C(0x000004D2)"),
            "{header}"
        );
    }

    /// 0 would be any product (CiA 302-3 has it so for the identity of a program, as the label here).
    #[test]
    fn two_boards_have_two_product_codes_and_neither_is_0() {
        let code = |name: &str, word: Option<&str>| {
            product_code(name, &Choices { product_code: word.map(str::to_owned), ..Choices::default() })
        };
        let codes = ["an-f405", "an-f413", "my-board"].map(|name| code(name, None).unwrap());
        assert!(codes[0] != codes[1] && codes[1] != codes[2] && !codes.contains(&0), "{codes:X?}");
        assert_eq!([code("a", Some("1234")), code("b", Some("0x4D2"))], [Ok(1234), Ok(1234)]);
        for word in ["0", "0x0", "x", "-1", "4294967296"] {
            assert!(code("a", Some(word)).unwrap_err().contains("--product-code"), "{word}");
        }
    }

    #[test]
    fn a_mistake_is_refused_by_name() {
        for (words, says) in [
            (["none", "", "", "", ""], "A board without a crystal needs a clock at OSC_IN"),
            (["0", "", "", "", ""], "--crystal 0: hse must be a crystal of 4 to 26 MHz"),
            (["8", "", "", "", ""], "--crystal 8: hse must be"),
            (["80000000", "", "", "", ""], "--crystal 80000000: hse must be"),
            (["-1", "", "", "", ""], "--crystal -1: it takes the frequency in Hz"),
            (["14745600", "", "", "", ""], "--crystal 14745600: the PLL's input must be a divisor"),
            (["", "3", "", "", ""], "--can 3: coboot can use CAN1 or CAN2"),
            (["", "", "PB9", "", ""], "--pins PB9: it takes two pins"),
            (["", "", "PB9,PB8,PB7", "", ""], "--pins PB8,PB7: a pin is PA0 to PK15"),
            (
                ["", "", "PB8,PB9", "", ""],
                "no transmit pin of this CAN controller. No file was written. (STM32F446RE",
            ),
            (["", "", "PB9,PB12", "", ""], "no receive pin of this CAN controller"),
            (["", "2", "PB9,PB8", "", ""], "has CAN2 on these pins: transmit PB6, PB13; receive PB5, PB12.)"),
            // The package has 64 pins.
            (["", "", "PD1,PD0", "", ""], "no such pins as can_pins names"),
            (["", "", "", "PB11", ""], "no such pin as led names"),
            (["", "", "", "PB3", ""], "led is a pin of the debugger"),
            (["", "", "", "PB9", ""], "led is a pin of the CAN controller"),
            (["", "", "", "PH0", ""], "led is a pin of the crystal"),
            (["", "", "", "PA16", ""], "--led PA16: a pin is PA0 to PK15"),
            (["", "", "", "PA05", ""], "--led PA05: a pin is"),
            (["", "", "", "", "A0"], "--strap A0: a pin is"),
            (["", "", "", "", "P\u{e9}0"], "a pin is"),
            (["", "", "", "", "PA13"], "entry_strap is a pin of the debugger"),
            (["", "", "", "PA5", "PA5"], "entry_strap is the pin of the LED"),
        ] {
            let refusal = fit(&STM32F446RE, words).err().unwrap_or_else(|| panic!("{words:?}"));
            assert!(refusal.contains(says), "{words:?}: {refusal}");
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
        let fit = fit(&STM32F446RE, [""; 5]).unwrap();
        for name in ["", "My", "1a", "a_b", "a-", "a--b", "../x", "a b", "ä", &long] {
            assert!(files(name, &fit, 1).unwrap_err().contains("is no name"), "{name}");
        }
        assert!(files("nucleo-f446re", &fit, 1).unwrap_err().contains("already"));
    }
}
