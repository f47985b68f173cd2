//! What can be sent to a device: RAM images that may run on it and others, and programs.

use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;
use std::sync::OnceLock;

use coflash_core::file::sealed::{key_block, Sealer, SigningKey};
use kit::renewal::{crc_of, image_of, BOARD, HOME, SOUND, STAGING};
use kit::rig::{block, crc32, program, words, Setup, PRODUCT_CODE, VENDOR_ID};
use shared_abi::ram_image::Header;
use shared_abi::renewal::BOOTLOADER;

/// What a download contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Content {
    /// The RAM image of a bootloader: [`Content::OLD`] to [`Content::NEWEST`] may run here; then a damaged
    /// one, and one for another board.
    Image(u8),
    /// A program for its place.
    Program {
        /// Its number.
        number: u8,
        /// Its size.
        extent: Extent,
    },
}

/// The size of a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Extent {
    /// It leaves staging alone.
    Small,
    /// It reaches into staging, or nearly fills its flash.
    Large,
    /// The same, and its control block does not tell it.
    Untold,
}

impl Content {
    /// The bootloader of a new device.
    pub const OLD: Self = Self::Image(0);
    /// The one that a tool installs at last.
    pub const NEWEST: Self = Self::Image(3);
    /// Those that an attack sends.
    pub const SENT: [Self; 6] =
        [Self::Image(1), Self::Image(1), Self::Image(2), Self::Image(2), Self::Image(4), Self::Image(5)];
}

/// Data bytes of a block of an image, and of a program.
const CHUNKS: [usize; 2] = [200, 1000];

fn root() -> SigningKey {
    SigningKey::from_seed([1; 32]).expect("its id is not 0")
}

/// The keys of a sealed device.
pub fn keys() -> [u8; 256] {
    key_block(&[root().public()], &[], 0, 0, false).expect("it has room for them")
}

/// The bytes as they are in flash.
pub fn plain(setup: &Setup, content: Content) -> Vec<u8> {
    match content {
        Content::Image(number) => {
            let counter = 1 + u32::from(number);
            let host = setup.host();
            let board = if number == 5 { !BOARD } else { BOARD };
            let header = Header {
                counter,
                board,
                features: host.features,
                vendor: 0,
                product: 0,
                version: counter,
                ..SOUND
            };
            let mut image = image_of(header, 0x200 + 0x40 * usize::from(number % 4), number, true);
            if number == 4 {
                image[0x100] ^= 1;
            }
            image
        }
        Content::Program { number, extent } => {
            let region = setup.region(number);
            let end = if region.end() > STAGING.base { STAGING.base + 0x180 } else { region.end() - 0x80 };
            let size = if extent == Extent::Small { 0x500 } else { (end - region.base) as usize };
            program(region, PRODUCT_CODE, size, number | (extent as u8) << 4)
        }
    }
}

/// The CRC by which a device knows it.
pub fn crc(setup: &Setup, content: Content) -> Option<u32> {
    let bytes = plain(setup, content);
    Some(if matches!(content, Content::Image(_)) { crc_of(&bytes) } else { crc32(&bytes) })
}

/// Whether an image with this CRC may run on any of the devices.
pub fn may_run(crc: u32) -> bool {
    static CRCS: OnceLock<Vec<u32>> = OnceLock::new();
    let all = || {
        kit::rig::RENEWALS.iter().flat_map(|setup| (0..4).filter_map(|n| self::crc(setup, Content::Image(n))))
    };
    CRCS.get_or_init(|| all().collect()).contains(&crc)
}

/// The blocks of a block file, or the only part of a sealed image; and all of it for one transfer.
pub struct File {
    /// Each is a transfer.
    pub blocks: Vec<Vec<u8>>,
    /// A raw image, or a sealed one.
    pub whole: Vec<u8>,
}

/// The file with this content for a device.
pub fn file(setup: &'static Setup, content: Content) -> Rc<File> {
    thread_local! {
        static FILES: RefCell<HashMap<(&'static str, Content), Rc<File>>> = RefCell::default();
    }
    FILES.with(|files| {
        let make = || Rc::new(make(setup, content));
        files.borrow_mut().entry((setup.name, content)).or_insert_with(make).clone()
    })
}

fn make(setup: &Setup, content: Content) -> File {
    let plain = plain(setup, content);
    let (base, number, counter) = match content {
        Content::Image(number) => (HOME.base, BOOTLOADER, 1 + u32::from(number)),
        Content::Program { number, .. } => (setup.region(number).base, number, 5),
    };
    if setup.takes_sealed {
        let sealer = Sealer {
            vendor_id: VENDOR_ID,
            product_code: PRODUCT_CODE,
            program: number,
            version: 1,
            counter,
            ..Sealer::default()
        };
        let whole = sealer.seal(&plain, &root()).expect("it can be sealed");
        return File { blocks: vec![whole.clone()], whole };
    }
    let size = plain.len() as u32;
    let is_told = matches!(content, Content::Program { extent: Extent::Small | Extent::Large, .. });
    let told = if is_told { size } else { 0 };
    let mut blocks = vec![block(0, 0, &words(&[told, VENDOR_ID, PRODUCT_CODE]))];
    let chunk = CHUNKS[usize::from(number != BOOTLOADER)];
    for (n, data) in (0..).zip(plain.chunks(chunk)) {
        blocks.push(block(1 + n, base + n * chunk as u32, data));
    }
    blocks.push(block(u32::MAX, 0, &words(&[size, crc32(&plain)])));
    File { blocks, whole: plain }
}
