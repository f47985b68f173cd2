//! Faults that were found by review: work on one program that affects another one (`tests/attack`
//! has more), and the journal of a newer bootloader.

use canopen::{BitRate, NodeId};
use kit::model::{ModelFlash, CHIP};
use kit::rig::{block, crc32, image, words, Rig, ESACADEMY_2, STANDARD_1, STANDARD_2};

use super::parameters::{header_of, slot};

const CLEAR: u8 = 3;
const BUFFER: usize = 1024;

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
    for moment in 0..400 {
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
    assert!(wrong.is_empty(), "{} of 400 moments; the first is {:?}", wrong.len(), wrong.first());
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
        device.send_all(one, [&data(one, 0)]);

        // A block of the other program, without its CLEAR: refused.
        device.send(other, &data(other, 0)).unwrap_err();
        device.settle();
        device.send_all(one, [&data(one, 1)]);
        assert_eq!(device.status(one), 0, "{one}");

        device.command(other, CLEAR).unwrap();
        device.send_all(other, [&control]);
        let before = device.cells(one);
        device.send(one, &data(one, 2)).unwrap_err();
        device.settle();
        assert_eq!((device.status(one), device.status(other)), (0x88, 0), "{one}: SEQUENCE");
        assert!(device.cells(one) == before, "{one}: a block of what was ended was written");

        // This refusal ended nothing, and the ended download can begin again.
        for n in 0..7 {
            device.send_all(other, [&data(other, n)]);
        }
        device.send_all(other, [&last(other)]);
        assert_eq!((device.status(other), device.state(other)), (0, 0), "{one}");
        device.install(one, &new[usize::from(one) - 1]);
        assert!(device.is_true(one) && device.is_true(other), "{one}");
    }
}

/// An older bootloader does not erase the journal of a newer one, which it cannot read: every store
/// is refused, and nothing changes. The device stays in the bootloader and can get the newer
/// bootloader back.
#[test]
fn a_journal_of_a_newer_format_refuses_what_has_to_be_stored_and_is_left_alone() {
    const NEWER: u32 = 0xFF;
    let regions = STANDARD_1.layout.parameters;
    // By the region of the newer journal, and the contents of the other region.
    let cases = [(0, None), (1, None), (0, Some(header_of(6, 0))), (1, Some(header_of(6, 1)))];
    for (newer, other) in cases {
        let mut flash = ModelFlash::new(&CHIP);
        flash.poke(regions[newer].base, &header_of(7, NEWER));
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
