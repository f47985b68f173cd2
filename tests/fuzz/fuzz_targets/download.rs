//! The program download against any blocks and commands in any order, with or without work of the
//! flash in between.
//!
//! Must hold: nothing outside the program's region and the parameters is ever written (the flash
//! model refuses more than the chip would); and afterwards CLEAR and a correct sequence of blocks
//! install a program.
#![cfg_attr(fuzzing, no_main)]

use boot_core::control::{Downloader, Policy, SealedMemory, Step};
use boot_core::store::Journal;
use canopen::program::{FlashError, FlashStatus, ProgramControl};
use coboot_fuzz::Input;
use kit::bench::{block, block_file, crc32, program, LAYOUT_REF as LAYOUT};
use kit::model::{ModelFlash, CHIP};

/// The largest block that the device accepts.
const BUFFER: usize = 256;
const LAST: u32 = u32::MAX;

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut flash = ModelFlash::new(&CHIP);
    let mut buffer = [0; BUFFER];
    let journal = Journal::open(&flash, LAYOUT.parameters);
    let mut room = SealedMemory::new();
    let mut device: Downloader<'_, _, 1> =
        Downloader::new(LAYOUT, &Policy::DEFAULT, journal, &flash, &mut buffer, room.sealed());
    let mut input = Input::new(bytes);
    let mut next = 0_u32;
    // Whether the SDO server has an open transfer: it only makes certain calls then.
    let mut open = false;
    while let Some(action) = input.byte() {
        match action {
            // A possibly valid block: number, place and size are correct or not.
            0..=89 => {
                let Some([how, number, place, len]) = input.array() else { break };
                let number = match how & 3 {
                    0 => LAST,
                    1 => number.into(),
                    _ => next,
                };
                let address = match how >> 2 & 3 {
                    0 => 0x0800_0000 + u32::from(place) * 0x80,
                    1 => u32::MAX - u32::from(place),
                    _ => 0x0800_0800 + u32::from(place) * 4,
                };
                let data = input.take(usize::from(len)).to_vec();
                let mut block = block(number, address, &data);
                if how & 0x10 != 0 {
                    let middle = block.len() / 2;
                    block[middle] ^= 1 << (how >> 5);
                }
                if send(&mut device, &flash, &block).is_ok() {
                    next = number.wrapping_add(1);
                }
                open = false;
            }
            90..=119 => {
                let Some([value]) = input.array() else { break };
                if let (Ok(command), false) = (ProgramControl::try_from(value), open) {
                    let _ = device.command(1, command);
                    if command == ProgramControl::Clear {
                        next = 0;
                    }
                }
            }
            // Any bytes, in pieces as they arrive from the bus.
            120..=139 => {
                if open {
                    device.download_cancel();
                }
                let size = (action & 1 != 0).then_some(u32::from(action) * 3);
                open = device.download_start(&flash, 1, size).is_ok();
            }
            140..=159 => {
                let data = input.take(usize::from(action % 8));
                if open && !data.is_empty() && device.download_data(data).is_err() {
                    device.download_cancel();
                    open = false;
                }
            }
            160..=169 => {
                if std::mem::take(&mut open) {
                    let _ = device.download_end();
                }
            }
            170..=179 => {
                if std::mem::take(&mut open) {
                    device.download_cancel();
                }
            }
            180..=219 => drop(device.step(&mut flash)),
            _ => settle(&mut device, &mut flash),
        }
        if device.take_boot_request().is_some() {
            // The device resets.
            break;
        }
    }
    flash.power_on();
    for region in &flash.touched {
        let program = LAYOUT.programs[0];
        let parameters = LAYOUT.parameters;
        let inside = [program, parameters[0], parameters[1]];
        assert!(inside.iter().any(|own| own.contains(region.base, region.size)), "{region:?} was written");
    }

    let mut buffer = [0; BUFFER];
    let journal = Journal::open(&flash, LAYOUT.parameters);
    let mut room = SealedMemory::new();
    let mut device: Downloader<'_, _, 1> =
        Downloader::new(LAYOUT, &Policy::DEFAULT, journal, &flash, &mut buffer, room.sealed());
    device.command(1, ProgramControl::Clear).expect("CLEAR");
    settle(&mut device, &mut flash);
    assert_eq!(device.status(1), FlashStatus::OK);
    let program = program(100, 0);
    for (number, block) in block_file(&program, 100).iter().enumerate() {
        assert_eq!(send(&mut device, &flash, block), Ok(()), "block {number}");
        settle(&mut device, &mut flash);
        assert_eq!(device.status(1), FlashStatus::OK, "block {number}");
    }
    assert_eq!(device.identification(1), crc32(&program));
    device.command(1, ProgramControl::Start).expect("START");
    assert_ne!(device.status(1).error, Some(FlashError::NoValidProgram));
    assert!(device.take_boot_request().is_some(), "the program does not start");
});

/// The calls of the SDO server for a block.
fn send(
    device: &mut Downloader<'_, Journal, 1>,
    flash: &ModelFlash,
    block: &[u8],
) -> Result<(), canopen::AbortCode> {
    device.download_cancel();
    device.download_start(flash, 1, Some(block.len() as u32))?;
    for piece in block.chunks(7) {
        if let Err(code) = device.download_data(piece) {
            device.download_cancel();
            return Err(code);
        }
    }
    device.download_end()
}

/// Runs until the flash's work has ended.
fn settle(device: &mut Downloader<'_, Journal, 1>, flash: &mut ModelFlash) {
    for _ in 0..200_000 {
        if device.step(flash) == Step::Idle && !device.busy() {
            return;
        }
    }
    panic!("the work never ends");
}
