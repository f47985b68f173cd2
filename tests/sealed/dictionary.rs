//! Two programs: an update with the other program of the device as dictionary.

use coboot_tests::sealed::{image, keys, sealer, Device, Parts, STANDARD_1, STANDARD_2};
use coflash_core::file::sealed::Sealer;

/// 1F57h: for another product, program or state of the device.
const WRONG_PRODUCT: u32 = 0x82;

/// An image for program 2 that is equal to program 1 except for some bytes, with program 1 as
/// dictionary.
fn update(base: &[u8], new: &[u8], encrypted: bool) -> Vec<u8> {
    let sealer = Sealer { program: 2, base: Some(base), ..sealer((encrypted, true)) };
    sealer.seal(new, &keys().release).expect("it can be sealed")
}

/// The contents of program 1, and the new contents of program 2. `length` of the dictionary may be
/// odd.
fn programs(length: usize) -> (Vec<u8>, Vec<u8>) {
    let base = image(STANDARD_2.region(1), length, 1);
    let own = image(STANDARD_2.region(2), 2000, 2);
    // The start is program 2's own, because of its vectors; then the contents of program 1 follow.
    let mut new = own[..700].to_vec();
    new.extend_from_slice(&base[700..]);
    (base, new)
}

#[test]
fn an_update_out_of_the_other_program_is_small_and_right() {
    for length in [3000, 3001, 4095, 4096] {
        for encrypted in [false, true] {
            let (base, new) = programs(length);
            let device = Device::sealed(&STANDARD_2);
            device.run(|host| host.install(1, &sealer((false, false)).seal(&base, &keys().release).unwrap()));
            let file = update(&base, &new, encrypted);
            let alone = Sealer { program: 2, ..sealer((encrypted, true)) };
            let alone = alone.seal(&new, &keys().release).unwrap();
            assert!(Parts::of(&file).payload().len() * 2 < Parts::of(&alone).payload().len());
            device.run(|host| host.install(2, &file));
            assert!(device.holds(2, &new), "{length} bytes, encrypted: {encrypted}");
            assert!(device.holds(1, &base), "the dictionary stays");
            assert!(device.verified(1).is_ok() && device.verified(2).is_ok());
        }
    }
}

#[test]
fn without_the_right_dictionary_nothing_is_touched() {
    let (base, new) = programs(3000);
    let file = update(&base, &new, false);
    let other = image(STANDARD_2.region(1), 3000, 9);
    for installed in [None, Some(&other)] {
        let device = Device::sealed(&STANDARD_2);
        if let Some(image) = installed {
            device.run(|host| host.install(1, &sealer((false, false)).seal(image, &keys().release).unwrap()));
        }
        device.take_touched();
        device.run(|host| assert_eq!(host.update(2, &file, 7).1, WRONG_PRODUCT));
        assert!(!device.was_touched(2) && !device.was_touched(1));
    }
    // A device with one program has no other program.
    let sealer = Sealer { base: Some(&base), ..sealer((false, true)) };
    let file = sealer.seal(&image(STANDARD_1.region(1), 2000, 3), &keys().release).unwrap();
    let device = Device::sealed(&STANDARD_1);
    device.run(|host| assert_eq!(host.update(1, &file, 7).1, WRONG_PRODUCT));
    assert!(!device.was_touched(1));
}
