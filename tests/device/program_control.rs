//! 1F51h of a running device: the sender of each answer, the time between an answer and the reset,
//! and the meaning of 80h for a program that was just downloaded. For the applications in Rust and
//! C.

use std::time::Duration;

use canopen::program::{ProgramControl, FLASH_STATUS, PROGRAM_CONTROL, PROGRAM_ID};
use canopen::{AbortCode, Address};
use coboot_tests::bench::{
    control, Bench, ACKNOWLEDGED, HEARTBEAT, NODE, REQUEST, RESCUE_WINDOW_MS, RESPONSE,
};
use coboot_tests::{firmware, renewal};
use coflash_core::device::info::info;
use coflash_core::update::steps::call_back;
use coflash_core::update::{catch, flash, CatchOptions, FlashOptions};
use coflash_core::Error;
use emulator::machine::Stop;
use emulator::time::{Span, Time};
use shared_abi::check_word;
use shared_abi::renewal::Progress;

const APPLICATIONS: [&str; 2] = [firmware::APP_V1, firmware::APP_C];

fn running_board(image: &str) -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.update(image);
    bench.run_ms(100);
    bench.events();
    bench
}

/// A command to 1F51h/1, which is acknowledged.
#[track_caller]
fn assert_acknowledged(bench: &mut Bench, command: u8) {
    bench.assert_answer(REQUEST, &control(command), RESPONSE, &ACKNOWLEDGED);
}

/// The time of the chip's single reset.
fn reset(bench: &mut Bench) -> Time {
    let events = bench.events();
    let [(at, Stop::Reset(_))] = events[..] else { panic!("{events:?}") };
    at
}

/// The answers since then, with the times of their ends.
fn answers(bench: &Bench, from: Time) -> Vec<(Time, [u8; 8])> {
    let frames = bench.frames_of(RESPONSE, from).into_iter();
    frames.map(|(at, data)| (at, data.try_into().expect("8 bytes"))).collect()
}

/// All kinds of requests during the 10 ms between the answer and the reset are answered; frames
/// that are not requests are not. Each acknowledged command has its 10 ms.
#[test]
fn requests_between_the_answer_and_the_reset_are_served() {
    for image in APPLICATIONS {
        for leaving in [0x80, 0x02] {
            let mut bench = running_board(image);
            let from = bench.time();
            assert_acknowledged(&mut bench, leaving);
            // Frames that are not requests, or are for other nodes.
            bench.post(REQUEST, &[0x40, 0, 0x10]);
            bench.post(REQUEST, &[0x80, 0, 0x10, 0, 0, 0, 0, 0]);
            bench.post(REQUEST + 1, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
            bench.post(0x000, &[0x81, NODE + 1]);
            // Start remote node: the state changes, and the heartbeat would show it.
            bench.post(0x000, &[0x01, NODE]);
            let read = bench.ask(REQUEST, &[0x40, 0, 0x10, 0, 0, 0, 0, 0], RESPONSE);
            assert_eq!(read.as_deref(), Some(&[0x43, 0, 0x10, 0, 0, 0, 0, 0][..]), "{image}");
            let absent = bench.ask(REQUEST, &[0x40, 0xFF, 0x5F, 0, 0, 0, 0, 0], RESPONSE);
            assert_eq!(absent.as_deref(), Some(&[0x80, 0xFF, 0x5F, 0, 0, 0, 2, 6][..]), "{image}");
            let signature = bench.ask(REQUEST, &control(0x83), RESPONSE);
            assert_eq!(signature.as_deref(), Some(&[0x80, 0x51, 0x1F, 1, 0x22, 0, 0, 8][..]), "{image}");
            assert_eq!(bench.events(), [], "{image}: it is still there");
            bench.await_boot_up(1000);
            let reset = reset(&mut bench);
            let (last, _) = answers(&bench, from)[0];
            assert!(reset - last >= Span::from_millis(10), "{image}");
            assert!(reset - last <= Span::from_millis(25), "{image}: {} us", (reset - last).0 / 1_000_000);
            assert_eq!(bench.is_bootloader(NODE), leaving == 0x80, "{image}");
            bench.assert_nothing_unmodelled();
        }
    }
}

/// Repeated 80h: each is acknowledged, the reset comes 10 ms after the last one, and a client that
/// never stops does not delay the device for ever.
#[test]
fn a_call_in_quick_succession_is_acknowledged_each_time() {
    for image in APPLICATIONS {
        let mut bench = running_board(image);
        let from = bench.time();
        for _ in 0..4 {
            assert_acknowledged(&mut bench, 0x80);
            bench.run_ms(3);
        }
        bench.await_boot_up(1000);
        let last = answers(&bench, from).last().unwrap().0;
        let pause = reset(&mut bench) - last;
        assert!(pause >= Span::from_millis(10), "{image}: {} us", pause.0 / 1_000_000);
        assert!(bench.is_bootloader(NODE), "{image}");

        let mut bench = running_board(image);
        let from = bench.time();
        while bench.time() - from < Span::from_millis(600) {
            bench.post(REQUEST, &control(0x80));
            bench.run_ms(4);
        }
        let reset = reset(&mut bench);
        assert!(reset - from <= Span::from_millis(520), "{image}: {} ms", (reset - from).0 / 1_000_000_000);
        assert!(bench.is_bootloader(NODE), "{image}");
    }
}

/// The second master's command arrives while the first one's is being carried out.
#[test]
fn two_masters_are_both_answered() {
    for image in APPLICATIONS {
        // STOP or CLEAR after the answer to 80h: the first has its 10 ms, the second is answered by
        // the bootloader within 25 ms.
        for second in [0x00, 0x03] {
            let mut bench = running_board(image);
            let from = bench.time();
            assert_acknowledged(&mut bench, 0x80);
            bench.run_ms(2);
            let asked = bench.time();
            assert_acknowledged(&mut bench, second);
            let took = bench.time() - asked;
            assert!(took <= Span::from_millis(25), "{image}, {second}: {} us", took.0 / 1_000_000);
            bench.run_ms(2);
            let answers = answers(&bench, from);
            assert_eq!(answers.len(), 2, "{image}, {second}");
            assert!(reset(&mut bench) - answers[0].0 >= Span::from_millis(10), "{image}, {second}");
            assert!(bench.is_bootloader(NODE), "{image}");
        }
        // A client that was promised the bootloader gets it, even if another one restarts the
        // device: by 2 of 1F51h, and by NMT reset node.
        for nmt in [false, true] {
            let mut bench = running_board(image);
            assert_acknowledged(&mut bench, 0x80);
            if nmt {
                bench.post(0x000, &[0x81, NODE]);
            } else {
                assert_acknowledged(&mut bench, 0x02);
            }
            bench.await_boot_up(1000);
            assert!(bench.is_bootloader(NODE), "{image}");
        }
    }
}

/// A heartbeat that is being sent is not cut off by an immediate departure, and no incomplete frame
/// disturbs the bus.
#[test]
fn a_frame_on_its_way_is_not_cut_off() {
    for image in APPLICATIONS {
        // The request at many distances from the heartbeat, over more than the time of a frame.
        for offset in 0..8 {
            let mut bench = running_board(image);
            let next = loop {
                let from = bench.time();
                bench.run_ms(1);
                if let Some((at, ..)) = bench.frames_since(from).iter().find(|(_, id, _)| *id == HEARTBEAT) {
                    let period = if image == firmware::APP_C { 1000 } else { 500 };
                    break *at + Span::from_millis(period);
                }
            };
            let before = bench.records().len();
            // The request takes 1 ms on the bus; the heartbeat begins at about this time.
            let asked = Time(next.0 - Span::from_micros(2000 - 250 * offset).0);
            bench.world.run_until(asked);
            bench.post(REQUEST, &control(0x00));
            bench.await_boot_up(1000);
            bench.run_ms(10);
            let bad: Vec<_> = bench.records()[before..]
                .iter()
                .filter(|record| record.outcome != emulator::bus::Outcome::Good)
                .cloned()
                .collect();
            assert!(bad.is_empty(), "{image}, {offset}: {bad:?}");
            assert_eq!(answers(&bench, asked).len(), 1, "{image}, {offset}");
        }
    }
}

/// The application answers if the bootloader could not answer in its place: the sub-index or the
/// value does not exist, or the command concerns another program.
#[test]
fn what_the_application_can_refuse_it_refuses_itself() {
    for image in APPLICATIONS {
        let mut bench = running_board(image);
        for (request, answer) in [
            // Neither a program nor the bootloader has this number.
            ([0x2F, 0x51, 0x1F, 3, 0, 0, 0, 0], [0x80, 0x51, 0x1F, 3, 0x11, 0, 0x09, 0x06]),
            ([0x2F, 0x51, 0x1F, 3, 3, 0, 0, 0], [0x80, 0x51, 0x1F, 3, 0x11, 0, 0x09, 0x06]),
            ([0x2F, 0x51, 0x1F, 3, 0x80, 0, 0, 0], [0x80, 0x51, 0x1F, 3, 0x11, 0, 0x09, 0x06]),
            ([0x2F, 0x51, 0x1F, 0, 3, 0, 0, 0], [0x80, 0x51, 0x1F, 0, 0x02, 0, 0x01, 0x06]),
            ([0x2F, 0x51, 0x1F, 1, 4, 0, 0, 0], [0x80, 0x51, 0x1F, 1, 0x30, 0, 0x09, 0x06]),
            ([0x2F, 0x51, 0x1F, 1, 0x84, 0, 0, 0], [0x80, 0x51, 0x1F, 1, 0x22, 0, 0, 0x08]),
        ] {
            assert_eq!(bench.ask(REQUEST, &request, RESPONSE).as_deref(), Some(&answer[..]), "{image}");
        }
        bench.run_ms(600);
        assert_eq!(bench.events(), [], "{image}: it stays");
    }
}

/// A machine that moves (08000022h, CiA 301 table 22): every command that would end in a reset is
/// refused, and stores one value however often it comes. So that an application which refuses for
/// ever does not lock itself in, the next start has the rescue window, by an NMT reset as after a
/// power-off.
#[test]
fn an_application_that_may_not_leave_stays_and_can_be_caught() {
    let nmt_reset: fn(&mut Bench) = |bench| bench.post(0, &[0x81, NODE]);
    let refused = [0x80, 0x51, 0x1F, 1, 0x22, 0, 0, 0x08];
    for image in [firmware::APP_V1, firmware::APP_C_PROBE] {
        let mut bench = fresh_board(image);
        assert!(bench.ask(REQUEST, &control(0x80), RESPONSE).is_some());
        assert_eq!(bench.boot_ups(nmt_reset), 1, "{image}: confirmed by the first 80h");
        for start in [nmt_reset, Bench::power_cycle] {
            bench.move_machine(image, true);
            assert_eq!(bench.ask(REQUEST, &control(0), RESPONSE).as_deref(), Some(&refused[..]), "{image}");
            let stored = bench.machine().flash().to_vec();
            for value in [0x80, 0x00, 0x02, 0x03].repeat(10) {
                let answer = bench.ask(REQUEST, &control(value), RESPONSE);
                assert_eq!(answer.as_deref(), Some(&refused[..]), "{image} {value}");
            }
            bench.run_ms(700);
            assert!(!bench.is_bootloader(NODE) && bench.machine().flash() == stored, "{image}");
            assert_eq!(bench.boot_ups(start), 2, "{image}: the bootloader, and the program");
        }
        if image == firmware::APP_V1 {
            // STOP in segments, which the server in C has not.
            bench.move_machine(image, true);
            bench.ask(REQUEST, &[0x21, 0x51, 0x1F, 1, 1, 0, 0, 0], RESPONSE);
            let end = bench.ask(REQUEST, &[0x0D, 0, 0, 0, 0, 0, 0, 0], RESPONSE);
            assert_eq!(end.as_deref(), Some(&refused[..]));
        }
        bench.power_cycle();
        let caught = catch(&mut bench.session(), &CatchOptions::default(), &mut |_| {}).unwrap();
        assert!(caught.running.is_some_and(|running| running.is_bootloader()), "{image}");
        // Its program is as it was, and leaves when its machine stands: it is confirmed again.
        bench.start_program();
        bench.run_ms(20);
        bench.confirm_program();
        bench.run_ms(50);
        assert_eq!(bench.boot_ups(Bench::power_cycle), 1, "{image}");
    }
}

/// CLEAR in the application is CLEAR in the bootloader: a refusal also comes from the bootloader.
/// Here 1F50h is locked by a password (ESAcademy).
#[test]
fn a_clear_that_the_bootloader_refuses_is_aborted_by_it() {
    /// The default of a boot loader of ESAcademy.
    const ESACADEMY: u8 = 64;
    let (request, answer) = (0x600 + u16::from(ESACADEMY), 0x580 + u32::from(ESACADEMY));
    for image in APPLICATIONS {
        let mut bench = Bench::of_image(firmware::BOOTLOADER_ESACADEMY);
        bench.power_on();
        bench.await_boot_up_of(ESACADEMY, 100);
        // 7F50h/1: the password "INIT".
        let password = [0x23, 0x50, 0x7F, 1, b'T', b'I', b'N', b'I'];
        assert_eq!(bench.ask(request, &password, answer).unwrap()[0], 0x60);
        raw_download(&mut bench, ESACADEMY, image);
        // It starts the downloaded program.
        bench.run_ms(2000);
        assert!(!bench.is_bootloader(ESACADEMY));
        let clear = bench.ask(request, &control(0x03), answer);
        assert_eq!(clear.as_deref(), Some(&[0x80, 0x51, 0x1F, 1, 0x22, 0, 0, 0x08][..]), "{image}");
        assert!(bench.is_bootloader(ESACADEMY));
        // 84h: NO_ACCESS.
        let status = bench.ask(request, &[0x40, 0x57, 0x1F, 1, 0, 0, 0, 0], answer);
        assert_eq!(status.as_deref(), Some(&[0x43, 0x57, 0x1F, 1, 0x84, 0, 0, 0][..]), "{image}");
    }
}

/// The answer to a client that writes a byte in segments is the end of the segment, which only the
/// application can acknowledge: STOP is a call, CLEAR is refused.
#[test]
fn commands_in_segments_are_answered_by_the_application() {
    let initiate = [0x21, 0x51, 0x1F, 1, 1, 0, 0, 0];
    for (value, end) in [(0, [0x20, 0, 0, 0, 0, 0, 0, 0]), (3, [0x80, 0x51, 0x1F, 1, 0x22, 0, 0, 0x08])] {
        let mut bench = running_board(firmware::APP_V1);
        bench.assert_answer(REQUEST, &initiate, RESPONSE, &ACKNOWLEDGED);
        let segment = [0x0D, value, 0, 0, 0, 0, 0, 0];
        assert_eq!(bench.ask(REQUEST, &segment, RESPONSE).as_deref(), Some(&end[..]), "{value}");
        bench.run_ms(100);
        assert_eq!(bench.is_bootloader(NODE), value == 0, "{value}");
    }
}

/// A damaged warm-start cell with an owed answer is not a request, and nothing is sent. A valid one
/// with an impossible command gets the abort of 1F51h for it; a command for another node gets no
/// answer.
#[test]
fn an_owed_answer_in_a_damaged_cell_is_not_sent() {
    let magic = u32::from_le_bytes(*b"CBW1");
    let sound = |argument: u32| [magic, 7, argument, check_word(&[magic, 7, argument])];
    let [.., good] = sound(0x0001_0001);
    let of_node_1 = |program: u32, value: u32| program | value << 8 | u32::from(NODE) << 16;
    let abort = |program: u8, code: [u8; 4]| {
        let [a, b, c, d] = code;
        Some([0x80, 0x51, 0x1F, program, a, b, c, d])
    };
    for (what, cell, stays, answer) in [
        ("STOP, for comparison", sound(of_node_1(1, 0)), true, Some(ACKNOWLEDGED)),
        ("CLEAR, for comparison", sound(of_node_1(1, 3)), true, Some(ACKNOWLEDGED)),
        ("a bit of the argument", [magic, 7, 0x0001_0003, good], false, None),
        ("a bit of the check word", [magic, 7, 0x0001_0001, good ^ 0x8000_0000], false, None),
        ("a bit of the request", [magic, 5, 0x0001_0001, good], false, None),
        ("no program", sound(of_node_1(0, 3)), false, None),
        ("bits that mean nothing", sound(of_node_1(1, 3) | 1 << 24), false, None),
        ("a program that is not there", sound(of_node_1(9, 3)), true, abort(9, [0x11, 0, 0x09, 0x06])),
        ("an unknown value", sound(of_node_1(1, 0x7F)), true, abort(1, [0x30, 0, 0x09, 0x06])),
        ("another node", sound(1 | 3 << 8 | 9 << 16), true, None),
        ("no node", sound(1 | 3 << 8), true, None),
        ("an impossible node", sound(1 | 3 << 8 | 200 << 16), true, None),
    ] {
        let mut bench = running_board(firmware::APP_V1);
        bench.set_warm_start(cell);
        let from = bench.time();
        bench.machine().reset_pin();
        bench.await_boot_up(1000);
        bench.run_ms(RESCUE_WINDOW_MS + 100);
        let sent: Vec<_> = answers(&bench, from).into_iter().map(|(_, data)| data).collect();
        assert_eq!(sent, answer.into_iter().collect::<Vec<_>>(), "{what}");
        assert_eq!(bench.is_bootloader(NODE), stays, "{what}");
        // Consumed: the next reset starts the program.
        bench.machine().reset_pin();
        bench.await_boot_up(1000);
        bench.run_ms(RESCUE_WINDOW_MS + 100);
        assert_eq!(answers(&bench, from).len(), sent.len() + 1, "{what}: only the question for 1000h");
        assert!(!bench.is_bootloader(NODE), "{what}");
    }
}

/// Downloads an application in one transfer, by the segments of any client.
fn raw_download(bench: &mut Bench, node: u8, image: &str) {
    let mut session = bench.session_with(node);
    session.transfer_by(coflash_core::device::Transfers::Segments);
    let doing = coflash_core::device::Doing::Program;
    let at = canopen::Address::new(0x1F50, 1);
    session.write(at, &firmware::raw(image), doing, &mut |_| {}).unwrap();
    let _ = session.await_idle(1, doing);
}

/// A board with a program that was downloaded in one transfer and started.
fn fresh_board(image: &str) -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.session().command(1, ProgramControl::Clear).unwrap();
    raw_download(&mut bench, NODE, image);
    bench.start_program();
    bench.run_ms(50);
    bench.events();
    bench
}

/// The first 80h confirms it; the second one calls the bootloader.
#[test]
fn the_first_80h_to_a_fresh_program_confirms_it() {
    for image in APPLICATIONS {
        let mut bench = fresh_board(image);
        // After any other request it stays fresh.
        bench.post(0x000, &[0x80, NODE]);
        assert_eq!(bench.number(0x1F51, 1), 1);
        assert_acknowledged(&mut bench, 0x01);
        assert_acknowledged(&mut bench, 0x80);
        bench.run_ms(600);
        assert_eq!(bench.events(), [], "{image}: it stays");
        assert_acknowledged(&mut bench, 0x80);
        bench.await_boot_up(1000);
        assert!(bench.is_bootloader(NODE), "{image}: the second is a call");
    }
}

/// A program is fresh if it was started directly after its download: not after a power-off, an NMT
/// reset or a restart by 2, not in a trial run of block files, not after a release by 83h.
#[test]
fn every_other_80h_is_a_call() {
    type Step = fn(&mut Bench);
    let between: [(&str, Step); 3] = [
        ("power-off", |bench| {
            bench.power_cycle();
            bench.await_program(1000);
        }),
        ("NMT reset node", |bench| {
            bench.post(0x000, &[0x81, NODE]);
            bench.await_program(1000);
        }),
        ("reset program", |bench| {
            assert!(bench.ask(REQUEST, &control(0x02), RESPONSE).is_some());
            bench.await_boot_up(1000);
        }),
    ];
    for image in APPLICATIONS {
        for (what, between) in between {
            let mut bench = fresh_board(image);
            between(&mut bench);
            bench.run_ms(50);
            assert!(!bench.is_bootloader(NODE), "{image}, {what}");
            assert!(bench.ask(REQUEST, &control(0x80), RESPONSE).is_some());
            bench.await_boot_up(1000);
            assert!(bench.is_bootloader(NODE), "{image}, {what}");
        }
        // A trial run of our own dialect: blocks, START, 80h, release.
        let mut bench = Bench::new().switched_on();
        let options = FlashOptions::default().watch(Some(Duration::ZERO));
        let began = bench.time();
        flash(&mut bench.session(), firmware::blocks(image), &options, &mut |_| {}).unwrap();
        // The erase of a sector of 128 KiB takes a second of it.
        assert!(bench.time() - began < Span::from_millis(4000), "{image}: nobody was asked twice");
        // Released by SYS TEC's command after a download in one transfer.
        bench.call_back();
        for value in [0x03, 0x83] {
            if value == 0x83 {
                raw_download(&mut bench, NODE, image);
            }
            assert_acknowledged(&mut bench, value);
        }
        bench.run_ms(100);
        assert!(bench.ask(REQUEST, &control(0x01), RESPONSE).is_some());
        bench.await_boot_up(1000);
        bench.run_ms(50);
        assert!(bench.ask(REQUEST, &control(0x80), RESPONSE).is_some());
        bench.await_boot_up(1000);
        assert!(bench.is_bootloader(NODE), "{image}, signed by 83h");
    }
}

/// A confirmation that cannot be stored is reported by an abort (06060000h, hardware), and does not
/// prevent the return: the next 80h is a call.
#[test]
fn a_confirmation_that_fails_is_told_and_leaves_the_way_back_open() {
    for image in APPLICATIONS {
        let mut bench = fresh_board(image);
        bench.protect_parameters(true);
        let refused = bench.ask(REQUEST, &control(0x80), RESPONSE);
        assert_eq!(refused.as_deref(), Some(&[0x80, 0x51, 0x1F, 1, 0, 0, 0x06, 0x06][..]), "{image}");
        bench.protect_parameters(false);
        assert_acknowledged(&mut bench, 0x80);
        bench.await_boot_up(1000);
        assert!(bench.is_bootloader(NODE), "{image}");
    }
}

/// The call of the host tool, when the first one was a confirmation.
#[test]
fn coflash_calls_a_fresh_program_back() {
    for image in APPLICATIONS {
        let mut bench = fresh_board(image);
        let began = bench.time();
        let running = call_back(&mut bench.session()).unwrap();
        assert!(running.is_bootloader(), "{image}");
        let took = bench.time() - began;
        assert!(took < Span::from_millis(4000), "{image}: {} ms", took.0 / 1_000_000_000);
    }
}

/// A program that is damaged in flash is refused after the reset of its START, and so it is at the start
/// by itself: 1F57h says NOVALPROG, 1F51h and 1F56h that there is none, and 2007h why.
#[test]
fn a_start_of_a_damaged_program_is_refused_and_says_why() {
    let region = firmware::board().programs[0];
    let read = |bench: &mut Bench, index, sub| {
        let value = bench.session().read(Address::new(index, sub)).unwrap();
        value.iter().rev().fold(0_u32, |word, byte| word << 8 | u32::from(*byte))
    };
    // A byte of the code, and the first vector.
    for (damage, reason) in [(region.base + 0x400, 9), (region.base, 10)] {
        let mut bench = running_board(firmware::APP_V1);
        bench.call_back();
        // It came back on request; a reset would start it.
        let state = [1, 11, 3, 4, 2].map(|sub| read(&mut bench, 0x2007, sub));
        let number = firmware::board().staging.map_or(0, |_| renewal::number());
        assert_eq!(state, [u32::from(number), 0, 3, 0, 255]);
        assert_ne!(read(&mut bench, PROGRAM_ID, 1), 0);
        bench.machine().poke(damage, &[0, 0, 0, 0]).unwrap();
        bench.session().command(1, ProgramControl::Start).unwrap();
        for after in ["START", "power-on"] {
            bench.await_boot_up(1000);
            assert!(bench.is_bootloader(NODE), "after {after}");
            assert_eq!(read(&mut bench, FLASH_STATUS, 1), 0x02, "after {after}");
            assert_eq!(read(&mut bench, PROGRAM_ID, 1), 0, "after {after}");
            assert_eq!(read(&mut bench, PROGRAM_CONTROL, 1), 3, "after {after}");
            assert_eq!(read(&mut bench, 0x2007, 2), reason, "after {after}");
            bench.power_cycle();
        }
        bench.await_boot_up(1000);
        // A new download brings everything back.
        bench.update(firmware::APP_V2);
        bench.run_ms(100);
        assert!(!bench.is_bootloader(NODE));
        bench.assert_nothing_unmodelled();
    }
}

/// To an application the bootloader is one more program, which does not run: a master reads there which
/// one a device has, and each command leads to it.
#[test]
#[cfg_attr(not(staging), ignore = "needs a region for staging")]
fn the_bootloader_is_a_program_of_the_application_too() {
    let number = renewal::number();
    let new = renewal::image_of(firmware::BOOTLOADER);
    let word = |at: usize| u32::from_le_bytes(new[at..at + 4].try_into().unwrap());
    let crc = word(4);
    let at = |index| Address::new(index, number);
    for image in APPLICATIONS {
        let mut bench = running_board(image);
        // The tool shows it as what it is.
        let seen = info(&mut bench.session()).unwrap();
        assert_eq!(seen.programs.len(), usize::from(number) - 1, "{image}");
        let bootloader = seen.bootloader.unwrap();
        assert_eq!((bootloader.number, bootloader.running), (number, None), "{image}");
        assert_eq!(bootloader.version.0, word(48), "{image}");
        let mut session = bench.session();
        assert_eq!(session.read(Address::new(PROGRAM_CONTROL, 0)).unwrap(), [number], "{image}");
        assert_eq!(session.read(at(PROGRAM_CONTROL)).unwrap(), [0], "{image}");
        assert_eq!(session.read_number(at(PROGRAM_ID)).unwrap(), crc, "{image}");
        assert_eq!(session.read_number(at(FLASH_STATUS)).unwrap(), 0, "{image}");
        assert_eq!(session.read(Address::new(0x2007, 1)).unwrap(), [number], "{image}");
        let absent = session.read(Address::new(PROGRAM_CONTROL, number + 1)).unwrap_err();
        assert!(
            matches!(absent, Error::Refused { code: AbortCode::NO_SUB_INDEX, .. }),
            "{image}: {absent:?}"
        );
        for command in [ProgramControl::Start, ProgramControl::SetSignature, ProgramControl::ClrSignature] {
            let refused = session.command(number, command).unwrap_err();
            assert!(
                matches!(refused, Error::Refused { code: AbortCode::DEVICE_STATE, .. }),
                "{image}: {refused:?}"
            );
        }
        // It is stopped: a tool may write back what it has read.
        session.command(number, ProgramControl::Stop).unwrap();
        assert_eq!(session.read(at(PROGRAM_CONTROL)).unwrap(), [0], "{image}");
        // The bootloader acknowledges CLEAR in the application's place, and changes nothing.
        session.command(number, ProgramControl::Clear).unwrap();
        assert!(bench.is_bootloader(NODE), "{image}");
        assert_eq!(renewal::progress(&mut bench), Progress::default());
        assert_eq!(renewal::identification(&mut bench), crc, "{image}");
        bench.session().command(1, ProgramControl::Start).unwrap();
        bench.await_program(1000);
        bench.session().command(number, ProgramControl::StartBootloader).unwrap();
        bench.await_boot_up(1000);
        assert!(bench.is_bootloader(NODE), "{image}");
        bench.assert_nothing_unmodelled();
    }
}
