//! `cargo xtask bench`: how fast a program gets into the device, beside the limits of wire and flash.

use std::process::ExitCode;

use canopen::BitRate;
use coboot_tests::throughput::{measure, Measurement};

const RATES: [BitRate; 4] = [BitRate::K125, BitRate::K250, BitRate::K500, BitRate::K1000];
const SIZES: [u32; 3] = [64, 256, 900];

fn main() -> ExitCode {
    let json = match std::env::args().nth(1).as_deref() {
        None => false,
        Some("--json") => true,
        Some(other) => {
            eprintln!("bench: {other:?} is no option; there is --json.");
            return ExitCode::FAILURE;
        }
    };
    if !json {
        println!("From CLEAR to verified, in virtual time; blocks of 4 KiB by SDO block transfer.\n");
        println!("   kbit/s   KiB     measured   wire limit  flash limit   of the limit   KiB/s");
    }
    let mut rows = Vec::new();
    for rate in RATES {
        for kib in SIZES {
            let row = measure(rate, kib);
            if json {
                rows.push(as_json(&row));
            } else {
                println!("{}", as_text(&row));
            }
        }
    }
    if json {
        println!("[\n{}\n]", rows.join(",\n"));
    }
    ExitCode::SUCCESS
}

fn as_text(row: &Measurement) -> String {
    let seconds = |us: u64| format!("{:.3} s", us as f64 / 1e6);
    format!(
        "{:>9} {:>5} {:>12} {:>12} {:>12} {:>12} % {:>8.1}",
        row.bit_rate / 1000,
        row.kib,
        seconds(row.took),
        seconds(row.wire),
        seconds(row.flash),
        row.percent(),
        f64::from(row.kib) * 1e6 / row.took as f64
    )
}

fn as_json(row: &Measurement) -> String {
    format!(
        "  {{\"bit_rate\": {}, \"kib\": {}, \"measured_us\": {}, \"wire_limit_us\": {}, \"flash_limit_us\": {}, \"percent\": {}}}",
        row.bit_rate,
        row.kib,
        row.took,
        row.wire,
        row.flash,
        row.percent()
    )
}
