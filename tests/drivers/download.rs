//! The bootloader with a program in a serial flash: a download, power cuts, and chips that do wrong.

use boot_core::bootloader::{entries, entry_count, Bootloader, Config, Extras};
use boot_core::control::Step;
use boot_core::crc::CrcKind;
use boot_core::program::verify;
use boot_core::store::Journal;
use canopen::od::{Address, Entry, Objects};
use kit::bench::{block, crc32, node, CLEAR, CONFIG, SET_SIGNATURE};
use kit::boot::{leaked, Boot};
use kit::model::{until_power_cut, Cut, ONE_PROGRAM};
use shared_abi::layout::Layout;

use crate::demonstration::{both, Internal};
use crate::serial_flash::chip::{Lie, Serial, REGION};
use crate::serial_flash::Both;

/// Program 1 is in the internal flash, and program 2 in the serial one. (`Layout::checked` holds the
/// regions of a board of this repository against its chip, which has no other flash.)
static LAYOUT: Layout = Layout { programs: &[ONE_PROGRAM.programs[0], REGION], ..ONE_PROGRAM };
static ENTRIES: [Entry; entry_count(2, Extras::STANDARD)] = entries(2, Extras::STANDARD).entries();

const SERIAL: u8 = 2;

type Device = Bootloader<'static, Both<Internal, Serial>, Journal, 2>;

fn device(internal: &Internal, serial: &Serial) -> Device {
    let config: &Config = Box::leak(Box::new(Config { entries: &ENTRIES, layout: &LAYOUT, ..CONFIG }));
    let (buffer, sealed) = leaked(4096);
    Boot::new(config, node()).on(both(internal, serial), buffer, sealed)
}

fn settle(device: &mut Device) {
    assert!((0..1_000_000).any(|_| device.step() == Step::Idle), "the work does not end");
}

/// 1F57h without BUSY (SYS TEC manual L-1112d_10, table 3).
fn status(device: &mut Device) -> u32 {
    let mut bytes = [0; 4];
    device.read(Address::new(0x1F57, SERIAL), &mut bytes).unwrap();
    u32::from_le_bytes(bytes) & 0xFFFF
}

/// A program that could start there: two vectors, and bytes.
fn image(fill: u8) -> Vec<u8> {
    let mut bytes = vec![fill; 1024];
    bytes[..4].copy_from_slice(&0x2001_0000_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&(REGION.base + 0x201).to_le_bytes());
    bytes
}

/// CLEAR, the blocks, and the release; the status at the end, or of the first failure.
fn update(device: &mut Device, image: &[u8]) -> u32 {
    let last = [1024, crc32(image)].map(u32::to_le_bytes).concat();
    let blocks = [block(0, 0, &[0; 8]), block(1, REGION.base, image), block(u32::MAX, 0, &last)];
    let command = |device: &mut Device, value| {
        let _ = device.write(Address::new(0x1F51, SERIAL), &[value]);
        settle(device);
        status(device)
    };
    let mut found = command(device, CLEAR);
    for block in blocks {
        if found != 0 {
            return found;
        }
        let at = Address::new(0x1F50, SERIAL);
        let _ = device
            .download_start(at, Some(block.len() as u32))
            .and_then(|()| device.download_data(at, &block))
            .and_then(|()| device.download_end(at));
        settle(device);
        found = status(device);
    }
    if found == 0 {
        found = command(device, SET_SIGNATURE);
    }
    found
}

/// What a reset finds: whether the program may start, and what is in it.
fn starts(internal: &Internal, serial: &Serial) -> Option<Vec<u8>> {
    let flash = both(internal, serial);
    let journal = Journal::open(&flash, LAYOUT.parameters);
    let verified = verify(&flash, &journal, &LAYOUT, CrcKind::Crc32, SERIAL).ok()?;
    let bytes = serial.cells.model().cells(REGION)[..1024].to_vec();
    verified.signed.then_some(bytes)
}

#[test]
fn a_program_is_installed_in_the_serial_flash() {
    let (internal, serial) = (Internal::new(), Serial::new(Lie::None));
    assert_eq!(starts(&internal, &serial), None);
    for fill in [0x11, 0x22] {
        assert_eq!(update(&mut device(&internal, &serial), &image(fill)), 0);
        assert_eq!(starts(&internal, &serial), Some(image(fill)));
    }
    // The place of the other program is as it was.
    assert!(internal.0.model().cells(LAYOUT.programs[0]).iter().all(|byte| *byte == 0xFF));
}

/// The power is cut at every operation of an update, in either flash: after it the old or the new program
/// starts, or none, and the next update installs one.
#[test]
fn no_power_cut_leaves_a_half_program_that_starts() {
    let (old, new) = (image(0x11), image(0x22));
    let mut cuts = 0;
    for in_serial in [false, true] {
        for cut in [Cut::Before, Cut::Torn(7), Cut::Unstable(8), Cut::After] {
            for number in 1.. {
                let (internal, serial) = (Internal::new(), Serial::new(Lie::None));
                assert_eq!(update(&mut device(&internal, &serial), &old), 0);
                let cells = if in_serial { &serial.cells } else { &internal.0 };
                cells.model().power_on();
                cells.model().cut = Some((number, cut));
                if !until_power_cut(|| {
                    update(&mut device(&internal, &serial), &new);
                }) {
                    break;
                }
                cuts += 1;
                internal.0.model().power_on();
                let serial = serial.switched_on();
                let found = starts(&internal, &serial);
                let is_whole = [None, Some(&old), Some(&new)].contains(&found.as_ref());
                assert!(is_whole, "{cut:?} in operation {number}, serial: {in_serial}");
                assert_eq!(update(&mut device(&internal, &serial), &new), 0);
                assert_eq!(starts(&internal, &serial), Some(new.clone()));
            }
        }
    }
    // At least the words of the program, and each record.
    assert!(cuts > 4 * 256, "{cuts}");
}

/// What the client reads in 1F57h (table 3): WRITE (0Ah) for a chip that does not take what it is sent,
/// SECURED (0Eh) for one that is protected, NOTCLEARED (08h) where the place is not blank. The bootloader
/// goes on, and the program does not start.
#[test]
fn a_chip_that_does_wrong_is_an_error_of_the_download() {
    const WRITE: u32 = 0x0A;
    const SECURED: u32 = 0x0E;
    const NOT_CLEARED: u32 = 0x08;
    for (lie, expected) in [
        (Lie::NeverEnds, WRITE),
        (Lie::StuckBit, WRITE),
        (Lie::Absent, WRITE),
        (Lie::Protected, SECURED),
        (Lie::ErasesNothing, NOT_CLEARED),
    ] {
        let (internal, mut serial) = (Internal::new(), Serial::new(Lie::None));
        assert_eq!(update(&mut device(&internal, &serial), &image(0x11)), 0);
        serial.lie = lie;
        assert_eq!(update(&mut device(&internal, &serial), &image(0x22)), expected, "{lie:?}");
        serial.lie = Lie::None;
        assert_eq!(starts(&internal, &serial), None, "{lie:?}");
        let serial = serial.switched_on();
        assert_eq!(update(&mut device(&internal, &serial), &image(0x33)), 0, "{lie:?}");
        assert_eq!(starts(&internal, &serial), Some(image(0x33)), "{lie:?}");
    }
}
