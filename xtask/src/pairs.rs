//! `cargo xtask pairs`: builds bootloaders so that every pair of choices of a product is together
//! in at least one.

use shared_abi::layout::{Layout, BOARDS};

use crate::args::Args;
use crate::product::Product;
use crate::setup::{self, Part};
use crate::size::{budgets, spare, within};
use crate::{build, files, outcome::Outcome, workspace};

pub const HELP: &str = "\
usage: cargo xtask pairs [--spread]

Builds bootloaders whose products differ from the default in many choices at once, so that any two
values of any two choices are together in one of them (a covering array), sealed images included, and
fails when one does not build, is over the budget of its flash, or leaves fewer than 512 bytes of it free on
the compact map. It prints the choices and the size of each.

  --spread        each of them for one board, the next for the next; without, each for every board
";

/// The fields of a product that are varied, and their values, as the product's file writes them; and
/// the feature [`SEALED`]. The first value is the default (that of the split map).
const FIELDS: [(&str, &[&str]); 50] = [
    ("profile", &["Profile::STANDARD", "Profile::PAULUS", "Profile::ESACADEMY", "Profile::LIFT"]),
    ("autostart", &["Autostart::InOrder", "Autostart::List(&[])", "Autostart::Function(|| &[1])"]),
    ("rescue_window_ms", &["300", "0"]),
    ("rescue_window_confirmed_ms", &["0", "100"]),
    ("node_ids", &["1..=127", "1..=100"]),
    ("bit_rates", &["0..=8", "2..=6"]),
    ("node_source", &["NodeSource::Stored", "NodeSource::Constant", SWITCHES]),
    ("boot_up_message", &["true", "false"]),
    ("crystal_failure", &["CrystalFailure::Silent", "CrystalFailure::RunFromHsi"]),
    ("sdo_request_base", &["0x600", "0x300"]),
    ("sdo_response_base", &["0x580", "0x480"]),
    ("auto_bit_rate", &["true", "false"]),
    ("boot_up_emergency", &["true", "false"]),
    ("heartbeat_ms", &["1000", "0"]),
    ("lss", &["true", "false"]),
    ("lss_start_in_configuration", &["false", "true"]),
    ("lss_announce", &["false", "true"]),
    ("lss_identify", &["true", "false"]),
    ("lss_store", &["true", "false"]),
    ("block_download", &["true", "false"]),
    ("segments_per_sub_block", &["127", "1"]),
    ("receive_queue", &["32", "8"]),
    ("block_upload", &["true", "false"]),
    ("identity_check", &["true", "false"]),
    ("check", &["|_, _| Verdict::Standard", "|_, _| Verdict::Accept"]),
    ("programming_allowed", &["|| true", "|| bsp::inputs('C') & 2 != 0"]),
    ("erase", &["None", "Some(|_| Erase::AtOnce)"]),
    ("start_allowed", &["|_| true", "|_| bsp::inputs('C') & 1 != 0"]),
    ("crc", &["CrcKind::Crc32", CRC_16]),
    ("crc_step", &["1024", "64 * 1024"]),
    ("block_buffer", &["80 * 1024", "1024"]),
    ("watchdog_ms", &["Some(1000)", "None"]),
    ("program_watchdog_ms", &["None", "Some(1000)"]),
    ("answer_to_reset_ms", &["15", "50"]),
    ("max_crash_resets", &["3", "1"]),
    ("security_counter", &["0", "5"]),
    ("counter_with_confirmation", &["false", "true"]),
    ("second_server", &["true", "false"]),
    ("resume", &["true", "false"]),
    ("read_back", &["true", "false"]),
    ("program_date", &["true", "false"]),
    ("intel_hex", &["true", "false"]),
    ("renewal", &["LAYOUT.staging.is_some()", "false"]),
    ("renewal_s", &["60", "1"]),
    ("bootloader_counter", &["0", "3"]),
    ("bootloader_revisions", &["0", "1"]),
    (SEALED, &["false", "true"]),
    // The compact map has no room for these three in the largest product.
    ("two_resets", &["false", "LAYOUT.home.is_some()"]),
    ("rom_loader", &["false", "LAYOUT.home.is_some()"]),
    ("identity", &["IdentitySource::Board", NAMEPLATE]),
];

/// Sealed images: a feature, no field of a product. On the compact map the row has its other choices alone.
const SEALED: &str = "sealed";

const NAMEPLATE: &str = "if LAYOUT.home.is_some() { IdentitySource::Otp } else { IdentitySource::Board }";

const CRC_16: &str = "if LAYOUT.home.is_some() { CrcKind::Crc16 } else { CrcKind::Crc32 }";

/// Seven switches for the node-ID, four for the bit rate.
const SWITCHES: &str = "NodeSource::Function(|| {
        let switches = bsp::inputs('E');
        ((switches >> 8) as u8 & 0x7F, (switches >> 4) as u8 & 0xF)
    })";

/// The values of a product, in the order of [`FIELDS`]; 0 is the default.
type Row = [u8; FIELDS.len()];

pub fn run(mut args: Args) -> Outcome {
    let spread = args.flag("--spread");
    args.none_left()?;
    setup::prepare(&[Part::Firmware])?;
    let rows = covering();
    let mut largest = 0;
    let folder = workspace::target_dir().join("pairs");
    for (number, row) in rows.iter().enumerate() {
        println!("{:>2}  {}", number + 1, words(row));
        let path = folder.join(format!("pairs-{:02}.rs", number + 1));
        files::write(&path, file(row))?;
        let product = Product::of_file(&path)?;
        let of_row = if spread { &BOARDS[number % BOARDS.len()..][..1] } else { BOARDS };
        for board in of_row {
            let used = size(board, row, &product)?;
            largest = largest.max(used);
            println!("    {:<24} {used:>6} bytes", board.board);
        }
    }
    println!("{} products, every pair of values among them; the largest has {largest} bytes", rows.len());
    Ok(())
}

/// The file of the product with these choices.
fn file(row: &Row) -> String {
    let mut file = String::from(
        "//! A product of `cargo xtask pairs`.

use super::*;

/// The choices of this product.
pub const PRODUCT: Product = Product {
",
    );
    let others = FIELDS.iter().zip(row).filter(|((name, _), value)| **value > 0 && *name != SEALED);
    for ((name, values), value) in others {
        file += &format!("    {name}: {},\n", values[usize::from(*value)]);
    }
    // The first field is the profile, by which the defaults of the compact map differ.
    file + &format!("    ..Product::of({})\n}};\n", FIELDS[0].1[usize::from(row[0])])
}

/// The size in a board's flash of the bootloader of this product, in bytes; an error if it is over the
/// budget.
fn size(board: &Layout, row: &Row, product: &Product) -> Outcome<u32> {
    let told = |problem: String| format!("{}, {}: {problem}", board.board, words(row));
    let is_sealed = FIELDS.iter().zip(row).any(|((name, _), value)| *name == SEALED && *value > 0);
    let features = if is_sealed && board.home.is_some() { SEALED } else { "" };
    let used = build::bootloader_size(board, features, product).map_err(told)?;
    for (bytes, budget) in used.iter().zip(budgets(board)) {
        within(*bytes, budget).map_err(told)?;
    }
    if board.home.is_none() {
        spare(used.iter().sum()).map_err(told)?;
    }
    Ok(used.iter().sum())
}

/// The fields that differ from their default.
fn words(row: &Row) -> String {
    let others = FIELDS.iter().zip(row).filter(|(_, value)| **value > 0);
    others.map(|((name, _), value)| format!("{name}={value}")).collect::<Vec<_>>().join(" ")
}

/// Whether a product may have these choices (`Product::checked`): a rescue window delays a program
/// that starts by itself, so it needs such a program; a sealed image carries a CRC-32; a silent device waits
/// for LSS; a renewal needs the watchdog; a group needs block download; a sealed device has no ROM loader. `None` is a field without a choice yet.
fn allowed(row: &[Option<u8>; FIELDS.len()]) -> bool {
    let is = |name: &str, value: u8| {
        FIELDS.iter().zip(row).any(|((field, _), chosen)| *field == name && *chosen == Some(value))
    };
    let window = is("rescue_window_ms", 0) || is("rescue_window_confirmed_ms", 1);
    let is_mute = is("lss", 1) && is("crystal_failure", 0);
    let hangs = is("renewal", 0) && is("watchdog_ms", 1);
    let is_slow = is("second_server", 0) && is("block_download", 1);
    let is_open = is("crc", 1) || is("rom_loader", 1);
    !(is("autostart", 1) && window || is(SEALED, 1) && is_open || is_mute || hangs || is_slow)
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
            row[field] = (0..FIELDS[field].1.len() as u8).rev().max_by_key(|value| adds(*value));
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
            for value_a in 0..FIELDS[a].1.len() as u8 {
                for value_b in 0..FIELDS[b].1.len() as u8 {
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

    /// Counted by hand: 4 for each pair of the 47 fields with two values, 6 with each of the two with three,
    /// 8 with the one with four; 9 and twice 12 between these; seven are not permitted.
    #[test]
    fn every_pair_stands_in_a_row_and_no_row_contradicts_itself() {
        let rows = covering();
        assert_eq!(pairs().len(), 47 * 46 / 2 * 4 + 47 * 6 * 2 + 47 * 8 + 9 + 12 * 2 - 7);
        for ((a, value_a), (b, value_b)) in pairs() {
            assert!(rows.iter().any(|row| row[a] == value_a && row[b] == value_b), "{a} {b}");
        }
        for row in &rows {
            assert!(allowed(&row.map(Some)), "{}", words(row));
            assert!(row.iter().zip(FIELDS).all(|(value, (_, values))| usize::from(*value) < values.len()));
        }
        assert!((12..=28).contains(&rows.len()), "{} rows", rows.len());
    }

    /// Our client meets our server with each value. One that reads a pin needs a chip, as the renewal of a
    /// bootloader does.
    #[test]
    fn the_client_meets_each_value() {
        let bare = |text: &str| text.split_whitespace().collect::<String>();
        let rows = bare(include_str!("../../tests/update/choices.rs"));
        for (name, values) in FIELDS.iter().filter(|(name, _)| ![SEALED, "renewal"].contains(name)) {
            for value in values.iter().skip(1).filter(|value| !value.contains("bsp::")) {
                assert!(rows.contains(&bare(&format!("{name}: {value}"))), "{name}: {value}");
            }
        }
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
        let mut varied: Vec<_> =
            FIELDS.iter().map(|(name, _)| *name).filter(|name| *name != SEALED).collect();
        fields.retain(|name| *name != "resident"); // tests/port/porting.rs
        fields.sort_unstable();
        varied.sort_unstable();
        assert_eq!(varied, fields);
    }
}
