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

/// The page with the table of the tests that do not run in every `cargo xtask test`.
const PAGE: &str = include_str!("../../../docs/testing.md");

/// That table: a row for the beginning of tests' paths, with the first run that has them and why it is not an
/// earlier one.
pub fn table() -> &'static str {
    let begin = PAGE.find("| tests | first run by |").expect("docs/testing.md has the table");
    PAGE[begin..].split("\n\n").next().unwrap_or_default()
}

/// The rows of [`table`]: the beginning of `program::path` of tests, and their tier.
fn later() -> impl Iterator<Item = (&'static str, Tier)> {
    table().lines().skip(2).map(|row| match row.split('`').collect::<Vec<_>>()[..] {
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
pub const OF_EACH_CHIP: &[(&str, &str)] = &[
    ("device", "device::"),
    ("device", "watchdog::"),
    ("device", "abi::"),
    ("device", "handover::"),
    ("update", "main_job::"),
];

/// Tests that need what not every board has.
pub struct Needs {
    /// Whether a board has it.
    pub has: fn(&Layout) -> bool,
    /// The tests: a program, and the beginning of their paths in it.
    pub tests: &'static [(&'static str, &'static str)],
}

/// The tests that some boards leave out.
pub const NEEDS: &[Needs] = &[
    // What only the split map has room for: images that are sealed, with a log, with the debugger, with CAN over
    // UART; a second server, resumption, block upload, the program's date; a RAM image to damage.
    Needs {
        has: |board| board.home.is_some(),
        tests: &[
            ("device", "debugger::"),
            ("device", "image::a_ram_image_runs_on_the_resident_part_of_another_bootloader"),
            ("device", "log::"),
            ("device", "software_date::"),
            ("device", "virtual_can::"),
            ("device", "ways_in::two_resets_without_a_bootloader_start_the_program"),
            ("update", "attacker::"),
            ("update", "fleet::"),
            ("update", "resume::"),
            ("update", "throughput::a_compressed_program_is_faster_than_the_wire_of_the_raw_one"),
            ("port", "matrix::"),
            ("foreign", "block_upload::"),
            ("foreign", "eds::a_file_has_no_object_that_the_product_leaves_out"),
            ("foreign", "eds::each_product_has_the_objects_of_its_file_and_no_others"),
            ("foreign", "eds::python_canopen_finds_other_products_as_their_files_say"),
            ("foreign", "gdb_door::"),
            ("foreign", "peers::"),
            ("sealed", ""),
        ],
    },
    // A bootloader that can be renewed.
    Needs {
        has: |board| board.staging.is_some(),
        tests: &[
            ("device", "program_control::the_bootloader_is_a_program_of_the_application_too"),
            ("device", "renewal::"),
            ("update", "renewal"),
            ("update", "masters::systecs_order_renews_a_bootloader_with_a_second_83h"),
            ("update", "masters::zephyrs_runner_renews_a_bootloader_with_one_request_more"),
            ("update", "powercut_board::a_cut_shows_a_home_that_is_erased_too_early"),
            ("update", "fleet::a_later_device_that_refuses_a_bootloader"),
            ("update", "fleet::if_the_first_device_refuses_a_bootloader"),
            ("sealed", "conform::"),
            ("sealed", "flash_lock::a_sealed_program_that_writes_flash_is_not_locked_out"),
            ("sealed", "provisioning::a_bootloader_that_can_be_renewed_leaves_its_home_writable"),
            ("sealed", "renewal::"),
        ],
    },
    // The board of the pages and of the projects that they describe; and its twin with two programs.
    Needs {
        has: |board| board.board == stm32f407g_disc1::LAYOUT.board,
        tests: &[
            ("update", "fleet::a_device_without_room_refuses_alone"),
            ("update", "recording::"),
            ("foreign", "examples::"),
            ("foreign", "pages::"),
            ("foreign", "python_package::"),
            ("port", "porting::"),
        ],
    },
];

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
        let rows = later().collect::<Vec<_>>().into_iter().rev();
        rows.fold(
            if self == Self::Product { "all()" } else { "none()" }.to_owned(),
            |filter, (tests, tier)| {
                let (program, path) = tests.split_once("::").unwrap_or((tests, ""));
                format!("({filter}) {} {}", if tier == self { '+' } else { '-' }, of(program, path))
            },
        )
    }
}

/// The tests of a program whose paths begin like this, as a filter of nextest. A program without a package is one
/// of coboot-tests, or has the unit tests of a package.
pub fn of(program: &str, path: &str) -> String {
    let program = program.replace('/', "::");
    format!("(binary_id(/^(coboot-tests::)?{program}(::bin.*)?$/) & test(/^{path}/))")
}

/// The tests of these rows, as a filter of nextest.
pub fn any_of<'r>(rows: impl IntoIterator<Item = &'r (&'r str, &'r str)>) -> String {
    rows.into_iter()
        .fold("none()".to_owned(), |filter, (program, path)| format!("{filter} + {}", of(program, path)))
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
        let (first, last) = (of("device", "application::"), of("xtask/hil", ""));
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
        assert!(Tier::Ci.filter().contains(&format!(" + {}", of("foreign", "ui::"))));
    }
}
