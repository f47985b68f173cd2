//! Every number of coboot.h, the C header of the ABI, against `shared-abi`. (Its assertions hold the
//! layout of the structures against the numbers when a C compiler reads it.)

use std::collections::BTreeMap;
use std::mem::{offset_of, size_of};

use shared_abi::callgate::{self, Crc32Args, NodeArgs, ProgramArgs, Selector, Status, Table};
use shared_abi::geometry::OTP;
use shared_abi::handoff::{self, Handoff, ResetCause};
use shared_abi::label::{self, Label};
use shared_abi::nameplate::{self, Nameplate};
use shared_abi::renewal;
use shared_abi::warm_start::{self, BootRequest, Owed, StoredNode, WarmStart};

const HEADER: &str = include_str!("../../examples/c/coboot/coboot.h");

/// The numbers of the header by what they are: the name after `COBOOT_`, or what an assertion is
/// about.
fn of_header() -> BTreeMap<String, i64> {
    let number = |text: &str| match text.strip_prefix("0x") {
        Some(digits) => i64::from_str_radix(digits, 16).unwrap(),
        None => text.parse().unwrap(),
    };
    let entry = |line: &str| {
        if let Some(define) = line.strip_prefix("#define COBOOT_") {
            let (name, value) = define.split_once(' ')?;
            let value = value.strip_prefix("UINT32_C(").or_else(|| value.strip_prefix("INT32_C("))?;
            return Some((name.to_owned(), number(value.split_once(')')?.0)));
        }
        let (what, value) = line.strip_prefix("COBOOT_STATIC_ASSERT(")?.split_once(" == ")?;
        Some((what.to_owned(), number(value.split_once(',')?.0)))
    };
    HEADER.lines().filter_map(entry).collect()
}

/// The size and the offsets of a structure, as the header's assertions have them.
macro_rules! structure {
    ($name:literal, $rust:ty, $($field:ident),+) => {
        [
            (format!("sizeof(struct {})", $name), size_of::<$rust>()),
            $((format!("offsetof(struct {}, {})", $name, stringify!($field)), offset_of!($rust, $field))),+
        ]
        .map(|(what, number)| (what, number as i64))
    };
}

/// The same of `shared-abi`.
fn of_rust() -> BTreeMap<String, i64> {
    let request = |request| WarmStart::new(request).request;
    let owed = Owed { program: 1, value: 0, node_id: 1 };
    let mut all: BTreeMap<String, i64> = [
        ("CHECK_SEED", shared_abi::CHECK_SEED),
        ("CHECK_ROTATION", shared_abi::CHECK_ROTATION),
        ("CHECK_FACTOR", shared_abi::CHECK_FACTOR),
        ("LABEL_MAGIC", label::MAGIC),
        ("WARM_START_MAGIC", warm_start::MAGIC),
        ("REQUEST_STAY", request(BootRequest::Stay)),
        ("REQUEST_TRIAL", request(BootRequest::Trial(1))),
        ("REQUEST_START", request(BootRequest::Start(1))),
        ("REQUEST_POWER_ON", request(BootRequest::PowerOn)),
        ("REQUEST_OWED", request(BootRequest::Owed(owed))),
        ("REQUEST_CONFIRM", request(BootRequest::Confirm(1))),
        ("REQUEST_INVALIDATE", request(BootRequest::Invalidate(1))),
        ("REQUEST_STORE_NODE", request(BootRequest::StoreNode(StoredNode::new(1, 0)))),
        ("REQUEST_RESCUE", request(BootRequest::Rescue)),
        ("HANDOFF_MAGIC", handoff::MAGIC),
        ("HANDOFF_VERSION", handoff::VERSION.into()),
        ("HANDOFF_OLDEST", handoff::OLDEST.into()),
        ("HANDOFF_FRESH", handoff::FLAG_FRESH),
        ("HANDOFF_NAMEPLATE", handoff::FLAG_NAMEPLATE),
        ("NAMEPLATE_MAGIC", nameplate::MAGIC),
        ("OTP", OTP.base),
        ("OTP_BLOCKS", nameplate::BLOCKS as u32),
        ("RESET_UNKNOWN", ResetCause::Unknown as u32),
        ("RESET_POWER_ON", ResetCause::PowerOn as u32),
        ("RESET_PIN", ResetCause::Pin as u32),
        ("RESET_SOFTWARE", ResetCause::Software as u32),
        ("RESET_INDEPENDENT_WATCHDOG", ResetCause::IndependentWatchdog as u32),
        ("RESET_WINDOW_WATCHDOG", ResetCause::WindowWatchdog as u32),
        ("RESET_LOW_POWER", ResetCause::LowPower as u32),
        ("RESET_BROWN_OUT", ResetCause::BrownOut as u32),
        ("RESET_STANDBY", ResetCause::Standby as u32),
        ("CALLGATE_MAGIC", callgate::MAGIC),
        ("CALLGATE_ABI_VERSION", callgate::ABI_VERSION.into()),
        ("CALLGATE_TABLE_SIZE", callgate::TABLE_SIZE),
        ("CALLGATE_STACK", callgate::STACK),
        ("SELECTOR_CRC32", Selector::Crc32 as u32),
        ("SELECTOR_READ_NODE", Selector::ReadNode as u32),
        ("SELECTOR_STORE_NODE", Selector::StoreNode as u32),
        ("SELECTOR_PROGRAM_INFO", Selector::ProgramInfo as u32),
        ("SELECTOR_CONFIRM", Selector::Confirm as u32),
        ("SELECTOR_INVALIDATE", Selector::Invalidate as u32),
        ("SELECTOR_UNCONFIRM", Selector::Unconfirm as u32),
        ("BOOTLOADER", renewal::BOOTLOADER.into()),
        ("PROGRAM_INSTALLED", callgate::PROGRAM_INSTALLED),
        ("PROGRAM_SIGNED", callgate::PROGRAM_SIGNED),
    ]
    .map(|(name, number)| (name.to_owned(), number.into()))
    .into();
    let codes = [
        ("OK", Status::Ok),
        ("UNKNOWN_SELECTOR", Status::UnknownSelector),
        ("BAD_POINTER", Status::BadPointer),
        ("BAD_RANGE", Status::BadRange),
        ("BUSY", Status::Busy),
        ("FAILED", Status::Failed),
        ("BAD_ARGUMENT", Status::BadArgument),
        ("NO_PROGRAM", Status::NoProgram),
        ("LOCKED", Status::Locked),
        ("FULL", Status::Full),
    ];
    all.extend(codes.map(|(name, code)| (format!("STATUS_{name}"), (code as i32).into())));
    all.extend(structure!(
        "coboot_label",
        Label,
        magic,
        vendor_id,
        product_code,
        version,
        date,
        reserved,
        check
    ));
    all.extend(structure!("coboot_warm_start", WarmStart, magic, request, argument, check));
    all.extend(structure!(
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
        bootloader_number,
        sdo_request_base,
        sdo_response_base,
        program_date,
        reserved,
        check
    ));
    all.extend(structure!(
        "coboot_nameplate",
        Nameplate,
        magic,
        vendor_id,
        product_code,
        revision,
        serial_number,
        reserved,
        check
    ));
    let table =
        structure!("coboot_callgate", Table<u32>, magic, abi_version, length, bootloader_version, entry);
    all.extend(table);
    all.extend(structure!("coboot_crc32_args", Crc32Args, address, len, crc));
    all.extend(structure!("coboot_node_args", NodeArgs, node_id, bit_rate));
    all.extend(structure!("coboot_program_args", ProgramArgs, number, size, crc, version, flags));
    all
}

#[test]
fn every_number_of_the_c_header_is_that_of_the_library() {
    let (header, rust) = (of_header(), of_rust());
    let differs = |(what, number): &(&String, &i64)| rust.get(*what) != Some(*number);
    let wrong: Vec<_> = header.iter().filter(differs).collect();
    assert!(wrong.is_empty(), "coboot.h has other numbers than shared-abi: {wrong:?}");
    let missing: Vec<_> = rust.keys().filter(|what| !header.contains_key(*what)).collect();
    assert!(missing.is_empty(), "coboot.h has no {missing:?}");
    // No line of the two forms was overlooked.
    let assertions = HEADER.matches("\nCOBOOT_STATIC_ASSERT(").count();
    let defines =
        HEADER.lines().filter(|line| line.starts_with("#define") && line.contains("INT32_C(")).count();
    assert_eq!(header.len(), assertions + defines);
}

/// The documented values (the check word's are in shared-abi), typed a second time.
#[test]
fn what_c_sees_are_the_documented_values() {
    for line in [
        "#define COBOOT_CHECK_SEED UINT32_C(0xC0B007A5)",
        "#define COBOOT_REQUEST_STAY UINT32_C(0x1)",
        "#define COBOOT_REQUEST_POWER_ON UINT32_C(0x5)",
        "#define COBOOT_SELECTOR_INVALIDATE UINT32_C(0x6)",
        "#define COBOOT_STATUS_NO_PROGRAM INT32_C(-7) /* nothing is installed under this number */",
        "#define COBOOT_REQUEST_OWED UINT32_C(0x7)",
        "#define COBOOT_HANDOFF_FRESH UINT32_C(0x1)",
        "    uint32_t date;",
        "    uint32_t program_date;",
        "    uint32_t reserved[2];",
        "#define COBOOT_OTP UINT32_C(0x1FFF7800)",
        "COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, flags) == 24, \"coboot_handoff: flags\");",
        "COBOOT_STATIC_ASSERT(sizeof(struct coboot_handoff) == 48, \"coboot_handoff\");",
        "COBOOT_STATIC_ASSERT(offsetof(struct coboot_handoff, reset_cause) == 10, \"coboot_handoff: reset_cause\");",
        "COBOOT_STATIC_ASSERT(offsetof(struct coboot_callgate, entry) == 12, \"coboot_callgate: entry\");",
    ] {
        assert!(HEADER.lines().any(|there| there == line), "{line}");
    }
}
