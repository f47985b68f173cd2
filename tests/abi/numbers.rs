//! The numbers of the ABI: `shared-abi` and coboot.h, the C header, have those of the golden copy
//! `numbers.txt`, and coboot.h the offsets of `records.txt`. (A C compiler proves them by its assertions.)

use std::collections::BTreeMap;
use std::fmt::Debug;

use boot_core::store::Key;
use shared_abi::abilities::Abilities;
use shared_abi::boot_report::Reason;
use shared_abi::callgate::{self, Selector, Status};
use shared_abi::geometry::OTP;
use shared_abi::handoff::{self, ResetCause};
use shared_abi::renewal::{self, Origin};
use shared_abi::services::{self, OperationResult, Step};
use shared_abi::warm_start::{self, Damage, TrialStep, WarmStart};
use shared_abi::{label, nameplate};

use crate::layout::{golden, FROZEN};

const HEADER: &str = include_str!("../../examples/c/coboot/coboot.h");

type Numbers = BTreeMap<String, i64>;

/// The golden copy: the numbers that C has, too, and the others.
fn frozen() -> [Numbers; 2] {
    let number = |line: &str| {
        let (name, digits) = line.split_once(' ')?;
        Some((name.to_owned(), i64::from_str_radix(digits, 16).ok()?))
    };
    let sections: Vec<_> = include_str!("numbers.txt").split("\n[").skip(1).collect();
    let [in_c, others] = sections[..] else { panic!("numbers.txt has two sections") };
    let mut in_c: Numbers = in_c.lines().filter_map(number).collect();
    for record in golden() {
        let Some(structure) = record.structure else { continue };
        in_c.insert(format!("sizeof(struct {structure})"), record.bytes.len() as i64);
        for (field, at) in &record.fields {
            in_c.insert(format!("offsetof(struct {structure}, {field})"), *at as i64);
        }
    }
    [in_c, others.lines().filter_map(number).collect()]
}

/// The numbers of the header by what they are: the name after `COBOOT_`, or what an assertion is
/// about.
fn of_header() -> Numbers {
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

/// All numbers that a reader knows, with their names as in C: not those that it takes for another.
fn known<T: Copy + Debug>(
    prefix: &str,
    of: impl Fn(u8) -> Option<T>,
    back: impl Fn(T) -> u8,
) -> Vec<(String, i64)> {
    let name = |value: T| {
        let mut name = prefix.to_owned();
        for letter in format!("{value:?}").chars().take_while(char::is_ascii_alphanumeric) {
            let separator = if letter.is_uppercase() { "_" } else { "" };
            name += &format!("{separator}{}", letter.to_ascii_uppercase());
        }
        name
    };
    let of = |number| of(number).filter(|value| back(*value) == number);
    (0..=u8::MAX).filter_map(|number| Some((name(of(number)?), number.into()))).collect()
}

/// Those of `shared-abi`, and of the journal.
fn of_rust() -> Numbers {
    let mut all: Numbers = [
        ("CHECK_SEED", shared_abi::CHECK_SEED),
        ("CHECK_ROTATION", shared_abi::CHECK_ROTATION),
        ("CHECK_FACTOR", shared_abi::CHECK_FACTOR),
        ("LABEL_MAGIC", label::MAGIC),
        ("LABEL_OFFSET", label::OFFSET),
        ("WARM_START_MAGIC", warm_start::MAGIC),
        ("HANDOFF_MAGIC", handoff::MAGIC),
        ("HANDOFF_VERSION", handoff::VERSION.into()),
        ("HANDOFF_OLDEST", handoff::OLDEST.into()),
        ("HANDOFF_FRESH", handoff::FLAG_FRESH),
        ("HANDOFF_NAMEPLATE", handoff::FLAG_NAMEPLATE),
        ("NAMEPLATE_MAGIC", nameplate::MAGIC),
        ("OTP", OTP.base),
        ("OTP_BLOCKS", nameplate::BLOCKS as u32),
        ("CALLGATE_MAGIC", callgate::MAGIC),
        ("CALLGATE_ABI_VERSION", callgate::ABI_VERSION.into()),
        ("CALLGATE_TABLE_SIZE", callgate::TABLE_SIZE),
        ("CALLGATE_STACK", callgate::STACK),
        ("BOOTLOADER", renewal::BOOTLOADER.into()),
        ("PROGRAM_INSTALLED", callgate::PROGRAM_INSTALLED),
        ("PROGRAM_SIGNED", callgate::PROGRAM_SIGNED),
        ("ABILITY_SEALED", Abilities::SEALED.0),
        ("ABILITY_RENEWAL", Abilities::RENEWAL.0),
        ("ABILITY_ROM_LOADER", Abilities::ROM_LOADER.0),
        ("ABILITY_NAMEPLATE", Abilities::NAMEPLATE.0),
        ("ABILITY_INSTALL", Abilities::INSTALL.0),
        ("SERVICES_OFFSET", services::OFFSET),
        ("OPERATION_ERASE", services::ERASE),
        ("OPERATION_PROGRAM", services::PROGRAM),
        ("STORE_STATE_WORDS", services::STORE_STATE_WORDS as u32),
        ("KEY_PROGRAM", Key::program(0).0),
        ("KEY_CRASH_COUNT", Key::CRASH_COUNT.0),
        ("KEY_NODE", Key::NODE.0),
        ("KEY_COUNTER", Key::counter(0).0),
        ("KEY_EVENT", Key::event(0).0),
        ("KEY_GRANTS", Key::GRANTS.0),
        ("KEY_DATE", Key::date(0).0),
    ]
    .map(|(name, number)| (name.to_owned(), number.into()))
    .into();
    let request = |number: u8| {
        let request = |argument| WarmStart::encode(number.into(), argument).request();
        request(0).or(request(1))
    };
    all.extend(known("REQUEST", request, |it| WarmStart::new(it).request as u8));
    all.extend(known("DAMAGE", Damage::from_number, |it| it as u8));
    all.extend(known("TRIAL_STEP", TrialStep::from_number, |it| it as u8));
    all.extend(known("REASON", Reason::from_byte, |it| it as u8));
    all.extend(known("RESET", |byte| Some(ResetCause::from_byte(byte)), |it| it as u8));
    all.extend(known("ORIGIN", |byte| Some(Origin::from_byte(byte)), |it| it as u8));
    all.extend(known("SELECTOR", |number| Selector::from_number(number.into()), |it| it as u8));
    all.extend(known("RESULT", |number| Some(OperationResult::from_number(number.into())), |it| it as u8));
    all.extend(known("STEP", |number| Some(Step::from_number(number.into())), |it| it as u8));
    use Status::*;
    for status in
        [Ok, UnknownSelector, BadPointer, BadRange, Busy, Failed, BadArgument, NoProgram, Locked, Full]
    {
        let name = known("STATUS", |number| (number == 0).then_some(status), |_| 0).remove(0).0;
        all.insert(name, (status as i32).into());
    }
    all
}

#[test]
fn every_number_is_the_golden_one_in_rust_and_in_c() {
    let [in_c, others] = frozen();
    let differs = |made: &Numbers, golden: &Numbers| -> Vec<String> {
        let names = made.keys().chain(golden.keys()).filter(|name| made.get(*name) != golden.get(*name));
        names.map(|name| format!("{name}: {:?}, golden {:?}", made.get(name), golden.get(name))).collect()
    };
    assert_eq!(differs(&of_header(), &in_c), [""; 0], "coboot.h");
    let of_records = in_c.iter().filter(|(name, _)| name.contains("of("));
    let mut rust = of_rust();
    rust.extend(of_records.map(|(name, number)| (name.clone(), *number)));
    let golden = in_c.clone().into_iter().chain(others).collect();
    assert_eq!(differs(&rust, &golden), [""; 0], "shared-abi: {FROZEN}");
    // No line of the two forms was overlooked.
    let assertions = HEADER.matches("\nCOBOOT_STATIC_ASSERT(").count();
    let defines =
        HEADER.lines().filter(|line| line.starts_with("#define") && line.contains("INT32_C(")).count();
    assert_eq!(in_c.len(), assertions + defines);
}
