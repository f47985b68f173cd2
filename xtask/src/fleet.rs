//! Tests of docs/fleet.md: how long an update of many devices takes. The model, against the page's
//! table, its picture, and what docs/bench.md has measured.

use std::fmt::Write;

use crate::{files, outcome::Outcome};

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
enum Way {
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
struct Case {
    way: Way,
    /// Devices.
    devices: f64,
    /// Bits in a second.
    bit_rate: f64,
    /// The program's size in KiB.
    kib: f64,
    /// Bytes of a block, without framing (16 bytes).
    block: f64,
    /// The share of lost frames.
    lost: f64,
}

impl Case {
    /// The duration in seconds, on a bus that carries nothing else, to devices whose flash keeps up.
    fn seconds(&self) -> f64 {
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
    let page = files::ours("docs/bench.md")?;
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

/// The ways with their colours.
const WAYS: [(Way, &str); 3] =
    [(Way::InTurn, "#9ca3af"), (Way::OneByOne, "#2563eb"), (Way::Together, "#dc2626")];

fn clock(seconds: f64) -> String {
    let seconds = seconds.round() as u32;
    format!("{}:{:02}", seconds / 60, seconds % 60)
}

const LEFT: f64 = 60.0;
const BOTTOM: f64 = 370.0;

/// The place of a point; both axes are logarithmic: 1 to 100 devices, 3 to 1000 seconds.
fn place(devices: f64, seconds: f64) -> (f64, f64) {
    let x = LEFT + devices.log10() / 2.0 * 480.0;
    let y = BOTTOM - (seconds / 3.0).log10() / (1000.0_f64 / 3.0).log10() * 330.0;
    (x, y)
}

const RATES: [f64; 4] = [125e3, 250e3, 500e3, 1e6];
const COUNTS: [f64; 5] = [2.0, 8.0, 32.0, 64.0, 94.0];
const LOST: [f64; 3] = [0.0, 1e-5, 1e-3];

/// The table of docs/fleet.md: minutes and seconds.
fn table() -> String {
    let mut table =
        "| kbit/s | devices | one after the other | at the same time | together |\n|---|---|---|---|---|\n"
            .to_string();
    for bit_rate in RATES {
        for devices in COUNTS {
            let _ = write!(table, "| {} | {devices} |", bit_rate / 1e3);
            for (way, _) in WAYS {
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
    let page = files::ours("docs/fleet.md").unwrap();
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

/// A program of 256 KiB at 1 Mbit/s: the lines of the model end at 94 devices, and the measured points
/// are where they were measured.
#[test]
fn the_picture_has_the_model_and_what_was_measured() {
    let picture = files::ours("docs/diagrams/fleet.svg").unwrap();
    for (way, colour) in WAYS {
        for lost in [0.0, 1e-3] {
            let case = |devices| Case { way, devices, bit_rate: 1e6, kib: 256.0, block: way.block(), lost };
            let [from, to] = [1.0, 94.0].map(|devices| {
                let (x, y) = place(devices, case(devices).seconds());
                format!("{x:.1},{y:.1}")
            });
            let is_line = |line: &&str| {
                line.starts_with(&format!("<polyline points=\"{from} ")) && line.contains(&format!(" {to}\""))
            };
            assert!(picture.lines().any(|line| is_line(&line) && line.contains(colour)), "{way:?} {lost}");
        }
    }
    let measured = measured().unwrap();
    let points: Vec<_> = measured.iter().filter(|row| row.case.block == row.case.way.block()).collect();
    for Measured { case, seconds } in &points {
        let (x, y) = place(case.devices, *seconds);
        assert!(picture.contains(&format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\"")), "{case:?}");
    }
    assert_eq!(picture.matches("<circle").count(), points.len());
}
