//! The way to a new board (docs/porting.md): followed to the letter, and left in every way that the
//! build has to notice.
//!
//! Both tests work on a copy of the repository, one after the other.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Mutex, MutexGuard, PoisonError};

const TARGET: &str = "thumbv7em-none-eabihf";

/// A copy of the repository.
struct Copy {
    root: PathBuf,
    /// Cargo's folder for it: cargo tells packages apart by where they are in their workspace, so a
    /// folder shared with another copy would be built anew each time.
    target: PathBuf,
    /// One test at a time.
    _alone: MutexGuard<'static, ()>,
}

impl Copy {
    /// What is there from an earlier run is brought up to date: files that did not change keep
    /// their time, so that cargo builds anew only what it has to.
    fn new() -> Self {
        static ALONE: Mutex<()> = Mutex::new(());
        let alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
        let tmp = Path::new(env!("CARGO_TARGET_TMPDIR")).join("porting");
        let (root, target) = (tmp.join("copy"), tmp.join("target"));
        synchronise(&Path::new(env!("CARGO_MANIFEST_DIR")).join(".."), &root);
        Self { root, target, _alone: alone }
    }

    fn cargo(&self, words: &[&str]) -> Output {
        self.cargo_for(None, words)
    }

    /// The same for a product by name.
    fn cargo_for(&self, product: Option<&str>, words: &[&str]) -> Output {
        // Firmware goes where `cargo xtask build` has it built.
        let firmware = words.contains(&TARGET);
        let target = if firmware { self.target.join("fw") } else { self.target.clone() };
        let mut cargo = Command::new(env!("CARGO"));
        cargo.current_dir(&self.root).args(words).env("CARGO_TARGET_DIR", target);
        if let Some(name) = product {
            cargo.env("COBOOT_PRODUCT", name);
        }
        cargo.output().expect("cargo can be started")
    }

    fn succeed(&self, words: &[&str]) {
        let output = self.cargo(words);
        assert!(output.status.success(), "cargo {}:\n{}", words.join(" "), text(&output));
    }

    /// Puts `new` in the place of `old`, which is there once; gives the file as it was.
    fn edit(&self, file: &str, old: &str, new: &str) -> String {
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

/// Makes `to` what `from` is, but for version control and what was built.
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

/// From `new-board` to an update on the emulated board. The steps are filled in with the numbers of
/// a NUCLEO-F446RE (but for the strap: this board has a button as it stands there at first); those
/// laid down are of a board with another chip.
#[test]
fn a_board_is_made_as_the_guide_says() {
    let copy = Copy::new();
    copy.succeed(&["run", "-q", "-p", "xtask", "--", "new-board", "my-board", "--chip", "stm32f446re"]);

    // Steps 1 to 4: the memory map fits the chip as it is laid down.
    let board = "bsp/src/my_board.rs";
    for (step, old, new) in [
        (5, "product_code: 0x4007_D151", "product_code: 0x1234_5678"),
        (5, "device_name: \"coboot STM32F407G-DISC1\"", "device_name: \"my board\""),
        (8, "hse_bypass: false", "hse_bypass: true"),
        (8, "pll_n: 168", "pll_n: 160"),
        (10, "Pin<'D', 12, Output>", "Pin<'A', 5, Output>"),
        (
            10,
            "let gpiod = take_port!(GPIOD, can1).split(rcc);",
            "let gpioa = take_port!(GPIOA, can1).split(rcc);",
        ),
        (10, "gpiod.pd12.into_push_pull_output();", "gpioa.pa5.into_push_pull_output();"),
        (
            11,
            "        #[cfg(feature = \"uart\")]\n        let gpioa = take_port!(GPIOA, can1).split(rcc);\n",
            "",
        ),
        (
            12,
            "can1.can((gpiod.pd1, gpiod.pd0), rcc)",
            "{\n            let gpiob = take_port!(GPIOB, can1).split(rcc);\n            \
             can1.can((gpiob.pb9, gpiob.pb8), rcc)\n        }",
        ),
    ] {
        println!("step {step}: {new}");
        copy.edit(board, old, new);
    }

    let header = "app-c/boards/my-board.h";
    for (step, old, new) in [
        (12, "CAN_PORT 'D'", "CAN_PORT 'B'"),
        (12, "CAN_RX_PIN 0", "CAN_RX_PIN 8"),
        (12, "CAN_TX_PIN 1", "CAN_TX_PIN 9"),
        (13, "LED_PORT 'D'", "LED_PORT 'A'"),
        (13, "LED_PIN 12", "LED_PIN 5"),
        (14, "HSE_BYPASS 0", "HSE_BYPASS 1"),
        (15, "0x4007D151", "0x12345678"),
    ] {
        println!("step {step}: {new}");
        copy.edit(header, old, new);
    }

    let images = copy.target.join("firmware").join("my-board");
    let app_c = images.join("app-c.elf");
    // Of an earlier run.
    let _ = fs::remove_file(&app_c);
    copy.succeed(&["run", "-q", "-p", "xtask", "--", "build", "--all", "--board", "my-board"]);
    assert!(app_c.exists(), "no application in C");
    // The main job, in the emulator: on a chip and a map that are those of another board.
    let mut demo = Command::new(env!("CARGO_BIN_EXE_demo"));
    demo.env("COBOOT_BOARD", "nucleo-f446re");
    demo.env("COBOOT_FIRMWARE_DIR", &images);
    let output = demo.output().expect("the demo can be started");
    assert!(output.status.success(), "{}", text(&output));
    let told = text(&output);
    assert!(told.contains("my board"), "the device does not say its name:\n{told}");
}

/// One mistake in an otherwise good port, and what the build says.
struct Mistake {
    file: &'static str,
    right: &'static str,
    wrong: &'static str,
    /// What has to be looked at for it to be found.
    by: By,
    says: &'static str,
}

/// What finds a mistake.
#[derive(Clone, Copy)]
enum By {
    /// `cargo check` of the memory maps.
    Layout,
    /// `cargo check` of the board file, on the host.
    Board,
    /// `cargo check` of the board file for the chip.
    Drivers,
    /// `cargo check` of the resident part, the smaller one of the two that the choices of a product
    /// are built into; for the product of this name, if one is named.
    Product(Option<&'static str>),
    /// The linker.
    Image,
}

const LAYOUT: &str = "shared-abi/src/layout/nucleo_f446re.rs";
const BOARD: &str = "bsp/src/nucleo_f446re.rs";

/// A choice that a product makes in place of the default.
const fn product(wrong: &'static str, says: &'static str) -> Mistake {
    let file = "bootloader/src/product.rs";
    Mistake { file, right: "Product { ..Product::DEFAULT }", wrong, by: By::Product(None), says }
}

const MISTAKES: &[Mistake] = &[
    Mistake {
        file: LAYOUT,
        right: "Region::new(0x0801_0000, 448 * 1024)",
        wrong: "Region::new(0x0800_C000, 464 * 1024)",
        by: By::Layout,
        says: "a program overlaps a parameter region",
    },
    Mistake {
        file: LAYOUT,
        right: "448 * 1024",
        wrong: "440 * 1024",
        by: By::Layout,
        says: "a program must start and end at sector borders",
    },
    Mistake {
        file: LAYOUT,
        right: "callgate_offset: 0x40",
        wrong: "callgate_offset: 0x3C",
        by: By::Layout,
        says: "the callgate overlaps the bootloader's vector table",
    },
    Mistake {
        file: LAYOUT,
        right: "0x0801_0000",
        wrong: "0x0801_0080",
        by: By::Layout,
        says: "a program must start and end at sector borders",
    },
    Mistake {
        file: LAYOUT,
        right: "warm_start: Region::new(0x2001_FFF0",
        wrong: "warm_start: Region::new(0x2002_0000",
        by: By::Layout,
        says: "the warm-start cell must be the last RAM cell of the chip",
    },
    Mistake {
        file: LAYOUT,
        right: "128 * 1024 - 64",
        wrong: "192 * 1024 - 64",
        by: By::Layout,
        says: "the RAM of the images lies outside the chip's SRAM",
    },
    Mistake {
        file: "shared-abi/src/geometry.rs",
        right: "SectorRun { count: 3, size: 128 * KIB }",
        wrong: "SectorRun { count: 4, size: 128 * KIB }",
        by: By::Layout,
        says: "the sectors do not add up to the flash",
    },
    Mistake {
        file: BOARD,
        right: "pll_n: 160",
        wrong: "pll_n: 163",
        by: By::Board,
        says: "board: the clock of the CAN controller (APB1) cannot make BIT_RATE",
    },
    Mistake {
        file: BOARD,
        right: "pll_n: 160",
        wrong: "pll_n: 180",
        by: By::Board,
        says: "board: the core is too fast",
    },
    Mistake {
        file: BOARD,
        right: "wait_states: 5",
        wrong: "wait_states: 4",
        by: By::Board,
        says: "board: the flash needs a wait state for every 30 MHz",
    },
    // RM0390, register boundary addresses: ports A to H.
    Mistake {
        file: BOARD,
        right: "('C', 13, false)",
        wrong: "('I', 13, false)",
        by: By::Board,
        says: "board: the chip has no such pin as ENTRY_STRAP names",
    },
    // DS10693 table 11: PB7 has no CAN1.
    Mistake {
        file: BOARD,
        right: "(gpiob.pb9, gpiob.pb8)",
        wrong: "(gpiob.pb7, gpiob.pb8)",
        by: By::Drivers,
        says: "can1::Tx: From<stm32f4xx_hal::gpio::Pin<'B', 7>>",
    },
    // DS10693, alternate functions: PA4 is the clock of USART2.
    Mistake {
        file: BOARD,
        right: "(gpioa.pa2, gpioa.pa3)",
        wrong: "(gpioa.pa4, gpioa.pa3)",
        by: By::Drivers,
        says: "usart2::Tx: From<stm32f4xx_hal::gpio::Pin<'A', 4>>",
    },
    // 40 MHz and 16 cycles a bit at least.
    Mistake {
        file: BOARD,
        right: "UART_BIT_RATE: u32 = 115_200",
        wrong: "UART_BIT_RATE: u32 = 3_000_000",
        by: By::Drivers,
        says: "board: the clock of the UART cannot make UART_BIT_RATE",
    },
    // Choices that contradict each other, or the layout, which has one program.
    product(
        "Product { autostart: Some(2), ..Product::DEFAULT }",
        "product: autostart names a program that the layout has not",
    ),
    product(
        "Product { max_crash_resets: 0, ..Product::DEFAULT }",
        "product: max_crash_resets must be 1 or more",
    ),
    product(
        "Product { autostart: None, ..Product::DEFAULT }",
        "product: a rescue window needs autostart: without it no program starts by itself",
    ),
    product(
        "Product { rescue_window_confirmed_ms: 1000, ..Product::DEFAULT }",
        "product: the rescue window must be shorter than the heartbeat period",
    ),
    product(
        "Product { node_ids: 1..=128, ..Product::DEFAULT }",
        "product: node_ids must be a range within 1 to 127",
    ),
    product("Product { crc_step: 63, ..Product::DEFAULT }", "product: crc_step must be 64 bytes or more"),
    product(
        "Product { block_buffer: 1023, ..Product::DEFAULT }",
        "product: block_buffer must be 1024 bytes or more, and fit the RAM",
    ),
    product(
        "Product { watchdog_ms: Some(4001), ..Product::DEFAULT }",
        "product: watchdog_ms must be 100 to 4000",
    ),
    product(
        "Product { bit_rates: 3..=9, ..Product::DEFAULT }",
        "product: bit_rates must be a range within 0 to 8",
    ),
    product(
        "Product { sdo_request_base: 0x781, ..Product::DEFAULT }",
        "product: sdo_request_base and sdo_response_base must be 80h to 780h",
    ),
    product(
        "Product { sdo_request_base: 0x5FF, ..Product::DEFAULT }",
        "product: sdo_request_base and sdo_response_base must be 80h or more apart",
    ),
    product(
        "Product { sdo_request_base: 0x680, sdo_response_base: 0x701, ..Product::DEFAULT }",
        "product: the COB-IDs of SDO must not be those of boot-up and heartbeat (700h)",
    ),
    product(
        "Product { program_watchdog_ms: Some(0), ..Product::DEFAULT }",
        "product: program_watchdog_ms must be 1 to 4000",
    ),
    product(
        "Product { answer_to_reset_ms: 9, ..Product::DEFAULT }",
        "product: answer_to_reset_ms must be 10 or more",
    ),
    product(
        "Product {
            profile: Profile {
                download: Policy { data: Some(1), ..Policy::DEFAULT },
                ..Profile::STANDARD
            },
            ..Product::DEFAULT
        }",
        "product: autostart names the profile's data, which are no program",
    ),
    product(
        "Product { profile: Profile { password: b\"\", ..Profile::LIFT }, ..Product::DEFAULT }",
        "product: a profile that locks 1F50h needs a password, and only such a profile has one",
    ),
    // This product does not find out the bit rate.
    Mistake {
        file: BOARD,
        right: "BIT_RATE: u32 = 125_000",
        wrong: "BIT_RATE: u32 = 0",
        by: By::Product(Some("least")),
        says: "product: the board leaves the bit rate to be found out (0), and auto_bit_rate is off",
    },
    Mistake {
        file: "bsp/Cargo.toml",
        right: "stm32f4xx-hal/stm32f446",
        wrong: "stm32f4xx-hal/stm32f407",
        by: By::Image,
        says: "the PAC's vector table has not the size that the layout's chip has",
    },
];

#[test]
fn a_mistake_in_a_port_fails_the_build_and_is_named() {
    let copy = Copy::new();
    let board = "--features=board-nucleo-f446re";
    let triple = ["--target", TARGET, "--profile=firmware"];
    let look = |by: By| match by {
        By::Layout => copy.cargo(&["check", "-p", "coboot-abi"]),
        By::Board => copy.cargo(&["check", "-p", "bsp", board]),
        By::Drivers => {
            let features = format!("{board},uart");
            copy.cargo(&[&["check", "-p", "bsp", &features][..], &triple].concat())
        }
        By::Product(name) => {
            let words = ["check", "-p", "bootloader", "--bin=resident", "--no-default-features"];
            let features = format!("{board},resident");
            copy.cargo_for(name, &[&words[..], &[&features], &triple].concat())
        }
        By::Image => {
            let words = ["build", "-p", "bootloader", "--no-default-features", board];
            copy.cargo(&[&words[..], &triple].concat())
        }
    };
    // Without a mistake there is none.
    for by in [By::Layout, By::Board, By::Drivers, By::Product(None), By::Product(Some("least")), By::Image] {
        let output = look(by);
        assert!(output.status.success(), "{}", text(&output));
    }
    for mistake in MISTAKES {
        let before = copy.edit(mistake.file, mistake.right, mistake.wrong);
        let output = look(mistake.by);
        fs::write(copy.root.join(mistake.file), before).expect("the file can be written");
        let said = text(&output);
        assert!(!output.status.success(), "built with {} in {}", mistake.wrong, mistake.file);
        // Types are told with or without their paths, and lines may be broken anywhere.
        let flat = |text: &str| {
            text.replace("stm32f4xx_hal::gpio::", "").split_whitespace().collect::<Vec<_>>().join(" ")
        };
        assert!(flat(&said).contains(&flat(mistake.says)), "{}, not told by:\n{said}", mistake.says);
    }
}
