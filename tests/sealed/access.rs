//! The rights of a sealed device (2002h), its log of events (2003h), and what needs a right; on the
//! model of the flash.

use canopen::od::Address;
use canopen::AbortCode;
use coboot_tests::sealed::{
    crc32, image, keys, seal, sealer, Device, Host, Parts, CLEAR, CLR_SIGNATURE, STANDARD_1, STANDARD_2,
};
use coboot_tests::sealed_board::status;
use coflash_core::file::sealed::{key_block, Sealer};
use seal::access::{event, right, EVENTS, REQUEST, SEALED};

/// CiA 301: the length does not match; a value that is not allowed; not now.
const LENGTH: AbortCode = AbortCode(0x0607_0010);
const INVALID_VALUE: AbortCode = AbortCode(0x0609_0030);
const DEVICE_STATE: AbortCode = AbortCode(0x0800_0022);

const RIGHTS: [u32; 5] =
    [right::ERASE, right::CLEAR_SIGNATURE, right::LOWER_COUNTER, right::STORE, right::READ_BACK];

fn program(seed: u8) -> Vec<u8> {
    image(STANDARD_1.region(1), 600, seed)
}

/// A sealed program with this counter and version.
fn sealed(seed: u8, counter: u32, version: u32) -> Vec<u8> {
    seal(&Sealer { counter, version, ..sealer((false, false)) }, &program(seed))
}

/// The same with a wrong signature.
fn forged(seed: u8, counter: u32, version: u32) -> Vec<u8> {
    let file = sealed(seed, counter, version);
    Parts::of(&file).signed_by(&keys().stranger).bytes()
}

#[test]
fn rights_add_up_and_end_with_the_power() {
    let device = Device::sealed(&STANDARD_1);
    for right in RIGHTS {
        for root in [&keys().root, &keys().second_root] {
            device.run(|host| {
                assert_eq!(host.rights(), SEALED);
                assert!(!host.grant(&keys().release, right, 0), "it is no root");
                assert_eq!(host.rights(), SEALED);
                assert!(host.grant(root, right, 0));
                assert_eq!(host.rights(), SEALED | right);
                let more = RIGHTS.iter().fold(0, |all, right| all | right) & !right;
                assert!(host.grant(root, more, 0));
                assert_eq!(host.rights(), SEALED | right | more);
            });
        }
    }
    // Nothing to grant: it has no keys, and the erased flash is none.
    Device::open(&STANDARD_1).run(|host| {
        assert_eq!(host.rights(), 0);
        let mut request = host.request(&keys().root, right::ERASE, 0);
        assert_eq!(host.ask(&request), Err(INVALID_VALUE));
        request[8..12].copy_from_slice(&[0xFF; 4]);
        assert_eq!(host.ask(&request), Err(INVALID_VALUE));
    });
}

/// 2002h/3: the roots, and what an image must have at least, as it was at the reset.
#[test]
fn roots_epoch_and_counter_are_told() {
    fn reported(host: &mut Host<'_>) -> Vec<u32> {
        let mut bytes = [0; 64];
        let len = host.node.read(Address::new(0x2002, 3), &mut bytes).unwrap();
        bytes[..len].chunks(4).map(|word| u32::from_le_bytes(word.try_into().unwrap())).collect()
    }
    let roots = [&keys().root, &keys().second_root].map(|root| root.public().id());
    let device = Device::sealed(&STANDARD_1);
    let before = device.run(|host| {
        let reported = reported(host);
        assert_eq!((&reported[..2], reported.len()), (&roots[..], 4));
        host.install(1, &sealed(1, 5, 1));
        reported
    });
    assert!(before[3] < 5, "{before:X?}");
    device.run(|host| {
        let reported = reported(host);
        assert_eq!((&reported[..2], reported[3]), (&roots[..], 5));
        assert!(reported[2] >= before[2]);
    });
    // Without keys there are no roots.
    Device::open(&STANDARD_1).run(|host| assert_eq!(reported(host)[..3], [0; 3]));
}

#[test]
fn a_request_is_good_for_one_challenge() {
    let device = Device::sealed(&STANDARD_1);
    let request = device.run(|host| {
        let before = host.challenge();
        assert_eq!(before, host.challenge(), "it stays until it is used");
        assert_ne!(before[12..44], [0; 32]);
        let request = host.request(&keys().root, right::ERASE, 0);
        assert_eq!(host.ask(&request), Ok(()));
        host.settle();
        assert_eq!(host.rights(), SEALED | right::ERASE);
        assert_eq!(host.challenge()[..12], before[..12], "the unique ID");
        assert_ne!(host.challenge()[12..44], before[12..44]);
        request
    });
    // After a reset, the same device without a source of randomness has another challenge.
    device.run(|host| {
        assert_eq!(host.ask(&request), Ok(()));
        host.settle();
        assert_eq!(host.rights(), SEALED);
    });
}

#[test]
fn what_is_no_request_is_told_at_once() {
    Device::with_keys(&STANDARD_1, &keys_of_one_root()).run(|host| {
        let good = host.request(&keys().root, right::ERASE, 0);
        for len in [0, 1, REQUEST - 1, REQUEST + 1] {
            let mut request = good.clone();
            request.resize(len, 0);
            assert_eq!(host.ask(&request), Err(LENGTH), "{len}");
        }
        let id = u32::from_le_bytes(good[8..12].try_into().unwrap());
        for other in [0, u32::MAX, id ^ 1, keys().stranger.public().id()] {
            let mut request = good.clone();
            request[8..12].copy_from_slice(&other.to_le_bytes());
            assert_eq!(host.ask(&request), Err(INVALID_VALUE), "{other:08X}");
        }
        assert_eq!(host.ask(&good), Ok(()));
    });
}

/// One signature is checked at a time, that of an image first; and a wrong one costs the next a delay.
#[test]
fn a_request_waits_for_other_work() {
    let device = Device::sealed(&STANDARD_2);
    let file = seal(&sealer((false, false)), &image(STANDARD_2.region(1), 600, 1));
    device.run(|host| {
        let request = host.request(&keys().root, right::STORE, 0);
        // Work on the flash.
        host.command(1, CLEAR).unwrap();
        host.settle();
        host.begin(1, &file, 7).unwrap();
        assert_eq!(host.ask(&request), Err(DEVICE_STATE));
        host.settle();
        // The image is open, and the flash waits.
        assert_eq!(host.ask(&request), Err(DEVICE_STATE));
        host.end(1).unwrap();
        host.settle();
        assert_eq!(host.ask(&request), Ok(()));
        assert_eq!(host.ask(&request), Err(DEVICE_STATE), "one at a time");
        host.settle();
        assert_eq!(host.rights(), SEALED | right::STORE);
    });
    // A program for another device is no attack; a wrong signature is.
    for (file, expected, next) in [
        (forged(2, 5, 1), status::SIGNATURE, Err(DEVICE_STATE)),
        (seal(&Sealer { counter: 4, ..sealer((false, false)) }, &program(3)), status::ROLLBACK, Ok(())),
    ] {
        let device = Device::sealed(&STANDARD_1);
        device.run(|host| host.install(1, &sealed(1, 5, 1)));
        device.run(|host| {
            let request = host.request(&keys().root, right::STORE, 0);
            assert_eq!(host.update(1, &file, 7).1, expected);
            assert_eq!(host.ask(&request), next);
            host.settle();
            host.wait();
            let request = host.request(&keys().root, right::STORE, 0);
            assert_eq!(host.ask(&request), Ok(()));
        });
    }
}

#[test]
fn without_its_right_a_program_is_not_lost() {
    let device = Device::sealed(&STANDARD_1);
    device.run(|host| host.install(1, &sealed(1, 5, 1)));
    for command in [CLR_SIGNATURE, CLEAR] {
        device.run(|host| {
            host.command(1, CLEAR).unwrap();
            host.settle();
            assert!(host.command(1, command).is_err());
            assert_eq!(host.status(1), 0x84, "NO_ACCESS");
        });
    }
    assert!(device.verified(1).is_ok_and(|program| program.signed));
    // Each with its own.
    device.run(|host| {
        assert!(host.grant(&keys().root, right::CLEAR_SIGNATURE, 0));
        host.command(1, CLEAR).unwrap();
        host.settle();
        assert!(host.command(1, CLEAR).is_err());
        assert_eq!(host.commanded(1, CLR_SIGNATURE), 0);
    });
    assert!(device.verified(1).is_ok_and(|program| !program.signed));
    device.run(|host| {
        assert!(host.grant(&keys().root, right::ERASE, 0));
        assert!(host.command(1, CLR_SIGNATURE).is_err());
        host.erase(1);
    });
    assert!(device.verified(1).is_err());
}

/// A right for a lower counter is for one program, with this counter at least; the others stay.
#[test]
fn a_lower_counter_needs_its_right_each_time() {
    let device = Device::sealed(&STANDARD_1);
    device.run(|host| host.install(1, &sealed(1, 9, 1)));
    device.run(|host| {
        assert_eq!(host.update(1, &sealed(2, 5, 1), 7).1, status::ROLLBACK);
        assert!(host.grant(&keys().root, right::LOWER_COUNTER | right::READ_BACK, 5));
        // Its argument is for this right alone.
        assert!(host.grant(&keys().root, right::STORE, 0));
        assert_eq!(host.update(1, &sealed(2, 4, 1), 7).1, status::ROLLBACK);
        host.install(1, &sealed(2, 5, 1));
        assert_eq!(host.rights(), SEALED | right::READ_BACK | right::STORE);
        host.install(1, &sealed(1, 9, 2));
        assert_eq!(host.update(1, &sealed(2, 5, 2), 7).1, status::ROLLBACK);
    });
    assert!(device.holds(1, &program(1)));
}

/// The holder of a root opens the device for ever: from the next reset on it is as without keys.
#[test]
fn an_opened_device_stays_open() {
    let device = Device::sealed(&STANDARD_1);
    device.run(|host| {
        assert!(host.grant(&keys().root, right::OPEN, 0));
        // What is granted after it takes nothing back.
        assert!(host.grant(&keys().root, right::STORE, 0));
        assert_eq!(host.rights(), SEALED | right::OPEN | right::STORE);
        assert_ne!(host.update(1, &program(1), 7).1, status::OK);
    });
    device.run(|host| {
        assert_eq!(host.rights(), 0);
        host.install(1, &program(1));
    });
    assert!(device.holds(1, &program(1)));
}

/// A key block with a fault opens nothing: it accepts no image at all.
#[test]
fn a_damaged_key_block_accepts_nothing() {
    let good = keys_of_one_root();
    let check = |mut block: [u8; 256]| {
        let crc = crc32(&block[..252]);
        block[252..].copy_from_slice(&crc.to_le_bytes());
        block
    };
    assert_eq!(check(good), good);
    let flipped = |at: usize| {
        let mut block = good;
        block[at] ^= 1;
        block
    };
    for (what, block) in [
        ("its magic", check(flipped(0))),
        ("its CRC", flipped(252)),
        ("a bit of the root", flipped(30)),
        ("a bit that nothing reads", flipped(200)),
    ] {
        let device = Device::with_keys(&STANDARD_1, &block);
        device.run(|host| {
            assert_eq!(host.rights() & SEALED, SEALED, "{what}");
            assert_ne!(host.update(1, &sealed(1, 9, 1), 7).1, status::OK, "{what}");
            host.wait();
            assert_ne!(host.update(1, &program(1), 7).1, status::OK, "{what}");
        });
        assert!(device.verified(1).is_err(), "{what}");
    }
    Device::with_keys(&STANDARD_1, &good).run(|host| host.install(1, &sealed(1, 9, 1)));
}

/// With room for another root.
fn keys_of_one_root() -> [u8; 256] {
    key_block(&[keys().root.public()], &keys().keks, 0, 0, false).expect("it has room for them")
}

#[test]
fn the_log_tells_the_last_events_the_latest_first() {
    let device = Device::sealed(&STANDARD_1);
    let code = |status: u32| event::REFUSED | status;
    device.run(|host| {
        assert_eq!(host.log(), [[0; 4]; EVENTS]);
        host.install(1, &sealed(1, 5, 11));
        assert_eq!(host.event(1), [1, event::INSTALLED | 1, 5, 11]);
        // The same refusal once, another one between two of them.
        for _ in 0..3 {
            assert_eq!(host.update(1, &forged(2, 6, 12), 7).1, status::SIGNATURE);
        }
        assert_eq!(host.event(1), [2, code(status::SIGNATURE), 6, 12]);
        assert_eq!(host.update(1, &sealed(3, 4, 13), 7).1, status::ROLLBACK);
        assert_eq!(host.event(1), [3, code(status::ROLLBACK), 4, 13]);
        // A refusal that the log has, also after another one.
        assert_eq!(host.update(1, &forged(2, 6, 12), 7).1, status::SIGNATURE);
        assert_eq!(host.event(1), [3, code(status::ROLLBACK), 4, 13]);
        host.wait();
        let rights = right::ERASE | right::STORE;
        assert!(host.grant(&keys().root, rights, 0));
        assert_eq!(host.event(1)[..2], [4, event::UNLOCKED | rights]);
        assert_eq!(host.event(4), [1, event::INSTALLED | 1, 5, 11]);
        assert_eq!(host.event(5), [0; 4]);
    });
    // Each installation is told, but not the same image again; and the log is there after a reset.
    let before = device.run(|host| {
        let before = host.log();
        assert_eq!(before[0][..2], [4, event::UNLOCKED | right::ERASE | right::STORE]);
        for version in 20..30 {
            host.install(1, &sealed(version as u8, 5, version));
            host.install(1, &sealed(version as u8, 5, version));
        }
        host.log()
    });
    assert_eq!(before[0], [14, event::INSTALLED | 1, 5, 29]);
    let numbers: Vec<u32> = before.iter().map(|event| event[0]).collect();
    assert_eq!(numbers, (7..=14).rev().collect::<Vec<_>>());
    device.run(|host| assert_eq!(host.log(), before));
}

/// The boot stage locks the flash for a program, unless its owner has signed that it writes flash.
#[test]
fn the_flash_is_locked_unless_the_owner_has_signed_otherwise() {
    for writes_flash in [false, true] {
        let device = Device::sealed(&STANDARD_1);
        let file = seal(&Sealer { writes_flash, ..sealer((false, false)) }, &program(1));
        device.run(|host| host.install(1, &file));
        let is_locked = |device: &Device| device.verified(1).map(|program| program.locks_flash);
        assert_eq!(is_locked(&device).ok(), Some(!writes_flash));
        // Also where its release for autostart is stored anew.
        device.run(|host| {
            assert!(host.grant(&keys().root, right::CLEAR_SIGNATURE, 0));
            assert_eq!(host.commanded(1, CLR_SIGNATURE), 0);
        });
        assert_eq!(is_locked(&device).ok(), Some(!writes_flash));
    }
    let device = Device::open(&STANDARD_1);
    device.run(|host| host.install(1, &program(1)));
    assert_eq!(device.verified(1).map(|program| program.locks_flash).ok(), Some(false));
}
