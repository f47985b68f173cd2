//! The identity of a device from the one-time programmable bytes of its chip (the choice `identity` of a product), in
//! the product `switches`.

use canopen::program::{ProgramControl, PROGRAM_DATA};
use canopen::{Address, BitRate};
use coboot_tests::bench::{Bench, NODE as BOARD_NODE};
use coboot_tests::{firmware, renewal};
use coflash_core::device::Doing;
use coflash_core::update::{flash, FlashOptions};
use coflash_core::Error;
use shared_abi::label::Label;

use crate::options::{set_switches, with, NODE};

/// RM0090 section 3.8, table 19.
const OTP: u32 = 0x1FFF_7800;

/// The numbers of the OEM's device, and the nameplate with them: the bytes of `tests/abi/layout.rs`, whose check word
/// comes from an implementation in another language.
const OEM: [u32; 4] = [0x123, 0x5EA1_0007, 0x0002_0003, 123_456];
#[rustfmt::skip]
const PLATE: [u8; 32] = [
    b'C', b'B', b'N', b'P', 0x23, 0x01, 0, 0, 0x07, 0, 0xA1, 0x5E, 3, 0, 2, 0,
    0x40, 0xE2, 0x01, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xFE, 0x3F, 0x2A, 0x54,
];
/// The same without a serial number.
#[rustfmt::skip]
const WITHOUT_SERIAL: [u8; 32] = [
    b'C', b'B', b'N', b'P', 0x23, 0x01, 0, 0, 0x07, 0, 0xA1, 0x5E, 3, 0, 2, 0,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xEC, 0x22, 0x54, 0x33,
];
/// The fold of the emulated chip's unique ID, worked out by hand (docs/coflash.md has it, too).
const FOLD: u32 = 0x54D1_2F97;

/// The identity of the board file.
fn of_board() -> [u32; 4] {
    let bsp::Identity { vendor_id, product_code, revision, .. } = bsp::IDENTITY;
    [vendor_id, product_code, revision, FOLD]
}

/// A running device with these blocks of OTP bytes.
fn device(blocks: &[(u32, [u8; 32])]) -> Bench {
    let mut bench = Bench::of_image(firmware::BOOTLOADER_SWITCHES);
    for (block, bytes) in blocks {
        bench.machine().load_bin(OTP + 32 * block, bytes).unwrap();
    }
    bench.set_host_bit_rate(500_000);
    set_switches(&mut bench, NODE, BitRate::K500 as u8);
    bench.machine().set_pin('C', 0, Some(true));
    bench.power_on();
    bench.run_ms(50);
    bench
}

/// 1018h/1 to 4, and whether the bootloader reports them.
fn identity(bench: &mut Bench) -> ([u32; 4], bool) {
    with(bench, |session| {
        let numbers = [1, 2, 3, 4].map(|sub| session.read_number(Address::new(0x1018, sub)).unwrap());
        (numbers, session.device_type().unwrap().unwrap().is_bootloader())
    })
}

/// Whether the device answers to "switch state selective" with this LSS address (CiA 305: 40h to 43h, then 44h).
fn is_selected(bench: &mut Bench, address: [u32; 4]) -> bool {
    bench.post(0x7E5, &[0x04, 0, 0, 0, 0, 0, 0, 0]);
    let frame = |(command, number): (u8, u32)| {
        let [a, b, c, d] = number.to_le_bytes();
        [command, a, b, c, d, 0, 0, 0]
    };
    let [vendor, product, revision, serial] = address;
    for frame in [(0x40, vendor), (0x41, product), (0x42, revision)].map(frame) {
        bench.post(0x7E5, &frame);
    }
    bench.ask(0x7E5, &frame((0x43, serial)), 0x7E4).is_some_and(|answer| answer[0] == 0x44)
}

/// A program whose label is for devices with these numbers.
fn program(image: &str, vendor_id: u32, product_code: u32) -> Vec<u8> {
    firmware::with_label(firmware::raw(image), &Label::new(vendor_id, product_code, 1))
}

#[test]
fn the_last_good_nameplate_is_the_identity() {
    let mut damaged = PLATE;
    damaged[5] &= 0xFE;
    let [vendor, product, revision, _] = OEM;
    for (blocks, expected) in [
        (&[][..], of_board()),
        (&[(0, PLATE)], OEM),
        (&[(0, WITHOUT_SERIAL)], [vendor, product, revision, FOLD]),
        (&[(0, PLATE), (1, WITHOUT_SERIAL)], [vendor, product, revision, FOLD]),
        (&[(0, WITHOUT_SERIAL), (15, PLATE)], OEM),
        (&[(0, PLATE), (1, damaged)], OEM),
        (&[(0, damaged)], of_board()),
        (&[(3, [0; 32])], of_board()),
    ] {
        let mut bench = device(blocks);
        assert_eq!(identity(&mut bench), (expected, true));
        assert!(is_selected(&mut bench, expected));
        for other in [of_board(), OEM].into_iter().filter(|other| *other != expected) {
            assert!(!is_selected(&mut bench, other), "{other:X?} selects {expected:X?}");
        }
        bench.assert_nothing_unmodelled();
    }
}

/// 80h WRONG_VID and 82h WRONG_PID (SYS TEC manual L-1112d_10, table 5), from the control block and from the label, for
/// what is for the board; and the application shows the identity of the bootloader.
#[test]
fn programs_are_for_the_oem_and_show_its_identity() {
    let mut bench = device(&[(0, PLATE)]);
    let [vendor, product, ..] = OEM;
    let [board_vendor, board_product, ..] = of_board();
    // 0 in a label is any vendor.
    let (other_vendor, other_product) = (vendor ^ 1, board_product);
    assert_eq!(board_vendor, 0);
    let once = FlashOptions::default().repeats(0);
    for (vendor, product, code) in [(other_vendor, product, 0x80), (vendor, other_product, 0x82)] {
        let bytes = program(firmware::APP_V1, vendor, product);
        let file = firmware::blocks_of_raw(&bytes);
        // The tool compares with 1018h; one that does not leaves it to the device.
        let refused = with(&mut bench, |session| flash(session, &file, &once, &mut |_| {}));
        assert!(matches!(refused, Err(Error::WrongTarget { .. })), "{refused:?}");
        with(&mut bench, |session| {
            flash(session, &file, &once.force(true), &mut |_| {}).unwrap_err();
            assert_eq!(session.read_number(Address::new(0x1F57, 1)).unwrap() & 0xFF, code);
            // The label alone, in a raw image.
            session.command(1, ProgramControl::Clear).unwrap();
            session.await_idle(1, Doing::Block(0)).unwrap();
            let at = Address::new(PROGRAM_DATA, 1);
            let refused = session.write(at, &bytes, Doing::Write(at), &mut |_| {});
            assert!(refused.is_err());
            assert_eq!(session.read_number(Address::new(0x1F57, 1)).unwrap() & 0xFF, code);
        });
    }
    for image in [firmware::APP_V1, firmware::APP_C] {
        let file = firmware::blocks_of_raw(&program(image, vendor, product));
        with(&mut bench, |session| flash(session, &file, &FlashOptions::default(), &mut |_| {}).unwrap());
        assert_eq!(identity(&mut bench), (OEM, false), "{image}");
    }
    with(&mut bench, |session| session.command(1, ProgramControl::StartBootloader).unwrap());
    bench.run_ms(100);
    assert_eq!(identity(&mut bench), (OEM, true));
    bench.assert_nothing_unmodelled();
}

/// Without the choice neither of them looks.
#[test]
fn a_product_without_the_choice_keeps_the_identity_of_the_board() {
    let mut bench = Bench::new();
    bench.machine().load_bin(OTP, &PLATE).unwrap();
    bench.switch_on();
    let numbers = |bench: &mut Bench| [1, 2, 3, 4].map(|sub| bench.number(0x1018, sub));
    assert_eq!(numbers(&mut bench), of_board());
    bench.update(firmware::APP_V1);
    assert!(!bench.is_bootloader(BOARD_NODE));
    assert_eq!(numbers(&mut bench), of_board());
}

/// The RAM image of such a product is for all OEMs. One that names another product code than the OEM's is refused
/// (82h), and so is one for hardware revision 2 alone: 1018h/3 says 3.
#[test]
fn a_new_bootloader_is_for_the_devices_of_every_oem() {
    if firmware::board().staging.is_none() {
        return;
    }
    let image = firmware::BOOTLOADER_SWITCHES;
    let built = renewal::image_of(image);
    assert_eq!(built[36..44], [0; 8], "vendor-ID and product code of the header");
    let board_product = of_board()[1];
    for (wrong, code) in [
        (built.clone(), 0),
        (renewal::with_word(image, 40, OEM[1]), 0),
        (renewal::with_word(image, 40, board_product), 0x82),
        (renewal::with_word(image, 44, 1 << 3), 0),
        (renewal::with_word(image, 44, 1 << 2), 0x82),
    ] {
        let mut bench = device(&[(0, PLATE)]);
        with(&mut bench, |session| {
            let at = Address::new(PROGRAM_DATA, renewal::number());
            session.command(renewal::number(), ProgramControl::Clear).unwrap();
            let _ = session.write(at, &wrong, Doing::Write(at), &mut |_| {});
            let _ = session.await_idle(renewal::number(), Doing::Block(0));
            let status = session.read_number(Address::new(0x1F57, renewal::number())).unwrap();
            assert_eq!(status & 0xFF, code);
        });
    }
}
