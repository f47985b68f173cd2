//! A sealed image in pieces, on the model of the flash: in the blocks of a block file, of any size and
//! with one that is not right (on the emulated chip: `blocks.rs`), slowly, and with a manifest
//! that the owner has signed and that is not true.

use boot_core::flash::FlashFault;
use canopen::od::Address;
use canopen::AbortCode;
use coboot_tests::sealed::{
    block, crc32, image, keys, seal, sealer, Device, Host, Parts, CLEAR, FORMS, STANDARD_1, STANDARD_2,
};
use coboot_tests::sealed_board::status;
use coflash_core::file::convert::blocks_of_sealed;
use coflash_core::file::sealed::{SealedFile, Sealer};

/// The blocks of a sealed image.
fn blocks(file: &[u8], size: usize) -> Vec<Vec<u8>> {
    let file = SealedFile::parse(file.to_vec()).expect("it is one");
    let blocks = blocks_of_sealed(&file, STANDARD_1.region(1).base, size).expect("it can be cut");
    blocks.blocks().iter().map(|block| block.emit_with(blocks.checksum())).collect()
}

/// Sends the blocks, with this many bytes at once; returns the first status that is not OK.
fn send_all(host: &mut Host<'_>, blocks: &[Vec<u8>], piece: usize) -> u32 {
    assert_eq!(host.commanded(1, CLEAR), status::OK);
    let words = blocks.iter().map(|block| host.send(1, block, piece).1);
    words.into_iter().find(|word| *word != status::OK).unwrap_or(status::OK)
}

#[test]
fn a_sealed_image_is_installed_from_blocks_of_any_size() {
    let region = STANDARD_1.region(1);
    for (form, seed) in FORMS.into_iter().zip(1..) {
        let image = image(region, 1900, seed);
        let file = seal(&sealer(form), &image);
        for (size, piece) in [(40, 7), (100, 20), (128, 1), (1000, 7), (1500, 100)] {
            let device = Device::sealed(&STANDARD_1);
            let blocks = blocks(&file, size);
            device.run(|host| assert_eq!(send_all(host, &blocks, piece), status::OK, "{form:?}, {size}"));
            assert!(device.holds(1, &image), "{form:?}, {size}");
        }
    }
}

#[test]
fn a_wrong_block_costs_nothing() {
    let region = STANDARD_1.region(1);
    let old = image(region, 700, 1);
    let new = seal(&sealer((false, false)), &image(region, 900, 2));
    let good = blocks(&new, 128);
    /// A block with other data and a matching CRC.
    fn changed(original: &[u8], change: impl Fn(&mut [u8])) -> Vec<u8> {
        let word = |at: usize| u32::from_le_bytes(original[at..at + 4].try_into().unwrap());
        let mut data = original[12..original.len() - 4].to_vec();
        change(&mut data);
        block(word(0), word(4), &data)
    }
    type Spoil = fn(&mut Vec<Vec<u8>>);
    let cases: [(&str, Spoil, u32); 8] = [
        ("a bit of the manifest", |all| all[1] = changed(&all[1], |data| data[50] ^= 1), status::SIGNATURE),
        ("a bit, and the CRC of its block", |all| all[1][50] ^= 1, status::CRC),
        ("no sealed image", |all| all[1] = changed(&all[1], |data| data[0] ^= 1), status::NO_ACCESS),
        (
            "no sealed image by its last letter",
            |all| all[1] = changed(&all[1], |data| data[3] ^= 1),
            status::NO_ACCESS,
        ),
        ("a block is left out", |all| drop(all.remove(2)), status::SEQUENCE),
        (
            "block 0 of another program in the middle",
            |all| all.insert(2, changed(&all[0], |data| data[0] ^= 1)),
            status::SEQUENCE,
        ),
        ("the end too early", |all| drop(all.drain(2..all.len() - 1)), status::FORMAT),
        ("nothing but the end", |all| drop(all.drain(1..all.len() - 1)), status::SEQUENCE),
    ];
    for (what, spoil, expected) in cases {
        let device = Device::sealed(&STANDARD_1);
        device.run(|host| host.install(1, &seal(&sealer((false, false)), &old)));
        let mut blocks = good.clone();
        spoil(&mut blocks);
        device.take_touched();
        device.run(|host| {
            assert_eq!(send_all(host, &blocks, 7), expected, "{what}");
            assert!(!device.was_touched(1), "{what}");
            host.wait();
            assert_eq!(send_all(host, &good, 7), status::OK, "{what}");
        });
        assert!(device.holds(1, &image(region, 900, 2)), "{what}");
    }
}

/// The blocks of a program that is not sealed, which has a block 1 without a manifest.
#[test]
fn blocks_of_an_unsealed_program_are_refused() {
    let region = STANDARD_2.region(1);
    let program = image(region, 600, 3);
    let device = Device::sealed(&STANDARD_2);
    device.run(|host| host.install(1, &seal(&sealer((false, false)), &image(region, 700, 1))));
    device.take_touched();
    device.run(|host| {
        assert_eq!(host.commanded(1, CLEAR), status::OK);
        assert_eq!(host.send(1, &block(0, 0, &[0; 8]), 7).1, status::OK);
        assert_eq!(host.send(1, &block(1, region.base, &program), 7).1, status::NO_ACCESS);
        host.wait();
        // For the other program, sealed.
        let other = image(STANDARD_2.region(2), 600, 4);
        let sealer = Sealer { program: 2, ..sealer((false, false)) };
        host.install(2, &sealer.seal(&other, &keys().release).unwrap());
    });
    assert!(!device.was_touched(1) && device.holds(1, &image(region, 700, 1)));
}

/// A block 0 begins anew, except in a sealed image: what has come of that is used up.
#[test]
fn a_block_0_comes_once() {
    let region = STANDARD_1.region(1);
    let first = block(0, 0, &[0; 8]);
    for (device, second) in
        [(Device::sealed(&STANDARD_1), status::SEQUENCE), (Device::open(&STANDARD_1), status::OK)]
    {
        device.run(|host| {
            assert_eq!(host.commanded(1, CLEAR), status::OK);
            assert_eq!(host.send(1, &first, 7), (Ok(()), status::OK));
            assert_eq!(host.send(1, &first, 7).1, second);
            let program = image(region, 600, 3);
            if second == status::OK {
                let last = [600_u32.to_le_bytes(), crc32(&program).to_le_bytes()].concat();
                for block in [block(1, region.base, &program), block(u32::MAX, 0, &last)] {
                    assert_eq!(host.send(1, &block, 7), (Ok(()), status::OK));
                }
                assert_eq!(host.identification(1), crc32(&program));
            }
        });
    }
}

/// The device works between any two bytes: the head of the image, too, arrives in pieces.
#[test]
fn a_slow_sender_gets_through() {
    let program = image(STANDARD_1.region(1), 700, 5);
    for form in FORMS {
        let file = seal(&sealer(form), &program);
        for piece in [1, 3, 64] {
            let device = Device::sealed(&STANDARD_1);
            device.run(|host| {
                host.clear(1);
                host.begin(1, &file[..1], 1).unwrap();
                for bytes in file[1..].chunks(piece) {
                    host.go_on(1, bytes, piece).unwrap();
                    host.steps(20);
                }
                host.end(1).unwrap();
                host.settle();
                assert_eq!(host.status(1), status::OK, "{form:?}, {piece}");
            });
            assert!(device.holds(1, &program), "{form:?}, {piece}");
        }
    }
}

/// The signature is good, and the manifest is wrong: what it says of the program is compared.
#[test]
fn a_signed_mistake_is_no_program() {
    let region = STANDARD_1.region(1);
    let program = image(region, 700, 5);
    for form in [(false, false), (false, true)] {
        let good = Parts::of(&seal(&sealer(form), &program));
        let size = |size: u32| good.clone().with(28, &size.to_le_bytes()).signed();
        for (what, file, expected) in [
            ("the hash of the image", good.clone().with(40, &[9; 32]).signed(), status::SIGNATURE),
            ("a larger size", size(704), status::FORMAT),
            ("a smaller size", size(600), status::FORMAT),
        ] {
            let device = Device::sealed(&STANDARD_1);
            device.run(|host| assert_eq!(host.update(1, &file, 7).1, expected, "{form:?}: {what}"));
            assert!(device.verified(1).is_err(), "{form:?}: {what}");
            device.run(|host| host.install(1, &good.clone().bytes()));
            assert!(device.holds(1, &program));
        }
    }
}

/// CiA 301: the next segment says why; a refused image, or flash that fails.
#[test]
fn the_abort_tells_a_refusal_from_a_fault() {
    // In chunks of 512 bytes: the first one is written while the rest comes.
    let sealer = Sealer { chunk: 9, ..sealer((false, false)) };
    let file = seal(&sealer, &image(STANDARD_1.region(1), 5000, 6));
    let forged = Parts::of(&file).signed_by(&keys().stranger).bytes();
    let device = Device::sealed(&STANDARD_1);
    let end = |file: &[u8], fault: bool| {
        device.run(|host| {
            host.wait();
            host.clear(1);
            let mut model = device.chip.model();
            model.fail = fault.then(|| (model.operations + 40, FlashFault::Failed));
            drop(model);
            let ended = host.begin(1, file, 7);
            host.settle();
            ended
        })
    };
    assert_eq!(end(&forged, false), Err(AbortCode(0x0800_0020)), "data cannot be stored");
    assert_eq!(end(&file, true), Err(AbortCode(0x0606_0000)), "hardware error");
    assert_eq!(end(&file, false), Ok(()));
}

/// A client that does not wait for its answers fills the buffer to the last byte, and no further.
#[test]
fn more_than_the_buffer_is_refused() {
    let file = seal(&sealer((false, false)), &image(STANDARD_1.region(1), 5000, 7));
    let at = Address::new(0x1F50, 1);
    let device = Device::sealed(&STANDARD_1);
    for (len, expected) in [(device.buffer, Ok(())), (device.buffer + 1, Err(AbortCode(0x0504_0005)))] {
        device.run(|host| {
            host.clear(1);
            host.node.download_start(at, None).unwrap();
            let sent = host.node.download_data(at, &file[..len]);
            assert_eq!(sent, expected, "{len}");
            host.cancel(1);
            host.settle();
            host.install(1, &file);
        });
    }
}
