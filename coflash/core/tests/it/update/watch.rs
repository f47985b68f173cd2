//! Programs that die after the tool has heard them: the watch after each start.

use std::sync::Arc;
use std::time::Duration;

use super::{file, left, node, update};
use canopen::nmt::parse_boot_up;
use canopen::{CobId, Frame, NodeId};
use coboot_can::gateway::{Ask, Gateway, GatewayError};
use coboot_can::{Adapter, AdapterError, Losses};
use coflash_core::device::{Doing, Session, Timing};
use coflash_core::update::many::{flash_many, Job, ManyOptions};
use coflash_core::update::{flash, DeviceAnswer, DeviceState, Event, FlashOptions, Report};
use coflash_core::Error;

use crate::tap::Tap;
use kit::fake::{Bus, Deed, End, Fake, Maker, APPLICATION, BOOTLOADER};

/// The result of an update, and its length in virtual time.
fn run(fake: &mut Fake, options: FlashOptions) -> (Result<Report, Error>, Duration) {
    let began = fake.now;
    let (result, _) = update(fake, file(), &options);
    (result, fake.now - began)
}

/// A device whose next programs end like this.
fn device(ends: &[Option<End>], state: Option<[u8; 3]>) -> Fake {
    let mut fake = Fake::new(BOOTLOADER);
    (fake.ends, fake.state) = (ends.iter().copied().collect(), state);
    fake
}

fn reset(ms: u64, into: u32) -> Option<End> {
    Some(End::Reset { after: Duration::from_millis(ms), into: Some(into) })
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
        (600, 8, "was reset by a wake-up from Standby"),
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

/// A program that answered after its start, and then is not heard any more: the cable, or a loop without
/// end. It has not "never answered", and it was not reset.
#[test]
fn a_program_that_falls_silent_in_its_watch_is_told() {
    let silent = Some(End::Reset { after: Duration::from_millis(400), into: None });
    for (ends, released) in [(vec![silent], false), (vec![None, silent], true)] {
        let mut fake = device(&ends, Some([2, 0, 0]));
        let (result, events) = update(&mut fake, file(), &FlashOptions::default());
        let error = result.unwrap_err();
        let text = text(&error);
        assert_eq!(error.number(), 0x6000_0014, "{text}");
        assert!(text.contains("it answered after its start, and node 5 is silent since then"), "{text}");
        assert!(!text.contains("was reset") && text.contains("coflash more catch --node 5"), "{text}");
        assert_eq!(text.contains("not released for autostart"), !released, "{text}");
        let state = if released { DeviceState::Released } else { DeviceState::Unreleased };
        assert_eq!(left(&events), state);
    }
}

/// Whatever the tool reads last: a program that falls silent between two requests is at fault, not the bus.
#[test]
fn a_program_that_falls_silent_between_two_requests_has_failed_its_trial() {
    let mut silences = 0;
    for after in (0..).map(|step| Duration::from_micros(1_000_000 + 250 * step)) {
        let mut fake = device(&[Some(End::Reset { after, into: None })], None);
        match run(&mut fake, FlashOptions::default()).0 {
            Ok(_) => break,
            Err(error) => assert!(matches!(error, Error::TrialFailed { .. }), "{after:?}: {error}"),
        }
        silences += 1;
    }
    assert!(silences > 3, "{silences}");
}

/// The adapter dies at any frame of a trial: the error is that of the adapter, and what is known of the
/// device is said. It is the same for each of two devices.
#[test]
fn an_adapter_that_dies_in_a_trial_is_named_with_the_state_of_the_device() {
    let mut whole = device(&[], None);
    run(&mut whole, FlashOptions::default()).0.unwrap();
    let sent = |command: u8| {
        let request = [0x2F, 0x51, 0x1F, 1, command, 0, 0, 0];
        whole.sent.iter().position(|frame| frame.exactly::<8>() == Some(&request)).unwrap()
    };
    let (start, release) = (sent(0x01), sent(0x83));
    assert!(start + 4 < release, "the trial has frames of its own: {start}, {release}");
    for frames in start + 1..=release {
        let mut fake = device(&[], None);
        fake.frames_left = frames;
        let (result, events) = update(&mut fake, file(), &FlashOptions::default());
        assert_eq!(result.unwrap_err().number(), 0x6000_0303, "{frames}");
        let Some(Event::Done(done)) = events.last() else { panic!("{events:?}") };
        assert_eq!((done.left.state, done.left.answer), (DeviceState::Unreleased, DeviceAnswer::NotAsked));
    }
}

/// A computer that sleeps in its nth wait.
#[test]
fn an_hour_of_sleep_is_no_silence_of_the_device() {
    let running = || {
        let mut fake = device(&[], None);
        fake.erase_time = Duration::from_secs(5);
        fake
    };
    let with_sleep_in = |wait: usize| {
        let mut waits = 0;
        let mut sleeps = Tap::receiving(running(), |fake, timeout| {
            let frame = fake.receive(timeout);
            waits += 1;
            fake.now += Duration::from_secs(if waits == wait { 3600 } else { 0 });
            frame
        });
        let result = update(&mut sleeps, file(), &FlashOptions::default()).0;
        drop(sleeps);
        (result, waits)
    };
    let (_, waits) = with_sleep_in(0);
    assert!(waits > 50, "{waits}");
    for wait in 0..=waits {
        let (result, _) = with_sleep_in(wait);
        assert!(result.is_ok(), "wait {wait} of {waits}: {}", result.unwrap_err());
    }
}

/// An adapter that forgets its open bus after START for a while: it refuses all frames, and hears none.
struct Forgets<A> {
    bus: A,
    lasts: Duration,
    started: Option<Duration>,
    losses: Losses,
}

impl<A: Adapter> Forgets<A> {
    fn new(bus: A, lasts: u64) -> Self {
        Self { bus, lasts: Duration::from_millis(lasts), started: None, losses: Losses::default() }
    }

    fn is_closed(&self) -> bool {
        let since =
            self.started.map(|started| self.now().saturating_sub(started + Duration::from_millis(100)));
        since.is_some_and(|since| !since.is_zero() && since < self.lasts)
    }
}

impl<A: Adapter> Adapter for Forgets<A> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        if self.is_closed() {
            (self.losses.refused, self.losses.restarts) = (self.losses.refused + 1, 1);
            return Ok(());
        }
        if frame.exactly() == Some(&[0x2F, 0x51, 0x1F, 1, 1, 0, 0, 0]) && self.started.is_none() {
            self.started = Some(self.now());
        }
        self.bus.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let frame = self.bus.receive(timeout)?;
        self.losses.restarts |= u32::from(self.is_closed());
        Ok(frame.filter(|_| !self.is_closed()))
    }

    fn now(&self) -> Duration {
        self.bus.now()
    }

    fn losses(&self) -> Losses {
        self.losses
    }
}

/// A silence that may be the adapter's is no verdict on the program, and neither is a watch that it has
/// interrupted. What the device itself says is one.
#[test]
fn a_trial_in_which_the_adapter_restarted_is_no_verdict_on_the_program() {
    let died = device(&[reset(400, BOOTLOADER)], Some([5, 4, 1]));
    for (fake, lasts, words) in [
        (device(&[], None), 60_000, "no verdict on the program of node 5: while it was started and watched, the adapter has restarted once"),
        (device(&[], None), 300, "no verdict on the program of node 5"),
        (died, 700, "the program was ended by the independent watchdog"),
    ] {
        let mut bus = Forgets::new(fake, lasts);
        let (result, events) = update(&mut bus, file(), &FlashOptions::default());
        let error = result.unwrap_err();
        assert!(text(&error).contains(words), "{lasts}: {}", text(&error));
        let is_verdict = matches!(error, Error::TrialFailed { .. });
        assert_eq!(error.number(), if is_verdict { 0x6000_0014 } else { 0x6000_0303 });
        assert_eq!((bus.bus.count("command 83"), left(&events)), (0, DeviceState::Unreleased));
        assert!(events.iter().any(|event| event.to_string().starts_with("the adapter has restarted once")));
    }
    // The same for two devices in a group, and for the start of a program without a trial.
    for result in many(&mut Forgets::new(two(), 60_000), &[5, 6]) {
        let (text, state) = result.unwrap_err();
        assert!(text.contains("no verdict on the program") && state == DeviceState::Unreleased, "{text}");
    }
    let mut bus = Forgets::new(device(&[], None), 60_000);
    let result = update(&mut bus, file(), &FlashOptions::default().trial_run(false)).0;
    assert!(matches!(result, Err(Error::NoVerdict { .. })), "{result:?}");
}

fn many(bus: &mut dyn Adapter, nodes: &[u8]) -> Vec<Result<Report, (String, DeviceState)>> {
    let file = Arc::new(file());
    let job = |node: &u8| Job::new(NodeId::new(*node).unwrap(), file.clone(), FlashOptions::default());
    let jobs: Vec<Job> = nodes.iter().map(job).collect();
    let results = flash_many(bus, &jobs, &ManyOptions::default(), &|_, _| {});
    results
        .into_iter()
        .map(|result| result.map_err(|failed| (text(&failed.error), failed.left.state)))
        .collect()
}

fn two() -> Bus {
    Bus([5, 6].map(|node| Fake::new(BOOTLOADER).at(node, 1)).into())
}

/// Two devices side by side, of which one dies in its trial: the other one is finished.
#[test]
fn a_death_in_a_trial_stops_no_other_device() {
    let end = |into| Some(End::Reset { after: Duration::from_millis(300), into });
    for (end, words) in [
        (end(Some(BOOTLOADER)), "was reset by the independent watchdog"),
        (end(None), "node 5 is silent since then"),
    ] {
        for dying in [0, 1] {
            let mut bus = two();
            bus.0[dying].ends = [end].into();
            bus.0[dying].state = Some([5, 4, 1]);
            let results = many(&mut bus, &[5, 6]);
            let (text, state) = results[dying].as_ref().unwrap_err();
            let words = words.replace('5', &bus.0[dying].node.to_string());
            assert!(text.contains(&words) && *state == DeviceState::Unreleased, "{text}");
            assert!(results[1 - dying].is_ok(), "{results:?}");
            let count = |at: usize, command| bus.0[at].count(command);
            assert_eq!((count(1 - dying, "command 83"), count(dying, "command 83")), (1, 0));
            assert_eq!(bus.0[1 - dying].running, Some(APPLICATION));
        }
    }
}

/// A device whose program has another node-ID than its bootloader.
struct Elsewhere(u8);

impl Maker for Elsewhere {
    fn write(&mut self, at: (u16, u8), data: &[u8], running: u32) -> Option<Result<Deed, u32>> {
        let starts = running == BOOTLOADER && at == (0x1F51, 1) && data == [1];
        starts.then_some(Ok(Deed::Restart(self.0, APPLICATION)))
    }
}

/// In the trial, and without one after the release.
#[test]
fn a_program_under_another_node_id_is_told_with_it() {
    for trial in [true, false] {
        let mut fake = Fake::new(BOOTLOADER);
        fake.maker = Some(Box::new(Elsewhere(9)));
        let (result, _) = run(&mut fake, FlashOptions::default().trial_run(trial));
        let text = text(&result.unwrap_err());
        assert!(text.contains("node 9 has booted up since then"), "{text}");
        assert!(text.contains("coflash info --node 9"), "{text}");
        assert_eq!(text.contains("not released for autostart"), trial, "{text}");
        assert_eq!(text.contains("--no-trial"), trial, "{text}");
    }
    // Two devices at once: each has its own program.
    let mut bus = two();
    bus.0[0].maker = Some(Box::new(Elsewhere(9)));
    let results = many(&mut bus, &[5, 6]);
    let (text, _) = results[0].as_ref().unwrap_err();
    assert!(text.contains("node 9 has booted up since then") && results[1].is_ok(), "{text}");
}

/// A neighbour that booted up before the start is not the program, nor one whose boot-up is no boot-up.
#[test]
fn a_neighbour_is_not_taken_for_the_program() {
    let mut fake = Fake::new(BOOTLOADER);
    fake.starts = None;
    fake.inject(Frame::of(CobId::new(0x709).unwrap(), &[0]));
    fake.noise = vec![Frame::of(CobId::new(0x70A).unwrap(), &[5])];
    let text = text(&run(&mut fake, FlashOptions::default()).0.unwrap_err());
    assert!(!text.contains("booted up since") && text.contains("node 5 has not answered"), "{text}");
}

/// A gateway that tells of boot-up messages (CiA 309-3 need not), in front of a device.
struct Through(Fake);

impl Through {
    fn session(&mut self, ask: &Ask<'_>) -> Session<'_> {
        Session::new(&mut self.0, ask.node, Timing::default().sdo(ask.sdo).attempts(1))
    }
}

fn refusal(error: Error) -> GatewayError {
    match error {
        Error::Refused { code, .. } => GatewayError::Abort(code),
        Error::NoAnswer { .. } => GatewayError::NoAnswer,
        other => panic!("{other}"),
    }
}

impl Gateway for Through {
    fn upload(&mut self, ask: &Ask<'_>, _: &mut dyn FnMut(u32)) -> Result<Vec<u8>, GatewayError> {
        self.session(ask).read_once(ask.at).map_err(refusal)
    }

    fn download(&mut self, ask: &Ask<'_>, data: &[u8], _: &mut dyn FnMut(u32)) -> Result<(), GatewayError> {
        self.session(ask).write(ask.at, data, Doing::Write(ask.at), &mut |_| {}).map_err(refusal)
    }

    fn reset_node(&mut self, _: NodeId) -> Result<(), GatewayError> {
        panic!("nobody resets a node here")
    }

    fn greet(&mut self, _: Duration) -> Result<(), AdapterError> {
        Ok(())
    }

    fn wait(&mut self, time: Duration) -> Result<Option<NodeId>, GatewayError> {
        let end = self.0.now + time;
        while self.0.now < end {
            let frame = self.0.receive(end - self.0.now)?;
            if let Some(node) = frame.as_ref().and_then(parse_boot_up) {
                return Ok(Some(node));
            }
        }
        Ok(None)
    }

    fn now(&self) -> Duration {
        self.0.now
    }
}

/// Behind a gateway, too: a program that comes back by itself, and one under another node-ID.
#[test]
fn boot_up_messages_of_a_gateway_count_as_those_of_a_bus() {
    let through = |fake: Fake| {
        let mut gateway = Through(fake);
        let mut session = Session::through(&mut gateway, node(), Timing::default());
        text(&flash(&mut session, file(), &FlashOptions::default(), &mut |_| {}).unwrap_err())
    };
    let back = through(device(&[None, reset(400, APPLICATION)], None));
    assert!(back.contains("it ran for 400 ms and was reset by itself or by a watchdog"), "{back}");
    let mut fake = Fake::new(BOOTLOADER);
    fake.maker = Some(Box::new(Elsewhere(9)));
    let elsewhere = through(fake);
    assert!(elsewhere.contains("node 9 has booted up since then"), "{elsewhere}");
}
