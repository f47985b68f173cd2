//! `cargo xtask pairs`: builds bootloaders so that every pair of choices of a product is together
//! in at least one.

use shared_abi::layout::{Layout, BOARDS};

use crate::args::Args;
use crate::product::Product;
use crate::setup::{self, Part};
use crate::size::{budgets, spare, within};
use crate::{build, files, outcome::Outcome, workspace};

pub const HELP: &str = "\
usage: cargo xtask pairs [--spread | --page]

Builds bootloaders whose products differ from the default in many choices at once, so that any two
values of any two choices are together in one of them (a covering array), sealed images included, and
fails when one does not build, is over the budget of its flash, or leaves fewer than 512 bytes of it free on
the compact map. It prints the choices and the size of each.

  --spread        each of them for one board, the next for the next; without, each for every board
  --page          instead: writes the table of the choices into docs/product.md
";

/// A choice of a product, or a group of them.
struct Choice {
    /// Its name, after that of its group and a point.
    path: &'static str,
    /// The default, and the other values that are tried: `None`, if a product may do without the group.
    values: &'static [&'static str],
    /// The struct of a group; empty for a choice.
    kind: &'static str,
    about: &'static [&'static str],
}

impl Choice {
    fn group(&self) -> &'static str {
        self.path.split('.').next().unwrap_or_default()
    }

    fn is_in_group(&self) -> bool {
        self.path.contains('.')
    }
}

/// Makes [`TABLE`] of the table of all choices, as text.
macro_rules! choices {
    ($(
        $(#[doc = $about:literal])*
        $group:ident: $type:ty = $default:expr => [$($other:expr),*]
        $(, $(#[$meta:meta])* struct $Group:ident {
            $(
                $(#[doc = $text:literal])*
                $field:ident: $field_type:ty = $field_default:expr => [$($field_other:expr),*];
            )*
        })?
    ;)*) => {
        /// All choices of a product, each after its group.
        const TABLE: &[Choice] = &[$(
            Choice {
                path: stringify!($group),
                values: &[stringify!($default) $(, stringify!($other))*],
                kind: concat!($(stringify!($Group))?),
                about: &[$($about),*],
            },
            $($(Choice {
                path: concat!(stringify!($group), ".", stringify!($field)),
                values: &[stringify!($field_default) $(, stringify!($field_other))*],
                kind: "",
                about: &[$($text),*],
            },)*)?
        )*];
    };
}

include!("../../bootloader/src/choices.rs");

/// Sealed images: a feature, no choice of a product. On the compact map the row has its other choices alone.
const SEALED: &Choice = &Choice { path: "sealed", values: &["false", "true"], kind: "", about: &[] };

/// What is varied.
fn fields() -> Vec<&'static Choice> {
    TABLE.iter().chain([SEALED]).filter(|choice| choice.values.len() > 1).collect()
}

/// The values of a product, in the order of [`fields`]; 0 is the default.
type Row = Vec<u8>;

pub fn run(mut args: Args) -> Outcome {
    let (spread, page) = (args.flag("--spread"), args.flag("--page"));
    args.none_left()?;
    if page {
        return files::write(&workspace::root().join(PAGE), self::page(&files::ours(PAGE)?)?);
    }
    setup::prepare(&[Part::Firmware])?;
    let fields = fields();
    let rows = covering(&fields);
    let mut largest = 0;
    let folder = workspace::target_dir().join("pairs");
    for (number, row) in rows.iter().enumerate() {
        println!("{:>2}  {}", number + 1, words(&fields, row));
        let path = folder.join(format!("pairs-{:02}.rs", number + 1));
        files::write(&path, file(&fields, row))?;
        let product = Product::of_file(&path)?;
        let of_row = if spread { &BOARDS[number % BOARDS.len()..][..1] } else { BOARDS };
        for board in of_row {
            let used = size(board, &fields, row, &product)?;
            largest = largest.max(used);
            println!("    {:<24} {used:>6} bytes", board.board);
        }
    }
    println!("{} products, every pair of values among them; the largest has {largest} bytes", rows.len());
    Ok(())
}

/// The choices of a row that differ from their default, with their values.
fn chosen<'a>(fields: &'a [&Choice], row: &'a [u8]) -> impl Iterator<Item = (&'a Choice, &'static str)> {
    let others = fields.iter().zip(row).filter(|(_, value)| **value > 0);
    others.map(|(field, value)| (*field, field.values[usize::from(*value)]))
}

/// The file of the product with these choices.
fn file(fields: &[&Choice], row: &[u8]) -> String {
    let value = |path: &str| Some(chosen(fields, row).find(|(field, _)| field.path == path)?.1);
    let profile = value("profile").unwrap_or("Profile::STANDARD");
    // By the profile the defaults of the compact map differ: it may do without the group.
    let mut file = format!(
        "//! A product of `cargo xtask pairs`.

use super::*;

const BASE: Product = Product::of({profile});

/// The choices of this product.
pub const PRODUCT: Product = Product {{
"
    );
    // The first one is the profile.
    for Choice { path, values, kind, .. } in TABLE.iter().filter(|choice| !choice.is_in_group()).skip(1) {
        let inner = chosen(fields, row).filter_map(|(field, value)| {
            Some(format!("{}: {value}, ", field.path.strip_prefix(path)?.strip_prefix('.')?))
        });
        let inner: String = inner.collect();
        let text = match (value(path), inner.as_str(), values.len()) {
            (Some(value), ..) => value.to_owned(),
            (None, "", _) => continue,
            (None, inner, 1) => format!("{kind} {{ {inner}..BASE.{path} }}"),
            (None, inner, _) => {
                format!(
                    "match BASE.{path} {{ Some(_base) => Some({kind} {{ {inner}.._base }}), None => None }}"
                )
            }
        };
        file += &format!("    {path}: {text},\n");
    }
    file + "    ..BASE\n};\n"
}

/// The size in a board's flash of the bootloader of this product, in bytes; an error if it is over the
/// budget.
fn size(board: &Layout, fields: &[&Choice], row: &[u8], product: &Product) -> Outcome<u32> {
    let named = |problem: String| format!("{}, {}: {problem}", board.board, words(fields, row));
    let is_sealed = chosen(fields, row).any(|(field, _)| field.path == SEALED.path);
    let features = if is_sealed && board.home.is_some() { SEALED.path } else { "" };
    let used = build::bootloader_size(board, features, product).map_err(named)?;
    for (bytes, budget) in used.iter().zip(budgets(board)) {
        within(*bytes, budget).map_err(named)?;
    }
    if board.home.is_none() {
        spare(used.iter().sum()).map_err(named)?;
    }
    Ok(used.iter().sum())
}

/// The choices that differ from their default, with the numbers of their values.
fn words(fields: &[&Choice], row: &[u8]) -> String {
    let others = fields.iter().zip(row).filter(|(_, value)| **value > 0);
    others.map(|(field, value)| format!("{}={value}", field.path)).collect::<Vec<_>>().join(" ")
}

/// Whether a product may have these choices (`Product::checked`): a group that a product does without has no
/// choices; a sealed image carries a CRC-32, and a sealed device has no ROM loader; a renewal needs the watchdog.
/// `None` is a choice that is not made yet.
fn allowed(fields: &[&Choice], row: &[Option<u8>]) -> bool {
    let of = |path: &str| {
        let at = fields.iter().position(|field| field.path == path);
        at.and_then(|at| row[at])
    };
    let differs = |path: &str| of(path).is_some_and(|value| value > 0);
    let inner = || fields.iter().filter(|field| field.is_in_group() && differs(field.path));
    let is_void = inner().any(|field| differs(field.group()));
    let renews = of("renewal") == Some(0) || inner().any(|field| field.group() == "renewal");
    let is_open = differs("download.crc") || differs("ways_in.rom_loader");
    !(is_void || differs(SEALED.path) && is_open || renews && differs("watchdog.bootloader_ms"))
}

/// Rows in which any two compatible values are together at least once. Each row takes a pair that
/// is in no row yet, and then, field by field, the value that adds most such pairs. The result is
/// always the same.
fn covering(fields: &[&Choice]) -> Vec<Row> {
    let mut open = pairs(fields);
    let mut rows = Vec::new();
    while let Some(&(a, b)) = open.first() {
        let mut row = vec![None; fields.len()];
        (row[a.0], row[b.0]) = (Some(a.1), Some(b.1));
        for field in 0..fields.len() {
            if row[field].is_some() {
                continue;
            }
            let adds = |value: u8| {
                let mut with = row.clone();
                with[field] = Some(value);
                let new = open.iter().filter(|(a, b)| with[a.0] == Some(a.1) && with[b.0] == Some(b.1));
                allowed(fields, &with).then(|| new.count())
            };
            // Of equal values it takes the first: the default.
            row[field] = (0..fields[field].values.len() as u8).rev().max_by_key(|value| adds(*value));
        }
        let row: Row = row.into_iter().map(|value| value.unwrap_or(0)).collect();
        open.retain(|(a, b)| row[a.0] != a.1 || row[b.0] != b.1);
        rows.push(row);
    }
    rows
}

/// A field and one of its values.
type Value = (usize, u8);

/// All permitted pairs of values of two fields.
fn pairs(fields: &[&Choice]) -> Vec<(Value, Value)> {
    let choices = |field: usize| (0..fields[field].values.len() as u8).map(move |value| (field, value));
    let with = |a: Value| (a.0 + 1..fields.len()).flat_map(choices).map(move |b| (a, b));
    let is_allowed = |&(a, b): &(Value, Value)| {
        let mut row = vec![None; fields.len()];
        (row[a.0], row[b.0]) = (Some(a.1), Some(b.1));
        allowed(fields, &row)
    };
    (0..fields.len()).flat_map(choices).flat_map(with).filter(is_allowed).collect()
}

/// The page, and what stands before its table of the choices.
const PAGE: &str = "docs/product.md";
const HEAD: &str = "| choice | default | |\n|---|---|---|\n";

/// The rows of the page: each group in bold, then its choices.
fn rows() -> String {
    let row = |choice: &Choice| {
        let Choice { path, values, kind, about } = choice;
        let name = if choice.is_in_group() { format!("`{path}`") } else { format!("**`{path}`**") };
        let is_always_there = !kind.is_empty() && values.len() == 1;
        let default = values[0].replace('|', "\\|");
        let default = if is_always_there { String::new() } else { format!("`{default}`") };
        let about = about.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ");
        format!("| {name} | {default} | {about} |\n")
    };
    TABLE.iter().map(row).collect()
}

/// The page with these rows.
fn page(text: &str) -> Outcome<String> {
    let (before, after) = text.split_once(HEAD).ok_or(format!("{PAGE} has no table of the choices."))?;
    let (_, after) = after.split_once("\n\n").unwrap_or_default();
    Ok(format!("{before}{HEAD}{}\n{after}", rows()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counted by hand: 4 for each pair of the 50 choices with two values, 6 with the one with three, 8 with the one
    /// with four, 12 between these. 21 are not permitted: 15 of a group that is not there, two of a sealed device, four
    /// of a renewal without the watchdog.
    #[test]
    fn every_pair_stands_in_a_row_and_no_row_contradicts_itself() {
        let fields = fields();
        let (rows, pairs) = (covering(&fields), pairs(&fields));
        assert_eq!(pairs.len(), 50 * 49 / 2 * 4 + 50 * 6 + 50 * 8 + 12 - 15 - 2 - 4);
        for ((a, value_a), (b, value_b)) in pairs {
            assert!(rows.iter().any(|row| row[a] == value_a && row[b] == value_b), "{a} {b}");
        }
        for row in &rows {
            let chosen: Vec<_> = row.iter().map(|value| Some(*value)).collect();
            assert!(allowed(&fields, &chosen), "{}", words(&fields, row));
            let mut all = row.iter().zip(&fields);
            assert!(all.all(|(value, field)| usize::from(*value) < field.values.len()));
        }
        assert!((12..=28).contains(&rows.len()), "{} rows", rows.len());
    }

    /// The page has each choice, as the table says it.
    #[test]
    fn the_page_has_every_choice() {
        let text = files::ours(PAGE).unwrap();
        assert!(
            page(&text).unwrap() == text,
            "cargo xtask pairs --page writes the table of the choices anew"
        );
        assert!(rows().lines().count() > 50);
    }
}
