//! `cargo xtask pairs`: builds bootloaders so that every pair of choices of a product is together
//! in at least one.

use shared_abi::layout::{Layout, BOARDS};

use crate::args::Args;
use crate::elf::Elf;
use crate::footprint::{kib, Flash};
use crate::setup::{Part, Setup};
use crate::{build, Outcome};

pub const HELP: &str = "\
usage: cargo xtask pairs [--spread] [--yes]

Builds bootloaders whose products differ from the default in many choices at once, so that any two
values of any two choices stand together in one of them (a covering array), and fails when one does not
build or does not fit its flash. It prints the choices and the size of each.

  --spread   each of them for one board, the next for the next; without, each for every board
  --yes      installs what is missing with sudo
";

/// The fields of a product that are varied, and their numbers of values. The values themselves are
/// in `bootloader/src/test_products.rs`, in the same order.
const FIELDS: [(&str, u8); 34] = [
    ("profile", 4),
    ("autostart", 2),
    ("rescue_window_ms", 2),
    ("rescue_window_confirmed_ms", 2),
    ("node_ids", 2),
    ("bit_rates", 2),
    ("node_source", 3),
    ("boot_up_message", 2),
    ("sdo_request_base", 2),
    ("sdo_response_base", 2),
    ("auto_bit_rate", 2),
    ("boot_up_emergency", 2),
    ("heartbeat_ms", 2),
    ("lss", 2),
    ("lss_start_in_configuration", 2),
    ("lss_announce", 2),
    ("lss_store", 2),
    ("block_upload", 2),
    ("identity_check", 2),
    ("check", 2),
    ("programming_allowed", 2),
    ("erase", 2),
    ("start_allowed", 2),
    ("crc", 2),
    ("crc_step", 2),
    ("block_buffer", 2),
    ("watchdog_ms", 2),
    ("program_watchdog_ms", 2),
    ("answer_to_reset_ms", 2),
    ("max_crash_resets", 2),
    ("security_counter", 2),
    ("counter_with_confirmation", 2),
    ("second_server", 2),
    ("resume", 2),
];

/// The values of a product, in the order of [`FIELDS`]; 0 is the default.
type Row = [u8; FIELDS.len()];

pub fn run(mut args: Args) -> Outcome {
    let setup = Setup::from(&mut args);
    let spread = args.flag("--spread");
    args.none_left()?;
    setup.prepare(&[Part::Firmware])?;
    let rows = covering();
    let mut largest = 0;
    for (number, row) in rows.iter().enumerate() {
        println!("{:>2}  {}", number + 1, words(row));
        let one = [BOARDS[number % BOARDS.len()]];
        for board in if spread { &one[..] } else { BOARDS } {
            let used = size(board, row)?;
            largest = largest.max(used);
            println!("    {:<24} {used:>6} bytes", board.board);
        }
    }
    println!("{} products, every pair of values among them; the largest has {largest} bytes", rows.len());
    Ok(())
}

/// The size in a board's flash of the bootloader with these choices, in bytes.
fn size(board: &Layout, row: &Row) -> Outcome<u32> {
    let product: String =
        std::iter::once(':').chain(row.iter().map(|value| char::from(b'0' + value))).collect();
    let told = |problem: String| format!("{}, {}: {problem}", board.board, words(row));
    let elf = build::to_look_at(board, "", Some(&product)).map_err(told)?;
    let used = Flash::of(&Elf::parse(&elf)?, board.bootloader).map_err(told)?.used;
    if used > board.bootloader.size {
        return Err(told(format!("{used} bytes, of {}", kib(board.bootloader.size))));
    }
    Ok(used)
}

/// The fields that differ from their default.
fn words(row: &Row) -> String {
    let others = FIELDS.iter().zip(row).filter(|(_, value)| **value > 0);
    let words: Vec<_> = others
        .map(
            |((name, values), value)| {
                if *values > 2 {
                    format!("{name}={value}")
                } else {
                    (*name).to_owned()
                }
            },
        )
        .collect();
    if words.is_empty() {
        "the default".to_owned()
    } else {
        words.join(" ")
    }
}

/// Whether a product may have these choices (`Product::checked`): a rescue window delays a program
/// that starts by itself, so it needs such a program. `None` is a field without a choice yet.
fn allowed(row: &[Option<u8>; FIELDS.len()]) -> bool {
    let (autostart_off, window, window_confirmed) = (row[1] == Some(1), row[2] == Some(0), row[3] == Some(1));
    !(autostart_off && (window || window_confirmed))
}

/// Rows in which any two compatible values are together at least once. Each row takes a pair that
/// is in no row yet, and then, field by field, the value that adds most such pairs. The result is
/// always the same.
fn covering() -> Vec<Row> {
    let mut open = pairs();
    let mut rows = Vec::new();
    while let Some(&(a, b)) = open.first() {
        let mut row = [None; FIELDS.len()];
        (row[a.0], row[b.0]) = (Some(a.1), Some(b.1));
        for field in 0..FIELDS.len() {
            if row[field].is_some() {
                continue;
            }
            let adds = |value: u8| {
                let mut with = row;
                with[field] = Some(value);
                let new = open.iter().filter(|(a, b)| with[a.0] == Some(a.1) && with[b.0] == Some(b.1));
                allowed(&with).then(|| new.count())
            };
            // Of equal values it takes the first: the default.
            row[field] = (0..FIELDS[field].1).rev().max_by_key(|value| adds(*value));
        }
        let row = row.map(|value| value.unwrap_or(0));
        open.retain(|(a, b)| row[a.0] != a.1 || row[b.0] != b.1);
        rows.push(row);
    }
    rows
}

/// A field and one of its values.
type Choice = (usize, u8);

/// All permitted pairs of values of two fields.
fn pairs() -> Vec<(Choice, Choice)> {
    let mut pairs = Vec::new();
    for a in 0..FIELDS.len() {
        for b in a + 1..FIELDS.len() {
            for value_a in 0..FIELDS[a].1 {
                for value_b in 0..FIELDS[b].1 {
                    let mut row = [None; FIELDS.len()];
                    (row[a], row[b]) = (Some(value_a), Some(value_b));
                    if allowed(&row) {
                        pairs.push(((a, value_a), (b, value_b)));
                    }
                }
            }
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counted by hand: 32 fields with two values, one with three, one with four.
    #[test]
    fn every_pair_stands_in_a_row_and_no_row_contradicts_itself() {
        let rows = covering();
        // 4 for each pair of the 32, 6 and 8 with the larger ones, 12 between these; two are not
        // permitted.
        assert_eq!(pairs().len(), 32 * 31 / 2 * 4 + 32 * 6 + 32 * 8 + 12 - 2);
        for ((a, value_a), (b, value_b)) in pairs() {
            assert!(rows.iter().any(|row| row[a] == value_a && row[b] == value_b), "{a} {b}");
        }
        for row in &rows {
            assert!(allowed(&row.map(Some)), "{}", words(row));
            assert!(row.iter().zip(FIELDS).all(|(value, (_, values))| *value < values));
        }
        assert!((12..=24).contains(&rows.len()), "{} rows", rows.len());
    }

    /// The names are those of the struct, so that a new field of the product is varied, too.
    #[test]
    fn the_fields_are_those_of_the_product() {
        let source = include_str!("../../bootloader/src/product.rs");
        let (_, fields) = source.split_once("pub struct Product {").unwrap();
        let (fields, _) = fields.split_once("\n}").unwrap();
        let mut fields: Vec<_> = fields
            .lines()
            .filter_map(|line| Some(line.strip_prefix("    pub ")?.split_once(':')?.0))
            .collect();
        let mut varied: Vec<_> = FIELDS.iter().map(|(name, _)| *name).collect();
        fields.sort_unstable();
        varied.sort_unstable();
        assert_eq!(varied, fields);
    }
}
