//! How long an update of many devices takes: the model of docs/fleet.md, its table and its picture,
//! with the measured points of docs/bench.md.

use std::fmt::Write;
use std::fs;

use crate::{workspace, Outcome};

/// Bits of a frame with 8 bytes of data: 111 with the intermission, and stuff bits as code has
/// them on average.
const FRAME_BITS: f64 = 118.0;
/// Identity, block 0, last block, CRC, trial and start, in seconds.
const FIXED: f64 = 0.4;
/// How long the group waits for a single answer that got lost, in seconds.
const LATE: f64 = 0.12;
/// How long one client waits for an answer, in seconds.
const TIMEOUT: f64 = 0.5;
/// Segments of a sub-block.
const SUB_BLOCK: f64 = 127.0;

/// How the program gets to the devices.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// One device after the other.
    InTurn,
    /// A download for each, at the same time.
    OneByOne,
    /// One download for all.
    Together,
}

impl Way {
    /// Bytes of a block without framing, by default.
    fn block(self) -> f64 {
        match self {
            Self::InTurn | Self::OneByOne => 1008.0,
            Self::Together => 4080.0,
        }
    }
}

/// What the model is asked.
#[derive(Clone, Copy, Debug)]
pub struct Case {
    pub way: Way,
    /// Devices.
    pub devices: f64,
    /// Bits in a second.
    pub bit_rate: f64,
    /// The program's size in KiB.
    pub kib: f64,
    /// Bytes of a block, without framing (16 bytes).
    pub block: f64,
    /// The share of lost frames.
    pub lost: f64,
}

impl Case {
    /// The duration in seconds, on a bus that carries nothing else, to devices whose flash keeps up.
    pub fn seconds(&self) -> f64 {
        let Self { way, devices, bit_rate, kib, block, lost } = *self;
        let blocks = kib * 1024.0 / block;
        let frame = FRAME_BITS / bit_rate;
        let segments = ((block + 16.0) / 7.0).ceil();
        let acks = (segments / SUB_BLOCK).ceil();
        // Initiate, segments and end; the device's answers; the status afterwards.
        let single = segments + 2.0 + (acks + 2.0) + 2.0;
        // A lost segment costs half a sub-block. Another lost frame costs a wait.
        let again = (segments.min(SUB_BLOCK) / 2.0) * frame;
        let single_lost = lost * (segments * again + (acks + 4.0) * TIMEOUT);
        match way {
            Way::InTurn => devices * (blocks * (single * frame + single_lost) + FIXED),
            // The wire is never idle, so one device waits while others are served.
            Way::OneByOne => {
                blocks * (devices * (single * frame + lost * segments * again)).max(single_lost) + FIXED
            }
            Way::Together => {
                let frames = segments + 2.0 + devices * (acks + 2.0);
                let late = devices * (acks + 2.0) * LATE + devices * single * frame + 2.0 * TIMEOUT;
                blocks * (frames * frame + lost * (segments * again + late)) + FIXED
            }
        }
    }
}

/// A row of docs/bench.md.
struct Measured {
    case: Case,
    seconds: f64,
}

/// The rows of docs/bench.md for fleets: boards, way, block size, lost frames, seconds.
fn measured() -> Outcome<Vec<Measured>> {
    let page = read("docs/bench.md")?;
    let row = |line: &str| {
        let line = line.replace("one by one", "one-by-one").replace("1 in ", "");
        let words: Vec<&str> = line.split_whitespace().collect();
        let [devices, way, block, lost, seconds, "s", _, "x"] = words[..] else { return None };
        let way = if way == "together" { Way::Together } else { Way::OneByOne };
        let lost = if lost == "none" { 0.0 } else { 1.0 / lost.parse::<f64>().ok()? };
        let (devices, block) = (devices.parse().ok()?, block.parse::<f64>().ok()? - 16.0);
        let case = Case { way, devices, bit_rate: 1e6, kib: 256.0, block, lost };
        Some(Measured { case, seconds: seconds.parse().ok()? })
    };
    let rows: Vec<Measured> = page.lines().filter_map(row).collect();
    if rows.is_empty() {
        return Err("docs/bench.md has no rows for fleets.".to_string());
    }
    Ok(rows)
}

fn read(file: &str) -> Outcome<String> {
    let path = workspace::root().join(file);
    fs::read_to_string(&path).map_err(|error| format!("{} cannot be read: {error}.", workspace::shown(&path)))
}

const WAYS: [(Way, &str, &str); 3] = [
    (Way::InTurn, "one after the other", "#9ca3af"),
    (Way::OneByOne, "at the same time", "#2563eb"),
    (Way::Together, "together", "#dc2626"),
];

fn clock(seconds: f64) -> String {
    let seconds = seconds.round() as u32;
    format!("{}:{:02}", seconds / 60, seconds % 60)
}

const WIDTH: f64 = 760.0;
const HEIGHT: f64 = 420.0;
const LEFT: f64 = 60.0;
const BOTTOM: f64 = 370.0;

/// The place of a point; both axes are logarithmic: 1 to 100 devices, 3 to 1000 seconds.
fn place(devices: f64, seconds: f64) -> (f64, f64) {
    let x = LEFT + devices.log10() / 2.0 * 480.0;
    let y = BOTTOM - (seconds / 3.0).log10() / (1000.0_f64 / 3.0).log10() * 330.0;
    (x, y)
}

/// The picture of docs/fleet.md: a program of 256 KiB at 1 Mbit/s, as lines of the model and the
/// measured points.
pub fn picture() -> Outcome<String> {
    let mut svg = String::new();
    let text = |svg: &mut String, x: f64, y: f64, anchor: &str, words: &str| {
        let _ = writeln!(svg, r#"<text x="{x:.0}" y="{y:.0}" text-anchor="{anchor}">{words}</text>"#);
    };
    let rule = |svg: &mut String, (x1, y1): (f64, f64), (x2, y2): (f64, f64)| {
        let _ = writeln!(
            svg,
            r##"<line x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}" stroke="#e5e7eb"/>"##
        );
    };
    for devices in [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 94.0] {
        rule(&mut svg, place(devices, 3.0), place(devices, 1000.0));
        text(&mut svg, place(devices, 3.0).0, BOTTOM + 18.0, "middle", &format!("{devices}"));
    }
    for seconds in [5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0] {
        rule(&mut svg, place(1.0, seconds), place(100.0, seconds));
        text(&mut svg, LEFT - 8.0, place(1.0, seconds).1 + 5.0, "end", &clock(seconds));
    }
    for (way, name, colour) in WAYS {
        for (lost, dashes) in [(0.0, "none"), (1e-3, "5 4")] {
            let case = |devices| Case { way, devices, bit_rate: 1e6, kib: 256.0, block: way.block(), lost };
            let points: Vec<String> = (0..=40)
                .map(|step| {
                    let devices = 94.0_f64.powf(f64::from(step) / 40.0);
                    let (x, y) = place(devices, case(devices).seconds());
                    format!("{x:.1},{y:.1}")
                })
                .collect();
            let _ = writeln!(
                svg,
                r#"<polyline points="{}" fill="none" stroke="{colour}" stroke-width="2" stroke-dasharray="{dashes}"/>"#,
                points.join(" ")
            );
            if lost == 0.0 {
                let (x, y) = place(100.0, case(94.0).seconds());
                let lower = if way == Way::OneByOne { 14.0 } else { -2.0 };
                text(&mut svg, x + 6.0, y + lower, "start", name);
            }
        }
    }
    for Measured { case, seconds } in measured()?.iter().filter(|row| row.case.block == row.case.way.block())
    {
        let colour = WAYS.iter().find(|(way, ..)| *way == case.way).map_or("black", |(.., colour)| colour);
        let fill = if case.lost == 0.0 { colour } else { "white" };
        let (x, y) = place(case.devices, *seconds);
        let _ = writeln!(
            svg,
            r#"<circle cx="{x:.1}" cy="{y:.1}" r="5" fill="{fill}" stroke="{colour}" stroke-width="2"/>"#
        );
    }
    text(&mut svg, LEFT, 22.0, "start", "256 KiB at 1 Mbit/s: minutes and seconds, by the number of devices");
    text(
        &mut svg,
        LEFT,
        HEIGHT - 8.0,
        "start",
        "line: model; point: measured; dashed and hollow: one of 1000 frames lost",
    );
    Ok(format!(
        "<!-- drawn by `cargo xtask diagrams` from xtask/src/fleet.rs and docs/bench.md -->\n\
         <svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{HEIGHT}\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" \
         font-family=\"Helvetica,Arial,sans-serif\" font-size=\"14\">\n\
         <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"white\"/>\n{svg}</svg>\n"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATES: [f64; 4] = [125e3, 250e3, 500e3, 1e6];
    const COUNTS: [f64; 5] = [2.0, 8.0, 32.0, 64.0, 94.0];
    const LOST: [f64; 3] = [0.0, 1e-5, 1e-3];

    /// The table of docs/fleet.md: minutes and seconds.
    fn table() -> String {
        let mut table = "| kbit/s | devices | one after the other | at the same time | together |\n|---|---|---|---|---|\n".to_string();
        for bit_rate in RATES {
            for devices in COUNTS {
                let _ = write!(table, "| {} | {devices} |", bit_rate / 1e3);
                for (way, ..) in WAYS {
                    let of = |lost| {
                        clock(Case { way, devices, bit_rate, kib: 256.0, block: way.block(), lost }.seconds())
                    };
                    let _ = write!(table, " {} |", LOST.map(of).join(" / "));
                }
                table.push('\n');
            }
        }
        table
    }

    #[test]
    fn the_page_has_the_table_of_the_model() {
        let page = read("docs/fleet.md").unwrap();
        assert!(page.contains(&table()), "docs/fleet.md has another table than:\n{}", table());
    }

    /// Without lost frames the model is off by a tenth at most; with them, chance decides more.
    #[test]
    fn the_model_fits_what_was_measured() {
        let rows = measured().unwrap();
        assert!(rows.len() >= 10);
        for Measured { case, seconds } in rows {
            let off = (case.seconds() / seconds - 1.0).abs();
            let most = if case.lost < 1e-4 { 0.1 } else { 0.3 };
            assert!(off < most, "{case:?}: {:.2} s, and {seconds} s measured", case.seconds());
        }
    }
}
