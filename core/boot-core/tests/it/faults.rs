//! Faults that were found by review: work on one program that affects another one, and the journal
//! of a newer bootloader.

use canopen::od::Address;
use canopen::{BitRate, NodeId};
use kit::model::{ModelFlash, CHIP};
use kit::rig::{
    block, crc32, hex, program, words, Rig, Setup, AT_ONCE_2, ESACADEMY_2, LIFT_2, PRODUCT_CODE, STANDARD_1,
    STANDARD_2,
};
use shared_abi::warm_start::BootRequest;

const START: u8 = 1;
const RESET_STAT: u8 = 2;
const CLEAR: u8 = 3;
const BUFFER: usize = 1024;

/// A program, or data if the setup has data there.
fn image(setup: &Setup, number: u8, len: usize, seed: u8) -> Vec<u8> {
    if setup.is_data(number) {
        return (0..len).map(|i| (i as u8).wrapping_mul(29) ^ seed).collect();
    }
    program(setup.region(number), PRODUCT_CODE, len, seed)
}

/// The number of moments during the work on one program that are tried.
const MOMENTS: u32 = 400;
/// The number of steps in which a sector is erased and some words are programmed.
const WORK: u32 = 100;

/// A download to program 1 is aborted, the password arrives again at any moment of the remaining
/// work, and a download to program 2 is aborted, too: program 2 matches its record, or has none.
/// Promise 3 of docs/powercut.md, without a power cut.
#[test]
fn a_record_never_outlives_its_program_whenever_the_password_comes() {
    let mut wrong = Vec::new();
    for setup in [&LIFT_2, &ESACADEMY_2] {
        let mut device = Rig::new(setup, BUFFER);
        device.install(1, &image(setup, 1, 900, 0x11));
        device.install(2, &image(setup, 2, 900, 0x22));
        let installed = device.chip.model().clone();
        let new = [1, 2].map(|number| image(setup, number, 700, 0x33));
        for moment in 0..MOMENTS {
            let mut device = Rig::on(setup, BUFFER, installed.clone());
            device.unlock(1).unwrap();
            device.begin(1, None, &new[0][..650]).unwrap();
            device.steps(moment);
            device.cancel(1);
            let unlocked = device.unlock(2).is_ok();
            if unlocked && device.begin(2, Some(700), &new[1][..650]).is_ok() {
                device.steps(WORK);
                device.cancel(2);
            }
            device.settle();
            let before = device.is_true(1) && device.is_true(2);
            device.reset();
            if !(before && device.is_true(1) && device.is_true(2)) {
                wrong.push((setup.name, moment));
            }
        }
    }
    assert!(wrong.is_empty(), "{} of {} moments; the first is {:?}", wrong.len(), 2 * MOMENTS, wrong[0]);
}

/// The same with CLEAR, and with a complete second program.
#[test]
fn a_record_never_outlives_its_program_whenever_clear_comes() {
    for setup in [&STANDARD_2, &AT_ONCE_2] {
        let mut device = Rig::new(setup, BUFFER);
        device.install(1, &image(setup, 1, 900, 0x11));
        device.install(2, &image(setup, 2, 900, 0x22));
        let installed = device.chip.model().clone();
        let new = [1, 2].map(|number| image(setup, number, 700, 0x33));
        for moment in 0..MOMENTS {
            let mut device = Rig::on(setup, BUFFER, installed.clone());
            device.command(1, CLEAR).unwrap();
            let _ = device.begin(1, None, &new[0][..650]);
            device.steps(moment);
            device.cancel(1);
            let cleared = device.command(2, CLEAR).is_ok();
            if cleared && device.begin(2, Some(700), &new[1][..650]).is_ok() {
                device.steps(WORK);
                device.cancel(2);
            }
            device.settle();
            for when in ["before", "after"] {
                assert!(device.is_true(1) && device.is_true(2), "{}, {moment}, {when} a reset", setup.name);
                device.reset();
            }
        }
    }
}

/// The manual of ESAcademy: the password of a program makes it invalid, also while the flash still
/// works on an aborted download of another program.
#[test]
fn a_password_that_is_taken_voids_its_program_whatever_is_going_on() {
    let setup = &ESACADEMY_2;
    let mut device = Rig::new(setup, BUFFER);
    device.install(1, &image(setup, 1, 900, 0x11));
    device.install(2, &image(setup, 2, 900, 0x22));
    let installed = device.chip.model().clone();
    let new = image(setup, 1, 700, 0x33);
    let mut wrong = Vec::new();
    for moment in 0..MOMENTS {
        let mut device = Rig::on(setup, BUFFER, installed.clone());
        device.unlock(1).unwrap();
        device.begin(1, None, &new[..650]).unwrap();
        device.steps(moment);
        if device.unlock(2).is_ok() {
            device.settle();
            if device.state(2) != 3 {
                wrong.push(moment);
            }
        }
    }
    assert!(wrong.is_empty(), "{} of {MOMENTS} moments; the first is {:?}", wrong.len(), wrong.first());
}

/// The program that a request starts in any way; 0 for another request.
fn program_of(request: BootRequest) -> u8 {
    match request {
        BootRequest::Start(program) | BootRequest::Fresh(program) => program,
        _ => 0,
    }
}

/// A stream to program 2 is complete, a stream to program 1 is being finished: START and the RESET
/// of CiA 302-3 for program 2 start program 2, or are refused. No request was made for the other
/// program.
#[test]
fn start_behind_a_stream_starts_the_program_that_it_names() {
    let setup = &STANDARD_2;
    let images = [1, 2].map(|number| image(setup, number, 700, 0x44));
    let mut wrong = Vec::new();
    for command in [START, RESET_STAT] {
        for (first, second) in [(2, 1), (1, 2)] {
            for as_hex in [false, true] {
                for moment in 0..MOMENTS {
                    let mut device = Rig::new(setup, BUFFER);
                    let data = |number: u8| {
                        let image = &images[usize::from(number) - 1];
                        if as_hex {
                            hex(setup.region(number).base, image)
                        } else {
                            image.clone()
                        }
                    };
                    device.install(first, &data(first));
                    device.command(second, CLEAR).unwrap();
                    device.send(second, &data(second)).unwrap();
                    device.steps(moment);
                    let taken = device.command(first, command).is_ok();
                    device.settle();
                    let request = device.node.take_boot_request();
                    if request.map(program_of) != taken.then_some(first) {
                        wrong.push((command, first, as_hex, moment, request));
                    }
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{} times; the first is {:?}", wrong.len(), wrong.first());
}

/// The same while a record of the other program is being stored, instead of a stream: the device
/// must also check there whose work is being finished.
#[test]
fn start_behind_a_signature_of_another_program_starts_the_program_that_it_names() {
    let setup = &STANDARD_2;
    let mut wrong = Vec::new();
    for signature in [0x83, 0x84] {
        for moment in 0..MOMENTS {
            let mut device = Rig::new(setup, BUFFER);
            device.install(2, &image(setup, 2, 700, 0x11));
            device.install(1, &image(setup, 1, 700, 0x22));
            device.command(2, signature).unwrap();
            device.steps(moment);
            let taken = device.command(1, START).is_ok();
            device.settle();
            let request = device.node.take_boot_request();
            if request.map(program_of) != taken.then_some(1) {
                wrong.push((signature, moment, request));
            }
        }
    }
    assert!(wrong.is_empty(), "{} times; the first is {:?}", wrong.len(), wrong.first());
}

/// A set of parameters is data: no command starts it, at any moment after its download.
#[test]
fn data_are_never_started() {
    let setup = &LIFT_2;
    for command in [START, RESET_STAT] {
        for moment in 0..MOMENTS {
            let mut device = Rig::new(setup, BUFFER);
            device.unlock(2).unwrap();
            device.send(2, &image(setup, 2, 700, 0x66)).unwrap();
            device.steps(moment);
            let taken = device.command(2, command);
            device.settle();
            let request = device.node.take_boot_request();
            assert_eq!(request, None, "1F51h/2 = {command} after {moment} steps was answered {taken:?}");
        }
    }
}

/// Layer setting services do not check whether a download is running, and neither does a second SDO
/// server: the values that they store must not replace the record that must be removed first.
#[test]
fn a_record_never_outlives_its_program_whatever_is_stored_during_a_download() {
    type Between = fn(&mut Rig) -> bool;
    // The device decides whether to accept it.
    const BETWEEN: [(&str, Between); 3] = [
        ("LSS", |device| device.node.store(NodeId::new(9), Some(BitRate::K250)).is_pending()),
        ("SET_SIGNATURE", |device| device.command(1, 0x83).is_ok()),
        ("CLR_SIGNATURE", |device| device.command(1, 0x84).is_ok()),
    ];
    let setup = &STANDARD_1;
    let mut installed = Rig::new(setup, BUFFER);
    installed.install(1, &image(setup, 1, 900, 0x11));
    let installed = installed.chip.model().clone();
    let new = image(setup, 1, 700, 0x77);
    let control = block(0, 0, &words(&[700, 0, 0]));
    let mut wrong = Vec::new();
    for (what, between) in BETWEEN {
        for data in [&control, &new, &hex(setup.region(1).base, &new)] {
            for sent in (0..data.len().min(300)).step_by(7) {
                let mut device = Rig::on(setup, BUFFER, installed.clone());
                device.command(1, CLEAR).unwrap();
                let at = Address::new(0x1F50, 1);
                device.begin(1, None, &data[..sent]).unwrap();
                between(&mut device);
                let rest = data[sent..].chunks(7).try_for_each(|segment| {
                    while device.node.download_space(at, false) < segment.len() {
                        assert!(!device.node.is_idle_after_step(), "there is never room");
                    }
                    device.node.download_data(at, segment)
                });
                match rest {
                    Ok(()) => drop(device.node.download_end(at)),
                    Err(_) => device.node.download_cancel(at),
                }
                for _ in 0..2 * WORK {
                    device.steps(1);
                    if !device.is_true(1) {
                        wrong.push((what, sent));
                        break;
                    }
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{} times; the first is {:?}", wrong.len(), wrong.first());
}

/// One download at a time: a new one ends the open one of another program; the next block of that
/// one is refused and writes nothing. A refused one ends nothing.
#[test]
fn a_download_that_begins_ends_one_of_another_program() {
    let setup = &STANDARD_2;
    let new = [1, 2].map(|number| image(setup, number, 700, 0x66));
    let control = block(0, 0, &words(&[700, 0, 0]));
    let data = |number: u8, n: usize| {
        let at = setup.region(number).base + 100 * n as u32;
        block(1 + n as u32, at, new[usize::from(number) - 1].chunks(100).nth(n).unwrap())
    };
    let last = |number: u8| block(u32::MAX, 0, &words(&[700, crc32(&new[usize::from(number) - 1])]));
    for (one, other) in [(1, 2), (2, 1)] {
        let mut device = Rig::new(setup, BUFFER);
        device.command(one, CLEAR).unwrap();
        device.send(one, &control).unwrap();
        device.send(one, &data(one, 0)).unwrap();
        device.settle();

        // A block of the other program, without its CLEAR: refused.
        device.send(other, &data(other, 0)).unwrap_err();
        device.settle();
        device.send(one, &data(one, 1)).unwrap();
        device.settle();
        assert_eq!(device.status(one), 0, "{one}");

        device.command(other, CLEAR).unwrap();
        device.send(other, &control).unwrap();
        device.settle();
        let before = device.cells(one);
        device.send(one, &data(one, 2)).unwrap_err();
        device.settle();
        assert_eq!((device.status(one), device.status(other)), (0x88, 0), "{one}: SEQUENCE");
        assert!(device.cells(one) == before, "{one}: a block of what was ended was written");

        // This refusal ended nothing, and the ended download can begin again.
        for n in 0..7 {
            device.send(other, &data(other, n)).unwrap();
            device.settle();
        }
        device.send(other, &last(other)).unwrap();
        device.settle();
        assert_eq!((device.status(other), device.state(other)), (0, 0), "{one}");
        device.install(one, &new[usize::from(one) - 1]);
        assert!(device.is_true(one) && device.is_true(other), "{one}");
    }
}

/// A slot of the journal (docs/adr/0004): five words, their CRC, and the mark.
fn slot(five: [u32; 5]) -> Vec<u8> {
    let mut bytes = words(&five);
    bytes.extend(crc32(&bytes).to_le_bytes());
    bytes.extend([0; 4]);
    bytes
}

/// An older bootloader does not erase the journal of a newer one, which it cannot read: every store
/// is refused, and nothing changes. The device stays in the bootloader and can get the newer
/// bootloader back.
#[test]
fn a_journal_of_a_newer_format_refuses_what_has_to_be_stored_and_is_left_alone() {
    const NEWER: u32 = 0xFF;
    let magic = u32::from_le_bytes(*b"CBNV");
    let header = |sequence: u32, format| slot([magic, sequence, !sequence, format, u32::MAX]);
    let regions = STANDARD_1.layout.parameters;
    // By the region of the newer journal, and the contents of the other region.
    let cases = [(0, None), (1, None), (0, Some(header(6, 0))), (1, Some(header(6, 1)))];
    for (newer, other) in cases {
        let mut flash = ModelFlash::new(&CHIP);
        flash.poke(regions[newer].base, &header(7, NEWER));
        flash.poke(regions[newer].base + 28, &slot([0x0001_0001, 1, 2, 3, 4]));
        if let Some(other) = &other {
            flash.poke(regions[1 - newer].base, other);
        }
        let what = format!("newer in region {newer}, {other:?} in the other one");
        let before = flash.cells(CHIP.flash).to_vec();
        let mut device = Rig::on(&STANDARD_1, BUFFER, flash);

        // LSS, a CLEAR that erases, a program.
        let mut stored = device.node.store(NodeId::new(9), Some(BitRate::K250));
        while stored.is_pending() {
            device.steps(1);
            stored = device.node.stored();
        }
        assert!(matches!(stored, std::task::Poll::Ready(Err(_))), "{what}: LSS was told that it is stored");
        assert!(device.chip.model().cells(CHIP.flash) == before, "{what}: changed by LSS");
        for _ in 0..2 {
            let _ = device.command(1, CLEAR);
            device.settle();
        }
        assert_eq!(device.status(1), 0x10, "{what}: NVDATA");
        assert!(device.chip.model().cells(CHIP.flash) == before, "{what}: changed by CLEAR");
        device.reset();
        let _ = device.command(1, CLEAR);
        let sent = device.send(1, &image(&STANDARD_1, 1, 700, 0x55));
        device.settle();
        assert_eq!(device.status(1), 0x10, "{what}: {sent:?}, NVDATA");
        assert_eq!(device.state(1), 3, "{what}");
        assert!(device.chip.model().cells(CHIP.flash) == before, "{what}: changed by a program");
    }
}
