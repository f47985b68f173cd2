//! The renewal of a bootloader against a fake device, which is played from docs/protocol.md: 2007h/1, /8 and
//! /9, and the sub-index 2 of 1F50h to 1F57h.

use std::fs;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use canopen::NodeId;
use coflash::device::info::info;
use coflash::device::scan::ScanOptions;
use coflash::device::{Session, Timing};
use coflash::file::ram_image::RamImage;
use coflash::file::raw;
use coflash::update::event::{Phase, Warning};
use coflash::update::many::{flash_many, Job, ManyOptions};
use coflash::update::{renew, DeviceState, Event, FlashOptions, NewBootloader, Renewal};
use coflash::Error;
use serde_json::Value;
use shared_abi::ram_image::Version;

use crate::fake::{Bus, Deed, Fake, Maker, APPLICATION, BOOTLOADER, NODE};
use crate::tool::{coflash, folder, serve};

/// Abort codes (CiA 301 table 22).
const NO_OBJECT: u32 = 0x0602_0000;
const NOT_STORED: u32 = 0x0800_0020;
const NOT_NOW: u32 = 0x0800_0022;

/// The states in 2007h/9.
const NONE: u8 = 0;
const STAGED: u8 = 1;
const CONFIRMED: u8 = 2;
const INSTALLED: u8 = 3;
/// The origins in 2007h/9.
const HOME: u8 = 0;
const TRIAL: u8 = 1;

const OLD: u32 = 0x0001_0002;
const NEW: u32 = 0x0001_0003;
const OLD_CRC: u32 = 0x1234_5678;

/// A RAM image, typed from the table of its header; its CRC is that of the words after the CRC.
pub fn image(version: u32) -> Vec<u8> {
    let mut bytes = b"CBI2".to_vec();
    for word in [0, 64, 256, 0x2000_0000, 0x2001_FFC0, 1, 0, 7, 1, 2, 0, version, 0, 0, 0] {
        bytes.extend(u32::to_le_bytes(word));
    }
    bytes.extend(0..=255_u8);
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&bytes[8..]);
    bytes[4..8].copy_from_slice(&crc.to_le_bytes());
    bytes
}

fn word_of(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

fn new() -> NewBootloader {
    let image = raw::read(&image(NEW), Some(0x0801_0000)).unwrap();
    NewBootloader::Plain(Arc::new(RamImage::find(&image).unwrap()))
}

/// What becomes of the image on trial.
#[derive(Clone, Copy)]
enum Trial {
    /// It answers.
    Works,
    /// It answers, and knows nothing of a renewal.
    Without,
    /// The old one is back, with these bytes in 2007h/9.
    Ends([u8; 2]),
    /// Nobody hears it, and the old one is back after this time, with these bytes in 2007h/9.
    Deaf(Duration, [u8; 2]),
}

/// A device whose bootloader can be renewed.
struct Board {
    node: u8,
    /// 2007h/1; `None` if it has no such object.
    number: Option<u8>,
    state: u8,
    origin: u8,
    end: [u8; 2],
    home: (u32, u32),
    staging: Option<(u32, u32)>,
    trial: Trial,
    /// How many reads of 1F57h are busy.
    busy: u32,
    status: u32,
    /// How a download is refused: the abort code, and then 1F57h.
    refuses: Option<(u32, u32)>,
    /// How the installation fails: 1F57h.
    fails: Option<u32>,
    /// Whether the image on trial wants a password.
    locked: bool,
    log: Log,
}

/// The writes to the bootloader's own sub-index.
type Log = Arc<Mutex<Vec<String>>>;

impl Board {
    fn new(log: &Log) -> Self {
        Self {
            node: NODE,
            number: Some(2),
            state: NONE,
            origin: HOME,
            end: [0; 2],
            home: (OLD, OLD_CRC),
            staging: None,
            trial: Trial::Works,
            busy: 0,
            status: 0,
            refuses: None,
            fails: None,
            locked: false,
            log: log.clone(),
        }
    }

    /// Version and CRC of what runs.
    fn runs(&self) -> (u32, u32) {
        self.staging.filter(|_| self.origin != HOME).unwrap_or(self.home)
    }

    fn restart(&mut self, origin: u8, end: [u8; 2]) -> Deed {
        (self.origin, self.end) = (origin, end);
        Deed::Restart(self.node, BOOTLOADER)
    }

    fn command(&mut self, command: u8) -> Result<Deed, u32> {
        self.log.lock().unwrap().push(format!("{command:02X}"));
        if self.busy > 0 {
            self.status = 0x86;
            return Err(NOT_NOW);
        }
        self.status = 0;
        let on_trial = self.origin == TRIAL && self.state == STAGED;
        if self.locked && on_trial {
            self.status = 0x84;
            return Err(NOT_NOW);
        }
        Ok(match command {
            0x03 | 0x84 if on_trial => self.restart(HOME, [2, 0]),
            0x01 if self.state == STAGED && self.origin != TRIAL => match self.trial {
                Trial::Works | Trial::Without => self.restart(TRIAL, [0; 2]),
                Trial::Ends(end) => self.restart(HOME, end),
                Trial::Deaf(time, end) => {
                    self.end = end;
                    Deed::RestartIn(time, self.node, BOOTLOADER)
                }
            },
            0x83 if on_trial || self.state == CONFIRMED => {
                self.busy = 3;
                match self.fails.take() {
                    Some(status) => (self.state, self.status) = (CONFIRMED, status),
                    None => (self.state, self.home) = (INSTALLED, self.staging.unwrap()),
                }
                Deed::Nothing
            }
            0x01 => {
                self.status = 0x02;
                Deed::Nothing
            }
            _ => Deed::Nothing,
        })
    }

    fn download(&mut self, data: &[u8]) -> Result<Deed, u32> {
        self.log.lock().unwrap().push(format!("{} bytes", data.len()));
        if let Some((code, status)) = self.refuses {
            self.status = status;
            return Err(code);
        }
        assert_eq!(data, image(NEW), "the image alone, as it lies in flash");
        (self.state, self.staging) = (STAGED, Some((word_of(data, 48), word_of(data, 4))));
        Ok(Deed::Nothing)
    }
}

impl Maker for Board {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        if running != BOOTLOADER {
            return None;
        }
        let number = match at {
            (0x2007, 1) => return Some(self.number.map(|number| vec![number]).ok_or(NO_OBJECT)),
            _ => self.number?,
        };
        match at {
            (0x1F50 | 0x1F51 | 0x1F56 | 0x1F57, 0) => Some(Ok(vec![number])),
            (0x2007, 8) => Some(Ok((u64::from(self.runs().0) | 1 << 32).to_le_bytes().to_vec())),
            (0x2007, 9) if self.origin == TRIAL && matches!(self.trial, Trial::Without) => {
                Some(Err(NO_OBJECT))
            }
            (0x2007, 9) => Some(Ok([&[self.state, self.origin][..], &self.end].concat())),
            (0x1F51, 2) => Some(Ok(vec![1])),
            (0x1F56, 2) => Some(Ok(self.runs().1.to_le_bytes().to_vec())),
            (0x1F57, 2) if self.busy > 0 => {
                self.busy -= 1;
                Some(Ok(vec![1, 0, 0, 0]))
            }
            (0x1F57, 2) => Some(Ok(self.status.to_le_bytes().to_vec())),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], running: u32) -> Option<Result<Deed, u32>> {
        match at {
            (0x1F51, 2) if running == BOOTLOADER => Some(self.command(data[0])),
            (0x1F50, 2) if running == BOOTLOADER => Some(self.download(data)),
            _ => None,
        }
    }

    fn reset(&mut self, _: u32) -> Option<(u8, u32)> {
        self.origin = HOME;
        Some((self.node, BOOTLOADER))
    }
}

/// A device with this board; `change` changes it first.
fn device(running: u32, change: impl FnOnce(&mut Board)) -> (Fake, Log) {
    let log = Log::default();
    let mut board = Board::new(&log);
    change(&mut board);
    let mut fake = Fake::new(running);
    fake.maker = Some(Box::new(board));
    (fake, log)
}

fn run_with(fake: &mut Fake, options: &FlashOptions) -> (Result<Renewal, Error>, Vec<Event>) {
    let mut session = Session::new(fake, NodeId::new(NODE).unwrap(), Timing::default());
    let mut events = Vec::new();
    let result = renew(&mut session, &new(), options, &mut |event| {
        if !matches!(event, Event::Progress { .. }) {
            events.push(event);
        }
    });
    (result, events)
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
        assert_eq!(
            events.iter().any(|event| matches!(event, Event::Phase(Phase::Started(_)))),
            result.is_ok()
        );
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
        assert!(error.advice().contains("nothing is lost"), "{}", error.advice());
        assert_eq!(written(&log), &WHOLE[..3], "83h is not written to the old one");
    }
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
        assert!(error.advice().contains(words), "{}", error.advice());
    }
    assert!(!events.iter().any(|event| matches!(event, Event::Phase(Phase::Starting))), "{events:?}");
    assert_eq!(fake.count("command 01"), 0, "nobody hears it");

    let mut fake = deaf();
    let timing = Timing::default().boot(Duration::from_secs(615));
    let mut session = Session::new(&mut fake, NodeId::new(NODE).unwrap(), timing);
    let result = renew(&mut session, &new(), &FlashOptions::default(), &mut |_| {});
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
        assert!(error.advice().contains(advice), "{status:X}: {}", error.advice());
        assert_eq!(written(&log), &WHOLE[..2], "{status:X}");
    }
    // Busy may pass.
    let (mut fake, log) = device(BOOTLOADER, |board| board.refuses = Some((NOT_NOW, 0x86)));
    assert!(run_with(&mut fake, &FlashOptions::default().repeats(1)).0.is_err());
    assert_eq!(written(&log), ["03", "320 bytes", "03", "320 bytes"]);
    // A transfer that broke off (05040000h: time-out) leaves data that are not in the expected form.
    let (mut fake, log) = device(BOOTLOADER, |board| board.refuses = Some((0x0504_0000, 0x04)));
    assert!(run_with(&mut fake, &FlashOptions::default().repeats(1)).0.is_err());
    assert_eq!(written(&log), ["03", "320 bytes", "03", "320 bytes"]);
}

#[test]
fn a_device_without_renewal_is_left_alone() {
    for number in [None, Some(0)] {
        let (mut fake, log) = device(BOOTLOADER, |board| board.number = number);
        let error = run(&mut fake).0.unwrap_err();
        assert_eq!(error.to_string(), "the bootloader of node 5 cannot be renewed over the bus");
        assert!(error.advice().contains("debug probe"));
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
    for (state, origin, end, words) in [
        (NONE, HOME, [0, 0], ""),
        (STAGED, HOME, [0, 0], "; another one waits for its trial"),
        (STAGED, TRIAL, [0, 0], "; it is on trial: coflash flash with its file confirms it"),
        (
            STAGED,
            HOME,
            [1, 0],
            "; another one waits for its trial; the last one on trial was not confirmed in time",
        ),
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

/// Devices with these node-IDs and trials.
fn devices(trials: [Trial; 3]) -> (Bus, Log) {
    let log = Log::default();
    let device = |(node, trial): (u8, Trial)| {
        let board = Board { node, trial, ..Board::new(&log) };
        let mut fake = Fake::new(BOOTLOADER);
        fake.node = node;
        fake.maker = Some(Box::new(board));
        fake
    };
    (Bus([5, 6, 7].into_iter().zip(trials).map(device).collect()), log)
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
    use coflash::machine::{make, plan, run, Entry, Package, Part, RunOptions};
    let entry = Entry {
        name: "bootloader".to_owned(),
        file: String::new(),
        size: 0,
        sha256: String::new(),
        nodes: vec![5, 6, 7],
        identity: None,
        count: None,
        program: 255,
        dialect: None,
        trial_run: true,
        verify: false,
    };
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

/// The command line, over a socket.
#[test]
fn flash_knows_a_bootloader_by_its_header() {
    let folder = folder("renew");
    let file = folder.file("new.bin", &image(NEW));
    let report = folder.path("report.json");
    let (url, server) = serve(device(APPLICATION, |_| {}).0);
    let done = coflash(&["--bus", &url, "flash", &file, "--node", "5", "--report", &report]);
    assert_eq!(done.exit, 0, "{}{}", done.out, done.err);
    let crc = word_of(&image(NEW), 4);
    for words in [
        &format!("{file}: bootloader 1.3 of 320 bytes, CRC {crc:08X}h\n")[..],
        "  renewing the bootloader (program 2): version 1.2 -> 1.3; the program stays\n",
        "  installed: bootloader 1.3\n",
        "  running: an application",
        "s: bootloader 1.2 -> 1.3, installed\n",
    ] {
        assert!(done.out.contains(words), "{words} is not in\n{}", done.out);
    }
    assert_eq!(server.join().unwrap().running, Some(APPLICATION));
    let written: Value = serde_json::from_str(&fs::read_to_string(&report).unwrap()).unwrap();
    let renewal = &written["devices"][0]["report"]["renewal"];
    assert_eq!((&renewal["number"], &renewal["from"], &renewal["to"]), (&2.into(), &OLD.into(), &NEW.into()));

    let done = coflash(&["inspect", &file, "--start-address", "0x08010000"]);
    for words in ["  bootloader   version 1.3, 320 bytes, CRC ", "a bootloader: coflash flash renews that of"]
    {
        assert!(done.out.contains(words), "{words} is not in\n{}", done.out);
    }
    let done = coflash(&["inspect", &file, "--start-address", "0x08010000", "--json"]);
    let json: Value = serde_json::from_str(&done.out).unwrap();
    assert_eq!((&json["bootloader"]["version"], &json["fault"]), (&NEW.into(), &Value::Null));

    // By a job file, too.
    let job = folder.file("job.toml", b"image = 'new.bin'\n[[device]]\nnode = 5\n");
    let (url, server) = serve(device(BOOTLOADER, |_| {}).0);
    let done = coflash(&["--bus", &url, "flash", "--job", &job]);
    assert_eq!(done.exit, 0, "{}{}", done.out, done.err);
    assert!(done.out.ends_with("1 of 1 devices are done\n"), "{}", done.out);
    drop(server.join());
}

/// What is refused before a device is asked.
#[test]
fn flash_refuses_what_is_no_bootloader_for_a_device() {
    let folder = folder("renew-refused");
    let file = folder.file("new.bin", &image(NEW));
    for option in ["--no-trial", "--no-start"] {
        let done = coflash(&["--bus", "socketcand://127.0.0.1:1/can0", "flash", &file, option]);
        assert_eq!(done.exit, 2, "{}", done.err);
        assert!(
            done.err.contains("a new bootloader is tried before it replaces the old one"),
            "{}",
            done.err
        );
    }
    let mut bench = image(NEW);
    bench[4..8].fill(0);
    let bench = folder.file("bench.bin", &bench);
    let mut damaged = image(NEW);
    damaged[100] ^= 1;
    let damaged = folder.file("damaged.bin", &damaged);
    for (file, words) in [
        (bench, "it is a bootloader without a CRC: build it by `cargo xtask build`, which writes the CRC"),
        (damaged, "it is a damaged bootloader: its header has the CRC"),
    ] {
        let done = coflash(&["--bus", "socketcand://127.0.0.1:1/can0", "flash", &file]);
        assert_eq!(done.exit, 3, "{}", done.err);
        assert!(done.err.contains(words), "{}", done.err);
    }
}
