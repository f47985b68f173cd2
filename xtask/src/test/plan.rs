//! What runs when needs: the images, and what is installed. `.config/nextest.toml` says which test that is.

use shared_abi::layout::{
    nucleo_f446re, stm32f407g_disc1, stm32f407g_disc1_can2, stm32f407g_disc1_two, stm32f429i_disc1, Layout,
};

use crate::setup::Part;

/// When a test runs first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Tier {
    /// `cargo xtask test`: the product on its default board, device and tool.
    Product,
    /// `.ci/run chips`: sealed images, two programs, and the other chips.
    Chips,
    /// `.ci/run pages`: what needs a browser, tools of others or the repository's pages.
    Pages,
    /// `cargo xtask test --all`: what takes minutes, or builds programs of its own.
    Night,
}

/// Images of a board that tests need.
pub struct Images {
    /// The tier that needs them; each one needs those of the product, and the night all.
    tier: Tier,
    /// Their board.
    pub board: &'static Layout,
    /// Their names; empty for all of the board, and the applications in C.
    pub names: &'static str,
}

/// The images for a board of another chip.
const OF_A_CHIP: &str = "bootloader bootloader-paulus bootloader-watchdog app-v1 app-v2 app-test";

/// The images for the board with two programs.
const OF_TWO_PROGRAMS: &str =
    "bootloader bootloader-lift app-v1 app-v2 app-program-2 app-lift app-lift-v2 app-c";

static IMAGES: [Images; 6] = [
    Images { tier: Tier::Product, board: &stm32f407g_disc1::LAYOUT, names: "" },
    Images { tier: Tier::Product, board: &stm32f407g_disc1_can2::LAYOUT, names: "bootloader app-v1 app-v2" },
    Images { tier: Tier::Chips, board: &stm32f407g_disc1_two::LAYOUT, names: OF_TWO_PROGRAMS },
    Images { tier: Tier::Chips, board: &nucleo_f446re::LAYOUT, names: OF_A_CHIP },
    Images { tier: Tier::Chips, board: &stm32f429i_disc1::LAYOUT, names: OF_A_CHIP },
    Images { tier: Tier::Night, board: &stm32f407g_disc1_two::LAYOUT, names: "" },
];

/// Tests that run for a board of each chip in [`Tier::Chips`], as a filter of nextest: they show the mistakes that a port
/// can have. The rest is the same on all chips; in [`Tier::Night`] every test of these programs runs.
pub const OF_EACH_CHIP: &str =
    "binary(device) & test(/^(abi|device|handover|watchdog)::/) | binary(update) & test(/^main_job::/)";

impl Tier {
    /// The images that the tests of this tier need.
    pub fn images(self) -> impl Iterator<Item = &'static Images> {
        IMAGES.iter().filter(move |row| [Self::Product, self].contains(&row.tier) || self == Self::Night)
    }

    /// What the tests of this tier need on the machine.
    pub fn needs(self) -> &'static [Part] {
        use Part::{Browser, Emulator, Examples, Firmware, Gdb, Python, Qemu, C};
        match self {
            Self::Product | Self::Chips => &[Firmware, C, Emulator, Python],
            Self::Pages => &[Firmware, C, Emulator, Python, Gdb, Browser, Examples],
            Self::Night => &[Firmware, C, Emulator, Python, Gdb, Browser, Examples, Qemu],
        }
    }

    /// The tests that run first in this tier, as a filter of nextest: by the groups of `.config/nextest.toml`.
    pub fn filter(self) -> &'static str {
        match self {
            Self::Product => "group(@global)",
            Self::Chips => "group(chips)",
            Self::Pages => "group(#pages*)",
            Self::Night => "group(#night*)",
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::{files, workspace};

    #[test]
    fn each_group_of_tests_has_a_tier_and_is_on_the_page() {
        let text = |name: &str| files::text(&workspace::root().join(name)).unwrap();
        let (config, page) = (text(".config/nextest.toml"), text("docs/testing.md"));
        let groups = config.lines().filter_map(|line| line.split_once(" = { max-threads"));
        for (group, _) in groups.clone() {
            assert!(
                ["chips", "pages", "night"].contains(&group.split('-').next().unwrap()),
                "no tier runs {group}"
            );
            assert!(page.contains(&format!("`{group}`")), "docs/testing.md: {group}");
        }
        assert!(groups.count() > 2);
    }

    /// A filter that takes nothing any more would move a slow test into every run.
    #[test]
    fn each_name_in_a_filter_of_tests_is_there() {
        let root = workspace::root();
        let sources =
            ["coflash", "sim", "tests"].map(|folder| files::below(&root.join(folder), &["python"]).unwrap());
        let sources =
            sources.concat().into_iter().filter(|file| file.extension().is_some_and(|of| of == "rs"));
        let sources: String = sources.map(|file| files::text(&file).unwrap()).collect();
        let config = files::text(&root.join(".config/nextest.toml")).unwrap();
        let filters = config.split("test(/^").skip(1).filter_map(|filter| filter.split("/)").next());
        let names = filters.flat_map(|filter| filter.split(|c: char| !c.is_alphanumeric() && c != '_'));
        for name in names.filter(|name| !name.is_empty()) {
            assert!(["mod", "fn"].iter().any(|kind| sources.contains(&format!("{kind} {name}"))), "{name}");
        }
    }
}
