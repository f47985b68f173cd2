//! The C header, compiled as C and as C++: what they make of it is what Rust has.

use std::env;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A program in C and C++ that prints what the header's functions make, as bytes, and a verdict on
/// records that come in as bytes.
const PROGRAM: &str = r#"
#include <stdio.h>
#include <string.h>
#include "coboot.h"

COBOOT_DATED_LABEL(0x319, 0x4007D151, 0x00010203, 1795804215);

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
        'C', 'B', 'H', 'O', 5, 0, 48, 0, 5, 1, 3, 1, 0x48, 0xE8, 0x01, 0x00,
        0x02, 0x00, 0x01, 0x00, 0xEF, 0xBE, 0xAD, 0xDE, 1, 0, 0, 0,
        2, 0, 0, 0, 0x80, 6, 0x80, 4, 0x37, 0xCC, 0x09, 0x6B, 0, 0, 0, 0, 0x7D, 0xF9, 0xA5, 0x46,
    };
    /* Of a bootloader that knew no flags. */
    static const unsigned char older[48] = {
        'C', 'B', 'H', 'O', 1, 0, 48, 0, 5, 1, 3, 1, 0x48, 0xE8, 0x01, 0x00,
        0x02, 0x00, 0x01, 0x00, 0xEF, 0xBE, 0xAD, 0xDE, 0, 0, 0, 0,
        0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xDD, 0x3C, 0xA8, 0xD2,
    };
    print(&coboot_label_of_image, sizeof coboot_label_of_image);
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
    printf("%d%d%u ", coboot_handoff_is_sound(&record), coboot_is_fresh(&record), coboot_bootloader_number(&record));
    printf("%x/%x ", coboot_sdo_request_base(&record), coboot_sdo_response_base(&record));
    memcpy(&record, handoff, sizeof record);
    printf("%d%u ", coboot_is_fresh(&record), coboot_bootloader_number(&record));
    printf("%x/%x ", coboot_sdo_request_base(&record), coboot_sdo_response_base(&record));
    printf("%u ", (unsigned)record.program_date);
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

    /* The last good one counts: the same without a serial number in block 9, a damaged one in block 15. */
    static const unsigned char plate[32] = {
        'C', 'B', 'N', 'P', 0x23, 0x01, 0, 0, 0x07, 0, 0xA1, 0x5E, 3, 0, 2, 0,
        0x40, 0xE2, 0x01, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xFE, 0x3F, 0x2A, 0x54,
    };
    static const unsigned char later[4] = { 0xEC, 0x22, 0x54, 0x33 };
    struct coboot_nameplate otp[16];
    memset(otp, 0xFF, sizeof otp);
    printf("%d", coboot_last_nameplate(otp) == NULL);
    memcpy(&otp[2], plate, sizeof plate);
    printf("%d", coboot_last_nameplate(otp) == &otp[2]);
    memcpy(&otp[9], plate, sizeof plate);
    otp[9].serial_number = 0;
    memcpy(&otp[9].check, later, sizeof later);
    printf("%d", coboot_last_nameplate(otp) == &otp[9]);
    memcpy(&otp[15], plate, sizeof plate);
    printf("%d", coboot_last_nameplate(otp) == &otp[15]);
    sound = 0;
    for (size_t bit = 0; bit < 8 * sizeof plate; bit++) {
        memcpy(&otp[15], plate, sizeof plate);
        ((unsigned char *)&otp[15])[bit / 8] ^= (unsigned char)(1u << bit % 8);
        sound += coboot_last_nameplate(otp) != &otp[9];
    }
    printf("%u\n", sound);

    static const unsigned char table[16] = { 'C', 'B', 'C', 'G', 1, 0, 16, 0, 1, 0, 0, 0, 0x11, 0x02, 0x00, 0x08 };
    struct coboot_callgate gate;
    memcpy(&gate, table, sizeof gate);
    printf("%d%d%d", coboot_callgate_state(&gate), gate.entry == 0x08000211, gate.bootloader_version == 1);
    gate.abi_version = 2;
    printf("%d", coboot_callgate_state(&gate));
    gate.abi_version = 0;
    printf("%d", coboot_callgate_state(&gate));
    gate.length = 12;
    printf("%d", coboot_callgate_state(&gate));
    memset(&gate, 0xFF, sizeof gate);
    printf("%d\n", coboot_callgate_state(&gate));
    return 0;
}
"#;

fn include() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/c/coboot")
}

/// A compiler that takes nothing lightly.
fn strict(compiler: &str) -> Command {
    let mut compiler = Command::new(compiler);
    compiler.args(["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wcast-align", "-Werror"]);
    compiler.arg("-I").arg(include());
    compiler
}

fn clang() -> Command {
    strict(&env::var("CLANG").unwrap_or_else(|_| "clang".into()))
}

fn succeed(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| {
        panic!("{command:?}: {error}. `cargo xtask setup` installs the compilers.");
    });
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// The bytes are those of `layout.rs`, whose check words come from an implementation in a third
/// language; so does that of the label.
#[test]
fn c_and_cpp_make_the_same_bytes_and_come_to_the_same_verdicts() {
    let expected = "\
        43424C311903000051D107400302010037CC096B00000000000000000C3AD889\n\
        434257310100000000000000F0B728D9\n\
        434257310200000001000000CD5920E5\n\
        434257310300000001000000F981E052\n\
        434257310700000002037F00A57F86CC\n\
        100 600/580 12 680/480 1795804215 1 5 125000 1 1\n\
        0\n\
        00\n\
        11110\n\
        0110211\n";
    for (extension, standard) in [("c", "-std=c11"), ("c", "-std=gnu17"), ("cpp", "-std=c++17")] {
        let folder = kit::folder!("header");
        let source = folder.write(format!("header.{extension}"), PROGRAM);
        let program = folder.join("header");
        succeed(
            clang()
                .args([standard, "-O2", "-fsanitize=undefined", "-fsanitize-trap=undefined"])
                // Those that need the library of C++.
                .arg("-fno-sanitize=function,vptr")
                .arg(&source)
                .arg("-o")
                .arg(&program),
        );
        assert_eq!(succeed(&mut Command::new(&program)), expected, "{standard}");
    }
}

/// What a program for the chip takes from the header and from the library.
const FOR_THE_CHIP: &str = r#"
#include "coboot.h"
#include "program.h"

COBOOT_LABEL(1, 2, 3);

#ifdef __cplusplus
extern "C" {
#endif
int call(void);
void leave(void);
#ifdef __cplusplus
}
#endif

int call(void)
{
    const struct coboot_callgate *gate = coboot_callgate();
    struct coboot_handoff handoff;
    struct coboot_node_args node;
    struct coboot_program_args program;
    uint32_t crc;
    return coboot_read_handoff(&handoff) && coboot_nameplate(&handoff) == NULL && coboot_crc32(gate, 0, 4, &crc) == 0 && coboot_read_node(gate, &node) == 0
        && coboot_store_node(gate, 1, 125000) == 0 && coboot_program_info(gate, 1, &program) == 0
        && coboot_confirm(gate, 1) == 0 && coboot_invalidate(gate, 1) == 0 && coboot_unconfirm(gate, 1) == 0;
}

void leave(void)
{
    coboot_reset(COBOOT_REQUEST_STORE_NODE, coboot_stored_node(1, 125000));
}
"#;

/// By both compilers, as C and as C++, as freestanding as it gets: the assertions on sizes and
/// offsets hold there, too. Clang for both float ABIs of the chip.
#[test]
fn it_compiles_for_the_chip() {
    let gcc = |name: &str| {
        let mut gcc = strict(name);
        gcc.arg("-mthumb");
        gcc
    };
    let clang = |target: &str| {
        let mut clang = clang();
        clang.arg(format!("--target={target}"));
        clang
    };
    for (extension, standard) in [("c", "-std=c11"), ("c", "-std=gnu17"), ("cpp", "-std=c++17")] {
        let folder = kit::folder!("header");
        let source = folder.write(format!("chip.{extension}"), FOR_THE_CHIP);
        let name = if extension == "c" { "arm-none-eabi-gcc" } else { "arm-none-eabi-g++" };
        for mut compiler in [clang("thumbv7em-none-eabihf"), clang("thumbv7em-none-eabi"), gcc(name)] {
            compiler.args(["-mcpu=cortex-m4", "-ffreestanding", "-Os", standard, "-c"]);
            succeed(compiler.arg(&source).arg("-o").arg(folder.join("chip.o")));
        }
    }
}
