//! The conformance checks on an emulated board, and what they leave behind.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use canopen::{Address, CobId, Frame, NodeId};
use coboot_can::{Adapter, AdapterError};
use coboot_tests::bench::{Bench, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coflash_conform::{checks, run, Check, Means, Outcome};
use coflash_core::device::Error;
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::{Operation, Options};
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

/// The answer that is heard in place of this one, to this request.
type Answer<'a> = &'a dyn Fn([u8; 8], [u8; 8]) -> Option<[u8; 8]>;

/// A board whose power the checks can switch, with a fault between it and the bus.
struct Faulty<'b> {
    bench: &'b mut Bench,
    power: Rc<Cell<Option<bool>>>,
    answer: Answer<'b>,
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
fn with_a_program(silicon: Silicon, answer: Answer<'_>) -> (Vec<String>, Vec<String>, Option<u32>) {
    let mut bench = Bench::with(Options { silicon, ..Options::default() }).switched_on();
    let program = Arc::new(firmware::blocks(firmware::APP_V1));
    let crc = program.crc();
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
    let (failed, skipped, runs) = with_a_program(WORST, &|_, answer| Some(answer));
    assert_eq!((&failed[..], &skipped[..]), (&[][..], &[][..]));
    assert!(runs.is_some());
}

#[test]
fn faults_of_updates_are_found() {
    // Another CRC of the running program, and of an erased one.
    let (failed, ..) = with_a_program(TYPICAL, &|asked, mut answer| {
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
    let (failed, ..) = with_a_program(TYPICAL, &|asked, answer| {
        let busy = asked[..4] == [0x40, 0x57, 0x1F, 1] && answer[0] == 0x43 && answer[4] & 1 != 0;
        (!busy).then_some(answer)
    });
    assert_eq!(ids(&failed), ["UPD-005", "UPD-006"]);
    // An error is never reported.
    let (failed, ..) = with_a_program(TYPICAL, &|asked, mut answer| {
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
    let mut bench = Bench::new().switched_on();
    let (failed, skipped) = verdicts(&mut bench, &harmless(), means());
    assert!(failed.is_empty(), "{failed:#?}");
    // A compact map has no room for block upload (docs/adr/0020), which these checks read by.
    let by_blocks = |id: &&str| id.starts_with("BLK-");
    let is_compact = firmware::board().home.is_none();
    let checks = harmless();
    let expected = checks.iter().map(|check| check.id).filter(|id| is_compact && by_blocks(id));
    let found = ids(&skipped).into_iter().filter(by_blocks);
    assert_eq!(found.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
    // A board without staging has no bootloader that can be renewed.
    let of_renewal = |id: &&str| id.starts_with("REN-");
    let expected = checks.iter().map(|check| check.id).filter(of_renewal);
    let expected = expected.filter(|_| firmware::board().staging.is_none());
    let found = ids(&skipped).into_iter().filter(of_renewal);
    assert_eq!(found.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
    // 1017h is const, and a bootloader has no operational state.
    let others = ids(&skipped).into_iter().filter(|id| !by_blocks(id) && !of_renewal(id));
    let mut others: Vec<_> = others.collect();
    others.sort_unstable();
    let mut expected = vec!["HB-004", "NMT-001", "NMT-002", "NMT-003", "NMT-006"];
    expected.extend(is_compact.then_some("LSS-021"));
    expected.sort_unstable();
    assert_eq!(others, expected, "{skipped:#?}");
    bench.assert_nothing_unmodelled();
}

/// The checks of the bootloader's own number, on a board with this fault.
fn of_renewal(answer: Answer<'_>) -> (Vec<String>, Vec<String>, Vec<Operation>) {
    let mut bench = Bench::new().switched_on();
    bench.machine().keep_flash_log();
    let all: Vec<_> = checks().into_iter().filter(|check| check.group() == "REN").collect();
    let mut faulty = Faulty { bench: &mut bench, power: Rc::default(), answer, asked: [0; 8] };
    let (failed, skipped) = verdicts(&mut faulty, &all, means());
    let log = bench.machine().take_flash_log();
    bench.assert_nothing_unmodelled();
    (failed, skipped, log)
}

/// An upload of this object, of the bootloader's number by sub-index 2.
const fn reads(asked: [u8; 8], index: u16, sub: u8) -> bool {
    let [low, high] = index.to_le_bytes();
    matches!(asked, [0x40, l, h, s, ..] if l == low && h == high && s == sub)
}

#[test]
fn faults_of_the_bootloaders_own_number_are_found() {
    if firmware::board().staging.is_none() {
        return;
    }
    let (failed, skipped, log) = of_renewal(&|_, answer| Some(answer));
    assert_eq!((&failed[..], &skipped[..], &log[..]), (&[][..], &[][..], &[][..]), "and it writes nothing");

    let all = ["REN-004", "REN-005", "REN-006", "REN-007", "REN-008", "REN-009", "REN-010", "REN-011"];
    // A command changes what an object reads.
    let changed = |index, sub, asked, mut answer: [u8; 8], reads: &Cell<u8>| {
        if self::reads(asked, index, sub) {
            // The reset or the damage of the last trial; the CRC.
            answer[7] = reads.replace(reads.get().wrapping_add(1)) % 4;
            answer[6] = if index == 0x2007 { 3 } else { answer[6] };
        }
        Some(answer)
    };
    // 1F57h/2 reads this in place of an error.
    let error = |error, asked, mut answer: [u8; 8]| {
        if reads(asked, 0x1F57, 2) && answer[4] > 1 {
            answer[4] = error;
        }
        Some(answer)
    };
    let (count, is_started) = (Cell::new(0), Cell::new(false));
    let faults: [(&str, &[&str], Answer<'_>); 8] = [
        ("1F51h/0 ends before it", &["REN-001"], &|asked, mut answer| {
            answer[4] -= u8::from(reads(asked, 0x1F51, 0));
            Some(answer)
        }),
        (
            "1F51h/2 reads \"stopped\", and 1F56h/2 a program that is not there",
            &["REN-002", "REN-003"],
            &|asked, mut answer| {
                if reads(asked, 0x1F51, 2) || reads(asked, 0x1F56, 2) {
                    answer[4..].fill(0);
                }
                Some(answer)
            },
        ),
        ("2007h/9 changes", &all, &|asked, answer| changed(0x2007, 9, asked, answer, &count)),
        ("1F56h/2 changes", &all, &|asked, answer| changed(0x1F56, 2, asked, answer, &count)),
        ("the commands are refused", &all, &|asked, answer| {
            let refused = [0x80, 0x51, 0x1F, 2, 0x30, 0, 0x09, 0x06];
            Some(if asked[..4] == [0x2F, 0x51, 0x1F, 2] { refused } else { answer })
        }),
        ("no error is reported", &all[5..], &|asked, answer| error(0, asked, answer)),
        ("another error is reported", &all[5..], &|asked, answer| error(6, asked, answer)),
        ("it leaves after START: 1000h reads that of an application", &["REN-009"], &|asked, mut answer| {
            is_started.set(is_started.get() || asked[..5] == [0x2F, 0x51, 0x1F, 2, 1]);
            if reads(asked, 0x1000, 0) && is_started.take() {
                answer[4..].fill(0);
            }
            Some(answer)
        }),
    ];
    for (what, expected, answer) in faults {
        assert_eq!(ids(&of_renewal(answer).0), expected, "{what}");
    }
}

/// A device in the middle of a renewal is left alone: 84h would give the image on trial up.
#[test]
fn a_device_in_the_middle_of_a_renewal_is_left_alone() {
    if firmware::board().staging.is_none() {
        return;
    }
    for progress in [[1, 0, 0, 0], [1, 1, 0, 0], [2, 2, 0, 0]] {
        let (failed, skipped, log) = of_renewal(&|asked, mut answer| {
            if reads(asked, 0x2007, 9) {
                answer[4..].copy_from_slice(&progress);
            }
            assert_ne!(asked[..3], [0x2F, 0x51, 0x1F], "no command is sent");
            Some(answer)
        });
        assert_eq!((&failed[..], skipped.len(), &log[..]), (&[][..], 11, &[][..]), "{progress:?}");
    }
}

#[test]
fn an_application_passes_and_keeps_its_state() {
    let mut bench = Bench::new().switched_on();
    flash(&mut bench.session(), firmware::blocks(firmware::APP_V1), &FlashOptions::default(), &mut |_| {})
        .unwrap();
    bench.post(0x000, &[0x01, NODE]);
    bench.run_ms(1100);
    let checks: Vec<_> = harmless().into_iter().filter(|check| !check.resets).collect();
    let (failed, skipped) = verdicts(&mut bench, &checks, means());
    assert!(failed.is_empty(), "{failed:#?}");
    assert!(
        skipped.iter().all(|line| ["PRG-", "REN-", "HB-004"].iter().any(|id| line.starts_with(id))),
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
        flag.store(true, Ordering::Relaxed);
    });
    assert!(matches!(result, Err(Error::Cancelled)), "{result:?}");
    operational(&mut bench);
    bench.assert_nothing_unmodelled();
}
