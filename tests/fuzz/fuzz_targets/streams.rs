//! Whole programs in one download: the detection of the format, raw images and Intel HEX, in pieces
//! of any length, truncated anywhere, with or without work of the flash in between; and the
//! passwords before them.
//!
//! Must hold: nothing outside the programs and the parameters is ever written; the device never
//! accepts more than the room that it has reported; and afterwards CLEAR and a valid image install
//! a program. A wrong password never unlocks anything.
#![cfg_attr(fuzzing, no_main)]

use boot_core::bootloader::{entries, entry_count, Bootloader, Config};
use boot_core::control::{Policy, Sealed, Step};
use boot_core::profile::Profile;
use boot_core::store::Journal;
use boot_core::store::NodeParameters;
use canopen::device::Device;
use canopen::od::{Entry, Objects};
use canopen::program::{ENABLE_FLASH, PROGRAM_CONTROL, PROGRAM_DATA, UNLOCK, UNLOCK_FIRMWARE};
use canopen::{AbortCode, Address, BitRate, Instant, NodeId};
use coboot_fuzz::Input;
use kit::boot::Boot;
use kit::model::{ModelFlash, CHIP, TWO_PROGRAMS};
use shared_abi::layout::Layout;

static LAYOUT: Layout = TWO_PROGRAMS;

const PROGRAMS: usize = 2;
const DATA: Address = Address::new(PROGRAM_DATA, 1);
const CLEAR: u8 = 3;

macro_rules! config {
    ($profile:expr) => {{
        const PROFILE: Profile = $profile;
        static ENTRIES: [Entry; entry_count(PROGRAMS as u8, PROFILE.extras)] =
            entries(PROGRAMS as u8, PROFILE.extras).entries();
        static CONFIG: Config = Config {
            entries: &ENTRIES,
            device: Device {
                device_type: PROFILE.device_type,
                name: "model",
                hardware_version: "0",
                software_version: "0",
                heartbeat_ms: 0,
                vendor_id: 1,
                product_code: 2,
                revision: 0,
                serial_number: 0,
            },
            node_id: PROFILE.node_id,
            layout: &LAYOUT,
            supports: |_| true,
            boot_up_emergency: false,
            download: Policy { identity: Some((1, 2)), ..PROFILE.download },
            password: PROFILE.password,
        };
        &CONFIG
    }};
}

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let config = match input.byte().unwrap_or(0) % 3 {
        0 => config!(Profile::STANDARD),
        1 => config!(Profile::ESACADEMY),
        _ => config!(Profile::LIFT),
    };
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
    let mut device = device(config!(Profile::STANDARD), &mut flash, &mut buffer);
    device.write(Address::new(PROGRAM_CONTROL, 1), &[CLEAR]).expect("CLEAR");
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
    device.write(Address::new(PROGRAM_CONTROL, 1), &[1]).expect("START");
    assert!(device.take_boot_request().is_some(), "the program does not start");
});

type Model<'b, 'f> = Bootloader<'b, &'f mut ModelFlash, Journal, PROGRAMS>;

fn device<'b, 'f>(config: &'static Config, flash: &'f mut ModelFlash, buffer: &'b mut [u8]) -> Model<'b, 'f> {
    let node = NodeParameters { id: NodeId::new(5), bit_rate: BitRate::K125 };
    Boot::new(config, node).on(flash, buffer, Sealed::NONE)
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
                    let _ = device.write(Address::new(PROGRAM_CONTROL, 1), &[value]);
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
