//! What the owner of the product ordered by name, as a part of `cargo xtask arrows`: paths, tasks,
//! crates and functions that must not be lost when the rest is moved.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use crate::modules::without_comments;
use crate::workspace::{self, TARGET};
use crate::{files, outcome::Outcome, process};

/// The paths at the top level.
const TOP_LEVEL: [&str; 6] = ["Cargo.toml", "bootloader", "app-template", "shared-abi", "linker", "tests"];
/// The programs with an RTIC task for received frames and a timer monotonic.
const PROGRAMS: [&str; 2] = ["bootloader", "app-template"];
/// The interrupts of received frames that a task may be bound to.
const RX_INTERRUPTS: [&str; 4] = ["CAN1_RX0", "CAN1_RX1", "CAN2_RX0", "CAN2_RX1"];
/// The crates of others that the image of the bootloader contains.
const IN_THE_IMAGE: [&str; 7] =
    ["rtic", "stm32f4xx-hal", "bxcan", "cortex-m", "heapless", "crc", "panic-probe"];
/// Code that is there: the words for it, a file, and pieces of that file.
const CODE: [(&str, &str, &[&str]); 6] = [
    ("warm-start cell", "shared-abi/src/warm_start.rs", &["pub struct Cell"]),
    ("vector relocation", "shared-abi/src/vectors.rs", &["0xE000_ED08"]),
    ("callgate", "shared-abi/src/callgate.rs", &["pub struct Table"]),
    (
        "callback of 1F51h = 80h that is called",
        "app-template/src/objects.rs",
        &["fn start_bootloader(", "self.start_bootloader("],
    ),
    ("host test of the ABI", "tests/abi/main.rs", &["mod layout;", "mod header;", "mod reentry;"]),
    (
        "test program of the ABI",
        "tests/kit/Cargo.toml",
        &["[[test]]\nname = \"abi\"\npath = \"../abi/main.rs\""],
    ),
];

/// The parts of the repository that the orders are about.
#[derive(Default)]
struct House {
    /// The files at and below the top-level paths, by their paths: the text of Rust sources and manifests, without
    /// comments, and nothing of the others.
    files: BTreeMap<PathBuf, String>,
    /// The crates that the image of the bootloader contains.
    image: BTreeSet<String>,
}

/// The orders that are not kept, as messages.
pub fn broken() -> Outcome<Vec<String>> {
    let root = workspace::root();
    let mut house = House::default();
    for path in TOP_LEVEL.map(|path| root.join(path)) {
        let files = if path.is_dir() { files::below(&path, &[])? } else { vec![path] };
        for file in files.iter().filter(|file| file.exists()) {
            let is_source = files::is(file, "rs") || files::is(file, "toml");
            let text = if is_source { without_comments(&files::text(file)?) } else { String::new() };
            house.files.insert(file.strip_prefix(root).unwrap_or(file).to_owned(), text);
        }
    }
    let tree = process::tree(&["--package", "bootloader", "--target", TARGET, "--edges", "normal"])?;
    house.image = tree.iter().filter_map(|krate| Some(krate.split(' ').next()?.to_owned())).collect();
    Ok(house.broken())
}

impl House {
    fn broken(&self) -> Vec<String> {
        let mut broken = Vec::new();
        let mut order = |is_kept: bool, message: String| broken.extend((!is_kept).then_some(message));
        for path in TOP_LEVEL {
            order(self.has(path, |_| true), format!("the top level has no {path}"));
        }
        for program in PROGRAMS {
            let sources = format!("{program}/src");
            order(
                self.has(&sources, has_receiving_task),
                format!("{program}: no RTIC task is bound to the interrupt of received CAN frames"),
            );
            let has_timer = self.has(&sources, |text| text.contains("_monotonic!("));
            order(has_timer, format!("{program}: there is no timer monotonic"));
        }
        for krate in IN_THE_IMAGE {
            order(self.image.contains(krate), format!("bootloader: its image does not contain {krate}"));
        }
        for (what, file, pieces) in CODE {
            let is_there = self.has(file, |text| pieces.iter().all(|piece| text.contains(piece)));
            order(is_there, format!("{file}: there is no {what} (`{}`)", pieces.join("`, `")));
        }
        broken
    }

    /// Whether a file at this path or below it has something.
    fn has(&self, path: &str, something: impl Fn(&str) -> bool) -> bool {
        self.files.iter().any(|(file, text)| file.starts_with(path) && something(text))
    }
}

/// Whether an RTIC application has a task for received frames.
fn has_receiving_task(source: &str) -> bool {
    let Some((_, app)) = source.split_once("#[rtic::app(") else { return false };
    app.split("#[task(").skip(1).any(|task| {
        let attribute = task.split(")]").next().unwrap_or_default();
        let binds = attribute.split(',').find_map(|part| part.trim().strip_prefix("binds = "));
        binds.is_some_and(|interrupt| RX_INTERRUPTS.contains(&interrupt))
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    const APP: &str = "systick_monotonic!(Mono, 1_000);\n#[rtic::app(device = pac)]\nmod app {\n\
                       #[task(binds = CAN1_RX0, shared = [can], priority = 4)]\nfn can_rx() {}\n\
                       #[task(binds = CAN1_TX, priority = 3)]\nfn protocol() {}\n}";

    fn house() -> House {
        let mut house = House { image: IN_THE_IMAGE.map(str::to_owned).into(), ..House::default() };
        let mut put = |path: &str, text: &str| house.files.insert(path.into(), text.to_owned());
        for file in ["Cargo.toml", "linker/application.x", "tests/Cargo.toml"] {
            put(file, "");
        }
        for program in PROGRAMS {
            put(&format!("{program}/src/main.rs"), APP);
        }
        for (_, file, pieces) in CODE {
            put(file, &pieces.join("\n"));
        }
        house
    }

    #[test]
    fn each_thing_that_is_missing_is_named() {
        assert_eq!(house().broken(), Vec::<String>::new());
        for (file, says) in [
            ("Cargo.toml", "no Cargo.toml"),
            ("linker/application.x", "no linker"),
            ("shared-abi/src/warm_start.rs", "no warm-start cell"),
            ("shared-abi/src/vectors.rs", "no vector relocation"),
            ("shared-abi/src/callgate.rs", "no callgate"),
            ("app-template/src/objects.rs", "no callback of 1F51h"),
            ("tests/abi/main.rs", "no host test of the ABI"),
            ("tests/kit/Cargo.toml", "no test program of the ABI"),
        ] {
            let mut house = house();
            house.files.remove(Path::new(file));
            let broken = house.broken();
            assert!(broken.len() == 1 && broken[0].contains(says), "{file}: {broken:?}");
        }
        for krate in IN_THE_IMAGE {
            let mut house = house();
            house.image.remove(krate);
            assert_eq!(house.broken(), [format!("bootloader: its image does not contain {krate}")]);
        }
    }

    #[test]
    fn a_program_without_its_task_or_its_timer_is_named() {
        let with = |file: &str, from: &str, to: &str| {
            let mut house = house();
            let text = house.files.get_mut(Path::new(file)).unwrap();
            assert!(text.contains(from), "{from}");
            *text = without_comments(&text.replace(from, to));
            house.broken()
        };
        for program in PROGRAMS {
            let file = format!("{program}/src/main.rs");
            for (from, to, says) in [
                ("binds = CAN1_RX0, ", "", "no RTIC task"),
                ("CAN1_RX0", "CAN1_SCE", "no RTIC task"),
                ("#[task(binds = CAN1_RX0", "// #[task(binds = CAN1_RX0", "no RTIC task"),
                ("#[rtic::app(device = pac)]", "", "no RTIC task"),
                ("systick_monotonic!(", "// systick_monotonic!(", "no timer monotonic"),
            ] {
                let broken = with(&file, from, to);
                assert!(broken.len() == 1 && broken[0].contains(says), "{program}, {from}: {broken:?}");
                assert!(broken[0].starts_with(program), "{broken:?}");
            }
            assert_eq!(with(&file, "CAN1_RX0", "CAN2_RX0"), Vec::<String>::new());
        }
        // A callback that nobody calls is none.
        let (_, file, pieces) = CODE[3];
        assert!(with(file, pieces[1], "")[0].contains("that is called"));
    }
}
