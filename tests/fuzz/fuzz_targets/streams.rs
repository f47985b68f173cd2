//! Whole programs in one download: the detection of the format, raw images and Intel HEX, in pieces
//! of any length, truncated anywhere, with or without work of the flash in between; and the
//! passwords before them.
//!
//! Must hold: nothing outside the programs and the parameters is ever written; the device never
//! accepts more than the room that it has reported; and afterwards CLEAR and a valid image install
//! a program. A wrong password never unlocks anything.
#![cfg_attr(fuzzing, no_main)]

use std::sync::OnceLock;

use boot_core::bootloader::{Bootloader, Config};
use boot_core::control::{Policy, Sealed, Step};
use boot_core::store::Journal;
use canopen::od::Objects;
use canopen::program::{ENABLE_FLASH, UNLOCK, UNLOCK_FIRMWARE};
use canopen::{AbortCode, Address, Instant};
use coboot_fuzz::Input;
use kit::bench::{CLEAR, CONTROL, DATA};
use kit::boot::Boot;
use kit::model::{ModelFlash, CHIP, TWO_PROGRAMS as LAYOUT};
use kit::rig::{Setup, BOARD_NODE, ESACADEMY_2, LIFT_2, STANDARD_2};

const PROGRAMS: usize = 2;

/// With the identity that the labels of the kept inputs have.
fn configs() -> &'static [Config; 3] {
    static CONFIGS: OnceLock<[Config; 3]> = OnceLock::new();
    let of = |Setup { config, .. }: &Setup| {
        let download = Policy { identity: Some((1, 2)), ..config.download };
        Config { download, ..*config }
    };
    CONFIGS.get_or_init(|| [&STANDARD_2, &ESACADEMY_2, &LIFT_2].map(of))
}

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let config = &configs()[usize::from(input.byte().unwrap_or(0) % 3)];
    let mut flash = ModelFlash::new(&CHIP);
    session(config, &mut flash, &mut input);
    flash.power_on();
    let [a, b] = LAYOUT.parameters;
    for region in &flash.touched {
        let inside = LAYOUT.programs.iter().chain([&a, &b]);
        assert!(inside.clone().any(|own| own.contains(region.base, region.size)), "{region:?} was written");
    }

    // A bootloader without passwords can use the resulting flash.
    let mut buffer = [0; 1024];
    let mut device = device(&configs()[0], &mut flash, &mut buffer);
    device.write(CONTROL, &[CLEAR]).expect("CLEAR");
    settle(&mut device);
    let mut image = vec![0x5A; 700];
    image[..8].copy_from_slice(&[0x00, 0xF0, 0x01, 0x20, 0x51, 0x09, 0x00, 0x08]);
    device.download_start(DATA, None).expect("a new beginning");
    for piece in image.chunks(7) {
        while device.download_space(DATA, false) < piece.len() {
            device.step();
        }
        device.download_data(DATA, piece).expect("a good image");
    }
    device.download_end(DATA).expect("a good image");
    settle(&mut device);
    device.write(CONTROL, &[1]).expect("START");
    assert!(device.take_boot_request().is_some(), "the program does not start");
});

type Model<'b, 'f> = Bootloader<'b, &'f mut ModelFlash, Journal, PROGRAMS>;

fn device<'b, 'f>(config: &'static Config, flash: &'f mut ModelFlash, buffer: &'b mut [u8]) -> Model<'b, 'f> {
    Boot::new(config, BOARD_NODE).on(flash, buffer, Sealed::NONE)
}

fn session(config: &'static Config, flash: &mut ModelFlash, input: &mut Input<'_>) {
    let mut buffer = [0; 1024];
    let mut device = device(config, flash, &mut buffer);
    let mut open = false;
    let mut locked = config.download.locked;
    let mut now = 0_u32;
    while let Some(action) = input.byte() {
        match action {
            0..=39 => {
                if open {
                    device.download_cancel(DATA);
                }
                let size = (action & 1 != 0).then_some(u32::from(action) * 40);
                let started = device.download_start(DATA, size);
                assert!(!locked || started.is_err(), "1F50h is open without a password");
                open = started.is_ok();
            }
            40..=139 => {
                let piece = input.take(usize::from(action % 8)).to_vec();
                if open && !piece.is_empty() && device.download_space(DATA, true) >= piece.len() {
                    let taken = device.download_data(DATA, &piece);
                    assert_ne!(taken, Err(AbortCode::OUT_OF_MEMORY), "there was said to be room");
                    if taken.is_err() {
                        device.download_cancel(DATA);
                        open = false;
                    }
                }
            }
            140..=159 => {
                if std::mem::take(&mut open) && device.download_end(DATA).is_err() {
                    device.download_cancel(DATA);
                }
            }
            160..=179 => {
                let Some([value]) = input.array() else { break };
                if !open {
                    let _ = device.write(CONTROL, &[value]);
                }
            }
            180..=199 => {
                let right = action & 1 != 0;
                let mut password = config.password.to_vec();
                if !right {
                    password = input.take(4).to_vec();
                }
                let at = [Address::new(ENABLE_FLASH, 1), Address::new(UNLOCK, UNLOCK_FIRMWARE)];
                for at in at.into_iter().filter(|at| config.entries.iter().any(|entry| entry.at == *at)) {
                    if !open && device.write(at, &password).is_ok() {
                        assert_eq!(password, config.password, "a wrong password opened it");
                        locked = false;
                    }
                }
            }
            200..=209 => {
                now = now.wrapping_add(u32::from(action) * 10);
                device.set_time(Instant::from_millis(now));
            }
            210..=239 => drop(device.step()),
            _ => settle(&mut device),
        }
        if device.take_boot_request().is_some() {
            return;
        }
    }
}

fn settle(device: &mut Model<'_, '_>) {
    for _ in 0..200_000 {
        if device.step() == Step::Idle && !device.busy() {
            return;
        }
    }
    panic!("the work never ends");
}
