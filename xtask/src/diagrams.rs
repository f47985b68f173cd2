//! `cargo xtask diagrams`: draws the pictures of the documents from text.

use std::fmt::Write;
use std::fs;
use std::path::PathBuf;
use std::process::Command;

use shared_abi::geometry::Region;
use shared_abi::layout::{stm32f407g_disc1, Layout};

use crate::args::Args;
use crate::{fleet, process, timing, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask diagrams

Draws the pictures in docs/diagrams/: each FILE.dot there by Graphviz, each FILE.timing as a timing
diagram (xtask/src/timing.rs), the memory map of the stm32f407g-disc1 from its layout, and the
durations of docs/fleet.md from their model (xtask/src/fleet.rs) and docs/bench.md. Needs
`dot` (Debian's package graphviz). The SVG files are checked in; a test tells when one is older than
what it is drawn from.
";

/// The names of the sources with this ending, without the ending.
fn sources(ending: &str) -> Outcome<Vec<String>> {
    let folder = path("");
    let entries = fs::read_dir(&folder)
        .map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(&folder)))?;
    let name = |path: PathBuf| {
        let is_source = path.extension().is_some_and(|extension| extension == ending);
        is_source.then(|| path.file_stem().unwrap_or_default().to_string_lossy().into_owned())
    };
    let mut names: Vec<_> = entries.flatten().filter_map(|entry| name(entry.path())).collect();
    names.sort();
    Ok(names)
}

/// The text of a source.
fn source(name: &str, ending: &str) -> Outcome<String> {
    let source = path(&format!("{name}.{ending}"));
    fs::read_to_string(&source)
        .map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(&source)))
}

/// A timing diagram.
fn timing_diagram(name: &str) -> Outcome<String> {
    timing::drawn(&source(name, "timing")?).map_err(|problem| format!("{name}.timing: {problem}"))
}

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    // The pictures that need no tool come first.
    write(&path("memory.svg"), &memory_map(&stm32f407g_disc1::LAYOUT))?;
    write(&path("fleet.svg"), &fleet::picture()?)?;
    for name in sources("timing")? {
        write(&path(&format!("{name}.svg")), &timing_diagram(&name)?)?;
    }
    for name in sources("dot")? {
        let text = source(&name, "dot")?;
        let drawn = process::output(Command::new("dot").arg("-Tsvg").arg(path(&format!("{name}.dot"))))
            .map_err(|problem| format!("{problem} Graphviz is needed: sudo apt-get install -y graphviz"))?;
        write(&path(&format!("{name}.svg")), &marked(&drawn, &text)?)?;
    }
    Ok(())
}

fn path(file: &str) -> PathBuf {
    workspace::root().join("docs/diagrams").join(file)
}

fn write(file: &PathBuf, text: &str) -> Outcome {
    fs::write(file, text).map_err(|error| format!("{} cannot be written: {error}.", workspace::shown(file)))
}

/// The picture with the mark of its source, and without the parts that change with the version of
/// Graphviz.
fn marked(drawn: &str, source: &str) -> Outcome<String> {
    let from = drawn.find("<svg").ok_or("Graphviz drew no SVG.")?;
    Ok(format!("{}\n{}", mark(source), &drawn[from..]))
}

/// A hash of the text (64-bit FNV-1a). The sources are compared by it, since pictures of another
/// version of Graphviz differ in every line.
fn mark(source: &str) -> String {
    let hash = source.bytes().fold(0xCBF2_9CE4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3)
    });
    format!("<!-- drawn by `cargo xtask diagrams` from {hash:016x} -->")
}

/// Widths and heights of the memory map, in pixels.
const BAR: u32 = 150;
const COLUMN: u32 = 440;
const TOP: u32 = 56;

/// Flash and RAM of a board as an SVG, each in the order of its addresses from bottom to top, as in
/// manuals. The heights are not to scale: 16 bytes beside 960 KiB would be invisible.
fn memory_map(layout: &Layout) -> String {
    let programs = (1..).zip(layout.programs).map(|(number, region)| (format!("program {number}"), *region));
    let mut flash = vec![
        ("bootloader".to_owned(), layout.bootloader),
        ("parameters A".to_owned(), layout.parameters[0]),
        ("parameters B".to_owned(), layout.parameters[1]),
    ];
    flash.extend(programs);
    let ram = vec![
        ("code and data".to_owned(), layout.ram),
        ("handoff".to_owned(), layout.handoff),
        ("warm-start cell".to_owned(), layout.warm_start),
    ];
    let mut svg = String::new();
    let columns = [("flash", flash, "#dbeafe"), ("RAM", ram, "#dcfce7")];
    let height = |region: &Region| 36 + 3 * region.size.ilog2();
    let bottom = TOP
        + columns
            .iter()
            .map(|(_, regions, _)| regions.iter().map(|(_, r)| height(r)).sum())
            .max()
            .unwrap_or(0);
    for (column, (title, mut regions, colour)) in (0..).zip(columns) {
        let x = 20 + column * COLUMN;
        let mut y = bottom;
        text(&mut svg, x, 40, "bold", &format!("{title} of the {}", layout.board));
        regions.sort_by_key(|(_, region)| region.base);
        for (name, region) in regions {
            let tall = height(&region);
            y -= tall;
            // Writing to a string cannot fail.
            let _ = writeln!(
                svg,
                r##"<rect x="{x}" y="{y}" width="{BAR}" height="{tall}" fill="{colour}" stroke="#4b5563"/>"##
            );
            let middle = y + tall / 2 + 5;
            text(&mut svg, x + 10, middle, "normal", &name);
            text(&mut svg, x + BAR + 10, y + tall - 6, "normal", &format!("{:08X}h", region.base));
            text(&mut svg, x + BAR + 110, middle, "normal", &remark(layout, &region));
        }
    }
    let (width, height) = (2 * COLUMN + 20, bottom + 20);
    format!(
        "<!-- drawn by `cargo xtask diagrams` from shared-abi/src/layout -->\n\
         <svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
         font-family=\"Helvetica,Arial,sans-serif\" font-size=\"14\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n{svg}</svg>\n"
    )
}

fn text(svg: &mut String, x: u32, y: u32, weight: &str, words: &str) {
    let _ = writeln!(svg, r#"<text x="{x}" y="{y}" font-weight="{weight}">{words}</text>"#);
}

/// Size and sectors.
fn remark(layout: &Layout, region: &Region) -> String {
    let size = match region.size {
        size if size.is_multiple_of(1024) => format!("{} KiB", size / 1024),
        size => format!("{size} B"),
    };
    match (layout.chip.sector_at(region.base), layout.chip.sector_at(region.end() - 1)) {
        (Some(a), Some(b)) if a.number == b.number => format!("{size}, sector {}", a.number),
        (Some(a), Some(b)) => format!("{size}, sectors {} to {}", a.number, b.number),
        _ => size,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pictures_are_those_of_their_sources() {
        let timings = sources("timing").unwrap();
        for name in &timings {
            let picture = fs::read_to_string(path(&format!("{name}.svg"))).unwrap();
            assert!(
                picture == timing_diagram(name).unwrap(),
                "{name}.svg is old: run `cargo xtask diagrams`"
            );
        }
        let drawn = sources("dot").unwrap();
        assert!(drawn.len() > 5 && !timings.is_empty(), "{drawn:?} {timings:?}");
        for name in drawn {
            let source = source(&name, "dot").unwrap();
            let picture = fs::read_to_string(path(&format!("{name}.svg"))).unwrap();
            assert!(picture.starts_with(&mark(&source)), "{name}.svg is old: run `cargo xtask diagrams`");
        }
        let picture = fs::read_to_string(path("fleet.svg")).unwrap();
        assert!(picture == fleet::picture().unwrap(), "fleet.svg is old: run `cargo xtask diagrams`");
        let picture = fs::read_to_string(path("memory.svg")).unwrap();
        assert!(
            picture == memory_map(&stm32f407g_disc1::LAYOUT),
            "memory.svg is old: run `cargo xtask diagrams`"
        );
    }

    /// Test vectors of FNV's authors for "" and "foobar".
    #[test]
    fn the_mark_is_fnv_1a() {
        assert!(mark("").contains("cbf29ce484222325"));
        assert!(mark("foobar").contains("85944171f73967e8"));
    }

    /// Addresses and sectors from the design's table.
    #[test]
    fn the_memory_map_shows_every_region() {
        let map = memory_map(&stm32f407g_disc1::LAYOUT);
        for words in ["08010000h", "960 KiB, sectors 4 to 11", "2001FFF0h", "16 B", "16 KiB, sector 3"] {
            assert!(map.contains(&format!(">{words}<")), "{words}");
        }
    }
}
