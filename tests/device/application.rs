//! The application of docs/application.md (`examples/no-stack`): it is built as a separate package,
//! like an application of another author, and runs under the real bootloader. Other tests show the
//! effects of mistakes in an application.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use canopen::program::ProgramControl;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::label::label_of;
use coflash_core::file::read::{read, Firmware};
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use kit::folder::Alone;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;
use shared_abi::layout::toml::Toml;

/// The folder of the example; the job for the examples has built it there.
fn example() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/no-stack")
}

/// The ELF file of the example. `None` if the tests run for another board.
fn built() -> Option<Vec<u8>> {
    let alone = alone();
    build(&example(), "no-stack", &alone)
}

/// The ELF file of a copy of the example in which `old` is replaced by `new` in the program or in
/// its build script: a change by its author.
fn altered(name: &str, old: &str, new: &str) -> Option<Vec<u8>> {
    let alone = alone();
    let copy = Path::new(env!("CARGO_TARGET_TMPDIR")).join("application").join(name);
    fs::create_dir_all(copy.join("src")).expect("the folder can be made");
    let mut found = 0;
    for file in ["Cargo.toml", "Cargo.lock", "build.rs", "board.toml", "src/identity.rs", "src/main.rs"] {
        let text = fs::read_to_string(example().join(file)).expect(file);
        let text = match file {
            // Of another name: cargo takes packages of one name in a folder for the same one.
            "Cargo.toml" | "Cargo.lock" => text
                .replace("\"no-stack\"", &format!("{name:?}"))
                .replace("../../", &format!("{}/../", env!("CARGO_MANIFEST_DIR"))),
            "src/main.rs" | "build.rs" => {
                found += text.matches(old).count();
                text.replace(old, new)
            }
            _ => text,
        };
        fs::write(copy.join(file), text).expect("the copy can be written");
    }
    assert_eq!(found, 1, "{old:?} is to be altered");
    build(&copy, name, &alone)
}

/// One build at a time: they share the folder of `cargo xtask examples`.
fn alone() -> Alone {
    Alone::at(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("application.lock"))
}

fn build(folder: &Path, program: &str, _: &Alone) -> Option<Vec<u8>> {
    if firmware::board().board != LAYOUT.board {
        println!("not run: the example is for {}", LAYOUT.board);
        return None;
    }
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).join("../examples/rust");
    let status = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
        .current_dir(folder)
        .args(["build", "--quiet", "--locked", "--release", "--target", "thumbv7em-none-eabihf"])
        .arg("--target-dir")
        .arg(&target)
        .status()
        .expect("cargo can be started");
    assert!(status.success(), "{} does not build", folder.display());
    Some(fs::read(target.join("thumbv7em-none-eabihf/release").join(program)).expect("it was built"))
}

fn blocks(elf: &[u8]) -> Program {
    let options = Options::default().region(Region::Strict(LAYOUT.programs[0].into()));
    program_of(read(elf, None, None).expect("an ELF"), &options)
        .expect("it lies in the program's flash")
        .program
}

fn power_cycle(bench: &mut Bench) {
    bench.power_cycle();
    bench.run_ms(500);
}

/// `.keeping_ram()` ends the RAM a KiB before its end, where the stack begins.
#[test]
fn its_build_script_may_keep_the_end_of_the_ram() {
    let Some(plain) = built() else { return };
    let keeping = altered("keeping-ram", ".emit()", ".keeping_ram().emit()").unwrap();
    let stack = |elf: &[u8]| u32::from_le_bytes(blocks(elf).flash_image()[..4].try_into().unwrap());
    assert_eq!((stack(&plain), stack(&keeping)), (0x2001_FFC0, 0x2001_FBC0));
}

/// Step 1: the memory map in the repository equals the printed one.
#[test]
fn its_memory_map_is_the_boards() {
    let printed = Toml(&LAYOUT).to_string();
    assert_eq!(
        fs::read_to_string(example().join("board.toml")).unwrap(),
        printed,
        "cargo xtask layout --toml --board stm32f407g-disc1 > examples/no-stack/board.toml"
    );
}

/// Steps 2 to 6, and "All of it": the second update starts in the running program.
#[test]
fn it_is_updated_twice_and_answers_what_a_host_asks() {
    let Some(elf) = built() else { return };
    let blocks = blocks(&elf);
    let mut bench = Bench::new().switched_on();
    for _ in 0..2 {
        flash(&mut bench.session(), &blocks, &FlashOptions::default().force(true), &mut |_| {}).unwrap();
        assert!(!bench.is_bootloader(NODE));
        assert_eq!(bench.number(0x1F51, 1), 1);
        assert_eq!(bench.number(0x1F56, 1), blocks.crc());
        assert_eq!(bench.number(0x1F57, 1), 0);
        assert_eq!(bench.number(0x1018, 2), bsp::IDENTITY.product_code);
        // The label's version is 1.
        assert_eq!(bench.number(0x2005, 1), 1);
        assert_eq!([0x1008, 0x100A].map(|index| bench.text(index)), [bsp::IDENTITY.device_name, "V1.0r0"]);
    }
    // Step 5: resets by the NMT master are no crashes: five of them exceed the limit of three.
    for _ in 0..5 {
        bench.post(0, &[0x81, NODE]);
        bench.await_program(1000);
        bench.run_ms(20);
    }
    assert!(!bench.is_bootloader(NODE));
    // Step 3: the bootloader answers STOP for the program.
    bench.session().command(1, ProgramControl::Stop).unwrap();
    assert!(bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();
}

/// Step 7: after a power-off the bootloader runs without a confirmation, and the program with one.
#[test]
fn a_trial_confirms_itself_when_its_master_has_started_it() {
    let Some(elf) = built() else { return };
    let mut bench = Bench::new().switched_on();
    flash(&mut bench.session(), blocks(&elf), &FlashOptions::default().start(false), &mut |_| {}).unwrap();
    for confirms in [false, true] {
        bench.session().command(1, ProgramControl::Start).unwrap();
        bench.await_program(1000);
        bench.run_ms(20);
        if confirms {
            bench.post(0, &[1, NODE]);
            bench.run_ms(600);
        }
        power_cycle(&mut bench);
        assert_eq!(bench.is_bootloader(NODE), !confirms, "confirmed: {confirms}");
    }
}

const LABEL: &str = "coboot_app::label!(vendor_id: VENDOR_ID, product_code: PRODUCT_CODE, version: VERSION);";
/// The first statement of the program.
const FIRST: &str = "    if !start_crystal(";
/// It sets VTOR to the vectors of the bootloader, like the start-up code for a program at the start
/// of the flash.
const WRONG_VTOR: &str = "    unsafe { (*SCB::PTR).vtor.write(0x0800_0000) };\n    if !start_crystal(";

/// The device accepts the program, because it does not name its target.
#[test]
fn a_program_without_a_label_is_taken_by_every_device() {
    let Some(elf) = built() else { return };
    let labelled = |elf: &[u8]| match read(elf, None, None).expect("an ELF") {
        Firmware::Image(image) => label_of(&image, LAYOUT.programs[0].base),
        Firmware::Blocks(_) => panic!("an ELF is no block file"),
    };
    let label = labelled(&elf).expect("label! puts one there");
    assert_eq!((label.vendor_id, label.product_code, label.version), (0, bsp::IDENTITY.product_code, 1));
    let Some(without) = altered("without-label", LABEL, "") else { return };
    assert_eq!(labelled(&without), None);
    let mut bench = Bench::new().switched_on();
    flash(&mut bench.session(), blocks(&without), &FlashOptions::default(), &mut |_| {}).unwrap();
    assert!(!bench.is_bootloader(NODE));
}

/// Its first interrupt enters the bootloader's vectors. It never answers, is not released, and a
/// good program replaces it.
#[test]
fn a_program_with_vtor_at_the_bootloader_is_told_to_be_silent_and_is_replaced() {
    let (Some(good), Some(wrong)) = (built(), altered("wrong-vtor", FIRST, WRONG_VTOR)) else { return };
    let mut bench = Bench::new().switched_on();
    let error =
        flash(&mut bench.session(), blocks(&wrong), &FlashOptions::default(), &mut |_| {}).unwrap_err();
    assert!(error.to_string().contains("the program is not released for autostart"), "{error}");
    bench.run_ms(3000);
    power_cycle(&mut bench);
    assert!(bench.is_bootloader(NODE), "it was not released: {error}");
    flash(&mut bench.session(), blocks(&good), &FlashOptions::default(), &mut |_| {}).unwrap();
    assert!(!bench.is_bootloader(NODE));
}
