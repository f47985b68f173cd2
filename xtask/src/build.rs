//! `cargo xtask build`: builds the images for the chip.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use shared_abi::geometry::Region;
use shared_abi::layout::{Image, Layout};

use crate::args::Args;
use crate::product::Product;
use crate::setup::{self, Part};
use crate::workspace::{PROFILE, TARGET};
use crate::{elf, files, outcome::Outcome, process, ram_image, workspace};

pub const HELP: &str = "\
usage: cargo xtask build [NAME...] [--all] [--product FILE|NAME] [--board BOARD]

Builds images of a board and puts them into target/firmware/BOARD/NAME.elf, and beside them the board's file,
BOARD.toml, for `emulate --board` and `coflash --board`. Without a NAME it builds bootloader, app-v1 and app-v2; a
wrong NAME lists the others. Cargo decides each time what has changed.
app-c is the application in C, for each program of the board, and with the tests' objects (app-c-probe).

  --all           every image of the board and the applications in C: what the tests need
  --product FILE  the product of the bootloaders: a file like bootloader/products/default.rs, or the name
                  of a file there. Its name is in the file of the image (bootloader-NAME.elf) and in 100Ah
  --board BOARD   the board (default: stm32f407g-disc1)
";

/// An image of a board.
pub struct Variant {
    /// Its file's name, without `.elf`.
    pub name: &'static str,
    /// The package, which is also the name of its program.
    pub package: &'static str,
    /// The features in addition to the one for the board.
    pub features: &'static str,
    /// The name of its product (`bootloader/products`), if it is not the default.
    pub product: Option<&'static str>,
    /// The number of the program; 0 for a bootloader.
    pub program: u8,
    /// The least number of programs of a board with this image.
    pub least_programs: usize,
}

/// The rows as written, followed by one row for each feature with each product, on boards with two programs.
macro_rules! table {
    ($($row:expr,)+; $($feature:literal with $($product:literal),+;)+) => {
        &[$($row,)+ $($(Variant {
            product: Some($product),
            least_programs: 2,
            ..bootloader(concat!("bootloader-", $feature, "-", $product), $feature)
        },)+)+]
    };
}

/// All images, in the order in which they are built.
pub const VARIANTS: &[Variant] = table![
    bootloader("bootloader", ""),
    product("bootloader-paulus", "paulus"),
    product("bootloader-esacademy", "esacademy"),
    product("bootloader-lift", "lift"),
    product("bootloader-crc-16", "crc-16"),
    // All options that a product may switch off are off.
    product("bootloader-least", "least"),
    // A board's own choices: switches, identifiers, ranges.
    product("bootloader-switches", "switches"),
    // Programs start with the watchdog.
    product("bootloader-watchdog", "watchdog"),
    // Ways into a bootloader without an entry strap.
    product("bootloader-ways-in", "ways-in"),
    // Its parameters are in an EEPROM.
    product("bootloader-eeprom", "eeprom"),
    // They log their work, each one in another way (`cargo xtask emulate --log=WAY`).
    bootloader("bootloader-log-rtt", "log-rtt"),
    bootloader("bootloader-log-defmt", "log-defmt"),
    bootloader("bootloader-log-uart", "log-uart"),
    bootloader("bootloader-virtual-can", "virtual-can"),
    // It accepts programs only from the holder of a key.
    bootloader("bootloader-sealed", "sealed"),
    // Its sealed programs may write flash, so it is not renewed.
    Variant { product: Some("writes-flash"), ..bootloader("bootloader-sealed-writes-flash", "sealed") },
    bootloader("bootloader-sealed-log-rtt", "sealed,log-rtt"),
    // With the debugger interface, only for the tests: never ship it.
    bootloader("bootloader-debugger", "debugger"),
    bootloader("bootloader-sealed-debugger", "sealed,debugger"),
    application("app-debugger", "test-app", "debugger"),
    application("app-test", "test-app", ""),
    // The unchanged template, in two versions.
    application("app-v1", "app-template", ""),
    application("app-v2", "app-template-v2", ""),
    application("app-virtual-can", "test-app", "virtual-can"),
    Variant { program: 2, least_programs: 2, ..application("app-program-2", "app-template-v2", "program-2") },
    Variant { least_programs: 2, ..application("app-lift", "test-app", "lift") },
    Variant { least_programs: 2, ..application("app-lift-v2", "test-app", "lift,version-2") },
    // The image for the sessions of the dialects over UART (tests/port/matrix.rs).
    Variant { least_programs: 2, ..application("app-virtual-can-v2", "test-app", "virtual-can,version-2") },
    Variant { least_programs: 2, ..application("app-virtual-can-lift", "test-app", "virtual-can,lift") },
    ;
    // Each log and the serial transport with each dialect, for example `bootloader-log-rtt-paulus`.
    "log-rtt" with "paulus", "esacademy", "lift";
    "log-defmt" with "paulus", "esacademy", "lift";
    "log-uart" with "paulus", "esacademy", "lift";
    "virtual-can" with "paulus", "esacademy", "lift";
];

/// The images for the main job.
pub const MAIN: [&str; 3] = ["bootloader", "app-v1", "app-v2"];

const fn bootloader(name: &'static str, features: &'static str) -> Variant {
    Variant { name, package: "bootloader", features, product: None, program: 0, least_programs: 1 }
}

/// The bootloader of this product (`bootloader/products`).
const fn product(name: &'static str, product: &'static str) -> Variant {
    Variant { product: Some(product), ..bootloader(name, "") }
}

const fn application(name: &'static str, package: &'static str, features: &'static str) -> Variant {
    Variant { name, package, features, product: None, program: 1, least_programs: 1 }
}

impl Variant {
    /// The image with this name, if the board has it.
    pub fn by_name(board: &Layout, name: &str) -> Outcome<&'static Self> {
        Self::of(board).find(|variant| variant.name == name).ok_or_else(|| {
            let known: Vec<_> = Self::of(board).map(|variant| variant.name).collect();
            format!("{} has no image \"{name}\"; it has: {}.", board.board, known.join(", "))
        })
    }

    /// The images of a board.
    pub fn of(board: &Layout) -> impl Iterator<Item = &'static Self> + '_ {
        let fits = |variant: &&Self| board.home.is_some() || !variant.needs_split();
        VARIANTS.iter().filter(|variant| variant.least_programs <= board.programs.len()).filter(fits)
    }

    /// Whether only the split map has room for it, or for the bootloader that it needs.
    fn needs_split(&self) -> bool {
        const FEATURES: [&str; 6] = ["debugger", "log-defmt", "log-rtt", "log-uart", "sealed", "virtual-can"];
        matches!(self.product, Some("crc-16" | "eeprom"))
            || self.features.split(',').any(|feature| FEATURES.contains(&feature))
    }

    /// The product of the image.
    pub fn product(&self) -> Outcome<Product> {
        self.product.map_or_else(|| Ok(Product::default()), Product::named)
    }

    /// The name of this image of another product.
    fn name_of(&self, product: &Product) -> Outcome<String> {
        if self.product.is_some() {
            return Err(format!("{} has a product; --product is for the others.", self.name));
        }
        let name = format!("{}-{}", self.name, product.name);
        let other = VARIANTS.iter().find(|other| other.name == name);
        if other.is_some_and(|other| other.product != Some(&product.name) || other.features != self.features)
        {
            return Err(format!("{name} is another image already; give the product another name."));
        }
        Ok(name)
    }

    /// Whether the image is a bootloader.
    pub const fn is_bootloader(&self) -> bool {
        self.program == 0
    }

    /// The flash regions of the image.
    fn regions(&self, board: &Layout) -> Vec<Region> {
        board.program(self.program).map_or_else(|| bootloader_flash(board), |program| vec![program])
    }
}

/// The flash regions of the bootloaders of a board: of the resident part, and in the split map of the RAM image.
pub fn bootloader_flash(board: &Layout) -> Vec<Region> {
    [Some(board.resident()), board.home].into_iter().flatten().collect()
}

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let every = args.flag("--all");
    let product = args.value("--product")?.map(|word| Product::chosen(&word)).transpose()?;
    let product = product.filter(|product| !product.is_default());
    let words = args.remaining();
    let names = match words.as_slice() {
        [] if every => all(board),
        [] => MAIN.to_vec(),
        _ if every => return Err("--all and names do not go together.".into()),
        words => words.iter().map(String::as_str).collect(),
    };
    // A name that there is not is refused before anything is installed.
    for name in names.iter().filter(|name| **name != C_APPLICATION) {
        Variant::by_name(board, name)?;
    }
    let in_c = names.contains(&C_APPLICATION);
    setup::prepare(if in_c { &[Part::Firmware, Part::C] } else { &[Part::Firmware] })?;
    build(board, &names, product.as_ref())
}

/// The names of all images of a board, and that of the applications in C.
fn all(board: &Layout) -> Vec<&'static str> {
    Variant::of(board).map(|of| of.name).chain([C_APPLICATION]).collect()
}

/// Builds images of a board by their names, and prints their sizes; a bootloader as one of this product, if there is
/// one. Cargo says what has changed: it alone knows of crates outside of the repository and of variables.
fn build(board: &Layout, names: &[&str], product: Option<&Product>) -> Outcome {
    board_file(board)?;
    each(board, names, |variant| match product.filter(|_| variant.is_bootloader()) {
        Some(product) => image(board, variant, &variant.name_of(product)?, product),
        None => image(board, variant, variant.name, &variant.product()?),
    })
}

/// Builds images of a board by their names: each by this function, or the applications in C.
fn each(board: &Layout, names: &[&str], of_one: impl Fn(&Variant) -> Outcome) -> Outcome {
    names.iter().try_for_each(|name| match *name {
        C_APPLICATION => c_applications(board),
        name => of_one(Variant::by_name(board, name)?),
    })
}

/// The same without another product; returns the folder of the images.
pub fn images(board: &Layout, names: &[&str]) -> Outcome<PathBuf> {
    build(board, names, None)?;
    Ok(workspace::firmware_dir(board))
}

/// The file of a board, for programs that were not built with it.
pub fn file_of(board: &Layout) -> PathBuf {
    workspace::firmware_dir(board).join(format!("{}.toml", board.board))
}

/// Writes it. The board's own crate knows what is around the chip.
fn board_file(board: &Layout) -> Outcome {
    let mut cargo = process::cargo("run --quiet --package bsp --example board");
    cargo.env("COBOOT_BOARD", board.board).arg("--target-dir").arg(target_dir(board));
    files::write(&file_of(board), process::output(&mut cargo)?)
}

/// What the images are made of. The crates of others are in Cargo.lock.
const SOURCES: &str = ".cargo Cargo.lock Cargo.toml app-template bootloader bsp coboot-app core linker \
                       rust-toolchain.toml shared-abi tests/apps";

/// Builds an image for a run of tests, unless such a run has built it after the last change of its sources and of this
/// program: cargo keeps only the last product of a program, and would link all others once more.
fn renewed(board: &Layout, variant: &Variant) -> Outcome {
    let (elf, stamp) = (elf_of(board, variant.name), elf_of(board, variant.name).with_extension("built"));
    let program = std::env::current_exe().map_err(|error| format!("this program has no path: {error}"))?;
    if elf.exists() && stamp.exists() {
        // A folder changes when a file in it goes. This program itself may have been linked anew since it began: its
        // old file has no name any more.
        let mut find = Command::new("find");
        find.current_dir(workspace::root())
            .args(SOURCES.split(' '))
            .args(Some(program).filter(|it| it.exists()));
        if process::output(find.arg("-newer").arg(&stamp).args(["-print", "-quit"]))?.is_empty() {
            return report(&elf, &variant.regions(board));
        }
    }
    // A source that changes in the meantime is newer.
    let begun = stamp.with_extension("begun");
    files::write(&begun, "")?;
    image(board, variant, variant.name, &variant.product()?)?;
    fs::rename(&begun, &stamp).map_err(|error| format!("{}: {error}.", stamp.display()))
}

/// The file of an image.
fn elf_of(board: &Layout, name: &str) -> PathBuf {
    workspace::firmware_dir(board).join(format!("{name}.elf"))
}

/// Builds the images that tests need, with these names for several boards, or everything where there are no names;
/// several chips at once, since the last step of each image uses only one core.
pub fn boards(boards: &[(&Layout, &str)]) -> Outcome {
    let of_board = |(board, names): (&Layout, &str)| {
        let names = if names.is_empty() { all(board) } else { names.split_whitespace().collect() };
        each(board, &names, |variant| renewed(board, variant))
    };
    let chips: BTreeSet<&str> = boards.iter().map(|(board, _)| board.chip.line.name()).collect();
    std::thread::scope(|scope| {
        let of_chip = |chip| boards.iter().copied().filter(move |(board, _)| board.chip.line.name() == chip);
        let builders: Vec<_> =
            chips.into_iter().map(|chip| scope.spawn(move || of_chip(chip).try_for_each(of_board))).collect();
        // A builder that panics has printed the reason.
        builders
            .into_iter()
            .try_for_each(|builder| builder.join().unwrap_or_else(|_| Err("a build broke off.".into())))
    })
}

/// Builds the application in C for each program of a board, and the same with the tests' object 2100h. A board
/// without a header in examples/c/boards has none.
fn c_applications(board: &Layout) -> Outcome {
    let (sources, dir) = (workspace::root().join("examples/c"), workspace::firmware_dir(board));
    let header = format!("boards/{}.h", board.board);
    if !sources.join(&header).exists() {
        eprintln!("  examples/c has no {header}: no application in C");
        return Ok(());
    }
    let probe = workspace::root().join("tests/c/probe.cmake");
    for (number, region) in (1..).zip(board.programs) {
        for (name, more) in [(C_APPLICATION, None), ("app-c-probe", Some(&probe))] {
            let name = if number == 1 { name.to_owned() } else { format!("{name}-program-{number}") };
            let work = dir.join("c").join(&name);
            let mut options = vec![
                format!("BOARD={header}"),
                format!("INTERRUPT_LINES={}", board.chip.interrupts),
                format!("LAYOUT={}", work.display()),
                format!("COBOOT_LD={}", lld()?.display()),
                "CMAKE_BUILD_TYPE=MinSizeRel".to_owned(),
                "CMAKE_COMPILE_WARNING_AS_ERROR=ON".to_owned(),
            ];
            options.extend(more.map(|file| format!("CMAKE_PROJECT_app_INCLUDE={}", file.display())));
            files::write(&work.join("layout.x"), board.linker_script(Image::Program(number)).to_string())?;
            let elf = dir.join(name).with_extension("elf");
            files::copy(&by_cmake(&sources, &work.join("build"), "clang", &options)?, &elf)?;
            report(&elf, &[*region])?;
        }
    }
    Ok(())
}

/// Builds an example with CMake, by a toolchain file of `examples/c/cmake` and these variables; returns the program.
pub fn by_cmake(folder: &Path, work: &Path, toolchain: &str, variables: &[String]) -> Outcome<PathBuf> {
    // The folder is deleted first: CMake keeps the compiler and the folders of the previous run.
    files::remove(work)?;
    let toolchain = workspace::root().join("examples/c/cmake").join(toolchain).with_extension("cmake");
    let mut configure = Command::new("cmake");
    configure.arg("-S").arg(folder).arg("-B").arg(work);
    configure.arg(format!("-DCMAKE_TOOLCHAIN_FILE={}", toolchain.display()));
    // Its output helps only to find a mistake.
    process::output(configure.args(variables.iter().map(|variable| format!("-D{variable}"))))?;
    process::output(Command::new("cmake").arg("--build").arg(work))?;
    Ok(work.join("app.elf"))
}

/// The name of the application in C; for a build it stands for all applications in C.
pub const C_APPLICATION: &str = "app-c";

/// The linker of the Rust toolchain, which also links the rest of the firmware.
fn lld() -> Outcome<PathBuf> {
    let version = process::output(Command::new("rustc").args(["--version", "--verbose"]))?;
    let host = version.lines().find_map(|line| line.strip_prefix("host: ")).unwrap_or_default();
    let sysroot = process::output(Command::new("rustc").args(["--print", "sysroot"]))?;
    let tools = Path::new(sysroot.trim()).join("lib/rustlib").join(host).join("bin/gcc-ld");
    Ok(tools.join(format!("ld.lld{}", std::env::consts::EXE_SUFFIX)))
}

/// Builds a bootloader; returns what it takes of each of [`bootloader_flash`], in bytes.
pub fn bootloader_size(board: &Layout, features: &str, product: &Product) -> Outcome<Vec<u32>> {
    let mut cargo = cargo_for("bootloader", board, features, product);
    used(board, &ram_image::seal(built(board, "bootloader", cargo.env("CARGO_TERM_QUIET", "true"))?)?)
}

/// The same of a bootloader that was built under a name.
pub fn size_of(board: &Layout, name: &str) -> Outcome<Vec<u32>> {
    used(board, &files::bytes(&elf_of(board, name))?)
}

fn used(board: &Layout, bootloader: &[u8]) -> Outcome<Vec<u32>> {
    elf::used(&elf::segments(bootloader)?, &bootloader_flash(board))
}

/// The folders with the files of the boards.
pub const BOARD_FOLDERS: [&str; 2] = ["shared-abi/src/layout/boards", "bsp/src/boards"];

/// The feature that selects the HAL of a board's chip.
pub fn chip_feature(board: &Layout) -> String {
    format!("bsp/chip-{}", board.chip.line.name())
}

/// Cargo on a firmware package for a board, whatever the `COBOOT_BOARD` of the caller says.
pub fn firmware(subcommand: &str, package: &str, board: &Layout, features: &str) -> Command {
    let features = format!("{},{features}", chip_feature(board));
    let mut cargo = process::cargo(subcommand);
    cargo.env("COBOOT_BOARD", board.board).arg("--target-dir").arg(target_dir(board));
    cargo.args(["--target", TARGET, "--profile", PROFILE, "--package", package, "--no-default-features"]);
    cargo.args(["--features", features.trim_end_matches(',')]);
    cargo
}

/// The same on the crate of the emulated tests, with the firmware of a board.
pub fn tests(subcommand: &str, board: &Layout) -> Command {
    let mut cargo = process::cargo(subcommand);
    cargo.env("COBOOT_BOARD", board.board).env("COBOOT_FIRMWARE_DIR", workspace::firmware_dir(board));
    cargo.arg("--package=coboot-tests");
    cargo
}

/// The command that runs a program of that crate; its arguments follow.
pub fn tests_program(board: &Layout, name: &str) -> Command {
    let mut cargo = tests("run", board);
    cargo.args(["--bin", name, "--"]);
    cargo
}

/// Cargo's folder for the firmware of a board: one for each chip. Cargo locks its folder, so this
/// allows builds of two chips and of a host crate at once; two chips share no HAL anyway.
fn target_dir(board: &Layout) -> PathBuf {
    workspace::target_dir().join("fw").join(board.chip.line.name())
}

/// The cargo command that builds an image.
fn cargo_for(package: &str, board: &Layout, features: &str, product: &Product) -> Command {
    let mut cargo = firmware("build", package, board, features);
    cargo.args(product.args()).args(["--bin", package]);
    cargo
}

/// Runs cargo and returns the ELF file of the package. It has the same place for all products and features: no other
/// job builds there until it is read.
fn built(board: &Layout, package: &str, cargo: &mut Command) -> Outcome<Vec<u8>> {
    let chip = board.chip.line.name();
    let _alone = files::lock(chip, &format!("Another job builds for the {chip}."))?;
    process::run(cargo)?;
    files::bytes(&target_dir(board).join(TARGET).join(PROFILE).join(package))
}

/// Builds an image under a name, and prints its size. After the link a bootloader gets the CRC of its RAM image.
fn image(board: &Layout, variant: &Variant, name: &str, product: &Product) -> Outcome {
    let mut cargo = cargo_for(variant.package, board, variant.features, product);
    let mut file = built(board, variant.package, &mut cargo)?;
    if variant.is_bootloader() {
        file = ram_image::seal(file).map_err(|problem| format!("{name} gets no CRC: {problem}"))?;
    }
    let to = elf_of(board, name);
    // What the caller's variables made of it is nothing for a run of tests.
    let _ = fs::remove_file(to.with_extension("built"));
    // An unchanged file is not written, so that its time does not change.
    if fs::read(&to).ok().as_ref() != Some(&file) {
        files::write(&to, file)?;
    }
    report(&to, &variant.regions(board))
}

/// Prints the size of an image, and a warning if it is a program for any product.
pub fn report(image: &Path, regions: &[Region]) -> Outcome {
    let file = files::bytes(image)?;
    let segments = elf::segments(&file)?;
    let used = elf::used(&segments, regions);
    let used = used.map_err(|problem| format!("{}: {problem}", workspace::shown(image)))?;
    // It goes to the standard error like cargo's messages: the standard output belongs to the job,
    // which may print JSON.
    let used: Vec<_> =
        used.iter().zip(regions).map(|(bytes, region)| format!("{bytes} of {}", region.size)).collect();
    eprintln!("  {:<52} {} bytes", workspace::shown(image), used.join(" + "));
    if regions
        .iter()
        .any(|region| elf::label(&segments, *region).is_some_and(|label| label.product_code == 0))
    {
        eprintln!(
            "  warning: its label has product code 0, which is any: a device of another product takes it. Set the \
             product code (docs/porting.md, step 5)."
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::{stm32f407g_disc1, stm32f407g_disc1_two};

    use super::*;

    #[test]
    fn a_name_stands_for_one_image_and_an_unknown_one_lists_them() {
        let (one, two) = (&stm32f407g_disc1::LAYOUT, &stm32f407g_disc1_two::LAYOUT);
        for variant in VARIANTS {
            let found = VARIANTS.iter().filter(|other| other.name == variant.name).count();
            assert_eq!(found, 1, "{}", variant.name);
        }
        for name in MAIN {
            assert!(Variant::by_name(one, name).is_ok(), "{name}");
        }
        let refused = Variant::by_name(one, "app-program-2").err().unwrap();
        assert!(
            refused.contains("has no image \"app-program-2\"") && refused.contains(", app-v1,"),
            "{refused}"
        );
        let other = Variant::by_name(one, "bootloader-sealed").ok().unwrap();
        let lift = Product::named("lift").ok().unwrap();
        assert_eq!(other.name_of(&lift).ok().unwrap(), "bootloader-sealed-lift");
        let standard = Variant::by_name(one, "bootloader").ok().unwrap();
        assert_eq!(standard.name_of(&lift).ok().unwrap(), "bootloader-lift");
        let sealed = Product { name: "sealed".to_owned(), ..lift };
        assert!(standard.name_of(&sealed).unwrap_err().contains("another image already"));
        let second = Variant::by_name(two, "app-program-2").ok().unwrap();
        assert_eq!(second.regions(two), [two.programs[1]]);
        assert_eq!(
            Variant::by_name(two, "bootloader-lift").ok().unwrap().regions(two),
            [Some(two.resident()), two.home].map(Option::unwrap)
        );
    }
}
