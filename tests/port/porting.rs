//! The guide to a new board (docs/porting.md): one test follows it exactly, another one makes each
//! mistake that the build must notice.
//!
//! The tests work on a copy of the repository, one after the other.

use std::fs;
use std::net::{TcpListener, TcpStream};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use coboot_tests::bench::Bench;
use coboot_tests::firmware;
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::{Operation, Options};
use kit::folder::Alone;
use object::{Object, ObjectSection};
use shared_abi::layout;

const TARGET: &str = "thumbv7em-none-eabihf";

/// A copy of the repository.
pub struct Copy {
    pub root: PathBuf,
    /// Cargo's folder for the copy. Cargo identifies packages by their place in the workspace, so a
    /// folder that is shared with another copy would be rebuilt each time.
    pub target: PathBuf,
    _alone: Alone,
}

impl Copy {
    /// The copy of an earlier run is updated: unchanged files keep their time, so that cargo
    /// rebuilds only what it must.
    pub fn new() -> Self {
        let tmp = Path::new(env!("CARGO_TARGET_TMPDIR")).join("porting");
        let alone = Alone::at(&tmp.join("lock"));
        let (root, target) = (tmp.join("copy"), tmp.join("target"));
        synchronise(&Path::new(env!("CARGO_MANIFEST_DIR")).join(".."), &root);
        if !target.exists() {
            share("debug", &target.join("debug"));
            for profile in ["release", "thumbv7em-none-eabihf/firmware"] {
                for chip in ["stm32f405", "stm32f407"] {
                    share(&format!("fw/stm32f407/{profile}"), &target.join("fw").join(chip).join(profile));
                }
            }
        }
        Self { root, target, _alone: alone }
    }

    fn cargo(&self, words: &[&str]) -> Output {
        self.cargo_for("stm32f407g-disc1", None, words)
    }

    /// The same for a board, and for a named product.
    fn cargo_for(&self, board: &str, product: Option<&str>, words: &[&str]) -> Output {
        // Firmware goes into the same folder as with `cargo xtask build`.
        let firmware = words.contains(&TARGET);
        let chip = layout::by_name(board).map_or("stm32f405", |layout| layout.chip.line.name());
        let target = if firmware { self.target.join("fw").join(chip) } else { self.target.clone() };
        let mut cargo = Command::new(env!("CARGO"));
        cargo.current_dir(&self.root).args(words).env("CARGO_TARGET_DIR", target).env("COBOOT_BOARD", board);
        // A variable of the shell does not change the product: there is none with this name.
        cargo.env("COBOOT_PRODUCT", "of-the-shell");
        if let Some(name) = product {
            cargo.arg("--config").arg(format!("env.COBOOT_PRODUCT.value=\"{name}\""));
        }
        cargo.output().expect("cargo can be started")
    }

    /// Replaces `old`, which must be there once, by `new`; returns the previous file.
    pub fn edit(&self, file: &str, old: &str, new: &str) -> String {
        let path = self.root.join(file);
        let before = fs::read_to_string(&path).expect(file);
        assert_eq!(before.matches(old).count(), 1, "{file}: {old:?}");
        fs::write(&path, before.replace(old, new)).expect(file);
        before
    }
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// Gives the copy the built crates of other authors: files that cargo replaces as a whole are hard
/// links, files that it changes are copied. If that fails, the copy builds them.
fn share(profile: &str, to: &Path) {
    let from = Path::new(env!("CARGO_TARGET_TMPDIR")).join("..").join(profile);
    fs::create_dir_all(to).expect("the folder can be made");
    for (how, folder) in [("-al", "deps"), ("-a", "build"), ("-a", ".fingerprint")] {
        let _ = Command::new("cp").arg(how).arg(from.join(folder)).arg(to).output();
    }
}

/// Makes `to` equal to `from`, except for version control and build results.
fn synchronise(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("the copy can be made");
    let names = |folder: &Path| -> Vec<_> {
        fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").file_name()).collect()
    };
    let wanted: Vec<_> = names(from)
        .into_iter()
        .filter(|name| name != "target" && name != ".git" && name != "corpus")
        .collect();
    for name in names(to).into_iter().filter(|name| !wanted.contains(name)) {
        let old = to.join(name);
        let removed = if old.is_dir() { fs::remove_dir_all(old) } else { fs::remove_file(old) };
        removed.expect("what is too much can be removed");
    }
    for name in wanted {
        let (from, to) = (from.join(&name), to.join(&name));
        if from.is_dir() {
            synchronise(&from, &to);
        } else {
            let new = fs::read(&from).expect("a file");
            if fs::read(&to).ok().as_ref() != Some(&new) {
                fs::write(&to, new).expect("the copy can be written");
            }
        }
    }
}

/// From `new-board` to an update on the emulated board: the guide's example, an STM32F405RG with
/// CAN1 on PA11 and PA12, a crystal of 25 MHz, its LED on PB0 and a strap on PC13.
#[test]
fn a_board_is_made_as_the_guide_says() {
    let copy = Copy::new();
    let before = files(&copy.root);
    let page = fs::read_to_string(copy.root.join("docs/porting.md")).expect("the guide");
    let command =
        page.lines().find_map(|line| line.strip_prefix("cargo xtask new-board ")).expect("the command");
    let words = [&["new-board"][..], &command.split_whitespace().collect::<Vec<_>>()].concat();
    copy.xtask(&words);
    let new = [
        "examples/c/boards/my-board.h",
        "bsp/src/boards/my_board.rs",
        "shared-abi/src/layout/boards/my_board.rs",
    ];
    let after = files(&copy.root);
    assert!(before.iter().all(|file| after.contains(file)), "a file changed");
    let added: Vec<_> = after.iter().filter(|file| !before.contains(file)).map(|(name, _)| &**name).collect();
    let mut expected = new;
    expected.sort_unstable();
    assert_eq!(added, expected);
    assert_formatted(&copy, &new[1..]);

    // The created files already have the memory map, clocks, pins and LED of the example.
    let board = new[1];
    let text = fs::read_to_string(copy.root.join(board)).expect(board);
    for line in ["hse: 25_000_000,", "pin: 13,", "led: ('B', 0),", "transmit: ('A', 12), receive: ('A', 11)"]
    {
        assert!(text.contains(line), "{line}:\n{text}");
    }
    copy.edit(board, "device_name: \"my-board\"", "device_name: \"a node of my own\"");

    let app_c = copy.target.join("firmware/my-board/app-c.elf");
    // The result of an earlier run.
    let _ = fs::remove_file(&app_c);
    copy.xtask(&["build", "bootloader", "app-v1", "app-v2", "app-c", "--board", "my-board"]);
    assert!(app_c.exists(), "no application in C");
    // The main job, in the emulator.
    let output = copy.xtask(&["demo", "--board", "my-board"]);
    assert!(output.contains("An emulated my-board"), "{output}");
    assert!(output.contains("a node of my own"), "the device does not say its name:\n{output}");
}

/// Three boards with other crystals and CAN controllers than the first: each is built, offered by
/// the emulator to other programs and updated, without an option that `new-board` had.
#[test]
fn boards_with_other_crystals_are_emulated_by_their_names() {
    let copy = Copy::new();
    let boards =
        ["a-12 STM32F405RGT6 12000000 1", "b-16 STM32F405VGT6 16000000 2", "c-25 STM32F405ZGT6 25000000 1"];
    let boards = boards.map(|words| words.split(' ').collect::<Vec<_>>());
    for board in &boards {
        let [name, chip, crystal, can] = board[..] else { panic!("{board:?}") };
        copy.xtask(&["new-board", name, "--chip", chip, "--crystal", crystal, "--can", can]);
    }
    for name in boards.iter().map(|board| board[0]) {
        copy.xtask(&["build", "app-v1", "--board", name]);
        let at =
            TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr()).expect("a port").to_string();
        let words = ["run", "-q", "-p", "xtask", "--", "emulate", "--board", name, "--socketcand", &at];
        let mut emulator = Command::new(env!("CARGO"));
        emulator.current_dir(&copy.root).args(words).env("CARGO_TARGET_DIR", &copy.target).process_group(0);
        let mut emulator = emulator.spawn().expect("cargo can be started");
        while TcpStream::connect(&at).is_err() {
            assert!(emulator.try_wait().expect("its state").is_none(), "{name}: the emulator has ended");
            std::thread::sleep(Duration::from_millis(100));
        }
        let images = copy.target.join("firmware").join(name);
        let mut coflash = coboot_tests::tools::coflash();
        coflash.args(["--bus", &format!("socketcand://{at}/can0"), "flash", "--board"]);
        let updated =
            coflash.arg(images.join(name).with_extension("toml")).arg(images.join("app-v1.elf")).output();
        let ended = Command::new("kill").args(["-INT", "--", &format!("-{}", emulator.id())]).status();
        assert!(ended.expect("kill can be started").success());
        emulator.wait().expect("it ends");
        println!("{name}: {}", coboot_tests::tools::succeeded(&updated.expect("coflash can be started")));
    }
}

/// Cargo's knowledge of what an image is made of is larger than the repository: a crate beside it, and a variable.
#[test]
fn a_build_takes_what_has_changed_outside_of_the_repository() {
    let copy = Copy::new();
    let beside = kit::folder!("beside-the-copy");
    fs::create_dir_all(beside.join("src")).expect("a folder of its own");
    beside.write(
        "Cargo.toml",
        "[package]\nname = \"mine\"\nversion = \"0.1.0\"\nedition = \"2021\"\n[workspace]\n",
    );
    let library = |ms: u16| {
        let text = format!("#![no_std]\n//! Mine.\n/// In ms.\npub const MS: u16 = {ms} + option_env!(\"MORE\").is_some() as u16;\n");
        beside.write("src/lib.rs", text);
    };
    library(500);
    let dependency = format!("[dependencies.mine]\npath = {:?}\n\n[build-dependencies]", &*beside);
    copy.edit("app-template/Cargo.toml", "[build-dependencies]", &dependency);
    copy.edit("app-template/src/objects.rs", "HEARTBEAT_MS: u16 = 500;", "HEARTBEAT_MS: u16 = mine::MS;");
    let build = |variables: &[&str]| {
        let words = ["run", "-q", "-p", "xtask", "--", "build", "app-v1"];
        let built = copy.cargo(&[variables, &words].concat());
        assert!(built.status.success(), "{}", text(&built));
        fs::read(copy.target.join("firmware/stm32f407g-disc1/app-v1.elf")).expect("an image")
    };
    let first = build(&[]);
    library(200);
    let second = build(&[]);
    assert!(second != first, "the crate beside the repository has changed");
    assert!(build(&["--config", "env.MORE='1'"]) != second, "the variable has changed");
}

/// A later RAM image for devices in the field: it is built for the resident part that they have.
#[test]
fn a_bootloader_is_built_for_a_released_resident_part() {
    let copy = Copy::new();
    let resident = |product: &str| {
        let name = if product == "default" { String::new() } else { format!("-{product}") };
        let elf = copy.target.join(format!("firmware/stm32f407g-disc1/bootloader{name}.elf"));
        let elf = fs::read(elf).expect("it was built");
        let file = object::File::parse(&*elf).expect("an ELF file");
        file.section_by_name(".resident").expect("a section").data().expect("its bytes").to_vec()
    };
    copy.xtask(&["build", "bootloader"]);
    let released = resident("default");
    let products = copy.root.join("bootloader/products");
    fs::write(products.join("released.bin"), &released).expect("it can be written");
    // What a fresh one would contain has changed since.
    copy.edit("bootloader/src/resident/stage.rs", "RESET_PERIOD_MS: u32 = 100", "RESET_PERIOD_MS: u32 = 50");
    let product = |choices: &str| {
        let text = format!(
            "use super::*;\n\npub const PRODUCT: Product = Product {{ {choices}, ..Product::DEFAULT }};\n"
        );
        fs::write(products.join("later.rs"), text).expect("it can be written");
        copy.cargo(&["run", "-q", "-p", "xtask", "--", "build", "bootloader", "--product", "later"])
    };
    let include = "resident: Some(include_bytes!(\"released.bin\"))";
    let built = product(include);
    assert!(built.status.success(), "{}", text(&built));
    assert!(resident("later") == released);
    for (choices, says) in [
        ("resident: Some(&[0; 64])", "is no resident part"),
        ("download: Download { crc: CrcKind::Crc16, ..Download::DEFAULT }", "has another download.crc"),
        ("node: Node { bit_rates: 0..=7, ..Node::DEFAULT }", "has other node.bit_rates"),
        ("node: Node { ids: 1..=126, ..Node::DEFAULT }", "has other node.ids"),
        ("autostart: None", "has another autostart"),
        ("sdo: Sdo { request_base: 0x300, ..Sdo::DEFAULT }", "has another sdo.request_base"),
        ("ways_in: WaysIn { rom_loader: true, ..WaysIn::DEFAULT }", "has another ways_in.rom_loader"),
        (
            "identity: Identity { source: IdentitySource::Otp, ..Identity::DEFAULT }",
            "has another identity.source",
        ),
    ] {
        let released = if choices.starts_with("resident") { String::new() } else { format!("{include}, ") };
        let refused = product(&format!("{released}{choices}"));
        let says = format!("product: `resident` {says}");
        assert!(!refused.status.success() && text(&refused).contains(&says), "{says}: {}", text(&refused));
    }
    let built = product("nmt: Nmt { heartbeat_ms: 2000, ..Nmt::DEFAULT }");
    assert!(built.status.success(), "{}", text(&built));
    assert!(resident("later") != released, "a fresh one has changed");
}

/// The loader in the ROM writes any program.
#[test]
fn a_sealed_product_with_the_rom_loader_is_not_built() {
    let copy = Copy::new();
    let text_of =
        "use super::*;\n\npub const PRODUCT: Product =\n    Product { ways_in: WaysIn { rom_loader: true, ..WaysIn::DEFAULT }, ..Product::DEFAULT };\n";
    fs::write(copy.root.join("bootloader/products/open.rs"), text_of).expect("it can be written");
    let refused =
        copy.cargo(&["run", "-q", "-p", "xtask", "--", "build", "bootloader-sealed", "--product", "open"]);
    let says = "product: ways_in.rom_loader would write any program into a device that takes sealed images";
    assert!(!refused.status.success() && text(&refused).contains(says), "{}", text(&refused));
}

/// RM0090 table 13: below 2.7 V the flash is programmed by half-words, below 2.1 V by bytes; it counts what the
/// voltage detector lets pass. Table 11: the wait states, and 160 MHz at most below 2.1 V.
#[test]
fn a_board_with_a_low_supply_programs_no_wider_than_its_flash_takes() {
    const BOARD: &str = "bsp/src/boards/stm32f407g_disc1.rs";
    let copy = Copy::new();
    for (supply_mv, pll_n, wait_states, width) in [(3_100, 168, 5, 4), (2_400, 168, 7, 2), (1_800, 160, 7, 1)]
    {
        let before = copy.edit(BOARD, "supply_mv: 2_900", &format!("supply_mv: {supply_mv}"));
        copy.edit(BOARD, "pll_n: 168", &format!("pll_n: {pll_n}"));
        copy.edit(BOARD, "wait_states: 6", &format!("wait_states: {wait_states}"));
        copy.xtask(&["build", "bootloader", "app-v1"]);
        fs::write(copy.root.join(BOARD), before).expect("the copy can be written");
        let image = |name: &str| {
            copy.target.join("firmware/stm32f407g-disc1").join(name).to_str().expect("a name").to_owned()
        };
        let options = Options { vdd_mv: supply_mv, ..Options::default() };
        let mut bench = Bench::of_image_with(&image(firmware::BOOTLOADER), options).switched_on();
        bench.machine().keep_flash_log();
        let update = FlashOptions::default().trial_run(false);
        let blocks = firmware::blocks(&image(firmware::APP_V1));
        flash(&mut bench.session(), &blocks, &update, &mut |_| {}).expect("an update");
        let log = bench.machine().take_flash_log();
        let mut words = log.iter().filter_map(|operation| match operation {
            Operation::Program { bytes, .. } => Some(bytes.len()),
            _ => None,
        });
        // 18 KiB.
        assert!(words.clone().count() > 18_000 / width, "{supply_mv} mV");
        assert!(words.all(|bytes| bytes == width), "{supply_mv} mV");
        assert_eq!(bench.machine().counters().flash_weak, 0, "{supply_mv} mV");
    }
}

/// A board for each chip in `COBOOT_CHIPS`, from `new-board` to the update on the emulated board.
/// Each one takes minutes: `cargo xtask chips` selects the chips.
#[test]
#[ignore = "cargo xtask chips"]
fn a_board_is_made_for_every_chip() {
    let chips = std::env::var("COBOOT_CHIPS").expect("COBOOT_CHIPS names chips, with commas between them");
    let copy = Copy::new();
    // All boards are made first: so tools that know the boards are built once.
    for chip in chips.split(',') {
        copy.xtask(&["new-board", chip, "--chip", chip]);
        assert_formatted(&copy, &[&format!("bsp/src/boards/{chip}.rs")]);
    }
    for chip in chips.split(',') {
        let started = std::time::Instant::now();
        let output = copy.xtask(&["demo", "--board", chip]);
        assert!(output.contains(&format!("An emulated {chip}")), "{output}");
        println!("{chip}: {} s", started.elapsed().as_secs());
    }
}

impl Copy {
    /// Runs a job of the copy; returns its output.
    pub fn xtask(&self, words: &[&str]) -> String {
        let output = self.cargo(&[&["run", "-q", "-p", "xtask", "--"], words].concat());
        assert!(output.status.success(), "cargo xtask {}:\n{}", words.join(" "), text(&output));
        text(&output)
    }
}

/// Every file below a folder with its contents, sorted by name.
fn files(root: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = Vec::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(root).expect("it lies below").display().to_string();
                found.push((name, fs::read(&path).expect("a file")));
            }
        }
    }
    found.sort();
    found
}

/// Checks that files have the standard formatting.
fn assert_formatted(copy: &Copy, files: &[&str]) {
    let mut rustfmt = Command::new("rustfmt");
    rustfmt.current_dir(&copy.root).args(["--check", "--edition", "2021"]).args(files);
    let output = rustfmt.output().expect("rustfmt can be started");
    assert!(output.status.success(), "{}", text(&output));
}

/// One mistake in an otherwise good port: the file, what is right, what is wrong, the check that finds it, and the
/// message of the build.
type Mistake = (&'static str, &'static str, &'static str, By, &'static str);

/// The checks that find mistakes.
#[derive(Clone, Copy)]
enum By {
    /// `cargo check` of the memory maps.
    Layout,
    /// `cargo check` of the board file, on the host.
    Board,
    /// The same for this board.
    BoardOf(&'static str),
    /// `cargo check` of the board file for the chip.
    Drivers,
    /// `cargo check` of the resident part, the smaller one of the two programs with the choices of
    /// a product; for the product with this name, if there is one.
    Product(Option<&'static str>),
}

const LAYOUT: &str = "shared-abi/src/layout/boards/nucleo_f446re.rs";
const BOARD: &str = "bsp/src/boards/nucleo_f446re.rs";

/// A mistake in the choices of a product.
fn product(&(choices, says): &(&str, &'static str)) -> Mistake {
    let default = if choices.contains("..Product::of") { "" } else { ", ..Product::DEFAULT" };
    // The one of the file becomes another constant.
    let wrong =
        format!("= Product {{ {choices}{default} }};\npub const _OF_FILE: Product = Product {{").leak();
    ("bootloader/products/default.rs", "= Product {", wrong, By::Product(None), says)
}

#[rustfmt::skip]
const MISTAKES: &[Mistake] = &[
    (LAYOUT, "Region::new(0x0801_0000, 448 * 1024)", "Region::new(0x0800_C000, 464 * 1024)", By::Layout, "a program overlaps a parameter region"),
    (LAYOUT, "448 * 1024", "440 * 1024", By::Layout, "a program must start and end at sector borders"),
    (LAYOUT, "callgate_offset: 0x40", "callgate_offset: 0x3C", By::Layout, "the callgate overlaps the bootloader's vector table"),
    (LAYOUT, "0x0801_0000", "0x0801_0080", By::Layout, "a program must start and end at sector borders"),
    (LAYOUT, "warm_start: Region::new(0x2001_FFF0", "warm_start: Region::new(0x2002_0000", By::Layout, "the warm-start cell must be the last RAM cell of the chip"),
    (LAYOUT, "128 * 1024 - 64", "192 * 1024 - 64", By::Layout, "the RAM of the images lies outside the chip's SRAM"),
    ("shared-abi/src/geometry/chip.rs", "bank(3) }, None)", "bank(4) }, None)", By::Layout, "the sectors do not add up to the flash"),
    (BOARD, "pll_n: 160", "pll_n: 163", By::Board, "board: the clock of the CAN controller (APB1) cannot make bit_rate"),
    (BOARD, "pll_n: 160", "pll_n: 180", By::Board, "board: the core is too fast: 168 MHz at most, without over-drive"),
    (BOARD, "apb1: 4", "apb1: 2", By::Board, "board: APB1 is too fast: 42 MHz at most, without over-drive"),
    (BOARD, "apb2: 2", "apb2: 1", By::Board, "board: APB2 is too fast: 84 MHz at most, without over-drive"),
    // The slower class of chips: DS11139 and DS11581, general operating conditions.
    ("bsp/src/boards/an_f412.rs", "pll_n: 96", "pll_n: 104", By::BoardOf("an-f412"), "board: the core is too fast: 100 MHz at most on this chip"),
    ("bsp/src/boards/an_f412.rs", "apb1: 2", "apb1: 1", By::BoardOf("an-f412"), "board: APB1 is too fast: 50 MHz at most on this chip"),
    ("bsp/src/boards/an_f413.rs", "wait_states: 3", "wait_states: 2", By::BoardOf("an-f413"), "board: the flash of this chip needs a wait state for every 25 MHz"),
    (BOARD, "wait_states: 5", "wait_states: 4", By::Board, "board: the flash needs a wait state for every 30 MHz"),
    // DS10693: HSE 4 to 26 MHz with a crystal, 1 to 50 MHz with a clock on OSC_IN.
    (BOARD, "hse: 8_000_000", "hse: 80_000_000", By::Board, "board: a clock on OSC_IN (hse_bypass) has 1 to 50 MHz"),
    (BOARD, "hse: 8_000_000,\n        hse_bypass: true", "hse: 0,\n        hse_bypass: false", By::Board, "board: hse must be a crystal of 4 to 26 MHz"),
    (BOARD, "hse: 8_000_000", "hse: 2_000_000", By::Board, "board: the crystal is divided by 2 to 63 for the PLL (PLLM)"),
    // DS10693: 1.8 to 3.6 V (1.7 V at reduced temperatures); RM0390 table 5: 24 MHz for each wait state below
    // 2.7 V, 22 MHz below 2.4 V. At 2.4 V the voltage detector lets 2.13 V pass.
    (BOARD, "supply_mv: 3_200", "supply_mv: 1_700", By::Board, "board: supply_mv, the lowest supply of the chip, is 1800 to 3600 (mV)"),
    (BOARD, "supply_mv: 3_200", "supply_mv: 5_000", By::Board, "board: supply_mv, the lowest supply of the chip, is 1800 to 3600 (mV)"),
    (BOARD, "supply_mv: 3_200", "supply_mv: 2_900", By::Board, "board: at this supply (supply_mv) the flash needs a wait state for every 24 MHz"),
    (BOARD, "supply_mv: 3_200", "supply_mv: 2_400", By::Board, "board: at this supply (supply_mv) the flash needs a wait state for every 22 MHz"),
    (BOARD, "node_id: 1", "node_id: 200", By::Board, "board: node_id must be 1 to 127, or 255"),
    // RM0390, SWJ debug port pins.
    (BOARD, "port: 'C', pin: 13", "port: 'A', pin: 13", By::Board, "board: entry_strap is a pin of the debugger (PA13 to PA15, PB3, PB4)"),
    (BOARD, "port: 'C', pin: 13", "port: 'B', pin: 8", By::Board, "board: entry_strap is a pin of the CAN controller"),
    (BOARD, "port: 'C', pin: 13", "port: 'A', pin: 5", By::Board, "board: entry_strap is the pin of the LED"),
    (BOARD, "led: ('A', 5)", "led: ('B', 3)", By::Board, "board: led is a pin of the debugger (PA13 to PA15, PB3, PB4)"),
    (BOARD, "led: ('A', 5)", "led: ('B', 9)", By::Board, "board: led is a pin of the CAN controller"),
    // RM0390, register boundary addresses: ports A to H.
    (BOARD, "port: 'C'", "port: 'I'", By::Board, "board: the chip has no such pin as entry_strap names"),
    (BOARD, "Some(Strap { port: 'C', pin: 13, pressed: false, pull: Pull::None })", "Some(Strap { port: 'C', pin: 13, pressed: false, pull: Pull::Down })", By::Board, "board: the chip's resistor pulls entry_strap to `pressed`"),
    // DS10693 table 11: PB7 has no CAN1.
    (BOARD, "transmit: ('B', 9)", "transmit: ('B', 7)", By::Board, "board: `transmit` of can_pins is no transmit pin of this CAN controller"),
    // DS10693 table 10: the package with 64 pins has no PB11.
    (BOARD, "led: ('A', 5)", "led: ('B', 11)", By::Board, "board: the chip has no such pin as led names"),
    (BOARD, "led: ('A', 5)", "led: ('A', 2)", By::Board, "board: led is a pin of the UART"),
    (BOARD, "can_controller!(CAN1)", "can_controller!(CAN2)", By::Board, "board: `transmit` of can_pins is no transmit pin of this CAN controller"),
    // DS10693, alternate functions: PA4 is the clock of USART2.
    (BOARD, "transmit: ('A', 2)", "transmit: ('A', 4)", By::Drivers, "usart2::Tx: From<stm32f4xx_hal::gpio::Pin<'A', 4>>"),
    // 40 MHz and at least 16 cycles a bit.
    (BOARD, "uart_bit_rate: 115_200", "uart_bit_rate: 3_000_000", By::Drivers, "board: the clock of the UART cannot make uart_bit_rate"),
    (BOARD, " node_id: 1", " node_id: 255", By::Product(Some("least")), "product: without lss a new device never gets a node-ID"),
    // The product does not detect the bit rate.
    (BOARD, " bit_rate: 125_000", " bit_rate: 0", By::Product(Some("least")), "product: the board leaves the bit rate to be found out (0), and node.auto_bit_rate is off"),
    ("bsp/Cargo.toml", "stm32f4xx-hal/stm32f446", "stm32f4xx-hal/stm32f407", By::Drivers, "board: the PAC has 082 interrupt lines, the chip 097"),
];

/// Choices of a product that contradict each other, the standards or the layout, which has only one program; and
/// what the build says of it.
const PRODUCTS: &[(&str, &str)] = &[
    ("autostart: Some(Start { programs: Autostart::List(&[2]), ..Start::DEFAULT })", "autostart.programs names a program that the layout has not"),
    ("autostart: Some(Start { programs: Autostart::List(&[]), ..Start::DEFAULT })", "autostart.programs has no program: write `autostart: None`"),
    ("block_download: Some(BlockDownload { second_server: true, ..BlockDownload::DEFAULT })", "node.auto_bit_rate and lss.identify need the split map, the compact one has no room for them: write `false`"),
    ("node: Node { auto_bit_rate: true, ..Node::DEFAULT }", "node.auto_bit_rate and lss.identify need the split map, the compact one has no room for them: write `false`"),
    ("lss: Some(Lss { identify: true, ..Lss::DEFAULT })", "node.auto_bit_rate and lss.identify need the split map, the compact one has no room for them: write `false`"),
    ("lss: Some(Lss::DEFAULT), ..Product::of(Profile::LIFT)", "lss needs the split map in a profile with a password, the compact one has no room for both: write `lss: None`"),
    ("download: Download { crc: CrcKind::Crc16, ..Download::DEFAULT }", "CrcKind::Crc16 needs the split map"),
    ("block_download: Some(BlockDownload::DEFAULT), ..Product::of(Profile::PAULUS)", "block_download needs the split map in the profiles PAULUS and ESACADEMY: write `block_download: None`"),
    ("download: Download { intel_hex: true, ..Download::DEFAULT }", "download.intel_hex needs the split map, or ESAcademy's profile"),
    ("renewal: Some(Renewal::DEFAULT)", "renewal needs a layout with staging, where a new bootloader waits: write `renewal: None`"),
    ("block_download: Some(BlockDownload { segments_per_sub_block: 128, ..BlockDownload::DEFAULT })", "block_download.segments_per_sub_block must be 1 to 127"),
    ("sdo: Sdo { receive_queue: 7, ..Sdo::DEFAULT }", "sdo.receive_queue must be 8 or more"),
    ("autostart: Some(Start { max_crash_resets: 0, ..Start::DEFAULT })", "autostart.max_crash_resets must be 1 or more"),
    ("autostart: Some(Start { programs: Autostart::List(&[0]), ..Start::DEFAULT })", "autostart.programs counts from 1; BLCOP_APP_START_INDEX = 0 is program 1"),
    ("autostart: Some(Start { programs: Autostart::List(&[1, 1]), ..Start::DEFAULT })", "autostart.programs names a program twice"),
    ("autostart: Some(Start { rescue_window_confirmed_ms: 1000, ..Start::DEFAULT })", "the rescue windows of autostart must be shorter than nmt.heartbeat_ms"),
    ("node: Node { ids: 1..=128, ..Node::DEFAULT }", "node.ids must be a range within 1 to 127"),
    ("download: Download { crc_step: 63, ..Download::DEFAULT }", "download.crc_step must be 64 bytes or more"),
    ("download: Download { block_buffer: 1023, ..Download::DEFAULT }", "download.block_buffer must be 1024 bytes or more, and fit the RAM"),
    ("watchdog: Watchdog { bootloader_ms: Some(4001), ..Watchdog::DEFAULT }", "watchdog.bootloader_ms must be 250 to 4000"),
    ("node: Node { bit_rates: 3..=9, ..Node::DEFAULT }", "node.bit_rates must be a range within 0 to 8"),
    ("sdo: Sdo { request_base: 0x781, ..Sdo::DEFAULT }", "sdo.request_base and sdo.response_base must be 80h to 780h"),
    ("sdo: Sdo { request_base: 0x5FF, ..Sdo::DEFAULT }", "sdo.request_base and sdo.response_base must be 80h or more apart"),
    ("sdo: Sdo { request_base: 0x300, response_base: 0x701, ..Sdo::DEFAULT }", "the COB-IDs of SDO must not be those of boot-up and heartbeat (700h)"),
    // CiA 301 table 39 (predefined connection set): EMCY has 081h to 0FFh, SDO of other nodes 581h to 67Fh; CiA
    // 305: LSS has 7E4h and 7E5h. The board has node-ID 1 and 125 kbit/s.
    ("sdo: Sdo { response_base: 0x80, ..Sdo::DEFAULT }", "sdo.response_base plus one of node.ids is a COB-ID of another service"),
    ("sdo: Sdo { request_base: 0x780, ..Sdo::DEFAULT }", "sdo.request_base plus one of node.ids is a COB-ID of another service"),
    ("sdo: Sdo { request_base: 0x501, response_base: 0x300, ..Sdo::DEFAULT }", "sdo.request_base plus one of node.ids is a COB-ID of another service"),
    // CiA 301 table 40 (restricted CAN-IDs): 6E0h to 6FFh. Up to node 95 base 680h is free.
    ("sdo: Sdo { request_base: 0x680, ..Sdo::DEFAULT }, node: Node { ids: 1..=96, ..Node::DEFAULT }", "sdo.request_base plus one of node.ids is a COB-ID of another service"),
    ("sdo: Sdo { request_base: 0x680, ..Sdo::DEFAULT }, node: Node { ids: 1..=95, ..Node::DEFAULT }, download: Download { crc_step: 63, ..Download::DEFAULT }", "download.crc_step must be 64 bytes or more"),
    // The bootloader of a lift is node 126.
    ("node: Node { ids: 1..=10, ..Node::DEFAULT }, sdo: Sdo { request_base: 0x510, response_base: 0x480, ..Sdo::DEFAULT }, ..Product::of(Profile::LIFT)", "sdo.request_base plus one of node.ids is a COB-ID of another service"),
    ("node: Node { ids: 10..=20, ..Node::DEFAULT }", "node.ids is without the node-ID of a new device"),
    ("node: Node { bit_rates: 0..=2, ..Node::DEFAULT }", "node.bit_rates is without the bit rate of a new device"),
    // Its new devices have node-ID 64 at 125 kbit/s.
    ("node: Node { ids: 1..=63, ..Node::DEFAULT }, ..Product::of(Profile::ESACADEMY)", "node.ids is without the node-ID of a new device"),
    ("autostart: Some(Start { max_crash_resets: 256, ..Start::DEFAULT })", "autostart.max_crash_resets must be 255 or less"),
    ("download: Download { crc_step: 65537, ..Download::DEFAULT }", "download.crc_step must be 65536 bytes or less"),
    ("nmt: Nmt { answer_to_reset_ms: 1001, ..Nmt::DEFAULT }", "nmt.answer_to_reset_ms must be 1000 or less"),
    ("watchdog: Watchdog { program_ms: Some(0), ..Watchdog::DEFAULT }", "watchdog.program_ms must be 1 to 4000"),
    ("nmt: Nmt { answer_to_reset_ms: 9, ..Nmt::DEFAULT }", "nmt.answer_to_reset_ms must be 10 or more"),
    ("profile: Profile { download: Policy { data: Some(1), ..Policy::DEFAULT }, ..Profile::STANDARD }, autostart: Some(Start { programs: Autostart::List(&[1]), ..Start::DEFAULT })", "autostart.programs names the profile's data, which are no program"),
    ("profile: Profile { password: b\"\", ..Profile::LIFT }, lss: None", "a profile that locks 1F50h needs a password, and only such a profile has one"),
    // Choices as they were written before there were groups.
    ("lss_store: false", "has no field named `lss_store`"),
];

/// The lines of the guide for a chip whose flash has two banks, and for CAN2: they compile as printed.
#[test]
fn the_lines_for_two_banks_and_for_can2_compile() {
    let copy = Copy::new();
    copy.xtask(&["new-board", "two-banks", "--chip", "STM32F429ZGT6"]);
    let page = fs::read_to_string(copy.root.join("docs/porting.md")).expect("the guide");
    let block = |words: &str| {
        let blocks = page.split("```rust\n").skip(1).filter_map(|block| block.split("```").next());
        blocks.into_iter().find(|block| block.contains(words)).expect(words)
    };
    let map = "shared-abi/src/layout/boards/two_banks.rs";
    let imports = "use crate::geometry::{Region, STM32F429ZG};\nuse crate::layout::Layout;\n";
    copy.edit(map, imports, block("in_two_banks"));
    copy.edit(map, "chip: &STM32F429ZG,", "chip: &CHIP,");
    let checked = copy.cargo(&["check", "-p", "coboot-abi"]);
    assert!(checked.status.success(), "{}", text(&checked));

    let board = "bsp/src/boards/two_banks.rs";
    let (pins, controller) = block("can_controller!").split_once("// …\n").expect("two places");
    copy.edit(board, "    can_pins: Pins { transmit: ('B', 9), receive: ('B', 8) },\n", pins);
    copy.edit(board, "can_controller!(CAN1);\n", controller);
    let words = ["check", "-p", "bsp", "--features=chip-stm32f429", "--target", TARGET, "--profile=firmware"];
    let checked = copy.cargo_for("two-banks", None, &words);
    assert!(checked.status.success(), "{}", text(&checked));
}

#[test]
fn a_mistake_in_a_port_fails_the_build_and_is_named() {
    let copy = Copy::new();
    for (name, chip) in [("an-f412", "STM32F412CEU6"), ("an-f413", "STM32F413RHT6")] {
        copy.xtask(&["new-board", name, "--chip", chip]);
    }
    let refused = copy.cargo(&["run", "-q", "-p", "xtask", "--", "new-board", "x", "--chip", "STM32F411RE"]);
    assert!(!refused.status.success());
    assert!(text(&refused).contains("an STM32F411 has no CAN controller"), "{}", text(&refused));
    let led = "new-board x --chip STM32F407VGT6 --led PB3".split(' ');
    let words: Vec<_> = ["run", "-q", "-p", "xtask", "--"].into_iter().chain(led).collect();
    let refused = text(&copy.cargo(&words));
    assert!(refused.contains("led is a pin of the debugger"), "{refused}");
    assert!(!copy.root.join("bsp/src/boards/x.rs").exists(), "a file was written");
    let board = "nucleo-f446re";
    let triple = ["--target", TARGET, "--profile=firmware"];
    let check = |by: By| match by {
        By::Layout => copy.cargo(&["check", "-p", "coboot-abi"]),
        By::Board => copy.cargo_for(board, None, &["check", "-p", "bsp"]),
        By::BoardOf(board) => copy.cargo_for(board, None, &["check", "-p", "bsp"]),
        By::Drivers => {
            let words = ["check", "-p", "bsp", "--features=chip-stm32f446,uart"];
            copy.cargo_for(board, None, &[&words[..], &triple].concat())
        }
        By::Product(name) => {
            let words = ["check", "-p", "bootloader", "--bin=resident", "--no-default-features"];
            let features = ["--features=bsp/chip-stm32f446,resident"];
            copy.cargo_for(board, name, &[&words[..], &features, &triple].concat())
        }
    };
    // The page's own line, without xtask.
    let page = fs::read_to_string(copy.root.join("docs/porting.md")).expect("the guide");
    let line = page.lines().find(|line| line.starts_with("$ COBOOT_BOARD=nucleo-f446re ")).expect("the line");
    let mut typed = Command::new("sh");
    typed
        .current_dir(&copy.root)
        .args(["-c", &line[2..]])
        .env("CARGO_TARGET_DIR", copy.target.join("fw/stm32f446"));
    coboot_tests::tools::succeeded(&typed.output().expect("sh"));
    // Without a mistake the build succeeds.
    let slower = [By::BoardOf("an-f412"), By::BoardOf("an-f413")];
    let good = [By::Layout, By::Board, By::Drivers, By::Product(None), By::Product(Some("least"))];
    for by in good.into_iter().chain(slower) {
        let output = check(by);
        assert!(output.status.success(), "{}", text(&output));
    }
    for (file, right, wrong, by, says) in PRODUCTS.iter().map(product).chain(MISTAKES.iter().copied()) {
        let before = copy.edit(file, right, wrong);
        let output = check(by);
        fs::write(copy.root.join(file), before).expect("the file can be written");
        let said = text(&output);
        assert!(!output.status.success(), "built with {wrong} in {file}");
        // Types appear with or without their paths, and lines may be broken anywhere.
        let flat = |text: &str| {
            text.replace("stm32f4xx_hal::gpio::", "").split_whitespace().collect::<Vec<_>>().join(" ")
        };
        assert!(flat(&said).contains(&flat(says)), "{says}, not said by:\n{said}");
    }
}
