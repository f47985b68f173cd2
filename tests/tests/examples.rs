//! The programs of `examples/`, as their own tools built them (`cargo xtask examples`): they come up
//! under the bootloader, go back into it and are updated. And what is said to those who build one of
//! them with a mistake.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::{env, fs};

use canopen::program::ProgramControl;
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::endpoint::Endpoint;
use coboot_tests::{call_back, firmware};
use shared_abi::label::{self, Label};
use shared_abi::layout::stm32f407g_disc1;

const CRC: Address = Address::new(0x1F56, 1);

/// Each as version 1, and as version 2, which another compiler may have made.
const EXAMPLES: [[&str; 2]; 2] =
    [["example-c-cmake.elf", "example-c-cmake-v2.elf"], ["example-cpp.elf", "example-cpp-v2.elf"]];

/// Whether the tests are about the board that the examples are for.
fn is_board_of_examples() -> bool {
    firmware::board() == &stm32f407g_disc1::LAYOUT
}

/// A board with nothing but the bootloader.
fn empty_board() -> Bench {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    bench
}

fn coflash() -> Command {
    let coflash = env::var_os("COBOOT_COFLASH")
        .unwrap_or_else(|| panic!("COBOOT_COFLASH is not set: run the tests by `cargo xtask test`"));
    Command::new(coflash)
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// The label of an image: at its place, and whole.
fn label_of(image: &str) -> Label {
    let bytes = firmware::raw_from(stm32f407g_disc1::LAYOUT.programs[0].base, image);
    let place = label::OFFSET as usize;
    Label::parse(bytes[place..place + label::SIZE].try_into().unwrap()).expect("a label")
}

/// The main job with each: installed, verified, started, called back, updated, and there again after
/// a power-off.
#[test]
fn each_is_installed_and_updates_itself_over_socketcand() {
    if !is_board_of_examples() {
        return;
    }
    for versions in EXAMPLES {
        let mut endpoint = Endpoint::new(empty_board());
        let url = endpoint.url();
        let mut crcs = Vec::new();
        for (version, name) in (1..).zip(versions) {
            assert_eq!(label_of(name), Label::new(0, 0x4007_D151, version), "{name}");
            let board = ["--verify", "--board", stm32f407g_disc1::LAYOUT.board];
            let mut command = coflash();
            command.args(["--bus", &url, "flash"]).arg(firmware::dir().join(name)).args(board);
            // The second time the program that runs is told to go back.
            let output = endpoint.run(&mut command);
            assert!(output.status.success(), "{name}: {}", text(&output));
            let output = endpoint.run(coflash().args(["--bus", &url, "info"]));
            assert!(output.status.success(), "{name}: {}", text(&output));
            assert!(text(&output).contains("an application"), "{name}: {}", text(&output));
            let mut session = endpoint.bench.session();
            assert_eq!(session.read_number(Address::new(0x1F51, 1)).unwrap(), 1, "{name} runs");
            crcs.push(session.read_number(CRC).unwrap());
        }
        assert_ne!(crcs[0], crcs[1], "another program");
        let bench = &mut endpoint.bench;
        bench.power_off();
        bench.run_ms(500);
        bench.power_on();
        bench.await_program(1000);
        assert!(!bench.is_bootloader(NODE), "it starts by itself");
        assert_eq!(bench.session().read_number(CRC).unwrap(), crcs[1]);
        bench.session().command(1, ProgramControl::StartBootloader).unwrap();
        bench.await_boot_up(1000);
        assert!(bench.is_bootloader(NODE));
        assert_eq!(bench.session().read_number(CRC).unwrap(), crcs[1], "the bootloader says the same");
        bench.assert_nothing_unmodelled();
    }
}

/// The answer to 80h is whole on the bus, and 10 ms more have passed, when they leave.
#[test]
fn each_can_be_called_back_at_every_bit_rate() {
    if is_board_of_examples() {
        EXAMPLES.concat().into_iter().for_each(|name| call_back::at_every_bit_rate(name, |_, _| {}));
    }
}
