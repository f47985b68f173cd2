//! What can be sent to a device: RAM images that may run on it and others, and programs.

use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;

use coflash_core::file::sealed::{key_block, Sealer, SigningKey};
use kit::random::Random;
use kit::renewal::{crc_of, image_of, BOARD, HOME, SOUND, STAGING};
use kit::rig::{block, crc32, hex, program, words, Setup, PRODUCT_CODE, VENDOR_ID};
use shared_abi::ram_image::Header;
use shared_abi::renewal::BOOTLOADER;

/// What a download contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Content {
    /// The RAM image of a bootloader: 0 to 3 may run here, 4 is damaged, and 5 is for another board.
    Image(u8),
    /// A program with this number, for its place.
    Program(u8, Extent),
    /// Bytes of this seed. Some begin as valid data do.
    Noise(u64),
}

/// What of it is one transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// This block of a block file, counted from 0, modulo their number.
    Block(usize),
    /// All of it, raw or sealed.
    Whole,
    /// All of it as Intel HEX. (A sealed device has no other form than sealed.)
    Hex,
}

/// What is wrong with a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flaw {
    None,
    /// A flipped bit in this byte, modulo the length.
    Bit(usize),
    /// A wrong CRC of a block, or checksum of a record.
    Crc,
    /// This address, of the data or of the program's start.
    Address(u32),
    /// The identity of another product.
    Product,
    /// Its end is missing: so many thousandths.
    Short(usize),
}

/// A transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sent {
    pub content: Content,
    pub part: Part,
    pub flaw: Flaw,
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
    /// So many bytes, and no fewer than 8.
    Bytes(usize),
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
    /// Where the first byte is.
    base: u32,
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

impl Sent {
    /// The bytes of the transfer.
    #[must_use]
    pub fn bytes(self, setup: &'static Setup) -> Vec<u8> {
        let file = file(setup, self.content);
        let (mut bytes, is_block) = match (self.part, self.flaw) {
            (Part::Block(block), _) => (file.blocks[block % file.blocks.len()].clone(), !setup.takes_sealed),
            (Part::Hex, Flaw::Address(base)) if !setup.takes_sealed => return hex(base, &file.plain),
            (Part::Hex, _) if !setup.takes_sealed => (hex(file.base, &file.plain), false),
            _ => (file.whole.clone(), false),
        };
        let len = bytes.len();
        let product = || bytes.windows(4).position(|word| word == PRODUCT_CODE.to_le_bytes());
        let other_word = match self.flaw {
            // The header of a block has its address, and a program begins with its vector table.
            Flaw::Address(address) => Some((4, address)),
            // Of the control block, or of the label.
            Flaw::Product => product().map(|at| (at, !PRODUCT_CODE)),
            _ => None,
        };
        if let Some((at, word)) = other_word {
            bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
            if is_block {
                let crc = crc32(&bytes[..len - 4]).to_le_bytes();
                bytes[len - 4..].copy_from_slice(&crc);
            }
        }
        match self.flaw {
            Flaw::Bit(n) => bytes[n % len] ^= 1 << (n / len % 8),
            Flaw::Crc => bytes[len - 1] ^= 1,
            Flaw::Short(thousandths) => bytes.truncate(len * (1000 - thousandths) / 1000),
            _ => {}
        }
        bytes
    }

    /// The CRC of the program that the transfer makes or completes, if it is accepted.
    pub(crate) fn crc(self, setup: &'static Setup, sub: u8) -> u32 {
        // Any beginning of a program is one, too, and data may be any bytes.
        let is_raw = (self.part == Part::Whole || setup.is_data(sub)) && !setup.takes_sealed;
        if is_raw {
            crc32(&self.bytes(setup))
        } else {
            file(setup, self.content).crc
        }
    }

    /// Whether it is no block of several: its first bytes may be accepted, and the rest not.
    pub(crate) fn is_stream(self, setup: &Setup, sub: u8) -> bool {
        !matches!(self.part, Part::Block(_)) || setup.takes_sealed || setup.is_data(sub)
    }

    /// Whether it has data that this program may have.
    pub(crate) fn fits(self, setup: &'static Setup, sub: u8) -> bool {
        let is_its = matches!(self.content, Content::Program(number, _) if number == sub);
        let is_sound = || self.bytes(setup) == Self { flaw: Flaw::None, ..self }.bytes(setup);
        // Another address is in the first bytes; any other flaw may come after accepted ones.
        let is_late = self.is_stream(setup, sub) && !matches!(self.flaw, Flaw::Address(_));
        setup.is_data(sub) || is_its && (is_late || is_sound())
    }
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
            let (size, fill) = match extent {
                Extent::Small => (0x500, 0),
                Extent::Bytes(size) => (size, size as u8),
                Extent::Large => ((end - region.base) as usize, 0x10),
                Extent::Untold => ((end - region.base) as usize, 0x20),
            };
            // Nearly all of the flash in few blocks.
            let chunk = if size > 0x800 { 1000 } else { 200 };
            (number, region.base, chunk, 5, program(region, PRODUCT_CODE, size, number | fill))
        }
        Content::Noise(seed) => {
            let mut random = Random(seed);
            let starts: [&[u8]; 5] = [b":020", &[0; 4], &[1, 0, 0, 0], &[0xC0, 0xFF, 0x01, 0x20], &[0xFF; 4]];
            let mut bytes = random.pick(&starts).to_vec();
            bytes.extend((0..8 + random.below(300)).map(|_| random.below(256) as u8));
            // Of no form: it has neither heads nor a seal.
            let crc = crc32(&bytes);
            return File { plain: bytes.clone(), blocks: vec![bytes.clone()], whole: bytes, base: 0, crc };
        }
    };
    let crc = if number == BOOTLOADER { crc_of(&plain) } else { crc32(&plain) };
    if setup.takes_sealed {
        let (vendor_id, product_code, program) = (VENDOR_ID, PRODUCT_CODE, number);
        let sealer = Sealer { vendor_id, product_code, program, version: 1, counter, ..Sealer::default() };
        let whole = sealer.seal(&plain, &root()).expect("it can be sealed");
        return File { plain, blocks: vec![whole.clone()], whole, base, crc };
    }
    let size = plain.len() as u32;
    let is_told = !matches!(content, Content::Image(_) | Content::Program(_, Extent::Untold));
    let told = if is_told { size } else { 0 };
    let mut blocks = vec![block(0, 0, &words(&[told, VENDOR_ID, PRODUCT_CODE]))];
    for (n, data) in (0..).zip(plain.chunks(chunk)) {
        blocks.push(block(1 + n, base + n * chunk as u32, data));
    }
    blocks.push(block(u32::MAX, 0, &words(&[size, crc32(&plain)])));
    File { whole: plain.clone(), plain, blocks, base, crc }
}
