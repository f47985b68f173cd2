//! `cargo xtask header`: writes the C header of the ABI.
//!
//! Every number in it is computed from shared-abi: sizes, offsets and values. The text around the
//! numbers is `header.h`; [`parts`] makes the replacement for each `@NAME@` in it.

use std::fmt::Write as _;
use std::mem::{offset_of, size_of};

use shared_abi::callgate::{self, Crc32Args, NodeArgs, ProgramArgs, Selector, Status, Table};
use shared_abi::handoff::{self, Handoff, ResetCause};
use shared_abi::label::{self, Label};
use shared_abi::warm_start::{self, BootRequest, Owed, StoredNode, WarmStart};

use crate::args::Args;
use crate::Outcome;

pub const HELP: &str = "\
usage: cargo xtask header

Prints the C header of the ABI between bootloader and application, made from shared-abi: warm-start cell,
handoff, callgate and label. It is the same for every board; addresses come from the linker, by the symbols that
`cargo xtask layout --ld program-1` prints. examples/c/coboot/coboot.h is a copy of it:

    cargo xtask header > examples/c/coboot/coboot.h
";

/// The text of the header around its numbers.
const TEMPLATE: &str = include_str!("header.h");

pub fn run(args: Args) -> Outcome {
    args.none_left()?;
    print!("{}", header());
    Ok(())
}

/// The header.
pub fn header() -> String {
    parts().into_iter().fold(TEMPLATE.to_owned(), |text, (name, part)| {
        text.replace(&format!("@{name}@"), part.trim_end_matches('\n'))
    })
}

/// The replacements in the template, by name.
fn parts() -> Vec<(&'static str, String)> {
    vec![
        ("CHECK", check()),
        ("LABEL", label()),
        ("WARM_START", warm_start()),
        ("HANDOFF", handoff()),
        ("CALLGATE", callgate()),
        ("SELECTORS", selectors()),
        ("ARGUMENTS", arguments()),
        ("STATUS", status()),
    ]
}

/// A field as declared in C: name, offset and size in bytes.
struct Field {
    name: &'static str,
    offset: usize,
    size: usize,
}

/// The size of a field, from an accessor function.
fn size_of_field<S, F>(_: impl Fn(&S) -> &F) -> usize {
    size_of::<F>()
}

/// A structure of the ABI: its name in C, and its fields in their order.
macro_rules! structure {
    ($name:literal, $rust:ty, $($field:ident),+) => {
        structure($name, size_of::<$rust>(), &[$(Field {
            name: stringify!($field),
            offset: offset_of!($rust, $field),
            size: size_of_field(|whole: &$rust| &whole.$field),
        }),+])
    };
}

/// The declaration of a structure, and the assertions that its layout in C equals the one in Rust.
///
/// All fields of the ABI are unsigned numbers or arrays of words, so the size determines the type.
fn structure(name: &str, size: usize, fields: &[Field]) -> String {
    let mut text = format!("struct {name} {{\n");
    let mut assertions = format!("COBOOT_STATIC_ASSERT(sizeof(struct {name}) == {size}, \"{name}\");\n");
    for Field { name: field, offset, size } in fields {
        let _ = match size {
            1 => writeln!(text, "    uint8_t {field};"),
            2 => writeln!(text, "    uint16_t {field};"),
            4 => writeln!(text, "    uint32_t {field};"),
            _ => writeln!(text, "    uint32_t {field}[{}];", size / 4),
        };
        let _ = writeln!(
            assertions,
            "COBOOT_STATIC_ASSERT(offsetof(struct {name}, {field}) == {offset}, \"{name}: {field}\");"
        );
    }
    text + "};\n" + &assertions
}

/// Definitions of unsigned numbers.
fn defines<T: Into<u32>>(numbers: impl IntoIterator<Item = (&'static str, T)>) -> String {
    let mut text = String::new();
    for (name, value) in numbers {
        let _ = writeln!(text, "#define COBOOT_{name} UINT32_C(0x{:X})", value.into());
    }
    text
}

fn check() -> String {
    defines([
        ("CHECK_SEED", shared_abi::CHECK_SEED),
        ("CHECK_ROTATION", shared_abi::CHECK_ROTATION),
        ("CHECK_FACTOR", shared_abi::CHECK_FACTOR),
    ])
}

fn label() -> String {
    defines([("LABEL_MAGIC", label::MAGIC)])
        + "\n"
        + &structure!("coboot_label", Label, magic, vendor_id, product_code, version, reserved, check)
}

/// Any owed answer: all owed answers have the same request number.
const OWED: Owed = Owed { program: 1, value: 0, node_id: 1 };

fn warm_start() -> String {
    let request = |request| WarmStart::new(request).request;
    defines([("WARM_START_MAGIC", warm_start::MAGIC)])
        + "\n/* Requests. Those for a program take its number, 1 to 254, as argument, an owed answer what coboot_owed makes, node\n \
           * parameters what coboot_stored_node makes, and the others 0. The last three are for what the callgate answers with\n \
           * COBOOT_STATUS_LOCKED. */\n"
        + &defines([
            ("REQUEST_STAY", request(BootRequest::Stay)),
            ("REQUEST_TRIAL", request(BootRequest::Trial(1))),
            ("REQUEST_START", request(BootRequest::Start(1))),
            ("REQUEST_POWER_ON", request(BootRequest::PowerOn)),
            ("REQUEST_OWED", request(BootRequest::Owed(OWED))),
            ("REQUEST_CONFIRM", request(BootRequest::Confirm(1))),
            ("REQUEST_INVALIDATE", request(BootRequest::Invalidate(1))),
            ("REQUEST_STORE_NODE", request(BootRequest::StoreNode(StoredNode::new(1, 0)))),
        ])
        + "\n"
        + &structure!("coboot_warm_start", WarmStart, magic, request, argument, check)
}

fn handoff() -> String {
    defines([
        ("HANDOFF_MAGIC", handoff::MAGIC),
        ("HANDOFF_VERSION", handoff::VERSION.into()),
        ("HANDOFF_OLDEST", handoff::OLDEST.into()),
    ]) + "\n/* In `flags`, since version 2: the program was started right behind its download in one go. */\n"
        + &defines([("HANDOFF_FRESH", handoff::FLAG_FRESH)])
        + "\n/* Reset causes. */\n"
        + &defines([
            ("RESET_UNKNOWN", ResetCause::Unknown as u8),
            ("RESET_POWER_ON", ResetCause::PowerOn as u8),
            ("RESET_PIN", ResetCause::Pin as u8),
            ("RESET_SOFTWARE", ResetCause::Software as u8),
            ("RESET_INDEPENDENT_WATCHDOG", ResetCause::IndependentWatchdog as u8),
            ("RESET_WINDOW_WATCHDOG", ResetCause::WindowWatchdog as u8),
            ("RESET_LOW_POWER", ResetCause::LowPower as u8),
            ("RESET_BROWN_OUT", ResetCause::BrownOut as u8),
        ])
        + "\n"
        + &structure!(
            "coboot_handoff",
            Handoff,
            magic,
            version,
            length,
            node_id,
            program,
            reset_cause,
            trial,
            bit_rate,
            bootloader_version,
            serial_number,
            flags,
            reserved,
            check
        )
}

fn callgate() -> String {
    defines([
        ("CALLGATE_MAGIC", callgate::MAGIC),
        ("CALLGATE_ABI_VERSION", callgate::ABI_VERSION.into()),
        ("CALLGATE_TABLE_SIZE", callgate::TABLE_SIZE),
    ]) + "\n/* Bytes of the caller's stack that a call may use. */\n"
        + &defines([("CALLGATE_STACK", callgate::STACK)])
        + "\n"
        + &structure!("coboot_callgate", Table<u32>, magic, abi_version, length, bootloader_version, entry)
}

fn selectors() -> String {
    defines([
        ("SELECTOR_CRC32", Selector::Crc32 as u32),
        ("SELECTOR_READ_NODE", Selector::ReadNode as u32),
        ("SELECTOR_STORE_NODE", Selector::StoreNode as u32),
        ("SELECTOR_PROGRAM_INFO", Selector::ProgramInfo as u32),
        ("SELECTOR_CONFIRM", Selector::Confirm as u32),
        ("SELECTOR_INVALIDATE", Selector::Invalidate as u32),
    ])
}

fn arguments() -> String {
    String::from("/* COBOOT_SELECTOR_CRC32: from `address` on, any alignment, `len` bytes of flash; gives `crc`. */\n")
        + &structure!("coboot_crc32_args", Crc32Args, address, len, crc)
        + "\n/* COBOOT_SELECTOR_READ_NODE and _STORE_NODE: node-ID 1 to 127, or 255 for none; bit rate in bit/s, 0 for one to be found\n \
           * out by listening. */\n"
        + &structure!("coboot_node_args", NodeArgs, node_id, bit_rate)
        + "\n/* COBOOT_SELECTOR_PROGRAM_INFO, _CONFIRM and _INVALIDATE: about program `number`; the first gives the rest. */\n"
        + &structure!("coboot_program_args", ProgramArgs, number, size, crc, version, flags)
        + "\n/* In `flags`: downloaded completely and right; signed, so that it starts by itself. */\n"
        + &defines([
            ("PROGRAM_INSTALLED", callgate::PROGRAM_INSTALLED),
            ("PROGRAM_SIGNED", callgate::PROGRAM_SIGNED),
        ])
}

fn status() -> String {
    let codes = [
        ("OK", Status::Ok, "done"),
        ("UNKNOWN_SELECTOR", Status::UnknownSelector, "this bootloader has no such selector"),
        ("BAD_POINTER", Status::BadPointer, "the argument pointer is null, misaligned or not in RAM"),
        ("BAD_RANGE", Status::BadRange, "the range does not lie in flash, or is empty"),
        ("BUSY", Status::Busy, "somebody uses the flash controller"),
        ("FAILED", Status::Failed, "the flash did not take the value"),
        (
            "BAD_ARGUMENT",
            Status::BadArgument,
            "a node-ID, bit rate or program number that does not exist here",
        ),
        ("NO_PROGRAM", Status::NoProgram, "nothing is installed under this number"),
        ("LOCKED", Status::Locked, "the flash is locked: leave with COBOOT_REQUEST_CONFIRM or the like"),
    ];
    let mut text = String::new();
    for (name, code, meaning) in codes {
        let _ = writeln!(text, "#define COBOOT_STATUS_{name} INT32_C({}) /* {meaning} */", code as i32);
    }
    text
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::workspace;

    #[test]
    fn the_copy_in_the_c_application_is_up_to_date() {
        let copy = fs::read_to_string(workspace::root().join("examples/c/coboot/coboot.h")).unwrap();
        assert!(
            copy == header(),
            "examples/c/coboot/coboot.h is old: cargo xtask header > examples/c/coboot/coboot.h"
        );
    }

    #[test]
    fn every_part_has_its_place() {
        for (name, _) in parts() {
            assert_eq!(TEMPLATE.matches(&format!("@{name}@")).count(), 1, "{name}");
        }
        assert!(!header().contains('@'));
    }

    /// The documented values (the check word's are in shared-abi), typed a second time.
    #[test]
    fn what_c_sees_are_the_documented_values() {
        let header = header();
        for line in [
            "#define COBOOT_CHECK_SEED UINT32_C(0xC0B007A5)",
            "#define COBOOT_REQUEST_STAY UINT32_C(0x1)",
            "#define COBOOT_REQUEST_POWER_ON UINT32_C(0x5)",
            "#define COBOOT_SELECTOR_INVALIDATE UINT32_C(0x6)",
            "#define COBOOT_STATUS_NO_PROGRAM INT32_C(-7) /* nothing is installed under this number */",
            "#define COBOOT_REQUEST_OWED UINT32_C(0x7)",
            "#define COBOOT_HANDOFF_FRESH UINT32_C(0x1)",
            "    uint32_t reserved[4];",
            "COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, flags) == 24, \"coboot_handoff: flags\");",
            "COBOOT_STATIC_ASSERT(sizeof(struct coboot_handoff) == 48, \"coboot_handoff\");",
            "COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, reset_cause) == 10, \"coboot_handoff: reset_cause\");",
            "COBOOT_STATIC_ASSERT(offsetof(struct coboot_callgate, entry) == 12, \"coboot_callgate: entry\");",
        ] {
            assert!(header.lines().any(|there| there == line), "{line}");
        }
    }
}
