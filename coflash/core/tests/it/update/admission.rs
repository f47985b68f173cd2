//! Refusals before the device is changed, in every dialect: files that cannot be a program, and
//! programs for another device or for another place in flash.

use super::{left, update};
use canopen::NodeId;
use coflash_core::device::info::info;
use coflash_core::device::{Dialect, Doing, Error, Session, Timing};
use coflash_core::file::convert::{program_of, Label as Told, Options};
use coflash_core::file::{raw, Firmware, Program};
use coflash_core::update::event::Warning;
use coflash_core::update::{DeviceState, Event, FlashOptions, Password, Report};
use kit::fake::{Deed, Fake, Maker, Outcome, APPLICATION, BOOTLOADER, NODE};

const START: u32 = 0x0801_0000;
/// The values of 1018h in the fake.
const VENDOR: u32 = 0x3F;
const PRODUCT: u32 = 1234;

/// A program of 1 KiB with a label (`shared-abi/src/label.rs`, written here from the page about it:
/// 32 bytes at 1E0h, "CBL1", vendor-ID, product code, version, three zeros, and a check word).
fn labelled(vendor_id: u32, product_code: u32) -> Vec<u8> {
    let mut bytes = vec![0x5A; 1024];
    bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
    bytes[4..8].copy_from_slice(&(START + 0x201).to_le_bytes());
    let mut words = vec![u32::from_le_bytes(*b"CBL1"), vendor_id, product_code, 7, 0, 0, 0];
    words.push(shared_abi::check_word(&words));
    for (place, word) in bytes[0x1E0..0x200].chunks_mut(4).zip(words) {
        place.copy_from_slice(&word.to_le_bytes());
    }
    bytes
}

/// The file of an image at this address, with this in its block 0.
fn file(bytes: &[u8], at: u32, label: Told) -> Program {
    let image = raw::read(bytes, Some(at)).unwrap();
    program_of(Firmware::Image(image), &Options::default().label(label)).unwrap().program
}

fn run(fake: &mut Fake, file: &Program, options: FlashOptions) -> (Result<Report, Error>, Vec<Event>) {
    update(fake, file, &options)
}

/// The update is refused, and nothing was written: not even the call to the bootloader.
#[track_caller]
fn refused(fake: &mut Fake, file: &Program, options: FlashOptions) -> Error {
    let (result, events) = run(fake, file, options);
    let error = result.unwrap_err();
    assert_eq!(fake.writes(), [] as [&str; 0], "{error}");
    assert_eq!(left(&events), DeviceState::Untouched, "{error}");
    error
}

fn speaks(dialect: Dialect) -> FlashOptions {
    FlashOptions::default().dialect(Some(dialect)).unlock(Password::new("0x494E4954"))
}

#[test]
fn another_devices_label_is_refused_in_every_dialect() {
    let product = "the program is for product code 000004D3h, and node 5 has 000004D2h";
    for (vendor_id, product_code, number, words) in [
        (VENDOR, PRODUCT + 1, 0x6000_0182, product),
        (0, PRODUCT + 1, 0x6000_0182, product),
        (0x40, PRODUCT, 0x6000_0180, "the program is for vendor-ID 00000040h, and node 5 has 0000003Fh"),
    ] {
        for dialect in Dialect::ALL {
            for running in [APPLICATION, BOOTLOADER] {
                // By block 0, which has what the label has; and by the label alone.
                for reported in [Told::default(), Told::None] {
                    let file = file(&labelled(vendor_id, product_code), START, reported);
                    let error = refused(&mut Fake::new(running), &file, speaks(dialect));
                    assert_eq!((error.number(), error.to_string().as_str()), (number, words), "{dialect:?}");
                }
            }
        }
    }
    // Block 0 counts, too, if it differs from the label.
    let reported = Told::Device { vendor_id: VENDOR, product_code: PRODUCT + 1 };
    let file = file(&labelled(VENDOR, PRODUCT), START, reported);
    assert_eq!(refused(&mut Fake::new(APPLICATION), &file, FlashOptions::default()).number(), 0x6000_0182);
}

#[test]
fn a_label_that_fits_goes_in_and_is_in_block_0() {
    for (vendor_id, product_code) in [(VENDOR, PRODUCT), (0, 0), (0, PRODUCT)] {
        let mut fake = Fake::new(APPLICATION);
        let file = file(&labelled(vendor_id, product_code), START, Told::default());
        run(&mut fake, &file, FlashOptions::default()).0.unwrap();
        // Block 0: 24 bytes of data (manual, table 6): size, vendor-ID, product code, version, date.
        let words = [1024, vendor_id, product_code, 7, 0, 0].map(u32::to_le_bytes).concat();
        assert_eq!(fake.blocks[0][12..36], words);
    }
    // A device that does not report its product code may be any product.
    struct Reticent;
    impl Maker for Reticent {
        fn value(&mut self, at: (u16, u8), _: u32) -> Option<Result<Vec<u8>, u32>> {
            (at == (0x1018, 2)).then_some(Err(0x0609_0011))
        }
    }
    let mut fake = Fake::new(APPLICATION);
    fake.maker = Some(Box::new(Reticent));
    run(&mut fake, &file(&labelled(VENDOR, 9), START, Told::default()), FlashOptions::default()).0.unwrap();
}

/// A device with these objects in place of the fake's own, while this device type runs or always.
struct Other(&'static [((u16, u8), &'static [u8])], Option<u32>);

impl Maker for Other {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        if self.1.is_some_and(|only| only != running) {
            return None;
        }
        self.0.iter().find(|(other, _)| *other == at).map(|(_, value)| Ok(value.to_vec()))
    }
}

fn other(objects: &'static [((u16, u8), &'static [u8])], only: Option<u32>) -> Fake {
    let mut fake = Fake::new(APPLICATION);
    fake.maker = Some(Box::new(Other(objects, only)));
    fake
}

/// 0 names no vendor and no product, on the device's side as on the file's (`coboot-node` has 0 and 0
/// by default, and its first example sends a program with a label).
#[test]
fn a_device_without_identity_takes_any_program() {
    const NOBODY: &[((u16, u8), &[u8])] = &[((0x1018, 1), &[0; 4]), ((0x1018, 2), &[0; 4])];
    let file = file(&labelled(VENDOR, PRODUCT), START, Told::default());
    let target = file.target();
    for options in [FlashOptions::default(), FlashOptions::default().check_target(target)] {
        run(&mut other(NOBODY, None), &file, options).0.unwrap();
    }
    // Each of the two numbers counts by itself.
    const NO_PRODUCT: &[((u16, u8), &[u8])] = &[((0x1018, 2), &[0; 4])];
    let foreign = self::file(&labelled(0x40, PRODUCT), START, Told::default());
    let target = foreign.target();
    for options in [FlashOptions::default(), FlashOptions::default().force(true).check_target(target)] {
        let error = run(&mut other(NO_PRODUCT, None), &foreign, options).0.unwrap_err();
        assert!(matches!(error, Error::WrongTarget { file: 0x40, .. }), "{error}");
    }
}

/// The default stack of CubeMX and cortex-m-rt: the end of the SRAM. Where the user names no board, the
/// name of the device (1008h) does.
#[test]
fn a_stack_over_the_handoff_is_refused_before_anything_is_erased() {
    const F446: &[((u16, u8), &[u8])] = &[((0x1008, 0), b"coboot NUCLEO-F446RE")];
    const F429: &[((u16, u8), &[u8])] = &[((0x1008, 0), b"coboot STM32F429I-DISC1")];
    const FOREIGN: &[((u16, u8), &[u8])] = &[((0x1008, 0), b"pump 2")];
    let mut bytes = labelled(VENDOR, PRODUCT);
    bytes[..4].copy_from_slice(&0x2002_0000_u32.to_le_bytes());
    let file = file(&bytes, START, Told::default());
    let error = refused(&mut other(F446, None), &file, FlashOptions::default());
    let words = "its stack begins at 20020000h, over the handoff (2001FFC0h)";
    assert!(error.to_string().contains(words), "{error}");
    assert!(error.advice().to_string().contains("LENGTH = 128K - 64"), "{}", error.advice());
    // Only the bootloader tells its name: the program was stopped, and is started again.
    let mut fake = other(F446, Some(BOOTLOADER));
    let error = run(&mut fake, &file, FlashOptions::default()).0.unwrap_err();
    assert!(error.to_string().contains(words), "{error}");
    assert_eq!(fake.writes(), ["command 80", "command 01"]);
    // 192 KiB of SRAM, or nobody knows: the device judges.
    for objects in [F429, FOREIGN] {
        run(&mut other(objects, None), &file, FlashOptions::default()).0.unwrap();
    }
}

#[test]
fn what_is_forced_is_left_to_the_device() {
    let file = file(&labelled(VENDOR, PRODUCT + 1), START, Told::default());
    let mut fake = Fake::new(APPLICATION);
    fake.on_block = Box::new(|_| Outcome::AbortStatus(0x0800_0020, 0x82));
    let error = run(&mut fake, &file, FlashOptions::default().force(true)).0.unwrap_err();
    assert!(matches!(error, Error::Failed { .. }), "{error}");
    assert_eq!(fake.writes(), ["command 80", "command 03", "block 0"]);
}

#[test]
fn what_can_be_no_program_is_refused_in_every_dialect() {
    let with = |at: usize, word: u32| {
        let mut bytes = labelled(VENDOR, PRODUCT);
        bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
        bytes
    };
    for (bytes, at, words) in [
        (labelled(VENDOR, PRODUCT), 0x0800_0000, "the image begins at the start of the flash"),
        (vec![0; 1024], START, "the image is not a program: all its bytes are 00h"),
        (vec![0xFF; 1024], START, "the image is not a program: all its bytes are FFh"),
        (with(0, 0x2001_FFC4), START, "the image is not a program: its first word, 2001FFC4h"),
        (with(4, START + 0x200), START, "the image is not a program: its reset vector is 08010200h, without"),
        (with(4, START - 0xFFF), START, "the image is not a program: its reset vector is 0800F001h, outside"),
    ] {
        let file = file(&bytes, at, Told::default());
        for dialect in Dialect::ALL {
            let error = refused(&mut Fake::new(APPLICATION), &file, speaks(dialect));
            assert!(error.to_string().starts_with(words), "{error}");
            assert_eq!(error.number(), 0x6000_0021);
        }
    }
}

/// A device that reports its program's region while this device type runs.
struct Told2004 {
    while_running: Vec<u32>,
    value: Vec<u8>,
}

impl Maker for Told2004 {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        let (value, bootloader) = self.value.split_at(8);
        match at {
            (0x2004, 1) if self.while_running.contains(&running) => Some(Ok(value.to_vec())),
            // A device that can be renewed has a number for its bootloader.
            (0x2007, 1) if !bootloader.is_empty() => Some(Ok(bootloader.to_vec())),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], _: u32) -> Option<Result<Deed, u32>> {
        // A whole image in one download; the fake takes blocks by itself.
        (at == (0x1F50, 1) && data.starts_with(&0x2001_FFC0_u32.to_le_bytes())).then_some(Ok(Deed::Nothing))
    }
}

/// A device whose program lies at `base`, as 2004h reports it.
fn at(base: u32, size: u32, running: u32, while_running: &[u32]) -> Fake {
    let mut fake = Fake::new(running);
    let value = [base.to_le_bytes(), size.to_le_bytes()].concat();
    fake.maker = Some(Box::new(Told2004 { while_running: while_running.to_vec(), value }));
    fake
}

#[test]
fn what_is_for_another_place_than_the_devices_is_refused() {
    const BOTH: [u32; 2] = [APPLICATION, BOOTLOADER];
    let file = file(&labelled(VENDOR, PRODUCT), START, Told::default());
    for dialect in Dialect::ALL {
        for running in BOTH {
            // Elsewhere, and too small.
            for (base, size) in [(START + 0x1_0000, 0x1_0000), (START, 1020)] {
                let error = refused(&mut at(base, size, running, &BOTH), &file, speaks(dialect));
                assert_eq!(error.number(), 0x6000_0015);
                let words = format!(
                    "the image is for 0x08010000..=0x080103ff, and node 5 has program 1 at {base:#010x}..={:#010x}",
                    base + size - 1
                );
                assert_eq!(error.to_string(), words);
            }
        }
    }
    // In the region, but not at its start: size and CRC would differ from the device's.
    for dialect in [Dialect::Block, Dialect::Raw, Dialect::Lift] {
        let error = refused(&mut at(START - 0x1000, 0x1_0000, APPLICATION, &BOTH), &file, speaks(dialect));
        assert_eq!(error.number(), 0x6000_0015, "{dialect:?}");
    }
    // Intel HEX says where its data go, and the device would look for vectors where none are.
    for dialect in [Dialect::Hex, Dialect::EsAcademy] {
        let error = refused(&mut at(START - 0x1000, 0x1_0000, APPLICATION, &BOTH), &file, speaks(dialect));
        let words = "the image is linked for 08010000h, and the program begins at 0800F000h";
        assert_eq!((error.number(), error.to_string().as_str()), (0x6000_0021, words), "{dialect:?}");
    }
    run(&mut at(START, 1024, APPLICATION, &BOTH), &file, FlashOptions::default()).0.unwrap();
    let force = FlashOptions::default().force(true);
    run(&mut at(START + 0x1_0000, 1024, APPLICATION, &BOTH), &file, force).0.unwrap();
}

/// A checksum at the end of the region, as srec_cat puts it there: the last sector of the last
/// program is for a new bootloader (RM0090 table 5: sector 11 of an STM32F407, 128 KiB from
/// 080E_0000h on).
#[test]
fn a_program_that_covers_staging_is_written_with_a_warning() {
    const BEGIN: u32 = 0x0802_0000;
    let with_checksum = |at: u32| {
        let mut bytes = vec![0x5A; 1024];
        bytes[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
        bytes[4..8].copy_from_slice(&(BEGIN + 0x201).to_le_bytes());
        bytes.resize((at + 4 - BEGIN) as usize, 0xFF);
        file(&bytes, BEGIN, Told::default())
    };
    for (checksum, bootloader, warned) in [
        (0x080F_FFFC, vec![2], true),
        (0x080E_0000, vec![2], true),
        (0x080D_FFFC, vec![2], false),
        (0x080F_FFFC, vec![3], false), // program 2 is the last one
        (0x080F_FFFC, vec![0], false), // no renewal
        (0x080F_FFFC, vec![], false),
    ] {
        let mut fake = Fake::new(APPLICATION);
        let region = [BEGIN, 0xE_0000].into_iter().flat_map(u32::to_le_bytes);
        let value = region.chain(bootloader.clone()).collect();
        fake.maker = Some(Box::new(Told2004 { while_running: vec![BOOTLOADER], value }));
        let (result, events) = run(&mut fake, &with_checksum(checksum), FlashOptions::default());
        result.unwrap();
        let warning = Event::from(Warning::CoversStaging { first: 0x080E_0000 });
        let count = events.iter().filter(|event| **event == warning).count();
        assert_eq!(count, usize::from(warned), "{checksum:08X}h, bootloader {bootloader:?}");
    }
}

/// An application of another manufacturer does not have this object: the bootloader is asked before
/// it erases.
#[test]
fn the_bootloader_is_asked_where_the_application_does_not_know() {
    let file = file(&labelled(VENDOR, PRODUCT), START, Told::default());
    let mut fake = at(START + 0x1_0000, 0x1_0000, APPLICATION, &[BOOTLOADER]);
    let (result, events) = run(&mut fake, &file, FlashOptions::default());
    assert_eq!(result.unwrap_err().number(), 0x6000_0015);
    // The application was called back in vain: it starts again.
    assert_eq!(fake.writes(), ["command 80", "command 01"]);
    assert_eq!(left(&events), DeviceState::Untouched);
    // What is no place in the flash of such a device is something else of another maker.
    for (base, size) in [(0x2000_0000, 0x1_0000), (START + 0x1_0000, 0), (START + 0x1_0000, u32::MAX)] {
        let mut fake = at(base, size, APPLICATION, &[APPLICATION, BOOTLOADER]);
        run(&mut fake, &file, FlashOptions::default()).0.unwrap();
    }
}

/// A device that reports its keys while one of these device types runs.
struct Sealed(Vec<u32>);

impl Maker for Sealed {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        let words = |words: &[u32]| words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<u8>>();
        let value = match at {
            (0x2002, 1) => [vec![0x5A; 44], words(&[1 << 31])].concat(),
            (0x2002, 3) => words(&[0x1234_5678, 0x9ABC_DEF0, 4, 7]),
            (0x2004, 1) => words(&[START, 0x1_0000]),
            _ => return None,
        };
        (self.0.contains(&running) || at.0 == 0x2004).then_some(Ok(value))
    }
}

#[test]
fn what_a_sealed_device_takes_is_shown() {
    let mut fake = Fake::new(APPLICATION);
    fake.maker = Some(Box::new(Sealed(vec![APPLICATION])));
    let mut session = Session::new(&mut fake, NodeId::new(NODE).unwrap(), Timing::default());
    let reported = info(&mut session).unwrap();
    let line = "  sealed            yes, roots 12345678h, 9ABCDEF0h, counter 7, epoch 4\n";
    assert!(reported.to_string().contains(line), "{reported}");
    let json = serde_json::to_value(&reported).unwrap();
    let security = serde_json::json!({
        "sealed": true, "roots": ["12345678h", "9ABCDEF0h"], "counters": [7], "epoch": 4
    });
    assert_eq!(json["security"], security);
    // One without keys takes any program, and one without the object says nothing.
    fake.maker = Some(Box::new(Sealed(vec![BOOTLOADER])));
    let mut session = Session::new(&mut fake, NodeId::new(NODE).unwrap(), Timing::default());
    assert!(!info(&mut session).unwrap().to_string().contains("sealed"));
}

/// A program that is not sealed is refused before the call back; where the application does not know,
/// before the erase, and the application starts again.
#[test]
fn a_sealed_device_gets_sealed_images_only() {
    let file = file(&labelled(VENDOR, PRODUCT), START, Told::default());
    let words = "node 5 takes sealed images only (roots 12345678h, 9ABCDEF0h)";
    for dialect in [Dialect::Block, Dialect::Raw, Dialect::Hex] {
        for running in [APPLICATION, BOOTLOADER] {
            let mut fake = Fake::new(running);
            fake.maker = Some(Box::new(Sealed(vec![APPLICATION, BOOTLOADER])));
            let error = refused(&mut fake, &file, speaks(dialect));
            assert_eq!((error.to_string().as_str(), error.number()), (words, 0x6000_0184));
            assert!(error.advice().to_string().contains("coflash seal"), "{}", error.advice());
        }
    }
    let mut fake = Fake::new(APPLICATION);
    fake.maker = Some(Box::new(Sealed(vec![BOOTLOADER])));
    let (result, events) = run(&mut fake, &file, FlashOptions::default());
    assert_eq!(result.unwrap_err().to_string(), words);
    assert_eq!(fake.writes(), ["command 80", "command 01"]);
    assert_eq!(left(&events), DeviceState::Untouched);
}

/// An image without addresses is checked against its target region.
#[test]
fn an_image_without_addresses_is_judged_by_the_devices_place() {
    const BOTH: [u32; 2] = [APPLICATION, BOOTLOADER];
    let file = file(&labelled(VENDOR, PRODUCT), 0, Told::default());
    for dialect in [Dialect::Raw, Dialect::Lift] {
        let error = refused(&mut at(START + 0x1_0000, 0x1_0000, APPLICATION, &BOTH), &file, speaks(dialect));
        let words =
            "the image is not a program: its reset vector is 08010201h, outside 0x08020000..=0x080203ff";
        assert_eq!(error.to_string(), words);
    }
    let mut fake = at(START, 1024, BOOTLOADER, &BOTH);
    fake.crc = Some(file.crc());
    run(&mut fake, &file, speaks(Dialect::Raw)).0.unwrap();
    assert!(fake.log.contains(&"5: 1F50/1, 1024 bytes".to_string()), "{:?}", fake.log);
}

/// All programs of a lift except its program 1 are any bytes (CiA 814-1 clause 6.4): they are not
/// checked, and the update continues with the password, which this device does not know.
#[test]
fn a_lifts_data_are_not_judged() {
    for bytes in [vec![0; 64], labelled(VENDOR, PRODUCT + 1)] {
        let file = file(&bytes, 0, Told::None);
        let options = FlashOptions::default().dialect(Some(Dialect::Lift)).program(2);
        let error = refused(&mut Fake::new(APPLICATION), &file, options.unlock(Password::new("open")));
        assert!(matches!(error, Error::Refused { doing: Doing::Unlock, .. }), "{error}");
    }
}
