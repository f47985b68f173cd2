//! The memory layout: the owner of each address, and the only source of these numbers.
//!
//! One file for each board in `layout/boards/` holds **the numbers**; linker scripts, firmware, host tool,
//! tests and documentation derive theirs from it. [`Layout::checked`] runs when the crate is
//! compiled: a layout that breaks a rule does not compile, and the compiler's message contains the
//! rule.
//!
//! A layout has one of two maps, by its regions:
//!
//! | map | the RAM image of the bootloader | for |
//! |---|---|---|
//! | *split* | in a region of its own, [`Layout::home`] | chips of 512 KiB and more; sealed images |
//! | *compact* | directly after the resident part | those who need the 64 KiB |

use core::fmt;

use crate::geometry::{Geometry, Region, CORE_VECTORS_SIZE};
use crate::{callgate, handoff, label, warm_start};

pub mod toml;

// The boards, from the files in `boards/` (build.rs).
include!(concat!(env!("OUT_DIR"), "/boards.rs"));

/// The board for builds that name none.
pub const DEFAULT: &Layout = &stm32f407g_disc1::LAYOUT;

/// The size of [`Layout::key_block`] in bytes.
pub const KEY_BLOCK_SIZE: u32 = 256;

/// The least number of bytes of RAM after the bootloader's variables that remain for its stack. The
/// boot stage, which copies the RAM image, uses the same RAM. `cargo xtask size` computes what they need.
pub const LEAST_STACK: u32 = 8192;

/// The size of [`Layout::kept`] in bytes.
const KEPT: u32 = 1024;

/// The offset of a word in the bootloader's vector table that is not a vector (PM0214 section
/// 2.3.4: reserved). It contains [`KNOWS_SEALED_IMAGES`] in a bootloader that uses a key block.
pub const MARK_OFFSET: u32 = 0x1C;
/// See [`MARK_OFFSET`].
pub const KNOWS_SEALED_IMAGES: u32 = u32::from_le_bytes(*b"CBS1");

/// The board with this name, as in `--board`.
#[must_use]
pub fn by_name(board: &str) -> Option<&'static Layout> {
    BOARDS.iter().copied().find(|layout| layout.board == board)
}

/// The board that a build is for, by the value of the variable `COBOOT_BOARD`: [`DEFAULT`] where it
/// is not set. For build scripts.
///
/// # Panics
/// If there is no such board; the message lists those that there are.
#[must_use]
pub fn chosen(variable: Option<&str>) -> &'static Layout {
    let Some(name) = variable else { return DEFAULT };
    by_name(name).unwrap_or_else(|| panic!("COBOOT_BOARD={name}: there is no such board; there is: {Names}."))
}

/// Prints the names of the boards.
struct Names;

impl fmt::Display for Names {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (number, layout) in BOARDS.iter().enumerate() {
            write!(f, "{}{}", if number > 0 { ", " } else { "" }, layout.board)?;
        }
        Ok(())
    }
}

/// The memory map of one board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// The name that `--board` and the variable `COBOOT_BOARD` take: that of its file, with hyphens.
    pub board: &'static str,
    /// The silicon on it.
    pub chip: &'static Geometry,
    /// The flash of the bootloader's resident part. Its vector table is at the base, where the core
    /// reads it after a reset. In the compact map the RAM image follows in the same region.
    pub bootloader: Region,
    /// The offset of the [`callgate`] table from the base: after the vectors of the core. (The
    /// vectors of interrupts are only in RAM.)
    pub callgate_offset: u32,
    /// The flash of the bootloader's RAM image in the split map; `None` in the compact map.
    pub home: Option<Region>,
    /// The two regions of the non-volatile parameters, at least one sector each.
    pub parameters: [Region; 2],
    /// Flash for the application's own data, which the bootloader never writes.
    pub data: Option<Region>,
    /// Flash of program 1, 2, … (sub-index of 1F50h, 1F51h, 1F56h, 1F57h).
    pub programs: &'static [Region],
    /// Flash for a new RAM image of the bootloader: the last sector of the last program, and never
    /// its only one.
    pub staging: Option<Region>,
    /// RAM for code and data. The application uses all of it, the bootloader all but
    /// [`Self::kept`].
    pub ram: Region,
    /// The place of the [`handoff`].
    pub handoff: Region,
    /// The [`warm_start`] cell: the last RAM cell of the chip.
    pub warm_start: Region,
}

impl Layout {
    /// Returns the layout if every rule holds; otherwise the build fails with the broken rule as
    /// message.
    #[must_use]
    pub const fn checked(self) -> Self {
        match self.check() {
            Ok(()) => self,
            Err(rule) => panic!("{}", rule),
        }
    }

    /// Checks every rule; the error is the text of the first broken rule. No number causes a panic:
    /// a layout may come from a file.
    ///
    /// # Errors
    /// The broken rule.
    pub const fn check(&self) -> Result<(), &'static str> {
        if !self.has_possible_regions() {
            return Err("a region is empty, or reaches over the end of the address space");
        }
        if let Err(rule) = self.check_bootloader() {
            return Err(rule);
        }
        if let Err(rule) = self.check_programs() {
            return Err(rule);
        }
        if let Err(rule) = self.check_staging() {
            return Err(rule);
        }
        self.check_ram()
    }

    const fn has_possible_regions(&self) -> bool {
        let [a, b] = self.parameters;
        are_possible(&[self.bootloader, a, b, self.ram, self.handoff, self.warm_start])
            && are_possible(self.home.as_slice())
            && are_possible(self.data.as_slice())
            && are_possible(self.staging.as_slice())
            && are_possible(self.programs)
    }

    /// The rules of all flash but that of the programs.
    const fn check_bootloader(&self) -> Result<(), &'static str> {
        let (chip, bootloader, [a, b]) = (self.chip, &self.bootloader, &self.parameters);
        let offset = self.callgate_offset;
        let has_callgate =
            offset < bootloader.size && bootloader.contains(bootloader.base + offset, callgate::TABLE_SIZE);
        let are_whole = chip.is_whole_sectors(a) && chip.is_whole_sectors(b);
        let broken = first_broken(&[
            (
                bootloader.base != chip.flash.base,
                "the bootloader must start at the base of the flash, where the core fetches its vectors after a reset",
            ),
            (!chip.is_whole_sectors(bootloader), "the bootloader must end at a sector border"),
            (bootloader.size <= KEY_BLOCK_SIZE, "the bootloader has no room beside its key block"),
            (offset < CORE_VECTORS_SIZE, "the callgate overlaps the bootloader's vector table"),
            (!has_callgate, "the callgate lies outside the bootloader"),
            (!are_whole, "a parameter region must start and end at sector borders"),
            (bootloader.overlaps(a) || bootloader.overlaps(b), "a parameter region overlaps the bootloader"),
            (a.overlaps(b), "the two parameter regions overlap"),
        ]);
        if broken.is_err() {
            return broken;
        }
        if let Some(home) = &self.home {
            let broken = first_broken(&[
                (
                    !chip.is_whole_sectors(home),
                    "the home of the RAM image must start and end at sector borders",
                ),
                (home.overlaps(bootloader), "the home of the RAM image overlaps the bootloader"),
                (
                    home.overlaps(a) || home.overlaps(b),
                    "the home of the RAM image overlaps a parameter region",
                ),
            ]);
            if broken.is_err() {
                return broken;
            }
        }
        let Some(data) = &self.data else { return Ok(()) };
        first_broken(&[
            (!chip.is_whole_sectors(data), "the data region must start and end at sector borders"),
            (self.is_in_bootloader(data), "the data region overlaps the bootloader"),
            (data.overlaps(a) || data.overlaps(b), "the data region overlaps a parameter region"),
        ])
    }

    const fn check_programs(&self) -> Result<(), &'static str> {
        let (chip, [a, b]) = (self.chip, &self.parameters);
        if self.programs.is_empty() || self.programs.len() > 254 {
            return Err("there must be 1 to 254 programs (sub-indices 1 to 254 of 1F50h)");
        }
        let mut p = 0;
        while p < self.programs.len() {
            let program = &self.programs[p];
            let is_aligned = program.base.is_multiple_of(chip.vector_table_alignment());
            let broken = first_broken(&[
                (!chip.is_whole_sectors(program), "a program must start and end at sector borders"),
                (!is_aligned, "a program's vector table is not aligned as VTOR demands"),
                (self.is_in_bootloader(program), "a program overlaps the bootloader"),
                (overlaps_one(program, self.data.as_slice()), "a program overlaps the data region"),
                (program.overlaps(a) || program.overlaps(b), "a program overlaps a parameter region"),
                (overlaps_one(program, self.programs.split_at(p).0), "two programs overlap"),
            ]);
            if broken.is_err() {
                return broken;
            }
            p += 1;
        }
        Ok(())
    }

    const fn check_staging(&self) -> Result<(), &'static str> {
        let Some(staging) = &self.staging else { return Ok(()) };
        let last = &self.programs[self.programs.len() - 1];
        let is_last = self.chip.is_whole_sectors(staging)
            && staging.end() == last.end()
            && staging.base > last.base
            && is_one_sector(self.chip, staging);
        first_broken(&[
            (
                self.home.is_none(),
                "a staging region needs a home of the RAM image, which the compact map has not",
            ),
            (
                !is_last,
                "the staging region must be the last sector of the last program, and not its only one",
            ),
        ])
    }

    const fn check_ram(&self) -> Result<(), &'static str> {
        let Self { ram, handoff: to, warm_start: cell, .. } = self;
        let sram = self.chip.sram;
        let is_inside = ram.overlaps(to) || ram.overlaps(cell);
        let has_sizes = [
            to.size as usize == size_of::<handoff::Handoff>(),
            cell.size as usize == size_of::<warm_start::WarmStart>(),
        ];
        let are_aligned = to.base.is_multiple_of(4) && cell.base.is_multiple_of(4);
        first_broken(&[
            (!sram.contains(ram.base, ram.size), "the RAM of the images lies outside the chip's SRAM"),
            (!ram.size.is_multiple_of(8), "the initial stack pointer must be a multiple of 8 (AAPCS)"),
            (is_inside, "the handoff or the warm-start cell lies inside the RAM of the images"),
            (to.overlaps(cell), "the handoff overlaps the warm-start cell"),
            (!has_sizes[0], "the handoff region has not the size of the handoff"),
            (!has_sizes[1], "the warm-start region has not the size of the warm-start cell"),
            (!are_aligned, "the handoff and the warm-start cell must be word-aligned"),
            (cell.end() != sram.end(), "the warm-start cell must be the last RAM cell of the chip"),
            (!sram.contains(to.base, to.size), "the handoff lies outside the chip's SRAM"),
        ])
    }

    const fn is_in_bootloader(&self, region: &Region) -> bool {
        region.overlaps(&self.bootloader) || overlaps_one(region, self.home.as_slice())
    }

    /// Address of the callgate table.
    #[must_use]
    pub const fn callgate(&self) -> u32 {
        self.bootloader.base + self.callgate_offset
    }

    /// The end of the RAM, which the bootloader leaves alone: an application finds there after each
    /// reset but that of the power what it wrote before. Empty on a chip with less than 128 KiB.
    #[must_use]
    pub const fn kept(&self) -> Region {
        // Beside the largest RAM image and its stack, 128 KiB have room for the default queue.
        let size = if self.chip.sram.size >= 128 * 1024 && self.ram.size > KEPT { KEPT } else { 0 };
        Region::new(self.ram.end() - size, size)
    }

    /// The RAM of the bootloader: of its resident part, which uses the end as its stack, and of its
    /// RAM image.
    #[must_use]
    pub const fn bootloader_ram(&self) -> Region {
        Region::new(self.ram.base, self.ram.size - self.kept().size)
    }

    /// The keys of a sealed device: the last [`KEY_BLOCK_SIZE`] bytes of the resident part's flash,
    /// written in production and never by the bootloader. Only the split map has sealed images.
    #[must_use]
    pub const fn key_block(&self) -> Region {
        Region::new(self.bootloader.end() - KEY_BLOCK_SIZE, KEY_BLOCK_SIZE)
    }

    /// The flash that the resident part may fill, in the compact map together with the RAM image:
    /// everything except the key block, which the compact map has not.
    #[must_use]
    pub const fn resident(&self) -> Region {
        match self.home {
            Some(_) => Region::new(self.bootloader.base, self.bootloader.size - KEY_BLOCK_SIZE),
            None => self.bootloader,
        }
    }

    /// The sectors that belong under the write protection of a product: bit *n* for sector *n*, as in nWRP,
    /// where a 0 protects. They are all sectors of the bootloader. One that can be renewed has to write its
    /// home, so there it is the resident part alone.
    #[must_use]
    pub fn protected_sectors(&self, renewal: bool) -> u32 {
        let home = self.home.filter(|_| !renewal);
        let is_protected = |place: Region| {
            self.bootloader.overlaps(&place) || home.is_some_and(|home| home.overlaps(&place))
        };
        let sectors = self.chip.sectors().filter(|sector| is_protected(sector.region));
        sectors.fold(0, |mask, sector| mask | 1 << sector.number)
    }

    /// The flash of program `number` (1 is the first, as in the sub-index).
    #[must_use]
    pub fn program(&self, number: u8) -> Option<Region> {
        let index = usize::from(number).checked_sub(1)?;
        self.programs.get(index).copied()
    }

    /// The flash of program `number` without staging.
    #[must_use]
    pub fn program_before_staging(&self, number: u8) -> Option<Region> {
        let region = self.program(number)?;
        let is_last = usize::from(number) == self.programs.len();
        let end = match self.staging {
            Some(staging) if is_last => staging.base,
            _ => region.end(),
        };
        Some(Region::new(region.base, end - region.base))
    }

    /// The linker script of this layout, which `build.rs` writes to `layout.x`.
    #[must_use]
    pub const fn linker_script(&self, image: Image) -> LinkerScript<'_> {
        let keeps_ram = matches!(image, Image::Bootloader);
        LinkerScript { layout: self, image, keeps_ram }
    }
}

/// The text of the first rule that is broken.
const fn first_broken(rules: &[(bool, &'static str)]) -> Result<(), &'static str> {
    let mut rule = 0;
    while rule < rules.len() {
        if rules[rule].0 {
            return Err(rules[rule].1);
        }
        rule += 1;
    }
    Ok(())
}

const fn are_possible(regions: &[Region]) -> bool {
    let mut n = 0;
    while n < regions.len() {
        if !regions[n].is_possible() {
            return false;
        }
        n += 1;
    }
    true
}

const fn overlaps_one(region: &Region, others: &[Region]) -> bool {
    let mut n = 0;
    while n < others.len() {
        if region.overlaps(&others[n]) {
            return true;
        }
        n += 1;
    }
    false
}

const fn is_one_sector(chip: &Geometry, region: &Region) -> bool {
    match chip.sector_at(region.base) {
        Some(sector) => sector.region.size == region.size,
        None => false,
    }
}

/// The image of a linker script.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Image {
    /// The bootloader.
    Bootloader,
    /// Program `n`, 1 is the first. It ends before staging: a larger program would take the flash that a
    /// new bootloader needs.
    Program(u8),
    /// Program `n` with all of its flash, staging included.
    WholeProgram(u8),
}

/// Prints the `MEMORY` command and the border symbols for the templates in `linker/`.
#[derive(Clone, Copy, Debug)]
pub struct LinkerScript<'a> {
    layout: &'a Layout,
    image: Image,
    keeps_ram: bool,
}

impl LinkerScript<'_> {
    /// Ends the RAM of a program before [`Layout::kept`], and names that for `panic-persist`.
    #[must_use]
    pub const fn keeping_ram(self) -> Self {
        Self { keeps_ram: true, ..self }
    }
}

impl fmt::Display for LinkerScript<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let layout = self.layout;
        let (flash, name) = match self.image {
            Image::Bootloader => (layout.resident(), "bootloader"),
            Image::Program(number) => (layout.program_before_staging(number).ok_or(fmt::Error)?, "program"),
            Image::WholeProgram(number) => (layout.program(number).ok_or(fmt::Error)?, "program"),
        };
        writeln!(
            f,
            "/* {name} of {}, made from shared-abi/src/layout/boards: change it there. */",
            layout.board
        )?;
        writeln!(f, "MEMORY\n{{")?;
        let home = layout.home.filter(|_| self.image == Image::Bootloader);
        let (kept, ram) = (layout.kept(), if self.keeps_ram { layout.bootloader_ram() } else { layout.ram });
        let memories = [("FLASH", Some(flash)), ("HOME ", home), ("RAM  ", Some(ram))];
        for (name, region) in memories {
            if let Some(Region { base, size }) = region {
                writeln!(f, "  {name} : ORIGIN = {base:#010x}, LENGTH = {size:#x}")?;
            }
        }
        writeln!(f, "}}")?;
        if self.image == Image::Bootloader && home.is_none() {
            // Compact: the RAM image follows the resident part.
            writeln!(f, "REGION_ALIAS(\"HOME\", FLASH)")?;
        }
        if let Some(home) = home {
            writeln!(f, "__home = {:#010x};", home.base)?;
        }
        for (symbol, value) in [
            ("__vector_table_alignment", layout.chip.vector_table_alignment()),
            ("__vector_table_size", layout.chip.vector_table_size()),
            ("__core_vectors_size", CORE_VECTORS_SIZE),
            ("__least_stack", LEAST_STACK),
            ("__label", flash.base + label::OFFSET),
            ("__label_end", flash.base + label::OFFSET + label::SIZE as u32),
            ("__callgate_table", layout.callgate()),
            ("__callgate_table_size", callgate::TABLE_SIZE),
            ("__kept", kept.base),
            ("__kept_end", kept.end()),
            ("__handoff", layout.handoff.base),
            ("__warm_start", layout.warm_start.base),
            ("__sram_end", layout.chip.sram.end()),
            ("__programs", layout.programs.len() as u32),
        ] {
            writeln!(f, "{symbol} = {value:#010x};")?;
        }
        if self.keeps_ram && self.image != Image::Bootloader {
            writeln!(f, "_panic_dump_start = __kept;\n_panic_dump_end = __kept_end;")?;
        }
        Ok(())
    }
}

/// Prints the memory map as a table for people.
impl fmt::Display for Layout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let flash = self.chip.flash;
        let sram = self.chip.sram;
        writeln!(
            f,
            "{} ({}: flash {} KiB, SRAM {} KiB)",
            self.board,
            self.chip.chip,
            flash.size / 1024,
            sram.size / 1024
        )?;
        writeln!(f)?;
        writeln!(f, "  {:<14} {:<24} {:>12}   remarks", "region", "addresses", "size")?;
        let map = [
            ("resident part", Some(self.bootloader), "vectors of the core, then the callgate"),
            ("parameters A", Some(self.parameters[0]), ""),
            ("parameters B", Some(self.parameters[1]), ""),
            ("data", self.data, "the application's own"),
            ("RAM image", self.home, "the rest of the bootloader"),
        ];
        let map = map.into_iter().filter_map(|(name, region, remark)| Some((name, region?, remark)));
        let staging = self.staging.map(|region| ("staging", region, "a new RAM image; in the last program"));
        let programs = self.programs.iter().zip(PROGRAM_NAMES).map(|(region, name)| (name, *region, ""));
        let ram = [
            ("RAM", self.ram, "code and data; the application gets all of it"),
            ("handoff", self.handoff, "bootloader -> application"),
            ("warm-start", self.warm_start, "application -> bootloader; the last RAM cell"),
        ];
        for (name, region, remark) in map.chain(programs).chain(staging).chain(ram) {
            self.row(f, name, region, remark)?;
        }
        writeln!(f, "\n  The callgate is at {}.", Address(self.callgate()))
    }
}

/// An address in the format of the manuals: `0800_0000`.
struct Address(u32);

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:04X}_{:04X}", self.0 >> 16, self.0 & 0xFFFF)
    }
}

/// Names in the printed map; of a layout with more programs, only the first ones are printed.
const PROGRAM_NAMES: [&str; 4] = ["program 1", "program 2", "program 3", "program 4"];

impl Layout {
    fn row(&self, f: &mut fmt::Formatter<'_>, name: &str, region: Region, remark: &str) -> fmt::Result {
        let (first, last) = (region.base, region.end() - 1);
        write!(f, "  {name:<14} {} - {}    ", Address(first), Address(last))?;
        match region.size {
            size if size.is_multiple_of(1024) => write!(f, "{:>8} KiB", size / 1024)?,
            size => write!(f, "{size:>8} B  ")?,
        }
        let sectors = match (self.chip.sector_at(first), self.chip.sector_at(last)) {
            (Some(a), Some(b)) if a.number == b.number => {
                write!(f, "   sector {}", a.number)?;
                true
            }
            (Some(a), Some(b)) => {
                write!(f, "   sectors {}-{}", a.number, b.number)?;
                true
            }
            _ => false,
        };
        match (remark.is_empty(), sectors) {
            (true, _) => writeln!(f),
            (false, true) => writeln!(f, ": {remark}"),
            (false, false) => writeln!(f, "   {remark}"),
        }
    }
}
