//! `cargo xtask examples`: builds the programs in `examples/`, each with its own tools as its page
//! says, outside the workspace.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use shared_abi::layout::{stm32f407g_disc1, Layout};

use crate::args::Args;
use crate::build::report;
use crate::setup::{self, Part, Setup};
use crate::{process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask examples [NAME...] [--yes]

Builds the programs in examples/ for the STM32F407G-DISC1, each by its own tools, and puts them into
target/firmware/stm32f407g-disc1/example-NAME.elf. Without a NAME it builds all of them:

  c       C by CMake, with arm-none-eabi-gcc
  c-v2    the same as version 2, with clang
  cpp           C++17 by CMake, with arm-none-eabi-g++
  cpp-v2        the same as version 2, with clang++
  no-stack      Rust without a CANopen stack: a main loop
  no-stack-v2   the same as version 2
  embassy       Rust on Embassy
  embassy-v2    the same as version 2
  rtic          Rust on RTIC, with a CANopen stack of its own
  rtic-v2       the same as version 2
  template      a new project, which `cargo generate` makes of no-stack. Only if it is named: the first time
                cargo-generate is built, which takes some minutes

  --yes         installs what is missing with sudo
";

/// The board of all examples: their pages name it.
const BOARD: &Layout = &stm32f407g_disc1::LAYOUT;

/// A program that is built from a folder of `examples/`.
struct Example {
    /// The name of its image without the prefix `example-`.
    name: &'static str,
    /// The folder within `examples/`.
    folder: &'static str,
    tools: Tools,
}

/// The build tool of an example.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Tools {
    /// CMake with a toolchain file of `examples/c/cmake/`; the version is for the program's label.
    Cmake { toolchain: &'static str, version: u32 },
    /// Cargo: the program of this name, with features of its package.
    Cargo { program: &'static str, features: &'static str },
    /// `cargo generate` with the folder as the template, then Cargo.
    Template,
}

const EXAMPLES: &[Example] = &[
    Example { name: "c", folder: "c", tools: Tools::Cmake { toolchain: "arm-none-eabi-gcc", version: 1 } },
    Example { name: "c-v2", folder: "c", tools: Tools::Cmake { toolchain: "clang", version: 2 } },
    Example {
        name: "cpp",
        folder: "cpp",
        tools: Tools::Cmake { toolchain: "arm-none-eabi-gcc", version: 1 },
    },
    Example { name: "cpp-v2", folder: "cpp", tools: Tools::Cmake { toolchain: "clang", version: 2 } },
    Example {
        name: "no-stack",
        folder: "no-stack",
        tools: Tools::Cargo { program: "no-stack", features: "" },
    },
    Example {
        name: "no-stack-v2",
        folder: "no-stack",
        tools: Tools::Cargo { program: "no-stack", features: "version-2" },
    },
    Example { name: "embassy", folder: "embassy", tools: Tools::Cargo { program: "embassy", features: "" } },
    Example {
        name: "embassy-v2",
        folder: "embassy",
        tools: Tools::Cargo { program: "embassy", features: "version-2" },
    },
    Example { name: "rtic", folder: "rtic", tools: Tools::Cargo { program: "rtic-example", features: "" } },
    Example {
        name: "rtic-v2",
        folder: "rtic",
        tools: Tools::Cargo { program: "rtic-example", features: "version-2" },
    },
    Example { name: "template", folder: "no-stack", tools: Tools::Template },
];

/// What makes a project of a template, and its version.
const GENERATE: (&str, &str) = ("cargo-generate", "0.23.7");

pub fn run(mut args: Args) -> Outcome {
    let setup = Setup::from(&mut args);
    let names = args.rest();
    let chosen = names.iter().map(|name| by_name(name)).collect::<Outcome<Vec<_>>>()?;
    setup.prepare(&[Part::Examples, Part::Firmware])?;
    if chosen.is_empty() {
        return all();
    }
    chosen.into_iter().try_for_each(build)
}

/// Builds all examples but the template, and prints their sizes. The tools must be installed.
pub fn all() -> Outcome {
    EXAMPLES.iter().filter(|example| example.tools != Tools::Template).try_for_each(build)
}

fn by_name(name: &str) -> Outcome<&'static Example> {
    EXAMPLES.iter().find(|example| example.name == name).ok_or_else(|| {
        let known: Vec<_> = EXAMPLES.iter().map(|example| example.name).collect();
        format!("there is no example \"{name}\"; there are: {}.", known.join(", "))
    })
}

fn build(example: &Example) -> Outcome {
    let folder = workspace::root().join("examples").join(example.folder);
    let work = workspace::target_dir().join("examples");
    let built = match example.tools {
        Tools::Cmake { toolchain, version } => cmake(&folder, &work.join(example.name), toolchain, version)?,
        Tools::Cargo { program, features } => cargo(&folder, &work.join("rust"), program, features)?,
        Tools::Template => template(&folder, &work)?,
    };
    let images = workspace::firmware_dir(BOARD);
    let image = images.join(format!("example-{}.elf", example.name));
    fs::create_dir_all(&images)
        .and_then(|()| fs::copy(&built, &image))
        .map_err(|error| format!("{} cannot be written: {error}.", workspace::shown(&image)))?;
    report(&image, BOARD.programs[0])
}

/// Builds a folder with CMake; returns the program.
fn cmake(folder: &Path, work: &Path, toolchain: &str, version: u32) -> Outcome<PathBuf> {
    // The folder is deleted first: CMake keeps the compiler and the folders of the previous run.
    if work.exists() {
        fs::remove_dir_all(work)
            .map_err(|error| format!("{} cannot be removed: {error}.", workspace::shown(work)))?;
    }
    let toolchain = workspace::root().join("examples/c/cmake").join(toolchain).with_extension("cmake");
    let mut configure = Command::new("cmake");
    configure.arg("-S").arg(folder).arg("-B").arg(work);
    configure.arg(format!("-DCMAKE_TOOLCHAIN_FILE={}", toolchain.display()));
    configure.arg(format!("-DVERSION={version}"));
    // Its output helps only to find a mistake.
    process::output(&mut configure)?;
    process::output(Command::new("cmake").arg("--build").arg(work))?;
    Ok(work.join("app.elf"))
}

/// Builds a package; returns the program. All packages share `work`, and so their dependencies.
fn cargo(folder: &Path, work: &Path, program: &str, features: &str) -> Outcome<PathBuf> {
    let mut cargo = process::cargo_on(folder, "build");
    // Cargo looks for the folder's own settings from its current folder.
    cargo.current_dir(folder).args(["--locked", "--release", "--features", features]);
    cargo.arg("--target-dir").arg(work);
    process::output(&mut cargo)?;
    Ok(work.join(workspace::TARGET).join("release").join(program))
}

/// Makes a project of the template in `folder` and builds it; returns the program.
fn template(folder: &Path, work: &Path) -> Outcome<PathBuf> {
    const NAME: &str = "from-template";
    let (tool, version) = GENERATE;
    let tool = setup::pinned_tool(tool, version, &[])?;
    let project = work.join(NAME);
    if project.exists() {
        fs::remove_dir_all(&project)
            .map_err(|error| format!("{} cannot be removed: {error}.", workspace::shown(&project)))?;
    }
    fs::create_dir_all(work)
        .map_err(|error| format!("{} cannot be made: {error}.", workspace::shown(work)))?;
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
    fs::copy(folder.join("Cargo.lock"), project.join("Cargo.lock"))
        .map_err(|error| format!("{} cannot be written to: {error}.", workspace::shown(&project)))?;
    let mut cargo = process::cargo_on(&project, "build");
    cargo.current_dir(&project).args(["--release", "--target-dir"]).arg(work.join("rust"));
    process::output(&mut cargo)?;
    Ok(work.join("rust").join(workspace::TARGET).join("release").join(NAME))
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::{self, Image};

    use super::*;

    /// The numbers in the repository's files are those of the board.
    #[test]
    fn the_memory_maps_of_the_examples_are_up_to_date() {
        let map = BOARD.linker_script(Image::Program(1)).to_string();
        for example in EXAMPLES.iter().filter(|example| matches!(example.tools, Tools::Cmake { .. })) {
            let path = workspace::root().join("examples").join(example.folder).join("layout.x");
            let line = format!(
                "cargo xtask layout --ld program-1 --board {} > {}",
                BOARD.board,
                workspace::shown(&path)
            );
            assert!(fs::read_to_string(&path).unwrap() == map, "{} is old: {line}", path.display());
        }
    }

    /// The interrupt lines that a CMakeLists.txt names are the chip's.
    #[test]
    fn the_examples_name_the_interrupt_lines_of_the_chip() {
        for example in EXAMPLES.iter().filter(|example| matches!(example.tools, Tools::Cmake { .. })) {
            let path = workspace::root().join("examples").join(example.folder).join("CMakeLists.txt");
            let line = format!("set(INTERRUPT_LINES {} ", BOARD.chip.interrupts);
            assert!(fs::read_to_string(&path).unwrap().contains(&line), "{}: {line}", path.display());
        }
    }

    /// Each file of the template is the example's, with the answers that fit the example.
    #[test]
    fn the_template_is_the_example() {
        let folder = workspace::root().join("examples/no-stack");
        let read = |file: &str| fs::read_to_string(folder.join(file)).unwrap();
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
        let path = workspace::root().join("examples/no-stack/cargo-generate.toml");
        let text = fs::read_to_string(path).unwrap();
        let choices = text.lines().find_map(|line| line.strip_prefix("choices = ")).unwrap();
        let names: Vec<_> = choices.split('"').skip(1).step_by(2).collect();
        assert_eq!(names.first(), Some(&BOARD.board));
        for name in names {
            assert_eq!(layout::by_name(name).expect(name).chip, BOARD.chip, "{name}");
        }
    }

    #[test]
    fn the_help_lists_every_example_and_each_has_its_page() {
        for example in EXAMPLES {
            let listed = HELP.lines().any(|line| line.trim_start().split(' ').next() == Some(example.name));
            assert!(listed, "{}", example.name);
            let page = workspace::root().join("examples").join(example.folder).join("README.md");
            assert!(page.exists(), "{}", page.display());
            assert!(by_name(example.name).is_ok_and(|found| found.folder == example.folder));
        }
        let unknown = by_name("cmake");
        assert!(unknown.is_err_and(|problem| problem.contains("there are: c, c-v2, cpp, cpp-v2, ")));
    }
}
