//! The generated C header, compiled: what C makes of it is what Rust has.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// A program that prints what the header's functions make, as bytes, and a verdict on records that
/// come in as bytes.
const PROGRAM: &str = r#"
#include <stdio.h>
#include <string.h>
#include "coboot.h"

static void print(const void *record, size_t len)
{
    for (size_t i = 0; i < len; i++) {
        printf("%02X", ((const unsigned char *)record)[i]);
    }
    putchar('\n');
}

int main(void)
{
    static const unsigned char handoff[48] = {
        'C', 'B', 'H', 'O', 2, 0, 48, 0, 5, 1, 3, 1, 0x48, 0xE8, 0x01, 0x00,
        0x02, 0x00, 0x01, 0x00, 0xEF, 0xBE, 0xAD, 0xDE, 1, [44] = 0x91, 0x69, 0x48, 0x4E,
    };
    /* Of a bootloader that knew no flags. */
    static const unsigned char older[48] = {
        'C', 'B', 'H', 'O', 1, 0, 48, 0, 5, 1, 3, 1, 0x48, 0xE8, 0x01, 0x00,
        0x02, 0x00, 0x01, 0x00, 0xEF, 0xBE, 0xAD, 0xDE, [44] = 0xDD, 0x3C, 0xA8, 0xD2,
    };
    struct coboot_warm_start cell = coboot_request(COBOOT_REQUEST_STAY, 0);
    print(&cell, sizeof cell);
    cell = coboot_request(COBOOT_REQUEST_TRIAL, 1);
    print(&cell, sizeof cell);
    cell = coboot_request(COBOOT_REQUEST_START, 1);
    print(&cell, sizeof cell);

    cell = coboot_request(COBOOT_REQUEST_OWED, coboot_owed(2, 3, 127));
    print(&cell, sizeof cell);

    struct coboot_handoff record;
    memcpy(&record, older, sizeof record);
    printf("%d%d ", coboot_handoff_is_sound(&record), coboot_is_fresh(&record));
    memcpy(&record, handoff, sizeof record);
    printf("%d ", coboot_is_fresh(&record));
    printf("%d %u %u %u %u\n", coboot_handoff_is_sound(&record), record.node_id, (unsigned)record.bit_rate,
           (unsigned)(record.reset_cause == COBOOT_RESET_SOFTWARE), record.trial);
    unsigned sound = 0;
    for (size_t bit = 0; bit < 8 * sizeof record; bit++) {
        memcpy(&record, handoff, sizeof record);
        ((unsigned char *)&record)[bit / 8] ^= (unsigned char)(1u << bit % 8);
        sound += coboot_handoff_is_sound(&record);
    }
    printf("%u\n", sound);
    memset(&record, 0xFF, sizeof record);
    printf("%d", coboot_handoff_is_sound(&record));
    memset(&record, 0, sizeof record);
    printf("%d\n", coboot_handoff_is_sound(&record));

    static const unsigned char table[16] = { 'C', 'B', 'C', 'G', 1, 0, 16, 0, 1, 0, 0, 0, 0x11, 0x02, 0x00, 0x08 };
    struct coboot_callgate gate;
    memcpy(&gate, table, sizeof gate);
    printf("%d%d%d", coboot_callgate_state(&gate), gate.entry == 0x08000211, gate.bootloader_version == 1);
    gate.abi_version = 2;
    printf("%d", coboot_callgate_state(&gate));
    gate.length = 12;
    printf("%d", coboot_callgate_state(&gate));
    memset(&gate, 0xFF, sizeof gate);
    printf("%d\n", coboot_callgate_state(&gate));
    return 0;
}
"#;

fn include() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../app-c")
}

fn clang() -> Command {
    let mut clang = Command::new(env::var_os("CLANG").unwrap_or_else(|| "clang".into()));
    clang.args(["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wcast-align", "-Werror"]);
    clang.arg("-I").arg(include());
    clang
}

fn succeed(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| {
        panic!("{command:?}: {error}. `cargo xtask setup` installs clang.");
    });
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn scratch(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(name)
}

/// The bytes are those of tests/abi.rs, whose check words come from an implementation in a third
/// language.
#[test]
fn c_makes_the_same_bytes_and_comes_to_the_same_verdicts() {
    let (source, program) = (scratch("header.c"), scratch("header"));
    fs::write(&source, PROGRAM).unwrap();
    succeed(
        clang()
            .args(["-O2", "-fsanitize=undefined", "-fsanitize-trap=undefined"])
            .arg(&source)
            .arg("-o")
            .arg(&program),
    );
    let printed = succeed(&mut Command::new(&program));
    let expected = "\
        434257310100000000000000F0B728D9\n\
        434257310200000001000000CD5920E5\n\
        434257310300000001000000F981E052\n\
        434257310700000002037F00A57F86CC\n\
        10 1 1 5 125000 1 1\n\
        0\n\
        00\n\
        011211\n";
    assert_eq!(printed, expected);
}

/// Both float ABIs of the chip, as C and as freestanding as it gets: the assertions on sizes and
/// offsets hold there, too.
#[test]
fn it_compiles_for_the_chip() {
    let source = scratch("chip.c");
    fs::write(
        &source,
        "#include \"coboot.h\"\nint there(void);\nint there(void) { return coboot_callgate() != NULL; }\n",
    )
    .unwrap();
    for target in ["thumbv7em-none-eabihf", "thumbv7em-none-eabi"] {
        let target = format!("--target={target}");
        for standard in ["-std=c11", "-std=gnu17"] {
            let mut clang = clang();
            clang.args([&target, "-mcpu=cortex-m4", "-ffreestanding", "-Os", standard, "-c"]);
            succeed(clang.arg(&source).arg("-o").arg(scratch("chip.o")));
        }
    }
}
