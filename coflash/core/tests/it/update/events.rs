//! The events in the form for programs: the names are a contract.

use std::time::Duration;

use super::{file, node};
use canopen::{AbortCode, NodeId};
use coboot_can::Losses;
use coflash_core::device::session::Silence;
use coflash_core::device::{DeviceType, Dialect, Doing, Session, Timing};
use coflash_core::file::checksum::Checksum;
use coflash_core::file::Target;
use coflash_core::update::event::{Note, Phase, Problem, RepeatReason, Retry, Warning};
use coflash_core::update::{flash, Event, FlashOptions};
use coflash_core::Error;
use kit::fake::{Fake, Outcome, APPLICATION, BOOTLOADER, NODE};
use serde_json::{json, Value};

/// The lines of an update of this device.
fn lines(fake: &mut Fake, options: &FlashOptions) -> Vec<Value> {
    let mut lines = Vec::new();
    let mut session = Session::new(fake, node(), Timing::default());
    let _ = flash(&mut session, file(), options, &mut |event| {
        let line = serde_json::to_string(&event.line(node())).unwrap();
        assert!(!line.contains('\n'), "{line}");
        lines.push(serde_json::from_str(&line).unwrap());
    });
    lines
}

/// The kind of each line, with its phase or note; progress once.
fn course(lines: &[Value]) -> Vec<String> {
    let mut course: Vec<String> = Vec::new();
    for line in lines {
        let kind = line["event"].as_str().unwrap();
        let detail = line.get(kind).and_then(Value::as_str).map_or(String::new(), |word| format!(" {word}"));
        course.push(format!("{kind}{detail}"));
    }
    course.dedup();
    course
}

#[test]
fn an_update_tells_its_course_and_ends_with_done() {
    let mut fake = Fake::new(APPLICATION);
    let lines = lines(&mut fake, &FlashOptions::default());
    assert_eq!(
        course(&lines).join(", "),
        "found, phase calling_back, phase in_bootloader, note dialect, phase erasing, phase erased, progress, \
         phase verified, phase trial_starting, phase trial_passed, phase released, phase starting, phase started, done"
    );
    for line in &lines {
        assert_eq!(line["node"], NODE, "{line}");
        assert!(line["text"].as_str().is_some_and(|text| !text.is_empty()), "{line}");
    }
    // The program is 4001 bytes (see procedure.rs), the file has 6 blocks more than that in framing.
    let total = data!("identity-110.blk").len();
    let last = lines.iter().rfind(|line| line["event"] == "progress").unwrap();
    assert_eq!((&last["done"], &last["total"]), (&json!(total), &json!(total)));
    let done = lines.last().unwrap();
    assert_eq!((&done["state"], &done["error"]), (&json!("released"), &Value::Null));
    assert_eq!(done["report"]["size"], 4001);
    assert_eq!(done["report"]["running"], APPLICATION);
}

#[test]
fn an_update_that_fails_tells_retries_and_ends_with_done_too() {
    let mut fake = Fake::new(BOOTLOADER);
    // 1F57h reads 06h, a wrong CRC, after each attempt at block 2.
    fake.on_block = Box::new(|block| if block == 2 { Outcome::Status(0x06) } else { Outcome::Accept });
    let lines = lines(&mut fake, &FlashOptions::default().repeats(2));
    let retries: Vec<&Value> = lines.iter().filter(|line| line["event"] == "retry").collect();
    assert_eq!(retries.len(), 2);
    for (line, repeat) in retries.into_iter().zip(1..) {
        assert_eq!((&line["block"], &line["repeat"], &line["of"]), (&json!(2), &json!(repeat), &json!(2)));
        assert_eq!((&line["reason"], &line["abort"]), (&json!("crc"), &Value::Null));
    }
    let done = lines.last().unwrap();
    assert_eq!((&done["event"], &done["state"]), (&json!("done"), &json!("erased")));
    assert_eq!(done["report"], Value::Null);
    // Table 5 of the manual: a wrong CRC of a block.
    assert_eq!(done["error"]["number"], "0x60000003");
    assert!(done["error"]["what"].as_str().unwrap().contains("block 2"), "{done}");
    assert!(!done["error"]["advice"].as_str().unwrap().is_empty());
}

/// The event has this form, and its line the node and the text, too; the names are those on which a
/// program may rely.
#[track_caller]
fn has_form(kind: &str, name: &str, event: &Event, data: &Value) {
    let mut form = json!({ "event": kind });
    if !name.is_empty() {
        form[kind] = name.into();
    }
    form.as_object_mut().unwrap().extend(data.as_object().unwrap().clone());
    assert_eq!(json!(event), form, "{event}");
    form["node"] = NODE.into();
    form["text"] = event.to_string().into();
    assert_eq!(json!(event.line(node())), form, "{event}");
}

const TOOK: Duration = Duration::from_micros(1_234_567);

#[test]
fn the_names_of_the_course_stay() {
    let application = DeviceType(0x0002_0192);
    let program = || json!({ "device_type": 131_474, "bootloader": false });
    let renewing = Phase::Renewing { number: 2, from: 1, to: 65_536 };
    let plain = [
        ("found", Event::Found(application), program()),
        ("progress", Event::Progress { done: 3, total: 9 }, json!({ "done": 3, "total": 9 })),
        (
            "retry",
            Event::Retry(Retry::block(2, 1, 3, RepeatReason::Broken(AbortCode(0x0504_0001)))),
            json!({ "block": 2, "repeat": 1, "of": 3, "reason": "broken", "abort": 84_148_225 }),
        ),
        (
            "retry",
            Event::Retry(Retry::program(1, 3, RepeatReason::NoAnswer)),
            json!({ "block": null, "repeat": 1, "of": 3, "reason": "no_answer", "abort": null }),
        ),
    ];
    let phases = [
        ("searching", Phase::Searching { reason: "why".into() }, json!({ "reason": "why" })),
        ("calling_back", Phase::CallingBack, json!({})),
        ("in_bootloader", Phase::InBootloader, json!({})),
        ("erasing", Phase::Erasing, json!({})),
        (
            "erased",
            Phase::Erased { took: TOOK, postponed: Some(true) },
            json!({ "seconds": 1.235, "postponed": true }),
        ),
        ("verified", Phase::Verified { crc: 7 }, json!({ "crc": 7 })),
        ("trial_starting", Phase::TrialStarting, json!({})),
        ("trial_passed", Phase::TrialPassed(application), program()),
        ("released", Phase::Released, json!({})),
        ("renewing", renewing, json!({ "number": 2, "from": 1, "to": 65_536 })),
        ("staged", Phase::Staged, json!({})),
        ("on_trial", Phase::OnTrial, json!({})),
        ("installed", Phase::Installed { version: 65_536 }, json!({ "version": 65_536 })),
        ("starting", Phase::Starting, json!({})),
        ("started", Phase::Started(application), program()),
        ("verified_again", Phase::VerifiedAgain { crc: 7 }, json!({ "crc": 7 })),
    ];
    plain.iter().for_each(|(kind, event, data)| has_form(kind, "", event, data));
    phases.into_iter().for_each(|(name, phase, data)| has_form("phase", name, &phase.into(), &data));
}

#[test]
fn the_names_of_the_notes_and_warnings_stay() {
    let of = |number| NodeId::new(number).unwrap();
    let target = Target { vendor_id: 63, product_code: 2 };
    let silence = Silence { doing: Doing::Restart, silent: TOOK, limit: TOOK };
    let silent = json!({ "doing": "restarting the program", "seconds": 1.235, "limit_seconds": 1.235 });
    let losses = Losses { refused: 9, lost: 2, restarts: 1 };
    let notes = [
        ("target_right", Note::TargetRight(target), json!({ "vendor_id": 63, "product_code": 2 })),
        ("dialect", Note::Dialect { dialect: Dialect::EsAcademy }, json!({ "dialect": "esacademy" })),
        ("other_crc", Note::OtherCrc { crc: Checksum::Crc16 }, json!({ "crc": "CRC-16" })),
        ("unlocked", Note::Unlocked, json!({})),
        ("moved", Note::Moved { node: of(126) }, json!({ "to": 126 })),
        ("master_taken", Note::MasterTaken { node: of(3) }, json!({ "master": 3 })),
        ("master_back", Note::MasterBack { node: of(3) }, json!({ "master": 3 })),
    ];
    let warnings = [
        ("master_kept", Warning::MasterKept { node: of(3) }, json!({ "master": 3 })),
        ("master_missing", Warning::MasterMissing, json!({})),
        ("covers_staging", Warning::CoversStaging { first: 0x080E_0000 }, json!({ "first": "0x080e0000" })),
        ("silent", Warning::Silent(silence), silent),
        ("adapter", Warning::Adapter(losses), json!({ "refused": 9, "lost": 2, "restarts": 1 })),
    ];
    notes.into_iter().for_each(|(name, note, data)| has_form("note", name, &note.into(), &data));
    warnings.into_iter().for_each(|(name, warning, data)| has_form("warning", name, &warning.into(), &data));
}

#[test]
fn a_problem_has_its_number_as_the_messages_have_it() {
    let problem = Problem::of(&Error::NoPassword { node: node() });
    let form = json!(problem);
    assert_eq!(form["number"], "0x60000018");
    assert_eq!(form["what"], problem.what.as_str());
}
