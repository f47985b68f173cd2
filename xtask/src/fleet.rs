//! Tests of docs/fleet.md: how long an update of many devices takes, by a model without lost frames. It is
//! compared with the page's table, its picture, and what docs/bench.md has measured.

use crate::files;

/// How the program gets to the devices: one after the other, by downloads at the same time, or by one
/// download for all. With the colours of the picture.
const WAYS: [(&str, &str); 3] = [("in turn", "#9ca3af"), ("one by one", "#2563eb"), ("together", "#dc2626")];

/// The seconds for 256 KiB in blocks of this many bytes with their framing, on a bus that carries nothing
/// else, to devices whose flash keeps up.
fn seconds(way: &str, devices: f64, bit_rate: f64, block: f64) -> f64 {
    // With 8 bytes of data: 111 bits with the intermission, and stuff bits as code has them on average.
    let frame = 118.0 / bit_rate;
    // Identity, block 0, last block, CRC, trial and start.
    let fixed = 0.4;
    let blocks = 256.0 * 1024.0 / (block - 16.0);
    let segments = (block / 7.0).ceil();
    // A sub-block has 127 segments; begin and end of a block are answered, too.
    let answers = (segments / 127.0).ceil() + 2.0;
    // With the status afterwards.
    let single = segments + 2.0 + answers + 2.0;
    match way {
        "in turn" => devices * (blocks * single * frame + fixed),
        // The wire is never idle, so one device waits while others are served.
        "one by one" => blocks * devices * single * frame + fixed,
        _ => blocks * (segments + 2.0 + devices * answers) * frame + fixed,
    }
}

/// Bytes of a block with its framing, by default.
fn block(way: &str) -> f64 {
    if way == "together" {
        4096.0
    } else {
        1024.0
    }
}

/// The rows of docs/bench.md for fleets at 1 Mbit/s that lost no frame: devices, way, bytes of a block,
/// seconds.
fn measured() -> Vec<(f64, &'static str, f64, f64)> {
    let row = |line: &str| {
        let (way, _) = WAYS.into_iter().find(|(way, _)| line.contains(way))?;
        let words: Vec<&str> = line.split(way).flat_map(str::split_whitespace).collect();
        let [devices, block, "none", seconds, "s", _, "x"] = words[..] else { return None };
        Some((devices.parse().ok()?, way, block.parse().ok()?, seconds.parse().ok()?))
    };
    files::ours("docs/bench.md").unwrap().lines().filter_map(row).collect()
}

#[test]
fn the_page_has_the_table_of_the_model() {
    let clock =
        |seconds: f64| format!("{:.0}:{:02.0}", (seconds.round() / 60.0).floor(), seconds.round() % 60.0);
    let mut table = String::from(
        "| kbit/s | devices | one after the other | at the same time | together |\n|---|---|---|---|---|\n",
    );
    for bit_rate in [125e3, 250e3, 500e3, 1e6] {
        for devices in [2.0, 8.0, 32.0, 64.0, 94.0] {
            let times = WAYS.map(|(way, _)| clock(seconds(way, devices, bit_rate, block(way))));
            table += &format!("| {} | {devices} | {} |\n", bit_rate / 1e3, times.join(" | "));
        }
    }
    let page = files::ours("docs/fleet.md").unwrap();
    assert!(page.contains(&table), "docs/fleet.md has another table than:\n{table}");
}

#[test]
fn the_model_fits_what_was_measured() {
    let rows = measured();
    assert!(rows.len() >= 6, "{rows:?}");
    for row @ (devices, way, block, measured) in rows {
        let modelled = seconds(way, devices, 1e6, block);
        assert!((modelled / measured - 1.0).abs() < 0.1, "{row:?}: {modelled:.2} s");
    }
}

/// A program of 256 KiB at 1 Mbit/s: the lines of the model end at 94 devices, and the measured points
/// are where they were measured. Both axes are logarithmic: 1 to 100 devices, 3 to 1000 seconds.
#[test]
fn the_picture_has_the_model_and_what_was_measured() {
    let place = |devices: f64, seconds: f64| {
        let y = 370.0 - (seconds / 3.0).log10() / (1000.0_f64 / 3.0).log10() * 330.0;
        (60.0 + devices.log10() / 2.0 * 480.0, y)
    };
    let picture = files::ours("docs/diagrams/fleet.svg").unwrap();
    for (way, colour) in WAYS {
        let [from, to] = [1.0, 94.0].map(|devices| {
            let (x, y) = place(devices, seconds(way, devices, 1e6, block(way)));
            format!("{x:.1},{y:.1}")
        });
        let is_line = |line: &str| {
            line.starts_with(&format!("<polyline points=\"{from} ")) && line.contains(&format!(" {to}\" "))
        };
        assert!(picture.lines().any(|line| is_line(line) && line.contains(colour)), "{way}");
    }
    let points: Vec<_> = measured().into_iter().filter(|(_, way, size, _)| *size == block(way)).collect();
    for point @ (devices, _, _, seconds) in &points {
        let (x, y) = place(*devices, *seconds);
        assert!(picture.contains(&format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\"")), "{point:?}");
    }
    assert_eq!(picture.matches("<circle").count(), points.len());
}
