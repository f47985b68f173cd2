//! Sealed images on the flash model: installations, the refusals of a sealed device, the programs
//! of a device that is not sealed, and the security counter.

use boot_core::canopen::{AbortCode, BitRate, NodeId};
use boot_core::flash::FlashFault;
use boot_core::program::Invalid;
use coboot_tests::sealed::{
    block, certificate, crc32, default_keys, image, keys, seal, sealer, Device, Host, Setup, CLEAR,
    CLR_SIGNATURE, CONFIRMED_1, CONSTANT_1, EPOCH, ESACADEMY_2, FORMS, LIFT_2, SET_SIGNATURE, STANDARD_1,
    STANDARD_2, START,
};
use coboot_tests::sealed_board::status::{KEY, NO_ACCESS, ROLLBACK, SIGNATURE, WRONG_PRODUCT};
use coflash_core::file::sealed::{key_block, Certificate, Sealer};
use kit::ihex::intel_hex;

/// NOT_CLEARED, NO_VALID_PROGRAM in 1F57h.
const NOT_CLEARED: u32 = 0x08;
const NO_PROGRAM: u32 = 0x02;

fn program(len: usize, seed: u8) -> Vec<u8> {
    image(STANDARD_1.region(1), len, seed)
}

/// Counter and version of an image of program 1.
fn of_counter(counter: u32, version: u32, image: &[u8]) -> Vec<u8> {
    seal(&Sealer { counter, version, ..sealer((false, false)) }, image)
}

/// The properties of an image that was just installed.
fn is_installed(host: &mut Host<'_>, number: u8, image: &[u8]) {
    let device = host.device;
    assert_eq!(host.state(number), 0, "stopped");
    assert_eq!(host.identification(number), crc32(image));
    assert!(device.holds(number, image));
    assert_eq!(host.start(number), Some(number), "START");
}

// --- good images

#[test]
fn a_good_image_of_every_form_is_installed() {
    // Around the borders of chunks and of sectors, and the whole flash.
    let sizes =
        [8, 9, 511, 512, 513, 1000, 1023, 1024, 1025, 2047, 2048, 2049, 4096, 4097, 8191, 8192, 8193, 15_360];
    let pieces = [1, 2, 3, 4, 5, 6, 7, 889];
    let mut number = 0;
    for form in FORMS {
        for chunk in 9..=13 {
            for size in sizes {
                let image = program(size, number as u8);
                let file = seal(&Sealer { chunk, ..sealer(form) }, &image);
                let piece = pieces[number % pieces.len()];
                number += 1;
                let reported = format!("{form:?}, chunks of 2^{chunk}, {size} bytes, {piece} at a time");
                let device = Device::sealed(&STANDARD_1);
                device.run(|host| {
                    assert_eq!(host.update(1, &file, piece), (Ok(()), 0), "{reported}");
                    // The size in the manifest.
                    assert_eq!(host.identification(1).to_le_bytes(), file[32..36], "{reported}");
                    is_installed(host, 1, &image);
                });
                assert_eq!(device.starts(None), Some(1), "{reported}");
                assert_eq!(device.counter(1), 5, "{reported}");
            }
        }
    }
}

/// The end of such an image is one symbol that gives more bytes than are decompressed at a time.
#[test]
fn an_image_that_ends_in_a_long_run_is_installed() {
    for run in [0, 1, 200, 273, 274, 511, 512, 513, 600, 3000] {
        for before in [501, 512, 1023, 1024, 1025, 1300] {
            for fill in [0, 0xFF] {
                let mut image = program(before, 7);
                image.resize(before + run, fill);
                for form in [(false, true), (true, true)] {
                    let device = Device::sealed(&STANDARD_1);
                    device.run(|host| host.install(1, &seal(&Sealer { chunk: 9, ..sealer(form) }, &image)));
                    assert!(device.holds(1, &image), "{form:?} {before} and {run} of {fill:02X}h");
                }
            }
        }
    }
}

/// Replaces another program, with any number of bytes at a time, with the smallest buffer and a
/// large one.
#[test]
fn however_it_is_cut_into_segments() {
    let (old, new) = (program(3000, 1), program(2600, 2));
    let before = Device::sealed(&STANDARD_1);
    before.run(|host| host.install(1, &of_counter(5, 1, &old)));
    for form in FORMS {
        let file = seal(&Sealer { chunk: 9, ..sealer(form) }, &new);
        for buffer in [64, 256, 16 * 1024] {
            for piece in [1, 2, 3, 4, 5, 6, 7, 889] {
                if piece > buffer / 4 {
                    continue;
                }
                let mut device = before.copy();
                device.buffer = buffer;
                device.run(|host| {
                    assert_eq!(host.update(1, &file, piece), (Ok(()), 0), "{form:?} {buffer} {piece}");
                    is_installed(host, 1, &new);
                });
            }
        }
    }
}

/// Without a certificate; by the second root; by a certificate for only this product.
#[test]
fn each_way_to_be_signed_is_taken() {
    let image = program(700, 3);
    let plain = sealer((false, false));
    let root = Sealer { certificate: None, ..plain.clone() };
    let of = |certificate: Certificate, root| Sealer {
        certificate: Some(certificate.signed_by(root)),
        ..plain.clone()
    };
    let product = Certificate { product_code: coboot_tests::sealed::PRODUCT_CODE, ..certificate() };
    let narrow = Certificate { lowest: 5, highest: 5, ..certificate() };
    let files = [
        root.seal(&image, &keys().root),
        root.seal(&image, &keys().second_root),
        of(certificate(), &keys().second_root).seal(&image, &keys().release),
        of(product, &keys().root).seal(&image, &keys().release),
        of(narrow, &keys().root).seal(&image, &keys().release),
    ];
    for file in files {
        let device = Device::sealed(&STANDARD_1);
        device.run(|host| {
            host.install(1, &file.expect("it can be sealed"));
            is_installed(host, 1, &image);
        });
    }
}

/// The device properties in a manifest.
#[test]
fn an_image_for_this_very_device_is_taken() {
    let image = program(700, 3);
    let device = Device::sealed(&STANDARD_1);
    let file = seal(
        &Sealer {
            unique_id: coboot_tests::sealed::UNIQUE_ID,
            hardware: 1 << 2,
            text: Some("for one"),
            source: Some("revision"),
            sbom: Some([7; 32]),
            writes_flash: true,
            ..sealer((true, true))
        },
        &image,
    );
    device.run(|host| {
        host.install(1, &file);
        is_installed(host, 1, &image);
    });
}

#[test]
fn a_test_key_signs_for_devices_that_are_marked_for_tests() {
    let image = program(700, 3);
    let file = seal(&Sealer { test: true, ..sealer((false, false)) }, &image);
    let marked = key_block(&[keys().root.public()], &[], 0, 0, true).unwrap();
    Device::with_keys(&STANDARD_1, &marked).run(|host| host.install(1, &file));
    Device::sealed(&STANDARD_1).run(|host| assert_eq!(host.update(1, &file, 7).1, KEY));
}

// --- the same again

#[test]
fn the_same_image_again_costs_nothing() {
    for form in FORMS {
        let image = program(2500, 9);
        let file = seal(&Sealer { chunk: 10, ..sealer(form) }, &image);
        let device = Device::sealed(&STANDARD_1);
        device.run(|host| host.install(1, &file));
        let record = device.record(1);
        device.take_touched();
        for _ in 0..2 {
            device.run(|host| {
                host.install(1, &file);
                is_installed(host, 1, &image);
                assert!(!device.was_touched(1), "{form:?}");
            });
        }
        assert_eq!((device.record(1), device.counter(1)), (record, 5));
        // It is checked all the same.
        let mut damaged = file.clone();
        *damaged.last_mut().unwrap() ^= 1;
        device.run(|host| {
            assert_eq!(host.update(1, &damaged, 7).1, SIGNATURE);
            assert!(device.holds(1, &image) && !device.was_touched(1));
        });
        // Another version with the same counter is another image, even if all program bytes are
        // equal.
        let other = seal(&Sealer { version: 2, chunk: 10, ..sealer(form) }, &image);
        device.run(|host| {
            host.install(1, &other);
            assert!(device.was_touched(1));
            is_installed(host, 1, &image);
        });
        assert_eq!(device.record(1).unwrap().version, 2);
    }
}

// --- sealed devices and open ones

/// The same program in every unsealed form: the refused transfer, and the transfer before it, which
/// is not refused because it does not show the format yet.
fn unsealed(setup: &Setup, number: u8, image: &[u8]) -> [(Option<Vec<u8>>, Vec<u8>); 3] {
    let base = setup.region(number).base;
    let control = (!setup.is_data(number)).then(|| block(0, 0, &[0; 8]));
    let hex = intel_hex(base, image).into_bytes();
    [(None, image.to_vec()), (None, hex), (control, block(1, base, &image[..256]))]
}

#[test]
fn a_sealed_device_takes_nothing_unsealed() {
    for setup in [&STANDARD_1, &STANDARD_2, &ESACADEMY_2, &LIFT_2] {
        for installed in [false, true] {
            for number in 1..=setup.programs() {
                let old = image(setup.region(number), 900, 1);
                let sealed =
                    Sealer { program: number, data: setup.is_data(number), ..sealer((false, false)) };
                let device = Device::sealed(setup);
                if installed {
                    device.run(|host| host.install(number, &seal(&sealed, &old)));
                }
                device.take_touched();
                for (before, data) in unsealed(setup, number, &image(setup.region(number), 900, 2)) {
                    for piece in [7, 889] {
                        device.run(|host| {
                            let (abort, status) = match &before {
                                Some(before) => {
                                    assert_eq!(host.update(number, before, piece), (Ok(()), 0));
                                    host.send(number, &data, piece)
                                }
                                None => host.update(number, &data, piece),
                            };
                            assert_eq!((abort, status), (Err(AbortCode::STORE), NO_ACCESS), "{}", setup.name);
                            assert!(!device.was_touched(number));
                            // A download of blocks that has begun is not a program that can be
                            // released.
                            if !installed && before.is_none() {
                                host.node.take_boot_request();
                                assert_eq!(host.commanded(number, SET_SIGNATURE), NO_PROGRAM);
                            }
                        });
                        assert_eq!(
                            device.record(number).is_some(),
                            installed,
                            "{} {number} {installed}",
                            setup.name
                        );
                        if !setup.is_data(number) {
                            assert_eq!(device.holds(number, &old), installed);
                        }
                    }
                }
            }
        }
    }
}

/// A device that was not sealed when it got its program.
#[test]
fn a_program_from_before_the_keys_has_no_rights() {
    let image = program(900, 1);
    let device = Device::open(&STANDARD_1);
    device.run(|host| host.install(1, &image));
    assert_eq!(device.starts(None), Some(1));
    let block = STANDARD_1.layout.key_block();
    device.chip.model().poke(block.base, &default_keys());
    device.take_touched();
    assert_eq!(device.verified(1), Err(Invalid::Absent));
    assert_eq!(device.starts(None), None);
    device.run(|host| {
        assert_eq!(host.state(1), 3, "there is none");
        assert_eq!(host.commanded(1, SET_SIGNATURE), NO_PROGRAM);
        assert_eq!(host.commanded(1, START), NO_PROGRAM);
        assert_eq!(host.node.take_boot_request(), None);
        assert_eq!(device.take_touched(), []);
        let sealed = seal(&sealer((true, true)), &image);
        host.install(1, &sealed);
        is_installed(host, 1, &image);
    });
    assert_eq!(device.starts(None), Some(1));
}

/// An unsealed program with and without a release, and the request of a trial.
#[test]
fn an_open_device_is_as_before_and_takes_no_sealed_image() {
    let image = program(900, 1);
    let raw = program(600, 2);
    for form in FORMS {
        let device = Device::open(&STANDARD_1);
        let file = seal(&sealer(form), &image);
        device.run(|host| {
            assert_eq!(host.send(1, &file, 7).1, KEY);
            assert_eq!(device.take_touched(), []);
            host.install(1, &raw);
            assert_eq!(host.start(1), Some(1));
            let hex = intel_hex(STANDARD_1.region(1).base, &image).into_bytes();
            host.install(1, &hex);
            is_installed(host, 1, &image);
            device.take_touched();
            assert_eq!(host.update(1, &file, 7).1, KEY);
            assert_eq!(device.take_touched(), []);
        });
        assert!(device.holds(1, &image));
        assert_eq!(device.starts(None), Some(1));
    }
}

/// Without CLEAR, like every other format.
#[test]
fn an_installed_program_stays_without_clear() {
    let device = Device::sealed(&STANDARD_1);
    let image = program(900, 1);
    device.run(|host| host.install(1, &of_counter(5, 1, &image)));
    device.run(|host| {
        device.take_touched();
        let (abort, status) = host.send(1, &of_counter(6, 1, &program(900, 2)), 7);
        assert_eq!((abort, status), (Err(AbortCode::DEVICE_STATE), NOT_CLEARED));
        assert_eq!(device.take_touched(), []);
        is_installed(host, 1, &image);
        // STOP counts as CLEAR for one image; it needs no right, and what is not genuine costs nothing.
        let newer = program(900, 2);
        let genuine = of_counter(6, 1, &newer);
        let mut forged = genuine.clone();
        forged[100] ^= 1;
        for (file, is_good) in [(&forged, false), (&forged, false), (&genuine, true)] {
            host.wait();
            host.command(1, 0x00).unwrap();
            assert_eq!(host.send(1, file, 7).1 == 0, is_good);
            is_installed(host, 1, if is_good { &newer } else { &image });
        }
        assert_eq!(host.send(1, &of_counter(7, 1, &image), 7).1, NOT_CLEARED);
    });
}

// --- the counter

fn refused(device: &Device, counter: u32, code: u32) {
    device.take_touched();
    device.run(|host| {
        assert_eq!(host.update(1, &of_counter(counter, 9, &program(900, 99)), 7).1, code, "{counter}");
        assert_eq!(device.take_touched(), []);
    });
}

#[test]
fn the_counter_never_goes_back() {
    let device = Device::sealed(&STANDARD_1);
    for (counter, version) in [(5, 1), (5, 2), (7, 1), (1000, 1)] {
        let image = program(900, version as u8 + counter as u8);
        device.run(|host| host.install(1, &of_counter(counter, version, &image)));
        assert_eq!(device.counter(1), counter);
        for lower in [0, 1, counter - 1] {
            refused(&device, lower, ROLLBACK);
        }
        assert!(device.holds(1, &image));
        // Erasing the program does not help either.
        let emptied = device.copy();
        emptied.run(|host| host.erase(1));
        assert!(emptied.record(1).is_none());
        refused(&emptied, counter - 1, ROLLBACK);
        assert_eq!(emptied.counter(1), counter);
        emptied.run(|host| host.install(1, &of_counter(counter, 1, &image)));
    }
    // No certificate permits this counter any more.
    let root = Sealer { certificate: None, counter: u32::MAX, ..sealer((false, false)) };
    let image = program(900, 1);
    let file = root.seal(&image, &keys().root).unwrap();
    device.run(|host| host.install(1, &file));
    assert_eq!(device.counter(1), u32::MAX);
    refused(&device, 1000, ROLLBACK);
    device.run(|host| host.install(1, &file));
}

#[test]
fn constants_of_the_bootloader_and_of_production_count_too() {
    let of_block = |counter, epoch| key_block(&[keys().root.public()], &[], counter, epoch, false).unwrap();
    for (setup, counter, lowest) in [(&STANDARD_1, 8, 8), (&CONSTANT_1, 0, 6), (&CONSTANT_1, 9, 9)] {
        let device = Device::with_keys(setup, &of_block(counter, EPOCH));
        refused(&device, lowest - 1, ROLLBACK);
        device.run(|host| host.install(1, &of_counter(lowest, 1, &program(900, 1))));
        assert_eq!(device.counter(1), lowest);
    }
    let device = Device::with_keys(&STANDARD_1, &of_block(0, EPOCH + 1));
    refused(&device, 5, ROLLBACK);
}

/// A certificate with a higher epoch revokes the earlier ones.
#[test]
fn the_epoch_never_goes_back() {
    let device = Device::sealed(&STANDARD_1);
    let of_epoch = |epoch, image: &[u8]| {
        let certificate = Certificate { epoch, ..certificate() };
        let certificate = Some(certificate.signed_by(&keys().root));
        seal(&Sealer { certificate, ..sealer((false, false)) }, image)
    };
    let (one, two) = (program(900, 1), program(900, 2));
    device.run(|host| {
        host.install(1, &of_epoch(4, &one));
        host.install(1, &of_epoch(6, &two));
        device.take_touched();
        assert_eq!(host.update(1, &of_epoch(5, &one), 7).1, ROLLBACK);
        assert_eq!(device.take_touched(), []);
        host.install(1, &of_epoch(6, &one));
    });
    // The same image with a certificate of a higher epoch revokes them as well.
    device.run(|host| {
        host.install(1, &of_epoch(7, &one));
        assert_eq!(host.update(1, &of_epoch(6, &two), 7).1, ROLLBACK);
    });
}

/// Raised when the program has returned the device, and not before.
#[test]
fn with_confirmation_the_counter_waits_for_it() {
    let device = Device::sealed(&CONFIRMED_1);
    let (one, two) = (program(900, 1), program(900, 2));
    device.run(|host| host.install(1, &of_counter(5, 1, &one)));
    // A program that does not start can be replaced by the previous one.
    device.run(|host| {
        host.install(1, &of_counter(9, 2, &two));
        host.install(1, &of_counter(5, 1, &one));
        host.confirm(1);
    });
    // Nor does such a program leave its counter behind when it is erased.
    device.copy().run(|host| {
        host.install(1, &of_counter(9, 2, &two));
        host.erase(1);
        host.install(1, &of_counter(5, 1, &one));
    });
    refused(&device, 4, ROLLBACK);
    device.copy().run(|host| host.install(1, &of_counter(6, 1, &two)));
    device.run(|host| {
        host.install(1, &of_counter(9, 2, &two));
        host.confirm(1);
        assert!(device.record(1).unwrap().confirmed);
    });
    refused(&device, 8, ROLLBACK);
    // Whatever happens to the program that has proved itself.
    let voided = device.copy();
    voided.run(|host| host.erase(1));
    refused(&voided, 8, ROLLBACK);
    let broken_off = device.copy();
    broken_off.run(|host| {
        host.clear(1);
        let file = of_counter(9, 3, &program(5000, 3));
        host.begin(1, &file[..5000], 7).unwrap();
        host.settle();
    });
    assert!(broken_off.record(1).is_none());
    refused(&broken_off, 8, ROLLBACK);
    let replaced = device.copy();
    replaced.run(|host| host.install(1, &of_counter(10, 3, &one)));
    refused(&replaced, 8, ROLLBACK);
    replaced.run(|host| host.install(1, &of_counter(9, 4, &two)));
}

/// The proved counter is stored before the record goes. If that fails, the record stays.
#[test]
fn a_store_that_fails_does_not_lower_the_counter() {
    let device = Device::sealed(&CONFIRMED_1);
    device.run(|host| {
        host.install(1, &of_counter(9, 2, &program(900, 2)));
        host.confirm(1);
    });
    let another = of_counter(9, 3, &program(5000, 3));
    let mut kept = 0;
    for operation in 1..=12 {
        let failing = device.copy();
        failing.run(|host| {
            let done = failing.chip.model().operations;
            failing.chip.model().fail = Some((done + operation, FlashFault::Failed));
            host.clear(1);
            let _ = host.begin(1, &another[..5000], 7);
            host.settle();
        });
        failing.chip.model().fail = None;
        kept += u32::from(failing.record(1).is_some());
        failing.run(|host| {
            assert_eq!(host.update(1, &of_counter(8, 9, &program(900, 99)), 7).1, ROLLBACK, "{operation}");
        });
    }
    assert!(kept > 0, "an operation before the record goes");
}

// --- two programs

#[test]
fn each_program_has_its_own_images_and_its_own_counter() {
    let device = Device::sealed(&STANDARD_2);
    let places = [STANDARD_2.region(1), STANDARD_2.region(2)];
    let images = places.map(|place| image(place, 900, 1));
    let of =
        |program, counter, image: &[u8]| seal(&Sealer { program, counter, ..sealer((true, true)) }, image);
    device.run(|host| {
        for number in [1, 2] {
            let other = 3 - number;
            let file = of(other, 5, &images[usize::from(other) - 1]);
            device.take_touched();
            assert_eq!(host.update(number, &file, 7).1, WRONG_PRODUCT);
            assert_eq!(device.take_touched(), []);
        }
        host.install(1, &of(1, 9, &images[0]));
        assert_eq!((device.counter(1), device.counter(2)), (9, 0));
        host.install(2, &of(2, 5, &images[1]));
        assert_eq!((device.counter(1), device.counter(2)), (9, 5));
        assert_eq!(host.update(1, &of(1, 8, &images[0]), 7).1, ROLLBACK);
        host.install(2, &of(2, 8, &images[1]));
        is_installed(host, 1, &images[0]);
        is_installed(host, 2, &images[1]);
    });
}

/// A lift: its parameters are any bytes, and images of its program are not parameters.
#[test]
fn data_of_the_application_are_sealed_as_data() {
    let device = Device::sealed(&LIFT_2);
    let bytes: Vec<u8> = (0..3000_u32).map(|i| (i * i / 8) as u8).collect();
    let data = Sealer { program: 2, data: true, ..sealer((true, true)) };
    device.run(|host| {
        assert_eq!(
            host.update(2, &seal(&Sealer { data: false, ..data.clone() }, &bytes), 7).1,
            WRONG_PRODUCT
        );
        for piece in [4, 5, 6, 7, 889] {
            assert_eq!(host.update(2, &seal(&data, &bytes), piece), (Ok(()), 0));
        }
        assert_eq!(device.cells(2, bytes.len()), bytes);
        assert_eq!(host.start(2), None);
        let program = image(LIFT_2.region(1), 900, 1);
        assert_eq!(
            host.update(1, &seal(&Sealer { data: true, ..sealer((false, false)) }, &program), 7).1,
            0x82
        );
        host.install(1, &seal(&sealer((false, false)), &program));
    });
}

// --- in between

/// Something that comes at any moment of an update of program 1; `strange` is for program 2.
type Between = fn(&mut Host<'_>, file: &[u8], strange: &[u8]);

const BETWEEN: [(&str, Between); 14] = [
    ("CLEAR of 1", |host, _, _| host.command(1, CLEAR).unwrap_or(())),
    ("CLEAR of 2", |host, _, _| host.command(2, CLEAR).unwrap_or(())),
    ("START of 1", |host, _, _| host.command(1, START).unwrap_or(())),
    ("START of 2", |host, _, _| host.command(2, START).unwrap_or(())),
    ("83h of 1", |host, _, _| host.command(1, SET_SIGNATURE).unwrap_or(())),
    ("83h of 2", |host, _, _| host.command(2, SET_SIGNATURE).unwrap_or(())),
    ("84h of 1", |host, _, _| host.command(1, CLR_SIGNATURE).unwrap_or(())),
    ("84h of 2", |host, _, _| host.command(2, CLR_SIGNATURE).unwrap_or(())),
    ("LSS store", |host, _, _| {
        let _ = host.node.store(NodeId::new(9), Some(BitRate::K125));
    }),
    ("rights", |host, _, _| {
        host.grant(&keys().root, 0xFF, 0);
    }),
    ("confirmation", |host, _, _| host.node.confirm(1)),
    ("a transfer to 2", |host, _, strange| host.begin(2, &strange[..300], 7).unwrap_or(())),
    ("a transfer to 1", |host, file, _| host.begin(1, &file[..300], 7).unwrap_or(())),
    ("an abort", |host, _, _| host.cancel(1)),
];

/// Commands, passwords, LSS, rights and another transfer at every stage of an update: it ends as
/// without them, or it is refused; and only authentic bytes are written to the flash of the
/// program.
#[test]
fn nothing_that_comes_in_between_gets_past_the_signature() {
    let region = STANDARD_2.region(1);
    let (old, new) = (image(region, 600, 1), image(region, 1500, 2));
    let other = image(STANDARD_2.region(2), 600, 3);
    let before = Device::sealed(&STANDARD_2);
    let of = |program, image: &[u8]| {
        seal(&Sealer { program, version: image.len() as u32, chunk: 9, ..sealer((true, true)) }, image)
    };
    let (file, strange) = (of(1, &new), of(2, &other));
    before.run(|host| {
        host.install(1, &of(1, &old));
        host.install(2, &strange);
    });
    let check = |right: bool, between: Between, at: usize, steps: u32, reported: &str| {
        let device = before.copy();
        device.run(|host| {
            if right {
                assert!(host.grant(&keys().root, 0x1B, 0), "{reported}");
            }
            host.clear(1);
            let mut sent = host.begin(1, &file[..at], 7);
            match steps {
                u32::MAX => host.settle(),
                steps => host.steps(steps),
            }
            between(host, &file, &strange);
            host.steps(steps.min(40));
            if sent.is_ok() {
                sent = host.go_on(1, &file[at..], 7).and_then(|()| host.end(1));
            }
            host.settle();
            host.node.take_boot_request();
            let whole = device.holds(1, &new);
            assert!(whole || device.holds(1, &old) || device.record(1).is_none(), "{reported}");
            assert!(sent.is_err() || whole || host.status(1) != 0, "{reported}");
            assert!(device.holds(2, &other), "{reported}");
            for touched in device.take_touched() {
                assert!(region.contains(touched.base, touched.size), "{reported}: {touched:?}");
            }
        });
        device.run(|host| assert_eq!(host.update(1, &file, 7), (Ok(()), 0), "{reported}"));
        assert!(device.holds(1, &new), "{reported}");
    };
    for right in [false, true] {
        for (what, between) in BETWEEN {
            for at in (0..=file.len()).step_by(60) {
                for steps in [0, 3, 40, u32::MAX] {
                    let reported = format!("{what} after {at} bytes and {steps} steps, rights: {right}");
                    check(right, between, at, steps, &reported);
                }
            }
        }
    }
}
