//! `cargo xtask foreign`: firmware of others, unmodified, in the emulator.

use std::path::{Path, PathBuf};
use std::process::Command;

use shared_abi::layout::DEFAULT;

use crate::args::Args;
use crate::{build, files, process, workspace, Outcome};

pub const HELP: &str = "\
usage: cargo xtask foreign NAME=DIR...

Builds firmware of others from a clone of theirs, each with its own tool chain, runs it unmodified in
the emulator and plays a check with it. Names: klipper, katapult, chibios, openblt, stm32f4xx-hal; and
ELF files that you have built yourself: canopennode=FILE.elf, or any of the names above. With klipper
and katapult, Klipper is also started by Katapult and called back. They need arm-none-eabi-gcc with
newlib, make and python3, or cargo.

A source that is not given is not run, which is no success. docs/foreign.md says what ran when.
";

/// How a firmware is built.
struct Recipe {
    name: &'static str,
    /// For `sh`, in the clone; `$OUT` is the folder for what is built.
    build: &'static str,
    /// The ELF file, in `$OUT` or in the clone.
    elf: &'static str,
}

const fn recipe(name: &'static str, build: &'static str, elf: &'static str) -> Recipe {
    Recipe { name, build, elf }
}

/// Klipper and Katapult are built by one Makefile: $KIND is the rest of the configuration.
const KCONFIG: &str = "mkdir -p $OUT && printf 'CONFIG_%s=y\\n' LOW_LEVEL_OPTIONS MACH_STM32 MACH_STM32F407 \
    STM32_CLOCK_REF_8M STM32_MMENU_CANBUS_PD0_PD1 $KIND >$OUT/config && \
    echo CONFIG_CANBUS_FREQUENCY=500000 >>$OUT/config && \
    make KCONFIG_CONFIG=$OUT/config OUT=$OUT/ olddefconfig && make KCONFIG_CONFIG=$OUT/config OUT=$OUT/";

const RECIPES: [Recipe; 7] = [
    recipe("katapult", "KIND=STM32_APP_START_8000", "katapult.elf"),
    recipe("klipper", "KIND=STM32_FLASH_START_0000", "klipper.elf"),
    recipe("klipper-8000", "KIND=STM32_FLASH_START_8000", "klipper.elf"),
    recipe(
        "chibios",
        "make -C testhal/STM32/STM32F4xx/CAN BUILDDIR=$OUT/build DEPDIR=$OUT/dep",
        "build/ch.elf",
    ),
    // A project of STM32CubeIDE, which has no makefile.
    recipe("canopennode", "", ""),
    recipe(
        "openblt",
        "make -C Target/Demo/ARMCM4_STM32F4_Olimex_STM32P405_GCC/Boot",
        "Target/Demo/ARMCM4_STM32F4_Olimex_STM32P405_GCC/Boot/bin/openblt_olimex_stm32p405.elf",
    ),
    recipe(
        "stm32f4xx-hal",
        "cargo build --release --example can-send --features stm32f407,can --target thumbv7em-none-eabihf \
         --target-dir $OUT",
        "thumbv7em-none-eabihf/release/examples/can-send",
    ),
];

pub fn run(args: Args) -> Outcome {
    let mut sources = Vec::new();
    for source in args.rest() {
        let (name, path) = source.split_once('=').ok_or_else(|| format!("{source:?} is no NAME=DIR."))?;
        if !RECIPES.iter().any(|recipe| recipe.name == name) {
            return Err(format!("{name:?} is none of the names; `cargo xtask foreign --help` has them."));
        }
        sources
            .push((name.to_owned(), std::path::absolute(path).map_err(|error| format!("{path}: {error}"))?));
    }
    if sources.is_empty() {
        return Err("give a source at least: NAME=DIR. Nothing was run.".into());
    }
    let given = |name: &str| sources.iter().find(|(other, _)| other == name).map(|(_, path)| path);
    let mut checks = Vec::new();
    for (name, path) in &sources {
        println!("{name}: {}", commit(path));
        checks.push(format!("{name}={}", elf(name, path)?.display()));
    }
    if let (Some(klipper), Some(katapult)) = (given("klipper"), given("katapult")) {
        if klipper.is_dir() {
            let (first, then) = (elf("katapult", katapult)?, elf("klipper-8000", klipper)?);
            checks.push(format!("klipper-katapult={},{}", first.display(), then.display()));
        }
    }
    for Recipe { name, .. } in RECIPES.iter().filter(|recipe| given(recipe.name).is_none()) {
        if *name != "klipper-8000" {
            println!("{name}: NOT RUN, no source was given");
        }
    }
    process::run(build::tests_program(DEFAULT, "foreign").args(checks))
}

/// Which version of a source it is.
fn commit(path: &Path) -> String {
    let folder = if path.is_dir() { path } else { path.parent().unwrap_or(path) };
    let mut git = Command::new("git");
    git.arg("-C").arg(folder).args(["log", "-1", "--format=commit %h of %as"]);
    process::output(&mut git).map_or_else(|_| "no clone".to_owned(), |text| text.trim().to_owned())
}

/// The ELF file of a firmware, built anew from a clone.
fn elf(name: &str, path: &Path) -> Outcome<PathBuf> {
    if path.is_file() {
        return Ok(path.to_owned());
    }
    let recipe = RECIPES.iter().find(|recipe| recipe.name == name).expect("the names were checked");
    if recipe.build.is_empty() {
        return Err(format!(
            "{name} is no project for make: build it, and give its ELF file: {name}=FILE.elf."
        ));
    }
    let out = workspace::target_dir().join("foreign").join(name);
    files::make(&out)?;
    let script = match recipe.build.strip_prefix("KIND=") {
        Some(kind) => KCONFIG.replace("$KIND", kind),
        None => recipe.build.to_owned(),
    };
    let mut sh = Command::new("sh");
    process::run(sh.args(["-ec", &script]).current_dir(path).env("OUT", &out))?;
    let built = [out.join(recipe.elf), path.join(recipe.elf)].into_iter().find(|file| file.is_file());
    built.ok_or_else(|| format!("{name}: the build has made no {}.", recipe.elf))
}
