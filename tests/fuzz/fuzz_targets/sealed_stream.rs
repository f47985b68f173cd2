//! Sealed images as they arrive at a sealed device, in pieces of any length, with or without work of
//! the flash in between: good ones, damaged ones, and hostile ones with a good signature (the holder
//! of a key makes mistakes, too).
//!
//! Must hold: a damaged image never becomes a program; what verifies has the hash in its manifest,
//! and without the key it is the image that was sealed; an undamaged image installs; only the
//! program and the parameters are written; and afterwards CLEAR and a good image install (tried after
//! each eighth input).
#![cfg_attr(fuzzing, no_main)]

use std::sync::OnceLock;

use boot_core::bootloader::Bootloader;
use boot_core::control::{SealedMemory, Step};
use boot_core::crc::CrcKind;
use boot_core::program::verify;
use boot_core::store::Journal;
use canopen::od::Objects;
use coboot_fuzz::{is_eighth, Input};
use coflash_core::file::sealed::{hash, key_block, Kek, Sealer, SigningKey};
use kit::bench::{CLEAR, CONTROL, DATA, LAYOUT, PROGRAM, STATUS};
use kit::boot::Boot;
use kit::model::{ModelFlash, CHIP};
use kit::rig::sealed::STANDARD_1;
use kit::rig::{BOARD_NODE, PRODUCT_CODE, VENDOR_ID};
use seal::wire::{head_size, Head, DOMAIN, HASH};

/// An Ed25519 signature with its header, at the end of a head with one signer.
const SIGNATURE: usize = 72;
/// The hash of the first chunk, in the manifest.
const CHAIN: usize = 72;
/// The size of the payload, in the manifest.
const PAYLOAD: usize = 36;
/// The binary logarithm of a chunk's payload, in the manifest.
const CHUNK: usize = 25;

/// The keys of the device, an image for it, and the image sealed in every form.
struct Made {
    root: SigningKey,
    key_block: [u8; 256],
    image: Vec<u8>,
    sealed: Vec<Vec<u8>>,
}

fn made() -> &'static Made {
    static MADE: OnceLock<Made> = OnceLock::new();
    MADE.get_or_init(|| {
        let root = SigningKey::from_seed([1; 32]).expect("its id is not 0");
        let keks = [Kek::new([5; 32]).expect("its id is not 0")];
        let key_block = key_block(&[root.public()], &keks, 0, 0, false).expect("it has room");
        let mut image: Vec<u8> = (0..2100).map(|i: u32| ((i * 31) ^ (i >> 8)) as u8 & 0x3F).collect();
        image[..4].copy_from_slice(&0x2001_FFC0_u32.to_le_bytes());
        image[4..8].copy_from_slice(&(PROGRAM.base + 0x101).to_le_bytes());
        let sealed = (0..8_u8)
            .map(|form| {
                let sealer = Sealer {
                    vendor_id: VENDOR_ID,
                    product_code: PRODUCT_CODE,
                    version: 1,
                    counter: 5,
                    encrypt_for: if form & 1 != 0 { &keks } else { &[] },
                    compress: form & 2 != 0,
                    chunk: if form & 4 != 0 { 9 } else { 11 },
                    ..Sealer::default()
                };
                sealer.seal(&image, &root).expect("it can be sealed")
            })
            .collect();
        Made { root, key_block, image, sealed }
    })
}

/// The number of bytes before the chunks.
fn head_of(file: &[u8]) -> usize {
    let mut have = 8;
    loop {
        match head_size(&file[..have]).expect("it is a sealed image") {
            size if size == have => return have,
            size => have = size,
        }
    }
}

/// Changes bytes as the input says, from its count on.
fn damage(bytes: &mut [u8], input: &mut Input<'_>) {
    for _ in 0..input.byte().unwrap_or(0) & 7 {
        let Some([low, high, value]) = input.array() else { return };
        let at = usize::from(u16::from_le_bytes([low, high])) % bytes.len();
        bytes[at] = value;
    }
}

/// A file of the holder of a key: manifest or payload are as the input says, the rest fits.
fn hostile(file: &[u8], payload_too: bool, input: &mut Input<'_>) -> Vec<u8> {
    let mut manifest = file[..head_of(file) - SIGNATURE].to_vec();
    let mut chunks = file[head_of(file)..].to_vec();
    if payload_too {
        let size = 1 << manifest[CHUNK];
        let mut payload: Vec<u8> =
            chunks.chunks(HASH + size).flat_map(|chunk| &chunk[HASH..]).copied().collect();
        damage(&mut payload, input);
        let mut next = [0; HASH];
        let mut chain: Vec<Vec<u8>> = Vec::new();
        for data in payload.chunks(size).rev() {
            let chunk = [&next[..], data].concat();
            next = hash(&chunk);
            chain.push(chunk);
        }
        chunks = chain.into_iter().rev().flatten().collect();
        manifest[PAYLOAD..PAYLOAD + 4].copy_from_slice(&(payload.len() as u32).to_le_bytes());
        manifest[CHAIN..CHAIN + HASH].copy_from_slice(&next);
    } else {
        damage(&mut manifest, input);
    }
    let signature = made().root.sign(&[&DOMAIN[..], &manifest].concat());
    let header = &file[head_of(file) - SIGNATURE..][..SIGNATURE - 64];
    [&manifest[..], header, &signature, &chunks].concat()
}

type Sealed<'b, 'f> = Bootloader<'b, &'f mut ModelFlash, Journal, 1>;

fn device<'b, 'f>(
    flash: &'f mut ModelFlash,
    buffer: &'b mut [u8],
    room: &'b mut SealedMemory,
) -> Sealed<'b, 'f> {
    Boot::new(&STANDARD_1.config, BOARD_NODE).on(flash, buffer, room.sealed())
}

fn settle(device: &mut Sealed<'_, '_>) {
    for _ in 0..2_000_000 {
        if device.step() == Step::Idle && !device.busy() {
            return;
        }
    }
    panic!("the work never ends");
}

fn status(device: &mut Sealed<'_, '_>) -> u32 {
    let mut bytes = [0; 4];
    assert_eq!(device.read(STATUS, &mut bytes), Ok(4));
    u32::from_le_bytes(bytes)
}

/// Sends a file in these pieces, seven bytes each after them; returns whether the device has
/// installed it. `until`: the download is cancelled there.
fn send(device: &mut Sealed<'_, '_>, file: &[u8], pieces: &mut Input<'_>, until: Option<usize>) -> bool {
    device.write(CONTROL, &[CLEAR]).expect("CLEAR");
    settle(device);
    if device.download_start(DATA, None).is_err() {
        return false;
    }
    let mut rest = file;
    while !rest.is_empty() {
        let (size, steps) = pieces.byte().map_or((7, 0), |byte| (usize::from(byte & 31) + 1, byte >> 5));
        let (piece, behind) = rest.split_at(size.min(rest.len()));
        let sent = file.len() - rest.len();
        if until.is_some_and(|until| sent >= until) {
            device.download_cancel(DATA);
            settle(device);
            return false;
        }
        for _ in 0..steps {
            device.step();
        }
        for waits in 0.. {
            if device.download_space(DATA, false) >= piece.len() {
                break;
            }
            assert!(waits < 2_000_000, "there is never room");
            device.step();
        }
        if device.download_data(DATA, piece).is_err() {
            device.download_cancel(DATA);
            settle(device);
            return false;
        }
        rest = behind;
    }
    let ended = device.download_end(DATA).is_ok();
    settle(device);
    ended && status(device) == 0
}

fn verifies(flash: &ModelFlash) -> bool {
    let journal = Journal::open(flash, LAYOUT.parameters);
    verify(flash, &journal, &LAYOUT, CrcKind::Crc32, 1).is_ok()
}

coboot_fuzz::target!(|bytes: &[u8]| {
    let Made { key_block, image, sealed, .. } = made();
    let mut input = Input::new(bytes);
    let Some([form, kind]) = input.array() else { return };
    let good = &sealed[usize::from(form & 7)];
    let signed = kind & 3 >= 2;
    let file = match kind & 3 {
        0 => good.clone(),
        1 => {
            let mut file = good.clone();
            damage(&mut file, &mut input);
            let len = usize::from(input.byte().unwrap_or(0)) * 16;
            if form & 8 != 0 {
                file.truncate(len.max(1));
            }
            file
        }
        mode => hostile(good, mode == 3, &mut input),
    };
    let until = if kind & 4 != 0 { input.byte().map(|at| usize::from(at) * 16) } else { None };
    let mut flash = ModelFlash::new(&CHIP);
    flash.poke(LAYOUT.key_block().base, key_block);
    let mut room = Box::<SealedMemory>::default();
    let mut buffer = [0; 256];
    let mut target = device(&mut flash, &mut buffer, &mut room);
    settle(&mut target);
    let installed = send(&mut target, &file, &mut input, until);
    flash.power_on();
    assert!(!installed || verifies(&flash), "the device says that it is installed");
    if until.is_none() && file == *good {
        assert!(installed, "a good image is refused");
    }
    if verifies(&flash) {
        let head = Head(&file[..head_of(&file)]);
        let cells = &flash.cells(PROGRAM)[..head.size() as usize];
        assert!(hash(cells) == *head.image_hash(), "what was installed was not signed");
        assert!(signed || cells == &image[..], "what was installed was not sealed");
        assert!(signed || file == *good, "a damaged image is installed");
    }
    for region in &flash.touched {
        let [a, b] = LAYOUT.parameters;
        let inside = [PROGRAM, a, b];
        assert!(inside.iter().any(|own| own.contains(region.base, region.size)), "{region:?} was written");
    }

    // A signed file may have raised counter and epoch beyond those of the good one.
    if !signed && is_eighth(bytes) {
        let mut room = Box::<SealedMemory>::default();
        let mut buffer = [0; 256];
        let mut target = device(&mut flash, &mut buffer, &mut room);
        settle(&mut target);
        assert!(send(&mut target, good, &mut Input::new(&[]), None), "a good image is refused");
        assert!(flash.cells(PROGRAM).starts_with(image));
    }
});
