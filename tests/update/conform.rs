//! The conformance checks on an emulated board, and what they leave behind.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::atomic::AtomicBool;
use std::sync::Arc;
use std::time::Duration;

use canopen::{Address, CobId, Frame, NodeId};
use coboot_tests::bench::{Bench, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coflash::bus::{Adapter, AdapterError};
use coflash::conform::{checks, run, Check, Means, Outcome};
use coflash::device::Error;
use coflash::update::{flash, FlashOptions};
use emulator::machine::Options;
use emulator::silicon::{Silicon, TYPICAL, WORST};

/// The checks that fail, and those that cannot be judged.
fn verdicts(bench: &mut dyn Adapter, checks: &[Check], means: Means<'_>) -> (Vec<String>, Vec<String>) {
    let (mut failed, mut skipped) = (Vec::new(), Vec::new());
    let node = NodeId::new(NODE).unwrap();
    run(bench, node, checks, means, &Arc::default(), &mut |verdict| match &verdict.outcome {
        Outcome::Passed => {}
        Outcome::Failed(what) => failed.push(format!("{}: {what}", verdict.check.id)),
        Outcome::Skipped(why) => skipped.push(format!("{}: {why}", verdict.check.id)),
    })
    .unwrap();
    (failed, skipped)
}

/// The checks that change no program.
fn harmless() -> Vec<Check> {
    checks().into_iter().filter(|check| !check.installs).collect()
}

fn means() -> Means<'static> {
    Means::of(Duration::from_millis(500))
}

/// A board whose power the checks can switch, with a fault between it and the bus.
struct Faulty<'b> {
    bench: &'b mut Bench,
    power: Rc<Cell<Option<bool>>>,
    /// The answer that is heard in place of this one, to this request.
    answer: fn(asked: [u8; 8], answer: [u8; 8]) -> Option<[u8; 8]>,
    asked: [u8; 8],
}

impl Adapter for Faulty<'_> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        if let (true, Some(data)) = (frame.has_cob_id(CobId::new(REQUEST).unwrap()), frame.exactly::<8>()) {
            self.asked = *data;
        }
        self.bench.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        match self.power.take() {
            Some(true) => self.bench.power_on(),
            Some(false) => self.bench.power_off(),
            None => {}
        }
        let id = CobId::new(RESPONSE as u16).unwrap();
        let Some(frame) = self.bench.receive(timeout)? else { return Ok(None) };
        match frame.exactly::<8>().filter(|_| frame.has_cob_id(id)) {
            Some(data) => match (self.answer)(self.asked, *data) {
                Some(data) => Ok(Some(Frame::full(id, data))),
                // Nothing is heard: the time passes.
                None => self.bench.receive(timeout),
            },
            None => Ok(Some(frame)),
        }
    }

    fn now(&self) -> Duration {
        self.bench.now()
    }
}

/// The checks with a program, on a board with this fault; with what it runs at the end.
fn with_a_program(
    silicon: Silicon,
    answer: fn([u8; 8], [u8; 8]) -> Option<[u8; 8]>,
) -> (Vec<String>, Vec<String>, Option<u32>) {
    let mut bench = Bench::with(Options { silicon, ..Options::default() });
    bench.power_on();
    bench.await_boot_up(100);
    let program = Arc::new(firmware::blocks(firmware::APP_V1));
    let crc = program.program_crc();
    let installing: Vec<_> = checks().into_iter().filter(|check| check.installs).collect();
    let power = Rc::new(Cell::new(None));
    let switch = Rc::clone(&power);
    let means = Means {
        image: Some(program.into()),
        power: Some(Box::new(move |on| {
            switch.set(Some(on));
            Ok(())
        })),
        ..means()
    };
    let mut faulty = Faulty { bench: &mut bench, power, answer, asked: [0; 8] };
    let (failed, skipped) = verdicts(&mut faulty, &installing, means);
    let told = bench.session().read_number(Address::new(0x1F56, 1)).ok();
    let runs = !bench.is_bootloader(NODE) && told == Some(crc);
    bench.assert_nothing_unmodelled();
    (failed, skipped, told.filter(|_| runs))
}

/// On the worst chip; the test below shows the same on a typical one.
#[test]
fn updates_pass_and_the_image_runs_at_the_end() {
    let (failed, skipped, runs) = with_a_program(WORST, |_, answer| Some(answer));
    assert_eq!((&failed[..], &skipped[..]), (&[][..], &[][..]));
    assert!(runs.is_some());
}

#[test]
fn faults_of_updates_are_found() {
    // Another CRC of the running program, and of an erased one.
    let (failed, ..) = with_a_program(TYPICAL, |asked, mut answer| {
        if asked[..4] == [0x40, 0x56, 0x1F, 1] && answer[0] == 0x43 {
            answer[4] ^= 1;
        }
        Some(answer)
    });
    assert_eq!(
        ids(&failed),
        ["UPD-001", "UPD-002", "UPD-003", "UPD-004", "UPD-006", "UPD-008", "UPD-009", "UPD-010", "UPD-011"]
    );
    // Silent while it is busy: status words with bit 0 are not heard. The next check meets the same
    // erase.
    let (failed, ..) = with_a_program(TYPICAL, |asked, answer| {
        let busy = asked[..4] == [0x40, 0x57, 0x1F, 1] && answer[0] == 0x43 && answer[4] & 1 != 0;
        (!busy).then_some(answer)
    });
    assert_eq!(ids(&failed), ["UPD-005", "UPD-006"]);
    // An error is never reported.
    let (failed, ..) = with_a_program(TYPICAL, |asked, mut answer| {
        if asked[..4] == [0x40, 0x57, 0x1F, 1] && answer[0] == 0x43 {
            answer[4] &= 1;
        }
        Some(answer)
    });
    assert_eq!(ids(&failed), ["UPD-006"]);
}

fn ids(lines: &[String]) -> Vec<&str> {
    lines.iter().filter_map(|line| line.split(':').next()).collect()
}

#[test]
fn the_bootloader_passes() {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    let (failed, skipped) = verdicts(&mut bench, &harmless(), means());
    assert!(failed.is_empty(), "{failed:#?}");
    // A compact map has no room for block upload (docs/adr/0020), which these checks read by.
    let by_blocks = |id: &&str| id.starts_with("BLK-");
    let is_compact = firmware::board().home.is_none();
    let checks = harmless();
    let expected = checks.iter().map(|check| check.id).filter(|id| is_compact && by_blocks(id));
    let found = ids(&skipped).into_iter().filter(by_blocks);
    assert_eq!(found.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
    // 1017h is const, and a bootloader has no operational state.
    let others: Vec<_> = ids(&skipped).into_iter().filter(|id| !by_blocks(id)).collect();
    assert_eq!(others, ["HB-004", "NMT-001", "NMT-002", "NMT-003", "NMT-006"], "{skipped:#?}");
    bench.assert_nothing_unmodelled();
}

#[test]
fn an_application_passes_and_keeps_its_state() {
    let mut bench = Bench::new();
    bench.power_on();
    bench.await_boot_up(100);
    flash(&mut bench.session(), &firmware::blocks(firmware::APP_V1), &FlashOptions::default(), &mut |_| {})
        .unwrap();
    bench.post(0x000, &[0x01, NODE]);
    bench.run_ms(1100);
    let checks: Vec<_> = harmless().into_iter().filter(|check| !check.resets).collect();
    let (failed, skipped) = verdicts(&mut bench, &checks, means());
    assert!(failed.is_empty(), "{failed:#?}");
    assert!(
        skipped.iter().all(|line| line.starts_with("PRG-") || line.starts_with("HB-004")),
        "{skipped:#?}"
    );
    let operational = |bench: &mut Bench| {
        let from = bench.time();
        bench.run_ms(1100);
        let frames = bench.frames_since(from);
        let beats = frames.iter().filter(|(_, id, _)| *id == coboot_tests::bench::HEARTBEAT);
        let states: Vec<_> = beats.map(|(_, _, data)| data.clone()).collect();
        assert!(!states.is_empty() && states.iter().all(|state| state == &[5]), "{states:?}");
    };
    operational(&mut bench);

    // The same when the user cancels.
    let cancelled = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&cancelled);
    let node = NodeId::new(NODE).unwrap();
    let result = run(&mut bench, node, &checks, means(), &cancelled, &mut |_| {
        flag.store(true, std::sync::atomic::Ordering::Relaxed);
    });
    assert!(matches!(result, Err(Error::Cancelled)), "{result:?}");
    operational(&mut bench);
    bench.assert_nothing_unmodelled();
}
