//! Which test runs when: a table of what does not run in every `cargo xtask test`, with the reason.

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

/// Tests that do not run in every `cargo xtask test`.
pub struct Later {
    /// A test program of the package `coboot-tests`, or a package.
    pub program: &'static str,
    /// The beginning of the tests' paths in it; empty for all of them.
    pub tests: &'static str,
    /// The first tier in which they run.
    pub tier: Tier,
    /// Why not earlier.
    pub why: &'static str,
}

const fn later(program: &'static str, tests: &'static str, tier: Tier, why: &'static str) -> Later {
    Later { program, tests, tier, why }
}

/// The reason of tests on a board whose images `cargo xtask test` does not build.
const TWO: &str = "images of the board with two programs";
/// The same where it takes all of them.
const ALL_OF_TWO: &str = "all images of the board with two programs";
/// The reason of tests that measure; a broken time is seen in `.ci/run`.
const TIMES: &str = "measures times, 1 minute";
/// The reason of tests of sealed images beyond a download, its blocks and strangers.
const SEALED: &str = "sealed images beyond the main flow";
/// The reason of a second client of others.
const OTHERS: &str = "one more client of others";

/// What runs later, in the order of the programs.
pub const LATER: &[Later] = &[
    later("coboot-kit/abi", "header::it_compiles_for_the_chip", Tier::Ci, "arm-none-eabi-gcc"),
    later("device", "application::", Tier::All, "builds an application anew, 2 minutes"),
    later("device", "boot_time::", Tier::Ci, TIMES),
    later("device", "c_application::the_other_program", Tier::All, ALL_OF_TWO),
    later("device", "image::gdb_loads_it", Tier::Ci, "gdb"),
    later("device", "leftovers::whatever", Tier::Ci, "sixteen states of a chip, 1 minute"),
    later("device", "stuck_bus::", Tier::All, "minutes of a bus that does not move"),
    later("device", "supply::with_every_combination", Tier::All, "32 combinations of option bytes, 1 minute"),
    later("device", "supply::", Tier::Ci, "supply voltages and option bytes, 1 minute"),
    later(
        "device",
        "silicon::each_scenario_works_with_the_chips",
        Tier::All,
        "more chips than the worst one",
    ),
    later("device", "virtual_can::", Tier::All, "CAN over UART, an option, 1 minute"),
    later("device", "ways_in::", Tier::Ci, "entries that are off by default, 1 minute"),
    later("update", "attacker::", Tier::All, "the standing attacker on boards, 2 minutes"),
    later("update", "coflash_dialects::the_profile_of_lifts", Tier::Ci, TWO),
    later("update", "dialects::a_lift", Tier::Ci, TWO),
    later("update", "fleet::", Tier::All, "groups of devices, 3 minutes"),
    later("update", "powercut::no_cut_bricks", Tier::All, "each power cut of the model, 3 minutes"),
    later("update", "powercut_board::", Tier::All, "the sample on the built firmware, 2 minutes"),
    later(
        "update",
        "resume::",
        Tier::All,
        "whole programs, cut anywhere, 3 minutes; the model is cut in each run",
    ),
    later("update", "renewal::", Tier::Ci, "a renewal by the host tool, 2 minutes"),
    later("update", "streams::", Tier::All, "whole programs at the slowest flash, 2 minutes"),
    later("update", "throughput::", Tier::All, TIMES),
    later("update", "two_programs::", Tier::Ci, TWO),
    later("sealed", "blocks::eight_sealed_devices", Tier::All, "groups of devices"),
    later("sealed", "powercut::", Tier::All, "each power cut of the model, 1 minute"),
    later("sealed", "attacker::", Tier::Ci, SEALED),
    later("sealed", "client::", Tier::Ci, SEALED),
    later("sealed", "confirmation::", Tier::Ci, SEALED),
    later("sealed", "model::", Tier::Ci, SEALED),
    later("sealed", "refusals::", Tier::Ci, SEALED),
    later("sealed", "renewal::", Tier::Ci, SEALED),
    later("foreign", "block_upload::", Tier::Ci, OTHERS),
    later("foreign", "eds::", Tier::Ci, OTHERS),
    later("foreign", "examples::", Tier::All, "builds a project of each tool chain"),
    later("foreign", "gdb_door::", Tier::Ci, "gdb"),
    later("foreign", "pages::", Tier::All, "types each page, 3 minutes"),
    later("foreign", "peers::", Tier::All, OTHERS),
    later("foreign", "python_package::", Tier::All, "builds the wheel, 8 minutes"),
    later("foreign", "ui::", Tier::Ci, "Chromium"),
    later("port", "matrix::", Tier::All, ALL_OF_TWO),
    later("port", "porting::", Tier::All, "builds a copy of the repository"),
    later("coboot-emulator/it", "emulate::gdb_stops_steps_looks_and_changes", Tier::Ci, "gdb"),
    later("coboot-zencan/zencan", "", Tier::Ci, OTHERS),
    later("xtask", "", Tier::Ci, "the repository and its pages, not the product"),
    later("xtask/hil", "", Tier::All, "builds and flashes for 4 minutes"),
];

/// Test modules that take longest, the slowest first: they begin first, so that no core waits for
/// one of them at the end.
pub const SLOW: &str =
    "powercut fleet powercut_board streams application ui device conform cli resume blocks \
                        commands nodes refusals clients client model program_control attacker throughput";

/// Test programs that mostly wait: their tests start programs that talk to each other in real time.
pub const WAITING: [&str; 4] = ["coboot-node/it", "coflash/it", "coflash-agent/it", "coflash-ui/it"];

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
const OF_A_CHIP: &str = "bootloader bootloader-least bootloader-paulus bootloader-watchdog app-v1 app-v2";

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
    ("device", "supply::"),
    ("device", "abi::"),
    ("device", "handover::"),
    ("update", "main_job::"),
    ("update", "conform::"),
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

/// The table [`LATER`], as a page has it.
pub fn table() -> String {
    let mut table = String::from("| tests | first run by | why not earlier |\n|---|---|---|\n");
    for Later { program, tests, tier, why } in LATER {
        let colons = if tests.is_empty() { "" } else { "::" };
        let by = match tier {
            Tier::Product => "`cargo xtask test`",
            Tier::Ci => "`.ci/run`",
            Tier::All => "`--all`",
        };
        let program = program.replace('/', "::");
        table += &format!("| `{program}{colons}{}` | {by} | {why} |\n", tests.trim_end_matches("::"));
    }
    table
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

    /// The first tier in which a test runs.
    pub fn of(program: &str, test: &str) -> Self {
        let row = LATER.iter().find(|row| row.program == program && test.starts_with(row.tests));
        row.map_or(Self::Product, |row| row.tier)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workspace;

    #[test]
    fn the_page_has_the_table() {
        let page = std::fs::read_to_string(workspace::root().join("docs/testing.md")).unwrap();
        assert!(page.contains(&table()), "docs/testing.md needs this table:\n{}", table());
    }

    #[test]
    fn each_test_has_one_tier() {
        for (number, row) in LATER.iter().enumerate() {
            for other in &LATER[..number] {
                let overlap = row.program == other.program && row.tests.starts_with(other.tests);
                assert!(!overlap, "{}::{} is hidden by {}", row.program, row.tests, other.tests);
            }
        }
        assert_eq!(Tier::of("foreign", "ui::a_test"), Tier::Ci);
        assert_eq!(Tier::of("device", "line::a_test"), Tier::Product);
    }
}
