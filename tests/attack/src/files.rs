//! What can be sent to a device: RAM images that may run on it and others, and programs.

use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;

use coflash_core::file::sealed::{key_block, Sealer, SigningKey};
use kit::renewal::{crc_of, image_of, BOARD, HOME, SOUND, STAGING};
use kit::rig::{block, crc32, program, words, Setup, PRODUCT_CODE, VENDOR_ID};
use shared_abi::ram_image::Header;
use shared_abi::renewal::BOOTLOADER;

/// What a download contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Content {
    /// The RAM image of a bootloader: 0 to 3 may run here, 4 is damaged, and 5 is for another board.
    Image(u8),
    /// A program with this number, for its place.
    Program(u8, Extent),
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

/// The bootloader of a new device.
pub const OLD: Content = Content::Image(0);
/// The one that a tool installs at last.
pub const NEWEST: Content = Content::Image(3);

pub struct File {
    /// The bytes in flash.
    pub plain: Vec<u8>,
    /// The blocks of a block file, or the only part of a sealed image: each is a transfer.
    pub blocks: Vec<Vec<u8>>,
    /// Raw or sealed, for one transfer.
    pub whole: Vec<u8>,
    /// The CRC by which a device knows it.
    pub crc: u32,
}

/// The file with this content for a device.
pub fn file(setup: &'static Setup, content: Content) -> Rc<File> {
    thread_local! {
        static FILES: RefCell<HashMap<(&'static str, Content), Rc<File>>> = RefCell::default();
    }
    let make = || Rc::new(make(setup, content));
    FILES.with(|files| files.borrow_mut().entry((setup.name, content)).or_insert_with(make).clone())
}

/// Whether an image with this CRC may run on a device.
pub fn may_run(setup: &'static Setup, crc: u32) -> bool {
    (0..4).any(|number| file(setup, Content::Image(number)).crc == crc)
}

fn root() -> SigningKey {
    SigningKey::from_seed([1; 32]).expect("its id is not 0")
}

/// The keys of a sealed device.
pub fn keys() -> [u8; 256] {
    key_block(&[root().public()], &[], 0, 0, false).expect("it has room for them")
}

fn make(setup: &Setup, content: Content) -> File {
    let (number, base, chunk, counter, plain) = match content {
        Content::Image(which) => {
            let counter = 1 + u32::from(which);
            let board = if which == 5 { !BOARD } else { BOARD };
            let features = setup.host().features;
            let of = Header { counter, board, features, vendor: 0, product: 0, version: counter, ..SOUND };
            let mut image = image_of(of, 0x200 + 0x40 * usize::from(which % 4), which, true);
            image[0x100] ^= u8::from(which == 4);
            (BOOTLOADER, HOME.base, 200, counter, image)
        }
        Content::Program(number, extent) => {
            let region = setup.region(number);
            let end = if region.end() > STAGING.base { STAGING.base + 0x180 } else { region.end() - 0x80 };
            let size = if extent == Extent::Small { 0x500 } else { (end - region.base) as usize };
            let image = program(region, PRODUCT_CODE, size, number | (extent as u8) << 4);
            (number, region.base, 1000, 5, image)
        }
    };
    let crc = if number == BOOTLOADER { crc_of(&plain) } else { crc32(&plain) };
    if setup.takes_sealed {
        let (vendor_id, product_code, program) = (VENDOR_ID, PRODUCT_CODE, number);
        let sealer = Sealer { vendor_id, product_code, program, version: 1, counter, ..Sealer::default() };
        let whole = sealer.seal(&plain, &root()).expect("it can be sealed");
        return File { plain, blocks: vec![whole.clone()], whole, crc };
    }
    let size = plain.len() as u32;
    let told = if matches!(content, Content::Program(_, Extent::Small | Extent::Large)) { size } else { 0 };
    let mut blocks = vec![block(0, 0, &words(&[told, VENDOR_ID, PRODUCT_CODE]))];
    for (n, data) in (0..).zip(plain.chunks(chunk)) {
        blocks.push(block(1 + n, base + n * chunk as u32, data));
    }
    blocks.push(block(u32::MAX, 0, &words(&[size, crc32(&plain)])));
    File { whole: plain.clone(), plain, blocks, crc }
}
