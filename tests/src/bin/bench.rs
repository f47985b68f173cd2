//! `cargo xtask bench`: the speed of a download, compared with the limits of wire and flash.

use std::process::ExitCode;

use canopen::BitRate;
use coboot_tests::fleet::{self, Distribution};
use coboot_tests::throughput::{load, measure, measure_form, Form, Load, Measurement, OfForm};
use serde_json::{json, Value};

const RATES: [BitRate; 4] = [BitRate::K125, BitRate::K250, BitRate::K500, BitRate::K1000];
const SIZES: [u32; 3] = [64, 256, 896];
/// The default of `coflash`, which the downloads above use.
const BLOCK_SIZES: [usize; 2] = [1024, 4096];

/// A row: its line in a table of text, and its object in JSON.
type Row = (String, Value);
/// What takes the rows of a table.
type Rows<'a> = &'a mut dyn FnMut(Row);

fn main() -> ExitCode {
    let json = match std::env::args().nth(1).as_deref() {
        None => false,
        Some("--json") => true,
        Some(other) => {
            eprintln!("bench: {other:?} is not an option; the only option is --json.");
            return ExitCode::FAILURE;
        }
    };
    // Prints a table, row by row as they are measured, or returns it as JSON.
    let table = |heads: &str, measure: &mut dyn FnMut(Rows<'_>)| -> Value {
        if !json {
            println!("{heads}");
        }
        let mut rows = Vec::new();
        measure(&mut |(text, row)| if json { rows.push(row) } else { println!("{text}") });
        rows.into()
    };
    let downloads = table(
        "From CLEAR to verified, in virtual time; blocks of 4 KiB by SDO block transfer.\n\n   \
         kbit/s   KiB     measured   wire limit  flash limit   of the limit   KiB/s",
        &mut |row| {
            RATES.iter().for_each(|rate| SIZES.iter().for_each(|kib| row(download(&measure(*rate, *kib)))))
        },
    );
    let bus = table(
        "\nThe bus while `coflash flash` sends a program, from the first block to verified.\n\n   \
         kbit/s   KiB  block size     measured    frames     busy",
        &mut |row| {
            RATES
                .iter()
                .for_each(|rate| BLOCK_SIZES.iter().for_each(|size| row(busy(&load(*rate, 256, *size)))));
        },
    );
    let forms = table(
        "\nA program of 256 KiB as one file, from CLEAR to verified; the wire limit is that of the raw program.\n\n   \
         kbit/s        form   bytes sent     measured   wire limit   of the limit   flash limit",
        &mut |row| {
            let forms = [(Form::Raw, "raw"), (Form::Sealed, "sealed"), (Form::Compressed, "compressed")];
            RATES.iter().for_each(|rate| {
                forms.iter().for_each(|(form, name)| row(of_form(&measure_form(*rate, 256, *form), name)));
            });
        },
    );
    let fleets = table(
        "\nA program of 256 KiB to several boards at 1 Mbit/s, from the first request until the last board runs it.\n\n   \
         boards          way  block size   lost frames     measured   of one board",
        &mut |row| fleet::measure(|measured| row(fleet(&measured))),
    );
    if json {
        println!("{}", json!({ "downloads": downloads, "bus": bus, "forms": forms, "fleets": fleets }));
    }
    ExitCode::SUCCESS
}

fn seconds(us: u64) -> String {
    format!("{:.3} s", us as f64 / 1e6)
}

fn download(row: &Measurement) -> Row {
    let (kbit, percent) = (row.bit_rate / 1000, row.percent());
    let [took, wire, flash] = [row.took, row.wire, row.flash].map(seconds);
    let speed = f64::from(row.kib) * 1e6 / row.took as f64;
    let text =
        format!("{kbit:>9} {:>5} {took:>12} {wire:>12} {flash:>12} {percent:>12} % {speed:>8.1}", row.kib);
    let Measurement { bit_rate, kib, took, wire, flash } = row;
    (
        text,
        json!({
            "bit_rate": bit_rate, "kib": kib, "measured_us": took, "wire_limit_us": wire, "flash_limit_us": flash,
            "percent": percent,
        }),
    )
}

fn busy(row: &Load) -> Row {
    let Load { bit_rate, kib, block_size, took, busy, frames } = row;
    let (kbit, percent, measured) = (bit_rate / 1000, row.percent(), seconds(*took));
    (
        format!("{kbit:>9} {kib:>5} {block_size:>11} {measured:>12} {frames:>9} {percent:>6} %"),
        json!({
            "bit_rate": bit_rate, "kib": kib, "block_size": block_size, "measured_us": took, "busy_us": busy,
            "frames": frames, "percent": percent,
        }),
    )
}

fn of_form(row: &OfForm, form: &str) -> Row {
    let (kbit, percent) = (row.bit_rate / 1000, row.percent());
    let [took, wire, flash] = [row.took, row.wire, row.flash].map(seconds);
    let text =
        format!("{kbit:>9} {form:>11} {:>12} {took:>12} {wire:>12} {percent:>12} % {flash:>13}", row.file);
    let OfForm { bit_rate, kib, file, took, wire, flash, .. } = row;
    (
        text,
        json!({
            "bit_rate": bit_rate, "kib": kib, "form": form, "bytes_sent": file, "measured_us": took,
            "wire_limit_us": wire, "flash_limit_us": flash, "percent": percent,
        }),
    )
}

fn fleet(row: &fleet::Measurement) -> Row {
    let fleet::Measurement { boards, distribution, block_size, lost_one_in, took, one } = row;
    let way = match distribution {
        Distribution::Together => "together",
        Distribution::OneByOne => "one by one",
    };
    let lost = if *lost_one_in == 0 { "none".to_owned() } else { format!("1 in {lost_one_in}") };
    let (s, share) = (took.as_secs_f64(), took.as_secs_f64() / one.as_secs_f64());
    (
        format!("{boards:>9} {way:>12} {block_size:>11} {lost:>13} {s:>10.3} s {share:>12.2} x"),
        json!({
            "boards": boards, "way": way, "block_size": block_size, "lost_one_in": lost_one_in,
            "measured_us": took.as_micros() as u64,
        }),
    )
}
