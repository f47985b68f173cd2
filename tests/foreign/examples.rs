//! The programs of `examples/`, built by their own tools (`cargo xtask examples`): they start under
//! the bootloader, return to it and are updated. And the messages for authors who make a mistake.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

use coboot_tests::bench::{Bench, NODE};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::tools::{coflash, succeeded, text};
use coboot_tests::{call_back, dead_crystal, firmware};
use coflash_core::update::{flash, FlashOptions};
use coflash_core::Error;
use shared_abi::label::{self, Label};
use shared_abi::layout::{stm32f407g_disc1, stm32f407g_disc1_two, Image};

/// Each program as version 1, and as version 2, which another compiler may have built.
const EXAMPLES: [[&str; 2]; 5] = [
    ["example-c.elf", "example-c-v2.elf"],
    ["example-cpp.elf", "example-cpp-v2.elf"],
    ["example-no-stack.elf", "example-no-stack-v2.elf"],
    ["example-embassy.elf", "example-embassy-v2.elf"],
    ["example-rtic.elf", "example-rtic-v2.elf"],
];

/// Registers for which the emulator reports an access when embassy-stm32 starts: `RCC_DCKCFGR`,
/// which the STM32F407 does not have (RM0090 section 7.3), and `CAN_MCR`, whose bit TTCM is for
/// time stamps that are not used.
const OF_EMBASSY: [u32; 2] = [0x4002_388C, 0x4000_6400];

/// The label of an image, which must be complete and at its place.
fn label_of(image: &str) -> Label {
    let bytes = firmware::raw_from(stm32f407g_disc1::LAYOUT.programs[0].base, image);
    let place = label::OFFSET as usize;
    Label::parse(bytes[place..place + label::SIZE].try_into().unwrap()).expect("a label")
}

/// The main job with each program: it is installed, verified, started, called back, updated, and
/// runs again after a power-off.
#[test]
fn each_is_installed_and_updates_itself_over_socketcand() {
    EXAMPLES.into_iter().for_each(install_and_update);
}

/// A new project of the template is updated to the example that the template is.
#[test]
#[ignore = "needs the image that `cargo xtask examples template` builds"]
fn a_project_of_the_template_is_installed_and_updates_itself() {
    install_and_update(["example-template.elf", "example-no-stack-v2.elf"]);
}

/// flip-link puts the variables at the end of the RAM, and the stack below them (its README).
#[test]
fn a_program_of_flip_link_is_installed_and_updates_itself() {
    let stack = firmware::raw("example-flip-link.elf").first_chunk().map(|word| u32::from_le_bytes(*word));
    assert!(stack < Some(firmware::board().ram.end()), "{stack:x?}");
    install_and_update(["example-flip-link.elf", "example-no-stack-v2.elf"]);
}

fn install_and_update(versions: [&str; 2]) {
    let mut endpoint = Endpoint::new(Bench::new().switched_on());
    let url = endpoint.url();
    let mut crcs = Vec::new();
    for (version, name) in (1..).zip(versions) {
        assert_eq!(label_of(name), Label::new(0, 0x4007_D151, version), "{name}");
        let board = ["--verify", "--board", stm32f407g_disc1::LAYOUT.board];
        let mut command = coflash();
        command.args(["--bus", &url, "flash"]).arg(firmware::dir().join(name)).args(board);
        // The second time the running program gets the command to return to the bootloader.
        println!("{name}: {}", endpoint.succeed(&mut command));
        let said = endpoint.succeed(coflash().args(["--bus", &url, "info"]));
        assert!(said.contains("an application"), "{name}: {said}");
        assert_eq!(endpoint.bench.number(0x1F51, 1), 1, "{name} runs");
        crcs.push(endpoint.bench.number(0x1F56, 1));
        endpoint.bench.assert_takes_every_dlc();
    }
    assert_ne!(crcs[0], crcs[1], "another program");
    let bench = &mut endpoint.bench;
    bench.power_cycle();
    bench.await_program(1000);
    assert!(!bench.is_bootloader(NODE), "it starts by itself");
    assert_eq!(bench.number(0x1F56, 1), crcs[1]);
    bench.call_back();
    assert!(bench.is_bootloader(NODE));
    assert_eq!(bench.number(0x1F56, 1), crcs[1], "the bootloader says the same");
    let known: &[u32] = if versions[0] == "example-embassy.elf" { &OF_EMBASSY } else { &[] };
    let reports = bench.world.machine_mut(bench.device).reports();
    let others: Vec<_> = reports.iter().filter(|report| !known.contains(&report.address)).collect();
    assert!(others.is_empty(), "{}: {others:#?}", versions[0]);
}

/// When they reset, the answer to 80h is complete on the bus, and 10 ms more have passed.
#[test]
fn each_can_be_called_back_at_every_bit_rate() {
    EXAMPLES.concat().into_iter().for_each(|name| call_back::at_every_bit_rate(name, |_, _| {}));
}

/// The one on Embassy waits for its crystal without a bound, in the start of embassy-stm32.
#[test]
fn each_leaves_for_the_bootloader_when_its_crystal_fails() {
    let without_embassy = EXAMPLES.into_iter().filter(|[name, _]| *name != "example-embassy.elf");
    without_embassy.for_each(|[name, _]| dead_crystal::brings_the_bootloader(&firmware::blocks(name)));
}

/// A copy of the example in C, to build it with a mistake.
struct Project(kit::folder::Folder);

impl Project {
    fn new(name: &str) -> Self {
        let root = kit::folder!(name);
        let house = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        copy(&house.join("examples/c"), &root);
        Self(root)
    }

    /// Replaces `old`, which must be there once, by `new`.
    fn edit(self, file: &str, old: &str, new: &str) -> Self {
        let path = self.0.join(file);
        let before = fs::read_to_string(&path).expect(file);
        assert_eq!(before.matches(old).count(), 1, "{file}: {old:?}");
        fs::write(&path, before.replace(old, new)).expect(file);
        self
    }

    /// Builds the project, which succeeds.
    fn built(&self) -> PathBuf {
        self.build(&[]).unwrap_or_else(|refused| panic!("{refused}"))
    }

    /// Builds the project with options of CMake.
    ///
    /// # Errors
    /// The tools' messages if they refuse it.
    fn build(&self, options: &[&str]) -> Result<PathBuf, String> {
        let build = self.0.join("build");
        let toolchain = self.0.join("cmake/arm-none-eabi-gcc.cmake");
        let mut configure = Command::new("cmake");
        configure.arg("-S").arg(&*self.0).arg("-B").arg(&build).args(options);
        configure.arg(format!("-DCMAKE_TOOLCHAIN_FILE={}", toolchain.display()));
        for command in [&mut configure, Command::new("cmake").arg("--build").arg(&build)] {
            let output = command.output().expect("`cargo xtask setup` installs cmake");
            if !output.status.success() {
                return Err(text(&output));
            }
        }
        Ok(build.join("app.elf"))
    }
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a folder below target");
    for entry in fs::read_dir(from).expect("a folder") {
        let entry = entry.expect("an entry");
        let (from, to) = (entry.path(), to.join(entry.file_name()));
        if from.is_dir() {
            copy(&from, &to);
        } else {
            fs::copy(from, to).expect("a file below target");
        }
    }
}

/// The output of `coflash` about a file, without a bus, and whether it accepts the file.
fn judged(words: &[&str], file: &Path) -> (bool, String) {
    let board = ["--board", stm32f407g_disc1::LAYOUT.board];
    let output = coflash().args(words).arg(file).args(board).output().expect("coflash starts");
    (output.status.success(), text(&output))
}

/// `flash` without a bus: it refuses these files before it looks for a bus.
const FLASH: [&str; 3] = ["--bus", "socketcand://127.0.0.1:1/can0", "flash"];

/// The label is after the vectors of the chip. More vectors would overlap it, fewer would leave
/// interrupts without a handler.
#[test]
fn another_number_of_vectors_than_the_chips_does_not_link() {
    let project = Project::new("vectors");
    for lines in [81, 83, 112] {
        let refused = project.build(&[&format!("-DINTERRUPT_LINES={lines}")]).expect_err("it links");
        assert!(
            refused.contains("ERROR(coboot): the vector table is not as long as the chip's"),
            "{lines}: {refused}"
        );
    }
    project.build(&["-DINTERRUPT_LINES=82"]).unwrap_or_else(|refused| panic!("{refused}"));
}

/// A label is optional: the device accepts the program, but coflash cannot determine its target.
#[test]
fn a_program_without_a_label_is_taken_and_says_nothing_of_itself() {
    let project =
        Project::new("label").edit("main.c", "COBOOT_LABEL(VENDOR_ID, PRODUCT_CODE, VERSION);\n", "");
    let elf = project.built();
    let (good, output) = judged(&["inspect"], &elf);
    assert!(good && output.contains("can be a program") && !output.contains("  label "), "{output}");
    let blocks = firmware::blocks_of_file(&elf);
    let mut bench = Bench::new().switched_on();
    let options = FlashOptions::default().trial_run(false);
    flash(&mut bench.session(), &blocks, &options, &mut |_| {}).unwrap();
    assert!(!bench.is_bootloader(NODE));

    // A second label is an error.
    let again = "COBOOT_LABEL(VENDOR_ID, PRODUCT_CODE, VERSION);\n";
    let project = Project::new("label").edit(
        "board.c",
        "#include \"registers.h\"\n",
        &format!("#include \"registers.h\"\n#include \"coboot/coboot.h\"\n#define VERSION 1\n{again}"),
    );
    let refused = project.build(&[]).expect_err("it links");
    assert!(refused.contains("multiple definition of `coboot_label_of_image'"), "{refused}");
}

/// The program is linked for the start of the flash, as in every new project, or for the place of
/// another program.
#[test]
fn a_program_for_another_address_is_refused_by_linker_and_coflash() {
    let layout = "layout.x";
    let at_the_beginning = |name: &str| {
        Project::new(name).edit(layout, "0x08020000, LENGTH = 0xc0000", "0x08000000, LENGTH = 0x100000")
    };
    let refused = at_the_beginning("address").build(&[]).expect_err("it links");
    assert!(refused.contains("ERROR(coboot): the program lies over the bootloader's callgate"), "{refused}");

    // With a linker script without the parts for coboot.
    let project = at_the_beginning("address").edit("app.x", "  INCLUDE coboot.x\n", "");
    let elf = project.built();
    for words in [&["convert"][..], &FLASH] {
        let (good, output) = judged(words, &elf);
        assert!(
            !good
                && output.contains("lies outside 0x08020000..=0x080fffff: link the program for this region")
                && output.contains("0x60000015"),
            "{output}"
        );
    }

    let map = stm32f407g_disc1_two::LAYOUT.linker_script(Image::Program(2)).to_string();
    let project = Project::new("address");
    fs::write(project.0.join(layout), map).unwrap();
    let elf = project.built();
    let (good, output) = judged(&FLASH, &elf);
    assert!(!good && output.contains("0x60000021"), "{output}");
    assert!(output.contains("is linked for 08080000h, and the program begins at 08020000h"), "{output}");
}

/// The stack begins at the end of the chip's RAM, as CubeMX lets it.
#[test]
fn a_stack_over_the_handoff_is_refused_by_linker_and_coflash() {
    let top = || {
        let names = ("_stack_start = ORIGIN(RAM) + LENGTH(RAM);", "_stack_start = 0x20020000;");
        Project::new("stack").edit("app.x", names.0, names.1)
    };
    let refused = top().build(&[]).expect_err("it links");
    let words = "ERROR(coboot): the stack (_stack_start) begins over the handoff";
    assert!(refused.contains(words), "{refused}");

    // Its folder is there as long as the project is.
    let project = top().edit("app.x", "  INCLUDE coboot.x\n", "");
    let elf = project.built();
    for words in [&["convert"][..], &FLASH] {
        let (good, output) = judged(words, &elf);
        let both = "its stack begins at 20020000h, over the handoff (2001FFC0h)";
        assert!(!good && output.contains(both) && output.contains("0x60000021"), "{output}");
    }
}

#[test]
fn the_linker_says_that_layout_x_is_missing() {
    let memory = "MEMORY\n{\n  FLASH : ORIGIN = 0x08000000, LENGTH = 1M\n  RAM : ORIGIN = 0x20000000, LENGTH = 128K\n}\n";
    let project = Project::new("layout").edit("app.x", "INCLUDE layout.x\n", memory);
    let refused = project.build(&[]).expect_err("it links");
    assert!(refused.contains("ERROR(coboot): layout.x is missing"), "{refused}");
}

/// `VTOR` is left at the bootloader's vectors, as by the start-up of a project for the whole flash:
/// the first interrupt ends the program.
#[test]
fn a_program_that_sets_vtor_wrong_ends_in_the_bootloader() {
    let project = Project::new("vtor").edit(
        "startup.c",
        "SCB_VTOR = (uint32_t)(uintptr_t)vectors;",
        "SCB_VTOR = 0x08000000;",
    );
    let elf = project.built();
    let blocks = firmware::blocks_of_file(&elf);
    let mut bench = Bench::new().switched_on();
    let refused = flash(&mut bench.session(), &blocks, &FlashOptions::default(), &mut |_| {}).unwrap_err();
    let output = refused.to_string();
    assert!(output.contains("the trial failed") && output.contains("it does not start"), "{output}");
    // START starts it, and it ends by itself; then the bootloader stays.
    let resets = bench.events().len();
    assert_eq!(resets, 2);
    bench.run_ms(3000);
    assert_eq!(bench.events(), []);
    assert!(bench.is_bootloader(NODE));

    // Without a trial it is started again until it has crashed too often.
    let options = FlashOptions::default().trial_run(false);
    let refused = flash(&mut bench.session(), &blocks, &options, &mut |_| {}).unwrap_err();
    assert!(matches!(refused, Error::StartFailed { .. }), "{refused}");
    bench.run_ms(3000);
    assert!(bench.is_bootloader(NODE), "it has kept the device");
    assert_eq!(bench.number(0x1F56, 1), blocks.crc(), "it is still there");
}

/// Each example in Rust can take the memory map of a board of one's own, as its page says: its
/// manifest has what the build script needs for that.
#[test]
fn each_example_in_rust_takes_a_memory_map_from_a_file() {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples");
    let examples = examples.canonicalize().expect("the examples");
    for example in ["embassy", "no-stack", "rtic"] {
        let manifest = fs::read_to_string(examples.join(example).join("Cargo.toml")).expect("a manifest");
        let line = manifest.lines().find(|line| line.starts_with("coboot-linker =")).expect("the helper");
        let line = line.replace("../..", &format!("{}/..", examples.display()));
        let project = kit::folder!("of-file");
        let package =
            "[workspace]\n[package]\nname = \"of-file\"\nedition = \"2021\"\n[[bin]]\nname = \"of-file\"\n\
                       path = \"main.rs\"\n[build-dependencies]\n";
        project.write("Cargo.toml", format!("{package}{line}\n"));
        project.write("main.rs", "fn main() {}\n");
        project.write(
            "build.rs",
            "fn main() {\n    coboot_linker::Application::of_file(\"board.toml\").emit();\n}\n",
        );
        fs::copy(examples.join("no-stack/board.toml"), project.join("board.toml")).expect("a map");
        fs::copy(examples.join(example).join("Cargo.lock"), project.join("Cargo.lock")).expect("versions");
        let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let target = Path::new(env!("CARGO_TARGET_TMPDIR")).join("of-file-target");
        let mut check = Command::new(cargo);
        check.args(["check", "--quiet"]).current_dir(&*project).env("CARGO_TARGET_DIR", target);
        println!("{example}: {}", succeeded(&check.output().expect("cargo starts")));
    }
}

/// The first block of a page in this language.
fn block<'p>(page: &'p str, language: &str) -> &'p str {
    let (_, behind) = page.split_once(&format!("```{language}\n")).expect("a block");
    behind.split_once("```").expect("its end").0
}

/// The page for projects of CubeIDE: the sample links with the script on the page, and its code
/// compiles with the parts of the HAL that it uses.
#[test]
fn the_blocks_of_the_page_for_cube_link_and_compile() {
    let house = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let page = fs::read_to_string(house.join("docs/cube.md")).expect("the page");
    let project = Project::new("cube")
        .edit("startup.c", "section(\".vector_table\")", "section(\".isr_vector\")")
        .edit("startup.c", "    [1] = reset,", "    [1] = Reset_Handler,")
        .edit("startup.c", "void reset(void);", "void Reset_Handler(void);")
        .edit("startup.c", "void reset(void)\n{", "void Reset_Handler(void)\n{")
        .edit("startup.c", "extern uint32_t _stack_start,", "extern uint32_t _estack,")
        .edit("startup.c", "&_stack_start", "&_estack");
    let script = project.0.join("app.x");
    let before = fs::read_to_string(&script).unwrap();
    let (_, as_it_was) = before.split_once("  INCLUDE coboot.x\n").expect("the sample's script");
    fs::write(&script, format!("{}{as_it_was}", block(&page, "ld"))).unwrap();
    let elf = project.built();
    // Its folder lasts as long as it does.
    let sample = Project::new("cube-sample");
    let sample_elf = sample.built();
    assert_eq!(firmware::blocks_of_file(&elf), firmware::blocks_of_file(&sample_elf), "the same program");

    let hal = "#include <stdint.h>\ntypedef struct { int state; } CAN_HandleTypeDef;\n\
               uint32_t HAL_CAN_GetTxMailboxesFreeLevel(const CAN_HandleTypeDef *can);\nuint32_t HAL_GetTick(void);\n\
               void NVIC_SystemReset(void);\nvoid HardFault_Handler(void);\nvoid Error_Handler(void);\n\
               void coboot_init(void);\nvoid coboot_poll(void);\n";
    let folder = project.0.join("hal");
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("main.h"), hal).unwrap();
    fs::write(folder.join("main.c"), block(&page, "c")).unwrap();
    let mut gcc = Command::new("arm-none-eabi-gcc");
    gcc.args(["-mcpu=cortex-m4", "-mthumb", "-std=gnu11", "-ffreestanding", "-Wall", "-Wextra", "-Werror"]);
    gcc.arg("-I").arg(house.join("examples/c")).arg("-c").arg(folder.join("main.c"));
    println!("{}", succeeded(&gcc.arg("-o").arg(folder.join("main.o")).output().expect("it can be started")));
}
