//! Which test runs when, and with which images. docs/testing.md has the table of what does not run in every
//! `cargo xtask test`, with the reasons.

use shared_abi::layout::{
    nucleo_f446re, stm32f407g_disc1, stm32f407g_disc1_can2, stm32f407g_disc1_two, stm32f429i_disc1, Layout,
};

use crate::setup::Part;

/// When a test runs. Each tier contains the ones before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Tier {
    /// `cargo xtask test`: the product on its default board, device and tool.
    Product,
    /// `.ci/run`: what needs a browser, tools of others, the other chips or the repository's pages.
    Ci,
    /// `cargo xtask test --all`: what takes minutes, or builds programs of its own.
    All,
}

/// The page with the tables of tests.
const PAGE: &str = include_str!("../../../docs/testing.md");
/// The head of the table of the tests that do not run in every `cargo xtask test`: a row has the beginning of tests' paths,
/// the first run that has them and why it is not an earlier one.
pub const LATER: &str = "| tests | first run by |";

/// The table of the page with this head.
pub fn table(head: &str) -> &'static str {
    let begin = PAGE.find(head).expect("docs/testing.md has the table");
    PAGE[begin..].split("\n\n").next().unwrap_or_default()
}

/// The rows of [`LATER`]: the beginning of `program::path` of tests, and their tier.
fn later() -> impl Iterator<Item = (&'static str, Tier)> {
    table(LATER).lines().skip(2).map(|row| match row.split('`').collect::<Vec<_>>()[..] {
        ["| ", tests, " | ", ".ci/run", _why] => (tests, Tier::Ci),
        ["| ", tests, " | ", "--all", _why] => (tests, Tier::All),
        _ => panic!(
            "docs/testing.md: a row is | `TESTS` | `.ci/run` or `--all` | why not earlier |, not {row}"
        ),
    })
}

/// The images of a board that the tests of a tier need.
pub struct Images {
    /// The first tier that needs them.
    pub tier: Tier,
    /// Their board.
    pub board: &'static Layout,
    /// Their names; empty for all of the board, and the applications in C.
    pub names: &'static str,
}

/// The images for a board of another chip.
const OF_A_CHIP: &str = "bootloader bootloader-paulus bootloader-watchdog app-v1 app-v2";

/// The images for the board with two programs.
const OF_TWO_PROGRAMS: &str =
    "bootloader bootloader-lift app-v1 app-v2 app-program-2 app-lift app-lift-v2 app-c";

/// The images by tier.
pub const IMAGES: &[Images] = &[
    Images { tier: Tier::Product, board: &stm32f407g_disc1::LAYOUT, names: "" },
    Images { tier: Tier::Product, board: &stm32f407g_disc1_can2::LAYOUT, names: "bootloader app-v1 app-v2" },
    Images { tier: Tier::Ci, board: &stm32f407g_disc1_two::LAYOUT, names: OF_TWO_PROGRAMS },
    Images { tier: Tier::Ci, board: &nucleo_f446re::LAYOUT, names: OF_A_CHIP },
    Images { tier: Tier::Ci, board: &stm32f429i_disc1::LAYOUT, names: OF_A_CHIP },
    Images { tier: Tier::All, board: &stm32f407g_disc1_two::LAYOUT, names: "" },
];

/// Tests that run for a board of each chip in [`Tier::Ci`]: they show the mistakes that a port can
/// have. The rest is the same on all chips; in [`Tier::All`] every test of these programs runs.
pub const OF_EACH_CHIP: [&str; 5] =
    ["device::device::", "device::watchdog::", "device::abi::", "device::handover::", "update::main_job::"];

/// The tests that a board leaves out, for they need what it does not have: the page has a table of them.
pub fn left_out(board: &Layout) -> impl Iterator<Item = &'static str> + '_ {
    let row = |row: &'static str| row.split_once(" | ").expect("a row has two cells");
    let rows = table("| a board with | tests |").lines().skip(2).map(row);
    let is_missing = |(needed, _): &(&str, &str)| match *needed {
        "| the split map" => board.home.is_none(),
        "| a region for staging" => board.staging.is_none(),
        "| the name stm32f407g-disc1" => board.board != stm32f407g_disc1::LAYOUT.board,
        other => panic!("docs/testing.md: nobody knows which boards have this: {other}"),
    };
    rows.filter(is_missing).flat_map(|(_, tests)| tests.split('`').skip(1).step_by(2))
}

impl Tier {
    /// What the tests up to this tier need on the machine.
    pub fn needs(self) -> &'static [Part] {
        use Part::{Browser, Emulator, Examples, Firmware, Gdb, Python, Qemu, C};
        match self {
            Self::Product => &[Firmware, C, Emulator, Python],
            Self::Ci => &[Firmware, C, Emulator, Python, Gdb, Browser, Examples],
            Self::All => &[Firmware, C, Emulator, Python, Gdb, Browser, Examples, Qemu],
        }
    }

    /// The tests that run first in this tier, as a filter of nextest.
    pub fn filter(self) -> String {
        // The first row that a test begins with has it: each one takes it from those after it.
        let mut filter = if self == Self::Product { "all()" } else { "none()" }.to_owned();
        for (tests, tier) in later().collect::<Vec<_>>().into_iter().rev() {
            filter = format!("({filter}) {} {}", if tier == self { '+' } else { '-' }, of(tests));
        }
        filter
    }
}

/// The tests whose `program::path` begins like this, as a filter of nextest. A program without a package is one of
/// coboot-tests, or has the unit tests of a package.
pub fn of(tests: &str) -> String {
    let (program, path) = tests.split_once("::").unwrap_or((tests, ""));
    let program = program.replace('/', "::");
    format!("(binary_id(/^(coboot-tests::)?{program}(::bin.*)?$/) & test(/^{path}/))")
}

/// All of these tests, as a filter of nextest.
pub fn any_of<'t>(tests: impl IntoIterator<Item = &'t str>) -> String {
    tests.into_iter().fold("none()".to_owned(), |filter, tests| format!("{filter} + {}", of(tests)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_test_has_one_tier() {
        let rows: Vec<_> = later().collect();
        for (number, (tests, _)) in rows.iter().enumerate() {
            let hides = rows[..number].iter().find(|(other, _)| tests.starts_with(other));
            assert_eq!(hides, None, "{tests}");
        }
        let (first, last) = (of("device::application::"), of("xtask/hil::"));
        assert_eq!(last, "(binary_id(/^(coboot-tests::)?xtask::hil(::bin.*)?$/) & test(/^/))");
        for (tier, all, first_mark, last_mark) in [
            (Tier::Product, "all()", '-', '-'),
            (Tier::Ci, "none()", '-', '-'),
            (Tier::All, "none()", '+', '+'),
        ] {
            let filter = tier.filter();
            let rows = filter.trim_start_matches('(');
            assert!(rows.starts_with(all) && rows.contains(&format!(" {last_mark} {last}")), "{filter}");
            assert!(filter.contains(&format!(" {first_mark} {first}")), "{filter}");
        }
        assert!(Tier::Ci.filter().contains(&format!(" + {}", of("foreign::ui::"))));
    }

    #[test]
    fn a_board_leaves_out_what_it_has_no_place_for() {
        let out = |board: &Layout| left_out(board).collect::<Vec<_>>();
        assert_eq!(out(&stm32f407g_disc1::LAYOUT), [""; 0]);
        let compact = Layout { home: None, board: "another", ..stm32f407g_disc1::LAYOUT };
        let out = out(&compact);
        assert!(["sealed::", "port::porting::"].iter().all(|tests| out.contains(tests)), "{out:?}");
        assert!(!out.contains(&"device::renewal::"), "{out:?}");
    }
}
