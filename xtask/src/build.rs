//! `cargo xtask build`: the images that go onto the chip.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use shared_abi::geometry::Region;
use shared_abi::layout::{Image, Layout};

use crate::args::Args;
use crate::setup::{Part, Setup};
use crate::size::{self, Flash};
use crate::workspace::{PROFILE, TARGET};
use crate::{process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask build [--board BOARD] [--yes]

Builds the bootloader, standard, with every option, without any, with a rescue window, with words for
whoever ports it and with CAN over UART, both versions of the application, the one for CAN over UART and
the one in C, and puts them into target/firmware/BOARD/ as bootloader.elf, bootloader-complete.elf,
bootloader-minimal.elf, bootloader-rescue.elf, bootloader-log-rtt.elf, -log-defmt.elf and -log-uart.elf,
bootloader-virtual-can.elf, app-v1.elf, app-v2.elf, app-virtual-can.elf and app-c.elf; for a board with room for two programs also app-program-2.elf and app-c-program-2.elf.
For the tests alone, bootloader-debugger.elf and app-debugger.elf have the debugger interface: never ship them.

  --board BOARD   the board (default: stm32f407g-disc1)
  --yes           installs what is missing with sudo
";

/// The built images of one board.
pub struct Images {
    /// The folder they are in.
    pub dir: PathBuf,
    /// The bootloader among them.
    pub bootloader: PathBuf,
    /// Those that tell what they do, by their places in [`LOGS`].
    pub logs: Vec<PathBuf>,
    /// The one that speaks CAN over the UART.
    pub virtual_can: PathBuf,
}

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let setup = Setup::from(&mut args);
    args.none_left()?;
    setup.prepare(&[Part::Firmware, Part::C])?;
    images(board)?;
    c_applications(board)
}

/// Builds all images of a board and prints their sizes.
///
/// # Errors
/// When one does not build, or is no image of this board.
pub fn images(board: &Layout) -> Outcome<Images> {
    let bootloader = bootloader(board)?;
    let complete = Build { board, package: "bootloader", features: COMPLETE };
    image(&complete, "bootloader-complete.elf", board.bootloader)?;
    let minimal = Build { board, package: "bootloader", features: "" };
    image(&minimal, "bootloader-minimal.elf", board.bootloader)?;
    let rescue = Build { board, package: "bootloader", features: RESCUE };
    image(&rescue, "bootloader-rescue.elf", board.bootloader)?;
    // Beside a second program there is no room for ESAcademy's password.
    let dialects: &[&str] = if board.programs.len() == 1 { &["paulus", "esacademy"] } else { &["paulus"] };
    for dialect in dialects {
        let features = format!("profile-{dialect}");
        let dialect = format!("bootloader-{dialect}.elf");
        image(&Build { board, package: "bootloader", features: &features }, &dialect, board.bootloader)?;
    }
    let logs = LOGS.iter().map(|(way, features)| {
        let log = Build { board, package: "bootloader", features };
        image(&log, &format!("bootloader-log-{way}.elf"), board.bootloader)
    });
    let logs = logs.collect::<Outcome<_>>()?;
    let debugger = Build { board, package: "bootloader", features: DEBUGGER };
    image(&debugger, "bootloader-debugger.elf", board.bootloader)?;
    let virtual_can = Build { board, package: "bootloader", features: VIRTUAL_CAN };
    let virtual_can = image(&virtual_can, "bootloader-virtual-can.elf", board.bootloader)?;
    let program = board.programs[0];
    // Version 1 is the template as it stands.
    image(&Build { board, package: "app-template", features: "" }, "app-v1.elf", program)?;
    image(&Build { board, package: "app-template", features: "version-2" }, "app-v2.elf", program)?;
    image(&Build { board, package: "app-template", features: "debugger" }, "app-debugger.elf", program)?;
    let application = Build { board, package: "app-template", features: "virtual-can" };
    image(&application, "app-virtual-can.elf", program)?;
    if let Some(second) = board.programs.get(1) {
        let features = "version-2,program-2";
        image(&Build { board, package: "app-template", features }, "app-program-2.elf", *second)?;
        // The second program's place takes the set of parameters.
        let lift = Build { board, package: "bootloader", features: "profile-lift" };
        image(&lift, "bootloader-lift.elf", board.bootloader)?;
        image(&Build { board, package: "app-template", features: "lift" }, "app-lift.elf", program)?;
        image(
            &Build { board, package: "app-template", features: "lift,version-2" },
            "app-lift-v2.elf",
            program,
        )?;
    }
    Ok(Images { dir: workspace::firmware_dir(board), bootloader, logs, virtual_can })
}

/// Builds the application in C for each program of a board. A board that app-c/boards does not know
/// has none.
///
/// # Errors
/// When it does not build, or is no image of this board.
pub fn c_applications(board: &Layout) -> Outcome {
    let sources = workspace::root().join("app-c");
    if !sources.join("boards").join(board.board).with_extension("h").exists() {
        eprintln!("  app-c/boards has no {}.h: no application in C", board.board);
        return Ok(());
    }
    let dir = workspace::firmware_dir(board);
    for (number, region) in (1..).zip(board.programs) {
        let name = if number == 1 { "app-c".to_owned() } else { format!("app-c-program-{number}") };
        let work = dir.join("c").join(&name);
        let write = |path: &Path, bytes: &[u8]| {
            fs::write(path, bytes)
                .map_err(|error| format!("{} cannot be written: {error}.", workspace::shown(path)))
        };
        fs::create_dir_all(&work)
            .map_err(|error| format!("{} cannot be made: {error}.", workspace::shown(&work)))?;
        let script = board.linker_script(Image::Program(number)).to_string();
        write(&work.join("layout.x"), script.as_bytes())?;
        let mut objects = Vec::new();
        for source in C_SOURCES {
            let object = work.join(source).with_extension("o");
            let mut clang = process::clang();
            clang.current_dir(&sources).args(C_FLAGS);
            clang.arg(format!("-DBOARD=\"boards/{}.h\"", board.board));
            process::run(clang.arg("-c").arg(source).arg("-o").arg(&object))?;
            objects.push(object);
        }
        let elf = dir.join(name).with_extension("elf");
        let mut linker = Command::new(rust_lld()?);
        linker.args(["-flavor", "gnu", "--gc-sections", "--nmagic", "--fatal-warnings", "-o"]).arg(&elf);
        linker.arg("-L").arg(&work).arg("-T").arg(sources.join("app.x"));
        process::run(linker.args(objects))?;
        report(&elf, *region)?;
    }
    Ok(())
}

/// What the application in C is made of.
const C_SOURCES: [&str; 4] = ["startup.c", "can.c", "probe.c", "main.c"];
/// How it is compiled. It keeps the FPU off, so it is compiled for a chip without one; what it
/// calls in the bootloader takes and gives no floating-point numbers.
const C_FLAGS: &[&str] = &[
    "--target=thumbv7em-none-eabi",
    "-mcpu=cortex-m4",
    "-mfloat-abi=soft",
    "-std=c11",
    "-ffreestanding",
    "-fno-builtin",
    "-ffunction-sections",
    "-fdata-sections",
    "-Os",
    "-g",
    "-fdebug-compilation-dir=app-c",
    "-Wall",
    "-Wextra",
    "-Werror",
];

/// The linker that comes with the Rust toolchain: what links the rest of the firmware.
fn rust_lld() -> Outcome<PathBuf> {
    let said = process::output(Command::new("rustc").args(["--version", "--verbose"]))?;
    let host = said.lines().find_map(|line| line.strip_prefix("host: ")).unwrap_or_default();
    let sysroot = process::output(Command::new("rustc").args(["--print", "sysroot"]))?;
    let tools = Path::new(sysroot.trim()).join("lib/rustlib").join(host).join("bin");
    Ok(tools.join("rust-lld").with_extension(std::env::consts::EXE_EXTENSION))
}

/// Builds the bootloader of a board and prints its size.
///
/// # Errors
/// When it does not build, or is no image of this board.
pub fn bootloader(board: &Layout) -> Outcome<PathBuf> {
    image(&Build { board, package: "bootloader", features: STANDARD }, "bootloader.elf", board.bootloader)
}

/// The bootloader's features that a product may go without.
pub const OPTIONAL: [&str; 9] = [
    "emcy",
    "lss",
    "raw-image",
    "intel-hex",
    "auto-bit-rate",
    "block-upload",
    "rescue-window",
    "password",
    "read-back",
];
/// Those of them that a product usually has: this bootloader is the one that is measured against
/// the budget.
pub const STANDARD: &str = "standard";
/// With a rescue window. Beside everything that is standard there is no room for it.
const RESCUE: &str = "emcy,lss,raw-image,rescue-window";
/// Bootloaders with words for whoever ports them, by the way that they take. The standard one and
/// its words would not fit: these do without the dialects.
pub const LOGS: [(&str, &str); 3] =
    [("rtt", "emcy,lss,log-rtt"), ("defmt", "emcy,lss,log-defmt"), ("uart", "emcy,lss,log-uart")];
/// The one with the debugger interface, for the tests: without programs that come in one piece and
/// layer setting services, or it would not fit.
pub const DEBUGGER: &str = "emcy,debugger";
/// A bootloader that speaks CAN over the UART, without the dialects as there is no room for them.
pub const VIRTUAL_CAN: &str = "emcy,lss,virtual-can";
/// All of them.
pub const COMPLETE: &str = "complete";

/// Builds the bootloader of a board with some of [`OPTIONAL`], to look at.
///
/// # Errors
/// When it does not build.
pub fn bootloader_with(board: &Layout, features: &[&str]) -> Outcome<PathBuf> {
    let features = features.join(",");
    let mut cargo = process::cargo("build");
    process::run(cargo.arg("--quiet").args(firmware_args("bootloader", board, &features)))?;
    Ok(workspace::target_dir().join("fw").join(TARGET).join(PROFILE).join("bootloader"))
}

/// One call of cargo: the package is also the name of its program.
struct Build<'a> {
    board: &'a Layout,
    package: &'a str,
    /// Besides the one that chooses the board.
    features: &'a str,
}

/// The arguments that make cargo work on a firmware package for a board; for `cargo clippy`, too.
pub fn firmware_args(package: &str, board: &Layout, features: &str) -> Vec<String> {
    let features = format!("board-{},{features}", board.board);
    // A folder of its own: another target and profile, built while host crates may be building.
    let target_dir = workspace::target_dir().join("fw").display().to_string();
    [
        ["--package", package],
        ["--target", TARGET],
        ["--profile", PROFILE],
        ["--features", features.trim_end_matches(',')],
        ["--target-dir", &target_dir],
    ]
    .concat()
    .into_iter()
    .chain(["--no-default-features"])
    .map(str::to_owned)
    .collect()
}

/// The arguments that make cargo build the crate of the emulated tests for a board.
pub fn tests_args(board: &Layout) -> Vec<String> {
    let features = format!("--features=board-{}", board.board);
    ["--package=coboot-tests", "--no-default-features", &features].map(str::to_owned).to_vec()
}

/// Builds an image and puts it, by its name there, into the board's folder.
fn image(build: &Build<'_>, name: &str, region: Region) -> Outcome<PathBuf> {
    let &Build { board, package, features } = build;
    let dir = workspace::firmware_dir(board);
    fs::create_dir_all(&dir)
        .map_err(|error| format!("{} cannot be made: {error}.", workspace::shown(&dir)))?;
    let to = dir.join(name);
    process::run(process::cargo("build").args(firmware_args(package, board, features)))?;
    let built = workspace::target_dir().join("fw").join(TARGET).join(PROFILE).join(package);
    let file = fs::read(&built).map_err(|error| {
        format!("cargo built {package}, but {} cannot be read: {error}.", built.display())
    })?;
    // Left alone when nothing changed, so that whoever looks at the time sees no change.
    if fs::read(&to).ok().as_ref() != Some(&file) {
        fs::write(&to, &file)
            .map_err(|error| format!("{} cannot be written: {error}.", workspace::shown(&to)))?;
    }
    report(&to, region)?;
    Ok(to)
}

/// Prints the size of an image.
///
/// # Errors
/// When it lies outside its flash.
fn report(image: &Path, region: Region) -> Outcome {
    let flash = Flash::of(&size::read(image)?, region)
        .map_err(|problem| format!("{}: {problem}", workspace::shown(image)))?;
    // Beside what cargo says: the standard output is the job's, which may be asked for JSON.
    eprintln!("  {:<52} {:>6} of {} bytes", workspace::shown(image), flash.used, region.size);
    Ok(())
}
