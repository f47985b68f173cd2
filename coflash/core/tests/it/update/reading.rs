//! From the bytes of a file to what a device gets.

use std::path::Path;

use coflash_core::device::Dialect;
use coflash_core::file::convert::blocks_of_sealed;
use coflash_core::file::judge;
use coflash_core::file::sealed::{SealedFile, Sealer, SigningKey};
use coflash_core::file::Format;
use coflash_core::update::{ContentFault, Judging, Loaded, Payload, Reading};
use shared_abi::layout::DEFAULT;

/// The first program of the board (docs/porting.md, `cargo xtask layout`): 128 KiB after the start of the flash.
const START: u32 = 0x0802_0000;

/// An image for there, with this initial stack pointer.
fn program(stack: u32) -> Vec<u8> {
    let mut bytes = vec![0x5A; 1024];
    bytes[..4].copy_from_slice(&stack.to_le_bytes());
    bytes[4..8].copy_from_slice(&(START + 0x201).to_le_bytes());
    bytes
}

/// An F407 has 128 KiB of SRAM at 2000_0000h, of which the last 64 bytes are the handoff's.
const GOOD: u32 = 0x2001_FFC0;
const OVER_THE_HANDOFF: u32 = 0x2002_0000;

fn read(reading: Reading, name: &str, bytes: &[u8]) -> Result<Loaded, ContentFault> {
    reading.read(Path::new(name), bytes)
}

fn start(loaded: Result<Loaded, ContentFault>) -> u32 {
    match loaded.unwrap().payload {
        Payload::Program(program) => program.start(),
        other => panic!("{other:?}"),
    }
}

/// Whoever reads a file takes the blocks with a sealed image for what they carry.
#[test]
fn a_sealed_image_is_the_same_in_a_file_and_in_blocks() {
    let sealer = Sealer { vendor_id: 63, product_code: 1, program: 1, ..Sealer::default() };
    let image = sealer.seal(&program(GOOD), &SigningKey::from_seed([1; 32]).unwrap()).unwrap();
    let blocks = blocks_of_sealed(&SealedFile::parse(image.clone()).unwrap(), START, 0x400).unwrap().emit();
    for file in [&image, &blocks] {
        // A named format is that of a program.
        for format in [None, Some(Format::Raw), Some(Format::BlockFile)] {
            let Payload::Sealed(read) = read(Reading::new(1).format(format), "a.cbs", file).unwrap().payload
            else {
                panic!("{format:?}")
            };
            assert!(read.bytes() == image);
        }
        // It says for which program it is, and only the device may think otherwise.
        let other = Reading::new(2);
        assert!(matches!(read(other, "a.cbs", file), Err(ContentFault::Sealed(_))));
        assert!(read(other.judging(Judging::Nothing), "a.cbs", file).is_ok());
    }
}

#[test]
fn a_raw_binary_is_where_the_board_or_the_dialect_says() {
    let (bytes, on) = (program(GOOD), |dialect| Reading::new(1).dialect(dialect));
    assert_eq!(start(read(Reading::new(1).board(Some(DEFAULT)), "a.bin", &bytes)), START);
    let given = Reading::new(1).address(Some(START + 0x400)).judging(Judging::Nothing);
    assert_eq!(start(read(given, "a.bin", &bytes)), START + 0x400);
    // The region is still that of the board.
    assert!(read(given.address(Some(START - 0x400)).board(Some(DEFAULT)), "a.bin", &bytes).is_err());
    // Their images have no addresses.
    for dialect in [Dialect::Raw, Dialect::Lift] {
        assert_eq!(start(read(on(Some(dialect)).judging(Judging::Nothing), "a.bin", &bytes)), 0);
    }
    for dialect in [None, Some(Dialect::Block)] {
        assert!(read(on(dialect), "a.bin", &bytes).unwrap_err().is_without_address());
    }
    assert!(!read(Reading::new(1), "a.dat", &bytes).unwrap_err().is_without_address());
    let fault = read(Reading::new(9).board(Some(DEFAULT)), "a.bin", &bytes).unwrap_err();
    assert_eq!(fault.to_string(), "stm32f407g-disc1 has no program 9");
}

#[test]
fn a_file_is_judged_as_much_as_its_reader_wants() {
    let on_board = Reading::new(1).board(Some(DEFAULT));
    let zeros = vec![0; 1024];
    let over = program(OVER_THE_HANDOFF);
    let handoff = |fault: &judge::Fault| matches!(fault, judge::Fault::StackOverHandoff { .. });
    for (judging, blank, stack) in
        [(Judging::Whole, true, true), (Judging::Handoff, false, true), (Judging::Nothing, false, false)]
    {
        let judged = |bytes| match read(on_board.judging(judging), "a.bin", bytes) {
            Ok(_) => None,
            Err(ContentFault::Judged(fault)) => Some(fault),
            Err(other) => panic!("{other}"),
        };
        assert_eq!(judged(&zeros), blank.then_some(judge::Fault::Blank(0)), "{judging:?}");
        assert_eq!(judged(&over).as_ref().map(handoff), stack.then_some(true), "{judging:?}");
        assert_eq!(judged(&program(GOOD)), None, "{judging:?}");
    }
}

/// All programs of a lift but the first are data (CiA 814-1 clause 6.4), and without a dialect it may be one.
#[test]
fn what_may_be_data_is_not_judged() {
    let zeros = vec![0; 1024];
    for (number, dialect, is_judged) in [
        (1, None, true),
        (1, Some(Dialect::Lift), true),
        (2, None, false),
        (2, Some(Dialect::Lift), false),
        (2, Some(Dialect::Raw), true),
    ] {
        let reading = Reading::new(number).dialect(dialect);
        let hex = kit::ihex::intel_hex(START, &zeros).into_bytes();
        let judged = matches!(read(reading, "a.hex", &hex), Err(ContentFault::Judged(_)));
        assert_eq!(judged, is_judged, "{number} {dialect:?}");
    }
}
