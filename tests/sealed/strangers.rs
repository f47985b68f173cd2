//! What a bus master without rights can do to a sealed device, again and again: how often the device
//! writes its journal for him, which events stay, how fast he can try signatures, and that he cannot
//! undo what needs a right. On the model of the flash, in virtual time.

use boot_core::canopen::od::Address;
use boot_core::canopen::{BitRate, Instant, NodeId};
use coboot_tests::sealed::{
    block, certificate, image, keys, seal, sealer, Device, Host, Parts, Setup, CLEAR, CLR_SIGNATURE,
    ESACADEMY_2, LIFT_2, SET_SIGNATURE, STANDARD_1, STANDARD_2,
};
use coboot_tests::sealed_board::status;
use coflash_core::file::sealed::{Certificate, Sealer};
use seal::access::{event, right};
use shared_abi::warm_start::BootRequest;

/// Operations of the flash for a record: the journal's slot (docs/adr/0004).
const SLOT_WORDS: usize = 7;
/// Records between two erases of a region of 16 KiB.
const RECORDS: u32 = 16 * 1024 / 28 - 1;
/// Erases that a sector of the chip endures (datasheet DS8626 table 42).
const ENDURANCE: u32 = 10_000;

/// A sealed image of this program with this seed, counter and version.
fn sealed(setup: &Setup, program: u8, seed: u8, counter: u32) -> Vec<u8> {
    let data = setup.is_data(program);
    let sealer = Sealer { program, counter, version: seed.into(), data, ..sealer((false, false)) };
    seal(&sealer, &image(setup.region(program), 600, seed))
}

/// A device with each of its programs, at counter 5.
fn device_with_programs(setup: &'static Setup) -> Device {
    let device = Device::sealed(setup);
    for program in 1..=setup.programs() {
        device.run(|host| host.install(program, &sealed(setup, program, program, 5)));
    }
    device
}

/// A file for each error that anybody can cause, by the error's code in 1F57h.
fn refused_files(setup: &Setup, program: u8) -> Vec<(u32, Vec<u8>)> {
    let good = Parts::of(&sealed(setup, program, 0x77, 6));
    let large = 0x10_0000_u32.to_le_bytes();
    vec![
        (status::FORMAT, good.clone().with(7, &[0x80]).signed()),
        (0x0C, good.clone().with(28, &large).with(36, &large).signed()),
        (0x80, good.clone().with(8, &[1]).signed()),
        (0x82, good.clone().with(12, &[0x77]).signed()),
        (status::ROLLBACK, sealed(setup, program, 0x77, 4)),
        (status::KEY, good.clone().certified(&[]).signed_by(&keys().stranger).bytes()),
        (status::SIGNATURE, good.signed_by(&keys().stranger).bytes()),
    ]
}

/// The events of 2003h, the latest first.
fn log(host: &mut Host<'_>) -> Vec<[u32; 4]> {
    host.log().into_iter().filter(|event| event[0] > 0).collect()
}

/// The operations of the flash since the last call: in the journal, and elsewhere.
fn operations(device: &Device) -> (usize, usize) {
    let touched = std::mem::take(&mut device.chip.model().touched);
    let journal = device.setup.layout.parameters;
    let (own, others): (Vec<_>, Vec<_>) = touched
        .into_iter()
        .partition(|region| journal.iter().any(|place| place.contains(region.base, region.size)));
    (own.len(), others.len())
}

/// Everything that a master without a right, but with the published file of the installed program, can
/// send between two resets. Returns the time that it took, in ms.
fn everything(device: &Device, round: u32) -> u64 {
    let setup = device.setup;
    device.run(|host| {
        let password = setup.profile.password;
        let start = host.now;
        for program in 1..=setup.programs() {
            for command in [SET_SIGNATURE, CLR_SIGNATURE, SET_SIGNATURE, 0, 1, 2, CLEAR, CLEAR, 0x80, 0x84] {
                let _ = host.command(program, command);
                host.settle();
                host.node.take_boot_request();
            }
            for given in [&b"wrong"[..], password] {
                for at in [Address::new(0x7F50, program), Address::new(0x6005, 1)] {
                    let _ = host.node.write(at, given);
                    host.settle();
                }
                host.wait();
            }
            // Refusals of each kind, in turn.
            for (code, file) in refused_files(setup, program) {
                assert_eq!(host.update(program, &file, 7).1, code, "{}: {code:02X}h", setup.name);
            }
            // What is not sealed, the installed image once more, and a part of it.
            let region = setup.region(program);
            let installed = sealed(setup, program, program, 5);
            let unsealed = image(region, 600, 0x55);
            for file in [&unsealed, &block(0, 0, &[0; 8]), &installed, &installed[..500].to_vec()] {
                let _ = host.update(program, file, 7);
                host.node.take_boot_request();
            }
            host.wait();
            host.clear(program);
            host.begin(program, &installed[..300], 7).unwrap();
            host.settle();
            host.cancel(program);
            host.settle();
        }
        // LSS, each time with other values; and a right with a wrong signature.
        let id = NodeId::new(1 + (round % 100) as u8);
        assert!(host.node.store(id, Some(BitRate::K250)).is_ready());
        assert!(!host.grant(&keys().stranger, right::STORE, 0));
        let mut request = host.request(&keys().root, right::STORE, 0);
        request[20] ^= 1;
        assert_eq!(host.ask(&request), Ok(()));
        host.settle();
        u64::from(host.now - start)
    })
}

/// A stranger writes the journal for the first of his refusals of each kind, and then never again,
/// whatever he sends and however often he resets the device.
#[test]
fn a_stranger_cannot_wear_out_the_journal() {
    for setup in [&STANDARD_1, &STANDARD_2, &ESACADEMY_2, &LIFT_2] {
        let device = device_with_programs(setup);
        operations(&device);
        let mut stored = 0;
        let (mut time, mut rounds) = (0, 0);
        // The journal of a device that stored 91 values in a second was worn out after 42 hours.
        while time < 42 * 3600 * 1000 {
            time += everything(&device, rounds);
            let (journal, others) = operations(&device);
            assert_eq!(others, 0, "{}, round {rounds}", setup.name);
            assert!(rounds == 0 || journal == 0, "{}, round {rounds}: {journal} operations", setup.name);
            stored += journal;
            rounds += 1;
        }
        assert!(rounds > 20, "{rounds}");
        // Three refusals, and a wrong signature.
        assert_eq!(stored, 4 * SLOT_WORDS, "{}", setup.name);
        for program in 1..=setup.programs() {
            assert!(setup.is_data(program) || device.verified(program).is_ok_and(|program| program.signed));
        }
        assert!(!device.run(|host| host.node.is_finishing()));
    }
}

/// What is not bounded is an installation: only the owner signs an image. It wears out the flash of the
/// program long before the journal: docs/security.md has the numbers.
#[test]
fn an_installation_wears_the_flash_of_its_program_and_not_the_journal() {
    let device = device_with_programs(&STANDARD_1);
    let two = [sealed(&STANDARD_1, 1, 1, 5), sealed(&STANDARD_1, 1, 2, 5)];
    let mut most = 0;
    for round in 0..6 {
        operations(&device);
        device.run(|host| host.install(1, &two[(round + 1) % 2]));
        let (journal, _) = operations(&device);
        // An erase and copies, now and then, in the small journal of the model.
        most = most.max(if journal % SLOT_WORDS == 0 { journal / SLOT_WORDS } else { 0 });
    }
    assert!((1..=4).contains(&most), "{most} records for an installation");
    // Each region of the journal is erased once in `2 * RECORDS` records, each sector of the program
    // once in an installation.
    let erases = ENDURANCE * most as u32 / (2 * RECORDS);
    println!("{most} records each: {ENDURANCE} installations erase a region of the journal {erases} times");
    assert!(erases < ENDURANCE / 200);

    // An image that is begun and not completed is written into the journal once.
    device.run(|host| {
        for round in 0..20 {
            host.wait();
            host.clear(1);
            host.begin(1, &two[(round + 1) % 2], 7).unwrap();
            host.settle();
            host.cancel(1);
            host.settle();
            let (journal, others) = operations(host.device);
            assert!(others > 0, "it was not authentic");
            assert!(round == 0 || journal == 0, "round {round}: {journal} operations");
        }
    });
}

/// Refusals never push the owner's events out of the log: three kinds of them are recorded, once each,
/// and the wrong signature in any case.
#[test]
fn refusals_leave_room_for_the_other_events() {
    let device = device_with_programs(&STANDARD_1);
    device.run(|host| {
        assert!(host.grant(&keys().root, right::STORE, 0));
        for (seed, counter) in [(2, 5), (3, 5), (1, 5)] {
            host.install(1, &sealed(&STANDARD_1, 1, seed, counter));
        }
    });
    let own = device.run(log);
    assert_eq!(own.len(), 5);
    for _ in 0..3 {
        device.run(|host| {
            for (code, file) in refused_files(&STANDARD_1, 1) {
                assert_eq!(host.update(1, &file, 7).1, code);
            }
        });
    }
    let is_refusal = |event: &[u32; 4]| event[1] & 0xFFFF_0000 == event::REFUSED;
    let (refusals, others): (Vec<_>, Vec<_>) =
        device.run(log).into_iter().partition(|event| is_refusal(event));
    let codes: Vec<u32> = refusals.iter().map(|event| event[1] & 0xFFFF).collect();
    assert_eq!(codes, [status::SIGNATURE, 0x80, 0x0C, status::FORMAT]);
    // The log has eight places: the oldest of five makes room for the fourth refusal.
    assert_eq!(others, own[..4]);
    // The owner's next events push the refusals out, and there is room for others again.
    device.run(|host| {
        for round in 0..7 {
            host.install(1, &sealed(&STANDARD_1, 1, 2 + round % 2, 5));
        }
        assert_eq!(host.update(1, &refused_files(&STANDARD_1, 1)[3].1, 7).1, 0x82);
        assert_eq!(log(host)[0][1], event::REFUSED | 0x82);
    });
}

/// Tries a wrong signature whenever the device takes one, for two minutes, and does `between` after
/// each. Returns the number of signatures that were checked.
fn tries_in_two_minutes(setup: &'static Setup, mut between: impl FnMut(&mut Host<'_>)) -> u32 {
    let device = device_with_programs(setup);
    let (_, forged) = refused_files(setup, 1).pop().unwrap();
    let mut checked = 0;
    let mut now = 0;
    while now < 120_000 {
        // From here to a reset, if `between` makes one.
        now = device.run(|host| {
            let started = now;
            while now < 120_000 {
                host.now = now - started;
                host.node.set_time(Instant::from_millis(host.now));
                let _ = host.command(1, SET_SIGNATURE);
                host.settle();
                if setup.profile.download.locked {
                    host.clear(1);
                } else {
                    let _ = host.command(1, CLEAR);
                }
                if host.begin(1, &forged, 889).is_ok() {
                    let _ = host.end(1);
                    host.settle();
                    assert_eq!(host.status(1), status::SIGNATURE);
                    checked += 1;
                }
                between(host);
                now += 20;
                if host.node.take_boot_request() == Some(BootRequest::PowerOn) {
                    break;
                }
            }
            now
        });
    }
    checked
}

/// Half a second, a second … half a minute: neither 83h nor a password ends the wait, and a reset does
/// not make it short again.
#[test]
fn a_wait_after_wrong_signatures_ends_by_time() {
    for setup in [&STANDARD_1, &ESACADEMY_2, &LIFT_2] {
        let tries = tries_in_two_minutes(setup, |host| {
            let _ = host.command(1, SET_SIGNATURE);
            host.settle();
            for at in [Address::new(0x7F50, 1), Address::new(0x6005, 1)] {
                let _ = host.node.write(at, setup.profile.password);
                host.settle();
            }
        });
        // After 0, 0.5, 1.5, 3.5, 7.5, 15.5, 31.5, 63.5 and 95.5 seconds.
        assert_eq!(tries, 9, "{}", setup.name);
    }
    // With a reset as soon as the device makes one.
    for at_least in 1..=8 {
        let mut count = 0;
        let device = device_with_programs(&STANDARD_1);
        let (_, forged) = refused_files(&STANDARD_1, 1).pop().unwrap();
        let mut now = 0;
        while now < 120_000 {
            now += device.run(|host| {
                let mut tries = 0;
                loop {
                    host.node.set_time(Instant::from_millis(host.now));
                    if tries < at_least {
                        let _ = host.command(1, CLEAR);
                        host.settle();
                        if host.begin(1, &forged, 889).is_ok() {
                            let _ = host.end(1);
                            host.settle();
                            tries += 1;
                            count += 1;
                        }
                    } else if !host.node.is_finishing() {
                        return host.now;
                    }
                    if now + host.now >= 120_000 {
                        return host.now;
                    }
                    host.now += 20;
                }
            });
        }
        assert!((4..=18).contains(&count), "a reset after {at_least}: {count} signatures in two minutes");
    }
}

/// A complete genuine image, and a granted right, make the next wait the first one again.
#[test]
fn a_good_signature_makes_the_next_wait_short() {
    let device = device_with_programs(&STANDARD_1);
    let (_, forged) = refused_files(&STANDARD_1, 1).pop().unwrap();
    let waits_after = |host: &mut Host<'_>| {
        assert_eq!(host.update(1, &forged, 889).1, status::SIGNATURE);
        host.clear(1);
        (0..100_000).step_by(100).find(|later| {
            host.node.set_time(Instant::from_millis(host.now + later));
            let begins = host.begin(1, &forged[..100], 889).is_ok();
            host.cancel(1);
            host.settle();
            begins
        })
    };
    device.run(|host| {
        assert_eq!(waits_after(host), Some(500));
        assert_eq!(waits_after(host), Some(1000));
        // A begun image makes 83h wait.
        host.clear(1);
        assert_eq!(host.commanded(1, SET_SIGNATURE), 0);
        let _ = host.send(1, &[0; 40], 7);
        assert_eq!(waits_after(host), Some(2000), "83h is no signature");
        host.install(1, &sealed(&STANDARD_1, 1, 1, 5));
        assert_eq!(waits_after(host), Some(500), "a genuine image");
        assert_eq!(waits_after(host), Some(1000));
        host.wait();
        assert!(host.grant(&keys().root, right::STORE, 0));
        assert_eq!(waits_after(host), Some(500), "a right");
    });
}

/// A certificate of a higher epoch for one program revokes the earlier keys for all of them.
#[test]
fn a_key_that_is_revoked_signs_for_no_program() {
    for setup in [&STANDARD_2, &LIFT_2] {
        let device = device_with_programs(setup);
        let of_epoch = |program, epoch, seed| {
            let certificate = Certificate { epoch, ..certificate() };
            let certificate = Some(certificate.signed_by(&keys().root));
            let data = setup.is_data(program);
            let sealer = Sealer { program, certificate, data, ..sealer((false, false)) };
            seal(&sealer, &image(setup.region(program), 600, seed))
        };
        for (first, other) in [(1, 2), (2, 1)] {
            let device = device.copy();
            device.run(|host| host.install(first, &of_epoch(first, 6, 0x31)));
            // Also after a reset, and also when the program that has proved the epoch is gone.
            if !setup.profile.download.locked {
                device.run(|host| host.erase(first));
            }
            device.run(|host| {
                for program in [other, first] {
                    let (_, reported) = host.update(program, &of_epoch(program, 5, 0x32), 7);
                    assert_eq!(reported, status::ROLLBACK, "{}: {program} behind {first}", setup.name);
                    host.install(program, &of_epoch(program, 6, 0x33));
                }
            });
        }
    }
}

/// To release a program that was withdrawn needs the right that withdrew it; and no program releases it
/// by a confirmation. A program that was only never released needs no right.
#[test]
fn a_withdrawal_is_undone_by_its_right_alone() {
    let device = device_with_programs(&STANDARD_1);
    let is_released = |device: &Device| device.verified(1).is_ok_and(|program| program.signed);
    assert!(is_released(&device));
    device.run(|host| {
        assert_eq!(host.commanded(1, SET_SIGNATURE), 0, "nothing changes");
        assert!(host.grant(&keys().root, right::CLEAR_SIGNATURE, 0));
        assert_eq!(host.commanded(1, CLR_SIGNATURE), 0);
    });
    assert!(!is_released(&device));
    assert_eq!(device.starts(None), None);
    for right in [0, right::ERASE | right::STORE] {
        device.run(|host| {
            assert!(right == 0 || host.grant(&keys().root, right, 0));
            assert!(host.command(1, SET_SIGNATURE).is_err());
            assert_eq!(host.status(1), status::NO_ACCESS);
            host.confirm(1);
            // The same image again does not release it either.
            host.install(1, &sealed(&STANDARD_1, 1, 1, 5));
        });
        assert!(!is_released(&device));
    }
    let record = device.record(1).unwrap();
    assert!(record.withdrawn && record.confirmed);
    // It can be started for once, by a request, as every genuine program.
    assert_eq!(device.starts(Some(BootRequest::Trial(1))), Some(1));
    device.run(|host| {
        assert!(host.grant(&keys().root, right::CLEAR_SIGNATURE, 0));
        assert_eq!(host.commanded(1, SET_SIGNATURE), 0);
    });
    assert!(is_released(&device));
    // In a device without keys nobody has rights, and everybody may do everything.
    let device = Device::open(&STANDARD_1);
    device.run(|host| {
        host.install(1, &image(STANDARD_1.region(1), 600, 1));
        for _ in 0..2 {
            assert_eq!(host.commanded(1, CLR_SIGNATURE), 0);
            assert_eq!(host.commanded(1, SET_SIGNATURE), 0);
        }
    });
    assert!(is_released(&device));
}
