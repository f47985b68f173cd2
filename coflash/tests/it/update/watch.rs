//! Programs that die after the tool has heard them: the watch after each start.

use std::time::Duration;

use crate::fake::{End, Fake, APPLICATION, BOOTLOADER, NODE};
use canopen::NodeId;
use coflash::device::{Session, Timing};
use coflash::file::block_file::BlockFile;
use coflash::update::{flash, FlashOptions, Report};
use coflash::Error;

/// The result of an update, and its length in virtual time.
fn run(fake: &mut Fake, options: FlashOptions) -> (Result<Report, Error>, Duration) {
    let file = BlockFile::parse(data!("identity-110.blk")).unwrap();
    let began = fake.now;
    let mut session = Session::new(fake, NodeId::new(NODE).unwrap(), Timing::default());
    let result = flash(&mut session, &file, &options, &mut |_| {});
    (result, fake.now - began)
}

/// A device whose next programs end like this.
fn device(ends: &[Option<End>], state: Option<[u8; 3]>) -> Fake {
    let mut fake = Fake::new(BOOTLOADER);
    (fake.ends, fake.state) = (ends.iter().copied().collect(), state);
    fake
}

fn reset(ms: u64, into: u32) -> Option<End> {
    Some(End::Reset { after: Duration::from_millis(ms), into })
}

fn text(error: &Error) -> String {
    format!("{error}; {}", error.advice())
}

/// A late panic, or a watchdog that the program does not feed, in its trial.
#[test]
fn a_program_that_dies_in_its_trial_is_not_released() {
    for (ms, cause, words) in [
        (200, 3, "was reset by software"),
        (500, 4, "was reset by the independent watchdog"),
        (950, 4, "was reset by the independent watchdog"),
        (350, 0, "was reset by itself or by a watchdog"),
    ] {
        let mut fake = device(&[reset(ms, BOOTLOADER)], Some([5, cause, 1]));
        let (result, _) = run(&mut fake, FlashOptions::default());
        let text = text(&result.unwrap_err());
        assert!(text.contains("not released for autostart") && text.contains(words), "{text}");
        assert!(text.contains(&format!("it ran for {ms} ms")), "{text}");
        assert!(text.contains("--watch"), "{text}");
        assert_eq!(fake.count("command 83"), 0, "after {ms} ms");
    }
    // Of another bootloader, which says nothing.
    let mut fake = device(&[reset(300, BOOTLOADER)], None);
    let (result, _) = run(&mut fake, FlashOptions::default());
    assert!(text(&result.unwrap_err()).contains("by itself or by a watchdog"));
    // An emergency 6000h of a program that goes on.
    let mut fake = device(&[Some(End::Panic { after: Duration::from_millis(300) })], None);
    let (result, _) = run(&mut fake, FlashOptions::default());
    assert!(matches!(result, Err(Error::TrialFailed { .. })), "{result:?}");
    assert_eq!(fake.count("command 83"), 0);
}

/// The start after the release, too: the program comes back by itself, and dies again.
#[test]
fn a_program_that_dies_after_its_release_is_told() {
    for into in [APPLICATION, BOOTLOADER] {
        let mut fake = device(&[None, reset(400, into)], Some([2, 4, 3]));
        let (result, _) = run(&mut fake, FlashOptions::default());
        let error = result.unwrap_err();
        assert!(matches!(error, Error::ProgramEnded { .. }), "{error}");
        assert!(text(&error).contains("it ran for 400 ms"), "{}", text(&error));
        assert_eq!(fake.count("command 83"), 1);
    }
}

/// A program is watched for a second at each of its two starts; 0 does not watch.
#[test]
fn the_watch_takes_a_second_or_what_the_user_says() {
    let took = |watch: Option<u64>, watchdog_ms: Option<u16>| {
        let mut fake = device(&[], None);
        fake.watchdog_ms = watchdog_ms;
        let options = FlashOptions::default().watch(watch.map(Duration::from_millis));
        let (result, took) = run(&mut fake, options);
        result.unwrap();
        took
    };
    let without = took(Some(0), None);
    for (watch, watchdog_ms, each) in [
        (None, None, 1000),
        (None, Some(0), 1000),
        (None, Some(100), 1000),
        (None, Some(500), 1000),
        (None, Some(2000), 4000),
        (Some(300), Some(2000), 300),
        (Some(0), Some(2000), 0),
    ] {
        let more = took(watch, watchdog_ms).saturating_sub(without).as_millis();
        let expected = 2 * each;
        assert!(
            more.abs_diff(expected) <= 100,
            "{watch:?}, watchdog {watchdog_ms:?}: {more} ms more, {expected} expected"
        );
    }
}

/// After the watch nobody looks any more, and with 0 nobody looks at all.
#[test]
fn a_death_after_the_watch_is_not_seen() {
    let mut fake = device(&[None, reset(1500, BOOTLOADER)], None);
    run(&mut fake, FlashOptions::default()).0.unwrap();
    let mut fake = device(&[None, reset(400, BOOTLOADER)], None);
    run(&mut fake, FlashOptions::default().watch(Some(Duration::ZERO))).0.unwrap();
}
