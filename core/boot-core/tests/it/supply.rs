//! A supply that is too low for the flash: nothing is given up for it, and nothing is written.

use boot_core::canopen::lss::StoreError;
use boot_core::control::Policy;
use canopen::od::{Address, Objects};
use canopen::{AbortCode, NodeId};
use kit::bench::{new_flash, Bench, SET_SIGNATURE};
use kit::model::{ModelFlash, CHIP};
use kit::rig::{
    block, hex, image, words, Rig, AT_ONCE_2, ESACADEMY_1, LIFT_1, PAULUS_1, PRODUCT_CODE, STANDARD_1,
};
use std::task::Poll;

/// 1F57h: NO_ACCESS ("programming is not allowed at present", L-1112d_10 table 3); in the upper half, 1 for the
/// supply (docs/protocol.md).
const LOW_SUPPLY: u32 = 0x0001_0084;

fn set_low(rig: &Rig, is_low: bool) {
    rig.chip.model().low_from = is_low.then_some(0);
}

/// In each profile and form. Not a word is written, in the journal neither.
#[test]
fn a_supply_that_is_too_low_costs_nothing() {
    for setup in [&STANDARD_1, &PAULUS_1, &ESACADEMY_1, &LIFT_1] {
        let (old, new) = (image(setup, 1, 900, 1), image(setup, 1, 5000, 2));
        for (form, data) in [("raw", new.clone()), ("HEX", hex(setup.region(1).base, &new))] {
            let what = format!("{}, {form}", setup.name);
            let mut rig = Rig::new(setup, 8192);
            rig.install(1, &old);
            set_low(&rig, true);
            rig.chip.model().touched.clear();
            let status = rig.status_of(1, &data);
            // A password gives up a program, unless its flash may not be written; data then get nowhere.
            assert_eq!(status & 0xFFFF, 0x84, "{what}");
            assert_eq!(rig.chip.model().touched, [], "{what}");
            rig.assert_installed(1, &old, &what);
            set_low(&rig, false);
            assert_eq!(rig.status_of(1, &data), 0, "{what}");
            assert_eq!(&rig.cells(1)[..new.len()], new, "{what}");
        }
    }
}

/// Blocks, and a CLEAR that erases.
#[test]
fn blocks_and_erasing_commands_are_refused_before_the_record_is_removed() {
    let (old, new) = (image(&STANDARD_1, 1, 900, 1), image(&STANDARD_1, 1, 3000, 2));
    let mut rig = Rig::new(&STANDARD_1, 8192);
    rig.install(1, &old);
    set_low(&rig, true);
    rig.clear(1);
    assert_eq!(rig.status(1), 0, "CLEAR alone loses nothing");
    rig.send_all(1, [block(0, 0, &words(&[3000, 0, PRODUCT_CODE]))]);
    let base = STANDARD_1.region(1).base;
    let _ = rig.send(1, &block(1, base, &new[..1000]));
    rig.settle();
    assert_eq!(rig.status(1), LOW_SUPPLY);
    // The emergency names it: 5000h, and 84h with the program.
    let emergencies: Vec<_> = std::iter::from_fn(|| rig.node.next_emergency()).collect();
    assert!(emergencies.iter().any(|data| data[..5] == [0x00, 0x50, 0x81, 0x84, 1]), "{emergencies:02X?}");
    assert!(rig.send(1, &block(2, base + 1000, &new[1000..])).is_err());
    rig.reset();
    assert_eq!(rig.identification(1), kit::rig::crc32(&old));

    let old = image(&AT_ONCE_2, 1, 900, 1);
    let mut rig = Rig::new(&AT_ONCE_2, 8192);
    rig.install(1, &old);
    set_low(&rig, true);
    rig.clear(1);
    assert_eq!(rig.status(1), LOW_SUPPLY);
    rig.reset();
    assert_eq!(rig.identification(1), kit::rig::crc32(&old));
}

/// Nothing of what is stored changes, and the host hears it.
#[test]
fn neither_signature_nor_node_id_is_stored() {
    let image = image(&STANDARD_1, 1, 900, 1);
    let mut rig = Rig::new(&STANDARD_1, 8192);
    rig.install(1, &image);
    rig.work(1, 0x84);
    let stored = rig.stored();
    set_low(&rig, true);
    rig.work(1, SET_SIGNATURE);
    // NVDATA.
    assert_eq!((rig.status(1), rig.stored()), (0x10, stored));
    assert_eq!(rig.node.store(NodeId::new(9), None), Poll::Pending);
    rig.settle();
    assert_eq!(rig.node.stored(), Poll::Ready(Err(StoreError::Failed)));
    assert_eq!(rig.stored(), stored);
    set_low(&rig, false);
    rig.work(1, SET_SIGNATURE);
    assert_eq!((rig.status(1), rig.stored().records[0].map(|(.., signed, _)| signed)), (0, Some(true)));
}

/// At each operation of an update: the old program is there, or none, never another one. When the supply is
/// good again, the same device takes the program, without a reset and after one.
#[test]
fn a_supply_that_falls_in_the_middle_loses_no_device() {
    let (old, new) = (image(&STANDARD_1, 1, 900, 1), image(&STANDARD_1, 1, 3000, 2));
    let mut ends = Vec::new();
    for from in 1.. {
        let mut rig = Rig::new(&STANDARD_1, 8192);
        rig.install(1, &old);
        let done = rig.chip.model().operations;
        rig.chip.model().low_from = Some(done + from);
        let status = rig.status_of(1, &new);
        if status == 0 {
            ends.push(from);
            break;
        }
        // The journal fails with NVDATA.
        let expected = if from == 1 { [LOW_SUPPLY; 2] } else { [LOW_SUPPLY, 0x10] };
        assert!(expected.contains(&status), "from operation {from} on: {status:X}");
        let written = rig.chip.model().operations;
        assert_eq!(written, done + from - 1, "nothing is written with it");
        assert!(rig.is_true(1), "from operation {from} on");
        if from % 2 == 0 {
            rig.reset();
            assert!(rig.is_true(1), "from operation {from} on");
            let id = rig.identification(1);
            assert!([0, kit::rig::crc32(&old)].contains(&id), "from operation {from} on: {id:08X}");
        }
        rig.chip.model().low_from = None;
        assert_eq!(rig.status_of(1, &new), 0, "from operation {from} on");
        assert_eq!(&rig.cells(1)[..new.len()], new, "from operation {from} on");
    }
    // A record, two sectors of 400h and 800h bytes, 750 words, a record.
    assert!(ends[0] > 750, "{ends:?}");
}

/// 2007h/6 and 7: 0 not watched, 1 good, 2 too low (docs/protocol.md); the option bytes as FLASH_OPTCR.
#[test]
fn the_device_says_what_its_supply_and_its_option_bytes_are() {
    let mut flash = ModelFlash::new(&CHIP);
    flash.option_bytes = 0x0FFF_AAED;
    let mut rig = Rig::on(&STANDARD_1, 256, flash);
    let read = |rig: &mut Rig, sub| {
        let mut bytes = [0; 4];
        let len = rig.node.read(Address::new(0x2007, sub), &mut bytes).unwrap();
        (len, u32::from_le_bytes(bytes))
    };
    assert_eq!((read(&mut rig, 6), read(&mut rig, 7)), ((4, 0x0FFF_AAED), (1, 1)));
    set_low(&rig, true);
    assert_eq!(read(&mut rig, 7), (1, 2));
    rig.chip.model().option_bytes = 0x8FFE_CCC1;
    assert_eq!(read(&mut rig, 6), (4, 0x8FFE_CCC1));
}

/// 5000h is for the supply alone: a product that forbids programming refuses a file with the same status.
#[test]
fn a_refusal_for_another_reason_is_no_fault_of_the_hardware() {
    let mut bench = Bench::with(new_flash(), Policy { allowed: || false, ..Policy::DEFAULT });
    let (refused, status) = bench.stream(&kit::bench::program(300, 1), None, 7);
    assert_eq!((refused, status), (Err(AbortCode::DEVICE_STATE), 0x84));
    let emergencies: Vec<_> = std::iter::from_fn(|| bench.node.next_emergency()).collect();
    // Code 6300h, status 84h, program 1.
    assert_eq!(emergencies, [[0x00, 0x63, 0x81, 0x84, 1, 0, 0, 0]]);
}
