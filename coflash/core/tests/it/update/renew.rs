//! The renewal of a bootloader against a fake device, (`kit::fake::renewal`).

use std::sync::{Arc, Mutex};
use std::time::Duration;

use canopen::{Frame, NodeId};
use coboot_can::{Adapter, AdapterError, Losses};
use coflash_core::device::info::info;
use coflash_core::device::scan::ScanOptions;
use coflash_core::device::{Session, Timing};
use coflash_core::file::ram_image::RamImage;
use coflash_core::file::raw;
use coflash_core::update::event::{Phase, Warning};
use coflash_core::update::many::{flash_many, Job, ManyOptions};
use coflash_core::update::{flash, DeviceState, Event, FlashOptions, Payload, Renewal};
use coflash_core::Error;
use shared_abi::ram_image::Version;

use super::update;
use kit::fake::renewal::*;
use kit::fake::{Bus, Fake, APPLICATION, BOOTLOADER, NODE};

pub fn new() -> Payload {
    let image = raw::read(&image(NEW), Some(0x0801_0000)).unwrap();
    RamImage::find(&image).unwrap().into()
}

fn run_with(fake: &mut Fake, options: &FlashOptions) -> (Result<Renewal, Error>, Vec<Event>) {
    let was = fake.running;
    let (result, mut events) = update(fake, new(), options);
    // One that was in its bootloader was not called, and a new bootloader is told at the end.
    let Some(Event::Done(done)) = events.last() else { panic!("{events:?}") };
    match &result {
        Ok(report) if report.renewal.unwrap().unchanged => {
            assert_eq!(done.left.state, DeviceState::Untouched);
        }
        Ok(_) => assert_eq!(done.left.state, DeviceState::Renewed),
        Err(_) if was == Some(BOOTLOADER) => assert_eq!(done.left.state, DeviceState::Untouched),
        Err(_) => {}
    }
    events.retain(|event| !matches!(event, Event::Progress { .. } | Event::Done(_)));
    (result.map(|report| report.renewal.unwrap()), events)
}

fn run(fake: &mut Fake) -> (Result<Renewal, Error>, Vec<Event>) {
    run_with(fake, &FlashOptions::default())
}

/// What was written to the bootloader's sub-index.
fn written(log: &Log) -> Vec<String> {
    std::mem::take(&mut log.lock().unwrap())
}

/// The writes of a whole renewal.
const WHOLE: [&str; 4] = ["03", "320 bytes", "01", "83"];

#[test]
fn a_bootloader_is_staged_tried_confirmed_and_installed() {
    let (mut fake, log) = device(BOOTLOADER, |_| {});
    let (result, events) = run(&mut fake);
    let renewal = result.unwrap();
    let Renewal { number, from, to, unchanged, running, .. } = renewal;
    assert_eq!((number, from, to, unchanged, running), (2, Version(OLD), Version(NEW), false, None));
    assert!(renewal.to_string().ends_with("bootloader 1.2 -> 1.3, installed"), "{renewal}");
    assert_eq!(written(&log), WHOLE);
    // The program was not started: it did not run before.
    assert_eq!(fake.count("command 01"), 0);
    assert!(matches!(
        events[..],
        [
            Event::Found(_),
            Event::Phase(Phase::Renewing { number: 2, from: OLD, to: NEW }),
            Event::Phase(Phase::Staged),
            Event::Phase(Phase::OnTrial),
            Event::Phase(Phase::Installed { version: NEW }),
        ]
    ));
    // The same again writes nothing, also while the image runs that was on trial.
    assert!(run(&mut fake).0.unwrap().unchanged);
    assert_eq!(written(&log), [] as [&str; 0]);
}

#[test]
fn a_program_that_ran_runs_again() {
    for trial in [Trial::Works, Trial::Ends([1, 0])] {
        let (mut fake, _) = device(APPLICATION, |board| board.trial = trial);
        let (result, events) = run(&mut fake);
        assert_eq!(result.is_ok(), matches!(trial, Trial::Works));
        assert_eq!(fake.writes().iter().filter(|entry| *entry == &"command 01").count(), 1);
        assert_eq!(fake.running, Some(APPLICATION));
        let started = events.iter().any(|event| matches!(event, Event::Phase(Phase::Started(_))));
        assert_eq!(started, result.is_ok());
    }
}

/// Each end of a trial, and how it is called.
#[test]
fn the_end_of_a_trial_is_told_in_words() {
    for (end, words) in [
        ([1, 0], "was not confirmed in time"),
        ([2, 0], "was given up by a master"),
        ([3, 4], "ended by a reset: the independent watchdog"),
        ([4, 1], "could not be loaded: its header is wrong"),
        ([4, 2], "could not be loaded: it needs a newer resident part, or another ability of it"),
        ([4, 3], "could not be loaded: its CRC is wrong"),
    ] {
        let (mut fake, log) = device(BOOTLOADER, |board| board.trial = Trial::Ends(end));
        let error = run(&mut fake).0.unwrap_err();
        assert_eq!(error.to_string(), format!("the new bootloader of node 5 {words}; the old one runs"));
        assert_eq!(error.number(), 0x6000_0014);
        assert!(error.advice().to_string().contains("nothing is lost"), "{}", error.advice());
        assert_eq!(written(&log), &WHOLE[..3], "83h is not written to the old one");
    }
}

/// A device that falls silent with the first data, when its adapter has lost a frame.
struct Dying(Fake, Losses);

impl Adapter for Dying {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        if frame.exactly::<8>().is_some_and(|sent| sent[1..4] == [0x50, 0x1F, 2]) {
            (self.0.running, self.1.lost) = (None, 1);
        }
        self.0.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        self.0.receive(timeout)
    }

    fn now(&self) -> Duration {
        self.0.now()
    }

    fn losses(&self) -> Losses {
        self.1
    }
}

/// A frame that was lost before the trial says nothing of it.
#[test]
fn a_device_that_dies_before_its_trial_has_had_none() {
    let mut dying = Dying(device(BOOTLOADER, |_| {}).0, Losses::default());
    let (result, _) = update(&mut dying, new(), &FlashOptions::default());
    assert_eq!(dying.1.lost, 1);
    assert!(matches!(result, Err(Error::NoAnswer { .. })), "{result:?}");
}

/// An image that nobody reaches ends after a minute; the tool waits for the old one, and says so.
#[test]
fn a_deaf_image_is_waited_for() {
    let (mut fake, _) =
        device(BOOTLOADER, |board| board.trial = Trial::Deaf(Duration::from_secs(61), [1, 0]));
    let (result, events) = run(&mut fake);
    assert!(matches!(result, Err(Error::RenewalFailed { .. })), "{result:?}");
    assert!(events.iter().any(|event| matches!(event, Event::Warning(Warning::Silent { .. }))), "{events:?}");
}

/// A product may have a longer time, up to an hour, and no object has it: the tool ends its wait, and says
/// how the device gets its old bootloader back. With the longer time it waits.
#[test]
fn a_trial_of_a_longer_time_than_usual_is_no_endless_wait() {
    let minutes = Duration::from_secs(600);
    let deaf = || device(APPLICATION, |board| board.trial = Trial::Deaf(minutes, [1, 0])).0;
    let mut fake = deaf();
    let began = fake.now;
    let (result, events) = run(&mut fake);
    let error = result.unwrap_err();
    assert!(fake.now - began < Duration::from_secs(90));
    let words = "the new bootloader of node 5 was started on trial, and nothing has answered for 75 s";
    assert_eq!(error.to_string(), words);
    assert_eq!(error.number(), 0x6000_0014);
    for words in ["nothing is lost", "switched off and on", "--boot-timeout"] {
        assert!(error.advice().to_string().contains(words), "{}", error.advice());
    }
    assert!(!events.iter().any(|event| matches!(event, Event::Phase(Phase::Starting))), "{events:?}");
    assert_eq!(fake.count("command 01"), 0, "nobody hears it");

    let mut fake = deaf();
    let timing = Timing::default().boot(Duration::from_secs(615));
    let mut session = Session::new(&mut fake, NodeId::new(NODE).unwrap(), timing);
    let result = flash(&mut session, new(), &FlashOptions::default(), &mut |_| {});
    assert!(matches!(result, Err(Error::RenewalFailed { .. })), "{result:?}");
    assert_eq!(fake.running, Some(APPLICATION), "the program runs again");
}

/// A refusal of the device, before it erases anything: its words and what to do.
#[test]
fn a_refusal_says_what_to_do() {
    for (code, status, words, advice) in [
        (NOT_NOW, 1 << 16 | 0x08, "program 1 reaches into the flash", "coflash erase --program 1"),
        (NOT_STORED, 0x04, "writing the bootloader", "another board"),
        (NOT_NOW, 4 << 16 | 0x0E, "sector 4 of the flash is write-protected", "debug probe"),
        (NOT_NOW, 1 << 16 | 0x84, "the supply of the device is too low", "supply"),
    ] {
        let (mut fake, log) = device(BOOTLOADER, |board| board.refuses = Some((code, status)));
        let error = run(&mut fake).0.unwrap_err();
        assert!(error.to_string().contains(words), "{status:X}: {error}");
        assert!(error.advice().to_string().contains(advice), "{status:X}: {}", error.advice());
        assert_eq!(written(&log), &WHOLE[..2], "{status:X}");
    }
    // Busy may pass. A transfer that broke off (05040000h: time-out) leaves data of another form.
    for refusal in [(NOT_NOW, 0x86), (0x0504_0000, 0x04)] {
        let (mut fake, log) = device(BOOTLOADER, |board| board.refuses = Some(refusal));
        assert!(run_with(&mut fake, &FlashOptions::default().repeats(1)).0.is_err());
        assert_eq!(written(&log), ["03", "320 bytes", "03", "320 bytes"], "{refusal:X?}");
    }
}

#[test]
fn a_device_without_renewal_is_left_alone() {
    for number in [None, Some(0)] {
        let (mut fake, log) = device(BOOTLOADER, |board| board.number = number);
        let error = run(&mut fake).0.unwrap_err();
        assert_eq!(error.to_string(), "the bootloader of node 5 cannot be renewed over the bus");
        assert!(error.advice().to_string().contains("debug probe"));
        assert_eq!((written(&log), fake.writes()), (vec![], vec![]));
    }
}

/// What an earlier renewal has left.
#[test]
fn a_renewal_goes_on_from_whatever_state() {
    let crc = word_of(&image(NEW), 4);
    let this = Some((NEW, crc));
    let other = Some((7, 8));
    let all = |state, origin, staging| {
        move |board: &mut Board| {
            (board.state, board.origin, board.staging) = (state, origin, staging);
            if state == INSTALLED {
                board.home = staging.unwrap();
            }
        }
    };
    let whole = WHOLE.to_vec();
    let again = |first: &'static str| [&[first][..], &WHOLE].concat();
    for (state, origin, staging, expected) in [
        (STAGED, HOME, this, whole.clone()),
        (INSTALLED, HOME, other, whole.clone()),
        // It is on trial: it gets the confirmation. Another one is given up first.
        (STAGED, TRIAL, this, vec!["83"]),
        (STAGED, TRIAL, other, again("84")),
        // It is installed, and runs from staging yet: a restart loads it from home.
        (INSTALLED, TRIAL, other, whole.clone()),
        // It is confirmed: first it is installed.
        (CONFIRMED, 2, this, vec!["83"]),
        (CONFIRMED, 2, other, again("83")),
    ] {
        let case = format!("{state} {origin} {staging:?}");
        let (mut fake, log) = device(BOOTLOADER, all(state, origin, staging));
        run(&mut fake).0.unwrap_or_else(|error| panic!("{case}: {error}"));
        assert_eq!(written(&log), expected, "{case}");
        let resets = fake.writes().iter().filter(|entry| entry.starts_with("nmt")).count();
        assert_eq!(resets, usize::from((state, origin) == (INSTALLED, TRIAL)), "{case}");
    }
    // An installation that goes on is waited for.
    let (mut fake, log) = device(BOOTLOADER, |board| {
        all(INSTALLED, 2, this)(board);
        board.busy = 20;
    });
    assert!(run(&mut fake).0.unwrap().unchanged);
    assert_eq!(written(&log), [] as [&str; 0]);
    // The user insists.
    let (mut fake, log) = device(BOOTLOADER, all(INSTALLED, HOME, this));
    assert!(!run_with(&mut fake, &FlashOptions::default().force(true)).0.unwrap().unchanged);
    assert_eq!(written(&log), whole);
}

/// 83h may be written twice, and is tried again after an installation that failed.
#[test]
fn an_installation_that_fails_says_so_and_can_be_tried_again() {
    let (mut fake, log) = device(BOOTLOADER, |board| board.fails = Some(1 << 16 | 0x84));
    let error = run(&mut fake).0.unwrap_err();
    assert!(error.to_string().contains("installing the bootloader"), "{error}");
    assert!(error.to_string().contains("supply"), "{error}");
    assert_eq!(written(&log), WHOLE);
    run(&mut fake).0.unwrap();
    assert_eq!(written(&log), ["83"]);
}

/// A new bootloader that takes no command without a password is not confirmed: a reset ends its trial.
#[test]
fn a_bootloader_that_takes_no_confirmation_is_given_up() {
    let (mut fake, log) = device(BOOTLOADER, |board| board.locked = true);
    let job = Job::new(NodeId::new(NODE).unwrap(), new(), FlashOptions::default());
    let results = flash_many(&mut fake, &[job], &ManyOptions::default(), &|_, _| {});
    let [Err(failed)] = &results[..] else { panic!("{results:?}") };
    let words = "installing the bootloader failed: programming is not allowed at present (1F57h reads 84h";
    assert!(failed.error.to_string().starts_with(words), "{}", failed.error);
    assert!(failed.left.to_string().starts_with("its bootloader is running; "), "{}", failed.left);
    assert_eq!(written(&log), [&WHOLE[..], &["84"]].concat());
    assert_eq!(fake.writes().iter().filter(|entry| entry.starts_with("nmt")).count(), 1);
}

/// One that is built without renewal would run until the next reset.
#[test]
fn a_bootloader_without_renewal_is_given_up() {
    let (mut fake, log) = device(BOOTLOADER, |board| board.trial = Trial::Without);
    let error = run(&mut fake).0.unwrap_err();
    assert!(error.to_string().contains("it is built without renewal"), "{error}");
    assert_eq!(written(&log), &WHOLE[..3]);
    assert_eq!(fake.writes().iter().filter(|entry| entry.starts_with("nmt")).count(), 1);
}

/// The bootloader is no program in `info`, and has a line of its own.
#[test]
fn info_shows_the_bootloader_and_its_renewal() {
    let late = "; another one waits for its trial; the last one on trial was not confirmed in time";
    for (state, origin, end, words) in [
        (NONE, HOME, [0, 0], ""),
        (STAGED, HOME, [0, 0], "; another one waits for its trial"),
        (STAGED, TRIAL, [0, 0], "; it is on trial: coflash flash with its file confirms it"),
        (STAGED, HOME, [1, 0], late),
        (CONFIRMED, 2, [0, 0], "; it is confirmed, and not installed yet"),
        (INSTALLED, TRIAL, [0, 0], "; a spare of it is in the flash of the last program"),
        (INSTALLED, HOME, [0, 0], "; a spare of it is in the flash of the last program"),
        (CONFIRMED, 3, [0, 0], "; its place was damaged, and is being repaired"),
        (INSTALLED, 3, [0, 0], "; its place was damaged, and is being repaired"),
    ] {
        let (mut fake, _) = device(BOOTLOADER, |board| {
            (board.state, board.origin, board.end) = (state, origin, end);
        });
        let mut session = Session::new(&mut fake, NodeId::new(NODE).unwrap(), Timing::default());
        let info = info(&mut session).unwrap();
        assert_eq!(info.programs.len(), 1);
        let bootloader = info.bootloader.unwrap();
        let line = format!("version 1.2, services 1, renewed as program 2{words}");
        assert_eq!(bootloader.to_string(), line);
        let json = serde_json::to_value(info).unwrap();
        let names = ["none", "staged", "confirmed", "installed"];
        assert_eq!(json["renewal"]["state"], names[usize::from(state)]);
        assert_eq!(json["renewal"]["version"], OLD);
        assert_eq!(json["bootloader"], true, "it runs");
        assert_eq!(json["programs"].as_array().unwrap().len(), 1);
    }
}

/// The first one is renewed before the others; if it fails, the others are not touched. If a later one
/// fails, the rest continue.
#[test]
fn of_several_devices_the_first_one_goes_first() {
    use Trial::{Ends, Works};
    let late = Ends([1, 0]);
    let (all, some) = ([WHOLE; 3].concat(), [&WHOLE[..], &WHOLE[..3], &WHOLE].concat());
    for (trials, good, expected) in [
        ([Works; 3], [true; 3], all),
        ([late, Works, Works], [false; 3], WHOLE[..3].to_vec()),
        ([Works, late, Works], [true, false, true], some),
    ] {
        let (mut bus, log) = devices(trials);
        let job = |node| Job::new(NodeId::new(node).unwrap(), new(), FlashOptions::default());
        let ends = Mutex::new(0);
        let results = flash_many(&mut bus, &[5, 6, 7].map(job), &ManyOptions::default(), &|_, event| {
            *ends.lock().unwrap() += u32::from(matches!(event, Event::Done(_)));
        });
        assert_eq!(results.iter().map(Result::is_ok).collect::<Vec<_>>(), good);
        assert_eq!(written(&log), expected);
        match &results[2] {
            Ok(report) => assert_eq!(report.renewal.unwrap().to, Version(NEW)),
            Err(failed) => {
                assert!(matches!(failed.error, Error::FirstFailed { .. }), "{failed:?}");
                assert_eq!(failed.left.state, DeviceState::Untouched);
                let words = "not renewed: the bootloader of node 5 was the first, and could not be renewed";
                assert_eq!(failed.error.to_string(), words);
            }
        }
    }
}

/// In a package for a machine: the plan says what is due, the run renews the first one before the others, and
/// then nothing is due. A bootloader on trial has to be confirmed.
#[test]
fn a_package_renews_bootloaders() {
    use coflash_core::machine::{make, plan, run, Entry, Package, Part, RunOptions};
    let entry = crate::machine::entry("bootloader", r#""nodes": [5, 6, 7]"#);
    let entry = Entry { program: 255, ..serde_json::from_str(&entry).unwrap() };
    let package = make(None, None, &[Part { entry, bytes: image(NEW) }], &[]).unwrap();
    let package = Package::parse(&package).unwrap();
    let due = |bus: &mut Bus| {
        let plan = plan(bus, &package, &ScanOptions::default(), &Arc::default()).unwrap();
        let updates = plan.updates();
        (plan, updates)
    };
    let outcome = |bus: &mut Bus| {
        let (plan, _) = due(bus);
        let outcomes = run(bus, &package, &plan, &RunOptions::default(), &|_, _, _| {});
        outcomes.iter().map(|outcome| outcome.result.is_ok()).collect::<Vec<_>>()
    };
    let (mut bus, log) = devices([Trial::Works; 3]);
    let (plan, updates) = due(&mut bus);
    // The halves of the version word, which are 0001_0002h and 0001_0003h.
    assert!(plan.to_string().contains("node 5: bootloader: 1.2 -> 1.3"), "{plan}");
    assert_eq!((updates, written(&log)), (3, vec![]));
    assert_eq!(outcome(&mut bus), [true; 3]);
    assert_eq!(written(&log), [WHOLE; 3].concat());
    assert_eq!((due(&mut bus).1, written(&log)), (0, vec![]));

    let (mut bus, log) = devices([Trial::Ends([1, 0]), Trial::Works, Trial::Works]);
    assert_eq!(outcome(&mut bus), [false; 3]);
    assert_eq!(written(&log), WHOLE[..3]);

    let (mut bus, _) = devices([Trial::Works; 3]);
    let staging = Some((NEW, word_of(&image(NEW), 4)));
    bus.0[0].maker =
        Some(Box::new(Board { state: STAGED, origin: TRIAL, staging, ..Board::new(&Log::default()) }));
    assert_eq!(due(&mut bus).1, 3);
}
