//! The C header, compiled as C and as C++: what they make of it is what Rust has.

use std::env;
use std::fmt::Write as _;
use std::fs::File;
use std::process::Command;

use coboot_app::callgate::{Callgate, CallgateError, Table};
use shared_abi::handoff::{BootInfo, Handoff};
use shared_abi::nameplate::Nameplate;

use crate::compiler::{compile_for_the_chip, strict, succeed};
use crate::layout::{golden, named, of_bytes};
use crate::old_and_new::records;

/// A program in C and C++ that prints the label and the arguments that the header makes; and what its
/// functions make of each record that comes in, as bytes.
const PROGRAM: &str = r#"
#include <stdio.h>
#include <stdlib.h>
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

static void print_handoff(const struct coboot_handoff *it)
{
    if (!coboot_handoff_is_sound(it)) {
        puts("None");
        return;
    }
    const unsigned cause = it->reset_cause <= COBOOT_RESET_STANDBY ? it->reset_cause : COBOOT_RESET_UNKNOWN;
    printf("%u %u %u %u ", it->node_id, it->program, cause, it->trial != 0);
    printf("%u %u %u ", (unsigned)it->bit_rate, (unsigned)it->bootloader_version, (unsigned)it->serial_number);
    printf("%u %u ", coboot_is_fresh(it), (it->flags & COBOOT_HANDOFF_NAMEPLATE) != 0);
    printf("%u %u %u ", coboot_bootloader_number(it), coboot_sdo_request_base(it), coboot_sdo_response_base(it));
    printf("%u\n", (unsigned)it->program_date);
}

int main(void)
{
    static char hex[2 * 512 + 1];
    static unsigned char bytes[512];
    char record;

    print(&coboot_label_of_image, sizeof coboot_label_of_image);
    printf("%08X %08X\n", (unsigned)coboot_owed(2, 3, 127), (unsigned)coboot_stored_node(127, 1000000));
    while (scanf(" %c %1024s", &record, hex) == 2) {
        memset(bytes, 0xFF, sizeof bytes);
        for (size_t i = 0; i < strlen(hex) / 2; i++) {
            const char digits[3] = { hex[2 * i], hex[2 * i + 1], 0 };
            bytes[i] = (unsigned char)strtoul(digits, NULL, 16);
        }
        struct coboot_warm_start cell;
        struct coboot_handoff handoff;
        struct coboot_callgate gate;
        struct coboot_nameplate otp[COBOOT_OTP_BLOCKS];
        const struct coboot_nameplate *plate;
        switch (record) {
        case 'w':
            memcpy(&cell, bytes, sizeof cell);
            cell = coboot_request(cell.request, cell.argument);
            print(&cell, sizeof cell);
            break;
        case 'h':
            memcpy(&handoff, bytes, sizeof handoff);
            print_handoff(&handoff);
            break;
        case 'n':
            memcpy(otp, bytes, sizeof otp);
            plate = coboot_last_nameplate(otp);
            if (plate == NULL) {
                puts("None");
            } else {
                printf("%u %u ", (unsigned)(plate - otp), (unsigned)plate->vendor_id);
                printf("%u %u ", (unsigned)plate->product_code, (unsigned)plate->revision);
                printf("%u\n", (unsigned)plate->serial_number);
            }
            break;
        default:
            memcpy(&gate, bytes, sizeof gate);
            printf("%u\n", (unsigned)coboot_callgate_state(&gate));
        }
    }
    return 0;
}
"#;

fn name_of_clang() -> String {
    env::var("CLANG").unwrap_or_else(|_| "clang".into())
}

pub fn clang() -> Command {
    strict(&name_of_clang())
}

/// What the library for Rust makes of a record, as the program prints it.
fn in_rust(name: &str, bytes: &[u8]) -> String {
    match name {
        "handoff" => of_bytes::<Handoff>(bytes).info().map_or("None".to_owned(), |it| {
            let BootInfo {
                node_id, program, reset_cause, bit_rate, bootloader_version, serial_number, ..
            } = it;
            let (trial, fresh, nameplate) = (u8::from(it.trial), u8::from(it.fresh), u8::from(it.nameplate));
            let (cause, number) = (reset_cause as u8, it.bootloader_number.unwrap_or(0));
            format!(
                "{node_id} {program} {cause} {trial} {bit_rate} {bootloader_version} {serial_number} {fresh} \
                 {nameplate} {number} {} {} {}",
                it.sdo.request, it.sdo.response, it.program_date
            )
        }),
        "nameplate" => Nameplate::parse(&of_bytes(bytes)).map_or("None".to_owned(), |it| {
            format!("0 {} {} {} {}", it.vendor_id, it.product_code, it.revision, it.serial_number)
        }),
        _ => match Callgate::check(of_bytes::<Table>(bytes)) {
            Ok(_) => "0",
            Err(CallgateError::Absent) => "1",
            Err(_) => "2",
        }
        .to_owned(),
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect()
}

/// The golden records, and those of another time.
#[test]
fn c_and_cpp_make_the_same_bytes_and_come_to_the_same_verdicts() {
    let (mut input, mut expected) = (String::new(), vec![hex(&named("label").bytes)]);
    expected.push("007F0302 0000C87F".to_owned());
    let mut add = |record: char, bytes: &[u8], line: String| {
        writeln!(input, "{record} {}", hex(bytes)).unwrap();
        expected.push(line);
    };
    for cell in golden().iter().filter(|record| record.name.starts_with("warm-start cell")) {
        add('w', &cell.bytes, hex(&cell.bytes));
    }
    let of_golden = golden().iter().map(|record| (record.name, record.bytes.clone()));
    for (name, bytes) in of_golden.chain(records().into_iter().map(|(name, _, bytes)| (name, bytes))) {
        let (kind, _) = name.split_once(':').unwrap_or((name, ""));
        if let "handoff" | "nameplate" | "callgate" = kind {
            add(kind.chars().next().unwrap(), &bytes, in_rust(kind, &bytes));
        }
    }
    // The last good one counts: after one in block 2, and before a damaged one in block 15.
    let mut otp = vec![0xFF; 512];
    for (block, serial_number) in [(2, 1), (9, 2), (15, 3)] {
        let plate = Nameplate::new(7, 8, 9, serial_number).words();
        otp[32 * block..][..32].copy_from_slice(plate.map(u32::to_le_bytes).as_flattened());
    }
    otp[511] ^= 1;
    add('n', &otp, "9 7 8 9 2".to_owned());

    for (extension, standard) in [("c", "-std=c11"), ("c", "-std=gnu17"), ("cpp", "-std=c++17")] {
        let folder = kit::folder!("header");
        let source = folder.write(format!("header.{extension}"), PROGRAM);
        let (program, records) = (folder.join("header"), folder.write("records", &input));
        succeed(
            clang()
                .args([standard, "-O2", "-fsanitize=undefined", "-fsanitize-trap=undefined"])
                // Those that need the library of C++.
                .arg("-fno-sanitize=function,vptr")
                .arg(&source)
                .arg("-o")
                .arg(&program),
        );
        let output = succeed(Command::new(&program).stdin(File::open(records).unwrap()));
        let differs = output.lines().zip(&expected).find(|(c, rust)| c != rust);
        assert_eq!((differs, output.lines().count()), (None, expected.len()), "{standard}");
    }
}

/// For both float ABIs of the chip; `by_gcc.rs` does the same with the other compiler.
#[test]
fn it_compiles_for_the_chip() {
    for target in ["thumbv7em-none-eabihf", "thumbv7em-none-eabi"] {
        compile_for_the_chip(&name_of_clang(), &format!("--target={target}"));
    }
}
