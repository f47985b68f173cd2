//! A memory map as a Rust expression.

use std::fmt;

use shared_abi::geometry::{Geometry, Region};
use shared_abi::layout::Layout;

/// Prints the expression; its names are those that `coboot-app` exports.
pub struct Expression<'a>(pub &'a Layout);

struct Place(Region);

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "::coboot_app::geometry::Region::new({:#010x}, {:#x})", self.0.base, self.0.size)
    }
}

/// A region that not every layout has.
fn optional(f: &mut fmt::Formatter<'_>, name: &str, region: &Option<Region>) -> fmt::Result {
    match region {
        Some(region) => writeln!(f, "    {name}: Some({}),", Place(*region)),
        None => writeln!(f, "    {name}: None,"),
    }
}

impl fmt::Display for Expression<'_> {
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
        let Geometry { chip: name, line, flash, sectors, second_bank, sram, ccm, interrupts, ports } = chip;
        writeln!(f, "::coboot_app::layout::Layout {{")?;
        writeln!(f, "    board: {board:?},")?;
        writeln!(f, "    chip: &::coboot_app::geometry::Geometry {{")?;
        writeln!(f, "        chip: {name:?},")?;
        writeln!(f, "        line: ::coboot_app::geometry::Line::{line:?},")?;
        writeln!(f, "        flash: {},", Place(*flash))?;
        writeln!(f, "        sectors: &[")?;
        for run in *sectors {
            writeln!(
                f,
                "            ::coboot_app::geometry::SectorRun {{ count: {}, size: {:#x} }},",
                run.count, run.size
            )?;
        }
        writeln!(f, "        ],")?;
        writeln!(f, "        second_bank: {second_bank:?},")?;
        writeln!(f, "        sram: {},\n        ccm: {},", Place(*sram), Place(*ccm))?;
        writeln!(f, "        interrupts: {interrupts},\n        ports: {ports},\n    }},")?;
        writeln!(f, "    bootloader: {},", Place(*bootloader))?;
        writeln!(f, "    callgate_offset: {callgate_offset:#x},")?;
        optional(f, "home", home)?;
        writeln!(f, "    parameters: [{}, {}],", Place(parameters[0]), Place(parameters[1]))?;
        optional(f, "data", data)?;
        writeln!(f, "    programs: &[")?;
        for program in *programs {
            writeln!(f, "        {},", Place(*program))?;
        }
        writeln!(f, "    ],")?;
        optional(f, "staging", staging)?;
        writeln!(f, "    ram: {},", Place(*ram))?;
        writeln!(f, "    handoff: {},\n    warm_start: {},", Place(*handoff), Place(*warm_start))?;
        writeln!(f, "}}\n.checked()")
    }
}
