//! A layout as text for the host tool (`coflash --board FILE.toml`), for boards that the tool was not
//! built with; and the circuit around the chip, for the emulator.

use core::fmt;

use super::Layout;
use crate::geometry::{Pin, Region};

/// Prints a layout, with its chip, as TOML.
#[derive(Clone, Copy, Debug)]
pub struct Toml<'a>(pub &'a Layout);

/// What is around the chip of a board, as an emulator must know it. Printed, it follows a layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Circuit {
    /// The crystal, or the clock at OSC_IN, in Hz.
    pub crystal: u32,
    /// The CAN controller with the transceiver, 1 or 2.
    pub can: u8,
    /// The name of the USART that is led out.
    pub usart: &'static str,
    /// A pin that a resistor on the board pulls up.
    pub pulled_up: Option<Pin>,
}

impl fmt::Display for Circuit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { crystal, can, usart, pulled_up } = self;
        writeln!(f, "\n# The circuit around the chip, for the emulator. The crystal is in Hz.\n[circuit]")?;
        writeln!(f, "crystal = {crystal}\ncan = {can}\nusart = \"{usart}\"")?;
        pulled_up.map_or(Ok(()), |(port, pin)| writeln!(f, "pulled-up = \"P{port}{pin}\""))
    }
}

struct Table(Region);

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{{ base = {:#010x}, size = {:#x} }}", self.0.base, self.0.size)
    }
}

struct List<'a>(&'a [Region]);

impl fmt::Display for List<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "[")?;
        for region in self.0 {
            writeln!(f, "  {},", Table(*region))?;
        }
        f.write_str("]")
    }
}

/// A region that not every layout has.
fn optional(f: &mut fmt::Formatter<'_>, name: &str, region: &Option<Region>) -> fmt::Result {
    region.map_or(Ok(()), |region| writeln!(f, "{name} = {}", Table(region)))
}

impl fmt::Display for Toml<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Layout {
            board,
            chip,
            bootloader,
            callgate_offset,
            home,
            parameters,
            data,
            programs,
            staging,
            ram,
            handoff,
            warm_start,
        } = self.0;
        writeln!(f, "# The memory map of a board, for coflash --board. Addresses and sizes are in bytes.")?;
        writeln!(f, "board = \"{board}\"")?;
        writeln!(f, "bootloader = {}", Table(*bootloader))?;
        writeln!(f, "callgate-offset = {callgate_offset:#x}")?;
        optional(f, "home", home)?;
        writeln!(f, "parameters = {}", List(parameters))?;
        optional(f, "data", data)?;
        writeln!(f, "programs = {}", List(programs))?;
        optional(f, "staging", staging)?;
        writeln!(f, "ram = {}", Table(*ram))?;
        writeln!(f, "handoff = {}", Table(*handoff))?;
        writeln!(f, "warm-start = {}", Table(*warm_start))?;
        writeln!(f, "\n[chip]\nname = \"{}\"", chip.chip)?;
        writeln!(f, "flash = {}", Table(chip.flash))?;
        writeln!(f, "sectors = [")?;
        for run in chip.sectors {
            writeln!(f, "  {{ count = {}, size = {:#x} }},", run.count, run.size)?;
        }
        writeln!(f, "]")?;
        if let Some(first) = chip.second_bank {
            writeln!(f, "second-bank = {first}")?;
        }
        writeln!(f, "sram = {}", Table(chip.sram))?;
        writeln!(f, "ccm = {}", Table(chip.ccm))?;
        writeln!(f, "interrupts = {}\nports = {}", chip.interrupts, chip.ports)
    }
}
