//! `cargo xtask bench`: the speed of a download, compared with the limits of wire and flash.

use std::process::ExitCode;

use canopen::BitRate;
use coboot_tests::fleet::{self, Way};
use coboot_tests::throughput::{load, measure, measure_form, Form, Load, Measurement, OfForm};

const RATES: [BitRate; 4] = [BitRate::K125, BitRate::K250, BitRate::K500, BitRate::K1000];
const SIZES: [u32; 3] = [64, 256, 896];
/// The default of `coflash`, which the downloads above use.
const BLOCK_SIZES: [usize; 2] = [1024, 4096];

fn main() -> ExitCode {
    let json = match std::env::args().nth(1).as_deref() {
        None => false,
        Some("--json") => true,
        Some(other) => {
            eprintln!("bench: {other:?} is not an option; the only option is --json.");
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
    if !json {
        println!("\nThe bus while `coflash flash` sends a program, from the first block to verified.\n");
        println!("   kbit/s   KiB  block size     measured    frames     busy");
    }
    let mut loads = Vec::new();
    for rate in RATES {
        for block_size in BLOCK_SIZES {
            let row = load(rate, 256, block_size);
            if json {
                loads.push(load_as_json(&row));
            } else {
                println!("{}", load_as_text(&row));
            }
        }
    }
    if !json {
        println!("\nA program of 256 KiB as one file, from CLEAR to verified; the wire limit is that of the raw program.\n");
        println!("   kbit/s        form   bytes sent     measured   wire limit   of the limit   flash limit");
    }
    let mut forms = Vec::new();
    for rate in RATES {
        for form in [Form::Raw, Form::Sealed, Form::Compressed] {
            let row = measure_form(rate, 256, form);
            if json {
                forms.push(form_as_json(&row));
            } else {
                println!("{}", form_as_text(&row));
            }
        }
    }
    if !json {
        println!("\nA program of 256 KiB to several boards at 1 Mbit/s, from the first request until the last board runs it.\n");
        println!("   boards          way  block size   lost frames     measured   of one board");
    }
    let mut fleets = Vec::new();
    fleet::measure(|row| {
        if json {
            fleets.push(fleet_as_json(&row));
        } else {
            println!("{}", fleet_as_text(&row));
        }
    });
    if json {
        let (forms, fleets) = (forms.join(",\n"), fleets.join(",\n"));
        let (rows, loads) = (rows.join(",\n"), loads.join(",\n"));
        println!("{{\"downloads\": [\n{rows}\n],\n\"bus\": [\n{loads}\n],\n\"forms\": [\n{forms}\n],\n\"fleets\": [\n{fleets}\n]}}");
    }
    ExitCode::SUCCESS
}

fn way(row: &fleet::Measurement) -> &'static str {
    match row.way {
        Way::Together => "together",
        Way::OneByOne => "one by one",
    }
}

fn fleet_as_text(row: &fleet::Measurement) -> String {
    let lost = match row.lost_one_in {
        0 => "none".to_string(),
        frames => format!("1 in {frames}"),
    };
    let share = row.took.as_secs_f64() / row.one.as_secs_f64();
    format!(
        "{:>9} {:>12} {:>11} {lost:>13} {:>10.3} s {share:>12.2} x",
        row.boards,
        way(row),
        row.block_size,
        row.took.as_secs_f64()
    )
}

fn fleet_as_json(row: &fleet::Measurement) -> String {
    format!(
        "  {{\"boards\": {}, \"way\": \"{}\", \"block_size\": {}, \"lost_one_in\": {}, \"measured_us\": {}}}",
        row.boards,
        way(row),
        row.block_size,
        row.lost_one_in,
        row.took.as_micros()
    )
}

fn load_as_text(row: &Load) -> String {
    format!(
        "{:>9} {:>5} {:>11} {:>10.3} s {:>9} {:>6} %",
        row.bit_rate / 1000,
        row.kib,
        row.block_size,
        row.took as f64 / 1e6,
        row.frames,
        row.percent()
    )
}

fn load_as_json(row: &Load) -> String {
    format!(
        "  {{\"bit_rate\": {}, \"kib\": {}, \"block_size\": {}, \"measured_us\": {}, \"busy_us\": {}, \"frames\": {}, \"percent\": {}}}",
        row.bit_rate,
        row.kib,
        row.block_size,
        row.took,
        row.busy,
        row.frames,
        row.percent()
    )
}

fn name(form: Form) -> &'static str {
    match form {
        Form::Raw => "raw",
        Form::Sealed => "sealed",
        Form::Compressed => "compressed",
    }
}

fn form_as_text(row: &OfForm) -> String {
    let seconds = |us: u64| format!("{:.3} s", us as f64 / 1e6);
    format!(
        "{:>9} {:>11} {:>12} {:>12} {:>12} {:>12} % {:>13}",
        row.bit_rate / 1000,
        name(row.form),
        row.file,
        seconds(row.took),
        seconds(row.wire),
        row.percent(),
        seconds(row.flash)
    )
}

fn form_as_json(row: &OfForm) -> String {
    format!(
        "  {{\"bit_rate\": {}, \"kib\": {}, \"form\": \"{}\", \"bytes_sent\": {}, \"measured_us\": {}, \"wire_limit_us\": {}, \"flash_limit_us\": {}, \"percent\": {}}}",
        row.bit_rate,
        row.kib,
        name(row.form),
        row.file,
        row.took,
        row.wire,
        row.flash,
        row.percent()
    )
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
