//! Devices of other manufacturers, each played from its document: the frames that they receive,
//! byte for byte, and the results.

use std::sync::Arc;

use canopen::NodeId;
use coboot_can::Adapter;
use coflash_core::device::{recognise, Dialect, Doing, Session, Timing, Transfers};
use coflash_core::file::block_file;
use coflash_core::file::convert::{program_of, Options};
use coflash_core::file::ihex;
use coflash_core::file::read::{read, Format};
use coflash_core::file::Target;
use coflash_core::update::dialect::{self, read_locked};
use coflash_core::update::event::{Note, Phase};
use coflash_core::update::many::{flash_many, Job, ManyOptions};
use coflash_core::update::{flash, DeviceState, Event, FlashOptions, Password, Report};
use coflash_core::Error;
use embedded_can::Frame as _;

use super::{file, left};
use kit::fake::lift::{Kept, Lift, LIFT, NOT_NOW, NO_OBJECT, PHRASE, RANGE};
use kit::fake::{Blocks, Bus, Deed, Fake, Maker, APPLICATION, BOOTLOADER, NODE};

/// "BOOT" (ESAcademy), and what older lift bootloaders have.
const BOOT: u32 = 0x424F_4F54;

fn node(id: u8) -> NodeId {
    NodeId::new(id).unwrap()
}

fn run_at(
    adapter: &mut dyn Adapter,
    at: u8,
    options: &FlashOptions,
) -> (Result<Report, Error>, Vec<Event>, u8) {
    let mut session = Session::new(adapter, node(at), Timing::default());
    let mut events = Vec::new();
    let result = flash(&mut session, file(), options, &mut |event| {
        if !matches!(event, Event::Progress { .. }) {
            events.push(event);
        }
    });
    (result, events, session.node().get())
}

fn locked(phrase: &str) -> FlashOptions {
    FlashOptions::default().unlock(Password::new(phrase))
}

// --- CiA 417

#[test]
fn a_lift_is_unlocked_twice_moves_to_node_126_and_back() {
    let (mut fake, kept) = Lift::fake(APPLICATION, |_| {});
    let (result, events, at) = run_at(&mut fake, NODE, &locked(PHRASE));
    let report = result.unwrap();
    assert_eq!((report.dialect, at), (Dialect::Lift, NODE));
    assert_eq!(report.running.unwrap().0, APPLICATION);
    let image = file().flash_image().into_owned();
    assert_eq!(*kept.lock().unwrap(), image, "the image from the program's start");
    let program = format!("126: 1F50/1, {} bytes", image.len());
    assert_eq!(
        fake.writes(),
        [
            "5: 6005/1, 11 bytes",
            "5: 1F51/1, 1 bytes",
            "126: 6005/1, 11 bytes",
            &program,
            "126: 1F51/1, 1 bytes"
        ]
    );
    assert!(
        events.contains(&Note::Moved { node: node(126) }.into()) && !events.contains(&Phase::Released.into()),
        "{events:?}"
    );
    // "Reset program", byte for byte.
    let reset = [0x2F, 0x51, 0x1F, 1, 2, 0, 0, 0];
    assert_eq!(fake.sent.iter().filter(|frame| frame.data() == reset).count(), 2);
}

#[test]
fn a_lift_that_moves_refuses() {
    let (mut fake, _) = Lift::fake(APPLICATION, |lift| lift.refuses = true);
    let error = run_at(&mut fake, NODE, &locked(PHRASE)).0.unwrap_err();
    assert_eq!(error.number(), 0x6000_0010);
    assert!(error.advice().to_string().starts_with("the application refuses now"), "{error}");
}

#[test]
fn other_lifts_are_understood_too() {
    // The older device type; a plain 6005h; no 1F51h; blocks; started in the bootloader.
    let changes: [&dyn Fn(&mut Lift); 4] =
        [&|lift| lift.bootloader = BOOT, &|lift| lift.sub = 0, &|lift| lift.has_control = false, &|lift| {
            (lift.bootloader, lift.sub) = (BOOT, 0)
        }];
    for (case, change) in changes.into_iter().enumerate() {
        for running in [APPLICATION, if case % 3 == 0 { BOOT } else { LIFT }] {
            let (mut fake, kept) = Lift::fake(running, |lift| change(lift));
            fake.knows_blocks = Blocks::Known(127);
            let from = fake.node;
            let (result, _, at) = run_at(&mut fake, from, &locked(PHRASE));
            let report = result.unwrap_or_else(|error| panic!("{case}, {running:X}: {error}"));
            assert_eq!((report.dialect, at, report.transfers), (Dialect::Lift, NODE, Transfers::Blocks));
            assert_eq!(*kept.lock().unwrap(), *file().flash_image());
        }
    }
}

#[test]
fn a_lift_that_refuses_is_left_as_it_was_found() {
    let (mut fake, _) = Lift::fake(APPLICATION, |_| {});
    let (result, events, _) = run_at(&mut fake, NODE, &locked("wrong"));
    let error = result.unwrap_err();
    assert!(matches!(error, Error::Refused { doing: Doing::Unlock, .. }), "{error}");
    assert!(error.advice().to_string().contains("password"), "{}", error.advice());
    assert_eq!(left(&events), DeviceState::Untouched);

    let (mut fake, _) = Lift::fake(APPLICATION, |_| {});
    let (result, events, _) = run_at(&mut fake, NODE, &FlashOptions::default());
    assert!(matches!(result, Err(Error::NoPassword { .. })));
    assert_eq!((left(&events), fake.writes().len()), (DeviceState::Untouched, 0));

    // Another device is already in its bootloader.
    let (fake, _) = Lift::fake(APPLICATION, |_| {});
    let (other, _) = Lift::fake(LIFT, |_| {});
    let mut bus = Bus(vec![fake, other]);
    let (result, _, _) = run_at(&mut bus, NODE, &locked(PHRASE));
    assert!(matches!(result, Err(Error::Occupied { .. })), "{result:?}");
    assert!(bus.0.iter().all(|fake| fake.writes().is_empty()));

    // The file is for another device.
    let (mut fake, kept) = Lift::fake(APPLICATION, |lift| lift.takes = false);
    let (result, _, _) = run_at(&mut fake, NODE, &locked(PHRASE));
    assert!(matches!(result, Err(Error::Refused { doing: Doing::Program, .. })), "{result:?}");
    assert!(kept.lock().unwrap().is_empty());

    // One that was recognised by 1018h is refused before anything.
    let (mut fake, _) = Lift::fake(APPLICATION, |_| {});
    let target = Some(Target { vendor_id: 1, product_code: 2 });
    let options = locked(PHRASE).check_target(target);
    assert!(matches!(run_at(&mut fake, NODE, &options).0, Err(Error::WrongTarget { .. })));
    assert!(fake.writes().is_empty());
}

#[test]
fn lifts_are_not_updated_together() {
    let (mut fake, _) = Lift::fake(APPLICATION, |_| {});
    // The second one is not there. A lift alone is followed to its other node-ID.
    let jobs = [NODE, NODE + 1].map(|id| Job::new(node(id), Arc::new(file()), locked(PHRASE)));
    let options = ManyOptions::default().transfers(Transfers::Segments).at_once(1);
    let results = flash_many(&mut fake, &jobs, &options, &|_, _| {});
    let failed = results.into_iter().next().unwrap().unwrap_err();
    assert!(matches!(failed.error, Error::NotInDialect { dialect: Dialect::Lift, .. }), "{}", failed.error);
    assert!(fake.writes().is_empty());
    assert!(flash_many(&mut fake, &jobs[..1], &options, &|_, _| {})[0].is_ok());
}

#[test]
fn a_lift_is_read_from_its_bootloader_and_restarted() {
    let at = canopen::Address::new(0x1F50, 1);
    for running in [APPLICATION, LIFT] {
        let (mut fake, _) = Lift::fake(running, |_| {});
        let from = fake.node;
        let mut session = Session::new(&mut fake, node(from), Timing::default());
        let read = read_locked(&mut session, at, None, Password::new(PHRASE), &mut |_| {}).unwrap();
        assert_eq!((&read[..], session.node().get()), (&b"what was stored"[..], from));
        // A device that was in its bootloader before stays there.
        let resets = fake.count("126: 1F51/1, 1 bytes");
        assert_eq!(resets, usize::from(running == APPLICATION));
    }
    let mut fake = Fake::new(BOOTLOADER);
    let mut session = Session::new(&mut fake, node(NODE), Timing::default());
    let refused = read_locked(&mut session, at, None, Password::new(PHRASE), &mut |_| {}).unwrap_err();
    assert!(matches!(refused, Error::NotInDialect { dialect: Dialect::Block, .. }), "{refused}");
    // Its password would erase the program to be read.
    let (mut fake, _) = EsAcademy::fake(|_| {});
    let mut session = Session::new(&mut fake, node(64), Timing::default());
    let refused = read_locked(&mut session, at, None, Password::new("INIT"), &mut |_| {}).unwrap_err();
    assert!(matches!(refused, Error::NotInDialect { dialect: Dialect::EsAcademy, .. }), "{refused}");
    assert!(fake.writes().is_empty());
}

// --- ESAcademy

/// The minimal boot loader that ESAcademy describes: no status, no CRC.
struct EsAcademy {
    kept: Kept,
    password: Option<[u8; 4]>,
    enabled: bool,
    /// The last flash operation has failed.
    failed: bool,
    fails: bool,
    runs_by_itself: bool,
}

impl EsAcademy {
    fn fake(change: impl FnOnce(&mut Self)) -> (Fake, Kept) {
        let kept = Kept::default();
        let mut device = Self {
            kept: kept.clone(),
            // 494E4954h, lowest byte first.
            password: Some([0x54, 0x49, 0x4E, 0x49]),
            enabled: false,
            failed: false,
            fails: false,
            runs_by_itself: true,
        };
        change(&mut device);
        device.enabled = device.password.is_none();
        let mut fake = Fake::new(BOOT);
        fake.node = 64;
        fake.maker = Some(Box::new(device));
        (fake, kept)
    }
}

impl Maker for EsAcademy {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        match at {
            (0x1F57, _) if running == APPLICATION => None,
            (0x1001, 0) => Some(Ok(vec![if self.failed { 0x81 } else { 0 }])),
            (0x1F56 | 0x1F57, _) => Some(Err(NO_OBJECT)),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], _: u32) -> Option<Result<Deed, u32>> {
        Some(match (at, self.password) {
            ((0x7F50, 1), Some(password)) if data == password => {
                self.kept.lock().unwrap().clear();
                self.enabled = true;
                Ok(Deed::Nothing)
            }
            ((0x7F50, 1), Some(_)) => Err(RANGE),
            ((0x1F50, 1), _) if !self.enabled => Err(NOT_NOW),
            ((0x1F50, 1), _) => {
                self.failed = self.fails;
                *self.kept.lock().unwrap() = data.to_vec();
                let starts = self.runs_by_itself && !self.failed;
                Ok(if starts { Deed::Restart(64, APPLICATION) } else { Deed::Nothing })
            }
            ((0x1F51, 1), _) if data == [2] => Ok(Deed::Restart(64, APPLICATION)),
            ((0x1F51, 1), _) if data == [0x80] => Ok(Deed::Restart(64, BOOT)),
            ((0x1F51, 1), _) => Err(RANGE),
            _ => Err(NO_OBJECT),
        })
    }
}

#[test]
fn esacademy_gets_the_password_and_then_intel_hex() {
    for (unlock, runs_by_itself) in [(None, true), (Some("INIT"), false), (Some("0x494E4954"), true)] {
        let (mut fake, kept) = EsAcademy::fake(|device| device.runs_by_itself = runs_by_itself);
        let options = FlashOptions::default().unlock(unlock.and_then(Password::new));
        let (result, events, _) = run_at(&mut fake, 64, &options);
        let report = result.unwrap();
        assert_eq!((report.dialect, report.running.unwrap().0), (Dialect::EsAcademy, APPLICATION));
        assert!(events.contains(&Note::Unlocked.into()), "{events:?}");
        let password = [0x23, 0x50, 0x7F, 1, 0x54, 0x49, 0x4E, 0x49];
        assert_eq!(fake.sent.iter().filter(|frame| frame.data() == password).count(), 1);
        let text = kept.lock().unwrap().clone();
        assert_eq!(text, ihex::emit(file().image()).into_bytes());
        // A program that already runs is not restarted.
        assert_eq!(fake.count("64: 1F51/1, 1 bytes"), usize::from(!runs_by_itself));
    }
    // The password is optional.
    let (mut fake, _) = EsAcademy::fake(|device| device.password = None);
    assert!(run_at(&mut fake, 64, &FlashOptions::default()).0.is_ok());
}

#[test]
fn esacademy_says_what_went_wrong_by_the_error_register_alone() {
    let (mut fake, _) = EsAcademy::fake(|device| device.fails = true);
    let (result, events, _) = run_at(&mut fake, 64, &FlashOptions::default());
    assert!(matches!(result, Err(Error::Failed { doing: Doing::Program, .. })), "{result:?}");
    assert_eq!(left(&events), DeviceState::Erased);

    for password in [[1, 2, 3, 4], [0x49, 0x4E, 0x49, 0x54]] {
        let (mut fake, _) = EsAcademy::fake(|device| device.password = Some(password));
        let (result, events, _) = run_at(&mut fake, 64, &FlashOptions::default());
        assert!(matches!(result, Err(Error::Refused { doing: Doing::Unlock, .. })), "{result:?}");
        assert_eq!(left(&events), DeviceState::Untouched);
    }
}

/// Where the dialect is named, no frame is sent; where the bootloader alone says it, the
/// application runs again.
#[test]
fn a_password_of_another_form_stops_no_application() {
    let all = [None, Some(Dialect::EsAcademy)];
    for (running, dialect) in all.into_iter().flat_map(|dialect| [(BOOT, dialect), (APPLICATION, dialect)]) {
        let (mut fake, _) = EsAcademy::fake(|_| {});
        fake.running = Some(running);
        let (result, ..) = run_at(&mut fake, 64, &locked("no number").dialect(dialect));
        assert!(matches!(result, Err(Error::NotInDialect { .. })), "{result:?}");
        let end = (fake.running, fake.sent.is_empty());
        assert_eq!(end, (Some(running), dialect.is_some()), "{:?}", fake.log);
        assert_eq!(fake.count("64: 7F50/1, 4 bytes"), 0);
    }
    // A lift without a password, also where it is only read.
    let (mut fake, _) = Lift::fake(APPLICATION, |_| {});
    let lift = Some(Dialect::Lift);
    let result = run_at(&mut fake, NODE, &FlashOptions::default().dialect(lift)).0;
    assert!(matches!(result, Err(Error::NoPassword { .. })));
    let mut session = Session::new(&mut fake, node(NODE), Timing::default());
    let read = read_locked(&mut session, canopen::Address::new(0x1F50, 1), lift, None, &mut |_| {});
    assert!(read.is_err() && fake.sent.is_empty());
}

// --- CiA 302-3

/// A device that only supports CiA 302-3. Its device type is that of its profile in both states;
/// 1F51h shows what runs.
struct Standard {
    kept: Kept,
    /// 0 stopped, 1 started.
    state: u8,
    cleared: bool,
    stops: bool,
}

impl Standard {
    fn fake(state: u8) -> (Fake, Kept) {
        let kept = Kept::default();
        let device = Self { kept: kept.clone(), state, cleared: false, stops: true };
        let mut fake = Fake::new(APPLICATION);
        fake.maker = Some(Box::new(device));
        (fake, kept)
    }
}

impl Maker for Standard {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        match at {
            (0x1F51, 1) => Some(Ok(vec![self.state])),
            (0x1F56 | 0x1F57, _) => Some(Err(NO_OBJECT)),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], _: u32) -> Option<Result<Deed, u32>> {
        Some(match (at, data) {
            ((0x1F51, 1), [0]) if self.stops => {
                self.state = 0;
                Ok(Deed::Nothing)
            }
            ((0x1F51, 1), [1]) if !self.kept.lock().unwrap().is_empty() => {
                self.state = 1;
                Ok(Deed::Nothing)
            }
            ((0x1F51, 1), [3]) if self.state == 0 => {
                self.cleared = true;
                Ok(Deed::Nothing)
            }
            ((0x1F50, 1), data) if self.cleared => {
                *self.kept.lock().unwrap() = data.to_vec();
                Ok(Deed::Nothing)
            }
            ((0x1F51, 1), _) => Err(RANGE),
            ((0x1F50, 1), _) => Err(NOT_NOW),
            _ => Err(NO_OBJECT),
        })
    }
}

#[test]
fn a_standard_device_is_stopped_cleared_written_and_started() {
    for state in [0, 1] {
        for (dialect, content) in [
            (None, file().flash_image().into_owned()),
            (Some(Dialect::Raw), file().flash_image().into_owned()),
            (Some(Dialect::Hex), ihex::emit(file().image()).into_bytes()),
        ] {
            let (mut fake, kept) = Standard::fake(state);
            let options = FlashOptions::default().dialect(dialect);
            let (result, ..) = run_at(&mut fake, NODE, &options);
            let report = result.unwrap();
            assert_eq!(report.dialect, dialect.unwrap_or(Dialect::Raw));
            assert_eq!(*kept.lock().unwrap(), content);
            let commands: Vec<u8> = fake
                .sent
                .iter()
                .filter(|frame| frame.data()[..4] == [0x2F, 0x51, 0x1F, 1])
                .map(|frame| frame.data()[4])
                .collect();
            let expected: &[u8] = if state == 1 { &[0, 3, 1] } else { &[3, 1] };
            assert_eq!(commands, expected);
        }
    }
}

// --- recognition

#[test]
fn each_is_recognised_by_what_its_document_says() {
    let found = |fake: &mut Fake| {
        let at = node(fake.node);
        let mut session = Session::new(&mut *fake, at, Timing::default());
        let running = session.device_type().unwrap().unwrap();
        let dialect = recognise(&mut session, running, 1).unwrap();
        assert!(fake.writes().is_empty());
        dialect
    };
    assert_eq!(found(&mut Fake::new(BOOTLOADER)), Dialect::Block);
    assert_eq!(found(&mut Fake::new(APPLICATION)), Dialect::Block);
    assert_eq!(found(&mut Lift::fake(APPLICATION, |_| {}).0), Dialect::Lift);
    assert_eq!(found(&mut Lift::fake(APPLICATION, |lift| lift.sub = 0).0), Dialect::Lift);
    assert_eq!(found(&mut Lift::fake(LIFT, |_| {}).0), Dialect::Lift);
    assert_eq!(found(&mut Lift::fake(BOOT, |lift| lift.bootloader = BOOT).0), Dialect::Lift);
    assert_eq!(found(&mut EsAcademy::fake(|_| {}).0), Dialect::EsAcademy);
    assert_eq!(found(&mut Standard::fake(1).0), Dialect::Raw);
}

#[test]
fn passwords_are_texts_or_numbers() {
    let number = |text: &str| Password::new(text).unwrap().number();
    assert_eq!(number("INIT"), Some(dialect::ESACADEMY_PASSWORD));
    assert_eq!(number("0x494E4954"), Some(0x494E_4954));
    assert_eq!(number("0X1"), Some(1));
    for text in ["INI", "INITS", "0x1234567890", "0xG1234", "0x+12"] {
        assert_eq!(number(text), None, "{text}");
    }
    assert!(Password::new("").is_none() && Password::new(&"x".repeat(65)).is_none());
    assert_eq!(format!("{:?}", Password::new("secret").unwrap()), "Password(…)");
}

/// The data record is the one that descriptions of the format show everywhere.
#[test]
fn intel_hex_is_written_as_its_description_has_it() {
    let text = "\
:10010000214601360121470136007EFE09D2190140
:100110002146017E17C20001FF5F16002148011928
:00000001FF
";
    let firmware = read(text.as_bytes(), None, None).unwrap();
    let written = ihex::emit(program_of(firmware, &Options::default()).unwrap().program.image());
    let lines: Vec<&str> = written.lines().collect();
    assert_eq!(lines[0], ":020000040000FA");
    assert_eq!(lines[1..].join("\n") + "\n", text);
    // Over a border of 64 KiB, from an odd address; two pieces far apart.
    let mut image = vec![0xA5; 70_003];
    image[0] = 1;
    for start in [0x0800_8001_u32, 0x0801_FFF0] {
        let firmware = read(&image, Some(Format::Raw), Some(start)).unwrap();
        let blocks = program_of(firmware, &Options::default()).unwrap().program;
        let again = read(ihex::emit(blocks.image()).as_bytes(), None, None).unwrap();
        assert_eq!(
            block_file::emit(&program_of(again, &Options::default()).unwrap().program),
            block_file::emit(&blocks)
        );
    }
}
