//! The report of a failed update about the device: the tool asks the device, in every dialect and
//! after every refusal. Also the detection of another tool that uses the device.

use std::time::Duration;

use canopen::{CobId, Frame};
use coboot_can::Adapter;
use coflash_core::device::error::Intruder;
use coflash_core::device::Dialect;
use coflash_core::update::event::Phase;
use coflash_core::update::{DeviceAfterUpdate, DeviceAnswer, DeviceState, Event, FlashOptions, Report};
use coflash_core::Error;

use super::{file, script, update};
use crate::tap::Tap;
use kit::fake::{Deed, Fake, Maker, Outcome, APPLICATION, BOOTLOADER, NODE};

const CLEAR: u8 = 0x03;
const CALL: u8 = 0x80;

fn run(adapter: &mut dyn Adapter, options: &FlashOptions) -> (Result<Report, Error>, Vec<Event>) {
    update(adapter, file(), options)
}

fn left(running: u32, change: &dyn Fn(&mut Fake), options: FlashOptions) -> DeviceAfterUpdate {
    let mut fake = Fake::new(running);
    change(&mut fake);
    let (result, events) = run(&mut fake, &options);
    assert!(result.is_err());
    match events.last() {
        Some(Event::Done(done)) => done.left,
        other => panic!("{other:?}"),
    }
}

fn on_command(command: u8, outcome: Outcome) -> impl Fn(&mut Fake) {
    move |fake| fake.on_command = script(command, usize::MAX, outcome)
}

fn dialect(dialect: Dialect) -> FlashOptions {
    FlashOptions::default().dialect(Some(dialect))
}

const STANDARD: [Dialect; 3] = [Dialect::Block, Dialect::Raw, Dialect::Hex];

#[test]
fn nobody_there_and_nothing_done() {
    let nobody = left(BOOTLOADER, &|fake| fake.running = None, FlashOptions::default());
    assert_eq!((nobody.state, nobody.answer), (DeviceState::Untouched, DeviceAnswer::NotAsked));
    assert_eq!(nobody.to_string(), "it was not changed");
    // A successful update reports no state.
    let (_, events) = run(&mut Fake::new(BOOTLOADER), &FlashOptions::default());
    assert!(events.iter().all(|event| event.left().is_none()));
}

/// An application that refuses or ignores the call continues.
#[test]
fn a_call_that_fails_has_changed_nothing() {
    for outcome in [Outcome::Abort(0x0602_0000), Outcome::Ignore] {
        let stays = left(APPLICATION, &on_command(CALL, outcome), FlashOptions::default());
        assert_eq!(stays.state, DeviceState::Untouched, "{outcome:?}");
        let words = stays.to_string();
        assert!(words.starts_with("its application is running; it was not changed"), "{words}");
    }
}

/// A refused CLEAR erases nothing.
#[test]
fn a_refusal_before_the_erasure_leaves_the_old_program() {
    for kind in STANDARD {
        for outcome in [Outcome::Abort(0x0800_0022), Outcome::AbortStatus(0x0800_0020, 0x84)] {
            let there = left(BOOTLOADER, &on_command(CLEAR, outcome), dialect(kind));
            assert_eq!(there.state, DeviceState::Untouched, "{kind}, {outcome:?}");
            let words = there.to_string();
            assert!(words.starts_with("its bootloader is running; it was not changed"), "{words}");
        }
    }
    let refuses = |fake: &mut Fake| {
        on_command(CLEAR, Outcome::Abort(0x0800_0022))(fake);
        fake.crc = Some(0x0BAD_CAFE);
    };
    let called = left(APPLICATION, &refuses, FlashOptions::default());
    assert_eq!(called.state, DeviceState::Called);
    assert_eq!(
        called.to_string(),
        "its bootloader is running; it was called back to the bootloader, and its program is unchanged (CRC \
         0BADCAFEh): coflash start starts it again"
    );
}

/// A device that erases with the first good data, and receives none, keeps its program.
#[test]
fn what_the_device_still_has_is_told() {
    for kind in STANDARD {
        // The first block, or the first segment of what is sent as a whole.
        let refuses = |crc| {
            move |fake: &mut Fake| {
                fake.crc = crc;
                if kind == Dialect::Block {
                    fake.on_block = Box::new(|_| Outcome::Abort(0x0606_0000));
                } else {
                    fake.knows_blocks = kit::fake::Blocks::Known(127);
                    fake.refuses_segment = Some((1, 0x0C));
                }
            }
        };
        let there = left(BOOTLOADER, &refuses(Some(0x0BAD_CAFE)), dialect(kind));
        assert_eq!(there.state, DeviceState::Untouched, "{kind}");
        let words = "its bootloader is running; it was not changed (CRC 0BADCAFEh)";
        assert_eq!(there.to_string(), words, "{kind}");
        let gone = left(BOOTLOADER, &refuses(None), dialect(kind));
        assert_eq!(gone.state, DeviceState::Erased, "{kind}");
        assert_eq!(gone.to_string(), "its bootloader is running; it contains no complete program");
    }
    // In the middle of the program the previous CRC no longer counts.
    let later = |fake: &mut Fake| {
        fake.crc = Some(0x0BAD_CAFE);
        fake.on_block = Box::new(|number| if number == 2 { Outcome::Status(0x0C) } else { Outcome::Accept });
    };
    assert_eq!(left(BOOTLOADER, &later, FlashOptions::default()).state, DeviceState::Erased);
    // The old program may have the CRC of the new one, if each version has its own at its end.
    let unheard = |fake: &mut Fake| {
        (fake.crc, fake.erase_time) = (Some(file().crc()), Duration::ZERO);
        fake.on_block = Box::new(|number| if number == 1 { Outcome::LoseRequest } else { Outcome::Accept });
    };
    assert_eq!(left(BOOTLOADER, &unheard, FlashOptions::default()).state, DeviceState::Postponed);
    // Nor does one that is not the file's.
    let wrong = left(BOOTLOADER, &|fake| fake.crc = Some(1), FlashOptions::default());
    assert_eq!(wrong.state, DeviceState::Erased);
}

#[test]
fn a_device_that_is_gone_is_not_said_to_wait_in_its_bootloader() {
    for kind in STANDARD {
        let dies = |fake: &mut Fake| {
            fake.erase_time = Duration::from_secs(100_000);
            fake.deaf_while_busy = true;
        };
        let gone = left(BOOTLOADER, &dies, dialect(kind));
        assert_eq!((gone.state, gone.answer), (DeviceState::Erased, DeviceAnswer::Silent), "{kind}");
        assert_eq!(gone.to_string(), "it does not answer; last known: it contains no complete program");
    }
    let mut fake = Fake::new(BOOTLOADER);
    run(&mut fake, &FlashOptions::default()).0.unwrap();
    let frames = fake.sent.len() / 2;
    let lost = left(BOOTLOADER, &|fake| fake.frames_left = frames, FlashOptions::default());
    assert_eq!(lost.answer, DeviceAnswer::NotAsked);
    assert_eq!(lost.to_string(), "it cannot be asked any more; last known: it contains no complete program");
}

/// A device that has postponed the erase, and acknowledged nothing since then, may have its program; the tool
/// cannot say that there is none. One of which 1F56h says that it has erased has none.
#[test]
fn without_an_answer_a_postponed_erase_is_not_called_done() {
    for kind in STANDARD {
        let erases = |fake: &mut Fake, clears| {
            (fake.had, fake.erase_time) = (Some((0x0BAD_CAFE, clears)), Duration::ZERO);
        };
        let postpones = |fake: &mut Fake| erases(fake, 2);
        let mut whole = Fake::new(BOOTLOADER);
        postpones(&mut whole);
        let _ = run(&mut whole, &dialect(kind));
        let command = |command| {
            let request = [0x2F, 0x51, 0x1F, 1, command, 0, 0, 0];
            whole.sent.iter().position(|frame| frame.exactly::<8>() == Some(&request))
        };
        // CLEAR and the read of 1F57h; the last is lost before the program is complete.
        let begin = command(CLEAR).unwrap() + 2;
        let first = left(BOOTLOADER, &|fake| (postpones(fake), fake.frames_left = begin).0, dialect(kind));
        assert_eq!((first.state, first.answer), (DeviceState::Postponed, DeviceAnswer::NotAsked), "{kind}");
        assert_eq!(
            first.to_string(),
            "it cannot be asked any more; last known: it was told to erase its program, and has acknowledged \
             nothing of the new one: it may have the old one"
        );
        // Also one that is long about the erase may not have begun with it: CLEAR has no answer, or 1F57h.
        for frames in [begin - 2, begin] {
            let unheard = |fake: &mut Fake| (fake.had, fake.frames_left) = (Some((0x0BAD_CAFE, 1)), frames);
            assert_eq!(left(BOOTLOADER, &unheard, dialect(kind)).state, DeviceState::Postponed, "{kind}");
        }
        // The read of 1F56h goes through.
        let erased = |fake: &mut Fake| (erases(fake, 1), fake.frames_left = begin + 1).0;
        assert_eq!(left(BOOTLOADER, &erased, dialect(kind)).state, DeviceState::Erased, "{kind}");
        let mut states = Vec::new();
        for frames in begin..command(1).unwrap_or(whole.sent.len()) {
            let cut = |fake: &mut Fake| (postpones(fake), fake.frames_left = frames).0;
            states.push(left(BOOTLOADER, &cut, dialect(kind)).state);
        }
        states.dedup();
        assert_eq!(states[..2], [DeviceState::Postponed, DeviceState::Erased], "{kind}: {states:?}");
        assert!(!states[2..].contains(&DeviceState::Postponed), "{kind}: {states:?}");
    }
}

/// 1F57h is refused once, after so many commands CLEAR; whether the device has erased at the command.
struct NoStatus {
    clears: u32,
    erases: bool,
    crc: Option<u32>,
}

impl Maker for NoStatus {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        match at {
            (0x1F57, 1) if self.clears == 1 => {
                self.clears = 2;
                Some(Err(0x0504_0001))
            }
            (0x1F56, 1) => match self.crc {
                Some(_) if self.erases && self.clears > 0 => Some(Ok(vec![0; 4])),
                Some(crc) => Some(Ok(crc.to_le_bytes().into())),
                None => Some(Err(0x0602_0000)),
            },
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], _: u32) -> Option<Result<Deed, u32>> {
        self.clears += u32::from((at, data) == ((0x1F51, 1), &[CLEAR]));
        None
    }
}

/// A device that refuses a question after it has taken CLEAR has not refused CLEAR.
#[test]
fn a_refused_question_after_the_erase_is_no_refusal_of_the_erase() {
    for kind in STANDARD {
        for (erases, crc, state) in [
            (true, Some(0x0BAD_CAFE), DeviceState::Erased),
            (false, Some(0x0BAD_CAFE), DeviceState::Untouched),
            (false, None, DeviceState::Postponed),
        ] {
            let refuses = |fake: &mut Fake| {
                fake.maker = Some(Box::new(NoStatus { clears: 0, erases, crc }));
                fake.erase_time = Duration::ZERO;
            };
            let there = left(BOOTLOADER, &refuses, dialect(kind));
            assert_eq!(there.state, state, "{kind}, erases: {erases}, {crc:?}: {there}");
        }
    }
}

/// A device with a begun download (2006h) of the file that has no data yet; and 1F57h until CLEAR.
struct Begun(u32);

impl Maker for Begun {
    fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
        // The CRC of block 0, which has 12 bytes of data after its 12 of header, and the start of the program.
        let crc = &data!("identity-110.blk")[24..28];
        match at {
            (0x2006, 1) => Some(Ok([crc, &0x0801_0000_u32.to_le_bytes()].concat())),
            (0x1F57, 1) if self.0 != 0 => Some(Ok(self.0.to_le_bytes().into())),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], _: u32) -> Option<Result<Deed, u32>> {
        if (at, data) == ((0x1F51, 1), &[CLEAR]) {
            self.0 = 0;
        }
        None
    }
}

/// The same of a download that goes on and has no data yet: the old program is there if its CRC is.
#[test]
fn a_begun_download_without_data_may_have_left_the_old_program() {
    for (crc, state) in [(0x0BAD_CAFE, DeviceState::Postponed), (0, DeviceState::Erased)] {
        let begun = |fake: &mut Fake| {
            fake.maker = Some(Box::new(Begun(0)));
            fake.crc = Some(crc);
        };
        let mut whole = Fake::new(BOOTLOADER);
        begun(&mut whole);
        let (_, events) = run(&mut whole, &FlashOptions::default());
        assert!(events.contains(&Phase::GoingOn { done: 0, total: 4001 }.into()), "{events:?}");
        let data = |frame: &Frame| frame.exactly::<8>().is_some_and(|data| data[1..4] == [0x50, 0x1F, 1]);
        let frames = whole.sent.iter().position(data).unwrap() + 1;
        let cut = |fake: &mut Fake| (begun(fake), fake.frames_left = frames).0;
        assert_eq!(left(BOOTLOADER, &cut, FlashOptions::default()).state, state, "{crc:08X}");
    }
}

/// What the device has refused last, here with FORMAT, is not gone on with: it may count the refused block.
#[test]
fn a_begun_download_that_was_refused_begins_again() {
    let mut fake = Fake::new(BOOTLOADER);
    fake.maker = Some(Box::new(Begun(0x04)));
    let (result, events) = run(&mut fake, &FlashOptions::default());
    result.unwrap();
    assert!(!events.iter().any(|event| matches!(event, Event::Phase(Phase::GoingOn { .. }))), "{events:?}");
}

#[test]
fn a_program_that_does_not_answer_is_told_with_its_release() {
    let silent = |fake: &mut Fake| fake.starts = None;
    let tried = left(BOOTLOADER, &silent, FlashOptions::default());
    assert_eq!((tried.state, tried.answer), (DeviceState::Unreleased, DeviceAnswer::Silent));
    assert_eq!(
        tried.to_string(),
        "it does not answer; last known: it contains the new program, not released for autostart"
    );
    let released = left(BOOTLOADER, &silent, FlashOptions::default().trial_run(false));
    assert_eq!((released.state, released.answer), (DeviceState::Released, DeviceAnswer::Silent));
    let written = |fake: &mut Fake| {
        fake.starts = None;
        fake.on_block = Box::new(|_| Outcome::Ignore);
        fake.crc = Some(file().crc());
    };
    let raw = left(BOOTLOADER, &written, dialect(Dialect::Raw));
    assert_eq!((raw.state, raw.answer), (DeviceState::Written, DeviceAnswer::Silent));
}

/// A request of another client to a node: reads 1F57h.
fn foreign(node: u8) -> Frame {
    let id = CobId::new(0x600 + u16::from(node)).unwrap();
    Frame::of(id, &[0x40, 0x57, 0x1F, 1, 0, 0, 0, 0])
}

#[test]
fn somebody_elses_requests_end_an_update_before_anything_is_done() {
    for running in [BOOTLOADER, APPLICATION] {
        let mut fake = Fake::new(running);
        fake.inject(foreign(NODE));
        let (result, events) = run(&mut fake, &FlashOptions::default());
        let error = result.unwrap_err();
        assert!(matches!(error, Error::NotAlone { who: Intruder::Requests(Some(_)), .. }), "{error}");
        assert_eq!(error.number(), 0x6000_0012);
        let words = "another tool is using node 5: it sends SDO requests, the last one for 1F57h/1";
        assert_eq!(error.to_string(), words);
        assert!(fake.writes().is_empty(), "{:?}", fake.log);
        assert_eq!(events.last().and_then(Event::left).map(|left| left.state), Some(DeviceState::Untouched));

        let mut fake = Fake::new(running);
        fake.inject(foreign(NODE));
        run(&mut fake, &FlashOptions::default().alone(false)).0.unwrap();
        // A client that talks to another node does not matter.
        let mut fake = Fake::new(running);
        fake.noise = vec![foreign(NODE + 1)];
        run(&mut fake, &FlashOptions::default()).0.unwrap();
    }
}

#[test]
fn an_adapters_echo_is_nobody_else() {
    for blocks in [kit::fake::Blocks::Known(127), kit::fake::Blocks::Refused(0x0504_0001)] {
        for running in [BOOTLOADER, APPLICATION] {
            let mut fake = Fake::new(running);
            fake.knows_blocks = blocks;
            let mut echo = Tap::sending(fake, |fake, frame| fake.inject(*frame));
            run(&mut echo, &FlashOptions::default()).0.unwrap();
            // But another client is detected over it.
            let mut echo = Tap::sending(Fake::new(running), |fake, frame| {
                fake.inject(*frame);
                fake.inject(foreign(NODE));
            });
            let error = run(&mut echo, &FlashOptions::default()).0.unwrap_err();
            assert!(matches!(error, Error::NotAlone { .. }), "{error}");
            assert!(echo.of.writes().is_empty());
        }
    }
}
