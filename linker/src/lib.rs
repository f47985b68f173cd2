//! A build-script helper for applications that run under the coboot bootloader. It gives the linker
//! the address of the program, and gives the program the memory map of its board.
//!
//! ```no_run
//! // build.rs
//! coboot_linker::Application::of_board("stm32f407g-disc1").emit();
//! ```
//!
//! [`Application::emit`] writes four files into `OUT_DIR` and makes cargo link with them:
//!
//! | file | what it is |
//! |---|---|
//! | `memory.x` | `MEMORY` and the border symbols of the board |
//! | `label.x` | places the label |
//! | `application.x` | includes the `link.x` of cortex-m-rt, checks the borders |
//! | `coboot_layout.rs` | the memory map as a Rust expression, for `coboot_app::layout!()` |
//!
//! `board` reads a memory map from a file, for host tools too (feature `file`, on by default).
#![forbid(unsafe_code)]

#[cfg(feature = "file")]
pub mod board;
mod rust;

use std::path::{Path, PathBuf};
use std::{env, fmt, fs};

use shared_abi::layout::{self, Image, Layout, LinkerScript, BOARDS};

/// Why the helper cannot prepare an application.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Error {
    /// No board has this name.
    NoBoard {
        /// The name.
        name: String,
    },
    /// The device has no program of this number.
    NoProgram {
        /// The board.
        board: &'static str,
        /// The number that was asked for.
        number: u8,
        /// How many programs the device has.
        programs: usize,
    },
    /// A file cannot be read or written, or says something wrong.
    File {
        /// The file.
        path: String,
        /// What is wrong with it.
        error: String,
    },
    /// This is no build script: cargo has not set `OUT_DIR`.
    NoBuildScript,
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let boards = || BOARDS.iter().map(|layout| layout.board).collect::<Vec<_>>().join(", ");
        match self {
            Self::NoBoard { name } => write!(
                f,
                "no board \"{name}\" is known; there is: {}. For another board write its memory map into a file \
                 (`cargo xtask layout --toml`) and use `of_file`.",
                boards()
            ),
            Self::NoProgram { board, number, programs } => {
                write!(f, "{board} has no program {number}: its programs are numbered from 1 to {programs}.")
            }
            Self::File { path, error } => write!(f, "{path}: {error}."),
            Self::NoBuildScript => {
                write!(f, "OUT_DIR is not set: this is to be called by a build script (build.rs).")
            }
        }
    }
}

impl std::error::Error for Error {}

impl Error {
    fn file(path: &Path, error: &dyn fmt::Display) -> Self {
        Self::File { path: path.display().to_string(), error: error.to_string() }
    }
}

/// The name of the file that `coboot_app::layout!()` includes.
pub const LAYOUT_FILE: &str = "coboot_layout.rs";
/// The linker script of an application.
const TEMPLATE: &str = include_str!("../application.x");
/// The part of it that is read first.
const LABEL: &str = include_str!("../label.x");

/// An application and the source of its memory map.
#[derive(Clone, Debug)]
#[must_use = "`emit` does the work"]
pub struct Application {
    layout: Result<&'static Layout, Error>,
    /// The file that the layout comes from.
    file: Option<PathBuf>,
    program: u8,
    over_staging: bool,
    keeps_ram: bool,
}

impl Application {
    /// For a board with this memory map.
    pub const fn new(layout: &'static Layout) -> Self {
        Self { layout: Ok(layout), file: None, program: 1, over_staging: false, keeps_ram: false }
    }

    /// For a board of the coboot repository, by its name.
    pub fn of_board(name: &str) -> Self {
        let layout = layout::by_name(name).ok_or_else(|| Error::NoBoard { name: name.to_owned() });
        Self { layout, ..Self::new(layout::DEFAULT) }
    }

    /// For the board of the coboot repository that the variable `COBOOT_BOARD` names.
    pub fn chosen() -> Self {
        Self { layout: chosen_board(), ..Self::new(layout::DEFAULT) }
    }

    /// For a board whose memory map is in this file, which `cargo xtask layout --toml` has written.
    /// A relative path begins at the package.
    #[cfg(feature = "file")]
    pub fn of_file(path: impl AsRef<Path>) -> Self {
        let path = path.as_ref();
        let layout = fs::read_to_string(path)
            .map_err(|error| Error::file(path, &error))
            .and_then(|text| board::parse(&text).map_err(|error| Error::file(path, &error)));
        Self { layout, file: Some(path.to_owned()), ..Self::new(layout::DEFAULT) }
    }

    /// Links for the place of program `number`; 1 (the default) is the first.
    pub const fn program(mut self, number: u8) -> Self {
        self.program = number;
        self
    }

    /// Links into staging, too: the flash that a new bootloader needs (docs/renewal.md). Such a program has to
    /// be cleared before the bootloader of its device is renewed.
    pub const fn over_staging(mut self) -> Self {
        self.over_staging = true;
        self
    }

    /// Ends the RAM of the program before the last KiB, which the bootloader leaves alone
    /// ([`Layout::kept`]): a crash log there outlives each reset but that of the power.
    /// `panic-persist` finds it by its symbols.
    pub const fn keeping_ram(mut self) -> Self {
        self.keeps_ram = true;
        self
    }

    /// Writes the files into `OUT_DIR` and makes cargo link with them. An error ends the build
    /// with a message that gives the reason.
    pub fn emit(self) {
        if let Err(error) = self.try_emit() {
            println!("cargo::error={error}");
            std::process::exit(1);
        }
    }

    /// As [`emit`](Self::emit).
    ///
    /// # Errors
    /// [`Error`] says what is wrong.
    pub fn try_emit(self) -> Result<(), Error> {
        let out = env::var_os("OUT_DIR").map(PathBuf::from).ok_or(Error::NoBuildScript)?;
        if let Some(file) = &self.file {
            println!("cargo::rerun-if-changed={}", file.display());
        }
        self.write(&out)?;
        println!("cargo::rerun-if-changed=build.rs");
        link(&out, &["label.x", "application.x"]);
        Ok(())
    }

    /// Writes the files into a folder.
    ///
    /// # Errors
    /// [`Error`] says what is wrong.
    pub fn write(&self, folder: &Path) -> Result<(), Error> {
        let layout = self.layout.clone()?;
        if layout.program(self.program).is_none() {
            return Err(Error::NoProgram {
                board: layout.board,
                number: self.program,
                programs: layout.programs.len(),
            });
        }
        let image = match self.over_staging {
            true => Image::WholeProgram(self.program),
            false => Image::Program(self.program),
        };
        let script = layout.linker_script(image);
        write_memory(if self.keeps_ram { script.keeping_ram() } else { script }, folder)?;
        for (name, text) in [
            ("label.x", LABEL.to_owned()),
            ("application.x", TEMPLATE.to_owned()),
            (LAYOUT_FILE, rust::Expression(layout).to_string()),
        ] {
            write(&folder.join(name), &text)?;
        }
        Ok(())
    }
}

/// The board of the coboot repository that the variable `COBOOT_BOARD` names, or the first one where
/// it is not set. For build scripts.
///
/// # Errors
/// [`Error::NoBoard`].
pub fn chosen_board() -> Result<&'static Layout, Error> {
    println!("cargo::rerun-if-env-changed=COBOOT_BOARD");
    match env::var("COBOOT_BOARD") {
        Ok(name) => layout::by_name(&name).ok_or(Error::NoBoard { name }),
        Err(_) => Ok(layout::DEFAULT),
    }
}

/// Writes `memory.x` of an image into a folder.
///
/// # Errors
/// [`Error::File`].
pub fn write_memory(script: LinkerScript<'_>, folder: &Path) -> Result<(), Error> {
    write(&folder.join("memory.x"), &script.to_string())
}

/// Makes cargo link the binaries of this package with `scripts`, which are in `folder` together
/// with the files that they include.
pub fn link(folder: &Path, scripts: &[&str]) {
    for argument in arguments(folder, scripts) {
        println!("cargo::rustc-link-arg-bins={argument}");
    }
}

/// The arguments, in the forms that LLD, GNU ld, gcc as a linker and flip-link all know: flip-link
/// 0.1.12 finds a folder only in an argument of its own after `-L`, and gcc hands on `-n`, but not
/// `--nmagic`.
fn arguments(folder: &Path, scripts: &[&str]) -> Vec<String> {
    // Not `rustc-link-search`: packages that depend on this one would find its files, too. Without
    // `-n` the linker aligns segments to pages of 64 KiB, and the file claims more flash than the
    // program fills.
    let folder = ["-n".into(), "-L".into(), folder.display().to_string()];
    folder.into_iter().chain(scripts.iter().map(|script| format!("-T{script}"))).collect()
}

fn write(path: &Path, text: &str) -> Result<(), Error> {
    fs::write(path, text).map_err(|error| Error::file(path, &error))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder that only this test uses.
    fn folder(name: &str) -> PathBuf {
        let folder = env::temp_dir().join(format!("coboot-linker-{}-{name}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        folder
    }

    #[test]
    fn a_map_from_a_file_places_a_program_as_the_map_of_the_repository_does() {
        let folder = folder("file");
        let map = folder.join("board.toml");
        let board = &layout::stm32f407g_disc1_two::LAYOUT;
        fs::write(&map, layout::toml::Toml(board).to_string()).unwrap();
        let mut scripts = Vec::new();
        for application in [Application::of_file(&map), Application::of_board(board.board)] {
            application.program(2).write(&folder).unwrap();
            scripts.push(fs::read_to_string(folder.join("memory.x")).unwrap());
        }
        assert_eq!(scripts[0], scripts[1]);
        // Sectors 8 to 10 of an STM32F407 (RM0090 table 5): sector 11 is staging.
        assert!(scripts[0].contains("FLASH : ORIGIN = 0x08080000, LENGTH = 0x60000"), "{}", scripts[0]);
        Application::of_file(&map).program(2).over_staging().write(&folder).unwrap();
        let whole = fs::read_to_string(folder.join("memory.x")).unwrap();
        assert!(whole.contains("FLASH : ORIGIN = 0x08080000, LENGTH = 0x80000"), "{whole}");
        assert!(fs::read_to_string(folder.join("application.x")).unwrap().contains("INCLUDE link.x"));
        fs::remove_dir_all(folder).unwrap();
    }

    /// As the parser of flip-link 0.1.12 reads them (`argument_parser.rs`): pairs for `-L`, one for
    /// `-T`.
    #[test]
    fn the_linkers_of_others_understand_the_arguments() {
        let arguments = arguments(Path::new("/out"), &["label.x", "application.x"]);
        assert_eq!(arguments, ["-n", "-L", "/out", "-Tlabel.x", "-Tapplication.x"]);
    }

    #[test]
    fn what_cannot_be_is_told_in_words() {
        let folder = folder("wrong");
        let refusal = |application: Application| application.write(&folder).unwrap_err().to_string();
        let text = refusal(Application::of_board("stm32f407g-disc2"));
        assert!(
            text.contains("no board \"stm32f407g-disc2\"") && text.contains("stm32f429i-disc1"),
            "{text}"
        );
        for number in [0, 2, 255] {
            let text = refusal(Application::of_board("stm32f407g-disc1").program(number));
            assert!(text.contains(&format!("no program {number}")), "{text}");
        }
        let missing = folder.join("none.toml");
        assert!(refusal(Application::of_file(&missing)).contains("none.toml"));
        let rubbish = folder.join("rubbish.toml");
        fs::write(&rubbish, "board = [").unwrap();
        let text = refusal(Application::of_file(&rubbish));
        assert!(text.contains("rubbish.toml: line 1"), "{text}");
        fs::remove_dir_all(folder).unwrap();
    }
}
