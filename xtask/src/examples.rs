//! `cargo xtask examples`: builds the programs in `examples/`, each with its own tools as its page
//! says, outside the workspace.

use std::path::{Path, PathBuf};
use std::process::Command;

use shared_abi::layout::{stm32f407g_disc1, Layout};

use crate::args::Args;
use crate::build::{by_cmake, report};
use crate::setup::{self, Part};
use crate::{files, outcome::Outcome, process, workspace};

pub const HELP: &str = "\
usage: cargo xtask examples [NAME...]

Builds the programs in examples/ for the STM32F407G-DISC1, each by its own tools, and puts them into
target/firmware/stm32f407g-disc1/example-NAME.elf. A NAME is a folder of examples/, or with -v2 the same
program as version 2 (c-v2 and cpp-v2 by clang). `flip-link` is no-stack linked by flip-link, which is installed
into target/tools. Without a NAME it builds all of these. `template` is a new project, which `cargo generate` makes
of no-stack; its tool is built first, which takes some minutes once.
";

/// The board of all examples: their pages name it.
const BOARD: &Layout = &stm32f407g_disc1::LAYOUT;

/// The folders of `examples/`: built by cargo, with the name of the program; or by CMake, with a toolchain
/// file of `examples/c/cmake/`.
const EXAMPLES: [(&str, Option<&str>); 5] = [
    ("c", None),
    ("cpp", None),
    ("no-stack", Some("no-stack")),
    ("embassy", Some("embassy")),
    ("rtic", Some("rtic-example")),
];
/// The name for a new project of the template, which is in the folder no-stack.
const TEMPLATE: &str = "template";
/// The version of cargo-generate, which makes a project of a template.
const GENERATE: &str = "0.23.7";
/// The linker that puts the stack below the variables, and its version.
const FLIP_LINK: (&str, &str) = ("flip-link", "0.1.12");

pub fn run(args: Args) -> Outcome {
    let chosen = args.remaining();
    let known: Vec<String> = names().chain([TEMPLATE.to_owned()]).collect();
    if let Some(name) = chosen.iter().find(|name| !known.contains(name)) {
        return Err(format!("there is no example \"{name}\"; there are: {}.", known.join(", ")));
    }
    setup::prepare(&[Part::Examples, Part::Firmware])?;
    if chosen.is_empty() {
        return all();
    }
    chosen.iter().try_for_each(|name| build(name))
}

/// Builds all examples but the template, and prints their sizes. The tools of [`Part::Examples`] must be installed.
pub fn all() -> Outcome {
    names().try_for_each(|name| build(&name))
}

/// The names of all examples but the template.
fn names() -> impl Iterator<Item = String> {
    let versions = EXAMPLES.iter().flat_map(|(folder, _)| [(*folder).to_owned(), format!("{folder}-v2")]);
    versions.chain([FLIP_LINK.0.to_owned()])
}

fn build(name: &str) -> Outcome {
    let (name_of_folder, is_second) = name.strip_suffix("-v2").map_or((name, false), |folder| (folder, true));
    let folder = workspace::root().join("examples").join(name_of_folder);
    let work = workspace::target_dir().join("examples");
    let built = match EXAMPLES.iter().find(|(known, _)| *known == name_of_folder) {
        Some((_, None)) => {
            let (toolchain, version) = if is_second { ("clang", 2) } else { ("arm-none-eabi-gcc", 1) };
            by_cmake(&folder, &work.join(name), toolchain, &[format!("VERSION={version}")])?
        }
        Some((_, Some(program))) => {
            by_cargo(&folder, &work.join("rust"), program, is_second.then_some("--features=version-2"))?
        }
        None if name == FLIP_LINK.0 => {
            let linker = setup::tool(FLIP_LINK.0, FLIP_LINK.1, &[])?;
            let linker =
                format!("--config=target.{}.linker={:?}", workspace::TARGET, linker.display().to_string());
            by_cargo(
                &workspace::root().join("examples/no-stack"),
                &work.join("rust"),
                "no-stack",
                Some(&linker),
            )?
        }
        None => template(&workspace::root().join("examples/no-stack"), &work)?,
    };
    let image = workspace::firmware_dir(BOARD).join(format!("example-{}.elf", name));
    files::copy(&built, &image)?;
    report(&image, &BOARD.programs[..1])
}

/// Builds a package; returns the program. All packages share `work`, and so their dependencies.
fn by_cargo(folder: &Path, work: &Path, program: &str, option: Option<&str>) -> Outcome<PathBuf> {
    let mut cargo = process::cargo_on(folder, "build --locked --release --target-dir");
    cargo.arg(work).args(option);
    // Cargo looks for the folder's own settings from its current folder.
    process::output(cargo.current_dir(folder))?;
    Ok(work.join(workspace::TARGET).join("release").join(program))
}

/// Makes a project of the template in `folder` and builds it; returns the program.
fn template(folder: &Path, work: &Path) -> Outcome<PathBuf> {
    const NAME: &str = "from-template";
    let tool = setup::tool("cargo-generate", GENERATE, &[])?;
    let project = work.join(NAME);
    files::remove(&project)?;
    files::make(work)?;
    let house = workspace::root().display().to_string().replace('\\', "/");
    let mut generate = Command::new(tool);
    // `--no-workspace`: the project is below the repository, but no member of its workspace.
    generate.args(["generate", "--silent", "--vcs", "none", "--no-workspace", "--name", NAME]);
    generate.arg("--path").arg(folder).arg("--destination").arg(work);
    for answer in [
        format!("board={}", BOARD.board),
        "vendor_id=0x0".into(),
        "product_code=0x4007D151".into(),
        format!("coboot={house}"),
    ] {
        generate.args(["--define", &answer]);
    }
    process::output(&mut generate)?;
    // The versions that the example is tested with; cargo writes the project's name into the copy.
    files::copy(&folder.join("Cargo.lock"), &project.join("Cargo.lock"))?;
    let mut cargo = process::cargo_on(&project, "build --release --target-dir");
    process::output(cargo.arg(work.join("rust")).current_dir(&project))?;
    Ok(work.join("rust").join(workspace::TARGET).join("release").join(NAME))
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::{self, Image};

    use super::*;

    /// The memory map and the interrupt lines in the files of an example by CMake are the board's.
    #[test]
    fn the_numbers_of_the_examples_are_up_to_date() {
        let map = BOARD.linker_script(Image::Program(1)).to_string();
        let lines = format!("set(INTERRUPT_LINES {} ", BOARD.chip.interrupts);
        for folder in ["examples/c", "examples/cpp"].map(Path::new) {
            let file = folder.join("layout.x");
            let command = "cargo xtask layout --ld program-1 --board";
            let mend = format!("{command} {} > {}", BOARD.board, file.display());
            assert!(files::ours(&file).unwrap() == map, "{} is old: {mend}", file.display());
            assert!(files::ours(folder.join("CMakeLists.txt")).unwrap().contains(&lines), "{lines}");
        }
    }

    /// Each file of the template is the example's, with the answers that fit the example.
    #[test]
    fn the_template_is_the_example() {
        let read = |file: &str| files::ours(Path::new("examples/no-stack").join(file)).unwrap();
        for file in ["Cargo.toml", "src/identity.rs"] {
            let mut text = read(&format!("{file}.liquid"));
            // The crates of coboot from a folder, not from a git repository.
            while let Some((before, condition)) = text.split_once("{% if ") {
                let (_, otherwise) = condition.split_once("{% else %}").unwrap();
                let (path, after) = otherwise.split_once("{% endif %}").unwrap();
                text = format!("{before}{path}{after}");
            }
            for (question, answer) in [
                ("project-name", "no-stack"),
                ("coboot", "../.."),
                ("vendor_id", "0x0"),
                ("product_code", "0x4007D151"),
            ] {
                text = text.replace(&format!("{{{{ {question} }}}}"), answer);
            }
            assert_eq!(text, read(file), "{file}");
        }
    }

    /// The boards that the template offers exist, and have the chip of its program.
    #[test]
    fn the_template_offers_boards_that_there_are() {
        let text = files::ours("examples/no-stack/cargo-generate.toml").unwrap();
        let choices = text.lines().find_map(|line| line.strip_prefix("choices = ")).unwrap();
        let names: Vec<_> = choices.split('"').skip(1).step_by(2).collect();
        assert_eq!(names.first(), Some(&BOARD.board));
        for name in names {
            assert_eq!(layout::by_name(name).expect(name).chip, BOARD.chip, "{name}");
        }
    }

    #[test]
    fn each_example_has_its_page() {
        for (folder, _) in &EXAMPLES {
            let page = workspace::root().join("examples").join(folder).join("README.md");
            assert!(page.exists(), "{}", page.display());
        }
        assert_eq!(names().take(3).collect::<Vec<_>>(), ["c", "c-v2", "cpp"]);
    }
}
